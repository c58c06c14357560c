"""Learning curves, and the summary of several arms: hand-worked numbers."""

import json

import numpy as np
import pytest

from srl_jax import statistics
from srl_jax.statistics import area_under_curve, at_equal_steps, mean_interval, runs_text, steps_to, summary


def test_a_curve_has_the_interval_that_its_points_have():
    curves = np.random.default_rng(7).normal(size=(5, 4))
    found = mean_interval(curves.T)
    for point in range(4):
        expected = mean_interval(curves[:, point])
        assert [x[point] for x in found[:3]] == pytest.approx(expected[:3], rel=1e-12)
    assert found.kind == statistics.STUDENT


def test_curves_meet_where_all_of_them_are():
    long, short = ([0, 10, 20, 30, 40], [0, 1, 2, 3, 4]), ([0, 20, 30], [5, 7, 4])
    steps, returns = at_equal_steps([long, short])
    assert steps.tolist() == [0, 20, 30] and steps.dtype == np.int64
    assert returns.tolist() == [[0, 2, 3], [5, 7, 4]]
    # Different steps: the coarser curve's, the other one's on straight lines; nothing before 5 or after 25.
    steps, returns = at_equal_steps([([5, 15, 25], [1, 3, 9]), ([0, 8, 12, 20, 28], [0, 8, 0, 0, 8])])
    assert steps.tolist() == [5, 15, 25]
    assert returns.tolist() == [[1, 3, 9], [5, 0, 5]]
    steps, returns = at_equal_steps([([0, 20, 40], [1, 3, 5]), ([10, 20, 30, 40], [7, 8, 9, 0])])
    assert steps.tolist() == [20, 40] and returns.tolist() == [[3, 5], [8, 0]]
    steps, returns = at_equal_steps([([0, 10], [1, 3]), ([0], [2])])
    assert steps.tolist() == [0] and returns.tolist() == [[1], [2]]
    # One that has no evaluation where both are does not decide.
    steps, returns = at_equal_steps([([0, 10], [1, 3]), ([4, 5], [2, 2])])
    assert steps.tolist() == [4, 5] and returns.tolist() == [pytest.approx([1.8, 2]), [2, 2]]


def test_area_under_a_curve_is_its_mean_over_time():
    steps, returns = [0, 10, 30], [0.0, 4.0, 6.0]
    assert area_under_curve(steps, returns) == pytest.approx((20 + 100) / 30)
    assert area_under_curve(steps, returns, until=10) == 2
    assert area_under_curve(steps, returns, until=20) == pytest.approx((20 + 45) / 20)
    assert area_under_curve(steps, returns, until=0) == 0
    assert area_under_curve([100], [3.0]) == 3
    np.testing.assert_allclose(area_under_curve(steps, [returns, [7, 7, 7]]), [4, 7])


def test_steps_to_a_score_lie_on_the_line_that_crosses_it_first():
    steps = [0, 10, 20, 30]
    curves = [[0, 4, 0, 8], [3, 0, 0, 9], [0, 1, 2, 2], [0, 0, 3, 3]]
    np.testing.assert_allclose(steps_to(steps, curves, 3), [7.5, 0, np.nan, 20])
    assert steps_to(steps, curves[0], 4) == 10


def test_a_summary_has_every_number_with_its_interval_and_its_runs():
    arms = {
        "joint": {"Pong": [14.6, -20.7, 14.6], "Breakout": [30.5, 1.7]},
        "rl_only": {"Pong": [-20.7, -20.7, -20.7], "Qbert": [100.0]},
    }
    rows = summary(arms, baseline="rl_only", repetitions=200)
    by_key = {(row["arm"], row["game"], row["statistic"]): row for row in rows}
    assert len(by_key) == len(rows)
    json.dumps(rows, allow_nan=False)
    assert by_key["joint", None, "mean"]["point"] == pytest.approx(2 / 3)  # of Pong, which both have
    assert by_key["joint", None, "optimality_gap"]["point"] == pytest.approx(1 / 3)
    assert by_key["joint", "Breakout", "return"]["point"] == pytest.approx(16.1)
    assert by_key["joint", "Breakout", "return"]["runs"] == "2 runs"
    assert by_key["rl_only", "Qbert", "return"]["low"] is None
    kinds = {key: row["kind"] for key, row in by_key.items()}
    assert kinds["joint", "Pong", "return"] == "Student's t"
    assert kinds["joint", "Pong", "return_difference"] == "Welch's t"
    assert kinds["joint", None, "interquartile_mean"] == "stratified bootstrap, too narrow"
    better = by_key["joint", None, "probability_of_improvement"]
    assert better["against"] == "rl_only" and better["point"] == pytest.approx((2 + 0.5) / 3)
    assert by_key["joint", None, "mean_difference"]["point"] == pytest.approx(2 / 3)
    difference = by_key["joint", "Pong", "return_difference"]
    assert difference["point"] == pytest.approx(35.3 * 2 / 3)
    assert difference["low"] <= difference["point"] <= difference["high"]
    names = {statistic for arm, game, statistic in by_key if arm == "joint" and game is None}
    aggregates = set(statistics.AGGREGATES)
    assert names == aggregates | {f"{n}_difference" for n in aggregates} | {"probability_of_improvement"}
    assert not any(row["against"] for row in rows if row["arm"] == "rl_only")


def test_the_number_of_runs_in_words():
    assert runs_text({"Pong": [1]}) == "1 run"
    assert runs_text(np.zeros((5, 2))) == "5 runs of each of 2 games"
    assert runs_text({"Pong": [1, 2], "Qbert": [1]}) == "Pong 2 runs, Qbert 1 run"
