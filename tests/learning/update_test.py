"""srl_jax/learning/update.py: who draws which noise, how slow copies follow, how an action is chosen."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax.augment import Views
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, make_optimizer
from srl_jax.learning.update import (
    Hyper,
    ema,
    follow_every,
    make_act,
    make_follow,
    make_init,
    make_update,
    passes,
    periodic,
)
from srl_jax.types import Encoder, Objective
from srl_jax.window import observation
from tests.helpers import all_moved, identical, make_window, to_numpy


def make_peek(weight=1.0, **options):
    """An objective of one number, whose metrics are its view, its latents and a draw of its key."""

    def loss(head, slow_head, latents, window, key):
        metrics = {
            "frames": window.frames,
            "online": latents.online(0),
            "slow": latents.slow(0),
            "noise": jax.random.normal(key, (3,)),
        }
        losses = jnp.mean(latents.online(0) ** 2, -1) + jnp.sum(head["w"] ** 2)
        return losses, metrics

    return Objective(lambda key: {"w": jax.random.normal(key, (3,))}, loss, weight, **options)


PIXELS = Encoder(  # its latent is the observation itself, times a number
    init=lambda key: {"scale": 1 + jax.random.uniform(key, (1,))},
    apply=lambda params, x: params["scale"] * (x.astype(jnp.float32) / 255).reshape(len(x), -1),
    features=6 * 6 * 4,
    observation_shape=(6, 6, 4),
    make_decoder=None,
)
SMALL = make_window()
RATES = dict.fromkeys(("encoder", "encoder_srl", RL, "representation"), np.float32(0.1))


def make_peeks(*names, mode="joint", every=2, clip=0.0, form="separate", target_encoder="slow", **options):
    """(init, update, hyper) of peeks by name; RL's has a slow copy."""
    terms = {name: make_peek(slow=periodic(every) if name == RL else None) for name in names}
    optimizer = make_optimizer(terms, max_grad_norm=clip)
    plan = passes(MODES[mode], terms, form)
    init = make_init(PIXELS, terms, MODES[mode], optimizer, plan=plan, target_encoder=target_encoder)
    update = make_update(PIXELS, terms, MODES[mode], optimizer, plan=plan, **options)
    return init, update, Hyper(dict.fromkeys(names, np.float32(1)), RATES)


def test_another_objective_changes_no_ones_noise_or_start():
    key = jax.random.key(1)
    alone, together = make_peeks(RL), make_peeks("first", RL, "peek")
    states = [init(key) for init, _, _ in (alone, together)]
    ours, theirs = (state.params for state in states)
    assert identical(ours["encoder"], theirs["encoder"])
    assert identical(ours[RL], theirs[RL])
    assert identical(states[0].slow[RL], states[1].slow[RL])
    heads = states[1].params
    assert not np.array_equal(heads["first"]["w"], heads["peek"]["w"])

    ours, theirs = (
        jax.jit(update)(state, SMALL, hyper)[2]
        for state, (_, update, hyper) in zip(states, (alone, together), strict=True)
    )
    np.testing.assert_array_equal(ours[f"{RL}/noise"], theirs[f"{RL}/noise"])
    noises = {theirs[f"{name}/noise"].tobytes() for name in ("first", RL, "peek")}
    assert len(noises) == 3


def test_noise_differs_between_updates_and_seeds():
    init, update, hyper = make_peeks(RL)
    update = jax.jit(update)
    noises = []
    for seed in (0, 1):
        state = init(jax.random.key(seed))
        for _ in range(3):
            state, _, metrics = update(state, SMALL, hyper)
            noises.append(np.asarray(metrics[f"{RL}/noise"]).tobytes())
    assert len(set(noises)) == 6


def test_an_update_of_some_objectives_leaves_the_others_alone():
    terms = {name: make_peek(slow=periodic(2) if name == RL else None) for name in (RL, "peek")}
    optimizer = make_optimizer(terms)
    plans = {names: passes(MODES["joint"], names, "summed") for names in (tuple(terms), (RL,))}
    init = make_init(PIXELS, terms, MODES["joint"], optimizer, plan=plans[tuple(terms)])
    hyper = Hyper(dict.fromkeys(terms, np.float32(1)), RATES)
    update = {
        names: jax.jit(make_update(PIXELS, terms, MODES["joint"], optimizer, plan=plan))
        for names, plan in plans.items()
    }
    start = init(jax.random.key(0))
    one, td_error, metrics = update[(RL,)](start, SMALL, hyper)
    assert "loss/peek" not in metrics and f"loss/{RL}" in metrics
    assert identical(one.params["peek"], start.params["peek"])
    assert identical(one.opt_state["peek"], start.opt_state["peek"])
    for tree in (lambda s: s.params[RL], lambda s: s.params["encoder"]):
        assert all_moved(tree(one), tree(start))
    # RL sees the same noise and moves its head alike, whether others are computed or not.
    both, _, _ = update[tuple(terms)](start, SMALL, hyper)
    np.testing.assert_allclose(one.params[RL]["w"], both.params[RL]["w"], rtol=1e-6)
    assert not identical(one.opt_state["encoder"], both.opt_state["encoder"])
    # In decoupled, the encoder is trained by what is left out, and so rests; Adam counts no step for it.
    plan = passes(MODES["decoupled"], (RL,))
    rests = jax.jit(make_update(PIXELS, terms, MODES["decoupled"], optimizer, plan=plan))
    after, _, _ = rests(start, SMALL, hyper)
    assert identical(after.params["encoder"], start.params["encoder"])
    assert identical(after.opt_state["encoder"], start.opt_state["encoder"])


def test_slow_copies_may_follow_apart_from_the_update():
    every_update = ema(0.9)
    cases = [
        ({RL: periodic(3)}, 3),
        ({RL: periodic(4), "a": periodic(6)}, 2),
        ({"a": every_update}, 1),
        ({}, 0),
    ]
    for rules, expected in cases:
        assert follow_every({name: make_peek(slow=rule) for name, rule in rules.items()}) == expected
    for rules in ({RL: periodic(2)}, {RL: periodic(2), "peek": every_update}):
        terms = {name: make_peek(slow=rules.get(name)) for name in (RL, "peek")}
        optimizer, hyper = make_optimizer(terms), Hyper(dict.fromkeys(terms, np.float32(1)), RATES)
        state = make_init(PIXELS, terms, MODES["joint"], optimizer)(jax.random.key(0))
        within, apart = (
            jax.jit(make_update(PIXELS, terms, MODES["joint"], optimizer, slow_follows=follows))
            for follows in (True, False)
        )
        follow, ours, theirs = jax.jit(make_follow(terms)), state, state
        for i in range(1, 5):
            ours, *_ = within(ours, SMALL, hyper)
            theirs, *_ = apart(theirs, SMALL, hyper)
            if i % follow_every(terms) == 0:
                theirs = follow(theirs)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours.slow, theirs.slow)


@pytest.mark.parametrize("target_encoder", ["slow", "online"])
def test_target_encoder(target_encoder):
    init, update, hyper = make_peeks(RL, every=3, target_encoder=target_encoder)
    update, state = jax.jit(update), init(jax.random.key(0))
    assert (state.slow[RL]["encoder"] == {}) == (target_encoder == "online")
    start = state.params["encoder"]["scale"]
    pixels = observation(SMALL, 0).reshape(len(SMALL.frames), -1) / 255
    for i in range(4):
        scale = state.params["encoder"]["scale"]
        state, _, metrics = update(state, SMALL, hyper)
        np.testing.assert_allclose(metrics[f"{RL}/online"], pixels * scale, rtol=1e-5)
        # Three updates on the first copy; the fourth sees the one that the third made.
        lagged = scale if target_encoder == "online" or i == 3 else start
        np.testing.assert_allclose(metrics[f"{RL}/slow"], pixels * lagged, rtol=1e-5)


def test_no_gradient_through_the_target_encoder():
    # A loss of the slow latents alone: nothing but the head, which has no gradient either, could move.
    def loss(head, slow_head, latents, window, key):
        return jnp.sum(latents.slow(0), -1) * head["w"], {}

    objective = Objective(lambda key: {"w": jnp.ones(())}, loss, slow=periodic(10))
    for target_encoder in ("slow", "online"):
        terms, options = {RL: objective}, {"target_encoder": target_encoder}
        optimizer = make_optimizer(terms)
        state = make_init(PIXELS, terms, MODES["joint"], optimizer, **options)(jax.random.key(0))
        update = make_update(PIXELS, terms, MODES["joint"], optimizer)
        after, _, _ = jax.jit(update)(state, SMALL, Hyper({RL: 1.0}, RATES))
        assert identical(state.params["encoder"], after.params["encoder"])
        assert not identical(state.params[RL], after.params[RL])


def test_an_objective_may_have_a_slow_copy_of_its_own_rule():
    terms = {RL: make_peek(slow=periodic(100)), "peek": make_peek(slow=ema(0.5))}
    optimizer = make_optimizer(terms)
    before = make_init(PIXELS, terms, MODES["joint"], optimizer)(jax.random.key(0))
    update = make_update(PIXELS, terms, MODES["joint"], optimizer)
    after, _, _ = jax.jit(update)(before, SMALL, Hyper({RL: 1.0, "peek": 1.0}, RATES))
    expected = 0.5 * after.params["peek"]["w"] + 0.5 * before.slow["peek"]["head"]["w"]
    np.testing.assert_allclose(after.slow["peek"]["head"]["w"], expected, rtol=1e-6)
    assert identical(after.slow[RL], before.slow[RL])
    assert not identical(after.slow["peek"]["encoder"], before.slow["peek"]["encoder"])


def test_numbers_may_change_without_another_trace():
    init, update, hyper = make_peeks(RL, "peek")
    update = jax.jit(chex.assert_max_traces(update, n=1))
    state = init(jax.random.key(0))
    scales = []
    for i in range(3):
        rates = dict.fromkeys(RATES, np.float32(10.0**-i))
        before = float(state.params["encoder"]["scale"][0])
        state, _, _ = update(state, SMALL, Hyper({RL: np.float32(i), "peek": np.float32(1)}, rates))
        scales.append(abs(float(state.params["encoder"]["scale"][0]) - before))
    assert scales[0] > scales[1] > scales[2] > 0  # and they have their effect


@pytest.mark.parametrize("tau", [0.0, 0.75, 0.99])
def test_ema_keeps_a_share_tau_of_the_copy(tau):
    # After three updates with the original at 1, a copy that started at 5 is 1 + 4 * tau ** 3.
    rule, copy = ema(tau), {"w": jnp.full(2, 5.0)}
    for step in (1, 2, 3):
        copy = rule({"w": jnp.ones(2)}, copy, step)
    np.testing.assert_allclose(copy["w"], 1 + 4 * tau**3, rtol=1e-6)


@pytest.mark.parametrize("tau", [-0.1, 1.0, float("nan")])
def test_an_ema_that_could_not_follow_is_refused(tau):
    with pytest.raises(ValueError, match="tau must be at least 0 and below 1"):
        ema(tau)


def test_state_can_be_donated_and_its_key_and_encoder_stay_the_callers():
    init, update, hyper = make_peeks(RL, "peek")
    key, encoder = jax.random.key(0), {"scale": jnp.ones(1)}
    update = jax.jit(update, donate_argnums=0)
    state = init(key, encoder)
    kept = state
    for _ in range(3):
        state, _, _ = update(state, SMALL, hyper)
    assert kept.params["encoder"]["scale"].is_deleted()  # it was donated
    assert float(encoder["scale"][0]) == 1.0
    jax.random.normal(key)
    assert int(state.step) == 3


def test_an_encoder_that_is_given_is_where_it_starts():
    init, _, _ = make_peeks(RL, mode="frozen")
    state = init(jax.random.key(0), {"encoder": {"scale": np.full(1, 7.0, np.float32)}})
    assert state.params["encoder"]["scale"] == state.slow[RL]["encoder"]["scale"] == 7
    # The heads start as without it.
    assert identical(state.params[RL], init(jax.random.key(0)).params[RL])


def test_seeds_may_be_vmapped_from_the_start():
    init, update, hyper = make_peeks(RL, "peek")
    keys = jax.random.split(jax.random.key(0), 2)
    both = jax.vmap(init)(keys)
    both, _, metrics = jax.jit(jax.vmap(update, (0, None, None)))(both, SMALL, hyper)
    update = jax.jit(update)
    for i in range(2):
        single, _, single_metrics = update(init(keys[i]), SMALL, hyper)
        ours = to_numpy(jax.tree.map(lambda x, i=i: x[i], both.params))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), ours, single.params)
        np.testing.assert_array_equal(metrics["peek/noise"][i], single_metrics["peek/noise"])
    assert all_moved(*(jax.tree.map(lambda x, i=i: x[i], both.params) for i in range(2)))
    assert not np.array_equal(*metrics["peek/noise"])


def test_weights_must_be_those_of_the_losses():
    init, update, hyper = make_peeks(RL, "peek")
    for weights in ({RL: 1.0}, {RL: 1.0, "peek": 1.0, "other": 1.0}):
        with pytest.raises(ValueError, match="weights .* for losses"):
            update(init(jax.random.key(0)), SMALL, hyper._replace(weights=weights))


def test_unknown_options_are_refused():
    with pytest.raises(ValueError, match="gate must be one of sum, .* not both"):
        make_update(PIXELS, {}, MODES["joint"], None, gate="both")
    with pytest.raises(ValueError, match="no view 'both'"):
        make_update(PIXELS, {RL: make_peek()}, MODES["joint"], None, views=Views("both"))
    with pytest.raises(ValueError, match="target_encoder"):
        make_init(PIXELS, {}, MODES["joint"], None, target_encoder="fast")
    with pytest.raises(ValueError, match="encoder_optimizer"):
        passes(MODES["joint"], (), "both")


def test_a_gate_that_is_shut_costs_no_differentiation():
    # In frozen, the encoder's gradient is not merely zero: it is not asked for.
    init, update, hyper = make_peeks(RL, mode="frozen", clip=1e9)
    state = init(jax.random.key(0))
    after, _, metrics = jax.jit(update)(state, SMALL, hyper)
    assert identical(after.params["encoder"], state.params["encoder"])
    gradient = 2 * np.asarray(state.params[RL]["w"])  # of the head's sum of squares
    np.testing.assert_allclose(metrics["grad_norm/all"], np.linalg.norm(gradient), rtol=1e-5)
    assert "grad_norm/encoder" not in metrics


# Acting

FRAMES = np.random.default_rng(0).integers(0, 256, (500, 4, 6, 6, 1), dtype=np.uint8)


def q_values(head, latents, key=None):
    """Values of 4 actions from the latent; noise of size 100 with a key."""
    q = latents[:, :4] + head
    return q if key is None else q + 100 * jax.random.normal(key, q.shape)


def run_act(noisy, step, epsilon, key=0):
    act = _acts[noisy]
    head = np.zeros(4, np.float32)
    return np.asarray(act({"scale": 1.0}, head, FRAMES, jax.random.key(key), step, np.float32(epsilon)))


_acts = {noisy: jax.jit(make_act(PIXELS, q_values, noisy=noisy)) for noisy in (False, True)}
# The latent's first four numbers are the four frames' first pixels, newest last.
GREEDY = FRAMES[:, :, 0, 0, 0].argmax(1)


def test_without_epsilon_and_noise_the_best_action_is_taken():
    actions = run_act(False, 3, 0.0)
    assert actions.dtype == np.int32
    np.testing.assert_array_equal(actions, GREEDY)


def test_epsilon_is_the_share_of_uniform_actions():
    # With epsilon 0.4, a share of 0.4 * 3 / 4 = 0.3 is not greedy; 500 draws, standard deviation 0.02.
    for epsilon, expected in ((0.4, 0.3), (1.0, 0.75)):
        actions = run_act(False, 3, epsilon)
        assert abs(np.mean(actions != GREEDY) - expected) < 0.08
    counts = np.bincount(run_act(False, 3, 1.0), minlength=4)
    assert counts.min() > 90  # 125 expected, standard deviation 10


def test_draws_depend_on_key_and_step_alone():
    base = run_act(False, 3, 1.0)
    np.testing.assert_array_equal(base, run_act(False, 3, 1.0))
    assert not np.array_equal(base, run_act(False, 4, 1.0))
    assert not np.array_equal(base, run_act(False, 3, 1.0, key=1))


def test_noise_is_for_training():
    noisy = run_act(True, 3, 0.0)
    assert np.mean(noisy != GREEDY) > 0.5
    assert not np.array_equal(noisy, run_act(True, 4, 0.0))
