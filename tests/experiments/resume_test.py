"""Tests of experiments.resume and --resume: from where a run goes on, and what cannot."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types

import pytest

from experiments import resume, train
from srl_jax.config import INFOS, SOURCES, Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint, rundir
from srl_jax.files.resuming import MAY_CHANGE
from srl_jax.run import ending
from tests.helpers import SMALL, rows_of
from tests.in_process import CATCH, ROOT, checkpoint_of, refused, train_in_process

JOINT = ["--game=Catch", "--mode=joint", "--objective=reconstruction"]


def test_a_run_goes_on_from_its_checkpoint_or_begins(capsys, loop, tmp_path):
    out = tmp_path / "run"
    resume = [*CATCH, f"--out={out}", "--resume=auto"]
    assert train_in_process(*resume) == 0  # a new directory
    assert Config.load(out).steps == 500
    assert train_in_process(*resume) == 0  # killed before its first checkpoint
    assert "no checkpoint there yet; the run begins again" in capsys.readouterr().err
    made = checkpoint_of(out, 200)
    (out / "metrics.jsonl").write_text("kept")
    assert train_in_process(*resume) == 0
    assert capsys.readouterr().err == f"resume: {out}: resumed from 200 env steps\n"
    assert loop.resumed == [None, None, made]
    assert (out / "metrics.jsonl").read_text() == "kept" and made == checkpoint.read_manifest(out)
    assert not (out / "lock").exists()
    # Without the flag, nothing is touched, as before.
    assert "--resume=auto resumes the run" in refused(capsys, *CATCH[1:], f"--out={out}")


def test_a_start_that_failed_is_in_nobodys_way(capsys, loop, tmp_path, monkeypatch):
    def failed(config, out, **_):
        (out / "metrics.jsonl").touch()
        raise RuntimeError("a mistake")

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "train", failed)
        with pytest.raises(RuntimeError):
            train_in_process(*CATCH, "--rl=:n_step=7", f"--out={out}")
    assert (out / "config.json").exists()
    capsys.readouterr()
    for arguments in ([], ["--resume=auto"]):
        assert train_in_process(*CATCH, "--rl=:n_step=6", f"--out={out}", *arguments) == 0
        assert "n_step=6" in Config.load(out).rl
        assert capsys.readouterr().err == (f"resume: {out}: no checkpoint there yet; the run begins again\n")


def test_what_cannot_be_gone_on_with_is_refused(capsys, loop, tmp_path):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    checkpoint_of(out, 200)
    before = sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*"))
    resume = [*CATCH[1:], f"--out={out}", "--resume=auto"]
    assert "--resume=auto: resumes the run that --overwrite deletes" in refused(
        capsys, *resume, "--overwrite"
    )
    line = refused(capsys, *resume, "--seed=7", "--gamma=0.5")
    assert "another configuration: seed is 0 there and 7 here, gamma is 0.99 there and 0.5 here" in line
    with rundir.held(out):
        assert f"process {os.getpid()} on" in refused(capsys, *resume)
    assert sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*")) == before
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "notes.txt").write_text("mine")
    line = refused(capsys, *CATCH[1:], f"--out={foreign}", "--resume=auto")
    assert "not a run directory, so --resume=auto cannot resume it" in line
    assert [p.name for p in foreign.iterdir()] == ["notes.txt"]
    assert len(loop.calls) == 1


def test_a_resume_that_the_loop_refuses_leaves_the_settings(capsys, loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    checkpoint_of(out, 200)
    before = (out / "config.json").read_bytes()
    longer = [f"--config={out}/config.json", "--steps=900", f"--out={out}", "--resume=auto"]
    with monkeypatch.context() as patch:

        def refuse(config, out, **_):
            raise ConfigError("metrics.jsonl: does not begin with the rows that the checkpoint knows")

        patch.setattr(loop, "train", refuse)
        with pytest.raises(SystemExit):
            train_in_process(*longer)
    assert "error: metrics.jsonl: does not begin" in capsys.readouterr().err
    assert (out / "config.json").read_bytes() == before
    train_in_process(*longer)
    assert Config.load(out).steps == 900


def test_a_run_goes_on_without_the_one_that_it_started_from(capsys, loop, tmp_path):
    pre, out = tmp_path / "pre", tmp_path / "run"
    objective = "--objective=reconstruction"
    train_in_process(*CATCH, "--mode=pretrain", objective, f"--out={pre}")
    checkpoint_of(pre, 500, ended=True)
    frozen = [*CATCH, "--mode=frozen", f"--out={out}", "--resume=auto"]
    train_in_process(*frozen, f"--encoder_from={pre}")
    made = checkpoint_of(out, 200)
    pre.rename(tmp_path / "moved")
    capsys.readouterr()
    for source in (pre, tmp_path / "moved", os.path.relpath(tmp_path / "moved")):
        assert train_in_process(*frozen, f"--encoder_from={source}") == 0
        assert loop.resumed[-1] == made
        said = capsys.readouterr().err
        assert ("neither is read any more" in said) == (source != pre)
        assert said.endswith("resumed from 200 env steps\n") and said.count("\n") <= 2
    # What has to begin needs it.
    line = refused(
        capsys, *CATCH[1:], "--mode=frozen", f"--encoder_from={pre}", "--resume=auto", f"--out={tmp_path}/new"
    )
    assert f"--encoder_from={pre}: no such path" in line and not (tmp_path / "new").exists()


def test_pretraining_goes_on_with_the_policy_that_it_needs(capsys, loop, tmp_path):
    policy, out = tmp_path / "policy", tmp_path / "run"
    train_in_process(*CATCH, f"--out={policy}")
    checkpoint_of(policy, 500, ended=True)
    pretrain = [*CATCH, "--mode=pretrain", "--objective=reconstruction", f"--out={out}", "--resume=auto"]
    train_in_process(*pretrain, f"--policy_from={policy}")
    made = checkpoint_of(out, 200)
    policy.rename(tmp_path / "moved")
    capsys.readouterr()
    line = refused(capsys, *pretrain[1:], f"--policy_from={policy}")
    assert line == (f"error: --policy_from={policy}: no such path; give a run directory or a checkpoint\n")
    assert train_in_process(*pretrain, f"--policy_from={tmp_path}/moved") == 0 and loop.resumed[-1] == made
    assert "the run resumes with the latter" in capsys.readouterr().err


def test_a_run_that_has_ended_says_so(capsys, loop, tmp_path):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    checkpoint_of(out, 500, ended=True)
    (out / "metrics.jsonl").unlink()
    capsys.readouterr()
    assert train_in_process(*CATCH, f"--out={out}", "--resume=auto") == 0
    line = f"the run in {out} has ended: 500 env steps"
    assert capsys.readouterr().out == f"{line}\n" and ending.read(out) is None  # its rows are not there
    # One that was killed, or told to end twice, while it drew pictures.
    (out / "metrics.jsonl").write_text('{"kind": "eval", "env_steps": 500}\n')
    for ended in (None, ending.Ending("stopped", 500)):
        if ended is not None:
            ending.write(out, ended)
        assert train_in_process(*CATCH, f"--out={out}", "--resume=auto", "--dry_run") == 0
        assert capsys.readouterr().out == f"{line}\n" and ending.read(out) == ended
        assert train_in_process(*CATCH, f"--out={out}", "--resume=auto") == 0
        late = "; it was killed before ended.json said so, which it does now\n"
        assert capsys.readouterr().out == line + late and ending.read(out) == ("finished", 500, "")
        (out / "ended.json").unlink()
    (out / "ended.json").write_text("{")
    assert train_in_process(*CATCH, f"--out={out}", "--resume=auto") == 0
    assert ending.read(out) == ("finished", 500, "") and not (out / "lock").exists()
    assert len(loop.calls) == 1


def test_a_run_that_has_ended_says_which_flags_come_too_late(capsys, loop, tmp_path):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    checkpoint_of(out, 500, ended=True)
    line = resume.command_line(str(out))
    capsys.readouterr()
    assert train_in_process(*line, "--steps=500", "--nokeep_replay") == 0 and capsys.readouterr().err == ""
    assert train_in_process(*line, "--logger=csv", "--nokeep_best") == 0
    said = sorted(capsys.readouterr().err.splitlines())
    late = ": changes nothing, the run has ended"
    assert said == [f"resume: --keep_best{late}", f"resume: --logger{late}"]


def test_the_help_of_resume_names_each_flag_that_may_follow():
    flags = [INFOS[name].flag or name for name in (*MAY_CHANGE, *SOURCES)]
    assert [flag for flag in flags if not re.search(rf"--{flag}\b", resume.__doc__)] == []


def test_seeds_go_on_together(capsys, loop, tmp_path):
    arguments = [*CATCH, f"--out={tmp_path}/runs", "--resume=auto"]
    train_in_process(*arguments, "--seeds=4,0")
    for seed, env_steps in ((4, 100), (0, 100), (4, 200)):
        checkpoint_of(tmp_path / "runs" / f"seed{seed}", env_steps)
    train_in_process(*arguments, "--seeds=4,0")
    assert capsys.readouterr().err == f"resume: {tmp_path}/runs: resumed from 100 env steps\n"
    assert loop.seeds == [[4, 0]] * 2
    assert [m and m.env_steps for m in loop.resumed] == [None, None, 100, 100]
    line = refused(capsys, *arguments[1:], "--seeds=4,0,1")
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
    assert train_in_process(*CATCH, f"--out={tmp_path}/run") == 128 + number
    assert capsys.readouterr().out.endswith(
        f"stopped after 40 env steps; srl-jax resume {tmp_path}/run resumes from there\n"
    )
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_resume_needs_nothing_but_the_directory(loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    train_in_process(*CATCH, "--lr_rl=1e-3", "--objective=inverse", "--mode=joint", f"--out={out}")
    manifest = checkpoint_of(out, 100)
    train_in_process(*resume.command_line(str(out)))
    (_, (config, path)) = loop.calls
    assert (config, path) == (Config.load(out), out)
    assert loop.resumed[-1].path == checkpoint.read_manifest(out).path and manifest


def test_resume_finds_the_seeds_of_a_process(loop, tmp_path):
    train_in_process(*CATCH, "--seeds=10,2", f"--out={tmp_path}/runs")
    shutil.copytree(tmp_path / "runs/seed2", tmp_path / "runs/seed2_old")  # somebody's copy, and no seed
    assert resume.command_line(f"{tmp_path}/runs") == [
        f"--config={tmp_path}/runs/seed2/config.json", "--seeds=2,10", f"--out={tmp_path}/runs",
        "--resume=auto",
    ]  # fmt: skip
    train_in_process(*CATCH, "--seeds=3,", f"--out={tmp_path}/one")
    train_in_process(*resume.command_line(f"{tmp_path}/one"))
    assert loop.seeds[-1] == [3] and loop.calls[-1][1] == tmp_path / "one/seed3"


def test_resume_does_not_join_seeds_that_were_trained_by_themselves(loop, tmp_path):
    for seed in (0, 1):
        train_in_process(*CATCH, f"--seed={seed}", f"--out={tmp_path}/runs/seed{seed}")
    with pytest.raises(ConfigError, match="each by itself, as seed0/config.json says; name one of them"):
        resume.command_line(f"{tmp_path}/runs")


def test_resume_refuses_what_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match="not a run directory"):
        resume.command_line(str(tmp_path))
    (tmp_path / "sweep.json").touch()
    with pytest.raises(ConfigError, match="a sweep, which srl-jax sweep --out="):
        resume.command_line(str(tmp_path))
    with pytest.raises(ConfigError, match="^name a run directory first: srl-jax resume runs/NAME$"):
        resume.main(["resume"])


SHORT = SMALL | {"steps": 600, "eval_every": 200, "rl": "dqn:hidden=16"}
RUN = [*(f"--{name}={value}" for name, value in SHORT.items()), "--tune_runtime=off"]


def test_a_process_that_is_told_to_end_goes_on_as_if_it_had_not(tmp_path, capsys, monkeypatch):
    from srl_jax.run import loop

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
    printed, _ = first.communicate(timeout=120)
    assert first.returncode == 128 + signal.SIGTERM
    stopped = checkpoint.read_manifest(out).env_steps
    assert 80 <= stopped < 600
    line = f"stopped after {stopped} env steps; srl-jax resume {out} resumes from there"
    assert line in printed.splitlines()

    monkeypatch.setattr(train, "draw", lambda *_: None)  # figures have tests of their own
    assert train_in_process(*resume.command_line(str(out)), "--tune_runtime=off") == 0
    assert f"600 env steps, 70 updates; everything is in {out}" in capsys.readouterr().out
    whole = tmp_path / "whole"
    whole.mkdir()
    loop.train(Config.load(out), whole, progress=False)
    assert rows_of(out) == rows_of(whole) and rows_of(out)[-1]["env_steps"] == 600
    assert checkpoint.read_manifest(out).files == checkpoint.read_manifest(whole).files
