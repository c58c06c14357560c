"""Runs as tasks of a Ray cluster, one task a run. Imports no jax, and Ray only when a sweep uses it.

A task gets texts and returns a small dict; everything else goes by way of the sweep's directory, which every
node sees under the same path, as it does the checkout and the interpreter. Of Ray it takes tasks, resources
and retries: when a worker or its node is lost, Ray starts the task again elsewhere, and the run is resumed
from its own checkpoint. The lock of a run directory is an flock: it goes with the process that has it, so a
task that is started again waits until the run's former process has ended. A file system that nodes share has
to have such locks, as NFS 4 does; there, those of a node that is lost go when its lease ends.
"""

import importlib.util
import os
import signal
import socket
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.reading import read_bytes

from . import attempt, machine, manifest, plan, states
from .launching import Ended
from .manifest import Entry
from .resolving import INSTALLED

PATIENCE_S = 600.0
"""How long a task waits for another process to leave its run's directory, in seconds."""

STORE_BYTES = 80 * 2**20
"""Of the object store, for which Ray wants at least 75 MiB. No data goes through it."""

OPTIONS = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}


class Ray:
    """A `launching.Launcher`.

    Args:
        root: of the sweep, absolute; on every node the same directory.
        workers: runs at once; None: as many as the cluster has room for.
        cpus_per_run: cores that a run is given, and keeps to.
        gpus_per_run: GPUs that a run is given; less than 1 shares one.
        retries: how often a run is resumed whose worker or node was lost.
        address: of a cluster, HOST:PORT or auto; None starts one on this machine.
        command: the command line of a run.

    Raises:
        ConfigError: Ray is not installed, or there is no cluster, or none of its nodes has room for a run.
    """

    def __init__(
        self,
        root: Path,
        workers: int | None,
        cpus_per_run: int,
        gpus_per_run: float,
        retries: int,
        address: str | None,
        command: Callable[[plan.Planned], list[str]],
    ):
        if importlib.util.find_spec("ray") is None:
            raise ConfigError("--launcher=ray: needs Ray, pip install 'srl-jax[ray]'")
        _check_address(address)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray

        self.ray, self.root, self.command, self.given = ray, root, command, workers
        self.cpus, self.gpus = cpus_per_run, gpus_per_run
        try:
            if address is None:
                ray.init(object_store_memory=STORE_BYTES, **OPTIONS)
            else:
                ray.init(address=address, **OPTIONS)
        except (ConnectionError, ValueError, RuntimeError) as error:
            line = str(error).strip().split("\n")[0]
            raise ConfigError(f"--ray_address={address}: no Ray cluster: {line}") from None
        self.task = ray.remote(_task()).options(
            num_cpus=cpus_per_run, num_gpus=gpus_per_run, max_retries=retries, retry_exceptions=False
        )
        self.flying: dict[Any, str] = {}
        self.stops = 0
        self.asked_at, self.most = float("-inf"), 1
        self.stop_file = root / "state" / f"stop-{uuid.uuid4().hex}"
        if not self.capacity():
            raise ConfigError(
                f"--cpus_per_run={cpus_per_run}: no node of the cluster has so many CPUs, and "
                f"{gpus_per_run:g} GPUs"
            )
        self.where = f"{self.workers} at once on {len(self.nodes())} nodes of Ray"

    @property
    def workers(self) -> int:
        """Runs at once; it changes where nodes come and go."""
        if self.given:
            return self.given
        if time.monotonic() - self.asked_at > 5.0:
            self.asked_at, self.most = time.monotonic(), max(self.capacity(), 1)
        return self.most

    def nodes(self) -> list[dict]:
        """Resources of the nodes that are alive."""
        return [node["Resources"] for node in self.ray.nodes() if node["Alive"]]

    def capacity(self) -> int:
        """Runs for which the cluster has room, all nodes together."""
        total = 0
        for node in self.nodes():
            room = int(node.get("CPU", 0) // self.cpus)
            total += min(room, int(node.get("GPU", 0) / self.gpus + 1e-9)) if self.gpus else room
        return total

    def room(self, config: Config) -> bool:
        return len(self.flying) < self.workers

    def start(self, entry: Entry) -> None:
        run, config = entry
        texts = str(self.root), run.name, self.command(run), config.to_json(), str(self.stop_file)
        self.flying[self.task.remote(str(INSTALLED), __name__, *texts, self.cpus, self.gpus)] = run.name

    def ended(self) -> list[Ended]:
        if not self.flying:
            return []
        ready, _ = self.ray.wait(list(self.flying), num_returns=len(self.flying), timeout=0)
        found = []
        for reference in ready:
            name = self.flying.pop(reference)
            try:
                told = self.ray.get(reference)
                found.append(Ended(name, told["status"], told["reason"]))
            except self.ray.exceptions.RayError as error:
                # Its worker was lost more often than there are retries, or the task has a mistake.
                line = next(filter(None, str(error).split("\n")), type(error).__name__)
                found.append(Ended(name, 1, f"{type(error).__name__}: {line:.300}", again=False))
        return found

    def stop(self) -> None:
        # A file, which tasks look for: Ray's way to cancel one is Ctrl-C, to which a sweep that a script has
        # started in the background is deaf, and its workers are, too.
        self.stops += 1
        manifest.replace(self.stop_file, f"{self.stops}\n")

    def close(self) -> None:
        self.stop_file.unlink(missing_ok=True)
        self.ray.shutdown()


def _check_address(address: str | None) -> None:
    """Whether somebody listens at HOST:PORT: Ray itself would try for a quarter of an hour.

    Raises:
        ConfigError: nobody does.
    """
    if address is None or address == "auto" or "://" in address:
        return
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except (OSError, ValueError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"--ray_address={address}: no Ray cluster: {why}; give HOST:PORT or auto") from None


def _task() -> Callable[..., dict]:
    """What a worker executes. Made in a function, so that its code travels and the worker can find ours."""

    def attempt_run(path: str, module: str, *arguments: Any) -> dict:
        import importlib
        import sys

        if path not in sys.path:
            sys.path.insert(0, path)
        return importlib.import_module(module).run_here(*arguments)

    return attempt_run


def run_here(
    root: str, name: str, command: list[str], config: str, stop_file: str, cpus: int, gpus: float
) -> dict:
    """Runs or resumes a run in this process' own child, and waits for it.

    Args:
        root: of the sweep.
        name: of the run.
        command: its command line.
        config: its configuration, JSON.
        stop_file: says how often a stop was asked for; none is there before.
        cpus, gpus: that it has.

    Returns:
        {"status", "reason"}: as of `states.Record`; 0 also where the run was complete already.
    """
    _limit_gpu(gpus)
    home = Path(root)
    notes: list[str] = []
    deadline = time.monotonic() + PATIENCE_S
    while (state := states.prepare(home / name, Config.from_json(config), notes.append)).kind == "busy":
        if time.monotonic() > deadline:
            return {"status": os.EX_TEMPFAIL, "reason": state.reason}
        time.sleep(0.5)
    if state.kind == "done":
        return {"status": 0, "reason": ""}
    if _stops(stop_file):
        return {"status": 128 + signal.SIGTERM, "reason": "stopped"}
    child, stops = attempt.Attempt(home, name, command, cpus), 0
    while (record := child.poll()) is None:
        if _stops(stop_file) > stops:
            stops += 1
            child.stop()
        time.sleep(0.2)
    return {"status": record.status, "reason": record.reason}


def _stops(stop_file: str) -> int:
    """How often a stop was asked for."""
    try:
        return int(read_bytes(stop_file, 100))
    except (OSError, ValueError):
        return 0


def _limit_gpu(gpus: float) -> None:
    """What the run's process shall know of GPUs, in the environment that it inherits."""
    if not gpus and machine.has_gpu():
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    elif 0 < gpus < 1:
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 * gpus:.3f}")
