"""What a long run costs: its memory does not grow, and its checkpoints and its resumption are cheap."""

import dataclasses
import os
import time
from unittest import mock

import numpy as np

import srl_jax
from experiments.presets import preset_values
from srl_jax.config import Config
from srl_jax.replay import Replay
from tests import helpers
from tests.soak.conftest import train_here

OF_PARAMETERS = 150e6
"""Bytes that a checkpoint may have beside the frames: four trees of 20 MB, rewards and priorities."""
MAY_GROW = 6e6
"""Bytes that resident memory may have grown by, from a third of the run to its end: malloc wanders."""


def resident():
    """Bytes of this process in memory."""
    with open("/proc/self/statm", encoding="utf-8") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Watch:
    """A context in which each step of a run is told, once its transitions are in replay.

    Args:
        config: of the run.
        each: called with its env steps so far.
    """

    def __init__(self, config, each):
        add, done = Replay.add, 0

        def watched(*arguments):
            nonlocal done
            add(*arguments)
            done += config.num_envs
            each(done)

        self._patch = mock.patch.object(Replay, "add", watched)

    def __enter__(self):
        self._patch.start()

    def __exit__(self, *_):
        self._patch.stop()


def test_memory_does_not_grow_once_the_buffer_is_full(tmp_path, amount, progress, record_property):
    # Kept for each update or episode since the last row, anything would show: all are between two rows.
    steps, seen = amount("memory_steps"), []
    sizes = {"steps": steps, "log_every": steps, "eval_every": steps // 5, "checkpoint_every": steps // 6}
    config = Config(**{**helpers.SMALL, **helpers.JOINT, **sizes, "updates_per_step": 0.9})

    def each(done):
        if done % 300 < config.num_envs:
            seen.append((done, resident()))
        progress(done, steps, "env steps")

    with Watch(config, each):
        result = srl_jax.train(config, tmp_path / "run", progress=False)
    at, size = np.array(seen).T
    before = float(np.median(size[(at > steps // 3) & (at < steps // 2)]))
    grown = float(np.median(size[at > steps * 5 // 6])) - before
    record_property("env steps", steps)
    record_property("updates between two rows", result.updates)
    record_property("growth", f"{grown / 1e6:+.1f} MB of {before / 1e6:.0f}")
    assert grown < MAY_GROW


def test_what_checkpoints_and_resuming_cost(tmp_path, amount, progress, record_property):
    """Of a full buffer: Pong, nature, thesis settings; its real env steps are filled in with few updates.

    The goals are under 2 % of a run's time and under 30 s; they depend on the machine, and so are told.
    """
    every = amount("buffer") // 2
    steps = 4 * every
    config = Config(**preset_values("thesis/rl_only_nature", None))
    own = {"eval_every": steps, "eval_games": 1, "eval_max_steps": 100, "log_every": every}
    own |= {"diagnostics": False, "eps_final": 1.0}
    filling = {"buffer_size": 2 * every, "steps": steps, "checkpoint_every": every, "keep_replay": True}
    filling |= {"updates_per_step": 1e-4, "learn_start": every}
    full = dataclasses.replace(config, **own, **filling)
    times = []

    def each(done):
        times.append(time.monotonic())
        progress(done, steps, "env steps")

    with Watch(full, each):
        srl_jax.train(full, tmp_path / "full", progress=False)
    # Between the step that passes a multiple and the next one a checkpoint is written.
    per, gaps = full.num_envs, np.diff(times)
    saves = [float(gaps[k * every // per - 1]) for k in (2, 3)]
    last = sorted((tmp_path / "full" / "checkpoints").iterdir())[-1]
    size = sum(path.stat().st_size for path in last.iterdir())

    began, times[:] = time.monotonic(), []
    run = f"{tmp_path}/full"
    with Watch(full, each):
        flags = (f"--config={run}", f"--out={run}", f"--steps={steps + 20 * per}", "--resume=auto")
        assert train_here(*flags, "--tune_runtime=off") == 0
    resumed = times[0] - began

    training = dataclasses.replace(config, **own, steps=300 * per, learn_start=50 * per)
    times.clear()
    with Watch(training, each):
        srl_jax.train(training, tmp_path / "training", progress=False)
    rate = 100 * per / (times[299] - times[199])
    save = float(np.median(saves))
    share = save / (save + every / rate)
    record_property("a checkpoint", f"{save:.2f} s every {every:,} env steps at {rate:.0f} a second")
    record_property("share of the time", f"{100 * share:.2f} %, goal 2 %")
    record_property("bytes of a checkpoint", size)
    record_property("resumed in", f"{resumed:.1f} s, goal 30 s")
    # Each frame is in it once, although a window has many.
    frames = full.buffer_size * full.frame_size**2
    assert frames < size < 1.1 * frames + OF_PARAMETERS
