"""What configurations say: where runs were made, in what arms differ, how policies were evaluated."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from srl_jax import envs, specs
from srl_jax.config import INFOS, Config
from srl_jax.errors import ConfigError
from srl_jax.provenance import history

from .. import collect
from ..collect import RunData

SPECIFICATIONS = ("rl", "encoder", "objectives")
"""Fields that are name:key=value,..., shown option by option."""

THEN = ", then "
"""Between what a run was made by and what it was resumed under."""


class About(NamedTuple):
    """What config.json says of where a run was made; empty where it does not.

    Of a run that was resumed under other versions or elsewhere, each is there in turn: `1.2, then 1.3`.
    """

    revision: str
    started: str
    cpus: str
    versions: tuple[tuple[str, str], ...]


class Differences(NamedTuple):
    """The settings of one or several games, whose arms differ in the same.

    Attributes:
        games: that this is true of.
        arms: that they have.
        fields: (field, its value in each arm), where two arms differ.
    """

    games: list[str]
    arms: list[str]
    fields: list[tuple[str, list[str]]]


def about(run: RunData) -> About:
    """Reads what a run's config.json holds beside its settings.

    Raises:
        ConfigError: it is not what training writes.
    """
    try:
        past = {name: said for name, found in history(run.about).items() if (said := _in_turn(found))}
        pairs = tuple((str(name), past.get(name, "")) for name in run.about.get("versions") or {})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{run.path / 'config.json'}: {error}") from None
    return About(
        past.get("git_revision", ""), str(run.about.get("started") or ""), past.get("cpus", ""), pairs
    )


def _in_turn(found: Sequence[Any]) -> str:
    return THEN.join(str(value or "none") for value in found) if any(found) else ""


def settings(runs: Sequence[RunData], arms: Sequence[str]) -> tuple[list[Differences], list[tuple[str, str]]]:
    """Every field of the configurations, apart from game and seed; specifications by their options.

    Returns:
        Where arms differ, by game; and (field, value) of what all arms of each game share, with a value for
        each game where games differ.
    """
    found: list[Differences] = []
    shared: dict[str, dict[str, str]] = {}
    for game, by_arm in collect.grouped(runs).items():
        here = [arm for arm in arms if arm in by_arm]
        cells = {arm: [_fields(run.config) for run in by_arm[arm]] for arm in here}
        names = dict.fromkeys(name for configs in cells.values() for config in configs for name in config)
        differing = []
        for name in sorted(names, key=_place):
            values = [
                ", ".join(dict.fromkeys(config.get(name, "–") for config in cells[arm])) for arm in here
            ]
            if len(set(values)) > 1:
                differing.append((name, values))
            else:
                shared.setdefault(name, {})[game] = values[0]
        same = next((x for x in found if (x.arms, x.fields) == (here, differing)), None)
        if same:
            same.games.append(game)
        else:
            found.append(Differences([game], here, differing))
    everywhere = [name for name, values in shared.items() if all(name not in dict(x.fields) for x in found)]
    return found, [(name, _by_game(shared[name])) for name in sorted(everywhere, key=_place)]


def _place(name: str) -> tuple:
    return list(INFOS).index(re.split("[ :]", name)[0]), name


def _by_game(values: dict[str, str]) -> str:
    if len(set(values.values())) == 1:
        return next(iter(values.values()))
    return "; ".join(f"{game}: {value}" for game, value in values.items())


def _fields(config: Config) -> dict[str, str]:
    """Each field as text; an option of a specification is a field of its own."""
    found = {}
    for field in INFOS:
        value = getattr(config, field)
        if field in ("game", "seed"):
            continue
        if field in SPECIFICATIONS:
            found |= _options(field, value)
        elif field == "imports":
            found[field] = ", ".join(Path(text).name for text in value) or "none"
        elif value and field in collect.OF_A_SEED:
            found[field] = source_name(value)
        else:
            found[field] = value_text(value)
    return found


def _options(field: str, value: Any) -> dict[str, str]:
    texts = value if isinstance(value, tuple) else (value,)
    names, found = [], {}
    for text in texts:
        try:
            name, options = specs.split(text)
        except specs.SpecError:
            name, options = text, {}
        names.append(name)
        prefix = f"{field} {name}" if isinstance(value, tuple) else field
        found |= {f"{prefix}: {key}": option for key, option in options.items()}
    return {field: " + ".join(names) or "none"} | found


def source_name(path: str) -> str:
    """The arm that the path of a run, or of a checkpoint in it, is of."""
    return collect.arm_name(Path(re.sub(r"/(checkpoints|encoders)(/.*)?$", "", path)))


def value_text(value: Any) -> str:
    """A setting as a reader would write it."""
    if value is None:
        return "off"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else str(value) or "none"


def protocol_text(config: Config) -> str:
    """How a policy was evaluated, in a line; what a game does not have is not said of it."""
    sticky = f"sticky actions {config.sticky_actions:g}" if config.sticky_actions else "no sticky actions"
    noops = f"fewer than {config.noop_max} no-ops at the start" if config.noop_max > 1 else "no no-ops"
    game = envs.known(config.game)
    frames = f", of {game.frames_per_step} frames each" if game.frames_per_step > 1 else ""
    parts = [
        f"{config.eval_games} full games an evaluation, every {config.eval_every:,} env steps",
        f"epsilon {config.eps_eval:g}",
        *([sticky] if "sticky_actions" in game.options else []),
        *([noops] if "noop_max" in game.options else []),
        f"at most {config.eval_max_steps:,} env steps a game{frames}",
        *(
            [f"in training, a lost life ends {'the return' if config.life_loss else 'nothing'}"]
            if game.lives
            else []
        ),
    ]
    return "; ".join(parts)
