"""sweep.json: the runs of a sweep, as they were planned. Plain JSON; imports no jax."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.reading import parse_json, read_bytes

from .plan import Planned

FILE = "sweep.json"
FORMAT = 1
_LIMIT = 1 << 28  # bytes


class Entry(NamedTuple):
    """A run and the configuration that it has, resolved."""

    run: Planned
    config: Config


def read(root: Path) -> dict[str, Entry]:
    """{name: Entry} of the sweep in a directory, sources first; {} where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    path = root / FILE
    try:
        content = parse_json(read_bytes(path, _LIMIT))
        if content["format"] != FORMAT:
            raise ConfigError(f"{path}: of format {content['format']}, not {FORMAT}")
        entries = {}
        for about in content["runs"]:
            run = planned({name: about[name] for name in about if name != "config"})
            entries[run.name] = Entry(run, Config.from_json(json.dumps(about["config"])))
        return entries
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{path}: not a sweep's manifest ({type(error).__name__}: {error!s:.100})"
        ) from None


def planned(values: Mapping[str, Any]) -> Planned:
    """A run from JSON values.

    Raises:
        ConfigError: its name is not one of a directory below the sweep's.
        TypeError, AttributeError: they are not a run's.
    """
    run = Planned(**values)
    flags = {name: tuple(x) if isinstance(x, list) else x for name, x in run.flags.items()}
    texts = [run.name, run.preset, run.encoder_from, run.policy_from, *flags]
    for x in flags.values():
        texts += x if isinstance(x, tuple) else (x,)
    if not all(type(text) is str for text in texts):
        raise TypeError("a run is made of texts")
    for name in (run.name, *run.sources):
        parts = name.split("/")
        if len(parts) != 3 or not all(part.isprintable() and part.strip(".") for part in parts):
            raise ConfigError(f"{name}: not the name of a run, GAME/ARM/seedN")
    return run._replace(flags=flags)


def write(root: Path, entries: Mapping[str, Entry]) -> None:
    """Writes sweep.json at once, or leaves the one that is there.

    Raises:
        SaveError: it could not be written.
    """
    runs = [{**run._asdict(), "config": dataclasses.asdict(config)} for run, config in entries.values()]
    replace(root / FILE, json.dumps({"format": FORMAT, "runs": runs}, indent=1) + "\n")


def replace(path: Path, text: str) -> None:
    """Writes a file at once, flushed to disk, or leaves the one that is there.

    Raises:
        SaveError: it could not be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise SaveError(f"{path}: not written: {error.strerror}") from error
