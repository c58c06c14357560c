"""Reinforcement-learning losses, each for one example: `jax.vmap` them over a batch.

They take arrays and give arrays, know nothing of networks, replay or `done`, and can be imported by another
project. A time index is `_tm1` for s_t and `_t` for the state bootstrapped from; `slow` is a lagged copy.
"""

import chex
import jax
import jax.numpy as jnp

from srl_jax.types import Array


def q_learning(
    q_tm1: Array, a_tm1: Array, r_t: Array, discount_t: Array, q_slow_t: Array, q_selector_t: Array
) -> Array:
    """The temporal-difference error of (double) Q-learning.

    `r + discount * q_slow[argmax q_selector] - q_tm1[a]`. With the slow network's own values as selector
    it is the target of DQN (Mnih et al. 2015); with the online network's, that of double DQN (van Hasselt
    et al. 2016, equation 4).

    Args:
        q_tm1: float32 [A], online values of s_t.
        a_tm1: int32 [], the action taken there.
        r_t: float32 [], the (n-step) return up to the state bootstrapped from.
        discount_t: float32 [], that state's discount; 0 where terminal.
        q_slow_t: float32 [A], slow values of that state.
        q_selector_t: float32 [A], the values whose greedy action is evaluated.

    Returns:
        float32 [], in units of reward. The gradient flows into q_tm1 alone.
    """
    chex.assert_rank([q_tm1, a_tm1, r_t, discount_t, q_slow_t, q_selector_t], [1, 0, 0, 0, 1, 1])
    chex.assert_type([q_tm1, a_tm1], [float, int])
    target = jax.lax.stop_gradient(r_t + discount_t * q_slow_t[jnp.argmax(q_selector_t)])
    return target - q_tm1[a_tm1]


def huber(td_error: Array, delta: float = 1.0) -> jax.Array:
    """The Huber loss of a temporal-difference error: quadratic within delta, linear beyond (any shape)."""
    size = jnp.abs(td_error)
    quadratic = jnp.minimum(size, delta)
    return 0.5 * quadratic**2 + delta * (size - quadratic)


def categorical_q_learning(
    q_logits_tm1: Array,
    atoms: Array,
    a_tm1: Array,
    r_t: Array,
    discount_t: Array,
    q_logits_slow_t: Array,
    q_selector_t: Array,
) -> jax.Array:
    """The cross-entropy of categorical (double) Q-learning, C51.

    The slow distribution of the selected action is shifted and scaled by the return and the discount,
    projected on the atoms, and compared with the online distribution of the action taken (Bellemare et al.
    2017, algorithm 1; with the online network as selector, Rainbow's: Hessel et al. 2018, section 3).

    Args:
        q_logits_tm1: float32 [A, M], online logits of s_t.
        atoms: float32 [M], evenly spaced and ascending returns.
        a_tm1: int32 [], the action taken in s_t.
        r_t: float32 [], the (n-step) return up to the state bootstrapped from.
        discount_t: float32 [], that state's discount; 0 where terminal.
        q_logits_slow_t: float32 [A, M], slow logits of that state.
        q_selector_t: float32 [A], the expected values whose greedy action is evaluated.

    Returns:
        float32 [], in nats. The gradient flows into q_logits_tm1 alone.
    """
    chex.assert_rank(
        [q_logits_tm1, atoms, a_tm1, r_t, discount_t, q_logits_slow_t, q_selector_t],
        [2, 1, 0, 0, 0, 2, 1],
    )
    chex.assert_type([q_logits_tm1, a_tm1], [float, int])
    target = categorical_target(atoms, r_t, discount_t, q_logits_slow_t, q_selector_t)
    return -jnp.sum(target * jax.nn.log_softmax(q_logits_tm1[a_tm1]))


def categorical_target(
    atoms: Array, r_t: Array, discount_t: Array, q_logits_slow_t: Array, q_selector_t: Array
) -> jax.Array:
    """What `categorical_q_learning` compares with; arguments as there. float32 [M], no gradient."""
    probs_t = jax.nn.softmax(q_logits_slow_t[jnp.argmax(q_selector_t)])
    target = categorical_projection(r_t + discount_t * atoms, probs_t, atoms)
    return jax.lax.stop_gradient(target)


def quantile_q_learning(
    q_quantiles_tm1: Array,
    a_tm1: Array,
    r_t: Array,
    discount_t: Array,
    q_quantiles_slow_t: Array,
    q_selector_t: Array,
    kappa: float = 1.0,
    taus: Array | None = None,
) -> jax.Array:
    """The quantile Huber loss of quantile (double) Q-learning: QR-DQN, and IQN where the taus are drawn.

    Output i is the online estimate of the return's quantile at tau_i. Each is compared with each of the slow
    quantiles of the selected action, scaled by the discount and shifted by the return (Dabney et al. 2018,
    equations 9 and 10, algorithm 1; Dabney et al. 2018b, equation 3).

    Args:
        q_quantiles_tm1: float32 [A, M], online quantiles of s_t, in units of reward; in any order.
        a_tm1: int32 [], the action taken in s_t.
        r_t: float32 [], the (n-step) return up to the state bootstrapped from.
        discount_t: float32 [], that state's discount; 0 where terminal.
        q_quantiles_slow_t: float32 [A, L], slow quantiles of that state.
        q_selector_t: float32 [A], the expected values whose greedy action is evaluated.
        kappa: where the Huber loss becomes linear, above 0, in units of reward.
        taus: float32 [M] in [0, 1], the online quantiles' shares of probability; None for the midpoints of M
            equal shares, (i + 0.5) / M.

    Returns:
        float32 [], a sum over the M online quantiles and a mean over the L slow ones. The gradient flows into
        q_quantiles_tm1 alone.
    """
    chex.assert_rank(
        [q_quantiles_tm1, a_tm1, r_t, discount_t, q_quantiles_slow_t, q_selector_t], [2, 0, 0, 0, 2, 1]
    )
    chex.assert_type([q_quantiles_tm1, a_tm1], [float, int])
    target = jax.lax.stop_gradient(r_t + discount_t * q_quantiles_slow_t[jnp.argmax(q_selector_t)])
    quantiles = q_quantiles_tm1[a_tm1]
    error = target[None, :] - quantiles[:, None]
    taus = midpoints(len(quantiles)) if taus is None else taus
    weight = jnp.abs(taus[:, None] - (error < 0))
    return jnp.sum(jnp.mean(weight * huber(error, kappa), 1))


def midpoints(number: int) -> jax.Array:
    """The midpoints of equal shares of probability, `(i + 0.5) / number`: float32 [number]."""
    return (jnp.arange(number, dtype=jnp.float32) + 0.5) / number


def munchausen_return(
    r_t: Array,
    discount_t: Array,
    q_slow_tm1: Array,
    a_tm1: Array,
    policy_t: Array,
    alpha: float = 0.9,
    tau: float = 0.03,
    clip: float = -1.0,
) -> Array:
    """The return with what Munchausen Q-learning adds to it (Vieillard et al. 2020, section 2).

    `r + alpha * clip(tau log pi(a | s_t), clip, 0) + discount * tau * H(pi(. | s_{t+n}))`, where pi is the
    softmax of q / tau. With it, and the average of the slow values under pi in place of the largest one, the
    target is the paper's. The bonus is that of the action in s_t alone, however large n is.

    Args:
        r_t: float32 [], the (n-step) return up to the state bootstrapped from.
        discount_t: float32 [], that state's discount; 0 where terminal.
        q_slow_tm1: float32 [A], slow values of s_t.
        a_tm1: int32 [], the action taken in s_t.
        policy_t: float32 [A], pi in the state bootstrapped from, by `soft_policy`.
        alpha: the share of the bonus that counts.
        tau: the temperature, above 0, in units of reward.
        clip: the least bonus, at most 0, in units of reward.

    Returns:
        float32 []. No gradient.
    """
    chex.assert_rank([r_t, discount_t, q_slow_tm1, a_tm1, policy_t], [0, 0, 1, 0, 1])
    bonus = jnp.clip(tau * jax.nn.log_softmax(q_slow_tm1 / tau)[a_tm1], clip, 0.0)
    return jax.lax.stop_gradient(r_t + alpha * bonus + discount_t * tau * entropy(policy_t))


def soft_policy(q: Array, tau: float) -> jax.Array:
    """The softmax of q / tau, float32 [..., A] -> [..., A]; tau in units of reward."""
    return jax.nn.softmax(q / tau)


def entropy(probs: Array) -> jax.Array:
    """The entropy of a distribution, float32 [M] -> [], in nats; `0 log 0` is 0."""
    return -jnp.sum(probs * jnp.log(jnp.maximum(probs, 1e-30)))


def categorical_projection(support: Array, probs: Array, atoms: Array) -> jax.Array:
    """Moves a distribution onto other atoms, each mass split between its two neighbours by distance.

    Args:
        support: float32 [L], where the masses are; beyond the atoms they go to the nearest end.
        probs: float32 [L], the masses.
        atoms: float32 [M], evenly spaced and ascending.

    Returns:
        float32 [M], of the same sum as probs (Bellemare et al. 2017, equation 7).
    """
    chex.assert_rank([support, probs, atoms], 1)
    spacing = (atoms[-1] - atoms[0]) / (atoms.shape[0] - 1)
    support = jnp.clip(support, atoms[0], atoms[-1])
    distance = jnp.abs(support[None, :] - atoms[:, None]) / spacing
    return jnp.clip(1.0 - distance, 0.0, 1.0) @ probs


def n_step(
    rewards: Array, discounts: Array, valid: Array, n: int | Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The n-step view of a window: what the return is, and where and with what discount to bootstrap.

    Sums rewards until n steps are done, a discount is 0 (a terminal state) or the episode is over. After a
    truncation it bootstraps from the episode's final observation, fewer than n steps ahead (Sutton & Barto
    2018, equation 7.1; Pardo et al. 2018 on time limits).

    Args:
        rewards, discounts, valid: float32 [..., K], as in `srl_jax.types.Window`, with K >= n.
        n: steps; int32 [...] where they are a number of each window, known when it runs.

    Returns:
        r_t: float32 [...], the discounted sum of rewards.
        discount_t: float32 [...], the product of the discounts; 0 where a terminal state was met.
        offset: int32 [...], where to bootstrap from, 1..n steps after s_t.

    Raises:
        ValueError: n, an int, is not in 1..K.
    """
    steps = rewards.shape[-1]
    if not isinstance(n, int):  # what lies n steps ahead or more counts as behind the episode's end
        valid, n = valid * (jnp.arange(steps) < n[..., None]), steps
    elif not 1 <= n <= steps:
        raise ValueError(f"n must be in 1..{steps}, the window's steps, not {n}")
    r_t = jnp.zeros(rewards.shape[:-1], rewards.dtype)
    discount_t = jnp.ones(rewards.shape[:-1], discounts.dtype)
    for k in range(n):
        r_t = r_t + valid[..., k] * discount_t * rewards[..., k]
        discount_t = discount_t * jnp.where(valid[..., k] > 0, discounts[..., k], 1.0)
    return r_t, discount_t, jnp.sum(valid[..., :n], -1).astype(jnp.int32)


def n_step_end_unnoticed(
    rewards: Array, discounts: Array, valid: Array, n: int | Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The n-step view as the buffer of the code of Nikishin et al. (2022) has it; a defect.

    It is `n_step`, but it is not noticed that the last of the n steps ended in a terminal state.

    Args:
        rewards, discounts, valid: see `n_step`.
        n: steps, at least 2.
    """
    before = jnp.concatenate([discounts[..., :1], discounts[..., :-1]], -1)
    last = jnp.arange(discounts.shape[-1]) == jnp.asarray(n)[..., None] - 1
    unnoticed = jnp.where(last, before, discounts)
    return n_step(rewards, unnoticed, valid, n)


def n_step_one_early(
    rewards: Array, discounts: Array, valid: Array, n: int | Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The n-step view as the buffers of Dopamine's Atari 100k agents and of BBF have it; a defect.

    It is `n_step_end_unnoticed`, and the state bootstrapped from is one step earlier: offset is 0..n - 1.
    """
    r_t, discount_t, offset = n_step_end_unnoticed(rewards, discounts, valid, n)
    return r_t, discount_t, offset - 1


def n_step_one_reward(
    rewards: Array, discounts: Array, valid: Array, n: int | Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The n-step view of SPR in Dopamine's Atari 100k lab: `n_step_one_early` of the first reward alone."""
    _, discount_t, offset = n_step_one_early(rewards, discounts, valid, n)
    return jnp.asarray(rewards[..., 0]), discount_t, offset
