"""srl_jax/files/checkpoint.py: what is written comes back bit by bit, or not at all."""

import errno
import hashlib
import io
import itertools
import os
import pickle
import shutil

import numpy as np
import pytest

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files import checkpoint
from tests.helpers import identical, whole

CONFIG = Config(game="Catch", frame_size=42, encoder="tiny:features=8", seed=5, lr_rl=1 / 3)


def make_params(seed=0):
    rng = np.random.default_rng(seed)
    layer = lambda *shape: {"kernel": rng.normal(size=shape).astype(np.float32)}  # noqa: E731
    params = {"encoder": {"Conv_0": layer(3, 3, 4, 2)}, "rl": {"q": layer(2, 3)}, "latent_l2": {}}
    # Numbers that a text format, or a change of precision, would not bring back.
    odd = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, 1 / 3], np.float32)
    params["encoder"]["odd"] = {"bias": odd}
    return params


def write(run, params=None, config=CONFIG, env_steps=1000, **options):
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": env_steps, "updates": 100}
    return checkpoint.save(run, make_params() if params is None else params, config, **counts, **options)


ARRAYS = {
    "scalar": np.array(1 / 3),
    "empty": np.zeros((0, 3), np.int32),
    "flags": np.array([True, False, True]),
    "strided": np.arange(24, dtype=np.int64).reshape(4, 6)[:, ::2],
    "transposed": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    "odd": np.array([np.nan, -np.inf, -0.0, 5e-324]),
    "frames": np.random.default_rng(0).integers(0, 256, (2, 3, 4), np.uint8),
}
NUMBERS = {"third": 1 / 3, "large": 2**100, "text": "ä", "list": [1, None, True]}


def make_state(arrays=ARRAYS, unchanged=()):
    trees = {"learner": {"step": np.int32(3), "moments": [np.ones(2, np.float32), {}]}}
    return checkpoint.State(trees, arrays, NUMBERS, frozenset(unchanged))


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("where", ["run", "checkpoints", "checkpoint"])
def test_round_trip_is_bit_identical(tmp_path, where):
    params = make_params()
    final = write(tmp_path, params).path
    path = {"run": tmp_path, "checkpoints": tmp_path / "checkpoints", "checkpoint": final}[where]
    manifest = checkpoint.read_manifest(path)
    assert manifest.path == final
    assert manifest.config == CONFIG
    assert (manifest.frame_shape, manifest.num_actions) == ((42, 42, 1), 3)
    assert (manifest.env_steps, manifest.updates) == (1000, 100)
    loaded = checkpoint.load_into(params, checkpoint.load(manifest), "test")
    assert same_bits(loaded["encoder"]["odd"]["bias"], params["encoder"]["odd"]["bias"])
    del loaded["encoder"]["odd"], params["encoder"]["odd"]  # NaN is not equal to itself
    assert identical(loaded, params)
    assert loaded["latent_l2"] == {}


def test_what_save_returns_is_what_is_read(tmp_path):
    assert write(tmp_path, state=make_state()) == whole(tmp_path)


def test_the_same_parameters_make_the_same_bytes(tmp_path):
    first, second = write(tmp_path / "a").path, write(tmp_path / "b").path
    assert names(first) == ["manifest.json", "manifest.sha256", "params.msgpack"]
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes()


def test_the_sum_is_one_that_sha256sum_checks(tmp_path):
    folder = write(tmp_path).path
    digest = hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest()
    assert (folder / "manifest.sha256").read_text() == f"{digest}  manifest.json\n"


def test_nothing_is_pickled(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("pickle was called")

    for name in ("dump", "dumps", "load", "loads", "Pickler", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    manifest = whole(write(tmp_path, state=make_state()).path)
    assert identical(checkpoint.load(manifest)["rl"], make_params()["rl"])
    for name, array in ARRAYS.items():
        assert same_bits(checkpoint.load_array(manifest, name), array)


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_come_back_bit_by_bit_and_as_numpy_reads_them(tmp_path, name):
    array = ARRAYS[name]
    manifest = write(tmp_path, state=make_state({name: array}))
    assert same_bits(checkpoint.load_array(manifest, name), array)
    assert same_bits(np.load(manifest.path / f"{name}.npy", allow_pickle=False), array)


def test_trees_and_numbers_come_back(tmp_path):
    manifest = write(tmp_path, state=make_state())
    tree = checkpoint.load_tree(manifest, "learner")
    assert same_bits(tree["step"], np.array(np.int32(3))) and tree["moments"]["1"] == {}
    assert same_bits(tree["moments"]["0"], np.ones(2, np.float32))
    assert checkpoint.load_numbers(manifest) == NUMBERS


def test_an_unchanged_array_is_a_hard_link_and_a_changed_one_is_not(tmp_path):
    first = write(tmp_path, state=make_state())
    flags = ~ARRAYS["flags"]
    # Nobody reads an array that is said to be unchanged, so here it would be noticed.
    arrays = ARRAYS | {"flags": flags, "frames": np.zeros_like(ARRAYS["frames"])}
    second = write(tmp_path, state=make_state(arrays, ["frames"]), base=first, env_steps=2000)
    inode = lambda manifest, name: (manifest.path / f"{name}.npy").stat().st_ino  # noqa: E731
    assert inode(first, "frames") == inode(second, "frames")
    assert inode(first, "flags") != inode(second, "flags")
    assert same_bits(checkpoint.load_array(whole(second.path), "frames"), ARRAYS["frames"])
    assert same_bits(checkpoint.load_array(second, "flags"), flags)
    # It outlives the checkpoint that it came from.
    shutil.rmtree(first.path)
    assert same_bits(checkpoint.load_array(whole(second.path), "frames"), ARRAYS["frames"])


def test_where_there_is_nothing_to_link_arrays_are_written(tmp_path, monkeypatch):
    first = write(tmp_path, state=make_state())
    shutil.rmtree(first.path)
    second = write(tmp_path, state=make_state(unchanged=ARRAYS), base=first, env_steps=2000)
    bare = write(tmp_path, env_steps=3000)
    third = write(tmp_path, state=make_state(unchanged=ARRAYS), base=bare, env_steps=4000)

    def refuse(*_):
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    fourth = write(tmp_path, state=make_state(unchanged=ARRAYS), base=third, env_steps=5000, keep=0)
    for manifest in (third, fourth):
        assert whole(manifest.path).files == second.files
        assert same_bits(checkpoint.load_array(manifest, "frames"), ARRAYS["frames"])


def test_the_newest_is_read_and_two_are_kept(tmp_path):
    for env_steps in (900, 1000, 20_000, 300_000):
        write(tmp_path, make_params(env_steps), env_steps=env_steps)
    assert checkpoint.read_manifest(tmp_path).env_steps == 300_000
    assert names(tmp_path / "checkpoints") == ["000020000", "000300000"]
    loaded = checkpoint.load(checkpoint.read_manifest(tmp_path))
    assert identical(loaded["rl"], make_params(300_000)["rl"])
    write(tmp_path, env_steps=300_001, keep=1)
    assert names(tmp_path / "checkpoints") == ["000300001"]


def test_the_newest_is_that_of_the_most_steps_however_many_digits_they_have(tmp_path):
    for env_steps in (999_999_000, 999_999_999, 1_000_000_998):
        write(tmp_path, env_steps=env_steps)
    assert checkpoint.read_manifest(tmp_path).env_steps == 1_000_000_998
    assert newest_good(tmp_path)[0].env_steps == 1_000_000_998
    assert newest_good(tmp_path, at_most=1_000_000_000)[0].env_steps == 999_999_999
    assert names(tmp_path / "checkpoints") == ["1000000998", "999999999"]
    (tmp_path / "checkpoints/2000000000 copy").mkdir()  # no checkpoint
    assert checkpoint.read_manifest(tmp_path).env_steps == 1_000_000_998


def test_what_was_just_written_is_kept_however_many_are_newer(tmp_path):
    # Where they are damaged, a run has gone on from before them.
    for env_steps in (1000, 2000, 3000, 4000):
        write(tmp_path, env_steps=env_steps, keep=0)
    assert whole(write(tmp_path, env_steps=1500).path).env_steps == 1500
    assert names(tmp_path / "checkpoints")[:2] == ["000001000", "000001500"]
    write(tmp_path, env_steps=1600)
    assert names(tmp_path / "checkpoints")[:2] == ["000001500", "000001600"]


def test_all_are_kept_in_a_folder_of_their_own(tmp_path):
    for env_steps in (1, 2, 3):
        write(tmp_path, env_steps=env_steps, keep=0, folder="encoders")
    assert names(tmp_path) == ["encoders"]
    assert names(tmp_path / "encoders") == ["000000001", "000000002", "000000003"]
    assert whole(tmp_path / "encoders" / "000000002").env_steps == 2


def test_a_checkpoint_of_the_same_step_is_replaced(tmp_path):
    write(tmp_path, make_params(1))
    write(tmp_path, make_params(2))
    loaded = checkpoint.load(checkpoint.read_manifest(tmp_path))
    assert identical(loaded["rl"], make_params(2)["rl"])


def test_a_write_that_was_cut_short_is_passed_over_and_cleared(tmp_path):
    write(tmp_path, env_steps=1000)
    folder = tmp_path / "checkpoints"
    shutil.copytree(folder / "000001000", folder / ".000002000.partial")
    assert checkpoint.read_manifest(tmp_path).env_steps == 1000
    write(tmp_path, env_steps=3000)
    assert names(folder) == ["000001000", "000003000"]


def test_slim_leaves_the_parameters(tmp_path):
    params = make_params()
    manifest = write(tmp_path, params, state=make_state())
    slimmed = checkpoint.slim(manifest)
    assert slimmed == whole(manifest.path)
    assert names(manifest.path) == ["manifest.json", "manifest.sha256", "params.msgpack"]
    assert identical(checkpoint.load(slimmed)["rl"], params["rl"])
    assert slimmed._replace(files={}) == manifest._replace(files={})
    with pytest.raises(ConfigError, match="no run.json in this checkpoint"):
        checkpoint.load_numbers(slimmed)
    with pytest.raises(ConfigError, match="no frames.npy in this checkpoint"):
        checkpoint.load_array(slimmed, "frames")


# Going on from the newest good one


def flip(path, bit):
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def newest_good(run, **options):
    said = []
    return checkpoint.newest_good(run, said.append, **options), said


def test_the_newest_good_one_is_found(tmp_path):
    assert newest_good(tmp_path) == (None, [])
    first, second = (write(tmp_path, state=make_state(), env_steps=n) for n in (1000, 2000))
    assert newest_good(tmp_path) == (second, [])
    assert newest_good(tmp_path, at_most=1999) == (first, [])
    assert newest_good(tmp_path, at_most=999) == (None, [])


@pytest.mark.parametrize("damage", ["bit", "file", "manifest", "empty"])
def test_a_damaged_one_is_told_and_the_one_before_is_taken(tmp_path, damage):
    first, second = (write(tmp_path, state=make_state(), env_steps=n) for n in (1000, 2000))
    if damage == "bit":
        flip(second.path / "frames.npy", 1000)
    elif damage == "empty":
        shutil.rmtree(second.path)
        second.path.mkdir()
    else:
        (second.path / {"file": "run.json", "manifest": "manifest.json"}[damage]).unlink()
    found, (line,) = newest_good(tmp_path)
    assert found == first
    assert line.startswith(f"{second.path}") and "\n" not in line
    assert line.endswith("going on from the one before, 000001000")
    (first.path / "params.msgpack").unlink()
    with pytest.raises(ConfigError, match="params.msgpack: .*; there is no other checkpoint"):
        newest_good(tmp_path)


def test_a_run_that_had_ended_does_not_go_on_from_before_a_damaged_end(tmp_path):
    # The one before its end has parameters alone: going on from it is not possible.
    before, end = (write(tmp_path, env_steps=n) for n in (1000, 2000))
    assert newest_good(tmp_path) == (end, [])
    flip(end.path / "params.msgpack", 77)
    with pytest.raises(ConfigError, match="params.msgpack: damaged.*cannot be gone on from"):
        newest_good(tmp_path)
    assert before == whole(before.path)


# Writing that fails


class Killed(BaseException):
    """The end of a process, in the middle of a call."""


class Faults:
    """The system calls of a save; the one of a number fails."""

    def __init__(self, monkeypatch, error):
        self.error, self.left = error, None
        for module, name in ((os, "replace"), (os, "mkdir"), (os, "link"), (os, "open"), (shutil, "rmtree")):
            monkeypatch.setattr(module, name, self.counted(getattr(module, name)))
        monkeypatch.setattr(os, "fsync", self.counted(lambda descriptor: None))
        monkeypatch.setattr(checkpoint, "open", self.opened, raising=False)

    def counted(self, call):
        def counted(*arguments, **options):
            if self.left is not None:
                self.left -= 1
                if self.left == 0:
                    if options.get("ignore_errors") and self.error is OSError:
                        return None
                    raise self.error(errno.ENOSPC, "No space left on device")
            return call(*arguments, **options)

        return counted

    def opened(self, path, mode, **options):
        file = self.counted(open)(path, mode, **options)
        if "w" not in mode:
            return file
        write = file.write  # all but the last byte go through
        failing = self.counted(lambda data: None)

        class Writing(io.BufferedIOBase):
            def write(_, data):
                data = memoryview(data).tobytes()
                size = len(data)
                write(data[: size - 1])
                failing(data)
                write(data[size - 1 :])

            fileno, flush, close = file.fileno, file.flush, file.close

        return Writing()


@pytest.mark.parametrize("error", [OSError, Killed], ids=["fails", "killed"])
@pytest.mark.parametrize("env_steps", [3000, 2000], ids=["another step", "the same step"])
def test_a_save_that_ends_anywhere_leaves_the_one_before(tmp_path, monkeypatch, error, env_steps):
    faults = Faults(monkeypatch, error)
    for number in itertools.count(1):
        run = tmp_path / str(number)
        first = write(run, make_params(1), state=make_state(), env_steps=1000)
        second = write(run, make_params(2), state=make_state(unchanged=ARRAYS), base=first, env_steps=2000)
        faults.left = number
        ended = False
        try:
            state = make_state(unchanged=["frames"])
            write(run, make_params(3), state=state, base=second, env_steps=env_steps)
        except (SaveError, Killed) as problem:
            ended = True
            if isinstance(problem, SaveError):
                assert "No space left on device" in str(problem) and "\n" not in str(problem)
        reached, faults.left = faults.left <= 0, None
        found, said = newest_good(run)
        heads = checkpoint.load(found)["rl"]
        new, old = (identical(heads, make_params(n)["rl"]) for n in (3, 2))
        if env_steps == 3000:
            assert not said and (new, old) == ((True, False) if found.env_steps == 3000 else (False, True))
            assert new or ended
        elif error is OSError:
            assert found.env_steps == 2000 and (new or (old and ended))
        else:  # between the two renames neither of the two is there: the one before them is
            assert (new or old) if found.env_steps == 2000 else found == first and ended
        last = write(run, make_params(4), state=make_state(unchanged=ARRAYS), base=found, env_steps=4000)
        assert whole(run) == last and not list((run / "checkpoints").glob(".*"))
        shutil.rmtree(run)
        if not reached:
            assert number > 25
            return


def test_slimming_that_fails_leaves_a_whole_checkpoint(tmp_path, monkeypatch):
    faults = Faults(monkeypatch, OSError)
    for number in itertools.count(1):
        manifest = write(tmp_path / str(number), state=make_state())
        faults.left = number
        possible = [{"params.msgpack"}]
        try:
            checkpoint.slim(manifest)
        except SaveError:
            possible.append(set(manifest.files))
        reached, faults.left = faults.left <= 0, None
        assert set(whole(manifest.path).files) in possible
        if not reached:
            assert number > 5
            return


def test_parameters_of_another_form_are_refused_by_name():
    template, cases = make_params(), []
    shape, dtype, missing, extra = (make_params() for _ in range(4))
    shape["rl"]["q"]["kernel"] = np.zeros((3, 2), np.float32)
    cases.append((shape, r"\(3, 2\), not float32 \(2, 3\)"))
    dtype["rl"]["q"]["kernel"] = np.zeros((2, 3), np.float64)
    cases.append((dtype, "float64"))
    del missing["rl"]["q"]
    cases.append((missing, "on one side only"))
    extra["inverse"] = {"kernel": np.zeros(1, np.float32)}
    cases.append((extra, "inverse/kernel is on one side only"))
    for tree, message in cases:
        with pytest.raises(ConfigError, match="the source: parameter.*" + message):
            checkpoint.load_into(template, tree, "the source")


def test_parameters_with_an_empty_branch_more_or_less_are_refused():
    template, extra, less = make_params(), make_params(), make_params()
    extra["inverse"] = {}
    del less["latent_l2"]
    for tree in (extra, less):
        with pytest.raises(ConfigError, match="the source: parameters do not fit"):
            checkpoint.load_into(template, tree, "the source")
