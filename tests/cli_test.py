"""Tests of the command line: experiments.flags and experiments.train."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time
import types

import numpy as np
import pytest
from absl import flags

import srl_jax
from experiments import flags as config_flags
from experiments import resume, train
from experiments.presets import PRESETS
from srl_jax import checkpoint, rundir
from srl_jax.config import INFOS, Config
from srl_jax.errors import ConfigError
from srl_jax.metrics import read_metrics, strip_wall
from tests.helpers import SMALL

ROOT = pathlib.Path(__file__).resolve().parents[1]
JOINT = ["--game=Catch", "--mode=joint", "--objective=reconstruction"]


class Loop(types.ModuleType):
    """Stands in for srl_jax.loop."""

    def __init__(self):
        super().__init__("srl_jax.loop")
        self.calls = []
        self.resumed = []
        self.seeds = []

    def train_seeds(self, config, seeds, outs, *, resume, stop):
        self.seeds.append(seeds)
        manifests = resume or [None] * len(outs)
        return [self.train(config, out, resume=m, stop=stop) for out, m in zip(outs, manifests, strict=True)]

    def train(self, config, out, *, resume=None, stop):
        assert not stop()
        self.calls.append((config, out))
        self.resumed.append(resume)
        (pathlib.Path(out) / "metrics.jsonl").touch()
        return types.SimpleNamespace(
            env_steps=0, updates=0, interrupted=False, saved=None, pictures={}, recording=None
        )


def test_seeds_get_a_run_directory_each(loop, tmp_path):
    _train("--game=Catch", "--seeds=4,0", f"--out={tmp_path / 'runs'}")
    assert [out.name for _, out in loop.calls] == ["seed4", "seed0"]
    seeds = [Config.load(tmp_path / "runs" / name).seed for name in ("seed4", "seed0")]
    assert seeds == [4, 0]


@pytest.fixture
def loop(monkeypatch):
    stub = Loop()
    monkeypatch.setitem(sys.modules, "srl_jax.loop", stub)
    monkeypatch.setattr(srl_jax, "loop", stub, raising=False)
    return stub


def _parse(arguments):
    values = flags.FlagValues()
    train.define_flags(values)
    config_flags.parse(["train", *arguments], values)
    return values


def _train(*arguments):
    """What the entry point does, in this process and with flags of its own."""
    try:
        return train.train(_parse(arguments))
    except ConfigError as error:
        config_flags.fail(error)


def _config(*arguments):
    return config_flags.config_from_flags(_parse(arguments), complete=False)


def _python(*arguments):
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60)


def test_every_field_is_a_flag_with_help_and_its_default():
    values = _parse([])
    assert config_flags.config_from_flags(values) == Config()
    for name, info in INFOS.items():
        flag = values[info.flag or name]
        assert info.help in flag.help and info.unit in flag.help
        assert flag.value == (getattr(Config(), name) or flag.value)


def test_flags_set_the_fields():
    config = _config(
        "--game=MsPacman", "--steps=1e6", "--gamma=0.9", "--notensorboard", "--reward_clip=false",
        "--stop_at_return=-3.5", "--mode=joint", "--objective=a:weight=1,size=2", "--objective=b",
    )  # fmt: skip
    assert config == Config(
        game="MsPacman", steps=1_000_000, gamma=0.9, reward_clip=False, stop_at_return=-3.5,
        mode="joint", objectives=("a:weight=1,size=2", "b"),
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
    assert _config("--preset=thesis/rl_only_256", "--encoder=:features=9").encoder.startswith(
        "sac_ae:features=9,init=he,"
    )


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
    _train("--preset=catch/joint", "--objective=inverse", f"--out={tmp_path}/a")
    assert (
        "objective: inverse in place of reconstruction:weight=1 and latent_l2:weight=1e-6 of "
        "--preset=catch/joint; --objective=+NAME adds to them\n"
    ) in capsys.readouterr().err
    _train("--preset=catch/joint", "--objective=+inverse", f"--out={tmp_path}/b")
    _train("--game=Catch", "--mode=joint", "--objective=inverse", f"--out={tmp_path}/c")
    assert "objective" not in capsys.readouterr().err


def test_settings_come_from_a_config_file(tmp_path, loop):
    out = tmp_path / "run"
    _train("--preset=catch/joint", "--seed=3", "--lr_rl=1e-3", f"--out={out}")
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
    (["--rl=:n_step=0"], "--rl=rainbow:n_step=0", "at least 1"),
    (["--rl=:n_step"], "--rl=:n_step", "'n_step' is not key=value"),
    (["--encoder=:n_step=1"], "--encoder=nature:n_step=1", "nature has no option"),
    (["--preset=small"], "--preset=small", "thesis/joint_256+small"),
    (["--preset=thesis/joint_256+smal"], "--preset=thesis/joint_256+smal", "did you mean small?"),
    (["--preset=catch/joint", "--config=x"], "--config=x", "--preset=catch/joint; give one of them"),
    (["--config=no/such"], "--config=no/such", "give a run's config.json"),
    (["--config=pyproject.toml"], "--config=pyproject.toml", "not JSON"),
    ([*JOINT, "--objective=+inverse"], "--objective=reconstruction", "replaces all"),
    (["--preset=catch/joint", "--objective=-inverse"], "--objective=-inverse", "reconstruction, latent_l2"),
    (["--import=no_such.py"], "--import=", "no such file"),
    (["--reward_clip=maybe"], "--reward_clip=maybe", "true or false"),
    (["--srl_every=4"], "--srl_every=4", "joint, decoupled"),
    (["--srl_every=0", *JOINT], "--srl_every=0", "at least 1"),
    (["--seeds=1,2,1"], "--seeds=1,2,1", "twice"),
    (["--seeds=1,b"], "--seeds=1,b", "not a whole number; give integers"),
    (["--seeds=0,-1"], "--seeds=0,-1", "at least 0"),
    (["--seeds="], "--seeds=", "give integers"),
    (["--seeds=0,1", "--seed=2"], "--seeds=0,1", "--seed=2; give one of them"),
    (["--tune_runtime=x"], "--tune_runtime=x", "valid: auto, off"),
    (["--steps"], "--steps", ""),
    (["--gane=Pong"], "--gane", "did you mean --game"),
    (["--lr=1"], "--lr: no such flag", "did you mean --lr_encoder or --lr_encoder_srl or"),
    (["Pong"], "'Pong'", "--name=value"),
    (["--notensorboard=1"], "--notensorboard=1", "argument"),
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
        _train(*([] if any("--out=" in text for text in arguments) else [f"--out={out}"]), *arguments)
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and printed.err.endswith("\n")
    assert flag in printed.err and choice in printed.err
    assert list(tmp_path.iterdir()) == []
    assert loop.calls == []


def test_a_later_flag_of_a_name_replaces_an_earlier_one():
    given = ("--a=1", "--objective=x", "--b=2", "--c", "--objective=y", "--a=3", "--b=", "run")
    left = ("--objective=x", "--c", "--objective=y", "--a=3", "--b=", "run")
    assert config_flags.last_of_each(given) == left


@pytest.mark.parametrize(
    ("program", "flag", "hint"),
    [
        ("draw", "run", "give it once"),
        ("evaluate", "games", "give it once"),
        ("report", "out", "give it once"),
        ("sweep", "lr_rl", "give it once"),
        ("sweep", "presets", "separate values with commas"),
        ("figures", "games", "separate values with commas"),
        ("reference_policies", "games", "separate values with commas"),
        ("benchmarks.bench", "rounds", "give it once"),
    ],
)
def test_a_flag_that_means_one_value_is_refused_twice(program, flag, hint):
    # A process each: that entry points parse in one place is the point.
    value = "Catch" if flag == "games" and program != "evaluate" else "1"
    done = _python("-m", f"experiments.{program}", f"--{flag}={value}", f"--{flag}={value}")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: --{flag}: given 2 times; {hint}\n"


def _refused(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        _train("--game=Catch", *arguments)
    assert ended.value.code == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line


def test_out_is_needed(capsys, loop):
    assert "--out: missing" in _refused(capsys)
    assert "--out: missing" in _refused(capsys, "--out=")


def test_out_that_cannot_be_made(capsys, loop, tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("mine")
    assert "not a directory" in _refused(capsys, f"--out={file}")
    assert "not a directory" in _refused(capsys, f"--out={file}/below")
    # The system refuses such a name only after its parent was made; the parent must go again.
    assert "--out=" in _refused(capsys, f"--out={tmp_path}/parent/{'x' * 300}")
    assert list(tmp_path.iterdir()) == [file] and file.read_text() == "mine"
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "no permission" in _refused(capsys, f"--out={tmp_path}/new")
    (tmp_path / "empty").mkdir()
    assert "no permission" in _refused(capsys, f"--out={tmp_path}/empty")
    assert loop.calls == []


def test_a_directory_with_files_is_kept(capsys, loop, tmp_path):
    (tmp_path / "config.json").write_text("{}")
    assert "not empty" in _refused(capsys, f"--out={tmp_path}")
    # Somebody else's config.json does not make it a run.
    assert "not a run directory" in _refused(capsys, f"--out={tmp_path}", "--overwrite")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert loop.calls == []


def test_overwrite_replaces_a_run_but_not_what_it_starts_from(capsys, loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    _train("--game=Catch", f"--out={out}")
    (out / "metrics.jsonl").write_text("{}")
    (out / "checkpoints").mkdir()
    start = ["--mode=finetuned", f"--encoder_from={out}/checkpoints"]
    line = _refused(capsys, f"--out={out}", "--overwrite", *start)
    assert "--overwrite would delete --encoder_from" in line
    monkeypatch.chdir(out)
    assert "working directory" in _refused(capsys, f"--out={out}", "--overwrite")
    monkeypatch.chdir(tmp_path)
    assert (out / "metrics.jsonl").exists()
    _train("--game=Catch", "--seed=1", f"--out={out}", "--overwrite")
    assert {path.name for path in out.iterdir()} == {"config.json", "metrics.jsonl"}
    assert (out / "metrics.jsonl").read_text() == ""  # the new run's
    assert Config.load(out).seed == 1


def test_a_run_starts_with_its_config_written(loop, tmp_path):
    out = tmp_path / "runs" / "a"
    _train(*JOINT, "--objective=latent_l2:weight=1e-6", f"--out={out}")
    ((config, path),) = loop.calls
    assert path == out
    assert Config.load(out) == config
    assert config.objectives == ("reconstruction:weight=1.0", "latent_l2:weight=1e-06")
    assert "n_step=3" in config.rl
    assert json.loads((out / "config.json").read_text())["versions"]["python"]


def test_a_config_that_the_loop_refuses_leaves_nothing(capsys, loop, tmp_path, monkeypatch):
    def refuse(config, out, **_):
        raise ConfigError("--encoder_from=x: another architecture")

    monkeypatch.setattr(loop, "train", refuse)
    line = _refused(capsys, f"--out={tmp_path}/runs/a")
    assert line == "error: --encoder_from=x: another architecture\n"
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty").mkdir()
    _refused(capsys, f"--out={tmp_path}/empty")
    assert list((tmp_path / "empty").iterdir()) == []


# Going on


CATCH = ["--game=Catch", "--encoder=tiny", "--frame_size=42", "--steps=500", "--checkpoint_every=100"]
CATCH += ["--nodiagnostics"]


def _checkpoint(out, env_steps, ended=False):
    """A checkpoint of the run in a directory, as the loop writes it."""
    params = {"encoder": {"kernel": np.ones(2, np.float32)}}
    state = None if ended else checkpoint.State({}, {}, {})
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": env_steps, "updates": 1}
    return checkpoint.save(out, params, Config.load(out), state=state, **counts)


def test_a_run_goes_on_from_its_checkpoint_or_begins(capsys, loop, tmp_path):
    out = tmp_path / "run"
    resume = [*CATCH, f"--out={out}", "--resume=auto"]
    assert _train(*resume) == 0  # a new directory
    assert Config.load(out).steps == 500
    assert _train(*resume) == 0  # killed before its first checkpoint
    assert "no checkpoint there yet; the run begins again" in capsys.readouterr().err
    made = _checkpoint(out, 200)
    (out / "metrics.jsonl").write_text("kept")
    assert _train(*resume) == 0
    assert loop.resumed == [None, None, made]
    assert (out / "metrics.jsonl").read_text() == "kept" and made == checkpoint.read_manifest(out)
    assert not (out / "lock").exists()
    # Without the flag, nothing is touched, as before.
    assert "--resume=auto resumes the run" in _refused(capsys, *CATCH[1:], f"--out={out}")


def test_a_start_that_failed_is_in_nobodys_way(capsys, loop, tmp_path, monkeypatch):
    def failed(config, out, **_):
        (out / "metrics.jsonl").touch()
        raise RuntimeError("a mistake")

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "train", failed)
        with pytest.raises(RuntimeError):
            _train(*CATCH, "--rl=:n_step=7", f"--out={out}")
    assert (out / "config.json").exists()
    capsys.readouterr()
    for arguments in ([], ["--resume=auto"]):
        assert _train(*CATCH, "--rl=:n_step=6", f"--out={out}", *arguments) == 0
        assert "n_step=6" in Config.load(out).rl
        assert capsys.readouterr().err == (f"resume: {out}: no checkpoint there yet; the run begins again\n")


def test_what_cannot_be_gone_on_with_is_refused(capsys, loop, tmp_path):
    out = tmp_path / "run"
    _train(*CATCH, f"--out={out}")
    _checkpoint(out, 200)
    before = sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*"))
    resume = [*CATCH[1:], f"--out={out}", "--resume=auto"]
    assert "--resume=auto: resumes the run that --overwrite deletes" in _refused(
        capsys, *resume, "--overwrite"
    )
    line = _refused(capsys, *resume, "--seed=7", "--gamma=0.5")
    assert "another configuration: seed is 0 there and 7 here, gamma is 0.99 there and 0.5 here" in line
    with rundir.held(out):
        assert f"process {os.getpid()} on" in _refused(capsys, *resume)
    assert sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*")) == before
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "notes.txt").write_text("mine")
    line = _refused(capsys, *CATCH[1:], f"--out={foreign}", "--resume=auto")
    assert "not a run directory, so --resume=auto cannot resume it" in line
    assert [p.name for p in foreign.iterdir()] == ["notes.txt"]
    assert len(loop.calls) == 1


def test_a_run_goes_on_without_the_one_that_it_started_from(capsys, loop, tmp_path):
    pre, out = tmp_path / "pre", tmp_path / "run"
    objective = "--objective=reconstruction"
    _train(*CATCH, "--mode=pretrain", objective, f"--out={pre}")
    _checkpoint(pre, 500, ended=True)
    frozen = [*CATCH, "--mode=frozen", f"--out={out}", "--resume=auto"]
    _train(*frozen, f"--encoder_from={pre}")
    made = _checkpoint(out, 200)
    pre.rename(tmp_path / "moved")
    capsys.readouterr()
    for source in (pre, tmp_path / "moved", os.path.relpath(tmp_path / "moved")):
        assert _train(*frozen, f"--encoder_from={source}") == 0
        assert loop.resumed[-1] == made
        said = capsys.readouterr().err
        assert ("neither is read any more" in said) == (source != pre) and said.count("\n") <= 1
    # What has to begin needs it.
    line = _refused(
        capsys, *CATCH[1:], "--mode=frozen", f"--encoder_from={pre}", "--resume=auto", f"--out={tmp_path}/new"
    )
    assert f"--encoder_from={pre}: no such path" in line and not (tmp_path / "new").exists()


def test_pretraining_goes_on_with_the_policy_that_it_needs(capsys, loop, tmp_path):
    policy, out = tmp_path / "policy", tmp_path / "run"
    _train(*CATCH, f"--out={policy}")
    _checkpoint(policy, 500, ended=True)
    pretrain = [*CATCH, "--mode=pretrain", "--objective=reconstruction", f"--out={out}", "--resume=auto"]
    _train(*pretrain, f"--policy_from={policy}")
    made = _checkpoint(out, 200)
    policy.rename(tmp_path / "moved")
    capsys.readouterr()
    line = _refused(capsys, *pretrain[1:], f"--policy_from={policy}")
    assert line == (f"error: --policy_from={policy}: no such path; give a run directory or a checkpoint\n")
    assert _train(*pretrain, f"--policy_from={tmp_path}/moved") == 0 and loop.resumed[-1] == made
    assert "the run resumes with the latter" in capsys.readouterr().err


def test_two_processes_do_not_write_one_run(capsys, loop, tmp_path):
    out = tmp_path / "run"
    _train(*CATCH, f"--out={out}")
    for flag in ("--overwrite", "--resume=auto"):
        with rundir.held(out):
            line = _refused(capsys, *CATCH[1:], f"--out={out}", flag)
        assert f"process {os.getpid()} on" in line and "is writing there" in line
        assert (out / "metrics.jsonl").exists() and Config.load(out).steps == 500
    assert len(loop.calls) == 1


def test_a_run_that_has_ended_says_so(capsys, loop, tmp_path):
    out = tmp_path / "run"
    _train(*CATCH, f"--out={out}")
    _checkpoint(out, 500, ended=True)
    capsys.readouterr()
    assert _train(*CATCH, f"--out={out}", "--resume=auto") == 0
    assert capsys.readouterr().out == f"the run in {out} has ended: 500 env steps\n"
    assert len(loop.calls) == 1


def test_seeds_go_on_together(capsys, loop, tmp_path):
    arguments = [*CATCH, f"--out={tmp_path}/runs", "--resume=auto"]
    _train(*arguments, "--seeds=4,0")
    for seed, env_steps in ((4, 100), (0, 100), (4, 200)):
        _checkpoint(tmp_path / "runs" / f"seed{seed}", env_steps)
    _train(*arguments, "--seeds=4,0")
    assert loop.seeds == [[4, 0]] * 2
    assert [m and m.env_steps for m in loop.resumed] == [None, None, 100, 100]
    line = _refused(capsys, *arguments[1:], "--seeds=4,0,1")
    assert "seed1: no checkpoint there" in line


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_run_that_was_stopped_says_how_to_go_on(capsys, loop, tmp_path, monkeypatch, number):
    def stopped(config, out, *, resume, stop):
        assert not stop()
        (out / "metrics.jsonl").touch()
        os.kill(os.getpid(), number)
        assert stop()
        if number != signal.SIGTERM:
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):  # who asks twice does not wait
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        return types.SimpleNamespace(
            env_steps=40, updates=0, interrupted=True, saved=40, pictures={}, recording=None
        )

    monkeypatch.setattr(loop, "train", stopped)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert _train(*CATCH, f"--out={tmp_path}/run") == 128 + number
    assert capsys.readouterr().out.endswith(
        f"stopped after 40 env steps; srl-jax resume {tmp_path}/run resumes from there\n"
    )
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


@pytest.mark.parametrize(("error", "status"), [("ConfigError", 2), ("SaveError", 3), ("Diverged", 4)])
def test_errors_are_one_line_and_have_a_status_of_their_own(error, status):
    code = (
        "from experiments import flags; from srl_jax import errors\n"
        "def main(argv):\n"
        f"    raise errors.{error}('two\\n lines')\n"
        "flags.run(main)"
    )
    done = _python("-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "error: two lines\n")


def test_resume_needs_nothing_but_the_directory(loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    _train(*CATCH, "--lr_rl=1e-3", "--objective=inverse", "--mode=joint", f"--out={out}")
    manifest = _checkpoint(out, 100)
    _train(*resume.command_line(str(out)))
    (_, (config, path)) = loop.calls
    assert (config, path) == (Config.load(out), out)
    assert loop.resumed[-1].path == checkpoint.read_manifest(out).path and manifest


def test_resume_finds_the_seeds_of_a_process(loop, tmp_path):
    for seed in (10, 2):
        _train(*CATCH, f"--seed={seed}", f"--out={tmp_path}/runs/seed{seed}")
    assert resume.command_line(f"{tmp_path}/runs") == [
        f"--config={tmp_path}/runs/seed2/config.json", "--seeds=2,10", f"--out={tmp_path}/runs",
        "--resume=auto",
    ]  # fmt: skip


def test_resume_refuses_what_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match="not a run directory"):
        resume.command_line(str(tmp_path))
    (tmp_path / "sweep.json").touch()
    with pytest.raises(ConfigError, match="a sweep, which srl-jax sweep --out="):
        resume.command_line(str(tmp_path))
    done = _python("-m", "experiments.resume")
    assert (done.returncode, done.stderr) == (
        2,
        "error: name a run directory first: srl-jax resume runs/NAME\n",
    )


SHORT = SMALL | {"steps": 1200, "eval_every": 400}
RUN = [*(f"--{name}={value}" for name, value in SHORT.items()), "--tune_runtime=off"]


def test_a_process_that_is_told_to_end_goes_on_as_if_it_had_not(tmp_path):
    from srl_jax import loop

    out, command = tmp_path / "run", [sys.executable, "-m", "experiments.train", *RUN]
    first = subprocess.Popen(
        [*command, f"--out={out}"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    metrics = out / "metrics.jsonl"
    deadline = time.monotonic() + 120
    while not (metrics.exists() and b"loss/rl" in metrics.read_bytes()):
        assert first.poll() is None and time.monotonic() < deadline, first.communicate()
        time.sleep(0.02)
    with pytest.raises(ConfigError, match=f"process {first.pid} on"):
        rundir.check_free(out)
    first.send_signal(signal.SIGTERM)
    printed, _ = first.communicate(timeout=60)
    assert first.returncode == 128 + signal.SIGTERM
    stopped = checkpoint.read_manifest(out).env_steps
    assert 80 <= stopped < 1200
    line = f"stopped after {stopped} env steps; srl-jax resume {out} resumes from there"
    assert line in printed.splitlines()

    done = _python("-m", "srl_jax", "resume", str(out), "--tune_runtime=off")
    assert done.returncode == 0, done.stderr
    assert f"1200 env steps, 145 updates; everything is in {out}" in done.stdout
    whole = tmp_path / "whole"
    whole.mkdir()
    loop.train(Config.load(out), whole, progress=False)
    rows = [[strip_wall(row) for row in read_metrics(path / "metrics.jsonl")] for path in (out, whole)]
    assert rows[0] == rows[1] and rows[0][-1]["env_steps"] == 1200
    assert checkpoint.read_manifest(out).files == checkpoint.read_manifest(whole).files


def test_a_flag_that_a_game_has_no_use_for_is_named(capsys, loop, tmp_path):
    _train("--game=Catch", "--sticky_actions=0.25", f"--out={tmp_path}/a")
    assert "--sticky_actions: changes nothing, Catch has none" in capsys.readouterr().err
    _train("--game=Pong", "--sticky_actions=0.25", f"--out={tmp_path}/b")
    _train("--preset=catch/rl_only", f"--out={tmp_path}/c")
    assert "changes nothing" not in capsys.readouterr().err


def test_a_game_that_cannot_be_made_leaves_nothing(capsys, loop, tmp_path):
    with pytest.raises(SystemExit):
        _train("--game=nonesuch_module:E-v0", f"--out={tmp_path}/a")
    line = capsys.readouterr().err
    assert "--game=nonesuch_module:E-v0: cannot be made: ModuleNotFoundError: No module named" in line
    assert not list(tmp_path.iterdir())


def test_an_extra_that_is_missing_is_named(capsys, loop, tmp_path, monkeypatch):
    monkeypatch.setattr(train.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit):
        _train("--game=Pong", f"--out={tmp_path}/a")
    assert "--game=Pong: Atari needs ale-py" in capsys.readouterr().err
    assert "--tensorboard" in _refused(capsys, "--tensorboard", f"--out={tmp_path}/a")


@pytest.mark.parametrize("preset", PRESETS)
def test_print_config_shows_every_preset(preset, capsys, loop):
    _train(f"--preset={preset}", "--print_config", "--seed=3")
    config = Config.from_json(capsys.readouterr().out)
    assert config.seed == 3
    assert config.mode == PRESETS[preset]["mode"]
    assert loop.calls == []


def test_the_entry_point_refuses_a_game_in_one_line(tmp_path):
    done = _python("-m", "experiments.train", "--game=Pogn", f"--out={tmp_path}/a")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --game=Pogn: did you mean Pong? valid: an Atari-57 game (")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_entry_point_refuses_an_option_in_one_line(tmp_path):
    # It takes jax to find this one, so a restart would come first.
    arguments = ["--rl=rainbow:v_min=20", "--tune_runtime=off", f"--out={tmp_path}/a"]
    done = _python("-m", "experiments.train", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --rl=rainbow:v_min=20")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize\nmore")])
def test_a_device_that_is_not_there_is_refused_before_anything_is_written(
    capsys, loop, tmp_path, monkeypatch, error
):
    import jax

    def devices():
        raise error

    monkeypatch.setattr(jax, "devices", devices)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    line = _refused(capsys, f"--out={tmp_path}/a")
    why = " (Unable to initialize)" if str(error) else ""
    assert line.startswith(f"error: JAX_PLATFORMS=cuda: jax finds no such device{why}; ")
    assert list(tmp_path.iterdir()) == [] and loop.calls == []


def test_the_entry_point_refuses_a_device_in_one_line(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "experiments.train",
            "--game=Catch",
            "--tune_runtime=off",
            f"--out={tmp_path}/a",
        ],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "nonsense"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_PLATFORMS=nonsense: jax finds no such device (")
    assert list(tmp_path.iterdir()) == []


def test_the_entry_point_prints_its_config():
    done = _python("-m", "experiments.train", "--preset=thesis/joint_256", "--print_config")
    assert (done.returncode, done.stderr) == (0, "")
    assert Config.from_json(done.stdout).encoder.startswith("sac_ae:features=256,")


def test_nothing_that_is_checked_first_imports_jax():
    code = (
        "import sys, experiments.train, srl_jax.config, srl_jax.modes, srl_jax.specs; "
        "print([m for m in ('jax', 'flax', 'gymnasium', 'ale_py') if m in sys.modules])"
    )
    assert _python("-c", code).stdout.strip() == "[]"
