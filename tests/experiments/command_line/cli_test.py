"""Tests of the command line: experiments.command_line.flags, and what experiments.train refuses."""

import importlib

import pytest

from experiments import train
from experiments.command_line import flags as config_flags
from experiments.presets import PRESETS
from srl_jax.config import INFOS, Config
from srl_jax.errors import EXIT_STATUS, ConfigError, Diverged, SaveError
from tests.in_process import parse, python, refused, train_in_process

JOINT = ["--game=Catch", "--mode=joint", "--objective=reconstruction"]


def _config(*arguments):
    return config_flags.config_from_flags(parse(train, *arguments), complete=False)


def test_every_field_is_a_flag_with_help_and_its_default():
    values = parse(train)
    assert config_flags.config_from_flags(values) == Config()
    for name, info in INFOS.items():
        flag = values[info.flag or name]
        assert info.help in flag.help and info.unit in flag.help
        assert flag.value == (getattr(Config(), name) or flag.value)


def test_flags_set_the_fields():
    config = _config(
        "--game=MsPacman", "--steps=1e6", "--gamma=0.9", "--nokeep_best", "--reward_clip=false",
        "--stop_at_return=-3.5", "--mode=joint", "--objective=a:weight=1,size=2", "--objective=b",
        "--logger=csv,wandb:project=x", "--logger=tensorboard",
    )  # fmt: skip
    assert config == Config(
        game="MsPacman", steps=1_000_000, gamma=0.9, reward_clip=False, stop_at_return=-3.5,
        mode="joint", objectives=("a:weight=1,size=2", "b"), keep_best=False,
        loggers=("csv", "wandb:project=x", "tensorboard"),
    )  # fmt: skip


def test_flags_override_a_preset_even_where_they_give_the_default():
    preset = "--preset=thesis/joint_256_l2_aug"
    assert PRESETS["thesis/joint_256_l2_aug"]["augment"] == "all"
    config = _config(preset, "--augment=none", "--objective=reconstruction", "--stop_at_return=off")
    assert config.augment == "none" == Config().augment
    assert config.objectives == ("reconstruction",)
    assert config.stop_at_return is None
    assert config.encoder == PRESETS["thesis/joint_256_l2_aug"]["encoder"]
    assert _config(preset).stop_at_return == 20
    assert _config(preset, "--game=Breakout").stop_at_return is None
    assert _config(preset, "--mode=rl_only", "--objective=none").objectives == ()


def test_a_colon_in_front_changes_options_and_keeps_the_rest():
    assert _config("--rl=:n_step=5,atoms=21").rl == "rainbow:n_step=5,atoms=21"
    preset = "--preset=catch/rl_only"
    assert _config(preset, "--rl=:noisy_std=0.5,v_max=3").rl == (
        "rainbow:v_min=-2,v_max=3,hidden=128,noisy_std=0.5"
    )
    assert _config(preset, "--rl=dqn").rl == "dqn"
    encoder = _config("--preset=thesis/rl_only_256", "--encoder=:features=9").encoder
    assert encoder == "sac_ae:features=9,gain=255"


@pytest.mark.parametrize(
    ("given", "left"),
    [
        (["inverse"], ["inverse"]),
        (["+inverse:weight=2"], ["reconstruction:weight=1", "latent_l2:weight=1e-6", "inverse:weight=2"]),
        (["-latent_l2"], ["reconstruction:weight=1"]),
        (["+reconstruction:weight=3"], ["reconstruction:weight=3", "latent_l2:weight=1e-6"]),
        (["-reconstruction", "+inverse"], ["latent_l2:weight=1e-6", "inverse"]),
    ],
)
def test_objectives_replace_or_with_a_sign_add_and_leave_out(given, left):
    flags = [f"--objective={text}" for text in given]
    assert _config("--preset=catch/joint", *flags).objectives == tuple(left)


def test_it_is_said_which_objectives_are_replaced(capsys, loop, tmp_path):
    train_in_process("--preset=catch/joint", "--objective=inverse", f"--out={tmp_path}/a")
    assert (
        "objective: inverse in place of reconstruction:weight=1 and latent_l2:weight=1e-6 of "
        "--preset=catch/joint; --objective=+NAME adds to them\n"
    ) in capsys.readouterr().err
    train_in_process("--preset=catch/joint", "--objective=+inverse", f"--out={tmp_path}/b")
    train_in_process("--game=Catch", "--mode=joint", "--objective=inverse", f"--out={tmp_path}/c")
    assert "objective" not in capsys.readouterr().err


def test_settings_come_from_a_config_file(tmp_path, loop):
    out = tmp_path / "run"
    train_in_process("--preset=catch/joint", "--seed=3", "--lr_rl=1e-3", f"--out={out}")
    ((first, _),) = loop.calls
    for given in (out, out / "config.json"):
        assert train.resolved(_config(f"--config={given}")) == first
    # What followed from another value follows it again.
    config = train.resolved(_config(f"--config={out}", "--lr_rl=5e-3", "--eval_every=500", "--seed=4"))
    assert (config.lr_encoder, config.checkpoint_every, config.seed) == (5e-3, 500, 4)
    assert config.objectives == first.objectives
    assert _config(f"--config={out}", "--objective=+inverse").objectives[-1] == "inverse"


BAD = [
    (["--game=Pogn"], "--game=Pogn", "did you mean Pong?"),
    (["--game=Pogn"], "--game=Pogn", "gymnasium:id=Name-v0, module:Name-v0"),
    (["--game=ALE/Pong-v5"], "--game=ALE/Pong-v5", "did you mean Pong?"),
    (["--preset=thesis/joint_25"], "--preset=thesis/joint_25", "did you mean thesis/joint_256?"),
    (["--preset="], "--preset=", "valid: "),
    (["--mode=jiont"], "--mode=jiont", "did you mean joint?"),
    (["--rl=rainbwo"], "--rl=rainbwo", "rainbow"),
    (["--rl=rainbow:n_stp=3"], "--rl=rainbow:n_stp=3", "did you mean n_step?"),
    (["--rl=rainbow:v_min=20"], "--rl=rainbow", "v_max"),
    (["--rl=rainbow:distributional=false,v_min=-1"], "--rl=rainbow", "nothing reads v_min"),
    (["--rl=dqn:atoms=21"], "--rl=dqn:atoms=21", "dqn has no option 'atoms'"),
    (["--encoder=natur"], "--encoder=natur", "did you mean nature?"),
    (["--encoder=nature", "--frame_size=10", "--game=Pong"], "--encoder=nature", "10"),
    (["--mode=joint", "--objective=recon"], "--objective=recon", "valid: reconstruction"),
    ([*JOINT, "--objective=inverse:weigth=1"], "--objective=inverse", "did you mean weight?"),
    ([*JOINT, "--objective=inverse:weight=-1"], "--objective=inverse", "not be negative"),
    ([*JOINT, "--objective=reconstruction"], "--objective=reconstruction", "twice"),
    (["--objective=reconstruction"], "--objective", "--mode=rl_only"),
    (["--mode=joint"], "--objective", "at least one"),
    (["--mode=frozen"], "--encoder_from", "--mode=frozen"),
    (["--preset=thesis/frozen_256"], "--encoder_from", "--preset=thesis/pretrain_256"),
    (["--preset=thesis/joint_from_pretrained_256"], "--encoder_from", "thesis/pretrain_256"),
    (["--mode=finetuned", "--encoder_from=no/such"], "--encoder_from=no/such", "no such path"),
    (["--mode=finetuned", "--encoder_from=."], "--encoder_from=.", ""),
    (["--steps=-5"], "--steps=-5", "at least 1 (env steps)"),
    (["--steps=abc"], "--steps=abc", "not a whole number"),
    (["--steps", "abc"], "--steps=abc", "not a whole number"),
    (["--lr_rl=nan"], "--lr_rl=nan", "finite"),
    (["--gamma=1.5"], "--gamma=1.5", "at most 1"),
    (["--n_step=3"], "--n_step", "is now --rl=:n_step=..."),
    (["--num_atoms=3"], "--num_atoms", "is now --rl=:atoms=..."),
    (["--lr_final=0.1"], "--lr_final", "is now --lr_final_share=..."),
    (["--tensorboard"], "--tensorboard", "is now --logger=tensorboard"),
    (["--logger=csvv"], "--logger=csvv", "did you mean csv? valid: tensorboard, wandb, csv"),
    (["--logger=nowhere/mine.py:Mine"], "--logger=", "nowhere/mine.py: no such file"),
    (["--rl=:n_step=0"], "--rl=rainbow:n_step=0", "at least 1"),
    (["--rl=:n_step"], "--rl=:n_step", "'n_step' is not key=value"),
    (["--encoder=:n_step=1"], "--encoder=nature:n_step=1", "nature has no option"),
    (["--preset=small"], "--preset=small", "thesis/joint_256+small"),
    (["--preset=thesis/joint_256+smal"], "--preset=thesis/joint_256+smal", "did you mean small?"),
    (["--preset=catch/joint", "--config=x"], "--config=x", "--preset=catch/joint; give one of them"),
    (["--config=no/such"], "--config=no/such", "give a run's config.json"),
    (["--config=pyproject.toml"], "--config=pyproject.toml", "not JSON"),
    ([*JOINT, "--objective=+inverse"], "--objective=reconstruction", "replaces all"),
    (["--preset=catch/joint", *["--objective=+inverse"] * 2], "inverse is given 2 times", "give it once"),
    (["--preset=catch/joint", "--objective=-inverse"], "--objective=-inverse", "reconstruction, latent_l2"),
    (["--import=no_such.py"], "--import=", "no such file"),
    (["--reward_clip=maybe"], "--reward_clip=maybe", "true or false"),
    (["--srl_every=4"], "--srl_every=4", "joint, decoupled"),
    (["--srl_every=0", *JOINT], "--srl_every=0", "at least 1"),
    (["--seeds=1,2,1"], "--seeds=1,2,1", "twice"),
    (["--seeds=1,b"], "--seeds=1,b", "not a whole number; give integers"),
    (["--seeds=0,-1"], "--seeds=0,-1", "at least 0"),
    (["--seeds="], "--seeds=", "give integers"),
    (["--seeds=3"], "--seeds=3", "not how many; --seeds=0,1,2 are three, --seed=3 is a run of that one"),
    (["--seeds=3"], "--seeds=3", ", and --seeds=3, (with the comma) is that one in a directory of seeds"),
    (["--seeds=0,1", "--seed=2"], "--seeds=0,1", "--seed=2; give one of them"),
    (["--tune_runtime=x"], "--tune_runtime=x", "valid: auto, off"),
    (["--steps"], "--steps", ""),
    (["--gane=Pong"], "--gane", "did you mean --gate or --game"),
    (["--lr=1"], "--lr: no such flag", "did you mean --lr_encoder or --lr_encoder_srl or"),
    (["--learning_rate=1"], "--learning_rate: no such flag", "did you mean --lr_rl or --lr_srl or"),
    (["--the=1"], "--the: no such flag", "no such flag; --help lists them all"),
    (["Pong"], "'Pong'", "--name=value"),
    (["--nokeep_best=1"], "--nokeep_best=1", "argument"),
    (["--flagfile=/dev/zero"], "--flagfile", "write the flags themselves"),
    (["--steps=3000000000"], "--steps=3000000000", "at most 2147483647 (env steps)"),
    (["--rl=rainbow:alpha=2"], "--rl=rainbow:alpha=2", "alpha must be at most 1"),
    (["--rl=rainbow:v_max=1e39"], "--rl=rainbow:v_max=1e39", "at most 3.402823466e+38"),
    (["--encoder=tiny:features=100000"], "--encoder=tiny:features=100000", "at most 65536"),
    (["--out=a\nb"], "--out=a b", "'\\n'; name it with printable ones"),
    (["--game=\x1b[31m"], "--game=\\x1b[31m", "valid: an Atari-57 game"),
    (["--game=Pong", "--game=Catch"], "--game: given 2 times", "give it once"),
    (["--steps=5", "--steps=5", "--steps=5"], "--steps: given 3 times", "give it once"),
    (["--reward_clip", "--noreward_clip"], "--reward_clip: given 2 times", "give it once"),
    (["--preset=demo", "--preset=demo"], "--preset: given 2 times", "give it once"),
    (["--mode=" + "x" * 10_000], "--mode=xxx", " [...] "),
]


@pytest.mark.parametrize(("arguments", "flag", "choice"), BAD, ids=lambda value: str(value))
def test_bad_input_is_one_line_and_status_2(arguments, flag, choice, tmp_path, capsys, loop):
    out = tmp_path / "runs" / "a"
    with pytest.raises(SystemExit) as ended:
        train_in_process(
            *([] if any("--out=" in text for text in arguments) else [f"--out={out}"]), *arguments
        )
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and printed.err.endswith("\n")
    assert flag in printed.err and choice in printed.err
    assert list(tmp_path.iterdir()) == []
    assert loop.calls == []


@pytest.mark.parametrize(
    ("program", "flag", "hint"),
    [
        ("evaluate", "games", "give it once"),
        ("report", "out", "give it once"),
        ("sweep", "lr_rl", "give it once"),
        ("sweep", "presets", "separate values with commas"),
        ("figures", "games", "separate values with commas"),
        ("reference_policies", "games", "separate values with commas"),
        ("benchmarks.bench", "rounds", "give it once"),
    ],
)
def test_a_flag_that_means_one_value_is_refused_twice(program, flag, hint, capsys):
    value = "Catch" if flag == "games" and program != "evaluate" else "1"
    with pytest.raises(SystemExit) as ended:
        parse(importlib.import_module(f"experiments.{program}"), *[f"--{flag}={value}"] * 2)
    assert ended.value.code == 2
    assert capsys.readouterr() == ("", f"error: --{flag}: given 2 times; {hint}\n")


@pytest.mark.parametrize("error", EXIT_STATUS)
def test_errors_are_one_line_and_have_a_status_of_their_own(error, capsys):
    def main(argv):
        raise error("two\n lines")

    with pytest.raises(SystemExit) as ended:
        config_flags.guarded(main)(["program"])
    assert ended.value.code == {ConfigError: 2, SaveError: 3, Diverged: 4}[error]
    assert capsys.readouterr() == ("", "error: two lines\n")


@pytest.mark.parametrize("preset", ["demo", "thesis/frozen_256", "catch/joint"])
def test_print_config_shows_a_preset(preset, capsys, loop):
    train_in_process(f"--preset={preset}", "--print_config", "--seed=3")
    config = Config.from_json(capsys.readouterr().out)
    assert config.seed == 3
    assert config.mode == PRESETS[preset]["mode"]
    assert loop.calls == []


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize\nmore")])
def test_a_device_that_is_not_there_is_refused_before_anything_is_written(
    capsys, loop, tmp_path, monkeypatch, error
):
    import jax

    def devices():
        raise error

    monkeypatch.setattr(jax, "devices", devices)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    line = refused(capsys, f"--out={tmp_path}/a")
    why = " (Unable to initialize)" if str(error) else ""
    assert line.startswith(f"error: JAX_PLATFORMS=cuda: jax finds no such device{why}; ")
    assert list(tmp_path.iterdir()) == [] and loop.calls == []


def test_the_entry_point_refuses_a_device_in_one_line(tmp_path):
    # A process: jax itself finds none, and neither jax nor absl says anything beside our line.
    arguments = ["--game=Catch", "--tune_runtime=off", f"--out={tmp_path}/a"]
    done = python("-m", "experiments.train", *arguments, JAX_PLATFORMS="nonsense")
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_PLATFORMS=nonsense: jax finds no such device (")
    assert list(tmp_path.iterdir()) == []
