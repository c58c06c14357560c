"""Files and JSON that people, or other programs, may have written. Imports no jax."""

import errno
import json
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from srl_jax.errors import ConfigError

SETTINGS = 1 << 24
"""Bytes that a config.json may have."""
ROWS = 1 << 30
"""Bytes that a metrics.jsonl may have."""


def read_bytes(path: str | os.PathLike, limit: int = sys.maxsize) -> bytes:
    """The content of a regular file. A pipe is not waited for, and no device is read.

    Args:
        path: of the file, or of a link to it.
        limit: the bytes that it may have.

    Raises:
        OSError: there is no such file, it is not a regular one, or too large; `strerror` says which.
    """
    path = os.fspath(path)
    try:
        about = os.stat(path)
    except ValueError as error:  # a NUL in the path
        raise OSError(errno.EINVAL, str(error), path) from None
    if not stat.S_ISREG(about.st_mode):
        code = errno.EISDIR if stat.S_ISDIR(about.st_mode) else errno.EINVAL
        raise OSError(code, os.strerror(code) if code == errno.EISDIR else "Not a regular file", path)
    if about.st_size > limit:
        raise OSError(errno.EFBIG, f"File larger than {limit} bytes", path)
    return Path(path).read_bytes()


def read_json(path: str | os.PathLike, limit: int = SETTINGS) -> Any:
    """What a JSON file holds.

    Args:
        path: of the file.
        limit: the bytes that it may have.

    Raises:
        ConfigError: the file cannot be read, or is not JSON as `parse_json` reads it; one line that names it.
    """
    try:
        return parse_json(read_bytes(path, limit))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None


def replace_text(path: Path, text: str) -> None:
    """`replace_bytes` of a text in UTF-8."""
    replace_bytes(path, text.encode("utf-8"))


def replace_bytes(path: Path, data: bytes) -> None:
    """Writes a file at once, flushed to disk: no process that is killed leaves half of it.

    Raises:
        OSError: it could not be written; it is as it was.
    """
    partial = path.with_name(f"{path.name}.partial")
    with open(partial, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def parse_json(data: bytes | str, constant: Callable[[str], Any] | None = None) -> Any:
    """Reads one JSON document, in UTF-8 where it is bytes.

    Args:
        data: the document.
        constant: takes "NaN", "Infinity" or "-Infinity"; None reads them as numbers.

    Raises:
        ValueError: it is none, an object has a key twice, or it is nested too deeply for Python's reader.
    """
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
        return json.loads(text, object_pairs_hook=_object, parse_constant=constant)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{max(names, key=names.count)!r} is there twice")
    return found
