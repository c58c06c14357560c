"""The kinds of value of an action: a number, a distribution over fixed returns, or quantiles of the return.

A kind is a function whose keyword arguments are its options, and gives a `Values`: what the head's outputs
mean and how they are learnt. Everything else of an algorithm is the same for all kinds.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.rl.losses import (
    categorical_q_learning,
    categorical_target,
    entropy,
    huber,
    q_learning,
    quantile_q_learning,
)
from srl_jax.specs import check_size, choices_text, needs
from srl_jax.types import Array

PRIORITIES = ("cross_entropy", "kl", "batch_mean")


class Taus(NamedTuple):
    """How many shares of probability, taus, a head is asked for; none where its outputs do not depend on any.

    Attributes:
        online: M of the state that is learnt about.
        target: of the state bootstrapped from.
        act: where the expected returns of actions are compared.
        cosines: how many the head embeds each share by.
    """

    online: int = 0
    target: int = 0
    act: int = 0
    cosines: int = 0


class Values(NamedTuple):
    """A kind of value, as pure functions.

    Attributes:
        outputs: M, the head's numbers for each action; of each share of probability, where there are taus.
        expected: float32 [..., M] -> float32 [...], the expected return, which a greedy policy compares.
        loss: of one example, (out_tm1 [A, M], a_tm1 [], r_t [], discount_t [], out_slow_t [A', M'],
            q_selector_t [A'], taus) -> (loss [], td_error []), float32; the arguments are those of
            `srl_jax.rl.losses`, `out` the head's numbers, taus those of out_tm1, float32 [M], or None. The
            gradient of the loss flows into out_tm1 alone; td_error is what priorities are made of.
        average: (out [A, M], probs [A]) -> float32 [M], the head's numbers of what a policy is worth that
            takes the actions with these probabilities.
        prior: M constants that the head's outputs of every action are added to; None: none.
        taus: where there are some, they go into the head, drawn anew for each example, and its M numbers of
            an action are as many quantiles as it is asked for.
        batch_mean: whether the batch's first example alone has its priority set, to the mean of all.
    """

    outputs: int
    expected: Callable[[Array], Array]
    loss: Callable[..., tuple[jax.Array, jax.Array]]
    average: Callable[[Array, Array], Array]
    prior: tuple[float, ...] | None = None
    taus: Taus = Taus()
    batch_mean: bool = False


def scalar() -> Values:
    """The expected return itself, by the Huber loss of its temporal-difference error (Mnih et al. 2015).

    Priorities are made of the temporal-difference error.
    """

    def expected(outputs: Array) -> Array:
        return outputs[..., 0]

    def loss(out_tm1, a_tm1, r_t, discount_t, out_slow_t, q_selector_t, taus):
        td_error = q_learning(expected(out_tm1), a_tm1, r_t, discount_t, expected(out_slow_t), q_selector_t)
        return huber(td_error), td_error

    return Values(1, expected, loss, average_outputs)


@needs(priority="prioritized=true,alpha!=0")
def categorical(
    *,
    atoms: int = 51,
    v_min: float = -10.0,
    v_max: float = 10.0,
    init_std: float = 0.0,
    priority: str = "cross_entropy",
) -> Values:
    """Probabilities of fixed returns, C51 (Bellemare et al. 2017); the head's outputs are their logits.

    Args:
        atoms, v_min, v_max: the distribution's support, in units of (discounted) reward.
        init_std: the distribution starts near a normal around 0 of this standard deviation, in units of
            reward, at least the distance of two atoms; 0: near uniform, as in C51. See `normal_logits`.
        priority: what priorities are made of: "cross_entropy" with the target, the loss itself, as Dopamine,
            dqn_zoo and the thesis have it, or "kl", the Kullback-Leibler divergence (Hessel et al. 2018,
            section 3), which leaves out the target's own entropy. "batch_mean": the mean of the batch's
            cross-entropies, for the first of its examples alone, the others keeping theirs: a defect of BBF's
            code, where priorities are set so (docs/deviations.md).

    Raises:
        ValueError: where atoms is out of range, v_min is not below v_max, float32 has no such atoms, init_std
            is below their distance, or priority is unknown.
    """
    check_size("atoms", atoms, least=2)
    if priority not in PRIORITIES:
        raise ValueError(f"priority: {choices_text(priority, PRIORITIES)}")
    support = make_support(v_min, v_max, atoms)

    def expected(outputs: Array) -> Array:
        return jax.nn.softmax(outputs) @ support

    def loss(out_tm1, a_tm1, r_t, discount_t, out_slow_t, q_selector_t, taus):
        bootstrap = r_t, discount_t, out_slow_t, q_selector_t
        cross_entropy = categorical_q_learning(out_tm1, support, a_tm1, *bootstrap)
        if priority != "kl":
            return cross_entropy, cross_entropy
        # The target's entropy says how random a return is, not how surprising.
        target = categorical_target(support, *bootstrap)
        return cross_entropy, jnp.maximum(cross_entropy - entropy(target), 0.0)

    def average(outputs: Array, probs: Array) -> Array:
        return jnp.log(jnp.maximum(probs @ jax.nn.softmax(outputs), 1e-30))

    prior = normal_logits(support, init_std) if init_std else None
    return Values(atoms, expected, loss, average, prior, batch_mean=priority == "batch_mean")


def quantile(*, quantiles: int = 200) -> Values:
    """The return at the midpoints of equal shares of probability, QR-DQN (Dabney et al. 2018).

    Priorities are made of the temporal-difference error of the expected returns.

    Args:
        quantiles: M; the paper has 200.

    Raises:
        ValueError: where quantiles is out of range.
    """
    check_size("quantiles", quantiles)
    return Values(quantiles, mean_quantile, quantile_loss, average_outputs)


def implicit_quantile(
    *, quantiles: int = 64, target_quantiles: int = 64, act_quantiles: int = 32, cosines: int = 64
) -> Values:
    """The return at shares of probability that are drawn and go into the head, IQN (Dabney et al. 2018b).

    The shares, taus, are uniform on [0, 1], drawn anew for each example; an evaluation acts with the
    midpoints of equal shares. Priorities are made of the temporal-difference error of the expected returns.

    Args:
        quantiles: N, taus of each state that is learnt about (equation 3).
        target_quantiles: N', taus of each state bootstrapped from.
        act_quantiles: K, taus over whose quantiles an action's expected return is the mean (equation 2).
        cosines: n of the embedding of a tau (equation 4).

    Raises:
        ValueError: where an option is out of range.
    """
    taus = Taus(quantiles, target_quantiles, act_quantiles, cosines)
    for name, value in zip(("quantiles", "target_quantiles", "act_quantiles", "cosines"), taus, strict=True):
        check_size(name, value)
    return Values(1, mean_quantile, quantile_loss, average_outputs, taus=taus)


def mean_quantile(outputs: Array) -> Array:
    """`Values.expected` of quantiles."""
    return jnp.mean(outputs, -1)


def quantile_loss(out_tm1, a_tm1, r_t, discount_t, out_slow_t, q_selector_t, taus):
    """`Values.loss` of quantiles."""
    bootstrap = r_t, discount_t, mean_quantile(out_slow_t), q_selector_t
    td_error = q_learning(mean_quantile(out_tm1), a_tm1, *bootstrap)
    losses = quantile_q_learning(out_tm1, a_tm1, r_t, discount_t, out_slow_t, q_selector_t, taus=taus)
    return losses, td_error


def average_outputs(outputs: Array, probs: Array) -> Array:
    """`Values.average` where the head's numbers are returns themselves."""
    return probs @ outputs


def make_support(v_min: float, v_max: float, atoms: int) -> np.ndarray:
    """The atoms of a value distribution: evenly spaced, float32 [atoms].

    Raises:
        ValueError: v_min is not below v_max, or float32 cannot hold such atoms, evenly spaced to a hundredth.
    """
    if v_min >= v_max:
        raise ValueError(f"v_min must be below v_max, not {v_min} and {v_max}")
    support = np.linspace(v_min, v_max, atoms, dtype=np.float32)
    spacing = (v_max - v_min) / (atoms - 1)
    with np.errstate(all="ignore"):
        uneven = np.abs(np.diff(support) / np.float32(spacing) - 1).max()
        width = support[-1] - support[0]
    if not (np.isfinite(width) and np.float32(spacing) > 0 and uneven < 0.01):
        raise ValueError(f"float32 has no {atoms} evenly spaced atoms from {v_min} to {v_max}")
    return support


def normal_logits(atoms: np.ndarray, std: float) -> tuple[float, ...]:
    """The logits of a normal distribution over atoms, around 0 (or the atom nearest to it).

    A categorical value distribution starts uniform on [v_min, v_max] in C51 (Bellemare et al. 2017). Where
    nothing but bootstrapping narrows it, as in games without short episodes, each copy to the slow network
    narrows it by discount ** n alone: with the thesis' settings (0.97 every 500 updates) its standard
    deviation is still 3.2 after 10,000 updates, while the values of actions differ by hundredths.

    The logits are constants that the network's own are added to. Where std were less than the distance of
    two atoms they would be hundreds, and nothing would be learnt.

    Args:
        atoms: float32 [M], ascending returns, evenly spaced.
        std: standard deviation, in units of reward.

    Returns:
        M logits, the largest 0.

    Raises:
        ValueError: std is less than the distance of two atoms.
    """
    spacing = (float(atoms[-1]) - float(atoms[0])) / (len(atoms) - 1)
    if not std >= spacing * (1 - 1e-6):
        raise ValueError(f"init_std must be 0 or at least {spacing:g}, the distance of two atoms")
    centre = np.clip(0.0, atoms[0], atoms[-1])
    return tuple((-0.5 * ((atoms.astype(np.float64) - centre) / std) ** 2).tolist())
