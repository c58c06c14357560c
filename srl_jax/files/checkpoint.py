"""Checkpoints of a run: a directory of plain data whose sums are compared before any of it is used.

A checkpoint is `checkpoints/ENV_STEPS` of a run:

    manifest.json     configuration, counts, and bytes and sha256 of every other file
    manifest.sha256   the manifest's own, as sha256sum writes and checks it
    params.msgpack    {"encoder": tree, OBJECTIVE: tree}
    NAME.msgpack, NAME.npy, run.json: what else a run needs to resume, see `srl_jax.run.seed.Seed.parts`

It is written to a temporary directory, each file flushed to disk, the manifest last, and renamed. Large
arrays come in chunks; one that has not changed since the checkpoint before is a hard link to its. The sums
show damage; they do not show a forgery. Reading executes nothing: msgpack, JSON and npy are data, and nothing
is unpickled. The module imports no jax until parameters are read or written.
"""

import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files.reading import read_bytes

MANIFEST, CHECKSUM, PARAMS, NUMBERS = "manifest.json", "manifest.sha256", "params.msgpack", "run.json"
FORMAT = 4


class Entry(NamedTuple):
    """The size in bytes and the sha256 of a file, as a manifest has them."""

    bytes: int
    sha256: str


class Manifest(NamedTuple):
    """What a checkpoint says of itself.

    Attributes:
        path: its directory.
        config: of the run that wrote it, resolved.
        frame_shape: (H, W, C) of that run's frames.
        num_actions: of that run's game.
        env_steps, updates: when it was written.
        files: {name: Entry}, of every file but the manifest and its sum.
    """

    path: Path
    config: Config
    frame_shape: tuple[int, int, int]
    num_actions: int
    env_steps: int
    updates: int
    files: dict[str, Entry]


class State(NamedTuple):
    """What a run needs to go on, beside its parameters.

    Attributes:
        trees: {name: tree of arrays}.
        arrays: {name: array}.
        numbers: JSON values; go into run.json.
        unchanged: names of arrays that are what they were when the run's last checkpoint was written.
    """

    trees: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]
    numbers: Mapping[str, Any]
    unchanged: frozenset[str] = frozenset()


def save(
    run: str | Path,
    params: Any,
    config: Config,
    *,
    frame_shape: tuple[int, int, int],
    num_actions: int,
    env_steps: int,
    updates: int,
    state: State | None = None,
    base: Manifest | None = None,
    keep: int = 2,
    folder: str = "checkpoints",
) -> Manifest:
    """Writes `run/checkpoints/ENV_STEPS` and removes those before it, but for the newest.

    One of the same step is replaced. A save that fails leaves the others as they are. Newer ones stay, too: a
    run leaves them behind where they are damaged.

    Args:
        run: the run directory.
        params: {"encoder": tree, OBJECTIVE: tree}.
        config, frame_shape, num_actions, env_steps, updates: see `Manifest`.
        state: what else is needed to go on; None where nobody will.
        base: the run's last checkpoint, whose files stand in for `state.unchanged`.
        keep: how many checkpoints stay, up to this one; 0 for all.
        folder: the name of the directory that holds them.

    Returns:
        The checkpoint's manifest.

    Raises:
        SaveError: it could not be written.
    """
    home = Path(run) / folder
    final = home / f"{env_steps:09d}"
    temporary = home / f".{final.name}.partial"
    try:
        home.mkdir(parents=True, exist_ok=True)
        for left in home.glob(".*.partial"):  # by a process that was killed
            shutil.rmtree(left)
        temporary.mkdir()
        files = _write_files(temporary, params, state, base)
        manifest = Manifest(final, config, frame_shape, num_actions, env_steps, updates, files)
        sign(temporary, _about(manifest))
        _put_in_place(temporary, final)
        up_to_this = [p for p in _all(home) if int(p.name) <= env_steps]
        for old in up_to_this[:-keep] if keep else ():
            aside = home / f".{old.name}.old.partial"
            os.replace(old, aside)  # so that nobody takes one that is half removed for a checkpoint
            shutil.rmtree(aside)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise SaveError(f"{final}: not written: {error.strerror or error}") from error
    return manifest


def _about(manifest: Manifest) -> dict[str, Any]:
    """The content of manifest.json."""
    about = {"format": FORMAT, **manifest._asdict()}
    del about["path"]
    files = {name: entry._asdict() for name, entry in manifest.files.items()}
    return about | {"config": json.loads(manifest.config.to_json()), "files": files}


def _write_files(folder: Path, params: Any, state: State | None, base: Manifest | None) -> dict[str, Entry]:
    from flax import serialization

    files = {}
    for name, tree in {"params": params, **(state.trees if state else {})}.items():
        data = serialization.msgpack_serialize(serialization.to_state_dict(tree))
        files[f"{name}.msgpack"] = write(folder / f"{name}.msgpack", data)
    if state is None:
        return files
    for name, array in state.arrays.items():
        file = f"{name}.npy"
        if name in state.unchanged and base is not None and _link(base, file, folder):
            files[file] = base.files[file]
        else:
            array, header = np.asarray(array, order="C"), io.BytesIO()
            about = np.lib.format.header_data_from_array_1_0(array)
            np.lib.format.write_array_header_1_0(header, about)
            files[file] = write(folder / file, header.getvalue(), array.data)
    text = json.dumps(dict(state.numbers), allow_nan=False, indent=1)
    files[NUMBERS] = write(folder / NUMBERS, text.encode())
    return files


def _link(base: Manifest, file: str, folder: Path) -> bool:
    """Whether the base's file could be linked; where it could not, it has to be written."""
    if file not in base.files:
        return False
    try:
        os.link(base.path / file, folder / file)
    except OSError:  # a file system without hard links, or somebody has removed the base
        return False
    return True


def _put_in_place(temporary: Path, final: Path) -> None:
    """Renames; of two checkpoints of one step the older one goes only when the newer one is there."""
    aside = final.parent / f".{final.name}.old.partial"
    _flush(temporary)
    if final.exists():
        os.replace(final, aside)
    try:
        os.replace(temporary, final)
    except OSError:
        if aside.exists():
            os.replace(aside, final)
        raise
    _flush(final.parent)
    shutil.rmtree(aside, ignore_errors=True)


def slim(manifest: Manifest) -> Manifest:
    """Rewrites a checkpoint from which nobody will resume: what `State` brought in is removed.

    Raises:
        SaveError: it could not be written; the checkpoint is whole, as it was or slim.
    """
    folder = manifest.path.parent
    about = manifest._asdict()
    del about["path"], about["files"]
    return save(folder.parent, load(manifest), **about, keep=0, folder=folder.name)


def sign(folder: Path, about: Mapping[str, Any]) -> None:
    """Writes a manifest and its sum."""
    data = json.dumps(dict(about), indent=1).encode()
    write(folder / MANIFEST, data)
    write(folder / CHECKSUM, _sum_line(data))


def _sum_line(data: bytes) -> bytes:
    return f"{hashlib.sha256(data).hexdigest()}  {MANIFEST}\n".encode()


def write(path: Path, *pieces: bytes | memoryview) -> Entry:
    """Writes a file from pieces, whose memory is contiguous, and flushes it to disk."""
    digest = hashlib.sha256()
    with open(path, "wb") as file:
        for piece in pieces:
            file.write(piece)
            digest.update(piece)
        file.flush()
        os.fsync(file.fileno())
    return Entry(sum(memoryview(piece).nbytes for piece in pieces), digest.hexdigest())


# Reading


def read_manifest(path: str | Path) -> Manifest:
    """The manifest of a checkpoint, or of a run's newest one.

    Args:
        path: a run directory, its `checkpoints`, or one checkpoint.

    Raises:
        ConfigError: there is none, or it is damaged; one line.
    """
    path = given = Path(path)
    for folder in (path / "checkpoints", path):
        if not os.path.lexists(path / MANIFEST) and (found := _all(folder)):
            path = found[-1]
    if path == given and not any(os.path.lexists(path / name) for name in (MANIFEST, CHECKSUM)):
        seeds = sorted(path.glob("seed*/checkpoints")) if os.path.isdir(path) else []
        run = f"one of the runs in it, as {seeds[0].parent}," if seeds else "a run directory"
        raise ConfigError(f"{path}: no checkpoint there; name {run} or one of its checkpoints")
    data = _read(path / MANIFEST)
    if _read(path / CHECKSUM) != _sum_line(data):
        raise ConfigError(f"{path / MANIFEST}: damaged: its sha256 is not the one in {CHECKSUM}")
    about = json.loads(data)
    if about["format"] != FORMAT:
        raise ConfigError(f"{path}: checkpoint of format {about['format']}, not {FORMAT}")
    try:
        config = Config.from_values(about["config"])
    except ConfigError as error:  # of another version
        raise ConfigError(f"{path / MANIFEST}: {error}") from None
    counts = {name: about[name] for name in ("num_actions", "env_steps", "updates")}
    height, width, channels = about["frame_shape"]
    files = {name: Entry(entry["bytes"], entry["sha256"]) for name, entry in about["files"].items()}
    return Manifest(path, config, (height, width, channels), files=files, **counts)


def verify(manifest: Manifest) -> None:
    """Reads every file and compares its sum.

    Raises:
        ConfigError: one is missing or damaged; names it.
    """
    for name in manifest.files:
        _checked(manifest, name)


def newest_good(run: str | Path, say: Callable[[str], None], at_most: int | None = None) -> Manifest | None:
    """The manifest of a run's newest checkpoint that is whole and can be gone on from.

    Args:
        run: the run directory.
        say: gets a line for each newer one that is damaged.
        at_most: env steps; newer checkpoints do not count.

    Returns:
        None where there is no checkpoint at all.

    Raises:
        ConfigError: there are some, and none is whole.
    """
    problem = None
    folders = _all(Path(run) / "checkpoints")
    for path in reversed([f for f in folders if at_most is None or int(f.name) <= at_most]):
        if problem:
            say(f"{problem}; going on from the one before, {path.name}")
        try:
            manifest = read_manifest(path)
            verify(manifest)
            if problem and NUMBERS not in manifest.files:
                raise ConfigError(f"{problem}; the run had ended, and {path.name} cannot be gone on from")
            return manifest
        except ConfigError as error:
            problem = error
    if problem:
        raise ConfigError(f"{problem}; there is no other checkpoint, and --overwrite would start anew")
    return None


def load(manifest: Manifest) -> Any:
    """The parameters, {"encoder": tree, OBJECTIVE: tree}, of numpy arrays; raises as `load_tree`."""
    return load_tree(manifest, "params")


def load_tree(manifest: Manifest, name: str) -> dict[str, Any]:
    """One of a checkpoint's trees, nested dicts of numpy arrays.

    Raises:
        ConfigError: the file is missing or damaged.
    """
    from flax import serialization

    return serialization.msgpack_restore(_checked(manifest, f"{name}.msgpack"))


def load_array(manifest: Manifest, name: str) -> np.ndarray:
    """One of the arrays of a checkpoint that `verify` has found whole: sums are not compared again.

    Raises:
        ConfigError: the file is missing.
    """
    path, _ = _entry(manifest, f"{name}.npy")
    try:
        return np.load(path, allow_pickle=False)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def load_numbers(manifest: Manifest) -> dict[str, Any]:
    """What run.json holds; raises as `load_tree`."""
    return json.loads(_checked(manifest, NUMBERS))


class Arrays(Mapping):
    """A checkpoint's arrays whose names begin with a prefix, without it; read anew whenever one is asked for.

    Args:
        manifest: the checkpoint's.
        prefix: what the names begin with.
    """

    def __init__(self, manifest: Manifest, prefix: str):
        self._manifest, self._prefix = manifest, prefix
        names = (Path(file).stem for file in manifest.files if file.endswith(".npy"))
        self._names = {name.removeprefix(prefix): name for name in names if name.startswith(prefix)}

    def __getitem__(self, name: str) -> np.ndarray:
        return load_array(self._manifest, self._prefix + name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _entry(manifest: Manifest, file: str) -> tuple[Path, Entry]:
    if file not in manifest.files:
        raise ConfigError(f"{manifest.path}: no {file} in this checkpoint; only a run's own can be resumed")
    return manifest.path / file, manifest.files[file]


def _checked(manifest: Manifest, file: str) -> bytes:
    """A file's content, if it has the sum that the manifest says."""
    path, entry = _entry(manifest, file)
    data = _read(path)
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise ConfigError(f"{path}: damaged: its sha256 is not the manifest's")
    return data


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def load_into(template: Any, tree: Any, what: str) -> Any:
    """Parameters read from disk in the form of a template's, checked leaf by leaf.

    Args:
        template: parameters, or their shapes, as the running code makes them.
        tree: from `load` or `load_tree`.
        what: what they are, for the error.

    Raises:
        ConfigError: names or shapes differ.
    """
    import jax
    from flax import serialization

    expected, found = _flat(serialization.to_state_dict(template)), _flat(tree)
    if odd := sorted(expected.keys() ^ found.keys()):
        raise ConfigError(f"{what}: parameters do not fit: {odd[0]} is on one side only")
    for name, x in expected.items():
        here, there = (tuple(getattr(leaf, a, None) for a in ("dtype", "shape")) for leaf in (x, found[name]))
        if here != there:
            raise ConfigError(f"{what}: parameter {name} is {there[0]} {there[1]}, not {here[0]} {here[1]}")
    restored = serialization.from_state_dict(template, tree)
    return jax.tree.unflatten(jax.tree.structure(template), jax.tree.leaves(restored))


def _flat(tree: dict[str, Any]) -> dict[str, Any]:
    """{path: leaf} of nested dicts, as encoder/Conv_0/kernel; an empty dict is a leaf, too."""
    from flax import traverse_util

    return traverse_util.flatten_dict(tree, keep_empty_nodes=True, sep="/")


def check_frames(manifest: Manifest, frame_shape: tuple, what: str, game: str) -> None:
    """Whether a checkpoint's encoder has seen frames of the shape (H, W, C) that a game shows.

    Args:
        manifest: of the checkpoint.
        frame_shape: of the game's frames.
        what, game: names of both, for the error.

    Raises:
        ConfigError: it has not; convolutions would take other frames without complaint.
    """
    if manifest.frame_shape != frame_shape:
        seen, shown = list(manifest.frame_shape), list(frame_shape)
        raise ConfigError(f"{what}: its encoder sees frames of {seen}, {game} shows {shown}")


def _all(folder: Path) -> list[Path]:
    """The checkpoints of a folder, oldest first; whether they are whole, their manifests tell."""
    if not os.path.isdir(folder):
        return []
    found = [p for p in folder.glob("[0-9]*") if p.name.isdecimal() and p.is_dir()]
    return sorted(found, key=lambda p: int(p.name))  # names have 9 digits, but more from a billion steps on


def _flush(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
