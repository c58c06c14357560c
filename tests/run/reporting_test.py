"""srl_jax/run/reporting.py: means of updates, and rows that go on as if nobody had stopped."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srl_jax.config import Config
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files.metrics import read_metrics
from srl_jax.learning.optim import NOT_MEASURED
from srl_jax.run import reporting
from srl_jax.run.evaluate import Evaluation
from srl_jax.run.reporting import Means, Report
from tests.helpers import rows_of


def one_by_one(rows, name):
    """The mean as it is defined: float64 sums in the order of the updates, then one division."""
    total, count = 0.0, 0
    for row in rows:
        if name in row and not (name.startswith("grad_norm/") and row[name] < 0):
            total, count = total + float(row[name]), count + 1
    return np.float32(total / count)


def make_rows(number, seed=0):
    """Updates of which every third measures a representation's loss, and every fifth a norm."""
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(number):
        row = {"loss/rl": np.float32(rng.lognormal(sigma=8)), "loss/total": np.float32(rng.normal())}
        row["grad_norm/encoder"] = np.float32(abs(rng.normal()) if i % 5 == 0 else NOT_MEASURED)
        if i % 3 == 0:
            row["loss/inverse"] = np.float32(rng.normal())
        rows.append(row)
    return rows


def bits(means):
    return {name: (x.dtype, x.tobytes()) for name, x in means.items()}


@given(st.integers(1, 60), st.sets(st.integers(0, 50)))
def test_means_are_sums_in_order_wherever_they_are_looked_at(number, looks):
    rows = make_rows(number, seed=number)
    means = Means()
    for i, row in enumerate(rows):
        means.add(row)
        if i in looks:  # a snapshot, too, from which another one goes on
            assert means.broken() is None
            text = json.dumps(means.snapshot(), allow_nan=False)
            means = Means()
            means.restore(json.loads(text))
    names = {name for row in rows for name in row}
    assert bits(means.take()) == bits({name: one_by_one(rows, name) for name in names})
    assert means.take() == {}  # anew


def test_a_norm_that_was_not_measured_is_left_out():
    means = Means()
    for norm in (NOT_MEASURED, 3.0, NOT_MEASURED, 5.0):
        means.add({"grad_norm/encoder": np.float32(norm), "loss/rl": np.float32(1)})
    assert means.broken() is None
    assert means.take() == {"grad_norm/encoder": 4.0, "loss/rl": 1.0}
    means.add({"grad_norm/encoder": np.float32(NOT_MEASURED)})
    assert means.take() == {}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [0, 7])
def test_a_loss_that_is_not_finite_is_named(bad, at):
    means = Means()
    for i in range(12):
        assert i > at or means.broken() is None
        losses = {"loss/total": 1.0, "loss/a": 1.0, "rl/q": np.inf}
        if i == at:
            losses |= {"loss/a": bad, "loss/total": bad}
        means.add({name: np.float32(x) for name, x in losses.items()})
    assert means.broken() == "loss/a"  # the part, not the total that it is in
    # Its gradient has made all parameters NaN.
    means.add({name: np.float32(np.nan) for name in ("loss/total", "loss/a", "loss/b")})
    assert means.broken() == "loss/a"
    means.take()
    means.add({"loss/total": np.float32(bad)})
    assert means.broken() == "loss/total"
    means.take()
    means.add({name: np.float32(bad) for name in ("loss/b", "loss/total", "loss/a")})
    assert means.broken() == "loss/a, loss/b"


def test_snapshots_of_means_are_exact():
    means = Means()
    values = {"rl/q": np.inf, "rl/nan": np.nan, "rl/low": -np.inf, "loss/rl": 0.1, "loss/a": 1e-45}
    for _ in range(3):
        means.add({name: np.float32(x) for name, x in values.items()})
    other = Means()
    other.restore(json.loads(json.dumps(means.snapshot(), allow_nan=False)))
    assert other.snapshot() == means.snapshot()
    assert bits(other.take()) == bits(means.take())


# Rows


def report(out):
    out.mkdir(exist_ok=True)
    return Report(out, Config(steps=1000), progress=False)


def go_on(one, first, last):
    """Steps of a run that has a row after every fourth step, and episodes that end now and then."""
    rows = make_rows(40)
    for step in range(first, last):
        one.means.add(rows[step])
        if step % 3 == 0:
            one.ended(np.array([step / 7, -1.0]))
        if step % 4 == 3:
            one.train_row(10 * (step + 1), step, {"epsilon": step / 9})
        if step % 8 == 7:
            one.eval_row(10 * (step + 1), step, {"eval/return_mean": step / 3})


@pytest.mark.parametrize("stop", range(0, 12))
@pytest.mark.parametrize("later", [0, 1, 9])
def test_rows_after_a_snapshot_are_those_that_would_have_been(tmp_path, stop, later):
    whole = report(tmp_path / "whole")
    with whole:
        go_on(whole, 0, 24)
    killed = report(tmp_path / "killed")
    with killed:
        go_on(killed, 0, stop)
        snapshot = json.loads(json.dumps(killed.snapshot(), allow_nan=False))
        go_on(killed, stop, stop + later)  # what it wrote after its last checkpoint
    with open(tmp_path / "killed" / "metrics.jsonl", "ab") as file:
        file.write(b'{"kind": "tr')
    again = report(tmp_path / "killed")
    again.restore(snapshot)
    with again:
        go_on(again, stop, 24)
    rows = rows_of(tmp_path / "killed")
    assert rows == rows_of(tmp_path / "whole")
    assert [row["env_steps"] for row in rows if row["kind"] == "train"] == [40, 80, 120, 160, 200, 240]
    # By hand: before the first row, steps 0 and 3 ended two episodes each.
    assert rows[0]["train/episodes"] == 4
    assert rows[0]["train/return_mean"] == pytest.approx((0 + 3 / 7 - 2) / 4)


def test_the_clock_goes_on_where_it_was(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(reporting.time, "perf_counter", lambda: now[0])
    first = report(tmp_path / "run")
    with first:
        now[0] += 8
        first.train_row(400, 0, {})
        now[0] += 2
        snapshot = first.snapshot()
    now[0] = 5000.0  # another process, another clock
    second = report(tmp_path / "run")
    second.restore(snapshot)
    with second:
        assert second.seconds == 10
        now[0] += 3
        second.train_row(700, 0, {})
    rows = read_metrics(tmp_path / "run" / "metrics.jsonl")
    # 400 env steps in 8 s; then 300 in 2 + 3 s.
    assert [(row["wall_s"], row["wall_steps_per_s"]) for row in rows] == [(8, 50), (13, 60)]


@pytest.mark.parametrize("change", ["other", "shorter", "missing", "directory"])
def test_metrics_that_the_checkpoint_does_not_know_are_left_alone(tmp_path, change):
    first = report(tmp_path / "run")
    with first:
        go_on(first, 0, 9)
        snapshot = first.snapshot()
        go_on(first, 9, 20)
    path = tmp_path / "run" / "metrics.jsonl"
    data = path.read_bytes()
    if change == "other":
        data = data.replace(b"epsilon", b"Epsilon", 1)
    elif change == "shorter":
        data = data[: snapshot["metrics"]["bytes"] - 1]
    path.write_bytes(data)
    if change in ("missing", "directory"):
        path.unlink()
    if change == "directory":
        path.mkdir()
    second = report(tmp_path / "run")
    second.restore(snapshot)
    with pytest.raises(ConfigError, match=f"{path}: .*the checkpoint knows") as error, second:
        pass
    assert "\n" not in str(error.value)
    if change in ("other", "shorter"):
        assert path.read_bytes() == data
    else:
        assert path.exists() == (change == "directory")


def test_a_full_disk_is_a_save_error(tmp_path):
    with pytest.raises(SaveError, match="metrics.jsonl: a row was not written: No space left") as error:
        with report(tmp_path / "run") as one:
            one._writer._file.close()
            one._writer._file = open("/dev/full", "ab")
            one.train_row(1, 1, {})
    assert "\n" not in str(error.value)


def test_what_cannot_be_flushed_is_a_save_error(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    with report(tmp_path / "run") as one:
        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(SaveError, match="metrics.jsonl: not flushed: No space left"):
            one.snapshot()


def test_an_evaluation_says_how_many_games_were_cut(tmp_path, monkeypatch):
    report = Report(tmp_path, Config(eval_max_steps=9), progress=False)
    said = []
    monkeypatch.setattr(report.progress, "note", said.append)
    with report:
        for cut in (0, 1):
            report.evaluation("eval", 0, 0, Evaluation([1.0, 3.0], [9, 3], None, cut), 2.0, {})
    assert said[0] == "evaluation after 0 env steps: mean return 2.00 over 2 games, 2.0 s"
    assert said[1] == said[0] + ", 1 of them cut at 9 env steps"
