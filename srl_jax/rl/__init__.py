"""The RL algorithms: `REGISTRY[name](context, **options) -> Algorithm`; rows are Rainbow less some parts."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.plugins import Registry
from srl_jax.rl.heads import QNetwork
from srl_jax.rl.losses import categorical_q_learning, categorical_target, entropy, huber, q_learning
from srl_jax.rl.losses import n_step as n_step_view
from srl_jax.specs import check_size, choices_text
from srl_jax.types import Context, Latents, Objective, Window

__all__ = ["REGISTRY", "register", "Algorithm", "normal_logits", "rainbow"]


PRIORITIES = ("cross_entropy", "kl")


class Algorithm(NamedTuple):
    """An RL algorithm: its term of the loss, how it values actions, and what it asks of replay.

    Attributes:
        objective: the loss; its metrics are `td_error` float32 [B], what priorities are made of, and
            `q_max_mean`, a scalar: the mean over the batch of the largest value of s_t.
        q_values: (head, latents [B, D], key | None) -> float32 [B, A]; without a key, without noise.
        alpha: the priority exponent; 0 where replay is uniform.
    """

    objective: Objective
    q_values: Callable
    alpha: float


def rainbow(
    context: Context,
    *,
    distributional: bool = True,
    double: bool = True,
    dueling: bool = True,
    noisy: bool = True,
    prioritized: bool = True,
    n_step: int = 3,
    atoms: int = 51,
    v_min: float = -10.0,
    v_max: float = 10.0,
    init_std: float = 0.0,
    noisy_std: float = 0.1,
    alpha: float = 0.5,
    priority: str = "cross_entropy",
    hidden: int = 512,
) -> Algorithm:
    """Rainbow (Hessel et al. 2018), each part of which can be left out alone.

    Args:
        context: the encoder below and the number of actions.
        distributional: C51 over `atoms` returns in [v_min, v_max]; otherwise Huber loss on Q values.
        double: the online network picks the action that the slow one evaluates.
        dueling: a stream of state values beside the actions' own.
        noisy: noisy linear layers, sigma starting at noisy_std / sqrt(inputs).
        prioritized: replay by priority, `|td_error| ** alpha`; otherwise uniform.
        n_step: steps of reward before bootstrapping.
        atoms, v_min, v_max: the value distribution's support, in units of (discounted) reward.
        init_std: the value distribution starts near a normal around 0 of this standard deviation, in units of
            reward, at least the distance of two atoms; 0: near uniform, as in C51. See `normal_logits`.
        noisy_std: see `srl_jax.layers.NoisyDense`.
        alpha: the priority exponent (Schaul et al. 2016).
        priority: what the priorities of a value distribution are made of: "cross_entropy" with its target,
            the loss itself, as Dopamine, dqn_zoo and the thesis have it, or "kl", the Kullback-Leibler
            divergence (Hessel et al. 2018, section 3), which leaves out the target's own entropy. Without a
            distribution they are made of the temporal-difference error.
        hidden: width of each stream's hidden layer.

    Raises:
        ValueError: where n_step is 0, hidden or atoms is out of range, v_min is not below v_max, float32 has
            no such atoms, init_std is below their distance, alpha is above 1, or priority is unknown.
    """
    if n_step < 1:
        raise ValueError("n_step must be at least 1")
    check_size("hidden", hidden)
    if distributional:
        check_size("atoms", atoms, least=2)
    if alpha > 1:
        raise ValueError("alpha must be at most 1")
    if priority not in PRIORITIES:
        raise ValueError(f"priority: {choices_text(priority, PRIORITIES)}")
    support = make_support(v_min, v_max, atoms) if distributional else None
    prior = normal_logits(support, init_std) if distributional and init_std else None
    network = QNetwork(
        context.num_actions, atoms if distributional else 1, hidden, dueling, noisy, noisy_std, prior
    )

    def init(key):
        return network.init(key, jnp.zeros((1, context.encoder.features), jnp.float32), None)["params"]

    def expected(output):  # [B, A, M] -> [B, A]
        if distributional:
            return jax.nn.softmax(output) @ support
        return output[..., 0]

    def q_values(head, latents, key=None):
        noise = None if key is None or not noisy else network.draw_noise(key, 1, context.encoder.features)[0]
        return expected(network.apply({"params": head}, latents, noise))

    def loss(head, slow_head, latents: Latents, window: Window, key):
        r_t, discount_t, offset = n_step_view(window.rewards, window.discounts, window.valid, n_step)
        a_tm1 = window.actions[:, 0]
        # The online network has one draw of noise for both observations, and so the same weights.
        online, slow = network.draw_noise(key, 2, context.encoder.features) if noisy else (None, None)
        out_tm1 = network.apply({"params": head}, latents.online(0), online)
        slow_t = network.apply({"params": slow_head}, latents.slow(offset), slow)
        slow_t = jax.lax.stop_gradient(slow_t)
        if double:
            z_t = jax.lax.stop_gradient(latents.online(offset))
            frozen = jax.lax.stop_gradient(head)
            selector_t = expected(network.apply({"params": frozen}, z_t, online))
        else:
            selector_t = expected(slow_t)
        if distributional:
            losses = jax.vmap(categorical_q_learning, (0, None, 0, 0, 0, 0, 0))(
                out_tm1, support, a_tm1, r_t, discount_t, slow_t, selector_t
            )
            td_error = losses
            if priority == "kl":  # the target's entropy says how random a return is, not how surprising
                target = jax.vmap(categorical_target, (None, 0, 0, 0, 0))(
                    support, r_t, discount_t, slow_t, selector_t
                )
                td_error = jnp.maximum(losses - jax.vmap(entropy)(target), 0.0)
        else:
            td_error = jax.vmap(q_learning)(
                out_tm1[..., 0], a_tm1, r_t, discount_t, slow_t[..., 0], selector_t
            )
            losses = huber(td_error)
        metrics = {"td_error": td_error, "q_max_mean": jnp.mean(jnp.max(expected(out_tm1), -1))}
        # Importance weights correct the RL loss alone, so it is the RL loss that multiplies them.
        return losses * window.weight, jax.lax.stop_gradient(metrics)

    return Algorithm(
        objective=Objective(init, loss, horizon=n_step),
        q_values=q_values,
        alpha=alpha if prioritized else 0.0,
    )


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


_plain = partial(rainbow, double=False, dueling=False, noisy=False, prioritized=False, n_step=1)
REGISTRY = Registry(
    "rl",
    {
        "rainbow": rainbow,
        "c51": _plain,
        "double": partial(_plain, distributional=False, double=True),
        "dqn": partial(_plain, distributional=False),
    },
)
register = REGISTRY.register
