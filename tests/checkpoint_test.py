"""srl_jax/checkpoint.py: what is written comes back bit by bit, or not at all."""

import dataclasses
import hashlib
import json
import os
import pickle
import shutil

import msgpack
import numpy as np
import pytest
from flax import serialization
from hypothesis import given
from hypothesis import strategies as st

from srl_jax import checkpoint
from srl_jax.config import Config
from srl_jax.specs import ConfigError
from tests.helpers import identical

CONFIG = Config(game="Catch", frame_size=42, encoder="tiny:features=8", seed=5, lr_rl=1 / 3)


def make_params(seed=0):
    rng = np.random.default_rng(seed)
    layer = lambda *shape: {"kernel": rng.normal(size=shape).astype(np.float32)}  # noqa: E731
    params = {"encoder": {"Conv_0": layer(3, 3, 4, 2)}, "heads": {"rl": {"q": layer(2, 3)}, "latent_l2": {}}}
    # Numbers that a text format, or a change of precision, would not bring back.
    odd = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, 1 / 3], np.float32)
    params["encoder"]["odd"] = {"bias": odd}
    return params


def write(run, params=None, config=CONFIG, env_steps=1000, **options):
    counts = {"num_actions": 3, "env_steps": env_steps, "updates": 100}
    return checkpoint.save(run, make_params() if params is None else params, config, **counts, **options)


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


@pytest.mark.parametrize("where", ["run", "checkpoints", "checkpoint"])
def test_round_trip_is_bit_identical(tmp_path, where):
    params = make_params()
    final = write(tmp_path, params)
    path = {"run": tmp_path, "checkpoints": tmp_path / "checkpoints", "checkpoint": final}[where]
    manifest = checkpoint.read_manifest(path)
    assert manifest.path == final
    assert manifest.config == CONFIG
    assert (manifest.num_actions, manifest.env_steps, manifest.updates) == (3, 1000, 100)
    loaded = checkpoint.load_into(params, checkpoint.load(manifest), "test")
    assert same_bits(loaded["encoder"]["odd"]["bias"], params["encoder"]["odd"]["bias"])
    del loaded["encoder"]["odd"], params["encoder"]["odd"]  # NaN is not equal to itself
    assert identical(loaded, params)
    assert loaded["heads"]["latent_l2"] == {}


def test_the_same_parameters_make_the_same_bytes(tmp_path):
    first, second = write(tmp_path / "a"), write(tmp_path / "b")
    assert [p.name for p in sorted(first.iterdir())] == ["manifest.json", "params.msgpack"]
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes()


def test_nothing_is_pickled(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("pickle was called")

    for name in ("dump", "dumps", "load", "loads", "Pickler", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    final = write(tmp_path)
    assert identical(checkpoint.load(checkpoint.read_manifest(final))["heads"], make_params()["heads"])


def test_the_newest_is_read_and_two_are_kept(tmp_path):
    for env_steps in (900, 1000, 20_000, 300_000):
        write(tmp_path, make_params(env_steps), env_steps=env_steps)
    assert checkpoint.read_manifest(tmp_path).env_steps == 300_000
    kept = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert kept == ["000020000", "000300000"]
    loaded = checkpoint.load(checkpoint.read_manifest(tmp_path))
    assert identical(loaded["heads"], make_params(300_000)["heads"])
    write(tmp_path, env_steps=300_001, keep=1)
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["000300001"]


def test_a_checkpoint_of_the_same_step_is_replaced(tmp_path):
    write(tmp_path, make_params(1))
    write(tmp_path, make_params(2))
    loaded = checkpoint.load(checkpoint.read_manifest(tmp_path))
    assert identical(loaded["heads"], make_params(2)["heads"])


def test_a_write_that_was_cut_short_is_passed_over_and_cleared(tmp_path):
    write(tmp_path, env_steps=1000)
    folder = tmp_path / "checkpoints"
    shutil.copytree(folder / "000001000", folder / ".000002000.partial")
    (folder / "000003000").mkdir()  # no manifest
    assert checkpoint.read_manifest(tmp_path).env_steps == 1000
    write(tmp_path, env_steps=2000)
    assert checkpoint.read_manifest(tmp_path).env_steps == 2000
    assert not (folder / ".000002000.partial").exists()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(tmp_path_factory.mktemp("run"))


@given(st.data())
def test_one_flipped_bit_is_refused(written, tmp_path_factory, data):
    content = bytearray((written / "params.msgpack").read_bytes())
    bit = data.draw(st.integers(0, 8 * len(content) - 1))
    content[bit // 8] ^= 1 << bit % 8
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copy(written / "manifest.json", folder)
    (folder / "params.msgpack").write_bytes(content)
    with pytest.raises(ConfigError, match="damaged") as error:
        checkpoint.load(checkpoint.read_manifest(folder))
    assert str(folder / "params.msgpack") in str(error.value)


@given(st.data())
def test_a_damaged_manifest_is_an_error_of_one_line_or_still_describes_the_file(
    written, tmp_path_factory, data
):
    # It holds no sum of itself: a flipped bit in a number passes. None may be a crash or load other bytes.
    content = bytearray((written / "manifest.json").read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        bit = data.draw(st.integers(0, 8 * len(content) - 1))
        content[bit // 8] ^= 1 << bit % 8
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copy(written / "params.msgpack", folder)
    (folder / "manifest.json").write_bytes(content)
    try:
        loaded = checkpoint.load(checkpoint.read_manifest(folder))
    except ConfigError as error:
        assert str(folder) in str(error) and "\n" not in str(error)
    else:
        assert identical(loaded["heads"], make_params()["heads"])


@pytest.mark.parametrize(
    "change",
    [
        lambda m: [],
        lambda m: {**m, "format": 2},
        lambda m: {**m, "format": True},
        lambda m: {**m, "num_actions": "3"},
        lambda m: {**m, "num_actions": -1},
        lambda m: {**m, "env_steps": 2**31},
        lambda m: {**m, "files": {}},
        lambda m: {**m, "files": ["params.msgpack"]},
        lambda m: {**m, "files": {"params.msgpack": "0"}},
        lambda m: {**m, "files": {"params.msgpack": {**m["files"]["params.msgpack"], "bytes": "100"}}},
        lambda m: {**m, "files": {"params.msgpack": {**m["files"]["params.msgpack"], "bytes": 10**30}}},
        lambda m: {**m, "files": {"../params.msgpack": {"sha256": "0"}}},
        lambda m: {**m, "config": {**m["config"], "mode": "none"}},
        lambda m: {n: m[n] for n in m if n != "updates"},
    ],
)
def test_a_manifest_of_another_form_is_refused(written, tmp_path, change):
    shutil.copy(written / "params.msgpack", tmp_path)
    manifest = json.loads((written / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(change(manifest)))
    with pytest.raises(ConfigError) as error:
        checkpoint.load(checkpoint.read_manifest(tmp_path))
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("size", [0, 100])
def test_a_file_that_is_cut_short_is_refused(written, tmp_path, size):
    shutil.copytree(written, tmp_path / "copy")
    path = tmp_path / "copy" / "params.msgpack"
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ConfigError, match="params.msgpack: damaged"):
        checkpoint.load(checkpoint.read_manifest(tmp_path / "copy"))


def test_missing_files_are_named(written, tmp_path):
    with pytest.raises(ConfigError, match="no checkpoint there"):
        checkpoint.read_manifest(tmp_path)
    with pytest.raises(ConfigError, match="no checkpoint there"):
        checkpoint.read_manifest(tmp_path / "nowhere")
    shutil.copytree(written, tmp_path / "copy")
    (tmp_path / "copy" / "params.msgpack").unlink()
    with pytest.raises(ConfigError, match="params.msgpack"):
        checkpoint.load(checkpoint.read_manifest(tmp_path / "copy"))


def test_a_file_that_fits_its_sum_but_holds_no_parameters_is_not_executed(written, tmp_path):
    # Whoever writes both files can make the sums fit; then the format has to be harmless by itself.
    trap = tmp_path / "executed"

    class Trap:
        def __reduce__(self):
            return trap.touch, ()

    trapped = pickle.dumps(Trap())
    for data in (trapped, msgpack.packb({"encoder": msgpack.ExtType(1, trapped), "heads": {}}), b"\x01"):
        check_refused(written, tmp_path, data)
    assert not trap.exists()


@pytest.mark.parametrize(
    "leaf", [3, 0.5, "text", None, [0.0], np.float32(1), {5: np.zeros(2, np.float32)}], ids=repr
)
def test_only_named_arrays_are_parameters(written, tmp_path, leaf):
    data = serialization.msgpack_serialize({"encoder": {"kernel": leaf}, "heads": {}})
    check_refused(written, tmp_path, data)


@pytest.mark.parametrize("content", ["[" * 100_000, '{"format": 1, "format": 1}'], ids=["deep", "twice"])
def test_a_manifest_that_is_no_plain_json_is_refused(tmp_path, content):
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(ConfigError, match="manifest.json: damaged"):
        checkpoint.read_manifest(tmp_path)


@pytest.mark.parametrize("name", ["manifest.json", "params.msgpack"])
@pytest.mark.parametrize("device", [False, True], ids=["pipe", "device"])
def test_pipes_and_devices_are_not_read(written, tmp_path, name, device):
    folder = tmp_path / "copy"
    shutil.copytree(written, folder)
    (folder / name).unlink()
    if device:
        (folder / name).symlink_to("/dev/zero")
    else:
        os.mkfifo(folder / name)
    with pytest.raises(ConfigError, match="Not a regular file"):
        checkpoint.load(checkpoint.read_manifest(folder))


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(ConfigError, match="no checkpoint there"):
        checkpoint.read_manifest("x" * 5000)


def check_refused(written, tmp_path, data):
    manifest = json.loads((written / "manifest.json").read_text())
    manifest["files"]["params.msgpack"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "params.msgpack").write_bytes(data)
    with pytest.raises(ConfigError, match="params.msgpack"):
        checkpoint.load(checkpoint.read_manifest(tmp_path))


def test_parameters_of_another_form_are_refused_by_name():
    template, cases = make_params(), []
    shape, dtype, missing, extra = (make_params() for _ in range(4))
    shape["heads"]["rl"]["q"]["kernel"] = np.zeros((3, 2), np.float32)
    cases.append((shape, r"\(3, 2\), not float32 \(2, 3\)"))
    dtype["heads"]["rl"]["q"]["kernel"] = np.zeros((2, 3), np.float64)
    cases.append((dtype, "float64"))
    del missing["heads"]["rl"]["q"]
    cases.append((missing, "on one side only"))
    extra["heads"]["inverse"] = {"kernel": np.zeros(1, np.float32)}
    cases.append((extra, "'inverse'.*on one side only"))
    for tree, message in cases:
        with pytest.raises(ConfigError, match="the source: parameter.*" + message):
            checkpoint.load_into(template, tree, "the source")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"seed": 6, "mode": "finetuned"}, None),
        ({"encoder": "tiny:features=16"}, "the architecture differs: encoder is tiny:features=8 there"),
        ({"encoder": "nature"}, "the architecture differs: encoder is .* and nature here"),
        ({"frame_size": 84}, "the preprocessing differs: frame_size is 42 there and 84 here"),
        ({"frame_stack": 3}, "the preprocessing differs: frame_stack is 4 there and 3 here"),
    ],
)
def test_encoders_that_do_not_fit_are_refused(tmp_path, change, message):
    write(tmp_path)
    config = dataclasses.replace(CONFIG, **{"mode": "frozen"} | change, encoder_from=str(tmp_path))
    if message is None:
        checkpoint.check_sources(config)
    else:
        with pytest.raises(ConfigError, match=f"--encoder_from={tmp_path}: {message}"):
            checkpoint.check_sources(config)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder": "nature"}, None),  # a policy brings its own encoder
        ({"game": "CatchDistractor"}, "the game differs"),
        ({"frame_size": 84}, "the preprocessing differs"),
        ({"frame_stack": 3}, "the preprocessing differs"),
    ],
)
def test_policies_that_do_not_fit_are_refused(tmp_path, change, message):
    write(tmp_path)
    pretrain = {"mode": "pretrain", "objectives": ("reconstruction",), "policy_from": str(tmp_path)}
    config = dataclasses.replace(CONFIG, **pretrain | change)
    if message is None:
        checkpoint.check_sources(config)
    else:
        with pytest.raises(ConfigError, match=f"--policy_from={tmp_path}: {message}"):
            checkpoint.check_sources(config)


def test_a_representation_run_has_no_policy(tmp_path):
    pretrain = dataclasses.replace(CONFIG, mode="pretrain", objectives=("reconstruction",))
    write(tmp_path, config=pretrain)
    config = dataclasses.replace(pretrain, policy_from=str(tmp_path))
    with pytest.raises(ConfigError, match="has no policy"):
        checkpoint.check_sources(config)


def test_sources_that_are_not_there_are_named_with_their_flag(tmp_path):
    for flag in ("encoder_from", "policy_from"):
        config = dataclasses.replace(CONFIG, **{flag: str(tmp_path / "none")})
        with pytest.raises(ConfigError, match=f"--{flag}=.*none: .*no checkpoint there"):
            checkpoint.check_sources(config)
