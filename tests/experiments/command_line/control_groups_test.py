"""Limits of control groups, in made-up trees of version 1, version 2, and both."""

import os

import pytest

from experiments.command_line import control_groups, runtime
from experiments.sweeping import launching

GIB = 2**30


@pytest.fixture
def tree(tmp_path):
    """A function that makes a file system: this process' groups, what is mounted, and {path: content}."""

    def make(mine, mounts, files):
        files = {"proc/self/cgroup": mine, "proc/self/mountinfo": mounts, **files}
        files.setdefault("proc/meminfo", "MemTotal: 99999999 kB\nMemAvailable: 33554432 kB\n")  # 32 GiB
        for name, content in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{content}\n")
        return tmp_path

    return make


V2 = "0::/slurm/job_7/step_0"
V2_MOUNT = "31 23 0:28 / /sys/fs/cgroup rw,nosuid shared:9 - cgroup2 cgroup2 rw,nsdelegate"
V1 = "9:name=systemd:/\n4:memory:/docker/ab\n3:cpu,cpuacct:/docker/ab\n0::/"
V1_MOUNTS = """31 23 0:28 / /sys/fs/cgroup rw - tmpfs tmpfs rw,mode=755
32 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct
35 31 0:32 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory
41 31 0:38 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw"""


def test_a_job_below_the_root_of_version_2(tree):
    group = "sys/fs/cgroup/slurm"
    root = tree(
        V2,
        V2_MOUNT,
        {
            f"{group}/job_7/step_0/memory.max": "max",
            f"{group}/job_7/step_0/memory.current": GIB,
            f"{group}/job_7/memory.max": 4 * GIB,
            f"{group}/job_7/memory.current": 3 * GIB,
            f"{group}/job_7/memory.stat": f"anon 5\ninactive_file {GIB}\n",
            f"{group}/memory.max": 100 * GIB,
            f"{group}/memory.current": 5 * GIB,
            f"{group}/job_7/step_0/cpu.max": "max 100000",
            f"{group}/job_7/cpu.max": "250000 100000",
            f"{group}/cpu.max": "800000 100000",
        },
    )
    # 4 GiB less 3, one of which is of files that nobody uses.
    assert control_groups.free_bytes(root) == control_groups.free_memory(root) == 2 * GIB
    assert control_groups.cores(root) == 3  # of 2.5


def test_a_container_of_version_1(tree):
    memory, cpu = "sys/fs/cgroup/memory/docker/ab", "sys/fs/cgroup/cpu,cpuacct/docker/ab"
    root = tree(
        V1,
        V1_MOUNTS,
        {
            f"{memory}/memory.limit_in_bytes": 2 * GIB,
            f"{memory}/memory.usage_in_bytes": GIB // 2,
            "sys/fs/cgroup/memory/memory.limit_in_bytes": 9223372036854771712,
            "sys/fs/cgroup/memory/memory.usage_in_bytes": 7 * GIB,
            f"{cpu}/cpu.cfs_quota_us": 50000,
            f"{cpu}/cpu.cfs_period_us": 100000,
            "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": -1,
            "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": 100000,
        },
    )
    assert control_groups.free_memory(root) == 3 * GIB // 2
    assert control_groups.cores(root) == 1  # half of one


@pytest.mark.parametrize(
    "mine, seen_from",
    [
        ("0::/docker/ab", "/docker/ab"),  # its group is mounted, and named from the machine's root
        ("0::/", "/"),  # a namespace of its own
        ("0::/../other", "/"),  # out of sight
        ("0::/docker/ab", "/elsewhere"),
    ],
)
def test_what_is_mounted_is_what_counts(tree, mine, seen_from):
    mount = f"31 23 0:28 {seen_from} /sys/fs/cgroup\\040x rw - cgroup2 cgroup2 rw"
    files = {"sys/fs/cgroup x/memory.max": GIB, "sys/fs/cgroup x/memory.current": 2 * GIB}
    root = tree(mine, mount, {**files, "sys/fs/cgroup x/cpu.max": "400000 100000", "sys/memory.max": 5})
    assert control_groups.folders(root) == [root / "sys/fs/cgroup x"]
    assert control_groups.free_memory(root) == 0 and control_groups.cores(root) == 4


@pytest.mark.parametrize("mine, mounts", [("", ""), (V2, V2_MOUNT), (V1, V1_MOUNTS), ("x\n:\n::", "y - z")])
def test_without_a_limit_the_machine_is_what_there_is(tree, tmp_path, mine, mounts):
    assert control_groups.free_memory(tmp_path) is None  # not Linux
    root = tree(mine, mounts, {"sys/fs/cgroup/cpu.max": "max 100000", "sys/fs/cgroup/memory.max": "max"})
    assert control_groups.free_bytes(root) is None and control_groups.cores(root) is None
    assert control_groups.free_memory(root) == 32 * GIB


@pytest.mark.parametrize("allowed, found", [(None, 3), (1, 1), (2, 2), (64, 3)])
def test_cores_are_those_that_affinity_and_groups_allow(monkeypatch, allowed, found):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 5, 7}, raising=False)
    monkeypatch.setattr(control_groups, "cores", lambda: allowed)
    monkeypatch.setattr(runtime, "has_gpu", lambda env: False)
    assert runtime.cores() == launching.most_workers() == found
