"""How fast this project is, beside PyTorch and Tianshou: `python -m experiments.benchmarks.bench`.

Every figure comes from workers, which take turns (A B A B ...) and never work at the same time. A figure is
the median over rounds of each round's median, with its quartiles; a ratio is formed round by round. What
needs PyTorch or Tianshou runs in an environment of its own (`make bench-install`), and is skipped without it.

`--out=DIR` also writes bench.json, with every repetition, and bench.md, the table.
"""

import datetime
import json
import math
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.provenance import git_revision, versions
from srl_jax.specs import choices_text

from .. import flags as config_flags
from .. import runtime
from . import table
from .rows import CHECK_UPDATES, ROWS, SIDES, Side, series_of, sides_of
from .runner import TOLERANCE, CheckFailed, Results, measure
from .worker import ROOT, Worker, WorkerError

FLAGS = flags.FLAGS
PYTHON = ".venv-bench/bin/python"
BUSY = 0.5
"""Load average from which on other programs are warned of."""


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_integer("rounds", 7, "how often each worker takes its turn", flag_values=values)
    flags.DEFINE_list("only", None, f"rows to measure, of: {', '.join(ROWS)}", flag_values=values)
    flags.DEFINE_string(
        "out", None, "directory for bench.json and bench.md; must be new or empty", flag_values=values
    )
    flags.DEFINE_string(
        "bench_python", PYTHON, "interpreter that has PyTorch and Tianshou", flag_values=values
    )


def chosen_rows(only: list[str] | None) -> list[str]:
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


def has(python: Path, package: str) -> bool:
    """Whether an interpreter has a package."""
    code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({package!r}) is None)"
    try:
        return subprocess.run([python, "-c", code], cwd=ROOT, stderr=subprocess.DEVNULL).returncode == 0
    except OSError:
        return False


def lacking(rows: list[str], python: Path) -> dict[str, str]:
    """{row: the package that it needs and nobody has}."""
    there: dict[tuple[Path, str], bool] = {}
    found = {}
    for row in rows:
        for name in sides_of([row]):
            side = SIDES[name]
            needs = [(python, side.needs)] if side.needs else [(Path(sys.executable), "jax")]
            if side.module in ("host_side", "train_side"):
                needs.append((Path(sys.executable), "ale_py"))
            for need in needs:
                if need not in there:
                    there[need] = has(*need)
                if not there[need]:
                    found.setdefault(row, need[1])
    return found


def start(side: Side, python: Path) -> Worker:
    """A worker's process; this project's compute on the CPU, in the environment that runs give themselves."""
    program = python if side.needs else Path(sys.executable)
    command = [str(program), "-m", f"experiments.benchmarks.{side.module}", *side.arguments]
    return Worker(command, None if side.needs else {"JAX_PLATFORMS": "cpu"})


def cpu_model() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def load() -> float:
    """How many programs have been running for the last minute, NaN where the system does not tell."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):
        return math.nan


def report(
    rows: list[str], skipped: dict[str, str], results: Results, about: dict[str, Any]
) -> tuple[str, dict]:
    """The table with what stands around it, and what bench.json holds."""
    lines, records = [], {}
    for name in rows:
        row = ROWS[name]
        if name in skipped:
            lines.append(table.skipped_cells(row.title, row.unit, row.goals))
            records[name] = {"title": row.title, "skipped": f"no {skipped[name]}"}
            continue
        theirs = {label: results.replies[series] for label, series in row.theirs.items()}
        found = table.figures(results.replies[row.ours], theirs, row.speedup, row.goals)
        lines.append(table.cells(row.title, row.unit, found, row.goals))
        records[name] = {
            "title": row.title,
            "unit": row.unit,
            "figures": table.as_json(found, row.goals),
            "rounds": {series: results.replies[series] for series in series_of(row)},
        }
    text = table.markdown(lines)
    text += f"\nMedians of {about['rounds']} rounds, in brackets their quartiles, on {about['cores']} cores "
    text += f"of {about['cpu']}.\n"
    if about["load"] > BUSY:
        text += f"Other programs were running: load average {about['load']:.1f} at the start.\n"
    if results.checks:
        shown = ", ".join(f"{arm} {value:.0e}" for arm, value in results.checks.items())
        text += f"Check passed: from equal weights, without noise, the losses of {CHECK_UPDATES} updates are "
        text += f"PyTorch's. Largest relative difference ({TOLERANCE:.0e} allowed): {shown}.\n"
    return text, {**about, "checks": results.checks, "workers": results.versions, "rows": records}


def bench(values: flags.FlagValues) -> None:
    """Checks the command line, measures, prints and writes.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
        WorkerError, CheckFailed: as `measure`.
    """
    rounds = values["rounds"].value
    if rounds < 1:
        raise ConfigError(f"--rounds={rounds}: must be at least 1")
    rows = chosen_rows(values["only"].value)
    path = check_out(values["out"].value)
    python = Path(values["bench_python"].value).expanduser()
    python = python if python.is_absolute() else ROOT / python
    skipped = lacking(rows, python)
    for package in dict.fromkeys(skipped.values()):
        names = ", ".join(name for name, lacks in skipped.items() if lacks == package)
        where = "make install" if package in ("jax", "ale_py") else "make bench-install"
        print(f"skipped for want of {package}: {names}; `{where}` installs it", file=sys.stderr)
    about = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": cpu_model(),
        "cores": runtime.cores(),
        "load": load(),
        "git_revision": git_revision(),
        "versions": versions(),
        "rounds": rounds,
    }
    if about["load"] > BUSY:
        print(f"load average {about['load']:.1f}: other programs distort what is measured", file=sys.stderr)
    measured = [name for name in rows if name not in skipped]
    sides = {name: SIDES[name] for name in sides_of(measured)}
    results = measure(
        {name: ROWS[name] for name in measured},
        sides,
        rounds=rounds,
        start=lambda side: start(side, python),
        threads=runtime.cores(),
    )
    text, record = report(rows, skipped, results, about)
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
