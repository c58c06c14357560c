"""How arms are compared: scores over games and seeds, learning curves, and how certain all of it is.

Scores are float64 [..., runs, games], or a mapping from a game to its scores [..., runs], in which games may
have different numbers of runs. Every statistic takes either, reduces runs and games, and keeps the axes
before them. Definitions are those of Agarwal et al., "Deep reinforcement learning at the edge of the
statistical precipice", 2021, and of its library rliable, with which the tests compare. Every game weighs the
same: where numbers of runs differ, a run of a game with few of them weighs more.

Which interval is right for what is decided in `estimates.py`, behind `estimate` and `estimate_difference`: t
intervals for means on one game (Student's of an arm, Welch's of a difference) and over games, and for
interquartile means of few runs; for all else percentile intervals of the stratified bootstrap, which draws
runs again within each game. At the points of learning curves [runs, points] it is `mean_interval(returns.T)`.
An `Interval` says which it is. A single run has none: its limits are NaN.

With few runs the bootstrap is too narrow. docs/figures.md has which share of intervals at 95 % contains the
truth, and experiments/results/coverage/README.md has it of more sources of returns. That Welch's interval
leaves out 0 is a two-sided test at about 5 %, at worst at 7 %, from 3 runs on and nearly so from 2. That a
bootstrap interval does is none with few runs: its kind says so below `ENOUGH` of them. Where runs are of two
kinds, some of which learn the game, no interval of the mean of 2 to 5 of them holds what it says, nor does
Welch's of a difference from an arm that has one kind.
`welch_power`, `smallest_effect` and `runs_needed` say how many runs a difference takes.
"""

from srl_jax.statistics.aggregates import (
    AGGREGATES,
    human_normalised,
    interquartile_mean,
    mean,
    median,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
)
from srl_jax.statistics.curves import area_under_curve, at_equal_steps, steps_to
from srl_jax.statistics.estimates import estimate, estimate_difference
from srl_jax.statistics.intervals import (
    BOOTSTRAP,
    ENOUGH,
    NARROW,
    NONE,
    STRATIFIED,
    STUDENT,
    WELCH,
    Interval,
    bootstrap,
    bootstrap_difference,
    percentile_interval,
)
from srl_jax.statistics.power import MOST, runs_needed, smallest_effect, welch_power
from srl_jax.statistics.student import (
    contrast,
    contrast_p,
    holm,
    mean_difference,
    mean_interval,
    stratified_interval,
    t_probability,
    t_quantile,
    welch_p,
)
from srl_jax.statistics.table import runs_text, summary

__all__ = [
    "AGGREGATES", "BOOTSTRAP", "ENOUGH", "MOST", "NARROW", "NONE", "STRATIFIED", "STUDENT", "WELCH",
    "Interval", "area_under_curve", "at_equal_steps", "bootstrap", "bootstrap_difference", "contrast",
    "contrast_p", "estimate", "estimate_difference", "holm", "human_normalised", "interquartile_mean", "mean",
    "mean_difference", "mean_interval", "median", "optimality_gap", "percentile_interval",
    "performance_profile", "probability_of_improvement", "runs_needed", "runs_text", "smallest_effect",
    "steps_to", "stratified_interval", "summary", "t_probability", "t_quantile", "welch_p",
    "welch_power",
]  # fmt: skip
