"""srl_jax/files/checkpoint.py: what is damaged is refused by name, and nothing that is read is executed."""

import errno
import hashlib
import io
import json
import pickle
import shutil

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.reading import read_bytes
from tests.files.checkpoint_test import flip, make_state, names, write
from tests.helpers import whole


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(tmp_path_factory.mktemp("run"), state=make_state()).path


@pytest.fixture
def copy(written, tmp_path):
    return shutil.copytree(written, tmp_path / "copy")


FILES = ["manifest.json", "manifest.sha256", "params.msgpack", "learner.msgpack", "run.json", "frames.npy"]


def check_refused(folder, file):
    with pytest.raises(ConfigError) as error:
        whole(folder)
    line = str(error.value)
    assert str(folder) in line and "\n" not in line
    # Of the manifest and its sum, neither can say which one it is.
    assert file in line or (file.startswith("manifest") and "manifest" in line)


@given(st.data())
def test_one_flipped_bit_in_any_file_is_refused(written, tmp_path_factory, data):
    folder = shutil.copytree(written, tmp_path_factory.mktemp("damaged") / "copy")
    file = data.draw(st.sampled_from(names(folder)))
    flip(folder / file, data.draw(st.integers(0, 8 * (folder / file).stat().st_size - 1)))
    check_refused(folder, file)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("kind", ["missing", "directory", "unreadable"])
def test_a_file_that_is_none_is_refused_by_name(copy, monkeypatch, file, kind):
    path = copy / file
    if kind == "unreadable":  # as of a disk that fails

        def broken(found, *arguments):
            if str(found) == str(path):
                raise OSError(errno.EIO, "Input/output error")
            return read_bytes(found, *arguments)

        monkeypatch.setattr(checkpoint, "read_bytes", broken)
    else:
        path.unlink()
        if kind == "directory":
            path.mkdir()
    check_refused(copy, file)


def test_missing_checkpoints_are_named(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ConfigError, match=f"{path}: no checkpoint there"):
            checkpoint.read_manifest(path)
    write(tmp_path / "seeds/seed3", env_steps=1000)
    with pytest.raises(ConfigError, match=f"name one of the runs in it, as {tmp_path}/seeds/seed3, or"):
        checkpoint.read_manifest(tmp_path / "seeds")
    # A directory that should be one is damaged; it is not passed over.
    write(tmp_path, env_steps=1000)
    (tmp_path / "checkpoints" / "000002000").mkdir()
    with pytest.raises(ConfigError, match="000002000"):
        checkpoint.read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 3}, "000001000: checkpoint of format 3, not 4$"),
        ({"config": {"frobnicate": 1}}, "manifest.json: .*frobnicate"),
        ({"config": {"mode": "none"}}, "manifest.json: .*none"),
    ],
)
def test_a_checkpoint_of_another_version_is_refused(tmp_path, change, message):
    folder = write(tmp_path).path
    about = json.loads((folder / "manifest.json").read_text())
    change = {name: about[name] | x if isinstance(x, dict) else x for name, x in change.items()}
    checkpoint.sign(folder, about | change)
    with pytest.raises(ConfigError, match=message) as error:
        checkpoint.read_manifest(folder)
    assert str(folder) in str(error.value) and "\n" not in str(error.value)


def test_nothing_is_executed_even_where_the_sums_fit(copy, tmp_path):
    trap = tmp_path / "executed"

    class Trap:
        def __reduce__(self):
            return trap.touch, ()

    objects = io.BytesIO()
    np.save(objects, np.array([Trap()], object), allow_pickle=True)
    pickled = pickle.dumps(Trap())
    extension = msgpack.packb({"encoder": msgpack.ExtType(1, pickled)})
    for file, load in (
        ("params.msgpack", checkpoint.load),
        ("run.json", checkpoint.load_numbers),
        ("frames.npy", lambda manifest: checkpoint.load_array(manifest, "frames")),
    ):
        for data in (pickled, extension, objects.getvalue()):
            manifest = checkpoint.read_manifest(copy)
            (copy / file).write_bytes(data)
            manifest.files[file] = checkpoint.Entry(len(data), hashlib.sha256(data).hexdigest())
            try:
                load(manifest)
            except Exception as error:
                assert "sha256" not in str(error)
    assert not trap.exists()


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(ConfigError, match="no checkpoint there"):
        checkpoint.read_manifest("x" * 5000)
