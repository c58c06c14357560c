"""experiments/soaking/sweeps.py would notice what its sweeps are looked at for."""

import json
import os
import subprocess
import sys

import pytest

from experiments.soaking import sweeps
from tests.sweep_test import A, B, Sweep


def _said(line):
    print(line)


@pytest.fixture
def pair(tmp_path):
    found = [Sweep(tmp_path / name).acts() for name in ("alone", "other")]
    for stubs in found:
        assert stubs.run() == 0
    return [stubs.root for stubs in found]


def failed(pair):
    return sweeps.compared("", *pair, _said, "").failed


def test_equal_sweeps_are_equal_and_differences_are_found(pair, capsys):
    assert sweeps.compared("what", *pair, _said, "detail") == ("what", 3, 0, "detail")
    metrics = pair[1] / A / "metrics.jsonl"
    row = json.loads(metrics.read_text())
    metrics.write_text(json.dumps(row | {"wall_s": 77.0}) + "\n")
    assert failed(pair) == 0  # the clock's
    metrics.write_text(json.dumps(row | {"eval/return_mean": 0.51}) + "\n")
    assert failed(pair) == 1 and f"{A}: metrics.jsonl differs" in capsys.readouterr().out
    with open(pair[1] / "logs" / f"{B}.log", "a") as log:
        log.write(f"500 env steps, 1 updates; everything is in {B}\n")
    assert failed(pair) == 2 and f"{B}: run to its end 2 times" in capsys.readouterr().out
    (pair[1] / f"{B}.broken-1").mkdir()
    assert failed(pair) == 3
    (pair[1] / B / "checkpoints/000000500/params.msgpack").unlink()
    failed(pair)
    assert "not complete" in capsys.readouterr().out


def test_figures_are_compared_byte_for_byte(tmp_path):
    for name in ("alone", "other"):
        (tmp_path / name / "figures").mkdir(parents=True)
        (tmp_path / name / "figures" / "6.3.json").write_text("1")
    roots = tmp_path / "alone", tmp_path / "other"
    assert sweeps.same_files(*roots, _said)[1:3] == (1, 0)
    (tmp_path / "other" / "figures" / "6.3.json").write_text("2")
    (tmp_path / "alone" / "figures" / "6.3.png").write_bytes(b"")
    (tmp_path / "alone" / "figures" / "A.1.png").write_bytes(b"x")
    assert sweeps.same_files(*roots, _said)[1:3] == (3, 2)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_descendants_are_all_that_a_process_has_started():
    code = "import subprocess; p = subprocess.Popen(['cat']); print(p.pid, flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    grandchild = int(process.stdout.readline())
    assert sweeps.descendants(process.pid) == [grandchild]
    assert {process.pid, grandchild} <= set(sweeps.descendants(os.getpid()))
    process.communicate("")
