"""srl_jax/objectives one by one, and what every row of both registries of losses has to keep.

A new row of `objectives.REGISTRY` or `rl.REGISTRY` inherits the tests of the second half.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import objectives, plugins, rl, specs
from srl_jax.latents import make_latents, shut
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, make_optimizer
from srl_jax.learning.update import Hyper, make_init, make_update, periodic
from srl_jax.objectives.latent_l2 import half_squared_norm
from srl_jax.types import Context, Objective, TrainState, Window
from srl_jax.window import image
from tests import helpers
from tests.helpers import SIZE, STACK, make_context, make_encoder, make_window

BATCH = 4

# One by one


def test_half_squared_norm_by_hand():
    assert float(half_squared_norm(np.array([3.0, -4.0]))) == 12.5  # (9 + 16) / 2


@pytest.mark.parametrize(("name", "offset"), [("reconstruction", 0), ("forward_pixels", 1)])
def test_decoders_are_compared_with_the_observation_at_their_offset(name, offset):
    row = build("objectives", name)
    target, output = row.picture(row.state, row.window)
    np.testing.assert_array_equal(target, image(row.window, offset))
    (_, (losses, _)), _ = row.probe(row.state, row.window, row.key)
    np.testing.assert_allclose(losses, ((output - target) ** 2).mean((1, 2, 3)), rtol=1e-4)


def test_forward_prediction_depends_on_the_action_of_its_row():
    row = build("objectives", "forward_pixels")
    actions = row.window.actions.copy()
    actions[1, 0] = (actions[1, 0] + 1) % helpers.NUM_ACTIONS
    (_, before), (_, after) = (
        row.picture(row.state, row.window._replace(actions=a)) for a in (row.window.actions, actions)
    )
    assert [np.array_equal(*pair) for pair in zip(before, after, strict=True)] == [True, False, True, True]


def test_inverse_needs_a_hidden_layer():
    with pytest.raises(ValueError, match="hidden"):
        objectives.inverse(make_context(), hidden=0)


def test_default_weights_are_the_thesis_ones():
    weights = {name: factory(make_context()).weight for name, factory in objectives.REGISTRY.items()}
    assert weights["reconstruction"] == weights["forward_pixels"] == 1.0
    assert weights["latent_l2"] == 1e-6
    assert objectives.inverse(make_context(), weight=0.25).weight == 0.25


@pytest.mark.parametrize("name", ["reconstruction", "forward_pixels"])
def test_a_decoder_that_is_not_there_is_told_in_one_line(name):
    spec = specs.parse(name, objectives.REGISTRY, "objective")
    message = f"^--objective={name}: it needs a decoder, and the encoder has none$"
    bare = Context.of(make_encoder()._replace(make_decoder=None), helpers.NUM_ACTIONS)
    for context in (Context(features=8, num_actions=3), bare):
        with pytest.raises(specs.SpecError, match=message):
            plugins.build(spec, objectives.REGISTRY, context)


def test_a_context_is_what_the_encoder_says():
    encoder = make_encoder(features=5)
    assert Context.of(encoder, 7) == (5, 7, encoder.make_decoder, None, None, None)
    assert Context.of(encoder._replace(map_shape=(2, 3, 4)), 7).map_shape == (2, 3, 4)


# Every row


class Row(NamedTuple):
    """A row of a registry, built and compiled once for all its tests.

    Attributes:
        probe: (state, window, key) -> ((mean, (losses, metrics)), (gradient of the parameters, of the slow
            copies)).
        shut_gradient: (state, window, key) -> the encoder's gradient with the gate shut.
        picture: (state, window) -> target, output.
        update, vmapped: of this objective alone; vmapped over states.
    """

    name: str
    objective: Objective
    state: TrainState
    init: Callable
    window: Window
    key: jax.Array
    probe: Callable
    shut_gradient: Callable
    picture: Callable
    update: Callable
    vmapped: Callable


@functools.cache
def build(kind: str, name: str) -> Row:
    encoder, context = make_encoder(), make_context()
    factory = {"objectives": objectives, "rl": rl}[kind].REGISTRY[name]
    options = {"hidden": 16} if "hidden" in specs.option_defaults(factory) else {}
    if name == "infonce":
        options["view"] = "shift"  # a crop of 6 pixels leaves nothing to learn
    objective = factory(context, **options)
    if kind == "rl":
        name, objective = RL, objective.objective._replace(slow=periodic(1000))
    terms = {name: objective}
    optimizer = make_optimizer(terms, adam_eps=1e-4)
    init = make_init(encoder, terms, MODES["joint"], optimizer)
    state = helpers.random_state(init)
    if state.slow:  # as it is between two copies: not the online one
        state = state._replace(slow=helpers.random_state(init, 1).slow)

    def loss(params, slow, window, key, gate=lambda latents: latents):
        own = slow.get(name, {"encoder": {}, "head": None})
        latents = gate(make_latents(encoder, params["encoder"], own["encoder"], window))
        losses, metrics = objective.loss(params[name], own["head"], latents, window, key)
        return jnp.mean(losses), (losses, metrics)

    def probe(state, window, key):
        return jax.value_and_grad(loss, (0, 1), has_aux=True)(state.params, state.slow, window, key)

    def shut_gradient(state, window, key):
        gradient, _ = jax.grad(loss, has_aux=True)(state.params, state.slow, window, key, gate=shut)
        return gradient["encoder"]

    def picture(state, window):
        latents = make_latents(encoder, state.params["encoder"], {}, window)
        return objective.image(state.params[name], latents, window)

    update = make_update(encoder, terms, MODES["joint"], optimizer)
    return Row(
        name=name,
        objective=objective,
        state=state,
        init=init,
        window=make_window(batch=BATCH, horizon=max(1, objective.horizon)),
        key=jax.random.key(7),
        probe=jax.jit(probe),
        shut_gradient=jax.jit(shut_gradient),
        picture=jax.jit(picture),
        update=jax.jit(update),
        vmapped=jax.jit(jax.vmap(update, (0, None, None))),
    )


ROWS = [("objectives", name) for name in objectives.REGISTRY] + [("rl", name) for name in rl.REGISTRY]
_BUILT = {name: factory(make_context()) for name, factory in objectives.REGISTRY.items()}
every_row = pytest.mark.parametrize(("kind", "name"), ROWS)


@every_row
def test_losses_are_finite_float32_one_for_each_row(kind, name):
    row = build(kind, name)
    (_, (losses, metrics)), _ = row.probe(row.state, row.window, row.key)
    assert losses.shape == (BATCH,) and losses.dtype == jnp.float32
    assert np.all(np.isfinite(losses)) and np.all(losses > 0)
    if kind == "rl":
        td_error = metrics.pop("td_error")
        assert td_error.shape == (BATCH,) and np.all(np.isfinite(td_error))
    for value in metrics.values():
        assert value.shape == () and np.isfinite(value)


@every_row
def test_gradients_reach_the_head_and_the_encoder_and_no_slow_copy(kind, name):
    row = build(kind, name)
    _, (gradient, slow) = row.probe(row.state, row.window, row.key)
    assert helpers.zero_leaves(gradient) == []
    assert helpers.all_zero(slow)
    if kind == "rl":
        assert slow[row.name]["encoder"] and slow[row.name]["head"]  # there was something to reach
    assert helpers.all_zero(row.shut_gradient(row.state, row.window, row.key))


@pytest.mark.parametrize("name", [name for name, term in _BUILT.items() if term.horizon])
def test_rows_whose_future_is_not_valid_add_nothing(name):
    row = build("objectives", name)
    valid = row.window.valid.copy()
    valid[1] = 0
    window = row.window._replace(valid=valid)
    other = window.frames.copy()
    other[1] = 255 - other[1]
    (_, (losses, _)), (gradient, _) = row.probe(row.state, window, row.key)
    _, (gradient_of_other, _) = row.probe(row.state, window._replace(frames=other), row.key)
    assert losses[1] == 0 and np.all(np.delete(losses, 1) > 0)
    assert helpers.identical(gradient, gradient_of_other)


@every_row
def test_importance_weights_are_for_rl_alone(kind, name):
    row = build(kind, name)
    weight = np.array([1, 0.5, 0.25, 0], np.float32)
    (_, (losses, metrics)), _ = row.probe(row.state, row.window, row.key)
    window = row.window._replace(weight=weight)
    (_, (weighted, weighted_metrics)), _ = row.probe(row.state, window, row.key)
    np.testing.assert_allclose(weighted, losses * weight if kind == "rl" else losses, rtol=1e-6)
    assert helpers.identical(metrics, weighted_metrics)  # td_error, too


@every_row
def test_training_on_one_batch_lowers_the_loss_and_vmapped_seeds_are_single_runs(kind, name):
    row = build(kind, name)
    rates = dict.fromkeys(("encoder", RL, "representation"), np.float32(3e-3))
    hyper = Hyper({row.name: np.float32(1)}, rates)
    singles = [helpers.random_state(row.init, seed) for seed in (0, 1)]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *singles)
    history = []
    for i in range(80):
        both, _, metrics = row.vmapped(both, row.window, hyper)
        history.append(metrics[f"loss/{row.name}"])
        if i < 2:
            singles = [row.update(state, row.window, hyper)[0] for state in singles]
        if i == 1:
            for seed, single in enumerate(singles):
                ours = jax.tree.map(lambda x, seed=seed: x[seed], (both.params, both.slow))
                jax.tree.map(
                    lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4),
                    ours,
                    (single.params, single.slow),
                )
    first, second = (jax.tree.map(lambda x, i=i: x[i], both.params) for i in range(2))
    assert helpers.all_moved(first, second)
    history = np.array(history)
    assert np.all(history[-5:].mean(0) < 0.95 * history[:5].mean(0)), history  # C51 cannot reach 0


@pytest.mark.parametrize("name", [name for name, term in _BUILT.items() if term.image])
def test_pictures_are_pairs_of_images(name):
    row = build("objectives", name)
    target, output = row.picture(row.state, row.window)
    for picture in (target, output):
        assert picture.shape == (BATCH, SIZE, SIZE, STACK) and picture.dtype == jnp.float32
    assert target.min() >= 0 and target.max() <= 1


@every_row
def test_who_has_views_of_its_own_has_an_option_that_says_which(kind, name):
    registry = {"objectives": objectives.REGISTRY, "rl": rl.REGISTRY}[kind]
    view = specs.option_defaults(registry[name]).get("view", "none")
    assert build(kind, name).objective.own_views == (view != "none")


@every_row
def test_decoder_heads_say_so(kind, name):
    # Decoder weight decay reaches what is marked; what draws the pictures is a decoder.
    row = build(kind, name)
    assert row.objective.is_decoder == (row.objective.image is not None)
