"""Trains one agent: `python -m experiments.train --preset=thesis/joint_256 --out=runs/pong`.

Bad input ends with one line on stderr and exit status 2 before anything is written. What can be checked
without jax is checked before jax is imported. Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 write a checkpoint and end
the run; a second Ctrl-C or SIGTERM ends it at once.
"""

import contextlib
import dataclasses
import functools
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from absl import flags

from srl_jax import envs
from srl_jax.config import INFOS, SOURCES, Config
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.resuming import (
    MAY_CHANGE,
    all_to_resume,
    blank,
    going_on,
    has_ended,
    has_seeds,
    is_run,
    say,
    say_anew,
    say_finished,
)
from srl_jax.files.rundir import LOCK, check_free, put_back, run_directory
from srl_jax.learning.modes import MODES
from srl_jax.specs import value_text
from srl_jax.training import check_game, check_sources, completed, resolved

from .command_line import flags as config_flags
from .command_line import paths, runtime
from .command_line.stopping import signals
from .packing import CONFIGS
from .runs.run_data import is_seed


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, *_ = config_flags.kinds(values)
    config_flags.define_config_flags(values)
    config_flags.define_runtime_flag(values)
    text("out", None, "run directory to make; must be new or empty")
    text(
        "seeds",
        None,
        "which seeds, 0,1,2 or 3, alone, in this process, instead of --seed: for an accelerator; a run "
        "directory each in --out, seed0, seed1, ...",
    )
    flags.DEFINE_enum(
        "resume",
        "off",
        ["off", "auto"],
        "auto: resume the run that --out holds from its newest good checkpoint, as if it had never stopped",
        values,
    )
    yes("overwrite", False, "delete the run that --out holds first")
    yes("print_config", False, "print the resolved config as JSON and exit")
    yes(
        "dry_run",
        False,
        "check everything, print the resolved config as JSON, say where the run would be written, and exit",
    )


def check_out(
    out: str | None, config: Config, *, overwrite: bool, resume: bool, seeds: Sequence[int] = ()
) -> Path:
    """Whether a run can be written there; writes nothing, but for `put_back`.

    Args:
        out: the path, or None where it was not given.
        config: what it starts from must not be deleted.
        overwrite: a run that lies there may be deleted.
        resume: whether a run that lies there will be resumed.
        seeds: of --seeds, whose directories are made in it.

    Returns:
        The path.

    Raises:
        ConfigError: it cannot.
    """
    if not out:
        raise ConfigError("--out: missing; name a directory for the run, --out=runs/NAME")
    if overwrite and resume:
        raise ConfigError("--resume=auto: resumes the run that --overwrite deletes; give one of them")
    path = paths.check_place("out", out)
    its_seeds = sorted(path.glob("seed*"))
    for directory in (path, *([path / f"seed{seed}" for seed in seeds] if resume else its_seeds)):
        check_free(directory)
    for directory in (path, *its_seeds):
        put_back(directory)
    try:
        problem = "" if blank(path) else _why_not(path, config, overwrite, resume, bool(seeds))
    except OSError as error:
        problem = str(error.strerror)
    if problem:
        raise ConfigError(f"--out={out}: {problem}")
    return path


def _why_not(path: Path, config: Config, overwrite: bool, resume: bool, seeds: bool) -> str:
    """Why a directory in which something lies cannot be resumed or deleted; "" where it can."""
    single, several = is_run(path), has_seeds(path)
    if resume:
        if not (single or several):
            return "not a run directory, so --resume=auto cannot resume it"
        if single and seeds:
            return "a single run lies there, which --seeds does not resume; name another directory"
        if not (single or seeds):
            return "runs of several seeds lie there; give their --seeds, or name another directory"
        return ""
    if not overwrite:
        return "not empty; name a new directory, or --resume=auto resumes the run, or --overwrite deletes it"
    if path.is_symlink():
        return "a link, so --overwrite does not delete it; name what it leads to"
    if not (single or several):
        return "not a run directory, so --overwrite does not delete it"
    others = [e.name for e in path.iterdir() if not (is_seed(e.name) or e.name == LOCK)]
    if not single and others:
        return (
            f"{min(others)} lies beside the runs of seeds, so --overwrite does not delete them; move it away"
        )
    own = {path, *path.glob("seed*")}
    there = (found.parent for name in ("config.json", CONFIGS) for found in sorted(path.rglob(name)))
    if other := next((folder for folder in there if folder not in own), None):
        return f"{other.relative_to(path)} lies in it, which --overwrite would delete with it; move it away"
    for flag in SOURCES:
        source = getattr(config, flag)
        if source and Path(source).resolve().is_relative_to(path.resolve()):
            return f"--overwrite would delete --{flag}={source}"
    here = Path.cwd().is_relative_to(path.resolve())
    return "--overwrite would delete the working directory" if here else ""


def check_seeds(values: flags.FlagValues) -> list[int]:
    """The seeds of --seeds; none where it was not given.

    Raises:
        ConfigError: they are not distinct integers, or one without a comma, which elsewhere is how many; or
            --seed was given beside them.
    """
    text = values["seeds"].value
    if text is None:
        return []
    if values["seed"].present:
        raise ConfigError(f"--seeds={text}: given beside --seed={values['seed'].value}; give one of them")
    try:
        seeds = [INFOS["seed"].parse(part) for part in text.removesuffix(",").split(",")]
        for seed in seeds:
            INFOS["seed"].check(seed)
    except ValueError as error:
        raise ConfigError(f"--seeds={text}: {error}; give integers, as in --seeds=0,1,2") from None
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"--seeds={text}: a seed is there twice")
    if "," not in text:
        raise ConfigError(
            f"--seeds={text}: names which seeds, not how many; --seeds=0,1,2 are three, --seed={text} is a "
            f"run of that one, and --seeds={text}, (with the comma) is that one in a directory of seeds"
        )
    return seeds


def say_unused(values: flags.FlagValues, game: str) -> None:
    """A line for each flag that was given and that the game's environments have no use for."""
    row = envs.game(game)
    has = {name: name in row.options for name in ("sticky_actions", "full_actions", "noop_max")}
    for name, known in (has | {"life_loss": row.lives}).items():
        if values[name].present and not known:
            display.say(f"--{name}: changes nothing, {game} has none")


def say_last_evaluation(config: Config) -> None:
    """A line where the last evaluation of the learning curve is not at the end."""
    end, every = config.whole_rounds(config.steps), config.eval_every
    last = end // every * every
    if MODES[config.mode].rl and not config.final_games and end - last >= config.num_envs:
        display.say(f"--eval_every={every}: the last evaluation is after {last:,} of {end:,} env steps")


def say_no_update(config: Config) -> None:
    """A line where the run ends before its first update is due; imports jax."""
    from srl_jax.learning.update import Hyper
    from srl_jax.run.schedules import Schedules

    last = config.whole_rounds(config.steps) - config.num_envs  # where the last round begins
    if not Schedules(config, Hyper({}, {})).updates_due(last):
        name = "learn_start" if last < config.learn_start else "updates_per_step"
        value = value_text(getattr(config, name))
        display.say(f"--{name}={value}: no update is due within {config.steps:,} env steps")


def check_paths(config: Config) -> None:
    """Whether the paths that the run starts from exist.

    Raises:
        ConfigError: one does not.
    """
    for flag in SOURCES:
        path = getattr(config, flag)
        if path and not os.path.exists(path):
            raise ConfigError(f"--{flag}={path}: no such path; give a run directory or a checkpoint")


def interrupt() -> None:
    """Ends a run in the middle of a step, without another checkpoint."""
    raise KeyboardInterrupt


def train(values: flags.FlagValues, prepare: Callable[[str, str], None] | None = None) -> int:
    """Checks the command line, makes the run directory and trains.

    Args:
        values: parsed flags, as `define_flags` defines them.
        prepare: called with --tune_runtime and the encoder before jax is imported, and only where a run
            follows. It may replace the process, so only a process of our own gives it.

    Returns:
        The exit status: 0, or 128 and the signal that stopped the run.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
        SaveError, Diverged: see `srl_jax.run.loop.train`.
    """
    config = config_flags.config_from_flags(values, complete=not values["print_config"].value)
    if values["print_config"].value:
        config_flags.say_what_is_replaced(values)
        display.result(resolved(config, config_flags.what_is_given(values)).to_json())
        return 0
    seeds = check_seeds(values)
    resume = values["resume"].value == "auto"
    overwrite = values["overwrite"].value
    path = check_out(values["out"].value, config, overwrite=overwrite, resume=resume, seeds=seeds)
    fresh = not resume or blank(path)  # whatever lies there makes way
    check_game(config)
    if not resume:
        check_paths(config)
    dry = values["dry_run"].value
    if prepare is not None and not dry:
        prepare(values["tune_runtime"].value, config.encoder)
    runtime.check_device()
    config = resolved(config, config_flags.what_is_given(values))

    from srl_jax.run import loop
    from srl_jax.run.schedules import printed

    runs = [(path / f"seed{seed}", dataclasses.replace(config, seed=seed)) for seed in seeds]
    runs = runs or [(path, config)]
    manifests = all_to_resume(runs, completed) if resume else [None] * len(runs)
    if all(m and has_ended(where, m, c) for (where, c), m in zip(runs, manifests, strict=True)):
        there, given = Config.load(runs[0][0]), config_flags.given_fields(values)
        for name in MAY_CHANGE:
            if name in given and getattr(there, name) != getattr(config, name):
                say(f"--{INFOS[name].flag or name}: changes nothing, the run has ended")
        late = not dry and any(
            [say_finished(where, m) for (where, _), m in zip(runs, manifests, strict=True)]
        )
        beside = "; it was killed before ended.json said so, which it does now" if late else ""
        print(f"the run in {path} has ended: {manifests[0].env_steps} env steps{beside}")
        return 0
    # A checkpoint has the encoder; the policy that others are pretrained on is read again.
    needed = dataclasses.replace(config, encoder_from="") if manifests[0] else config
    check_paths(needed)
    check_sources(needed)
    config_flags.say_what_is_replaced(values)
    new_end = not manifests[0] or manifests[0].config.steps != config.steps
    if dry:
        display.result(config.to_json())
        if config.reset != "none" or config.n_anneal or config.gamma_anneal:
            for line in printed(config, every=max(1, config.steps // 20)):
                display.say(line)
        say_unused(values, config.game)
        if new_end:
            say_last_evaluation(config)
        if not manifests[0]:
            say_no_update(config)
        for (directory, _), manifest in zip(runs, manifests, strict=True):
            how = f"would resume from {manifest.env_steps} env steps" if manifest else "would begin"
            display.say(f"dry run: nothing is written; a run {how} in {directory}")
        return 0
    if not resume and not overwrite:
        for directory, _ in runs:
            say_anew(directory)
    if manifests[0]:
        say(f"{path}: resumed from {manifests[0].env_steps:,} env steps")
    say_unused(values, config.game)
    with contextlib.ExitStack() as stack:
        started = contextlib.ExitStack()  # what is to be done once the run has begun
        if new_end:
            started.callback(say_last_evaluation, config)
        if not manifests[0]:
            started.callback(say_no_update, config)
        if seeds and fresh:
            started.callback(stack.enter_context(run_directory(path, None)))
        for (directory, its_config), manifest in zip(runs, manifests, strict=True):
            if manifest:
                begun = stack.enter_context(going_on(directory, manifest, its_config))
            else:
                begun = stack.enter_context(run_directory(directory, its_config, seeds))
            started.callback(begun)
        caught = stack.enter_context(signals(again=interrupt))
        directories = [directory for directory, _ in runs]
        resumed = manifests if manifests[0] else None
        results = loop.train_seeds(
            config,
            seeds or [config.seed],
            directories,
            resume=resumed,
            stop=lambda: bool(caught),
            begun=started.close,
        )
        draw([directory for directory, _ in runs], [config for _, config in runs], results)
    if any(result.interrupted for result in results):
        done, saved = results[0].env_steps, results[0].saved
        where = "from there" if saved == done else f"from its checkpoint of {saved}"
        how = "there is no checkpoint" if saved is None else f"srl-jax resume {path} resumes {where}"
        print(f"stopped after {done} env steps; {how}")
        return 128 + (caught[0] if caught else signal.SIGINT)
    done = f"{results[0].env_steps} env steps, {results[0].updates} updates"
    print(f"{done}{' of each seed' if seeds else ''}; everything is in {path}")
    return 0


def draw(paths: list[Path], configs: list[Config], results: list) -> None:
    """The figures of runs, where what they need is installed.

    Raises:
        SaveError: they cannot be written.
    """
    from .drawing import plots
    from .drawing.run_figures import draw_run

    if not plots.available():
        print("no figures: they need matplotlib and Pillow, pip install 'srl-jax[plots]'")
        return
    for path, config, result in zip(paths, configs, results, strict=True):
        with saving(path, "no figures"):
            draw_run(path, config, pictures=result.pictures, recording=result.recording)


cli = config_flags.program(functools.partial(train, prepare=runtime.prepare), define_flags)

if __name__ == "__main__":
    cli()
