"""Tests of srl_jax.config and of srl_jax.learning.modes, which a config is checked against."""

import dataclasses
import datetime
import json
import os
import subprocess

import hypothesis
import pytest
from hypothesis import strategies as st

from srl_jax import checks
from srl_jax import config as config_module
from srl_jax.config import INFOS, Config, difference, resolve
from srl_jax.errors import ConfigError
from srl_jax.files import provenance
from srl_jax.learning import modes
from srl_jax.specs import LIMITS


def _rl(context, *, n_step: int = 3, alpha: float = 0.5):
    return context, n_step, alpha


def _encoder(shape, *, features: int = 256):
    return shape, features


def _objective(context, *, weight: float = 1.0):
    return context, weight


REGISTRIES = {"rainbow": _rl}, {"nature": _encoder}, {"first": _objective, "second": _objective}


def test_defaults_are_table_5_1():
    # The rows of the thesis' table 5.1 that are not options of --rl.
    table = {
        "eps_eval": 0.005, "eps_train": 1.0, "eps_final": 0.05, "buffer_size": 100_000,
        "lr_rl": 1e-4, "gamma": 0.99, "beta": 0.4, "beta_final": 1.0,
        "beta_anneal_steps": 5_000_000, "slow_update_every": 500, "steps": 50 * 100_000,
        "eval_every": 100_000, "num_envs": 10, "updates_per_step": 0.1, "batch_size": 32,
        "eval_games": 10, "frame_stack": 4,
    }  # fmt: skip
    assert {name: getattr(Config(), name) for name in table} == table


def _values(name, info):
    if info.choices:
        return st.sampled_from(info.choices)
    if info.kind is bool:
        return st.booleans()
    if info.kind is tuple:
        return st.lists(st.text(max_size=8), max_size=3).map(tuple)
    if info.kind is str:
        return st.text(max_size=8)
    if info.kind is int:
        return st.integers(info.minimum, info.maximum or LIMITS[int])
    low = info.above if info.minimum is None else info.minimum
    low = -LIMITS[float] if low is None else low
    values = st.floats(
        low,
        info.maximum or LIMITS[float],
        exclude_min=info.above is not None,
        allow_nan=False,
        allow_infinity=False,
    )
    return values | st.none() if info.optional else values


@st.composite
def _configs(draw):
    values = {
        name: draw(_values(name, info))
        for name, info in INFOS.items()
        if name not in ("game", "frame_size", "buffer_size", "batch_size", "learn_start")
    }
    return Config(**values)


@hypothesis.given(_configs())
@hypothesis.settings(deadline=None, max_examples=8, suppress_health_check=[hypothesis.HealthCheck.too_slow])
def test_json_round_trip_is_exact(config):
    again = Config.from_json(config.to_json())
    assert again == config
    assert again.to_json() == config.to_json()
    for name in INFOS:
        assert type(getattr(again, name)) is type(getattr(config, name))


def test_a_whole_number_is_a_float_where_a_float_is_meant():
    assert type(Config(gamma=1).gamma) is float
    assert Config(gamma=1).to_json() == Config(gamma=1.0).to_json()


@pytest.mark.parametrize("name", [n for n, i in INFOS.items() if i.kind in (int, float)])
def test_every_number_is_limited(name):
    info = INFOS[name]
    bad = [float("nan"), float("inf"), "1", True]
    if not info.optional:  # A return may be negative; no other number may.
        bad.append(info.kind(-1))
    if info.above is not None:
        bad.append(info.above)
    if info.maximum is not None:
        bad.append(info.maximum + 1)
    for value in bad:
        with pytest.raises(ConfigError, match=f"^--{name}=") as error:
            Config(**{name: value})
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"game": "Pogn"}, "--game=Pogn: did you mean Pong?"),
        ({"game": "catch:ball=99"}, "--game=catch:ball=99: ball must be at least 1 and at most 12"),
        ({"game": "catch:ball=1", "frame_size": 50}, "--frame_size=50: --game=catch:ball=1 knows 42 and 84"),
        ({"mode": "jiont"}, "--mode=jiont: did you mean joint?"),
        ({"augment": "both"}, "--augment=both: valid: none, srl, all"),
        ({"objectives": "first"}, "--objective='first': not a tuple of texts, as ("),
        ({"objectives": (1,)}, "--objective=(1,): not a tuple of texts, as ("),
        ({"game": "Catch", "frame_size": 50}, "--frame_size=50: --game=Catch knows 42 and 84"),
        ({"buffer_size": 20}, "--batch_size=32: must be at most --buffer_size=20"),
        ({"steps": 2**31}, "--steps=2147483648: must be at most 2147483647"),
        ({"lr_rl": 1e39}, "--lr_rl=1e+39: must be at most 3.402823466e+38"),
        ({"adam_eps": 1e-50}, "--adam_eps=1e-50: must be at least 1e-37"),
        ({"num_envs": 10_001}, "--num_envs=10001: must be at most 10000"),
        ({"learn_start": 100_001}, "--learn_start=100001: must be at most --buffer_size=100000"),
    ],
)
def test_values_that_are_refused(values, message):
    with pytest.raises(ConfigError) as error:
        Config(**values)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[]", "not a JSON object"),
        ('{"gamee": "Pong"}', "did you mean game?"),
        ('{"steps": 1.5}', "--steps=1.5"),
        ('{"gamma": NaN}', "--gamma=nan"),
        ('{"gamma": 1' + "0" * 400 + "}", "--gamma=1000"),
        ('{"seed": 1, "seed": 2}', "'seed' is there twice"),
        ("[" * 100_000, "nested too deeply"),
        (b'{"game": "\xff"}', "not JSON"),
    ],
)
def test_json_that_is_refused(text, message):
    with pytest.raises(ConfigError) as error:
        Config.from_json(text)
    assert message in str(error.value)


def test_save_and_load(tmp_path):
    config = Config(game="Catch", objectives=("first:weight=0.1",), stop_at_return=-1.5)
    config.save(tmp_path)
    assert Config.load(tmp_path) == config
    saved = json.loads((tmp_path / "config.json").read_text())
    assert saved["versions"].keys() >= {"python", "platform", "jax", "numpy"}
    assert "git_revision" in saved
    assert datetime.datetime.fromisoformat(saved["started"]) and saved["cpus"] >= 1
    with pytest.raises(ConfigError, match="not a run directory"):
        Config.load(tmp_path / "nothing")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
def test_the_cores_of_a_run_that_is_pinned_are_kept(monkeypatch):
    assert provenance.made_by()["cores"] == len(os.sched_getaffinity(0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3})
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    made = provenance.made_by()
    assert (made["cpus"], made["cores"]) == (64, 1)


def test_git_revision(tmp_path, monkeypatch):
    for variable in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):
        monkeypatch.delenv(variable, raising=False)
    package = tmp_path / "srl_jax" / "files"
    package.mkdir(parents=True)
    source = package / "provenance.py"
    source.write_text("1")
    monkeypatch.setattr(provenance, "__file__", str(source))

    def git(*arguments):
        user = ["-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", tmp_path, *user, *arguments], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert provenance.git_revision() is None  # No checkout.
    git("init")
    assert provenance.git_revision() is None  # No commit.
    git("add", ".")
    git("commit", "-m", "first")
    assert provenance.git_revision() == git("rev-parse", "HEAD")
    source.write_text("2")
    assert provenance.git_revision() == git("rev-parse", "HEAD") + "-dirty"
    # Installed somewhere below another project's checkout: its commit says nothing about us.
    (tmp_path / "site-packages" / "srl_jax" / "files").mkdir(parents=True)
    below = tmp_path / "site-packages" / "srl_jax" / "files" / "provenance.py"
    monkeypatch.setattr(provenance, "__file__", str(below))
    assert provenance.git_revision() is None


def test_a_game_is_resolved_to_its_one_name():
    names = {"atari:game=Pong": "Pong", "catch:background=moving": "CatchDistractor"}
    names |= {"catch:ball=2": "catch:ball=2,background=none", "Catch": "Catch"}
    for typed, name in names.items():
        assert resolve(Config(game=typed), *REGISTRIES).game == name


def test_resolving_writes_out_every_default():
    config = Config(
        mode="joint", rl="rainbow:n_step=1", objectives=("second", "first:weight=2"), eval_every=7
    )
    full = resolve(config, *REGISTRIES)
    assert full.rl == "rainbow:n_step=1,alpha=0.5"
    assert full.encoder == "nature:features=256"
    assert full.objectives == ("second:weight=1.0", "first:weight=2.0")
    assert full.checkpoint_every == 7
    assert full.lr_encoder == config.lr_rl
    assert resolve(full, *REGISTRIES) == full


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rl": "rainbwo"}, "--rl=rainbwo: no 'rainbwo'; did you mean rainbow?"),
        ({"encoder": "nature:feature=1"}, "--encoder=nature:feature=1: nature has no option"),
        ({"objectives": ("third",)}, "--objective=third: no 'third'"),
        ({"objectives": ("first", "first:weight=2")}, "--objective=first: first is given twice"),
    ],
)
def test_resolving_refuses(values, message):
    with pytest.raises(ConfigError) as error:
        resolve(Config(**values), *REGISTRIES)
    assert str(error.value).startswith(message)


def test_the_modes_are_the_table_of_the_thesis():
    # name: RL runs, representation runs, starts from, RL trains it, representation trains it
    assert {mode.name: tuple(mode[1:6]) for mode in modes.MODES.values()} == {
        "rl_only": (True, False, "scratch", True, False),
        "pretrain": (False, True, "either", False, True),
        "frozen": (True, False, "checkpoint", False, False),
        "finetuned": (True, False, "checkpoint", True, False),
        "joint": (True, True, "either", True, True),
        "decoupled": (True, True, "either", False, True),
    }
    assert list(modes.MODES) == [mode.name for mode in modes.MODES.values()]


@pytest.mark.parametrize(
    ("mode", "rate"),
    [
        ("rl_only", 2.0), ("finetuned", 2.0), ("joint", 2.0),
        ("pretrain", 3.0), ("decoupled", 3.0), ("frozen", 0.0),
    ],
)  # fmt: skip
def test_the_encoder_learns_at_its_trainers_rate(mode, rate):
    config = Config(mode=mode, lr_rl=2.0, lr_srl=3.0)
    assert modes.encoder_learning_rate(config) == rate
    given = dataclasses.replace(config, lr_encoder=5.0)
    assert modes.encoder_learning_rate(given) == 5.0


@pytest.mark.parametrize("mode", modes.MODES.values(), ids=list(modes.MODES))
def test_a_mode_takes_the_encoder_and_the_objectives_that_it_needs(mode):
    objectives = ("first",) if mode.representation else ()
    scratch = Config(mode=mode.name, objectives=objectives)
    started = dataclasses.replace(scratch, encoder_from="runs/a")
    for config, start in ((scratch, "scratch"), (started, "checkpoint")):
        if mode.encoder_start in (start, "either"):
            checks.check(config)
        else:
            with pytest.raises(ConfigError, match="^--encoder_from"):
                checks.check(config)
    right = scratch if mode.encoder_start != "checkpoint" else started
    wrong = dataclasses.replace(right, objectives=() if objectives else ("first",))
    with pytest.raises(ConfigError, match=f"^--objective: --mode={mode.name}"):
        checks.check(wrong)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"mode": "rl_only", "policy_from": "x"},
            "--policy_from=x: nothing reads it in --mode=rl_only, which acts",
        ),
        ({"mode": "rl_only", "augment": "srl"}, "--augment=srl: nothing reads it in --mode=rl_only"),
        ({"mode": "frozen", "encoder_from": "x", "lr_encoder": 1.0}, "--lr_encoder=1.0"),
        (
            {"mode": "rl_only", "srl_view": "shift"},
            "--srl_view=shift: nothing reads it in --mode=rl_only",
        ),
        (
            {"mode": "pretrain", "objectives": ("a",), "rl_view": "shift"},
            "--rl_view=shift: nothing reads it in --mode=pretrain",
        ),
    ],
)
def test_settings_that_a_mode_ignores_are_refused(values, message):
    with pytest.raises(ConfigError) as error:
        checks.check(Config(**values))
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("field", ["lr_encoder", "lr_encoder_srl"])
def test_a_rate_of_0_that_would_be_the_default_is_refused(field):
    joint = Config(mode="joint", objectives=("first",))
    with pytest.raises(ConfigError, match=f"^--{field}=0: 0 stands for the rate of what trains the encoder"):
        checks.check(joint, given=[field])
    assert checks.check(joint, given=["lr_rl"]) == checks.check(joint) == joint


def test_updates_that_int32_does_not_count_are_refused():
    most = Config(steps=2**31 - 1, num_envs=1, updates_per_step=1.0)
    assert checks.check(most) == most
    with pytest.raises(ConfigError, match="^--steps=2147483647: with --updates_per_step=1.5 that is"):
        checks.check(dataclasses.replace(most, updates_per_step=1.5))


def test_an_encoder_may_be_needed_beyond_the_mode_or_not_be_asked_for():
    joint = Config(mode="joint", objectives=("first",))
    with pytest.raises(ConfigError, match="needs --encoder_from=PATH; make one$"):
        checks.check(joint, needs_encoder=True, hint="make one")
    checks.check(joint, needs_encoder=True, complete=False)
    checks.check(Config(mode="frozen"), complete=False)


def test_the_difference_of_two_configurations_names_every_field():
    for name in INFOS:
        here = Config()
        object.__setattr__(here, name, "other")  # past its checks
        assert difference(Config(), here) == f"{name} is {getattr(Config(), name)} there and other here"
    assert difference(Config(), Config()) == ""
    assert difference(Config(), Config(seed=1, steps=7)) == (
        "seed is 0 there and 1 here, steps is 5000000 there and 7 here"
    )


def test_config_json_is_replaced_as_a_whole(tmp_path, monkeypatch):
    Config(seed=1).save(tmp_path)

    def killed(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        Config(seed=2).save(tmp_path)
    assert Config.load(tmp_path).seed == 1


def test_config_json_has_what_xla_was_told(tmp_path, monkeypatch):
    for name in ("XLA_FLAGS", "NPROC", "JAX_PLATFORMS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XLA_FLAGS", "--a --b")
    monkeypatch.setenv("NPROC", "2")
    Config().save(tmp_path)
    told = json.loads((tmp_path / "config.json").read_text())["environment"]
    assert told == {"XLA_FLAGS": "--a --b", "NPROC": "2"} == provenance.told_to_xla()


def test_a_config_of_before_a_field_was_renamed_is_read():
    assert Config.from_json('{"lr_final": 0.25}') == Config(lr_final_share=0.25)
    assert Config.from_json('{"tensorboard": true}') == Config(loggers=("tensorboard",))
    assert Config.from_json('{"tensorboard": false}') == Config()
    assert Config.from_json('{"tensorboard": true, "loggers": []}') == Config()  # resumed since, without


def test_what_follows_from_other_fields_follows_again():
    registries = {"rainbow": _rl}, {"nature": _encoder}, {"first": _objective}
    for values in ({}, {"lr_encoder": 0.5}, {"checkpoint_every": 7}, {"mode": "frozen"}):
        config = Config(rl="rainbow:n_step=3,alpha=0.5", encoder="nature:features=256", **values)
        bare = config_module.unresolved(resolve(config, *registries))
        assert bare == config
        assert resolve(bare, *registries) == resolve(config, *registries)
