"""Tests of experiments.train: where a run is written, and what is said before it begins."""

import importlib.util
import json
import os
import sys

import pytest

from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import rundir
from tests.in_process import CATCH, checkpoint_of, refused, train_in_process

JOINT = ["--game=Catch", "--mode=joint", "--objective=reconstruction"]


def test_seeds_get_a_run_directory_each(loop, tmp_path):
    train_in_process("--game=Catch", "--seeds=4,0", f"--out={tmp_path / 'runs'}")
    assert [out.name for _, out in loop.calls] == ["seed4", "seed0"]
    seeds = [Config.load(tmp_path / "runs" / name).seed for name in ("seed4", "seed0")]
    assert seeds == [4, 0]


def test_out_is_needed(capsys, loop):
    assert "--out: missing" in refused(capsys)
    assert "--out: missing" in refused(capsys, "--out=")


def test_out_that_cannot_be_made(capsys, loop, tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("mine")
    assert "not a directory" in refused(capsys, f"--out={file}")
    assert "not a directory" in refused(capsys, f"--out={file}/below")
    # The system refuses such a name only after its parent was made; the parent must go again.
    assert "--out=" in refused(capsys, f"--out={tmp_path}/parent/{'x' * 300}")
    assert list(tmp_path.iterdir()) == [file] and file.read_text() == "mine"
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "no permission" in refused(capsys, f"--out={tmp_path}/new")
    (tmp_path / "empty").mkdir()
    assert "no permission" in refused(capsys, f"--out={tmp_path}/empty")
    assert loop.calls == []


def test_a_directory_with_files_is_kept(capsys, loop, tmp_path):
    (tmp_path / "config.json").write_text("{}")
    assert "not empty" in refused(capsys, f"--out={tmp_path}")
    # Somebody else's config.json does not make it a run.
    assert "not a run directory" in refused(capsys, f"--out={tmp_path}", "--overwrite")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert loop.calls == []


def test_a_run_starts_with_its_config_written(loop, tmp_path):
    out = tmp_path / "runs" / "a"
    train_in_process(*JOINT, "--objective=latent_l2:weight=1e-6", f"--out={out}")
    ((config, path),) = loop.calls
    assert path == out
    assert Config.load(out) == config
    first = [text.split(",")[0] for text in config.objectives]
    assert first == ["reconstruction:weight=1.0", "latent_l2:weight=1e-06"]
    assert "n_step=3" in config.rl
    assert json.loads((out / "config.json").read_text())["versions"]["python"]


def test_a_config_that_the_loop_refuses_leaves_nothing(capsys, loop, tmp_path, monkeypatch):
    def refuse(config, out, **_):
        raise ConfigError("--encoder_from=x: another architecture")

    monkeypatch.setattr(loop, "train", refuse)
    line = refused(capsys, f"--out={tmp_path}/runs/a")
    assert line == "error: --encoder_from=x: another architecture\n"
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty").mkdir()
    refused(capsys, f"--out={tmp_path}/empty")
    assert list((tmp_path / "empty").iterdir()) == []


def test_two_processes_do_not_write_one_run(capsys, loop, tmp_path):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    for flag in ("--overwrite", "--resume=auto"):
        with rundir.held(out):
            line = refused(capsys, *CATCH[1:], f"--out={out}", flag)
        assert f"process {os.getpid()} on" in line and "is writing there" in line
        assert (out / "metrics.jsonl").exists() and Config.load(out).steps == 500
    assert len(loop.calls) == 1


def test_a_flag_that_a_game_has_no_use_for_is_named(capsys, loop, tmp_path):
    train_in_process("--game=Catch", "--sticky_actions=0.25", "--nolife_loss", f"--out={tmp_path}/a")
    said = capsys.readouterr().err
    assert all(
        f"--{name}: changes nothing, Catch has none" in said for name in ("sticky_actions", "life_loss")
    )
    train_in_process("--game=Pong", "--nolife_loss", "--sticky_actions=0.25", f"--out={tmp_path}/b")
    train_in_process("--preset=catch/rl_only", f"--out={tmp_path}/c")
    assert "changes nothing" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "last"),
    [
        (["--steps=700", "--eval_every=500"], "500 of 700"),
        (["--steps=90", "--eval_every=100"], "0 of 90"),
        (["--steps=1000", "--eval_every=500"], ""),
        (["--steps=95", "--eval_every=100"], ""),  # a round of ten environments ends at 100
        (["--steps=700", "--eval_every=500", "--final_games=3"], ""),
    ],
)
def test_a_last_evaluation_before_the_end_is_said(capsys, loop, tmp_path, flags, last):
    train_in_process("--preset=catch/rl_only", *flags, f"--out={tmp_path}/a")
    assert (f"the last evaluation is after {last} env steps" in capsys.readouterr().err) == bool(last)


def test_an_extended_run_says_it_too(capsys, loop, tmp_path):
    resume = [*(x for x in CATCH if "--steps" not in x), f"--out={tmp_path / 'run'}", "--resume=auto"]
    train_in_process(*resume, "--steps=500")
    checkpoint_of(tmp_path / "run", 200)
    for steps, said in ((500, False), (800, True), (1000, False)):
        train_in_process(*resume, f"--steps={steps}", "--dry_run")
        assert ("the last evaluation is after 500 of 800" in capsys.readouterr().err) == said
    train_in_process(*resume, "--steps=800")
    assert "the last evaluation is after 500 of 800" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        # Ten environments: the last round of 300 begins at 290, and its ten steps have one update.
        (["--learn_start=1000"], "--learn_start=1000: no update is due within 300 env steps"),
        (["--learn_start=291"], "--learn_start=291: no update"),
        (["--learn_start=290", "--updates_per_step=0.1"], ""),
        (["--learn_start=290", "--updates_per_step=0.09"], "--updates_per_step=0.09: no update"),
        (["--learn_start=32", "--updates_per_step=1e-6"], "--updates_per_step=1e-06: no update"),
    ],
)
def test_a_run_without_an_update_is_said(capsys, loop, tmp_path, flags, says):
    train_in_process("--preset=catch/rl_only", "--steps=300", *flags, f"--out={tmp_path}/a")
    said = capsys.readouterr().err
    assert says in said and ("no update is due" in said) == bool(says)


def test_a_game_that_cannot_be_made_leaves_nothing(capsys, loop, tmp_path):
    with pytest.raises(SystemExit):
        train_in_process("--game=nonesuch_module:E-v0", f"--out={tmp_path}/a")
    line = capsys.readouterr().err
    assert "--game=nonesuch_module:E-v0: cannot be made: ModuleNotFoundError: No module named" in line
    assert not list(tmp_path.iterdir())


def test_an_extra_that_is_missing_is_named(capsys, loop, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit):
        train_in_process("--game=Pong", f"--out={tmp_path}/a")
    assert "--game=Pong: Atari needs ale-py" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert "needs wandb: pip install wandb" in refused(capsys, "--logger=wandb", f"--out={tmp_path}/a")


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(capsys, loop, tmp_path):
    out = tmp_path / "run"
    assert train_in_process(*CATCH, "--dry_run", f"--out={out}", "--seeds=3,4") == 0
    printed = capsys.readouterr()
    config = Config.from_json(printed.out)
    assert config.steps == 500 and "n_step=3" in config.rl
    assert printed.err == "".join(
        f"dry run: nothing is written; a run would begin in {out}/seed{seed}\n" for seed in (3, 4)
    )
    assert loop.calls == [] and list(tmp_path.iterdir()) == []
    train_in_process(*CATCH, f"--out={out}")
    checkpoint_of(out, 200)
    capsys.readouterr()
    before = sorted((p, p.stat().st_mtime_ns) for p in tmp_path.rglob("*"))
    assert train_in_process(*CATCH, "--dry_run", f"--out={out}", "--resume=auto") == 0
    assert f"a run would resume from 200 env steps in {out}\n" in capsys.readouterr().err
    assert "not empty" in refused(capsys, *CATCH[1:], "--dry_run", f"--out={out}")
    new = ["--dry_run", f"--out={tmp_path}/new"]
    assert "no 'rainbwo'" in refused(capsys, "--rl=rainbwo", *new)
    # Ten environments of 4 frames, 10,000 steps ahead, the slot that is written and one to spare.
    assert "--buffer_size=100000: must be at least 100060; " in refused(capsys, "--rl=:n_step=10000", *new)
    assert "--out=/proc/x: nothing can be made in /proc: " in refused(capsys, "--dry_run", "--out=/proc/x")
    told = ["--steps=500", "--eval_every=400", "--sticky_actions=0.25", "--learn_start=600"]
    train_in_process("--preset=catch/rl_only", *told, *new)
    said = capsys.readouterr().err
    assert "--sticky_actions: changes nothing" in said and "--learn_start=600: no update" in said
    assert "--eval_every=400: the last evaluation is after 400 of 500" in said
    assert sorted((p, p.stat().st_mtime_ns) for p in tmp_path.rglob("*")) == before and len(loop.calls) == 1
