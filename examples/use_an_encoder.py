"""A run's encoder, frozen in somebody else's flax network.

    python examples/use_an_encoder.py runs/x

A small head over the encoder learns the values that the run gives to actions, from frames of random play. The
network has no parameters but the head's. `srl_jax.load("runs/x/encoders/000100000").encode` is an encoder
that was kept on the way.
"""

import sys
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

import srl_jax
from srl_jax.run.actor import FrameStack, make_env
from srl_jax.types import Params
from srl_jax.window import stack_last


class Network(nn.Module):
    """Observations [B, H, W, S * C] -> [B, A], over an encoder that is none of its parameters."""

    encode: Callable[[jax.Array], jax.Array]
    num_actions: int

    @nn.compact
    def __call__(self, observations: jax.Array) -> jax.Array:
        return nn.Dense(self.num_actions)(nn.relu(nn.Dense(64)(self.encode(observations))))


def random_play(config: srl_jax.Config, number: int) -> jax.Array:
    """Observations of a run's game, uint8 [number, H, W, S * C]."""
    env, rng = make_env(config, "random play", 1), np.random.default_rng(0)
    seen: list[np.ndarray] = []
    stacks = FrameStack(1, config.frame_stack, env.single_observation_space.shape)
    stacks.begin(env.reset()[0])
    while len(seen) < number:
        seen.append(stacks.observations())
        frames, _, terminated, truncated, _ = env.step(rng.integers(0, env.single_action_space.n, 1))
        stacks.push(frames)
        if (over := terminated | truncated).any():
            stacks.begin(env.reset(options={"reset_mask": over})[0])
    return stack_last(jnp.concatenate(seen))


def main(run: str, updates: int = 200) -> tuple[float, float]:
    """The mean squared error of the head's values, before and after so many updates."""
    loaded = srl_jax.load(run)
    observations = random_play(loaded.config, 256)
    targets = loaded.q_values(observations)
    network, optimizer = Network(loaded.encode, targets.shape[-1]), optax.adam(1e-3)
    params = network.init(jax.random.key(0), observations)
    state = optimizer.init(params)

    @jax.jit
    def update(params: Params, state: optax.OptState, observations: jax.Array):
        def loss(params: Params):
            values: Any = network.apply(params, observations)
            return jnp.mean((values - targets) ** 2)

        value, gradient = jax.value_and_grad(loss)(params)
        steps, state = optimizer.update(gradient, state)
        return optax.apply_updates(params, steps), state, value

    errors = []
    for _ in range(updates):
        params, state, error = update(params, state, observations)
        errors.append(float(error))
    return errors[0], errors[-1]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        print("error: name a run: python examples/use_an_encoder.py runs/x", file=sys.stderr)
        sys.exit(2)
    before, after = main(sys.argv[1])
    print(f"mean squared error of the values: {before:.3g} before, {after:.3g} after")
