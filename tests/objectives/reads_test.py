"""Objectives that compute with parameters of another group: SPR by RL's first layer, a tied decoder."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders, objectives, plugins, rl, specs
from srl_jax.augment import UNCHANGED
from srl_jax.config import Config
from srl_jax.diagnostics.functions import make_functions
from srl_jax.encoders.convolutional import Layer, convolutional_encoder
from srl_jax.encoders.options import End, Start
from srl_jax.latents import make_losses
from srl_jax.layers import Conv, ConvTranspose
from srl_jax.learning.agent import components
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, RL_SRL, make_optimizer
from srl_jax.learning.resets import reset
from srl_jax.learning.update import Hyper, make_init, make_update, passes
from srl_jax.types import Context, Objective, TrainState
from tests import helpers
from tests.helpers import (
    NUM_ACTIONS,
    SIZE,
    STACK,
    all_zero,
    draw,
    latents_of,
    make_context,
    make_encoder,
    make_window,
)
from tests.objectives.by_numpy import dense, min_max, spr_distances

BATCH, D, STEPS = 4, 5, 2
RATES = dict.fromkeys(("encoder", "encoder_srl", RL, "representation"), np.float32(0.01))


def rl_and_spr(features: int = D, row: str = "c51", **options):
    """RL's algorithm, and SPR that projects by its first layer."""
    context = make_context(features)
    algorithm = rl.REGISTRY[row](context, hidden=3, **options)
    context = context._replace(rl_layer=algorithm.first_layer)
    return algorithm, context, objectives.spr(context, steps=STEPS, projection="rl")


@pytest.mark.parametrize(
    ("target", "options", "layers"),
    [
        ("slow", {}, ["q_hidden"]),
        ("stopped", {"dueling": True, "noisy": True}, ["q_hidden", "v_hidden"]),
        ("slow", {"dueling": True, "shared_hidden": True}, ["hidden"]),
    ],
)
def test_spr_by_the_first_layer_of_rl_against_numpy(target, options, layers):
    algorithm, context, _ = rl_and_spr(**options)
    objective = objectives.spr(context, steps=STEPS, projection="rl", target=target)
    z, slow = draw(STEPS + 1, BATCH, D), draw(STEPS + 1, BATCH, D, seed=1)
    window = make_window(horizon=STEPS)
    window.valid[2, 1:] = 0
    of_rl, lagged = (helpers.random_params(algorithm.objective.init, seed) for seed in (3, 4))
    own = helpers.random_params(objective.init)
    assert sorted(own) == ["predictor", "transition"]
    head, behind = (objective.head(own, objective.read({RL: x})) for x in (of_rl, lagged))
    losses, _ = jax.jit(lambda *args: objective.loss(*args, latents_of(z, slow), window, None))(head, behind)

    def project(tree, x):
        return np.concatenate([dense(tree[name], x) for name in layers], -1)

    below = lagged if target == "slow" else of_rl
    goals = [project(below, min_max(x)) for x in slow[1:]]
    distances = spr_distances(own, functools.partial(project, of_rl), goals, z[0], window.actions)
    np.testing.assert_allclose(losses, (distances * window.valid.T).mean(0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("mode", "form", "moves"),
    [
        ("joint", "separate", True),
        ("joint", "summed", True),
        ("decoupled", "separate", True),
        ("shut", "separate", False),
    ],
)
def test_sprs_gradient_moves_rls_first_layer_alone_where_the_gate_is_open(mode, form, moves):
    algorithm, _, objective = rl_and_spr(8, dueling=True, noisy=True, slow="none")
    mode = MODES["joint" if mode == "shut" else mode]._replace(representation_trains_encoder=mode != "shut")
    terms = {RL: algorithm.objective, "spr": objective}
    optimizer, plan = make_optimizer(terms), passes(mode, terms, form)
    init = make_init(make_encoder(), terms, mode, optimizer, plan=plan)
    state = helpers.random_state(init)
    update = jax.jit(make_update(make_encoder(), terms, mode, optimizer, plan=plan))
    hyper = Hyper({RL: np.float32(0), "spr": np.float32(1)}, RATES)  # RL's own gradient is 0
    new, _, _ = update(state, make_window(horizon=STEPS), hyper)
    changed = jax.tree.map(lambda a, b: bool(np.any(a != b)), new.params[RL], state.params[RL])
    means = {"kernel": moves, "bias": moves}
    first = means | {"kernel_sigma": False, "bias_sigma": False}
    last = dict.fromkeys(first, False)
    assert changed == {"q_hidden": first, "v_hidden": first, "q_out": last, "v_out": last}
    assert (RL_SRL in state.opt_state) == (len(plan) == 2)
    # The slow copy of the layer follows the online one by SPR's own rule, 0.99 of it stays.
    for stream in ("q_hidden", "v_hidden"):
        before, after, online = (
            x[stream]["kernel"]
            for x in (state.slow["spr"]["read"][RL], new.slow["spr"]["read"][RL], new.params[RL])
        )
        np.testing.assert_allclose(after, 0.99 * before + 0.01 * online, rtol=1e-5, atol=1e-7)


def test_what_the_gradients_of_two_passes_are_added_up_over():
    # Both losses reach the layer: one Adam's first step has the sign of the sum, and RL's is the larger.
    reads = {RL: lambda head: {"w": head["w"]}}
    term = Objective(lambda key: {}, lambda head, *_: (jnp.ones(BATCH) * 2 * head[RL]["w"], {}), reads=reads)
    of_rl = Objective(
        lambda key: {"w": jnp.zeros(())}, lambda head, *_: (-3 * jnp.ones(BATCH) * head["w"], {})
    )
    terms, mode = {RL: of_rl, "two": term}, MODES["joint"]
    moved = {}
    for form, gate in (("summed", "sum"), ("summed", "pcgrad"), ("simultaneous", "pcgrad")):
        plan, optimizer = passes(mode, terms, form), make_optimizer(terms)
        state = make_init(make_encoder(), terms, mode, optimizer, plan=plan)(jax.random.key(0))
        update = jax.jit(make_update(make_encoder(), terms, mode, optimizer, plan=plan, gate=gate))
        hyper = Hyper(dict.fromkeys(terms, 1.0), RATES)
        moved[form, gate] = float(update(state, make_window(horizon=1), hyper)[0].params[RL]["w"])
    assert moved["summed", "sum"] == moved["summed", "pcgrad"] == pytest.approx(0.01, rel=1e-4)
    assert moved["simultaneous", "pcgrad"] == pytest.approx(0, abs=1e-6)  # a step there, and one back


def test_the_group_that_is_read_moves_with_the_pass_that_reads_it():
    _, _, objective = rl_and_spr()
    terms = {RL: Objective(None, None), "spr": objective, "other": Objective(None, None)}
    first, second = passes(MODES["joint"], terms)
    assert first.groups == {RL: RL, "encoder": "encoder"}
    assert second.groups == {"spr": "spr", "other": "other", "encoder": "encoder_srl", RL: RL_SRL}
    (one,) = passes(MODES["decoupled"], terms)
    assert one.groups == {RL: RL, "spr": "spr", "other": "other", "encoder": "encoder"}
    with pytest.raises(ValueError, match="cannot be called rl_srl"):
        passes(MODES["joint"], ("rl_srl",))


def test_a_reset_of_rls_head_resets_its_copies_and_both_adams():
    algorithm, _, objective = rl_and_spr(8, slow="none")
    terms, mode = {RL: algorithm.objective, "spr": objective}, MODES["joint"]
    init = make_init(make_encoder(), terms, mode, make_optimizer(terms), plan=passes(mode, terms))
    old, fresh = (helpers.random_state(init, seed) for seed in (0, 1))
    ones = jax.tree.map(np.ones_like, old.opt_state)
    new = reset(old._replace(opt_state=ones), fresh, "head", 0.5)
    assert helpers.identical(new.slow["spr"]["read"], fresh.slow["spr"]["read"])
    assert helpers.identical(new.slow["spr"]["head"], old.slow["spr"]["head"])
    assert all_zero(new.opt_state[RL_SRL].mu) and helpers.identical(new.opt_state["spr"], ones["spr"])
    # What SPR projects by is before the last layers.
    new = reset(old._replace(opt_state=ones), fresh, "head_last", 0.5)
    assert helpers.identical(new.slow["spr"], old.slow["spr"])
    moments = new.opt_state[RL_SRL].mu
    assert helpers.identical(moments["q_hidden"], ones[RL_SRL].mu["q_hidden"]) and all_zero(moments["q_out"])


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"mode": "pretrain"}, "needs an RL head that is trained beside it"),
        ({"rl": "iqn"}, "begins with a linear layer over the latent"),
        ({"objectives": ("spr:projection=rk",)}, "projection: valid: own, rl"),
    ],
)
def test_spr_is_refused_a_layer_that_there_is_not(values, told):
    config = Config(**{**helpers.SMALL, "mode": "joint", "objectives": ("spr:projection=rl",), **values})
    with pytest.raises(specs.SpecError) as error:
        components(config, (42, 42, 1), NUM_ACTIONS)
    assert told in str(error.value) and str(error.value).startswith("--objective=spr:")
    assert "\n" not in str(error.value)


# A decoder with the encoder's kernels


def test_a_tied_decoder_by_hand():
    # z = 2 s and an image of 2 z = 4 s, at s = 1: (4 - 1)^2 = 9. Of w^2 s the slope in w is 2 w, so that the
    # loss' is 2 (4 - 1) 2 2 = 24; through one use alone it would be half of it.
    encoder = convolutional_encoder((1, 1, 1), [Layer(1, 1, 1)], Start(), End())
    objective = objectives.reconstruction(Context.of(encoder, 2), tied=True)
    assert objective.init(jax.random.key(0)) == {"ConvTranspose_0": {"bias": pytest.approx(0, abs=1)}}
    window = make_window(horizon=1, size=1)._replace(frames=np.full((BATCH, 2, 1, 1, 1), 255, np.uint8))
    terms = {"reconstruction": objective}
    state = TrainState(
        {
            "encoder": {"Conv_0": {"kernel": np.full((1, 1, 1, 1), 2, np.float32), "bias": np.zeros(1)}},
            "reconstruction": {"ConvTranspose_0": {"bias": np.zeros(1, np.float32)}},
        },
        {}, None, np.int32(0), jax.random.key(0),
    )  # fmt: skip
    for opens, slope in ((True, 24.0), (False, 0.0)):
        mode = MODES["pretrain"]._replace(representation_trains_encoder=opens)
        losses_of = make_losses(encoder, terms, mode, views=UNCHANGED)
        loss = lambda params: jnp.mean(losses_of(params, state, window)[0]["reconstruction"])  # noqa: B023, E731
        value, gradient = jax.jit(jax.value_and_grad(loss))(state.params)
        assert float(value) == pytest.approx(9)
        assert float(gradient["encoder"]["Conv_0"]["kernel"].sum()) == pytest.approx(slope)


@pytest.mark.parametrize(("name", "size"), [("nature:padding=same", 21), ("der", 23), ("tiny", 19)])
def test_a_tied_decoders_convolutions_are_the_transposes_of_the_encoders(name, size):
    spec = specs.parse(name, encoders.REGISTRY)
    encoder = plugins.build(spec, encoders.REGISTRY, (size, size, 2))
    decoder = encoder.make_tied_decoder()
    params = helpers.random_params(encoder.init)
    ((group, part),) = decoder.reads.items()
    kernels = part(params)
    shapes = jax.eval_shape(encoder.make_decoder().init, jax.random.key(0))
    assert group == "encoder" and len(kernels) == sum(layer.startswith("Conv_") for layer in params)
    for i, layer in enumerate(sorted(kernels)):
        of = params[f"Conv_{len(kernels) - 1 - i}"]["kernel"]
        assert kernels[layer]["kernel"].shape == shapes[layer]["kernel"].shape
        np.testing.assert_array_equal(kernels[layer]["kernel"], of.swapaxes(2, 3))
    # What a convolution takes from a pixel its transpose gives back to it: the adjoint, <C x, y> = <x, C' y>.
    side, stride = of.shape[0], {"nature": 4, "der": 5, "tiny": 4}[spec.name]
    x, conv = draw(1, 3 * stride + side, 3 * stride + side, of.shape[2]), Conv(of.shape[3], side, stride)
    zero = {"bias": np.zeros(of.shape[3], np.float32)}
    forward = lambda x: conv.apply({"params": {"kernel": of, **zero}}, x)  # noqa: E731
    y = draw(*jax.eval_shape(forward, x).shape, seed=1)
    back = ConvTranspose(of.shape[2], side, stride, x.shape[1:3])
    tied = {"kernel": of.swapaxes(2, 3), "bias": np.zeros(of.shape[2], np.float32)}
    both = jax.jit(lambda x, y: (back.apply({"params": tied}, y), jax.vjp(forward, x)[1](y)[0]))
    np.testing.assert_allclose(*both(x, y), rtol=1e-4, atol=1e-4)


def test_a_tied_decoder_needs_plain_convolutions():
    for encoder in (make_encoder(), encoders.impala((12, 12, 4))):
        with pytest.raises(ValueError, match="^tied=true needs an encoder of plain convolutions"):
            objectives.reconstruction(Context.of(encoder, 3), tied=True)


def test_pictures_and_decoder_errors_of_a_tied_decoder_are_made_by_the_encoders_kernels():
    encoder = convolutional_encoder((SIZE, SIZE, STACK), [Layer(2, 3, 1)], Start(), End(), features=3)
    terms = {"reconstruction": objectives.reconstruction(Context.of(encoder, 3), tied=True)}
    functions = make_functions(encoder, terms, MODES["pretrain"], channels=1)
    assert functions.groups == ("encoder", "reconstruction") and not functions.others
    init = make_init(encoder, terms, MODES["pretrain"], make_optimizer(terms))
    params, window = helpers.random_state(init).params, make_window(horizon=1)
    z = draw(BATCH, 3)
    _, errors, _, _ = functions.decode["reconstruction"](params, z, window)
    kernels = jax.tree.map(lambda x: 2 * x, params["encoder"])
    _, others, _, _ = functions.decode["reconstruction"](params | {"encoder": kernels}, z, window)
    assert errors.shape == (BATCH,) and not np.allclose(errors, others)
