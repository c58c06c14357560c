"""Tests of experiments.collect."""

import dataclasses
import json

import pytest

from experiments import collect
from srl_jax.config import Config
from srl_jax.errors import ConfigError


def _write(path, returns=(1.0, 2.0), **values):
    path.mkdir(parents=True)
    config = Config(game="Catch", frame_size=42, **values)
    (path / "config.json").write_text(json.dumps({**dataclasses.asdict(config), "versions": {}}))
    rows = [
        {"kind": "eval", "env_steps": 100 * i, "updates": i, "wall_s": 0.5, "eval/return_mean": x}
        for i, x in enumerate(returns)
    ]
    rows.insert(1, {"kind": "train", "env_steps": 50, "updates": 0, "wall_s": 0.1})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_runs_are_found_and_grouped(tmp_path):
    _write(tmp_path / "Catch/b/seed1", seed=1)
    _write(tmp_path / "Catch/b/seed0", returns=(0.5, None, -1.0))
    _write(tmp_path / "Catch/a/seed0")
    _write(tmp_path / "loose_seed3", seed=3)
    _write(tmp_path / "Catch/b/seed0.broken-1", seed=0)
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
    _write(tmp_path / "x/a/seed0")
    _write(tmp_path / "y/a/seed0")
    with pytest.raises(ConfigError, match="the same game, arm and seed"):
        collect.load_runs(tmp_path)


def test_runs_of_an_arm_differ_in_their_seed_alone(tmp_path):
    _write(tmp_path / "a/seed0", encoder_from="x/seed0")
    _write(tmp_path / "a/seed1", encoder_from="x/seed1", seed=1)
    _write(tmp_path / "b/seed0", gamma=0.9)
    collect.check_arms(collect.load_runs(tmp_path))
    _write(tmp_path / "a/seed2", seed=2, gamma=0.9)
    with pytest.raises(ConfigError, match="seed2.*a on Catch.*gamma is 0.99 there and 0.9 here$"):
        collect.check_arms(collect.load_runs(tmp_path))


@pytest.mark.parametrize(
    "field, value",
    [("sticky_actions", 0.25), ("life_loss", False), ("eps_eval", 0.05), ("eval_games", 3), ("noop_max", 1)],
)
def test_other_protocols_are_refused_unless_forced(tmp_path, field, value):
    _write(tmp_path / "a/seed0", gamma=0.9)
    _write(tmp_path / "b/seed0")
    _write(tmp_path / "c/seed0", returns=(), **{field: value})  # nothing of it is compared
    assert collect.check_protocols(collect.load_runs(tmp_path)) == []
    _write(tmp_path / "d/seed0", **{field: value})
    runs = collect.load_runs(tmp_path)
    with pytest.raises(ConfigError, match=f"another protocol.*{field} is .*--force"):
        collect.check_protocols(runs)
    (line,) = collect.check_protocols(runs, force=True)
    assert f"{field} is {getattr(Config(), field)} there and {value} here" in line
