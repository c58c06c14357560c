"""Trains many agents: `python -m experiments.sweep --presets=thesis/* --games=Pong --seeds=5 --out=runs/all`.

There is a run for each preset, game and seed, and for each encoder or policy that these start from. Each has
a process and a run directory of its own, --out/GAME/ARM/seedN. Given again, the command runs what is missing.
With --out alone it resumes everything that was ever planned there. Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 write
a checkpoint of each run and end the sweep. `--status` says how far a sweep is, `--dry_run` what one would do.
`--grid=lr_rl=1e-4,3e-4 --grid=batch_size=32,64` tries each combination. At the end comes a table of the arms,
the best one first.

Flags of `srl-jax train` beside these go to every run. Of --steps, pretraining takes 0.3, as in the thesis.
Bad input ends with one line on stderr and exit status 2 before anything is written. Exit status: 0 if all
runs are complete, 1 if one failed, 3 if the disk is full, 128 + n after signal n.
"""

from pathlib import Path

from absl import flags

from srl_jax import envs
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display, rundir

from . import packing
from .command_line import flags as config_flags
from .command_line import paths
from .runs import collect
from .sweeping import launching, manifest, options, plan, states, status
from .sweeping.plan import Planned


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, names, texts = config_flags.kinds(values)
    options.define_flags(values)
    names("presets", None, "what is compared: presets, or patterns as in thesis/*")
    texts(
        "grid",
        None,
        "FLAG=VALUE,VALUE: each preset with each of these values, an arm each; repeated: with each "
        "combination; a ; separates values that have commas",
    )
    names("games", None, "to run each on; each preset's own if not given")
    text("seeds", "1", "how many seeds, 5, or which ones: 0,3,7 or 3,")
    text("out", None, "directory of the sweep, new or an old one's")
    yes("status", False, "print how far the sweep in --out is, and exit")


def chosen_runs(values: flags.FlagValues, root: Path) -> list[Planned]:
    """The runs that the command line asks for: of --presets, or all of the sweep's that is there.

    Raises:
        ConfigError: they cannot be planned.
    """
    given = options.given_flags(values)
    if values["presets"].value:
        arms = [plan.arm_of(preset) for preset in plan.presets(values["presets"].value)]
        arms = plan.grid(arms, values["grid"].value or [], given)
        games = envs.several(values["games"].value or [], others=bool(values["import"].value))
        return plan.plan(arms, games, plan.parse_seeds(values["seeds"].value), given)
    entries = manifest.read(root)
    if not entries:
        raise ConfigError("--presets: missing; name some, as in --presets=thesis/joint_256,thesis/rl_only_*")
    if flag := next((name for name in ("games", "seeds", "grid", *given) if values[name].present), None):
        raise ConfigError(
            f"--{flag}: only with --presets; without it, the sweep in --out is resumed as it was planned"
        )
    return [entry.run for entry in entries.values()]


def status_lines(root: Path, workers: int) -> list[str]:
    """How far the sweep in a directory is, and who is at work there.

    Raises:
        ConfigError: there is none.
    """
    entries = manifest.read(root)
    if not entries:
        raise ConfigError(f"--out={root}: no sweep there (no {manifest.FILE})")
    try:
        rundir.check_free(root)
        at_work = "no sweep is at work there"
    except ConfigError as error:
        at_work = f"{states.holder(error)} is at work there"
    return [*status.lines(root, entries, workers), at_work]


def main(values: flags.FlagValues) -> int:
    """The entry point; returns the exit status."""
    if not values.out:
        raise ConfigError("--out: missing; name a directory for the sweep, --out=runs/NAME")
    root = paths.given("out", values.out) if values.status else paths.check_place("out", values.out)
    if values.status:
        for name in ("presets", "games", "seeds", "grid", "dry_run", *options.given_flags(values)):
            if values[name].present:
                raise ConfigError(f"--{name}: --status tells of the sweep that is in --out; leave it out")
    if packing.is_packed(root):
        raise ConfigError(f"--out={values.out}: runs are packed there; name another directory")
    how = options.launcher_options(values)
    workers = how["workers"] or launching.most_workers(how["cpus_per_run"])
    if values.status:
        display.result("\n".join(status_lines(root, workers)))
        return 0
    runs = chosen_runs(values, root)
    options.say_what_is_replaced(values, runs)
    entries = manifest.resolve(runs)
    if values.dry_run:
        display.result("\n".join(status.dry_run(root, entries, workers)))
        return 0
    with saving(f"--out={values.out}", "stopped"):
        code = launching.run_sweep(root, entries, **how)
        if code < 128:  # not told to end
            if lines := status.best(collect.load_named(root, entries)):
                display.result("\n".join(lines))
    return code


cli = config_flags.program(main, define_flags)

if __name__ == "__main__":
    cli()
