"""Flags of programs that run a sweep: who runs the runs, and what is given to all of them. Imports no jax."""

from collections.abc import Sequence
from typing import Any

from absl import flags

from srl_jax.config import INFOS
from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.specs import Info, value_text

from ..command_line import flags as config_flags
from ..command_line import help
from ..presets import preset_values
from . import plan

_COUNTS = {
    "workers": (Info(int, "runs at once; 0: one a core that has memory, and one on a GPU", minimum=0), 0),
    "retries": (Info(int, "how often a run that crashed is resumed", minimum=0), 2),
    "cpus_per_run": (Info(int, "cores that a run keeps to", "cores", minimum=1), 1),
    "gpus_per_run": (Info(float, "of one GPU or several, with --launcher=ray", "GPUs", minimum=0), 0.0),
}  # fmt: skip
"""{flag: (what it may be, its default)}."""


def define_flags(values: flags.FlagValues) -> None:
    """Defines the flags of training that a sweep gives to its runs, and those that say how runs are run."""
    text, yes, *_ = config_flags.kinds(values)
    config_flags.define_config_flags(values)
    for name in plan.OWN:  # defined to be refused with a reason
        values[name].help = help.HIDDEN
    config_flags.define_runtime_flag(values)
    launchers = "who runs the runs: this machine, or a Ray cluster"
    flags.DEFINE_enum("launcher", "local", ["local", "ray"], launchers, values)
    for name, (info, default) in _COUNTS.items():
        config_flags.define(name, info, default, values)
    text(
        "ray_address",
        None,
        "of a Ray cluster that runs, HOST:PORT or auto; a new one on this machine if not given",
    )
    yes("dry_run", False, "print what would run and how long it would take, and exit")


LAUNCHER = ("launcher", *_COUNTS, "ray_address")


def launcher_options(values: flags.FlagValues) -> dict[str, Any]:
    """What `launching.run_sweep` takes.

    Raises:
        ConfigError: a value is not valid, or not for this launcher.
    """
    found = {name: values[name].value for name in LAUNCHER}
    for name in ("gpus_per_run", "ray_address"):
        if values[name].present and found["launcher"] == "local":
            raise ConfigError(f"--{name}: only --launcher=ray takes it")
    return found | {"workers": found["workers"] or None}


def given_flags(values: flags.FlagValues) -> dict[str, str | tuple[str, ...]]:
    """The flags of training that were given, as texts; `plan.plan` refuses those that it gives each run."""
    names = [info.flag or name for name, info in INFOS.items()]
    found: dict[str, str | tuple[str, ...]] = {}
    for name in (*names, "preset", "protocol", "config", "tune_runtime"):
        if values[name].present:
            value = values[name].value
            text = tuple(value) if isinstance(value, list) else "off" if value is None else value_text(value)
            found[name] = text
    return found


def say_what_is_replaced(values: flags.FlagValues, runs: Sequence[plan.Planned]) -> None:
    """Says in a line which presets' objectives are replaced by those of --objective."""
    given = values["objective"].value or ()
    whose = [
        preset
        for preset in dict.fromkeys(run.preset for run in runs)
        if config_flags.replaced_objectives(given, preset_values(preset).get("objectives", ()), preset)
    ]
    if whose:
        display.say(config_flags.replaced_objectives(given, ("those",), ", ".join(whose)))
