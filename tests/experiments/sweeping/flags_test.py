"""The command line of experiments/sweep.py, and the list of runs that it writes."""

import json
import pathlib
import subprocess
import sys

import pytest

from experiments import sweep
from experiments.sweeping import manifest, options
from srl_jax.errors import ConfigError
from tests.experiments.sweeping.sweep_test import ALL, A
from tests.in_process import parse


def _main(*arguments):
    values = parse(sweep, *arguments)
    root = pathlib.Path(values["out"].value)
    return values, root


@pytest.mark.parametrize(
    "arguments, says",
    [
        ((), "--presets: missing"),
        (("--presets=small/joint_256", "--seed=1"), "--seed: a sweep gives it to each run; --seeds decides"),
        (("--presets=small/joint_256", "--preset=demo"), "--preset: a sweep gives it"),
        (("--presets=nope",), "--presets=nope: "),
        (("--presets=small/joint_256", "--seeds=x"), "--seeds=x: "),
        (("--presets=small/joint_256", "--games=Pang"), "did you mean Pong"),
    ],
)
def test_command_lines_that_are_refused(tmp_path, arguments, says):
    values, root = _main(f"--out={tmp_path / 'new'}", *arguments)
    with pytest.raises(ConfigError, match=says):
        sweep.chosen_runs(values, root)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_packed_runs_takes_no_others(tmp_path):
    (tmp_path / "configs.json").write_text("[]")
    values, _ = _main("--presets=small/joint_256", f"--out={tmp_path}")
    with pytest.raises(ConfigError, match="runs are packed there; name another"):
        sweep.main(values)


def test_the_status_writes_nothing_and_may_be_asked_where_nothing_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(
        sweep.paths, "check_place", lambda *_: pytest.fail("--status asks whether it may write")
    )
    values, _ = _main(f"--out={tmp_path}", "--status")
    with pytest.raises(ConfigError, match="no sweep there"):
        sweep.main(values)


@pytest.mark.parametrize("given", ["--presets=catch/joint", "--seeds=2", "--lr_rl=1e-3", "--dry_run"])
def test_the_status_takes_nothing_that_would_plan_another_sweep(tmp_path, given):
    values, _ = _main(f"--out={tmp_path}", "--status", given)
    with pytest.raises(ConfigError, match=f"^{given.partition('=')[0]}: --status tells of the sweep that is"):
        sweep.main(values)


@pytest.mark.parametrize("given", ["--lr_rl=1e-4,3e-4", "--mode=joint,rl_only"])
def test_several_values_of_a_flag_are_a_grid(tmp_path, capsys, given):
    with pytest.raises(SystemExit):
        _main(f"--out={tmp_path}", given)
    assert capsys.readouterr().err.endswith(f"; --grid {given[2:]} tries each\n")


def test_flags_of_training_go_to_every_run(tmp_path):
    given = ("--steps=1e3", "--objective=inverse", "--nolife_loss", "--stop_at_return=off", "--rl=:n_step=2")
    values, root = _main(f"--out={tmp_path}", "--presets=small/joint_*", "--games=Catch", "--seeds=2", *given)
    runs = sweep.chosen_runs(values, root)
    assert runs[0].name == "Catch/joint_256/seed0"
    assert runs[0].flags == {
        "game": "Catch", "seed": "0", "objective": ("inverse",), "steps": "1000", "stop_at_return": "off",
        "life_loss": "false", "rl": ":n_step=2",
    }  # fmt: skip
    with pytest.raises(ConfigError, match="--gpus_per_run: only --launcher=ray"):
        options.launcher_options(_main(f"--out={tmp_path}", "--gpus_per_run=1")[0])


def test_a_grid_makes_arms_and_it_is_said_whose_objectives_are_replaced(tmp_path, capsys):
    given = ("--grid", "lr_rl=1e-4,3e-4", "--objective=inverse")
    values, root = _main(f"--out={tmp_path}", "--presets=small/joint_256,small/joint_50", *given)
    runs = sweep.chosen_runs(values, root)
    assert [run.name.split("/")[1] for run in runs] == [
        f"{arm}_lr_rl={rate}" for arm in ("joint_256", "joint_50") for rate in ("1e-4", "3e-4")
    ]
    options.say_what_is_replaced(values, runs)
    assert capsys.readouterr().err == (
        "objective: inverse in place of those of small/joint_256, small/joint_50; "
        "--objective=+NAME adds to them\n"
    )


def test_a_sweep_is_resumed_as_it_was_planned_where_no_presets_are_given(tmp_path):
    manifest.write(tmp_path, ALL)
    assert manifest.read(tmp_path) == ALL
    values, root = _main(f"--out={tmp_path}")
    assert sweep.chosen_runs(values, root) == [run for run, _ in ALL.values()]
    for given in (("--gamma=0.9",), ("--grid", "lr_rl=1,2")):
        values, root = _main(f"--out={tmp_path}", *given)
        with pytest.raises(ConfigError, match=f"--{given[0][2:6]}.*: only with --presets"):
            sweep.chosen_runs(values, root)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda about: "{",
        lambda about: "[]",
        lambda about: json.dumps({**about, "format": 9}),
        lambda about: json.dumps({**about, "runs": [{}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "name": "../../x"}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "name": "a/../x"}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "flags": []}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "policy_from": "a/b/c"}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "config": {"steps": -1}}]}),
        lambda about: "[" * 100_000,
    ],
)
def test_a_manifest_that_is_none_is_refused_in_one_line(tmp_path, spoil):
    manifest.write(tmp_path, {A: ALL[A]})
    path = tmp_path / "sweep.json"
    path.write_text(spoil(json.loads(path.read_text())))
    with pytest.raises(ConfigError, match="sweep.json: ") as refused:
        manifest.read(tmp_path)
    assert "\n" not in str(refused.value)


def test_bad_input_is_one_line_and_status_2(tmp_path):
    """The one test with a process: the whole way through the entry point."""
    out = tmp_path / "new"
    done = subprocess.run(
        [sys.executable, "-m", "experiments.sweep", "--presets=small/joint_256", f"--out={out}", "--gamma=2"],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "--gamma=2" in done.stderr
    assert not out.exists()
