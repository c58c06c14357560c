"""experiments/sweeping/probe.py: how long a run takes, from the rows of a short one."""

import dataclasses

import pytest

from experiments.sweeping import launching, probe, status
from experiments.sweeping.manifest import Entry
from experiments.sweeping.plan import Planned
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from tests.helpers import write_run

CONFIG = Config(game="Catch", frame_size=42, steps=10_000, learn_start=300, eval_every=1_000)
HOW = {"launcher": "local", "workers": 2, "cpus_per_run": 1, "retries": 2}


def row(kind, env_steps, wall_s, **values):
    return {"kind": kind, "env_steps": env_steps, "updates": 0, "wall_s": wall_s, **values}


def short(evaluation=2.0, final=0.0):
    """Until it learns 20 s with an evaluation; then 0.1 s an env step; an evaluation, the end."""
    rows = [row("eval", 0, 5.0, wall_eval_s=4.0), row("train", 200, 15.0)]
    rows += [row("train", n, 20.0 + (n - 500) / 10) for n in range(500, 1501, 200)]
    end = rows[-1]["wall_s"] + evaluation
    rows.append(row("eval", 1500, end, wall_eval_s=evaluation))
    return rows + ([row("final", 1500, end + final)] if final else [])


def test_a_whole_run_by_hand():
    # 20 s to step 500; 9,500 at 0.1 s; ten evaluations of 2 s.
    assert probe.whole(CONFIG, short()) == pytest.approx(20 + 950 + 20)
    # A final evaluation comes once.
    assert probe.whole(CONFIG, short(final=30.0)) == pytest.approx(20 + 950 + 20 + 30)
    # Without a policy nobody plays: the rows of evaluations have no time, or there are none.
    bare = [{k: x for k, x in row.items() if k != "wall_eval_s"} for row in short()]
    assert probe.whole(CONFIG, bare) == pytest.approx(20 + 950 + 2)


def test_it_foretells_a_longer_run_of_the_same_kind():
    """The rows of a run made up by the same rules, to its end."""
    seconds = 20.0 + 0.1 * (CONFIG.steps - 500) + 2.0 * (CONFIG.steps // CONFIG.eval_every)
    assert probe.whole(CONFIG, short()) == pytest.approx(seconds, rel=0.01)


@pytest.fixture
def sweeps(monkeypatch):
    """The sweeps that would have been run; each leaves the rows of `short`."""
    done = []

    def run_sweep(root, entries, **how):
        done.append((entries, how))
        for name in entries:
            (root / name).mkdir(parents=True)
        return 0

    monkeypatch.setattr(launching, "run_sweep", run_sweep)
    monkeypatch.setattr(probe, "read_rows", lambda path: short())
    return done


def entries(*names):
    """Runs of GAME/ARM/seedN, alike but for their games."""
    found = {}
    for name in names:
        game = name.partition("/")[0]
        flags = {"game": game, "seed": "0", "steps": "10000"}
        found[name] = Entry(Planned(name, "catch/rl_only", flags), dataclasses.replace(CONFIG, game=game))
    return found


def test_a_kind_is_timed_on_as_many_games_at_once_as_the_sweep_has(tmp_path, sweeps):
    names = ("Catch/a/seed0", "Catch/a/seed1", "CatchDistractor/a/seed0", "catch:ball=2/a/seed0")
    measured = probe.measured(tmp_path, entries(*names), HOW)
    ((ran, how),) = sweeps
    assert list(ran) == ["Catch/a/seed0", "CatchDistractor/a/seed0"]
    assert how["workers"] == 2 and how["retries"] == 0
    for entry in ran.values():
        assert (entry.config.steps, entry.config.eval_every) == (300 + probe.LEARNING,) * 2
    steps, seconds = measured[status.alike(CONFIG)]
    assert steps == 20_000 and seconds / steps == pytest.approx(990 / 10_000, rel=0.01)
    assert list(tmp_path.iterdir()) == []


def test_what_has_been_timed_here_is_not_timed_again(tmp_path, sweeps):
    write_run(tmp_path / "Catch/a/seed0", (0.0, 1.0, 2.0), every=1000)
    assert probe.measured(tmp_path, entries("Catch/a/seed0", "Catch/a/seed1"), HOW) == {}
    assert probe.measured(tmp_path, entries("Catch/a/seed1"), {**HOW, "launcher": "ray"}) == {}
    assert sweeps == []


def test_a_short_run_that_fails_is_said(tmp_path, sweeps, monkeypatch):
    monkeypatch.setattr(launching, "run_sweep", lambda *given, **how: 1)
    with pytest.raises(ConfigError, match="ended with status 1"):
        probe.measured(tmp_path, entries("Catch/a/seed0"), HOW)
