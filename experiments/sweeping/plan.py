"""What a sweep runs: a run for each arm, game and seed, and what these start from. Imports no jax."""

import fnmatch
import os
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from experiments.presets import ENCODER_PRESETS, POLICY_PRESETS, PRESETS
from srl_jax import envs
from srl_jax.config import INFOS
from srl_jax.errors import ConfigError
from srl_jax.specs import choices_text

Flags = Mapping[str, str | tuple[str, ...]]
"""Flags of experiments.train as typed on the command line; a tuple's is repeated."""

PRETRAIN_SHARE = 0.3
"""Of --steps that pretraining takes, as 1.5 million env steps to 5 million in the thesis."""

SOURCES = {"encoder_from": ENCODER_PRESETS, "policy_from": POLICY_PRESETS}
"""{flag that names a run to start from: {preset that needs one: preset of that run}}."""

OWN = {
    "game": "games",
    "seed": "seeds",
    "preset": "presets",
    "encoder_from": "presets",
    "policy_from": "presets",
}
"""{flag that a sweep gives each run itself: the sweep's flag that decides it}."""


class Arm(NamedTuple):
    """What is compared.

    Attributes:
        name: of its runs' directories.
        preset: a key of `experiments.presets.PRESETS`.
        flags: over the preset, for this arm alone.
    """

    name: str
    preset: str
    flags: Flags = {}


class Planned(NamedTuple):
    """One run of a sweep.

    Attributes:
        name: GAME/ARM/seedN, also its directory under the sweep's root.
        preset: a key of `experiments.presets.PRESETS`.
        flags: over the preset.
        encoder_from, policy_from: names of the runs that it starts from, or "".
    """

    name: str
    preset: str
    flags: dict[str, str | tuple[str, ...]]
    encoder_from: str = ""
    policy_from: str = ""

    @property
    def sources(self) -> list[str]:
        """Names of the runs that have to be done before it."""
        return [name for name in (self.encoder_from, self.policy_from) if name]


def arm_of(preset: str) -> Arm:
    """The arm of a preset, with its name less its family's."""
    return Arm(preset.rpartition("/")[2], preset)


def plan(
    arms: Sequence[Arm], games: Sequence[str], seeds: Sequence[int], flags: Flags | None = None
) -> list[Planned]:
    """The runs of a sweep, each after those that it starts from.

    A run whose preset needs another's encoder or policy starts from the run of the arm that has the preset's
    name; where there is none, one is added. Pretraining gets `PRETRAIN_SHARE` of the `steps` in `flags`.

    Args:
        arms: compared.
        games: that each is run on; none: each preset's own.
        seeds: each a run.
        flags: for every run.

    Returns:
        The first seed of everything, then the second, and so on.

    Raises:
        ConfigError: a name is unknown, or two runs would have the same one.
    """
    flags = dict(flags or {})
    by_name: dict[str, Arm] = {}
    for arm in arms:
        _check(arm)
        if by_name.setdefault(arm.name, arm) != arm:
            raise ConfigError(
                f"arm {arm.name}: there twice, of {by_name[arm.name].preset} and of {arm.preset}; "
                "give one of them another name"
            )
    games = [envs.canonical(game, "games") for game in games]
    directories = {envs.file_name(game): game for game in reversed(games)}
    for game in games:
        if (other := directories[envs.file_name(game)]) != game:
            raise ConfigError(f"--games={game}: its runs would lie where those of {other} do")
    _check_flags("", flags)

    runs: dict[str, Planned] = {}

    def add(arm: Arm, game: str, seed: int) -> str:
        mode = arm.flags.get("mode", flags.get("mode", PRESETS[arm.preset]["mode"]))
        own = {**flags, **arm.flags}
        if mode == "pretrain" and "steps" in flags and "steps" not in arm.flags:
            own["steps"] = _pretraining(flags["steps"])
        sources = {}
        for flag, table in SOURCES.items():
            # A preset's source is asked for while its mode is, as on the command line of a single run.
            if arm.preset in table and mode == PRESETS[arm.preset]["mode"]:
                source = arm_of(table[arm.preset])
                named = by_name.get(source.name, source)
                if named.preset != source.preset:
                    raise ConfigError(
                        f"arm {named.name}: of {named.preset}, and {arm.name} starts from one of that name of"
                        f" {source.preset}; give it another name"
                    )
                sources[flag] = add(named, game, seed)
        name = f"{envs.file_name(game)}/{arm.name}/seed{seed}"
        runs[name] = Planned(name, arm.preset, {"game": game, "seed": str(seed), **own}, **sources)
        return name

    for seed in seeds:
        for arm in by_name.values():
            for game in games or [PRESETS[arm.preset]["game"]]:
                add(arm, game, seed)
    return list(runs.values())


def _check(arm: Arm) -> None:
    if arm.preset not in PRESETS:
        raise ConfigError(f"arm {arm.name}: {arm.preset}: {choices_text(arm.preset, PRESETS)}")
    plain = arm.name.replace("_", "").replace("-", "").replace(".", "").replace("=", "")
    if not (plain.isascii() and plain.isalnum()) or arm.name.startswith("."):
        raise ConfigError(f"arm {arm.name}: a name is made of letters, digits and _ - . =")
    if ".broken-" in arm.name:
        raise ConfigError(f"arm {arm.name}: .broken- marks what was moved aside; give it another name")
    _check_flags(f"arm {arm.name}: ", arm.flags)


def _check_flags(where: str, flags: Flags) -> None:
    for flag, mine in OWN.items():
        if flag in flags:
            raise ConfigError(f"{where}--{flag}: a sweep gives it to each run; --{mine} decides it")


def _pretraining(steps: str | tuple[str, ...]) -> str:
    try:
        return str(max(1, round(PRETRAIN_SHARE * INFOS["steps"].parse(steps))))
    except ValueError as error:
        raise ConfigError(f"--steps={steps}: {error}") from None


def presets(patterns: Sequence[str]) -> list[str]:
    """The presets that match any of the patterns, as in thesis/*, in the order of the table.

    Raises:
        ConfigError: a pattern matches none.
    """
    for pattern in patterns:
        if not fnmatch.filter(PRESETS, pattern):
            raise ConfigError(f"--presets={pattern}: {choices_text(pattern, PRESETS)}")
    return [name for name in PRESETS if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]


def parse_seeds(text: str, flag: str = "seeds") -> list[int]:
    """`5` is the seeds 0 to 4; `0,3,7` are those; `3,` is 3 alone.

    Raises:
        ConfigError: it is neither.
    """
    parts = text.split(",")
    try:
        numbers = [INFOS["seed"].parse(part) for part in parts if part or part is not parts[-1]]
        for number in numbers:
            INFOS["seed"].check(number)
    except ValueError as error:
        raise ConfigError(f"--{flag}={text}: {error}; give a number of seeds, or seeds as in 0,3,7") from None
    if not numbers or (len(parts) == 1 and not 0 < numbers[0] <= 10_000):
        raise ConfigError(f"--{flag}={text}: give a number of seeds from 1 to 10000, or seeds as in 0,3,7")
    if len(set(numbers)) < len(numbers):
        raise ConfigError(f"--{flag}={text}: a seed is there twice")
    return list(range(numbers[0])) if len(parts) == 1 else numbers


def settings(run: Planned) -> list[str]:
    """The flags of a run's settings, but for the runs that it starts from."""
    found = [f"--preset={run.preset}"]
    for name, value in run.flags.items():
        values = value if isinstance(value, tuple) else (value,)
        found += [f"--{name}={text}" for text in values or ("none",)]
    return found


def command(run: Planned, root: str | os.PathLike = "") -> list[str]:
    """The command line of a run; a person may type it.

    Args:
        run: of a sweep.
        root: the sweep's; empty for a process that works there. Launchers do that: config.json then names
            what a run starts from as it lies under the root, wherever that is.
    """
    found = [sys.executable, "-m", "experiments.train", *settings(run)]
    for flag in SOURCES:
        if source := getattr(run, flag):
            found.append(f"--{flag}={os.path.join(root, source)}")
    return [*found, f"--out={os.path.join(root, run.name)}", "--resume=auto"]
