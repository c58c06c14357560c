"""How a run ends: told to, interrupted, diverged, with a full disk; and what it leaves."""

import dataclasses
import errno
import itertools
import os
import threading
import time
from unittest import mock

import numpy as np
import pytest

from srl_jax.config import Config
from srl_jax.errors import ConfigError, Diverged, SaveError
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics
from srl_jax.files.resuming import has_ended
from srl_jax.replay import Replay
from srl_jax.run import actor, ending, evaluations, loop
from srl_jax.run.reporting import Report
from srl_jax.run.seed import Seed
from tests.helpers import JOINT, SMALL, stop_after, whole
from tests.run.loop_test import train

pytestmark = pytest.mark.usefixtures("shared_agents")


def test_ctrl_c_in_the_middle_of_a_step_leaves_the_last_checkpoint(tmp_path, monkeypatch, capsys):
    original = Replay.add

    def add(self, *arguments):
        original(self, *arguments)
        if self.num_transitions >= 100:
            raise KeyboardInterrupt

    monkeypatch.setattr(Replay, "add", add)
    path = tmp_path / "run"
    pytest.importorskip("tensorboardX")
    result = train(path, **JOINT, checkpoint_every=40, progress=True, loggers=("tensorboard",))
    # The step from 96 to 100 was being added; it does not count.
    assert result.interrupted and result.env_steps == 96
    assert "interrupted after 96 env steps; the last checkpoint is of 80" in capsys.readouterr().err
    assert whole(path).env_steps == 80 and "run.json" in whole(path).files
    assert "reconstruction" in result.pictures
    (events,) = (path / "tensorboard").iterdir()
    assert b"pictures/reconstruction" in events.read_bytes()


def test_a_run_that_is_told_to_stop_saves_and_leaves_it_to_others_to_say_so(tmp_path, capsys):
    path = tmp_path / "run"
    with stop_after(52) as stop:
        result = train(path, progress=True, stop=stop)
    assert result.interrupted and result.env_steps == result.saved == 52
    assert "stopped" not in "".join(capsys.readouterr())  # the command says it, with how to resume, once
    assert whole(path).env_steps == 52 and "run.json" in whole(path).files


@pytest.mark.parametrize("env_steps", [120, 132])
def test_a_stop_waits_for_no_evaluation(tmp_path, monkeypatch, env_steps):
    original = evaluations.evaluate

    def play(policy, env, *, stop, **options):  # takes as long as anybody waits for it
        while options["seed"] == actor.seed_for(0, "eval", 120) and not stop():
            time.sleep(0.01)
        return original(policy, env, stop=stop, **options)

    monkeypatch.setattr(evaluations, "evaluate", play)
    with stop_after(env_steps) as stop:
        result = train(tmp_path / "run", progress=True, stop=stop)
    assert result.interrupted and result.env_steps == result.saved == env_steps


def broken(update, at, name, td_error):
    """An update whose number `at` gives NaN: in one loss, and in temporal-difference errors or not."""
    calls = itertools.count(1)

    def call(*arguments):
        state, errors, metrics = update(*arguments)
        if next(calls) == at:
            if name.startswith("loss/"):
                metrics = metrics | {name: np.float32(np.nan), "loss/total": np.float32(np.nan)}
            errors = np.full_like(errors, np.nan) if td_error else errors
        return state, errors, metrics

    return call


@pytest.mark.parametrize(
    ("name", "td_error", "env_steps"),
    # The seventh update is due once (env_steps + 4 - 40) * 0.125 is 7, in the step from 92.
    [
        ("loss/rl", True, 92),
        ("a temporal-difference error", True, 92),
        ("loss/reconstruction", False, 120),
        ("loss/latent_l2", False, 120),
    ],
)
def test_a_loss_that_is_nan_ends_the_run_before_another_checkpoint(
    tmp_path, monkeypatch, name, td_error, env_steps
):
    make_agent = loop.make_agent

    def breaking(*arguments):
        agent = make_agent(*arguments)
        return agent._replace(update=broken(agent.update, 7, name, td_error))

    monkeypatch.setattr(loop, "make_agent", breaking)
    path = tmp_path / "run"
    with pytest.raises(Diverged) as error:
        train(path, **JOINT, seed=3, checkpoint_every=44)
    # At once, if the priorities would be set from it, and otherwise when the next row is due.
    assert f"{name} is not finite after {env_steps} env steps" in str(error.value)
    assert "\n" not in str(error.value)
    told = ending.read(path)
    assert told.failed and told.env_steps == env_steps
    assert told.reason == str(error.value).removesuffix("; the checkpoints are from before")
    assert whole(path).env_steps == 88
    rows = read_metrics(path / "metrics.jsonl")
    assert [row["env_steps"] for row in rows if row["kind"] == "train"] == [40, 80]
    assert all(row[x] is not None for row in rows for x in row if x.startswith("loss/"))


def test_a_loss_that_is_nan_after_the_last_row_is_noticed_at_the_end(tmp_path, monkeypatch):
    make_agent = loop.make_agent

    def breaking(*arguments):
        agent = make_agent(*arguments)
        return agent._replace(update=broken(agent.update, 7, "loss/rl", False))

    monkeypatch.setattr(loop, "make_agent", breaking)
    for name, values in (("end", {"steps": 96}), ("save", {"checkpoint_every": 96})):
        with pytest.raises(Diverged, match="after 96 env steps and 7 updates"):
            train(tmp_path / name, log_every=1000, **values)
        assert not (tmp_path / name / "checkpoints").exists()


@pytest.mark.parametrize("at", [1, 12, 24])
def test_a_disk_that_is_full_ends_the_run_and_leaves_the_checkpoint_before(tmp_path, monkeypatch, at):
    calls, save, fsync = itertools.count(1), checkpoint.save, os.fsync

    def full(descriptor):
        if next(calls) == at:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    def failing(*arguments, env_steps, **options):
        if env_steps == 80:
            monkeypatch.setattr(os, "fsync", full)
        return save(*arguments, env_steps=env_steps, **options)

    monkeypatch.setattr(checkpoint, "save", failing)
    path = tmp_path / "run"
    with pytest.raises(SaveError, match="000000080: not written: No space left on device"):
        train(path, checkpoint_every=40)
    monkeypatch.setattr(os, "fsync", fsync)
    assert whole(path).env_steps == 40 and "run.json" in whole(path).files
    assert ending.read(path).reason.endswith("000000080: not written: No space left on device")
    assert [p.name for p in (path / "checkpoints").iterdir()] == ["000000040"]


def test_a_row_that_cannot_be_written_ends_the_run_with_its_threads(tmp_path, monkeypatch):
    write = Report.eval_row

    def full(self, env_steps, *arguments):
        if env_steps:
            self._writer._file.close()
            self._writer._file = open("/dev/full", "ab")
        write(self, env_steps, *arguments)

    monkeypatch.setattr(Report, "eval_row", full)
    before = threading.active_count()
    with pytest.raises(SaveError, match="metrics.jsonl: a row was not written: No space left"):
        train(tmp_path / "run", checkpoint_every=20)
    manifest = whole(tmp_path / "run")  # where the evaluation whose row it is was under way
    assert manifest.env_steps == 140 and "evaluating.msgpack" in manifest.files
    assert threading.active_count() <= before


def test_early_stop(tmp_path):
    result = train(tmp_path / "run", stop_at_return=-1.0)
    # Every return is at least -1, the untrained policy's too; it is known before the first row is written.
    assert result.env_steps == 40 and ending.read(tmp_path / "run") == ("finished", 40, "")
    assert checkpoint.read_manifest(tmp_path / "run").env_steps == 40
    # What was learnt until then is written; without replay nothing can be resumed from.
    assert [row["kind"] for row in read_metrics(tmp_path / "run" / "metrics.jsonl")] == ["eval", "train"]
    assert result.saved is None


def test_a_run_that_had_reached_its_return_has_ended_though_it_kept_its_replay(tmp_path):
    path = tmp_path / "run"
    train(path, stop_at_return=-1.0, keep_replay=True)
    config, manifest = Config.load(path), whole(path)
    assert has_ended(path, manifest, config)
    assert not has_ended(path, manifest, dataclasses.replace(config, stop_at_return=None))
    assert not has_ended(path, manifest, dataclasses.replace(config, steps=400))


def test_a_run_that_had_reached_its_return_and_was_killed_before_it_said_so_does_not_train_on(
    tmp_path, monkeypatch
):
    path = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "pictures", lambda *_: 1 / 0)  # drawn behind the last checkpoint
        with pytest.raises(ZeroDivisionError):
            train(path, stop_at_return=-1.0, keep_replay=True)
    manifest = whole(path)
    assert not has_ended(path, manifest, manifest.config)
    result = loop.train(manifest.config, path, resume=manifest)
    assert result.env_steps == 40 and ending.read(path) == ("finished", 40, "")
    # One that is extended has its end before it.
    longer = dataclasses.replace(manifest.config, stop_at_return=None, steps=80)
    assert loop.train(longer, path, resume=whole(path)).env_steps == 80


def test_an_error_of_an_environment_in_the_middle_is_said(tmp_path, monkeypatch):
    step = Seed.step_env

    def other(self, actions):
        if len(self.replay) > 20:
            raise ConfigError("--game: shows images of another shape")
        return step(self, actions)

    monkeypatch.setattr(Seed, "step_env", other)
    with pytest.raises(ConfigError, match="another shape"):
        train(tmp_path / "run")
    assert ending.read(tmp_path / "run").status == "failed"


def test_environments_are_closed_where_no_thread_steps_them_and_where_a_run_is_refused(tmp_path, monkeypatch):
    made, stepping, closed = [], [], []
    make_env, step_env = loop.make_env, Seed.step_env

    def making(*arguments):
        env = make_env(*arguments)
        close = env.close
        env.close = lambda: (closed.append(list(stepping)), close())
        return made.append(env) or env

    def slowly(self, actions):
        stepping.append(True)
        time.sleep(0.1)
        found = step_env(self, actions)
        stepping.clear()
        return found

    monkeypatch.setattr(loop, "make_env", making)
    monkeypatch.setattr(Seed, "step_env", slowly)
    monkeypatch.setattr(loop.Run, "update", mock.Mock(side_effect=RuntimeError("meanwhile")))
    with pytest.raises(RuntimeError, match="meanwhile"):
        train(tmp_path / "run", learn_start=8)
    assert len(made) == 1 and closed == [[]]
    with pytest.raises(ConfigError, match="--buffer_size=12"):
        train(tmp_path / "refused", learn_start=8, buffer_size=12)
    assert len(made) == 2 and closed == [[], []]
    assert not any(thread.name.startswith("environments") for thread in threading.enumerate())


def test_what_ends_a_run_before_it_begins_leaves_how_it_ended_before(tmp_path, monkeypatch):
    path = tmp_path / "run"
    train(path, steps=40, keep_replay=True)
    assert ending.read(path) == ("finished", 40, "")
    monkeypatch.setattr(loop, "Seed", mock.Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        loop.train(Config(**{**SMALL, "steps": 400}), path, progress=False, resume=whole(path))
    assert ending.read(path) == ("finished", 40, "")


def test_a_run_whose_environments_cannot_be_reset_has_not_begun(tmp_path, monkeypatch):
    """So that what `--overwrite` replaces is still there."""
    begun = []
    monkeypatch.setattr(loop.Seed, "begin", mock.Mock(side_effect=RuntimeError("no display")))
    with pytest.raises(RuntimeError):
        loop.train(Config(**SMALL), tmp_path, progress=False, begun=lambda: begun.append(True))
    assert not begun


def test_how_a_run_ended_is_said_until_it_goes_on(tmp_path, monkeypatch):
    path, config = tmp_path / "run", Config(**SMALL)
    with stop_after(60) as stop:
        assert train(path, checkpoint_every=40, stop=stop).interrupted
    assert ending.read(path) == ("stopped", 60, "") and not ending.read(path).failed
    manifest, rows = whole(path), (path / "metrics.jsonl").read_bytes()
    # What is refused changes nothing, not even what is better and of a later step.
    (path / "metrics.jsonl").write_bytes(b"")
    later, begun = path / "best/000000120", []
    later.mkdir(parents=True)
    options = {"progress": False, "resume": manifest, "begun": lambda: begun.append(ending.read(path).status)}
    with pytest.raises(ConfigError, match="does not begin with the rows"):
        loop.train(config, path, **options)
    assert ending.read(path).status == "stopped" and later.exists() and not begun
    (path / "metrics.jsonl").write_bytes(rows)
    # A run that is under way says nothing, and neither does one that is killed.
    update, seen = loop.Run.update, []

    def broken(run):
        seen.append(ending.read(path))
        if run.env_steps == 100:
            raise RuntimeError("two\nlines")
        update(run)

    monkeypatch.setattr(loop.Run, "update", broken)
    with pytest.raises(RuntimeError):
        loop.train(config, path, **options)
    assert ending.read(path) == ("failed", 100, "RuntimeError: two lines") and set(seen) == {None}
    assert begun == ["stopped"] and not later.exists()
    monkeypatch.setattr(loop.Run, "update", update)
    loop.train(config, path, progress=False, resume=manifest)
    assert ending.read(path) == ("finished", 240, "")
    # So does one that ends before its first step.
    monkeypatch.setattr(loop, "make_env", lambda *arguments, **options: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(tmp_path / "other")
    assert ending.read(tmp_path / "other") == ("failed", 0, "ZeroDivisionError: division by zero")
