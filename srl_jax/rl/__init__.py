"""The RL algorithms: `REGISTRY[name](context, **options) -> Algorithm`; a kind of value each."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax

from srl_jax.augment import make_view
from srl_jax.layers import INITIALISERS
from srl_jax.learning.update import ema, periodic
from srl_jax.plugins import Registry
from srl_jax.rl.heads import QNetwork
from srl_jax.rl.learner import Munchausen, QLearner
from srl_jax.rl.losses import n_step as n_step_view
from srl_jax.rl.losses import n_step_end_unnoticed, n_step_one_early, n_step_one_reward
from srl_jax.rl.values import Values, categorical, implicit_quantile, normal_logits, quantile, scalar
from srl_jax.specs import check_choice, check_size, needs, needs_of, option_defaults
from srl_jax.types import Array, Context, Layer, Objective, Params

__all__ = ["REGISTRY", "register", "Algorithm", "Values", "normal_logits", "q_learner", "rainbow"]

SLOW, ACTORS = ("periodic", "ema", "none"), ("online", "slow")
N_STEP_VIEWS = {
    "s_t+n": n_step_view,
    "s_t+n-1": n_step_one_early,
    "one_reward": n_step_one_reward,
    "end_unnoticed": n_step_end_unnoticed,
}
"""What a target is made of, by name; all but the first are defects of public codes."""

Rule: TypeAlias = Callable[[Params, Params, Array], Params]
"""How a slow copy follows, as of `srl_jax.types.Objective.slow`."""


class QFunction(Protocol):
    """The type of `Algorithm.q_values`."""

    def __call__(self, head: Params, latents: Array, key: jax.Array | None = None) -> Array: ...


class Algorithm(NamedTuple):
    """An RL algorithm: its term of the loss, how it values actions, and what it asks of replay.

    Attributes:
        objective: the loss; its metrics are `td_error` float32 [B], what priorities are made of (or [k], of
            the first k examples, where the others keep theirs), and `q_max_mean`, a scalar: the mean over the
            batch of the largest value of s_t.
        q_values: (head, latents [B, D], key | None) -> float32 [B, A]; without a key, without noise.
        alpha: the priority exponent; 0 where replay is uniform.
        slow: --slow_update_every -> the rule by which the slow copies of head and encoder follow; None where
            there are none.
        acts_slow: whether the slow copies act, in training and in evaluations.
        first_layer: of the head, for objectives that compute with it; None where there is none over latents.
    """

    objective: Objective
    q_values: QFunction
    alpha: float
    slow: Callable[[int], Rule | None] = periodic
    acts_slow: bool = False
    first_layer: Layer | None = None


@needs(
    shared_hidden="dueling=true",
    noisy_std="noisy=true",
    prioritized="alpha!=0",
    alpha="prioritized=true",
    munchausen_alpha="munchausen=true",
    munchausen_tau="munchausen=true",
    munchausen_clip="munchausen=true",
    copies="view!=none",
    target_copies="view!=none",
    slow_tau="slow=ema",
)
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
    shared_hidden: bool = False,
    init: str = "pytorch",
    munchausen: bool = False,
    munchausen_alpha: float = 0.9,
    munchausen_tau: float = 0.03,
    munchausen_clip: float = -1.0,
    view: str = "none",
    copies: int = 1,
    target_copies: int = 1,
    slow: str = "periodic",
    slow_tau: float = 0.995,
    act_with: str = "online",
    target: str = "s_t+n",
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
        shared_hidden: the streams of a dueling network have one hidden layer, as Dopamine's have.
        init: how the head's layers start, the means of noisy ones, too; `srl_jax.layers.INITIALISERS`.
        munchausen: the reward has a share of the action's log-probability under the softmax policy added,
            and the target is of that policy (Vieillard et al. 2020); see `munchausen_return`.
        munchausen_alpha, munchausen_tau, munchausen_clip: the share, the temperature, and the least bonus.
        view: what s_t and the state bootstrapped from are seen through, each by draws of its own; see
            `srl_jax.augment.make_view`. "none": as they are.
        copies: K, the loss is a mean over so many views of s_t (Kostrikov et al. 2020, DrQ, section 3);
            without a view there is one.
        target_copies: M, the target is a mean over so many views of the state bootstrapped from, likewise.
        slow: how the slow copies of encoder and head follow: "periodic", replaced after each
            --slow_update_every updates; "ema", a moving average; "none", the online ones without gradient
            take their place.
        slow_tau: of the moving average, the share that stays in an update, see `srl_jax.learning.update.ema`.
        act_with: whether the "online" or the "slow" network acts, in training and in evaluations.
        target: what it is made of, `N_STEP_VIEWS`: n rewards and s_{t+n}, or a defect of public codes, see
            docs/deviations.md.

    Raises:
        ValueError: where a number is out of range, a choice is unknown, or two options do not go together.
    """
    if n_step < 1:
        raise ValueError("n_step must be at least 1")
    check_size("hidden", hidden)
    check_size("copies", copies)
    check_size("target_copies", target_copies)
    if alpha > 1:
        raise ValueError("alpha must be at most 1")
    for option, value, choices in (
        ("slow", slow, SLOW), ("act_with", act_with, ACTORS), ("target", target, N_STEP_VIEWS),
        ("init", init, INITIALISERS),
    ):  # fmt: skip
        check_choice(option, value, choices)
    if munchausen and double:
        raise ValueError("munchausen=true averages over actions and picks none; it needs double=false")
    if munchausen and not (munchausen_tau > 0 and munchausen_clip <= 0):
        raise ValueError("munchausen_tau must be above 0 and munchausen_clip at most 0")
    if act_with == "slow" and slow == "none":
        raise ValueError("act_with=slow needs a slow network; slow=none has none")
    if target != "s_t+n" and n_step < 2:
        raise ValueError(f"target={target} needs n_step of at least 2")
    if slow == "ema":
        ema(slow_tau)  # raises where it is out of range
    rules: dict[str, Callable[[int], Rule | None]] = {
        "periodic": periodic,
        "ema": lambda every: ema(slow_tau),
        "none": lambda every: None,
    }
    learner = QLearner(
        values=values,
        network=QNetwork(
            context.num_actions, values.outputs, hidden, dueling, noisy, noisy_std, values.prior,
            shared_hidden and dueling, values.taus.cosines, init,
        ),
        features=context.features,
        step_view=N_STEP_VIEWS[target],
        n_step=n_step,
        double=double,
        munchausen=Munchausen(munchausen_alpha, munchausen_tau, munchausen_clip) if munchausen else None,
        view=None if view == "none" else make_view(view),
        copies=1 if view == "none" else copies,
        target_copies=1 if view == "none" else target_copies,
        lagged=slow != "none",
    )  # fmt: skip
    return Algorithm(
        objective=Objective(learner.init, learner.loss, horizon=n_step, own_views=learner.view is not None),
        q_values=learner.q_values,
        alpha=alpha if prioritized else 0.0,
        slow=rules[slow],
        acts_slow=act_with == "slow",
        first_layer=learner.network.first_layer(),
    )


@needs(**dict.fromkeys(("atoms", "v_min", "v_max", "init_std", "priority"), "distributional=true"))
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
    **options: Any,
) -> Algorithm:
    """Rainbow (Hessel et al. 2018), each part of which can be left out alone.

    Args:
        context: the latents below and the number of actions.
        distributional: the values are `srl_jax.rl.values.categorical`, C51; otherwise `scalar`.
        atoms, v_min, v_max, init_std, priority: see `srl_jax.rl.values.categorical`.
        double, dueling, noisy, prioritized, n_step, noisy_std, alpha, hidden, **options: see `q_learner`.

    Raises:
        ValueError: as `q_learner` and `categorical` do.
    """
    kind = partial(categorical, atoms=atoms, v_min=v_min, v_max=v_max, init_std=init_std, priority=priority)
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
        **options,
    )


def with_options_of(row: Callable[..., Algorithm], *functions: Callable) -> Callable[..., Algorithm]:
    """The row, whose signature says that its options are those of these functions, as the first has them.

    An option needs all that any of the functions says it does.
    """
    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    options: dict[str, inspect.Parameter] = {}
    merged: dict[str, str] = {}
    for function in functions:
        for name, need in needs_of(function).items():
            merged[name] = f"{merged[name]},{need}" if name in merged else need
        for name, parameter in inspect.signature(function).parameters.items():
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
                options.setdefault(name, parameter)
    row.__dict__["__signature__"] = inspect.Signature([context, *options.values()])
    return needs(**merged)(row)


def q_learner_of(kind: Callable[..., Values], **defaults: Any) -> Callable[..., Algorithm]:
    """A row: `q_learner` of a kind of value; its options are those of both, and no others.

    Args:
        kind: options -> Values, of `srl_jax.rl.values`.
        **defaults: options of `q_learner` that the row has another default of.
    """
    own = option_defaults(kind)

    def row(context: Context, **options: Any) -> Algorithm:
        values = kind(**{name: options.pop(name) for name in own if name in options})
        return q_learner(context, values, **options)

    return partial(with_options_of(row, q_learner, kind), **defaults)


with_options_of(rainbow, rainbow, q_learner, categorical)
REGISTRY = Registry(
    "rl",
    {
        "rainbow": rainbow,
        "c51": q_learner_of(categorical),
        "qr_dqn": q_learner_of(quantile),
        "iqn": q_learner_of(implicit_quantile),
        "double": q_learner_of(scalar, double=True),
        "dqn": q_learner_of(scalar),
        "drq": q_learner_of(
            scalar, double=True, dueling=True, n_step=10, view="shift", copies=2, target_copies=2
        ),
    },
)
register = REGISTRY.register
