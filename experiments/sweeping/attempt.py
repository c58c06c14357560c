"""One attempt at a run: a process with the run's command line, its log and its record. Imports no jax."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from srl_jax.errors import EXIT_STATUS, ConfigError, Diverged, SaveError

from .. import PACKAGE
from . import machine, states
from .resolving import environment
from .states import Record

BAD_INPUT, NO_SPACE, DIVERGED = (EXIT_STATUS[kind] for kind in (ConfigError, SaveError, Diverged))


class Attempt:
    """A run's process, from its start to its end.

    It works in the sweep's root, in a session of its own: what a terminal sends to a sweep does not reach it.

    Args:
        root: the sweep's, absolute.
        name: of the run, and its directory below the root.
        command: its command line, with paths as they are under the root.
        cores: how many it keeps to.

    Raises:
        SaveError: its log cannot be written.
    """

    def __init__(self, root: Path, name: str, command: list[str], cores: int = 1):
        self.root, self.name, self.stopped = root, name, False
        self.cores = machine.lend(cores)
        before = states.read_record(root, name)
        log = states.log_path(root, name)
        numbers = ",".join(map(str, self.cores.numbers))
        watched = [sys.executable, "-m", f"{PACKAGE}.sweeping.child", str(os.getpid()), numbers, *command]
        attempts = before.attempts + 1 if before else 1
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            with open(log, "ab") as output:
                about = f"{time.strftime('%Y-%m-%d %H:%M:%S')} attempt {attempts} on {states.host()}"
                output.write(f"--- {about}, core {numbers or 'any'}: {' '.join(command)}\n".encode())
                output.flush()
                self.process = subprocess.Popen(
                    watched,
                    cwd=root,
                    env=environment(),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
        except OSError as error:
            self.cores.give_back()
            raise SaveError(f"{log}: {name} was not started: {error.strerror}") from error
        self.record = Record(
            states.host(), self.process.pid, self.cores.numbers, attempts, round(time.time(), 3)
        )
        self._write_record()

    def poll(self) -> Record | None:
        """The record once the process has ended, which is then written; None before."""
        status = self.process.poll()
        if status is None:
            return None
        self.cores.give_back()
        reason = "" if status == 0 or self.stopped else self._reason(status)
        self.record = self.record._replace(ended=round(time.time(), 3), status=status, reason=reason)
        self._write_record()
        return self.record

    def _write_record(self) -> None:
        # A record informs and decides nothing: a full disk, the run itself reports.
        with contextlib.suppress(SaveError):
            states.write_record(self.root, self.name, self.record)

    def _reason(self, status: int) -> str:
        if status < 0:
            return f"killed by {signal.Signals(-status).name}"
        line = states.last_line(self.root, self.name)
        if line.startswith("---"):
            line = "no output"
        return line if status in (BAD_INPUT, NO_SPACE, DIVERGED) else f"status {status}: {line}"

    def stop(self) -> None:
        """Asks the process to write a checkpoint and end; a second time, to end at once."""
        self.stopped = True
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)


def retryable(status: int) -> bool:
    """Whether a run that ended so may end otherwise when it is resumed."""
    return status not in (0, BAD_INPUT, NO_SPACE, DIVERGED)
