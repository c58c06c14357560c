"""Run directories: how one is made or replaced, and the lock that gives it one writer at a time."""

import contextlib
import fcntl
import functools
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError, saving
from srl_jax.files import display

LOCK = "lock"
ASIDE = ".overwritten"
"""What lay in a run directory, until the run that replaces it has begun."""
MOVING, GONE = f"{ASIDE}.moving", f"{ASIDE}.deleted"
"""The same, on its way there or back, and once nobody needs it."""


def check_free(run: Path) -> None:
    """Whether no process holds a run directory; writes nothing.

    Raises:
        ConfigError: one does; the line says which one.
    """
    try:
        descriptor = os.open(run / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return
    try:
        _lock(descriptor, fcntl.LOCK_SH)
    except BlockingIOError:
        raise _refusal(run, descriptor) from None
    finally:
        os.close(descriptor)


def is_free(run: Path) -> bool:
    """Whether no process holds a run directory; writes nothing."""
    try:
        check_free(run)
    except ConfigError:
        return False
    return True


@contextlib.contextmanager
def held(run: Path) -> Iterator[None]:
    """Holds a run directory, which exists, for this process.

    The lock goes with the process, however it ends; the file only says who has it. On a file system without
    locks a line says that nothing keeps another process away.

    Raises:
        ConfigError: another process holds it; the line says which one.
    """
    path = run / LOCK
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}") from None
        try:
            without = _lock(descriptor, fcntl.LOCK_EX)
        except BlockingIOError:
            refusal = _refusal(run, descriptor)
            os.close(descriptor)
            raise refusal from None
        # The one before us may have removed the file between our opening and locking it.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                break
        os.close(descriptor)
    if without:
        _say_without(without, os.fstat(descriptor).st_dev)
    try:
        about = {"pid": os.getpid(), "host": platform.node(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
            os.truncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps(about).encode(), 0)
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


@contextlib.contextmanager
def run_directory(
    path: Path, config: Config | None, seeds: Sequence[int] = ()
) -> Iterator[Callable[[], None]]:
    """Makes the run directory with its config.json, and yields what deletes the run that lay there before.

    That is called once the new run has begun; until then the old one is set aside, in `ASIDE`. It comes back
    if something ends the new run before: here, or in `put_back` where the process was killed. What was made
    here goes again if what follows refuses the config.

    Args:
        path: of a directory that may be made, or may be emptied: a run that lies there is deleted.
        config: resolved; written to config.json. None: the directory is for those of several seeds.
        seeds: that one process trains in step, for config.json; none of a run by itself.

    Raises:
        ConfigError: it cannot be made, or another process writes there, or to a seed's directory in it.
        SaveError: config.json could not be written, or by what is yielded: the old run cannot be deleted.
    """
    made, under_way = [], False

    def begun() -> None:
        nonlocal under_way
        if (path / ASIDE).exists():
            with saving(path / ASIDE, "not deleted"):
                os.rename(path / ASIDE, path / GONE)
            shutil.rmtree(path / GONE, ignore_errors=True)
        under_way = True

    try:
        try:
            missing = [p for p in (path, *path.absolute().parents) if not p.exists()]
            for directory in reversed(missing):
                directory.mkdir()
                made.append(directory)
        except OSError as error:
            raise ConfigError(f"--out={path}: {error.strerror}") from None
        with held(path):
            for seed in path.glob("seed*"):
                check_free(seed)
            try:
                try:
                    _set_aside(path)
                    if config is not None:
                        config.save(path, seeds)
                except OSError as error:
                    raise SaveError(f"--out={path}: {error.strerror}") from None
                yield begun
            except BaseException as error:
                if not under_way:
                    with contextlib.suppress(OSError):
                        if not _restored(path) and isinstance(error, ConfigError):
                            _empty(path, LOCK)
                raise
            begun()
    except ConfigError:
        with contextlib.suppress(OSError):
            for directory in reversed(made):
                directory.rmdir()
        raise


def put_back(path: Path) -> None:
    """Brings the run back that a killed process had set aside, see `run_directory`, and says so in a line.

    Raises:
        ConfigError: another process holds the directory.
        SaveError: it cannot be brought back.
    """
    if any((path / name).exists() for name in (ASIDE, MOVING, GONE)):
        with held(path), saving(path, "what was to be overwritten is not back"):
            if _restored(path):
                display.say(f"{path}: what lay there is back: the run that was to replace it never began")


def _set_aside(path: Path) -> None:
    """Moves what lies in a directory into its `ASIDE`, if anything does."""
    _restored(path)
    if not (entries := [entry for entry in path.iterdir() if entry.name not in (LOCK, GONE)]):
        return
    (path / MOVING).mkdir()
    for entry in entries:
        os.rename(entry, path / MOVING / entry.name)
    os.rename(path / MOVING, path / ASIDE)


def _restored(path: Path) -> bool:
    """Whether anything was set aside; it is where it was then. Can be done again, wherever it was killed."""
    shutil.rmtree(path / GONE, ignore_errors=True)
    if (path / ASIDE).exists():  # all of it: what else lies there is the new run's
        _empty(path, LOCK, ASIDE)
        os.rename(path / ASIDE, path / MOVING)
    if not (path / MOVING).exists():
        return False
    for entry in (path / MOVING).iterdir():
        os.rename(entry, path / entry.name)
    (path / MOVING).rmdir()
    return True


def _empty(path: Path, *but: str) -> None:
    """Deletes what lies in a directory, but for what has one of these names."""
    for entry in path.iterdir():
        if entry.name not in but:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()


def _lock(descriptor: int, how: int) -> str:
    """Locks a file, or says why there are no locks where it lies; "" where it is locked.

    Raises:
        BlockingIOError: another process has it.
    """
    try:
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:  # ENOSYS, ENOLCK, EOPNOTSUPP, ...: Lustre, NFS and others, as they are mounted
        return error.strerror or str(error)
    return ""


@functools.cache
def _say_without(why: str, device: int) -> None:
    """Said once of a file system, which a sweep has many runs on."""
    display.say(f"lock: run directories are not locked ({why}): see to it that no two processes write to one")


def _refusal(run: Path, descriptor: int) -> ConfigError:
    holder = "another process"
    try:
        about = json.loads(os.pread(descriptor, 1000, 0))
        holder = f"process {int(about['pid'])} on {about['host']:.100} (since {about['since']:.30})"
    except (ValueError, KeyError, TypeError, OSError):
        pass
    return ConfigError(f"--out={run}: {holder} is writing there; wait for it, or name another directory")
