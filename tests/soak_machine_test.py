"""experiments/soaking/machine.py finds nothing wrong with Replay, and finds what is planted."""

import sys

import pytest

from experiments.soaking import machine
from srl_jax.replay import Replay
from srl_jax.specs import ConfigError


def test_the_short_soak_finds_nothing(tmp_path):
    (count,) = machine.soak(True, tmp_path, pytest.fail)
    assert count.failed == 0
    assert count.number >= machine.SHORT
    for operation in ("begins", "steps", "samples", "priorities set", "restores"):
        assert operation in count.detail
    assert not list(tmp_path.iterdir())


def closes_one_too_late(monkeypatch):
    right = Replay._update_tree

    def wrong(self, *arguments):
        self.stack -= 1
        right(self, *arguments)
        self.stack += 1

    monkeypatch.setattr(Replay, "_update_tree", wrong)


def forgets_that_it_was_truncated(monkeypatch):
    right = Replay.add

    def wrong(self, actions, rewards, terminated, truncated, life_lost, frames):
        right(self, actions, rewards, terminated, truncated, life_lost, frames)
        slots = (self.next_position - 2) % self.slots
        self.flags[truncated, slots[truncated]] &= 0b10

    monkeypatch.setattr(Replay, "add", wrong)


def restores_no_ages(monkeypatch):
    right = Replay.restore

    def wrong(self, arrays, numbers):
        right(self, arrays, numbers)
        self.age[:] = 0

    monkeypatch.setattr(Replay, "restore", wrong)


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (closes_one_too_late, "priorities"),
        (forgets_that_it_was_truncated, "windows: "),
        (restores_no_ages, "restored age"),
    ],
)
def test_planted_bugs_are_found(plant, what, monkeypatch, tmp_path):
    plant(monkeypatch)
    said = []
    (count,) = machine.soak(True, tmp_path, said.append)
    assert count.failed == 1
    assert count.number < machine.SHORT
    assert what in count.detail
    assert said[-1].startswith("machine: failed: ")
    assert "state.make(" in (tmp_path / "machine_failure.txt").read_text()  # what led there


def test_without_hypothesis_it_says_so(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "hypothesis", None)
    with pytest.raises(ConfigError, match="needs hypothesis") as error:
        machine.soak(True, tmp_path, pytest.fail)
    assert "\n" not in str(error.value)
