"""A checkpoint of a real run, damaged in every way that a disk knows: all must be noticed, by name.

A bit flipped at random positions (half of them drawn by file, half by byte, so that small files are not
spared), each file cut short, made longer, removed, and replaced by another.
"""

import random
import shutil
from pathlib import Path

from srl_jax import checkpoint
from srl_jax.errors import ConfigError

from . import Count, Say
from .small import stopped_run

BITS = 1000


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    run = folder / "run"
    stopped_run(run, at=400)
    whole = checkpoint.newest_good(run, say)
    checks = Checks(whole.path)
    bits = 60 if short else BITS
    draw = random.Random(0)
    files = sorted(whole.path.iterdir())
    sizes = [path.stat().st_size for path in files]
    for i in range(bits):
        (path,) = draw.choices(files, sizes) if i % 2 else [draw.choice(files)]
        checks.flip(path, draw.randrange(8 * path.stat().st_size))
    rows = [checks.count(f"one bit flipped, {len(files)} files, {sum(sizes):,} bytes")]
    for size in (lambda n: 0, lambda n: n // 2, lambda n: n - 1, lambda n: n + 1):
        for path in files:
            checks.resize(path, size(path.stat().st_size))
    rows.append(checks.count("each file cut to nothing, to half, by a byte; a byte longer"))
    for path in files:
        checks.remove(path)
    rows.append(checks.count("each file removed"))
    for path in files:
        checks.swap(path, files[(files.index(path) + 1) % len(files)])
    rows.append(checks.count("each file replaced by another"))
    return rows


class Checks:
    """Damages a checkpoint, looks whether it is refused by the file's name, and mends it.

    Args:
        folder: of the checkpoint.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._number = self._missed = 0

    def count(self, what: str) -> Count:
        """Of the damages since the last call."""
        found = Count(what, self._number, self._missed)
        self._number = self._missed = 0
        return found

    def flip(self, path: Path, bit: int) -> None:
        """One bit."""
        with open(path, "r+b") as file:
            self._toggle(file, bit)
            file.flush()
            self._look(path)
            self._toggle(file, bit)

    def resize(self, path: Path, size: int) -> None:
        """Cut short or longer."""
        data = path.read_bytes()
        path.write_bytes(data[:size].ljust(size, b"\0"))
        self._look(path)
        path.write_bytes(data)

    def remove(self, path: Path) -> None:
        """Gone."""
        aside = self._folder.parent / "aside"
        path.rename(aside)
        self._look(path)
        aside.rename(path)

    def swap(self, path: Path, other: Path) -> None:
        """Another file's content."""
        data = path.read_bytes()
        shutil.copyfile(other, path)
        self._look(path)
        path.write_bytes(data)

    def _look(self, path: Path) -> None:
        self._number += 1
        try:
            checkpoint.verify(checkpoint.read_manifest(self._folder))
        except ConfigError as error:
            # A manifest that does not fit its sum may be either's fault.
            names = [path.name] if path.name not in _ABOUT else [*_ABOUT, str(self._folder)]
            self._missed += not any(name in str(error) for name in names) or "\n" in str(error)
        else:
            self._missed += 1

    @staticmethod
    def _toggle(file, bit: int) -> None:
        file.seek(bit // 8)
        (byte,) = file.read(1)
        file.seek(bit // 8)
        file.write(bytes([byte ^ 1 << bit % 8]))


_ABOUT = (checkpoint.MANIFEST, checkpoint.CHECKSUM)
