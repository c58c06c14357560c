"""Two views of one observation: BYOL, VICReg and Barlow Twins."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from srl_jax.augment import make_view
from srl_jax.learning.update import ema
from srl_jax.objectives.networks import MLP, cosine_distance, functions
from srl_jax.specs import check_size
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.window import only


def two_views(draw: Callable, latents: Latents, window: Window, key: jax.Array) -> list[Latents]:
    """The latents of two views of s_t, which is their offset 0.

    The views are drawn of s_t's frames alone. Heads see both as one batch, [2B, D]; in the encoder, where a
    batch is large enough as it is, one of twice the size is slower on a CPU.
    """
    return [latents.of(draw(only(window, 0), k)) for k in jax.random.split(key)]


def byol(
    context: Context,
    *,
    weight: float = 1.0,
    hidden: int = 512,
    outputs: int = 128,
    view: str = "shift+intensity",
    tau: float = 0.99,
) -> Objective:
    """Predicts one view's projection from the other's (Grill et al. 2020, section 3.1, equation 2).

    The mean of `2 - 2 cos(q(p(z)), p'(z'))` over both ways round; z and z' are the latents of two views of
    s_t, the second under slow copies of encoder and projection. The gradient flows into projection p and
    predictor q, and through z into the encoder.

    Args:
        hidden: width of the hidden layer of projection and predictor.
        outputs: size of a projection.
        view: see `srl_jax.augment.make_view`.
        tau: of the slow copies, see `srl_jax.learning.update.ema`.
    """
    check_size("hidden", hidden)
    check_size("outputs", outputs)
    draw = make_view(view)
    init_project, project = functions(MLP(hidden, outputs), context.features)
    init_predict, predict = functions(MLP(hidden, outputs), outputs)

    def init(key: jax.Array) -> Params:
        first, second = jax.random.split(key)
        return {"projection": init_project(first), "predictor": init_predict(second)}

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        one, other = two_views(draw, latents, window, key)
        z = jnp.concatenate([one.online(0), other.online(0)])
        wanted = jnp.concatenate([other.slow(0), one.slow(0)])  # each view's target is the other's
        prediction = predict(head["predictor"], project(head["projection"], z))
        target = jax.lax.stop_gradient(project(slow_head["projection"], wanted))
        return jnp.mean(jax.vmap(cosine_distance)(prediction, target).reshape(2, -1), 0), {}

    return Objective(init, loss, weight, slow=ema(tau), own_views=True)


def variance_loss(z: Array) -> jax.Array:
    """`mean_d max(0, 1 - std_d)` over the batch: float32 [B, D] -> [] (Bardes et al. 2022, equation 1)."""
    variance = jnp.sum((z - jnp.mean(z, 0)) ** 2, 0) / max(len(z) - 1, 1)  # one row has none
    return jnp.mean(jax.nn.relu(1 - jnp.sqrt(variance + 1e-4)))


def covariance_loss(z: Array) -> jax.Array:
    """The squares of the covariances of different features, summed, over D: float32 [B, D] -> float32 [].

    Bardes et al. (2022), equations 3 and 4.
    """
    centred = z - jnp.mean(z, 0)
    covariance = centred.T @ centred / max(len(z) - 1, 1)
    return jnp.sum((covariance * (1 - jnp.eye(z.shape[-1], dtype=jnp.float32))) ** 2) / z.shape[-1]


def vicreg(
    context: Context,
    *,
    weight: float = 1.0,
    hidden: int = 512,
    outputs: int = 128,
    invariance: float = 25.0,
    variance: float = 25.0,
    covariance: float = 1.0,
    view: str = "shift+intensity",
) -> Objective:
    """Two views alike, features varied and uncorrelated (Bardes et al. 2022, equation 6). No slow copy.

    As in the authors' code, and not in the equation, the squared distance of the views is a mean over D, and
    the variance term the mean of both views'. The gradient flows into the expander and, through the latents
    of both views, into the encoder.

    Args:
        hidden, outputs: width of the expander's hidden layer and size of what it gives.
        invariance, variance, covariance: factors of the three terms: lambda, mu and nu.
        view: see `srl_jax.augment.make_view`.
    """
    check_size("hidden", hidden, least=0)
    check_size("outputs", outputs)
    draw = make_view(view)
    init, expand = functions(MLP(hidden, outputs), context.features)

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        both = [view.online(0) for view in two_views(draw, latents, window, key)]
        z = jnp.split(expand(head, jnp.concatenate(both)), 2)
        alike = jnp.mean((z[0] - z[1]) ** 2, -1)
        varied = sum(map(variance_loss, z)) / 2
        apart = sum(map(covariance_loss, z))
        metrics = {"invariance": jnp.mean(alike), "variance": varied, "covariance": apart}
        losses = invariance * alike + variance * varied + covariance * apart
        return losses, jax.lax.stop_gradient(metrics)

    return Objective(init, loss, weight, own_views=True)


def cross_correlation(z: Array, other: Array) -> Array:
    """Pearson's correlation over the batch of each pair of features: [B, D], [B, D] -> float32 [D, D]."""
    z, other = ((x - jnp.mean(x, 0)) / jnp.sqrt(jnp.var(x, 0) + 1e-5) for x in (z, other))
    return z.T @ other / len(z)


def barlow(
    context: Context,
    *,
    weight: float = 1.0,
    hidden: int = 512,
    outputs: int = 128,
    redundancy: float = 0.005,
    view: str = "shift+intensity",
) -> Objective:
    """Correlations of two views' features are those of the identity (Zbontar et al. 2021, equation 1).

    `sum_d (1 - C_dd)^2 + redundancy sum_{d != e} C_de^2`, the same for every row of the batch, whose mean it
    is. No slow copy. The gradient flows into the projection and, through both latents, into the encoder.

    Args:
        hidden, outputs: width of the projection's hidden layer and size of what it gives.
        redundancy: lambda.
        view: see `srl_jax.augment.make_view`.
    """
    check_size("hidden", hidden, least=0)
    check_size("outputs", outputs)
    draw = make_view(view)
    init, project = functions(MLP(hidden, outputs), context.features)

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        both = [view.online(0) for view in two_views(draw, latents, window, key)]
        first, second = jnp.split(project(head, jnp.concatenate(both)), 2)
        correlation = cross_correlation(first, second)
        identity = jnp.eye(outputs, dtype=jnp.float32)
        factor = identity + redundancy * (1 - identity)
        total = jnp.sum(factor * (correlation - identity) ** 2)
        return jnp.full(len(first), total), {}

    return Objective(init, loss, weight, own_views=True)
