"""Tests of srl_jax.files.reading."""

import math
import os

import pytest

from srl_jax.files.reading import parse_json, read_bytes


def test_a_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\0\xff\n" * 5)
    (tmp_path / "link").symlink_to(path)
    for name in (path, str(path), tmp_path / "link"):
        assert read_bytes(name, 15) == b"\0\xff\n" * 5
    with pytest.raises(OSError) as error:
        read_bytes(path, 14)
    assert error.value.strerror == "File larger than 14 bytes"
    assert read_bytes(path, 10**30) == path.read_bytes()


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "No such file"),
        (os.mkfifo, "Not a regular file"),
        (os.mkdir, "Is a directory"),
        (lambda path: path.symlink_to("/dev/zero"), "Not a regular file"),
        (lambda path: path.symlink_to(path.name), "symbolic links"),
        (lambda path: path.write_bytes(b"") or os.truncate(path, 1 << 40), "File larger than"),
    ],
    ids=["nothing", "pipe", "folder", "device", "loop", "terabyte"],
)
def test_what_is_no_file_is_refused_at_once(make, reason, tmp_path):
    make(tmp_path / "file")
    with pytest.raises(OSError) as error:
        read_bytes(tmp_path / "file", 1000)
    assert reason in error.value.strerror and error.value.filename == str(tmp_path / "file")


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000])
def test_names_that_no_file_can_have(name):
    with pytest.raises(OSError) as error:
        read_bytes(name, 1000)
    assert error.value.strerror


def test_json_is_read():
    text = '{"a": [1, 2.5, null, true], "b": {"a": "\\u00e9"}}'
    assert parse_json(text) == parse_json(text.encode()) == {"a": [1, 2.5, None, True], "b": {"a": "é"}}
    assert math.isnan(parse_json("[NaN]")[0])
    assert parse_json("[NaN]", str.lower) == ["nan"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "Expecting value"),
        ('{"a": 1, "b": 2, "a": 1}', "'a' is there twice"),
        ('[{"b": {"c": 1, "c": 2}}]', "'c' is there twice"),
        ("[" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        (b'"\xff"', "utf-8"),
        ('{"a": 1}'.encode("utf-16"), "utf-8"),
        ("1" * 5000, "digits"),
    ],
)
def test_what_is_no_json_is_refused(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_json(text)
