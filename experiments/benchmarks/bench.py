"""How fast this project is, beside PyTorch and Tianshou: `python -m experiments.benchmarks.bench`.

Every figure comes from workers, which take turns (A B A B ...) and never work at the same time. A figure is
the median over rounds of each round's median, with its quartiles; a ratio is formed round by round. What
needs PyTorch or Tianshou runs in an environment of its own (`make bench-install`), and is skipped without it.

`--out=DIR` also writes bench.json, with every repetition, and bench.md, the table.
"""

import contextlib
import datetime
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from absl import flags

from srl_jax import display
from srl_jax.config import git_revision, versions
from srl_jax.errors import ConfigError
from srl_jax.specs import Info, choices_text

from .. import flags as config_flags
from .. import runtime
from .rows import GROUPS, Group
from .worker import ROOT, Worker, WorkerError

FLAGS = flags.FLAGS
PYTHON = ".venv-bench/bin/python"
ROWS = {name: row for group in GROUPS for name, row in group.rows.items()}
CHECK_UPDATES = 2
"""Updates whose losses must be equal; the second one's depend on the first one's gradients."""
TOLERANCE = 1e-4
"""Largest relative difference of two losses that count as equal."""
BUSY = 0.5
"""Load average from which on other programs are warned of."""
HEAD = ("name", "this project", "the other side", "ratio", "goal", "met?")


class CheckFailed(RuntimeError):
    """The two sides do not compute the same."""


class Results(NamedTuple):
    """What was found.

    Attributes:
        replies: {series: the repetitions of each round}.
        checks: {worker: the largest relative difference of a loss from its twin's}.
    """

    replies: dict[str, list[list[float]]]
    checks: dict[str, float]


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    config_flags.define("rounds", Info(int, "how often each worker takes its turn", minimum=1), 7, values)
    flags.DEFINE_list("only", None, f"rows to measure, of: {', '.join(ROWS)}", flag_values=values)
    flags.DEFINE_string(
        "out", None, "directory for bench.json and bench.md; must be new or empty", flag_values=values
    )
    flags.DEFINE_string(
        "bench_python", PYTHON, "interpreter that has PyTorch and Tianshou", flag_values=values
    )
    quick = "one round of turns a twelfth as long, to try this program; its figures say nothing"
    flags.DEFINE_boolean("quick", False, quick, flag_values=values)


def chosen_rows(only: Sequence[str] | None) -> list[str]:
    """The rows that --only names, in the table's order; None: all.

    Raises:
        ConfigError: there is no such row.
    """
    if only == []:
        raise ConfigError(f"--only=: names no row; {choices_text('', ROWS)}")
    for name in only or []:
        if name not in ROWS:
            raise ConfigError(f"--only={name}: {choices_text(name, ROWS)}")
    return [name for name in ROWS if not only or name in only]


def check_out(out: str | None) -> Path | None:
    """The directory to write to, or None for none; writes nothing.

    Raises:
        ConfigError: it is no directory, or not empty, or there is no permission.
    """
    if not out:
        return None
    path = config_flags.check_place("out", out)
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


def measure(group: Group, rows: Sequence[str], rounds: int, python: str, quick: bool = False) -> Results:
    """Measures some rows of a group.

    Args:
        group: its workers take turns.
        rows: their names.
        rounds: how often each worker takes its turn.
        python: the interpreter of the other sides.
        quick: turns are a twelfth as long.

    Raises:
        WorkerError: a worker failed.
        CheckFailed: the sides compute different losses.
    """
    results = Results({}, {})
    programs = group.needed(rows)
    start = time.monotonic()
    with contextlib.ExitStack() as stack:
        workers: dict[str, Worker] = {}
        twins: dict[str, Any] = {}
        for name, program in programs.items():
            interpreter, env = (
                (python, {}) if program.is_other else (sys.executable, {"JAX_PLATFORMS": "cpu"})
            )
            worker = Worker(interpreter, program.side, program.arguments, env)
            workers[name] = stack.enter_context(worker)
            worker.ask("build")
            if program.twin:
                if program.twin not in twins:
                    twins[program.twin] = workers[program.twin].ask("check", updates=CHECK_UPDATES)
                ours = dict(twins[program.twin])
                losses = ours.pop("losses")
                results.checks[name] = difference(losses, worker.ask("check", updates=CHECK_UPDATES, **ours))
            display.say(f"bench: {name}: ready after {time.monotonic() - start:.0f} s")
        for number in range(rounds):
            for name, program in programs.items():
                turn = {what: -(-count // 12) if quick else count for what, count in program.turn.items()}
                for series, found in workers[name].ask("turn", **turn).items():
                    results.replies.setdefault(f"{name}.{series}", []).append(found)
            spent = time.monotonic() - start
            display.say(f"bench: {', '.join(rows)}: round {number + 1} of {rounds} after {spent:.0f} s")
    return results


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns that line up in a terminal too; ends with a newline."""
    widths = [max(len(row[i]) for row in (HEAD, *rows)) for i in range(len(HEAD))]
    rule = ["-" * width for width in widths]
    padded = (map(str.ljust, row, widths) for row in (HEAD, rule, *rows))
    return "".join(f"| {' | '.join(row)} |\n" for row in padded)


def report(rows: Sequence[str], results: Results, about: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """The table with what stands around it, and what bench.json holds; rows without replies were skipped."""
    lines, records = [], {}
    for name in rows:
        row = ROWS[name]
        replies = {series: results.replies.get(series) for series in (row.ours, *row.theirs.values())}
        found = row.figures(replies) if all(replies.values()) else None
        lines.append(row.cells(found))
        records[name] = {"title": row.title, "unit": row.unit, "goal": row.goal, "skipped": not found}
        if found:
            as_json = {key: x._asdict() if isinstance(x, tuple) else x for key, x in found.items()}
            records[name] |= {"figures": as_json, "rounds": replies}
    text = markdown(lines)
    text += f"\nMedians of {about['rounds']} rounds, in brackets their quartiles, on {about['cores']} cores "
    text += f"of {about['cpu']}.\n"
    if about["load"] > BUSY:
        text += f"Other programs were running: load average {about['load']:.1f} at the start.\n"
    if results.checks:
        shown = ", ".join(f"{name} {value:.0e}" for name, value in results.checks.items())
        text += f"Check passed: from equal weights, without noise, the losses of {CHECK_UPDATES} updates are "
        text += f"PyTorch's. Largest relative difference ({TOLERANCE:.0e} allowed): {shown}.\n"
    return text, {**about, "checks": results.checks, "rows": records}


def bench(values: flags.FlagValues) -> None:
    """Checks the command line, measures, prints and writes.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
        WorkerError, CheckFailed: as `measure`.
    """
    rows = chosen_rows(values["only"].value)
    path = check_out(values["out"].value)
    quick = values["quick"].value
    python = str(ROOT / Path(values["bench_python"].value).expanduser())
    others = other_versions(python)
    about = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": cpu_model(),
        "cores": runtime.cores(),
        "load": os.getloadavg()[0],
        "git_revision": git_revision(),
        "versions": versions(),
        "other_versions": others,
        "rounds": 1 if quick else values["rounds"].value,
    }
    if about["load"] > BUSY:
        display.say(f"load average {about['load']:.1f}: other programs distort what is measured")
    results = Results({}, {})
    for group in GROUPS:
        chosen = [name for name in rows if name in group.rows]
        needing = [
            name for name in chosen if any(program.is_other for program in group.needed([name]).values())
        ]
        lacking = [] if others else needing
        if lacking:
            why = "for want of PyTorch and Tianshou; `make bench-install` installs them"
            display.say(f"skipped: {', '.join(lacking)}, {why}")
        if measured := [name for name in chosen if name not in lacking]:
            found = measure(group, measured, min(about["rounds"], group.rounds), python, quick)
            results.replies.update(found.replies)
            results.checks.update(found.checks)
    text, record = report(rows, results, about)
    print(text, end="")
    if path is not None:
        path.mkdir(parents=True, exist_ok=True)
        (path / "bench.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        (path / "bench.md").write_text(text, encoding="utf-8")


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    try:
        bench(FLAGS)
    except (WorkerError, CheckFailed) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    define_flags()
    config_flags.run(main)
