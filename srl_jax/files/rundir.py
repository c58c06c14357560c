"""Run directories: how one is made, and the lock that gives it one writer at a time."""

import contextlib
import fcntl
import functools
import json
import os
import platform
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files import display

LOCK = "lock"


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
def run_directory(path: Path, config: Config) -> Iterator[None]:
    """Makes the run directory with its config.json; unmakes it if what follows refuses the config.

    Args:
        path: of a directory that may be made, or may be emptied: a run that lies there is deleted.
        config: resolved; written to config.json.

    Raises:
        ConfigError: it cannot be made, or another process writes there.
        SaveError: config.json could not be written.
    """
    made, written = [], False
    try:
        try:
            missing = [p for p in (path, *path.absolute().parents) if not p.exists()]
            for directory in reversed(missing):
                directory.mkdir()
                made.append(directory)
        except OSError as error:
            raise ConfigError(f"--out={path}: {error.strerror}") from None
        with held(path):
            try:
                for old in path.iterdir():
                    # The old config.json stays until the new one replaces it: it says that this is a run.
                    if old.name not in (LOCK, "config.json"):
                        shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
                config.save(path)
                written = True
            except OSError as error:
                raise SaveError(f"--out={path}: {error.strerror}") from None
            yield
    except ConfigError:
        # Only what was made here goes: once anything else lies there, all of it stays.
        with contextlib.suppress(OSError):
            if written and [file.name for file in path.iterdir()] == ["config.json"]:
                (path / "config.json").unlink()
        with contextlib.suppress(OSError):
            for directory in reversed(made):
                directory.rmdir()
        raise


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
