"""experiments/sweep.py and what runs its runs; training is played by tests/stub_run.py."""

import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
from absl import flags

from experiments import flags as config_flags
from experiments import sweep
from experiments.sweeping import manifest, states, table
from experiments.sweeping.plan import Planned
from srl_jax import rundir
from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError

STUB = pathlib.Path(__file__).with_name("stub_run.py")
CONFIG = Config(game="Catch", frame_size=42, steps=500, checkpoint_every=100, num_envs=4, learn_start=40)
A, B, C = "Catch/a/seed0", "Catch/b/seed0", "Catch/c/seed0"


def run(name, encoder_from=""):
    return Planned(name, "catch/joint", {"game": "Catch", "seed": "0"}, encoder_from)


RUNS = [run(A), run(B), run(C, A)]
"""Two, and one that starts from the first."""


def resolve(runs):
    return {r.name: dataclasses.replace(CONFIG, encoder_from=r.encoder_from) for r in runs}


class Sweep:
    """A sweep of stubs in a directory."""

    def __init__(self, root):
        self.root = root

    def acts(self, **acts):
        for r in RUNS:
            path = self.root / "stub" / f"{r.name}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            config = dataclasses.asdict(resolve([r])[r.name]) | {"versions": {}}
            content = {"config": config, "acts": acts.get(r.name.split("/")[1], ["end"])}
            path.write_text(json.dumps(content))
        return self

    def run(self, runs=RUNS, **options):
        options = {"workers": 2, "resolve": resolve, "command": self.command, **options}
        return sweep.run_sweep(self.root, runs, **options)

    def command(self, planned):
        return [sys.executable, "-S", "-E", str(STUB), str(self.root), planned.name]

    def count(self, name, what="attempts"):
        path = self.root / "stub" / f"{name}.{what}"
        return len(path.read_text().splitlines()) if path.exists() else 0

    def record(self, name):
        return states.read_record(self.root, name)


@pytest.fixture
def stubs(tmp_path):
    return Sweep(tmp_path / "root").acts()


def test_runs_are_run_once_and_after_what_they_start_from(stubs, capsys):
    outcome = stubs.run()
    assert (sorted(outcome.done), outcome.failed, outcome.blocked, outcome.status) == ([A, B, C], {}, {}, 0)
    began = {}
    for name in (A, B, C):
        in_root, began[name] = (stubs.root / "stub" / f"{name}.attempts").read_text().split()
        assert in_root == "True"
    assert float(began[C]) > max(float(began[A]), float(began[B]) - 9)
    assert stubs.record(C).status == 0 and stubs.record(C).ended >= stubs.record(A).ended
    assert f"{C}: done, 500 env steps in 0:00:05, last evaluation 0.5" in capsys.readouterr().err
    # Again: nothing is left to do.
    before = {p: p.read_bytes() for p in stubs.root.rglob("*") if p.is_file()}
    assert sorted(stubs.run().done) == [A, B, C]
    assert {p: p.read_bytes() for p in stubs.root.rglob("*") if p.is_file()} == before


def test_crashes_are_gone_on_with_and_errors_are_not(stubs, capsys):
    stubs.acts(a=["kill", "exit:1", "end"], b=["exit:2"])
    outcome = stubs.run(retries=2)
    assert sorted(outcome.done) == [A, C] and outcome.status == 1
    assert outcome.failed == {B: "ended on purpose 1"}
    assert [stubs.count(name) for name in (A, B, C)] == [3, 1, 1]
    assert f"{A}: killed by SIGKILL; resuming it" in capsys.readouterr().err
    assert (stubs.record(A).attempts, stubs.record(B).status) == (3, 2)


def test_what_starts_from_a_failed_run_is_blocked(stubs):
    stubs.acts(a=["exit:1"], b=["exit:4"])
    outcome = stubs.run(retries=1)
    assert outcome.failed == {A: "status 1: ended on purpose 2", B: "ended on purpose 1"}
    assert outcome.blocked == {C: f"{A} failed"}
    assert [stubs.count(name) for name in (A, B, C)] == [2, 1, 0]
    view = table.view_of_files(stubs.root, manifest.read(stubs.root))
    assert (view.failed, view.blocked) == (outcome.failed, outcome.blocked)
    # Started again, it tries what is not complete.
    stubs.acts()
    assert stubs.run().status == 0


def test_a_full_disk_stops_the_sweep(stubs):
    stubs.acts(a=["exit:3"], b=["wait"])
    with pytest.raises(SaveError, match=f"{A}: ended on purpose"):
        stubs.run()
    # It was told to write a checkpoint and end, and has: before it heard of signals, or behind that.
    assert stubs.record(B).status in (128 + signal.SIGTERM, -signal.SIGTERM)
    assert states.look(stubs.root / B, CONFIG).kind in ("missing", "resumable")


def test_a_run_that_ends_well_has_to_be_complete(stubs):
    stubs.acts(b=["lie"])
    assert stubs.run([run(B)]).failed == {B: "ended with status 0 and is resumable"}
    assert stubs.count(B) == 1


def test_another_version_of_the_code_fails_its_run_and_not_the_sweep(stubs):
    """Runs are started with the code that lies there then, which somebody may have changed."""
    stubs.acts(a=["slow"])
    path = stubs.root / "stub" / f"{A}.json"
    content = json.loads(path.read_text())
    content["config"]["new"] = 1
    path.write_text(json.dumps(content))
    outcome = stubs.run()
    assert "no field 'new'" in outcome.failed[A] and outcome.done == [B] and C in outcome.blocked
    with pytest.raises(ConfigError, match="no field 'new'"):  # and the next sweep says so at once
        stubs.run()


def test_broken_directories_are_moved_aside_and_nothing_is_lost(stubs, capsys):
    assert stubs.run().status == 0
    for name, spoil in {
        A: lambda run: (run / "config.json").write_text("{"),
        B: lambda run: (run / "metrics.jsonl").unlink(),
        C: lambda run: (run / "checkpoints/000000500/params.msgpack").write_bytes(b"12"),
    }.items():
        spoil(stubs.root / name)
    (stubs.root / "Catch/a/seed0.broken-1").mkdir()
    assert stubs.run().status == 0
    assert [stubs.count(name, "ends") for name in (A, B, C)] == [2, 2, 2]
    said = capsys.readouterr().err
    assert "config.json: Expecting property name" in said and "moved aside to seed0.broken-2" in said
    assert "metrics.jsonl: No such file" in said and "params.msgpack has not the size" in said
    assert (stubs.root / "Catch/a/seed0.broken-2/config.json").read_text() == "{"
    # One that got further than its first checkpoint, and has none.
    rows = "".join(json.dumps({"env_steps": n}) + "\n" for n in (0, 104))
    (stubs.root / B / "metrics.jsonl").write_text(rows)
    checkpoints = stubs.root / B / "checkpoints"
    (checkpoints / "000000500").rename(stubs.root / "gone")
    config = resolve([run(B)])[B]
    state = states.prepare(stubs.root / B, config, lambda line: None)
    assert (
        state.kind == "missing" and (stubs.root / "Catch/b/seed0.broken-2/metrics.jsonl").read_text() == rows
    )


def test_a_changed_plan_is_merged(stubs, capsys):
    assert stubs.run([run(B)]).status == 0
    assert stubs.run([run(A)]).done == [A]
    assert list(manifest.read(stubs.root)) == [B, A]
    assert [stubs.count(name) for name in (A, B)] == [1, 1]
    before = (stubs.root / "sweep.json").read_bytes()

    def longer(runs):
        return {r.name: dataclasses.replace(CONFIG, steps=900) for r in runs}

    with pytest.raises(ConfigError, match=r"b/seed0: .* steps is 500 there and 900 here; give the flags"):
        stubs.run([run(B)], resolve=longer)
    assert (stubs.root / "sweep.json").read_bytes() == before
    with pytest.raises(ValueError, match="comes before"):
        stubs.run([run(C, A), run(A)])


def test_a_directory_that_somebody_writes_to_is_waited_for(stubs, capsys, monkeypatch):
    (stubs.root / B).mkdir(parents=True)
    other = subprocess.Popen(stubs.acts(b=["slow"]).command(run(B)), cwd=stubs.root)
    while not (stubs.root / B / "config.json").exists():
        time.sleep(0.01)
    outcome = stubs.run([run(B)])
    assert other.wait() == 0 and outcome.done == [B] and stubs.count(B) == 1
    assert f"{B}: waiting: process " in capsys.readouterr().err or stubs.record(B) is None
    with rundir.held(stubs.root), pytest.raises(ConfigError, match="is writing there"):
        stubs.run([run(A)])


DRIVER = """
import json, pathlib, sys
sys.path.insert(0, sys.argv[1])
from tests.sweep_test import RUNS, Sweep
print("begun", flush=True)
sys.exit(Sweep(pathlib.Path(sys.argv[2])).run(retries=0).status)
"""


def driver(stubs):
    root = pathlib.Path(__file__).resolve().parents[1]
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(root), str(stubs.root)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    process.stdout.readline()
    return process


def wait_for(stubs, name, attempts):
    deadline = time.monotonic() + 120
    while not (stubs.count(name) >= attempts and (stubs.root / name / "config.json").exists()):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_sweep_that_is_killed_goes_on_and_its_runs_do_not_linger(stubs):
    stubs.acts(b=["wait", "wait", "end"])
    first = driver(stubs)
    wait_for(stubs, B, 1)
    first.kill()
    first.communicate()
    # Its run was told, and ends; the next one, stopped with Ctrl-C, waits for its runs to end.
    second = driver(stubs)
    wait_for(stubs, B, 2)
    assert states.look(stubs.root / B, CONFIG).kind == "busy"
    second.send_signal(signal.SIGINT)
    second.communicate(timeout=120)
    assert second.returncode == 128 + signal.SIGINT
    assert states.look(stubs.root / B, CONFIG).kind == "resumable"
    assert stubs.record(B).ended is not None and stubs.record(B).reason == ""
    assert stubs.run().status == 0
    assert [stubs.count(name, "ends") for name in (A, B, C)] == [1, 1, 1]


@pytest.mark.skipif(sys.platform != "linux", reason="affinity and parents' deaths are Linux'")
def test_runs_keep_to_cores_of_their_own(stubs):
    stubs.acts(a=["wait"], b=["wait"])
    process = driver(stubs)
    wait_for(stubs, A, 1)
    wait_for(stubs, B, 1)
    records = [stubs.record(A), stubs.record(B)]
    found = [os.sched_getaffinity(record.pid) for record in records]
    assert found == [set(record.cores) for record in records]
    assert all(len(cores) == 1 for cores in found)
    if len(os.sched_getaffinity(0)) > 2:
        assert found[0] != found[1]
    # A status from elsewhere.
    assert states.alive(records[0]) and not states.alive(records[0]._replace(host="elsewhere"))
    assert not states.alive(records[0]._replace(pid=2**30))
    lines = table.status(stubs.root, manifest.read(stubs.root), 1)
    assert "0 of 3 runs done, 2 running, 1 waiting" in lines[0]
    assert lines[2].split()[:5] == [A, records[0].host, "core", str(records[0].cores[0]), "0/500"]
    assert f"process {process.pid} on" in lines[-1] and "is at work there" in lines[-1]
    process.kill()
    process.communicate()


# The command line


def _main(*arguments):
    values = flags.FlagValues()
    sweep.define_flags(values)
    config_flags.parse(["sweep", *arguments], values)
    root = pathlib.Path(values["out"].value)
    return values, root


@pytest.mark.parametrize(
    "arguments, says",
    [
        ((), "--presets: missing"),
        (("--presets=small/joint_256", "--seed=1"), "--seed: a sweep gives it to each run; --seeds decides"),
        (("--presets=small/joint_256", "--preset=demo"), "--preset: a sweep gives it"),
        (("--presets=nope",), "--presets=nope: "),
        (("--presets=small/joint_256", "--seeds=x"), "--seeds=x: "),
        (("--presets=small/joint_256", "--games=Pang"), "did you mean Pong"),
    ],
)
def test_command_lines_that_are_refused(tmp_path, arguments, says):
    values, root = _main(f"--out={tmp_path / 'new'}", *arguments)
    with pytest.raises(ConfigError, match=says):
        sweep.chosen_runs(values, root)
    assert list(tmp_path.iterdir()) == []


def test_flags_of_training_go_to_every_run(tmp_path):
    given = ("--steps=1e3", "--objective=inverse", "--nolife_loss", "--stop_at_return=off", "--rl=:n_step=2")
    values, root = _main(f"--out={tmp_path}", "--presets=small/joint_*", "--games=Catch", "--seeds=2", *given)
    runs = sweep.chosen_runs(values, root)
    assert runs[0].name == "Catch/joint_256/seed0"
    assert runs[0].flags == {
        "game": "Catch", "seed": "0", "objective": ("inverse",), "steps": "1000", "stop_at_return": "off",
        "life_loss": "false", "rl": ":n_step=2",
    }  # fmt: skip
    with pytest.raises(ConfigError, match="--gpus_per_run: only --launcher=ray"):
        sweep.launcher_options(_main(f"--out={tmp_path}", "--gpus_per_run=1")[0])


def test_a_grid_makes_arms_and_it_is_said_whose_objectives_are_replaced(tmp_path, capsys):
    given = ("--grid", "lr_rl=1e-4,3e-4", "--objective=inverse")
    values, root = _main(f"--out={tmp_path}", "--presets=small/joint_256,small/joint_50", *given)
    runs = sweep.chosen_runs(values, root)
    assert [run.name.split("/")[1] for run in runs] == [
        f"{arm}_lr_rl={rate}" for arm in ("joint_256", "joint_50") for rate in ("1e-4", "3e-4")
    ]
    sweep.say_what_is_replaced(values, runs)
    assert capsys.readouterr().err == (
        "objective: inverse in place of those of small/joint_256, small/joint_50; "
        "--objective=+NAME adds to them\n"
    )
    with pytest.raises(ConfigError, match="--grid: only with --presets"):
        sweep.chosen_runs(_main(f"--out={tmp_path}", "--grid", "lr_rl=1,2")[0], _planned(tmp_path))


def _planned(root):
    manifest.write(root, {A: manifest.Entry(run(A), CONFIG)})
    return root


def test_a_sweep_goes_on_as_it_was_planned_where_no_presets_are_given(stubs):
    assert stubs.run().status == 0
    values, root = _main(f"--out={stubs.root}")
    assert sweep.chosen_runs(values, root) == RUNS
    values, root = _main(f"--out={stubs.root}", "--gamma=0.9")
    with pytest.raises(ConfigError, match="--gamma: only with --presets"):
        sweep.chosen_runs(values, root)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda about: "{",
        lambda about: "[]",
        lambda about: json.dumps({**about, "format": 9}),
        lambda about: json.dumps({**about, "runs": [{}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "name": "../../x"}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "name": "a/../x"}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "flags": {"steps": 3}}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "flags": []}]}),
        lambda about: json.dumps({**about, "runs": [{**about["runs"][0], "config": {"steps": -1}}]}),
        lambda about: "[" * 100_000,
    ],
)
def test_a_manifest_that_is_none_is_refused_in_one_line(stubs, spoil):
    stubs.root.mkdir(exist_ok=True)
    manifest.write(stubs.root, {A: manifest.Entry(RUNS[0], CONFIG)})
    path = stubs.root / "sweep.json"
    path.write_text(spoil(json.loads(path.read_text())))
    with pytest.raises(ConfigError, match="sweep.json: ") as refused:
        manifest.read(stubs.root)
    assert "\n" not in str(refused.value)


def test_a_dry_run_writes_nothing_and_counts(stubs):
    stubs.acts(a=["end"])
    assert stubs.run([run(A)]).status == 0
    before = sorted(stubs.root.rglob("*"))
    lines = sweep.dry_run(stubs.root, [*RUNS, run("Catch/a/seed1")], workers=2, resolve=resolve)
    # The run that is complete took 5 s: three more are 15 s, and two run at once.
    assert lines[1].split() == ["Catch/a", "2", "1", "1", "500", "100", "0:00:05"]
    assert lines[-1] == (
        "3 of 4 runs to run, 1,500 env steps, 0:00:08 with 2 at once; speeds: runs of this sweep"
    )
    assert sorted(stubs.root.rglob("*")) == before
    line, why = sweep.dry_run(stubs.root / "new", [run(A)], workers=2, resolve=resolve)[2:]
    assert line == "1 of 1 runs to run, 500 env steps, unknown time with 2 at once; speeds: unknown"
    assert why.startswith("unknown: no run of this game's kind, encoder and mode has been timed")
    assert "--status" in why


def test_bad_input_is_one_line_and_status_2(tmp_path):
    """The one test with a process: the whole way through the entry point."""
    out = tmp_path / "new"
    done = subprocess.run(
        [sys.executable, "-m", "experiments.sweep", "--presets=small/joint_256", f"--out={out}", "--gamma=2"],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "--gamma=2" in done.stderr
    assert not out.exists()
