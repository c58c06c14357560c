"""A disk that is full: at every operation with which a run writes in turn, and for real.

In turn: in this process, from the n-th operation on (making a directory, opening, half-writing, linking,
renaming) there is no space left, for every n until a run gets to its end before. For real, where this process
may mount one: a run on a small file system. Each time the run ends with one line, its checkpoints are whole,
and it goes on to the end that it has elsewhere once there is room.
"""

import errno
import itertools
import os
import shutil
import subprocess

import jax
import pytest

from srl_jax.errors import ConfigError, SaveError
from srl_jax.files import checkpoint
from tests.soak.conftest import ROOT, SMALL_RUN, different, remains, small_chunks, train_here
from tests.soak.faults import Faults
from tests.soak.kills_test import ENVIRONMENT, command, flags_of, life


@pytest.fixture
def compiled_once():
    """Lives of a run in this process share what they compile, however little that is."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, name)
    jax.config.update(name, 0)
    yield
    jax.config.update(name, before)


def full(name):
    if not name.startswith("removing"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@small_chunks
def resume(run):
    """Goes on with a copy of the small run: one more checkpoint, and its end."""
    assert train_here(*SMALL_RUN, "--steps=240", f"--out={run}", "--resume=auto") == 0


def checkpoints_are_whole(run):
    """Reads all that a reader would take for checkpoints; there are some."""
    folders = list((run / "checkpoints").glob("[0-9]*"))
    for path in folders:
        checkpoint.verify(checkpoint.read_manifest(path))
    return bool(folders)


def test_a_run_whose_disk_is_full_at_any_operation_is_resumed(
    small_run, tmp_path, amount, progress, record_property, capsys, compiled_once
):
    shutil.copytree(small_run, tmp_path / "alone")
    with Faults(tmp_path / "alone", None, full) as counted:
        resume(tmp_path / "alone")
    alone, run, wrong, reached = remains(tmp_path / "alone"), tmp_path / "run", [], {}
    for number in itertools.count(0, amount("every")):
        shutil.copytree(small_run, run)
        line = ""
        with Faults(run, number, full) as faults:
            try:
                resume(run)
            except (SaveError, ConfigError) as error:
                line = str(error)
        if not faults.reached:
            break
        reached[faults.reached] = reached.get(faults.reached, 0) + 1
        told = "No space left on device" in line and "\n" not in line
        # What is only removed needs no room, and what cannot be linked or removed may be left.
        if not told and not faults.reached.startswith("removing"):
            wrong.append((number, faults.reached, line))
        if not checkpoints_are_whole(run):
            wrong.append((number, faults.reached, "no checkpoint"))
        resume(run)
        wrong += [(number, faults.reached, what) for what in different(remains(run), alone)]
        shutil.rmtree(run)
        progress(number, counted.number, "operations")
    for name, times in reached.items():
        record_property(name, times)
    assert not wrong


def test_a_run_on_a_full_disk_ends_with_status_3_and_is_resumed(tmp_path, say, record_property):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)], capture_output=True)
    if mount.returncode:
        pytest.skip("this process may not mount a file system")
    try:
        flags = flags_of("Catch")
        assert life(tmp_path / "alone", flags)[0] == 0
        full_times = 0
        for size in ("4m", "8m", "12m", "20m", "40m", "200m"):
            subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)
            line = command(disk / "run", flags)
            done = subprocess.run(line, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True)
            errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
            say(f"{size}: status {done.returncode}, {errors}")
            if done.returncode == 0:
                break
            assert (done.returncode, len(errors), "Traceback" in done.stderr) == (3, 1, False), done.stderr
            full_times += 1
        assert done.returncode == 0 and full_times
        record_property("ends with status 3", full_times)
        assert different(remains(disk / "run"), remains(tmp_path / "alone")) == []
    finally:
        subprocess.run(["umount", str(disk)], check=False)
