"""srl_jax/encoders/lix.py: how maps are mixed, and how their gradient tunes the radius."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders, objectives
from srl_jax.augment import UNCHANGED
from srl_jax.encoders.convolutional import RADIUS, Layer, convolutional_encoder
from srl_jax.encoders.lix import MOST, Mixing, discontinuity, mixed, moved, tuned
from srl_jax.encoders.options import End, Start
from srl_jax.latents import make_losses
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import make_optimizer
from srl_jax.learning.update import make_init, passes
from srl_jax.types import Context, Encoder
from tests import helpers
from tests.helpers import NUM_ACTIONS, SIZE, STACK, draw, make_window

MIXING = Mixing(1.0, 0.75)


def small(lix: Mixing | None) -> Encoder:
    return convolutional_encoder((SIZE, SIZE, STACK), [Layer(2, 3, 1)], Start(), End(), features=3, lix=lix)


def test_moving_by_hand():
    x = jnp.array([0.0, 10.0, 20.0])[None, :, None, None] * jnp.ones((1, 3, 2, 1))
    move = jax.jit(moved)
    down = move(x, jnp.array([0.25, 0.0]))[0, :, :, 0]
    np.testing.assert_allclose(down, np.repeat([[2.5], [12.5], [20.0]], 2, 1))  # the border is repeated
    up = move(jnp.swapaxes(x, 1, 2), jnp.array([0.0, -1.5]))[0, :, :, 0]
    np.testing.assert_allclose(up, np.repeat([[0.0, 0.0, 5.0]], 2, 0))
    np.testing.assert_array_equal(move(x, jnp.zeros(2)), x)


def test_shifts_stay_within_the_radius():
    ramp = jnp.arange(9.0)[None, :, None, None] * jnp.ones((2, 1, 9, 1))
    mix = jax.jit(lambda radius, i: mixed(ramp, radius, jax.random.key(i)) - ramp)
    by = [mix(np.float32(radius), i) for radius in (0.5, 9.0) for i in range(20)]
    middle = np.array([x[:, 4, 4, 0] for x in by]).reshape(2, 20, 2)
    assert np.all(middle[..., 0] == middle[..., 1])  # one draw for the batch
    largest = np.abs(middle[..., 0]).max(1)
    assert 0.3 < largest[0] <= 0.5 and 1.2 < largest[1] <= MOST


def test_discontinuity_by_hand():
    # Around 1 are five times 1 and three times -1: squares of differences are 12, of neighbours 8.
    gradient, score = np.float32([1.0, -1.0]).reshape(1, 1, 2, 1), jax.jit(discontinuity)
    assert float(score(gradient)) == pytest.approx(np.log(1 + 12 / 8), rel=1e-6)
    assert float(score(np.float32(1e-15) * gradient)) == pytest.approx(np.log(1 + 12 / 8), rel=1e-6)
    flat = np.ones((2, 3, 3, 1), np.float32)
    assert float(score(flat)) == 0 == float(score(0 * flat))


def test_discontinuity_against_numpy():
    gradient = draw(3, 4, 5, 2)
    mean = gradient.mean(0)
    padded = np.pad(mean, [(1, 1), (1, 1), (0, 0)], mode="edge")
    scores = []
    for (i, j, c), g in np.ndenumerate(mean):
        patch = padded[i : i + 3, j : j + 3, c]
        scores.append(np.log(1 + np.sum((patch - g) ** 2) / (np.sum(patch**2) - g**2)))
    assert float(jax.jit(discontinuity)(gradient)) == pytest.approx(np.mean(scores), rel=1e-5)


@pytest.mark.parametrize(
    ("radius", "goal", "expected"),
    [
        (1.0, 0.75, 0.75 - np.log(2.5)),  # not smooth enough: an optimizer that goes down raises S
        (MOST, 0.75, 0.0),
        (1.0, 1.5, 1.5 - np.log(2.5)),
        (0.0, 1.5, 0.0),
        (1.0, 0.0, 0.0),
    ],
)
def test_the_radius_goes_where_the_gradient_of_the_maps_is_as_smooth_as_the_goal(radius, goal, expected):
    weights = jnp.array([1.0, -1.0]).reshape(1, 1, 2, 1)

    def loss(x, s):
        return jnp.sum(weights * tuned(x, s, goal))

    to_maps, to_radius = jax.jit(jax.grad(loss, (0, 1)))(jnp.ones((1, 1, 2, 1)), jnp.float32(radius))
    np.testing.assert_array_equal(to_maps, weights)
    assert float(to_radius) == pytest.approx(expected, abs=1e-6)


def test_an_encoder_mixes_in_updates_alone():
    encoder, plain = small(MIXING), small(None)
    params = helpers.random_params(plain.init)
    mixing = params | {RADIUS: np.float32(1)}
    assert float(encoder.init(jax.random.key(0))[RADIUS]) == 1 and plain.train is None
    x = make_window().frames[:, :STACK, :, :, 0].transpose(0, 2, 3, 1)
    seen, train = jax.jit(plain.apply)(params, x), jax.jit(encoder.train)
    np.testing.assert_array_equal(jax.jit(encoder.apply)(mixing, x), seen)
    first, again, other = (train(mixing, x, jax.random.key(i)) for i in (0, 0, 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    unmixed = train(mixing | {RADIUS: np.float32(0)}, x, jax.random.key(0))
    np.testing.assert_allclose(unmixed, seen, rtol=1e-5)


def test_one_objectives_noise_does_not_depend_on_what_others_ask_for():
    encoder = small(MIXING)
    context = Context.of(encoder, NUM_ACTIONS)
    terms = {
        "latent_l2": objectives.latent_l2(context),
        "inverse": objectives.inverse(context, hidden=4),
        "barlow": objectives.barlow(context, hidden=0, outputs=3, view="none"),
    }
    mode, window = MODES["pretrain"], make_window(horizon=1)
    init = make_init(encoder, terms, mode, make_optimizer(terms), plan=passes(mode, terms))
    state = helpers.random_state(init)
    state = state._replace(
        params=state.params | {"encoder": state.params["encoder"] | {RADIUS: np.float32(1)}}
    )

    def total(params, names):
        losses_of = make_losses(encoder, {n: terms[n] for n in names}, mode, views=UNCHANGED)
        losses, _ = losses_of(params, state, window)
        return sum(map(jnp.mean, losses.values())), losses

    (_, together), gradient = jax.jit(lambda p: jax.value_and_grad(total, has_aux=True)(p, terms))(
        state.params
    )
    for name in terms:
        _, alone = jax.jit(lambda p, name=name: total(p, [name]))(state.params)
        np.testing.assert_allclose(alone[name], together[name], rtol=1e-5)
    assert gradient["encoder"][RADIUS] != 0
    state = state._replace(step=np.int32(1))
    _, later = jax.jit(lambda p: total(p, ["latent_l2"]))(state.params)
    assert not np.allclose(later["latent_l2"], together["latent_l2"])


def test_options_of_a_lix():
    assert (
        encoders.a_lix((20, 20, 4), lix=1.0).train is not None and encoders.a_lix((20, 20, 4)).train is None
    )
    with pytest.raises(ValueError, match="lix must be at most 2"):
        encoders.a_lix((20, 20, 4), lix=3.0)
