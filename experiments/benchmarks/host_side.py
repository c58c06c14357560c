"""This project's side of the benchmarks of the loop and of replay; answers `worker` requests.

`python -m experiments.benchmarks.host_side ENCODER`, in the environment that a run with this encoder gives
itself. Imports jax when it is first asked.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax.provenance import versions

from .. import runtime
from .worker import serve

WARM_UPDATES = 5
"""Updates of the loop before anything is timed."""

STREAMS, CAPACITY, STACK, HORIZON, SIDE = 10, 100_000, 4, 3, 84
"""Of the replay buffer."""

BATCH, BETA = 32, 0.4


def timed(function: Callable[[], Any]) -> float:
    """Seconds of a call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


class Loop:
    """A run of `srl_jax.loop`, step by step, without evaluation and files; `setup` comes first."""

    def setup(self, preset: str) -> dict[str, Any]:
        """Builds the run, and takes it past its first updates. Replies with "versions"."""
        from srl_jax import loop

        from .jax_side import config_of

        self._acting = []
        self._run = loop.Run([config_of(preset)], [Path()])
        act_and_step = self._run.act_and_step

        def timed_act_and_step(*arguments):
            start = time.perf_counter()
            result = act_and_step(*arguments)
            self._acting.append(time.perf_counter() - start)
            return result

        self._run.act_and_step = timed_act_and_step
        self._run.begin()
        while self._run.updates < WARM_UPDATES:
            self._run.step()
        self._forget()
        return {"versions": versions()}

    def run(self, env_steps: int) -> dict[str, Any]:
        """Goes on with training, and ends with what a row of metrics.jsonl waits for.

        Args:
            env_steps: how long, rounded up to whole steps of all environments.

        Returns:
            "seconds" by the wall clock, "env_steps" and "updates" done.
        """
        run = self._run
        env_steps, updates = run.env_steps + env_steps, run.updates
        begun = run.env_steps
        start = time.perf_counter()
        while run.env_steps < env_steps:
            run.step()
        self._forget()
        seconds = time.perf_counter() - start
        return {"seconds": seconds, "env_steps": run.env_steps - begun, "updates": run.updates - updates}

    def parts(self, iterations: int) -> dict[str, Any]:
        """Whole iterations of the loop, then as many of either of its two parts alone.

        Returns:
            Lists of seconds: "iteration"; "acting", acting and the step of all environments, while nothing
            is updated; "update", from sampling to setting priorities, while no environment moves. And "busy":
            processor time of the whole iterations to their wall-clock time.
        """
        run = self._run
        busy = time.process_time()
        iteration = [timed(run.step) for _ in range(iterations)]
        busy = (time.process_time() - busy) / sum(iteration)
        self._acting.clear()
        updates, run.updates = run.updates, 10**12  # as if all had been done
        for _ in range(iterations):
            run.step()
        run.updates = updates
        acting = list(self._acting)
        # As many as were left out, so that none is due later.
        update = [timed(run.update) for _ in range(iterations)]
        self._forget()
        return {"iteration": iteration, "acting": acting, "update": update, "busy": [busy]}

    def _forget(self) -> None:
        """As after a row."""
        self._run.fetch()
        self._run.seeds[0].report.means.take()
        self._acting.clear()


class Replays:
    """A full buffer; `setup` comes first."""

    def setup(self, seed: int = 0) -> dict[str, Any]:
        """Fills a buffer with noise, in episodes of about 800 env steps. Replies with "versions"."""
        from srl_jax.replay import Replay

        self._rng = rng = np.random.default_rng(seed)
        self._replay = Replay(
            capacity=CAPACITY,
            num_streams=STREAMS,
            frame_shape=(SIDE, SIDE, 1),
            stack=STACK,
            horizon=HORIZON,
            seed=seed,
        )
        pool = rng.integers(0, 256, (97, STREAMS, SIDE, SIDE, 1), np.uint8)
        zeros = np.zeros(STREAMS, bool)
        self._replay.begin(pool[0])
        for i in range(self._replay.slots + STACK):
            actions = rng.integers(0, 6, STREAMS)
            over = rng.random(STREAMS) < 1 / 800
            self._replay.add(
                actions, rng.integers(-1, 2, STREAMS).astype(np.float32), over, zeros, zeros, pool[i % 97]
            )
            if over.any():
                self._replay.begin(pool[0][over], np.flatnonzero(over))
        self._frames = self._replay.frames.reshape(-1, SIDE, SIDE, 1)
        self._env = None
        self.sample(100)
        return {"versions": versions()}

    def sample(self, repetitions: int) -> dict[str, Any]:
        """Draws batches and sets their priorities, in turn with gathering as many frames.

        Returns:
            Lists of seconds: "sample"; "gather", of one numpy index into the same frames, in runs as long as
            a window.
        """
        sample, gather = [], []
        length = STACK + HORIZON
        for _ in range(repetitions):
            errors = self._rng.random(BATCH)

            def draw(errors=errors):
                _, indices = self._replay.sample(BATCH, BETA)
                self._replay.set_priorities(indices, errors)

            sample.append(timed(draw))
            first = self._rng.integers(0, len(self._frames) - length, BATCH)
            indices = first[:, None] + np.arange(length)
            gather.append(timed(lambda indices=indices: self._frames[indices]))
        return {"sample": sample, "gather": gather}

    def insert(self, steps: int) -> dict[str, Any]:
        """Steps environments of Pong with random actions, and adds what they give.

        Returns:
            Lists of seconds: "step" of all environments, "add".
        """
        if self._env is None:
            from srl_jax import envs

            self._env = envs.make("Pong", num_envs=STREAMS, seed=0)
            frames, _ = self._env.reset()
            self._replay.begin(frames)
        seconds = {"step": [], "add": []}
        for _ in range(steps):
            actions = self._rng.integers(0, 6, STREAMS, np.int32)
            start = time.perf_counter()
            frames, rewards, terminated, truncated, info = self._env.step(actions)
            stepped = time.perf_counter()
            self._replay.add(actions, rewards, terminated, truncated, info["life_lost"], frames)
            seconds["add"].append(time.perf_counter() - stepped)
            seconds["step"].append(stepped - start)
            over = terminated | truncated
            if over.any():
                frames, _ = self._env.reset(options={"reset_mask": over})
                self._replay.begin(frames[over], np.flatnonzero(over))
        return seconds


if __name__ == "__main__":
    runtime.prepare("auto", sys.argv[1])
    loops, replays = Loop(), Replays()
    serve(
        {
            "setup": loops.setup,
            "run": loops.run,
            "parts": loops.parts,
            "fill": replays.setup,
            "sample": replays.sample,
            "insert": replays.insert,
        }
    )
