"""Checkpoints of an agent, and starting from one: msgpack parameters beside a manifest with sha256.

A checkpoint is a directory, `checkpoints/ENV_STEPS` of a run. It is written to a temporary one, flushed,
and renamed. Reading one executes nothing: msgpack and JSON are data, and both are checked against the
manifest before any array reaches jax. The module imports no jax until parameters are read or written.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax.config import Config
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.specs import LIMITS, ConfigError

_MANIFEST, _PARAMS, _FORMAT = "manifest.json", "params.msgpack", 1


class Manifest(NamedTuple):
    """What a checkpoint says of itself.

    Attributes:
        path: its directory.
        config: of the run that wrote it, resolved.
        num_actions: of that run's game.
        env_steps, updates: when it was written.
        files: {name: {"bytes", "sha256"}}.
    """

    path: Path
    config: Config
    num_actions: int
    env_steps: int
    updates: int
    files: dict[str, dict]


def save(
    run: str | Path,
    params: Any,
    config: Config,
    *,
    num_actions: int,
    env_steps: int,
    updates: int,
    keep: int = 2,
) -> Path:
    """Writes `run/checkpoints/ENV_STEPS` and removes all but the newest `keep`.

    Args:
        run: the run directory.
        params: {"encoder": tree, "heads": {name: tree}}.
        config, num_actions, env_steps, updates: see `Manifest`.
        keep: how many checkpoints stay.

    Returns:
        The checkpoint's directory.
    """
    from flax import serialization

    folder = Path(run) / "checkpoints"
    final = folder / f"{env_steps:09d}"
    temporary = folder / f".{final.name}.partial"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    arrays = serialization.to_state_dict(params)
    data = serialization.msgpack_serialize(_map(np.asarray, arrays))
    manifest = {
        "format": _FORMAT,
        "num_actions": num_actions,
        "env_steps": env_steps,
        "updates": updates,
        "files": {_PARAMS: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}},
        "config": json.loads(config.to_json()),
    }
    _write(temporary / _PARAMS, data)
    _write(temporary / _MANIFEST, json.dumps(manifest, indent=2).encode())
    if final.exists():
        shutil.rmtree(final)
    os.replace(temporary, final)
    _flush(folder)
    for old in _all(folder)[:-keep]:
        shutil.rmtree(old)
    return final


def read_manifest(path: str | Path) -> Manifest:
    """The manifest of a checkpoint, or of a run's newest one.

    Args:
        path: a run directory, its `checkpoints`, or one checkpoint.

    Raises:
        ConfigError: there is none, or it is damaged; one line.
    """
    path = Path(path)
    try:
        for folder in (path / "checkpoints", path):
            if not (path / _MANIFEST).exists() and folder.is_dir() and _all(folder):
                path = _all(folder)[-1]
        content = parse_json(read_bytes(path / _MANIFEST, SETTINGS))
        if type(content["format"]) is not int or content["format"] != _FORMAT:
            raise ConfigError(f"{path}: checkpoint of format {content['format']}, not {_FORMAT}")
        numbers = [content[name] for name in ("num_actions", "env_steps", "updates")]
        if not all(type(number) is int and 0 <= number <= LIMITS[int] for number in numbers):
            raise ValueError("counts are not whole numbers, at least 0")
        files = content["files"]
        entry = files[_PARAMS] if list(files) == [_PARAMS] else {"sha256": None, "bytes": None}
        if type(entry["sha256"]) is not str or type(entry["bytes"]) is not int:
            raise ValueError("files are not what they should be")
        config = json.dumps(content["config"])
    except OSError as error:
        raise ConfigError(
            f"{path}: no checkpoint there; name a run directory or one of its checkpoints ({error.strerror})"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path / _MANIFEST}: damaged ({error})") from None
    try:
        return Manifest(path, Config.from_json(config), *numbers, files)
    except ConfigError as error:
        raise ConfigError(f"{path / _MANIFEST}: {error}") from None


def load(manifest: Manifest) -> Any:
    """The parameters, {"encoder": tree, "heads": {name: tree}}, of numpy arrays.

    Raises:
        ConfigError: the file is missing or is not what the manifest says.
    """
    from flax import serialization

    path = manifest.path / _PARAMS
    try:
        data = read_bytes(path, manifest.files[_PARAMS]["bytes"])
    except OSError as error:
        raise ConfigError(f"{path}: damaged: {error.strerror}") from None
    if len(data) != manifest.files[_PARAMS]["bytes"]:
        raise ConfigError(f"{path}: damaged: its size is not the manifest's")
    if hashlib.sha256(data).hexdigest() != manifest.files[_PARAMS]["sha256"]:
        raise ConfigError(f"{path}: damaged: its sha256 is not the manifest's")
    try:
        tree = serialization.msgpack_restore(data)
        if set(tree) != {"encoder", "heads"}:
            raise ValueError("not an encoder and heads")
        _check(tree)
    except Exception as error:  # msgpack's and flax's own; the sum fits, so somebody wrote it so
        raise ConfigError(f"{path}: not parameters ({type(error).__name__}: {error})") from None
    return tree


def load_into(template: Any, tree: Any, what: str) -> Any:
    """Parameters read from disk in the form of a template's, checked leaf by leaf.

    Args:
        template: parameters, or their shapes, as the running code makes them.
        tree: from `load`.
        what: what they are, for the error.

    Raises:
        ConfigError: names or shapes differ.
    """
    import jax

    expected = {jax.tree_util.keystr(k): x for k, x in jax.tree_util.tree_leaves_with_path(template)}
    found = {jax.tree_util.keystr(k): x for k, x in jax.tree_util.tree_leaves_with_path(tree)}
    if set(expected) != set(found):
        odd = sorted(set(expected) ^ set(found))[0]
        raise ConfigError(f"{what}: parameters do not fit: {odd} is on one side only")
    for name, x in expected.items():
        if x.shape != found[name].shape or x.dtype != found[name].dtype:
            raise ConfigError(
                f"{what}: parameter {name} is {found[name].dtype} {found[name].shape}, "
                f"not {x.dtype} {x.shape}"
            )
    leaves = [found[jax.tree_util.keystr(k)] for k, _ in jax.tree_util.tree_leaves_with_path(template)]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


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
    """The finished checkpoints of a folder, oldest first."""
    return sorted(p for p in folder.glob("[0-9]*") if p.is_dir() and (p / _MANIFEST).is_file())


def _check(tree: dict) -> None:
    """Raises an error unless a tree holds named arrays and nothing else."""
    for name, branch in tree.items():
        if type(name) is not str:
            raise ValueError(f"{name!r} is not a name")
        if isinstance(branch, dict):
            _check(branch)
        elif not isinstance(branch, np.ndarray):
            raise ValueError(f"{name} is not an array")


def _map(function, tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _map(function, branch) for name, branch in tree.items()}
    return function(tree)


def _write(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _flush(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
