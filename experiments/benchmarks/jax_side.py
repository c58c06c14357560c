"""This project's updates: timed, and checked; a side of `worker`, and what other benchmarks share."""

import dataclasses
import time
from typing import Any
from unittest import mock

import jax
import numpy as np
from flax.traverse_util import flatten_dict

from srl_jax import encoders, objectives, rl
from srl_jax.config import Config, resolve
from srl_jax.learning.agent import make_agent, over_seeds
from srl_jax.rl import heads
from srl_jax.types import Window

from ..presets import PRESETS

NUM_ACTIONS = 6
"""Pong's."""

WINDOWS = 8
"""Different batches that the timed updates take in turn."""

WARM_UPDATES = 5
"""Updates, or rounds of `srl_every` of them, before any that is timed."""

CHECK_ADAM_EPS = 1e-3
"""Of the checked updates: with a tiny one, Adam's first step is the sign of a gradient, rounding and all."""

JITTER = 0.003
"""Standard deviation of noise on the checked weights, so that biases are not 0 and the slow copy is none."""


def config_of(preset: str, **overrides: Any) -> Config:
    """The resolved settings of a preset."""
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


class Updates:
    """A preset's jitted update and the state that it moves, compiled and warmed up.

    Attributes:
        config, agent: of the preset.
        state: after the updates so far; with an axis of seeds in front where there are several.
        windows: {seed: batches}, which updates take in turn.

    Args:
        preset: a key of `experiments.presets.PRESETS`.
        seeds: in one call.
        **overrides: fields of `Config`.
    """

    def __init__(self, preset: str, seeds: int = 1, **overrides: Any):
        self.config = config_of(preset, **overrides)
        self.agent = make_agent(self.config, frame_shape(self.config), NUM_ACTIONS)
        self.device = over_seeds(self.agent, seeds)
        keys = [jax.random.key(self.config.seed + i) for i in range(seeds)]
        self.state = self.device.stack([self.agent.init(key, None) for key in keys])
        self.windows = [random_window(self.config, self.agent.horizon, seed) for seed in range(WINDOWS)]
        self._seeds, self._count = seeds, 0
        self.turn(WARM_UPDATES)

    def check(self, updates: int) -> tuple[list[dict[str, float]], dict[str, Any]]:
        """What another side must reproduce, without noise and on one batch.

        Args:
            updates: how many.

        Returns:
            The losses of each, {name: the mean before its weight}, "total" the weighted sum. And what they
            start from: "params", `TrainState.params` and `.slow` by path, with biases and a slow copy unlike
            those of a start; "window".
        """
        state = self.agent.init(jax.random.key(self.config.seed), None)
        state = state._replace(params=_jittered(state.params, 1), slow=_jittered(state.slow, 2))
        given = {
            "params": flatten_dict(jax.device_get({"params": state.params, "slow": state.slow}), sep="/"),
            "window": {name: x for name, x in self.windows[0]._asdict().items() if x is not None},
        }
        # Not the timed update: what is traced here has no noise in it.
        config = dataclasses.replace(self.config, adam_eps=CHECK_ADAM_EPS)
        agent = make_agent(config, frame_shape(config), NUM_ACTIONS)
        found = []
        with mock.patch.object(heads, "factorised_noise", lambda key, size: np.zeros(size, np.float32)):
            for _ in range(updates):
                state, _, metrics = agent.update(state, self.windows[0], agent.hyper)
                names = [name for name in metrics if name.startswith("loss/")]
                found.append({name.removeprefix("loss/"): float(metrics[name]) for name in names})
        return found, given

    def turn(self, updates: int) -> dict[str, list[float]]:
        """Goes on with so many updates.

        Returns:
            "update", the milliseconds of each from handing over windows to priorities and state in hand; with
            `srl_every` the means of so many rounds in which the representation losses run once.
        """
        every = self.config.srl_every
        return {"update": [1e3 * sum(self._update() for _ in range(every)) / every for _ in range(updates)]}

    def _update(self) -> float:
        update = self.device.update_rl if self._count % self.config.srl_every else self.device.update
        windows = [self.windows[(self._count + i) % WINDOWS] for i in range(self._seeds)]
        self._count += 1
        start = time.perf_counter()
        self.state, td_error, _ = update(self.state, windows, self.agent.hyper)
        np.asarray(td_error)
        jax.block_until_ready(self.state)
        return time.perf_counter() - start


def _jittered(tree: Any, seed: int) -> Any:
    """The tree with a little noise on every number."""
    rng = np.random.default_rng(seed)

    return jax.tree.map(lambda x: x + rng.normal(0, JITTER, x.shape).astype(np.float32), tree)
