"""Command lines: values generated from what a flag says of itself, specifications, contradictions."""

import re
import sys

import pytest

from experiments import train
from experiments.command_line.flags import MOVED, fail
from srl_jax.config import INFOS
from srl_jax.errors import ConfigError
from srl_jax.specs import Info
from tests.malformed.conftest import CODE, EVALUATE, TRAIN


def wrong(info):
    """Texts that a flag must refuse."""
    if info.kind is bool:
        return ["", "maybe", "2", CODE]
    if info.choices:
        first = info.choices[0]
        return ["", "x", CODE, f"{first}\nx", f"{first}\u0301", "x" * 5000]
    if info.kind not in (int, float):
        return []
    texts = ["", "abc", CODE, "1\n2", "inf", "nan", "1e400", "9" * 400]
    texts += ["1.5", str(2**31), "0x10"] if info.kind is int else ["1e39", "1+1j"]
    least = info.minimum if info.minimum is not None else info.above
    texts += [] if least is None else [f"{least - 1:.10g}"]
    return texts + ([] if info.maximum is None else [f"{info.maximum + 1:.10g}"])


FLAGS = {info.flag or name: info for name, info in INFOS.items() if wrong(info)}
FLAGS["tune_runtime"] = Info(str, "", choices=("auto", "off"))


@pytest.mark.parametrize("flag", FLAGS)
def test_values_that_a_flag_does_not_take(flag, refused):
    for text in wrong(FLAGS[flag]):
        refused(*TRAIN, f"--{flag}={text}", names=f"--{flag}")


@pytest.mark.parametrize(
    ("flag", "texts"),
    [
        ("games", ("", "0", "-1", "1.5", "nan", "x", "9" * 400, "9" * 5000, "9999999999999", CODE)),
        ("seed", ("", "-1", "1.5", "nan", "x", "2147483648", "9" * 400, CODE)),
        ("epsilon", ("", "-0.1", "1.1", "nan", "inf", "-inf", "1e400", "x", CODE)),
        ("tune_runtime", ("", "x", CODE)),
        ("run", ("",)),
        ("frobnicate", ("1",)),
    ],
)
def test_values_that_evaluate_does_not_take(flag, texts, refused, source):
    for text in texts:
        refused(*EVALUATE, f"--{flag}={text}", names=flag)


def test_flags_that_there_are_not(refused):
    for flag in ("--gane=Pong", "--frobnicate=1", "--__class__=1", *(f"--{flag}=1" for flag in MOVED)):
        refused(*TRAIN, flag, names=flag.partition("=")[0])
    for argument, names in (
        (f"--{CODE}", CODE[:20]),
        ("--steps", "steps"),
        ("-steps=abc", "--steps"),
        ("---steps=5", "-steps"),
        ("Pong", "Pong"),
        ("--nosteps", "nosteps"),
        ("--notensorboard=5", "tensorboard"),
        ("--overwrite=perhaps", "overwrite"),
        ("--print_config=perhaps", "print_config"),
        ("--\u017fteps=5", "teps"),
        ("--flagfile=file", "--flagfile"),
    ):
        refused(*TRAIN, argument, names=names)
    refused(*TRAIN, "--", "x", names="'x'")


def test_seeds_and_presets_that_there_are_not(refused):
    seeds = (
        "", ",", "1", ",1", "1,,", "1,,2", "1;2", "0,0", "-1", "1.5", "nan", "2147483648", "9" * 400, "a",
        CODE,
    )  # fmt: skip
    for text in seeds:
        refused(*TRAIN, f"--seeds={text}", names="--seeds")
    presets = (
        "", "x", "none", "thesis/joint_25", "joint_256", "DEMO", "demo,catch/joint", "demo ", "demo\nx",
        "../presets", "__class__", CODE, "x" * 5000, "d\u0435mo", "\x1b[2J",
    )  # fmt: skip
    for text in presets:
        refused(*TRAIN, f"--preset={text}", names="--preset")
    for preset in ("thesis/frozen_256", "thesis/joint_from_pretrained_256", "catch/finetuned"):
        refused(*TRAIN, f"--preset={preset}", names="--encoder_from")


SPECS = {
    "objective": (
        f"reconstruction:weight={CODE}", CODE, "__class__", "__import__('os')", "lambda: 0",
        "reconstruction:__class__=1", "reconstruction:context=1", "reconstruction:weight=",
        "reconstruction:weight", "reconstruction:", "reconstruction:=1", "reconstruction:,",
        "reconstruction:weight=1,", "reconstruction:weight=1,weight=1", ":weight=1",
        "reconstruction:weight=nan", "reconstruction:weight=inf", "reconstruction:weight=1e39",
        "reconstruction:weight=-1", "reconstruction:weight=1:2", "reconstruction:weight=1;x=2",
        "reconstruction:weight=True", "reconstruction:weight=0x1", "reconstruction:weight={}",
        "reconstruction weight=1", "Reconstruction", "reconstruction\nlatent_l2", "r\u0435construction",
        "\x1b[31mreconstruction", "../reconstruction", "srl_jax.objectives.inverse", "x" * 5000,
        "inverse:hidden=0", "inverse:hidden=-1", "inverse:hidden=1.5", "inverse:hidden=2147483648",
        "inverse:hidden=2147483647", "inverse:hidden=" + "9" * 400, "latent_l2:hidden=4", " ",
    ),
    "encoder": (
        "", ":", "tiny:", "Tiny", "nature:channels=1", "nature:observation_shape=1", "sac_ae:end=x",
        "sac_ae:features=-1", "sac_ae:features=2.5", "sac_ae:features=1e400", "sac_ae:features=99999999999",
        "sac_ae:features=2147483647", "sac_ae:layer_norm=maybe", "sac_ae:features=256,features=256",
        f"tiny:features={CODE}", "tiny:__dict__=1", "__builtins__",
    ),
    "rl": (
        "", "rainbow:", "rainbow:n_step=0", "rainbow:n_step=1.5", "rainbow:n_step=2147483647",
        "rainbow:n_step=1e9,n_step=1", "rainbow:atoms=1", "rainbow:atoms=1000000000", "rainbow:v_min=10",
        "rainbow:v_min=nan", "rainbow:v_max=1e39", "rainbow:v_min=1,v_max=1", "rainbow:hidden=0",
        "rainbow:hidden=2147483647", "rainbow:alpha=2", "rainbow:alpha=-1", "rainbow:noisy_std=-1",
        "rainbow:noisy_std=inf", "rainbow:init_std=-1", "rainbow:init_std=1e-300", "rainbow:double=2",
        "rainbow:context=1", "dqn:dueling=yes", "c51:func=rainbow", f"double:{CODE}",
        f"rainbow:hidden={CODE}", "_plain",
    ),
}  # fmt: skip


@pytest.mark.parametrize("flag", SPECS)
def test_specifications_of_nothing(flag, refused):
    mode = ("--mode=joint",) if flag == "objective" else ()
    for text in SPECS[flag]:
        refused(*TRAIN, "--game=Catch", *mode, f"--{flag}={text}", names=f"--{flag}=")


TOGETHER = {
    "--batch_size": ("--batch_size=100", "--buffer_size=99"),
    "--learn_start": ("--learn_start=2000", "--buffer_size=1999"),
    "--buffer_size": ("--buffer_size=2000000000",),
    "--buffer_size=50": ("--batch_size=1", "--learn_start=0", "--num_envs=10", "--buffer_size=50"),
    "n_step": ("--rl=:n_step=20000", "--buffer_size=1000"),
    "num_envs": ("--num_envs=100", "--buffer_size=200", "--learn_start=100"),
    "--encoder": ("--game=Pong", "--frame_size=8"),
    "--encoder_from": ("--encoder_from=.",),
    "--objective": ("--mode=joint", "--objective="),
    "--objective=": ("--mode=joint", "--objective=none", "--objective=inverse"),
    "--objective=latent_l2": ("--mode=joint", "--objective=latent_l2", "--objective=latent_l2:weight=2"),
    "--mode=finetuned": ("--mode=finetuned", "--objective=inverse", "--encoder_from=."),
    "--policy_from": ("--mode=joint", "--objective=inverse", "--policy_from=."),
    "--augment": ("--augment=srl",),
    "--rl_view": ("--rl_view=shft",),
    "--gate": ("--gate=pcgrad",),
    "--objective=inverse:weight=ratio:0.1": ("--mode=pretrain", "--objective=inverse:weight=ratio:0.1"),
    "--lr_encoder": ("--mode=frozen", "--encoder_from=.", "--lr_encoder=1"),
    "--srl_every": ("--mode=pretrain", "--objective=inverse", "--srl_every=2"),
    "v_m": ("--rl=:v_min=1,v_max=0",),
}


@pytest.mark.parametrize("names", TOGETHER)
def test_flags_that_contradict_each_other(names, refused):
    refused(*TRAIN, "--game=Catch", *TOGETHER[names], names=names)


# The check itself


@pytest.mark.parametrize(
    ("does", "seen"),
    [
        (lambda folder: 0, "(0, '')"),
        (lambda folder: (folder / "new").touch(), "=="),
        (lambda folder: print("{}"), r"(2, '{}\n')"),
        (lambda folder: sys.stderr.write("two\nlines\n"), "two"),
        (lambda folder: sys.stderr.write("\x1b[31m"), "isprintable"),
    ],
)
def test_what_is_not_refused_is_noticed(does, seen, folder, refused, monkeypatch):
    def mistaken(*_):
        if does(folder) == 0:
            return 0
        raise ConfigError("--out: no")

    monkeypatch.setattr(train, "train", mistaken)
    with pytest.raises(AssertionError, match=re.escape(seen)):
        refused(*TRAIN, names="--out")
    monkeypatch.setattr(train, "train", lambda *_: fail("--steps: no"))
    with pytest.raises(AssertionError, match="--out"):
        refused(*TRAIN, names="--out")
    refused(*TRAIN, names="--steps")
