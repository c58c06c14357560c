"""A sweep as text: what runs, where, how far, and what failed and why. Imports no jax."""

import contextlib
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from srl_jax import checkpoint, ending, rundir
from srl_jax.display import Display, hms
from srl_jax.errors import ConfigError

from . import states
from .launching import View
from .manifest import Entry
from .speed import Progress, Speeds, progress, seconds_left

MOST = 12
"""Failed runs that are listed; the others are counted."""


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, their cells below each other; the first cell to the left, the others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells]).rstrip())
    return lines


def table(
    root: Path,
    entries: Mapping[str, Entry],
    view: View,
    got: Mapping[str, Progress],
    left: tuple[float, int] | None,
) -> list[str]:
    """The lines of a sweep's table.

    Args:
        root: of the sweep, as it shall be named.
        entries: {name: Entry}.
        view: what is how.
        got: {name of a run that runs: how far it is}.
        left: seconds until all is complete, and runs that these do not count; None: not said.
    """
    lines = [summary(root, view, left)]
    if view.running:
        rows = [("run", "where", "env steps", "steps/s", "left", "evaluation", "attempt")]
        for name in view.running:
            p, config = got.get(name, Progress()), entries[name].config
            record = states.read_record(root, name)
            rate = "" if p.per_s is None else f"{p.per_s:,.0f}"
            steps_left = max(config.steps - p.env_steps, 0)
            rows.append(
                (
                    name,
                    where(record),
                    f"{p.env_steps:,}/{config.steps:,}",
                    rate,
                    hms(steps_left / p.per_s) if p.per_s else "",
                    "" if p.evaluation is None else f"{p.evaluation:.4g}",
                    str(view.attempts.get(name) or (record.attempts if record else "")),
                )
            )
        lines += columns(rows)
    told = [(name, f"failed: {reason}") for name, reason in view.failed.items()]
    told += [(name, f"blocked: {reason}") for name, reason in view.blocked.items()]
    told += [
        (name, f"waiting: {why}") for name, why in view.waiting.items() if why and not why.startswith("for ")
    ]
    lines += [f"{name}: {why}" for name, why in told[:MOST]]
    if len(told) > MOST:
        lines.append(f"and {len(told) - MOST} more")
    return lines


def where(record: states.Record | None) -> str:
    """Host and cores of a run; "" before it has been started there."""
    if record is None or record.ended is not None:
        return ""
    cores = ",".join(map(str, record.cores))
    return record.host + (f" core {cores}" if cores else "")


def summary(root: Path, view: View, left: tuple[float, int] | None) -> str:
    """One line: how many are how, and how long still."""
    counts = {
        "running": len(view.running), "waiting": len(view.waiting), "failed": len(view.failed),
        "blocked": len(view.blocked),
    }  # fmt: skip
    total = len(view.done) + sum(counts.values())
    parts = [f"{len(view.done)} of {total} runs done"]
    parts += [f"{number} {what}" for what, number in counts.items() if number]
    if left is not None and (view.running or view.waiting):
        seconds, unknown = left
        text = f"{hms(seconds)} left" if seconds else "time left unknown"
        if seconds and unknown:
            text += f" and {unknown} of unknown speed"
        parts.append(text)
    return f"{', '.join(parts)} | {root}"


class Screen:
    """Shows a sweep on stderr: a terminal's table is redrawn in place, elsewhere a line says what changed.

    Args:
        root: of the sweep.
        entries: {name: Entry} of what it runs.
        workers: runs at once.
        stream: where to write.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        root: Path,
        entries: Mapping[str, Entry],
        workers: int,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.root, self.entries, self.workers = root, entries, workers
        self.stream = Display(sys.stderr if stream is None else stream)
        self.clock = clock
        self.tty = self.stream.isatty()
        self.drawn_at = self.measured_at = float("-inf")
        self.drawn = 0  # lines of the table that stand on the terminal
        self.seen: View | None = None
        self.per_s: dict[str, float | None] = {}

    def update(self, view: View, *, final: bool = False) -> None:
        """See `launching.Screen`."""
        now = self.clock()
        if not self.tty:
            self._tell_changes(view)
        if final or now - self.drawn_at >= (1.0 if self.tty else 60.0):
            self.drawn_at = now
            lines = self._lines(view, now)
            self._draw(lines if self.tty or final else lines[:1])
        self.seen = view

    def note(self, text: str) -> None:
        """See `launching.Screen`."""
        self._clear()
        self._write(f"sweep: {text}\n")
        self.drawn_at = float("-inf") if self.tty else self.drawn_at

    def _lines(self, view: View, now: float) -> list[str]:
        if now - self.measured_at >= 60.0:
            self.measured_at = now
            speeds = Speeds(self.root, self.entries.values())
            found = {name: speeds.of(entry.config) for name, entry in self.entries.items()}
            self.per_s = {name: speed and speed.per_s for name, speed in found.items()}
        got = {name: progress(self.root / name) for name in view.running}
        own = {name: p.per_s for name, p in got.items() if p.per_s}
        reached = {name: p.env_steps for name, p in got.items()}
        without = {*view.done, *view.failed, *view.blocked}
        left = seconds_left(self.entries, reached, {**self.per_s, **own}, self.workers, without)
        return table(self.root, self.entries, view, got, left)

    def _draw(self, lines: list[str]) -> None:
        self._clear()
        if self.tty:
            size = shutil.get_terminal_size()
            lines = [line[: max(size.columns - 1, 1)] for line in lines[: max(size.lines - 1, 1)]]
            self.drawn = len(lines)
        self._write("".join(f"{line}\n" for line in lines))

    def _clear(self) -> None:
        if self.drawn:
            self._write(f"\x1b[{self.drawn}F\x1b[J")
            self.drawn = 0

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()

    def _tell_changes(self, view: View) -> None:
        before = self.seen
        for name in view.running:
            if before is None or view.attempts.get(name) != before.attempts.get(name):
                record = states.read_record(self.root, name)
                self.note(f"{name}: started" + (f" on {where(record)}" if record else ""))
        for name in view.done if before else ():
            if name not in before.done:
                p = progress(self.root / name)
                steps = p.env_steps
                with contextlib.suppress(ConfigError):  # the last row may be of before the end
                    steps = checkpoint.read_manifest(self.root / name).env_steps
                score = "" if p.evaluation is None else f", last evaluation {p.evaluation:.4g}"
                self.note(f"{name}: done, {steps:,} env steps in {hms(p.seconds)}{score}")
        for name, why in view.blocked.items():
            if before is None or name not in before.blocked:
                self.note(f"{name}: blocked: {why}")
        for name, why in view.waiting.items():
            if why and not why.startswith("for ") and (before is None or before.waiting.get(name) != why):
                self.note(f"{name}: waiting: {why}")


def status(root: Path, entries: Mapping[str, Entry], workers: int) -> list[str]:
    """The table of a sweep that was started elsewhere, or does not run, from its files alone.

    Args:
        root: of the sweep.
        entries: of its manifest.
        workers: runs at once, for the time left where nothing runs.
    """
    view = view_of_files(root, entries)
    speeds = Speeds(root, entries.values())
    found = {name: speeds.of(entry.config) for name, entry in entries.items()}
    got = {name: progress(root / name) for name in (*view.running, *view.waiting)}
    per_s = {name: speed and speed.per_s for name, speed in found.items()}
    per_s |= {name: got[name].per_s for name in view.running if got[name].per_s}
    reached = {name: p.env_steps for name, p in got.items()}
    without = {*view.done, *view.failed, *view.blocked}
    left = seconds_left(entries, reached, per_s, len(view.running) or workers, without)
    try:
        rundir.check_free(root)
        lines = ["no sweep is at work there"]
    except ConfigError as error:
        lines = [str(error).partition(": ")[2].partition(" is writing")[0] + " is at work there"]
    return [*table(root, entries, view, got, left), *lines]


def view_of_files(root: Path, entries: Mapping[str, Entry]) -> View:
    """What is how, as the files say."""
    view = View([], {}, [], {}, {}, {})
    for name, (run, config) in entries.items():
        try:
            state = states.look(root / name, config)
        except ConfigError as error:
            view.failed[name] = str(error)
            continue
        record = states.read_record(root, name)
        bad = next(
            (source for source in run.sources if source in view.failed or source in view.blocked), None
        )
        if state.kind == "done":
            view.done.append(name)
        elif state.kind == "busy" or (record is not None and states.alive(record)):
            view.running.append(name)  # in its first seconds a process does not hold the directory yet
        elif record is not None and record.ended is not None and record.status and record.reason:
            view.failed[name] = record.reason
        elif record is None and (reason := _failed(root / name)):  # it was not run by a sweep
            view.failed[name] = reason
        elif bad:
            view.blocked[name] = f"{bad} failed" if bad in view.failed else view.blocked[bad]
        elif record is not None and record.ended is None:
            view.waiting[name] = f"killed on {record.host}, after {state.env_steps:,} env steps"
        else:
            view.waiting[name] = state.reason if state.kind == "broken" else ""
    return view


def _failed(run: Path) -> str:
    """Why a run ended with an error, as its directory says; "" where it does not."""
    with contextlib.suppress(ConfigError):
        if (ended := ending.read(run)) is not None and ended.failed:
            return ended.reason
    return ""
