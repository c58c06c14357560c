"""What a sweep runs: a run for each arm, game and seed, and what these start from. Imports no jax."""

import fnmatch
import itertools
import re
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from srl_jax import envs, plugins
from srl_jax.config import INFOS
from srl_jax.errors import ConfigError
from srl_jax.files import loggers
from srl_jax.specs import choices_text

from .. import PACKAGE
from ..command_line.flags import unknown
from ..presets import ENCODER_PRESETS, POLICY_PRESETS, PRESETS, preset_values, source_preset

Flags = Mapping[str, str | tuple[str, ...]]
"""Flags of experiments.train as typed on the command line; a tuple's is repeated."""

PRETRAIN_SHARE = 0.3
"""Of --steps that pretraining takes, as 1.5 million env steps to 5 million in the thesis."""

SOURCES = {"encoder_from": ENCODER_PRESETS, "policy_from": POLICY_PRESETS}
"""{flag that names a run to start from: {preset that needs one: preset of that run}}."""

OF_TRAINING = ("protocol", "tune_runtime")
"""Flags of training that an arm may have and that are no fields of Config."""

OWN = {
    "game": "games",
    "seed": "seeds",
    "preset": "presets",
    "config": "presets",
    "encoder_from": "presets",
    "policy_from": "presets",
}
"""{flag that a sweep gives each run itself: the sweep's flag that decides it}."""


class Arm(NamedTuple):
    """What is compared.

    Attributes:
        name: of its runs' directories.
        preset: as of `experiments.presets.preset_values`.
        flags: over the preset, for this arm alone.
    """

    name: str
    preset: str
    flags: Flags = {}


class Planned(NamedTuple):
    """One run of a sweep.

    Attributes:
        name: GAME/ARM/seedN, also its directory under the sweep's root.
        preset: as of `experiments.presets.preset_values`.
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
    """The arm of a preset, with its name less its family's: thesis/joint_256+small is joint_256_small."""
    return Arm("_".join(part.rpartition("/")[2] for part in preset.split("+")), preset)


def grid(arms: Sequence[Arm], texts: Sequence[str], flags: Flags) -> list[Arm]:
    """The arms, each once with every combination of values.

    Args:
        arms: to vary.
        texts: FLAG=VALUE,VALUE,... each; with ; between them values may have commas.
        flags: for every run, given beside.

    Raises:
        ConfigError: one is not that, or no flag of training, or the flag is there already.
    """
    known = [*(info.flag or name for name, info in INFOS.items()), *OF_TRAINING]
    axes: dict[str, list[str]] = {}
    for text in texts:
        flag, _, rest = text.partition("=")
        values = [value.strip() for value in rest.split(";" if ";" in rest else ",")]
        if not all((flag, *values)):
            raise ConfigError(f"--grid={text}: must be FLAG=VALUE,VALUE, as in --grid=lr_rl=1e-4,3e-4")
        if flag not in known:
            raise ConfigError(f"--grid={text}: --{flag}: {unknown(flag, known)}")
        for first, second in itertools.pairwise(values):
            if ":" in first and "=" in second.partition(":")[0]:
                raise ConfigError(
                    f"--grid={text}: {second!r} is an option; a ; separates values that have commas, as in "
                    f"--grid='{flag}={first},{second};{first}'"
                )
        if flag in axes or flag in flags:
            raise ConfigError(f"--grid={text}: --{flag} is given beside it; give it once")
        if twice := next((value for value in values if values.count(value) > 1), None):
            raise ConfigError(f"--grid={text}: {twice} is given {values.count(twice)} times; give it once")
        axes[flag] = values
    found = []
    for arm in arms:
        for combination in itertools.product(*axes.values()):
            own = dict(zip(axes, combination, strict=True))
            parts = (f"{flag}={re.sub(r'[^A-Za-z0-9_.=-]+', '-', x.lstrip(':+'))}" for flag, x in own.items())
            found.append(Arm("_".join((arm.name, *parts)), arm.preset, {**arm.flags, **own}))
    return found


def plan(
    arms: Sequence[Arm], games: Sequence[str], seeds: Sequence[int], flags: Flags | None = None
) -> list[Planned]:
    """The runs of a sweep, each after those that it starts from.

    A run whose preset needs another's encoder or policy starts from the run of the arm that has the preset's
    name, or else of one with that preset and this arm's flags, as of a grid; where there is none, one is
    added, with the flags for every run. Pretraining gets `PRETRAIN_SHARE` of the `steps` in `flags`.

    Args:
        arms: compared.
        games: that each is run on; none: each preset's own.
        seeds: each a run.
        flags: for every run.

    Returns:
        The first seed of everything, then the second, and so on.

    Raises:
        ConfigError: a name is unknown, or two runs would have the same one, or a flag is there twice.
    """
    flags = _checked(flags or {})
    by_name: dict[str, Arm] = {}
    for arm in arms:
        try:
            arm = _checked_arm(arm)
        except ConfigError as error:
            raise ConfigError(f"arm {arm.name}: {error}") from None
        if by_name.setdefault(arm.name, arm) != arm:
            raise ConfigError(
                f"arm {arm.name}: there twice, of {by_name[arm.name].preset} and of {arm.preset}; "
                "give one of them another name"
            )
    for arm in by_name.values():
        if both := sorted(flags.keys() & arm.flags.keys()):
            raise ConfigError(f"--{both[0]}: arm {arm.name} has its own; give it once")
    if "import" not in flags:  # else it may be a row of what is imported, which the runs will know
        games = [envs.canonical(game, "games") for game in games]
    directories = {envs.file_name(game): game for game in reversed(games)}
    for game in games:
        if (other := directories[envs.file_name(game)]) != game:
            raise ConfigError(f"--games={game}: its runs would lie where those of {other} do")

    runs: dict[str, Planned] = {}

    def add(arm: Arm, game: str, seed: int) -> str:
        mode = arm.flags.get("mode", flags.get("mode", preset_values(arm.preset)["mode"]))
        own = {**flags, **arm.flags}
        if mode == "pretrain" and "steps" in flags:
            own["steps"] = _pretraining(flags["steps"])
        sources = {}
        for flag, table in SOURCES.items():
            # A preset's source is asked for while its mode is, as on the command line of a single run.
            preset = source_preset(arm.preset, table)
            if preset and mode == preset_values(arm.preset.partition("+")[0])["mode"]:
                source = arm_of(preset)
                alike = (it for it in by_name.values() if (it.preset, it.flags) == (source.preset, arm.flags))
                named = by_name.get(source.name) or next(alike, source)
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
            for game in games or [preset_values(arm.preset)["game"]]:
                add(arm, game, seed)
    return list(runs.values())


def _checked_arm(arm: Arm) -> Arm:
    preset_values(arm.preset)
    if not re.fullmatch(r"(?!\.)[A-Za-z0-9_.=-]*[A-Za-z0-9][A-Za-z0-9_.=-]*", arm.name):
        raise ConfigError("a name is made of letters, digits and _ - . =")
    if ".broken-" in arm.name:  # `run_data.run_directories` passes over it
        raise ConfigError(".broken- marks what an earlier version moved aside; give it another name")
    return arm._replace(flags=_checked(arm.flags))


def _checked(flags: Flags) -> dict[str, str | tuple[str, ...]]:
    """The flags, with the files that they import named so that a process finds them that works elsewhere."""
    for flag, mine in OWN.items():
        if flag in flags:
            raise ConfigError(f"--{flag}: a sweep gives it to each run; --{mine} decides it")
    own = dict(flags)
    if "import" in own:
        texts = (own["import"],) if isinstance(own["import"], str) else own["import"]
        own["import"] = tuple(text if text == "none" else plugins.located(text) for text in texts)
    if "logger" in own:
        texts = (own["logger"],) if isinstance(own["logger"], str) else own["logger"]
        own["logger"] = loggers.listed(texts) or ("none",)
    return own


def _pretraining(steps: str | tuple[str, ...]) -> str:
    try:
        return str(max(1, round(PRETRAIN_SHARE * INFOS["steps"].parse(steps))))
    except ValueError as error:
        raise ConfigError(f"--steps={steps}: {error}") from None


def presets(patterns: Sequence[str]) -> list[str]:
    """The presets that match the patterns, as in thesis/* or thesis/*+small, in the order of the table.

    Raises:
        ConfigError: a pattern matches none.
    """
    found: dict[str, list[str]] = {}
    for text in patterns:
        pattern, plus, pieces = text.partition("+")
        matching = fnmatch.filter(PRESETS, pattern)
        if not matching:
            raise ConfigError(f"--presets={text}: {choices_text(pattern, PRESETS)}")
        found.setdefault(plus + pieces, []).extend(matching)
    return [name + pieces for pieces, names in found.items() for name in PRESETS if name in names]


def parse_seeds(text: str) -> list[int]:
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
        raise ConfigError(f"--seeds={text}: {error}; give a number of seeds, or seeds as in 0,3,7") from None
    if not numbers or (len(parts) == 1 and not 0 < numbers[0] <= 10_000):
        raise ConfigError(f"--seeds={text}: give a number of seeds from 1 to 10000, or seeds as in 0,3,7")
    if len(set(numbers)) < len(numbers):
        raise ConfigError(f"--seeds={text}: a seed is there twice")
    return list(range(numbers[0])) if len(parts) == 1 else numbers


def settings(run: Planned) -> list[str]:
    """The flags of a run's settings, for a process that works in the sweep's root."""
    found = [f"--preset={run.preset}"]
    for name, value in run.flags.items():
        values = value if isinstance(value, tuple) else (value,)
        found += [f"--{name}={text}" for text in values or ("none",)]
    sources = {"encoder_from": run.encoder_from, "policy_from": run.policy_from}
    return found + [f"--{flag}={name}" for flag, name in sources.items() if name]


def command(run: Planned) -> list[str]:
    """The command line of a run, for a process that works in the sweep's root; a person may type it there.

    config.json then names what a run starts from as it lies under the root, wherever that is.
    """
    return [sys.executable, "-m", f"{PACKAGE}.train", *settings(run), f"--out={run.name}", "--resume=auto"]
