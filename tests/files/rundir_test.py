"""srl_jax/files/rundir.py: one writer at a time, whatever becomes of it."""

import errno
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from srl_jax.errors import ConfigError
from srl_jax.files import rundir

ROOT = Path(__file__).resolve().parents[2]
HOLD = """
import sys, time
from pathlib import Path
from srl_jax.files import rundir

with rundir.held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(100)
"""


@pytest.fixture
def holder(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def contents(folder):
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


def test_a_second_process_is_refused_and_told_which_one_is_the_first(tmp_path, holder):
    before = contents(tmp_path)
    for refused in (rundir.check_free, lambda path: rundir.held(path).__enter__()):
        with pytest.raises(ConfigError) as error:
            refused(tmp_path)
        assert re.fullmatch(
            rf"--out={tmp_path}: process {holder.pid} on \S+ \(since [-0-9]+ [:0-9]+\) is writing there; .*",
            str(error.value),
        )
    assert contents(tmp_path) == before


def test_the_lock_of_a_killed_process_is_free(tmp_path, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    before = contents(tmp_path)
    assert "lock" in before
    rundir.check_free(tmp_path)
    assert contents(tmp_path) == before
    with rundir.held(tmp_path):
        assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()
    assert contents(tmp_path) == {}


def test_the_lock_goes_with_its_holder_however_that_ends(tmp_path):
    with pytest.raises(KeyError), rundir.held(tmp_path):
        with pytest.raises(ConfigError, match=f"process {os.getpid()} "), rundir.held(tmp_path):
            pass
        assert "lock" in contents(tmp_path)  # which the refused one has left there
        raise KeyError
    assert contents(tmp_path) == {}
    with rundir.held(tmp_path):
        pass


def test_check_free_writes_nothing(tmp_path):
    rundir.check_free(tmp_path)
    rundir.check_free(tmp_path / "nowhere")
    assert contents(tmp_path) == {} and not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": "x"}', '{"pid": 1}', "\xff"])
def test_a_lock_that_says_nothing_of_its_holder_still_holds(tmp_path, text):
    with rundir.held(tmp_path):
        (tmp_path / "lock").write_bytes(text.encode("latin-1"))
        with pytest.raises(ConfigError, match=f"--out={tmp_path}: another process is writing there"):
            rundir.check_free(tmp_path)


@pytest.mark.parametrize("kind", ["link", "pipe", "directory"])
def test_a_lock_that_is_no_file_is_not_written_through(tmp_path, kind):
    run, other = tmp_path / "run", tmp_path / "other"
    run.mkdir()
    other.write_text("mine")
    if kind == "link":
        (run / "lock").symlink_to(other)
    elif kind == "pipe":
        os.mkfifo(run / "lock")
    else:
        (run / "lock").mkdir()
    rundir.check_free(run)
    if kind == "pipe":
        with rundir.held(run):
            pass
    else:
        with pytest.raises(ConfigError, match=f"{run}/lock: "), rundir.held(run):
            pass
    assert other.read_text() == "mine"


def test_a_full_disk_does_not_keep_a_run_from_its_directory(tmp_path, monkeypatch):
    # What the file says is for people; the lock is the kernel's.
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with rundir.held(tmp_path):
        with pytest.raises(ConfigError, match="is writing there"):
            rundir.check_free(tmp_path)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("error", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EBADF, errno.EINVAL])
def test_a_file_system_without_locks_is_written_to_all_the_same(tmp_path, monkeypatch, capsys, error):
    def flock(*_):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(fcntl, "flock", flock)
    rundir._say_without.cache_clear()
    for _ in range(2):
        rundir.check_free(tmp_path)
        with rundir.held(tmp_path):
            assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()
            rundir.check_free(tmp_path)
        assert contents(tmp_path) == {}
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"not locked ({os.strerror(error)})" in said


@pytest.mark.parametrize("call", [1, 2, 3])
def test_a_lock_that_is_removed_while_it_is_taken_is_made_anew(tmp_path, monkeypatch, call):
    calls, stat = [], os.stat

    def removed(path, *arguments, **options):  # by the one before us, as it ends
        calls.append(path)
        if len(calls) == call:
            os.unlink(tmp_path / "lock")
        return stat(path, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "stat", removed)
        holding = rundir.held(tmp_path)
        holding.__enter__()
    if call <= len(calls):
        with pytest.raises(ConfigError, match="is writing there"):
            rundir.check_free(tmp_path)
    holding.__exit__(None, None, None)
    assert contents(tmp_path) == {}


@pytest.fixture
def impatient():
    """Threads that take turns all the time."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def test_of_many_that_come_and_go_never_two_hold_it(tmp_path, impatient):
    inside, most, failures, held = [], [0], [], [0]

    def come_and_go():
        for _ in range(200):
            try:
                with rundir.held(tmp_path):
                    inside.append(1)
                    most[0] = max(most[0], len(inside))
                    held[0] += 1
                    inside.pop()
            except ConfigError:
                pass
            except Exception as error:
                failures.append(error)

    threads = [threading.Thread(target=come_and_go) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures and most == [1] and held[0] >= 8
    assert contents(tmp_path) == {}
