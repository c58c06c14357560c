"""A checkpoint of a real run, damaged in every way that a disk knows: all must be noticed, by name."""

import random
import shutil

import pytest

from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint

ABOUT = (checkpoint.MANIFEST, checkpoint.CHECKSUM)


@pytest.fixture
def folder(small_run, tmp_path):
    """A copy of the run's last checkpoint."""
    return shutil.copytree(checkpoint.read_manifest(small_run).path, tmp_path / "000000160")


def noticed(path):
    """Whether the damage to a file is told in one line that names it."""
    try:
        checkpoint.verify(checkpoint.read_manifest(path.parent))
    except ConfigError as error:
        # A manifest that does not fit its sum may be either's fault.
        names = [path.name] if path.name not in ABOUT else [*ABOUT, str(path.parent)]
        return any(name in str(error) for name in names) and "\n" not in str(error)
    return False


def toggle(path, bit):
    with open(path, "r+b") as file:
        file.seek(bit // 8)
        (byte,) = file.read(1)
        file.seek(bit // 8)
        file.write(bytes([byte ^ 1 << bit % 8]))


def test_a_flipped_bit_is_noticed(folder, amount, progress, record_property):
    draw, missed = random.Random(0), []
    files = sorted(folder.iterdir())
    sizes = [path.stat().st_size for path in files]
    for i in range(amount("flips")):
        # Half of them drawn by file, half by byte, so that small files are not spared.
        (path,) = draw.choices(files, sizes) if i % 2 else [draw.choice(files)]
        bit = draw.randrange(8 * path.stat().st_size)
        toggle(path, bit)
        missed += [] if noticed(path) else [(path.name, bit)]
        toggle(path, bit)
        progress(i + 1, amount("flips"), "bits")
    record_property("bits flipped", amount("flips"))
    record_property("files", len(files))
    record_property("bytes", sum(sizes))
    assert not missed
    checkpoint.verify(checkpoint.read_manifest(folder))


def test_a_file_cut_longer_removed_or_replaced_is_noticed(folder, record_property):
    missed, damages = [], 0
    files = sorted(folder.iterdir())
    for path, other in zip(files, [*files[1:], files[0]], strict=True):
        data = path.read_bytes()
        for changed in (b"", data[: len(data) // 2], data[:-1], data + b"\0", other.read_bytes(), None):
            path.unlink() if changed is None else path.write_bytes(changed)
            missed += [] if noticed(path) else [(path.name, changed and len(changed))]
            damages += 1
        path.write_bytes(data)
    record_property("damages", damages)
    assert not missed
