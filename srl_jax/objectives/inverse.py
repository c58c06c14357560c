"""The inverse model: which action led from one latent to the next."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import Dense
from srl_jax.objectives.networks import masked_mean
from srl_jax.specs import check_size
from srl_jax.types import Array, Context, Latents, Objective, Window


class InverseHead(nn.Module):
    """Linear, ReLU, linear on two latents side by side: [B, D], [B, D] -> logits [B, A]."""

    num_actions: int
    hidden: int

    @nn.compact
    def __call__(self, z_tm1: Array, z_t: Array) -> Array:
        x = jnp.concatenate([z_tm1, z_t], -1)
        return Dense(self.num_actions)(nn.relu(Dense(self.hidden)(x)))


def action_cross_entropy(logits: Array, a_tm1: Array) -> jax.Array:
    """The cross-entropy of the action taken: float32 [A], int32 [] -> float32 [], in nats."""
    return -jax.nn.log_softmax(logits)[a_tm1]


def inverse(context: Context, *, weight: float = 1.0, hidden: int = 256, steps: int = 1) -> Objective:
    """Predicts a_t from z_t and z_{t+steps} (thesis, section 3.2.3; Pathak et al. 2017, equation 2).

    The gradient flows into the head and, through both latents, into the encoder.

    Args:
        hidden: width of the head's hidden layer.
        steps: how many steps apart the latents are; rows whose episode ends between them count 0.
    """
    check_size("hidden", hidden)
    check_size("steps", steps)
    network = InverseHead(context.num_actions, hidden)
    z = jnp.zeros((1, context.features))

    def loss(head, slow_head, latents: Latents, window: Window, key):
        logits: Any = network.apply({"params": head}, latents.online(0), latents.online(steps))
        losses = jax.vmap(action_cross_entropy)(logits, window.actions[:, 0])
        valid = window.valid[:, steps - 1]
        correct = masked_mean(jnp.argmax(logits, -1) == window.actions[:, 0], valid)
        return valid * losses, {"accuracy": jax.lax.stop_gradient(correct)}

    return Objective(lambda key: network.init(key, z, z)["params"], loss, weight, horizon=steps)
