"""A sweep on a Ray cluster of two nodes, simulated on this machine, that loses workers and then a node.

Every run must be complete once in the end, with the rows and parameters of the same sweep run by the local
launcher and left alone, bit for bit.
"""

import importlib.util
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from ..flags import last_of_each
from ..sweeping import manifest, states
from . import Count, Say, sweeps

SWEEP = ("--presets=small/frozen_256,small/joint_256,small/rl_only_256", "--seeds=2", *sweeps.SMALL)
"""Ten runs."""

WORKERS_KILLED = 5
SLOTS = 2
"""CPUs that each of the two nodes says that it has."""


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    if importlib.util.find_spec("ray") is None:
        return [Count("a Ray cluster", 0, 0, "skipped: Ray is not installed")]
    alone, spread = folder / "alone", folder / "spread"
    flags = last_of_each((*SWEEP, "--seeds=1", "--steps=1600")) if short else SWEEP
    sweeps.left_alone(sweeps.command("sweep", alone, flags), say)
    detail = disturbed(spread, flags, 1 if short else WORKERS_KILLED, random.Random(0), say)
    return [sweeps.compared("a Ray cluster of two nodes", alone, spread, say, detail)]


def disturbed(root: Path, flags: tuple[str, ...], kills: int, draw: random.Random, say: Say) -> str:
    """Runs the sweep on a cluster, killing workers and, when half of the runs are complete, a node.

    Returns:
        What was done to it.

    Raises:
        RuntimeError: the sweep failed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": SLOTS, "object_store_memory": 80 * 2**20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    try:
        del node["include_dashboard"]
        second = cluster.add_node(**node)
        line = [sys.executable, "-m", "experiments.sweep", *flags, f"--out={root}", "--launcher=ray"]
        line += [f"--ray_address={cluster.address}", "--retries=5"]
        say(f"cluster: {' '.join(line)}")
        errors = root.parent / "errors.txt"
        with open(errors, "w") as file:
            sweep = subprocess.Popen(line, cwd=sweeps.CHECKOUT, stderr=file)
            killed, lost = _disturb(sweep, cluster, second, root, kills, draw, say)
        if sweep.returncode:
            raise RuntimeError(f"status {sweep.returncode}: {errors.read_text()[-2000:]}")
    finally:
        cluster.shutdown()
    attempts = sum(states.read_record(root, name).attempts for name in manifest.read(root))
    node = f"a node removed with {lost} runs on it" if lost else "no node removed"
    return f"{killed} workers killed, {node}; {attempts} attempts in all"


def _disturb(
    sweep, cluster, second, root: Path, kills: int, draw: random.Random, say: Say
) -> tuple[int, int]:
    """Returns how many workers were killed, and how many runs the second node had when it was removed."""
    raylet = second.all_processes["raylet"][0].process.pid
    killed, lost, next_kill = 0, None, time.monotonic() + draw.uniform(8.0, 16.0)
    while sweep.poll() is None:
        time.sleep(0.2)
        entries = manifest.read(root) if (root / manifest.FILE).exists() else {}
        records = {name: states.read_record(root, name) for name in entries}
        running = {name: r.pid for name, r in records.items() if r and r.ended is None and _parent(r.pid)}
        if killed < kills and running and time.monotonic() > next_kill:
            name = draw.choice(sorted(running))
            worker = _parent(running[name])
            if worker and worker != os.getpid() and "ray::" in _title(worker):
                say(f"cluster: kills the worker of {name}")
                os.kill(worker, signal.SIGKILL)
                killed += 1
                next_kill = time.monotonic() + draw.uniform(4.0, 10.0)
        done = sum(1 for r in records.values() if r and r.status == 0)
        here = [name for name, pid in running.items() if _parent(_parent(pid) or 0) == raylet]
        if lost is None and here and done >= len(entries) / 4 and killed >= (kills + 1) // 2:
            say(f"cluster: removes a node that runs {', '.join(here)}")
            lost = len(here)
            cluster.remove_node(second, allow_graceful=False)
    return killed, lost or 0


def _parent(pid: int) -> int | None:
    """The process that has started one; None where that one has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else int(fields[1])


def _title(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace")
    except OSError:
        return ""
