"""Weights that are more than a number: ratios to RL's gradient, and schedules."""

import dataclasses
import functools
from functools import partial

import jax
import numpy as np
import pytest

from srl_jax import checks, objectives, specs
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.learning import modes, weights
from srl_jax.learning.agent import make_agent
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, make_optimizer
from srl_jax.learning.update import NORM_EVERY, Hyper, make_init, make_update, passes
from srl_jax.learning.weights import DECAY, make_norms
from srl_jax.run import loop, saving
from srl_jax.run.schedules import Schedules
from srl_jax.specs import Weight, parse_weight
from srl_jax.types import Objective
from tests.helpers import SMALL, make_context, make_encoder, make_window, random_state, rows_of, stop_after


@pytest.mark.parametrize(
    ("text", "start", "at_50", "at_100", "ratio"),
    [
        ("1->0.01@100", 1.0, 0.505, 0.01, False),
        ("0->2@1e2", 0.0, 1.0, 2.0, False),
        ("ratio:0.1", 0.1, 0.1, 0.1, True),
        ("ratio:0.2->0.1@100", 0.2, 0.15, 0.1, True),
    ],
)
def test_weights_by_hand(text, start, at_50, at_100, ratio):
    weight = parse_weight(text)
    assert float(weight) == weight.at(0) == start and weight.ratio == ratio
    assert weight.at(50) == pytest.approx(at_50) and weight.at(100) == weight.at(1000) == at_100
    again = parse_weight(repr(weight))
    assert again == weight != float(weight) + 1 and repr(again) == repr(weight)
    full = specs.parse(f"inverse:weight={text}", objectives.REGISTRY).full
    assert f"weight={weight!r}" in full and specs.parse(full, objectives.REGISTRY).full == full
    assert specs.has_ratio(full) == ratio


@pytest.mark.parametrize(
    "text",
    [
        "ratio:", "ratio:x", "ratio:-1", "share:0.1", "1->2", "1->@5", "1->2@0", "1->2@1.5", "1->-2@5", "1@5",
        "->1@5", "1->inf@5",
    ],
)  # fmt: skip
def test_what_is_no_weight(text):
    with pytest.raises(ConfigError, match=r"^--objective=inverse:weight=.* is (not a|a)"):
        specs.parse(f"inverse:weight={text}", objectives.REGISTRY, "objective")
    assert not specs.has_ratio(f"inverse:weight={text}")


@pytest.mark.parametrize("name", objectives.REGISTRY)
def test_every_objective_passes_its_weight_on(name):
    weight = Weight(0.1, ratio=True)
    assert objectives.REGISTRY[name](make_context(), weight=weight).weight is weight


def test_a_factory_that_makes_another_weight_of_it_is_refused(monkeypatch):
    def doubled(context, *, weight: float = 1.0):
        return objectives.inverse(context, weight=2 * weight)

    monkeypatch.setitem(objectives.REGISTRY, "doubled", doubled)
    config = Config(**{**SMALL, "mode": "joint", "objectives": ("doubled:weight=ratio:0.1",)})
    with pytest.raises(
        ConfigError, match=r"^--objective=doubled:weight=ratio:0.1: .* changes its weight; give a"
    ):
        make_agent(config, (42, 42, 1), 3)


# Ratios in updates of a small problem


ENCODER = make_encoder()


def noisy_linear(scale):
    """A loss whose gradient on the latent is a fixed direction, of a length that each batch draws."""

    def init(key):
        return {"w": jax.random.normal(key, (8,))}

    def loss(head, slow_head, latents, window, key):
        length = scale * jax.random.uniform(key, minval=0.5, maxval=1.5)
        return length * (latents.online(0) @ jax.lax.stop_gradient(head["w"])) + 0 * head["w"][0], {}

    return Objective(init, loss)


LOSSES = {
    RL: noisy_linear(3.0),
    "far": noisy_linear(1000.0)._replace(weight=Weight(0.1, ratio=True)),
    "near": noisy_linear(1e-4)._replace(weight=Weight(0.5, ratio=True)),
}


@functools.cache
def run_of(form, updates=60):
    """Metrics of each update of a run, with rates at which the encoder hardly moves."""
    optimizer, mode = make_optimizer(LOSSES), MODES["joint"]
    plan = passes(mode, LOSSES, form)
    state = random_state(make_init(ENCODER, LOSSES, mode, optimizer, plan=plan))
    rates = {"encoder": 1e-4, "encoder_srl": 0.0, RL: 0.0, "representation": 0.0}
    hyper = Hyper(
        {n: np.float32(x.weight) for n, x in LOSSES.items()}, {n: np.float32(x) for n, x in rates.items()}
    )
    update = jax.jit(make_update(ENCODER, LOSSES, mode, optimizer, plan=plan))
    norms = jax.jit(make_norms(ENCODER, LOSSES, mode, optimizer))
    found, window = [], make_window()
    for i in range(updates):
        if i % NORM_EVERY == 0:
            state = state._replace(norms=norms(state, window, hyper))
        state, _, metrics = update(state, window, hyper)
        found.append({**metrics, "norms": state.norms})
    return jax.device_get(found)


def test_a_ratio_holds_the_norm_of_an_objectives_gradient_on_the_encoder():
    last = run_of("summed")[-1]
    means = last["norms"]["gradient"]
    for name, ratio in (("far", 0.1), ("near", 0.5)):
        running = {n: last[f"running_gradient/{n}"] for n in (name, RL)}
        assert running == {n: means[n] for n in running}
        held = last[f"weight/{name}"] * running[name] / running[RL]
        assert held == pytest.approx(ratio, rel=1e-4)
    assert "step" not in last["norms"]


def test_the_mean_of_what_an_update_adds_is_within_a_fifth_of_the_ratio():
    rows = run_of("summed")
    own = [row["norms"]["gradient"] for row in rows[::NORM_EVERY]]
    # Single norms, from running means one after the other.
    singles = [
        {n: (now[n] - DECAY * before[n]) / (1 - DECAY) for n in now}
        for before, now in zip([dict.fromkeys(own[0], 0.0), *own], own, strict=False)
    ]
    for name, ratio in (("far", 0.1), ("near", 0.5)):
        added = np.mean(
            [row[f"weight/{name}"] * x[name] for row, x in zip(rows[::NORM_EVERY], singles, strict=True)]
        )
        assert added / np.mean([x[RL] for x in singles]) == pytest.approx(ratio, rel=0.2)


@pytest.mark.parametrize("form", ["separate", "simultaneous"])
def test_with_two_adams_ratios_hold_the_length_of_the_second_ones_step(form):
    rows = run_of(form)
    steps = [row["step_ratio/encoder"] for row in rows[::NORM_EVERY]]
    assert steps == pytest.approx([0.6] * len(steps), rel=0.2)  # the sum of the ratios
    assert steps[0] == pytest.approx(0.6, rel=1e-3)  # of the first steps, which no norm had seen


def test_a_ratio_that_nothing_was_measured_of_is_a_weight_and_zero_makes_none_of_infinity():
    start = weights.start(LOSSES, two_adams=False)
    numbers = {name: np.float32(x.weight) for name, x in LOSSES.items()}
    assert weights.factors(LOSSES, numbers, start) == pytest.approx(numbers)
    vanished = {"gradient": {RL: np.float32(3), "far": np.float32(0), "near": np.float32(6)}}
    found = weights.factors(LOSSES, numbers, vanished)
    assert found == pytest.approx({RL: 1, "far": 0.1, "near": 0.25})
    assert weights.start({RL: LOSSES[RL]}, two_adams=True) is None


# Runs


RUN = Config(
    **SMALL
    | dict(
        mode="joint", objectives=("inverse:weight=ratio:0.2->0.1@100",), srl_every=2, updates_per_step=0.5,
        num_envs=2, learn_start=20, log_every=20, steps=80, eval_every=80, eval_games=1, eval_max_steps=30,
        rl="dqn:hidden=16",
    )
)  # fmt: skip


def used(path):
    return [row["weight/inverse"] for row in rows_of(path) if "weight/inverse" in row]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """(agent, directory of a whole run)."""
    path = tmp_path_factory.mktemp("alone")
    agent = make_agent(RUN, (42, 42, 1), 3)
    loop.train(RUN, path, progress=False, agent=agent)
    return agent, path


def test_a_run_with_ratios_resumes_bit_identically(alone, tmp_path):
    agent, whole = alone
    with stop_after(56) as stop:
        loop.train(RUN, tmp_path, progress=False, agent=agent, stop=stop)
    saved = checkpoint.read_manifest(tmp_path)
    assert 0 < saved.updates < 30 and saved.updates % NORM_EVERY
    loop.train(RUN, tmp_path, progress=False, agent=agent, resume=saved)
    assert rows_of(whole) == rows_of(tmp_path)
    assert len(set(used(whole))) == 3 and min(used(whole)) > 0


def test_a_checkpoint_without_ratios_is_what_it_was_before_there_were_any():
    def kept(config: Config) -> set[str]:
        agent = make_agent(config, (42, 42, 1), 3)
        return set(jax.eval_shape(partial(saving.rest, agent), agent.shapes()))

    plain = kept(Config(**SMALL))
    assert plain == {"slow", "opt_state", "step", "key"} and kept(RUN) == {*plain, "norms"}


def test_a_seed_with_a_ratio_in_company_is_the_seed_alone(alone, tmp_path):
    paths = [tmp_path / name for name in ("s0", "s7")]
    for path in paths:
        path.mkdir()
    loop.train_seeds(RUN, [0, 7], paths, progress=False)
    together, other = map(used, paths)
    assert together == pytest.approx(used(alone[1]), rel=1e-3)
    assert together != pytest.approx(other, rel=1e-3)


def test_a_weight_changes_over_env_steps():
    terms = {
        RL: LOSSES[RL],
        "own": LOSSES["near"]._replace(weight=Weight(1.0, 0.0, 100)),
        **{"far": LOSSES["far"]},
    }
    hyper = Hyper({name: np.float32(x.weight) for name, x in terms.items()}, {})
    schedules = Schedules(Config(), hyper, terms)
    for env_steps, expected in ((0, 1.0), (25, 0.75), (1000, 0.0)):
        found = schedules.at(env_steps).hyper.weights
        assert (
            found == pytest.approx({RL: 1, "own": expected, "far": 0.1}) and found["own"].dtype == np.float32
        )
        assert schedules.weights(env_steps) == {"own": expected}
    plain = Schedules(Config(), hyper, {RL: LOSSES[RL]})
    assert plain.at(5).hyper is hyper and plain.weights(5) == {}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mode": "decoupled"}, "^--objective=inverse:weight=ratio:0.1: .*--mode=decoupled.* give a number$"),
        ({"mode": "pretrain"}, "^--objective=inverse:weight=ratio:0.1: .* give a number$"),
        ({"gate": "srl_stopped"}, "^--objective=inverse:weight=ratio:0.1: .*--gate=srl_stopped"),
        (
            {"objectives": ("inverse:weight=ratio:0.1", "latent_l2")},
            "^--objective=.* give all of them ratios",
        ),
        ({"lr_encoder_srl": 0.1}, "^--lr_encoder_srl=0.1: .* where inverse:weight=ratio:0.1 says how long"),
    ],
)
def test_a_ratio_of_nothing_is_refused(values, message):
    config = Config(**{"mode": "joint", "objectives": ("inverse:weight=ratio:0.1",), **values})
    with pytest.raises(ConfigError, match=message):
        checks.check(config)


def test_the_second_rate_of_ratios_is_nobodys_to_give():
    config = Config(mode="joint", objectives=("inverse:weight=ratio:0.1",), lr_srl=0.5)
    assert modes.second_learning_rate(config) == 0
    assert modes.second_learning_rate(dataclasses.replace(config, objectives=("inverse",))) == 0.5
