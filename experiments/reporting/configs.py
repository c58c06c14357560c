"""What configurations say: where runs were made, in what arms differ, how policies were evaluated."""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from srl_jax import envs, specs
from srl_jax.config import INFOS, Config
from srl_jax.errors import ConfigError
from srl_jax.files.provenance import history
from srl_jax.learning.modes import MODES

from ..runs import collect
from ..runs.collect import RunData

THEN = ", then "
"""Between what a run was made by and what it was resumed under."""


def about(run: RunData) -> dict[str, str]:
    """What a run was made by: revision, CPUs, cores, versions of packages, "started"; no empty ones.

    Of a run that was resumed under other versions or elsewhere, each is there in turn: `1.2, then 1.3`.

    Raises:
        ConfigError: config.json is not what training writes.
    """
    try:
        past = {name: x for name, x in history(run.about).items() if any(x)}
        texts = {name: THEN.join(str(value or "none") for value in x) for name, x in past.items()}
        # Environment variables are among these, and are nobody's business.
        names = ["git_revision", "cpus", "cores", *(run.about.get("versions") or {})]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{run.path / 'config.json'}: {error}") from None
    revision = THEN.join(re.sub(r"^(\w{10})\w*", r"\1", x) for x in texts.get("git_revision", "").split(THEN))
    texts |= {"git_revision": revision, "started": str(run.about.get("started") or "")}
    return {name: texts[name] for name in [*names, "started"] if texts.get(name)}


def settings(
    runs: Sequence[RunData], arms: Sequence[str]
) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """Every field of the configurations, apart from game and seed; specifications by their options.

    Returns:
        field -> arm -> value, where two arms differ on a game; and field -> value of what they share, as they
        do an option that has its default in every arm whose objective it is. Where games differ, a value is
        that of each game.
    """
    found: dict[str, dict[str, dict[str, set[str]]]] = {}
    configs = [(run, _fields(run.config)) for run in runs]
    names = sorted({name for _, fields in configs for name in fields}, key=_place)
    for (run, fields), name in itertools.product(configs, names):
        by_arm = found.setdefault(name, {}).setdefault(run.game, {})
        by_arm.setdefault(run.arm, set()).add(fields.get(name, "–"))

    def text(by_game: Mapping[str, set[str]]) -> str:
        texts = {game: ", ".join(sorted(values)) for game, values in by_game.items()}
        if len(set(texts.values())) == 1:
            return next(iter(texts.values()))
        return "; ".join(f"{game}: {value}" for game, value in texts.items())

    differing, shared, defaults = {}, {}, _defaults(names)
    for name, games in found.items():
        texts = set().union(*(texts for by_arm in games.values() for texts in by_arm.values()))
        if texts == {"–", defaults.get(name)}:
            shared[name] = f"{defaults[name]}, where the objective is"
        elif any(
            by_arm[arm] != by_arm[other] for by_arm in games.values() for arm in by_arm for other in by_arm
        ):
            differing[name] = {arm: text({g: x[arm] for g, x in games.items() if arm in x}) for arm in arms}
        else:
            shared[name] = text({game: set.union(*by_arm.values()) for game, by_arm in games.items()})
    return differing, shared


def glossary(
    runs: Sequence[RunData], differing: Mapping[str, Mapping[str, str]], baseline: str | None
) -> dict[str, str]:
    """arm -> what it is, in a line: its mode, and in which settings it differs from the baseline."""
    found = {}
    for run in runs:
        parts = [
            f"{name.removeprefix('objectives ').replace(':', '')} {values[run.arm]}"
            for name, values in differing.items()
            if name != "mode" and run.arm != baseline and values[run.arm] not in ("–", values.get(baseline))
        ]
        found[run.arm] = "; ".join([MODES[run.config.mode].help, *parts])
    return found


def _defaults(names: Sequence[str]) -> dict[str, str]:
    """What options of the objectives here have if nothing is said, as `_fields` names them."""
    rows = {name.split()[1].rstrip(":") for name in names if name.startswith("objectives ")}
    if not rows:
        return {}
    from srl_jax.objectives import REGISTRY  # which imports jax

    return {
        f"objectives {row}: {option}": specs.value_text(value)
        for row in rows
        if row in REGISTRY
        for option, value in specs.option_defaults(REGISTRY[row]).items()
    }


def _place(name: str) -> tuple:
    return list(INFOS).index(re.split("[ :]", name)[0]), name


def _fields(config: Config) -> dict[str, str]:
    """Each setting as text, an option of an objective as "objectives spr: tau"."""
    found = {}
    for field, row, option, value in collect.settings(config):
        if row:
            found[f"{field} {row}: {option}" if field == "objectives" else f"{field}: {option}"] = value
        elif field in ("imports", "loggers"):
            found[field] = ", ".join(Path(text).name for text in value) or "none"
        elif value and field in ("encoder_from", "policy_from"):
            found[field] = collect.source_arm(value)
        else:
            found[field] = value_text(value)
    return found


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
    game = envs.known(config.game)
    sticky = f"sticky actions {config.sticky_actions:g}" if config.sticky_actions else "no sticky actions"
    finals = f"{config.final_games} after the last env step"
    noops = f"fewer than {config.noop_max} no-ops at the start" if config.noop_max > 1 else "no no-ops"
    frames = f", of {game.frames_per_step} frames each" if game.frames_per_step > 1 else ""
    parts = {
        f"{config.eval_games} full games an evaluation, every {config.eval_every:,} env steps": True,
        finals: config.final_games > 0,
        f"epsilon {config.eps_eval:g}": True,
        sticky: "sticky_actions" in game.options,
        "all 18 actions": config.full_actions and "full_actions" in game.options,
        noops: "noop_max" in game.options,
        f"at most {config.eval_max_steps:,} env steps a game{frames}": True,
        f"in training, a lost life ends {'the return' if config.life_loss else 'nothing'}": game.lives,
    }
    return "; ".join(part for part, said in parts.items() if said)
