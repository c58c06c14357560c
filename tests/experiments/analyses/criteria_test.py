"""Tests of experiments.analyses.criteria: what a campaign wrote down is what is tested."""

import json

import numpy as np
import pytest

from experiments import packing
from experiments.analyses import criteria
from srl_jax.errors import ConfigError
from srl_jax.run.ending import Ending
from tests.helpers import write_run

AREAS = {"base": (0.0, 0.2, 0.4), "low": (1.0, 1.2, 1.4), "high": (2.0, 2.2, 2.4), "same": (0.0, 0.2, 0.5)}
ASKED = {
    "game": "Catch",
    "seeds": [0, 1, 2],
    "measures": ["area"],
    "families": {
        "dose": {"slope": {"low": -1.0, "high": 1.0}},
        "less base": {arm: {arm: 1, "base": -1} for arm in ("low", "same")},
    },
    "doses": {
        "across": "dose",
        "reference": "base",
        "panels": {"one": {"line": {"0.1": "low", "1": "high"}}},
    },
}


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    path = tmp_path_factory.mktemp("criteria")
    for arm, areas in AREAS.items():
        for seed, area in enumerate(
            (*areas, 9.0)[: 4 if arm == "low" else 3]
        ):  # one of a search, which does not count
            run = path / f"runs/Catch/{arm}/seed{seed}"
            write_run(run, (-1.0, 2 * area + 1.0), seed=seed, steps=100, ended=Ending("finished", 100))
            rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
            for i, row in enumerate(rows):
                row |= {"diag/drift/steps": list(range(i)), "diag/drift/cosine": [0.0] * (i - 1) + [area][:i]}
            (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    packing.pack(path / "runs", path / "packed")
    return path / "packed"


@pytest.fixture
def campaign(packed):
    (packed / "criteria.json").write_text(json.dumps(ASKED))
    return packed


def analysed(campaign):
    return criteria.analyse(campaign, criteria.read(campaign))


def test_numbers_by_hand(campaign):
    found = analysed(campaign)
    assert found["arms"]["area"]["low"]["mean"] == pytest.approx(1.2)
    families = found["tests"]["area"]
    slope, less = families["dose"]["slope"], families["less base"]
    # Two arms of three runs with a standard deviation of 0.2: 1 / (0.2 sqrt(2/3)) is 6.12, with 4 degrees.
    assert slope["mean"] == pytest.approx(1.0) and slope["p"] == pytest.approx(0.0036, abs=1e-4)
    assert slope["low"] == pytest.approx(1 - 2.776 * 0.2 * (2 / 3) ** 0.5, abs=1e-3)
    # Holm's correction is over a family: one test is as it was, of two the smaller p is doubled.
    assert slope["holm"] == slope["p"] and less["low"]["holm"] == pytest.approx(2 * less["low"]["p"])
    assert less["same"]["holm"] == less["same"]["p"] > 0.5
    assert found["best"] == {"one": {"line": {"0.1": 0.0, "1": 1.0}}}
    text = criteria.tables(found)
    assert "| slope | **+1.000 [+0.547, +1.453]** | 0.0036 | 0.0036 |" in text
    assert "| same | +0.033 [" in text and "| line | 0 % | 100 % |" in text


def test_how_often_a_dose_is_best():
    values = {"a": np.array([0.0, 1.0]), "b": np.array([0.4, 0.4])}
    shares = criteria.best({"0.1": "a", "1": "b"}, values)
    assert shares["0.1"] == pytest.approx(0.75, abs=0.02)  # of 0, 0.5, 0.5 and 1 the last three are above 0.4
    assert sum(shares.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("measure", ["drift", "centred_drift"])
def test_drift_is_to_the_encoder_before_from_the_second_on(measure):
    key = {"drift": "diag/drift/cosine", "centred_drift": "diag/drift/centred_cosine"}[measure]

    def run(*cosines):
        rows = [{"diag/drift/steps": list(range(len(its))), key: its} for its in cosines]
        return criteria.RunData(None, "Catch", "a", 0, None, rows)

    found = criteria.MEASURES[measure]({"a": [run([], [0.1], [0.2, 0.7], [0.3, 0.4, 0.9])]})
    np.testing.assert_allclose(found["a"], [0.2])
    with pytest.raises(ConfigError, match=f"has no {key}"):
        criteria.MEASURES[measure]({"a": [run([], [0.1])]})
    with pytest.raises(ConfigError, match=f"{key} is null"):
        criteria.MEASURES[measure]({"a": [run([], [0.1], [0.2, None], [0.3, 0.4, 0.9])]})


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"measures": ["areas"]}, 'expected "game", .* out of area, drift, centred_drift'),
        ({"families": {}}, "expected"),
        ({"families": {"a": {"b": ["low"]}}}, "expected"),
        ({"families": {"a": {"b": {"low": "1-"}}}}, "expected"),
        ({"families": {"a": {"b": {"low": "1", "high": None}}}}, "expected"),
        ({"families": {"a": {"b": {}}}}, "expected"),
        ({"doses": {**ASKED["doses"], "reference": ["base"]}}, "expected"),
        ({"doses": {**ASKED["doses"], "panels": {"one": {"line": {"1": ["low"]}}}}}, "expected"),
        (
            {"families": {"a": {"b": {"nobody": 1}}}},
            "nobody on Catch has no run that is over of seed 0, 1, 2",
        ),
        ({"seeds": [0, 1, 3]}, "high on Catch has no run that is over of seed 3"),
        ({"seeds": [0]}, 'two "seeds" or more'),
        ({"seeds": [0, 0]}, 'two "seeds" or more'),
        ({"doses": {"panels": {}}}, "expected"),
        ({"doses": {**ASKED["doses"], "panels": {"one": {"line": {"-1": "low"}}}}}, "expected"),
        ({"game": "Pong"}, "low on Pong has no run"),
    ],
)
def test_criteria_that_are_none_are_one_line(campaign, changed, said):
    (campaign / "criteria.json").write_text(json.dumps({**ASKED, **changed}))
    with pytest.raises(ConfigError, match=said):
        analysed(campaign)


def test_the_picture_has_a_panel_of_each(campaign, tmp_path):
    pytest.importorskip("matplotlib")
    found = analysed(campaign)
    # Runs that are all alike have no interval.
    found["arms"]["area"]["low"] |= {"low": None, "high": None}
    assert criteria.draw(ASKED, found, tmp_path / "doses.png").stat().st_size > 1000


def test_lines_of_other_doses_have_their_shares_below_them():
    best = {"one": {"first": {"0.1": 0.2, "1": 0.8}, "second": {"1": 0.9, "10": 0.1}}}
    text = criteria.tables({"tests": {}, "best": best})
    assert "| best of | 0.1 | 1 | 10 |" in text
    assert "| first | 20 % | 80 % | - |" in text and "| second | - | 90 % | 10 % |" in text
