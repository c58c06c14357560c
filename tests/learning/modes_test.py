"""srl_jax/learning/modes.py and agent.py: the mode x parameter-group matrix, of small but real runs."""

import functools

import jax
import numpy as np
import pytest

from srl_jax import encoders, objectives, rl
from srl_jax.config import Config
from srl_jax.learning.agent import make_agent
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, make_optimizer
from srl_jax.learning.update import ema, make_init, make_update, periodic
from srl_jax.types import Context
from tests.helpers import NUM_ACTIONS, all_moved, identical, make_window, random_state

TERMS = ("reconstruction", "inverse")
MOVES = {  # in two updates; all other groups of the mode stay bit-identical
    "rl_only": {"encoder", RL},
    "pretrain": {"encoder", *TERMS},
    "frozen": {RL},
    "finetuned": {"encoder", RL},
    "joint": {"encoder", RL, *TERMS},
    "decoupled": {"encoder", RL, *TERMS},
}
FRAME = 18  # the smallest that the tiny encoder takes
WINDOW = make_window(size=FRAME)


def small(mode, **values):
    """A small real configuration."""
    return Config(
        mode=mode,
        frame_size=FRAME,
        encoder="tiny:features=8",
        rl="rainbow:noisy=false,hidden=8,atoms=5,n_step=3",
        objectives=tuple(f"{name}:weight=0.5" for name in TERMS) if MODES[mode].representation else (),
        slow_update_every=2,
        lr_rl=1e-3,
        lr_srl=2e-3,
        **values,
    )


@functools.cache
def build(mode):
    """(agent, its update compiled quickly, an initial state on the host) of a small configuration."""
    agent = make_agent(small(mode), (FRAME, FRAME, 1), NUM_ACTIONS)
    return agent, jax.jit(agent.update.pure), random_state(agent.init)


@functools.cache
def two_updates(mode):
    """The states before, between and after, and the metrics of the first."""
    agent, update, state = build(mode)
    first, _, metrics = update(state, WINDOW, agent.hyper)
    second, _, _ = update(first, WINDOW, agent.hyper)
    assert agent.follow_every == (2 if agent.mode.rl else 0)
    if agent.follow_every:  # the loop's part
        second = jax.jit(agent.follow.__wrapped__)(second)
    return state, first, second, metrics


def test_the_matrix_knows_every_mode():
    assert set(MOVES) == set(MODES)


@pytest.mark.parametrize("mode", MODES)
def test_what_should_move_moves_and_the_rest_is_bit_identical(mode):
    before, _, after, metrics = two_updates(mode)
    present = {RL} if MODES[mode].rl else set()
    present |= set(TERMS) if MODES[mode].representation else set()
    assert set(before.params) == {"encoder"} | present
    for name, start in before.params.items():
        end = after.params[name]
        assert (all_moved if name in MOVES[mode] else identical)(start, end), name
    assert {name for name in metrics if name.startswith("loss/")} == {"loss/total"} | {
        f"loss/{name}" for name in present
    }


@pytest.mark.parametrize("mode", MODES)
def test_slow_copies_are_replaced_every_second_update_and_stay_in_between(mode):
    before, between, after, _ = two_updates(mode)
    if not MODES[mode].rl:
        assert before.slow == after.slow == {}
        return
    assert set(before.slow) == {RL}
    assert identical(before.slow, between.slow)
    for name, part in (("encoder", "encoder"), (RL, "head")):
        slow = after.slow[RL][part]
        assert identical(slow, after.params[name])
        # the newest, not the one before it (which a frozen encoder cannot tell)
        before_copy = between.params[name]
        assert identical(slow, before_copy) == (name not in MOVES[mode])


@pytest.mark.parametrize("mode", MODES)
def test_the_optimizer_keeps_state_for_what_moves_alone(mode):
    state, _, after, _ = two_updates(mode)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(state.opt_state)]
    for name in ("encoder", RL, *TERMS):
        assert any(f"'{name}'" in leaf for leaf in names) == (name in MOVES[mode]), name
    assert int(after.step) == 2


def test_the_encoder_learns_at_the_rate_of_its_trainer():
    rates = {
        "rl_only": 1e-3,
        "pretrain": 2e-3,
        "frozen": 0,
        "finetuned": 1e-3,
        "joint": 1e-3,
        "decoupled": 2e-3,
    }
    for mode, rate in rates.items():
        agent, _, _ = build(mode)
        found = {group: float(x) for group, x in agent.hyper.learning_rates.items()}
        expected = {"encoder": rate, "rl": 1e-3, "representation": 2e-3}
        expected["encoder_srl"] = 2e-3 if mode == "joint" else 0  # elsewhere the encoder has one Adam
        assert found == pytest.approx(expected), mode


def test_decoupled_rl_gradient_never_enters_the_encoder():
    weights = {RL: np.float32(100)}
    for mode, same in (("decoupled", True), ("joint", False)):
        agent, update, state = build(mode)
        heavy = agent.hyper._replace(weights=agent.hyper.weights | weights)
        ours, theirs = (update(state, WINDOW, hyper)[0].params for hyper in (agent.hyper, heavy))
        assert identical(ours["encoder"], theirs["encoder"]) == same
        # Nor a head; but with two Adams the representation's step starts from the encoder that RL's left.
        assert identical(ours["inverse"], theirs["inverse"]) == same
        assert not identical(ours[RL], theirs[RL])


def test_decoupled_trains_its_encoder_as_pretraining_does():
    # The same starts, names and losses: what RL adds beside them must not show in the encoder.
    (_, _, decoupled, _), (_, _, pretrain, _), (_, _, joint, _) = map(
        two_updates, ("decoupled", "pretrain", "joint")
    )
    close = lambda a, b: all(  # noqa: E731
        np.allclose(x, y, atol=1e-5) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    assert close(decoupled.params["encoder"], pretrain.params["encoder"])
    assert not close(joint.params["encoder"], pretrain.params["encoder"])


def test_the_total_is_the_weighted_sum_of_means():
    agent, update, state = build("joint")
    weights = {RL: np.float32(0.25), "reconstruction": np.float32(3), "inverse": np.float32(0)}
    _, _, metrics = update(state, WINDOW, agent.hyper._replace(weights=weights))
    expected = sum(weight * float(metrics[f"loss/{name}"]) for name, weight in weights.items())
    np.testing.assert_allclose(metrics["loss/total"], expected, rtol=1e-5)
    assert {name: float(w) for name, w in agent.hyper.weights.items()} == {RL: 1, **dict.fromkeys(TERMS, 0.5)}


def test_importance_weights_multiply_the_rl_loss_alone():
    agent, update, state = build("joint")
    light = WINDOW._replace(weight=np.full_like(WINDOW.weight, 0.25))
    (_, td_error, metrics), (_, light_td_error, light_metrics) = (
        update(state, window, agent.hyper) for window in (WINDOW, light)
    )
    assert td_error.shape == WINDOW.weight.shape
    np.testing.assert_array_equal(td_error, light_td_error)
    for name in (RL, *TERMS):
        factor = 0.25 if name == RL else 1.0
        np.testing.assert_allclose(light_metrics[f"loss/{name}"], factor * metrics[f"loss/{name}"], rtol=1e-6)


def test_no_td_error_without_rl():
    agent, update, state = build("pretrain")
    _, td_error, metrics = update(state, WINDOW, agent.hyper)
    assert td_error is None
    assert "inverse/accuracy" in metrics and "grad_norm/encoder" in metrics


def test_an_update_of_rl_alone_takes_over_and_returns_only_what_it_moves():
    agent = make_agent(small("joint", srl_every=2), (FRAME, FRAME, 1), NUM_ACTIONS)
    state = jax.tree.map(jax.numpy.asarray, random_state(agent.init))
    before = jax.tree.map(np.array, state.params)
    new, _, _ = agent.update_rl(state, WINDOW, agent.hyper)
    for name in TERMS:
        for old, same in ((state.params, new.params), (state.opt_state, new.opt_state)):
            assert all(a is b for a, b in zip(*map(jax.tree.leaves, (old[name], same[name])), strict=True))
    assert new.slow is state.slow and new.key is state.key
    assert all(x.is_deleted() for x in jax.tree.leaves((state.opt_state["encoder"], state.opt_state[RL])))
    # The old parameters may still act.
    assert identical(state.params, before)
    assert all_moved(before["encoder"], new.params["encoder"])
    assert int(new.step) == 1


@pytest.mark.parametrize(
    ("mode", "encoder", "algorithm"),
    [
        *(("joint", encoder, "rainbow" if encoder == "tiny" else "dqn") for encoder in encoders.REGISTRY),
        *(("rl_only", "tiny", algorithm) for algorithm in rl.REGISTRY),
        *((mode, "tiny", "rainbow") for mode in MODES if mode not in ("joint", "rl_only")),
    ],
)
def test_everything_is_float32_also_where_jax_may_use_64_bits(mode, encoder, algorithm):
    # Shapes and dtypes alone: nothing is compiled. Every objective is over tiny and beside RL; elsewhere are
    # those that ask for more than a latent.
    terms = objectives.REGISTRY if (mode, encoder) == ("joint", "tiny") else ("forward_pixels", "spr")
    terms = tuple(terms) if MODES[mode].representation else ()
    with jax.enable_x64(True):
        values = {"encoder": encoder, "rl": algorithm, "mode": mode, "max_grad_norm": 1.0}
        agent = make_agent(Config(objectives=terms, **values), (84, 84, 1), NUM_ACTIONS)
        state = jax.eval_shape(agent.init.__wrapped__, jax.random.key(0))
        window = make_window(horizon=agent.horizon, size=84)
        after = jax.eval_shape(agent.update.pure, state, window, agent.hyper)
    for leaf in jax.tree.leaves((state, *after)):
        assert leaf.dtype not in (np.float64, np.int64)


@functools.cache
def two_updates_by_rules(mode):
    """Rules, and the states before, between and after, where every loss has a rule of its own.

    An image, a slow encoder and actions stand for all objectives, whose slow copies are moved alike.
    """
    agent = make_agent(small(mode), (FRAME, FRAME, 1), NUM_ACTIONS)
    context = Context.of(agent.encoder, NUM_ACTIONS)
    terms = {n: o for n, o in agent.objectives.items() if n == RL}
    if MODES[mode].representation:
        names = ("reconstruction", "spr", "inverse")
        terms |= {name: objectives.REGISTRY[name](context) for name in names}
    rules = {name: periodic(2) if name == RL else ema(0.9 - 0.03 * i) for i, name in enumerate(terms)}
    terms = {name: objective._replace(slow=rules[name]) for name, objective in terms.items()}
    optimizer = make_optimizer(terms)
    state = random_state(make_init(agent.encoder, terms, MODES[mode], optimizer))
    update = jax.jit(make_update(agent.encoder, terms, MODES[mode], optimizer))
    hyper = agent.hyper._replace(weights=dict.fromkeys(terms, np.float32(1)))
    window = make_window(horizon=max(term.horizon for term in terms.values()) or 1, size=FRAME)
    states = [state]
    for _ in range(2):
        states.append(update(states[-1], window, hyper)[0])
    return rules, states


@pytest.mark.parametrize("mode", MODES)
def test_the_slow_copies_of_each_objective_move_by_its_rule_in_every_mode(mode):
    rules, states = two_updates_by_rules(mode)
    encoder_moves = "encoder" in MOVES[mode]
    assert all(set(state.slow) == set(rules) for state in states)
    for before, after in zip(states, states[1:], strict=False):
        for name, rule in rules.items():
            old, now = before.slow[name], after.slow[name]
            online = {"encoder": after.params["encoder"], "head": after.params[name]}
            expected = rule(online, old, after.step)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), now, expected)
            if name != RL:  # and it is a rule that moves them
                assert all_moved(now["head"], old["head"]), name
                assert all_moved(now["encoder"], old["encoder"]) == encoder_moves, name
    if RL in rules:
        start, between, end = (state.slow[RL] for state in states)
        assert identical(start, between)
        assert identical(end, {"encoder": states[2].params["encoder"], "head": states[2].params[RL]})
