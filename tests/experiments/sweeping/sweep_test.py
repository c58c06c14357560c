"""experiments/sweep.py and how its runs are run; training is played by stub_run.py."""

import concurrent.futures as cf
import dataclasses
import importlib.util
import json
import os
import pathlib
import pickle
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from experiments import sweep
from experiments.command_line import runtime
from experiments.sweeping import launching, manifest, states, status
from experiments.sweeping.manifest import Entry
from experiments.sweeping.plan import Planned
from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files import checkpoint, resuming, rundir
from srl_jax.run import ending
from srl_jax.run.ending import Ending
from srl_jax.training import completed

STUB = pathlib.Path(__file__).with_name("stub_run.py")
CONFIG = Config(game="Catch", frame_size=42, steps=500, checkpoint_every=100, num_envs=4, learn_start=40)
A, B, C = "Catch/a/seed0", "Catch/b/seed0", "Catch/c/seed0"


def entry(name, encoder_from=""):
    run = Planned(name, "catch/joint", {"game": "Catch", "seed": "0"}, encoder_from)
    return Entry(run, dataclasses.replace(CONFIG, encoder_from=encoder_from))


ALL = {A: entry(A), B: entry(B), C: entry(C, A)}
"""Two, and one that starts from the first."""


def complete(run, config, state=None):
    """What a run leaves at its end."""
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": 500, "updates": 1}
    checkpoint.save(run, {"encoder": {"w": np.zeros(2)}}, config, state=state, **counts)
    row = {"kind": "eval", "env_steps": 500, "updates": 1, "wall_s": 5.0, "eval/return_mean": 0.5}
    (run / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    ending.write(run, Ending("finished", 500))


class Sweep:
    """A sweep of stubs in a directory."""

    def __init__(self, root):
        self.root = root

    def acts(self, **acts):
        for name, (_, config) in ALL.items():
            run = self.root / "stub" / f"{name}.run"
            if not run.exists():
                complete(run, config)
            about = {"config": dataclasses.asdict(config) | {"versions": {}}}
            about |= {"acts": acts.get(name.split("/")[1], ["end"])}
            run.with_suffix(".json").write_text(json.dumps(about))
        return self

    def run(self, *names, **how):
        entries = {name: ALL[name] for name in names or ALL}
        return launching.run_sweep(self.root, entries, **{"workers": 2, "command": self.command, **how})

    def command(self, planned):
        return [sys.executable, "-S", "-E", str(STUB), str(self.root), planned.name]

    def count(self, what="attempts"):
        paths = [self.root / "stub" / f"{name}.{what}" for name in ALL]
        return [len(path.read_text().splitlines()) if path.exists() else 0 for path in paths]

    def seen(self):
        return status.view(self.root, ALL)

    def wait_for(self, name, attempts=1):
        deadline, lock = time.monotonic() + 120, self.root / name / "lock"
        while self.count()[list(ALL).index(name)] < attempts or not lock.exists() or not lock.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.01)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(launching, "EVERY_S", 0.02)


@pytest.fixture
def stubs(tmp_path):
    return Sweep(tmp_path / "root").acts()


def test_runs_are_run_once_and_after_what_they_start_from(stubs, capsys):
    assert stubs.run() == 0
    began = {}
    for name in ALL:
        in_root, began[name] = (stubs.root / "stub" / f"{name}.attempts").read_text().split()
        assert in_root == "True"
    assert float(began[C]) > float(began[A])
    said = capsys.readouterr().err
    assert f"{C}: done, 500 env steps in 0:00:05, last evaluation 0.5" in said
    assert said.endswith("sweep: 3 of 3 runs done\n")
    # Again: nothing is left to do.
    before = {p: p.read_bytes() for p in stubs.root.rglob("*") if p.is_file()}
    assert stubs.run() == 0
    assert {p: p.read_bytes() for p in stubs.root.rglob("*") if p.is_file()} == before


def test_crashes_are_resumed_and_what_starts_from_a_failed_run_is_blocked(stubs, capsys):
    stubs.acts(a=["kill", "exit:1", "exit:7"], b=["exit:2"])
    assert stubs.run(retries=2) == 1
    assert stubs.count() == [3, 1, 0]
    assert stubs.seen() == {
        A: ("failed", "status 7: ended on purpose 3"),
        B: ("failed", "ended on purpose 1"),  # bad input: no second attempt
        C: ("blocked", f"{A} failed"),
    }
    said = capsys.readouterr().err
    assert f"{A}: killed by SIGKILL; resuming it" in said and f"{C}: blocked: {A} failed" in said
    # Given again, the command tries what is not complete, and what is wrong is forgotten until it is again.
    stubs.acts(b=["", "wait", "end"])
    thread = threading.Thread(target=stubs.run, kwargs={"retries": 0})
    thread.start()
    stubs.wait_for(B, 2)
    assert stubs.seen()[B][0] == "running" and "failed" not in dict(stubs.seen().values())
    (stubs.root / launching.STOP).unlink()  # also stops a sweep
    thread.join()
    assert stubs.seen()[B] == ("waiting", "") and stubs.run() == 0


def test_a_full_disk_stops_the_sweep(stubs, capsys):
    stubs.acts(a=["exit:3"], b=["wait"])
    with pytest.raises(SaveError, match=f"{A}: ended on purpose"):
        stubs.run()
    # The other run was told to write a checkpoint and end, and has: before it heard of signals, or after.
    assert states.look(stubs.root / B, CONFIG).kind in ("missing", "resumable")
    assert "stopping: Catch/a/seed0: ended on purpose 1; each run writes" in capsys.readouterr().err


@pytest.mark.parametrize("spoil", ["rows", "parameters"])
def test_a_run_that_ends_well_has_to_be_complete(stubs, spoil):
    assert stubs.run(B) == 0
    if spoil == "rows":
        (stubs.root / B / "metrics.jsonl").unlink()
    else:
        (stubs.root / B / "checkpoints/000000500/params.msgpack").write_bytes(b"12")
    stubs.acts(b=["lie"])
    assert stubs.run(B) == 1 and stubs.count()[1] == 2
    why = {"rows": "metrics.jsonl: No such file", "parameters": "params.msgpack has not the size"}[spoil]
    assert stubs.seen()[B][1].startswith(f"ended with status 0 and is resumable {why}")


def test_a_run_that_kept_its_replay_is_complete_once_it_has_finished(tmp_path):
    complete(tmp_path, CONFIG, checkpoint.State({}, {}, {}))
    CONFIG.save(tmp_path)
    assert states.look(tmp_path, CONFIG) == ("done", 500, "")
    ending.clear(tmp_path)
    assert states.look(tmp_path, CONFIG) == ("resumable", 500, "")


def test_a_run_that_was_killed_before_it_said_that_it_is_over_is_resumed(tmp_path):
    # Its parameters alone are left: it has done everything, and is no complete run for those who read it.
    complete(tmp_path, CONFIG)
    CONFIG.save(tmp_path)
    for how in (None, Ending("stopped", 500)):
        ending.clear(tmp_path)
        if how:
            ending.write(tmp_path, how)
        assert states.look(tmp_path, CONFIG) == ("resumable", 500, "ended.json, which says that it is over")
    assert resuming.say_finished(tmp_path, checkpoint.read_manifest(tmp_path))
    assert states.look(tmp_path, CONFIG) == ("done", 500, "")


def test_a_run_that_was_too_short_for_a_row_is_complete(tmp_path):
    complete(tmp_path, CONFIG)
    CONFIG.save(tmp_path)
    (tmp_path / "metrics.jsonl").write_bytes(b"")
    assert states.look(tmp_path, CONFIG) == ("done", 500, "")


def test_a_run_that_was_unpacked_is_done_if_it_had_finished(tmp_path):
    CONFIG.save(tmp_path)
    (tmp_path / "metrics.jsonl").write_text('{"kind": "eval", "env_steps": 500}\n')
    for how, kind in (("stopped", "resumable"), ("finished", "done")):
        ending.write(tmp_path, Ending(how, 500))
        assert states.look(tmp_path, CONFIG).kind == kind
    with pytest.raises(ConfigError, match="another configuration: "):
        states.look(tmp_path, dataclasses.replace(CONFIG, gamma=0.5))


def test_a_run_of_before_an_option_or_with_what_nothing_reads_is_the_run_that_was_planned(tmp_path):
    planned = completed(dataclasses.replace(CONFIG, rl="rainbow:hidden=8"))
    old = dataclasses.replace(planned, rl="rainbow:hidden=8,n_step=3", lr_srl=0.5)
    old.save(tmp_path)
    complete(tmp_path, old)
    assert states.look(tmp_path, planned) == ("done", 500, "")
    with pytest.raises(ConfigError, match="another configuration: rl is "):
        states.look(tmp_path, completed(dataclasses.replace(planned, rl="rainbow:hidden=9")))


def test_another_version_of_the_code_fails_its_run_and_not_the_sweep(stubs):
    """Runs are started with the code that lies there then, which somebody may have changed."""
    path = stubs.root / "stub" / f"{A}.json"
    content = json.loads(path.read_text())
    content["config"]["new"] = 1
    path.write_text(json.dumps(content))
    assert stubs.run() == 1
    seen = stubs.seen()
    assert "no field 'new'" in seen[A][1] and [seen[B][0], seen[C][0]] == ["done", "blocked"]
    with pytest.raises(ConfigError, match="no field 'new'"):  # and the next sweep says so at once
        stubs.run()


def test_a_changed_plan_is_merged(stubs):
    assert stubs.run(B) == stubs.run(A) == 0
    assert list(manifest.read(stubs.root)) == [B, A]
    assert stubs.count() == [1, 1, 0]
    before = (stubs.root / "sweep.json").read_bytes()
    longer = {B: entry(B)._replace(config=dataclasses.replace(CONFIG, steps=900))}
    with pytest.raises(ConfigError, match=r"b/seed0: .* steps is 500 there and 900 here; give the flags"):
        launching.run_sweep(stubs.root, longer)
    with pytest.raises(ConfigError, match="a run directory; name another one"):
        launching.run_sweep(stubs.root / B, longer)
    assert (stubs.root / "sweep.json").read_bytes() == before


def test_seeds_of_other_settings_are_no_seeds_of_an_arm_that_is_there(stubs):
    assert stubs.run(A) == 0
    before = (stubs.root / "sweep.json").read_bytes()
    name, (run, config) = A.replace("seed0", "seed1"), ALL[A]
    other = {name: Entry(run._replace(name=name), dataclasses.replace(config, seed=1, gamma=0.5))}
    told = (
        "would be of the same arm as .*seed0 there, but gamma is 0.99 there and 0.5 here; name another --out"
    )
    with pytest.raises(ConfigError, match=told):
        launching.run_sweep(stubs.root, other)
    assert (stubs.root / "sweep.json").read_bytes() == before
    same = {name: other[name]._replace(config=dataclasses.replace(config, seed=1, keep_best=False))}
    assert list(manifest.merged(stubs.root, same)) == [A, name]


def test_a_directory_that_somebody_writes_to_is_waited_for(stubs, monkeypatch):
    said = []  # not capsys, which loses what another thread writes while it is read
    monkeypatch.setattr(launching, "say", said.append)
    other = subprocess.Popen(stubs.acts(b=["wait", "end"]).command(ALL[B].run), cwd=stubs.root)
    stubs.wait_for(B)
    thread = threading.Thread(target=stubs.run, args=[B])
    thread.start()
    while not any(f"{B}: waiting for process {other.pid} on here" in line for line in said):
        assert thread.is_alive()
        time.sleep(0.01)
    other.terminate()
    thread.join()
    assert stubs.count() == [0, 2, 0] and stubs.seen()[B][0] == "done" and other.wait() == 143
    with rundir.held(stubs.root), pytest.raises(ConfigError, match="is writing there"):
        stubs.run(A)


DRIVER = """
import pathlib, sys
sys.path.insert(0, sys.argv[1])
from tests.experiments.sweeping.sweep_test import Sweep
print("begun", flush=True)
sys.exit(Sweep(pathlib.Path(sys.argv[2])).run(retries=0))
"""


def driver(stubs):
    root = pathlib.Path(__file__).resolve().parents[3]
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(root), str(stubs.root)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    process.stdout.readline()
    return process


@pytest.mark.skipif(sys.platform != "linux", reason="affinity and parents' deaths are Linux'")
def test_a_sweep_that_is_killed_is_resumed_and_its_runs_do_not_linger(stubs):
    stubs.acts(b=["wait", "wait", "end"])
    first = driver(stubs)
    stubs.wait_for(B)
    pid = json.loads((stubs.root / B / "lock").read_text())["pid"]
    assert len(os.sched_getaffinity(pid)) == 1
    assert "is at work there" in status_text(stubs) and f"process {pid} on" in status_text(stubs)
    first.kill()
    first.communicate()
    # Its run was told, and ends; the next one, stopped with Ctrl-C, waits for its runs to end.
    second = driver(stubs)
    stubs.wait_for(B, 2)
    second.send_signal(signal.SIGINT)
    second.communicate(timeout=120)
    assert second.returncode == 128 + signal.SIGINT
    assert stubs.seen()[B] == ("waiting", "") and "no sweep is at work there" in status_text(stubs)
    assert stubs.run() == 0
    assert stubs.count("ends") == [1, 1, 1]


def status_text(stubs):
    return "\n".join(sweep.status_lines(stubs.root, 1))


# What an executor is given


def fake(monkeypatch, tmp_path, entries, workers=9, memory=None):
    """The order in which runs begin and end where each takes a while; nothing is run."""
    monkeypatch.setattr(states, "look_at_all", lambda root, entries: dict.fromkeys(entries, states.State("")))
    monkeypatch.setattr(status, "ended_text", lambda run: "")
    monkeypatch.setattr(status, "lines", lambda *_: [""])
    log, at_once = [], []

    def run(name):
        log.append(f"+{name}")
        at_once.append(sum(1 if x[0] == "+" else -1 for x in log))
        time.sleep(0.05)
        log.append(f"-{name}")
        return 0, ""

    with cf.ThreadPoolExecutor(9) as executor:
        submit = lambda entry: executor.submit(run, entry.run.name)  # noqa: E731
        assert launching.launch(tmp_path, entries, submit, lambda: workers, memory) == 0
    assert len(log) == 2 * len(entries)
    return log, max(at_once)


def test_runs_are_given_in_order_and_as_many_as_there_is_room_for(monkeypatch, tmp_path):
    entries = {name: entry(name) for name in "badc"} | {"x": entry("x", "y"), "y": entry("y", "a")}
    log, most = fake(monkeypatch, tmp_path, entries, workers=1)
    assert [name[1] for name in log[::2]] == list("badcyx") and most == 1
    log, most = fake(monkeypatch, tmp_path, entries)
    assert most == 4 and log.index("-a") < log.index("+y") < log.index("-y") < log.index("+x")
    # The buffer: 100,000 frames of 42 x 42 bytes, and 600 MiB.
    assert launching.run_bytes(CONFIG) == 600 * 1024**2 + 176_400_000
    assert fake(monkeypatch, tmp_path, entries, memory=2.5 * launching.run_bytes(CONFIG))[1] == 2
    assert fake(monkeypatch, tmp_path, entries, memory=0)[1] == 1  # a single one always fits


def test_a_task_can_be_sent_elsewhere_and_a_lost_one_is_a_failure(tmp_path, monkeypatch):
    sent = pickle.dumps((launching.attempt, tmp_path, A, ["x"], CONFIG, 1, 2))
    assert pickle.loads(sent)[0] is launching.attempt
    monkeypatch.setattr(states, "look_at_all", lambda root, entries: {A: states.State("missing")})
    lost = cf.Future()
    lost.set_exception(RuntimeError("\nthe node\ndied"))
    assert launching.launch(tmp_path, {A: ALL[A]}, lambda entry: lost, lambda: 1) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="affinity is Linux'")
@pytest.mark.parametrize("locks", [True, False])
def test_a_run_has_a_core_to_itself_as_long_as_there_are_any(tmp_path, monkeypatch, locks):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 5, 7})
    monkeypatch.setattr(runtime, "has_gpu", lambda env: False)
    if not locks:
        monkeypatch.setattr(rundir, "_lock", lambda *_: "Function not implemented")
    with launching.own_cores(1, tmp_path) as a, launching.own_cores(1, tmp_path) as b:
        with launching.own_cores(1, tmp_path) as c:
            assert sorted(a + b + c) == [2, 5, 7]
            with launching.own_cores(2, tmp_path) as shared:  # none is free: as many as it has alone
                assert len(set(shared)) == 2
        with launching.own_cores(1, tmp_path) as again:
            assert again == c
        if locks:  # another sweep's
            code = "from experiments.sweeping import launching as l; import os, pathlib, sys\n"
            code += "os.sched_getaffinity = lambda pid: {2, 5, 7}\n"
            code += "with l.own_cores(1, pathlib.Path(sys.argv[1])) as mine: print(mine)"
            line = [sys.executable, "-c", code, str(tmp_path)]
            assert json.loads(subprocess.run(line, capture_output=True, text=True).stdout) == c
    monkeypatch.setattr(runtime, "has_gpu", lambda env: True)
    with launching.own_cores(1, tmp_path) as none:
        assert none == [] and launching.most_workers() == 1


@pytest.mark.parametrize("address", ["localhost:1", "nowhere", "localhost:x", "localhost:99999999"])
def test_without_ray_or_its_cluster_one_line_says_so(stubs, monkeypatch, address):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    with pytest.raises(ConfigError, match=f"--ray_address={address}: no Ray cluster: "):
        stubs.run(launcher="ray", ray_address=address)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'srl-jax\[ray\]'"):
        stubs.run(launcher="ray")
    assert not (stubs.root / "sweep.json").exists()
