"""experiments/runs/run_data.py: runs are found, and what is drawn of them is checked first."""

import json
import os

import pytest

from experiments.runs import run_data
from srl_jax.specs import ConfigError
from tests.helpers import write_run

EVAL = {"kind": "eval", "env_steps": 5, "eval/return_mean": 1.0, "eval/returns": [1.0, None]}
TRAIN = {"kind": "train", "env_steps": 5, "loss/rl": None, "grad_norm/rl": 2}


def _write(run, *rows):
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run / "metrics.jsonl"


def test_rows_as_training_writes_them(tmp_path):
    assert run_data.read_rows(_write(tmp_path, TRAIN, EVAL)) == [TRAIN, EVAL]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"kind": "other"}, "kind"),
        ({"kind": ["eval"]}, "kind"),
        ({"env_steps": -1}, "env_steps"),
        ({"env_steps": 2**31}, "env_steps"),
        ({"env_steps": 1.0}, "env_steps"),
        ({"env_steps": True}, "env_steps"),
        ({"eval/return_mean": "1"}, "eval/return_mean"),
        ({"eval/return_mean": 10**400}, "eval/return_mean"),
        ({"eval/returns": 5}, "eval/returns"),
        ({"eval/returns": [[1.0]]}, "eval/returns"),
        ({"eval/returns": [1e39]}, "eval/returns"),
        ({"loss/rl": {}}, "loss/rl"),
        ({"grad_norm": [1.0]}, "grad_norm"),
        ({"diag/effective_rank": "2"}, "diag/effective_rank"),
        ({"diag/drift/cka": [0.5, [1.0]]}, "diag/drift/cka"),
        ({"diag/drift/steps": [1.5]}, "diag/drift/steps"),
        ({"diag/drift/steps": 5}, "diag/drift/steps"),
        ({"final/games": [1]}, "final/games"),
    ],
)
def test_other_rows_are_refused_with_their_line(change, reason, tmp_path):
    path = _write(tmp_path, TRAIN, {**EVAL, **change})
    with pytest.raises(ConfigError) as error:
        run_data.read_rows(path)
    assert str(error.value).startswith(f"{path}, line 2: {reason} ")


def test_what_is_no_metrics_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="metrics.jsonl: No such file"):
        run_data.read_rows(tmp_path / "metrics.jsonl")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="pipe: Not a regular file"):
        run_data.read_rows(tmp_path / "pipe")
    path = _write(tmp_path)
    path.write_text("[" * 100_000 + "\n")
    with pytest.raises(ConfigError, match="line 1: nested too deeply"):
        run_data.read_rows(path)


def test_runs_behind_links_are_found_and_loops_end(tmp_path):
    root, disk = tmp_path / "cmp", tmp_path / "disk"
    for name in ("joint_seed1", "joint_seed2", "more/Catch/a/seed0"):
        write_run(disk / name)
    write_run(root / "joint_seed0")
    (root / "joint_seed1").symlink_to(disk / "joint_seed1")
    (root / "joint_seed2").symlink_to(os.path.relpath(disk / "joint_seed2", root))
    (root / "more").symlink_to(disk / "more")
    (root / "again").symlink_to(root / "joint_seed0")  # found by its own name
    (root / "loop").symlink_to(root)
    (root / "up").symlink_to("..")  # what lies above is not below
    (disk / "more/Catch/back").symlink_to(disk / "more")
    (root / "gone").symlink_to(tmp_path / "nowhere")
    names = ["joint_seed0", "joint_seed1", "joint_seed2", "more/Catch/a/seed0"]
    assert run_data.runs_below(root) == [root / name for name in names]
    # Links alone, and a link to all of it.
    (root / "joint_seed0").rename(disk / "joint_seed0")
    (root / "again").unlink()
    (root / "joint_seed0").symlink_to(disk / "joint_seed0")
    assert len(run_data.runs_below(root)) == 4
    (tmp_path / "link").symlink_to(root)
    assert run_data.runs_below(tmp_path / "link")[0] == tmp_path / "link/joint_seed0"
    assert run_data.runs_below(root / "joint_seed1") == [root / "joint_seed1"]


@pytest.mark.parametrize("name", ["n\udcff", "two\nlines"])
def test_an_arm_that_cannot_be_shown_is_refused(name, tmp_path):
    write_run(tmp_path / name / "seed0", (0.0, 1.0))
    with pytest.raises(ConfigError) as error:
        run_data.load_run(tmp_path / name / "seed0")
    assert f"{name!a} has the character" in str(error.value)


def test_runs_come_in_the_order_of_their_numbers(tmp_path):
    for seed in (10, 2, 1):
        write_run(tmp_path / f"a/seed{seed}")
    assert [path.name for path in run_data.runs_below(tmp_path)] == ["seed1", "seed2", "seed10"]


def test_numbers_in_names_are_sorted_as_numbers_and_what_begins_with_0_as_a_fraction():
    names = [
        "joint_50",
        "joint_256",
        "ratio0",
        "ratio003",
        "ratio01",
        "ratio03",
        "ratio1",
        "ratio3",
        "ratio10",
    ]
    assert sorted(reversed(names), key=run_data.natural) == names


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_cannot_be_read_is_said(tmp_path):
    write_run(tmp_path / "a/seed0")
    (tmp_path / "b").mkdir(0o000)
    with pytest.raises(ConfigError, match="b: Permission denied"):
        run_data.runs_below(tmp_path)
