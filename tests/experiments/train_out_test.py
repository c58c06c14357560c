"""--out of experiments.train: which runs make way for another one, and which do not."""

import os

import pytest

from experiments import resume
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import rundir
from tests.in_process import CATCH, checkpoint_of, refused, train_in_process


def test_overwrite_replaces_a_run_but_not_what_it_starts_from(capsys, loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    train_in_process("--game=Catch", f"--out={out}")
    (out / "metrics.jsonl").write_text("{}")
    (out / "checkpoints").mkdir()
    start = ["--mode=finetuned", f"--encoder_from={out}/checkpoints"]
    line = refused(capsys, f"--out={out}", "--overwrite", *start)
    assert "--overwrite would delete --encoder_from" in line
    monkeypatch.chdir(out)
    assert "working directory" in refused(capsys, f"--out={out}", "--overwrite")
    monkeypatch.chdir(tmp_path)
    assert (out / "metrics.jsonl").exists()
    train_in_process("--game=Catch", "--seed=1", f"--out={out}", "--overwrite")
    assert {path.name for path in out.iterdir()} == {"config.json", "metrics.jsonl"}
    assert (out / "metrics.jsonl").read_text() == ""  # the new run's
    assert Config.load(out).seed == 1


def test_a_run_within_another_is_not_overwritten_with_it(capsys, loop, tmp_path):
    out = tmp_path / "run"
    train_in_process("--game=Catch", f"--out={out}")
    train_in_process("--game=Catch", f"--out={out}/Catch/a/seed0")
    line = refused(capsys, f"--out={out}", "--overwrite")
    assert "Catch/a/seed0 lies in it, which --overwrite would delete with it; move it away" in line
    assert (out / "Catch/a/seed0/config.json").exists() and (out / "config.json").exists()


def test_overwriting_that_the_loop_refuses_leaves_the_old_run(capsys, loop, tmp_path, monkeypatch):
    out = tmp_path / "run"
    train_in_process(*CATCH, f"--out={out}")
    (out / "metrics.jsonl").write_text("{}")
    checkpoint_of(out, 200)

    def refuse(config, out, **_):
        assert not (out / "metrics.jsonl").exists()  # it would append to the old one's
        (out / "metrics.jsonl").touch()
        raise ConfigError("--buffer_size=70: must be at least 90")

    monkeypatch.setattr(loop, "train", refuse)
    before = sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*") if p.is_file())
    assert "--buffer_size=70" in refused(capsys, "--seed=3", "--overwrite", f"--out={out}")
    assert sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*") if p.is_file()) == before


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize("flag", ["--overwrite", "--resume=auto", "--overwrite --seeds=1,", "--seeds=1,"])
def test_a_seed_that_a_process_holds_is_not_deleted(capsys, loop, tmp_path, flag, begun):
    seed = tmp_path / "run/seed0"
    train_in_process(*CATCH, f"--out={seed}")
    if begun:
        (seed / "metrics.jsonl").unlink()
    with rundir.held(seed):
        line = refused(capsys, *CATCH[1:], f"--out={tmp_path}/run", *flag.split())
        if flag != "--resume=auto":
            assert f"--out={seed}: process {os.getpid()} on" in line
        assert Config.load(seed).steps == 500 and (seed / "metrics.jsonl").exists() != begun
        # A race that nobody sees when it is looked first.
        with pytest.raises(ConfigError, match="is writing there"):
            with rundir.run_directory(tmp_path / "run", Config.load(seed)):
                raise AssertionError("a run began")
    assert Config.load(seed).steps == 500 and len(loop.calls) == 1


def test_seeds_do_not_write_where_a_single_run_does(capsys, loop, tmp_path):
    train_in_process(*CATCH, f"--out={tmp_path}")
    with rundir.held(tmp_path):
        for flag in ("--overwrite", "--resume=auto"):
            line = refused(capsys, *CATCH[1:], f"--out={tmp_path}", "--seeds=0,1", flag)
            assert f"--out={tmp_path}: process {os.getpid()} on" in line
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "metrics.jsonl"}


def test_a_directory_holds_a_single_run_or_seeds(capsys, loop, tmp_path):
    single, seeds = [f"--out={tmp_path}/a"], [f"--out={tmp_path}/b", "--seeds=0,1,2"]
    for arguments in (single, seeds):
        train_in_process(*CATCH, *arguments)
    for run in ("a", "b/seed0", "b/seed1", "b/seed2"):
        checkpoint_of(tmp_path / run, 200)
    capsys.readouterr()
    line = refused(capsys, *CATCH[1:], *single, "--seeds=0,1", "--resume=auto")
    assert "a single run lies there, which --seeds does not resume" in line
    line = refused(capsys, *CATCH[1:], f"--out={tmp_path}/b", "--resume=auto")
    assert "runs of several seeds lie there; give their --seeds" in line
    assert not (tmp_path / "a/seed0").exists() and not (tmp_path / "b/config.json").exists()
    # What is overwritten goes as a whole.
    train_in_process(*CATCH, *single, "--seeds=0,1", "--overwrite")
    assert {path.name for path in (tmp_path / "a").iterdir()} == {"seed0", "seed1"}
    train_in_process(*CATCH, f"--out={tmp_path}/b", "--seeds=0,1", "--overwrite")
    assert {path.name for path in (tmp_path / "b").iterdir()} == {"seed0", "seed1"}
    assert resume.command_line(f"{tmp_path}/b")[1] == "--seeds=0,1"
    # An arm of a sweep looks alike, and its runs are none of one process.
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(ConfigError, match=f"^{tmp_path}/b: runs of a sweep, each by itself"):
        resume.command_line(f"{tmp_path}/b")
    (tmp_path / "sweep.json").unlink()
    train_in_process(*CATCH, f"--out={tmp_path}/b", "--overwrite")
    assert {path.name for path in (tmp_path / "b").iterdir()} == {"config.json", "metrics.jsonl"}
    # What lies beside seeds may be anything.
    (tmp_path / "a/pong").mkdir()
    line = refused(capsys, *CATCH[1:], f"--out={tmp_path}/a", "--overwrite")
    assert "pong lies beside the runs of seeds, so --overwrite does not delete them; move it away" in line


@pytest.mark.parametrize(
    ("arguments", "left"),
    [
        (["--seeds=2,"], {"seed2"}),
        (["--seeds=0,", "--resume=auto"], {"seed0"}),
        (["--resume=auto"], {"config.json", "metrics.jsonl"}),
        ([], {"config.json", "metrics.jsonl"}),
    ],
)
def test_what_left_no_row_is_no_seed_of_the_next_run(loop, tmp_path, arguments, left):
    train_in_process(*CATCH, f"--out={tmp_path}", "--seeds=0,1")
    train_in_process(*CATCH, f"--out={tmp_path}", *arguments)
    assert {path.name for path in tmp_path.iterdir()} == left
