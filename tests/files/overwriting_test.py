"""What becomes of a run that another one replaces: srl_jax/files/rundir.py."""

import contextlib
import dataclasses
import shutil

import pytest

from experiments import resume
from experiments.runs.run_data import run_directories
from experiments.train import check_out
from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files.rundir import run_directory
from tests.files.resuming_test import CONFIG, everything, make
from tests.files.rundir_test import contents


@pytest.mark.parametrize("folder", ["", "seed0"])
@pytest.mark.parametrize("number", range(1, 28, 2))
def test_overwriting_that_is_killed_anywhere_can_be_done_again(tmp_path, monkeypatch, capsys, folder, number):
    path = tmp_path / "run"
    make(path / folder, checkpoints=(100, 200))
    old, left = everything(path), [number]
    new = dataclasses.replace(CONFIG, seed=1)
    began = False

    class Killed(BaseException):
        pass

    def counted(call):
        def counted(*arguments, **options):
            left[0] -= 1
            if left[0] <= 0:  # who is killed puts nothing back
                raise Killed
            return call(*arguments, **options)

        return counted

    with monkeypatch.context() as patch, contextlib.suppress(Killed):
        for name in ("unlink", "rmdir", "replace", "rename", "mkdir", "fsync"):
            patch.setattr(shutil.os, name, counted(getattr(shutil.os, name)))
        with run_directory(path, new) as begun:
            (path / "metrics.jsonl").touch()
            began = left[0] > 1  # what is renamed then is not needed any more
            begun()
    (path / "lock").unlink(missing_ok=True)
    assert check_out(str(path), new, overwrite=True, resume=False) == path
    assert everything(path) == old if not began else Config.load(path) == new
    said = capsys.readouterr().err
    assert said in ("", f"{path}: what lay there is back: the run that was to replace it never began\n")
    assert not list(path.glob(".overwritten*"))
    with run_directory(path, new) as begun:
        begun()
        assert set(contents(path)) == {"config.json", "lock"}


@pytest.mark.parametrize("error", [ConfigError("refused"), KeyboardInterrupt()])
def test_what_ends_a_run_before_it_begins_leaves_the_one_that_it_replaces(tmp_path, error):
    path = tmp_path / "run"
    make(path, checkpoints=(100,), reached=100)
    (path / "notes").symlink_to(tmp_path)
    old = everything(path)
    with pytest.raises(type(error)), run_directory(path, dataclasses.replace(CONFIG, seed=1)):
        (path / "tensorboard").mkdir()
        (path / "metrics.jsonl").touch()
        raise error
    assert everything(path) == old and (path / "notes").is_symlink() and not (path / "tensorboard").exists()
    # Of one that has begun, nothing comes back.
    with pytest.raises(type(error)), run_directory(path, dataclasses.replace(CONFIG, seed=1)) as begun:
        begun()
        raise error
    assert set(contents(path)) == {"config.json"} and Config.load(path).seed == 1


def test_a_run_that_was_set_aside_is_in_nobodys_way(tmp_path, capsys):
    path = tmp_path / "run"
    make(path / ".overwritten", checkpoints=(100,), reached=100)
    old = everything(path / ".overwritten").values()
    dataclasses.replace(CONFIG, seed=1).save(path)
    assert run_directories(tmp_path) == [path]
    assert resume.command_line(str(path))[0] == f"--config={path}/config.json"
    assert "what lay there is back" in capsys.readouterr().err
    assert Config.load(path) == CONFIG and list(everything(path).values()) == list(old)


def test_a_config_that_cannot_be_written_is_a_save_error(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SaveError, match=f"--out={tmp_path}/run: No space left on device"):
        with run_directory(tmp_path / "run", CONFIG):
            raise AssertionError("a run began")
