"""What checkpoints of a full buffer of 100,000 cost, and going on from one: Pong, nature, thesis settings.

The buffer is filled by real env steps with few updates; then iterations with updates as in the thesis are
timed, then checkpoints with 50,000 env steps between them, then a new run that takes up the last one.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np

from . import Count, Say

EVERY = 50_000
SHARE, SECONDS = 0.02, 30.0
"""The goals: share of a run's time, seconds until a run goes on."""


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    from srl_jax import checkpoint
    from srl_jax.loop import Run

    from ..benchmarks.jax_side import config_of

    preset = config_of("thesis/rl_only_nature")
    every = 600 if short else EVERY
    if short:
        preset = dataclasses.replace(preset, buffer_size=1000, encoder="tiny", game="Catch")
    folder = folder / "run"
    folder.mkdir()
    run = Run([dataclasses.replace(preset, updates_per_step=1e-4)], [folder])
    run.__enter__()
    run.begin()

    def forward(env_steps: int, what: str) -> float:
        began, start = time.monotonic(), run.env_steps
        shown = began
        while run.env_steps < start + env_steps:
            run.step()
            if time.monotonic() > shown + 10:
                shown = time.monotonic()
                left = (shown - began) / (run.env_steps - start) * (start + env_steps - run.env_steps)
                say(f"cost: {what}, {run.env_steps:,} env steps; {left:.0f} s left")
        return (run.env_steps - start) / (time.monotonic() - began)

    forward(run.config.buffer_size + every, "filling the buffer")
    updates = run.updates
    run.config = preset
    run.updates = int(
        (run.env_steps - preset.learn_start) * preset.updates_per_step
    )  # so that one is due a step
    forward(200, "warming up")
    rate = forward(400 if short else 1500, "training")
    run.updates = updates + run.updates - int((run.env_steps - preset.learn_start) * preset.updates_per_step)
    run.config = dataclasses.replace(preset, updates_per_step=1e-4)
    saves = []
    for i in range(3):
        began = time.monotonic()
        run.save()
        saves.append(time.monotonic() - began)
        say(f"cost: checkpoint {i}: {saves[-1]:.2f} s")
        if i < 2:
            forward(every, "between checkpoints")
    run.__exit__(None, None, None)
    (seed,) = run.seeds
    size = sum(path.stat().st_size for path in seed.saved.path.iterdir())
    began = time.monotonic()
    manifest = checkpoint.newest_good(folder, say)
    verified = time.monotonic() - began
    again = Run([preset], [folder], resume=[manifest])
    seconds = time.monotonic() - began
    (other,) = again.seeds
    same = bool((other.replay.frames == seed.replay.frames).all()) and again.env_steps == run.env_steps
    again.env_threads.shutdown()
    other.close()
    save = float(np.median(saves[1:]))
    share = save / (save + every / rate)
    costs = f"{save:.2f} s every {every:,} env steps at {rate:.0f} a second"
    told = f"{costs}: {100 * share:.2f} %; {size / 1e6:.0f} MB"
    resumed = f"{seconds:.1f} s, {verified:.1f} of them to check the sums; {len(other.replay):,} transitions"
    return [
        Count("a checkpoint costs under 2 % of a run's time", 1, int(share >= SHARE and not short), told),
        Count("going on takes under 30 s", 1, int(seconds >= SECONDS or not same), resumed),
    ]
