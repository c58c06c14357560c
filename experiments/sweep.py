"""Trains many agents: `python -m experiments.sweep --presets=thesis/* --games=Pong --seeds=5 --out=runs/all`.

A run for each preset, game and seed, and the runs whose encoder or policy these start from, each a process
with a run directory of its own, --out/GAME/ARM/seedN. Given again, the command runs what is missing or
broken; with --out alone it resumes everything that was ever planned there. Ctrl-C, SIGTERM, SIGHUP and
SIGUSR1 write a checkpoint of each run and end. `--status` says how far a sweep is, `--dry_run` what one would
do. `--grid=lr_rl=1e-4,3e-4 --grid=batch_size=32,64` tries each combination; a table of the arms, the best one
first, comes at the end.

Flags of experiments.train beside these are given to every run, but --steps: pretraining takes 0.3 of it, as
in the thesis. Bad input ends with one line on stderr and exit status 2 before anything is written. Exit
status: 0 if all runs are complete, 1 if one failed, 3 if the disk is full, 128 + n after signal n.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from absl import flags

from srl_jax import display, envs, rundir
from srl_jax.config import INFOS, Config
from srl_jax.display import hms
from srl_jax.errors import ConfigError, SaveError
from srl_jax.specs import Info, value_text

from . import collect
from . import flags as config_flags
from .presets import preset_values
from .sweeping import best, launching, local, machine, manifest, plan, resolving, speed, table
from .sweeping.launching import Launcher, Outcome
from .sweeping.manifest import Entry
from .sweeping.plan import Planned

FLAGS = flags.FLAGS

LAUNCHERS = ("local", "ray")

_INFOS = {
    "workers": Info(int, "runs at once; 0: one a core, as far as memory allows, and one on a GPU", minimum=0),
    "retries": Info(int, "how often a run that crashed is resumed", minimum=0),
    "cpus_per_run": Info(int, "cores that a run keeps to", "cores", minimum=1),
    "gpus_per_run": Info(float, "of one GPU or several, with --launcher=ray", "GPUs", minimum=0),
}


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    config_flags.define_config_flags(values)
    config_flags.define_runtime_flag(values)
    flags.DEFINE_list(
        "presets", None, "what is compared: presets, or patterns as in thesis/*", flag_values=values
    )
    flags.DEFINE_multi_string(
        "grid",
        None,
        "FLAG=VALUE,VALUE: each preset with each of these values, an arm each; repeated: with each "
        "combination; a ; separates values that have commas",
        flag_values=values,
    )
    flags.DEFINE_list("games", None, "to run each on; each preset's own if not given", flag_values=values)
    flags.DEFINE_string("seeds", "1", "how many seeds, 5, or which ones: 0,3,7 or 3,", flag_values=values)
    flags.DEFINE_string("out", None, "directory of the sweep, new or an old one's", flag_values=values)
    define_launcher_flags(values)
    flags.DEFINE_boolean("status", False, "print how far the sweep in --out is, and exit", flag_values=values)


def define_launcher_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines the flags that say how runs are run, for every entry point that runs a sweep."""
    flags.DEFINE_enum(
        "launcher",
        "local",
        LAUNCHERS,
        "who runs the runs: this machine, or a Ray cluster",
        flag_values=values,
    )
    for name, default in {"workers": 0, "retries": 2, "cpus_per_run": 1, "gpus_per_run": 0.0}.items():
        config_flags.define(name, _INFOS[name], default, values)
    flags.DEFINE_string(
        "ray_address",
        None,
        "of a Ray cluster that runs, HOST:PORT or auto; a new one on this machine if not given",
        flag_values=values,
    )
    flags.DEFINE_boolean(
        "dry_run", False, "print what would run and how long it would take, and exit", flag_values=values
    )


def launcher_options(values: flags.FlagValues) -> dict:
    """What `run_sweep` takes, from the flags of `define_launcher_flags`.

    Raises:
        ConfigError: a value is not valid, or not for this launcher.
    """
    launcher = values["launcher"].value
    if launcher == "local":
        for name in ("gpus_per_run", "ray_address"):
            if values[name].present:
                raise ConfigError(f"--{name}: only --launcher=ray takes it")
    for name, info in _INFOS.items():
        try:
            info.check(values[name].value)
        except ValueError as error:
            raise ConfigError(f"--{name}={values[name].value}: {error}") from None
    return {
        "launcher": launcher,
        "workers": values["workers"].value or None,
        "retries": values["retries"].value,
        "cpus_per_run": values["cpus_per_run"].value,
        "gpus_per_run": values["gpus_per_run"].value,
        "ray_address": values["ray_address"].value,
    }


def given_flags(values: flags.FlagValues) -> dict[str, str | tuple[str, ...]]:
    """The flags of experiments.train that were given, as texts.

    Raises:
        ConfigError: one is among them that a sweep gives to each run itself.
    """
    names = [info.flag or name for name, info in INFOS.items()]
    found: dict[str, str | tuple[str, ...]] = {}
    for name in (*names, "preset", "config", "tune_runtime"):
        if not values[name].present:
            continue
        if name in plan.OWN:
            raise ConfigError(f"--{name}: a sweep gives it to each run; --{plan.OWN[name]} decides it")
        value = values[name].value
        found[name] = (
            tuple(value) if isinstance(value, list) else "off" if value is None else value_text(value)
        )
    return found


def say_what_is_replaced(values: flags.FlagValues, runs: Sequence[Planned]) -> None:
    """Says in a line which presets' objectives are replaced by those of --objective."""
    given = values["objective"].value or ()
    whose = [
        preset
        for preset in dict.fromkeys(run.preset for run in runs)
        if config_flags.replaced_objectives(given, preset_values(preset).get("objectives", ()), preset)
    ]
    if whose:
        display.say(config_flags.replaced_objectives(given, ("those",), ", ".join(whose)))


def run_sweep(
    root: Path,
    runs: Sequence[Planned],
    *,
    launcher: str = "local",
    workers: int | None = None,
    retries: int = 2,
    cpus_per_run: int = 1,
    gpus_per_run: float = 0.0,
    ray_address: str | None = None,
    command: Callable[[Planned], list[str]] = plan.command,
    resolve: Callable[[Sequence[Planned]], Mapping[str, Config]] = resolving.resolve,
) -> Outcome:
    """Runs those of these runs that are missing or broken; shows them on stderr.

    Args:
        root: of the sweep, whose other runs are left alone; made if need be.
        runs: from `plan.plan`.
        launcher: one of `LAUNCHERS`.
        workers: runs at once; None: as many as there is room for.
        retries: how often a run that crashed is resumed: no bad setting, full disk or infinite loss.
        cpus_per_run: cores that a run keeps to. Roundings, and so results, may depend on it.
        gpus_per_run: of one GPU or several, for Ray.
        ray_address: of a Ray cluster; None starts one on this machine.
        command: the command line of a run that works in `root`.
        resolve: the configurations that the runs have.

    Raises:
        ConfigError: a run cannot be run, or another sweep is at work there; nothing was written.
        SaveError: nothing more can be written; what ran has been stopped.
    """
    chosen = check(root, runs, resolve)
    root = root.absolute()
    rundir.check_free(root)
    executor: Launcher
    if launcher == "ray":
        from .sweeping.ray_launcher import Ray

        executor = Ray(root, workers, cpus_per_run, gpus_per_run, retries, ray_address, command)
    else:
        executor = local.Local(root, workers, cpus_per_run, command)
    with contextlib.closing(executor):
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out={root}: {error.strerror}") from None
        with rundir.held(root):
            manifest.write(root, manifest.read(root) | chosen)
            screen = table.Screen(root, chosen, executor.workers)
            screen.note(f"{len(chosen)} runs in {root}, {executor.where}")
            return launching.launch(root, chosen, executor, screen, retries=retries)


def check(
    root: Path, runs: Sequence[Planned], resolve: Callable[[Sequence[Planned]], Mapping[str, Config]]
) -> dict[str, Entry]:
    """Whether runs can be run in a directory; writes nothing.

    Returns:
        {name: Entry}, each after those that it starts from.

    Raises:
        ConfigError: they cannot.
    """
    if (root / "config.json").exists():
        raise ConfigError(f"--out={root}: a run directory; name another one, the sweep's runs are made in it")
    manifest.read(root)
    configs = resolve(runs)
    chosen = {run.name: Entry(run, configs[run.name]) for run in runs}
    launching.check_order(list(chosen.values()))
    launching.look_at_all(root, chosen)
    return chosen


def dry_run(
    root: Path,
    runs: Sequence[Planned],
    *,
    workers: int | None = None,
    cpus_per_run: int = 1,
    resolve: Callable[[Sequence[Planned]], Mapping[str, Config]] = resolving.resolve,
    **_: object,
) -> list[str]:
    """What `run_sweep` would do, as lines; writes nothing.

    Raises:
        ConfigError: see `check`.
    """
    entries = check(root, runs, resolve)
    found = launching.look_at_all(root, entries)
    speeds = speed.Speeds(root, entries.values())
    reached, per_s, sources = {}, {}, set()
    arms: dict[tuple[str, str], list[str]] = {}
    for name, (run, config) in entries.items():
        got = speeds.of(config)
        per_s[name] = got and got.per_s
        sources.add(got.source if got else "unknown")
        # What a run has beyond its last checkpoint it does again.
        reached[name] = config.steps if found[name].kind == "done" else found[name].env_steps
        arms.setdefault(tuple(run.name.split("/")[:2]), []).append(name)
    rows = [("arm", "runs", "done", "to run", "env steps", "steps/s", "time")]
    total = [0, 0, 0]
    for arm, names in arms.items():
        todo = [name for name in names if found[name].kind != "done"]
        steps = sum(max(entries[name].config.steps - reached[name], 0) for name in todo)
        rate = per_s[names[0]]
        cells = ("unknown", "unknown") if rate is None else (f"{rate:,.0f}", hms(steps / rate))
        rows.append(
            ("/".join(arm), *map(str, (len(names), len(names) - len(todo), len(todo))), f"{steps:,}", *cells)
        )
        total = [a + b for a, b in zip(total, (len(names), len(todo), steps), strict=True)]
    lines = table.columns(rows)
    for name, state in found.items():
        if state.kind in ("busy", "broken"):
            what = "would wait" if state.kind == "busy" else "would be moved aside and run anew"
            lines.append(f"{name}: {state.reason}; {what}")
    workers = workers or max(machine.most_workers() // cpus_per_run, 1)
    done = [name for name, state in found.items() if state.kind == "done"]
    seconds, unknown = speed.seconds_left(entries, reached, per_s, workers, done)
    line = f"{total[1]} of {total[0]} runs to run, {total[2]:,} env steps"
    if total[1]:
        line += f", {hms(seconds) if seconds else 'unknown time'} with {workers} at once"
        if unknown and seconds:
            line += f" and {unknown} runs of unknown speed"
        line += f"; speeds: {'; '.join(sorted(sources))}"
    lines.append(line)
    if total[1] and unknown:
        lines.append(
            "unknown: no run of this game's kind, encoder and mode has been timed, here or among published "
            "ones; start the sweep, and a few minutes later --status says how long it takes"
        )
    return lines


def chosen_runs(values: flags.FlagValues, root: Path) -> list[Planned]:
    """The runs that the command line asks for: of --presets, or all of the sweep's that is there.

    Raises:
        ConfigError: they cannot be planned.
    """
    given = given_flags(values)
    if values["presets"].value:
        arms = [plan.arm_of(preset) for preset in plan.presets(values["presets"].value)]
        arms = plan.grid(arms, values["grid"].value or [], given)
        seeds = plan.parse_seeds(values["seeds"].value)
        return plan.plan(
            arms, envs.several(values["games"].value or [], others=bool(values["import"].value)), seeds, given
        )
    entries = manifest.read(root)
    if not entries:
        raise ConfigError("--presets: missing; name some, as in --presets=thesis/joint_256,thesis/rl_only_*")
    if flag := next((name for name in ("games", "seeds", "grid", *given) if values[name].present), None):
        raise ConfigError(
            f"--{flag}: only with --presets; without it, the sweep in --out is resumed as it was planned"
        )
    return [entry.run for entry in entries.values()]


def main(argv: list[str]) -> int:
    """The entry point; returns the exit status."""
    del argv
    if not FLAGS.out:
        raise ConfigError("--out: missing; name a directory for the sweep, --out=runs/NAME")
    root = config_flags.check_place("out", FLAGS.out)
    options = launcher_options(FLAGS)
    if FLAGS.status:
        entries = manifest.read(root)
        if not entries:
            raise ConfigError(f"--out={FLAGS.out}: no sweep there (no {manifest.FILE})")
        workers = options["workers"] or machine.most_workers()
        display.result("\n".join(table.status(root, entries, workers)))
        return 0
    runs = chosen_runs(FLAGS, root)
    say_what_is_replaced(FLAGS, runs)
    if FLAGS.dry_run:
        display.result("\n".join(dry_run(root, runs, **options)))
        return 0
    try:
        outcome = run_sweep(root, runs, **options)
        if outcome.status < 128:  # not told to end
            if lines := best.lines(collect.load_named(root, [run.name for run in runs])):
                display.result("\n".join(lines))
    except OSError as error:
        raise SaveError(f"--out={FLAGS.out}: {error.strerror or error}") from error
    return outcome.status


def cli() -> None:
    """Runs this entry point as a program."""
    define_flags()
    config_flags.run(main)


if __name__ == "__main__":
    cli()
