import errno
import hashlib
import io

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srl_jax.errors import SaveError
from srl_jax.files import metrics
from srl_jax.files.metrics import Mark, MetricsWriter, read_metrics, strip_wall


def lines(path):
    return path.read_text().splitlines()


def test_row_is_one_line_in_the_documented_order(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with MetricsWriter(path) as writer:
        writer.write("train", 320, 32, 1.23456, {"z": 1, "loss/rl": np.float32(0.1), "a": True})
    assert path.read_text() == (
        '{"kind": "train", "env_steps": 320, "updates": 32, "wall_s": 1.235, '
        '"a": true, "loss/rl": 0.1, "z": 1}\n'
    )


def test_every_row_is_on_disk_before_the_writer_closes(tmp_path):
    path = tmp_path / "metrics.jsonl"
    writer = MetricsWriter(path)
    for step in range(3):
        writer.write("eval", step, 0, 0.0, {})
        assert [row["env_steps"] for row in read_metrics(path)] == list(range(step + 1))
    writer.close()
    writer.close()


def test_values_of_all_kinds(tmp_path):
    path = tmp_path / "metrics.jsonl"
    values = {
        "array": jnp.array([1.5, 0.1]),
        "double": 0.1,
        "half": jnp.bfloat16(0.5),
        "int": np.int64(3),
        "list": [np.float32(0.3), 2],
        "none": None,
        "flag": np.bool_(True),
        "scalar": jnp.float32(1e-6),
        "text": "x",
    }
    with MetricsWriter(path) as writer:
        writer.write("eval", np.int64(1), jnp.int32(2), 0.0, values)
    row = read_metrics(path)[0]
    assert {key: row[key] for key in values} == {
        "array": [1.5, 0.1],
        "double": 0.1,
        "half": 0.5,
        "int": 3,
        "list": [0.3, 2],
        "none": None,
        "flag": True,
        "scalar": 1e-6,
        "text": "x",
    }


def test_what_json_lacks_becomes_null_and_reads_as_nan(tmp_path):
    path = tmp_path / "metrics.jsonl"
    bad = [float("nan"), np.float32("inf"), -np.float64("inf"), jnp.float32("nan")]
    with MetricsWriter(path) as writer:
        writer.write("train", 0, 0, 0.0, {"x": bad, "y": jnp.array([jnp.nan, 1.0])})
    row = read_metrics(path)[0]
    assert row["x"] == [None] * 4 and row["y"] == [None, 1.0]
    assert np.isnan(np.array(row["x"], float)).all()


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_float32_round_trips_by_its_shortest_decimal(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("metrics") / "metrics.jsonl"
    with MetricsWriter(path) as writer:
        writer.write("train", 0, 0, 0.0, {"x": np.float32(value)})
    read = read_metrics(path)[0]["x"]
    assert np.float32(read) == np.float32(value)
    # 9 significant digits always suffice for a float32.
    assert float(f"{read:.8e}") == read


@pytest.mark.parametrize(
    ("kind", "values", "error", "words"),
    [
        ("test", {}, ValueError, "valid: train, eval"),
        ("train", {"wall_s": 1.0}, ValueError, "wall_s"),
        ("train", {"x": object()}, TypeError, "x: .*type object"),
        ("train", {"x": 1j}, TypeError, "x: .*type complex"),
    ],
)
def test_bad_rows_are_refused_and_nothing_is_written(tmp_path, kind, values, error, words):
    path = tmp_path / "metrics.jsonl"
    with MetricsWriter(path) as writer, pytest.raises(error, match=words):
        writer.write(kind, 0, 0, 0.0, values)
    assert path.read_text() == ""


def test_a_file_cut_anywhere_reads_up_to_the_cut_and_can_be_continued(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with MetricsWriter(path) as writer:
        for step in range(2):
            writer.write("train", step, 0, 0.0, {"text": "ä", "x": 1.0})
    data = path.read_bytes()
    ends = [data.index(b"}") + 1, len(data) - 1]  # a row is whole with or without its newline
    for cut in range(len(data) + 1):
        path.write_bytes(data[:cut])
        whole = sum(cut >= end for end in ends)
        assert [row["env_steps"] for row in read_metrics(path)] == list(range(whole))
        with MetricsWriter(path) as writer:
            writer.write("eval", 9, 0, 0.0, {})
        assert [row["env_steps"] for row in read_metrics(path)] == [*range(whole), 9]


class Full(io.FileIO):
    """A file that is full."""

    def write(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("when", ["mended", "ended", "opened"])
def test_a_file_that_cannot_be_opened_or_ended_is_named(tmp_path, monkeypatch, when):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"kind": "train", "env_steps": 1}')

    def full(file, mode):
        if when == {"r+b": "mended", "ab": "opened"}[mode]:
            raise OSError(errno.ENOSPC, "No space left on device")
        return Full(file, "r+") if when == "ended" else open(file, mode)

    monkeypatch.setattr(metrics, "open", full, raising=False)
    with pytest.raises(SaveError, match=r"metrics.jsonl: not opened: No space left on device$"):
        MetricsWriter(path)


def test_a_file_is_cut_back_to_a_mark_and_continued(tmp_path):
    path = tmp_path / "metrics.jsonl"
    marks = []
    with MetricsWriter(path) as writer:
        for step in range(4):
            marks.append(writer.mark())
            writer.write("train", step, 0, 0.0, {"x": step / 3})
    data = path.read_bytes()
    assert marks[0] == Mark(0, hashlib.sha256(b"").hexdigest())
    for step, mark in reversed(list(enumerate(marks))):
        assert mark.sha256 == hashlib.sha256(data[: mark.bytes]).hexdigest()
        path.write_bytes(data[: -step or None])  # a killed process may have been anywhere in a line
        with MetricsWriter(path, mark=mark) as writer:
            assert writer.mark() == mark
            for later in range(step, 4):
                assert writer.mark() == marks[later]
                writer.write("train", later, 0, 0.0, {"x": later / 3})
        assert path.read_bytes() == data


@pytest.mark.parametrize("line", ["{", '{"x": NaN}', "[1]", ""])
def test_a_damaged_line_before_the_last_is_named(tmp_path, line):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"x": 1}\n' + line + '\n{"x": 2}\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 2: "):
        read_metrics(path)


def test_strip_wall_removes_what_the_clock_decides_and_nothing_else():
    row = {"kind": "train", "wall_s": 1.0, "wall_steps_per_s": 2.0, "loss/wall_e": 3.0}
    assert strip_wall(row) == {"kind": "train", "loss/wall_e": 3.0}
    assert "wall_s" in row
