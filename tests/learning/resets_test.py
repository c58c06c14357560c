"""srl_jax/learning/resets.py and annealing.py: what a reset leaves, and when; n and gamma after it."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments.presets import preset_values
from srl_jax import checks
from srl_jax.config import Config, resolve
from srl_jax.errors import ConfigError
from srl_jax.learning import annealing
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import make_optimizer
from srl_jax.learning.resets import kept, reset, reset_key
from srl_jax.learning.update import Hyper, make_init, passes, periodic
from srl_jax.objectives import REGISTRY
from srl_jax.rl import REGISTRY as ALGORITHMS
from srl_jax.rl import rainbow
from srl_jax.run import loop
from srl_jax.run.schedules import Schedules, printed
from srl_jax.types import TrainState
from tests.helpers import fill, identical, make_context, make_encoder

BBF, SR_SPR, SPR_RESETS = (
    Config(**preset_values(f"atari100k/{name}")) for name in ("bbf", "sr_spr", "spr_resets")
)
"""Of google-research's BBF.gin and SR_SPR.gin, with no reset where the next were past 100,000, and of
rl_with_resets' SPR_with_resets.gin, which has four."""


# What a reset leaves


@pytest.fixture(scope="module")
def states():
    """Two learners of RL, SPR and a decoder, (before, fresh), of random numbers; two Adams of the encoder."""
    context, encoder = make_context(), make_encoder()
    objectives = {
        "rl": rainbow(context, atoms=3, hidden=4).objective._replace(slow=periodic(5)),
        "spr": REGISTRY["spr"](context, steps=2, hidden=4),
        "reconstruction": REGISTRY["reconstruction"](context),
    }
    mode, optimizer = MODES["joint"], make_optimizer(objectives)
    init = make_init(encoder, objectives, mode, optimizer, plan=passes(mode, objectives))
    shapes = jax.eval_shape(init, jax.random.key(0))

    def state(seed: int, count: int) -> TrainState:
        filled = fill(shapes._replace(key=None, step=None), seed)
        counted = {n: x._replace(count=np.int32(count)) for n, x in filled.opt_state.items()}
        return filled._replace(step=np.int32(count), key="key", opt_state=counted)

    return state(1, 70), state(2, 0)


def test_a_head_is_reset_with_its_slow_copy_and_moments_and_nothing_else(states):
    before, fresh = states
    after = reset(before, fresh, "head", 0.5)
    assert identical(after.params, before.params | {"rl": fresh.params["rl"]})
    assert identical(after.opt_state, before.opt_state | {"rl": fresh.opt_state["rl"]})
    of_rl = {"encoder": before.slow["rl"]["encoder"], "head": fresh.slow["rl"]["head"]}
    assert identical(after.slow, before.slow | {"rl": of_rl})
    assert after.step == 70 and after.key == "key"


def test_the_last_layers_of_a_head_are_reset_and_what_it_has_before_them_stays(states):
    before, fresh = states
    after = reset(before, fresh, "head_last", 0.5)

    def last(old, new):
        return old | {name: new[name] for name in ("q_out", "v_out")}

    assert identical(after.params, before.params | {"rl": last(before.params["rl"], fresh.params["rl"])})
    old, new = before.opt_state["rl"], fresh.opt_state["rl"]
    own = old._replace(count=np.int32(0), mu=last(old.mu, new.mu), nu=last(old.nu, new.nu))
    assert identical(after.opt_state, before.opt_state | {"rl": own})
    old, new = before.slow["rl"], fresh.slow["rl"]
    of_rl = {"encoder": old["encoder"], "head": last(old["head"], new["head"])}
    assert identical(after.slow, before.slow | {"rl": of_rl})


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_head_has_last_layers_and_what_comes_before(name):
    shapes = jax.eval_shape(ALGORITHMS[name](make_context()).objective.init, jax.random.key(0))
    share = {layer: kept("head_last", "rl", (layer, "kernel"), 0.5) for layer in shapes}
    assert share == {layer: 0.0 if layer in ("q_out", "v_out") else 1.0 for layer in shapes}
    assert set(share.values()) == {0.0, 1.0}


def test_all_heads_are_reset_and_the_encoder_and_the_transition_are_shrunk(states):
    before, fresh = states
    after = reset(before, fresh, "all", 0.75)
    shrunk = partial(jax.tree.map, lambda old, new: 0.75 * old + 0.25 * new)
    assert identical(after.params["encoder"], shrunk(before.params["encoder"], fresh.params["encoder"]))
    for name in ("rl", "reconstruction"):
        assert identical(after.params[name], fresh.params[name])
        assert identical(after.opt_state[name], fresh.opt_state[name])
    spr, old, new = after.params["spr"], before.params["spr"], fresh.params["spr"]
    assert identical(spr, new | {"transition": shrunk(old["transition"], new["transition"])})
    for name in ("rl", "spr"):
        old, new = before.slow[name], fresh.slow[name]
        assert identical(after.slow[name]["encoder"], shrunk(old["encoder"], new["encoder"]))
    assert identical(after.slow["rl"]["head"], fresh.slow["rl"]["head"])
    # What is shrunk keeps its moments, in both Adams; where only a part does, the count starts again.
    for name in ("encoder", "encoder_srl"):
        assert identical(after.opt_state[name], before.opt_state[name])
    old, new = before.opt_state["spr"], fresh.opt_state["spr"]
    moments = {"transition": old.mu["transition"], "projection": new.mu["projection"]}
    assert identical({name: after.opt_state["spr"].mu[name] for name in moments}, moments)
    assert after.opt_state["spr"].count == 0


def test_a_share_of_1_leaves_the_encoder(states):
    before, fresh = states
    assert identical(reset(before, fresh, "all", 1.0).params["encoder"], before.params["encoder"])


def test_several_seeds_are_reset_as_each_alone(states):
    before, fresh = (state._replace(key=np.int32(0)) for state in states)
    stacked = partial(jax.tree.map, lambda *x: np.stack(x))
    both = stacked(before, fresh), stacked(fresh, before)
    reset_all = jax.jit(partial(reset, kind="all", shrink=0.3))
    alone = [reset_all(before, fresh), reset_all(fresh, before)]
    together = jax.device_get(reset_all(*both))
    for i, state in enumerate(alone):
        assert identical(jax.tree.map(lambda x: x[i], together), state)  # noqa: B023


def test_each_reset_draws_with_a_key_of_its_own():
    keys = [reset_key(jax.random.key(seed), number) for seed in (0, 1) for number in (1, 2)]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in (jax.random.key(0), *keys)}) == 5


# When, and n and gamma after it


def table(config, every):
    return [line.split() for line in printed(config, every)]


def test_no_update_comes_late_however_long_the_run():
    schedules = Schedules(Config(updates_per_step=0.7, num_envs=10, learn_start=0), Hyper({}, {}))
    assert [schedules.updates_due(10 * i) for i in (4_194_305, 2**40)] == [
        7 * (i + 1) for i in (4_194_305, 2**40)
    ]
    third = Schedules(Config(updates_per_step=1 / 3, num_envs=1, learn_start=0), Hyper({}, {}))
    assert [third.updates_due(i) for i in range(4)] == [0, 0, 1, 1]


def test_bbfs_schedule_of_100_000_steps():
    schedules = Schedules(BBF, Hyper({}, {}))
    steps = range(100_001)
    counts = [schedules.resets(step) for step in steps]
    assert [i for i in steps if i and counts[i] > counts[i - 1]] == [20_000, 40_000, 60_000, 80_000]
    # Two updates a step from 2,000 on; n and gamma are those of NumPy's geometric series, from each reset on.
    n = np.round(np.geomspace(10, 3, 10_001))
    gamma = 1 - np.geomspace(0.03, 0.003, 10_001)
    for step in range(2_000, 100_000, 37):
        for update in (0, 1):
            updates = 2 * (step - 2_000) + update
            since = min(updates if step < 20_000 else 2 * (step % 20_000) + update, 10_000)
            now = schedules.at(step, updates).gamma_and_n
            assert now["n_step"] == n[since]
            assert now["gamma"] == pytest.approx(gamma[since], abs=1e-12)
    assert table(BBF, 20_000) == [
        ["env_steps", "updates", "resets", "since_reset", "n_step", "gamma"],
        ["0", "0", "0", "0", "10", "0.97000"],
        ["20000", "36000", "1", "0", "10", "0.97000"],
        ["40000", "76000", "2", "0", "10", "0.97000"],
        ["60000", "116000", "3", "0", "10", "0.97000"],
        ["80000", "156000", "4", "0", "10", "0.97000"],
        ["100000", "196000", "4", "40000", "3", "0.99700"],
    ]
    # Half way, 2,500 steps after a reset: round(sqrt(10 * 3)) and 1 - sqrt(0.03 * 0.003).
    assert table(BBF, 22_500)[2] == ["22500", "41000", "1", "5000", "5", "0.99051"]


def test_sr_sprs_schedule_of_100_000_steps():
    lines = table(SR_SPR, 5_000)[1:]
    # Eight updates a step, 40,000 between two resets; the 19th is the last, n and gamma stay.
    assert [int(line[2]) for line in lines] == [*range(20), 19]
    assert [int(line[3]) for line in lines] == [0] * 20 + [40_000]
    assert {tuple(line[4:]) for line in lines} == {("-", "0.99000")}


def test_spr_is_reset_four_times_in_100_000_steps():
    # Two updates a step: 36,000 before the first reset, then 40,000 each.
    lines = table(SPR_RESETS, 20_000)[1:]
    assert [int(line[2]) for line in lines] == [0, 1, 2, 3, 4, 4]
    assert [int(line[1]) for line in lines] == [0, 36_000, 76_000, 116_000, 156_000, 196_000]


def test_resets_come_with_the_first_step_that_begins_then_or_later():
    config = Config(
        num_envs=8, learn_start=16, updates_per_step=0.5, reset="head", reset_every=20, n_anneal="3->1@2"
    )
    schedules = Schedules(config, Hyper({}, {}))
    assert [schedules.resets(step) for step in range(0, 65, 8)] == [0, 0, 0, 1, 1, 2, 2, 2, 3]
    # The step from 16 to 24 has the first four updates, those after 24 come after the first reset.
    assert [schedules.since_reset(step, updates) for step, updates in ((16, 3), (24, 4), (32, 9))] == [
        3,
        0,
        5,
    ]
    # A row is of the step that ended, which had not been reset yet.
    assert schedules.row(24, 4) == {"n_step": 1, "resets": 0}
    assert schedules.row(32, 8)["resets"] == 1


def test_what_is_measured_when_a_reset_is_due_has_the_n_of_what_was_learnt():
    config = Config(num_envs=8, learn_start=16, updates_per_step=0.5, reset="head", reset_every=20)
    schedules, measured = Schedules(dataclasses.replace(config, n_anneal="3->1@2"), Hyper({}, {})), []
    seed = SimpleNamespace(start_evaluation=lambda *given: measured.append(given[-1].gamma_and_n))
    run = SimpleNamespace(schedules=schedules, state=None)
    run.fetch, run.each = lambda: None, lambda state: [(seed, state)]
    for run.env_steps, run.updates in ((0, 0), (24, 4), (32, 8)):
        run.now = schedules.at(run.env_steps, run.updates)
        loop.Run.start_evaluation(run)
    # The step that begins at 24 starts with a reset, which makes n 3 again.
    assert measured == [{"n_step": 3}, {"n_step": 1}, {"n_step": 1}]
    assert schedules.at(24, 4).gamma_and_n == {"n_step": 3}


def test_without_flags_rows_and_windows_have_nothing_new():
    schedules = Schedules(Config(), Hyper({}, {}))
    assert schedules.row(100, 10) == {} and schedules.at(100, 10).gamma_and_n == {}


# What is refused

TERMINAL = {"mode": "joint", "objectives": ("terminal:hidden=0",)}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"n_anneal": "10-"}, "10-: not start->end@updates, in quotes for the shell: '10->3@10000'"),
        ({"n_anneal": "10->2.5@5"}, "--n_anneal=10->2.5@5: not start->end@updates"),
        ({"n_anneal": "10->0@5"}, "--n_anneal=10->0@5: 0 must be a whole number from 1"),
        ({"n_anneal": "10->3@0"}, "--n_anneal=10->3@0: must be annealed over at least 1 update"),
        ({"gamma_anneal": "0.9->1@5"}, "--gamma_anneal=0.9->1@5: 1.0 must be at least 0 and below 1"),
        ({"gamma_anneal": "0.9->0.997@5"}, "ends at --gamma, which is 0.99; give --gamma=0.997"),
        ({"gamma_anneal": "0.9->0.99@5", "mode": "pretrain"}, "--mode=pretrain, which trains no RL"),
        ({"gamma": 0.0, **TERMINAL}, "--gamma=0: a discount of 0 is how --objective=terminal knows"),
        ({"gamma_anneal": "0->0.99@5", **TERMINAL}, "--gamma_anneal=0->0.99@5: a discount of 0 is how"),
        ({"reset": "head"}, "--reset=head: give --reset_every"),
        ({"reset_every": 5}, "--reset_every=5: nothing reads it with --reset=none"),
        ({"reset_last": 5}, "--reset_last=5: nothing reads it with --reset=none"),
        ({"reset": "head", "reset_every": 9, "reset_last": 8}, "--reset_last=8: is before the first reset"),
        ({"reset": "head", "reset_every": 9, "shrink": 0.1}, "nothing reads it without --reset=all"),
        ({"reset": "all", "reset_every": 9, "mode": "pretrain"}, "nothing reads it in --mode=pretrain"),
        ({"reset": "all", "reset_every": 9, "mode": "frozen"}, "--mode=frozen never moves the encoder"),
    ],
    ids=str,
)  # fmt: skip
def test_what_makes_no_sense_is_refused_in_a_line(values, message):
    extra = {"objectives": ("inverse",)} if values.get("mode") == "pretrain" else {}
    extra |= {"encoder_from": "runs/x"} if values.get("mode") == "frozen" else {}
    with pytest.raises(ConfigError) as error:
        checks.check(Config(**values, **extra))
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", MODES)
def test_a_reset_of_the_head_makes_sense_in_every_mode_with_rl(name):
    mode = MODES[name]
    if mode.rl:
        objectives = ("inverse",) if mode.representation else ()
        start = "" if mode.encoder_start == "scratch" else "runs/x"
        checks.check(
            Config(mode=name, reset="head", reset_every=9, objectives=objectives, encoder_from=start)
        )


def test_a_schedule_that_means_the_same_is_the_same_configuration():
    registry = {"rainbow": lambda context, *, n_step=3: None}
    values = {"n_anneal": "3->1@1e4", "gamma_anneal": "0.90->0.99@1_000"}
    full = resolve(Config(**values), registry, {"nature": lambda shape: None}, {})
    assert (full.n_anneal, full.gamma_anneal) == ("3->1@10000", "0.9->0.99@1000")


def test_the_larger_n_is_that_of_rl():
    def resolved(rl, n_anneal="10->3@1e4"):
        registry = {
            "rainbow": lambda context, *, n_step=3, target="s_t+n": None,
            "own": lambda context, *, hidden=3: None,
        }
        return resolve(Config(rl=rl, n_anneal=n_anneal), registry, {"nature": lambda shape: None}, {})

    assert "n_step=10" in resolved("rainbow:n_step=10").rl
    for rl, message in (
        ("rainbow", "--rl has n_step=3; give --rl=:n_step=10"),
        ("own", "has no option n_step"),
    ):
        with pytest.raises(ConfigError, match=message):
            resolved(rl)
    # One step ahead of s_t less one is s_t itself.
    late = "rainbow:n_step=10,target=s_t+n-1"
    assert resolved(late, "10->2@5")
    with pytest.raises(ConfigError, match="--n_anneal=10->1@5: with --rl=:target=s_t.n-1 n is at least 2"):
        resolved(late, "10->1@5")


def test_a_schedule_is_written_as_it_is_read():
    for text, kind in (("10->3@10000", int), ("0.97->0.997@10000", float)):
        assert str(annealing.parse(text, kind)) == text
