"""experiments/sweeping/speed.py and table.py: how far, how fast, how long still."""

import dataclasses
import io
import json
import pathlib

import pytest

from experiments import packing
from experiments.sweeping import speed, table
from experiments.sweeping.launching import View
from experiments.sweeping.manifest import Entry
from experiments.sweeping.plan import Planned
from experiments.sweeping.speed import Progress, Speeds, seconds_left
from srl_jax import ending
from srl_jax.config import Config
from srl_jax.ending import Ending
from tests.helpers import NOT_FINITE

CONFIG = Config(game="Catch", frame_size=42, steps=1000, learn_start=10)


def entries(**sources):
    return {name: Entry(Planned(name, "demo", {}, source), CONFIG) for name, source in sources.items()}


def write(run, *rows):
    run.mkdir(parents=True)
    lines = [
        {"kind": kind, "env_steps": steps, "updates": 0, "wall_s": seconds, **more}
        for kind, steps, seconds, more in rows
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"cut": ')


def test_time_left_by_hand():
    runs = entries(a="", b="a", c="")
    # a: 500 steps at 10/s are 50 s; b, which starts from it: 1000 at 20/s, 50 s; c: 1000 at 50/s, 20 s.
    rates = {"a": 10.0, "b": 20.0, "c": 50.0}
    assert seconds_left(runs, {"a": 500}, rates, 1) == (120.0, 0)
    # Two at once: 60 s of work each, but b cannot begin before a has ended.
    assert seconds_left(runs, {"a": 500}, rates, 2) == (100.0, 0)
    assert seconds_left(runs, {"a": 500}, rates, 2, done=["a", "b"]) == (20.0, 0)
    assert seconds_left(runs, {}, {"a": None, "c": 50.0}, 2) == (20.0, 2)


def test_progress_is_read_from_the_end(tmp_path):
    write(
        tmp_path / "run",
        ("eval", 0, 1.0, {"eval/return_mean": -1.0}),
        ("train", 100, 4.0, {}),
        ("eval", 200, 6.0, {"eval/return_mean": 0.25}),
        ("train", 300, 8.0, {}),
    )
    assert speed.progress(tmp_path / "run") == Progress(300, 8.0, 50.0, 0.25)
    assert speed.progress(tmp_path / "none") == Progress()
    # A long file: its beginning is not read, its last line counts.
    with open(tmp_path / "run" / "metrics.jsonl", "w") as file:
        for n in range(20_000):
            file.write(json.dumps({"kind": "train", "env_steps": n, "updates": 0, "wall_s": n / 4}) + "\n")
    assert speed.progress(tmp_path / "run") == Progress(19_999, 19_999 / 4, 4.0, None)


def test_speeds_are_of_like_runs(tmp_path):
    other = dataclasses.replace(CONFIG, batch_size=99)
    known = {"a": CONFIG, "b": CONFIG, "c": other}
    runs = {name: Entry(Planned(name, "demo", {}), config) for name, config in known.items()}
    write(tmp_path / "a", ("train", 1000, 10.0, {}))
    write(tmp_path / "b", ("train", 500, 20.0, {}))
    write(tmp_path / "c", ("train", 300, 1.0, {}))
    speeds = Speeds(tmp_path, runs.values(), results=tmp_path / "none")
    assert speeds.of(CONFIG) == (50.0, "runs of this sweep")  # 1500 env steps in 30 s
    assert speeds.of(other) == (300.0, "runs of this sweep")
    # Another batch: the nearest is all of the same encoder and mode, 1800 env steps in 31 s.
    third = dataclasses.replace(CONFIG, batch_size=7)
    assert speeds.of(third) == (1800 / 31, "runs of this sweep, of other settings")
    assert speeds.of(dataclasses.replace(CONFIG, encoder="sac_ae:features=50")) is None
    # Published runs count where the sweep's own do not.
    published = packing.read(speed.RESULTS / "catch")[-1].config
    found = Speeds(tmp_path, runs.values()).of(dataclasses.replace(published, seed=99))
    assert found.source == "published runs, on their machine" and 100 < found.per_s < 5000


def view(**changes):
    return View([], {}, [], {}, {}, {})._replace(**changes)


def test_the_table_says_what_runs_and_what_failed(tmp_path):
    runs = entries(**{name: "" for name in "abcde"})
    lines = table.table(
        pathlib.Path("runs/x"),
        runs,
        view(
            running=["a"], done=["b"], failed={"c": "status 1: no"}, waiting={"d": "", "e": "process 3 on z"},
            attempts={"a": 2},
        ),
        {"a": Progress(250, 5.0, 50.0, -0.5)},
        (3661.0, 1),
    )  # fmt: skip
    assert lines == [
        "1 of 5 runs done, 1 running, 2 waiting, 1 failed, 1:01:01 left and 1 of unknown speed | runs/x",
        "run  where  env steps  steps/s     left  evaluation  attempt",
        "a           250/1,000       50  0:00:15        -0.5        2",
        "c: failed: status 1: no",
        "e: waiting: process 3 on z",
    ]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal(), io.StringIO()])
def test_the_screen_redraws_on_a_terminal_and_tells_changes_elsewhere(tmp_path, stream):
    now = [0.0]
    runs = entries(a="", b="")
    screen = table.Screen(tmp_path, runs, 1, stream, clock=lambda: now[0])
    screen.update(view(waiting={"a": "", "b": ""}))
    now[0] = 0.5
    screen.update(view(waiting={"b": ""}, running=["a"], attempts={"a": 1}))
    now[0] = 70.0
    screen.note("something")
    screen.update(view(failed={"a": "no", "b": "no"}), final=True)
    text = stream.getvalue()
    if stream.isatty():
        assert text.count("\x1b[1F\x1b[J") == 1 and "a: started" not in text
    else:
        assert "\x1b" not in text and text.count("sweep: a: started\n") == 1
    assert text.count("2 waiting") == 1 and text.count("0 of 2 runs done, 2 failed") == 1
    assert text.endswith("\na: failed: no\nb: failed: no\n")


def test_a_run_that_failed_without_a_sweep_is_shown_as_failed(tmp_path):
    found = entries(a="", b="", c="a")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        found[name].config.save(tmp_path / name)
    ending.write(tmp_path / "a", NOT_FINITE)
    ending.write(tmp_path / "b", Ending("stopped", 100))
    seen = table.view_of_files(tmp_path, found)
    assert seen.failed == {"a": NOT_FINITE.reason} and seen.blocked == {"c": "a failed"}
    assert seen.waiting == {"b": ""}
