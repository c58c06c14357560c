"""Emulators: against gymnasium's own wrappers, through the loop into replay, and out of snapshots."""

import pytest

from srl_jax import envs
from tests.envs.players import MOMENTS, Player, goes_on

pytest.importorskip("ale_py")
cv2 = pytest.importorskip("cv2")

from tests.envs.beside_gymnasium import NOOP_MAX, beside  # noqa: E402
from tests.run.recorder import Watched  # noqa: E402

STEPS = 200
TEN_GAMES = (
    "Breakout", "SpaceInvaders", "Qbert", "Pong", "MsPacman", "Seaquest", "Enduro", "YarsRevenge", "Asterix",
    "Boxing",
)  # fmt: skip
ODD_GAMES = ("Breakout", "Qbert", "YarsRevenge", "Seaquest", "Pong")
"""Several lives; remember the past; score against another player."""


def test_frames_and_numbers_are_those_of_gymnasiums_wrappers(amount, progress, record_property):
    games = envs.ATARI_57[: amount("games")]
    frames = starts = over = pixels = 0
    wrong = set()
    for number, game in enumerate(games):
        for frame in beside(game, STEPS):
            frames, starts, over = frames + 1, starts + frame.begins, over + frame.over
            pixels += int((frame.difference != 0).sum())
            if frame.difference.any() or not frame.agree:
                wrong.add(game)
        progress(number + 1, len(games), "games")
    counts = {"games": len(games), "frames": frames, "starts": starts, "games over": over}
    for what, count in (counts | {"pixels that differ": pixels, "OpenCV": cv2.__version__}).items():
        record_property(what, count)
    assert not wrong


@pytest.mark.parametrize("game", TEN_GAMES)
def test_replay_and_policy_see_what_the_environments_gave(game, tmp_path, amount, progress, record_property):
    total = amount("loop_steps")
    options = {"num_envs": 10, "slots": 1000, "max_steps": 500, "reseed_every": 500}
    watched = Watched(game, **options, say=lambda done: progress(done, total, "env steps"))
    counts = watched.run(tmp_path / "run", total // 10, seed=TEN_GAMES.index(game))
    for what, count in counts.items():
        record_property(what, count)
    assert {name: counts[name] for name in watched.WRONG} == dict.fromkeys(watched.WRONG, 0)


def test_snapshots_go_on_as_the_environments_did(amount, progress, record_property):
    """At random moments, restored in new environments, beside the old ones for 200 moves.

    All 57 games, and some of them with and without sticky actions and no-ops, after a step, a reset and an
    end. Episodes are cut after 40 steps and environments reseeded after 60, so that the logs that are played
    again hold resets and begin at different times.
    """
    sticky, noops, moments = (0.0, 0.25), (0, NOOP_MAX), list(MOMENTS)
    cases = [
        (game, sticky[i % 2], noops[i // 2 % 2], moments[i % 3]) for i, game in enumerate(envs.ATARI_57)
    ][: amount("games")]
    if amount("games") >= len(envs.ATARI_57):
        cases += [(g, s, n, m) for g in ODD_GAMES for s in sticky for n in noops for m in moments]
    events, wrong = 0, []
    for number, case in enumerate(cases):
        game, sticky_actions, noop_max, moment = case
        options = {"sticky_actions": sticky_actions, "noop_max": noop_max}

        def make(game=game, options=options):
            limits = {"max_frames": 160, "reseed_every": 60}
            return envs.make(game, num_envs=3, seed=1, frame_size=42, **options, **limits)

        player = Player.start(make(), number)
        player.moves(int(player.rng.integers(50, 150)))
        difference, snapshot = goes_on(player, make, player.until(moment), 200)
        player.env.close()
        wrong += [(*case, difference)] if difference else []
        events += len(snapshot["events"])
        progress(number + 1, len(cases), "snapshots")
    record_property("snapshots restored", len(cases))
    record_property("steps and resets played again", events)
    assert not wrong
