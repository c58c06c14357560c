"""Runs read from disk, grouped by game and arm, and what may be compared with what.

The layout is ROOT/GAME/ARM/seedN/; a run directory that lies elsewhere is an arm of its own name. A link to a
run has the link's name. Runs may be packed, see `packing`. Imports no jax.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax import checks, envs, specs, statistics
from srl_jax.config import INFOS, Config, difference
from srl_jax.data import Published, ReferencePolicy
from srl_jax.errors import ConfigError
from srl_jax.files import display, provenance
from srl_jax.learning.modes import MODES

from .. import packing
from .run_data import RunData, arm_name, in_order, load_run, run_directories, runs_below

RETURN = "eval/return_mean"
"""The key of learning curves."""
FINAL = "final/return_mean"
"""The key of the games after the last env step."""
PROTOCOL = (
    "sticky_actions", "full_actions", "life_loss", "noop_max", "eps_eval", "eval_games", "eval_max_steps",
)  # fmt: skip
"""Fields that say what a score means: runs that differ in one are not compared, unless forced."""

WRITTEN = ("loggers", "checkpoint_every", "keep_encoder_every", "keep_best", "keep_replay")
"""Fields that say what is written of a run beside its rows."""
FIVE_MINUTES = 4_500
"""Env steps of an Atari game, the least at which a published protocol cuts one (Bellemare et al. 2013)."""
OF_A_SEED = ("seed", "encoder_from", "policy_from", "imports", *WRITTEN)
"""Fields in which runs of one arm and game may differ: what is theirs alone, and what is `WRITTEN`."""
OF_AN_ARM = tuple(name for name in INFOS if name not in OF_A_SEED)
"""The other fields, in which they do not differ."""


def difference_in_meaning(
    there: Config, here: Config, names: Iterable[str], differing: Callable[..., str] = difference
) -> str:
    """What differs of these fields but for options that one of two configurations, of another version, lacks.

    Where the texts are the same, that takes no jax. Rows of plug-ins are compared as they are written, unless
    they are imported.
    """
    if not (found := differing(there, here, names)):
        return ""
    from srl_jax.training import completed

    try:
        return differing(completed(there), completed(here), names)
    except ConfigError:
        return found


def source_arm(path: str) -> str:
    """The arm that the path of a run, or of a checkpoint in it, is of."""
    return arm_name(Path(re.sub(r"/(checkpoints|encoders|best)(/.*)?$", "", path)))


def settings(config: Config) -> Iterator[tuple[str, str, str, Any]]:
    """(field, row, option, value) of all that a configuration says, but for its game and seed.

    Of --rl, --encoder and the objectives, first the names of their rows are a value, and then each option of
    each row is one, as text. Elsewhere row and option are "".
    """
    for field in INFOS:
        value = getattr(config, field)
        if field in ("rl", "encoder", "objectives"):
            rows = []
            for text in (value,) if isinstance(value, str) else value:
                try:
                    rows.append(specs.split(text))
                except specs.SpecError:
                    rows.append((text, {}))
            yield field, "", "", " + ".join(name for name, _ in rows) or "none"
            for row, options in rows:
                for option, text in options.items():
                    yield field, row, option, text
        elif field not in ("game", "seed"):
            yield field, "", "", value


def load_runs(*roots: str | Path) -> list[RunData]:
    """All runs in or below directories, by game, arm and seed: those of run directories, and packed ones.

    Links are followed, and each run is read once.

    What was moved aside as broken does not count.

    Raises:
        ConfigError: in one there is none, one cannot be read, or two are of the same game, arm and seed.
    """
    files: dict[str, Path] = {}
    for root in map(Path, roots):
        found = [path / "config.json" for path in run_directories(root)]
        found += [folder / packing.CONFIGS for folder in runs_below(root, packing.CONFIGS)]
        if not found:
            raise ConfigError(f"{root}: no run directory there (none has a config.json), and no packed run")
        for path in found:
            files.setdefault(os.path.realpath(path), path)
    read: list[RunData] = []
    for path in files.values():
        read += packing.read(path.parent) if path.name == packing.CONFIGS else [load_run(path.parent)]
    return in_order(_each_once(read))


def load_named(root: Path, names: Iterable[str]) -> list[RunData]:
    """The runs at places below a directory: in a directory there, or packed in the root. Others are not read.

    Args:
        root: the directory.
        names: of the places, GAME/ARM/seedN. Where there is no run, there is none in the result. A packed run
            may have had another path, if it is of that game, arm and seed.

    Raises:
        ConfigError: one cannot be read, or is there in both forms.
    """
    places = list(names)
    found = [(name, load_run(root / name)) for name in places if (root / name / "config.json").exists()]
    for run in packing.read(root) if packing.is_packed(root) else ():
        own = run.path.relative_to(root).as_posix()
        for name in dict.fromkeys((own, f"{envs.file_name(run.game)}/{run.arm}/seed{run.seed}")):
            if name in places:
                found.append((name, run))
                break
    found.sort(key=lambda pair: places.index(pair[0]))
    return list(_each_once([run for _, run in found]))


def _each_once(runs: Sequence[RunData]) -> Sequence[RunData]:
    """The runs.

    Raises:
        ConfigError: two are of the same game, arm and seed.
    """
    found: dict[tuple, RunData] = {}
    for run in runs:
        other = found.setdefault(run.key, run)
        if other is not run:
            raise ConfigError(
                f"{run.path}: the same game, arm and seed as {other.path}; move one of them away"
            )
    return runs


def arm_names(root: Path) -> list[str]:
    """The arms of all runs in or below a directory, whose rows are not read."""
    names = {arm_name(path) for path in run_directories(root)}
    return sorted(names.union(*(packing.arms(folder) for folder in runs_below(root, packing.CONFIGS))))


def grouped(runs: Iterable[RunData]) -> dict[str, dict[str, list[RunData]]]:
    """{game: {arm: its runs by seed}}, games and arms in the order in which they come."""
    groups: dict[str, dict[str, list[RunData]]] = {}
    for run in runs:
        groups.setdefault(run.game, {}).setdefault(run.arm, []).append(run)
    return groups


def steps_and_values(run: RunData, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Env steps int64 [N], ascending, and a key's values float64 [N], of rows where it is not null.

    Raises:
        ConfigError: a value is no number, or rows are not in ascending order.
    """
    found = {row["env_steps"]: row[key] for row in run.rows if row.get(key) is not None}
    if not all(isinstance(value, int | float) for value in found.values()):
        raise ConfigError(f"{run.path}: {key} is not a number in each row")
    if sorted(found) != list(found):
        raise ConfigError(f"{run.path}: the env steps of {key} in metrics.jsonl are not in ascending order")
    return np.array(list(found), np.int64), np.array(list(found.values()), np.float64)


def steps_and_returns(run: RunData) -> tuple[np.ndarray, np.ndarray]:
    """The learning curve, `steps_and_values` of mean evaluation returns."""
    return steps_and_values(run, RETURN)


Curves = Sequence[tuple[np.ndarray, np.ndarray]]
"""Of an arm's runs, as of `steps_and_returns`."""


def shared(arms: Mapping[Any, Curves]) -> dict[Any, Curves]:
    """The curves of a game's arms between the env steps that all of them have, whose ends all have then.

    What a run's curve has at an end is interpolated; no other run's evaluations change what lies between.

    Raises:
        ConfigError: there is no such step.
    """
    every = [steps for curves in arms.values() for steps, _ in curves]
    start, until = max(int(steps[0]) for steps in every), min(int(steps[-1]) for steps in every)
    if start > until:
        raise ConfigError(
            f"no env step that all curves have: one begins at {start:,}, another ends at {until:,}"
        )

    def cut(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = np.unique([start, *steps[(steps > start) & (steps < until)], until])
        return at, np.interp(at, steps, values)

    return {arm: [cut(*curve) for curve in curves] for arm, curves in arms.items()}


def ends(arms: Mapping[Any, Curves]) -> tuple[int, dict[Any, dict[str, np.ndarray]]]:
    """What arms of a game are compared by: between the env steps that all of their curves have.

    Args:
        arms: the curves of each.

    Returns:
        The last of these env steps; and for each arm the area under the curve up to there and the value
        there, float64 [runs].

    Raises:
        ConfigError: there is no such step.
    """
    cut = shared(arms)
    until = next(int(steps[-1]) for curves in cut.values() for steps, _ in curves)
    return until, {
        arm: {
            "area_under_curve": np.array([statistics.area_under_curve(*curve) for curve in curves]),
            "at_the_end": np.array([values[-1] for _, values in curves]),
        }
        for arm, curves in cut.items()
    }


def has_policy(run: RunData) -> bool:
    """Whether its mode trains a policy, which is then evaluated."""
    return MODES[run.config.mode].rl


def comparable(runs: Sequence[RunData]) -> list[RunData]:
    """Runs whose curves of returns can be laid beside each other, in their order; the others, `left_out` has.

    One that ended with an error is left out however far it got, one without evaluations, and one with a
    single evaluation where others of its game have more: it has only just begun. Each would cut the curves of
    all others down to where it is.
    """
    return [run for run, why in zip(runs, _why_not(runs, RETURN), strict=True) if not why]


def left_out(runs: Sequence[RunData], key: str = RETURN) -> list[tuple[RunData, str]]:
    """The runs that are not `comparable`, by this key, and why; of returns, those with a policy."""
    whys = zip(runs, _why_not(runs, key), strict=True)
    return [(run, why) for run, why in whys if why and (key != RETURN or has_policy(run))]


def _why_not(runs: Sequence[RunData], key: str) -> list[str]:
    points = [0 if run.failed else len(steps_and_values(run, key)[0]) for run in runs]
    under_way = {run.game for run, count in zip(runs, points, strict=True) if count > 1}
    found = []
    for run, count in zip(runs, points, strict=True):
        why = ""
        if run.failed:
            why = run.ended.reason
        elif count == 0 and any(key in row for row in run.rows):
            why = f"{key} is null in each row"
        elif count == 0:
            why = "not evaluated yet" if key == RETURN else f"has no {key}"
        elif count == 1 and run.game in under_way:
            why = "has only begun" if run.ended is None else "has a single evaluation"
        found.append(why)
    return found


def left_out_text(arm: str, whys: Mapping[int, str], seeds: int) -> str:
    """Which seeds of an arm are left out: `joint: 1 of 3 seeds left out: has only begun (seed 2)`.

    Args:
        arm: its name.
        whys: {seed: why it is left out}, at least one.
        seeds: how many it has in all.
    """
    of: dict[str, list[str]] = {}
    for seed, why in whys.items():
        of.setdefault(why, []).append(str(seed))
    reasons = "; ".join(f"{why} (seed {', '.join(those)})" for why, those in of.items())
    return f"{arm}: {len(whys)} of {seeds} seed{'' if seeds == 1 else 's'} left out: {reasons}"


def left_out_lines(runs: Sequence[RunData]) -> list[str]:
    """A line for each arm on a game of which seeds are `left_out`, see `left_out_text`."""
    whys: dict[tuple[str, str], dict[int, str]] = {}
    for run, why in left_out(runs):
        whys.setdefault((run.game, run.arm), {})[run.seed] = why
    groups = grouped(runs)
    return [
        f"{game}, {left_out_text(arm, those, len(groups[game][arm]))}" for (game, arm), those in whys.items()
    ]


def check_arms(runs: Sequence[RunData]) -> None:
    """Whether runs of one arm and game differ in nothing but `OF_A_SEED`.

    Says of an arm whose files of --import were not the same all the time.

    Raises:
        ConfigError: two differ in more; says in what.
    """
    for game, arms in grouped(runs).items():
        for arm, members in arms.items():
            for line in _other_files(members):
                display.say(f"{arm} on {game}: {line}")
            in_force = [checks.run_of(run.config).in_force() for run in members]
            for run, config in zip(members[1:], in_force[1:], strict=True):
                if differing := difference_in_meaning(in_force[0], config, OF_AN_ARM):
                    raise ConfigError(
                        f"{run.path}: of the same arm, {arm} on {game}, as {members[0].path}, but {differing}"
                    )


def history(run: RunData) -> dict[str, list[Any]]:
    """What made a run, as `srl_jax.files.provenance.history` gives it.

    Raises:
        ConfigError: config.json does not say it as training writes it.
    """
    try:
        return provenance.history(run.about)
    except ValueError as error:
        raise ConfigError(f"{run.path}: {error}") from None


def _other_files(runs: Iterable[RunData]) -> Iterator[str]:
    """A line for each file of --import that was not the same in all of an arm's runs, or while one ran."""
    found: dict[str, dict[str, list[str]]] = {}
    for run in runs:
        past = history(run)
        for name in filter(provenance.is_file, past):
            sums = ", then ".join(str(x)[:10] for x in past[name])
            found.setdefault(name, {}).setdefault(sums, []).append(str(run.seed))
    for name, seeds in found.items():
        if len(seeds) > 1 or ", then " in next(iter(seeds)):
            texts = [f"sha256 {sums} (seed {', '.join(those)})" for sums, those in seeds.items()]
            yield f"the imported {name} was not the same in all runs: {'; '.join(texts)}"


def check_protocols(
    runs: Sequence[RunData],
    *,
    force: bool | None = None,
    more: Sequence[str] = (),
    across_games: bool = False,
) -> list[str]:
    """Whether returns of these runs mean the same: one protocol for each game.

    Args:
        runs: those without a policy's returns do not count.
        force: say what differs, and do not refuse; None where the program has no such flag.
        more: fields beside `PROTOCOL` that must be the same.
        across_games: whether it is one for each arm, in all of its games.

    Returns:
        A line for each run whose protocol is not that of the game's, or the arm's, first.

    Raises:
        ConfigError: there is one, and it is not forced.
    """
    found = []
    first: dict[str, RunData] = {}
    for run in runs:
        if not len(steps_and_returns(run)[0]):
            continue
        reference = first.setdefault(run.arm if across_games else run.game, run)
        if differing := difference(reference.config, run.config, (*PROTOCOL, *more)):
            found.append(f"{run.path}: another protocol than {reference.path}: {differing}")
    if found and not force:
        way_out = "" if force is None else "; --force compares them all the same"
        raise ConfigError(f"{found[0]}{way_out}")
    return found


def differs(
    score: Published | ReferencePolicy, config: Config, env_steps: int | None = None, seeds: int | None = None
) -> str:
    """What differs between the score of others, or of a policy that learns nothing, and a run's evaluations.

    Args:
        score: from `srl_jax.data`.
        config: of the run.
        env_steps: when the run was evaluated; by default at its end.
        seeds: runs that its score is the mean of; None leaves them out.

    Returns:
        "env steps 250,000 (here 100,000), training score (here the mean of 10 evaluation games); not
        known: sticky actions, seeds", say, to be shown beside both; "" if nothing differs.
    """
    compared: dict[str, tuple[float | None, float | None]]
    compared = {"sticky actions": (score.sticky_actions, config.sticky_actions)}
    more, unknown, source = [], [], ""
    if isinstance(score, ReferencePolicy):
        if score.episodes is None:
            source = f"published, {score.source}"
        else:  # None: the game has no such thing
            names = ("sticky_actions", "noop_max", "eval_max_steps")
            pairs = {name.replace("_", " "): (getattr(score, name), getattr(config, name)) for name in names}
            compared = {name: pair for name, pair in pairs.items() if pair[0] is not None}
            if config.full_actions and score.sticky_actions is not None:
                more = ["the actions that the game knows (here all 18)"]
    else:
        if score.env_steps is not None:
            compared["env steps"] = score.env_steps, config.steps if env_steps is None else env_steps
            compared["epsilon"] = score.epsilon, config.eps_eval
            compared["seeds"] = score.seeds, score.seeds if seeds is None else seeds
        if score.score_of is None:
            unknown = ["kind of score"]
        elif score.score_of != "evaluation":
            more = [f"{score.score_of} score (here the mean of {config.eval_games} evaluation games)"]
        if config.eval_max_steps < FIVE_MINUTES:
            more += [f"whole games (here cut at {config.eval_max_steps:,} env steps)"]
    texts = [
        f"{name} {there:,} (here {here:,})"
        for name, (there, here) in compared.items()
        if there not in (None, here)
    ]
    unknown = [name for name, (there, _) in compared.items() if there is None] + unknown
    parts = [source, ", ".join(texts + more), f"not known: {', '.join(unknown)}" if unknown else ""]
    return "; ".join(part for part in parts if part)
