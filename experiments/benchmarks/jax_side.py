"""This project's side of the benchmarks of updates: timed, and checked; answers `worker` requests.

`python -m experiments.benchmarks.jax_side ENCODER`, in the environment that a run with this encoder gives
itself. Imports jax when it is first asked.
"""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from srl_jax.config import Config, resolve
from srl_jax.provenance import versions
from srl_jax.types import TrainState, Window

from .. import runtime
from ..presets import PRESETS
from .worker import serve

NUM_ACTIONS = 6
"""Pong's."""

WINDOWS = 8
"""Different batches that the timed updates take in turn."""

CHECK_ADAM_EPS = 1e-3
"""Of the checked updates: with a tiny one, Adam's first step is the sign of a gradient, rounding and all."""

JITTER = 0.003
"""Standard deviation of noise on the checked weights, so that biases are not 0 and the slow copy is none."""


def config_of(preset: str, **overrides: Any) -> Config:
    """The resolved settings of a preset; imports jax."""
    from srl_jax import encoders, objectives, rl

    config = Config(**{**PRESETS[preset], **overrides})
    return resolve(config, rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY)


def frame_shape(config: Config) -> tuple[int, int, int]:
    """(H, W, C) of a preset's frames: all are of Atari games or Catch."""
    return config.frame_size, config.frame_size, 1


def random_window(config: Config, horizon: int, seed: int) -> Window:
    """A window of noise with the shapes of a run's; some rows end, or are cut, within the horizon."""
    rng = np.random.default_rng(seed)
    batch = config.batch_size
    frames = rng.integers(0, 256, (batch, config.frame_stack + horizon, *frame_shape(config)), np.uint8)
    end = np.where(rng.random(batch) < 0.1, rng.integers(0, horizon, batch), horizon)[:, None]
    steps = np.arange(horizon)
    valid = steps <= end
    terminal = (steps == end) & (rng.random(batch) < 0.5)[:, None]
    return Window(
        frames=frames,
        actions=np.where(valid, rng.integers(0, NUM_ACTIONS, valid.shape), 0).astype(np.int32),
        rewards=np.where(valid, rng.integers(-1, 2, valid.shape), 0).astype(np.float32),
        discounts=np.where(valid & ~terminal, config.gamma, 0).astype(np.float32),
        valid=valid.astype(np.float32),
        weight=rng.uniform(0.1, 1.0, batch).astype(np.float32),
    )


def flat(tree: Any) -> dict[str, np.ndarray]:
    """A tree of dicts as {path/with/slashes: array}."""
    import jax

    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {"/".join(str(k.key) for k in path): np.array(leaf) for path, leaf in leaves}


def _jittered(tree: Any, seed: int) -> Any:
    """The tree with a little noise on every number."""
    import jax

    rng = np.random.default_rng(seed)

    def moved(leaf):
        return jax.numpy.asarray(leaf + rng.normal(0, JITTER, leaf.shape).astype(np.float32))

    return jax.tree.map(moved, tree)


class Updates:
    """One preset's jitted update and the state that it moves; `setup` comes first."""

    def setup(self, preset: str, **overrides: Any) -> dict[str, Any]:
        """Builds and compiles the update.

        Args:
            preset: a key of `experiments.presets.PRESETS`.
            **overrides: fields of `Config`.

        Returns:
            "versions"; "compile_s", the seconds of the first updates.
        """
        import jax

        from srl_jax.agent import make_agent

        self._config = config_of(preset, **overrides)
        self._agent = make_agent(self._config, frame_shape(self._config), NUM_ACTIONS)
        self._state = self._agent.init(jax.random.key(self._config.seed), None)
        self._windows = [self._window(seed) for seed in range(WINDOWS)]
        self._count = 0
        start = time.perf_counter()
        self.time(self._config.srl_every)
        return {"versions": versions(), "compile_s": time.perf_counter() - start}

    def check(self, folder: str, updates: int) -> dict[str, Any]:
        """The mean losses of the first updates without noise, before weights, and their weighted sum "total".

        Args:
            folder: where params.npz (`TrainState.params` and `.slow`, by path) and window.npz are written, so
                that another side can start from the same. Neither biases nor the slow copy are as at a start.
            updates: how many, on one batch.

        Returns:
            "losses", {name: value} of each update; "params" and "window", paths of the files.
        """
        from srl_jax.agent import make_agent
        from srl_jax.rl import heads

        state, window = self._checked_state(), self._window(0)
        weights = flat({"params": state.params, "slow": state.slow})
        paths = {name: str(Path(folder) / f"{name}.npz") for name in ("params", "window")}
        np.savez(paths["params"], **weights)
        np.savez(paths["window"], **window._asdict())
        # Not the timed update: what is traced here has no noise in it.
        config = dataclasses.replace(self._config, adam_eps=CHECK_ADAM_EPS)
        agent = make_agent(config, frame_shape(config), NUM_ACTIONS)
        losses = []
        with mock.patch.object(heads, "factorised_noise", lambda key, size: np.zeros(size, np.float32)):
            for _ in range(updates):
                state, _, metrics = agent.update(state, window, agent.hyper)
                found = {n.removeprefix("loss/"): x for n, x in metrics.items() if n.startswith("loss/")}
                losses.append({name: float(value) for name, value in found.items()})
        return {"losses": losses, **paths}

    def time(self, updates: int) -> dict[str, Any]:
        """Does so many updates, from where the last call left off.

        Where `srl_every` is above 1, the representation losses run in the updates that it divides.

        Returns:
            "seconds" of each, from handing over the window to priorities and state in hand.
        """
        return {"seconds": [self._update() for _ in range(updates)]}

    def _update(self) -> float:
        import jax

        window = self._windows[self._count % WINDOWS]
        update = self._agent.update_rl if self._count % self._config.srl_every else self._agent.update
        self._count += 1
        start = time.perf_counter()
        self._state, td_error, _ = update(self._state, window, self._agent.hyper)
        np.asarray(td_error)
        jax.block_until_ready(self._state)
        return time.perf_counter() - start

    def _window(self, seed: int) -> Window:
        return random_window(self._config, self._agent.horizon, seed)

    def _checked_state(self) -> TrainState:
        import jax

        state = self._agent.init(jax.random.key(self._config.seed), None)
        return state._replace(params=_jittered(state.params, 1), slow=_jittered(state.slow, 2))


if __name__ == "__main__":
    runtime.prepare("auto", sys.argv[1])
    updates = Updates()
    serve({"setup": updates.setup, "check": updates.check, "time": updates.time})
