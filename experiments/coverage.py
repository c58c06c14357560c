"""How often 95 % intervals of few runs contain the truth: `python -m experiments.coverage`.

Simulates experiments whose truth is known and prints the table that srl_jax/statistics/__init__.py shows: the
share of intervals that contain it, in percent. Imports no jax.
"""

from collections.abc import Callable

import numpy as np
from absl import flags

from srl_jax.config import Info
from srl_jax.statistics import bootstrap, bootstrap_difference, mean, mean_difference, mean_interval

from .command_line import flags as config_flags

RUNS = (2, 3, 5, 7, 10, 20)
"""Of each arm, and of each game."""
GAMES = 5
REPETITIONS = 1_000
"""Of a bootstrap."""
LEARNS = 0.3
"""How likely a run learns the game, where returns are of two kinds."""

Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Normal returns, float64, of mean 0."""
    return rng.normal(size=shape)


def two_kinds(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Returns of runs that learn or do not, float64, of mean 0: near 0.7 in 30 % of them, else near -0.3."""
    return rng.normal(rng.random(shape) < LEARNS, 0.1) - LEARNS


def of_bootstrap(rng: np.random.Generator, draw: Draw, runs: int, experiments: int, games: int) -> float:
    """The share of bootstrap intervals of an arm's mean over games that contain it."""
    arms = draw(rng, (experiments, runs, games))
    return _share(*(bootstrap(mean, arm, repetitions=REPETITIONS, seed=i)[:3] for i, arm in enumerate(arms)))


def of_bootstrap_difference(rng: np.random.Generator, draw: Draw, runs: int, experiments: int) -> float:
    """The share of bootstrap intervals of the difference of two like arms on one game that contain 0."""
    pairs = draw(rng, (experiments, 2, runs, 1))
    how = {"repetitions": REPETITIONS}
    return _share(*(bootstrap_difference(x, y, seed=i, **how)[:3] for i, (x, y) in enumerate(pairs)))


def of_t(rng: np.random.Generator, draw: Draw, runs: int, experiments: int) -> float:
    """The share of Student's intervals of an arm's mean on one game that contain it."""
    return _share(mean_interval(draw(rng, (experiments, runs)))[:3])


def of_welch(rng: np.random.Generator, draw: Draw, runs: int, experiments: int) -> float:
    """The share of Welch's intervals of the difference of two like arms on one game that contain 0."""
    return _share(mean_difference(*draw(rng, (2, experiments, runs)))[:3])


def _share(*intervals: tuple) -> float:
    _, low, high = np.stack([np.stack(interval) for interval in intervals], axis=1)
    return float(np.mean((low <= 0) & (high >= 0)))


def table(experiments: int, seed: int = 0) -> list[str]:
    """Lines of text: a row a kind of interval and of returns, a column a number of runs."""
    kinds = {
        "mean of one game, bootstrap": lambda *a: of_bootstrap(*a, games=1),
        "mean of one game, Student's t": of_t,
        "difference on one game, bootstrap": of_bootstrap_difference,
        "difference on one game, Welch's t": of_welch,
        f"mean of {GAMES} games, bootstrap": lambda *a: of_bootstrap(*a, games=GAMES),
    }
    lines = [f"{'runs of each game':44}" + "".join(f"{runs:5}" for runs in RUNS)]
    for returns, draw in (("normal", normal), ("two kinds", two_kinds)):
        for name, covered in kinds.items():
            shares = [covered(np.random.default_rng(seed), draw, runs, experiments) for runs in RUNS]
            lines.append(f"{returns + ', ' + name:44}" + "".join(f"{100 * share:5.0f}" for share in shares))
    return lines


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    print("\n".join(table(flags.FLAGS.experiments)))


if __name__ == "__main__":
    info = Info(int, "simulated for each number of the table", minimum=1, maximum=1_000_000)
    config_flags.define("experiments", info, 10_000)
    config_flags.run(main)
