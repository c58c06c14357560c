"""How often 95 % intervals of few runs contain the truth: `python -m experiments.analyses.coverage`.

Simulates experiments whose truth is known, on returns from formulas, from the runs in results/catch_runs.json
and from published spreads, and prints which share of each kind of interval contains the truth, in percent.
`--out` writes that as DIRECTORY/coverage.json. Imports no jax.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from absl import flags

from srl_jax import data, statistics
from srl_jax.files import display
from srl_jax.specs import Info

from ..command_line import flags as config_flags
from ..runs.json_values import json_text
from . import output, populations

RUNS = (2, 3, 5, 7, 10, 20)
"""Of each arm, and of each game."""
GAMES = 5
"""Of a formula's aggregate."""
REPETITIONS = 1_000
"""Of a bootstrap."""
SEVERAL = 10
"""How many times fewer experiments there are of several games."""
TAILS = (0.025, 0.975)
_BLOCK = 1 << 21
"""Scores that are drawn again at once."""
DER, SPR = "DER, 100 runs", "SPR, 100 runs"


class Returns(NamedTuple):
    """Where returns are drawn from.

    Attributes:
        name: in the table.
        arms: for each game, the populations of its arms, see `populations`: a difference is of two
            different ones of a game, or of the same one twice where the game has no other.
        games: the populations of several games; none has no aggregate.
    """

    name: str
    arms: Sequence[Sequence[np.ndarray]] = ()
    games: Sequence[np.ndarray] = ()


def sources() -> list[Returns]:
    """All that the table is of."""
    normal, two = populations.normal(), populations.two_kinds()
    arms = populations.chosen()
    pools, tens = [], []
    for game in ("Catch", "CatchDistractor"):
        areas = [populations.areas(arm) for arm in arms if arm.game == game]
        pools.append(populations.residuals(areas))
        tens.append([area for area in areas if len(area) == 10])
    der, spr = (
        [
            statistics.human_normalised(game, populations.like(score))
            for game, score in data.atari100k(method).items()
        ]
        for method in (DER, SPR)
    )
    return [
        Returns("normal", [[normal]], [normal] * GAMES),
        Returns("two kinds", [[two]], [two] * GAMES),
        Returns("Catch", [[pools[0]]]),
        Returns("CatchDistractor", [[pools[1]]]),
        Returns("Catch and CatchDistractor", (), pools),
        Returns("arms of ten", tens),
        Returns("Atari 100k, DER", [[game] for game in der], der),
        Returns("Atari 100k, DER and SPR", list(zip(der, spr, strict=True))),
    ]


def mean(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean over games, and what each game adds to its variance.

    Args:
        scores: float64 [..., runs, games].

    Returns:
        float64 [...] and [..., games].
    """
    runs, games = scores.shape[-2:]
    # From the first: runs that are all equal have a variance of 0, and not of a rounding.
    variance = (scores - scores[..., :1, :]).var(-2, ddof=1)
    return scores.mean((-2, -1)), variance / (runs * games**2)


def interquartile_mean(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Likewise of the interquartile mean, by its influence function (Huber 1981, section 3.3)."""
    runs, games = scores.shape[-2:]
    total = runs * games
    cut = total // 4
    values = np.sort(scores.reshape(*scores.shape[:-2], total))
    limits = values[..., [cut, total - 1 - cut]][..., None, :]
    _, variance = mean(np.clip(scores, limits[..., :1], limits[..., 1:]))
    return values[..., cut : total - cut].mean(-1), variance / (1 - 2 * cut / total) ** 2


def mean_again(rng: np.random.Generator, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `mean` gives of runs drawn again within each game, in a product of matrices.

    Args:
        rng: of the draws, which are alike in all experiments.
        scores: float64 [experiments, runs, games].

    Returns:
        float64 [experiments, repetitions] and [experiments, repetitions, games].
    """
    runs, games = scores.shape[-2:]
    counts = rng.multinomial(runs, np.full(runs, 1 / runs), (games, REPETITIONS)).swapaxes(1, 2)
    own = scores.mean(-2, keepdims=True)
    rest = np.moveaxis(scores - own, -1, 0)
    means = rest @ counts / runs
    variances = np.maximum(rest**2 @ counts / runs - means**2, 0) * (runs / (runs - 1))
    variances *= counts.max(1)[:, None] < runs  # a run alone has no spread, whatever was rounded
    points = own.mean(-1) + means.mean(0)
    return points, np.moveaxis(variances, 0, -1) / (runs * games**2)


def interquartile_mean_again(rng: np.random.Generator, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Likewise of `interquartile_mean`."""
    _, runs, games = scores.shape
    draws = rng.integers(runs, size=(REPETITIONS, runs, games))
    return interquartile_mean(scores.astype(np.float32)[:, draws, np.arange(games)])


Statistic = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
AGAIN = {mean: mean_again, interquartile_mean: interquartile_mean_again}


def covered(
    rng: np.random.Generator, arms: Sequence[np.ndarray], statistic: Statistic, truth: float
) -> dict[str, float]:
    """The share of intervals that contain the truth, by their kind.

    Experiments whose runs are all alike are left out: there is no interval, and real runs are not.

    Args:
        rng: what is drawn again comes from it.
        arms: scores float64 [experiments, runs, games] of one arm, or of two whose difference is meant.
        statistic: `mean` or `interquartile_mean`.
        truth: what the intervals should contain.
    """
    differ = _less([statistic(arm) for arm in arms])[1].sum(-1) > 0
    arms = [arm[differ] for arm in arms]
    experiments, runs, games = arms[0].shape
    point, variances = _less([statistic(arm) for arm in arms])
    error, limits = np.sqrt(variances.sum(-1)), {}
    # Satterthwaite (1946): Student's of one arm on one game, Welch's of two.
    freedom = variances.sum(-1) ** 2 / (variances**2).sum(-1) * (runs - 1)
    margin = statistics.t_quantile(0.95, freedom) * error
    limits["t"] = [np.array([point - margin, point + margin])]
    size = max(1, _BLOCK // (REPETITIONS * runs * games))
    for start in range(0, experiments, size):
        block = slice(start, start + size)
        again = [AGAIN[statistic](rng, arm[block]) for arm in arms]
        points, spreads = _less(again)
        limits.setdefault("bootstrap", []).append(_quantiles(points))
        if runs == 2 and games == 1:
            continue  # of a draw of one run twice there is no spread
        spreads = np.sqrt(spreads.sum(-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            high, low = _quantiles((points - point[block, None]) / spreads)
        of = np.array([point[block] - low * error[block], point[block] - high * error[block]])
        limits.setdefault("studentised", []).append(of)
    found = {}
    for kind, blocks in limits.items():
        low, high = np.concatenate(blocks, axis=1)
        found[kind] = float(np.mean((low <= truth) & (truth <= high)))
    return found


def _quantiles(values: np.ndarray) -> np.ndarray:
    """`TAILS` of what is finite in each row of [rows, repetitions], to the next value: [2, rows]."""
    values = np.sort(np.where(np.isfinite(values), values, np.nan))  # NaN goes last
    last = np.isfinite(values).sum(-1) - 1
    return np.stack([values[np.arange(len(values)), np.rint(tail * last).astype(int)] for tail in TAILS])


def _less(arms: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """The first arm's statistic less the second's, and what adds to its variance; of one arm, its own."""
    point, *others = (point for point, _ in arms)
    return point - sum(others), np.concatenate([variances for _, variances in arms], axis=-1)


def drawn(
    rng: np.random.Generator, given: Sequence[Sequence[np.ndarray]], experiments: int, runs: int
) -> list[np.ndarray]:
    """Scores of two arms on one game, [experiments, runs, 1] each, less the means of their populations.

    Args:
        rng: of the games, the arms and their runs.
        given: see `Returns.arms`; each experiment is on one of the games.
        experiments: how many.
        runs: of each arm.
    """
    games = rng.integers(len(given), size=experiments)
    sizes = np.array([len(given[game]) for game in games])
    first = rng.integers(sizes)
    second = (first + rng.integers(1, np.maximum(sizes, 2))) % sizes
    centred = [[arm - arm.mean() for arm in arms] for arms in given]
    return [
        np.array([rng.choice(centred[game][arm], runs) for game, arm in zip(games, arms, strict=True)])[
            ..., None
        ]
        for arms in (first, second)
    ]


def table(
    experiments: int, given: Sequence[Returns], seed: int = 0
) -> dict[str, dict[str, list[float | None]]]:
    """What intervals cover: source -> "mean, t" and so on -> a share for each of `RUNS`, None where none is.

    Args:
        experiments: that are simulated of one game; of several games a tenth of them.
        given: where returns come from.
        seed: of all draws.
    """
    found: dict[str, dict[str, list[float | None]]] = {}
    for source in given:
        rows = found[source.name] = {}
        for runs in RUNS:
            rng = np.random.default_rng([seed, zlib.crc32(source.name.encode()), runs])
            shares = {}
            if source.arms:
                arms = drawn(rng, source.arms, experiments, runs)
                shares["mean"] = covered(rng, arms[:1], mean, 0.0)
                shares["difference"] = covered(rng, arms, mean, 0.0)
            if source.games:
                size = (max(1, experiments // SEVERAL), runs)
                scores = np.stack([rng.choice(game, size) for game in source.games], axis=-1)
                every = {str(i): game for i, game in enumerate(source.games)}
                of = f"of {len(source.games)} games"
                shares[f"mean {of}"] = covered(rng, [scores], mean, float(statistics.mean(every)))
                truth = float(statistics.interquartile_mean(every))
                shares[f"interquartile mean {of}"] = covered(rng, [scores], interquartile_mean, truth)
            for of, kinds in shares.items():
                for kind in ("t", "studentised", "bootstrap"):
                    rows.setdefault(f"{of}, {kind}", []).append(kinds.get(kind))
    return found


def lines(found: Mapping[str, Mapping[str, Sequence[float | None]]]) -> list[str]:
    """The table as text, in percent: a row an interval, a column a number of runs."""
    names = [f"{source}: {of}" for source, rows in found.items() for of in rows]
    width = max(map(len, names)) + 1
    shown = [f"{'runs of each game':{width}}" + "".join(f"{runs:5}" for runs in RUNS)]
    shares = [shares for rows in found.values() for shares in rows.values()]
    for name, row in zip(names, shares, strict=True):
        cells = ("-" if share is None else f"{100 * share:.0f}" for share in row)
        shown.append(f"{name:{width}}" + "".join(f"{cell:>5}" for cell in cells))
    return shown


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    info = Info(int, "simulated for each number of the table", minimum=1, maximum=1_000_000)
    config_flags.define("experiments", info, 10_000, values)
    output.define_out("coverage.json", values)


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    out = output.place(values.out, drawn=False)
    found = table(values.experiments, sources())
    display.result("\n".join(lines(found)))
    if out is not None:
        content = {
            "experiments": values.experiments,
            "repetitions": REPETITIONS,
            "runs": RUNS,
            "covered": found,
        }
        output.write(out, {"coverage.json": json_text(content)})


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
