"""A small run of Catch, in this process, for parts that need a real checkpoint."""

from pathlib import Path
from typing import Any

from srl_jax.config import Config, resolve


def config(**values: Any) -> Config:
    """A run of some seconds."""
    from srl_jax import encoders, objectives, rl

    small = {
        "game": "Catch",
        "mode": "joint",
        "encoder": "tiny:features=16",
        "rl": "rainbow:hidden=16,atoms=11",
        "objectives": ("reconstruction",),
        "frame_size": 42,
        "num_envs": 3,
        "buffer_size": 300,
        "batch_size": 8,
        "updates_per_step": 0.2,
        "learn_start": 40,
        "steps": 900,
        "eval_every": 210,
        "eval_games": 3,
        "log_every": 60,
        "checkpoint_every": 150,
        "slow_update_every": 7,
        "diagnostics": False,
    }
    return resolve(Config(**{**small, **values}), rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY)


def stopped_run(out: Path, at: int, **values: Any) -> Any:
    """The `Run`, after it was stopped at so many env steps; its checkpoint is in `out`."""
    from srl_jax.loop import Run

    out.mkdir(parents=True)
    run = Run([config(**values)], [out])
    run.stop = lambda: run.env_steps >= at
    run.train()
    return run
