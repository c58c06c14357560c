"""What a report says in numbers: which runs there are, how they compare, what they cost. Imports no jax."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from srl_jax import statistics
from srl_jax.data import with_reference_scores
from srl_jax.errors import ConfigError
from srl_jax.specs import LIMITS
from srl_jax.statistics import NARROW, Interval

from ..presets import PRESETS
from ..runs import collect
from ..runs.collect import RunData, has_policy
from ..runs.run_data import natural

NEVER = 1e18
"""Env steps that stand for never, where a median is drawn again."""
THRESHOLDS = 101
"""Of a performance profile."""


class Comparison(NamedTuple):
    """The learning curves of one game between the env steps that all of them have.

    Attributes:
        until: the last of these env steps.
        ends: arm -> what arms are compared by, see `collect.ends`.
        curves: arm -> of its runs, see `collect.shared`.
        cut_by: the run that ends first, where others continue.
    """

    until: int
    ends: dict[str, dict[str, np.ndarray]]
    curves: dict[str, collect.Curves]
    cut_by: RunData | None


class Game(NamedTuple):
    """The runs of one game.

    Attributes:
        name: of the game.
        runs: arm -> its runs, arms in the order of the page.
        taken: those of which numbers are shown.
        comparable: whether there are runs to compare.
        comparison: of them; None also where they have no env step in common.
    """

    name: str
    runs: dict[str, list[RunData]]
    taken: list[RunData]
    comparable: bool
    comparison: Comparison | None

    @property
    def sound(self) -> list[RunData]:
        """Those taken that have not failed: others would cut all curves."""
        return [run for run in self.taken if not run.failed]

    @property
    def cut(self) -> list[str]:
        """A line for each arm whose curves of training end before its longest run does."""
        lines = []
        for arm, runs in collect.grouped(self.sound).get(self.name, {}).items():
            reached = {run.seed: reached_step(run) for run in runs}
            if (least := min(reached.values())) < max(reached.values()):
                seeds = ", ".join(str(seed) for seed, steps in reached.items() if steps == least)
                lines.append(f"{arm}: cut at {least:,} env steps, where seed {seeds} is")
        return lines

    @property
    def first(self) -> list[RunData]:
        """Each arm's first seed of these."""
        return list({run.arm: run for run in reversed(self.sound)}.values())[::-1]

    @property
    def played(self) -> list[RunData]:
        """Those with a policy."""
        return [run for runs in self.runs.values() for run in runs if has_policy(run)]

    @property
    def finals(self) -> dict[str, tuple[Interval, str]]:
        """arm -> the mean return of its final games, over seeds, and how many games of how many seeds.

        Of runs that have played them.
        """
        found = {}
        for arm, runs in collect.grouped(self.sound).get(self.name, {}).items():
            rows = [row for run in runs for row in run.rows if row.get(collect.FINAL) is not None]
            if rows:
                means = {self.name: np.array([row[collect.FINAL] for row in rows], float)}
                games = " or ".join(map(str, sorted({row.get("final/games", "?") for row in rows}, key=str)))
                steps = " or ".join(f"{n:,}" for n in sorted({row["env_steps"] for row in rows}))
                told = f"{games} games of each of {len(rows)} seeds after {steps} env steps"
                found[arm] = statistics.estimate(statistics.mean, means), told
        return found

    @property
    def left_out(self) -> list[str]:
        """A line for each arm of which seeds are not compared."""
        lines = collect.left_out_lines([run for runs in self.runs.values() for run in runs])
        return [line.removeprefix(f"{self.name}, ") for line in lines]


def arms_of(runs: Sequence[RunData]) -> list[str]:
    """All arms: those of the presets in their order, then the others; those without a policy last."""
    known = {name.partition("/")[2] or name: i for i, name in reversed(list(enumerate(PRESETS)))}
    playing = {run.arm for run in runs if has_policy(run)}
    return sorted(
        {run.arm for run in runs}, key=lambda a: (a not in playing, known.get(a, len(PRESETS)), natural(a))
    )


def baseline_of(runs: Sequence[RunData], arms: Sequence[str], given: str | None = None) -> str | None:
    """The arm that others are compared with, or None where no arm has a policy.

    The one that was asked for. Else of the arms that are RL alone, or else have a policy, the one on the most
    games; of these the one that differs in the fewest settings from all others, or the first: of arms that
    can be compared, as long as there are some.

    Raises:
        ConfigError: the one that was asked for is not there.
    """
    playing = {run.arm for run in runs if has_policy(run)}
    if given is not None and given not in playing:
        raise ConfigError(
            f"--baseline={given}: not an arm with a policy; valid: {', '.join(sorted(playing))}"
        )
    playing = {run.arm for run in collect.comparable(runs)} or playing
    plain = {run.arm for run in runs if run.config.mode == "rl_only"} & playing
    settings = {run.arm: {tuple(key): x for *key, x in collect.settings(run.config)} for run in runs}

    def order(arm: str) -> tuple[int, int]:
        differences = sum(len(settings[arm].items() ^ settings[other].items()) for other in playing)
        return -len({run.game for run in runs if run.arm == arm}), differences

    return given or min((arm for arm in arms if arm in (plain or playing)), key=order, default=None)


def reached_step(run: RunData) -> int:
    """The env step of its last row, or 0."""
    return max((row["env_steps"] for row in run.rows), default=0)


def finished(run: RunData) -> bool:
    """Whether its last rows are there: those of its last env steps, or of the return that ends a run.

    Behind them is that of the final games, where it plays any. Where there is an ended.json, it decides.
    """
    config = run.config
    if run.ended is not None:
        return run.ended.status == "finished"
    if config.final_games and has_policy(run):
        return run.rows[-1:] != [] and run.rows[-1]["kind"] == "final"
    steps, returns = collect.steps_and_returns(run)
    if config.stop_at_return is not None and (returns >= config.stop_at_return).any():
        return True
    evaluated = len(steps) and steps[-1] >= config.steps // config.eval_every * config.eval_every
    every = min(config.log_every, config.steps)
    return (evaluated or not has_policy(run)) and reached_step(run) >= config.steps // every * every


def compare(runs: Sequence[RunData]) -> Comparison | None:
    """The learning curves of one game's runs, as figures compare them; None where no env step is all's.

    Raises:
        ConfigError: the evaluations of a run are not in ascending order.
    """
    every = [collect.steps_and_returns(run) for run in runs]
    curves: dict[str, list] = {}
    for run, curve in zip(runs, every, strict=True):
        curves.setdefault(run.arm, []).append(curve)
    try:
        shared = collect.shared(curves)
    except ConfigError:
        return None
    until, ends = collect.ends(shared)
    last = [int(steps[-1]) for steps, _ in every]
    first = runs[last.index(until)] if until < max(last) else None
    return Comparison(until, ends, shared, first)


def scores(comparisons: Mapping[str, Comparison], of: str) -> dict[str, dict[str, np.ndarray]]:
    """arm -> game -> float64 [runs]: "at_the_end" or "area_under_curve", see `collect.ends`."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for game, comparison in comparisons.items():
        for arm, ends in comparison.ends.items():
            found.setdefault(arm, {})[game] = ends[of]
    return found


def table(
    comparisons: Mapping[str, Comparison], of: str, baseline: str | None
) -> dict[str | None, dict[str, dict[str, Interval]]]:
    """game -> arm -> statistic -> its Interval; the game None is for all that every arm has, normalised.

    Args:
        comparisons: from `compare`.
        of: see `scores`.
        baseline: what `srl_jax.statistics.summary`, which names the statistics, compares with.
    """
    given = scores(comparisons, of)
    found: dict[str | None, dict[str, dict[str, Interval]]] = {}
    for row in statistics.summary(given, baseline=baseline if baseline in given else None):
        limits = (np.float64(np.nan if row[name] is None else row[name]) for name in Interval._fields[:3])
        own = found.setdefault(row["game"], {}).setdefault(row["arm"], {})
        own[row["statistic"]] = Interval(*limits, row["kind"])
    return found


def verdict(difference: Interval) -> str:
    """What an interval of a difference says; nothing is concluded from one that is too narrow."""
    if np.isnan(difference.low):
        return "no interval"
    if difference.kind == NARROW:
        return "too few seeds"
    return "better" if difference.low > 0 else "worse" if difference.high < 0 else "not told apart"


def reaching(comparison: Comparison, target: float) -> dict[str, tuple[Interval, int]]:
    """arm -> env steps until a score is reached, the median over seeds, and how many seeds reached it.

    NEVER or more is never.
    """
    found = {}
    for arm, curves in comparison.curves.items():
        taken = np.array([statistics.steps_to(*curve, target) for curve in curves])
        times = {"": np.where(np.isnan(taken), NEVER, taken)}
        median = statistics.estimate(lambda drawn: np.median(drawn[""], axis=-1), times)
        found[arm] = median, int(np.isfinite(taken).sum())
    return found


def profiles(comparisons: Mapping[str, Comparison]) -> tuple[list[str], np.ndarray, dict[str, Interval]]:
    """The share of an arm's runs that end above a normalised return, averaged over games.

    Returns:
        The games that every arm with a policy has and that have reference scores; thresholds [T], from just
        below the smallest score to the largest; arm -> its profile [T], no arm where there is no such game.
    """
    given = scores(comparisons, "at_the_end")
    games = with_reference_scores(game for game in comparisons if all(game in x for x in given.values()))
    if not games:
        return [], np.zeros(0), {}
    normal = {
        arm: {game: statistics.human_normalised(game, mine[game]) for game in games}
        for arm, mine in given.items()
    }
    every = np.concatenate([x for mine in normal.values() for x in mine.values()])
    thresholds = np.linspace(every.min() - 0.02 * (np.ptp(every) or 1.0), every.max(), THRESHOLDS)

    def profile(drawn: Mapping[str, np.ndarray]) -> np.ndarray:
        return statistics.performance_profile(drawn, thresholds)

    return games, thresholds, {arm: statistics.estimate(profile, mine) for arm, mine in normal.items()}


def hours(runs: Sequence[RunData]) -> float:
    """What runs took so far, all together, by their own clocks."""
    return sum(value_of(run, run.rows[-1], "wall_s") or 0.0 for run in runs if run.rows) / 3600


def speed(runs: Sequence[RunData]) -> float | None:
    """Env steps a second, the median over rows of training."""
    rows = [(run, row) for run in runs for row in run.rows if row["kind"] == "train"]
    values = [value for run, row in rows if (value := value_of(run, row, "wall_steps_per_s"))]
    return float(np.median(values)) if values else None


def value_of(run: RunData, row: Mapping[str, Any], key: str) -> float | None:
    """A number of a row; None where it is missing or null.

    Raises:
        ConfigError: it is something else.
    """
    value = row.get(key)
    if value is not None and (type(value) not in (int, float) or abs(value) > LIMITS[float]):
        raise ConfigError(f"{run.path / 'metrics.jsonl'}: {key} is not a number of single precision")
    return None if value is None else float(value)


def as_csv(runs: Sequence[RunData]) -> str:
    """Every row of all runs: game, arm, seed, kind ("train", "eval", "final"), env_step, a column a number.

    Lists (the returns of single games, drift) are left out. What a row does not have is empty.
    """
    rows = []
    for run in runs:
        for row in run.rows:
            values = {key: value for key, value in row.items() if isinstance(value, int | float)}
            own = {"game": run.game, "arm": run.arm, "seed": run.seed, "kind": row["kind"]}
            rows.append({**own, "env_step": values.pop("env_steps"), **values})
    first = ["game", "arm", "seed", "kind", "env_step"]
    file = io.StringIO()
    writer = csv.DictWriter(
        file, [*first, *sorted({x for row in rows for x in row} - {*first})], lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()
