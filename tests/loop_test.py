"""The loop: schedules, files and reproducibility of whole short runs on Catch."""

import errno
import itertools
import json
import os
import re
import shutil
import threading
import time

import jax
import numpy as np
import pytest
from absl import flags
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space

from experiments.command_line import flags as config_flags
from srl_jax import loading, training
from srl_jax.config import Config
from srl_jax.diagnostics import heldout
from srl_jax.diagnostics.pictures import PICTURES
from srl_jax.envs.catch import Catch
from srl_jax.errors import ConfigError, Diverged, SaveError
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics, strip_wall
from srl_jax.modes import ENCODER_OPTIMIZERS
from srl_jax.replay import Replay
from srl_jax.run import actor, ending, evaluations, loop
from srl_jax.run.reporting import Report
from srl_jax.run.schedules import Schedules
from srl_jax.types import Window
from srl_jax.update import Hyper
from tests.helpers import JOINT, SMALL, identical, one_run

pytestmark = pytest.mark.usefixtures("shared_agents")


def train(path, progress=False, stop=None, **values):
    options = {} if stop is None else {"stop": stop}
    path.mkdir()
    config = Config(**{**SMALL, **values})
    config.save(path)
    return loop.train(config, path, progress=progress, **options)


def whole(path):
    """The manifest of the newest checkpoint, of which every file is what it says."""
    manifest = checkpoint.read_manifest(path)
    checkpoint.verify(manifest)
    return manifest


@pytest.fixture(scope="module")
def joint(tmp_path_factory, shared_agents):
    """One joint run that the tests below look at, and start from."""
    path = tmp_path_factory.mktemp("runs") / "joint"
    return path, train(path, **JOINT, seed=3, diagnostics=True)


def test_same_seed_same_metrics(joint, tmp_path):
    path, _ = joint
    train(tmp_path / "again", **JOINT, seed=3, diagnostics=True)
    train(tmp_path / "other", **JOINT, seed=4)

    def rows(p):
        return [strip_wall(row) for row in read_metrics(p / "metrics.jsonl")]

    assert rows(path) == rows(tmp_path / "again")
    assert rows(path) != rows(tmp_path / "other")
    assert files_of(path) == files_of(tmp_path / "again")
    assert {folder.name for folder in (path / "encoders").iterdir()} == {"000000000", "000000120"}


def files_of(path):
    """Every file of parameters that a run leaves, with its sha256: equal ones are bit-identical."""
    return {p.relative_to(path): checkpoint.read_manifest(p).files for p in path.glob("*/0*")}


def test_neither_timing_nor_diagnostics_change_anything(joint, tmp_path, monkeypatch):
    path, _ = joint
    rng, act_and_step, update = np.random.default_rng(0), loop.Run.act_and_step, loop.Run.update

    def slow_step(*arguments):
        time.sleep(rng.choice([0, 0.02]))
        result = act_and_step(*arguments)
        time.sleep(rng.choice([0, 0.02]))
        return result

    def slow_update(run):
        time.sleep(rng.choice([0, 0.02]))
        update(run)

    monkeypatch.setattr(loop.Run, "act_and_step", slow_step)
    monkeypatch.setattr(loop.Run, "update", slow_update)
    train(tmp_path / "again", **JOINT, seed=3)
    ours, theirs = files_of(tmp_path / "again"), files_of(path)
    assert ours == {name: sums for name, sums in theirs.items() if name.parent.name != "encoders"}
    rows, diagnosed = (
        [strip_wall(row) for row in read_metrics(p / "metrics.jsonl")] for p in (tmp_path / "again", path)
    )
    kept = [{key: x for key, x in row.items() if not key.startswith("diag/")} for row in diagnosed]
    assert kept == rows != diagnosed


def test_representation_losses_in_every_third_update(tmp_path, monkeypatch):
    calls = []
    make_agent = loop.make_agent

    def watched(*arguments):
        agent = make_agent(*arguments)

        def watch(name):
            def call(state, window, hyper):
                result = getattr(agent, name)(state, window, hyper)
                calls.append((name, result[2]))
                return result

            return call

        return agent._replace(update=watch("update"), update_rl=watch("update_rl"))

    monkeypatch.setattr(loop, "make_agent", watched)
    train(tmp_path / "run", **JOINT, srl_every=3)
    names = [name for name, _ in calls]
    assert names == (["update", "update_rl", "update_rl"] * 9)[: len(names)] and len(names) == 25
    rows = [r for r in read_metrics(tmp_path / "run" / "metrics.jsonl") if r["kind"] == "train"]
    # A row is five updates apart from the next; of the updates 10 to 14, only 12 has them.
    assert [row["updates"] for row in rows[2:5]] == [10, 15, 20]
    np.testing.assert_allclose(rows[3]["loss/reconstruction"], calls[12][1]["loss/reconstruction"], rtol=1e-6)
    of_rl = [float(metrics["loss/rl"]) for _, metrics in calls[10:15]]
    np.testing.assert_allclose(rows[3]["loss/rl"], np.mean(of_rl), rtol=1e-5)


def test_a_step_acts_with_the_parameters_from_before_its_updates():
    run = one_run(Config(**{**SMALL, "updates_per_step": 0.5}))
    acted, known = [], []

    def act(params, *rest):  # the state of so many updates has these parameters
        acted.append(next(i for i, x in enumerate(known) if x is params))
        return device.act(params, *rest)

    def update(*arguments):
        state, *rest = device.update(*arguments)
        known.append(state.params)
        return state, *rest

    device = run.device
    run.device = device._replace(act=act, update=update)
    known.append(run.state.params)
    run.begin()
    for _ in range(14):
        run.step()
    run.env_threads.shutdown()
    # Two updates a step of four environments, from the step on that starts at 40.
    assert acted == [0] * 11 + [2, 4, 6] and run.updates == 8


def test_rows_of_a_run(joint):
    path, result = joint
    rows = read_metrics(path / "metrics.jsonl")
    train_rows = [row for row in rows if row["kind"] == "train"]
    assert [row["env_steps"] for row in train_rows] == [40, 80, 120, 160, 200, 240]
    assert [row["env_steps"] for row in rows if row["kind"] == "eval"] == [0, 120, 240]
    # Learning starts at 40 env steps; the step from 40 to 44 brings the first half of an update.
    # By 240 there are (240 - 40) * 0.125 = 25.
    assert result.updates == rows[-1]["updates"] == 25
    assert train_rows[0]["updates"] == 0 and "loss/rl" not in train_rows[0]
    last = train_rows[-1]
    names = {
        "loss/rl",
        "loss/reconstruction",
        "loss/latent_l2",
        "loss/total",
        "grad_norm/encoder",
        "rl/q_max_mean",
    }
    assert names | {"epsilon", "beta", "wall_steps_per_s"} <= set(last)
    # epsilon: 1 - 0.95 * 240 / 1,000,000
    assert last["epsilon"] == pytest.approx(1 - 0.95 * 240e-6)
    evaluation = rows[-1]
    assert evaluation["kind"] == "eval" and len(evaluation["eval/returns"]) == 3
    assert evaluation["eval/return_mean"] == pytest.approx(np.mean(evaluation["eval/returns"]))
    assert all(17 <= length <= 24 for length in evaluation["eval/lengths"])


def test_pictures_show_input_target_and_output(joint):
    _, result = joint
    (inputs, targets, outputs) = result.pictures["reconstruction"]
    assert inputs.shape == targets.shape == outputs.shape == (6, 42, 42, 1)
    np.testing.assert_allclose(inputs, targets, atol=1e-7)  # reconstruction's target is its input
    assert 0 <= inputs.min() and inputs.max() <= 1


def test_the_last_evaluation_was_recorded(joint):
    path, result = joint
    last = read_metrics(path / "metrics.jsonl")[-1]
    # Three games, one in each environment: the first one's frames, and the one that it began with.
    assert result.recording.dtype == np.uint8
    assert result.recording.shape == (last["eval/lengths"][0] + 1, 42, 42, 1)


def test_an_agent_comes_back_from_its_checkpoint(joint):
    path, _ = joint
    loaded = loading.load(path)
    assert (loaded.env_steps, loaded.manifest.updates) == (240, 25)
    assert set(loaded.params) == {"encoder", "rl", "reconstruction", "latent_l2"}
    assert set(loaded.agent.objectives) == {"rl", "reconstruction", "latent_l2"}


@pytest.mark.parametrize("mode", ["frozen", "finetuned", "joint", "decoupled"])
def test_starting_from_an_encoder(joint, tmp_path, mode):
    source, _ = joint
    values = {"objectives": JOINT["objectives"]} if mode in ("joint", "decoupled") else {}
    # No update happens before 200 env steps, so the encoder written at 120 is the one it began with.
    run = tmp_path / mode
    train(run, mode=mode, encoder_from=str(source), learn_start=200, **values)
    started = checkpoint.load(checkpoint.read_manifest(run / "checkpoints" / "000000120"))["encoder"]
    given = checkpoint.load(checkpoint.read_manifest(source))["encoder"]
    ended = checkpoint.load(checkpoint.read_manifest(run))["encoder"]

    def same(a, b):
        return all(np.array_equal(a[layer][name], b[layer][name]) for layer in given for name in given[layer])

    assert same(given, started)
    assert same(given, ended) == (mode == "frozen")


def test_pretraining_on_a_given_policy_and_on_a_random_one(joint, tmp_path):
    source, _ = joint
    train(tmp_path / "random", mode="pretrain", objectives=("inverse",))
    train(tmp_path / "given", mode="pretrain", objectives=("inverse",), policy_from=str(source))
    rows = [read_metrics(tmp_path / name / "metrics.jsonl") for name in ("random", "given")]
    for mode_rows in rows:
        assert {row["kind"] for row in mode_rows} == {"train"}
        assert "loss/inverse" in mode_rows[-1] and "loss/rl" not in mode_rows[-1]
    assert [rows[0][-1]["epsilon"], rows[1][-1]["epsilon"]] == [1.0, 0.3]
    # Such a run starts another one, but has no policy to give.
    train(tmp_path / "frozen", mode="frozen", encoder_from=str(tmp_path / "random"))
    config = Config(**SMALL, mode="pretrain", objectives=("inverse",), policy_from=str(tmp_path / "random"))
    with pytest.raises(ConfigError, match="has no policy"):
        training.check_sources(config)


def test_a_buffer_that_cannot_be_is_refused():
    # 4 environments, and windows of 4 + 3 frames, a slot being written and a spare one: 36.
    small = Config(**{**SMALL, "buffer_size": 35, "learn_start": 0})
    with pytest.raises(ConfigError, match="--buffer_size=35: capacity must be at least 36, got 35"):
        one_run(small)


@pytest.mark.parametrize(("eval_max_steps", "frames"), [(100, 108_000), (27_000, 108_000), (40_000, 160_000)])
def test_no_evaluation_game_is_cut_before_eval_max_steps(monkeypatch, eval_max_steps, frames):
    made = []
    monkeypatch.setattr("srl_jax.envs.make", lambda game, **options: made.append(options["max_frames"]))
    config = Config(game="Pong", eval_max_steps=eval_max_steps)
    actor.make_env(config, "eval", 1)
    actor.make_env(config, "train", 1)  # whose episodes are as long as ever
    assert made == [frames, 108_000]


def test_a_given_checkpoint_is_played_as_long_as_its_evaluations(joint, monkeypatch, capsys):
    from experiments import evaluate

    asked, make = [], actor.make_env

    def make_env(*arguments, **options):
        asked.append((arguments[1:], options))
        return make(*arguments, **options)

    monkeypatch.setattr(actor, "make_env", make_env)
    values = flags.FlagValues()
    evaluate.define_flags(values)
    config_flags.parse(["evaluate", f"--run={joint[0]}", "--games=1"], values)
    monkeypatch.setattr(evaluate, "FLAGS", values)
    evaluate.main([])
    assert asked == [(("eval", 1), {"seed": 0})]
    assert len(json.loads(capsys.readouterr().out)["returns"]) == 1


def test_a_checkpoint_that_asks_for_what_there_is_not_is_refused_by_its_name(joint, tmp_path):
    path, _ = joint
    shutil.copytree(path, tmp_path / "copy")
    manifest = checkpoint.read_manifest(tmp_path / "copy").path / "manifest.json"
    values = json.loads(manifest.read_text())
    for change, reason in (
        ({"rl": "x"}, "no 'x'"),
        ({"encoder": "sac_ae:features=-1"}, "must not be negative"),
    ):
        checkpoint.sign(manifest.parent, {**values, "config": {**values["config"], **change}})
        with pytest.raises(ConfigError, match=f"^{re.escape(str(manifest.parent))}.*{reason}"):
            loading.load(tmp_path / "copy")


def test_an_encoder_that_does_not_fit_is_refused(joint):
    source, _ = joint
    for field, value in (("encoder", "tiny:features=16"), ("frame_size", 84), ("frame_stack", 2)):
        config = Config(**{**SMALL, "mode": "frozen", "encoder_from": str(source), field: value})
        with pytest.raises(ConfigError, match=f"{field} is .* there and .* here"):
            training.check_sources(config)


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
    calls = itertools.count()
    path = tmp_path / "run"
    result = train(path, progress=True, stop=lambda: next(calls) == 13)
    assert result.interrupted and result.env_steps == result.saved == 13 * 4
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
    calls = itertools.count()
    result = train(tmp_path / "run", progress=True, stop=lambda: next(calls) == env_steps // 4)
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


class Colour(Catch):
    """Catch with a margin on its right, in three colours: frames of 42 x 50 pixels."""

    def __init__(self, **options):
        super().__init__(**options)
        self.single_observation_space = Box(0, 255, (42, 50, 3), np.uint8)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _frames(self):
        grey = super()._frames()
        return np.concatenate([grey, grey // 2, 255 - grey], -1)


def test_a_run_in_colour_of_any_shape(tmp_path, monkeypatch):
    def make(game, *, num_envs, seed, frame_size, **options):
        return Colour(num_envs=num_envs, seed=seed, size=frame_size)

    objectives = ("reconstruction", "forward_pixels", "latent_l2")
    values = {**SMALL, "steps": 120, "eval_every": 60, "diagnostics": True, "augment": "all"}
    config = Config(**{**values, "mode": "joint", "objectives": objectives})
    rows = []
    heldout._collect.cache_clear()
    with monkeypatch.context() as patched:
        patched.setattr("srl_jax.envs.make", make)
        for path, stop_at in ((tmp_path / "whole", None), (tmp_path / "resumed", 16)):
            path.mkdir()
            asked = itertools.count(1)
            stop = lambda at=stop_at, asked=asked: next(asked) == at  # noqa: E731
            result = loop.train(config, path, progress=False, stop=stop)
            if stop_at is not None:
                assert result.interrupted and result.env_steps == 60
                result = loop.train(config, path, progress=False, resume=whole(path))
            rows.append([strip_wall(row) for row in read_metrics(path / "metrics.jsonl")])
    heldout._collect.cache_clear()
    assert rows[0] == rows[1] and rows[0][-1]["env_steps"] == 120
    # What is seen, learnt, recorded and measured has the environment's shape.
    assert result.recording.shape[1:] == (42, 50, 3)
    np.testing.assert_array_equal(result.recording[..., 0], 255 - result.recording[..., 2])
    for name in ("reconstruction", "forward_pixels"):
        inputs, targets, outputs = result.pictures[name]
        assert inputs.shape == targets.shape == outputs.shape == (PICTURES, 42, 50, 3)
        np.testing.assert_allclose(targets[..., 0], 1 - targets[..., 2], atol=1e-6)
        assert rows[0][-1][f"diag/error/{name}/moving"] > 0
    # No environment is needed to know it.
    loaded = loading.load(path)
    assert loaded.manifest.frame_shape == (42, 50, 3) and loaded.encoder.observation_shape == (42, 50, 12)
    for flag in ("policy_from", "encoder_from"):
        grey = Config(**{**SMALL, "mode": "pretrain", "objectives": ("latent_l2",), flag: str(path)})
        with pytest.raises(ConfigError, match=rf"--{flag}=.* of \[42, 50, 3\], Catch shows \[42, 42, 1\]"):
            one_run(grey, tmp_path)


def test_early_stop(tmp_path):
    result = train(tmp_path / "run", stop_at_return=-1.0)
    # Every return is at least -1, the untrained policy's too; it is known before the first row is written.
    assert result.env_steps == 40 and ending.read(tmp_path / "run") == ("finished", 40, "")
    assert checkpoint.read_manifest(tmp_path / "run").env_steps == 40
    assert [row["kind"] for row in read_metrics(tmp_path / "run" / "metrics.jsonl")] == ["eval"]


def test_how_a_run_ended_is_said_until_it_goes_on(tmp_path, monkeypatch):
    path, config = tmp_path / "run", Config(**SMALL)
    asked = itertools.count()
    assert train(path, checkpoint_every=40, stop=lambda: next(asked) == 15).interrupted
    assert ending.read(path) == ("stopped", 60, "") and not ending.read(path).failed
    manifest, rows = whole(path), (path / "metrics.jsonl").read_bytes()
    # What is refused changes nothing.
    (path / "metrics.jsonl").write_bytes(b"")
    with pytest.raises(ConfigError, match="does not begin with the rows"):
        loop.train(config, path, progress=False, resume=manifest)
    assert ending.read(path).status == "stopped"
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
        loop.train(config, path, progress=False, resume=manifest)
    assert ending.read(path) == ("failed", 100, "RuntimeError: two lines") and set(seen) == {None}
    monkeypatch.setattr(loop.Run, "update", update)
    loop.train(config, path, progress=False, resume=manifest)
    assert ending.read(path) == ("finished", 240, "")
    # So does one that ends before its first step.
    monkeypatch.setattr(loop, "make_env", lambda *arguments, **options: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(tmp_path / "other")
    assert ending.read(tmp_path / "other") == ("failed", 0, "ZeroDivisionError: division by zero")


def test_updates_are_compiled_once(joint):
    del joint
    run = one_run(Config(**SMALL, lr_final_share=0.5))
    (seed,) = run.seeds
    run.begin()
    for _ in range(30):
        seed.take(*seed.step_env(np.ones(4, np.int32)))
    run.update()
    size = run.agent.update.compiled._cache_size()  # other runs of the session share the agent
    for _ in range(2):
        run.env_steps += 40  # another learning rate
        run.update()
    assert isinstance(seed.replay.sample(2, 0.5)[0], Window)
    assert run.agent.update.compiled._cache_size() == size


def test_config_is_data(joint):
    path, _ = joint
    values = json.loads((path / "config.json").read_text())
    assert Config.load(path).seed == values["seed"] == 3
    assert values["versions"]["jax"]


def test_learning_rates_fall_linearly_to_the_share_that_is_left():
    def at(env_steps, share):
        config = Config(**{**SMALL, "steps": 200, "lr_final_share": share})
        hyper = Hyper({}, {name: np.float32(rate) for name, rate in (("encoder", 0.0), ("rl", 4e-3))})
        rates = Schedules(config, hyper).at(env_steps).hyper.learning_rates
        assert all(rate.dtype == np.float32 for rate in rates.values())
        return rates

    assert at(150, 1.0) == pytest.approx({"encoder": 0.0, "rl": 4e-3})
    assert at(0, 0.2) == pytest.approx({"encoder": 0.0, "rl": 4e-3})
    assert at(150, 0.2) == pytest.approx({"encoder": 0.0, "rl": 1.6e-3})
    assert at(200, 0.2) == pytest.approx({"encoder": 0.0, "rl": 0.8e-3})


def started(tmp_path, **values):
    """The parameters that a run begins with."""
    run = one_run(Config(**{**SMALL, **values}), tmp_path)
    with run:
        return run.state.params


def test_heads_that_both_runs_have_start_from_the_other_run_as_asked(joint, tmp_path):
    source, _ = joint
    theirs = checkpoint.load(whole(source))
    objectives = ("reconstruction", "inverse")
    scratch = started(tmp_path, mode="joint", objectives=objectives, seed=9)
    for heads_from, taken in (
        ("representation", {"encoder", "reconstruction"}),
        ("all", {"encoder", "reconstruction", "rl"}),
        ("none", {"encoder"}),
    ):
        how = {"encoder_from": str(source), "heads_from": heads_from}
        params = started(tmp_path, mode="joint", objectives=objectives, seed=9, **how)
        for name in ("encoder", "rl", *objectives):
            assert identical(params[name], theirs[name] if name in taken else scratch[name]), name


def test_a_head_that_does_not_fit_is_named_with_a_way_out(joint, tmp_path):
    source, _ = joint
    other = {"rl": "rainbow:hidden=8,atoms=11,v_min=-2,v_max=2", "mode": "finetuned"}
    with pytest.raises(
        ConfigError, match="--heads_from=none starts from the encoder alone.*.rl..*not float32"
    ):
        started(tmp_path, encoder_from=str(source), heads_from="all", **other)
    started(tmp_path, encoder_from=str(source), **other)


@pytest.mark.parametrize("form", ENCODER_OPTIMIZERS)
def test_a_run_makes_no_nan_on_the_way(form, tmp_path):
    # jax.debug_nans takes any NaN for a fault, a placeholder too.
    with jax.debug_nans(True):
        train(tmp_path / form, **JOINT, encoder_optimizer=form, max_grad_norm=1.0, steps=160)
    rows = read_metrics(tmp_path / form / "metrics.jsonl")
    assert any(row.get("grad_norm/encoder", 0) > 0 for row in rows)  # measured in some updates alone
    ratios = [row["step_ratio/encoder"] for row in rows if "step_ratio/encoder" in row]
    assert bool(ratios) == (form != "summed") and all(0.05 < ratio < 20 for ratio in ratios)
