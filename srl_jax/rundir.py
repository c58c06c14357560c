"""A run directory has one writer at a time."""

import contextlib
import fcntl
import json
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path

from srl_jax.errors import ConfigError

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
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _refusal(run, descriptor) from None
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def held(run: Path) -> Iterator[None]:
    """Holds a run directory, which exists, for this process.

    The lock goes with the process, however it ends; the file only says who has it.

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
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            refusal = _refusal(run, descriptor)
            os.close(descriptor)
            raise refusal from None
        # The one before us may have removed the file between our opening and locking it.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                break
        os.close(descriptor)
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


def _refusal(run: Path, descriptor: int) -> ConfigError:
    holder = "another process"
    try:
        about = json.loads(os.pread(descriptor, 1000, 0))
        holder = f"process {int(about['pid'])} on {about['host']:.100} (since {about['since']:.30})"
    except (ValueError, KeyError, TypeError, OSError):
        pass
    return ConfigError(f"--out={run}: {holder} is writing there; wait for it, or name another directory")
