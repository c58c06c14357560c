"""Starts the workers of the chosen rows, has them take turns, and collects their replies."""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .rows import ARMS, CHECK_UPDATES, SERIES, Row, Side, series_of
from .worker import Worker

TOLERANCE = 1e-4
"""Largest relative difference of two losses that count as equal."""


class CheckFailed(RuntimeError):
    """The two sides do not compute the same."""


class Left:
    """A line on standard error: what is done now, and how long it all may still take.

    Args:
        total: seconds that all tasks are thought to take.
        stream: where to write; a terminal's line is rewritten.
        clock: seconds.
    """

    def __init__(
        self, total: float, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ):
        self._total, self._clock = total, clock
        self._stream = sys.stderr if stream is None else stream
        self._done = 0.0
        self._start = clock()

    @contextlib.contextmanager
    def task(self, text: str, seconds: float) -> Iterator[None]:
        """Shows a task that is thought to take so long; it has been done at the end."""
        left = self._total - self._done
        if self._done:
            left *= (self._clock() - self._start) / self._done
        self._write(f"{text}; about {left / 60:.1f} min left")
        yield
        self._done += seconds

    def end(self) -> None:
        """Clears a terminal's line."""
        if self._stream.isatty():
            self._write("")

    def _write(self, text: str) -> None:
        if self._stream.isatty():
            self._stream.write(f"\r\x1b[K{text[:100]}")
        else:
            self._stream.write(f"bench: {text}\n")
        self._stream.flush()


def difference(ours: Sequence[Mapping[str, float]], theirs: Sequence[Mapping[str, float]]) -> float:
    """The largest relative difference of the losses of the same updates.

    Raises:
        CheckFailed: they are not the same updates or losses.
    """
    if [set(losses) for losses in ours] != [set(losses) for losses in theirs]:
        raise CheckFailed(f"the sides compute different losses: {ours} and {theirs}")
    found = [
        abs(own - their[name]) / max(abs(own), abs(their[name]), 1e-30)
        for mine, their in zip(ours, theirs, strict=True)
        for name, own in mine.items()
    ]
    return float(np.max(found))  # NaN where one is


class Results:
    """What was found.

    Attributes:
        replies: {series: the repetitions of each round}.
        checks: {arm: the largest relative difference of a loss}.
        versions: {worker: {package: version}}.
    """

    def __init__(self):
        self.replies: dict[str, list[list[float]]] = {}
        self.checks: dict[str, float] = {}
        self.versions: dict[str, dict[str, str]] = {}


def measure(
    rows: Mapping[str, Row],
    sides: Mapping[str, Side],
    *,
    rounds: int,
    start: Callable[[Side], Worker],
    threads: int,
    left: Left | None = None,
) -> Results:
    """Measures rows, group after group of workers.

    Args:
        rows: by name.
        sides: the workers that they need, by name.
        rounds: how often each worker takes its turn.
        start: starts a worker.
        threads: PyTorch's.
        left: where progress is shown; None: on standard error.

    Raises:
        experiments.benchmarks.worker.WorkerError: a worker failed.
        CheckFailed: the sides compute different losses.
    """
    results = Results()
    series = {name: SERIES[name] for row in rows.values() for name in series_of(row)}
    left = left or Left(estimate(sides, rounds))
    for group in dict.fromkeys(side.group for side in sides.values()):
        members = {name: side for name, side in sides.items() if side.group == group}
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            workers: dict[str, Worker] = {}
            losses: dict[str, dict[str, Any]] = {}
            for name, side in members.items():
                with left.task(f"{name}: starting", side.seconds[0]):
                    workers[name] = stack.enter_context(start(side))
                    if side.twin and side.twin not in losses:
                        losses[side.twin] = _check_twin(workers[side.twin], folder, side.twin)
                    _set_up(workers[name], name, side, threads, losses.get(side.twin), results)
            for number in range(rounds):
                for name, side in members.items():
                    if number < side.rounds:
                        with left.task(f"{name}: round {number + 1} of {rounds}", side.seconds[1]):
                            own = {key: one for key, one in series.items() if one.side == name}
                            _ask(workers[name], own, results)
    left.end()
    return results


def estimate(sides: Mapping[str, Side], rounds: int) -> float:
    """Seconds that all this is thought to take."""
    return sum(side.seconds[0] + min(rounds, side.rounds) * side.seconds[1] for side in sides.values())


def _check_twin(worker: Worker, folder: Path, name: str) -> dict[str, Any]:
    """This project's losses, and the files that the other side starts from."""
    own = folder / name
    own.mkdir()
    return worker.ask("check", folder=str(own), updates=CHECK_UPDATES)


def _set_up(
    worker: Worker, name: str, side: Side, threads: int, twin: dict[str, Any] | None, results: Results
) -> None:
    """The first requests of a worker, among them the comparison with its twin's losses."""
    extra = {"threads": threads} if side.needs else {}
    if twin is not None:
        extra |= {key: twin[key] for key in ("params", "window")}
    if side.setup:
        reply = worker.ask(**side.setup, **extra)
        results.versions[name] = reply.get("versions", {})
    if twin is not None:
        found = difference(twin["losses"], worker.ask("check", updates=CHECK_UPDATES)["losses"])
        arm, form = ARMS[name.split()[1]]
        arm += "" if form == "separate" else f" {form}"
        if not found <= TOLERANCE:
            raise CheckFailed(
                f"{name}: a loss differs by {found:.1e} of its value, more than {TOLERANCE:.0e}"
            )
        results.checks[arm] = max(found, results.checks.get(arm, 0.0))
    for request in side.warm:
        worker.ask(**request)


def _ask(worker: Worker, series: Mapping[str, Any], results: Results) -> None:
    """One turn of a worker: its series, equal requests once."""
    replies: list[tuple[dict, dict]] = []
    for name, one in series.items():
        reply = next((reply for request, reply in replies if request == one.request), None)
        if reply is None:
            reply = worker.ask(**one.request)
            replies.append((one.request, reply))
        results.replies.setdefault(name, []).append(one.pick(reply))
