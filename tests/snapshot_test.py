"""srl_jax/snapshot.py: a run that goes on from a checkpoint is the run that had not ended."""

import dataclasses
import hashlib
import json
import shutil
from functools import cache
from unittest import mock

import jax
import numpy as np
import pytest
from flax import serialization

from srl_jax import checkpoint, envs, evaluator, loop, snapshot
from srl_jax.agent import make_agent
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.metrics import read_metrics, strip_wall
from tests.helpers import SMALL, identical, jit
from tests.rundir_test import contents

MODES = {
    "rl_only": {},
    "joint": {
        "mode": "joint", "objectives": ("inverse", "reconstruction"), "srl_every": 2,
        "game": "CatchDistractor", "diagnostics": True, "diagnostics_kept": 2,
    },
    "pretrain": {"mode": "pretrain", "objectives": ("inverse",), "diagnostics": True},
}  # fmt: skip
ENCODERS = {"rl_only": [104], "joint": [0, 60, 104], "pretrain": [0, 60, 104, 120]}
"""Of every second checkpoint, which is that of 104, and what diagnostics keep."""
EVERY = {"steps": 200, "log_every": 40, "eval_every": 60, "checkpoint_every": 52, "eval_games": 5}


@cache
def agent_of(config):
    with mock.patch.object(jax, "jit", jit):  # compiles faster; what is compiled runs a few times only
        return make_agent(config, (42, 42, 1), 3)


def make_config(mode, **values):
    return Config(**SMALL | EVERY | MODES[mode] | values)


def make_run(config, path, **options):
    """A run whose agent is compiled once for all runs of a mode."""
    path.mkdir(exist_ok=True)
    no_matter = {"steps": 1, "stop_at_return": None, "checkpoint_every": 0, "keep_encoder_every": 0}
    no_matter |= {"diagnostics": False, "diagnostics_kept": 0, "encoder_from": ""}
    return loop.Run(config, path, False, agent_of(dataclasses.replace(config, **no_matter)), **options)


def digests(run):
    """A hash of each piece of what the rest of a run depends on."""
    state = run.agent.export(run.state)
    state = state._replace(key=jax.random.key_data(state.key))
    found = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(state)}
    arrays, numbers = run.replay.snapshot()
    found |= {f"replay {name}": x for name, x in arrays.items()} | {"frames": run.replay.frames}
    found |= {f"env {name}": x for name, x in run.env.snapshot().items()} | {"stacks": run.stacks.frames}
    recording = run.evaluator.recording
    found |= {} if recording is None else {"recording": recording}
    found = {name: hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest() for name, x in found.items()}
    return found | {
        "replay": json.dumps(numbers),
        "random": json.dumps(run.random.bit_generator.state),
        "score": run.score.tolist(),
        "solved": run.solved,
        "counts": (run.env_steps, run.updates),
    }


def go(config, path, stop_at=None, **options):
    """Runs to the end or to an env step: (result, digests of the end)."""
    run = make_run(config, path, **options)
    run.stop = lambda: stop_at is not None and run.env_steps >= stop_at
    close, end = run.env.close, []
    run.env.close = lambda: (end.append(digests(run)), close())
    return run.train(), end[0]


def resume(config, path, stop_at=None):
    manifest = checkpoint.newest_good(path, pytest.fail)
    return go(config, path, stop_at, resume=manifest)


def rows(path):
    return [strip_wall(row) for row in read_metrics(path / "metrics.jsonl")]


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
    ],
)
def test_a_run_that_is_stopped_and_goes_on_is_the_run_that_was_not(whole, tmp_path, mode, stops):
    config, whole_path, whole_end = whole(mode)
    path = tmp_path / mode
    stopped, _ = go(config, path, stops[0])
    for stop, now in zip(stops, [*stops[1:], None], strict=True):
        assert stopped.interrupted and stopped.env_steps == stop
        assert checkpoint.read_manifest(path).env_steps == stop
        stopped, end = resume(config, path, now)
    assert not stopped.interrupted
    assert {name for name in whole_end if end[name] != whole_end[name]} == set()
    assert rows(path) == rows(whole_path)
    # Parameters alone, of the last two checkpoints; and encoders.
    ours, folders = files(path)
    assert ours == files(whole_path)[0]
    kept = [f for f in folders if f.parent.name == "encoders"]
    assert [int(f.name) for f in kept] == ENCODERS[mode]
    ours, theirs = ([checkpoint.read_manifest(p / f).files for f in kept] for p in (path, whole_path))
    assert ours == theirs
    assert all(set(checkpoint.read_manifest(path / f).files) == {"params.msgpack"} for f in folders)


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
    assert len(rows(tmp_path / "run")) > 4
    _, end = resume(config, tmp_path / "run")
    assert end == whole_end
    assert rows(tmp_path / "run") == rows(whole_path)


def test_a_run_goes_on_without_the_encoder_that_it_started_from(whole, tmp_path):
    shutil.copytree(whole("joint")[1], tmp_path / "source")
    config = make_config("joint", encoder_from=str(tmp_path / "source"))
    _, whole_end = go(config, tmp_path / "whole")
    go(config, tmp_path / "run", 64)
    shutil.rmtree(tmp_path / "source")
    _, end = resume(config, tmp_path / "run")
    assert end == whole_end
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")


@pytest.mark.parametrize("stop", [120, 124])
def test_a_return_that_ends_a_run_ends_it_all_the_same(tmp_path, monkeypatch, stop):
    # The evaluation of 120 reaches it, which is known when the next row is due, at 160.
    evaluate = evaluator.evaluate

    def better(policy, env, *, seed, **options):
        played = evaluate(policy, env, seed=seed, **options)
        return played and played._replace(returns=[float(seed == loop.seed_for(0, "eval", 120))] * 5)

    monkeypatch.setattr(evaluator, "evaluate", better)
    config = make_config("rl_only", stop_at_return=0.5)
    result, whole_end = go(config, tmp_path / "whole")
    assert result.env_steps == 160 and whole_end["solved"] and not result.interrupted
    go(config, tmp_path / "run", stop)
    result, end = resume(config, tmp_path / "run")
    assert result.env_steps == 160 and end == whole_end
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")


def test_chunks_of_frames_that_nothing_was_written_to_are_links(tmp_path, monkeypatch):
    # Streams of 100 slots, chunks of 8 slots: from 104 to 156 env steps, 13 to 15 slots of each are written.
    monkeypatch.setattr(snapshot, "CHUNK_BYTES", 8 * 4 * 42 * 42)
    config = make_config("rl_only", checkpoint_every=104)
    go(config, tmp_path / "run", 156)
    first, second = sorted((tmp_path / "run" / "checkpoints").iterdir())
    inodes = [{f.name: f.stat().st_ino for f in p.glob("replay_frames_*")} for p in (first, second)]
    same = [name for name, inode in inodes[0].items() if inodes[1][name] == inode]
    assert sorted(same) == [f"replay_frames_0000{i}.npy" for i in range(len(same))]
    assert 2 <= len(same) < len(inodes[0]) < len(inodes[1]) <= len(same) + 4
    # What they hold together is what the run had.
    run = make_run(config, tmp_path / "run", resume=checkpoint.newest_good(tmp_path / "run", pytest.fail))
    other = make_run(make_config("rl_only", checkpoint_every=104), tmp_path / "other")
    other.start()
    while other.env_steps < 156:
        other.step()
    np.testing.assert_array_equal(run.replay.frames, other.replay.frames)
    for one in (run, other):
        with one.env_thread, one.evaluator:
            pass


# Every attribute of a run, sorted


IN_THE_SNAPSHOT = {
    "state", "replay", "random", "evaluator", "stacks", "score", "env_steps", "updates", "solved", "report",
    "env", "saved", "saved_position",
}  # fmt: skip
OF_THE_CONFIGURATION = {
    "config", "out", "stop", "checkpoint_every", "num_actions", "agent", "learning_rates", "key", "given",
    "act_key", "eval_key",
}  # fmt: skip
OF_THE_PROCESS = {"env_thread", "resumed"}
IN_ENCODERS = {"diagnostics"}


def test_every_attribute_of_a_run_is_taken_or_follows_from_the_configuration(tmp_path):
    # A new one has to be written and read by srl_jax.snapshot, if it changes while a run runs.
    run = make_run(make_config("rl_only"), tmp_path / "run")
    run.env_thread.shutdown()
    assert set(vars(run)) == IN_THE_SNAPSHOT | OF_THE_CONFIGURATION | OF_THE_PROCESS | IN_ENCODERS
    of_the_process = {"_config", "_policy", "_make_env", "_thread", "_env", "_future", "_left"}
    assert set(vars(run.evaluator)) == {"moment", "recording"} | of_the_process


# Snapshots that somebody has made up: the sums fit


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run, and its checkpoint: with a row and an evaluation behind it and one under way."""
    path = tmp_path_factory.mktemp("stopped") / "run"
    config = make_config("joint")
    go(config, path, 72)
    return config, path


@pytest.fixture
def put(stopped, tmp_path, monkeypatch):
    """A function: brings a run to a checkpoint that was changed, and says what it would save then."""
    config, path = stopped
    copy = shutil.copytree(path, tmp_path / "copy")
    run = make_run(config, copy)
    run.evaluator.leave()  # nobody waits for its evaluations
    shapes = run.agent.shapes()
    run.agent = run.agent._replace(shapes=lambda: shapes, adopt=lambda state: state)  # for speed, as the next
    monkeypatch.setattr("os.fsync", lambda _: None)

    def put():
        manifest = checkpoint.read_manifest(copy)
        checkpoint.verify(manifest)
        snapshot.put(run, manifest)
        with run.report:
            state = snapshot.take(run)
        json.dumps(state.numbers, allow_nan=False)
        return state

    put.folder = copy / "checkpoints" / "000000072"
    put.run = run
    with run.env_thread, run.evaluator:
        yield put


def replace(folder, file, data, **entry):
    """Puts other data in place of a file, with a manifest that says so."""
    (folder / file).write_bytes(data)
    about = json.loads((folder / "manifest.json").read_text())
    sums = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    about["files"][file] = about["files"].get(file, {}) | sums | entry
    checkpoint.sign(folder, about)


def test_what_is_put_is_what_is_taken(put):
    numbers = json.loads((put.folder / "run.json").read_text())
    numbers["score"] = [1.5, -2.0, 0.0, 1 / 3]  # Catch has none before a game is over
    replace(put.folder, "run.json", json.dumps(numbers).encode())
    manifest = checkpoint.read_manifest(put.folder)
    state = put()
    taken = json.loads(json.dumps(state.numbers))
    assert taken["report"].pop("seconds") > numbers["report"].pop("seconds")
    assert taken == numbers
    assert {f"{name}.npy" for name in state.arrays} == {f for f in manifest.files if f.endswith(".npy")}
    for name, array in state.arrays.items():
        written = checkpoint.load_array(manifest, name)
        assert (array.dtype, array.tobytes()) == (written.dtype, written.tobytes())
    assert set(state.trees) == {"learner", "evaluation"}
    for name, tree in state.trees.items():
        assert identical(serialization.to_state_dict(tree), checkpoint.load_tree(manifest, name))


def check_refused_or_possible(put, what):
    """Going on is refused in a line, or what came of it is a run whose state can be written again."""
    try:
        put()
    except ConfigError as error:
        assert "\n" not in str(error), what
        assert str(put.folder.parents[1]) in str(error), what
        return True
    return False


def paths(value, path=()):
    yield path
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, item in items:
            yield from paths(item, (*path, name))


def changed(value, path, new):
    """A copy with another value at a path; None removes it."""
    if not path:
        return new
    value = dict(value) if isinstance(value, dict) else list(value)
    if len(path) == 1 and new == "REMOVED":
        del value[path[0]]
    else:
        value[path[0]] = changed(value[path[0]], path[1:], new)
    return value


def test_numbers_that_were_changed_are_refused_or_possible(put):
    numbers = json.loads((put.folder / "run.json").read_text())
    assert numbers["evaluating"] and put()
    refused = tried = 0
    for path in paths(numbers):
        values = (None, "REMOVED", [], {}, "x", -1, 1.5, 10**400)
        if len(path) > 1 and path[0] in ("replay", "report"):  # whose own tests try more
            values = (None, 10**400)
        elif path[:2] == ("evaluating", "diagnosed") and len(path) > 2:  # null and other numbers may be there
            values = ("x", 10**400)
        for new in values:
            if path or new != "REMOVED":
                replace(put.folder, "run.json", json.dumps(changed(numbers, path, new)).encode())
                refused += check_refused_or_possible(put, (path, new))
                tried += 1
    assert refused > 0.8 * tried > 150


def test_arrays_that_were_changed_are_refused_or_possible(put):
    manifest = checkpoint.read_manifest(put.folder)
    for file, entry in manifest.files.items():
        if not file.endswith(".npy"):
            continue
        data = (put.folder / file).read_bytes()
        array = np.load(put.folder / file)
        others = [array[:0], array[..., None], array.astype(np.float64) + 0.5, array > 0]
        if array.dtype.kind in "iuf" and array.size:
            top = np.finfo(array.dtype).max if array.dtype.kind == "f" else np.iinfo(array.dtype).max
            others += [np.full_like(array, x) for x in (0, 1, top)]
        if array.dtype.kind == "f":
            others += [np.full_like(array, x) for x in (np.nan, -1.0, np.inf)]
        elif array.dtype.kind == "i":
            others += [np.full_like(array, -1), array.astype(np.float32) * np.nan]
        for other in others:
            written = checkpoint.write_array(put.folder / file, other)
            about = {"dtype": written.dtype, "shape": list(written.shape)}
            replace(put.folder, file, (put.folder / file).read_bytes(), **about)
            if check_refused_or_possible(put, (file, other)):
                continue
            assert (other.dtype, other.shape) == (array.dtype, array.shape), file
        replace(put.folder, file, data, dtype=entry.dtype, shape=list(entry.shape))
    assert put()


def test_files_that_are_missing_from_the_manifest_are_named(put):
    manifest = (put.folder / "manifest.json").read_text()
    for file in set(checkpoint.read_manifest(put.folder).files) - {"recording.npy"}:  # a run may have none
        about = json.loads(manifest)
        del about["files"][file]
        checkpoint.sign(put.folder, about)
        with pytest.raises(ConfigError) as error:
            put()
        name = file.split(".")[0].removeprefix("env_").removeprefix("replay_")
        assert name in str(error.value)
    checkpoint.sign(put.folder, json.loads(manifest))
    replace(put.folder, "env_other.npy", (put.folder / "env_ended.npy").read_bytes())
    about = json.loads((put.folder / "manifest.json").read_text())
    about["files"]["env_other.npy"] |= {"dtype": "|b1", "shape": [4]}
    checkpoint.sign(put.folder, about)
    with pytest.raises(ConfigError, match="unknown arrays: other"):
        put()


def test_a_checkpoint_of_another_kind_of_run_is_refused(put, stopped, tmp_path):
    _, path = stopped
    before = contents(path / "checkpoints" / "000000072")
    for values in ({"num_envs": 2}, {"buffer_size": 300}, {"frame_stack": 2}, {"game": "Catch"}):
        run = loop.Run(make_config("joint", **values), tmp_path / "copy", False, put.run.agent)
        with pytest.raises(ConfigError, match="000000072.*"):
            snapshot.put(run, checkpoint.read_manifest(path))
        run.env_thread.shutdown()
    assert contents(path / "checkpoints" / "000000072") == before


def test_environments_that_do_not_come_back_are_named(put, monkeypatch):
    class Other(envs.make("Catch", num_envs=1, seed=0, frame_size=42).__class__):
        def _frames(self):
            frames = super()._frames()
            frames[2] ^= 1
            return frames

    put.run.env.__class__ = Other  # say of another version of the emulator
    with pytest.raises(ConfigError, match=r"environments \[2\] cannot be rebuilt"):
        put()
