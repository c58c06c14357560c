"""srl_jax/objectives/two_views.py and infonce.py: whole losses, from pixels on, against numpy."""

import jax
import numpy as np
import pytest

from srl_jax import objectives
from srl_jax.augment import make_view
from srl_jax.latents import make_latents
from srl_jax.objectives.two_views import covariance_loss, variance_loss
from tests.helpers import STACK, make_context, make_encoder, make_window, random_params
from tests.objectives.by_numpy import cosine_distance, log_softmax, mlp, unit

BATCH, D = 6, 5


def of_two_views(name: str, *, second: int = 0, scale: float = 1.0, **options) -> tuple:
    """What an objective gives of views by "shift", of s_t and of s_{t+second}, and what that is made of.

    Of row 3 the episode ends after one step. Heads and encoders have different parameters, the slow ones
    too; those of heads are multiplied by the scale.

    Returns:
        losses, metrics, [head, slow head], the latents of [first view, second view] under the online
        encoder, and those under the slow one.
    """
    encoder, window, key = make_encoder(D), make_window(batch=BATCH, horizon=2), jax.random.key(3)
    window.valid[3, 1] = 0
    objective = objectives.REGISTRY[name](make_context(D), view="shift", hidden=7, outputs=3, **options)
    assert objective.horizon == second
    encoders = [random_params(encoder.init, seed) for seed in (1, 2)]
    heads = [jax.tree.map(lambda x: scale * x, random_params(objective.init, seed)) for seed in (3, 4)]

    def loss(heads, encoders):
        return objective.loss(*heads, make_latents(encoder, *encoders, window), window, key)

    losses, metrics = jax.jit(loss)(heads, encoders)
    pixels = []
    for k, own in zip((0, second), jax.random.split(key), strict=True):
        view = jax.jit(make_view("shift"))(window._replace(frames=window.frames[:, k : k + STACK]), own)
        pixels.append(np.moveaxis(np.asarray(view.frames)[..., 0], 1, -1).reshape(BATCH, -1) / 255)
    online, slow = ([np.tanh(x @ params["kernel"]) for x in pixels] for params in encoders)
    return losses, metrics, heads, online, slow


def test_byol_against_numpy():
    losses, _, (head, behind), online, slow = of_two_views("byol")
    predicted = [mlp(head["predictor"], mlp(head["projection"], z)) for z in online]
    wanted = [mlp(behind["projection"], z) for z in slow]
    expected = cosine_distance(predicted[0], wanted[1]) + cosine_distance(predicted[1], wanted[0])
    np.testing.assert_allclose(losses, expected / 2, rtol=1e-5)


def test_vicreg_against_numpy():
    """The squared distance is a mean over features, and variance one over both views (the authors' code)."""
    losses, metrics, (head, _), online, _ = of_two_views(
        "vicreg", scale=3.0, invariance=5.0, variance=2.0, covariance=3.0
    )
    z = [mlp(head, x) for x in online]
    alike = ((z[0] - z[1]) ** 2).mean(-1)
    spread = [np.sqrt(x.var(0, ddof=1) + 1e-4) for x in z]
    assert np.min(spread) < 1 < np.max(spread)
    varied = np.mean(np.maximum(0, 1 - np.stack(spread)))
    between = [np.cov(x.T)[~np.eye(3, dtype=bool)] for x in z]
    apart = sum((x**2).sum() for x in between) / 3
    np.testing.assert_allclose(losses, 5 * alike + 2 * varied + 3 * apart, rtol=1e-5)
    expected = {"invariance": alike.mean(), "variance": varied, "covariance": apart}
    assert metrics == pytest.approx(expected, rel=1e-5)


def test_a_single_row_has_neither_variance_nor_covariance():
    variance, covariance = jax.jit(lambda z: (variance_loss(z), covariance_loss(z)))(np.ones((1, 2)))
    assert float(variance) == pytest.approx(0.99) and float(covariance) == 0


def test_barlow_against_numpy():
    """Features are normalised as by BatchNorm, in the authors' code: 1e-5 is added to their variance."""
    losses, _, (head, _), online, _ = of_two_views("barlow", redundancy=0.3)
    z = [mlp(head, x) for x in online]
    first, second = ((x - x.mean(0)) / np.sqrt(x.var(0) + 1e-5) for x in z)
    correlation = first.T @ second / BATCH
    diagonal = np.eye(3, dtype=bool)
    expected = ((1 - correlation[diagonal]) ** 2).sum() + 0.3 * (correlation[~diagonal] ** 2).sum()
    np.testing.assert_allclose(losses, np.full(BATCH, expected), rtol=1e-5)


@pytest.mark.parametrize(("similarity", "temporal"), [("bilinear", 0), ("cosine", 2)])
def test_infonce_against_numpy(similarity, temporal):
    """Rows whose episode ended before are neither anchors nor anybody's negatives."""
    losses, metrics, (head, behind), online, slow = of_two_views(
        "infonce", second=temporal, temporal=temporal, similarity=similarity, temperature=0.5
    )
    anchor = mlp(head["projection"], online[0], layer_norm=True)
    positive = mlp(behind["projection"], slow[1], layer_norm=True)
    if similarity == "bilinear":
        logits = anchor @ head["bilinear"] @ positive.T
    else:
        logits = unit(anchor) @ unit(positive).T
    there = [0, 1, 2, 4, 5] if temporal else range(BATCH)
    logits = logits[np.ix_(there, there)] / 0.5
    expected = np.zeros(BATCH)
    expected[there] = -np.diag(log_softmax(logits))
    np.testing.assert_allclose(losses, expected, rtol=1e-5)
    found = np.mean(logits.argmax(-1) == np.arange(len(there)))
    assert float(metrics["accuracy"]) == pytest.approx(found)
