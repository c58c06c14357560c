"""The representation objectives that predict, compare and contrast latents, each by a number that is known.

What every row of the registry keeps is in objectives_test.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders, objectives
from srl_jax.augment import make_view
from srl_jax.latents import make_latents
from srl_jax.objectives.bisimulation import bisimulation_error
from srl_jax.objectives.infonce import info_nce
from srl_jax.objectives.latent_l2 import l2_norm
from srl_jax.objectives.networks import cosine_distance, mean_squared_error, over_others
from srl_jax.objectives.reward import binary_cross_entropy, symlog, two_hot
from srl_jax.objectives.slowness import similarity, squared_step
from srl_jax.objectives.spr import min_max
from srl_jax.objectives.two_views import covariance_loss, cross_correlation, variance_loss
from srl_jax.objectives.vae import gaussian_divergence
from srl_jax.types import Context, Latents, Window
from tests import helpers
from tests.helpers import (
    NUM_ACTIONS,
    draw,
    latents_of,
    loss_of,
    make_context,
    make_encoder,
    make_window,
)

BATCH, D = 4, 5

# What they share


def test_distances_by_hand():
    # Mean of 1, 4, 0; a right angle; the same direction; the opposite one.
    assert float(mean_squared_error(np.array([1.0, 2, 3]), np.array([0.0, 0, 3]))) == pytest.approx(5 / 3)
    x = np.array([3.0, 4.0])
    for y, expected in (([-4.0, 3.0], 2), (2 * x, 0), (-x, 4)):
        assert float(cosine_distance(x, np.array(y))) == pytest.approx(expected, abs=1e-6)


def test_a_vector_of_zeros_has_no_direction_and_no_gradient():
    zero = jnp.zeros(3)
    assert float(cosine_distance(zero, jnp.ones(3))) == 2
    assert np.all(jax.grad(cosine_distance)(zero, jnp.ones(3)) == 0)


def test_means_over_other_valid_rows_by_hand():
    x, valid = jnp.array([1.0, 2.0, 5.0, 9.0]), jnp.array([1.0, 1.0, 1.0, 0.0])
    # Row 0 has 2 and 5 beside it: (2 - 1 + 5 - 1) / 2.
    np.testing.assert_allclose(over_others(lambda a, b: b - a, valid, x), [2.5, 1.0, -3.5, 0.0])
    alone = jnp.array([1.0, 0.0, 0.0, 0.0])
    assert np.all(over_others(lambda a, b: b - a, alone, x) == 0)


# Self-prediction


def by_numpy(head, z: np.ndarray, action: np.ndarray) -> np.ndarray:
    """`networks.MLP` over a latent and an action."""
    x = np.concatenate([z, np.eye(NUM_ACTIONS)[action]], -1)
    x = np.maximum(x @ head["hidden"]["kernel"] + head["hidden"]["bias"], 0)
    return x @ head["out"]["kernel"] + head["out"]["bias"]


@pytest.mark.parametrize("target", ["slow", "periodic", "stopped"])
def test_forward_latent_against_numpy(target):
    z, slow = draw(3, BATCH, D), draw(3, BATCH, D, seed=1)
    objective = objectives.forward_latent(make_context(D), steps=2, hidden=7, residual=True, target=target)
    window = make_window(horizon=2)
    window.valid[1, 1] = 0
    losses, head, _ = loss_of(objective, latents_of(z, slow), window)
    head, goal = head["MLP_0"], slow  # of `stopped`: the online encoder's, as the target view has them
    first = z[0] + by_numpy(head, z[0], window.actions[:, 0])
    second = first + by_numpy(head, first, window.actions[:, 1])
    errors = [((p - g) ** 2).mean(-1) for p, g in ((first, goal[1]), (second, goal[2]))]
    np.testing.assert_allclose(losses, (errors[0] + window.valid[:, 1] * errors[1]) / 2, rtol=1e-5)
    assert (objective.slow is None) == (target == "stopped") and objective.horizon == 2
    assert getattr(objective.slow, "every", None) == (250 if target == "periodic" else None)


@pytest.mark.parametrize(("target", "reaches"), [("slow", False), ("stopped", False), ("gradient", True)])
def test_only_target_gradient_lets_the_gradient_into_the_targets(target, reaches):
    objective = objectives.forward_latent(make_context(D), hidden=0, target=target)
    head = helpers.random_params(objective.init)

    def total(z_t):
        z = {0: jnp.asarray(draw(BATCH, D)), 1: z_t}
        give = lambda k: jnp.stack([z[i] for i in k]) if isinstance(k, list) else z[k]  # noqa: E731
        latents = Latents(give, lambda k: jax.lax.stop_gradient(give(k)))
        return jnp.sum(objective.loss(head, None, latents, make_window(horizon=1), None)[0])

    assert np.any(jax.grad(total)(jnp.asarray(draw(BATCH, D, seed=1))) != 0) == reaches


@pytest.mark.parametrize("mask", [True, False])
def test_spr_against_numpy(mask):
    steps, hidden = 3, 6
    z, slow = draw(steps + 1, BATCH, D), draw(steps + 1, BATCH, D, seed=1)
    objective = objectives.spr(make_context(D), steps=steps, hidden=hidden, mask=mask, importance=True)
    window = make_window(horizon=steps)
    window.valid[2, 1:] = 0
    window = window._replace(weight=np.array([1, 0.5, 1, 0.25], np.float32))
    losses, head, behind = loss_of(objective, latents_of(z, slow), window)

    def scaled(x):  # SPR, section 2.3: into [0, 1] by each latent's own extremes
        low, high = x.min(-1, keepdims=True), x.max(-1, keepdims=True)
        return (x - low) / (high - low)

    def linear(tree, x):
        return x @ np.asarray(tree["kernel"]).reshape(x.shape[-1], -1) + tree["bias"]

    state, total = scaled(z[0]), np.zeros(BATCH)
    for k in range(steps):
        action = np.eye(NUM_ACTIONS)[window.actions[:, k]]
        maps = np.maximum(linear(head["transition"]["first"], np.concatenate([state, action], -1)), 0)
        state = scaled(np.maximum(linear(head["transition"]["second"], maps), 0))
        y = linear(head["predictor"], linear(head["projection"], state))
        goal = linear(behind["projection"], scaled(slow[k + 1]))
        cosine = (y * goal).sum(-1) / np.linalg.norm(y, axis=-1) / np.linalg.norm(goal, axis=-1)
        total += (window.valid[:, k] if mask else 1) * (2 - 2 * cosine)
    np.testing.assert_allclose(losses, window.weight * total / steps, rtol=1e-5, atol=1e-5)
    # The paper's loss is the sum of the negative cosines times 2: the same gradient at this weight.
    assert objectives.spr(make_context(D)).weight / 5 * 2 == 2


def test_spr_has_a_convolutional_transition_where_the_latent_is_a_map():
    context = make_context(24)._replace(map_shape=(2, 3, 4))
    kernels = jax.eval_shape(objectives.spr(context).init, jax.random.key(0))["transition"]
    assert kernels["first"]["kernel"].shape == (3, 3, 4 + NUM_ACTIONS, 4)
    assert kernels["second"]["kernel"].shape == (3, 3, 4, 4)
    tiny = Context.of(encoders.tiny((42, 42, 4), features=256), NUM_ACTIONS)  # its maps are of 256, too
    kernels = jax.eval_shape(objectives.spr(tiny).init, jax.random.key(0))["transition"]
    assert kernels["first"]["kernel"].shape == (1, 1, 256 + NUM_ACTIONS, 256)
    behind_a_bottleneck = objectives.spr(make_context(D))
    kernels = jax.eval_shape(behind_a_bottleneck.init, jax.random.key(0))["transition"]
    assert kernels["first"]["kernel"].shape == (1, 1, D + NUM_ACTIONS, D)


def test_min_max_by_hand():
    np.testing.assert_allclose(min_max(np.array([1.0, 3.0, 2.0])), [0, 1, 0.5])
    assert np.all(min_max(jnp.full(3, 7.0)) == 0)


# Two views, and contrast


def test_variance_and_covariance_of_vicreg_by_hand():
    # Standard deviations 2 and sqrt(0.5), of samples; the second is short by 1 - 0.707.
    z = jnp.array([[-2.0, 0.0], [2.0, 1.0]]) / jnp.array([jnp.sqrt(2.0), 1.0])
    assert float(variance_loss(z)) == pytest.approx((1 - np.sqrt(0.5 + 1e-4)) / 2, rel=1e-5)
    # The covariance of (-1, 1) and (0, 1) is 1: 1 twice, over two features.
    assert float(covariance_loss(jnp.array([[-1.0, 0.0], [1.0, 1.0]]))) == pytest.approx(1.0)
    # A single row has neither.
    assert float(variance_loss(z[:1])) == pytest.approx(0.99) and float(covariance_loss(z[:1])) == 0


def test_vicreg_weighs_its_terms_as_the_authors_code_does():
    """Twice the same latents: 2 of variance for the mean of both views, 3 of each view's covariance."""
    encoder = make_encoder()
    window, params = make_window(), helpers.random_params(encoder.init)
    objective = objectives.vicreg(
        make_context(), hidden=0, outputs=3, invariance=5.0, variance=2.0, covariance=3.0, view="none"
    )
    head = helpers.random_params(objective.init)
    latents = make_latents(encoder, params, params, window)
    losses, metrics = objective.loss(head, head, latents, window, jax.random.key(0))
    (layer,) = head.values()
    z = np.asarray(latents.online(0)) @ layer["kernel"] + layer["bias"]
    expected = 2 * float(variance_loss(z)) + 6 * float(covariance_loss(z))
    np.testing.assert_allclose(losses, expected, rtol=1e-4)
    assert float(metrics["variance"]) == pytest.approx(float(variance_loss(z)), rel=1e-4)


def test_barlows_correlation_is_numpys():
    one, other = draw(50, 3), draw(50, 3, seed=1)
    expected = np.corrcoef(one.T, other.T)[:3, 3:]
    np.testing.assert_allclose(cross_correlation(one, other), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["byol", "vicreg", "barlow", "infonce"])
def test_the_two_views_differ_and_are_drawn_by_the_key(name):
    encoder = make_encoder()
    window = make_window(horizon=1)
    params = helpers.random_params(encoder.init)
    objective = objectives.REGISTRY[name](make_context(), view="intensity")
    latents = make_latents(encoder, params, params, window)
    values = [loss_of(objective, latents, window, key=k)[0] for k in (0, 0, 1)]
    assert np.array_equal(values[0], values[1]) and not np.array_equal(values[0], values[2])
    with pytest.raises(ValueError, match="no view '.*'; did you mean shift"):
        objectives.REGISTRY[name](make_context(), view="shfit")


def test_byol_of_equal_networks_and_views_is_the_predictors_error():
    encoder = make_encoder()
    window, params = make_window(), helpers.random_params(encoder.init)
    objective = objectives.byol(make_context(), hidden=4, outputs=3, view="none")
    head = helpers.random_params(objective.init)
    latents = make_latents(encoder, params, params, window)
    losses, _ = objective.loss(head, head, latents, window, jax.random.key(0))

    def mlp(tree, x):
        x = np.maximum(x @ tree["hidden"]["kernel"] + tree["hidden"]["bias"], 0)
        return x @ tree["out"]["kernel"] + tree["out"]["bias"]

    goal = mlp(head["projection"], np.asarray(latents.online(0)))
    y = mlp(head["predictor"], goal)
    cosine = (y * goal).sum(-1) / np.linalg.norm(y, axis=-1) / np.linalg.norm(goal, axis=-1)
    np.testing.assert_allclose(losses, 2 - 2 * cosine, rtol=1e-4, atol=1e-5)


def test_info_nce_by_hand():
    # Of exp(0), exp(log 3): a quarter and three quarters.
    logits = jnp.array([[0.0, np.log(3)], [0.0, np.log(3)]])
    np.testing.assert_allclose(info_nce(logits, jnp.ones(2)), np.log([4, 4 / 3]), rtol=1e-6)


def test_infonce_leaves_out_rows_whose_future_is_not_valid():
    encoder = make_encoder()
    params = helpers.random_params(encoder.init)
    objective = objectives.infonce(
        make_context(), temporal=2, view="none", similarity="cosine", temperature=0.1
    )
    window = make_window(horizon=2)
    window.valid[3, 1] = 0
    losses, head, slow = loss_of(objective, make_latents(encoder, params, params, window), window)
    three = jax.tree.map(lambda x: x[:3], window)
    alone, _ = objective.loss(
        head, slow, make_latents(encoder, params, params, three), three, jax.random.key(0)
    )
    np.testing.assert_allclose(losses, [*alone, 0], rtol=1e-5)
    assert objective.horizon == 2


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_views_keep_the_shape_and_move_a_sequence_as_one(dtype):
    window = make_window(size=12, horizon=1)
    if dtype == np.float32:
        window = window._replace(frames=window.frames.astype(np.float32) / 255)
    key = jax.random.key(1)
    for parts in ("shift", "crop_pad_crop", "shift+intensity"):
        seen = np.asarray(make_view(parts)(window, key).frames)
        assert seen.shape == window.frames.shape
        same = np.stack([window.frames[:, 0]] * window.frames.shape[1], 1)
        moved = np.asarray(make_view(parts)(window._replace(frames=same), key).frames)
        assert np.array_equal(moved[:, 0], moved[:, -1]) and not np.array_equal(moved[:, 0], same[:, 0])
    assert make_view("none")(window, key).frames is window.frames


def test_a_crop_that_is_padded_and_cropped_holds_pixels_of_the_image_in_order():
    ramp = np.broadcast_to(np.arange(12, dtype=np.uint8)[None, :, None, None], (1, 12, 12, 1))
    starts = set()
    for seed in range(30):
        rows = np.asarray(make_view("crop_pad_crop")(window_of(ramp), jax.random.key(seed)).frames)[
            0, 0, :, 0, 0
        ]
        assert np.all(np.isin(np.diff(rows.astype(int)), (0, 1))) and len(np.unique(rows)) <= 8
        starts.add(int(rows[0]))
    assert len(starts) > 4


def window_of(frames: np.ndarray) -> Window:
    window = make_window(batch=1, horizon=1)
    return window._replace(frames=frames[None])


# Rewards, ends, distances


def test_two_hot_by_hand():
    bins = jnp.array([-1.0, 0.0, 2.0])
    for x, expected in ((0.5, [0, 0.75, 0.25]), (-1.0, [1, 0, 0]), (9.0, [0, 0, 1]), (0.0, [0, 1, 0])):
        np.testing.assert_allclose(two_hot(jnp.float32(x), bins), expected, atol=1e-6)
    assert float(symlog(jnp.float32(-(np.e - 1)))) == pytest.approx(-1)
    assert float(binary_cross_entropy(jnp.log(3.0), 1.0)) == pytest.approx(np.log(4 / 3))
    assert float(binary_cross_entropy(jnp.log(3.0), 0.0)) == pytest.approx(np.log(4))


@pytest.mark.parametrize("loss", ["two_hot", "squared"])
def test_a_linear_reward_model_against_numpy(loss):
    z, window = draw(1, BATCH, D), make_window(horizon=1)
    losses, head, _ = loss_of(objectives.reward(make_context(D), hidden=0, loss=loss), latents_of(z), window)
    x = np.concatenate([z[0], np.eye(NUM_ACTIONS)[window.actions[:, 0]]], -1)
    output = x @ head["out"]["kernel"] + head["out"]["bias"]
    if loss == "squared":
        expected = (output[:, 0] - window.rewards[:, 0]) ** 2
    else:
        place = (np.sign(window.rewards[:, 0]) * np.log1p(np.abs(window.rewards[:, 0])) + 10) / 20 * 64
        below = np.floor(place).astype(int)
        logs = output - np.log(np.exp(output).sum(-1, keepdims=True))
        rows = np.arange(BATCH)
        expected = -(1 - place + below) * logs[rows, below] - (place - below) * logs[rows, below + 1]
    np.testing.assert_allclose(losses, expected, rtol=1e-4)


@pytest.mark.parametrize("loss", ["cross_entropy", "squared"])
def test_terminal_is_a_discount_of_nothing(loss):
    z, window = draw(1, BATCH, D), make_window(horizon=1)
    window.discounts[2, 0] = 0
    losses, head, _ = loss_of(
        objectives.terminal(make_context(D), hidden=0, loss=loss), latents_of(z), window
    )
    x = np.concatenate([z[0], np.eye(NUM_ACTIONS)[window.actions[:, 0]]], -1)
    output = (x @ head["out"]["kernel"] + head["out"]["bias"])[:, 0]
    ends = np.array([0, 0, 1, 0])
    p = 1 / (1 + np.exp(-output))
    crossed = -np.where(ends, np.log(p), np.log(1 - p))
    np.testing.assert_allclose(
        losses, crossed if loss == "cross_entropy" else (output - ends) ** 2, rtol=1e-4
    )


def test_bisimulation_error_by_hand():
    # |z - z'| is (1 + 3) / 2 = 2; rewards differ by 1; what follows by sqrt((9 + 16) / 2), times 0.5.
    z, other, z_t, other_t = (np.array(x, np.float32) for x in ([1, 3], [0, 0], [3, 4], [0, 0]))
    error = bisimulation_error(z, 0.5, z_t, other, -0.5, other_t, 0.5)
    assert float(error) == pytest.approx((2 - 1 - 0.5 * np.sqrt(12.5)) ** 2, rel=1e-5)
    gradient = jax.grad(bisimulation_error, (0, 2, 3, 5))(z, 0.5, z_t, other, -0.5, other_t, 0.5)
    assert [bool(np.any(g != 0)) for g in gradient] == [True, False, True, False]


def test_slowness_by_hand():
    assert float(squared_step(np.array([1.0, 2]), np.array([0.0, 4]))) == 5
    assert float(similarity(np.array([3.0, 0]), np.array([0.0, 4]))) == pytest.approx(np.exp(-5))
    same = jnp.ones(2)
    assert float(similarity(same, same)) == 1
    assert np.all(jax.grad(similarity)(same, same) == 0)


def test_gaussian_divergence_by_hand():
    # 0.5 (9 + 1 - 1 - 0) and 0.5 (0 + 4 - 1 - log 4).
    divergence = gaussian_divergence(np.array([3.0, 0.0]), np.array([0.0, np.log(4)]))
    assert float(divergence) == pytest.approx(4.5 + 1.5 - np.log(2))


def test_the_inverse_model_looks_as_far_as_it_is_told():
    objective = objectives.inverse(make_context(D), steps=3)
    window = make_window(horizon=3)
    window.valid[0, 2] = 0
    z = draw(4, BATCH, D)
    losses, head, _ = loss_of(objective, latents_of(z), window)
    z[1:3] += 1
    again, _ = objective.loss(head, None, latents_of(z), window, None)
    z[3] += 1
    other, _ = objective.loss(head, None, latents_of(z), window, None)
    assert objective.horizon == 3 and losses[0] == 0 and np.all(losses[1:] > 0)
    assert np.array_equal(losses, again) and not np.array_equal(losses, other)
    # The accuracy is of valid rows.
    window.valid[1:, 2] = 0
    _, metrics = objective.loss(head, None, latents_of(z), window, None)
    assert metrics["accuracy"] == 0


def test_latents_are_pulled_to_zero_or_to_the_slow_ones():
    assert float(l2_norm(np.array([3.0, 4.0]))) == 5
    assert np.all(jax.grad(l2_norm)(jnp.zeros(2)) == 0)
    z, slow = draw(1, BATCH, D), draw(1, BATCH, D, seed=1)
    objective = objectives.latent_l2(make_context(D), norm="l2", target="slow")
    losses, _, _ = loss_of(objective, latents_of(z, slow), make_window())
    np.testing.assert_allclose(losses, np.linalg.norm(z[0] - slow[0], axis=-1), rtol=1e-5)
    assert objective.slow and not objectives.latent_l2(make_context(D)).slow


@pytest.mark.parametrize(
    ("name", "options", "word"),
    [
        ("forward_latent", {"steps": 0}, "steps"),
        ("forward_latent", {"distance": "cosin"}, "did you mean cosine"),
        ("forward_latent", {"target": "fast"}, "slow, periodic, stopped, gradient"),
        ("forward_latent", {"tau": 1.0}, "tau"),
        ("spr", {"target": "gradient"}, "slow, stopped"),
        ("infonce", {"temperature": 0.0}, "temperature"),
        ("infonce", {"similarity": "dot"}, "bilinear, cosine"),
        ("reward", {"loss": "two"}, "two_hot"),
        ("terminal", {"loss": "two_hot"}, "cross_entropy, squared"),
        ("bisimulation", {"discount": 1.0}, "discount"),
        ("reconstruction", {"masked": 1.0}, "masked"),
        ("reconstruction", {"noise": -0.1}, "noise"),
        ("forward_pixels", {"target": "pixels"}, "observation, difference"),
        ("latent_l2", {"norm": "l1"}, "half_squared, l2"),
    ],
)
def test_options_out_of_range_are_named(name, options, word):
    with pytest.raises(ValueError, match=word):
        objectives.REGISTRY[name](make_context(), **options)
