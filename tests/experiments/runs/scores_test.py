"""Scores at the end of runs beside published ones: numbers, tables, picture; of directories and packed."""

import csv
import io
import json
import re

import numpy as np
import pytest

from experiments import figures, packing
from experiments.arms import figures_named
from experiments.drawing import dots
from experiments.drawing.colours import styles
from experiments.presets import PRESETS
from experiments.reporting import score_table
from experiments.runs import collect, scores
from srl_jax import statistics
from srl_jax.data import atari100k, atari100k_methods
from srl_jax.envs import SUITES
from srl_jax.errors import ConfigError
from srl_jax.run import ending
from srl_jax.run.ending import Ending
from tests.helpers import NOT_FINITE, write_run
from tests.in_process import parse

REPORTED, RERUN = scores.BESIDE["der"]
GAMES = ["Boxing", "Pong"]


def finished(path, last, final=None, **values):
    """A run of 200 env steps that has ended; with a final evaluation where it is given."""
    write_run(path, (0.0, 1.0, last), steps=200, **values)
    if final is not None:
        row = {"kind": "final", "env_steps": 200, "updates": 9, "wall_s": 2.0}
        row |= {"final/return_mean": final, "final/games": 100, "final/return_std": 1.0}
        with open(path / "metrics.jsonl", "a") as file:
            file.write(json.dumps(row) + "\n")
    ending.write(path, Ending("finished", 200))
    return path


@pytest.fixture
def runs(tmp_path):
    """Two seeds of der on two games: of Boxing with a final evaluation, of Pong without."""
    for seed, score in enumerate((1.0, 3.0)):
        finished(tmp_path / f"Boxing/der/seed{seed}", -50.0, score, game="Boxing", seed=seed)
        finished(tmp_path / f"Pong/der/seed{seed}", 15.0 + score, game="Pong", seed=seed)
    return tmp_path


def evaluated(root, games=GAMES, methods=(REPORTED, RERUN), **how):
    found = scores.evaluated("x", "X", "?", collect.load_runs(root), {"der": methods}, games, **how)
    return json.loads(json.dumps(found, allow_nan=False))


def test_a_final_evaluation_counts_where_there_is_one_and_else_the_last(runs):
    found = evaluated(runs)["arms"]["der"]
    boxing, pong = (found["games"][game] for game in GAMES)
    assert boxing["scores"] == [1.0, 3.0] and boxing["of"] == ["100 games at the end"] * 2
    assert pong["scores"] == [16.0, 18.0] and pong["of"] == ["last evaluation, 10 games"] * 2
    assert found["of"] == ["100 games at the end", "last evaluation, 10 games"]
    # Student's t of two runs: 12.706 times half of their distance.
    assert boxing["mean"] == 2.0 and boxing["high"] == pytest.approx(2 + 12.706, abs=1e-3)
    assert boxing["kind"] == statistics.STUDENT
    # Boxing: random 0.1, human 12.1.
    assert boxing["normalised"]["mean"] == pytest.approx(1.9 / 12)


def test_what_has_no_score_is_left_out_and_said(runs):
    finished(runs / "Boxing/der/seed2", 1.0, game="Boxing", seed=2).joinpath("ended.json").unlink()
    ending.write(runs / "Boxing/der/seed2", NOT_FINITE)
    under_way = finished(runs / "Boxing/der/seed3", 1.0, game="Boxing", seed=3)
    ending.write(under_way, Ending("stopped", 200))
    early = write_run(runs / "Boxing/der/seed4", (0.0, 1.0), game="Boxing", seed=4, steps=200)
    late = finished(runs / "Boxing/der/seed5", 1.0, game="Boxing", seed=5)
    with open(late / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"kind": "train", "env_steps": 250, "updates": 9, "wall_s": 2.0}) + "\n")
    numbers = evaluated(runs)
    assert numbers["arms"]["der"]["games"]["Boxing"]["seeds"] == [0, 1]
    assert {x["seed"]: x["reason"] for x in numbers["left_out"]} == {
        2: NOT_FINITE.reason,
        3: "not at its end: 200 of 200 env steps",
        4: "not at its end: 100 of 200 env steps",
        5: "not evaluated at its end, after 250 env steps",
    }
    assert early.name == "seed4"


def test_a_run_that_may_be_playing_its_final_games_has_no_score(tmp_path):
    write_run(tmp_path / "a", (0.0, 1.0, 2.0), steps=200, final_games=100)
    score, why = scores.end_score(collect.load_runs(tmp_path / "a")[0])
    assert score is None and why == "not at its end: 200 of 200 env steps, without its final games"


def test_an_old_final_evaluation_of_a_run_that_went_on_does_not_count(runs):
    path = runs / "Boxing/der/seed0"
    row = {"kind": "eval", "env_steps": 300, "updates": 9, "wall_s": 3.0, "eval/return_mean": 7.0}
    with open(path / "metrics.jsonl", "a") as file:
        file.write(json.dumps(row) + "\n")
    score, _ = scores.end_score(collect.load_runs(path)[0])
    assert score == (7.0, 10, False)


def test_how_far_a_mean_is_from_published_ones(runs):
    games = evaluated(runs)["arms"]["der"]["games"]
    # Boxing: reported 0.2 without a deviation, rerun -0.3085 ± 2.09448; ours 2.
    distances = games["Boxing"]["distances"]
    assert distances[RERUN] == pytest.approx((2 + 0.3085) / 2.09448)
    assert distances[REPORTED] == pytest.approx((2 - 0.2) / 2.09448)
    assert games["Boxing"]["verdict"] == "within"
    # Pong: -9.7 ± 8.5 and -19.3; ours 17.
    assert games["Pong"]["verdict"] == "above" and games["Pong"]["distances"][RERUN] > 3
    assert scores._distance("Breakout", 2.0, (REPORTED, RERUN))["verdict"] == "within"  # as reported: 1.9
    verdicts = {x: scores._distance("Breakout", x, (REPORTED, RERUN))["verdict"] for x in (-1.5, 5.5, 12.6)}
    assert verdicts == {-1.5: "below", 5.5: "within", 12.6: "above"}  # 1.9 and 9.2 ± 1.65
    assert scores._distance("Pong", 0.0, (REPORTED,)) == {"distances": {}, "verdict": ""}
    assert scores._distance("Enduro", 0.0, (REPORTED, RERUN)) == {"distances": {}, "verdict": ""}


def test_the_stratified_interval_by_hand():
    scores_of = {"a": np.array([0.0, 2.0]), "b": np.array([1.0, 5.0])}
    # Variances of the means 1 and 4: 5 degrees of freedom are 25 / (1 + 16); of the mean of two, root 5 / 2.
    found = statistics.stratified_interval(scores_of)
    margin = float(statistics.t_quantile(0.95, 25 / 17)) * np.sqrt(5) / 2
    assert (found.point, found.kind) == (2.0, statistics.STRATIFIED)
    assert (found.low, found.high) == pytest.approx((2 - margin, 2 + margin))
    one = statistics.stratified_interval({"a": np.array([0.0, 1.0, 5.0])})
    assert one[1:3] == pytest.approx(statistics.mean_interval([0.0, 1.0, 5.0])[1:3])
    single = statistics.stratified_interval({"a": np.array([0.0, 2.0]), "b": np.array([1.0])})
    assert np.isnan(single.low) and single.kind == statistics.NONE


def test_the_stratified_interval_covers_what_it_says_with_two_runs_of_26_games():
    rng = np.random.default_rng(0)
    spreads = rng.uniform(0.01, 0.3, 26)
    hits = 0
    for draws in rng.normal(size=(1000, 26, 2)):
        found = statistics.stratified_interval(
            {str(i): s * x for i, (s, x) in enumerate(zip(spreads, draws, strict=True))}
        )
        hits += found.low <= 0 <= found.high
    assert 0.94 < hits / 1000 < 0.985  # a bootstrap of two runs: 75 to 80 %


def test_aggregates_are_of_the_games_that_all_have(runs):
    numbers = evaluated(runs)
    assert numbers["aggregated"] == GAMES
    own, rerun = numbers["arms"]["der"]["aggregates"], numbers["published"][RERUN]["aggregates"]
    normal = {game: statistics.human_normalised(game, [atari100k(RERUN)[game].mean]) for game in GAMES}
    assert rerun["mean"] == pytest.approx(float(statistics.mean(normal)))
    assert rerun["interquartile_mean"] is None  # of runs, of the 26 games alone
    assert own["mean"]["kind"] == own["optimality_gap"]["kind"] == statistics.STRATIFIED
    assert own["median"]["kind"] == own["interquartile_mean"]["kind"] == statistics.NARROW
    finished(runs / "Enduro/der/seed0", 5.0, game="Enduro")  # which DER has no published score of
    assert evaluated(runs, [*GAMES, "Enduro"])["aggregated"] == GAMES


def test_on_the_26_games_the_published_aggregates_are_the_known_ones(tmp_path):
    for game in SUITES["26"]:
        finished(tmp_path / f"{game}/der/seed0", atari100k(RERUN)[game].mean, game=game)
    numbers = evaluated(tmp_path, SUITES["26"])
    rerun, mine = numbers["published"][RERUN]["aggregates"], numbers["arms"]["der"]["aggregates"]
    assert (rerun["mean"], rerun["median"]) == pytest.approx((0.350, 0.189), abs=5e-4)
    assert rerun["interquartile_mean"] == pytest.approx(0.183, abs=5e-4)
    for name in ("mean", "median", "interquartile_mean_of_means", "optimality_gap_of_means"):
        assert mine[name]["mean"] == pytest.approx(rerun[name])
        assert mine[name]["low"] is None and mine[name]["kind"] == statistics.NONE
    reported = numbers["published"][REPORTED]["aggregates"]
    assert (reported["mean"], reported["median"]) == pytest.approx((0.285, 0.161), abs=5e-4)
    assert reported["interquartile_mean"] is None
    assert {x["verdict"] for x in numbers["arms"]["der"]["games"].values()} == {"within"}


def test_runs_of_different_protocols_are_refused_unless_forced(runs):
    for seed in (0, 1):
        finished(runs / f"Boxing/other/seed{seed}", 1.0, game="Boxing", seed=seed, sticky_actions=0.25)
    arms = {"der": (REPORTED,), "other": (REPORTED,)}
    read = collect.load_runs(runs)
    with pytest.raises(ConfigError, match="sticky_actions is 0.0 there and 0.25 here"):
        scores.evaluated("x", "X", "?", read, arms, GAMES)
    numbers = scores.evaluated("x", "X", "?", read, arms, GAMES, force=True)
    assert "Protocols differ" in score_table.as_markdown(numbers)
    assert numbers["aggregated"] == ["Boxing"]  # which both arms have


def test_tables_have_every_number_and_what_it_is(runs):
    numbers = evaluated(runs)
    rows = list(csv.DictReader(io.StringIO(score_table.as_csv(numbers))))
    (mine,) = [row for row in rows if (row["game"], row["of"]) == ("Boxing", "der")]
    assert (mine["value"], mine["scores"], mine["verdict"], mine["runs"]) == ("2.0", "1 3", "within", "2")
    assert mine["basis"] == "100 games at the end" and mine["interval"] == statistics.STUDENT
    (theirs,) = [row for row in rows if (row["game"], row["of"]) == ("Boxing", RERUN)]
    assert (theirs["basis"], theirs["level"], theirs["runs"]) == (
        "rerun by Agarwal et al. 2021",
        "runs",
        "100",
    )
    text = score_table.as_markdown(numbers)
    row = "| Boxing | 0.1 | 12.1 | 2.00 | 1.00 / 3.00 | [-10.7, 14.7] | 0.20 | -0.31 ± 2.09 | "
    row += "+0.9, +1.1: within |"
    head = next(line for line in text.splitlines() if line.startswith("| game"))
    assert row in text.splitlines() and head.count("|") == row.count("|")
    assert "last evaluation, 10 games" in text and "2 games: 1 within, 1 above, 0 below" in text
    assert "env steps 100,000 (here 200)" in text and "too narrow" in text and "games cut" not in text


def test_games_that_are_cut_earlier_than_the_published_ones_are_said(tmp_path):
    finished(tmp_path / "Pong/der/seed0", -2.0, game="Pong", eval_max_steps=100, eval_games=1)
    arm = evaluated(tmp_path, ["Pong"])["arms"]["der"]
    assert arm["differs"][RERUN].startswith("games cut after 27,000 env steps (here 100); env steps 100,000")
    assert arm["of"] == ["last evaluation, 1 game"]


def test_every_preset_of_the_literature_has_published_scores_beside_it():
    names = {name.removeprefix("atari100k/") for name in PRESETS if name.startswith("atari100k/")}
    assert scores.BESIDE.keys() == names
    for methods in scores.BESIDE.values():
        assert set(methods) <= atari100k_methods().keys()
    assert (
        scores.beside("atari100k/der+aug") == scores.BESIDE["der"] and scores.beside("thesis/joint_256") == ()
    )


def call(*arguments):
    return figures.run(parse(figures, *arguments))


def test_the_figure_is_the_same_from_packed_runs_byte_for_byte(runs, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    packed = tmp_path / "packed"
    packing.pack(runs, packed)
    flags_ = ("--figure=atari100k", "--games=Boxing,Pong", "--seeds=2", "--redraw")
    assert call(*flags_, f"--out={runs}") == 0 and call(*flags_, f"--out={packed}") == 0
    names = ["atari100k.csv", "atari100k.json", "atari100k.md", "atari100k.png"]
    assert sorted(path.name for path in (runs / "figures").iterdir()) == names
    for name in names:
        assert (runs / "figures" / name).read_bytes() == (packed / "figures" / name).read_bytes()
    assert capsys.readouterr().out.splitlines()[-1] == str(packed / "figures" / "atari100k.png")
    # No number has the digits in which processors differ.
    for name in names[:2]:
        values = [float(x) for x in re.findall(r"\d+\.\d+", (packed / "figures" / name).read_text())]
        assert values and all(x == float(f"{x:.8g}") for x in values)


def test_no_two_arms_and_no_two_methods_look_alike(monkeypatch):
    pytest.importorskip("matplotlib")
    arms = [name.partition("/")[2] for name in PRESETS if name.startswith("atari100k/")]
    methods = {name for names in scores.BESIDE.values() for name in names}
    entry = {"normalised": {"mean": 0.5}, "normalised_scores": [0.5], "verdict": "", "seeds": [0]}
    published = {"normalised": 0.5, "normalised_sd": None}
    numbers = {
        "title": "",
        "arms": {arm: {"games": {"Pong": entry}} for arm in arms},
        "published": {name: {"games": {"Pong": published}} for name in methods},
        "styles": styles(arms),
        "games": ["Pong"],
    }
    monkeypatch.setattr(dots, "_notes", lambda numbers: [])
    monkeypatch.setattr(dots, "save", lambda figure, path: figure)
    (legend,) = dots.draw(numbers, "x.png").legends
    looks = [(x.get_marker(), x.get_color(), x.get_markerfacecolor()) for x in legend.legend_handles]
    assert len(set(looks)) == len(looks) == len(arms) + len(methods) > 25


@pytest.mark.parametrize(
    "arguments, told",
    [
        (["--games=Catch"], "--games=Catch: published scores of --figure=atari100k are of Atari games"),
        (["--presets=atari100k/deer"], "--presets=atari100k/deer: did you mean atari100k/der?"),
        (["--games=Pong", "--published=DER"], "--published=DER: did you mean "),
        (["--games=Pong", "--redraw", "--seeds=1,"], "no score of any arm of figure atari100k on Pong in "),
        (["--figure=6.3,atari100k"], "--figure=6.3,atari100k: "),
        (["--figure=6.3", "--presets=demo"], "--presets: only --figure=atari100k takes it"),
    ],
)
def test_bad_input_is_refused_and_nothing_written(tmp_path, arguments, told):
    with pytest.raises(ConfigError, match=f"^{re.escape(told)}") as error:
        figure = () if arguments[0].startswith("--figure") else ("--figure=atari100k",)
        call(*figure, *arguments, f"--out={tmp_path / 'new'}")
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_what_the_figure_runs():
    (figure,) = figures_named("atari100k", ["atari100k/der", "atari100k/curl+aug"])
    assert [arm.name for arm in figure.arms] == ["der", "curl_aug"]
    names = [run.name for run in figures.planned([figure], SUITES["signed"], [0, 1], {})]
    assert len(names) == 2 * 6 * 2 and names[0] == "Boxing/der/seed0"


def test_games_of_different_protocols_are_not_aggregated_unless_forced(tmp_path):
    finished(tmp_path / "Boxing/der/seed0", 1.0, 1.0, game="Boxing")
    for seed in range(2):
        values = {"game": "Pong", "sticky_actions": 0.25, "seed": seed}
        finished(tmp_path / f"Pong/der/seed{seed}", 1.0, 1.0, **values)
    with pytest.raises(ConfigError, match="another protocol than .*Boxing.*sticky_actions.*--force"):
        evaluated(tmp_path)
    found = evaluated(tmp_path, force=True)
    assert len(found["forced"]) == 2 and "sticky_actions" in found["forced"][0]
    differs = found["arms"]["der"]["differs"][RERUN]
    assert (
        differs.startswith("Boxing: ")
        and "seeds 100 (here 1); Pong: sticky actions 0.0 (here 0.25)" in differs
    )


def test_where_a_run_was_resumed_is_said(runs):
    path = runs / "Boxing/der/seed0/config.json"
    about = json.loads(path.read_text()) | {"cores": 1, "git_revision": "a"}
    about["continued"] = [{"changed": {"cores": 2, "git_revision": "b"}}]
    path.write_text(json.dumps(about))
    found = evaluated(runs)["arms"]["der"]
    assert found["cores"] == [0, 1, 2] and found["revisions"] == ["None", "a", "b"]
