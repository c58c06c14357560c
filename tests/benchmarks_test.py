"""Tests of experiments.benchmarks: the protocol, the arithmetic, the command line. Nothing is timed here."""

import io
import json
import pathlib
import subprocess
import sys
import types

import pytest
from absl import flags

from experiments import flags as config_flags
from experiments.benchmarks import bench, rows, runner, table
from experiments.benchmarks.rows import ROWS, SERIES, SIDES, Row, Series, Side
from experiments.benchmarks.runner import CheckFailed, Results
from experiments.benchmarks.table import Goal
from experiments.benchmarks.worker import Worker, WorkerError
from srl_jax.errors import ConfigError
from tests.helpers import SMALL

ROOT = pathlib.Path(__file__).resolve().parents[1]
SERVE = """
import os, sys
from experiments.benchmarks.worker import serve

def fail():
    raise ValueError("two\\nlines")

def leave():
    print("no more memory", file=sys.stderr)
    os._exit(3)

def shout(text):
    print("this is no reply")
    return {"text": text.upper()}

serve({"shout": shout, "fail": fail, "leave": leave})
"""


# The protocol


@pytest.fixture
def worker():
    with Worker([sys.executable, "-c", SERVE]) as one:
        yield one


def test_a_worker_answers_and_what_it_prints_is_no_reply(worker):
    assert worker.ask("shout", text="a\nü") == {"text": "A\nÜ"}
    assert worker.ask("shout", text="b") == {"text": "B"}


def test_a_handlers_error_is_one_line_and_the_worker_goes_on(worker):
    with pytest.raises(WorkerError, match="fail: ValueError: two lines") as error:
        worker.ask("fail")
    assert "\n" not in str(error.value)
    with pytest.raises(WorkerError, match="no handler 'sing'; there are shout, fail, leave"):
        worker.ask("sing")
    assert worker.ask("shout", text="c") == {"text": "C"}


def test_a_worker_that_ends_early_is_an_error_with_its_last_words(worker):
    with pytest.raises(WorkerError, match="ended without a reply to 'leave': no more memory"):
        worker.ask("leave")
    with pytest.raises(WorkerError, match="no more memory"):
        worker.ask("shout", text="d")


def test_a_program_that_is_not_there_is_an_error():
    with pytest.raises(WorkerError, match="/no/such/program: No such file"):
        Worker(["/no/such/program"])


# The arithmetic


def test_a_figure_is_the_median_of_the_rounds_medians_with_their_quartiles():
    # Medians of rounds: 2, 4, 6, 8, 10.
    series = [[1, 2, 99], [4], [5, 7], [8, 8], [10, 0, 11]]
    assert table.medians(series) == [2, 4, 6, 8, 10]
    assert table.spread(table.medians(series)) == (6, 4, 8)


def test_a_ratio_is_the_median_of_the_ratios_of_rounds():
    ours, theirs = [[1], [2], [10]], [[3], [4], [10]]
    # Round by round 3, 2, 1; the ratio of the medians would be 4 / 2 as well, the inverse's not 3 / 6.
    found = table.figures(ours, {"other": theirs}, True, ())
    assert found.ratio == (2, 1.5, 2.5)
    found = table.figures(ours, {"other": theirs}, False, ())
    assert found.ratio.median == pytest.approx(1 / 2)
    # Ratios 1, 1 / 8, 8; the ratio of the medians is 1 / 2.
    found = table.figures([[4], [8], [1]], {"other": [[4], [1], [8]]}, True, ())
    assert found.ratio.median == 1


def test_of_several_others_the_one_with_the_least_median_counts():
    others = {"slow": [[5], [1], [6]], "fast": [[4], [9], [3]]}
    found = table.figures([[1], [1], [1]], others, True, ())
    assert (found.label, found.theirs.median, found.ratio.median) == ("fast", 4, 4)


@pytest.mark.parametrize(
    ("sign", "value", "met"),
    [(">=", 2.0, True), (">=", 1.9, False), ("<=", 2.0, True), ("<=", 2.1, False), ("<", 2.0, False)],
)
def test_goals_are_met_or_not(sign, value, met):
    ours, theirs = [[value]], {"other": [[1.0]]}
    assert table.figures(ours, theirs, False, (Goal("ratio", sign, 2.0),)).met is met
    assert table.figures(ours, {}, False, (Goal("ours", sign, 2.0),)).met is met


def test_all_goals_must_be_met():
    goals = (Goal("ratio", "<=", 2), Goal("ours", "<=", 0.3))
    assert table.figures([[0.2]], {"other": [[0.1]]}, False, goals).met
    assert not table.figures([[0.2]], {"other": [[0.05]]}, False, goals).met
    assert not table.figures([[0.4]], {"other": [[0.4]]}, False, goals).met


def test_numbers_have_three_digits():
    values = (0.0123456, 0.3, 1.6, 12.34, 999.0, 1234.5, 0.0)
    assert [table.number(value) for value in values] == [
        "0.0123",
        "0.300",
        "1.60",
        "12.3",
        "999",
        "1234",
        "0.0",
    ]


def _report(replies, skipped, only):
    results = Results()
    results.replies, results.checks = replies, {"rl_only_nature": 2e-6}
    return bench.report(only, skipped, results, {"rounds": 3, "cores": 2, "cpu": "a processor", "load": 1.5})


def test_the_table_shows_figures_and_what_was_skipped():
    replies = {
        "jax nature": [[10.0], [20.0], [30.0]],
        "torch nature contiguous": [[90.0]] * 3,
        "torch nature channels_last": [[20.0], [40.0], [60.0]],
        "startup": [[13.0]],
    }
    text, record = _report(replies, {"loop": "tianshou"}, ["update_nature", "loop", "startup"])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[:5]]
    assert lines[2] == [
        "update rl_only nature",
        "20.0 ms (15.0 to 25.0)",
        "40.0 ms (30.0 to 50.0), PyTorch channels last",
        "2.00",
        ">= 1.8",
        "yes",
    ]
    assert lines[3] == ["loop Pong nature", "skipped", "not installed", "-", ">= 2.5", "-"]
    assert lines[4][1:] == ["13.0 s", "-", "-", "< 12 s", "no"]
    assert len({line.count("|") for line in text.splitlines()[:5]}) == 1
    assert "rl_only_nature 2e-06" in text and "load average 1.5" in text
    record = json.loads(json.dumps(record))
    assert record["rows"]["loop"] == {"title": "loop Pong nature", "skipped": "no tianshou"}
    assert record["rows"]["update_nature"]["rounds"]["jax nature"] == [[10.0], [20.0], [30.0]]


def test_reductions_of_replies():
    reply = {"seconds": [0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5]}
    assert SERIES["jax joint4"].pick(reply) == pytest.approx([250, 500])
    assert SERIES["tianshou"].pick({"env_steps": 300, "seconds": 2.0}) == [150]
    parts = {"iteration": [0.2], "acting": [0.1, 0.3, 0.2], "update": [0.15]}
    assert SERIES["slower part"].pick(parts) == pytest.approx([200])


# Turns


class Recorder:
    """Stands in for the workers: writes down what they are asked."""

    def __init__(self, losses=((1.0,), (1.0,))):
        self.asked, self.losses, self.closed = [], losses, []

    def start(self, side):
        return _Recorded(self, side)


class _Recorded:
    def __init__(self, recorder, side):
        self._recorder, self._side = recorder, side

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._recorder.closed.append(self._side.module)

    def ask(self, do, **values):
        self._recorder.asked.append((self._side.module, do))
        if do == "check":
            own, other = self._recorder.losses
            values = own if "folder" in values else other
            return {"losses": [{"rl": v} for v in values], "params": "p", "window": "w"}
        return {"seconds": [1.0], "versions": {}}


def _measure(recorder, names, rounds=2):
    chosen = {name: ROWS[name] for name in names}
    sides = {name: SIDES[name] for name in rows.sides_of(names)}
    left = runner.Left(1.0, stream=io.StringIO())
    return runner.measure(chosen, sides, rounds=rounds, start=recorder.start, threads=2, left=left)


def test_workers_take_turns_and_are_closed():
    recorder = Recorder()
    results = _measure(recorder, ["update_nature"])
    assert recorder.asked[-6:] == [("jax_side", "time"), ("torch_side", "time"), ("torch_side", "time")] * 2
    assert recorder.closed == ["torch_side", "torch_side", "jax_side"]
    assert results.replies["jax nature"] == [[1000.0], [1000.0]]
    assert results.checks == {"rl_only_nature": 0.0}


def test_equal_requests_of_a_turn_are_asked_once(monkeypatch):
    request = {"do": "time"}
    for name in ("one", "two"):
        monkeypatch.setitem(SERIES, name, Series("side", request, lambda reply: reply["seconds"]))
    recorder = Recorder()
    row = Row("", "s", "one", {"two": "two"}, ())
    left = runner.Left(1.0, stream=io.StringIO())
    sides = {"side": Side("group", "module", rounds=2)}
    results = runner.measure({"row": row}, sides, rounds=5, start=recorder.start, threads=1, left=left)
    assert recorder.asked == [("module", "time")] * 2
    assert results.replies == {"one": [[1.0], [1.0]], "two": [[1.0], [1.0]]}


@pytest.mark.parametrize(("own", "passes"), [(1.00009, True), (1.0002, False), (float("nan"), False)])
def test_losses_must_be_equal_before_anything_is_timed(own, passes):
    recorder = Recorder(((1.0, own), (1.0, 1.0)))
    if passes:
        assert _measure(recorder, ["update_nature"]).checks["rl_only_nature"] == pytest.approx(9e-5, rel=1e-2)
        return
    with pytest.raises(CheckFailed, match="torch nature contiguous: a loss differs"):
        _measure(recorder, ["update_nature"])
    assert recorder.closed == ["torch_side", "jax_side"]


def test_sides_that_compute_other_losses_do_not_pass():
    with pytest.raises(CheckFailed, match="different losses"):
        runner.difference([{"rl": 1.0}], [{"rl": 1.0, "latent_l2": 0.0}])


def test_the_time_left_follows_what_was_done():
    now = [0.0]
    stream = io.StringIO()
    left = runner.Left(60.0, stream, lambda: now[0])
    with left.task("first", 30.0):
        now[0] = 60.0  # twice as long as thought
    with left.task("second", 30.0):
        pass
    assert stream.getvalue().splitlines() == [
        "bench: first; about 1.0 min left",
        "bench: second; about 1.0 min left",
    ]


def test_every_row_names_what_there_is():
    for row in ROWS.values():
        for name in rows.series_of(row):
            assert SERIES[name].side in SIDES
            assert (ROOT / "experiments" / "benchmarks" / f"{SIDES[SERIES[name].side].module}.py").exists()
    for name, side in SIDES.items():
        if side.twin:
            assert list(SIDES).index(side.twin) < list(SIDES).index(name)
            assert SIDES[side.twin].group == side.group
    for name in ROWS:
        chosen = rows.sides_of([name])
        assert all(SIDES[side].twin in ("", *chosen) for side in chosen)


# The loop, as the workers run it


@pytest.fixture
def tiny(monkeypatch):
    """A run that compiles quickly, in place of every preset."""
    from experiments.benchmarks import jax_side
    from srl_jax.config import Config

    config = Config(**SMALL | {"updates_per_step": 0.25, "steps": 1000, "eval_every": 100})
    monkeypatch.setattr(jax_side, "config_of", lambda preset: config)
    return config


def test_the_timed_loop_does_the_updates_that_are_due(tiny):
    from experiments.benchmarks.host_side import WARM_UPDATES, Loop

    timed = Loop()
    timed.setup("any")
    assert timed._run.updates == WARM_UPDATES
    reply = timed.run(60)
    assert (reply["env_steps"], reply["updates"]) == (60, 15) and reply["seconds"] > 0
    parts = timed.parts(3)
    assert [len(parts[name]) for name in ("iteration", "acting", "update", "busy")] == [3, 3, 3, 1]
    assert timed._run.seeds[0].report.means.take() == {}  # nothing is kept from one request to the next
    timed._run.env_threads.shutdown()


def test_a_projected_run_has_the_evaluations_of_a_whole_one(tiny, monkeypatch):
    from experiments.benchmarks import gpu

    found = gpu.whole_run(0.05)
    minutes = (1000 / found["env_steps_per_s"] + 11 * found["evaluation_s"]) / 60
    assert found["minutes"] == pytest.approx(minutes) and found["evaluation_s"] > 0


# The command line


def _values(*arguments):
    values = flags.FlagValues()
    bench.define_flags(values)
    config_flags.parse(["bench", *arguments], values)
    return values


def test_rows_are_chosen_in_the_tables_order():
    assert bench.chosen_rows(None) == list(ROWS)
    assert bench.chosen_rows(["memory", "loop"]) == ["loop", "memory"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rounds=0"], "--rounds=0: must be at least 1"),
        (["--only=update_natur"], "did you mean update_nature\\?"),
        (["--out=FULL"], "not empty; name a new directory"),
        (["--out=FULL/file"], "is not a directory"),
        (["--out=FULL/file/new"], "is not a directory"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_measured(arguments, message, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(bench, "measure", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(ConfigError, match=message):
        bench.bench(_values(*(text.replace("FULL", str(tmp_path)) for text in arguments)))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_bad_flag_is_one_line_and_status_2():
    done = subprocess.run(
        [sys.executable, "-m", "experiments.benchmarks.bench", "--only=speed"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --only=speed: valid: update_nature, ")
    assert done.stderr.count("\n") == 1


def test_a_failed_check_is_one_line_and_status_1(monkeypatch, tmp_path):
    def measure(*_, **__):
        raise CheckFailed("a loss differs")

    monkeypatch.setattr(bench, "measure", measure)
    monkeypatch.setattr(bench, "FLAGS", _values("--only=replay_sample", f"--out={tmp_path}/new"))
    monkeypatch.setattr(bench, "has", lambda *_: True)
    with pytest.raises(SystemExit) as end:
        bench.main([])
    assert end.value.code == "error: a loss differs"  # Python prints it, with status 1
    assert not (tmp_path / "new").exists()


def test_rows_without_their_other_side_are_skipped_and_results_written(monkeypatch, tmp_path, capsys):
    seen = {}

    def measure(chosen, sides, **_):
        seen.update(chosen)
        results = Results()
        results.replies = {"sample": [[0.2]], "gather": [[0.15]]}
        return results

    monkeypatch.setattr(bench, "measure", measure)
    monkeypatch.setattr(bench, "has", lambda python, package: package not in ("torch", "tianshou"))
    bench.bench(_values("--only=replay_sample,update_256,loop", f"--out={tmp_path}/new"))
    assert list(seen) == ["replay_sample"]
    out, err = capsys.readouterr()
    assert "skipped for want of torch: update_256; `make bench-install` installs it\n" in err
    assert "skipped for want of tianshou: loop; `make bench-install` installs it\n" in err
    assert (tmp_path / "new" / "bench.md").read_text(encoding="utf-8") == out
    record = json.loads((tmp_path / "new" / "bench.json").read_text(encoding="utf-8"))
    assert record["rows"]["loop"]["skipped"] == "no tianshou"
    assert record["rows"]["replay_sample"]["figures"]["met"] is True
    assert {"date", "cpu", "cores", "load", "git_revision", "versions", "rounds"} <= record.keys()


def test_the_parent_imports_no_jax():
    code = (
        "import sys, experiments.benchmarks.bench; sys.exit('jax' in sys.modules or 'torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_an_interpreter_that_is_not_there_has_nothing():
    assert bench.has(pathlib.Path(sys.executable), "json")
    assert not bench.has(pathlib.Path(sys.executable), "no_such_package")
    assert not bench.has(pathlib.Path("/no/such/python"), "json")


def test_load_is_nan_where_the_system_does_not_tell(monkeypatch):
    monkeypatch.setattr(bench, "os", types.SimpleNamespace())
    assert bench.load() != bench.load()
