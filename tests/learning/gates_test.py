"""How RL's and the objectives' gradients meet in the encoder: by hand, and in whole updates."""

import functools

import jax
import numpy as np
import pytest

from srl_jax import checks
from srl_jax.errors import ConfigError
from srl_jax.learning.agent import make_agent
from srl_jax.learning.modes import GATES, MODES, PROJECTING
from srl_jax.learning.optim import PROJECTIONS, RL, make_optimizer
from srl_jax.learning.update import Hyper, make_init, make_update, passes
from srl_jax.types import Objective
from tests.helpers import NUM_ACTIONS, all_moved, identical, make_encoder, make_window, random_state
from tests.learning.modes_test import FRAME, TERMS, WINDOW, small


def two(x, y):
    """The vector (x, y) as a tree of two leaves, of which no rule must look at one alone."""
    return {"x": np.float32([x]), "y": np.float32([y])}


@pytest.mark.parametrize(
    ("gate", "rl", "srl", "expected"),
    [
        # (1, 0) and (-1, 1) have the product -1: (1, 0) + 1/2 (-1, 1), and (-1, 1) + (1, 0).
        ("pcgrad", (1, 0), (-1, 1), ((0.5, 0.5), (0, 1))),
        ("pcgrad", (3, 0), (-1, 1), ((1.5, 1.5), (0, 1))),
        ("pcgrad", (1, 0), (1, 1), ((1, 0), (1, 1))),  # no conflict
        ("pcgrad", (1, 2), (-2, -4), ((0, 0), (0, 0))),
        ("pcgrad", (0, 0), (1, 1), ((0, 0), (1, 1))),
        ("orthogonal", (1, 0), (-1, 1), ((1, 0), (0, 1))),
        ("orthogonal", (2, 0), (3, 1), ((2, 0), (0, 1))),  # also what agrees
        ("orthogonal", (1, 2), (5, 0), ((1, 2), (4, -2))),  # less 5/5 of (1, 2)
        ("orthogonal", (0, 0), (5, 1), ((0, 0), (5, 1))),
    ],
)
def test_two_vectors_by_hand(gate, rl, srl, expected):
    found = PROJECTIONS[gate](two(*rl), two(*srl))
    assert [(float(g["x"][0]), float(g["y"][0])) for g in found] == list(expected)


def test_a_projected_gradient_is_orthogonal_and_every_projection_has_a_gate():
    rng = np.random.default_rng(0)
    trees = [{"a": rng.normal(size=(3, 2)), "b": rng.normal(size=5)} for _ in range(2)]
    dot = lambda a, b: sum(float(np.vdot(a[k], b[k])) for k in a)  # noqa: E731
    rl, srl = PROJECTIONS["orthogonal"](*trees)
    assert rl is trees[0] and dot(rl, srl) == pytest.approx(0, abs=1e-5)
    against = {k: -x for k, x in trees[0].items()}
    against["b"] = against["b"] + 0.1
    rl, srl = PROJECTIONS["pcgrad"](trees[0], against)
    assert dot(rl, against) == pytest.approx(0, abs=1e-4) and dot(srl, trees[0]) == pytest.approx(0, abs=1e-4)
    assert tuple(PROJECTIONS) == PROJECTING and set(PROJECTING) < set(GATES)


ENCODER = make_encoder()


def linear(direction):
    """A loss whose gradient on the latent is constant, and a head that it pulls."""

    def loss(head, slow_head, latents, window, key):
        return latents.online(0) @ np.float32(direction) + head["w"], {}

    return Objective(lambda key: {"w": np.float32(0)}, loss)


LOSSES = {
    RL: linear([1, 0, 0, 0, 0, 0, 0, 2]),
    "a": linear([-1, 1, 0, 0, 0, 0, 0, 0]),
    "b": linear([0, 0, 1, 0, 0, 0, 0, 0]),
}
NUMBERS = {RL: np.float32(1), "a": np.float32(3), "b": np.float32(0.5)}


@functools.cache
def one_update(gate, form, active=tuple(LOSSES)):
    """State before, after, and metrics; the moments after one update are a tenth of the gradient."""
    terms = {name: LOSSES[name] for name in active}
    optimizer, mode = make_optimizer(terms), MODES["joint"]
    plan = passes(mode, terms, form)
    state = random_state(make_init(ENCODER, terms, mode, optimizer, plan=plan))
    rates = dict.fromkeys(("encoder", "encoder_srl", RL, "representation"), np.float32(0.01))
    update = jax.jit(make_update(ENCODER, terms, mode, optimizer, plan=plan, gate=gate))
    after, _, metrics = update(state, make_window(), Hyper({n: NUMBERS[n] for n in active}, rates))
    return state, after, metrics


def gradients(form, gate):
    """What the Adams of the encoder saw: one gradient or two."""
    _, after, _ = one_update(gate, form)
    found = [after.opt_state[name].mu for name in ("encoder", "encoder_srl") if name in after.opt_state]
    return [np.asarray(jax.tree.leaves(mu)[0]) * 10 for mu in found]


@pytest.mark.parametrize("gate", PROJECTING)
def test_the_update_hands_adam_what_the_projection_makes_of_the_two_gradients(gate):
    rl, srl = gradients("simultaneous", "sum")
    assert np.vdot(rl, srl) < 0
    expected = PROJECTIONS[gate](rl, srl)
    found = gradients("simultaneous", gate)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6)
    assert not np.allclose(found[1], srl, rtol=1e-2)
    (summed,) = gradients("summed", gate)
    np.testing.assert_allclose(summed, sum(expected), rtol=1e-4, atol=1e-6)
    (plain,) = gradients("summed", "sum")
    np.testing.assert_allclose(plain, rl + srl, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("form", ["summed", "simultaneous"])
def test_heads_and_losses_do_not_notice_a_gate(form):
    start, plain, metrics = one_update("sum", form)
    for gate in PROJECTING:
        _, projected, seen = one_update(gate, form)
        for name in LOSSES:
            assert identical(plain.params[name], projected.params[name])
        assert not identical(plain.params["encoder"], projected.params["encoder"])
        assert set(seen) == set(metrics)
        for name in ("loss/total", *(f"loss/{name}" for name in LOSSES)):
            np.testing.assert_allclose(seen[name], metrics[name], rtol=1e-6)
    assert all_moved(start.params["encoder"], plain.params["encoder"])


def test_one_kind_of_loss_meets_nothing():
    for active in ((RL,), ("a", "b")):
        plain, projected = (one_update(gate, "summed", active)[1] for gate in ("sum", "pcgrad"))
        assert identical(plain.params, projected.params)


def test_two_steps_one_after_the_other_have_no_projection():
    with pytest.raises(ValueError, match="gate pcgrad takes both gradients at the same parameters"):
        one_update("pcgrad", "separate")


# In a real agent: the rows of modes_test's matrix, by gate


@functools.cache
def stepped(gate, form="summed", mode="joint"):
    """(agent, its update, before, after one update) of a small real configuration."""
    agent = make_agent(small(mode, gate=gate, encoder_optimizer=form), (FRAME, FRAME, 1), NUM_ACTIONS)
    state, update = random_state(agent.init), jax.jit(agent.update.pure)
    return agent, update, state, update(state, WINDOW, agent.hyper)[0]


@pytest.mark.parametrize("gate", GATES)
def test_every_head_and_the_encoder_move_under_every_gate(gate):
    _, _, before, after = stepped(gate)
    assert all(all_moved(before.params[name], after.params[name]) for name in ("encoder", RL, *TERMS))


def test_a_mode_is_the_name_of_a_gate():
    agent, _, before, gated = stepped("rl_stopped", "separate")
    *_, decoupled = stepped("sum", "separate", "decoupled")
    assert identical(gated.params, decoupled.params) and "encoder_srl" not in before.opt_state
    assert float(agent.hyper.learning_rates["encoder"]) == pytest.approx(2e-3)  # the representation's


def test_objectives_that_look_on_leave_the_encoder_to_rl():
    for gate, same in (("srl_stopped", True), ("sum", False)):
        agent, update, state, after = stepped(gate)
        heavy = agent.hyper._replace(weights=agent.hyper.weights | dict.fromkeys(TERMS, np.float32(100)))
        other = update(state, WINDOW, heavy)[0]
        assert identical(after.params["encoder"], other.params["encoder"]) == same
        assert identical(after.params[RL], other.params[RL])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("gate", GATES)
def test_a_gate_is_refused_where_no_two_gradients_meet(mode, gate):
    start = {"encoder_from": "x"} if MODES[mode].encoder_start == "checkpoint" else {}
    config = small(mode, gate=gate, encoder_optimizer="summed", **start)
    if mode == "joint" or gate == "sum":
        assert checks.check(config, given=["gate"]).gate == gate
        return
    with pytest.raises(
        ConfigError, match=f"^--gate={gate}: .* in --mode={mode}, where .*modes that do: joint"
    ):
        checks.check(config, given=["gate"])
    assert checks.check(config, given=[]).gate == "sum"  # a preset's


@pytest.mark.parametrize("gate", GATES)
def test_a_projection_is_refused_where_the_second_gradient_comes_later(gate):
    config = small("joint", gate=gate)  # separate
    if gate not in PROJECTING:
        assert checks.check(config, given=["gate"]).gate == gate
        return
    with pytest.raises(
        ConfigError, match=f"^--gate={gate}: .*=separate .* give --encoder_optimizer=summed or"
    ):
        checks.check(config)


@pytest.mark.parametrize(
    ("mode", "gate"), [(m, "sum") for m in MODES] + [("joint", "rl_stopped"), ("joint", "srl_stopped")]
)
def test_a_second_rate_is_refused_with_what_leaves_the_encoder_one_optimizer_or_none(mode, gate):
    start = {"encoder_from": "x"} if mode in ("frozen", "finetuned") else {}
    config = small(mode, gate=gate, lr_encoder_srl=0.1, **start)
    if (mode, gate) == ("joint", "sum"):
        assert checks.check(config, given=["lr_encoder_srl"]).lr_encoder_srl == 0.1
        return
    reason = f"with --gate={gate}, where" if mode == "joint" else f"in --mode={mode}, where RL and"
    reason = "in --mode=frozen, which never moves the encoder" if mode == "frozen" else reason
    with pytest.raises(
        ConfigError, match=f"^--lr_encoder_srl=0.1: nothing reads it {reason}.* leave it out$"
    ):
        checks.check(config, given=["lr_encoder_srl"])
