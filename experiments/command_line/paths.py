"""Paths that flags name, checked before anything is written. Imports no jax."""

import contextlib
import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from srl_jax.errors import ConfigError


def given(flag: str, text: str) -> Path:
    """The path of what is read.

    Args:
        flag: that it came from.
        text: its value, with or without ~.

    Raises:
        ConfigError: it is empty, as of a variable of the shell that is not set.
    """
    if not text:
        raise ConfigError(f"--{flag}: is empty; name a path")
    return Path(os.path.expanduser(text))


def check_place(flag: str, text: str) -> Path:
    """The path of a directory that is there and can be written to, or can be made there; writes nothing.

    Args:
        flag: that it came from.
        text: its value, with or without ~.

    Raises:
        ConfigError: neither holds.
    """
    return _checked(flag, text, _no_place)


def _no_place(path: Path) -> str:
    """Why a path is no such directory, or ""."""
    if path.is_dir():
        return "" if os.access(path, os.W_OK | os.X_OK) else "no permission to write there"
    if os.path.lexists(path):
        return "exists and is not a directory"
    parent = next(p for p in path.absolute().parents if os.path.lexists(p))
    if not parent.is_dir():
        return f"{parent} is not a directory"
    return _closed(parent)


def _closed(directory: Path) -> str:
    """Why nothing can be made in a directory, or ""; tries it with a file without a name."""
    if not os.access(directory, os.W_OK | os.X_OK):
        return f"no permission to write in {directory}"
    try:
        tempfile.TemporaryFile(dir=directory).close()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):  # who writes tells of a full disk
            return f"nothing can be made in {directory}: {error.strerror}"
    return ""


def check_file(
    flag: str, text: str, *suffixes: str, overwrite: bool | None = None, beside: str = "", deep: bool = False
) -> Path:
    """The path of a file that is to be made; writes nothing.

    Args:
        flag: that it came from.
        text: its value, with or without ~.
        suffixes: of which it has to end in one.
        overwrite: whether a file may be there already; None where no flag allows it.
        beside: the suffix of another file that is written there; "" for none.
        deep: whether its directory is made, too; otherwise it has to be there.

    Raises:
        ConfigError: it has another name, or something lies there, or the directory does not.
    """

    def problem(path: Path) -> str:
        if path.suffix.lower() not in suffixes:
            return f"must end in {' or '.join(suffixes)}"
        for file in (path, path.with_suffix(beside)) if beside else (path,):
            there, name = False, "" if file == path else f"{file} "
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                there = bool(
                    file.lstat()
                )  # os.path.lexists takes a name that is too long for one that is free
            if there and not overwrite:
                hint = "" if overwrite is None else ", or --overwrite replaces it"
                return f"{name}exists; name a new file{hint}"
            if there and not file.is_file():
                return f"{name}exists and is not a file"
        if path.absolute().parent.is_dir():
            return _closed(path.absolute().parent)
        if not deep:
            return "no such directory"
        why = _no_place(path.parent)
        return f"{path.parent}: {why}" if why else ""

    return _checked(flag, text, problem)


def _checked(flag: str, text: str, problem: Callable[[Path], str]) -> Path:
    """The path that a flag names, if no problem is found with it.

    Raises:
        ConfigError: there is one, or its name cannot be shown, or the system refuses it.
    """
    odd = next((character for character in text if not character.isprintable()), None)
    if odd is not None:
        raise ConfigError(f"--{flag}={text}: has the character {odd!a}; name it with printable ones")
    path = Path(os.path.expanduser(text))
    try:
        found = problem(path)
    except OSError as error:
        found = str(error.strerror)
    if found:
        raise ConfigError(f"--{flag}={text}: {found}")
    return path
