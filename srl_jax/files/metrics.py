"""A run's numbers on disk: metrics.jsonl. Imports no jax.

Every key whose value depends on the clock begins with `wall_` (`wall_s`, `wall_steps_per_s`); every
other value must be a function of the configuration and the seed. Two runs of the same seed on the
same machine therefore have equal rows once `strip_wall` has been applied.
"""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax.errors import ConfigError, saving
from srl_jax.files.reading import ROWS, parse_json, read_bytes

KINDS = ("train", "eval", "final")
LEADING = ("kind", "env_steps", "updates", "wall_s")
"""The keys that every row begins with, in this order; the rest follow sorted."""


class Mark(NamedTuple):
    """A place in a file.

    Attributes:
        bytes: before it.
        sha256: of these.
    """

    bytes: int
    sha256: str


class MetricsWriter:
    """Appends rows to a file of JSON objects, one a line, each flushed as it is written.

    An existing file is continued: from a `Mark`, which cuts it back to what it was then, or from its end.
    What a killed process left of its last line is removed first, so that the next row does not run into it.

    Numbers are written so that they read back as they were: float32 by the shortest decimal that
    gives the same float32, float64 likewise. JSON has no NaN and no infinity: all three of NaN, inf
    and -inf are written as null, which `np.array(values, float)` reads as NaN.

    Args:
        path: the file, made if it does not exist; its directory must exist.
        mark: from `mark`, or None.

    Raises:
        ConfigError: the file does not begin with what it held at the mark; it is as it was.
        SaveError: it cannot be opened, or its last line not be ended.
    """

    def __init__(self, path: str | os.PathLike, mark: Mark | None = None):
        if mark is not None:
            _cut(Path(path), mark)
        with saving(path, "not opened"):
            _mend(Path(path))
            self._digest = hashlib.sha256(Path(path).read_bytes() if os.path.isfile(path) else b"")
            self._file = open(path, "ab")

    def write(
        self, kind: str, env_steps: int, updates: int, wall_s: float, values: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Writes one row.

        Args:
            kind: one of `KINDS`.
            env_steps: agent decisions so far, over all environments.
            updates: gradient updates so far.
            wall_s: seconds since the run began, written to the millisecond.
            values: key -> a number, bool, string, None, or an array or sequence of those. Device
                arrays are fetched here: this is where the host waits for them.

        Returns:
            The row, as `read_metrics` will read it.

        Raises:
            ValueError: for another kind, or a value under one of the leading keys.
            TypeError: for a value of another type.
        """
        if kind not in KINDS:
            raise ValueError(f"kind is {kind!r}; valid: {', '.join(KINDS)}")
        if clash := sorted(set(values) & set(LEADING)):
            raise ValueError(f"values may not hold the leading keys {', '.join(clash)}")
        row = {
            "kind": kind,
            "env_steps": int(env_steps),
            "updates": int(updates),
            "wall_s": round(float(wall_s), 3),
            **{key: _plain(key, values[key]) for key in sorted(values)},
        }
        line = (json.dumps(row, allow_nan=False) + "\n").encode()
        self._file.write(line)
        self._file.flush()
        self._digest.update(line)
        return row

    def mark(self) -> Mark:
        """Where the file ends now, flushed to disk."""
        os.fsync(self._file.fileno())
        return Mark(self._file.tell(), self._digest.hexdigest())

    def close(self) -> None:
        """Closes the file. A second call does nothing."""
        self._file.close()

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_metrics(path: str | os.PathLike) -> list[dict[str, Any]]:
    """Reads a metrics.jsonl, also one that is still being written.

    A last line that is cut short (the writer was killed, or is in the middle of it) is left out.

    Returns:
        The rows in the order of the file; null is None.

    Raises:
        OSError: if it cannot be read, see `srl_jax.files.reading.read_bytes`.
        ValueError: if any other line is not a JSON object, naming the file and the line.
    """
    lines = read_bytes(path, ROWS).split(b"\n")
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            if number < len(lines) or line:
                rows.append(parse_row(line))
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"{path}, line {number}: {error}") from None
    return rows


def strip_wall(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row without its `wall_` keys: the part that a seed must reproduce."""
    return {key: value for key, value in row.items() if not key.startswith("wall_")}


def parse_row(line: bytes) -> dict[str, Any]:
    """Reads one line of a metrics.jsonl.

    Raises:
        ValueError: it is not a JSON object, or has a NaN or an infinity.
    """

    def refuse(name):
        raise ValueError(f"{name} is not JSON")

    row = parse_json(line, refuse)
    if not isinstance(row, dict):
        raise ValueError("not a JSON object")
    return row


def _cut(path: Path, mark: Mark) -> None:
    try:
        with open(path, "r+b") as file:
            size = os.fstat(file.fileno()).st_size
            if size < mark.bytes or hashlib.sha256(file.read(mark.bytes)).hexdigest() != mark.sha256:
                raise ConfigError(f"{path}: does not begin with the rows that the checkpoint knows")
            file.truncate(mark.bytes)
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; the checkpoint knows {mark.bytes} bytes of it"
        ) from None


def _mend(path: Path) -> None:
    """Ends the file with a whole line: completes the last one if only its newline is missing."""
    if not path.exists():
        return
    with open(path, "r+b") as file:
        data = file.read()
        whole = data.rfind(b"\n") + 1
        if whole == len(data):
            return
        try:
            parse_row(data[whole:])
            file.write(b"\n")
        except ValueError:
            file.truncate(whole)


def _plain(key: str, value: Any) -> Any:
    """The value in Python's own types, floats finite or None."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, list | tuple):
        return [_plain(key, item) for item in value]
    array = np.asarray(value)
    if array.ndim:
        return [_plain(key, item) for item in array]
    if array.dtype.kind in "biu":
        return array.item()
    if isinstance(value, int):  # larger than any array's
        return value
    try:
        if array.dtype.kind == "c":
            raise TypeError
        # numpy prints the shortest decimal that gives back the same float32; the nearest double to
        # it prints the same. Narrower floats fit in a float32.
        number = float(array if array.dtype == np.float64 else str(array.astype(np.float32)[()]))
        return number if math.isfinite(number) else None
    except (TypeError, ValueError):
        raise TypeError(f"{key}: cannot write a value of type {type(value).__name__}") from None
