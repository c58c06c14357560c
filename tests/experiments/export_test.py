"""experiments/export.py and srl_jax/encoders/files.py: an encoder in a file that numpy reads."""

import errno
import json
import os
import zipfile

import jax
import numpy as np
import pytest

import srl_jax
from experiments import export
from srl_jax import encoders, plugins, specs
from srl_jax.errors import ConfigError, SaveError
from tests.helpers import JOINT, fill, identical, write_checkpoint
from tests.in_process import parse


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    write_checkpoint(path, **JOINT)
    write_checkpoint(path, env_steps=120, folder="encoders", only=["encoder"], **JOINT)
    return path


@pytest.fixture
def exported():
    """Runs the command, whose arguments it takes."""

    def call(*arguments):
        export.main(parse(export, *arguments, positional="run"))

    return call


def test_numpy_alone_reads_it(run, exported, tmp_path, capsys):
    path = tmp_path / "enc.npz"
    exported(run, f"--encoder={path}")
    assert capsys.readouterr().out == f"{path}: tiny, observations [42, 42, 4] to 8 numbers\n"
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    about = json.loads(str(arrays.pop("about")))
    assert about.pop("steps")[1] == {
        "step": "conv", "parameters": "Conv_0", "stride": 4, "padding": [[0, 0], [0, 0]],
    }  # fmt: skip
    assert about == {
        "encoder": "tiny:features=8",
        "observation_shape": [42, 42, 4],
        "features": 8,
        "game": "Catch",
        "env_steps": 240,
    }
    own = srl_jax.load(run).params["encoder"]
    assert set(arrays) == {f"{layer}/{name}" for layer in own for name in own[layer]}
    assert arrays["Conv_0/kernel"].shape == (6, 6, 4, 16) and arrays["LayerNorm_0/scale"].dtype == np.float32
    np.testing.assert_array_equal(arrays["Dense_0/kernel"], own["Dense_0"]["kernel"])


def computed(steps, arrays, x):
    """What "steps" of a file say, by numpy alone."""
    x = x.astype(np.float64)
    for step in steps:
        own = {
            name.partition("/")[2]: a
            for name, a in arrays.items()
            if name.partition("/")[0] == step.get("parameters")
        }
        match step["step"]:
            case "multiply":
                x = x * step["by"]
            case "conv":
                x = np.pad(x, [(0, 0), *step["padding"], (0, 0)])
                side, stride = own["kernel"].shape[0], step["stride"]
                patches = np.lib.stride_tricks.sliding_window_view(x, (side, side), (1, 2))[
                    :, ::stride, ::stride
                ]
                x = np.einsum("bhwcij,ijco->bhwo", patches, own["kernel"]) + own["bias"]
            case "relu":
                x = np.maximum(x, 0)
            case "flatten":
                x = x.reshape(len(x), -1)
            case "dense":
                x = x @ own["kernel"] + own["bias"]
            case "layer_norm":
                x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + step["epsilon"])
                x = x * own["scale"] + own["bias"]
            case "tanh":
                x = np.tanh(x)
            case "elu":
                x = np.where(x > 0, x, np.expm1(x))
            case "average":
                x = x.mean((1, 2))
            case "min_max":
                low, high = x.min(-1, keepdims=True), x.max(-1, keepdims=True)
                x = (x - low) / np.maximum(high - low, step["least"])
            case "sim_norm":
                x = np.exp(x.reshape(len(x), -1, step["group"]))
                x = (x / x.sum(-1, keepdims=True)).reshape(len(x), -1)
            case other:
                raise ValueError(other)
    return x


@pytest.mark.parametrize(
    ("spec", "side"),
    [("nature:gain=32", 84), ("sac_ae:features=5", 37), ("tiny", 45), ("tiny:features=0", 42)]
    + [
        ("der", 84),
        ("der:features=8,end=sim_norm", 41),
        ("der:end=min_max", 41),
        ("a_lix", 20),
        ("mrq:features=8", 25),
    ]
    + [("nature:padding=same,pool=average,end=layer_norm", 42), ("tiny:end=relu", 42)],
)
def test_what_the_file_says_is_enough_to_run_the_encoder(tmp_path, spec, side):
    # At 37 and 45 pixels some strides do not fit, and zeros are added.
    row = specs.parse(spec, encoders.REGISTRY)
    encoder = plugins.build(row, encoders.REGISTRY, (side, side, 2))
    params = fill(jax.eval_shape(encoder.init, jax.random.key(0)))
    encoders.to_npz(tmp_path / "enc.npz", encoder, params, spec)
    with np.load(tmp_path / "enc.npz", allow_pickle=False) as file:
        arrays = dict(file)
    steps = json.loads(str(arrays.pop("about")))["steps"]
    x = np.random.default_rng(0).integers(0, 256, (2, side, side, 2), dtype=np.uint8)
    expected = jax.jit(encoder.apply)(params, x)
    np.testing.assert_allclose(computed(steps, arrays, x), expected, atol=1e-4, rtol=1e-4)


def test_it_is_loaded_without_the_run(run, exported, tmp_path):
    for place, env_steps in ((run, 240), (run / "encoders" / "000000120", 120)):
        path = tmp_path / f"{env_steps}.npz"
        exported(place, f"--encoder={path}")
        encoder, params = srl_jax.encoders.from_npz(path)
        loaded = srl_jax.load(place)
        assert identical(params, loaded.params["encoder"]) and loaded.env_steps == env_steps
        x = np.random.default_rng(0).integers(0, 256, (2, 42, 42, 4), dtype=np.uint8)
        np.testing.assert_allclose(jax.jit(encoder.apply)(params, x), loaded.encode(x), atol=1e-5)
    for wrong, said in (
        (x.astype(np.int32), r"not int32 \[2, 42, 42, 4\]"),
        (x[0], r"\[B, 42, 42, 4\], not uint8 \[42, 42, 4\]"),
        (x[:, :40], r"not uint8 \[2, 40, 42, 4\]"),
    ):
        for apply in (encoder.apply, jax.jit(encoder.apply)):
            with pytest.raises(ValueError, match=said):
                apply(params, wrong)
    with pytest.raises(ValueError, match="give bytes as uint8"):
        encoder.apply(params, x.astype(np.float32))


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(run, exported, tmp_path):
    file = tmp_path / "enc.npz"
    for arguments, message in (
        ((), "--run: missing"),
        ((run,), "--encoder: missing; name the file to write"),
        ((run, f"--encoder={tmp_path / 'enc'}"), "--encoder=.*enc: must end in .npz"),
        ((run, f"--encoder={tmp_path / 'no' / 'enc.npz'}"), "--encoder=.*: no such directory"),
        ((tmp_path / "no", f"--encoder={file}"), ".*no: no checkpoint there"),
        (
            (run, f"--encoder={file}", "--import=no_such_module"),
            "--import=no_such_module: ModuleNotFoundError",
        ),
    ):
        with pytest.raises(ConfigError, match=f"^{message}"):
            exported(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_there_is_replaced_only_if_asked(run, exported, tmp_path):
    path = tmp_path / "enc.npz"
    path.write_text("mine")
    with pytest.raises(ConfigError, match="enc.npz: exists; name a new file, or --overwrite replaces it$"):
        exported(run, f"--encoder={path}")
    with pytest.raises(ConfigError):
        exported(tmp_path / "no", f"--encoder={path}", "--overwrite")
    assert path.read_text() == "mine"
    exported(run, f"--encoder={path}", "--overwrite")
    assert srl_jax.encoders.from_npz(path)[0].features == 8
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ConfigError, match="exists and is not a file"):
        exported(run, f"--encoder={tmp_path / 'folder.npz'}", "--overwrite")


def test_a_full_disk_leaves_what_was_there(run, exported, tmp_path, monkeypatch):
    path = tmp_path / "enc.npz"
    path.write_text("mine")

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(SaveError, match="enc.npz: not written: No space left on device"):
        exported(run, f"--encoder={path}", "--overwrite")
    assert [file.name for file in tmp_path.iterdir()] == ["enc.npz"] and path.read_text() == "mine"


def test_what_export_has_not_written_is_refused(run, exported, tmp_path):
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    exported(run, f"--encoder={good}")
    with np.load(good) as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))

    def refused(message):
        with pytest.raises(ConfigError, match=f"^{bad}: {message}"):
            srl_jax.encoders.from_npz(bad)

    refused("No such file")
    for data in (b"", b"text", good.read_bytes()[:-40]):
        bad.write_bytes(data)
        refused("not an encoder that srl-jax export has written")
    np.save(bad.with_suffix(".npy"), np.zeros(3))
    bad.write_bytes(bad.with_suffix(".npy").read_bytes())
    refused("not an encoder that srl-jax export has written")
    with zipfile.ZipFile(bad, "w") as file:
        file.writestr("about.npy", b"no array")
    refused("not an encoder that srl-jax export has written")
    for change, message in (
        ({"encoder": "own:features=8"}, "'own:features=8': no 'own'; valid: nature"),
        ({"encoder": "tiny:features=9"}, "parameter .* is float32 .*8.*, not float32 .*9"),
        ({"observation_shape": [2, 2, 4]}, ".*frames of 2 pixels are too small"),
        ({"observation_shape": "wide"}, "not an encoder that srl-jax export has written"),
    ):
        np.savez(bad, **{**arrays, "about": np.array(json.dumps({**about, **change}))})
        refused(message)
    np.savez(bad, **{name: x for name, x in arrays.items() if name != "Conv_1/bias"})
    refused("parameters do not fit: .*Conv_1.*bias.* is on one side only")
