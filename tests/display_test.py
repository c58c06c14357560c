"""srl_jax/display.py: a display that is lost ends nothing, whoever writes to it."""

import contextlib
import errno
import io
import os
import pathlib
import subprocess
import sys

import pytest

from experiments.sweeping import launching, table
from srl_jax import display
from srl_jax.display import Display, Progress
from srl_jax.errors import SaveError
from tests.helpers import SMALL

ROOT = pathlib.Path(__file__).resolve().parents[1]


class Gone(io.StringIO):
    """A stream whose reader goes away after so many writes."""

    def __init__(self, after=0, error=errno.EPIPE):
        super().__init__()
        self.left, self.error = after, error

    def isatty(self):
        return True

    def write(self, text):
        if not self.left:
            raise OSError(self.error, os.strerror(self.error))
        self.left -= 1
        return super().write(text)


@pytest.mark.parametrize("error", [errno.EPIPE, errno.EIO, errno.ENOSPC, errno.EBADF])
def test_what_cannot_be_shown_is_not(error):
    stream = Gone(after=1, error=error)
    shown = Display(stream)
    for text in ("a", "b", "c"):
        assert shown.write(text) == 1
    shown.flush()
    assert stream.getvalue() == "a" and shown.lost.errno == error and not shown.isatty()


def test_a_stream_that_is_closed_or_missing_shows_nothing():
    closed = io.StringIO()
    closed.close()
    for stream in (closed, None):
        shown = Display(stream)
        assert shown.write("a") == 1 and not shown.isatty() and shown.lost
        shown.flush()
    with pytest.raises(OSError, match="fileno"):
        Display(None).fileno()


def test_letters_that_a_stream_does_not_know_are_escaped():
    raw = io.BytesIO()
    shown = Display(io.TextIOWrapper(raw, encoding="ascii", write_through=True))
    shown.write("in Gemälde\n")
    shown.write("more\n")
    assert raw.getvalue() == b"in Gem\\xe4lde\nmore\n" and shown.lost is None


@pytest.mark.parametrize("after", range(6))
def test_progress_and_tables_go_on_without_their_readers(after, tmp_path):
    clock = iter(range(0, 1000, 10)).__next__
    with Progress(10, stream=Gone(after), clock=clock, width=80) as progress:
        for done in range(4):
            progress.update(done)
            progress.note("a line")
    screen = table.Screen(tmp_path, {}, 1, stream=Gone(after), clock=clock)
    for _ in range(3):
        screen.update(launching.View([], {}, [], {}, {}, {}))
        screen.note("a line")


def test_progress_without_stderr_shows_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with Progress(10) as progress:
        progress.update(1)
        progress.note("a line")
    display.say("a line")


def test_a_result_that_is_lost_is_an_error_unless_its_reader_went(monkeypatch):
    for error in (errno.ENOSPC, errno.EIO):
        monkeypatch.setattr(sys, "stdout", Gone(error=error))
        with pytest.raises(SaveError, match=f"standard output: {os.strerror(error)}"):
            display.result("{}")
    monkeypatch.setattr(sys, "stdout", Display(None))
    with pytest.raises(SaveError, match="standard output: Bad file descriptor"):
        display.result("{}")
    monkeypatch.setattr(sys, "stdout", Gone(error=errno.EPIPE))
    display.result("{}")


# Whole processes

CODE = """
from experiments import flags
def main(argv):
    print("Gem\\u00e4lde " * 10_000, flush=True)
    with open("file", "w") as file:
        assert file.fileno() > 2
    return 7
flags.run(main)
"""


def _shell(line, path, **env):
    """The status of a shell command, `PY` being Python on CODE, in a directory."""
    command = line.replace("PY", '"$PYTHON" -c "$CODE"')
    env = {**os.environ, "PYTHON": sys.executable, "CODE": CODE, "PYTHONPATH": str(ROOT), **env}
    done = subprocess.run(
        ["bash", "-c", command], cwd=path, env=env, capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    "line",
    [
        "PY >&-",
        "PY 2>&-",
        "PY <&- >&- 2>&-",
        "PY > /dev/full",
        "PY 2> /dev/full",
        "PY | true; exit ${PIPESTATUS[0]}",
        "PY 2>&1 | head -c 1; exit ${PIPESTATUS[0]}",
    ],
)
def test_an_entry_point_ends_as_it_would_with_a_display(line, tmp_path):
    status, _, said = _shell(line, tmp_path)
    assert (status, said) == (7, "")


def test_an_entry_point_shows_what_it_can(tmp_path):
    status, shown, _ = _shell("PY", tmp_path, PYTHONIOENCODING="ascii")
    assert status == 7 and shown.startswith("Gem\\xe4lde Gem\\xe4lde ")
    status, _, said = _shell("PY", tmp_path, CODE=CODE.replace("return 7", "raise flags.ConfigError('bad')"))
    assert (status, said) == (2, "error: bad\n")


def test_a_run_goes_on_when_the_reader_of_its_progress_goes(tmp_path):
    values = SMALL | {"steps": 400, "eval_every": 40, "eval_games": 1}
    flags = [*(f"--{name}={value}" for name, value in values.items()), "--tune_runtime=off"]
    read, write = os.pipe()
    run = subprocess.Popen(
        [sys.executable, "-m", "experiments.train", *flags, f"--out={tmp_path}/Gemälde"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=write,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        text=True,
    )
    os.close(write)
    with contextlib.closing(os.fdopen(read)) as stream:
        assert stream.readline()  # of evaluation or progress; then nobody reads on
    printed, _ = run.communicate(timeout=120)
    assert run.returncode == 0
    assert f"400 env steps, 45 updates; everything is in {tmp_path}/Gem\\xe4lde" in printed
