"""A million operations on replays beside their reference, see `tests/replay/machine.py`."""

from collections import Counter

from hypothesis import seed, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.replay.machine import SETTINGS, ReplayMachine


def test_replay_does_what_an_obvious_reference_does(amount, progress, record_property, monkeypatch):
    wanted, done = amount("operations"), Counter()
    monkeypatch.setattr(ReplayMachine, "done", done)
    finish = ReplayMachine.finish

    def told(self, operation):
        finish(self, operation)
        progress(done.total(), wanted, "operations")

    monkeypatch.setattr(ReplayMachine, "finish", told)
    small = settings(SETTINGS, max_examples=100, stateful_step_count=30, derandomize=False)
    number = 0
    try:
        while done.total() < wanted:
            run_state_machine_as_test(seed(number)(ReplayMachine), settings=small)
            number += 1
    finally:
        for operation, times in done.items():
            record_property(operation, times)
