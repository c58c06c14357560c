"""experiments/sweeping/ray_launcher.py: what a worker does; `tests/soak/cluster_test.py` has a cluster."""

import importlib.util
import json
import marshal
import subprocess
import sys
import threading

import pytest

from experiments.sweeping import ray_launcher
from srl_jax import rundir
from srl_jax.errors import ConfigError
from tests.sweep_test import RUNS, A, B, Sweep, resolve

CONFIGS = {name: config.to_json() for name, config in resolve(RUNS).items()}


@pytest.fixture
def here(tmp_path):
    stubs = Sweep(tmp_path / "root").acts(a=["exit:7", "end"], b=["wait"])

    def run(name):
        command = next(stubs.command(run) for run in RUNS if run.name == name)
        stop_file = str(tmp_path / "stop")
        return ray_launcher.run_here(str(stubs.root), name, command, CONFIGS[name], stop_file, 1, 0.0)

    return stubs, run


def test_a_task_runs_what_is_not_complete_and_returns_a_small_dict(here):
    stubs, run = here
    assert run(A) == {"status": 7, "reason": "status 7: ended on purpose 1"}
    assert run(A) == {"status": 0, "reason": ""}
    assert run(A) == {"status": 0, "reason": ""}  # a task that is started again after the end
    assert (stubs.count(A), stubs.count(A, "ends"), stubs.record(A).attempts) == (2, 1, 2)


def test_a_task_waits_for_the_runs_former_process(here, monkeypatch):
    stubs, run = here
    (stubs.root / B).mkdir(parents=True)
    monkeypatch.setattr(ray_launcher, "PATIENCE_S", 0.0)
    with rundir.held(stubs.root / B):
        told = run(B)
    assert told["status"] not in (0, 2, 3, 4) and "process" in told["reason"] and stubs.count(B) == 0


def test_a_task_is_stopped_by_a_file(here, tmp_path):
    stubs, run = here

    def stop():
        while not (stubs.root / B / "config.json").exists():
            pass
        (tmp_path / "stop").write_text("1\n")

    thread = threading.Thread(target=stop)
    thread.start()
    assert run(B) == {"status": 143, "reason": ""}
    thread.join()
    assert run(B) == {"status": 143, "reason": "stopped"} and stubs.count(B) == 1


def test_without_ray_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    stubs = Sweep(tmp_path / "new")
    with pytest.raises(ConfigError, match=r"pip install 'srl-jax\[ray\]'"):
        stubs.run(launcher="ray")
    assert not stubs.root.exists()


@pytest.mark.parametrize("address", ["localhost:1", "nowhere", "localhost:x", "localhost:99999999"])
def test_an_address_where_nobody_listens_is_refused_at_once(tmp_path, monkeypatch, address):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    stubs = Sweep(tmp_path / "new")
    with pytest.raises(ConfigError, match=f"--ray_address={address}: no Ray cluster: "):
        stubs.run(launcher="ray", ray_address=address)
    assert not stubs.root.exists()


def test_the_task_needs_nothing_but_its_texts(tmp_path):
    """A worker does not have the checkout on its path: the function that travels puts it there."""
    module = tmp_path / "experiments" / "sweeping" / "ray_launcher.py"
    module.parent.mkdir(parents=True)
    module.write_text("def run_here(*x): return {'got': x}")
    code = (
        "import json, marshal, sys, types; "
        "task = types.FunctionType(marshal.loads(bytes.fromhex(sys.argv[1])), {}); "
        "print(json.dumps(task(*sys.argv[2:], 'a', 1)))"
    )
    task = marshal.dumps(ray_launcher._task().__code__).hex()
    line = [sys.executable, "-I", "-c", code, task, str(tmp_path), ray_launcher.__name__]
    done = subprocess.run(line, capture_output=True, text=True)
    assert json.loads(done.stdout or "{}") == {"got": ["a", 1]}, done.stderr
