"""Tests of experiments.analyses.populations."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import packing
from experiments.analyses import populations
from experiments.runs.run_data import load_run
from srl_jax.data import Score100k, atari100k
from srl_jax.errors import ConfigError
from tests.helpers import write_run


@pytest.fixture
def results(tmp_path):
    runs = [
        write_run(tmp_path / f"runs/Catch/a/seed{seed}", (0, seed, 3 * seed), seed=seed) for seed in (1, 2, 3)
    ]
    packing.write(
        tmp_path / "results/one",
        [
            load_run(path)._replace(path=tmp_path / "results/one" / path.parent.name / path.name)
            for path in runs
        ],
    )
    return tmp_path / "results"


def _choose(results: Path, **values):
    entry = {"campaign": "one", "games": ["Catch"], "seeds": [1, 3], "arms": ["a"], **values}
    (results / populations.CHOSEN).write_text(json.dumps([entry]))
    return populations.chosen(results)


def test_the_runs_that_are_named_are_read_and_no_others(results):
    (arm,) = _choose(results)
    assert (arm.campaign, arm.game, arm.name, [run.seed for run in arm.runs]) == ("one", "Catch", "a", [1, 3])
    # Evaluations at 0, 100 and 200 env steps: half of the way between 0 and s, then between s and 3 s.
    np.testing.assert_allclose(populations.areas(arm), [1.25, 3.75])
    np.testing.assert_allclose(populations.areas(arm, start=100), [2, 6])


@pytest.mark.parametrize("values", [{"seeds": [1, 4]}, {"arms": ["b"]}, {"games": ["Pong"]}])
def test_a_run_that_is_not_there_is_said(results, values):
    with pytest.raises(ConfigError, match="has no run"):
        _choose(results, **values)


def test_the_list_of_the_project_is_of_what_it_says():
    entries = json.loads((populations.RESULTS / populations.CHOSEN).read_text())
    for game, arms, runs in (("Catch", 32, 185), ("CatchDistractor", 33, 190)):
        its = [entry for entry in entries if game in entry["games"]]
        assert sum(len(entry["arms"]) for entry in its) == arms
        assert sum(len(entry["arms"]) * len(entry["seeds"]) for entry in its) == runs


def test_residuals_have_the_variance_of_their_arms():
    """Of 0 and 2 the variance is 2, of 5, 5, 8 it is 3: the mean square, weighted by runs, is 13 / 5."""
    found = populations.residuals([np.array([0.0, 2.0]), np.array([5.0, 5.0, 8.0])])
    np.testing.assert_allclose(found[:2], [-(2**0.5), 2**0.5])
    assert found.mean() == pytest.approx(0) and np.mean(found**2) == pytest.approx(13 / 5)


def test_runs_of_two_kinds():
    values = populations.two_kinds()
    assert values.mean() == pytest.approx(0) and np.mean(values > 0.2) == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("off", [0.0, 0.2, -0.29, 0.35, -0.6])
def test_a_population_is_like_what_was_published(off):
    found = populations.like(Score100k(10.0, 2.0, 10 - 2 * off, 100))
    assert found.mean() == pytest.approx(10) and found.std() == pytest.approx(2)
    assert np.median(found) == pytest.approx(10 - 2 * off, abs=0.02)
    with pytest.raises(ValueError, match="a standard deviation and a median"):
        populations.like(Score100k(10.0))


def test_der_and_spr_have_what_populations_need():
    for method in ("DER, 100 runs", "SPR, 100 runs"):
        scores = atari100k(method)
        assert len(scores) == 26 and all(score.sd and score.median is not None for score in scores.values())
