"""Runs as processes of this machine, each on a core of its own. Imports no jax."""

from collections.abc import Callable
from pathlib import Path

from srl_jax.config import Config

from . import machine, plan, states
from .attempt import Attempt
from .launching import Ended
from .manifest import Entry


class Local:
    """A `launching.Launcher`.

    A run that has one core to itself is slower than one that has two, and two of them are faster than that.

    Args:
        root: of the sweep, absolute.
        workers: runs at once; None: one a core, as far as memory allows, and one in all on a GPU.
        cores_per_run: that a run keeps to.
        command: the command line of a run.
    """

    def __init__(
        self,
        root: Path,
        workers: int | None = None,
        cores_per_run: int = 1,
        command: Callable[[plan.Planned], list[str]] = plan.command,
    ):
        self.root, self.command, self.cores_per_run = root, command, cores_per_run
        self.workers = workers or max(machine.most_workers() // cores_per_run, 1)
        # Who says how many also says that there is memory for them.
        free = machine.free_bytes() if workers is None else None
        self.memory = None if free is None else free * machine.SHARE
        self.attempts: dict[str, tuple[Attempt, int]] = {}
        self.where = f"{self.workers} at once on {states.host()}"

    def room(self, config: Config) -> bool:
        if len(self.attempts) >= self.workers:
            return False
        taken = sum(size for _, size in self.attempts.values())
        return not self.attempts or self.memory is None or taken + machine.run_bytes(config) <= self.memory

    def start(self, entry: Entry) -> None:
        run = entry.run
        attempt = Attempt(self.root, run.name, self.command(run), self.cores_per_run)
        self.attempts[run.name] = attempt, machine.run_bytes(entry.config)

    def ended(self) -> list[Ended]:
        found = []
        for name, (attempt, _) in list(self.attempts.items()):
            if (record := attempt.poll()) is not None:
                del self.attempts[name]
                found.append(Ended(name, record.status, record.reason))
        return found

    def stop(self) -> None:
        for attempt, _ in self.attempts.values():
            attempt.stop()

    def close(self) -> None:
        pass
