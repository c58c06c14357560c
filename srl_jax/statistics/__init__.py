"""How arms are compared: scores over games and seeds, learning curves, and how certain all of it is.

Scores are float64 [..., runs, games], or a mapping from a game to its scores [..., runs], in which games may
have different numbers of runs. Every statistic takes either, reduces runs and games, and keeps the axes
before them. Definitions are those of Agarwal et al., "Deep reinforcement learning at the edge of the
statistical precipice", 2021, and of its library rliable, with which the tests compare. Every game weighs the
same: where numbers of runs differ, a run of a game with few of them weighs more.

Which interval is right for what is decided in `estimates.py`, behind `estimate`, `estimate_difference` and
`curve_interval`: t intervals for means on one game (Student's of an arm, Welch's of a difference) and over
games, and for interquartile means of few runs; for all else percentile intervals of the stratified bootstrap,
which draws runs again within each game. An `Interval` says which it is. A single run has none: its limits are
NaN.

With few runs the bootstrap is too narrow. Of intervals at 95 %, this share contains the truth, in percent
(`python -m experiments.analyses.coverage`: up to 10,000 simulated experiments each; Atari: distributions like
those of DER's 100 published runs; Catch: residuals of 185 runs; "two kinds": runs of which 30 % learn the
game and the others do not; experiments/results/coverage has the table):

    runs of each game                               2    3    5    7   10   20
    Catch, mean, bootstrap                         49   74   84   87   89   92
    Catch, mean, Student's t                       95   95   95   95   95   95
    Catch, difference, bootstrap                   66   80   88   90   91   93
    Catch, difference, Welch's t                   98   97   95   96   95   95
    Atari, mean of a game, bootstrap               47   69   80   84   88   91
    Atari, mean of a game, Student's t             93   91   90   91   92   94
    Atari, difference on a game, bootstrap         66   80   88   89   91   93
    Atari, difference on a game, Welch's t         97   97   96   96   95   95
    Atari, DER less SPR on a game, Welch's t       95   94   93   93   93   94
    Atari, IQM of 26 games, bootstrap              82   86   90   93   93   96
    Atari, IQM of 26 games, stratified t           97   96   95   96   95   96
    two kinds, mean of one game, Student's t       82   71   83   91   94   94
    two kinds, difference on a game, Welch's t     93   98   98   96   96   95

That Welch's interval leaves out 0 is therefore a two-sided test at about 5 %, at worst at 7 %, from 3 runs on
and nearly so from 2. That a bootstrap interval does is none with few runs: its kind says so below `ENOUGH` of
them. Where runs are of two kinds, no interval of the mean of 2 to 5 of them holds what it says, nor does
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
from srl_jax.statistics.curves import Reached, area_under_curve, at_equal_steps, reached, steps_to
from srl_jax.statistics.estimates import curve_interval, estimate, estimate_difference
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
    bootstrap_curve,
    bootstrap_difference,
    percentile_interval,
)
from srl_jax.statistics.power import MOST, runs_needed, smallest_effect, welch_power
from srl_jax.statistics.student import (
    contrast,
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
    "Interval", "Reached", "area_under_curve", "at_equal_steps", "bootstrap", "bootstrap_curve",
    "bootstrap_difference", "contrast", "curve_interval", "estimate", "estimate_difference",
    "human_normalised", "interquartile_mean", "mean", "mean_difference", "mean_interval", "median",
    "optimality_gap", "percentile_interval", "performance_profile", "probability_of_improvement",
    "reached", "runs_needed", "runs_text", "smallest_effect", "steps_to", "stratified_interval",
    "summary", "t_probability", "t_quantile", "welch_p", "welch_power",
]  # fmt: skip
