"""This project's updates: timed, and checked; a `worker`, and what other benchmarks share.

Imports jax when an update is built.
"""

import dataclasses
import time
from typing import Any
from unittest import mock

import numpy as np

from srl_jax.config import Config, resolve
from srl_jax.types import TrainState, Window

from .. import runtime
from ..presets import PRESETS
from .worker import arguments, serve

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
        import jax

        from srl_jax.agent import make_agent, over_seeds

        self.config = config_of(preset, **overrides)
        self.agent = make_agent(self.config, frame_shape(self.config), NUM_ACTIONS)
        self.device = over_seeds(self.agent, seeds)
        keys = [jax.random.key(self.config.seed + i) for i in range(seeds)]
        self.state = self.device.stack([self.agent.init(key, None) for key in keys])
        self.windows = [random_window(self.config, self.agent.horizon, seed) for seed in range(WINDOWS)]
        self._seeds, self._count = seeds, 0
        self.turn(WARM_UPDATES)

    def check(self, updates: int) -> dict[str, Any]:
        """What another side must reproduce.

        Args:
            updates: how many, without noise and on one batch.

        Returns:
            "losses" of each, {name: the mean before its weight}, "total" the weighted sum. What they start
            from: "params", `TrainState.params` and `.slow` by path, with biases and a slow copy unlike those
            of a start; "window".
        """
        import jax

        from srl_jax.agent import make_agent
        from srl_jax.rl import heads

        state = self.agent.init(jax.random.key(self.config.seed), None)
        state = state._replace(params=_jittered(state.params, 1), slow=_jittered(state.slow, 2))
        found = {"params": flat({"params": state.params, "slow": state.slow}), "losses": []}
        # Not the timed update: what is traced here has no noise in it.
        config = dataclasses.replace(self.config, adam_eps=CHECK_ADAM_EPS)
        agent = make_agent(config, frame_shape(config), NUM_ACTIONS)
        with mock.patch.object(heads, "factorised_noise", lambda key, size: np.zeros(size, np.float32)):
            for _ in range(updates):
                state, _, metrics = agent.update(state, self.windows[0], agent.hyper)
                losses = {n.removeprefix("loss/"): x for n, x in metrics.items() if n.startswith("loss/")}
                found["losses"].append({name: float(value) for name, value in losses.items()})
        return found | {"window": self.windows[0]._asdict()}

    def turn(self, updates: int) -> dict[str, list[float]]:
        """Goes on with so many updates.

        Returns:
            "update", the milliseconds of each from handing over windows to priorities and state in hand; with
            `srl_every` the means of so many rounds in which the representation losses run once.
        """
        every = self.config.srl_every
        return {"update": [1e3 * sum(self._update() for _ in range(every)) / every for _ in range(updates)]}

    def _update(self) -> float:
        import jax

        update = self.device.update_rl if self._count % self.config.srl_every else self.device.update
        windows = [self.windows[(self._count + i) % WINDOWS] for i in range(self._seeds)]
        self._count += 1
        start = time.perf_counter()
        self.state, td_error, _ = update(self.state, windows, self.agent.hyper)
        np.asarray(td_error)
        jax.block_until_ready(self.state)
        return time.perf_counter() - start


def _jittered(tree: TrainState, seed: int) -> Any:
    """The tree with a little noise on every number."""
    import jax

    rng = np.random.default_rng(seed)

    def moved(leaf):
        return jax.numpy.asarray(leaf + rng.normal(0, JITTER, leaf.shape).astype(np.float32))

    return jax.tree.map(moved, tree)


def prepare() -> None:
    """Gives a worker the environment that a run of its preset gives itself."""
    runtime.prepare("auto", PRESETS[arguments()["preset"]]["encoder"])


if __name__ == "__main__":
    prepare()
    serve(Updates)
