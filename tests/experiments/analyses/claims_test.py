"""Tests of experiments.analyses.claims."""

import json

import numpy as np
import pytest

from experiments.analyses import claims, populations
from srl_jax import data, statistics

SCORES = {"DER, 100 runs": (-20.0, 1.0, -20.0), "SPR, 100 runs": (-18.0, 2.0, -18.2)}
"""Mean, standard deviation, median."""


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(claims, "SPLITS", 40)
    monkeypatch.setattr(claims, "REPETITIONS", 500)


def test_the_rules_by_hand():
    """Deviations of 1 and standard errors of 0.577 of three runs each, whose means differ more and more."""
    y = np.array([[-1.0, 0.0, 1.0]])
    found = {shift: claims.claims(y + shift, y, np.random.default_rng(0)) for shift in (1, 1.2, 2.05, -5)}
    names = ("standard errors apart", "deviations apart", "Welch's t")
    signs = {shift: [int(rules[name][0]) for name in names] for shift, rules in found.items()}
    # 1.155 is twice the standard error; Welch's margin is 2.776 times 0.816.
    assert signs == {1: [0, 0, 0], 1.2: [1, 0, 0], 2.05: [1, 1, 0], -5: [-1, -1, -1]}
    assert found[-5]["bootstrap"] == found[-5]["bootstraps apart"] == [-1]
    assert found[1]["bootstraps apart"] == [0]


def test_the_bootstrap_is_the_librarys():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 30, 5)) * [[[1.0]], [[2.0]]]
    ours = claims.claims(x + 1.2, y, rng)["bootstrap"]
    theirs = [
        statistics.bootstrap_difference(a[:, None] + 1.2, b[:, None]) for a, b in zip(x, y, strict=True)
    ]
    differ = [
        claim != int(found.low > 0) - int(found.high < 0) for claim, found in zip(ours, theirs, strict=True)
    ]
    assert 5 < np.abs(ours).sum() < 25 and sum(differ) <= 1  # of one whose limit is next to 0


def test_false_claims_are_of_all_pairs_of_groups():
    """Of four runs there are three pairs of two against two."""
    found = claims.of_nothing(np.array([0.0, 0.1, 0.2, 9.0]), 2, np.random.default_rng(0))
    assert found["Welch's t"] == 0 and found["deviations apart"] == 0
    found = claims.of_nothing(np.array([0.0, 0.1, 9.0, 9.1]), 2, np.random.default_rng(0))
    assert found["Welch's t"] == pytest.approx(1 / 3)  # the one pair that tells them apart


def test_bootstraps_of_three_runs_are_apart_where_the_runs_are(few, monkeypatch):
    """A draw of the lowest run three times has 1 of 27, more than 2.5 %: the intervals go from run to run."""
    monkeypatch.setattr(claims, "REPETITIONS", 10_000)
    runs = np.random.default_rng(0).normal(size=6)
    found = claims.of_nothing(runs, 3, np.random.default_rng(0))
    assert found["bootstraps apart"] == pytest.approx(1 / 10)


def test_of_arms_that_are_all_alike_a_rate_has_no_interval(few, monkeypatch):
    monkeypatch.setattr(claims, "SEEDS", (5,))
    monkeypatch.setattr(populations, "areas", lambda arm: np.arange(10.0) + 100 * arm.runs[0])
    monkeypatch.setattr(data, "atari100k", lambda method: {"Pong": data.Score100k(*SCORES[method], 100)})
    alike = [populations.ChosenArm("x", "Catch", f"{i}", [i] * 10) for i in range(3)]
    row = claims.analyse(alike)["nothing"]["5"]["Welch's t"]
    assert 0 < row["share"] < 0.1 and row["low"] is None and row["high"] is None


def test_fresh_runs_look_again(few):
    rng = np.random.default_rng(0)
    far = claims.seen_again(rng.normal(size=6), 100 + rng.normal(size=6), 3, rng)
    for made, other, again, claimed, fresh in far.values():
        assert (made, other, again) == (40, 0, 40) and claimed == pytest.approx(fresh, rel=0.05)
    near = claims.seen_again(rng.normal(size=20), rng.normal(size=20), 5, rng)["standard errors apart"]
    assert 0 < near[0] < 40 and near[3] > near[4]  # what was claimed is larger than what is seen again


def test_published_spreads(few):
    pairs = {"a": (populations.normal(), populations.normal() + 50), "b": (populations.normal(),) * 2}
    found = claims.of_published(pairs, 5, np.random.default_rng(0))["Welch's t"]
    assert 1 <= found["claimed"] <= 1.25 and found["wrong sign"] == 0
    assert found["missed"] == pytest.approx(2 - found["claimed"])
    assert found["exaggeration"] == pytest.approx(1, abs=0.05) and found["claimed of nothing"] < 0.4


def test_all_of_it_is_written_alike_each_time(few, monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    values = np.random.default_rng(0).normal(size=(3, 10)) + [[0.0], [1.0], [9.0]]
    arms = [populations.ChosenArm("x", "Catch", name, [None] * 10) for name in "abc"]
    arms.append(populations.ChosenArm("x", "Catch", "few", [None] * 5))
    monkeypatch.setattr(populations, "areas", lambda arm: values["abc".index(arm.name)])
    monkeypatch.setattr(claims, "SEEDS", (5,))
    monkeypatch.setattr(data, "atari100k", lambda method: {"Pong": data.Score100k(*SCORES[method], 100)})
    found = claims.analyse(arms)
    json.dumps(found, allow_nan=False)
    assert json.dumps(found) == json.dumps(claims.analyse(arms))
    assert found["nothing"]["5"]["Welch's t"]["arms"].keys() == {"Catch a", "Catch b", "Catch c"}
    assert claims.tables(found).count("\n| ") == 4 * 2 + 3 * 5 + 3  # heads, rules, intervals
    assert claims.draw(found, tmp_path / "x.png").stat().st_size > 5_000
