"""Tests of experiments.analyses.predictors."""

import json

import numpy as np
import pytest

from experiments.analyses import predictors
from experiments.analyses.populations import ChosenArm
from experiments.analyses.predictors import Stratum
from experiments.runs.run_data import load_run
from tests.helpers import write_run
from tests.references import stats

KEY = "diag/effective_rank"


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(predictors, "PERMUTATIONS", 2_000)
    monkeypatch.setattr(predictors, "REPETITIONS", 200)


def _stratum(rng, seeds, slope):
    x, z = rng.normal(size=(2, len(seeds)))
    return Stratum(x, slope * x + 0.1 * rng.normal(size=len(seeds)), z, np.array(seeds))


def test_correlations_are_scipys():
    x, y, z = np.random.default_rng(0).integers(6, size=(3, 9)).astype(float)  # with equal ones among them
    found, partial = predictors.correlations(predictors.moments(x, y, z))
    assert found == pytest.approx(stats.spearmanr(x, y).statistic)
    # The partial one is that of what is left of two ranks where the third's line is taken off.
    a, b, c = map(predictors.ranks, (x, y, z))
    left = [u - c * (u @ c) / (c @ c) for u in (a, b)]
    assert partial == pytest.approx(np.corrcoef(*left)[0, 1])


def test_without_a_spread_there_is_none():
    assert np.isnan(predictors.correlations(predictors.moments(np.ones(4), np.arange(4), np.arange(4)))).all()


def test_a_seed_changes_places_alike_in_all_arms_and_stays_in_its_block():
    rng = np.random.default_rng(0)
    strata = [_stratum(rng, seeds, 1) for seeds in (range(10, 15), range(10), range(5))]
    places = predictors.seeds_change_places(strata, rng, 50)
    assert places.shape == (50, 20)
    for start, size in ((0, 5), (5, 5), (10, 5), (15, 5)):
        assert (np.sort(places[:, start : start + size]) == np.arange(start, start + size)).all()
    np.testing.assert_array_equal(places[:, 5:10] - 5, places[:, 15:] - 15)
    assert (places[:, 5:10] - 5 != places[:, 10:15] - 10).any()
    with pytest.raises(ValueError, match="a part of a block"):
        predictors.seeds_change_places([_stratum(rng, range(4), 1)], rng, 50)


def test_p_is_the_share_of_permutations_that_correlate_as_much(few):
    """Of five runs in order: of 120 orders, that one and its reverse."""
    five = Stratum(np.arange(5.0), np.arange(5.0), np.zeros(5), np.arange(5))
    for change in (predictors.seeds_change_places, predictors.arms_change_places):
        assert predictors.p_value([five], change, 0) == pytest.approx(2 / 120, abs=0.008)
    again = [five._replace(names=five.names + 5 * i) for i in range(3)]
    assert predictors.p_value(again, predictors.seeds_change_places, 0) < 0.002


def test_an_effect_of_arms_is_none_within_them(few):
    """Arms whose means rise together, while their runs go the other way."""
    rng = np.random.default_rng(0)
    strata = []
    for level in range(8):
        one = _stratum(rng, range(5), -1)
        strata.append(one._replace(x=one.x + 100 * level, y=one.y + 100 * level))
    found = predictors._row(strata, "within arms", KEY)
    assert found["correlation"][0] < -0.8 and found["correlation"][2] < 0 and found["arms"] == 8
    means = Stratum(
        *(np.array([getattr(one, name).mean() for one in strata]) for name in "xyz"), np.arange(8)
    )
    found = predictors._row([means], "across arms", KEY)
    assert found["correlation"][0] == 1 and found["p"] < 0.002 and found["arms"] == 8


def test_what_varies_in_few_arms_has_no_interval(few):
    rng = np.random.default_rng(0)
    strata = [_stratum(rng, range(5), 1) for _ in range(6)]
    strata = strata[:4] + [one._replace(x=np.zeros(5)) for one in strata[4:]]
    found = predictors._row(strata, "within arms", KEY)
    assert (found["vary"], found["arms"]) == (4, 6)
    assert found["correlation"][0] > 0.5 and found["correlation"][1:] == [None, None]
    assert predictors._varying([strata[0]], "across arms") == 5
    assert predictors._varying([strata[0], strata[4]], "across arms") == 5


@pytest.fixture
def arms(tmp_path):
    """Three arms a game in two campaigns, whose ranks say what their returns will be at the end."""
    rng, found = np.random.default_rng(0), []
    for campaign in ("catch_separate", "catch_figures"):
        for game in predictors.GAMES:
            for arm in "abc":
                runs = []
                for seed in range(5):
                    later = float(rng.normal())
                    path = tmp_path / campaign / game / arm / f"seed{seed}"
                    write_run(path, (0, 0, 0, later), every=9_000, seed=seed, game=game, steps=27_000)
                    lines = []
                    for line in (path / "metrics.jsonl").read_text().splitlines():
                        row = json.loads(line)
                        if row["kind"] == "eval":
                            row |= {KEY: 2 * later, "diag/drift/cka": [0.1, -later]}
                            row |= {} if arm == "a" else {"diag/error/forward_pixels/static": 1.0}
                        lines.append(json.dumps(row) + "\n")
                    (path / "metrics.jsonl").write_text("".join(lines))
                    runs.append(load_run(path))
                found.append(ChosenArm(campaign, game, arm, runs))
    return found


def test_values_and_strata(arms):
    run = arms[1].runs[0]
    assert predictors.value(run, "diag/error/*/static", 9_000) == 1
    assert predictors.value(run, "diag/drift/cka", 9_000) == -predictors.value(run, KEY, 9_000) / 2
    assert predictors.value(arms[0].runs[0], "diag/error/*/static", 9_000) is None
    its = [arm for arm in arms if arm.game == "Catch"]
    assert len(predictors.within(its, KEY, 9_000)) == 6
    assert len(predictors.within(its, "diag/error/*/static", 9_000)) == 4
    one, two = predictors.across(its, KEY, 9_000)
    assert len(one.x) == len(two.x) == 3
    assert one.x[0] == np.mean([predictors.value(run, KEY, 9_000) for run in arms[6].runs])


def test_what_predicts_is_found_and_drawn(arms, few, monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(predictors, "KEYS", (KEY, "diag/drift/cka", "diag/error/*/static"))
    monkeypatch.setattr(predictors, "LEVEL", 0.5)  # of few orders some are as good by chance
    rows = predictors.analyse(arms)
    assert json.dumps(rows) == json.dumps(predictors.analyse(arms)) and len(rows) == 2 * 2 * 2 * 4
    its = {key: [row for row in rows if row["key"] == key] for key in (*predictors.KEYS, predictors.SO_FAR)}
    assert all(row["correlation"][0] == 1 for row in its[KEY])
    assert all(row["correlation"] == [-1, -1, -1] and row["vary"] == 6 for row in its["diag/drift/cka"])
    assert all(row["correlation"][0] is None and row["p"] is None for row in its["diag/error/*/static"])
    assert all(row["holm"] is None for row in its[predictors.SO_FAR])
    text = predictors.tables(rows)
    assert text.startswith("16 tests") and text.count("| yes") == 8 and text.count("| no |") == 4
    assert predictors.draw(rows, tmp_path / "x.png").stat().st_size > 5_000


def test_the_verdict():
    rows = [
        {"key": KEY, "holm": 0.01, "correlation": [0.5, 0.3, 0.6], "beyond": [0.4, 0.1, 0.5]},
        {"key": KEY, "holm": 0.04, "correlation": [0.4, 0.3, 0.6], "beyond": [0.2, 0.1, 0.5]},
    ]
    assert predictors.verdict(rows) == "yes, beyond the return so far"
    assert predictors.verdict([rows[0], rows[1] | {"beyond": [0.2, -0.1, 0.5]}]) == "yes"
    assert predictors.verdict([rows[0], rows[1] | {"holm": 0.05}]) == "no"
    assert predictors.verdict([rows[0], rows[1] | {"correlation": [-0.4, -0.5, -0.3]}]) == "no: another sign"
