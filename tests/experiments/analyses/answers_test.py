"""Tests of experiments.analyses.answers: the numbers of docs/answers.md are those of the runs."""

import json

import numpy as np
import pytest

from experiments.analyses import answers
from srl_jax.errors import ConfigError


def test_the_page_says_what_the_runs_say():
    page = answers.PAGE.read_text(encoding="utf-8")
    assert answers.filled(page) == page
    assert len(answers.MARK.findall(page)) > 30


def test_the_head_of_the_page_is_in_the_readme():
    head = answers.head(answers.PAGE.read_text(encoding="utf-8"))
    assert "<!--" not in head and "](experiments/results/" in head
    assert head in answers.README.read_text(encoding="utf-8")


def test_a_number_of_a_file(tmp_path):
    values = {
        "share": 0.196,
        "rows": [{"game": "Pong", "at": 9, "x": [1.0, 2.345]}, {"game": "Pong", "at": 18}],
    }
    (tmp_path / "a.json").write_text(json.dumps(values))
    page = "<!--a.json; share; .0%-->?<!----> of <!--a.json; rows; Pong; 9; x; 1; +.2f--><!---->"
    filled = "<!--a.json; share; .0%-->20 %<!----> of <!--a.json; rows; Pong; 9; x; 1; +.2f-->+2.35<!---->"
    assert answers.filled(page, tmp_path) == filled


@pytest.mark.parametrize(
    "what, said",
    [
        ("a.json; shares; .0%", "no 'shares'"),
        ("a.json; rows; Pong; x; .2f", "no 'x'"),  # two rows are of Pong
        ("a.json; rows; Pong; 9; x; 5; .2f", "no '5'"),
        ("a.json; share; .0k", "Unknown format|Invalid format"),
        ("campaign Catch joint", "expected CAMPAIGN GAME ARM BASELINE"),
        ("c G a b - c G a b - c G a b", "expected CAMPAIGN GAME ARM BASELINE"),
        ("catch_weight Catch rl_only_256 joint_256_weight10 a-b", "expected the seeds as FIRST-LAST"),
        ("catch_weight+catch_weight Catch rl_only_256 joint_256_weight10", r"see \[5, 6, 7, 8, 9\]"),
        ("catch_weight Catch nobody rl_only_256", "catch_weight: nobody on Catch has not one run"),
        (
            "catch_weight Catch rl_only_256 joint_256_weight10 8-10",
            r"one run of each of its seeds, see \[10\]",
        ),
    ],
)
def test_a_mark_that_means_nothing_is_an_error(tmp_path, what, said):
    results = answers.RESULTS
    if what.startswith("a.json"):
        results = tmp_path
        values = {"share": 0.2, "rows": [{"game": "Pong", "at": 9, "x": [1.0]}, {"game": "Pong", "at": 18}]}
        (tmp_path / "a.json").write_text(json.dumps(values))
    with pytest.raises(ConfigError, match=said):
        answers.filled(f"<!--{what}-->?<!---->", results)


def test_what_survives_holms_correction():
    """The smallest p is compared with 0.05 over all of them, the next one with 0.05 over those left."""
    x, rest = np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 2.0])

    def shifted(by: float) -> list[np.ndarray]:
        return [x + by, x]

    shifts = {"a": 3.3, "b": 2.9, "c": 2.5, "none": 0.1}  # p of 0.011, 0.019, 0.034 and 0.92
    arms = {name: shifted(by) for name, by in shifts.items()} | {"two": [x + 9, x, rest, rest]}
    assert answers.surviving(arms) == {"two", "a"}  # of 5: 0.0125 is the limit of the second, 0.0167 of b
    assert answers.surviving({name: arms[name] for name in "ab"}) == {"a", "b"}
    assert answers.surviving({name: arms[name] for name in "bc"}) == {"b", "c"}
    assert answers.surviving({name: arms[name] for name in ("b", "none", "two")}) == {"b", "two"}
    assert answers.surviving({name: arms[name] for name in ("c", "none", "two")}) == {"two"}
    untested = [x[:1], x[:1]]  # counts all the same
    assert answers.surviving({"c": arms["c"], "one": untested}) == set()


def test_a_seed_that_was_left_out_is_asked_for_again(tmp_path, monkeypatch):
    monkeypatch.setattr(answers.packing, "is_packed", lambda folder: True)
    arms = {"a": {"seeds": [0, 1]}}
    left = [{"arm": "a", "game": game, "seed": 4} for game in ("Catch", "Pong")]
    numbers = {"figure": "6.3", "games": {"Catch": {"arms": arms}}, "forced": [], "left_out": left}
    (tmp_path / "x/figures").mkdir(parents=True)
    (tmp_path / "x/figures/6.3.json").write_text(json.dumps(numbers))
    drawn = dict(answers.commands(tmp_path))["x/6.3"]
    assert "--seeds=0,1,4," in drawn and "--games=Catch,Pong" in drawn


def test_criteria_of_a_campaign_that_is_under_way_are_not_computed(tmp_path):
    for name in ("configs.json", "criteria.json"):
        (tmp_path / "x").mkdir(exist_ok=True)
        (tmp_path / "x" / name).write_text("{}")
    assert answers.with_criteria(tmp_path) == []
    (tmp_path / "x/tests.json").write_text("{}")
    assert answers.with_criteria(tmp_path) == [tmp_path / "x"]


def test_every_figure_of_a_packed_campaign_is_drawn_again():
    found = dict(answers.commands())
    drawn = {name for name in found if "/" in name}
    every = {f"{path.parents[1].name}/{path.stem}" for path in answers.RESULTS.glob("*/figures/*.json")}
    assert drawn == every
    assert found["catch_separate/h1_joint"][4:6] == [
        "--games=Catch,CatchDistractor",
        "--seeds=10,11,12,13,14,15,16,17,18,19,",
    ]
    assert len(answers.contents()) > 40
    asked = {f"criteria of {folder.name}" for folder in answers.with_criteria()}
    assert {*answers.ANALYSES.values(), *asked} == set(found) - drawn
