"""srl_jax/learning/optim.py against PyTorch's Adam written out in numpy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from srl_jax.learning.optim import NOT_MEASURED, make_optimizer, real_copy
from srl_jax.types import Objective
from tests.helpers import identical, to_numpy

RATES = {"encoder": 0.1, "rl": 0.01, "reconstruction": 0.001, "inverse": 0.001}
HEADS = {"rl": False, "reconstruction": True, "inverse": False}  # whether it is a decoder
OBJECTIVES = {name: Objective(None, None, is_decoder=decoder) for name, decoder in HEADS.items()}


def tree(seed):
    rng = np.random.default_rng(seed)
    leaf = lambda: {"kernel": rng.normal(size=(3, 2)).astype(np.float32)}  # noqa: E731
    return {name: leaf() for name in ("encoder", *HEADS)}


def leaves(params):
    """{group: kernel}."""
    return {group: tree["kernel"] for group, tree in params.items()}


def torch_adam(params, grads, *, eps=1e-8, decay=0.0, clip=0.0):
    """What `torch.nn.utils.clip_grad_norm_` and `torch.optim.Adam(weight_decay=...)` do, in float64."""
    params = {n: p.astype(np.float64) for n, p in leaves(params).items()}
    first, second = {n: 0.0 for n in params}, {n: 0.0 for n in params}
    for t, gradient in enumerate(map(leaves, grads), 1):
        norm = np.sqrt(sum((g.astype(np.float64) ** 2).sum() for g in gradient.values()))
        for n, p in params.items():
            g = gradient[n] * (min(1.0, clip / norm) if clip else 1.0)
            if HEADS.get(n):
                g = g + decay * p
            first[n] = 0.9 * first[n] + 0.1 * g
            second[n] = 0.999 * second[n] + 0.001 * g**2
            mean, square = first[n] / (1 - 0.9**t), second[n] / (1 - 0.999**t)
            params[n] = p - RATES[n] * mean / (np.sqrt(square) + eps)
    return params


def ours(params, grads, **options):
    names = {"decay": "decoder_weight_decay", "clip": "max_grad_norm", "eps": "adam_eps"}
    optimizer = make_optimizer(OBJECTIVES, **{names[n]: value for n, value in options.items()})
    state, norms, update = optimizer.init(params), [], jax.jit(optimizer.update)
    for i, gradient in enumerate(grads):
        params, state, norm = update(gradient, state, params, RATES, i != 1)
        norms.append(norm)
    return leaves(params), norms


@pytest.mark.parametrize(
    "options",
    [{}, {"decay": 0.3}, {"clip": 0.5, "eps": 0.1}, {"decay": 0.3, "clip": 0.5, "eps": 0.1}, {"clip": 1e3}],
    ids=str,
)
def test_steps_are_torch_adams_with_a_rate_for_each_group(options):
    # A large epsilon, since Adam alone would undo the scale that clipping gives a gradient.
    params, grads = tree(0), [tree(1), tree(2), tree(3)]
    moved, norms = ours(params, grads, **options)
    expected = torch_adam(params, grads, **options)
    for name in expected:
        np.testing.assert_allclose(moved[name], expected[name], rtol=1e-5, atol=1e-6, err_msg=name)
    # Norms are those before clipping; the encoder's was not asked for at the second step.
    encoder = [np.linalg.norm(gradient["encoder"]["kernel"]) for gradient in grads]
    np.testing.assert_allclose(
        [n["encoder"] for n in norms], [encoder[0], NOT_MEASURED, encoder[2]], rtol=1e-5
    )
    if "clip" in options:
        before = [np.sqrt(sum((g**2).sum() for g in leaves(gradient).values())) for gradient in grads]
        np.testing.assert_allclose([n["all"] for n in norms], before, rtol=1e-5)
    else:
        assert "all" not in norms[0]


def test_decay_changes_decoders_alone_and_by_hand():
    params, grads = tree(0), [tree(1)]
    plain, _ = ours(params, grads, eps=1.0)
    decayed, _ = ours(params, grads, eps=1.0, decay=0.5)
    for name in plain:
        assert np.array_equal(plain[name], decayed[name]) == (name != "reconstruction")
    # The first step of Adam: both moments, corrected, are g and g^2, so p - rate * g / (|g| + eps), where
    # decay has made g = gradient + 0.5 p.
    p, g = (leaves(t)["reconstruction"] for t in (params, grads[0]))
    g = g + 0.5 * p
    np.testing.assert_allclose(decayed["reconstruction"], p - 0.001 * g / (np.abs(g) + 1), rtol=1e-5)


def test_groups_that_are_left_out_keep_their_moments_and_their_count():
    # Three steps of two groups, of which the head misses the second, equal two steps of the head alone.
    optimizer = make_optimizer(OBJECTIVES)
    update = jax.jit(optimizer.update)
    params, grads = tree(0), [tree(1), tree(2), tree(3)]
    without = lambda t: {n: h for n, h in t.items() if n != "inverse"}  # noqa: E731
    state, some = optimizer.init(params), params
    some, state, _ = update(grads[0], state, some, RATES)
    moved, new_state, _ = update(without(grads[1]), state, without(some), RATES)
    assert set(moved) == {"encoder", "rl", "reconstruction"}
    some, state = some | moved, state | new_state
    some, _, _ = update(grads[2], state, some, RATES)
    two, _ = ours(params, [grads[0], grads[2]])
    three, _ = ours(params, grads)
    some = leaves(some)
    np.testing.assert_array_equal(some["inverse"], two["inverse"])
    for name in ("encoder", "rl", "reconstruction"):
        np.testing.assert_allclose(some[name], three[name], rtol=1e-6, err_msg=name)


def test_rates_are_traced():
    optimizer = make_optimizer(OBJECTIVES)
    params, grads = tree(0), tree(1)
    update = jax.jit(optimizer.update)
    state = optimizer.init(params)
    still, _, _ = update(grads, state, params, dict.fromkeys(RATES, 0.0))
    moved, _, _ = update(grads, state, params, dict.fromkeys(RATES, 0.1))
    assert identical(to_numpy(still), params) and not identical(to_numpy(moved), params)
    assert update._cache_size() == 1


def test_real_copy_survives_the_donation_of_its_original():
    params = jax.device_put({"kernel": np.ones((3, 2), np.float32), "key": jax.random.key(0)})
    copy = real_copy(params)
    jax.jit(lambda p: jax.tree.map(lambda x: x, p) | {"kernel": p["kernel"] + 1}, donate_argnums=0)(params)
    assert params["kernel"].is_deleted()
    np.testing.assert_array_equal(copy["kernel"], np.ones((3, 2)))
    assert float(jax.random.uniform(copy["key"])) == float(jax.random.uniform(jax.random.key(0)))


def test_a_group_of_another_pass_does_not_decay():
    params = {"rl": {"kernel": jnp.ones((2, 2))}, "own": {"kernel": jnp.ones((2, 2))}}
    optimizer = make_optimizer({}, weight_decay=0.5)
    nothing, rates = jax.tree.map(jnp.zeros_like, params), {"rl": 0.1, "own": 0.1}
    update = jax.jit(partial(optimizer.update, others=["rl"]))
    moved, _, _ = update(nothing, optimizer.init(params), params, rates)
    assert float(moved["rl"]["kernel"][0, 0]) == 1 and float(moved["own"]["kernel"][0, 0]) == pytest.approx(
        0.95
    )


def test_decoupled_decay_is_optax_adamws_but_for_what_has_one_axis():
    rng = np.random.default_rng(0)
    draws = [{"kernel": rng.normal(size=(3, 2)), "bias": rng.normal(size=2)} for _ in range(4)]
    params, *gradients = jax.tree.map(np.float32, draws)
    ours = make_optimizer({}, weight_decay=0.3)
    theirs = optax.adamw(0.01, weight_decay=0.3, mask=lambda tree: jax.tree.map(lambda x: x.ndim != 1, tree))
    moved, expected = {"rl": params}, params
    state, their_state, update = ours.init(moved), theirs.init(expected), jax.jit(ours.update)
    for gradient in gradients:
        moved, state, _ = update({"rl": gradient}, state, moved, {"rl": 0.01})
        steps, their_state = jax.jit(theirs.update)(gradient, their_state, expected)
        expected = optax.apply_updates(expected, steps)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7), moved["rl"], expected)
