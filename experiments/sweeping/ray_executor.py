"""A Ray cluster as an executor. Imports no jax, and Ray only when a sweep uses it.

A run is a task, which has a process of its own. Every node sees the sweep's directory under the same path,
as it does the checkout and the interpreter. When a worker or its node is lost, Ray starts the task again
elsewhere, and the run is resumed from its own checkpoint. The lock of a run directory goes with the process
that has it, so the task waits until the run's former process has ended. A file system that nodes share has to
have such locks, as NFS 4 does; there, those of a node that is lost go when its lease ends.
"""

import concurrent.futures as cf
import functools
import importlib.util
import os
import socket
from collections.abc import Callable
from typing import Any

from srl_jax.errors import ConfigError

from .launching import python_path

STORE_BYTES = 80 * 2**20
"""Of the object store, for which Ray wants at least 75 MiB. No data goes through it."""


class Ray(cf.Executor):
    """Calls functions as tasks of Ray.

    Args:
        cpus: cores that a task is given.
        gpus: GPUs that a task is given; less than 1 shares one.
        retries: how often a task is started again whose worker or node was lost.
        address: of a cluster, HOST:PORT or auto; None starts one on this machine.

    Raises:
        ConfigError: Ray is not installed, or there is no cluster, or none of its nodes has room for a task.
    """

    def __init__(self, cpus: int, gpus: float, retries: int, address: str | None):
        if importlib.util.find_spec("ray") is None:
            raise ConfigError("--launcher=ray: needs Ray, pip install 'srl-jax[ray]'")
        _check_address(address)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray

        variables = {"PYTHONPATH": python_path()}
        if gpus == 0:
            variables["JAX_PLATFORMS"] = os.environ.get("JAX_PLATFORMS", "cpu")
        elif gpus < 1:
            variables["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 * gpus:.3f}"
        own = {} if address else {"object_store_memory": STORE_BYTES, "include_dashboard": False}
        try:
            ray.init(
                address or "local",
                log_to_driver=False,
                logging_level="ERROR",
                runtime_env={"env_vars": variables},
                **own,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            line = str(error).strip().split("\n")[0]
            raise ConfigError(f"--ray_address={address}: no Ray cluster: {line}") from None
        self.ray, self.cpus, self.gpus = ray, cpus, gpus
        options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": retries, "retry_exceptions": False}
        self.remote = functools.cache(lambda function: ray.remote(function).options(**options))
        if not self.capacity():
            self.shutdown()
            raise ConfigError(
                f"--cpus_per_run={cpus}: no node of the cluster has so many CPUs, and {gpus:g} GPUs"
            )

    def submit(self, function: Callable[..., Any], /, *args: Any) -> cf.Future:
        return self.remote(function).remote(*args).future()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self.ray.shutdown()

    def capacity(self) -> int:
        """Tasks for which the cluster has room, all nodes that are alive together."""
        total = 0
        for node in self.ray.nodes():
            if node["Alive"]:
                room = int(node["Resources"].get("CPU", 0) // self.cpus)
                gpus = node["Resources"].get("GPU", 0)
                total += min(room, int(gpus / self.gpus + 1e-9)) if self.gpus else room
        return total


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
