"""sweep.json: the runs of a sweep as they were planned, each with the configuration that it has."""

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from absl import flags

from srl_jax.config import INFOS, Config, difference
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.reading import parse_json, read_bytes, replace_text
from srl_jax.needs import Unread

from ..command_line import flags as config_flags
from ..runs import collect
from .plan import Planned, settings

FILE = "sweep.json"
FORMAT = 1
_LIMIT = 1 << 28  # bytes


class Entry(NamedTuple):
    """A run and the configuration that it has, resolved."""

    run: Planned
    config: Config


def read(root: Path) -> dict[str, Entry]:
    """{name: Entry} of the sweep in a directory, in the order of the plan; {} where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    path = root / FILE
    try:
        content = parse_json(read_bytes(path, _LIMIT))
        if content["format"] != FORMAT:
            raise ValueError(f"of format {content['format']}, not {FORMAT}")
        entries = {about["name"]: _entry(**about) for about in content["runs"]}
        for run, _ in entries.values():
            if missing := set(run.sources) - entries.keys():
                raise ValueError(f"{run.name} starts from {missing.pop()}, which is not there")
        return entries
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: not what a sweep writes: {error!s:.200}") from None


def _entry(config: Mapping[str, Any], **about: Any) -> Entry:
    run = Planned(**about)
    parts = run.name.split("/")
    if len(parts) != 3 or not all(part.strip(".") for part in parts):
        raise ValueError(f"{run.name}: not the name of a run, GAME/ARM/seedN")
    flags = {name: tuple(x) if isinstance(x, list) else x for name, x in run.flags.items()}
    return Entry(run._replace(flags=flags), Config.from_json(json.dumps(config)))


def write(root: Path, entries: Mapping[str, Entry]) -> None:
    """Writes sweep.json at once, or leaves the one that is there.

    Raises:
        SaveError: it could not be written.
    """
    runs = [{**run._asdict(), "config": dataclasses.asdict(config)} for run, config in entries.values()]
    with saving(root / FILE):
        replace_text(root / FILE, json.dumps({"format": FORMAT, "runs": runs}, indent=1) + "\n")


def merged(root: Path, entries: Mapping[str, Entry]) -> dict[str, Entry]:
    """The runs of the sweep in a directory, with more of them.

    Raises:
        ConfigError: the runs there cannot be read; or one that comes would be of an arm on a game that has
            other settings there.
    """
    there = read(root)
    for name, (_, config) in entries.items():
        arm = name.rpartition("/")[0]
        for other, entry in there.items():
            if other.rpartition("/")[0] == arm and other not in entries:
                if differing := collect.difference_in_meaning(entry.config, config, collect.OF_AN_ARM):
                    raise ConfigError(
                        f"{root}: {name} would be of the same arm as {other} there, but {differing}; name "
                        "another --out, or move what is there away"
                    )
                break
    return there | entries


def resolve(runs: Sequence[Planned]) -> dict[str, Entry]:
    """{name: the run with the configuration that it will write into its config.json}; imports jax.

    A flag that all runs have need not be read by each of them: those that do not read it go without. Says
    which runs mean the same, so that a comparison of their arms means nothing.

    Raises:
        ConfigError: a run's flags are not valid, or it cannot start from the runs that it names, or nothing
            reads one of them.
    """
    if "jax" not in sys.modules:  # this process shall take no GPU, and those of the runs may
        import jax

        jax.config.update("jax_platforms", "cpu")

    everywhere = set.intersection(*(set(run.flags.items()) for run in runs)) if runs else set()
    without: dict[str, list[ConfigError]] = {}
    entries: dict[str, Entry] = {}
    known: dict[Any, Config] = {}  # what differs by the seed alone is resolved once
    for run in runs:
        while run.name not in entries:
            try:
                entries[run.name] = Entry(run, _config(run, known))
            except Unread as error:
                flag = INFOS[error.field].flag or error.field
                without.setdefault(flag, []).append(ConfigError(f"{run.name}: {error}"))
                if (flag, run.flags.get(flag)) not in everywhere or len(without[flag]) == len(runs):
                    raise without[flag][0] from None
                run = run._replace(flags={name: x for name, x in run.flags.items() if name != flag})
            except ConfigError as error:
                raise ConfigError(f"{run.name}: {error}") from None
    first: dict[Config, str] = {}
    for name, entry in entries.items():
        _check_sources(entry, entries)
        if (other := first.setdefault(entry.config, name)) != name:
            display.say(f"{other} and {name} have the same settings, so that both will be the same run")
    return entries


def _config(run: Planned, known: dict[Any, Config]) -> Config:
    """A run's configuration, resolved; `known` has those of the runs before it, but for the seed."""
    from srl_jax.training import check_game, resolved

    config, given = parsed(run)
    key = dataclasses.replace(config, seed=0), frozenset(given)
    if key not in known:
        check_game(config)
        known[key] = resolved(*key)
    return dataclasses.replace(known[key], seed=config.seed)


def parsed(run: Planned) -> tuple[Config, set[str]]:
    """The configuration of a run's command line, not yet resolved, and what that gives.

    Raises:
        ConfigError: a flag is unknown or its value is not valid.
    """
    values = flags.FlagValues()
    config_flags.define_config_flags(values)
    config_flags.define_runtime_flag(values)
    try:
        values([run.name, *settings(run)])
    except flags.UnrecognizedFlagError as error:
        raise ConfigError(f"--{error.flagname}: {config_flags.unknown(error.flagname, values)}") from None
    except (flags.Error, ValueError) as error:
        raise ConfigError(str(error).removeprefix("flag ")) from None
    return config_flags.config_from_flags(values), config_flags.what_is_given(values)


def _check_sources(entry: Entry, entries: Mapping[str, Entry]) -> None:
    """`srl_jax.files.checkpoint.check_sources` before there are any checkpoints.

    Raises:
        ConfigError: the run cannot start from those that it names.
    """
    (run, here), frames = entry, ("frame_size", "frame_stack")
    for source, names in ((run.encoder_from, ("encoder", *frames)), (run.policy_from, ("game", *frames))):
        if not source:
            continue
        if source not in entries:
            raise ConfigError(f"{run.name}: starts from {source}, which is not a run of this sweep")
        there = entries[source].config
        if differing := difference(there, here, names):
            raise ConfigError(f"{run.name}: cannot start from {source}: {differing}")
        if source == run.policy_from and there.mode == "pretrain":
            raise ConfigError(f"{run.name}: {source} has no policy: its mode is pretrain")
