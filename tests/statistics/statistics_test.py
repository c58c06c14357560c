"""Statistics: hand-worked numbers, rliable as the independent reference, what must hold of any interval."""

from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.analyses import coverage
from srl_jax import statistics
from srl_jax.statistics import (
    area_under_curve,
    at_equal_steps,
    bootstrap,
    bootstrap_difference,
    contrast,
    contrast_p,
    estimate,
    estimate_difference,
    holm,
    human_normalised,
    interquartile_mean,
    mean,
    mean_difference,
    mean_interval,
    median,
    optimality_gap,
    percentile_interval,
    performance_profile,
    probability_of_improvement,
    stratified_interval,
    summary,
    t_probability,
    t_quantile,
    welch_p,
)
from srl_jax.statistics.aggregates import interquartile_terms
from tests.references import library, metrics, stats

SCORES = np.random.default_rng(0).normal(0.6, 0.7, size=(6, 4))
OTHERS = np.random.default_rng(1).normal(0.5, 0.7, size=(5, 4)).round(1)
THRESHOLDS = np.linspace(-1, 2, 13)
PAIRS = {
    "mean": (mean, "aggregate_mean"),
    "median": (median, "aggregate_median"),
    "interquartile_mean": (interquartile_mean, "aggregate_iqm"),
    "optimality_gap": (optimality_gap, "aggregate_optimality_gap"),
}
"""Each aggregate here and in rliable."""
matrices = st.tuples(st.integers(1, 7), st.integers(1, 5)).flatmap(
    lambda shape: st.lists(
        st.lists(st.integers(-40, 80), min_size=shape[1], max_size=shape[1]),
        min_size=shape[0],
        max_size=shape[0],
    )
)


def test_human_normalised_score_is_0_for_random_play_and_1_for_a_human():
    np.testing.assert_allclose(human_normalised("Pong", [-20.7, 14.6, 21.0]), [0, 1, 41.7 / 35.3], rtol=1e-12)
    assert human_normalised("Catch", 0.5) == human_normalised("CatchDistractor", 0.5) == 0.75
    with pytest.raises(ValueError, match="no reference scores for game Chess"):
        human_normalised("Chess", 0)


def test_aggregates_of_hand_worked_scores():
    scores = np.array([[0.0, 4.0, 1.0], [2.0, 8.0, 0.0]])  # means of games: 1, 6, 0.5
    assert mean(scores) == 2.5
    assert median(scores) == 1.0
    assert interquartile_mean(scores) == (0 + 1 + 2 + 4) / 4  # 6 // 4 = 1 run is cut at either end
    assert optimality_gap(scores) == pytest.approx((1 + 0 + 0 + 0 + 0 + 1) / 6)
    assert optimality_gap(scores, threshold=4) == pytest.approx((4 + 0 + 3 + 2 + 0 + 4) / 6)


@given(scores=matrices)
def test_aggregates_are_rliables(scores):
    scores = np.array(scores) / 40
    for ours, theirs in PAIRS.values():
        np.testing.assert_allclose(ours(scores), getattr(metrics, theirs)(scores), rtol=1e-12, atol=1e-12)


def test_games_with_different_numbers_of_runs_weigh_the_same():
    ragged = {"a": [1.0, 2.0], "b": [3.0, 5.0, 0.0, 4.0]}
    same = np.array([[1, 1, 2, 2], [3, 5, 0, 4]], float).T  # the runs of a, twice each
    for name, (ours, theirs) in PAIRS.items():
        assert ours(ragged) == pytest.approx(getattr(metrics, theirs)(same), abs=1e-12), name
    assert interquartile_mean(ragged) == (1 + 2 + 2 + 3) / 4
    assert interquartile_mean({"a": [1.0] * 3, "b": [4.0] * 5}) == 2.5


def test_leading_axes_are_kept():
    many = np.stack([SCORES, SCORES + 1, 2 * SCORES])
    for ours, _ in PAIRS.values():
        np.testing.assert_allclose(ours(many), [ours(x) for x in many], rtol=1e-12)
    found = probability_of_improvement(many, np.stack([OTHERS] * 3))
    np.testing.assert_allclose(found, [probability_of_improvement(x, OTHERS) for x in many], rtol=1e-12)
    assert performance_profile(many, THRESHOLDS).shape == (3, 13)


def test_probability_of_improvement_counts_pairs_and_half_of_ties():
    x, y = np.array([[1.0, 5], [3, 5], [2, 5]]), np.array([[2.0, 5], [0, 5]])
    # First game: 1 beats 0, 3 beats both, 2 beats 0 and ties: 4.5 of 6. Second: ties alone.
    assert probability_of_improvement(x, y) == pytest.approx((4.5 / 6 + 0.5) / 2)
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1)
    assert probability_of_improvement({"g": [1, 2], "h": [0]}, {"h": [1], "g": [0]}) == 0.5
    with pytest.raises(ValueError, match="the games differ: g and h"):
        probability_of_improvement({"g": [1]}, {"h": [1]})


@given(x=matrices, runs=st.integers(1, 6))
def test_probability_of_improvement_is_rliables(x, runs):
    x = np.array(x, float)
    y = np.resize(x[::-1].T, (runs, x.shape[1]))
    ours, theirs = probability_of_improvement(x, y), metrics.probability_of_improvement(x, y)
    assert ours == pytest.approx(theirs, abs=1e-12)
    assert probability_of_improvement(x, x) == pytest.approx(0.5)


def test_performance_profile_is_rliables_and_strictly_above():
    scores = np.array([[0.0, 1.0], [1.0, 3.0]])
    assert performance_profile(scores, [0, 1, 2, 3]).tolist() == [0.75, 0.25, 0.25, 0]
    assert performance_profile({"a": [0, 1, 2, 3], "b": [5]}, [1.5]) == 0.75
    theirs = library.score_distributions(SCORES, THRESHOLDS)
    np.testing.assert_allclose(performance_profile(SCORES, THRESHOLDS), theirs, atol=1e-12)


def _again(scores: np.ndarray) -> np.ndarray:
    """Scores drawn again as rliable draws them, from numpy's global generator."""
    return scores[np.random.choice(len(scores), scores.shape), np.arange(scores.shape[1])]


def test_intervals_are_rliables_for_the_same_draws():
    names = list(PAIRS)
    np.random.seed(3)
    points, limits = library.get_interval_estimates(
        {"arm": SCORES}, lambda x: np.array([getattr(metrics, PAIRS[n][1])(x) for n in names]), reps=200
    )
    np.random.seed(3)
    drawn = np.stack([_again(SCORES) for _ in range(200)])
    for i, name in enumerate(names):
        ours = PAIRS[name][0]
        assert ours(SCORES) == pytest.approx(points["arm"][i], abs=1e-12)
        np.testing.assert_allclose(percentile_interval(ours(drawn)), limits["arm"][:, i], atol=1e-12)


def test_intervals_of_pairs_are_rliables_for_the_same_draws():
    np.random.seed(4)
    _, limits = library.get_interval_estimates(
        {"pair": (SCORES, OTHERS)},
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        reps=30,
    )
    np.random.seed(4)
    x, y = (np.stack(d) for d in zip(*((_again(SCORES), _again(OTHERS)) for _ in range(30)), strict=True))
    ours = percentile_interval(probability_of_improvement(x, y))
    np.testing.assert_allclose(ours, limits["pair"][:, 0], atol=1e-12)


def test_intervals_of_profiles_are_rliables_for_the_same_draws():
    np.random.seed(5)
    _, limits = library.create_performance_profile({"arm": SCORES}, THRESHOLDS, reps=50)
    np.random.seed(5)
    drawn = np.stack([_again(SCORES) for _ in range(50)])
    ours = percentile_interval(performance_profile(drawn, THRESHOLDS))
    np.testing.assert_allclose(ours, limits["arm"], atol=1e-12)


def test_draws_are_with_replacement_within_a_game():
    # Game a: a mean of 0, 0.5, 0.5 or 1 over two draws, each with 1/4; game b: always 10.
    scores = {"a": [1.0, 0.0], "b": [10.0, 10.0]}
    assert bootstrap(mean, scores, level=0.6)[:3] == (5.25, 5.0, 5.5)
    assert bootstrap(mean, scores, level=0.4)[:3] == (5.25, 5.25, 5.25)


def test_arms_are_drawn_independently():
    arm = {"a": [0.0, 1.0]}
    # The difference is -1 or 1 with 1/16 each, so 0.9 holds both; drawn alike it would be 0 throughout.
    assert bootstrap_difference(arm, arm, level=0.9)[:3] == (0, -1, 1)
    assert bootstrap(probability_of_improvement, arm, arm, level=0.9)[:3] == (0.5, 0, 1)
    shifted = bootstrap_difference(SCORES + 3, SCORES, median, seed=2)
    assert shifted.point == pytest.approx(3) and shifted.low < 3 < shifted.high


def test_equal_arms_are_neither_better_nor_worse():
    same = np.full((4, 2), 0.3)
    assert bootstrap(probability_of_improvement, same, same).point == 0.5
    assert bootstrap_difference(same, same).point == 0


@given(order=st.permutations(range(6)), seed=st.integers(0, 100))
def test_the_order_of_runs_changes_nothing(order, seed):
    once = partial(bootstrap, interquartile_mean, repetitions=100, seed=seed)
    assert once(SCORES) == once(SCORES[order])


@given(seed=st.integers(0, 100))
def test_an_interval_grows_with_its_level_and_holds_a_symmetric_arms_mean(seed):
    symmetric = np.array([[-2.0, 1], [-1, 2], [0, 3], [1, 4], [2, 5]])
    narrow, wide = (bootstrap(mean, symmetric, level=level, seed=seed) for level in (0.5, 0.95))
    assert wide.low < narrow.low < narrow.point < narrow.high < wide.high


def test_the_interval_of_ten_normal_runs_covers_less_than_it_says_but_not_by_much():
    rng = np.random.default_rng(6)
    found = [bootstrap(mean, rng.normal(size=(10, 1)), repetitions=400, seed=i) for i in range(400)]
    covered = np.mean([interval.low <= 0 <= interval.high for interval in found])
    assert 0.85 < covered < 0.97


def test_t_intervals_of_hand_worked_scores():
    # 1, 2, 3: the standard error is 1 / sqrt(3), and t of two degrees of freedom 4.3027 (any table).
    margin = 4.302653 / np.sqrt(3)
    assert mean_interval([1, 3, 2])[:3] == pytest.approx((2, 2 - margin, 2 + margin))
    # Of arms with the same spread and number of runs Welch has both arms' degrees of freedom, 4: 2.7764.
    margin = 2.776445 * np.sqrt(2 / 3)
    assert mean_difference([5, 6, 7], [1, 3, 2])[:3] == pytest.approx((4, 4 - margin, 4 + margin))
    assert (
        mean_interval([0.0, 1.0]).kind == "Student's t"
        and mean_difference([0, 1], [0, 1]).kind == "Welch's t"
    )


def test_a_contrast_by_hand():
    """Means 1, 2, 4 and 6, whose variances are 1, 4, 0 and 1, with 1, 1, 1 and 2 degrees of freedom."""
    groups = [0.0, 2.0], [0.0, 4.0], [4.0, 4.0], [6 - 3**0.5, 6.0, 6 + 3**0.5]
    found = contrast(groups, (1, -1, -1, 1))
    margin = float(t_quantile(0.95, 36 / (1 + 16 + 1 / 2))) * 6**0.5
    assert found[:3] == pytest.approx((1, 1 - margin, 1 + margin)) and found.kind == "stratified t"
    two = contrast(([5, 6, 7], [1, 3, 2.5]), (1, -1))
    assert two[:3] == pytest.approx(mean_difference([5, 6, 7], [1, 3, 2.5])[:3])
    assert np.isnan(contrast(([1.0], [0.0, 1.0]), (1, -1)).low)


def test_t_is_scipys():
    freedom = np.array([1, 1.01, 1.4, 2, 2.5, 3, 4, 7.7, 10, 30, 100, 1000])
    for level in (0.1, 0.5, 0.9, 0.95, 0.99, 0.999):
        np.testing.assert_allclose(
            t_quantile(level, freedom), stats.t.ppf((1 + level) / 2, freedom), rtol=1e-7
        )
    for t in (0, 1e-6, 0.3, 1, 2, 5, 30, 1000):
        np.testing.assert_allclose(t_probability(t, freedom), 1 - 2 * stats.t.sf(t, freedom), atol=1e-7)


@given(
    x=st.lists(st.integers(-40, 80), min_size=2, max_size=9),
    y=st.lists(st.integers(-40, 80), min_size=2, max_size=9),
)
def test_intervals_and_p_values_of_differences_are_scipys(x, y):
    difference, p = mean_difference(x, y), welch_p(x, y)
    if len(set(x)) == len(set(y)) == 1:  # no spread at all: no interval, no test
        assert np.isnan(difference.low) and np.isnan(p)
        return
    theirs = stats.ttest_ind(x, y, equal_var=False)
    assert p == pytest.approx(theirs.pvalue, abs=1e-7)
    low, high = theirs.confidence_interval(0.95)
    assert difference[:3] == pytest.approx((np.mean(x) - np.mean(y), low, high), rel=1e-6, abs=1e-9)
    if abs(p - 0.05) > 1e-6:
        assert (p < 0.05) == (not difference.low <= 0 <= difference.high)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])  # stops at the first above 0.05
    np.testing.assert_allclose(holm([np.nan, 0.01]), [np.nan, 0.02])
    assert holm([]).shape == (0,)


def test_a_contrast_has_the_p_of_its_interval():
    groups = np.random.default_rng(3).normal(size=(4, 6)) * [[1], [2], [3], [1]] + [[2], [0], [0], [0]]
    weights = [1, -1, -1, 1]
    p = contrast_p(groups, weights)
    assert contrast_p(groups[:2], [1, -1]) == pytest.approx(welch_p(*groups[:2]))
    assert contrast(groups, weights, 1 - p + 1e-5).low < 0 < contrast(groups, weights, 1 - p - 1e-5).low
    assert np.isnan(contrast_p([groups[0], [1.0]], [1, -1]))


def test_differences_of_real_runs():
    # Areas under the curve of five seeds an arm, of experiments/results/catch_weight. Of the first, the
    # bootstrap's interval leaves out 0, [-0.166, -0.010], and Welch's does not; of the second it just does.
    rl, joint = [-0.333, -0.470, -0.494, -0.279, -0.416], [-0.521, -0.440, -0.526, -0.444, -0.489]
    found = mean_difference(joint, rl)
    assert found[:3] == pytest.approx((-0.086, -0.197, 0.026), abs=5e-4)
    assert welch_p(joint, rl) == pytest.approx(0.107, abs=5e-4)
    assert bootstrap_difference({"g": joint}, {"g": rl}).high < 0
    rl, joint = [-0.113, -0.082, -0.079, 0.062, -0.229], [0.114, -0.011, 0.173, 0.130, -0.068]
    assert mean_difference(joint, rl)[:3] == pytest.approx((0.156, 0.006, 0.306), abs=5e-4)
    assert welch_p(joint, rl) == pytest.approx(0.044, abs=5e-4)


def test_t_intervals_keep_leading_axes_and_need_spread():
    x, y = np.random.default_rng(8).normal(size=(2, 3, 4, 5))
    for found, one in (
        (mean_interval(x), lambda i: mean_interval(x[i])),
        (mean_difference(x, y[..., :3]), lambda i: mean_difference(x[i], y[i][..., :3])),
    ):
        for i in np.ndindex(3, 4):
            assert [values[i] for values in found[:3]] == pytest.approx(one(i)[:3], rel=1e-12)
    assert mean_interval(x[0, 0]) == mean_interval(x[0, 0, ::-1])  # the order changes no bit
    # Equal runs say nothing of the spread, also where their mean is rounded; one arm with some is enough.
    assert np.isnan(mean_interval([0.1] * 3).low) and np.isnan(mean_difference([0.1] * 3, [0.3] * 3).low)
    assert mean_difference([1.0] * 3, [1.0, 2.0]).low < 0
    for found in (mean_interval([1.0]), mean_difference([1.0, 2.0], [3.0])):
        assert np.isnan(found.low) and np.isnan(found.high) and found.kind == statistics.NONE


def test_which_interval_is_right_for_what():
    one, two = {"a": [0.0, 1.0, 3.0]}, {"a": [0.0, 1.0, 3.0], "b": [1.0, 2.0]}
    other = {"a": [2.0, 2.5]}
    assert estimate(mean, one) == mean_interval(one["a"])
    assert estimate(median, one)[:3] == estimate(mean, one)[:3]
    assert estimate(optimality_gap, one)[:3] == pytest.approx(mean_interval([1.0, 0.0, 0.0])[:3])
    assert estimate_difference(one, other) == mean_difference(one["a"], other["a"])
    # All else is drawn again, and too narrow with fewer than five runs of some game.
    for statistic in (median, interquartile_mean):
        assert estimate(statistic, two) == bootstrap(statistic, two)
    assert estimate(interquartile_mean, one) == bootstrap(interquartile_mean, one)
    assert estimate(probability_of_improvement, one, other).kind == statistics.NARROW
    assert estimate_difference(two, two, median).kind == statistics.NARROW
    # Means over games have the t interval of runs within games.
    assert estimate(mean, two) == stratified_interval(two)
    assert estimate(optimality_gap, two)[:3] == pytest.approx(
        stratified_interval({"a": [1.0, 0.0, 0.0], "b": [0.0, 0.0]})[:3]
    )
    difference = estimate_difference(two, {"a": [1.0, 2.0], "b": [0.0, 5.0, 7.0]})
    groups = [*two.values(), [1.0, 2.0], [0.0, 5.0, 7.0]]
    assert difference == contrast(groups, (0.5, 0.5, -0.5, -0.5))
    with pytest.raises(ValueError, match="the games differ: a, b and a"):
        estimate_difference(two, one)


def test_the_interval_of_an_interquartile_mean_with_few_runs():
    scores = np.random.default_rng(1).normal(size=(3, 6)) * [1, 2, 0.5, 3, 1, 1] + [0, 1, -1, 2, 5, 0]
    found = estimate(interquartile_mean, scores)
    point, variances = coverage.interquartile_mean(scores)  # written on its own
    assert found.kind == statistics.STRATIFIED and found.point == pytest.approx(point)
    freedom = variances.sum() ** 2 / (variances**2 / 2).sum()
    assert found.high - point == pytest.approx(float(t_quantile(0.95, freedom)) * variances.sum() ** 0.5)
    assert estimate(interquartile_mean, scores[:, :4]).kind == statistics.NARROW  # of few games
    assert estimate(interquartile_mean, np.tile(scores, (4, 1))).kind == statistics.BOOTSTRAP  # of many runs
    # Few runs of one arm decide for a difference.
    difference = estimate_difference(scores, np.tile(scores, (4, 1)), interquartile_mean)
    assert difference.kind == statistics.STRATIFIED and difference.low < 0 < difference.high
    # With other numbers of runs, too, the terms' mean is the interquartile mean, also under leading axes.
    games = {str(i): scores[None, : 2 + i % 2, i] * [[1.0], [-1.0]] for i in range(6)}
    assert mean(interquartile_terms(games)) == pytest.approx(interquartile_mean(games))


def test_it_covers_what_it_says():
    """With three runs of each of 26 games, where the bootstrap has 86 %."""
    rng = np.random.default_rng(0)
    centres, spreads = rng.normal(size=26), rng.uniform(0.1, 1, 26)
    truth = float(interquartile_mean(centres + spreads * rng.normal(size=(20_000, 26))))
    draws = centres + spreads * rng.normal(size=(400, 3, 26))
    found = [estimate(interquartile_mean, scores) for scores in draws]
    assert 0.91 < np.mean([x.low <= truth <= x.high for x in found]) < 0.99


def test_the_interquartile_mean_of_many_different_numbers_of_runs():
    # The least common multiple of these is 3e18 and more than an int64 holds, so by exact fractions:
    scores = {str(n): np.arange(n) % 50 + n / 1000 for n in (101, 103, 107, 109, 113, 127, 131, 137, 139)}
    weighed = sorted((x, Fraction(1, len(game))) for game in scores.values() for x in game)
    cut, total, upto = Fraction(len(scores), 4), Fraction(0), Fraction(0)
    for x, weight in weighed:
        kept = max(0, min(upto + weight, len(scores) - cut) - max(upto, cut))
        total, upto = total + kept * Fraction(x), upto + weight
    assert interquartile_mean(scores) == pytest.approx(float(total / (len(scores) - 2 * cut)), rel=1e-12)
    assert interquartile_mean({str(n): np.full(n, 2.5) for n in range(3, 44)}) == pytest.approx(
        2.5, rel=1e-12
    )


def test_runs_that_are_all_alike_have_no_interval():
    alike, other = {"g": [1.0] * 3, "h": [2.0] * 5}, {"g": [0.0] * 2, "h": [2.0] * 2}
    for found in (
        estimate(interquartile_mean, {"g": [1, 1, 1]}),
        estimate(median, alike),
        estimate(probability_of_improvement, alike, other),
        estimate_difference(alike, other, median),
        bootstrap(partial(performance_profile, thresholds=[0.5, 1.5]), alike),
    ):
        assert np.isfinite(found.point).all() and np.isnan(found[1:3]).all()
    # One run of one game that differs is enough.
    assert estimate(median, {"g": [1.0] * 3, "h": [2.0, 2.0, 4.0]}).low == 1.5
    assert estimate(probability_of_improvement, alike, other | {"h": [1.0, 2.0]}).high == 1


def test_a_single_run_has_no_interval():
    point, low, high, kind = bootstrap(mean, {"a": [1.0], "b": [2.0, 4.0]})
    assert kind == statistics.NONE
    assert point == 2 and np.isnan(low) and np.isnan(high)
    assert np.isnan(mean_interval([[1.0], [2.0]]).low).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean([]), "scores are"),
        (lambda: mean(np.zeros((0, 2))), "no scores"),
        (lambda: mean({}), "no scores"),
        (lambda: mean({"Pong": [1, np.nan]}), "scores of game Pong are not all finite"),
        (lambda: bootstrap(mean, np.zeros((2, 3, 4))), "bootstrap takes scores"),
        (lambda: bootstrap(mean, SCORES, repetitions=0), "repetitions=0"),
        (lambda: bootstrap(mean, SCORES, level=1.0), "level=1.0"),
        (lambda: bootstrap_difference(SCORES, SCORES[:, :2]), "the games differ"),
        (lambda: mean_interval([]), "no runs"),
        (lambda: mean_interval(1.0), "no runs"),
        (lambda: mean_difference([1, 2], [1, np.inf]), "not all finite"),
        (lambda: mean_interval([1, 2], level=0), "level=0"),
        (lambda: at_equal_steps([]), "no curves"),
        (lambda: at_equal_steps([([0, 10], [1, 2]), ([20, 30], [1, 2])]), "all 2 curves have"),
        (lambda: at_equal_steps([([0, 10, 10], [1, 2, 3])]), "whole and ascending"),
        (lambda: at_equal_steps([([0, 10], [1, np.inf])]), "must be finite"),
        (lambda: at_equal_steps([([0, 10], [1])]), "steps .N. and returns"),
        (lambda: area_under_curve([0, 10], [1, 2], until=11), "until=11"),
        (lambda: summary({"a": {"Pong": [1]}}, baseline="b"), "baseline b is not one of the arms: a"),
    ],
)
def test_what_cannot_be_computed_is_said_in_a_line(call, message):
    with pytest.raises(ValueError, match=message):
        call()
