"""This project's loop and its replay; two sides of `worker`."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax import envs, replay
from srl_jax.learning.agent import make_agent
from srl_jax.run import loop

from .jax_side import NUM_ACTIONS, config_of, frame_shape

WARM_UPDATES = 5
"""Updates of the loop before anything is timed."""

BETA = 0.4


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Milliseconds of a call, and what it returns."""
    start = time.perf_counter()
    found = function(*arguments)
    return 1e3 * (time.perf_counter() - start), found


class Loop:
    """A run of a preset, without evaluation and files, past its first updates."""

    def __init__(self, preset: str):
        self._run = loop.Run([config_of(preset)], [Path()])
        while self._run.updates < WARM_UPDATES:
            self._run.step()
        self._forget()

    def turn(self, env_steps: int, iterations: int) -> dict[str, list[float]]:
        """Goes on with training.

        Args:
            env_steps: how long, rounded up to whole steps of all environments.
            iterations: steps of all environments with the updates that are due, and as many of either half.

        Returns:
            "rate" of the first, env steps a second, to the end of what a row of metrics.jsonl waits for;
            milliseconds of each "iteration", and "busy", processor time to wall-clock time meanwhile. The
            "slower half" of an iteration is the slower one of acting and stepping the environments, while
            nothing is updated, and its updates, with sampling and priorities, while no environment moves.
        """
        run = self._run
        first, start = run.env_steps, time.perf_counter()
        while run.env_steps < first + env_steps:
            run.step()
        self._forget()
        rate = (run.env_steps - first) / (time.perf_counter() - start)

        processor = time.process_time()
        iteration = [timed(run.step)[0] for _ in range(iterations)]
        busy = 1e3 * (time.process_time() - processor) / sum(iteration)
        before = run.schedules.updates_due(run.env_steps)
        acting = [self._act() for _ in range(iterations)]
        # As many as were left out, so that none is due later.
        due = run.schedules.updates_due(run.env_steps) - before
        updates = [timed(run.update)[0] for _ in range(due)]
        self._forget()
        slower = float(max(np.median(acting), np.median(updates) * due / iterations))
        return {"rate": [rate], "iteration": iteration, "busy": [busy], "slower half": [slower]}

    def _act(self) -> float:
        """A step of the loop without updates: milliseconds of acting and of the environments' step."""
        run = self._run
        frames = [seed.stacks.observations() for seed in run.seeds]
        now = run.state.params, frames, run.env_steps, run.now.epsilon
        milliseconds, steps = run.env_threads.submit(timed, run.act_and_step, *now).result()
        for seed, step in zip(run.seeds, steps, strict=True):
            seed.take(*step)
        run.env_steps += run.config.num_envs
        return milliseconds

    def _forget(self) -> None:
        """As after a row."""
        self._run.fetch()
        self._run.seeds[0].report.means.take()


class Replay:
    """A preset's buffer, full of noise in episodes of about 800 env steps, and its environments."""

    def __init__(self, preset: str):
        config = config_of(preset)
        shape, streams = frame_shape(config), config.num_envs
        self._rng = rng = np.random.default_rng(0)
        self._batch = config.batch_size
        horizon = make_agent(config, shape, NUM_ACTIONS).horizon
        self._length = config.frame_stack + horizon
        self._replay = replay.Replay(
            capacity=config.buffer_size,
            num_streams=streams,
            frame_shape=shape,
            stack=config.frame_stack,
            horizon=horizon,
            seed=0,
        )
        pool = rng.integers(0, 256, (97, streams, *shape), np.uint8)
        zeros = np.zeros(streams, bool)
        self._replay.begin(pool[0])
        for i in range(self._replay.slots + config.frame_stack):
            rewards = rng.integers(-1, 2, streams).astype(np.float32)
            over = rng.random(streams) < 1 / 800
            self._replay.add(rng.integers(0, 6, streams), rewards, over, zeros, zeros, pool[i % 97])
            if over.any():
                self._replay.begin(pool[0][over], np.flatnonzero(over))
        self._frames = self._replay.frames.reshape(-1, *shape)
        self._env = envs.make(config.game, num_envs=streams, seed=0)
        self._replay.begin(self._env.reset()[0])
        self.turn(100, 10)

    def turn(self, samples: int, inserts: int) -> dict[str, list[float]]:
        """Samples, and adds what random actions give; in milliseconds.

        Args:
            samples: batches.
            inserts: steps of all environments.

        Returns:
            "sample", of drawing a batch and setting its priorities; "gather", of one numpy index into the
            same frames, in runs as long as a window; "env step" of all environments; "add".
        """
        found: dict[str, list[float]] = {"sample": [], "gather": [], "env step": [], "add": []}
        for _ in range(samples):
            found["sample"].append(timed(self._sample, self._rng.random(self._batch))[0])
            first = self._rng.integers(0, len(self._frames) - self._length, self._batch)
            indices = first[:, None] + np.arange(self._length)
            found["gather"].append(timed(lambda: self._frames[indices])[0])  # noqa: B023
        for _ in range(inserts):
            actions = self._rng.integers(0, NUM_ACTIONS, self._env.num_envs, np.int32)
            milliseconds, step = timed(self._env.step, actions)
            frames, rewards, terminated, truncated, info = step
            found["env step"].append(milliseconds)
            added = actions, rewards, terminated, truncated, info["life_lost"], frames
            found["add"].append(timed(self._replay.add, *added)[0])
            over = terminated | truncated
            if over.any():
                frames, _ = self._env.reset(options={"reset_mask": over})
                self._replay.begin(frames[over], np.flatnonzero(over))
        return found

    def _sample(self, errors: np.ndarray) -> None:
        _, indices = self._replay.sample(self._batch, BETA)
        self._replay.set_priorities(indices, errors)
