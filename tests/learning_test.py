"""It learns: every mode, on a small Catch, through the same loop as any run.

A random player catches 18 % (mean return -0.64). Each mode has to catch clearly more than half after a
short run; the full statement, 95 % over 200 games, is a campaign in experiments/results.
"""

import pytest

from experiments.presets import preset_values
from srl_jax import loop
from srl_jax.config import Config
from srl_jax.metrics import read_metrics

SHORT = {"steps": 24_000, "eval_every": 24_000, "eval_games": 100, "eps_anneal_steps": 8_000}


def run(path, preset, **overrides):
    path.mkdir()
    config = Config(**{**preset_values(preset), **SHORT, **overrides})
    config.save(path)
    loop.train(config, path, progress=False)
    return read_metrics(path / "metrics.jsonl")


def final_return(rows):
    return [row["eval/return_mean"] for row in rows if row["kind"] == "eval"][-1]


@pytest.mark.parametrize("mode", ["rl_only", "joint"])
def test_from_scratch(tmp_path, mode):
    assert final_return(run(tmp_path / mode, f"catch/{mode}")) > 0.0
