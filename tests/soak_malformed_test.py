"""experiments/soaking/malformed.py: some of its cases, and that its judge sees every kind of fault."""

import os

import pytest

from experiments.soaking import malformed
from experiments.soaking.malformed import Outcome, judge, listing
from experiments.soaking.malformed_cases import KINDS, VALID, cases


def test_the_short_version_finds_nothing(tmp_path):
    said = []
    counts = malformed.soak(True, tmp_path, said.append)
    assert sum(count.number for count in counts) == len(malformed.SHORT) == 12
    assert [count for count in counts if count.failed] == [], said
    assert {count.what for count in counts} <= set(KINDS)


def test_there_are_cases_of_every_kind():
    kinds = [case.kind for case in cases()]
    assert set(kinds) == set(KINDS)
    assert len(kinds) - kinds.count(VALID) >= 220


GOOD = Outcome(2, "", "error: --steps=x: not a whole number\n")


@pytest.mark.parametrize(
    ("outcome", "fault"),
    [
        (GOOD, None),
        (GOOD._replace(status=0), "status 0"),
        (GOOD._replace(status=1), "status 1"),
        (GOOD._replace(status=None), "took more than"),
        (GOOD._replace(stderr=""), "0 lines"),
        (GOOD._replace(stderr="\n"), "1 lines"),
        (GOOD._replace(stderr=GOOD.stderr * 2), "2 lines"),
        (GOOD._replace(stderr="Traceback (most recent call last):\n"), "traceback"),
        (GOOD._replace(stderr="error: something is wrong\n"), "'--steps' is not in"),
        (GOOD._replace(stderr="error: --steps=\x1b[31m: no\n"), "control characters"),
        (GOOD._replace(stdout="{}"), "printed"),
    ],
)
def test_the_judge_sees_a_fault(outcome, fault):
    problems = judge(outcome, "--steps", {}, {})
    assert not problems if fault is None else any(fault in problem for problem in problems)


def _append(folder):
    with open(folder / "file", "a") as file:
        file.write("!")


def _retouch(folder):
    os.utime(folder / "file", ns=(0, 0))


def _relink(folder):
    (folder / "link").unlink()
    (folder / "link").symlink_to("elsewhere")


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        (lambda folder: None, None),
        (lambda folder: (folder / "new").mkdir(), "new"),
        (lambda folder: (folder / "CANARY").touch(), "executed"),
        (lambda folder: (folder / "file").unlink(), "file"),
        (_append, "file"),
        (_retouch, "file"),
        (_relink, "link"),
    ],
)
def test_the_judge_sees_what_changed_in_the_folder(change, seen, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    before = listing(tmp_path)
    change(tmp_path)
    problems = judge(GOOD, "--steps", before, listing(tmp_path))
    assert not problems if seen is None else any(seen in problem for problem in problems)
