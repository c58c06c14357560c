"""Returns of a known distribution, to try statistics on: real runs drawn again, published spreads, formulas.

A population is float64 [values], each as likely as the others; what is drawn from it is drawn with
replacement, so its mean and its quantiles are the truth. Imports no jax.
"""

import functools
from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from srl_jax import data
from srl_jax.errors import ConfigError
from srl_jax.files.reading import ROWS, read_json

from .. import packing
from ..runs import collect
from ..runs.run_data import RunData

RESULTS = Path(__file__).resolve().parents[1] / "results"
CHOSEN = "catch_runs.json"
"""In `RESULTS`: [{"campaign", "games", "seeds", "arms"}], the runs that are analysed together. A list, since
campaigns go on: what is made of it stays the same."""
LEVEL = 0.05
"""Below which the p value of a test is, corrected where there are several, of what is told apart."""
POINTS = 10_001
"""Values of a population that stands for a continuous distribution."""
LEARNS = 0.3
"""How likely a run learns the game, in `two_kinds`."""
MOST_SKEWED = 0.29
"""Standard deviations that a lognormal's median can be below its mean, less a hundredth."""


class ChosenArm(NamedTuple):
    """An arm of a campaign on a game.

    Attributes:
        campaign: the folder of `RESULTS`.
        game, name: of the arm.
        runs: by seed.
    """

    campaign: str
    game: str
    name: str
    runs: list[RunData]


def chosen(results: Path = RESULTS) -> list[ChosenArm]:
    """The arms of `CHOSEN`, in its order.

    Args:
        results: where that file and the campaigns are.

    Raises:
        ConfigError: a file cannot be read, or a run is not there.
    """
    entries = read_json(results / CHOSEN, ROWS)
    campaigns = {entry["campaign"]: {} for entry in entries}
    for name, runs in campaigns.items():
        runs |= {run.key: run for run in packing.read(results / name)}
    found = []
    for entry in entries:
        for game in entry["games"]:
            for arm in entry["arms"]:
                keys = [(game, arm, seed) for seed in entry["seeds"]]
                if missing := [key for key in keys if key not in campaigns[entry["campaign"]]]:
                    raise ConfigError(f"{results / entry['campaign']}: has no run {missing[0]}, see {CHOSEN}")
                runs = [campaigns[entry["campaign"]][key] for key in keys]
                found.append(ChosenArm(entry["campaign"], game, arm, runs))
    return found


def areas(arm: ChosenArm, start: int = 0, until: float = np.inf) -> np.ndarray:
    """The area under each run's learning curve, float64 [runs], between evaluations that all of them have.

    Args:
        arm: whose runs.
        start: env step of the first evaluation, or before it.
        until: env step of the last one, or after it.
    """
    curves = []
    for steps, returns in map(collect.steps_and_returns, arm.runs):
        kept = (steps >= start) & (steps <= until)
        curves.append((steps[kept], returns[kept]))
    return collect.ends({arm.name: curves})[1][arm.name]["area_under_curve"]


def residuals(groups: Sequence[np.ndarray]) -> np.ndarray:
    """What runs differ by from the mean of their arm, of all arms together: a population of mean 0.

    Each is times the root of n / (n - 1) for an arm of n, so that its expected square is the arm's variance.
    """
    return np.concatenate([(x - x.mean()) * np.sqrt(len(x) / (len(x) - 1)) for x in groups])


@functools.cache
def normal(points: int = POINTS) -> np.ndarray:
    """Of mean 0 and standard deviation 1."""
    values = np.array([NormalDist().inv_cdf((i + 0.5) / points) for i in range(points)])
    return values / values.std()


def two_kinds(share: float = LEARNS, spread: float = 0.1) -> np.ndarray:
    """Runs that learn or do not: normal around 1, a share of them, and around 0, less their mean.

    Args:
        share: of runs that learn.
        spread: standard deviation of each kind.
    """
    learn = round(share * POINTS)
    values = np.concatenate([spread * normal(POINTS - learn), 1 + spread * normal(learn)])
    return values - values.mean()


def like(score: data.Score100k) -> np.ndarray:
    """A population with the mean and the standard deviation that were published, and nearly the median.

    A shifted lognormal, mirrored where the median is above the mean. Where it is farther off than a
    lognormal's can be, runs of two kinds, each with a fifth of the standard deviation.

    Raises:
        ValueError: one of the three was not published.
    """
    if not score.sd or score.median is None:
        raise ValueError("a population needs a standard deviation and a median")
    off = (score.mean - score.median) / score.sd
    # What a family's shape is, from the share or the exponent up to which the median falls steadily.
    family, most = (_lognormal, 0.98) if abs(off) <= MOST_SKEWED else (_of_two_kinds, 0.45)
    low, high = 0.0, most
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if -np.median(family(middle)) > abs(off) else (middle, high)
    return score.mean + np.copysign(score.sd, off) * family(low)


def _lognormal(exponent: float) -> np.ndarray:
    return _standard(np.exp(exponent * normal()) if exponent > 1e-6 else normal())


def _of_two_kinds(share: float) -> np.ndarray:
    """Two kinds whose own deviation is a fifth of that of all."""
    between = np.sqrt(share * (1 - share))  # of 0 and 1; 0.2^2 of the variance is within
    return _standard(two_kinds(share, between * 0.2 / np.sqrt(1 - 0.2**2)))


def _standard(values: np.ndarray) -> np.ndarray:
    return (values - values.mean()) / values.std()
