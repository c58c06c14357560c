"""Some of what tests/soak/replay_test.py does a million times, and whether it finds what is planted."""

import pytest
from hypothesis import Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from srl_jax.replay import Replay
from tests.replay.machine import SETTINGS, ReplayMachine


def run(**options):
    small = settings(SETTINGS, max_examples=10, stateful_step_count=20, derandomize=False, **options)
    run_state_machine_as_test(seed(0)(ReplayMachine), settings=small)


def test_replay_does_what_the_reference_does():
    ReplayMachine.done.clear()
    run()
    assert set(ReplayMachine.done) == {"steps", "begins", "samples", "priorities set", "restores"}
    assert ReplayMachine.done.total() > 200


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
def test_planted_bugs_are_found(plant, what, monkeypatch):
    plant(monkeypatch)
    with pytest.raises(AssertionError, match=what) as error:
        run(phases=[Phase.generate])  # without looking for the shortest example
    assert any("state.make(" in note for note in error.value.__notes__)  # what led there is told
