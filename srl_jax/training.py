"""Training as one call, and the checks that come before. Imports no jax until they need it."""

import dataclasses
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srl_jax import checks, envs, plugins, specs
from srl_jax.config import Config, resolve
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.rundir import run_directory
from srl_jax.needs import EVERYTHING

if TYPE_CHECKING:
    from srl_jax.run.loop import Result
    from srl_jax.types import Objective


def train(config: Config, out: str | os.PathLike[str], *, progress: bool = True) -> "Result":
    """Trains one agent and writes its run directory, as `srl-jax train` does but for the figures.

    `srl-jax resume` resumes it, `srl-jax draw` draws its figures, `srl_jax.load` loads it. Ctrl-C
    ends it and leaves the last checkpoint. The command also sets what jax runs well with on a CPU before jax
    is imported; here the environment is as the caller has it.

    Args:
        config: see its fields; what it leaves to defaults is written out in config.json.
        out: the run directory, new or empty.
        progress: whether to draw a progress bar on stderr.

    Returns:
        How the run ended; what came of it is in `out`.

    Raises:
        ConfigError: the configuration cannot be run, or the directory is not empty; nothing was written.
        TypeError: the configuration is no Config.
        SaveError, Diverged: see `srl_jax.run.loop.train_seeds`.
    """
    if not isinstance(config, Config):
        raise TypeError(f"config must be a srl_jax.Config, not {type(config).__name__}")
    path = Path(out)
    try:
        taken = path.exists() and (not path.is_dir() or any(path.iterdir()))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    if taken:
        raise ConfigError(f"{path}: not an empty directory; name a new one (srl-jax resume resumes a run)")
    config = checks.check(config)
    check_game(config)
    full = resolved(config, EVERYTHING)
    check_sources(full)

    from srl_jax.run import loop

    with run_directory(path, full) as begun:
        return loop.train(full, path, progress=progress, begun=begun)


def check_game(config: Config, imported: bool = False) -> None:
    """Whether the game's environments can be made here; one of a plug-in is known once that is `imported`.

    Raises:
        ConfigError: they cannot; the line says why.
    """
    try:
        game = envs.game(config.game)
    except ConfigError:
        if imported or not config.imports:
            raise
        return
    try:
        game.check()
    except ConfigError as error:
        raise ConfigError(f"--game={config.game}: {error}") from None


def resolved(config: Config, given: Collection[str] = ()) -> Config:
    """`srl_jax.config.resolve` with the registries and what --import adds, and a trial build; imports jax.

    Args:
        config: a run's.
        given: fields and options that were given and have to be read, see `srl_jax.needs.Run.refuse`.

    Raises:
        ConfigError: what is to be imported cannot be, or a specification is not valid, or cannot be built for
            these frames, or replay has no room for a window, or there is no such view, or a logger's package
            is missing, or nothing reads what was given.
    """
    from srl_jax.augment import check_views
    from srl_jax.files import loggers
    from srl_jax.learning.agent import components, trained_terms

    if config.imports:
        plugins.load(config.imports)
        check_game(config, imported=True)
    loggers.check(config.loggers)
    full = completed(config, given)
    # Options may be valid one by one and not together, or not for these frames: only a factory knows. An
    # environment's own size and its number of actions are known once it is made; any will do for that.
    size = config.frame_size or 84
    _, algorithm, terms = components(config, (size, size, 1), num_actions=18)
    checks.check_replay(config, trained_terms(config, algorithm, terms)[1])
    check_views(full, size)
    refuse_unread(config, full, terms, given)
    return full


def refuse_unread(
    config: Config, full: Config, terms: Mapping[str, "Objective"], given: Collection[str]
) -> None:
    """Raises ConfigError where nothing reads a field that was given.

    Args:
        config: as it was given, where a rate of 0 is that of another group.
        full: `completed`.
        terms: the objectives that were made of it.
        given: fields.
    """
    asked = dataclasses.replace(full, lr_encoder=config.lr_encoder, lr_encoder_srl=config.lr_encoder_srl)
    checks.run_of(asked, **built(full, terms)).refuse(given)


def built(config: Config, terms: Mapping[str, "Objective"]) -> dict[str, Any]:
    """What of `srl_jax.needs.Run` takes the registries, and the objectives of a configuration."""
    import jax

    from srl_jax import objectives, rl

    key = jax.random.key(0)
    return {
        "rl": specs.parse(config.rl, rl.REGISTRY, "rl"),
        "objectives": tuple(
            specs.parse(text, objectives.REGISTRY, "objective") for text in config.objectives
        ),
        "terms": terms,
        "heads": any(jax.tree.leaves(jax.eval_shape(term.init, key)) for term in terms.values()),
    }


def completed(config: Config, given: Collection[str] = ()) -> Config:
    """`srl_jax.config.resolve` with the registries as they are: what is imported is known; imports jax."""
    from srl_jax import encoders, objectives, rl

    return resolve(config, rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY, given)


_SAME = {"encoder_from": "encoder", "policy_from": "game"}
"""What a run must have in common with the one that a flag names, beside how frames are made."""


def _written_out(encoder: str) -> str:
    """A specification with the options that the encoder has by now; as it is where it is none."""
    from srl_jax import encoders

    try:
        return specs.parse(encoder, encoders.REGISTRY, "encoder").full
    except ConfigError:
        return encoder


def check_sources(config: Config) -> None:
    """Whether the checkpoints that a run wants to start from exist and fit it; reads manifests alone.

    Raises:
        ConfigError: one line that names the flag and what differs.
    """
    for flag, own in _SAME.items():
        if not (path := getattr(config, flag)):
            continue
        try:
            found = checkpoint.read_manifest(path).config
        except ConfigError as error:
            raise ConfigError(f"--{flag}={path}: {error}") from None
        if flag == "policy_from" and found.mode == "pretrain":
            raise ConfigError(
                f"--{flag}={path}: a representation run has no policy; name a run of another mode"
            )
        for field in (own, "frame_size", "frame_stack"):
            what = {"encoder": "architecture", "game": "game"}.get(field, "preprocessing")
            ours, theirs = getattr(config, field), getattr(found, field)
            if ours != theirs and (field != "encoder" or _written_out(ours) != _written_out(theirs)):
                raise ConfigError(
                    f"--{flag}={path}: the {what} differs: {field} is {theirs} there and {ours} here"
                )
