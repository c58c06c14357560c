"""The representation objectives that predict and compare latents, each by a number that is known.

Those of two views are in two_views_test.py. What every row of the registry keeps is in objectives_test.py.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders, layers, objectives
from srl_jax.augment import make_view
from srl_jax.objectives.bisimulation import bisimulation_error
from srl_jax.objectives.infonce import info_nce
from srl_jax.objectives.inverse import action_cross_entropy
from srl_jax.objectives.latent_l2 import l2_norm
from srl_jax.objectives.networks import cosine_distance, mean_squared_error, over_others
from srl_jax.objectives.reward import binary_cross_entropy, symlog, two_hot
from srl_jax.objectives.slowness import similarity, squared_step
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
    make_window,
)
from tests.objectives.by_numpy import dense, log_softmax, min_max, mlp, spr_distances, with_action

BATCH, D = 4, 5

# What they share


def test_distances_by_hand():
    # Mean of 1, 4, 0; a right angle; the same direction; the opposite one.
    assert float(mean_squared_error(np.array([1.0, 2, 3]), np.array([0.0, 0, 3]))) == pytest.approx(5 / 3)
    x = np.array([3.0, 4.0])
    for y, expected in (([-4.0, 3.0], 2), (2 * x, 0), (-x, 4)):
        assert float(cosine_distance(x, np.array(y))) == pytest.approx(expected, abs=1e-6)


def test_a_vector_of_zeros_has_no_direction_and_no_gradient():
    value, gradient = jax.jit(jax.value_and_grad(cosine_distance))(jnp.zeros(3), jnp.ones(3))
    assert float(value) == 2 and np.all(gradient == 0)


LOG3 = np.log(3)
BY_HAND = {
    # (|1 - 0| + |3 - 1|) / 2 = 1.5, less |2 - 1| + 0.5 sqrt((4 + 4) / 2) = 2, squared.
    "bisimulation": (bisimulation_error, ([1, 3], 2, [0, 0], [0, 1], 1, [2, 2], 0.5), 0.25),
    "a step": (squared_step, ([1, 2], [4, 6]), 25),  # 9 + 16
    "two apart": (similarity, ([0, 0], [3, 4]), np.exp(-5)),
    "divergence": (gaussian_divergence, ([1, 0], [0, np.log(4)]), (1 + 3 - np.log(4)) / 2),
    "the action taken": (lambda x: action_cross_entropy(x, 1), ([0, LOG3],), np.log(4 / 3)),  # p is 3 of 4
    # A share of 1 in 4; the second row does not count.
    "its own column": (info_nce, ([[0, LOG3], [0, 0]], [1, 0]), [np.log(4), 0]),
    # Variances 2 and 0.02, to which 0.0001 is added: a root of 0.14177 is 0.85823 short of 1.
    "spread": (variance_loss, ([[0, 0], [2, 0.2]],), 0.85823 / 2),
    "covariance": (covariance_loss, ([[1, 1], [-1, -1]],), 4),  # 2 squared, twice, over 2 features
    "correlation": (cross_correlation, ([[1, 1], [-1, -1]], [[1, -1], [-1, 1]]), [[1, -1], [1, -1]]),
}


@pytest.mark.parametrize("what", BY_HAND)
def test_what_losses_are_made_of_by_hand(what):
    function, arguments, expected = BY_HAND[what]
    found = function(*(np.asarray(x, np.float32) for x in arguments))
    np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_means_over_other_valid_rows_by_hand():
    x, valid = jnp.array([1.0, 2.0, 5.0, 9.0]), jnp.array([1.0, 1.0, 1.0, 0.0])
    # Row 0 has 2 and 5 beside it: (2 - 1 + 5 - 1) / 2.
    np.testing.assert_allclose(over_others(lambda a, b: b - a, valid, x), [2.5, 1.0, -3.5, 0.0])
    alone = jnp.array([1.0, 0.0, 0.0, 0.0])
    assert np.all(over_others(lambda a, b: b - a, alone, x) == 0)


# Self-prediction


@pytest.mark.parametrize("target", ["slow", "periodic", "stopped"])
def test_forward_latent_against_numpy(target):
    z, slow = draw(3, BATCH, D), draw(3, BATCH, D, seed=1)
    objective = objectives.forward_latent(make_context(D), steps=2, hidden=7, residual=True, target=target)
    window = make_window(horizon=2)
    window.valid[1, 1] = 0
    losses, head, _ = loss_of(objective, latents_of(z, slow), window)
    head, goal = head["MLP_0"], slow  # of `stopped`: the online encoder's, as the target view has them
    first = z[0] + mlp(head, with_action(z[0], window.actions[:, 0]))
    second = first + mlp(head, with_action(first, window.actions[:, 1]))
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


@pytest.mark.parametrize(("mask", "shape"), [(True, (2, 3, 4)), (False, None)])
def test_spr_against_numpy(mask, shape):
    steps, features = 3, 24 if shape else D
    z, slow = (draw(steps + 1, BATCH, features, seed=seed) for seed in (0, 1))
    context = make_context(features)._replace(map_shape=shape)
    objective = objectives.spr(context, steps=steps, hidden=6, mask=mask, importance=True)
    window = make_window(horizon=steps)
    window.valid[2, 1:] = 0
    window = window._replace(weight=np.array([1, 0.5, 1, 0.25], np.float32))
    losses, head, behind = loss_of(objective, latents_of(z, slow), window)
    goals = [dense(behind["projection"], min_max(x)) for x in slow[1:]]
    project = functools.partial(dense, head["projection"])
    distances = spr_distances(head, project, goals, z[0], window.actions, shape)
    counted = distances * window.valid.T if mask else distances
    np.testing.assert_allclose(losses, window.weight * counted.mean(0), rtol=1e-5)
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


def test_sprs_layers_start_as_asked():
    objective = objectives.spr(make_context(24)._replace(map_shape=(2, 3, 4)), hidden=32, init="xavier")
    head = jax.jit(objective.init)(jax.random.key(0))
    for layer in (*head["transition"].values(), head["projection"], head["predictor"]):
        *window, inputs, outputs = layer["kernel"].shape
        bound = (6 / (np.prod(window) * (inputs + outputs))) ** 0.5
        assert 0.9 * bound < np.abs(layer["kernel"]).max() <= bound and not layer["bias"].any()


def test_a_constant_has_no_range():
    assert np.all(layers.min_max(jnp.full(3, 7.0)) == 0)


# Views


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
    starts, view = set(), jax.jit(make_view("crop_pad_crop"))
    for seed in range(30):
        rows = np.asarray(view(window_of(ramp), jax.random.key(seed)).frames)[0, 0, :, 0, 0]
        assert np.all(np.isin(np.diff(rows.astype(int)), (0, 1))) and len(np.unique(rows)) <= 8
        starts.add(int(rows[0]))
    assert len(starts) > 4


def test_a_crop_of_a_single_pixel_is_refused():
    with pytest.raises(ValueError, match="^crop_pad_crop cuts 4 pixels off each side, .* have 5\\b"):
        make_view("crop_pad_crop")(window_of(np.zeros((1, 5, 5, 1), np.uint8)), jax.random.key(0))


def window_of(frames: np.ndarray) -> Window:
    window = make_window(batch=1, horizon=1)
    return window._replace(frames=frames[None])


# Rewards, ends, distances


def test_two_hot_by_hand():
    bins = jnp.array([-1.0, 0.0, 2.0])
    found = jax.jit(jax.vmap(two_hot, (0, None)))(jnp.array([0.5, -1.0, 9.0, 0.0]), bins)
    np.testing.assert_allclose(found, [[0, 0.75, 0.25], [1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-6)
    assert float(symlog(jnp.float32(-(np.e - 1)))) == pytest.approx(-1)
    assert float(binary_cross_entropy(jnp.log(3.0), 1.0)) == pytest.approx(np.log(4 / 3))
    assert float(binary_cross_entropy(jnp.log(3.0), 0.0)) == pytest.approx(np.log(4))


@pytest.mark.parametrize("loss", ["two_hot", "squared"])
def test_a_linear_reward_model_against_numpy(loss):
    z, window = draw(1, BATCH, D), make_window(horizon=1)
    losses, head, _ = loss_of(objectives.reward(make_context(D), hidden=0, loss=loss), latents_of(z), window)
    output = dense(head["out"], with_action(z[0], window.actions[:, 0]))
    if loss == "squared":
        expected = (output[:, 0] - window.rewards[:, 0]) ** 2
    else:
        place = (np.sign(window.rewards[:, 0]) * np.log1p(np.abs(window.rewards[:, 0])) + 10) / 20 * 64
        below = np.floor(place).astype(int)
        logs, rows = log_softmax(output), np.arange(BATCH)
        expected = -(1 - place + below) * logs[rows, below] - (place - below) * logs[rows, below + 1]
    np.testing.assert_allclose(losses, expected, rtol=1e-4)


@pytest.mark.parametrize("loss", ["cross_entropy", "squared"])
def test_terminal_is_a_discount_of_nothing(loss):
    z, window = draw(1, BATCH, D), make_window(horizon=1)
    window.discounts[2, 0] = 0
    losses, head, _ = loss_of(
        objectives.terminal(make_context(D), hidden=0, loss=loss), latents_of(z), window
    )
    output = dense(head["out"], with_action(z[0], window.actions[:, 0]))[:, 0]
    ends = np.array([0, 0, 1, 0])
    p = 1 / (1 + np.exp(-output))
    crossed = -np.where(ends, np.log(p), np.log(1 - p))
    np.testing.assert_allclose(
        losses, crossed if loss == "cross_entropy" else (output - ends) ** 2, rtol=1e-4
    )


def test_bisimulation_against_numpy():
    z, window = draw(2, BATCH, D), make_window(horizon=1)
    window.valid[1] = 0
    losses, _, _ = loss_of(objectives.bisimulation(make_context(D), discount=0.5), latents_of(z), window)
    expected = np.zeros(BATCH)
    for i, j in itertools.permutations((0, 2, 3), 2):
        apart = np.abs(z[0, i] - z[0, j]).mean()
        follows = np.sqrt(((z[1, i] - z[1, j]) ** 2).mean())
        target = abs(window.rewards[i, 0] - window.rewards[j, 0]) + 0.5 * follows
        expected[i] += (apart - target) ** 2 / 2
    np.testing.assert_allclose(losses, expected, rtol=1e-5)


def test_bisimulations_gradient_flows_into_latents_and_not_into_next_ones():
    z, other, z_t, other_t = draw(4, D)
    gradient = jax.grad(bisimulation_error, (0, 2, 3, 5))(z, 0.5, z_t, other, -0.5, other_t, 0.5)
    assert [bool(np.any(g != 0)) for g in gradient] == [True, False, True, False]


def test_slowness_against_numpy():
    z, window = draw(2, BATCH, D), make_window(horizon=1)
    window.valid[1] = 0
    losses, _, _ = loss_of(objectives.slowness(make_context(D), variability=3.0), latents_of(z), window)
    expected = window.valid[:, 0] * ((z[1] - z[0]) ** 2).sum(-1)
    for i, j in itertools.permutations((0, 2, 3), 2):
        expected[i] += 3 * np.exp(-np.linalg.norm(z[0, i] - z[0, j])) / 2
    np.testing.assert_allclose(losses, expected, rtol=1e-5)


def test_latents_that_are_the_same_are_similar_without_a_gradient():
    same = jnp.ones(2)
    value, gradient = jax.value_and_grad(similarity)(same, same)
    assert float(value) == 1 and np.all(gradient == 0)


def test_the_inverse_model_against_numpy():
    objective = objectives.inverse(make_context(D), hidden=7, steps=3)
    z, window = draw(4, BATCH, D), make_window(horizon=3)
    window.actions[:] = [[0, 1, 2], [1, 0, 2], [2, 0, 1], [0, 2, 1]]
    window.valid[0, 2] = 0
    head = helpers.random_params(objective.init)
    losses, metrics = jax.jit(lambda head: objective.loss(head, None, latents_of(z), window, None))(head)
    network = {"hidden": head["Dense_1"], "out": head["Dense_0"]}  # flax numbers the outermost call first
    logits, taken = mlp(network, np.concatenate([z[0], z[3]], -1)), window.actions[:, 0]
    expected = -log_softmax(logits)[np.arange(BATCH), taken]
    np.testing.assert_allclose(losses, window.valid[:, 2] * expected, rtol=1e-5)
    assert float(metrics["accuracy"]) == pytest.approx(np.mean((logits.argmax(-1) == taken)[1:]))
    assert objective.horizon == 3


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
    ]
    + [(name, {"view": "shfit"}, "did you mean shift") for name in ("byol", "vicreg", "barlow", "infonce")],
)
def test_options_out_of_range_are_named(name, options, word):
    with pytest.raises(ValueError, match=word):
        objectives.REGISTRY[name](make_context(), **options)
