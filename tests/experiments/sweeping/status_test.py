"""experiments/sweeping/status.py: how far, how fast, how long still, which arm is best."""

import dataclasses
import json

from experiments import packing
from experiments.runs import collect
from experiments.sweeping import status
from experiments.sweeping.manifest import Entry
from experiments.sweeping.plan import Planned
from experiments.sweeping.status import Progress, rates, seconds_left
from srl_jax import training
from srl_jax.config import Config
from srl_jax.files import rundir
from srl_jax.run import ending
from srl_jax.run.ending import Ending
from tests.helpers import NOT_FINITE, write_run

CONFIG = Config(game="Catch", frame_size=42, steps=1000, learn_start=10)


def entries(config=CONFIG, **sources):
    return {name: Entry(Planned(name, "demo", {}, source), config) for name, source in sources.items()}


def write(run, *rows):
    """A run with these rows: env steps, seconds, mean return."""
    run.mkdir(parents=True, exist_ok=True)
    CONFIG.save(run)
    lines = [{"env_steps": n, "wall_s": s, **({"eval/return_mean": x[0]} if x else {})} for n, s, *x in rows]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"cut": ')


def test_time_left_by_hand():
    runs = entries(b="a", a="", c="")
    # a: 500 steps at 10/s are 50 s; b, which starts from it: 1000 at 20/s, 50 s; c: 1000 at 50/s, 20 s.
    per_s = {"a": 10.0, "b": 20.0, "c": 50.0}
    steps = {"a": 500, "b": 1000, "c": 1000}
    assert seconds_left(runs, steps, per_s, 1) == (120.0, 0)
    # Two at once: 60 s of work each, but b cannot begin before a has ended.
    assert seconds_left(runs, steps, per_s, 2) == (100.0, 0)
    assert seconds_left(runs, {"c": 1000}, per_s, 2) == (20.0, 0)
    assert seconds_left(runs, steps, {"a": None, "b": None, "c": 50.0}, 2) == (20.0, 2)


def test_progress_is_read_from_the_end(tmp_path):
    write(tmp_path / "run", (0, 1.0, -1.0), (100, 4.0), (200, 6.0, 0.25), (300, 8.0))
    assert status.progress(tmp_path / "run") == Progress(300, 8.0, 0.25)
    assert status.progress(tmp_path / "none") == Progress()
    # A long file: its beginning is not read, its last whole line counts.
    write(tmp_path / "run", (0, 1.0, -1.0), *((n, n / 4) for n in range(20_000)))
    assert status.progress(tmp_path / "run") == Progress(19_999, 19_999 / 4, None)
    # A row may be longer than what is read at first.
    assert status.progress(tmp_path / "run", tail=20) == Progress(19_999, 19_999 / 4, None)


def test_a_rate_is_a_runs_own_or_that_of_runs_like_it(tmp_path):
    write(tmp_path / "a", (1000, 10.0))
    write(tmp_path / "b", (500, 20.0))
    write(tmp_path / "c", (15, 1.0))  # has hardly learnt
    other = dataclasses.replace(CONFIG, encoder="tiny:features=77")
    published = dataclasses.replace(packing.read(status.RESULTS / "catch")[-1].config, seed=99)
    assert "end=" not in published.encoder  # an option that is newer, which a sweep of today writes out
    today = training.completed(published)
    found = entries(a="", b="", c="", d="") | entries(other, x="") | entries(published, y="")
    found = rates(tmp_path, found | entries(today, z=""))
    # 1500 env steps in 30 s.
    assert found.pop("y") == found.pop("z") > 100  # on the machine where it was measured
    assert found == {"a": 100.0, "b": 25.0, "c": 50.0, "d": 50.0, "x": None}


def test_the_table_says_what_runs_and_what_failed(tmp_path):
    found = entries(a="", b="", c="b", d="c", e="", f="")
    write(tmp_path / "a", (250, 5.0, -0.5))
    for name, ended in {"b": NOT_FINITE, "e": Ending("stopped", 100)}.items():
        write(tmp_path / name)
        ending.write(tmp_path / name, ended)
    with rundir.held(tmp_path / "a"):
        by = status.view(tmp_path, found)["a"][1]
        lines = status.lines(tmp_path, found, 1)
    assert by.startswith("process ")
    assert lines[0] == "0 of 6 runs done, 1 running, 2 waiting, 1 failed, 2 blocked, 0:00:55 left"
    assert [line.split()[:5] for line in lines[1:3]] == [
        ["run", "env", "steps", "steps/s", "left"],
        ["a", "250/1,000", "50", "0:00:15", "-0.5"],
    ]
    assert lines[3:] == [f"b: failed: {NOT_FINITE.reason}", "c: blocked: b failed", "d: blocked: b failed"]


def test_a_dry_run_writes_nothing_and_counts(tmp_path):
    found = entries(**{"Catch/a/seed0": "", "Catch/a/seed1": "", "Catch/b/seed0": ""})
    write(tmp_path / "Catch/a/seed0", (1000, 10.0))
    before = sorted(tmp_path.rglob("*"))
    lines = status.dry_run(tmp_path, found, 2)
    # Without a checkpoint the first begins again: 1000 env steps each at 100/s.
    assert [line.split() for line in lines[1:3]] == [
        ["Catch/a", "2", "0", "2", "2,000", "100", "0:00:20"],
        ["Catch/b", "1", "0", "1", "1,000", "100", "0:00:10"],
    ]
    assert lines[3:] == [
        "3 of 3 runs to run, 3,000 env steps, 0:00:15 with 2 at once; each start takes up to a minute more"
    ]
    assert sorted(tmp_path.rglob("*")) == before
    slow = dataclasses.replace(CONFIG, encoder="tiny:features=77")
    line, why = status.dry_run(tmp_path / "new", entries(slow, **{"Catch/a/seed0": ""}), 2)[2:]
    assert line == "1 of 1 runs to run, 1,000 env steps, unknown time with 2 at once"
    assert f"srl-jax sweep --out={tmp_path / 'new'} --status" in why
    # Seeds that go at their own speeds: 10 s and 40 s, in the table and in all.
    write(tmp_path / "Catch/a/seed1", (1000, 40.0))
    both = {name: found[name] for name in found if "/a/" in name}
    _, row, line = status.dry_run(tmp_path, both, 1)
    assert row.split() == ["Catch/a", "2", "0", "2", "2,000", "40", "0:00:50"] and "0:00:50 with 1" in line


def test_the_best_arm_comes_first(tmp_path):
    # Areas by hand: 1 and 1; 2 and 3, whose interval is 2.5 and 12.706 times 0.5 to either side.
    for arm, returns in {"a": [(0, 2), (2, 0)], "b": [(1, 3), (2, 4)]}.items():
        for seed, its in enumerate(returns):
            write_run(tmp_path / "Catch" / arm / f"seed{seed}", its, seed=seed)
    write_run(tmp_path / "CatchDistractor" / "a" / "seed0", game="CatchDistractor")
    lines = status.best(collect.load_runs(tmp_path))
    assert [line.split() for line in lines[:3]] == [
        ["Catch", "seeds", "area", "95", "%", "at", "the", "end"],
        ["b", "2", "2.5", "[-3.853,", "8.853]", "3.5"],
        ["a", "2", "1", "-", "1"],
    ]
    assert lines[3].startswith("area: mean evaluation return up to 100 env steps. The best of 2 is flattered")
    assert len(lines) == 4
    assert status.best(collect.load_runs(tmp_path / "CatchDistractor")) == []


def test_alike_are_runs_of_the_same_work():
    other = {
        "updates_per_step": 1.0,
        "batch_size": 64,
        "encoder": "der",
        "mode": "joint",
        "objectives": ("spr",),
        "game": "Pong",
    }
    kinds = {status.alike(dataclasses.replace(CONFIG, **{name: value})) for name, value in other.items()}
    assert len(kinds | {status.alike(CONFIG)}) == 7
    same = dataclasses.replace(CONFIG, game="CatchDistractor", seed=3, lr_rl=1e-3)
    assert status.alike(same) == status.alike(CONFIG)


def test_a_measured_speed_counts_where_nothing_here_was_timed(tmp_path):
    write(tmp_path / "a", (1000, 10.0))
    new = dataclasses.replace(CONFIG, encoder="tiny:features=77")
    found = entries(a="") | entries(new, x="")
    measured = {status.alike(CONFIG): (10, 1.0), status.alike(new): (1000, 50.0)}
    assert rates(tmp_path, found, measured) == {"a": 100.0, "x": 20.0}
    # x: 1000 steps at 20/s are 50 s; a, which has no checkpoint, is not timed anew: 1000 at 100/s.
    (line,) = [line for line in status.dry_run(tmp_path / "new", entries(new, x=""), 1, measured)][-1:]
    assert "0:00:50 with 1 at once" in line
