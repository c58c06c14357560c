"""How fast this project is, beside PyTorch and Tianshou: `python -m experiments.benchmarks.bench`.

Every figure comes from workers, which take turns (A B A B ...) and never work at the same time. A figure is
the median over rounds of each round's median, with its quartiles; a ratio is formed round by round. What
needs PyTorch or Tianshou runs in an environment of its own (`make bench-install`), and is skipped without it.

`--out=DIR` also writes bench.json, with every repetition, and bench.md, the table.
"""

import contextlib
import datetime
import json
import math
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.files.provenance import git_revision, versions
from srl_jax.specs import Info, choices_text

from ..command_line import flags as config_flags
from ..command_line import paths, runtime
from .rows import GROUPS, OF_OBJECTIVES, Group
from .worker import ROOT, Worker, WorkerError

PYTHON = ".venv-bench/bin/python"
ROWS = {name: row for group in (*GROUPS, *OF_OBJECTIVES) for name, row in group.rows.items()}
MAIN = [name for group in GROUPS for name in group.rows]
"""The rows that are measured where none is chosen."""
CHECK_UPDATES = 2
"""Updates whose losses must be equal; the second one's depend on the first one's gradients."""
TOLERANCE = 1e-4
"""Largest relative difference of two losses that count as equal."""
BUSY = 0.5
"""Load average from which on other programs are warned of."""
HEAD = ("name", "this project", "the other side", "ratio", "goal")


class CheckFailed(RuntimeError):
    """The two sides do not compute the same."""


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, names, *_ = config_flags.kinds(values)
    config_flags.define("rounds", Info(int, "how often each worker takes its turn", minimum=1), 7, values)
    names("only", None, f"rows to measure, of: {', '.join(MAIN)}; objectives for what each costs")
    text("out", None, "directory for bench.json and bench.md; must be new or empty")
    text("bench_python", PYTHON, "interpreter that has PyTorch and Tianshou")
    yes("quick", False, "one round of turns a twelfth as long, to try this program; its figures say nothing")


def chosen_rows(only: Sequence[str] | None) -> list[str]:
    """The rows that --only names, in the table's order; None: all but those of objectives.

    Raises:
        ConfigError: there is no such row.
    """
    if only == []:
        raise ConfigError(f"--only=: names no row; {choices_text('', ROWS)}")
    chosen = set(MAIN if only is None else only)
    if "objectives" in chosen:
        chosen = chosen - {"objectives"} | {name for group in OF_OBJECTIVES for name in group.rows}
    for name in chosen - ROWS.keys():
        raise ConfigError(f"--only={name}: {choices_text(name, [*ROWS, 'objectives'])}")
    return [name for name in ROWS if name in chosen]


def check_out(out: str | None) -> Path | None:
    """The directory to write to, or None for none; writes nothing.

    Raises:
        ConfigError: it is no directory, or not empty, or there is no permission.
    """
    if not out:
        return None
    path = paths.check_place("out", out)
    if path.is_dir() and any(path.iterdir()):
        raise ConfigError(f"--out={out}: not empty; name a new directory")
    return path


def other_versions(python: str) -> dict[str, str]:
    """What an interpreter has to compare with; {} unless it has both PyTorch and Tianshou."""
    code = "import importlib.metadata as m, json; "
    code += "print(json.dumps({name: m.version(name) for name in ('torch', 'tianshou', 'numpy')}))"
    try:
        done = subprocess.run([python, "-c", code], cwd=ROOT, capture_output=True)
    except OSError:
        return {}
    return {} if done.returncode else json.loads(done.stdout)


def cpu_model() -> str:
    """The processor's name."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    found = re.search(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    return found[1] if found else platform.machine()


def difference(ours: Sequence[Mapping[str, float]], theirs: Sequence[Mapping[str, float]]) -> float:
    """The largest relative difference of the losses of the same updates.

    Raises:
        CheckFailed: it is above `TOLERANCE`, or they are not the same updates or losses.
    """
    if [set(losses) for losses in ours] != [set(losses) for losses in theirs]:
        raise CheckFailed(f"the sides compute different losses: {ours} and {theirs}")
    pairs = [(mine[name], their[name]) for mine, their in zip(ours, theirs, strict=True) for name in mine]
    found = float(np.max([abs(a - b) / max(abs(a), abs(b), 1e-30) for a, b in pairs]))  # NaN where one is
    if not found <= TOLERANCE:
        raise CheckFailed(f"a loss differs by {found:.1e} of its value, more than {TOLERANCE:.0e}")
    return found


def start(group: Group, rows: Sequence[str], python: str, stack: contextlib.ExitStack) -> tuple[dict, dict]:
    """Starts the workers that some rows of a group need, and compares their losses with their twins'.

    Returns:
        {name: worker}, and {name: the largest relative difference of a loss} of those that have a twin.
    """
    workers, checks, checked = {}, {}, {}
    for name, program in group.needed(rows).items():
        interpreter = python if program.is_other else None
        worker = stack.enter_context(Worker(program.side, program.arguments, interpreter))
        worker.ask("build")
        workers[name] = worker
        if twin := program.twin:
            if twin not in checked:
                checked[twin] = workers[twin].ask("check", updates=CHECK_UPDATES)
            losses, given = checked[twin]
            checks[name] = difference(losses, worker.ask("check", updates=CHECK_UPDATES, **given))
        display.say(f"bench: {name} is ready")
    return workers, checks


def measure(
    group: Group, rows: Sequence[str], *, rounds: int, python: str, quick: bool = False
) -> tuple[dict[str, list[list[float]]], dict[str, float]]:
    """Measures some rows of a group.

    Args:
        group: its workers take turns.
        rows: their names.
        rounds: how often each worker takes its turn.
        python: the interpreter of the other sides.
        quick: turns are a twelfth as long.

    Returns:
        {series: the repetitions of each round}, and what `start` found.

    Raises:
        WorkerError: a worker failed.
        CheckFailed: the sides compute different losses.
    """
    replies: dict[str, list[list[float]]] = {}
    rounds = min(rounds, group.rounds)
    with contextlib.ExitStack() as stack:
        workers, checks = start(group, rows, python, stack)
        begun = time.monotonic()
        for number in range(1, rounds + 1):
            for name, worker in workers.items():
                turn = group.programs[name].turn
                turn = {what: math.ceil(count / 12) for what, count in turn.items()} if quick else turn
                for series, found in worker.ask("turn", **turn).items():
                    replies.setdefault(f"{name}.{series}", []).append(found)
            left = (rounds / number - 1) * (time.monotonic() - begun)
            display.say(f"bench: {', '.join(rows)}: round {number} of {rounds}, {left:.0f} s left")
    return replies, checks


def table(lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns that line up in a terminal too; ends with a newline."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    head, *rest = (" | ".join(map(str.ljust, line, widths)) for line in lines)
    rule = " | ".join("-" * width for width in widths)
    return "".join(f"| {line} |\n" for line in (head, rule, *rest))


def report(
    rows: Sequence[str], replies: Mapping[str, Any], checks: Mapping[str, float], about: Mapping[str, Any]
) -> tuple[str, dict[str, Any]]:
    """The table with what stands around it, and what bench.json holds; see `measure`.

    Rows without replies were skipped.
    """
    lines, records = [HEAD], {}
    for name in rows:
        row = ROWS[name]
        lines.append(row.cells(replies))
        records[name] = {"title": row.title, "unit": row.unit, "goal": row.goal}
        if found := row.figures(replies):
            records[name] |= {"figures": found, "rounds": {series: replies[series] for series in row.series}}
    text = f"{table(lines)}\nMedians of {about['rounds']} rounds, in brackets their quartiles, on "
    text += f"{about['cores']} cores of {about['cpu']}.\n"
    if about["load"] > BUSY:
        text += f"Other programs were running: load average {about['load']:.1f} at the start.\n"
    if checks:
        text += f"Check passed: from equal weights, without noise, the losses of {CHECK_UPDATES} updates are "
        text += (
            f"PyTorch's. Largest relative difference: {max(checks.values()):.0e} ({TOLERANCE:.0e} allowed).\n"
        )
    return text, {**about, "checks": checks, "rows": records}


def bench(values: flags.FlagValues) -> None:
    """Checks the command line, measures, prints and writes.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
        WorkerError, CheckFailed: as `measure`.
    """
    rows, path = chosen_rows(values["only"].value), check_out(values["out"].value)
    quick = values["quick"].value
    python = str(ROOT / Path(values["bench_python"].value).expanduser())
    about = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": cpu_model(),
        "cores": runtime.cores(),
        "load": os.getloadavg()[0],
        "git_revision": git_revision(),
        "versions": versions(),
        "other_versions": other_versions(python),
        "rounds": 1 if quick else values["rounds"].value,
    }
    if about["load"] > BUSY:
        display.say(f"load average {about['load']:.1f}: other programs distort what is measured")
    if not about["other_versions"]:
        display.say(
            "PyTorch and Tianshou are not there, `make bench-install` installs them; their rows are skipped"
        )
    replies, checks = {}, {}
    for group in (*GROUPS, *OF_OBJECTIVES):
        chosen = [name for name in rows if name in group.rows]
        if not about["other_versions"]:
            chosen = [name for name in chosen if not any(x.is_other for x in group.needed([name]).values())]
        if chosen:
            found = measure(group, chosen, rounds=about["rounds"], python=python, quick=quick)
            replies |= found[0]
            checks |= found[1]
    text, record = report(rows, replies, checks, about)
    print(text, end="")
    if path is not None:
        path.mkdir(parents=True, exist_ok=True)
        (path / "bench.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        (path / "bench.md").write_text(text, encoding="utf-8")


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    try:
        bench(values)
    except (WorkerError, CheckFailed) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
