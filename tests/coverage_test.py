"""Tests of experiments.coverage: why differences of few seeds have t intervals."""

import numpy as np
import pytest

from experiments import coverage


@pytest.mark.parametrize("runs", [3, 5])
def test_t_intervals_of_few_runs_hold_what_they_say_and_the_bootstraps_do_not(runs):
    """With 4,000 experiments the standard error of a share near 0.95 is 0.0034, with 500 near 0.88 0.015."""
    rng = np.random.default_rng(0)
    assert 0.93 <= coverage.of_welch(rng, coverage.normal, runs, 4_000) <= 0.97
    assert 0.93 <= coverage.of_t(rng, coverage.normal, runs, 4_000) <= 0.97
    assert coverage.of_bootstrap_difference(rng, coverage.normal, runs, 500) < 0.9
    assert coverage.of_bootstrap(rng, coverage.normal, runs, 500, games=1) < 0.9


def test_returns_of_both_kinds_have_a_mean_of_0():
    drawn = coverage.two_kinds(np.random.default_rng(0), (100_000,))
    assert abs(drawn.mean()) < 0.01
    assert np.mean(drawn > 0.35) == pytest.approx(0.3, abs=0.01)


def test_the_table_has_a_column_for_each_number_of_runs(monkeypatch):
    monkeypatch.setattr(coverage, "RUNS", (2, 3))
    head, *rows = coverage.table(4)
    assert head.split()[-2:] == ["2", "3"] and len(rows) == 10
    assert all(0 <= float(share) <= 100 for row in rows for share in row.split()[-2:])
