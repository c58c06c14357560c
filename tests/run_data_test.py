"""Tests of experiments.runs.run_data: what is drawn is checked first."""

import json
import os

import pytest

from experiments.runs import run_data
from srl_jax.specs import ConfigError

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
