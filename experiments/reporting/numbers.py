"""What a report says in numbers: which runs there are, how they compare, what they cost.

Imports no jax.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax import statistics
from srl_jax.config import Config
from srl_jax.data import with_reference_scores
from srl_jax.errors import ConfigError
from srl_jax.specs import LIMITS

from .. import collect
from ..collect import RunData, has_policy
from ..presets import PRESETS
from ..run_data import natural
from . import configs

NEVER = 1e18
"""Env steps that stand for never, where a median is drawn again."""
THRESHOLDS = 101
"""Of a performance profile."""


class Comparison(NamedTuple):
    """The learning curves of one game at steps that all of them have.

    Attributes:
        steps: int64 [points].
        returns: arm -> float64 [runs, points].
        cut_by: the run that ends first, where others continue.
    """

    steps: np.ndarray
    returns: dict[str, np.ndarray]
    cut_by: RunData | None


class Row(NamedTuple):
    """An arm on a game, compared with the others at the last env step that all runs have.

    Attributes:
        final: mean over seeds of the return there.
        area: of the return averaged over the env steps until then.
        final_difference, area_difference: from the baseline's; None for the baseline itself.
        reaching: env steps until the score is reached; its median over seeds, NEVER or more for never.
        reached: how many runs did.
    """

    game: str
    arm: str
    seeds: int
    final: statistics.Interval
    area: statistics.Interval
    final_difference: statistics.Interval | None
    area_difference: statistics.Interval | None
    reaching: statistics.Interval
    reached: int


class Cost(NamedTuple):
    """What an arm's runs on a game took.

    Attributes:
        hours: of all runs together, by their own clocks.
        per_run: hours of one, the mean.
        speed: env steps a second, the median over rows of training.
        relative: time for an env step, as a multiple of the baseline's; None without one.
        source: the arm that its encoder was made by, or empty.
    """

    game: str
    arm: str
    runs: int
    hours: float
    per_run: float
    speed: float | None
    relative: float | None
    source: str


def arms_of(runs: Sequence[RunData]) -> list[str]:
    """All arms: those of the presets in their order, then the others; those without a policy last."""
    known = {name.partition("/")[2] or name: i for i, name in reversed(list(enumerate(PRESETS)))}
    playing = {run.arm for run in runs if has_policy(run)}
    return sorted(
        {run.arm for run in runs}, key=lambda a: (a not in playing, known.get(a, len(PRESETS)), natural(a))
    )


def baseline_of(runs: Sequence[RunData], arms: Sequence[str], given: str | None = None) -> str | None:
    """The arm that others are compared with, or None where no arm has a policy.

    The one that was asked for, else the first that is RL alone, else the first with a policy: of those that
    can be compared, as long as there are some.

    Raises:
        ConfigError: the one that was asked for is not there.
    """
    playing = {run.arm for run in runs if has_policy(run)}
    if given is not None:
        if given not in playing:
            raise ConfigError(
                f"--baseline={given}: not an arm with a policy; valid: {', '.join(sorted(playing))}"
            )
        return given
    playing = {run.arm for run in collect.comparable(runs)} or playing
    plain = {run.arm for run in runs if run.config.mode == "rl_only"} & playing
    return next((arm for arm in arms if arm in (plain or playing)), None)


def config_of(runs: Sequence[RunData]) -> Config:
    """Of the first run with a policy: the protocol of a game."""
    return next(run.config for run in runs if has_policy(run))


def reached_step(run: RunData) -> int:
    """The env step of its last row, or 0."""
    return max((row["env_steps"] for row in run.rows), default=0)


def finished(run: RunData) -> bool:
    """Whether its last rows are there: those of its last env steps, or of the return that ends a run.

    Not where it ended with an error all the same.
    """
    config = run.config
    if run.failed:
        return False
    steps, returns = collect.steps_and_returns(run)
    if config.stop_at_return is not None and (returns >= config.stop_at_return).any():
        return True
    evaluated = not has_policy(run) or (
        len(steps) > 0 and steps[-1] >= _last(config.steps, config.eval_every)
    )
    return evaluated and reached_step(run) >= _last(config.steps, min(config.log_every, config.steps))


def _last(steps: int, every: int) -> int:
    return steps // every * every


def compare(runs: Sequence[RunData], arms: Sequence[str]) -> dict[str, Comparison | None]:
    """Game -> its `comparable` learning curves at equal steps; None where there is no step that all have.

    Raises:
        ConfigError: the evaluations of a run are not in ascending order.
    """
    found: dict[str, Comparison | None] = {}
    for game, by_arm in collect.grouped(runs).items():
        members = collect.comparable([run for arm in arms for run in by_arm.get(arm, [])])
        if not members:
            continue
        curves = [collect.steps_and_returns(run) for run in members]
        for run, (steps, _) in zip(members, curves, strict=True):
            if (np.diff(steps) <= 0).any():
                raise ConfigError(f"{run.path}: evaluations in metrics.jsonl are not in ascending order")
        try:
            steps, returns = statistics.at_equal_steps(curves)
        except ValueError:
            found[game] = None
            continue
        ends = [int(curve[0][-1]) for curve in curves]
        first = members[int(np.argmin(ends))] if min(ends) < max(ends) else None
        by_arm = {arm: returns[[run.arm == arm for run in members]] for arm in arms}
        found[game] = Comparison(steps, {arm: x for arm, x in by_arm.items() if len(x)}, first)
    return found


def scores(comparisons: Mapping[str, Comparison | None], of: str, arms: Sequence[str]) -> dict[str, dict]:
    """arm -> game -> float64 [runs]: the last return, or the one averaged over env steps.

    Args:
        comparisons: from `compare`.
        of: "final" or "area".
        arms: in their order.
    """
    found: dict[str, dict[str, np.ndarray]] = {}
    for arm in arms:
        for game, comparison in comparisons.items():
            if comparison is not None and arm in comparison.returns:
                curves = comparison.returns[arm]
                area = statistics.area_under_curve(comparison.steps, curves)
                found.setdefault(arm, {})[game] = area if of == "area" else curves[:, -1]
    return found


def profiles(
    comparisons: Mapping[str, Comparison | None], arms: Sequence[str]
) -> tuple[list[str], np.ndarray, dict[str, statistics.Interval]]:
    """The share of an arm's runs that end above a human-normalised return, averaged over games.

    Args:
        comparisons: from `compare`.
        arms: in their order.

    Returns:
        The games that every arm with a policy has and that have reference scores; thresholds [T], from just
        below the smallest score to the largest; arm -> its profile [T]. No arm where there is no such game.
    """
    given = scores(comparisons, "final", arms)
    games = [game for game in comparisons if given and all(game in mine for mine in given.values())]
    games = with_reference_scores(games)
    if not games:
        return [], np.zeros(0), {}
    normal = {
        arm: {game: statistics.human_normalised(game, mine[game]) for game in games}
        for arm, mine in given.items()
    }
    every = np.concatenate([x for mine in normal.values() for x in mine.values()])
    room = 0.02 * (np.ptp(every) or 1.0)
    thresholds = np.linspace(every.min() - room, every.max(), THRESHOLDS)

    def profile(drawn: Mapping[str, np.ndarray]) -> np.ndarray:
        return statistics.performance_profile(drawn, thresholds)

    return games, thresholds, {arm: statistics.estimate(profile, mine) for arm, mine in normal.items()}


def targets(
    comparisons: Mapping[str, Comparison | None], baseline: str | None, given: Mapping[str, float]
) -> dict[str, float]:
    """game -> the score to be reached: the one given, else what the baseline ends with on average."""
    return {
        game: given.get(game, float(np.mean(comparison.returns[baseline][:, -1])))
        for game, comparison in comparisons.items()
        if comparison is not None and (game in given or baseline in comparison.returns)
    }


def rows(
    comparisons: Mapping[str, Comparison | None],
    arms: Sequence[str],
    baseline: str | None,
    wanted: Mapping[str, float],
) -> list[Row]:
    """The table of each game, arms in their order."""
    final, area = (scores(comparisons, of, arms) for of in ("final", "area"))
    found = []
    for game, comparison in comparisons.items():
        for arm in arms:
            if comparison is None or arm not in comparison.returns:
                continue
            mine = [{game: x[arm][game]} for x in (final, area)]
            differences = [None, None]
            if arm != baseline and game in final.get(baseline, {}):
                theirs = [{game: x[baseline][game]} for x in (final, area)]
                differences = [
                    statistics.estimate_difference(x, y) for x, y in zip(mine, theirs, strict=True)
                ]
            values = [statistics.estimate(statistics.mean, x) for x in mine]
            taken = np.full(len(comparison.returns[arm]), np.nan)
            if game in wanted:
                taken = statistics.steps_to(comparison.steps, comparison.returns[arm], wanted[game])
            never = np.isnan(taken)
            reaching = statistics.estimate(_median_run, {game: np.where(never, NEVER, taken)})
            found.append(Row(game, arm, len(taken), *values, *differences, reaching, int((~never).sum())))
    return found


def _median_run(given: Mapping[str, np.ndarray]) -> np.ndarray:
    (values,) = given.values()
    return np.median(values, axis=-1)


def costs(runs: Sequence[RunData], arms: Sequence[str], baseline: str | None) -> list[Cost]:
    """The cost of each arm on each game.

    Raises:
        ConfigError: a row's clock is no number.
    """
    found = []
    for game, by_arm in collect.grouped(runs).items():
        speeds = {arm: _speed(members) for arm, members in by_arm.items()}
        reference = speeds.get(baseline)
        for arm in arms:
            if arm not in by_arm:
                continue
            members = [run for run in by_arm[arm] if run.rows]
            hours = [(value_of(run, run.rows[-1], "wall_s") or 0.0) / 3600 for run in members]
            total, mean = sum(hours), sum(hours) / len(hours) if hours else 0.0
            relative = reference / speeds[arm] if reference and speeds[arm] else None
            origin = next(filter(None, (_source(run, runs) for run in by_arm[arm])), "")
            found.append(Cost(game, arm, len(members), total, mean, speeds[arm], relative, origin))
    return found


def _speed(runs: Sequence[RunData]) -> float | None:
    rows = [(run, row) for run in runs for row in run.rows if row["kind"] == "train"]
    values = [value_of(run, row, "wall_steps_per_s") for run, row in rows]
    values = [value for value in values if value]
    return float(np.median(values)) if values else None


def _source(run: RunData, runs: Sequence[RunData]) -> str:
    """The arm of the run that its encoder is from; the path's own words where that run is not among these."""
    if not (path := run.config.encoder_from):
        return ""
    parts = Path(path).parts
    for other in runs:
        # As it is named here, and as it lies on disk: its directory may be a link.
        tails = {p.parts[-3:] for p in (other.path.absolute(), Path(os.path.realpath(other.path)))}
        if any(parts[i : i + 3] in tails for i in range(len(parts))):
            return other.arm
    return configs.source_name(path)


def value_of(run: RunData, row: Mapping[str, Any], key: str) -> float | None:
    """A number of a row; None where it is missing or null.

    Raises:
        ConfigError: it is something else.
    """
    value = row.get(key)
    if value is None:
        return None
    if type(value) not in (int, float) or abs(value) > LIMITS[float]:
        raise ConfigError(f"{run.path / 'metrics.jsonl'}: {key} is not a number of single precision")
    return float(value)


def numbers_of(run: RunData, row: Mapping[str, Any], key: str) -> list[float | None]:
    """A list of numbers of a row, or one number as a list of it; null is None.

    Raises:
        ConfigError: it is something else.
    """
    value = row.get(key)
    items = value if isinstance(value, list) else [value]
    return [value_of(run, {key: item}, key) for item in items]
