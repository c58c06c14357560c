"""How arms are compared: scores over games and seeds, learning curves, and how certain all of it is.

Scores are float64 [..., runs, games], or a mapping from a game to its scores [..., runs], in which games may
have different numbers of runs. Every statistic takes either, reduces runs and games, and keeps the axes
before them. Definitions are those of Agarwal et al., "Deep reinforcement learning at the edge of the
statistical precipice", 2021, and of its library rliable, with which the tests compare. Every game weighs the
same: where numbers of runs differ, a run of a game with few of them weighs more.

Intervals are percentile intervals of the stratified bootstrap: runs are drawn again, with replacement, within
each game. With few runs they are too narrow. Of intervals at 95 %, this share contains the truth, in percent,
where returns are normal (20,000 simulated experiments each):

    runs of each game               2    3    4    5    7   10   20
    mean of one game               50   75   80   84   87   90   93
    mean of five games             76   86   89   90   92   93   94
    difference of means, one game  67   80   85   88   90   92   94

So what 3 to 5 seeds show is a lower bound of the uncertainty: an interval of 3 runs that leaves out 0 is no
test at 5 %. A single run has no interval: its limits are NaN.
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
from srl_jax.statistics.curves import Reached, area_under_curve, at_equal_steps, reached, steps_to
from srl_jax.statistics.intervals import (
    Interval,
    bootstrap,
    bootstrap_difference,
    curve_interval,
    percentile_interval,
)
from srl_jax.statistics.table import runs_text, summary

__all__ = [
    "AGGREGATES",
    "Interval",
    "Reached",
    "area_under_curve",
    "at_equal_steps",
    "bootstrap",
    "bootstrap_difference",
    "curve_interval",
    "human_normalised",
    "interquartile_mean",
    "mean",
    "median",
    "optimality_gap",
    "percentile_interval",
    "performance_profile",
    "probability_of_improvement",
    "reached",
    "runs_text",
    "steps_to",
    "summary",
]
