"""Checkpoints of a run: data on disk, checked before any of it is used.

A checkpoint is a directory, `checkpoints/ENV_STEPS` of a run:

    manifest.json     configuration, counts, and of every other file: bytes, sha256, and dtype and shape
    manifest.sha256   the manifest's own, as sha256sum writes and checks it
    params.msgpack    {"encoder": tree, OBJECTIVE: tree}
    NAME.msgpack, NAME.npy, run.json: what else a run needs to go on, see `srl_jax.snapshot`

It is written to a temporary directory, each file flushed to disk, the manifest last, and renamed. Large
arrays come in chunks; one that has not changed since the checkpoint before is a hard link to its. Reading
executes nothing: msgpack, JSON and npy are data; an npy header is not parsed but compared with what it must
be. The module imports no jax until parameters are read or written.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.reading import parse_json
from srl_jax.specs import LIMITS

MANIFEST, CHECKSUM, PARAMS, NUMBERS = "manifest.json", "manifest.sha256", "params.msgpack", "run.json"
FORMAT = 4
LARGEST_SIDE = 1 << 12  # of a frame, in pixels
_NAME = re.compile(r"[a-z0-9_]+\.(msgpack|npy|json)")
_DTYPES = frozenset(np.dtype(code).str for code in "?bhiqBHIQefd")  # of numbers, as numpy writes them
_PIECE = 1 << 24  # bytes that are written, or read to be summed, at a time


class Entry(NamedTuple):
    """What a manifest says of a file.

    Attributes:
        bytes, sha256: of the file.
        dtype, shape: of an array, as numpy writes them; None of another file.
    """

    bytes: int
    sha256: str
    dtype: str | None = None
    shape: tuple[int, ...] | None = None


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
        about = {"format": FORMAT, "frame_shape": list(frame_shape), "num_actions": num_actions}
        about |= {"env_steps": env_steps, "updates": updates}
        about["files"] = {name: _about(entry) for name, entry in files.items()}
        about["config"] = json.loads(config.to_json())
        sign(temporary, about)
        _put_in_place(temporary, final)
        up_to_this = [p for p in _all(home) if int(p.name) <= env_steps]
        for old in up_to_this[:-keep] if keep else ():
            aside = home / f".{old.name}.old.partial"
            os.replace(old, aside)  # so that nobody takes one that is half removed for a checkpoint
            shutil.rmtree(aside)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise SaveError(f"{final}: not written: {error.strerror or error}") from error
    return Manifest(final, config, tuple(frame_shape), num_actions, env_steps, updates, files)


def _write_files(folder: Path, params: Any, state: State | None, base: Manifest | None) -> dict[str, Entry]:
    from flax import serialization

    def packed(tree: Any) -> bytes:
        return serialization.msgpack_serialize(_map(np.asarray, serialization.to_state_dict(tree)))

    files = {PARAMS: write(folder / PARAMS, [packed(params)])}
    if state is None:
        return files
    for name, tree in state.trees.items():
        file = f"{name}.msgpack"
        files[file] = write(folder / file, [packed(tree)])
    for name, array in state.arrays.items():
        file = f"{name}.npy"
        linked = name in state.unchanged and base is not None and _link(base, file, folder)
        files[file] = base.files[file] if linked else write_array(folder / file, array)
    text = json.dumps(dict(state.numbers), allow_nan=False, indent=1)
    files[NUMBERS] = write(folder / NUMBERS, [text.encode()])
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
    """Rewrites a checkpoint from which nobody will go on: what `State` brought in is removed.

    Raises:
        SaveError: it could not be written; the checkpoint is whole, as it was or slim.
    """
    final = manifest.path
    temporary = final.parent / f".{final.name}.partial"
    files = {PARAMS: manifest.files[PARAMS]}
    try:
        temporary.mkdir()
        if not _link(manifest, PARAMS, temporary):
            shutil.copyfile(final / PARAMS, temporary / PARAMS)
        about = json.loads((final / MANIFEST).read_text(encoding="utf-8"))
        sign(temporary, about | {"files": {PARAMS: _about(files[PARAMS])}})
        _put_in_place(temporary, final)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise SaveError(f"{final}: not rewritten: {error.strerror or error}") from error
    return manifest._replace(files=files)


def sign(folder: Path, about: Mapping[str, Any]) -> None:
    """Writes a manifest and its sum."""
    text = json.dumps(dict(about), indent=1).encode()
    entry = write(folder / MANIFEST, [text])
    write(folder / CHECKSUM, [f"{entry.sha256}  {MANIFEST}\n".encode()])


def write(path: Path, pieces: list) -> Entry:
    """Writes a file from pieces, bytes or contiguous arrays, and flushes it to disk."""
    digest, size = hashlib.sha256(), 0
    with open(path, "wb") as file:
        for piece in pieces:
            view = memoryview(piece).cast("B")
            for start in range(0, len(view), _PIECE):
                part = view[start : start + _PIECE]
                file.write(part)
                digest.update(part)
                size += len(part)
        file.flush()
        os.fsync(file.fileno())
    return Entry(size, digest.hexdigest())


def write_array(path: Path, array: np.ndarray) -> Entry:
    """Writes an npy file, flushed to disk."""
    array = np.asarray(array, order="C")
    pieces = [_header(array.dtype, array.shape)] + ([array.reshape(-1)] if array.size else [])
    return write(path, pieces)._replace(dtype=array.dtype.str, shape=array.shape)


def _header(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    """The first bytes of an npy file of such an array, as numpy writes them."""
    buffer = io.BytesIO()
    about = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": tuple(shape)}
    np.lib.format.write_array_header_1_0(buffer, about)
    return buffer.getvalue()


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
        if not _there(path / MANIFEST) and _there(folder) and _all(folder):
            path = _all(folder)[-1]
    if path == given and not any(_there(path / name) for name in (MANIFEST, CHECKSUM)):
        raise ConfigError(f"{path}: no checkpoint there; name a run directory or one of its checkpoints")
    data = _bytes(path / MANIFEST)
    written = _bytes(path / CHECKSUM)
    if written != f"{hashlib.sha256(data).hexdigest()}  {MANIFEST}\n".encode():
        raise ConfigError(f"{path / MANIFEST}: damaged: its sha256 is not the one in {CHECKSUM}")
    try:
        content = parse_json(data)
        if type(content["format"]) is not int or content["format"] != FORMAT:
            raise ConfigError(f"{path}: checkpoint of format {content['format']}, not {FORMAT}")
        numbers = [content[name] for name in ("num_actions", "env_steps", "updates")]
        if not all(type(number) is int and 0 <= number <= LIMITS[int] for number in numbers):
            raise ValueError("counts are not whole numbers")
        shape = tuple(content["frame_shape"])
        if len(shape) != 3 or not all(type(side) is int and 1 <= side <= LARGEST_SIDE for side in shape):
            raise ValueError("frame_shape is not height, width and channels")
        files = {name: _entry(name, about) for name, about in content["files"].items()}
        if PARAMS not in files:
            raise ValueError(f"no {PARAMS}")
        config = json.dumps(content["config"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path / MANIFEST}: damaged ({_line(error)})") from None
    try:
        return Manifest(path, Config.from_json(config), shape, *numbers, files)
    except (ConfigError, OverflowError) as error:
        raise ConfigError(f"{path / MANIFEST}: {error}") from None


def _entry(name: str, about: Any) -> Entry:
    """One file's entry, checked. A name is a plain one: no entry leads out of the directory."""
    if not _NAME.fullmatch(name) or name in (MANIFEST, CHECKSUM):
        raise ValueError(f"no checkpoint has a file {name!r}")
    entry = Entry(**{field: about[field] for field in Entry._fields if field in about})
    if type(entry.bytes) is not int or type(entry.sha256) is not str:
        raise ValueError(f"{name}: size and sha256 are not what they should be")
    if not name.endswith(".npy"):
        return entry
    if type(entry.dtype) is not str or type(entry.shape) is not list:
        raise ValueError(f"{name}: no dtype and shape")
    return entry._replace(shape=tuple(entry.shape))


def verify(manifest: Manifest) -> None:
    """Reads every file and compares its size and sum.

    Raises:
        ConfigError: one is missing or damaged; names it.
    """
    for name, entry in manifest.files.items():
        _check(manifest.path / name, entry)


def _check(path: Path, entry: Entry) -> None:
    digest, size = hashlib.sha256(), 0
    with _opened(path) as file:
        if os.fstat(file.fileno()).st_size == entry.bytes:
            while piece := file.read(_PIECE):
                digest.update(piece)
                size += len(piece)
    if size != entry.bytes or digest.hexdigest() != entry.sha256:
        raise ConfigError(f"{path}: damaged: its size or sha256 is not the manifest's")


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
    """The parameters, {"encoder": tree, OBJECTIVE: tree}, of numpy arrays.

    Raises:
        ConfigError: the file is missing or is not what the manifest says.
    """
    tree = load_tree(manifest, "params")
    if "encoder" not in tree:
        raise ConfigError(f"{manifest.path / PARAMS}: not parameters: no encoder")
    return tree


def load_tree(manifest: Manifest, name: str) -> dict[str, Any]:
    """One of a checkpoint's trees, nested dicts of numpy arrays.

    Raises:
        ConfigError: the file is missing, or damaged, or not a tree.
    """
    from flax import serialization

    path, data = _checked(manifest, f"{name}.msgpack")
    try:
        tree = serialization.msgpack_restore(data)
        if type(tree) is not dict:
            raise ValueError("not a tree")
        _check_tree(tree)
    except Exception as error:  # msgpack's and flax's own; the sum fits, so somebody wrote it so
        raise ConfigError(f"{path}: not a tree of arrays ({type(error).__name__}: {_line(error)})") from None
    return tree


def load_array(manifest: Manifest, name: str, into: np.ndarray | None = None) -> np.ndarray:
    """One of a checkpoint's arrays.

    Args:
        manifest: the checkpoint's, which `verify` has found whole.
        name: the array's.
        into: a contiguous array to read into; the one on disk must have its dtype and shape.

    Raises:
        ConfigError: the file is missing or not such an array.
    """
    file = f"{name}.npy"
    path, entry = manifest.path / file, manifest.files.get(file)
    if entry is None:
        raise ConfigError(f"{manifest.path}: no {file} in this checkpoint")
    try:
        if entry.dtype not in _DTYPES or not all(type(n) is int and n >= 0 for n in entry.shape):
            raise ValueError(f"dtype {entry.dtype} and shape {entry.shape} are not an array's")
        dtype = np.dtype(entry.dtype)
        if into is not None and (into.dtype != dtype or into.shape != entry.shape):
            raise ValueError(f"{dtype} {entry.shape}, not {into.dtype} {into.shape}")
        header = _header(dtype, entry.shape)
        if entry.bytes != len(header) + dtype.itemsize * int(np.prod(entry.shape, dtype=object)):
            raise ValueError("its size does not fit its shape")
        with _opened(path) as file:
            if file.read(len(header)) != header:
                raise ValueError("its header is not that of the manifest's dtype and shape")
            array = np.empty(entry.shape, dtype) if into is None else into
            if array.size and file.readinto(memoryview(array).cast("B")) != array.nbytes:
                raise ValueError("cut short")
    except (ValueError, TypeError, MemoryError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: damaged: {_line(error)}") from None
    return array


class Arrays(Mapping):
    """A checkpoint's arrays whose names begin with a prefix, without it; read anew whenever one is asked for.

    Args:
        manifest: the checkpoint's, which `verify` has found whole.
        prefix: what the names begin with.
    """

    def __init__(self, manifest: Manifest, prefix: str):
        self._manifest, self._prefix = manifest, prefix

    def __getitem__(self, name: str) -> np.ndarray:
        return load_array(self._manifest, self._prefix + name)

    def __iter__(self) -> Iterator[str]:
        start = len(self._prefix)
        return (
            n[start:-4] for n in self._manifest.files if n.startswith(self._prefix) and n.endswith(".npy")
        )

    def __contains__(self, name: object) -> bool:
        return f"{self._prefix}{name}.npy" in self._manifest.files

    def __len__(self) -> int:
        return len(list(self))


def load_numbers(manifest: Manifest) -> dict[str, Any]:
    """What run.json holds.

    Raises:
        ConfigError: it is missing, damaged, or not JSON.
    """
    path, data = _checked(manifest, NUMBERS)
    try:
        numbers = json.loads(data, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: damaged ({_line(error)})") from None
    if type(numbers) is not dict:
        raise ConfigError(f"{path}: damaged (not a JSON object)")
    return numbers


def _checked(manifest: Manifest, file: str) -> tuple[Path, bytes]:
    path, entry = manifest.path / file, manifest.files.get(file)
    if entry is None:
        raise ConfigError(f"{manifest.path}: no {file} in this checkpoint; only a run's own can be resumed")
    data = _bytes(path, entry.bytes)
    if len(data) != entry.bytes or hashlib.sha256(data).hexdigest() != entry.sha256:
        raise ConfigError(f"{path}: damaged: its size or sha256 is not the manifest's")
    return path, data


def _bytes(path: Path, size: int = 1 << 24) -> bytes:
    """A file's content; of one that is larger than `size`, a byte more than that."""
    with _opened(path) as file:
        return file.read(min(size, os.fstat(file.fileno()).st_size) + 1)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """The file, for reading bytes, if it is a plain one: not a link, a pipe or a device.

    Raises:
        ConfigError: it is not, or cannot be opened, or read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise ConfigError(f"{path}: not a plain file")
        with open(descriptor, "rb", buffering=0) as file:
            yield file
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def _there(path: Path) -> bool:
    """Whether there is something, without errors about names that no file can have."""
    try:
        return os.path.lexists(path)
    except ValueError:
        return False


def _finite(text: str) -> float:
    """A number of a JSON text.

    Raises:
        ValueError: it is none that JSON has, or too large for a float.
    """
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is not a finite number")
    return number


def _line(error: Exception) -> str:
    """The first line of an error, not too long."""
    return str(error).split("\n")[0][:200]


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

    expected = _flat(serialization.to_state_dict(template))
    found = _flat(tree)
    if set(expected) != set(found):
        odd = sorted(set(expected) ^ set(found))[0]
        raise ConfigError(f"{what}: parameters do not fit: {odd} is on one side only")
    for name, x in expected.items():
        (dtype, shape), (right_dtype, right_shape) = _form(found[name]), _form(x)
        if (dtype, shape) != (right_dtype, right_shape):
            raise ConfigError(f"{what}: parameter {name} is {dtype} {shape}, not {right_dtype} {right_shape}")
    restored = serialization.from_state_dict(template, tree)
    return jax.tree.unflatten(jax.tree.structure(template), jax.tree.leaves(restored))


def is_part(template: Any, tree: Any) -> bool:
    """Whether a tree from `load` holds a part of a template's parameters, and nothing else."""
    from flax import serialization

    whole, found = (
        {name for name, x in _flat(branch).items() if not isinstance(x, dict)}
        for branch in (serialization.to_state_dict(template), tree)
    )
    return found < whole


def _flat(tree: Any, path: str = "") -> dict[str, Any]:
    """{path: leaf} of nested dicts, as ['encoder']['kernel']; an empty dict is a leaf."""
    if not isinstance(tree, dict) or not tree:
        return {path: tree}
    leaves = {}
    for name, branch in tree.items():
        leaves |= _flat(branch, f"{path}[{name!r}]")
    return leaves


def _form(leaf: Any) -> tuple:
    """Dtype and shape; of what is no array its type, and None."""
    return (leaf.dtype, leaf.shape) if hasattr(leaf, "shape") else (type(leaf).__name__, None)


def check_sources(config: Config) -> None:
    """Whether the checkpoints that a run wants to start from exist and fit it; reads manifests alone.

    Raises:
        ConfigError: one line that names the flag and what differs.
    """
    if config.encoder_from:
        found = _source("encoder_from", config.encoder_from).config
        _same("encoder_from", config, found, "encoder", "the architecture")
        _same("encoder_from", config, found, "frame_size", "the preprocessing")
        _same("encoder_from", config, found, "frame_stack", "the preprocessing")
    if config.policy_from:
        found = _source("policy_from", config.policy_from).config
        if found.mode == "pretrain":
            raise ConfigError(
                f"--policy_from={config.policy_from}: a representation run has no policy; "
                "name a run of another mode"
            )
        _same("policy_from", config, found, "game", "the game")
        _same("policy_from", config, found, "frame_size", "the preprocessing")
        _same("policy_from", config, found, "frame_stack", "the preprocessing")


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


def _source(flag: str, path: str) -> Manifest:
    try:
        return read_manifest(path)
    except ConfigError as error:
        raise ConfigError(f"--{flag}={path}: {error}") from None


def _same(flag: str, config: Config, found: Config, field: str, what: str) -> None:
    ours, theirs = getattr(config, field), getattr(found, field)
    if ours != theirs:
        raise ConfigError(
            f"--{flag}={getattr(config, flag)}: {what} differs: {field} is {theirs} there and {ours} here"
        )


def _all(folder: Path) -> list[Path]:
    """The checkpoints of a folder, oldest first; whether they are whole, their manifests tell."""
    found = [p for p in folder.glob("[0-9]*") if re.fullmatch("[0-9]+", p.name) and p.is_dir()]
    return sorted(found, key=lambda p: int(p.name))  # names have 9 digits, but more from a billion steps on


def _about(entry: Entry) -> dict[str, Any]:
    """An entry as JSON holds it."""
    return {field: value for field, value in entry._asdict().items() if value is not None}


def _check_tree(tree: dict) -> None:
    """Raises an error unless a tree holds named arrays and nothing else."""
    for name, branch in tree.items():
        if type(name) is not str:
            raise ValueError(f"{name!r} is not a name")
        if isinstance(branch, dict):
            _check_tree(branch)
        elif not isinstance(branch, np.ndarray):
            raise ValueError(f"{name} is not an array")


def _map(function, tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _map(function, branch) for name, branch in tree.items()}
    return function(tree)


def _flush(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
