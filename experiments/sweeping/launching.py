"""Runs what a sweep has left to do, in the order in which runs need each other. Imports no jax.

Where runs are executed is a `Launcher`'s: processes of this machine (`local`), or tasks of Ray
(`ray_launcher`).
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError

from ..stopping import signals
from . import attempt, states
from .manifest import Entry


class Ended(NamedTuple):
    """How an attempt at a run ended.

    Attributes:
        name: of the run.
        status: its exit status, negative for a signal.
        reason: why it did not end well, or "".
        again: whether another attempt may be made.
    """

    name: str
    status: int
    reason: str = ""
    again: bool = True


class Launcher(Protocol):
    """Executes runs."""

    where: str  # said at the start
    workers: int  # runs at once

    def room(self, config: Config) -> bool:
        """Whether one more run can be started now."""

    def start(self, entry: Entry) -> None:
        """Starts a run, or resumes it.

        Raises:
            SaveError: nothing can be written.
        """

    def ended(self) -> list[Ended]:
        """Those that have ended since the last call; does not wait."""

    def stop(self) -> None:
        """Asks what runs to write a checkpoint and to end; `ended` tells when it has."""

    def close(self) -> None:
        """Called once, when nothing runs any more."""


class Outcome(NamedTuple):
    """How a sweep ended.

    Attributes:
        done: names of the runs that are complete.
        failed: {name: why}.
        blocked: {name: which run it would have started from failed}.
        signal: that stopped it; 0 for none.
    """

    done: list[str]
    failed: dict[str, str]
    blocked: dict[str, str]
    signal: int = 0

    @property
    def status(self) -> int:
        """The exit status of the sweep: 0 if every run is complete."""
        if self.signal:
            return 128 + self.signal
        return int(bool(self.failed or self.blocked))


class View(NamedTuple):
    """What a table shows of a sweep that runs.

    Attributes:
        running: names, in the order in which they were started.
        waiting: {name: what for}.
        done, failed, blocked: as of `Outcome`.
        attempts: {name: how often it was started by this sweep}.
    """

    running: list[str]
    waiting: dict[str, str]
    done: list[str]
    failed: dict[str, str]
    blocked: dict[str, str]
    attempts: dict[str, int]


class Screen(Protocol):
    """Shows a sweep."""

    def update(self, view: View, *, final: bool = False) -> None:
        """Shows it, if it is time to."""

    def note(self, text: str) -> None:
        """Shows a line of its own."""


def launch(
    root: Path,
    entries: Mapping[str, Entry],
    launcher: Launcher,
    screen: Screen,
    *,
    retries: int,
    every_s: float = 0.2,
) -> Outcome:
    """Runs what is missing or broken; returns when nothing is left to do, or a signal has come.

    Args:
        root: of the sweep, absolute; held by this process.
        entries: {name: Entry}, each after those that it starts from, which are all among them.
        launcher: executes them.
        screen: shows them.
        retries: how often a run that crashed is resumed.
        every_s: how often to look, in seconds.

    Raises:
        SaveError: nothing more can be written; what ran has been stopped.
        ConfigError: a directory holds a run of another configuration; nothing was started.
    """
    sweep = _Sweep(root, entries, launcher, screen, retries)
    with signals() as caught:
        try:
            while not sweep.over:
                sweep.take_ended()
                if len(caught) > sweep.told:
                    sweep.stop(f"stopping: signal {caught[-1]}; each run writes a checkpoint")
                    sweep.told = len(caught)
                if not sweep.stopping:
                    sweep.start_next()
                screen.update(sweep.view())
                if not sweep.over:
                    time.sleep(every_s)
        except BaseException:
            sweep.stop("stopping: each run writes a checkpoint")
            while sweep.running:  # so that nobody writes on unknown
                sweep.take_ended()
                time.sleep(every_s)
            raise
    screen.update(sweep.view(), final=True)
    if sweep.disk:
        raise SaveError(sweep.disk)
    return Outcome(list(sweep.done), sweep.failed, sweep.blocked, caught[0] if caught else 0)


class _Sweep:
    def __init__(
        self, root: Path, entries: Mapping[str, Entry], launcher: Launcher, screen: Any, retries: int
    ):
        self.root, self.entries, self.launcher, self.screen = root, entries, launcher, screen
        self.retries = retries
        self.waiting = dict.fromkeys(entries, "")
        self.running: list[str] = []
        self.done: dict[str, None] = {}
        self.failed: dict[str, str] = {}
        self.blocked: dict[str, str] = {}
        self.attempts: dict[str, int] = {}
        self.ask_again: dict[str, float] = {}  # when, for those whose directory another process holds
        self.stopping, self.told, self.disk = False, 0, ""
        for name, state in look_at_all(root, entries).items():
            if state.kind == "done":
                self.waiting.pop(name)
                self.done[name] = None

    @property
    def over(self) -> bool:
        return not self.running and (self.stopping or not self.waiting)

    def view(self) -> View:
        return View(
            list(self.running), dict(self.waiting), list(self.done), dict(self.failed), dict(self.blocked),
            dict(self.attempts),
        )  # fmt: skip

    def stop(self, why: str) -> None:
        if self.running:
            self.screen.note(why)
        self.stopping = True
        self.launcher.stop()

    def take_ended(self) -> None:
        for name, status, reason, again in self.launcher.ended():
            self.running.remove(name)
            if status == 0:
                reason, again = self.why_not_done(name), False
                if not reason:
                    self.done[name] = None
                    continue
            if self.stopping:
                self.waiting[name] = "stopped"
            elif status == attempt.NO_SPACE:
                self.waiting[name] = reason
                self.disk = f"{name}: {reason}"
                self.stop(f"stopping: {self.disk}")
            elif again and attempt.retryable(status) and self.attempts[name] <= self.retries:
                self.screen.note(f"{name}: {reason}; resuming it")
                self.waiting = {name: reason, **self.waiting}
            else:
                self.failed[name] = reason
                self.screen.note(f"{name}: failed: {reason}")

    def why_not_done(self, name: str) -> str:
        """Why a run that has ended well is not complete; "" if it is."""
        try:
            state = states.look(self.root / name, self.entries[name].config)
        except ConfigError as error:  # other code was run than this process has
            return str(error)
        if state.kind == "done":
            return ""
        return f"ended with status 0 and is {state.kind} {state.reason}".rstrip()

    def start_next(self) -> None:
        now = time.monotonic()
        for name in list(self.waiting):
            entry = self.entries[name]
            if bad := next((s for s in entry.run.sources if s in self.failed or s in self.blocked), None):
                del self.waiting[name]
                self.blocked[name] = f"{bad} failed" if bad in self.failed else self.blocked[bad]
                continue
            if source := next((s for s in entry.run.sources if s not in self.done), None):
                self.waiting[name] = f"for {source}"
                continue
            if now < self.ask_again.get(name, 0.0) or not self.launcher.room(entry.config):
                continue
            try:
                state = states.prepare(self.root / name, entry.config, self.screen.note)
            except ConfigError as error:  # it was as it should be when the sweep began; the others may go on
                del self.waiting[name]
                self.failed[name] = str(error)
                self.screen.note(f"{name}: failed: {error}")
                continue
            if state.kind == "busy":
                self.ask_again[name] = now + 1.0
                self.waiting[name] = state.reason
                continue
            del self.waiting[name]
            if state.kind == "done":  # another process has ended it
                self.done[name] = None
                continue
            self.launcher.start(entry)
            self.attempts[name] = self.attempts.get(name, 0) + 1
            self.running.append(name)


def look_at_all(root: Path, entries: Mapping[str, Entry]) -> dict[str, states.State]:
    """{name: how far it is}; see `states.look`.

    Raises:
        ConfigError: a directory holds a run of another configuration.
    """
    return {name: states.look(root / name, entry.config) for name, entry in entries.items()}


def check_order(entries: Sequence[Entry]) -> None:
    """Whether each run comes after those that it starts from.

    Raises:
        ValueError: one does not.
    """
    seen: set[str] = set()
    for entry in entries:
        if missing := [name for name in entry.run.sources if name not in seen]:
            raise ValueError(f"{entry.run.name} comes before {missing[0]}, from which it starts")
        seen.add(entry.run.name)
