"""What a transition brings: its reward, and whether it ends the episode."""

import jax
import jax.numpy as jnp

from srl_jax.objectives.networks import MLP, functions, join, one_hot
from srl_jax.specs import check_choice, check_size
from srl_jax.types import Array, Context, Latents, Objective, Params, Window

REWARD_LOSSES = ("two_hot", "squared")
TERMINAL_LOSSES = ("cross_entropy", "squared")
BINS = 65
LARGEST = 10.0
"""The outermost bins, in units of symlog: rewards up to exp(10) - 1 in size can be told apart."""


def symlog(x: Array) -> jax.Array:
    """`sign(x) log(1 + |x|)`, of any shape (Hafner et al. 2023, equation 1)."""
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def two_hot(x: Array, bins: Array) -> jax.Array:
    """Weights of the two neighbouring bins whose mean is x: float32 [], increasing [M] -> float32 [M].

    Hafner et al. (2023), equation 9. What lies outside the bins goes to the outermost one.
    """
    x = jnp.clip(x, bins[0], bins[-1])
    above = jnp.clip(jnp.searchsorted(bins, x, side="right"), 1, len(bins) - 1)
    low, high = bins[above - 1], bins[above]
    share = (x - low) / (high - low)
    return jnp.zeros(len(bins), jnp.float32).at[above - 1].set(1 - share).at[above].set(share)


def two_hot_cross_entropy(logits: Array, reward: Array, bins: Array) -> jax.Array:
    """The cross-entropy with the two-hot symlog of a reward: [M], [], [M] -> float32 [], in nats."""
    return -jnp.sum(two_hot(symlog(reward), bins) * jax.nn.log_softmax(logits))


def binary_cross_entropy(logit: Array, target: Array) -> jax.Array:
    """`-log p(target)` with p(1) = sigmoid(logit): float32 [], 0 or 1 [] -> float32 [], in nats."""
    return jax.nn.softplus(logit) - target * logit


def reward(context: Context, *, weight: float = 1.0, hidden: int = 256, loss: str = "two_hot") -> Objective:
    """Predicts r_{t+1}, as learnt from, from z_t and a_t (Fujimoto et al. 2025, MR.Q, section 4).

    The gradient flows into the head and, through z_t, into the encoder.

    Args:
        hidden: width of the head's hidden layer; 0 for a linear head.
        loss: "two_hot", the cross-entropy over 65 bins of symlog in [-10, 10], or "squared", in units of
            reward squared.
    """
    check_size("hidden", hidden, least=0)
    check_choice("loss", loss, REWARD_LOSSES)
    outputs = BINS if loss == "two_hot" else 1
    init, apply = functions(MLP(hidden, outputs), context.features + context.num_actions)
    bins = jnp.linspace(-LARGEST, LARGEST, BINS, dtype=jnp.float32)

    def losses_of(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        action = one_hot(window.actions[:, 0], context.num_actions)
        output, wanted = apply(head, join(latents.online(0), action)), window.rewards[:, 0]
        if loss == "squared":
            losses = (output[:, 0] - wanted) ** 2
        else:
            losses = jax.vmap(two_hot_cross_entropy, (0, 0, None))(output, wanted, bins)
        return window.valid[:, 0] * losses, {}

    return Objective(init, losses_of, weight, horizon=1)


def terminal(
    context: Context, *, weight: float = 1.0, hidden: int = 256, loss: str = "cross_entropy"
) -> Objective:
    """Predicts from z_t and a_t whether s_{t+1} is terminal (Fujimoto et al. 2025, MR.Q, section 4).

    Terminal is what has a discount of 0. The gradient flows into the head and, through z_t, into the encoder.

    Args:
        hidden: width of the head's hidden layer; 0 for a linear head.
        loss: "cross_entropy" of a logit, or "squared" of the output itself, as in MR.Q.
    """
    check_size("hidden", hidden, least=0)
    check_choice("loss", loss, TERMINAL_LOSSES)
    init, apply = functions(MLP(hidden, 1), context.features + context.num_actions)

    def losses_of(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        action = one_hot(window.actions[:, 0], context.num_actions)
        output = apply(head, join(latents.online(0), action))[:, 0]
        ends = (window.discounts[:, 0] == 0).astype(jnp.float32)
        losses = (output - ends) ** 2 if loss == "squared" else jax.vmap(binary_cross_entropy)(output, ends)
        return window.valid[:, 0] * losses, {}

    return Objective(init, losses_of, weight, horizon=1)
