"""The RL algorithms: `REGISTRY[name](context, **options) -> Algorithm`; a kind of value each."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from srl_jax.plugins import Registry
from srl_jax.rl.heads import QNetwork
from srl_jax.rl.losses import n_step as n_step_view
from srl_jax.rl.values import Values, categorical, normal_logits, quantile, scalar
from srl_jax.specs import check_size, option_defaults
from srl_jax.types import Array, Context, Latents, Objective, Params, Window

__all__ = ["REGISTRY", "register", "Algorithm", "Values", "normal_logits", "q_learner", "rainbow"]


class QFunction(Protocol):
    """The type of `Algorithm.q_values`."""

    def __call__(self, head: Params, latents: Array, key: jax.Array | None = None) -> Array: ...


class Algorithm(NamedTuple):
    """An RL algorithm: its term of the loss, how it values actions, and what it asks of replay.

    Attributes:
        objective: the loss; its metrics are `td_error` float32 [B], what priorities are made of, and
            `q_max_mean`, a scalar: the mean over the batch of the largest value of s_t.
        q_values: (head, latents [B, D], key | None) -> float32 [B, A]; without a key, without noise.
        alpha: the priority exponent; 0 where replay is uniform.
    """

    objective: Objective
    q_values: QFunction
    alpha: float


def q_learner(
    context: Context,
    values: Values,
    *,
    double: bool = False,
    dueling: bool = False,
    noisy: bool = False,
    prioritized: bool = False,
    n_step: int = 1,
    noisy_std: float = 0.1,
    alpha: float = 0.5,
    hidden: int = 512,
) -> Algorithm:
    """Deep Q-learning (Mnih et al. 2015) of a kind of value, with those parts of Rainbow that are asked for.

    Args:
        context: the latents below and the number of actions.
        values: the kind of value.
        double: the online network picks the action that the slow one evaluates.
        dueling: a stream of state values beside the actions' own.
        noisy: noisy linear layers, sigma starting at noisy_std / sqrt(inputs).
        prioritized: replay by priority, `|td_error| ** alpha`; otherwise uniform.
        n_step: steps of reward before bootstrapping.
        noisy_std: see `srl_jax.layers.NoisyDense`.
        alpha: the priority exponent (Schaul et al. 2016).
        hidden: width of each stream's hidden layer.

    Raises:
        ValueError: where n_step is 0, hidden is out of range, or alpha is above 1.
    """
    if n_step < 1:
        raise ValueError("n_step must be at least 1")
    check_size("hidden", hidden)
    if alpha > 1:
        raise ValueError("alpha must be at most 1")
    network = QNetwork(context.num_actions, values.outputs, hidden, dueling, noisy, noisy_std, values.prior)

    def init(key):
        return network.init(key, jnp.zeros((1, context.features), jnp.float32), None)["params"]

    def apply(head: Params, latents: Array, noise: Array | None) -> Any:
        return network.apply({"params": head}, latents, noise)

    def q_values(head: Params, latents: Array, key: jax.Array | None = None) -> Array:
        noise = None if key is None or not noisy else network.draw_noise(key, 1, context.features)[0]
        return values.expected(apply(head, latents, noise))

    def loss(head, slow_head, latents: Latents, window: Window, key):
        n = n_step if window.n_step is None else window.n_step
        r_t, discount_t, offset = n_step_view(window.rewards, window.discounts, window.valid, n)
        a_tm1 = window.actions[:, 0]
        # The online network has one draw of noise for both observations, and so the same weights.
        online, slow = network.draw_noise(key, 2, context.features) if noisy else (None, None)
        out_tm1 = apply(head, latents.online(0), online)
        slow_t = jax.lax.stop_gradient(apply(slow_head, latents.slow(offset), slow))
        if double:
            z_t = jax.lax.stop_gradient(latents.online(offset))
            frozen = jax.lax.stop_gradient(head)
            selector_t = values.expected(apply(frozen, z_t, online))
        else:
            selector_t = values.expected(slow_t)
        losses, td_error = jax.vmap(values.loss)(out_tm1, a_tm1, r_t, discount_t, slow_t, selector_t)
        metrics = {"td_error": td_error, "q_max_mean": jnp.mean(jnp.max(values.expected(out_tm1), -1))}
        # Importance weights correct the RL loss alone, so it is the RL loss that multiplies them.
        return losses * window.weight, jax.lax.stop_gradient(metrics)

    return Algorithm(
        objective=Objective(init, loss, horizon=n_step),
        q_values=q_values,
        alpha=alpha if prioritized else 0.0,
    )


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
        context: the latents below and the number of actions.
        distributional: the values are `srl_jax.rl.values.categorical`, C51; otherwise `scalar`.
        atoms, v_min, v_max, init_std, priority: see `srl_jax.rl.values.categorical`; without a distribution
            nothing reads them, and they must keep their defaults.
        double, dueling, noisy, prioritized, n_step, noisy_std, alpha, hidden: see `q_learner`.

    Raises:
        ValueError: as `q_learner` and `categorical` do; or distributional is false and an option describes
            the distribution.
    """
    kind = partial(categorical, atoms=atoms, v_min=v_min, v_max=v_max, init_std=init_std, priority=priority)
    if not distributional:
        defaults = option_defaults(categorical)
        unread = [name for name, value in kind.keywords.items() if value != defaults[name]]
        if unread:
            raise ValueError(f"with distributional=false nothing reads {', '.join(unread)}; leave that out")
    return q_learner(
        context,
        kind() if distributional else scalar(),
        double=double,
        dueling=dueling,
        noisy=noisy,
        prioritized=prioritized,
        n_step=n_step,
        noisy_std=noisy_std,
        alpha=alpha,
        hidden=hidden,
    )


def q_learner_of(kind: Callable[..., Values], **defaults: Any) -> Callable[..., Algorithm]:
    """A row: `q_learner` of a kind of value; its options are those of both, and no others.

    Args:
        kind: options -> Values, of `srl_jax.rl.values`.
        **defaults: options of `q_learner` that the row has another default of.
    """
    context, _, *parts = inspect.signature(q_learner).parameters.values()
    own = inspect.signature(kind).parameters

    def row(context: Context, **options: Any) -> Algorithm:
        values = kind(**{name: options.pop(name) for name in own if name in options})
        return q_learner(context, values, **options)

    row.__dict__["__signature__"] = inspect.Signature([context, *parts, *own.values()])
    return partial(row, **defaults)


REGISTRY = Registry(
    "rl",
    {
        "rainbow": rainbow,
        "c51": q_learner_of(categorical),
        "qr_dqn": q_learner_of(quantile),
        "double": q_learner_of(scalar, double=True),
        "dqn": q_learner_of(scalar),
    },
)
register = REGISTRY.register
