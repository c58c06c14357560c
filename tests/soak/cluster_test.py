"""A sweep on a Ray cluster of two nodes, simulated on this machine, that loses workers and then a node.

Every run must be complete once in the end, with the rows and parameters of the same sweep run by the local
launcher and left alone, bit for bit.
"""

import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

from srl_jax.run import ending
from tests.soak.conftest import ROOT
from tests.soak.sweeps_test import SMALL, check_runs, command, descendants, left_alone, parent, runs_of

pytest.importorskip("ray")

ARMS = ("frozen_256", "joint_256", "rl_only_256")
FLAGS = (f"--presets={','.join(f'small/{arm}' for arm in ARMS)}", *SMALL)
SLOTS = 2
"""CPUs that each of the two nodes says that it has."""


def title(pid):
    """A process's command line, or ""."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace")
    except OSError:
        return ""


def workers(raylet):
    """{process of a run: the Ray worker that has started it}, of a node."""
    found = {pid: parent(pid) for pid in descendants(raylet)}
    return {pid: its for pid, its in found.items() if its and title(its).startswith("ray::")}


def finished(root):
    """How many runs of a sweep are complete."""
    ends = [ending.read(root / name) for name in runs_of(root)]
    return sum(end is not None and end.status == "finished" for end in ends)


def disturb(sweep, cluster, second, root, total, kills, say):
    """Kills so many workers of a cluster while a sweep runs, and removes the node when it can.

    Returns:
        How many workers were killed, and how many runs the second node had when it was removed.
    """
    draw, killed, lost = random.Random(0), 0, 0
    raylets = [node.all_processes["raylet"][0].process.pid for node in (cluster.head_node, second)]
    next_kill = time.monotonic() + draw.uniform(8.0, 16.0)
    while sweep.poll() is None:
        time.sleep(0.2)
        both = workers(raylets[0]) | ({} if lost else workers(raylets[1]))
        if killed < kills and both and time.monotonic() > next_kill:
            worker = both[draw.choice(sorted(both))]
            say(f"kills worker {worker}; {finished(root)} of {total} runs are complete")
            os.kill(worker, signal.SIGKILL)
            killed += 1
            next_kill = time.monotonic() + draw.uniform(4.0, 10.0)
        elif not lost and killed >= (kills + 1) // 2 and finished(root) >= total / 4:
            if lost := len(workers(raylets[1])):
                say(f"removes a node that runs {lost}")
                cluster.remove_node(second, allow_graceful=False)
    return killed, lost


@pytest.mark.filterwarnings("ignore")  # of Ray, about itself
def test_a_cluster_that_loses_workers_and_a_node_ends_with_the_same_runs(
    tmp_path, amount, say, record_property, monkeypatch
):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    kills, seeds = amount("worker_kills"), 2 if amount("worker_kills") > 1 else 1
    alone, spread, flags = tmp_path / "alone", tmp_path / "spread", (*FLAGS, f"--seeds={seeds}")
    left_alone([*command("sweep", alone, flags), "--workers=2"])
    node = {"num_cpus": SLOTS, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    try:
        second = cluster.add_node(**node)
        ray = ("--launcher=ray", f"--ray_address={cluster.address}", "--retries=5")
        with open(tmp_path / "errors.txt", "w+") as errors:
            line = command("sweep", spread, (*flags, *ray))
            sweep = subprocess.Popen(line, cwd=ROOT, stdout=errors, stderr=errors)
            killed, lost = disturb(sweep, cluster, second, spread, len(runs_of(alone)), kills, say)
            errors.seek(0)
            assert sweep.returncode == 0, errors.read()[-2000:]
    finally:
        cluster.shutdown()
    record_property("workers killed", killed)
    record_property("runs on the node that was removed", lost)
    check_runs(alone, spread, record_property)
