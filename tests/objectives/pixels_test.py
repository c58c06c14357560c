"""The representation objectives that predict pixels, each by a number that is known; and what collapses."""

import dataclasses

import jax
import numpy as np
import pytest

from srl_jax import checks, encoders, objectives
from srl_jax.config import Config
from srl_jax.envs import make
from srl_jax.errors import ConfigError
from srl_jax.latents import make_latents
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import make_optimizer
from srl_jax.learning.update import Hyper, make_init, make_update
from srl_jax.objectives.forward_pixels import ActionGate
from srl_jax.objectives.reconstruction import (
    change_weights,
    corrupted,
    largest_singular_value,
    shifted_stack,
    spectrally_normalised,
    weighted_squared_error,
)
from srl_jax.types import Context, Window
from srl_jax.window import image
from tests import helpers
from tests.helpers import (
    STACK,
    draw,
    latents_of,
    loss_of,
    make_context,
    make_encoder,
    make_window,
)
from tests.objectives.by_numpy import dense

BATCH = 4

# Pixels


def test_pixels_that_move_weigh_more_by_hand():
    before, now = np.zeros((2, 2, 1), np.float32), np.zeros((2, 2, 1), np.float32)
    now[0, 1] = 0.5
    weights = change_weights(before, now, 3.0)
    np.testing.assert_array_equal(weights[..., 0], [[1, 4], [1, 1]])
    # An error of 1 there alone: 4 of 7.
    error = weighted_squared_error(now, now + (weights > 1), weights)
    assert float(error) == pytest.approx(4 / 7)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])  # as an intensity view has them
def test_one_level_of_brightness_is_no_motion_and_two_are(factor):
    levels = np.float32(factor) * (np.arange(256, dtype=np.float32) / 255)[:, None, None]
    assert (change_weights(levels[:-1], levels[1:], 3.0) == 1).all()
    assert (change_weights(levels[:-2], levels[2:], 3.0) == 4).all()


def test_a_frame_is_compared_with_the_one_before_it():
    window = make_window(horizon=1)
    stack = image(window, 0)
    before = shifted_stack(stack, window)
    np.testing.assert_array_equal(before[..., 1:], stack[..., :-1])
    np.testing.assert_array_equal(before[..., 0], stack[..., 0])


def test_corruption_hides_whole_patches_in_all_frames_and_is_seen_by_the_encoder_alone():
    window = make_window(horizon=1, size=12)
    window = window._replace(frames=np.full_like(window.frames, 255))
    frames = np.asarray(corrupted(window, jax.random.key(0), 0.0, 0.5, 4).frames)
    patches = frames.reshape(*frames.shape[:2], 3, 4, 3, 4)
    assert np.all(patches.max((3, 5)) == patches.min((3, 5)))
    assert np.all(frames == frames[:, :1]) and 0.2 < frames.mean() < 0.8
    whole, larger = (corrupted(window, jax.random.key(0), 0.0, 0.5, side).frames for side in (12, 65_536))
    np.testing.assert_array_equal(whole, larger)
    noisy = np.asarray(corrupted(window, jax.random.key(0), 0.5, 0.0, 4).frames)
    assert 0 <= noisy.min() < noisy.max() == 1

    encoder, plain = make_encoder(), make_window(horizon=1)
    params = helpers.random_params(encoder.init)
    latents = make_latents(encoder, params, params, plain)
    for options in ({"noise": 0.3}, {"masked": 0.5, "patch": 2}):
        objective = objectives.reconstruction(make_context(), **options)
        losses, head, _ = loss_of(objective, latents, plain)
        target, output = objective.image(head, latents, plain)  # the picture is of the clean one
        assert not np.allclose(losses, ((output - target) ** 2).mean((1, 2, 3)), rtol=1e-3)


def test_the_gradient_penalty_of_a_linear_decoder_is_its_kernels_size():
    context, window = make_context(), make_window()
    plain, penalised = (objectives.reconstruction(context, gradient_penalty=p) for p in (0.0, 2.0))
    latents = latents_of(draw(1, BATCH, 8))
    head = helpers.random_params(plain.init)
    losses = lambda of, key: of.loss(head, None, latents, window, key)[0]  # noqa: E731
    more = jax.jit(jax.vmap(lambda key: losses(penalised, key) - losses(plain, key)))
    rows = more(jax.random.split(jax.random.key(0), 30))
    expected = 2.0 * np.sum(np.asarray(head["kernel"]) ** 2) / (6 * 6 * 4)
    assert np.mean(rows) == pytest.approx(expected, rel=0.15)


def test_a_largest_singular_value_and_its_gradient_by_hand():
    # The columns' lengths are 5 and 1, and they are orthogonal: u = (0.6, 0.8, 0), v = (1, 0).
    matrix = np.array([[3.0, 0.0], [4.0, 0.0], [0.0, 1.0]], np.float32)
    value, gradient = jax.jit(jax.value_and_grad(largest_singular_value))(matrix)
    assert float(value) == pytest.approx(5)
    np.testing.assert_allclose(gradient, [[0.6, 0], [0.8, 0], [0, 0]], atol=1e-6)
    # A matrix whose singular values lie close together is the worst case: they come out a little too small.
    random = np.random.default_rng(0).normal(size=(40, 30)).astype(np.float32)
    exact = np.linalg.svd(random, compute_uv=False)[0]
    assert 0.85 * exact < float(jax.jit(largest_singular_value)(random)) <= exact * (1 + 1e-6)


def test_a_spectrally_normalised_decoder_has_kernels_of_size_one():
    rng = np.random.default_rng(0)
    params = {
        "a": {"kernel": 9 * rng.normal(size=(2, 2, 3, 5)), "bias": np.full(5, 7.0)},
        "b": np.zeros((2, 2)),
    }
    params = jax.tree.map(np.float32, params)
    normal = jax.jit(spectrally_normalised)(params)
    sizes = np.linalg.svd(np.asarray(normal["a"]["kernel"]).reshape(12, 5), compute_uv=False)
    assert (
        sizes[0] == pytest.approx(1, rel=0.05)
        and np.all(normal["a"]["bias"] == 7)
        and np.all(normal["b"] == 0)
    )

    context, window = make_context(), make_window()
    plain, bounded = (objectives.reconstruction(context, spectral_norm=n) for n in (False, True))
    latents = latents_of(draw(1, BATCH, 8))
    head = helpers.random_params(bounded.init)

    def losses(of, head):
        return of.loss(head, None, latents, window, jax.random.key(0))[0]

    pair = jax.jit(lambda head: (losses(bounded, head), losses(plain, spectrally_normalised(head))))(head)
    np.testing.assert_allclose(*pair, rtol=1e-5)
    # The kernel's size does not count, so its gradient has no share along the kernel.
    gradient = jax.jit(jax.grad(lambda head: losses(bounded, head).sum()))(head)
    along = np.sum(np.asarray(gradient["kernel"]) * head["kernel"])
    length = np.linalg.norm(gradient["kernel"]) * np.linalg.norm(head["kernel"])
    assert length > 0 and abs(along) < 1e-3 * length


@pytest.mark.parametrize("action", ["joined", "multiplied"])
def test_differences_two_steps_ahead(action):
    objective = objectives.forward_pixels(make_context(), steps=2, target="difference", action=action)
    window = make_window(horizon=2)
    window.valid[1, 1] = 0
    losses, head, _ = loss_of(objective, latents_of(draw(1, BATCH, 8)), window)
    target, output = objective.image(head, latents_of(draw(1, BATCH, 8)), window)
    frames = window.frames.astype(np.float32) / 255
    stacks = [np.moveaxis(frames[:, k : k + 4, :, :, 0], 1, -1) for k in (0, 2)]
    # The picture is of observations; the loss is of half of 1 + s_{t+2} - s_t, so half as far off.
    np.testing.assert_allclose(target, stacks[1], atol=1e-6)
    off = np.mean((output - target) ** 2, (1, 2, 3)) / 4
    np.testing.assert_allclose(losses, window.valid[:, 1] * off, rtol=1e-5)
    assert objective.horizon == 2 and losses[1] == 0 and np.all(np.delete(losses, 1) > 0)


def test_multiplied_actions_by_hand():
    gate = ActionGate()
    eye = {"kernel": np.eye(2), "bias": np.zeros(2)}
    params = {"latent": eye, "action": {"kernel": np.array([[2.0, 3.0]]), "bias": np.zeros(2)}, "out": eye}
    output = gate.apply({"params": params}, np.array([[1.0, 10.0]]), np.array([[1.0]]))
    np.testing.assert_allclose(output, [[2, 30]])


def test_a_variational_autoencoder_against_numpy():
    objective, key = objectives.vae(make_context(), beta=20.0), jax.random.key(5)
    z, window = 2 * draw(1, BATCH, 8), make_window()
    head = helpers.random_params(objective.init)
    losses, metrics = jax.jit(lambda head: objective.loss(head, None, latents_of(z), window, key))(head)
    log_variance = dense(head["log_variance"], z[0])
    noisy = z[0] + np.sqrt(np.exp(log_variance)) * np.asarray(jax.random.normal(key, (BATCH, 8)))
    pixels = np.moveaxis(window.frames[:, :STACK, :, :, 0], 1, -1).reshape(BATCH, -1) / 255
    error = ((noisy @ head["decoder"]["kernel"] - pixels) ** 2).mean(-1)
    divergence = (z[0] ** 2 + np.exp(log_variance) - 1 - log_variance).sum(-1) / 2
    np.testing.assert_allclose(losses, error + 20 * divergence / (6 * 6 * 4), rtol=1e-5)
    expected = {"squared_error": error.mean(), "divergence": divergence.mean()}
    assert metrics == pytest.approx(expected, rel=1e-5)


def test_what_is_corrupted_has_no_view_of_its_own():
    for option in ("noise=0.1", "masked=0.5"):
        losses = f"reconstruction:{option}", "inverse"
        given = Config(mode="joint", objectives=losses, srl_view="shift@each")
        with pytest.raises(ConfigError, match=f"^--srl_view=shift@each: reconstruction:{option} .*=shift$"):
            checks.check(given, given=["srl_view"])
    clean = ("reconstruction:noise=0,moving=1",)
    assert checks.check(dataclasses.replace(given, objectives=clean), given=["srl_view"]).srl_view


# Collapse


@pytest.fixture(scope="module")
def catch() -> Window:
    """The first windows of 32 games of Catch under a random policy, of one step."""
    env = make("Catch", num_envs=32, seed=0, frame_size=42)
    rng = np.random.default_rng(0)
    actions = [rng.integers(0, 3, 32) for _ in range(STACK)]
    frames = [env.reset()[0], *(env.step(a)[0] for a in actions)]
    env.close()
    ones = np.ones((32, 1), np.float32)
    return Window(
        frames=np.stack(frames, 1).reshape(32, STACK + 1, 42, 42, 1),
        actions=actions[-1][:, None].astype(np.int32),
        rewards=0 * ones,
        discounts=ones,
        valid=ones,
        weight=ones[:, 0],
    )


def rank_after_training(
    name: str, window: Window, updates: int = 100, **options: object
) -> tuple[float, float]:
    """The effective rank of the window's latents, their mean among them, before and after training.

    It is 1 where all latents are the same. The head learns 30 times as fast as the encoder, as the theory of
    self-prediction assumes (Tang et al. 2023, section 3).
    """
    encoder = encoders.tiny((42, 42, STACK), features=0)
    terms = {name: objectives.REGISTRY[name](Context.of(encoder, 3), **options)}
    optimizer = make_optimizer(terms)
    init = make_init(encoder, terms, MODES["pretrain"], optimizer)
    state = jax.jit(init)(jax.random.key(0))
    update = jax.jit(make_update(encoder, terms, MODES["pretrain"], optimizer))
    rates = {"encoder": 1e-3, "encoder_srl": 1e-3, "rl": 1e-3, "representation": 3e-2}
    hyper = Hyper({name: np.float32(1)}, {group: np.float32(rate) for group, rate in rates.items()})
    encode = jax.jit(encoder.apply)

    def rank() -> float:
        z = np.asarray(encode(state.params["encoder"], image(window, 0)), np.float64)
        shares = np.linalg.svd(z, compute_uv=False)
        shares = shares[shares > 1e-9 * shares[0]] / shares.sum()
        return float(np.exp(-np.sum(shares * np.log(shares))))

    before = rank()
    for _ in range(updates):
        state, _, _ = update(state, window, hyper)
    return before, rank()


def test_self_prediction_collapses_with_neither_slow_target_nor_stop_gradient(catch):
    ranks = {
        target: rank_after_training("forward_latent", catch, target=target, hidden=0, distance="cosine")
        for target in ("gradient", "stopped", "slow")
    }
    before, after = ranks["gradient"]
    kept = min(ranks["stopped"][1], ranks["slow"][1])
    assert after < 0.5 * before and after < 0.3 * kept and kept > 0.7 * before, ranks


def test_slowness_collapses_without_variability(catch):
    before, alone = rank_after_training("slowness", catch, variability=0.0)
    _, kept = rank_after_training("slowness", catch)
    assert alone < 0.5 * before and alone < 0.5 * kept and kept > 0.7 * before, (before, alone, kept)
