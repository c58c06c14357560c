"""Tests of experiments.analyses.coverage: why differences of few seeds have t intervals."""

import itertools
import json

import numpy as np
import pytest

from experiments.analyses import coverage, populations
from srl_jax import statistics
from tests.in_process import parse


def _covered(arms, runs, experiments, statistic=coverage.mean, games=1):
    rng = np.random.default_rng(0)
    scores = [rng.normal(size=(experiments, runs, games)) for _ in range(arms)]
    return coverage.covered(rng, scores, statistic, 0.0)


@pytest.mark.parametrize("runs", [3, 5])
def test_t_intervals_of_few_runs_hold_what_they_say_and_the_bootstraps_do_not(runs):
    """With 2,000 experiments the standard error of a share near 0.95 is 0.005, near 0.88 0.007."""
    for arms in (1, 2):
        found = _covered(arms, runs, 2_000)
        assert 0.935 <= found["t"] <= 0.98
        assert found["bootstrap"] < found["studentised"] < found["t"] + 0.02
        assert found["bootstrap"] < 0.91


def test_of_two_runs_on_one_game_there_is_no_studentised_bootstrap():
    assert _covered(1, 2, 50).keys() == {"t", "bootstrap"}
    assert _covered(1, 2, 50, games=3).keys() == {"t", "bootstrap", "studentised"}


def test_the_t_intervals_are_students_and_welchs():
    """Experiments of which a half has means that far off: those within the library's limits are covered."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(400, 4, 1)), 3 * rng.normal(size=(400, 4, 1))
    for truth in (0.4, -2.0):
        for arms, interval in (
            ([x], statistics.mean_interval(x[..., 0])),
            ([x, y], statistics.mean_difference(x[..., 0], y[..., 0])),
        ):
            expected = np.mean((interval.low <= truth) & (truth <= interval.high))
            assert coverage.covered(rng, arms, coverage.mean, truth)["t"] == expected


def test_aggregates_are_the_librarys_and_know_how_much_they_vary():
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(2_000, 8, 5)) * [1, 2, 3, 1, 1] + [0, 0, 1, 2, 8]
    for ours, theirs in (
        (coverage.mean, statistics.mean),
        (coverage.interquartile_mean, statistics.interquartile_mean),
    ):
        point, variances = ours(scores)
        np.testing.assert_allclose(point, theirs(scores))
        assert variances.sum(-1).mean() == pytest.approx(point.var(), rel=0.1)
    assert (coverage.mean(np.full((1, 3, 1), 0.1, np.float32))[1] == 0).all()


def test_means_of_runs_drawn_again_are_those_of_the_draws(monkeypatch):
    """Of two runs, 0 and 1 in one game and 4 and 8 in the other: a draw has both, or one twice."""
    monkeypatch.setattr(coverage, "REPETITIONS", 400)
    points, variances = coverage.mean_again(np.random.default_rng(0), np.array([[[0.0, 4.0], [1.0, 8.0]]]))
    pairs = {(round(float(p), 9), *np.round(v, 9)) for p, v in zip(points[0], variances[0], strict=True)}
    own = {(a, v, b, w) for a, v in ((0, 0), (0.5, 1 / 16), (1, 0)) for b, w in ((4, 0), (6, 1), (8, 0))}
    assert pairs == {((a + b) / 2, v, w) for a, v, b, w in own}
    rng = np.random.default_rng(0)
    points, _ = coverage.interquartile_mean_again(rng, np.array([[[0.0, 4.0], [1.0, 8.0]]]))
    assert {round(float(p), 6) for p in points[0]} == {2, 2.5, 4, 4.5}  # the two in the middle of four


def test_a_difference_is_of_two_arms_of_one_game():
    """Arms whose values are 1 from their mean on a game of one arm, and 10, 20 and 30 on another."""
    given = [[np.array([4.0, 6.0])], [n * np.array([-1.0, 1.0]) + 3 for n in (10, 20, 30)]]
    x, y = coverage.drawn(np.random.default_rng(0), given, 500, 3)
    sizes = np.abs(np.stack([x, y], -1)[..., 0, :])
    assert (sizes == sizes[:, :1]).all()  # all runs of an arm are of one population
    pairs = {(int(a), int(b)) for a, b in sizes[:, 0]}
    assert pairs == {(1, 1), *itertools.permutations((10, 20, 30), 2)}


def test_the_table_has_a_column_for_each_number_of_runs(monkeypatch):
    monkeypatch.setattr(coverage, "RUNS", (2, 3))
    given = [coverage.Returns("a", [[populations.normal()]]), coverage.Returns("b", (), [np.arange(9.0)] * 2)]
    found = coverage.table(40, given)
    assert found == coverage.table(40, given)
    head, *rows = coverage.lines(found)
    assert head.split()[-2:] == ["2", "3"] and len(rows) == 12
    assert rows[1].startswith("a: mean, studentised") and rows[1].split()[-2] == "-"
    assert all(0 <= float(row.split()[-1]) <= 100 for row in rows)
    assert rows[-1].startswith("b: interquartile mean of 2 games, bootstrap")


def test_it_writes_what_it_prints(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(coverage, "RUNS", (3,))
    monkeypatch.setattr(coverage, "sources", lambda: [coverage.Returns("a", [[np.arange(9.0)]])])
    coverage.main(parse(coverage, "--experiments=5", f"--out={tmp_path / 'new'}"))
    written = json.loads((tmp_path / "new/coverage.json").read_text())
    assert coverage.lines(written["covered"]) == capsys.readouterr().out.splitlines()
