"""Trains one agent: `python -m experiments.train --preset=thesis/joint_256 --out=runs/pong`.

Bad input ends with one line on stderr and exit status 2 before anything is written. What can be
checked without jax is checked before jax is imported.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from absl import flags

from experiments import flags as config_flags
from experiments import runtime
from srl_jax.config import INFOS, Config, resolve
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.specs import ConfigError, build, parse

FLAGS = flags.FLAGS


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    config_flags.define_config_flags(values)
    config_flags.define_runtime_flag(values)
    flags.DEFINE_string("out", None, "run directory to make; must be new or empty", flag_values=values)
    flags.DEFINE_string(
        "seeds",
        None,
        "several seeds in this process, 0,1,2, instead of --seed: for an accelerator; a run directory each "
        "in --out, seed0, seed1, ...",
        flag_values=values,
    )
    flags.DEFINE_boolean("overwrite", False, "delete the run that --out holds first", flag_values=values)
    flags.DEFINE_boolean(
        "print_config", False, "print the resolved config as JSON and exit", flag_values=values
    )


def check_seeds(values: flags.FlagValues) -> list[int]:
    """The seeds of --seeds; none where it was not given.

    Raises:
        ConfigError: they are not distinct integers, or --seed was given beside them.
    """
    text = values["seeds"].value
    if text is None:
        return []
    if values["seed"].present:
        raise ConfigError(f"--seeds={text}: given beside --seed={values['seed'].value}; give one of them")
    try:
        seeds = [INFOS["seed"].parse(part) for part in text.split(",")]
        for seed in seeds:
            INFOS["seed"].check(seed)
    except ValueError as error:
        raise ConfigError(f"--seeds={text}: {error}; give integers, as in --seeds=0,1,2") from None
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"--seeds={text}: a seed is there twice")
    return seeds


def check_extras(config: Config) -> None:
    """Whether the optional packages that the run needs are installed.

    Raises:
        ConfigError: one is not; the line says which extra has it.
    """
    if not config.game.startswith("Catch") and importlib.util.find_spec("ale_py") is None:
        raise ConfigError(
            f"--game={config.game}: Atari needs ale-py, pip install 'srl-jax[atari]'; "
            "valid without it: Catch, CatchDistractor"
        )
    if config.tensorboard and importlib.util.find_spec("tensorboardX") is None:
        raise ConfigError("--tensorboard: needs tensorboardX, pip install 'srl-jax[tensorboard]'")


def check_paths(config: Config) -> None:
    """Whether the paths that the run starts from exist.

    Raises:
        ConfigError: one does not.
    """
    for flag in ("encoder_from", "policy_from"):
        path = getattr(config, flag)
        if path and not os.path.exists(path):
            raise ConfigError(f"--{flag}={path}: no such path; give a run directory or a checkpoint")


def check_out(out: str | None, overwrite: bool, config: Config) -> Path:
    """Whether a run directory can be made there; writes nothing.

    Args:
        out: the path, or None where it was not given.
        overwrite: a run that lies there may be deleted.
        config: what it starts from must not be deleted.

    Returns:
        The path.

    Raises:
        ConfigError: it cannot.
    """
    if not out:
        raise ConfigError("--out: missing; name a directory for the run, --out=runs/NAME")
    path = config_flags.check_place("out", out)
    try:
        if not path.is_dir() or not any(path.iterdir()):
            return path
        if not overwrite:
            raise ConfigError(f"--out={out}: not empty; name a new directory, or --overwrite deletes the run")
        if path.is_symlink() or not _is_run(path):
            raise ConfigError(f"--out={out}: not a run directory, so --overwrite does not delete it")
    except OSError as error:
        raise ConfigError(f"--out={out}: {error.strerror}") from None
    kept = {"encoder_from": config.encoder_from, "policy_from": config.policy_from}
    for flag, source in kept.items():
        if source and Path(source).resolve().is_relative_to(path.resolve()):
            raise ConfigError(f"--out={out}: --overwrite would delete --{flag}={source}")
    if Path.cwd().is_relative_to(path.resolve()):
        raise ConfigError(f"--out={out}: --overwrite would delete the working directory")
    return path


def _is_run(path: Path) -> bool:
    """Whether the directory holds a config.json that this program wrote."""
    try:
        values = parse_json(read_bytes(path / "config.json", SETTINGS))
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and {"game", "mode", "versions"} <= values.keys()


@contextlib.contextmanager
def run_directory(path: Path, config: Config):
    """Makes the run directory with its config.json; unmakes it if what follows refuses the config.

    Args:
        path: as `check_out` returned it; a run that lies there is deleted.
        config: resolved; written to config.json.

    Raises:
        ConfigError: it cannot be made.
    """
    try:
        if path.is_dir() and any(path.iterdir()):
            shutil.rmtree(path)
    except OSError as error:
        raise ConfigError(f"--out={path}: {error.strerror}") from None
    made = []
    try:
        try:
            missing = [p for p in (path, *path.absolute().parents) if not p.exists()]
            for directory in reversed(missing):
                directory.mkdir()
                made.append(directory)
            config.save(path)
        except OSError as error:
            raise ConfigError(f"--out={path}: {error.strerror}") from None
        yield
    except ConfigError:
        # Only what was made here goes: once anything else lies there, all of it stays.
        with contextlib.suppress(OSError):
            if [file.name for file in path.iterdir()] == ["config.json"]:
                (path / "config.json").unlink()
        with contextlib.suppress(OSError):
            for directory in reversed(made):
                directory.rmdir()
        raise


def resolved(config: Config) -> Config:
    """`srl_jax.config.resolve` with the project's registries, and a trial build; imports jax.

    Raises:
        ConfigError: a specification is not valid, or cannot be built for these frames.
    """
    from srl_jax import encoders, objectives, rl
    from srl_jax.types import Context

    full = resolve(config, rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY)
    # Options may be valid one by one and not together, or not for these frames: only a factory
    # knows. The number of actions is not known yet; any will do for that.
    shape = (config.frame_size, config.frame_size, config.frame_stack)
    encoder = build(parse(config.encoder, encoders.REGISTRY, "encoder"), encoders.REGISTRY, shape)
    context = Context(encoder, num_actions=18)
    build(parse(config.rl, rl.REGISTRY, "rl"), rl.REGISTRY, context)
    for text in config.objectives:
        objective = parse(text, objectives.REGISTRY, "objective")
        build(objective, objectives.REGISTRY, context)
    return full


def train(values: flags.FlagValues, prepare: Callable[[str, str], None] | None = None) -> None:
    """Checks the command line, makes the run directory and trains.

    Args:
        values: parsed flags, as `define_flags` defines them.
        prepare: called with --tune_runtime and the encoder before jax is imported, and only where a run
            follows. It may replace the process, so only a process of our own gives it.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
    """
    config = config_flags.config_from_flags(values, complete=not values["print_config"].value)
    if values["print_config"].value:
        print(resolved(config).to_json())
        return
    seeds = check_seeds(values)
    path = check_out(values["out"].value, values["overwrite"].value, config)
    check_extras(config)
    check_paths(config)
    if prepare is not None:
        prepare(values["tune_runtime"].value, config.encoder)
    config = resolved(config)

    from experiments import plots
    from experiments.draw import draw_run
    from srl_jax import checkpoint, loop

    checkpoint.check_sources(config)
    runs = [(path / f"seed{seed}", dataclasses.replace(config, seed=seed)) for seed in seeds]
    runs = runs or [(path, config)]
    with contextlib.ExitStack() as directories:
        for directory, its_config in runs:
            directories.enter_context(run_directory(directory, its_config))
        if seeds:
            from srl_jax import lockstep

            results = lockstep.train_seeds(config, seeds, [directory for directory, _ in runs])
        else:
            results = [loop.train(config, path)]
    if plots.available():
        for (directory, its_config), result in zip(runs, results, strict=True):
            draw_run(directory, its_config, pictures=result.pictures)
    else:
        print("no figures: they need matplotlib and Pillow, pip install 'srl-jax[plots]'")
    done = f"{results[0].env_steps} env steps, {results[0].updates} updates"
    print(f"{done}{' of each seed' if seeds else ''}; everything is in {path}")


def main(argv: list[str], prepare: Callable[[str, str], None] | None = None) -> None:
    """The entry point; `prepare` as for `train`."""
    del argv
    train(FLAGS, prepare)


if __name__ == "__main__":
    define_flags()
    config_flags.run(functools.partial(main, prepare=runtime.prepare))
