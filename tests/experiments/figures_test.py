"""Tests of experiments.figures."""

import json

import numpy as np
import pytest

from experiments import figures
from experiments.arms import FIGURES, Figure, FigureArm
from experiments.drawing import plots
from experiments.reporting.numbers import arms_of, compare, table
from experiments.runs import collect
from experiments.runs.json_values import plain
from srl_jax.config import Config
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from tests.helpers import NOT_FINITE, write_run
from tests.in_process import parse

FIGURE = Figure("mine", "Mine", "?", (FigureArm("a", "catch/rl_only"), FigureArm("b", "catch/joint")))
GONE = "Catch, {}: {} of {} seeds left out: not there (seed {})\n"


@pytest.fixture
def runs(tmp_path):
    """Two seeds of a, to 200 env steps, and three of b, one of which ends at 200."""
    for seed, returns in enumerate([(-1, 0, 1), (-1, -1, 0)]):
        write_run(tmp_path / f"Catch/a/seed{seed}", returns, seed=seed)
    for seed, returns in enumerate([(0, 1, 1, 5), (0, 0, 1), (0, 2, 1, 5)]):
        write_run(tmp_path / f"Catch/b/seed{seed}", returns, seed=seed, mode="joint")
    write_run(tmp_path / "Catch/other/seed0", (9, 9, 9))
    return tmp_path


def _evaluated(root, games=("Catch",), **how):
    return figures.evaluated(FIGURE, collect.load_runs(root), games, **how)


def test_numbers_by_hand(runs):
    numbers = _evaluated(runs)
    assert numbers["arms"] == ["a", "b"] and numbers["forced"] == []
    catch = numbers["games"]["Catch"]
    assert catch["equal_until"] == 200 and list(catch["arms"]) == ["a", "b"]
    a, b = catch["arms"].values()
    assert a["seeds"] == [0, 1] and b["seeds"] == [0, 1, 2]
    # No further than the shortest seed of the arm.
    assert b["env_steps"] == [0, 100, 200] and b["mean"] == [0.0, 1.0, 1.0]
    assert a["mean"] == [-1.0, -0.5, 0.5] and a["runs"] == [[-1, 0, 1], [-1, -1, 0]]
    # Student's t of two seeds, 1 apart: 12.706 times a standard error of 0.5. Seeds that are alike have none.
    assert a["kind"] == "Student's t" and a["low"][0] is None and a["high"][0] is None
    np.testing.assert_allclose([a["low"][1:], a["high"][1:]], [[-6.853, -5.853], [5.853, 6.853]], atol=1e-3)
    # Averages over 0 .. 200: (-1 / 2 + 0 + 1 / 2) / 2 = 0, (-1 / 2 - 1 + 0) / 2 = -0.75; of b .75, .25, 1.25.
    area = a["area_under_curve"]
    assert area == {"mean": -0.375, "low": area["low"], "high": area["high"], "kind": "Student's t"}
    assert (area["low"], area["high"]) == pytest.approx((-5.140, 4.390), abs=1e-3)
    assert b["area_under_curve"]["mean"] == 0.75
    against = b["against_baseline"]
    assert against["area_under_curve"]["mean"] == 1.125
    assert against["at_the_end"]["mean"] == 0.5
    assert against["probability_of_improvement"]["mean"] == 1.0
    # What is no mean is drawn again, and said to be too narrow; an interval with 0 in it has p above 0.05.
    kinds = {of: values["kind"] for of, values in against.items()}
    assert kinds["area_under_curve"] == kinds["at_the_end"] == "Welch's t"
    assert kinds["probability_of_improvement"] == "stratified bootstrap, too narrow"
    for of in ("area_under_curve", "at_the_end"):
        assert (against[of]["low"] < 0) == (against[of]["p"] > 0.05)
    assert "against_baseline" not in a


def test_final_games_are_in_the_json_where_all_seeds_have_them(tmp_path):
    for seed, final in enumerate([(1, 3), (4, 6)]):
        write_run(tmp_path / f"Catch/a/seed{seed}", seed=seed, final_games=2, final=final)
        more = {"final": (1, 2)} if seed else {}
        write_run(tmp_path / f"Catch/b/seed{seed}", seed=seed, final_games=2, mode="joint", **more)
    a, b = _evaluated(tmp_path)["games"]["Catch"]["arms"].values()
    assert (a["final"]["mean"], a["final"]["games"], a["final"]["kind"]) == (3.5, 2, "Student's t")
    assert a["at_the_end"]["mean"] == 2 and "final" not in b


def test_a_longer_arm_is_compared_where_the_others_are(tmp_path):
    write_run(tmp_path / "Catch/a/seed0", (0, 2))
    write_run(tmp_path / "Catch/b/seed0", (0, 1, 1), mode="joint")
    catch = _evaluated(tmp_path)["games"]["Catch"]
    assert catch["equal_until"] == 100
    a, b = catch["arms"].values()
    assert b["env_steps"] == [0, 100, 200]  # drawn as far as it goes
    assert (a["at_the_end"]["mean"], b["at_the_end"]["mean"]) == (2.0, 1.0)
    assert (a["area_under_curve"]["mean"], b["area_under_curve"]["mean"]) == (1.0, 0.5)
    # One seed has no interval.
    assert a["low"] == [None, None] and b["against_baseline"]["at_the_end"]["low"] is None


def test_a_run_that_has_only_begun_cuts_no_curve(runs):
    before = _evaluated(runs)["games"]
    write_run(runs / "Catch/a/seed2", (7,), seed=2)
    assert _evaluated(runs)["games"] == before
    # On a game of which there is nothing more, it is what there is.
    (runs / "alone").mkdir()
    write_run(runs / "alone/Catch/a/seed2", (7,), seed=2)
    alone = _evaluated(runs / "alone")["games"]["Catch"]
    assert alone["equal_until"] == 0 and alone["arms"]["a"]["mean"] == [7.0]


def test_a_seed_that_failed_cuts_no_curve_and_is_named(runs, tmp_path, drawn_notes):
    before = _evaluated(runs)
    write_run(runs / "Catch/a/seed2", (7,), seed=2, ended=NOT_FINITE)
    write_run(runs / "Catch/a/seed3", (7, 7), seed=3, ended=NOT_FINITE)
    write_run(runs / "Catch/b/seed3", (0, 0, 0, 0, 0), seed=3, mode="joint", ended=NOT_FINITE)
    write_run(runs / "Catch/b/seed4", (), seed=4, mode="joint")
    after = _evaluated(runs)
    assert after["games"] == before["games"] and before["left_out"] == []
    assert after["left_out"][0] == {"game": "Catch", "arm": "a", "seed": 2, "reason": NOT_FINITE.reason}
    assert [(run["arm"], run["seed"]) for run in after["left_out"]] == [
        ("a", 2),
        ("a", 3),
        ("b", 3),
        ("b", 4),
    ]
    lines = [
        f"Catch, a: 2 of 4 seeds left out: {NOT_FINITE.reason} (seed 2, 3)",
        f"Catch, b: 2 of 5 seeds left out: {NOT_FINITE.reason} (seed 3); not evaluated yet (seed 4)",
    ]
    figures.draw(FIGURE, json.loads(json.dumps(after)), tmp_path / "x.png")
    assert len(drawn_notes) == 1 and drawn_notes[0][1:] == lines


def test_an_arm_of_which_all_seeds_failed_is_listed(runs, tmp_path):
    (runs / "alone").mkdir()
    for seed in (0, 1):
        write_run(runs / f"alone/Catch/a/seed{seed}", (-1, 0), seed=seed, ended=NOT_FINITE)
    with pytest.raises(
        ConfigError, match="no evaluation .*; Catch, a: 2 of 2 seeds left out: loss/rl is not f"
    ):
        figures.write(FIGURE, collect.load_runs(runs / "alone"), ["Catch"], tmp_path / "figures")
    write_run(runs / "alone/Catch/b/seed0", (0, 1), mode="joint")
    numbers = _evaluated(runs / "alone")
    assert list(numbers["games"]["Catch"]["arms"]) == ["b"] and len(numbers["left_out"]) == 2
    (line,) = figures.left_out_lines(numbers)
    assert line.startswith("Catch, a: 2 of 2 seeds left out: loss/rl")
    assert figures.left_out_lines({"games": {}}) == []  # a file of before


@pytest.fixture
def drawn_notes(monkeypatch):
    """The lines below the figures that would have been drawn."""
    notes = []
    monkeypatch.setattr(plots, "draw_panels", lambda *given: notes.append(given[3].splitlines()))
    return notes


def test_the_report_has_the_same_numbers(tmp_path):
    returns = np.random.default_rng(0).normal(size=(10, 3))
    for i, arm in enumerate("ab"):
        for seed in range(5):
            own = (
                {"mode": "joint", "every": 150} if arm == "b" else {"every": 100}
            )  # b is evaluated less often
            write_run(tmp_path / f"Catch/{arm}/seed{seed}", returns[5 * i + seed], seed=seed, **own)
    mine = _evaluated(tmp_path)["games"]["Catch"]["arms"]
    comparisons = {"Catch": compare(collect.load_runs(tmp_path))}
    for of in ("at_the_end", "area_under_curve"):
        found = table(comparisons, of, "a")["Catch"]
        assert tuple(mine["a"][of].values())[:4] == found["a"]["return"]
        assert tuple(mine["b"][of].values())[:4] == found["b"]["return"]
        difference = mine["b"]["against_baseline"][of]
        assert tuple(difference.values())[:4] == found["b"]["return_difference"]


def test_other_games_and_arms_without_runs_are_left_out(runs):
    numbers = _evaluated(runs, games=("Pong", "Catch"))
    assert list(numbers["games"]) == ["Catch"]
    b = [run for run in collect.load_runs(runs) if run.arm == "b"]
    alone = figures.evaluated(FIGURE, b, ["Catch"])["games"]["Catch"]["arms"]
    assert list(alone) == ["b"] and "against_baseline" not in alone["b"]


def test_other_protocols_are_refused_unless_forced(runs):
    write_run(runs / "Catch/b/seed3", (0, 1, 1), seed=3, mode="joint", eval_games=3)
    with pytest.raises(ConfigError, match="same arm"):
        _evaluated(runs)
    (runs / "Catch/b").rename(runs / "Catch/c")
    write_run(runs / "Catch/b/seed3", (0, 1, 1), seed=3, mode="joint", eval_games=3)
    with pytest.raises(ConfigError, match="another protocol.*eval_games is 10 there and 3 here"):
        _evaluated(runs)
    assert "eval_games" in _evaluated(runs, force=True)["forced"][0]


def test_a_run_that_has_only_begun_is_checked_like_the_others(runs):
    write_run(runs / "Catch/b/seed9", (0,), seed=9, mode="joint", sticky_actions=0.25)
    with pytest.raises(ConfigError, match="sticky_actions"):
        _evaluated(runs)


def test_the_same_runs_give_the_same_bytes(runs, tmp_path):
    pytest.importorskip("matplotlib")
    made = []
    for name in ("x.png", "y.png"):
        numbers = _evaluated(runs)
        path = figures.draw(FIGURE, numbers, tmp_path / name)
        made.append((json.dumps(numbers), path.read_bytes()))
    assert made[0] == made[1]
    # What is drawn is what was written.
    again = figures.draw(FIGURE, json.loads(made[0][0]), tmp_path / "z.png")
    assert again.read_bytes() == made[0][1]


def test_an_arm_has_one_colour_in_all_figures_of_a_directory_and_on_its_page(runs):
    pytest.importorskip("matplotlib")
    from experiments.drawing.colours import styles

    other = Figure("other", "Other", "?", (FigureArm("b", "catch/joint"), FigureArm("c", "catch/joint")))
    (runs / "Catch/other").rename(runs / "Catch/c")
    read, among = collect.load_runs(runs), collect.arm_names(runs)
    assert among == ["a", "b", "c"]
    first, second = (figures.evaluated(x, read, ["Catch"], among=among)["styles"] for x in (FIGURE, other))
    assert first["b"] == second["b"] and len({tuple(x) for x in (first | second).values()}) == 3
    assert {arm: list(style) for arm, style in styles(arms_of(read)).items()} == first | second


def test_all_figures_share_their_runs():
    runs = figures.planned(list(FIGURES.values()), ["Catch", "Pong"], [0, 1], {"steps": "1000"})
    names = [run.name for run in runs]
    assert len(names) == len(set(names))
    # 13 arms, and two runs that make encoders, on two games with two seeds.
    assert len(names) == 15 * 4
    presets = {run.name: run.preset for run in runs}
    assert presets["Catch/joint_50/seed1"] == "small/joint_50"
    assert presets["Pong/joint_50/seed0"] == "thesis/joint_50"
    for run in runs:
        for source in (run.encoder_from, run.policy_from):
            assert not source or names.index(source) < names.index(run.name)
    steps = {run.preset.partition("/")[2]: run.flags["steps"] for run in runs}
    assert steps["joint_50"] == "1000" and steps["pretrain_256"] == "300"


def _run(*arguments):
    return figures.run(parse(figures, *arguments))


@pytest.mark.parametrize(
    "arguments, told",
    [
        ([], "--figure: missing; one of all, 6.1"),
        (["--figure=6.9"], "--figure=6.9: did you mean"),
        (["--figure=none.json"], "--figure=none.json: No such file"),
        (["--figure=6.3", "--games=Pnog"], "--games=Pnog: did you mean Pong"),
        (["--figure=6.3", "--seeds=0"], "--seeds=0: give a number of seeds"),
        (["--figure=6.3", "--seed=1"], "--seed: a sweep gives it to each run; --seeds decides it"),
        (["--figure=6.3", "--preset=demo"], "--preset: the figure's arms decide it; a JSON file names arms"),
        (["--figure=6.3", "--encoder_from=x"], "--encoder_from: the figure's arms decide it"),
        (["--figure=atari100k", "--preset=demo"], "--preset: a sweep gives it to each run; --presets"),
        (["--figure=6.3", "--published=Nope"], "--published=Nope: valid: Random; Human; DER, as reported; "),
        (["--figure=6.3", "--published=Hunan"], "--published=Hunan: did you mean Human"),
        (["--figure=6.3", "--gpus_per_run=1"], "--gpus_per_run: only --launcher=ray takes it"),
        (["--figure=6.3", "--redraw", "--lr_rl=0.5"], "--lr_rl: --redraw starts no run; leave one of them"),
        (["--figure=6.3", "--redraw", "--workers=3"], "--workers: --redraw starts no run"),
        (["--figure=6.3", "--redraw", "--dry_run"], "--dry_run: --redraw starts no run"),
        (
            ["--figure=6.3", "--games=Catch", "--redraw", "--seeds=3"],
            "no evaluation of any arm of figure 6.3",
        ),
    ],
)
def test_bad_input_is_refused_and_nothing_written(tmp_path, arguments, told):
    with pytest.raises(ConfigError) as error:
        _run(*arguments, f"--out={tmp_path / 'new'}")
    assert str(error.value).startswith(told) and "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_drawn_again_and_nothing_run(runs, capsys):
    pytest.importorskip("matplotlib")
    (runs / "Catch/a").rename(runs / "Catch/rl_only_nature")
    (runs / "Catch/b").rename(runs / "Catch/joint_256")
    assert _run("--figure=6.3", "--games=Catch", "--seeds=2", "--redraw", f"--out={runs}") == 0
    told = capsys.readouterr()
    assert told.out == f"{runs / 'figures' / '6.3.png'}\n" and told.err == GONE.format(
        "joint_50", 2, 2, "0, 1"
    )
    catch = json.loads((runs / "figures" / "6.3.json").read_text())["games"]["Catch"]
    assert {arm: values["seeds"] for arm, values in catch["arms"].items()} == {
        "rl_only_nature": [0, 1],
        "joint_256": [0, 1],
    }

    # Without --games and --seeds all that are there are drawn.
    assert _run("--figure=6.3", "--redraw", f"--out={runs}") == 0
    every = json.loads((runs / "figures" / "6.3.json").read_text())["games"]["Catch"]["arms"]
    assert {arm: values["seeds"] for arm, values in every.items()} == {
        "rl_only_nature": [0, 1],
        "joint_256": [0, 1, 2],
    }
    assert _run("--figure=6.3", "--games=Catch", "--seeds=2", "--redraw", f"--out={runs}") == 0
    capsys.readouterr()

    # Seeds that were asked for and are not there are said, and change nothing.
    before = (runs / "figures" / "6.3.json").read_bytes()
    (runs / "Catch/joint_256/seed2").rename(runs / "Catch/joint_256/seed5")
    assert _run("--figure=6.3", "--games=Catch", "--seeds=0,1,3,4", "--redraw", f"--out={runs}") == 0
    expected = [GONE.format(arm, 2, 4, "3, 4") for arm in catch["arms"]]
    expected.append(GONE.format("joint_50", 4, 4, "0, 1, 3, 4"))
    assert capsys.readouterr().err == "".join(expected)
    assert (runs / "figures" / "6.3.json").read_bytes() == before


def test_a_game_of_a_plug_in_is_drawn_whatever_options_its_name_leaves_out(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    for seed in range(2):
        own = {"seed": seed, "game": "mine:size=3", "imports": (str(tmp_path / "mine.py"),)}
        write_run(tmp_path / f"mine/rl_only_nature/seed{seed}", (0, 1), **own)
    (tmp_path / "mine.py").touch()
    given = ["--figure=6.3", "--games=mine", "--seeds=2", f"--import={tmp_path}/mine.py"]
    assert _run(*given, "--redraw", f"--out={tmp_path}") == 0
    games = json.loads((tmp_path / "figures/6.3.json").read_text())["games"]
    assert games["mine:size=3"]["arms"]["rl_only_nature"]["seeds"] == [0, 1]
    assert "mine:size=3, joint_256: 2 of 2 seeds left out" in capsys.readouterr().err


def test_where_all_runs_failed_the_status_says_so(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(figures.launching, "run_sweep", lambda *_, **__: 1)
    for made in ((), (0, 1)):
        for seed in made:
            write_run(tmp_path / f"Catch/rl_only_nature/seed{seed}", (0,), seed=seed, ended=NOT_FINITE)
        assert _run("--figure=6.3", "--games=Catch", "--seeds=2", f"--out={tmp_path}") == 1
        out, err = capsys.readouterr()
        *gone, last = err.splitlines(keepends=True)
        assert gone == [GONE.format(arm, 2, 2, "0, 1") for arm in ("joint_256", "joint_50") if made]
        assert out == "" and last.startswith(f"no evaluation of any arm of figure 6.3 on Catch in {tmp_path}")
        assert not (tmp_path / "figures").exists()


def test_published_results_say_what_differs():
    config = Config(game="Pong", steps=300_000)
    human, rainbow = figures.published_levels("Pong", ["Human", "Dopamine Rainbow"], config, 260_000)
    assert (human.method, human.score) == ("Human", 14.6)
    # Of its scores, the one after 250,000 env steps: training scores of sticky games.
    assert "env steps 250,000 (here 260,000)" in rainbow.differs and "sticky actions 0.25" in rainbow.differs
    assert "training score" in rainbow.differs
    assert figures.published_levels("Catch", ["Human"], config, 100) == []


def test_policies_that_learn_nothing_are_in_the_json_and_drawn(runs, monkeypatch):
    pytest.importorskip("matplotlib")
    numbers = json.loads(json.dumps(_evaluated(runs)))
    policies = numbers["games"]["Catch"]["policies"]
    known = reference_policies("Catch")
    assert {name: x["mean"] for name, x in policies.items()} == {
        name: row.return_mean for name, row in known.items()
    }
    assert all(x["source"].startswith("python -m experiments.") for x in policies.values())
    assert all(x["differs"] == "" for x in policies.values())
    given = []
    monkeypatch.setattr(plots, "draw_panels", lambda *values: given.extend(values))
    figures.draw(FIGURE, numbers, runs / "x.png")
    panels, _, _, note, _ = given
    assert note.split("; ") == [
        "bands: 95 % intervals over seeds at each point, Student's t",
        "thin: both runs of an arm of two",
        "dash-dotted: policies that learn nothing",
    ]
    assert [line.runs for line in panels[0].lines] == [numbers["games"]["Catch"]["arms"]["a"]["runs"], ()]
    levels = [(name, row.return_mean, "") for name, row in known.items()]
    assert [tuple(level) for level in panels[0].policies] == levels


def test_limits_of_a_single_seed_are_no_numbers():
    assert plain([1.0, np.nan]) == [1.0, None]
