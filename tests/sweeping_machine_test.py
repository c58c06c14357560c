"""experiments/sweeping/machine.py and local.py: how many runs there is room for, and which cores they get."""

import errno
import fcntl
import os
import sys
from collections import Counter

import pytest

from experiments.sweeping import local, machine
from srl_jax.config import Config


def test_a_run_takes_its_buffer_and_the_rest():
    # The thesis' buffer: 100,000 frames of 84 x 84 bytes.
    assert machine.run_bytes(Config()) == 600 * 1024**2 + 705_600_000


def test_as_many_runs_as_memory_and_cores_allow(tmp_path, monkeypatch):
    config = Config()
    monkeypatch.setattr(machine, "most_workers", lambda: 8)
    monkeypatch.setattr(machine, "free_bytes", lambda: 2.5 * machine.run_bytes(config) / machine.SHARE)
    launcher = local.Local(tmp_path)
    assert launcher.workers == 8
    started = 0
    while launcher.room(config):
        launcher.attempts[started] = None, machine.run_bytes(config)
        started += 1
    assert started == 2
    # Who says how many gets them; a single one always fits.
    assert local.Local(tmp_path, workers=3).room(config)
    monkeypatch.setattr(machine, "free_bytes", lambda: 0)
    assert local.Local(tmp_path).room(config)
    assert local.Local(tmp_path, cores_per_run=3).workers == 2


@pytest.mark.skipif(sys.platform != "linux", reason="affinity is Linux'")
def test_cores_are_lent_to_one_run_each(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 5, 7})
    monkeypatch.setattr(machine, "_lent", Counter())
    lent = [machine.lend(1, tmp_path) for _ in range(3)]
    assert [x.numbers for x in lent] == [(2,), (5,), (7,)]
    shared = machine.lend(2, tmp_path)  # none is free: as many as it has alone
    assert len(set(shared.numbers)) == 2 and set(shared.numbers) < {2, 5, 7}
    third = {2, 5, 7} - set(shared.numbers)  # what all have shared least
    assert set(machine.lend(1, tmp_path).numbers) == third
    lent[1].give_back()
    lent[1].give_back()  # nothing is left to give
    lent[1] = machine.lend(1, tmp_path)
    assert lent[1].numbers == (5,)
    assert len(machine.lend(9, tmp_path).numbers) == 3
    for x in lent:
        x.give_back()


@pytest.mark.skipif(sys.platform != "linux", reason="affinity is Linux'")
def test_runs_of_a_sweep_have_a_core_each_where_files_cannot_be_locked(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 5, 7})
    monkeypatch.setattr(machine, "_lent", Counter())
    assert sorted(machine.lend(1, tmp_path).numbers[0] for _ in range(3)) == [2, 5, 7]


def test_a_gpu_has_one_run_and_all_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "has_gpu", lambda: True)
    assert machine.most_workers() == 1
    assert machine.lend(1, tmp_path).numbers == ()
