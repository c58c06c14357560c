"""Tests of experiments.benchmarks: the protocol, the arithmetic, the command line. Nothing is timed here."""

import contextlib
import json
import types
from functools import partial

import pytest

from experiments.benchmarks import bench, rows
from experiments.benchmarks.bench import CheckFailed
from experiments.benchmarks.rows import GROUPS, Row
from experiments.benchmarks.worker import Worker, WorkerError
from srl_jax import objectives
from srl_jax.errors import ConfigError
from tests.helpers import SMALL
from tests.in_process import parse

SIDE = """
import os

class Side:
    def __init__(self, text):
        print("this is no reply")
        self.text = text

    def shout(self, times):
        return [self.text.upper()] * times

    def fail(self):
        raise ValueError("two\\nlines")

    def leave(self):
        os._exit(3)
"""


# The protocol


def test_a_worker_answers_until_it_ends_and_errors_are_one_line(tmp_path, monkeypatch):
    (tmp_path / "loud.py").write_text(SIDE, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Worker("loud.Side", {"text": "a\nü"}) as worker:
        worker.ask("build")
        assert worker.ask("shout", times=2) == ["A\nÜ", "A\nÜ"]
        with pytest.raises(WorkerError, match="^loud.Side: fail: ValueError: two lines$"):
            worker.ask("fail")
        assert worker.ask("shout", times=1) == ["A\nÜ"]
        for _ in range(2):
            with pytest.raises(WorkerError, match="loud.Side: ended without a reply to 'leave'"):
                worker.ask("leave")


def test_a_program_that_is_not_there_is_an_error_and_has_nothing_to_compare_with():
    with pytest.raises(WorkerError, match="/no/such/program: No such file"):
        Worker("loud.Side", {}, "/no/such/program")
    assert bench.other_versions("/no/such/program") == {}


# The arithmetic


def test_a_figure_is_the_median_of_the_rounds_medians_with_their_quartiles():
    # Medians of rounds: 2, 4, 6, 8, 10.
    found = Row("", "ms", "a.x").figures({"a.x": [[1, 2, 99], [4], [5, 7], [8, 8], [10, 0, 11]]})
    assert found == {"ours": {"low": 4, "median": 6, "high": 8}}


def test_a_ratio_is_formed_round_by_round_with_the_fastest_of_the_others():
    row = Row("", "ms", "a.x", {"slow": "b.x", "fast": "c.x"}, speedup=True)
    replies = {"a.x": [[4], [8], [1]], "b.x": [[9], [5], [9]], "c.x": [[4], [1], [8]]}
    # Ratios 1, 1 / 8, 8; the ratio of the medians is 1.
    found = row.figures(replies)
    assert (found["label"], found["theirs"]["median"]) == ("fast", 4)
    assert found["ratio"] == {"low": 9 / 16, "median": 1, "high": 9 / 2}
    assert row._replace(speedup=False).figures(replies | {"c.x": [[2], [2], [2]]})["ratio"]["median"] == 2


def test_numbers_have_three_digits():
    values = (0.0123456, 0.3, 1.6, 12.34, 999.0, 1234.5, 0.0)
    shown = ["0.0123", "0.300", "1.60", "12.3", "999", "1234", "0"]
    assert [rows.number(value) for value in values] == shown


@pytest.mark.parametrize(
    ("theirs", "message"),
    [
        ([{"rl": 1.0}, {"rl": 1.0002}], "a loss differs by 2.0e-04"),
        ([{"rl": 1.0}, {"rl": float("nan")}], "a loss differs by nan"),
        ([{"rl": 1.0}, {"rl": 1.0, "latent_l2": 0.0}], "different losses"),
        ([{"rl": 1.0}], "different losses"),
    ],
)
def test_losses_must_be_equal(theirs, message):
    ours = [{"rl": 1.0}, {"rl": 1.0}]
    assert bench.difference(ours, [{"rl": 1.0}, {"rl": 1.00009}]) == pytest.approx(9e-5, rel=1e-3)
    with pytest.raises(CheckFailed, match=message):
        bench.difference(ours, theirs)


# Turns, with workers that only note what they are asked


@pytest.fixture
def asked(monkeypatch):
    """[what each worker is asked, (module, method)]; `their_loss` is the other sides'."""
    found = types.SimpleNamespace(calls=[], their_loss=1.0)

    @contextlib.contextmanager
    def worker(side, arguments, python=None):
        module = side.split(".")[1]

        def ask(method, **values):
            found.calls.append((module, method))
            if method == "check":
                given = {"params": {}, "window": {}}
                return [{"rl": found.their_loss}] if python else ([{"rl": 1.0}], given)
            names = ("update", "sample", "gather")
            return {name: [float(len(found.calls))] * values.get("updates", 1) for name in names}

        try:
            yield types.SimpleNamespace(ask=ask)
        finally:
            found.calls.append((module, "end"))

    monkeypatch.setattr(bench, "Worker", worker)
    return found


def test_workers_are_checked_and_take_turns_and_end(asked):
    replies, checks = bench.measure(rows.UPDATE, ["update_nature"], rounds=2, python="other")
    ours, theirs = "jax_side", "torch_side"
    ready = [(ours, "build"), (theirs, "build"), (ours, "check"), (theirs, "check")]
    ready += [(theirs, "build"), (theirs, "check")]
    turns = [(ours, "turn"), (theirs, "turn"), (theirs, "turn")] * 2
    assert asked.calls == [*ready, *turns, (theirs, "end"), (theirs, "end"), (ours, "end")]
    assert replies["nature.update"] == [[7.0] * 60, [10.0] * 60]
    assert list(checks.values()) == [0.0, 0.0]


def test_nothing_is_timed_where_losses_differ(asked):
    asked.their_loss = 1.1
    with pytest.raises(CheckFailed):
        bench.measure(rows.UPDATE, ["update_nature"], rounds=2, python="other")
    assert ("jax_side", "turn") not in asked.calls and asked.calls[-1] == ("jax_side", "end")


def test_every_row_names_workers_of_its_group_behind_their_twins():
    for group in GROUPS:
        for name in group.rows:
            needed = list(group.needed([name]))
            assert {series.split(".")[0] for series in group.rows[name].series} <= set(needed)
            twins = [(group.programs[worker].twin, worker) for worker in needed]
            assert all(needed.index(twin) < needed.index(worker) for twin, worker in twins if twin)


# This project's sides


@pytest.fixture
def tiny(monkeypatch):
    """A run that compiles quickly, in place of every preset."""
    from experiments.benchmarks import host_side, jax_side
    from srl_jax.config import Config

    config = Config(**SMALL | {"updates_per_step": 0.25, "steps": 1000, "eval_every": 100})
    for module in (host_side, jax_side):
        monkeypatch.setattr(module, "config_of", lambda preset: config)


def test_the_timed_loop_does_the_updates_that_are_due(tiny):
    from experiments.benchmarks.host_side import WARM_UPDATES, Loop

    timed = Loop("any")
    run = timed._run
    assert run.updates == WARM_UPDATES
    steps = run.env_steps
    found = timed.turn(env_steps=60, iterations=3)
    # 15 steps of all 4 environments, 3 more, and 3 of which the updates come afterwards.
    assert (run.env_steps - steps, run.updates - WARM_UPDATES) == (4 * 21, 21)
    assert {name: len(values) for name, values in found.items()} == {
        "rate": 1,
        "iteration": 3,
        "busy": 1,
        "slower half": 1,
    }
    assert run.seeds[0].report.means.take() == {}  # nothing is kept from one turn to the next
    run.env_threads.shutdown()


def test_a_projected_run_has_the_evaluations_of_a_whole_one(tiny):
    from experiments.benchmarks import gpu

    found = gpu.whole_run(0.05)
    minutes = (1000 / found["env_steps_per_s"] + 11 * found["evaluation_s"]) / 60
    assert found["minutes"] == pytest.approx(minutes) and found["evaluation_s"] > 0


# The command line


_values = partial(parse, bench)


def test_rows_are_chosen_in_the_tables_order():
    assert bench.chosen_rows(None) == bench.MAIN
    assert bench.chosen_rows(["memory", "loop"]) == ["loop", "memory"]
    ours = [name for name, row in objectives.REGISTRY.items() if row.__module__.startswith("srl_jax.")]
    others = ["reconstruction_moving", "forward_latent_5", "infonce_temporal"]
    assert bench.chosen_rows(["objectives", "loop"]) == [
        "loop",
        *(f"objective_{name}" for name in ours + others),
    ]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--only=update_natur", "--only=update_natur: .*did you mean update_nature\\?"),
        ("--only=", "--only=: names no row"),
        ("--out=FULL", "not empty; name a new directory"),
        ("--out=FULL/file", "is not a directory"),
        ("--out=FULL/file/new", "is not a directory"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_measured(argument, message, tmp_path, asked):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=message):
        bench.bench(_values(argument.replace("FULL", str(tmp_path))))
    assert not asked.calls and [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failed_check_is_one_line_and_status_1(monkeypatch, tmp_path, asked):
    asked.their_loss = 1.1
    monkeypatch.setattr(bench, "other_versions", lambda _: {"torch": "2"})
    with pytest.raises(SystemExit) as end:
        bench.main(_values("--only=update_nature", f"--out={tmp_path}/new"))
    assert end.value.code.startswith("error: a loss differs")  # Python prints it, with status 1
    assert not (tmp_path / "new").exists()


def test_rows_without_their_other_side_are_skipped_and_results_written(monkeypatch, tmp_path, capsys, asked):
    monkeypatch.setattr(bench, "other_versions", lambda _: {})
    bench.bench(_values("--only=joint_cost,update_256,replay_sample", "--quick", f"--out={tmp_path}/new"))
    assert {module for module, _ in asked.calls} == {"host_side", "jax_side"}
    out, err = capsys.readouterr()
    assert "PyTorch and Tianshou are not there, `make bench-install` installs them" in err
    assert (tmp_path / "new" / "bench.md").read_text(encoding="utf-8") == out
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines()[:5]]
    assert lines[2] == ["update rl_only 256", "skipped", "not installed", "-", ">= 1.25"]
    assert lines[3][1:] == [
        "4.00 ms",
        "3.00 ms, rl_only",
        "1.33",
        "<= 1.7",
    ]  # though it needs the same worker
    assert lines[4][1:] == ["8.00 ms", "8.00 ms, numpy gather", "1.00", "<= 2, <= 0.3 ms"]
    record = json.loads((tmp_path / "new" / "bench.json").read_text(encoding="utf-8"))
    assert "figures" not in record["rows"]["update_256"]
    assert record["rows"]["replay_sample"]["rounds"] == {"replay.sample": [[8.0]], "replay.gather": [[8.0]]}
    assert {"date", "cpu", "cores", "load", "git_revision", "versions", "rounds"} <= record.keys()
