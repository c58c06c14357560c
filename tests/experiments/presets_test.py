"""Tests of experiments.presets."""

import dataclasses

import pytest

from experiments import train
from experiments.command_line import help
from experiments.presets import (
    ENCODER_PRESETS,
    PIECES,
    POLICY_PRESETS,
    PRESETS,
    preset_config,
    preset_values,
    source_preset,
)
from srl_jax import checks, encoders, objectives, rl, specs
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.learning import modes
from srl_jax.needs import EVERYTHING

# The arms of every figure of the thesis, and the runs that make their encoders.
ARMS = [
    "rl_only_nature", "finetuned_from_rl_nature", "finetuned_256_aug", "frozen_256", "rl_only_256",
    "rl_only_256_aug", "joint_256", "joint_50", "joint_256_l2_aug", "joint_256_noreg",
    "joint_forward_256", "joint_forward_256_aug", "joint_from_pretrained_256", "pretrain_256",
    "pretrain_256_aug",
]  # fmt: skip


def _config(name, **values):
    config = Config(**{**preset_values(name), **values})
    if name in ENCODER_PRESETS:
        config = dataclasses.replace(config, encoder_from="runs/encoder")
    return config


@pytest.mark.parametrize("family", ["thesis", "small"])
def test_every_arm_has_a_preset(family):
    assert {f"{family}/{arm}" for arm in ARMS} == {n for n in PRESETS if n.startswith(f"{family}/")}


@pytest.mark.parametrize("arm", ARMS)
def test_a_small_arm_is_the_arm_at_another_size(arm):
    large, small = _config(f"thesis/{arm}"), _config(f"small/{arm}")
    for field in ("mode", "objectives", "augment", "decoder_weight_decay", "updates_per_step"):
        assert getattr(small, field) == getattr(large, field)
    assert small.encoder == f"tiny:features={specs.split(large.encoder)[1].get('features', 0)}"
    assert small.encoder_optimizer == large.encoder_optimizer == "separate"
    # The proportion of 15 to 50 epochs.
    assert small.steps == (9_000 if small.mode == "pretrain" else 30_000)
    assert small.game == "Catch" and small.frame_size == 42


def test_every_mode_has_a_catch_preset():
    assert {f"catch/{mode}" for mode in modes.MODES} == {n for n in PRESETS if n.startswith("catch/")}
    for mode in modes.MODES:
        assert _config(f"catch/{mode}").mode == mode


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_valid_run(name):
    config = preset_config(name, **({"encoder_from": "x"} if name in ENCODER_PRESETS else {}))
    full = train.resolved(config)
    assert train.resolved(full) == full
    # `srl_jax.train` takes it, which cannot know what was given and what the preset brings.
    assert train.resolved(checks.check(config), EVERYTHING) == full


def test_a_field_beside_a_preset_is_read_or_refused():
    config = preset_config("thesis/joint_256", game="Breakout", gamma=0.5)
    assert (config.game, config.gamma, config.stop_at_return) == ("Breakout", 0.5, None)
    with pytest.raises(ConfigError, match="^--gate=pcgrad: nothing reads it in --mode=rl_only"):
        preset_config("catch/rl_only", gate="pcgrad")
    with pytest.raises(ConfigError, match="^--encoder_from: --mode=frozen needs"):
        preset_config("catch/frozen")


@pytest.mark.parametrize("name", PRESETS)
def test_what_a_preset_sets_is_read_in_this_mode_or_in_another(name):
    config = _config(name)
    learner = specs.parse(config.rl, rl.REGISTRY, "rl")
    run = checks.run_of(config, rl=learner)
    assert all(why.startswith("in --mode=") for _, why in run.unread()), [*run.unread()]
    registries = {"encoder": encoders.REGISTRY, "objective": objectives.REGISTRY}
    parsed = [("encoder", config.encoder), *(("objective", text) for text in config.objectives)]
    for spec in (learner, *(specs.parse(text, registries[kind], kind) for kind, text in parsed)):
        assert not [*run.unread_options(spec)]


@pytest.mark.parametrize("name", [f"thesis/{arm}" for arm in ARMS])
def test_an_arm_is_what_its_name_says(name):
    config = _config(name)
    assert config.mode == name.removeprefix("thesis/").split("_")[0].replace("rl", "rl_only")
    encoder, options = specs.split(config.encoder)
    features = "50" if name.endswith("_50") else "256"
    nature = name.endswith("nature")
    assert (encoder, options.get("features")) == (("nature", None) if nature else ("sac_ae", features))
    # As the authors' code starts: pixels in 0..255, and all else the textbook's.
    assert options.keys() <= {"gain", "features"} and options["gain"] == "255"
    assert config.rl == "rainbow"
    assert config.augment == ("all" if name.endswith("_aug") else "none")
    losses = [specs.split(text) for text in config.objectives]
    expected = []
    if modes.MODES[config.mode].representation:
        first = "forward_pixels" if "_forward_" in name else "reconstruction"
        expected = [(first, {"weight": "1"})]
        if not name.endswith("noreg"):
            expected.append(("latent_l2", {"weight": "1e-6"}))
    assert losses == expected
    assert config.decoder_weight_decay == (0 if name.endswith("noreg") else 1e-7)
    if config.mode == "pretrain":
        # 15 epochs of 100,000 env steps, batch 64, 0.3 updates per env step, epsilon 0.3.
        assert (config.steps, config.batch_size) == (1_500_000, 64)
        assert (config.updates_per_step, config.pretrain_epsilon) == (0.3, 0.3)
    else:
        assert (config.steps, config.batch_size, config.updates_per_step) == (5_000_000, 32, 0.1)


def test_an_encoder_comes_from_a_run_that_fits():
    needs = {name for name, values in PRESETS.items() if values["mode"] in ("frozen", "finetuned")}
    both = {f"{family}/joint_from_pretrained_256" for family in ("thesis", "small")}
    assert set(ENCODER_PRESETS) == needs | both
    for name, source in ENCODER_PRESETS.items():
        user, maker = _config(name), _config(source)
        for field in ("encoder", "frame_size", "frame_stack", "game"):
            assert getattr(user, field) == getattr(maker, field)


def test_frames_for_pretraining_come_from_a_run_that_fits():
    assert set(POLICY_PRESETS) == {
        f"{family}/{arm}" for family in ("thesis", "small") for arm in ("pretrain_256", "pretrain_256_aug")
    }
    for name, source in POLICY_PRESETS.items():
        user, maker = _config(name), _config(source)
        assert modes.MODES[maker.mode].rl
        for field in ("frame_size", "frame_stack", "game"):
            assert getattr(user, field) == getattr(maker, field)


def test_only_pong_of_the_thesis_games_stops_early():
    assert preset_values("thesis/joint_256")["stop_at_return"] == 20
    for pong in ("Pong", "atari", "atari:game=Pong", " Pong"):  # which all mean the same
        assert preset_values("thesis/joint_256", pong)["stop_at_return"] == 20
    assert "stop_at_return" not in preset_values("thesis/joint_256", "Breakout")
    assert "stop_at_return" not in preset_values("thesis/pretrain_256")
    assert "stop_at_return" not in PRESETS["thesis/joint_256"]


@pytest.mark.parametrize("arm", ARMS)
def test_small_is_a_piece_that_changes_any_preset(arm):
    assert preset_values(f"thesis/{arm}+small") == preset_values(f"small/{arm}")


def test_what_stands_later_overrides():
    assert preset_values("catch/joint+catch/rl_only") == {
        **PRESETS["catch/joint"],
        **PRESETS["catch/rl_only"],
    }
    assert preset_values("thesis/joint_256+aug")["augment"] == "all"
    for name in ("spr", "drq", "mrq", "bbf"):
        with pytest.raises(
            ConfigError, match=f"^atari100k/{name}[+]aug: aug: the preset has views of its own"
        ):
            preset_values(f"atari100k/{name}+aug")
    textbook = preset_values("thesis/joint_256+textbook")
    assert (textbook["rl"], textbook["encoder"]) == ("rainbow", "sac_ae:features=256")
    assert textbook["stop_at_return"] == 20
    early = preset_values("thesis/rl_only_nature+five_choices")
    assert early["rl"] == "rainbow:init_std=1,priority=kl"
    assert early["encoder"] == "nature:gain=32,init=he,zero_sum=true,decoder_scale=0.1"
    assert preset_values("thesis/rl_only_nature+five_choices+textbook")["encoder"] == "nature"
    assert preset_values("catch/joint+small+aug")["encoder"] == "tiny"


def test_an_objective_and_a_gate_are_pieces():
    assert preset_values("atari100k/der+objective/spr+gate/orthogonal") == {
        **PRESETS["atari100k/der"],
        "mode": "joint",
        "objectives": ("spr",),
        "gate": "orthogonal",
        "encoder_optimizer": "summed",
    }
    decoupled = PRESETS["catch/decoupled"]
    both = ("reconstruction:weight=1", "latent_l2:weight=1e-6", "mine")  # a row of --import, say
    assert preset_values("catch/decoupled+objective/mine") == {**decoupled, "objectives": both}
    # One Adam only where two step in turn, and only for gates that need both gradients at once.
    assert preset_values("demo+gate/pcgrad") == {
        **PRESETS["demo"], "gate": "pcgrad", "encoder_optimizer": "summed",
    }  # fmt: skip
    assert preset_values("demo+gate/rl_stopped") == {**PRESETS["demo"], "gate": "rl_stopped"}
    two = {"mode": "joint", "encoder_optimizer": "simultaneous"}
    assert PIECES["gate/pcgrad"](two) == {**two, "gate": "pcgrad"}


@pytest.mark.parametrize(
    "name",
    [
        *(f"atari100k/der+objective/{name}" for name in objectives.REGISTRY),
        *(f"atari100k/der+objective/spr+gate/{gate}" for gate in modes.GATES),
        *(f"catch/{mode}+objective/spr" for mode in ("rl_only", "pretrain", "joint", "decoupled")),
        "atari100k/bbf+gate/orthogonal",
        "thesis/joint_256+objective/inverse+gate/pcgrad+small",
    ],
)
def test_a_preset_with_pieces_is_a_valid_run(name):
    full = train.resolved(checks.check(_config(name), given=()))
    pieces = dict(part.split("/") for part in name.split("+")[1:] if "/" in part)
    assert full.gate == pieces.get("gate", "sum")
    assert not pieces.get("objective") or full.objectives[-1].startswith(f"{pieces['objective']}:weight=")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("thesis/joint_25", "did you mean thesis/joint_256"),
        ("thesis/joint_256+smal", "did you mean small"),
        ("small", "small changes a preset; write it behind one"),
        ("catch/joint+", "valid: small, textbook, five_choices, aug"),
        ("objective/spr", "objective/spr changes a preset; write it behind one"),
        ("gate/pcgrad+demo", "gate/pcgrad changes a preset; write it behind one"),
        ("demo+objectives/spr", "did you mean objective/NAME?"),
        ("demo+objective/spr:steps=2", "did you mean objective/NAME?"),
        ("demo+gate/pcgrd", "did you mean gate/pcgrad?"),
        ("thesis/frozen_256+objective/spr", "objective/spr: the preset is of --mode=frozen, which runs no"),
        ("atari100k/spr+objective/spr", "objective/spr: the preset has it; --objective=+spr:key=value"),
        ("atari100k/der+gate/sum+objective/spr", "gate/sum: in --mode=rl_only RL and representation do not"),
        ("atari100k/der+gate/sum", "write objective/NAME before it, for --mode=joint"),
        ("atari100k/mrq+gate/pcgrad", "gate/pcgrad: in --mode=decoupled RL and representation do not both"),
    ],
)
def test_a_preset_that_there_is_not_is_refused(name, told):
    with pytest.raises(ConfigError) as error:
        preset_values(name)
    assert str(error.value).startswith(f"{name}: ") and told in str(error.value)
    assert "\n" not in str(error.value)


def test_a_changed_preset_starts_from_one_that_is_changed_likewise():
    assert source_preset("thesis/frozen_256+small", ENCODER_PRESETS) == "thesis/pretrain_256+small"
    assert source_preset("thesis/joint_256+small", ENCODER_PRESETS) == ""
    # What is added to this run's losses is not of the one that it starts from.
    name = "thesis/joint_from_pretrained_256+objective/spr+gate/orthogonal+aug"
    assert source_preset(name, ENCODER_PRESETS) == "thesis/pretrain_256+aug"


@pytest.mark.parametrize("name", PRESETS)
def test_a_summary_is_a_line(name):
    text = help.summary(name)
    assert text.startswith(f"{PRESETS[name]['game']}: {PRESETS[name]['mode']}, ") and len(text) < 120
