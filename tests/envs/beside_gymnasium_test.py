"""Some of what tests/soak/emulators_test.py compares in 57 games, and whether the comparison notices."""

import pytest

pytest.importorskip("ale_py")
pytest.importorskip("cv2")

from tests.envs import beside_gymnasium  # noqa: E402
from tests.envs.beside_gymnasium import beside  # noqa: E402


@pytest.mark.parametrize("game", ["Breakout", "Berzerk", "Freeway"])
def test_frames_and_numbers_are_those_of_gymnasium(game):
    # They start with FIRE; with frames of ALE's own, before the first; without FIRE.
    found = list(beside(game, 60))
    assert sum(frame.begins for frame in found) == 3 and len(found) == 63
    assert not any(frame.difference.any() for frame in found) and all(frame.agree for frame in found)


def test_other_starts_are_noticed(monkeypatch):
    # Without the no-ops that are predicted, every frame is another one.
    right = beside_gymnasium.TWISTER
    monkeypatch.setattr(beside_gymnasium, "TWISTER", lambda seed: right(seed + 1))
    found = list(beside("Freeway", 60))
    assert sum(bool(frame.difference.any()) for frame in found) > 30
    assert sum(not frame.agree for frame in found) > 30
