"""A disk that is full: at every operation of writing a checkpoint in turn, and for real.

In turn: in one process, the n-th operation (making a directory, writing, half-writing, flushing, linking,
renaming) says "No space left on device", for every n until none is reached. Each time the checkpoints from
before must be whole and the next save must work. For real, where this process may mount one: a run on a small
file system ends with one line and status 3, and goes on to the end that it has elsewhere once there is room.
"""

import contextlib
import errno
import os
import subprocess
from pathlib import Path
from unittest import mock

from srl_jax import checkpoint, replay
from srl_jax.errors import ConfigError, SaveError

from . import Count, Say, kills
from .small import stopped_run

STEPS_BETWEEN = 30
"""Env steps between two saves."""


class Disk:
    """The file operations of `srl_jax.checkpoint`, of which the n-th finds the disk full.

    Args:
        full_at: n, from 0.
    """

    def __init__(self, full_at: int):
        self._left = full_at
        self.reached = ""

    def operation(self, name: str) -> None:
        """One that needs room."""
        if self._left == 0:
            self.reached = name
        self._left -= 1
        if self.reached:  # and full it stays
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def around(self, name: str, function):
        """The function, as this operation."""

        def call(*arguments, **options):
            self.operation(name)
            return function(*arguments, **options)

        return call

    def write(self, path: Path, *pieces) -> checkpoint.Entry:
        """`checkpoint.write`, which may find no room for the file, or for its second half."""
        self.operation(f"opening {path.suffix}")
        data = b"".join(pieces)
        path.write_bytes(data[: len(data) // 2])
        self.operation(f"writing {path.suffix}")
        return _write(path, *pieces)

    def patches(self) -> list:
        """For `mock.patch`."""
        found = [mock.patch.object(checkpoint, "write", self.write)]
        for name in ("mkdir", "fsync", "link", "replace"):
            found.append(mock.patch.object(os, name, self.around(name, getattr(os, name))))
        return found


_write = checkpoint.write


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    return [in_turn(folder / "turn", short, say), for_real(folder / "real", say)]


def in_turn(folder: Path, short: bool, say: Say) -> Count:
    """Every operation of one checkpoint."""
    with mock.patch.object(replay, "CHUNK_BYTES", 200_000):  # so that there are several
        run = stopped_run(folder, at=400)
    kept = {path.name: contents(path) for path in checkpoint_folders(folder)}
    state = run_state(run)
    tried = failed = 0
    for n in range(0, 1000, 7 if short else 1):
        disk = Disk(n)
        refused = ""
        with contextlib.ExitStack() as stack:
            for patch in disk.patches():
                stack.enter_context(patch)
            try:
                save(run, state)
            except SaveError as error:
                refused = str(error)
        if not disk.reached:
            break
        tried += 1
        now = {path.name: contents(path) for path in checkpoint_folders(folder)}
        # A new one may be in place already when flushing its directory fails: then it must be whole.
        whole = all(is_whole(folder / "checkpoints" / name) for name in now)
        lost = not whole or any(now.get(name, kept[name]) != kept[name] for name in kept)
        lost |= not (set(kept) <= set(now) or len(now) >= 2)
        lines = refused.count("\n") == 0 and "No space left" in refused
        swallowed = disk.reached in ("link",) and not refused  # written instead of linked
        if lost or not (lines or swallowed):
            failed += 1
            say(f"disk: {disk.reached}, operation {n}: {refused or 'no error'}; {sorted(now)}")
        for name in set(now) - set(kept):
            checkpoint.shutil.rmtree(folder / "checkpoints" / name)
    save(run, state)
    failed += not is_whole(checkpoint_folders(folder)[-1])
    return Count("no space at each operation of a checkpoint in turn", tried, failed)


def run_state(run) -> tuple:
    """What there is to save, of a run that has been stopped."""
    (seed,) = run.seeds
    with mock.patch.object(type(seed.report), "snapshot", lambda report: {}):
        state = seed.snapshot(run.state, run.env_steps)
    return state._replace(unchanged=frozenset(sorted(state.unchanged)[::2]))  # some linked, some written


def save(run, state) -> None:
    """A checkpoint of some steps later than the run's."""
    (seed,) = run.seeds
    later = run.env_steps + STEPS_BETWEEN
    seed.save_parameters(run.state.params, later, run.updates, state=state, base=seed.saved)


def checkpoint_folders(run: Path) -> list[Path]:
    """Those that a reader would take for checkpoints."""
    return sorted((run / "checkpoints").glob("[0-9]*"))


def contents(folder: Path) -> dict[str, bytes]:
    """Of all its files."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def is_whole(folder: Path) -> bool:
    """Whether it can be read."""
    try:
        checkpoint.verify(checkpoint.read_manifest(folder))
    except ConfigError:
        return False
    return True


def for_real(folder: Path, say: Say) -> Count:
    """A run on a file system that is too small, which then grows."""
    what = "a run on a file system that is full"
    folder.mkdir()
    disk = folder / "disk"
    disk.mkdir()
    environment = dict(os.environ, JAX_COMPILATION_CACHE_DIR=str(folder / "compiled"))
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)], capture_output=True)
    if mount.returncode:
        return Count(what, 0, 0, "skipped: this process may not mount one")
    try:
        flags = kills.flags_of("Catch")
        say("disk: Catch, left alone")
        alone = kills.reference(folder / "alone", flags, environment)
        ends = []
        for size in ("4m", "6m", "9m", "14m", "200m"):
            subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)
            command = kills.command(folder / "digest", flags)
            command = [
                part.replace(f"--out={folder / 'digest'}", f"--out={disk / 'run'}") for part in command
            ]
            done = subprocess.run(command, cwd=kills.ROOT, env=environment, capture_output=True, text=True)
            errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
            ends.append((done.returncode, len(errors), "Traceback" in done.stderr))
            say(f"disk: {size}: status {done.returncode}, {errors}")
            if done.returncode == 0:
                break
        failed = sum(end != (3, 1, False) for end in ends[:-1]) + (ends[-1][0] != 0) + (len(ends) < 2)
        (disk / "run.digest").write_text((folder / "digest.digest").read_text())
        wrong = kills.differing(disk / "run", alone)
        say(f"disk: differs in {wrong}") if wrong else None
        return Count(
            what, len(ends), failed + bool(wrong), f"ended {len(ends) - 1} times with status 3, then whole"
        )
    finally:
        subprocess.run(["umount", str(disk)], check=False)
