"""The commands of `srl-jax`, which is `python -m srl_jax`: a row of `COMMANDS` each. Imports no jax."""

import importlib
import os
import sys
from typing import NamedTuple

from srl_jax import specs
from srl_jax.files import display

from . import flags as config_flags


class Command(NamedTuple):
    """A command.

    Attributes:
        help: one line.
        usage: what is typed after its name.
        module: of this package, whose `cli` runs it; empty where it is the command's name.
    """

    help: str
    usage: str
    module: str = ""


COMMANDS: dict[str, Command] = {
    "train": Command("train an agent", "--preset=catch/joint --out=runs/x"),
    "evaluate": Command("play full games with a trained agent", "runs/x --gif=x.gif"),
    "resume": Command("resume a run that was stopped or killed", "runs/x"),
    "sweep": Command("train many agents", "--presets=catch/* --seeds=3 --out=runs/many"),
    "figures": Command("run and draw a figure", "--figure=6.3 --games=Catch"),
    "report": Command("write a page about many runs", "runs --out=report.html"),
    "draw": Command("draw the figures of a run again", "runs/x"),
    "compare": Command("draw the curves of several runs", "runs/a runs/b --out=ab.png"),
    "power": Command("how many seeds a difference takes", "--effect=0.1 --spread=0.12"),
    "export": Command("write a run's encoder to a file for numpy", "runs/x --encoder=enc.npz"),
}
"""What follows `srl-jax`, in the order in which it is listed."""


def listing() -> str:
    """The commands, a line each."""
    usages = {name: f"srl-jax {name} {command.usage}" for name, command in COMMANDS.items()}
    width = max(map(len, usages.values()))
    lines = [f"  {usages[name]:{width}}  {command.help}" for name, command in COMMANDS.items()]
    return "\n".join(["Commands, with an example each:", *lines, "srl-jax COMMAND --help lists its flags."])


def main() -> None:
    """Runs the command that the first argument names; lists them all where there is none."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h", "--helpfull", "help"):
        display.result(listing())
        return
    if name not in COMMANDS:
        config_flags.fail(f"{name}: no such command; {specs.choices_text(name, COMMANDS)}")
    sys.argv[:] = [f"srl-jax {name}", *rest]
    try:
        here = os.getcwd()
    except OSError as error:
        config_flags.fail(f"the working directory: {error.strerror}; cd to one that is there")
    if here not in sys.path:  # as `python -m` has it: --game=module:Name-v0 may lie here
        sys.path.append(here)
    importlib.import_module(f"..{COMMANDS[name].module or name}", __package__).cli()
