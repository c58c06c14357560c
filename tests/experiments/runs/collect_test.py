"""Tests of experiments.runs.collect."""

import json
import shutil

import numpy as np
import pytest

from experiments.runs import collect
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.run.ending import Ending
from tests.helpers import NOT_FINITE, write_run


def test_runs_are_found_and_grouped(tmp_path):
    write_run(tmp_path / "Catch/b/seed1", seed=1)
    write_run(tmp_path / "Catch/b/seed0", returns=(0.5, None, -1.0))
    write_run(tmp_path / "Catch/a/seed0")
    write_run(tmp_path / "loose_seed3", seed=3)
    write_run(tmp_path / "Catch/b/seed0.broken-1", seed=0)
    groups = collect.grouped(collect.load_runs(tmp_path))
    assert list(groups) == ["Catch"]
    seeds = {arm: [run.seed for run in runs] for arm, runs in groups["Catch"].items()}
    assert seeds == {"a": [0], "b": [0, 1], "loose": [3]}
    steps, returns = collect.steps_and_returns(groups["Catch"]["b"][0])
    assert steps.tolist() == [0, 200] and returns.tolist() == [0.5, -1.0]
    assert [run.path.name for run in collect.load_runs(tmp_path / "Catch/a/seed0")] == ["seed0"]


def test_no_run_and_the_same_run_twice_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no run directory"):
        collect.load_runs(tmp_path)
    write_run(tmp_path / "x/a/seed0")
    write_run(tmp_path / "y/a/seed0")
    with pytest.raises(ConfigError, match="the same game, arm and seed"):
        collect.load_runs(tmp_path)


def test_linked_runs_have_the_name_of_the_link(tmp_path):
    for seed in (0, 1, 10):
        write_run(tmp_path / f"disk/joint_seed{seed}", seed=seed)
    write_run(tmp_path / "cmp/arm10/seed0")
    write_run(tmp_path / "cmp/arm9/seed0")
    (tmp_path / "cmp/joint").mkdir()
    (tmp_path / "cmp/joint/seed0").symlink_to(tmp_path / "disk/joint_seed0")
    (tmp_path / "cmp/other_seed1").symlink_to(tmp_path / "disk/joint_seed1")
    (tmp_path / "cmp/joint_seed10").symlink_to(tmp_path / "disk/joint_seed10")
    found = [(run.arm, run.seed) for run in collect.load_runs(tmp_path / "cmp")]
    assert found == [("arm9", 0), ("arm10", 0), ("joint", 0), ("joint", 10), ("other", 1)]


def test_several_directories_are_read_as_one(tmp_path):
    for name in ("x/a/seed0", "y/b_seed0", "z"):
        write_run(tmp_path / name)
    (tmp_path / "y/again_seed0").symlink_to(tmp_path / "x/a/seed0")
    places = [tmp_path / "x", tmp_path / "y", tmp_path / "z", tmp_path / "x/a"]
    assert [run.arm for run in collect.load_runs(*places)] == ["a", "b", "z"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="empty: no run directory"):
        collect.load_runs(tmp_path / "x", tmp_path / "empty")


def test_the_arm_of_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(write_run(tmp_path / "joint/seed0"))
    assert [run.arm for run in collect.load_runs(".")] == ["joint"]
    monkeypatch.chdir(write_run(tmp_path / "alone_seed3"))
    assert [run.arm for run in collect.load_runs(".")] == ["alone"]


def test_a_run_that_failed_is_neither_compared_nor_under_way(tmp_path):
    write_run(tmp_path / "a/seed0", (0, 1, 2))
    write_run(tmp_path / "a/seed1", (0,), seed=1, ended=NOT_FINITE)
    write_run(tmp_path / "a/seed2", (0, 1), seed=2, ended=NOT_FINITE)
    write_run(tmp_path / "b/seed0", (0, 1, 2), ended=Ending("finished", 200))
    write_run(tmp_path / "b/seed1", (0, 1), seed=1, ended=Ending("stopped", 100))
    write_run(tmp_path / "b/seed2", (0,), seed=2)
    write_run(tmp_path / "b/seed3", (), seed=3)
    write_run(tmp_path / "b/seed4", (0,), seed=4, ended=Ending("finished", 9))
    write_run(tmp_path / "c/seed0", (), mode="pretrain")
    runs = collect.load_runs(tmp_path)
    assert [(run.arm, run.seed) for run in collect.comparable(runs)] == [("a", 0), ("b", 0), ("b", 1)]
    left = {(run.arm, run.seed): why for run, why in collect.left_out(runs)}
    assert left == {
        ("a", 1): NOT_FINITE.reason,
        ("a", 2): NOT_FINITE.reason,
        ("b", 2): "has only begun",
        ("b", 3): "not evaluated yet",
        ("b", 4): "has a single evaluation",
    }
    # One that failed says nothing of how far the others of its game are.
    alone = [run for run in runs if run.seed == 2]
    assert [(run.arm, run.seed) for run in collect.comparable(alone)] == [("b", 2)]


def test_what_is_left_out_is_said_in_a_line():
    assert collect.left_out_text("a", {2: "x"}, 3) == "a: 1 of 3 seeds left out: x (seed 2)"
    assert collect.left_out_text("a", {0: "x"}, 1) == "a: 1 of 1 seed left out: x (seed 0)"
    text = collect.left_out_text("a", {0: "x", 1: "y", 2: "x"}, 3)
    assert text == "a: 3 of 3 seeds left out: x (seed 0, 2); y (seed 1)"


def test_runs_of_an_arm_differ_in_nothing_that_changes_a_row_but_their_seed(tmp_path):
    write_run(tmp_path / "a/seed0", encoder_from="x/seed0")
    kept = {"checkpoint_every": 50, "keep_encoder_every": 1, "keep_best": False, "keep_replay": True}
    write_run(tmp_path / "a/seed1", encoder_from="x/seed1", seed=1, **kept)
    write_run(tmp_path / "b/seed0", gamma=0.9)
    collect.check_arms(collect.load_runs(tmp_path))
    # Of a version before an option there is, and with the option written out.
    for seed, rl in enumerate(("rainbow:hidden=8", "rainbow:hidden=8,n_step=3")):
        write_run(tmp_path / f"c/seed{seed}", seed=seed, rl=rl)
    collect.check_arms(collect.load_runs(tmp_path))
    write_run(tmp_path / "c/seed2", seed=2, rl="rainbow:hidden=9")
    with pytest.raises(ConfigError, match="seed2.*c on Catch.*but rl is rainbow"):
        collect.check_arms(collect.load_runs(tmp_path / "c"))
    shutil.rmtree(tmp_path / "c")
    write_run(tmp_path / "a/seed2", seed=2, gamma=0.9)
    with pytest.raises(ConfigError, match="seed2.*a on Catch.*gamma is 0.99 there and 0.9 here$"):
        collect.check_arms(collect.load_runs(tmp_path))


def test_an_arm_whose_runs_imported_other_files_is_named(tmp_path, capsys):
    def run(arm, seed, then, *later):
        path = write_run(tmp_path / f"{arm}/seed{seed}", seed=seed) / "config.json"
        more = {"imported": {"mine.py": then}, "continued": [{"changed": {"mine.py": x}} for x in later]}
        path.write_text(json.dumps(json.loads(path.read_text()) | more))

    one, other = "0123456789" * 6, "abcdefghij" * 6
    for seed in (0, 1):
        run("a", seed, one)
    write_run(tmp_path / "a/seed2", seed=2)  # from before it was kept
    collect.check_arms(collect.load_runs(tmp_path))
    assert capsys.readouterr().err == ""
    run("a", 3, other)
    run("b", 0, one, other)
    collect.check_arms(collect.load_runs(tmp_path))
    line = "on Catch: the imported mine.py was not the same in all runs: sha256 0123456789"
    assert capsys.readouterr().err == (
        f"a {line} (seed 0, 1); sha256 abcdefghij (seed 3)\nb {line}, then abcdefghij (seed 0)\n"
    )


@pytest.mark.parametrize(
    "field, value",
    [("sticky_actions", 0.25), ("life_loss", False), ("eps_eval", 0.05), ("eval_games", 3), ("noop_max", 1)],
)
def test_other_protocols_are_refused_unless_forced(tmp_path, field, value):
    write_run(tmp_path / "a/seed0", gamma=0.9)
    write_run(tmp_path / "b/seed0")
    write_run(tmp_path / "c/seed0", returns=(), **{field: value})  # nothing of it is compared
    assert collect.check_protocols(collect.load_runs(tmp_path)) == []
    write_run(tmp_path / "d/seed0", **{field: value})
    runs = collect.load_runs(tmp_path)
    with pytest.raises(ConfigError, match=f"another protocol.*{field} is .*--force"):
        collect.check_protocols(runs, force=False)
    with pytest.raises(ConfigError, match=f"another protocol.*{field} is ") as raised:
        collect.check_protocols(runs)  # of a program that has no such flag
    assert "--force" not in str(raised.value)
    (line,) = collect.check_protocols(runs, force=True)
    assert f"{field} is {getattr(Config(), field)} there and {value} here" in line


def test_arms_are_compared_where_all_of_them_have_curves():
    """The same line, evaluated from 1,000 or from 2,500 env steps on: the same area, from 2,500 on."""
    early = (np.arange(1000, 6000, 1000), np.arange(1, 6) / 5)
    late = (np.array([2500, 5000]), np.array([0.5, 1.0]))
    until, found = collect.ends({"early": [early, early], "late": [late]})
    assert until == 5000 and found["late"]["area_under_curve"] == pytest.approx([0.75])
    assert found["early"]["area_under_curve"] == pytest.approx([0.75, 0.75])
    assert found["early"]["at_the_end"].tolist() == [1.0, 1.0]
    with pytest.raises(ConfigError, match="one begins at 2,500, another ends at 2,000"):
        collect.ends({"early": [(early[0][:2], early[1][:2])], "late": [late]})


def test_an_end_that_the_sparsest_run_has_no_point_at_is_interpolated():
    """Up to 350: the sparse run is at 3.5 and its mean 1.75; the dense one has a point between.

    Its mean is (0 + 100 * (0 + 6) / 2 + 250 * 6) / 350.
    """
    sparse, dense = ([0, 400], [0.0, 4.0]), ([0, 100, 350], [0.0, 6.0, 6.0])
    curves = [tuple(map(np.array, curve)) for curve in (sparse, dense)]
    dense_area = (300 + 1500) / 350
    for arms in ({"both": curves}, {"sparse": curves[:1], "dense": curves[1:]}):
        until, found = collect.ends(arms)
        areas, last = (
            np.concatenate(x) for x in zip(*(each.values() for each in found.values()), strict=True)
        )
        assert until == 350 and areas == pytest.approx([1.75, dense_area])
        assert last == pytest.approx([3.5, 6.0])


def test_rows_that_are_not_in_order_are_refused(tmp_path):
    run = write_run(tmp_path / "a/seed0", (0, 1, 2))
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[::-1]))
    with pytest.raises(
        ConfigError, match="seed0: the env steps of eval/return_mean .* not in ascending order"
    ):
        collect.steps_and_returns(*collect.load_runs(tmp_path))
