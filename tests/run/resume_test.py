"""A run that is resumed from a checkpoint is the run that had not ended."""

import dataclasses
import hashlib
import json
import shutil
from functools import cache

import jax
import numpy as np
import pytest
from flax import serialization

from srl_jax import envs, replay
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.run import evaluations, loop
from srl_jax.run.actor import seed_for
from tests.files.rundir_test import contents
from tests.helpers import SMALL, agent_of, all_moved, identical, one_run, rows_of

MODES = {
    "rl_only": {},
    "joint": {
        "mode": "joint", "objectives": ("inverse", "reconstruction"), "srl_every": 2,
        "game": "CatchDistractor", "diagnostics": True, "diagnostics_kept": 2,
        # Resets after 52, where there is a checkpoint, 104 and 156; then n falls over 4 of 6 or 7 updates.
        "reset": "all", "reset_every": 52, "n_anneal": "3->1@4", "gamma_anneal": "0.9->0.99@4",
        "weight_decay": 0.1,
    },
    "pretrain": {"mode": "pretrain", "objectives": ("inverse",), "diagnostics": True},
    "slow acts": {
        "rl": "iqn:hidden=16,quantiles=8,noisy=true,prioritized=true,slow=ema,slow_tau=0.9,act_with=slow",
    },
}  # fmt: skip
ENCODERS = {"rl_only": [104], "joint": [0, 60, 104], "pretrain": [0, 60, 104, 120]}
ENCODERS |= {"slow acts": [104]}
"""Of every second checkpoint, which is that of 104, and what diagnostics keep."""
EVERY = {"steps": 200, "log_every": 40, "eval_every": 60, "checkpoint_every": 52, "eval_games": 5}


def make_config(mode, **values):
    return Config(**SMALL | EVERY | MODES[mode] | values)


def make_run(config, path, **options):
    """A run whose agent is compiled once for all runs of a mode."""
    path.mkdir(exist_ok=True)
    return one_run(config, path, agent=agent_of(config), **options)


def digests(run):
    """A hash of each piece of what the rest of a run depends on."""
    state = run.state._replace(key=jax.random.key_data(run.state.key))
    found = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(state)}
    numbers = {"counts": (run.env_steps, run.updates)}
    for name, (snapshot, _) in run.seeds[0].parts(run.env_steps).items():
        if name != "report":  # whose rows are compared
            arrays, numbers[name] = snapshot()
            found |= {f"{name} {key}": x for key, x in arrays.items()}
    found = {name: hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest() for name, x in found.items()}
    return found | {name: json.dumps(x) for name, x in numbers.items()}


def go(config, path, stop_at=None, **options):
    """Runs to the end or to an env step: (result, digests of the end)."""
    run = make_run(config, path, **options)
    run.stop = lambda: stop_at is not None and run.env_steps >= stop_at
    close, end = run.seeds[0].close, []
    run.seeds[0].close = lambda: (end.append(digests(run)), close())
    (result,) = run.train()
    return result, end[0]


def resume(config, path, stop_at=None):
    manifest = checkpoint.newest_good(path, pytest.fail)
    return go(config, path, stop_at, resume=[manifest])


def files(path):
    """The last checkpoint's, with their sums, and which ones there are."""
    folders = sorted(p.relative_to(path) for p in path.glob("*/0*"))
    return checkpoint.read_manifest(path).files, folders


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of each mode that nobody stops."""

    @cache
    def run(mode):
        path = tmp_path_factory.mktemp("whole") / mode
        config = make_config(mode, keep_encoder_every=2)
        result, end = go(config, path)
        assert not result.interrupted and result.env_steps == 200
        return config, path, end

    return run


@pytest.mark.parametrize(
    ("mode", "stops"),
    [
        # 0: before the first step. 36: before learning starts. 60: a row of evaluation begins, and is under
        # way at 64 and 76, with other parameters than the run has by then. 104: a checkpoint is due there.
        ("rl_only", [0]),
        ("rl_only", [64]),
        ("rl_only", [104]),
        ("rl_only", [36, 60, 76, 80, 84, 196]),
        ("joint", [4, 88]),
        ("joint", [64, 156]),
        ("pretrain", [48]),
        ("pretrain", [20, 100, 132]),
        ("slow acts", [60, 76]),
    ],
)
def test_a_run_that_is_stopped_and_goes_on_is_the_run_that_was_not(whole, tmp_path, mode, stops):
    config, whole_path, whole_end = whole(mode)
    path = tmp_path / mode
    stopped, _ = go(config, path, stops[0])
    for stop, now in zip(stops, [*stops[1:], None], strict=True):
        assert stopped.interrupted and stopped.env_steps == stop
        manifest = checkpoint.read_manifest(path)
        assert manifest.env_steps == stop
        # Of an evaluation that began before: of 0 until the row of 40, of 60 until 80, 120 until 160, 180.
        under_way = mode != "pretrain" and stop in (4, 36, 64, 76, 156, 196)
        assert ("evaluating.msgpack" in manifest.files) == under_way
        stopped, end = resume(config, path, now)
    assert not stopped.interrupted
    assert {name for name in whole_end if end[name] != whole_end[name]} == set()
    assert rows_of(path) == rows_of(whole_path)
    # Parameters alone, of the last two checkpoints; and encoders.
    ours, folders = files(path)
    assert ours == files(whole_path)[0]
    kept = [f for f in folders if f.parent.name == "encoders"]
    assert [int(f.name) for f in kept] == ENCODERS[mode]
    ours, theirs = ([checkpoint.read_manifest(p / f).files for f in kept] for p in (path, whole_path))
    assert ours == theirs
    assert all(set(checkpoint.read_manifest(path / f).files) == {"params.msgpack"} for f in folders)


def test_what_is_kept_of_a_run_whose_slow_network_acts_is_what_acts(whole, tmp_path):
    config, path, _ = whole("slow acts")
    go(config, tmp_path / "run", 104)
    manifest = checkpoint.read_manifest(tmp_path / "run")
    kept, learner = checkpoint.load(manifest), checkpoint.load_tree(manifest, "learner")
    slow = learner["slow"]["rl"]
    assert identical(kept, {"encoder": slow["encoder"], "rl": slow["head"]})
    assert all_moved(kept, learner["params"])
    # The last one of the whole run has nothing beside.
    assert set(checkpoint.read_manifest(path).files) == {"params.msgpack"}


def test_a_run_that_is_killed_goes_on_from_its_last_checkpoint(whole, tmp_path, monkeypatch):
    config, whole_path, whole_end = whole("joint")
    step = loop.Run.step

    def killed(run):
        if run.env_steps == 132:  # a row was written at 120, which the checkpoint of 104 does not know
            raise RuntimeError("killed")
        step(run)

    with monkeypatch.context() as patch:
        patch.setattr(loop.Run, "step", killed)
        with pytest.raises(RuntimeError, match="killed"):
            go(config, tmp_path / "run")
    assert checkpoint.read_manifest(tmp_path / "run").env_steps == 104
    assert len(rows_of(tmp_path / "run")) > 4
    _, end = resume(config, tmp_path / "run")
    assert end == whole_end
    assert rows_of(tmp_path / "run") == rows_of(whole_path)


def test_a_run_goes_on_without_the_encoder_that_it_started_from(whole, tmp_path):
    shutil.copytree(whole("joint")[1], tmp_path / "source")
    config = make_config("joint", encoder_from=str(tmp_path / "source"))
    _, whole_end = go(config, tmp_path / "whole")
    go(config, tmp_path / "run", 64)
    shutil.rmtree(tmp_path / "source")
    _, end = resume(config, tmp_path / "run")
    assert end == whole_end
    assert rows_of(tmp_path / "run") == rows_of(tmp_path / "whole")


@pytest.mark.parametrize("stop", [120, 124])
def test_a_return_that_ends_a_run_ends_it_all_the_same(tmp_path, monkeypatch, stop):
    # The evaluation of 120 reaches it, which ends the run when the next row is due, at 160.
    evaluate = evaluations.evaluate

    def better(policy, env, *, seed, **options):
        played = evaluate(policy, env, seed=seed, **options)
        return played and played._replace(returns=[float(seed == seed_for(0, "eval", 120))] * 5)

    monkeypatch.setattr(evaluations, "evaluate", better)
    config = make_config("rl_only", stop_at_return=0.5)
    result, whole_end = go(config, tmp_path / "whole")
    assert result.env_steps == 160 and '"best": 1.0' in whole_end["play"] and not result.interrupted
    go(config, tmp_path / "run", stop)
    result, end = resume(config, tmp_path / "run")
    assert result.env_steps == 160 and end == whole_end
    assert rows_of(tmp_path / "run") == rows_of(tmp_path / "whole")


def test_a_best_policy_of_after_the_checkpoint_goes(stopped, tmp_path):
    """The run may not get there again; readers take the newest."""
    config, path = stopped
    run = shutil.copytree(path, tmp_path / "run")
    (best,) = (run / "best").iterdir()
    shutil.copytree(best, run / "best" / f"{73:09d}")
    manifest = checkpoint.newest_good(run, pytest.fail)
    go(config, run, 72, resume=[manifest])
    assert manifest.env_steps == 72
    assert [p.name for p in (run / "best").iterdir()] == [best.name]
    # Where it was the only one that was kept, the best of before is gone with it, and any other is better.
    again = shutil.copytree(path, tmp_path / "again")
    (again / "best" / best.name).rename(again / "best" / f"{73:09d}")
    one = make_run(config, again, resume=[manifest])
    one.stop = lambda: True
    one.train()
    assert one.seeds[0].evaluations.best == -np.inf and not any((again / "best").iterdir())


@pytest.mark.parametrize("steps", [104, 120])
def test_a_finished_run_that_is_extended_is_the_run_that_was_longer(whole, tmp_path, steps):
    # After 120 env steps an evaluation is under way when the run ends.
    config, whole_path, whole_end = whole("rl_only")
    path, shorter = tmp_path / "run", dataclasses.replace(config, steps=steps, keep_replay=True)
    result, _ = go(shorter, path)
    assert not result.interrupted and result.env_steps == steps
    result, end = resume(config, path)
    assert not result.interrupted and result.env_steps == 200
    assert end == whole_end and rows_of(path) == rows_of(whole_path)
    assert files(path)[0] == files(whole_path)[0]


def test_chunks_of_frames_that_nothing_was_written_to_are_links(tmp_path, monkeypatch):
    # Streams of 100 slots, chunks of 8 slots: from 104 to 156 env steps, 13 to 15 slots of each are written.
    monkeypatch.setattr(replay, "CHUNK_BYTES", 8 * 4 * 42 * 42)
    config = make_config("rl_only", checkpoint_every=104)
    go(config, tmp_path / "run", 156)
    first, second = sorted((tmp_path / "run" / "checkpoints").iterdir())
    inodes = [{f.name: f.stat().st_ino for f in p.glob("replay_frames_*")} for p in (first, second)]
    same = [name for name, inode in inodes[0].items() if inodes[1][name] == inode]
    assert sorted(same) == [f"replay_frames_0000{i}.npy" for i in range(len(same))]
    assert 2 <= len(same) < len(inodes[0]) < len(inodes[1]) <= len(same) + 4
    # What they hold together is what the run had.
    manifest = checkpoint.newest_good(tmp_path / "run", pytest.fail)
    run = make_run(config, tmp_path / "run", resume=[manifest])
    other = make_run(make_config("rl_only", checkpoint_every=104), tmp_path / "other")
    while other.env_steps < 156:
        other.step()
    np.testing.assert_array_equal(run.seeds[0].replay.frames, other.seeds[0].replay.frames)
    for one in (run, other):
        one.env_threads.shutdown()


# Every attribute of a run, sorted


OF_A_RUN = {
    "in the checkpoint": {"state", "env_steps", "updates", "seeds"},
    "in metrics.jsonl before one is written": {"waiting"},
    "of the configuration": {
        "config", "checkpoint_every", "agent", "device", "schedules", "act_keys", "stop",
    },
    "of the process": {"env_threads", "begun"},
}  # fmt: skip
OF_EVALUATIONS = {
    "in parts": {"under_way", "best", "last", "recording"},
    "of the process": {"games", "thread", "_envs"},
    "of the configuration": {"_config", "_agent", "_report", "_keep"},
}
OF_A_SEED = {
    "in parts": {
        "replay", "env", "report", "stacks", "score", "rng", "evaluations",
    },
    "the checkpoint itself": {"saved", "saved_position"},
    "of the configuration": {"config", "out", "agent", "key", "policy"},
    "in encoders/": {"diagnostics"},
}  # fmt: skip


def test_every_attribute_of_a_run_is_in_its_checkpoint_or_follows_from_the_configuration(tmp_path):
    # A new one has to be in `Seed.parts`, if it changes while a run runs.
    run = make_run(make_config("rl_only"), tmp_path / "run")
    run.env_threads.shutdown()
    assert set(vars(run)) == set().union(*OF_A_RUN.values())
    (seed,) = run.seeds
    assert set(vars(seed)) == set().union(*OF_A_SEED.values())
    assert set(vars(seed.evaluations)) == set().union(*OF_EVALUATIONS.values())


# What a checkpoint must be


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run, and its checkpoint: with a row and an evaluation behind it."""
    path = tmp_path_factory.mktemp("stopped") / "run"
    config = make_config("joint")
    go(config, path, 72)
    return config, path


@pytest.fixture
def copy(stopped, tmp_path, monkeypatch):
    """The configuration, a copy of the run, and a function that restores a new seed from it."""
    config, path = stopped
    folder = shutil.copytree(path, tmp_path / "copy")
    monkeypatch.setattr("os.fsync", lambda _: None)  # for speed
    run = make_run(config, folder)
    shapes = run.agent.shapes()
    (seed,) = run.seeds
    seed.agent = run.agent._replace(shapes=lambda: shapes)  # for speed

    def restore():
        manifest = checkpoint.read_manifest(folder)
        checkpoint.verify(manifest)
        return seed.restore(manifest)

    yield seed, folder / "checkpoints" / "000000072", restore
    run.env_threads.shutdown()


def test_what_is_restored_is_what_was_saved(copy):
    seed, folder, restore = copy
    manifest = checkpoint.read_manifest(folder)
    numbers = checkpoint.load_numbers(manifest)
    state = restore()
    for name, (snapshot, _) in seed.parts(72).items():
        if name == "report":
            seed.report.__enter__()
        arrays, value = snapshot()
        value = json.loads(json.dumps(value, allow_nan=False))
        if name == "report":
            seed.report.__exit__(None, None, None)
            assert value.pop("seconds") > numbers[name].pop("seconds")
        assert value == numbers[name]
        saved = checkpoint.Arrays(manifest, f"{name}_")
        assert set(saved) == set(arrays)
        for key, array in arrays.items():
            assert (array.dtype, array.tobytes()) == (saved[key].dtype, saved[key].tobytes())
    assert identical(state.params, checkpoint.load(manifest))
    learner = {"slow": state.slow, "opt_state": state.opt_state, "step": state.step}
    learner["key"] = jax.random.key_data(state.key)
    assert identical(serialization.to_state_dict(learner), checkpoint.load_tree(manifest, "learner"))


def test_files_that_are_missing_from_the_manifest_are_named(copy):
    _, folder, restore = copy
    manifest = (folder / "manifest.json").read_text()
    for file in set(checkpoint.read_manifest(folder).files) - {"play_recording.npy"}:  # a run may have none
        about = json.loads(manifest)
        del about["files"][file]
        checkpoint.sign(folder, about)
        with pytest.raises(ConfigError) as error:
            restore()
        assert "\n" not in str(error.value) and str(folder.parents[1]) in str(error.value)
        name = file.split(".")[0].partition("_")[2] or file
        assert name.partition("_")[0] in str(error.value)


@pytest.mark.parametrize(
    "change", [{"num_envs": 2}, {"buffer_size": 300}, {"frame_stack": 2}, {"game": "Catch"}]
)
def test_a_checkpoint_of_another_kind_of_run_is_refused(stopped, tmp_path, change):
    config, path = stopped
    before = contents(path / "checkpoints" / "000000072")
    run = one_run(make_config("joint", **change), tmp_path, agent=agent_of(config))
    with pytest.raises(ConfigError, match="000000072.*"):
        run.seeds[0].restore(checkpoint.read_manifest(path))
    run.env_threads.shutdown()
    assert contents(path / "checkpoints" / "000000072") == before


def test_environments_that_do_not_come_back_are_named(copy):
    seed, _, restore = copy

    class Other(envs.make("Catch", num_envs=1, seed=0, frame_size=42).__class__):
        def _frames(self):
            frames = super()._frames()
            frames[2] ^= 1
            return frames

    seed.env.__class__ = Other  # say of another version of the emulator
    with pytest.raises(ConfigError, match=r"environments \[2\] cannot be rebuilt"):
        restore()
