"""Resumes a run that was stopped or killed: `python -m experiments.resume runs/x`.

The run's config.json has all settings. These flags may follow: --steps, which also extends a run that has
ended if it was trained with --keep_replay; --stop_at_return; --keep_replay; --keep_best; --logger; --import;
--encoder_from and --policy_from of runs that lie elsewhere; and --tune_runtime.
"""

import os
import sys
from pathlib import Path

from srl_jax import config
from srl_jax.errors import ConfigError
from srl_jax.files.rundir import put_back

from . import train
from .command_line import flags as config_flags
from .command_line import help
from .runs.run_data import is_seed, natural
from .sweeping.manifest import FILE


def command_line(run: str) -> list[str]:
    """The flags of training that resume a run, or the seeds that one process trained.

    Args:
        run: its directory, or the one that holds theirs.

    Raises:
        ConfigError: it is neither.
    """
    path = Path(os.path.expanduser(run))
    put_back(path)
    goes_on = [f"--out={run}", "--resume=auto"]
    if (path / "config.json").is_file():
        return [f"--config={path / 'config.json'}", *goes_on]
    if (path / FILE).is_file():
        raise ConfigError(f"{run}: a sweep, which srl-jax sweep --out={run} resumes")
    there = (file.parent.name for file in path.glob("seed*/config.json"))
    seeds = sorted(filter(is_seed, there), key=natural)
    if not seeds:
        raise ConfigError(f"{run}: not a run directory (no config.json)")
    if root := next((root for root in path.absolute().parents[:2] if (root / FILE).is_file()), None):
        raise ConfigError(
            f"{run}: runs of a sweep, each by itself; name one of them, or give srl-jax sweep --out={root}"
        )
    numbers = ",".join(name.removeprefix("seed") for name in seeds)
    if len(seeds) == 1:
        numbers += ","  # a lone number is refused
    line = [f"--config={path / seeds[0] / 'config.json'}", f"--seeds={numbers}", *goes_on]
    in_step = [config.read(path / name)[1].get("seeds") for name in seeds]
    if None in in_step:
        raise ConfigError(
            f"{run}: runs of seeds, each by itself, as {seeds[in_step.index(None)]}/config.json says; name "
            f"one of them. If one process of an earlier version trained them: srl-jax train {' '.join(line)}"
        )
    return line


def main(argv: list[str]) -> None:
    """The entry point: becomes training with the flags of the run.

    Args:
        argv: the program's name, the run, and flags beside its own.
    """
    program, run, *beside = argv if len(argv) > 1 else [*argv, ""]
    if not run or run.startswith("-"):
        raise ConfigError("name a run directory first: srl-jax resume runs/NAME")
    sys.argv[:] = [program, *command_line(run), *beside]
    train.cli()


def cli() -> None:
    """Runs this entry point as a program."""
    help.if_asked(sys.argv, __doc__)
    config_flags.guarded(main)(sys.argv)


if __name__ == "__main__":
    cli()
