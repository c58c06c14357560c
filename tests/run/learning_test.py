"""It learns: RL and the representation, on a small Catch, through the same loop as any run.

The other modes learn in tests/soak/learning_test.py.

A random player catches 18 % of the balls: a mean return of -0.64. Over 200 games the standard error of a
return near that is 0.054, so nothing that acts at random passes -0.45. The full statement, 95 % within
three minutes, is a campaign and lies in experiments/results.
"""

from experiments.presets import preset_values
from srl_jax.config import Config
from srl_jax.files.metrics import read_metrics
from srl_jax.run import loop
from tests.helpers import optimised

SHORT = {
    "diagnostics": False,
    "steps": 24_000,
    "eval_every": 24_000,
    "eval_games": 200,
    "eps_anneal_steps": 8_000,
}


def run(path, preset, **overrides):
    """The rows of a short run, and the mean return at its end (None where it has no policy)."""
    path.mkdir()
    config = Config(**{**preset_values(preset), **SHORT, **overrides})
    config.save(path)
    with optimised():
        loop.train(config, path, progress=False)
    rows = read_metrics(path / "metrics.jsonl")
    return rows, rows[-1].get("eval/return_mean")


def test_joint(tmp_path):
    # A quarter of the preset's batch and half its frame, which is a quarter of the time. Seeds 0, 1 and 2 end
    # at 0.12, -0.04 and 0.29.
    rows, final = run(tmp_path / "joint", "catch/joint", batch_size=16, frame_size=42)
    assert final > -0.2
    losses = [row["loss/reconstruction"] for row in rows if "loss/reconstruction" in row]
    assert losses[-1] < 0.6 * losses[0]
