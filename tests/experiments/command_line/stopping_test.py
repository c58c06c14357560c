"""experiments/command_line/stopping.py: which signals end a program, and which are left alone."""

import os
import signal
import subprocess
import sys
import threading
from signal import SIGHUP, SIGINT, SIGTERM, SIGUSR1

import pytest

from experiments.command_line.stopping import ASKING, WARNING, signals


@pytest.fixture(autouse=True)
def free():
    """Nobody has a use for the signals, also where nohup runs the tests."""
    old = {number: signal.signal(number, signal.SIG_DFL) for number in WARNING}
    yield
    for number, handler in old.items():
        signal.signal(number, handler)


def handlers():
    return [signal.getsignal(number) for number in (*ASKING, *WARNING)]


@pytest.mark.parametrize(
    ("sent", "caught", "again"),
    [
        ([SIGTERM], [SIGTERM], 0),
        ([SIGHUP], [SIGHUP], 0),
        ([SIGUSR1], [SIGUSR1], 0),
        ([SIGINT, SIGTERM], [SIGINT, SIGTERM], 1),  # somebody is impatient
        ([SIGTERM] * 3, [SIGTERM] * 3, 2),
        ([SIGHUP] * 2, [SIGHUP], 0),  # from the shell and from the terminal
        ([SIGTERM, SIGHUP], [SIGTERM], 0),  # systemd sends both
        ([SIGUSR1, SIGTERM], [SIGUSR1], 0),  # a queue warns, then ends the job
        ([SIGHUP, SIGINT, SIGINT], [SIGHUP, SIGINT], 1),
    ],
)
def test_what_is_caught(sent, caught, again):
    before, calls = handlers(), []
    with signals(lambda: calls.append(1)) as found:
        for number in sent:
            os.kill(os.getpid(), number)
    assert found == caught and len(calls) == again
    assert handlers() == before


def test_signals_that_have_another_use_keep_it():
    came = []
    old = signal.signal(SIGHUP, signal.SIG_IGN), signal.signal(SIGUSR1, lambda *_: came.append(1))
    try:
        with signals() as found:
            os.kill(os.getpid(), SIGHUP)
            os.kill(os.getpid(), SIGUSR1)
        assert found == [] and came == [1]
    finally:
        for number, handler in zip((SIGHUP, SIGUSR1), old, strict=True):
            signal.signal(number, handler)


def test_a_program_under_nohup_does_not_hear_its_terminal_close(tmp_path):
    code = (
        "import os, signal\n"
        "from experiments.command_line.stopping import signals\n"
        "with signals() as found:\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    print(found)"
    )
    done = subprocess.run(["nohup", sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n", done


def test_a_thread_that_has_no_signals_is_told_of_none():
    before = handlers()

    def ask():
        with signals() as found:
            assert found == [] and handlers() == before

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert handlers() == before
