"""Snapshots: a new environment goes on from one as the old one does, to the bit, or says why not."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from hypothesis import given, settings
from hypothesis import strategies as st

from srl_jax import envs
from tests.envs.players import MOMENTS, Player, goes_on, same

RESET = 255
"""An unseeded reset among the events of Atari's snapshots."""


def check(make, player, moment, moves):
    """The snapshot of the moment, once a new environment went on from it as the old one did."""
    difference, snapshot = goes_on(player, make, player.until(moment), moves)
    assert not difference
    return snapshot


@pytest.mark.parametrize(
    "game", ["Catch", "CatchDistractor", "catch:ball=4,background=static", "catch:ball=1,background=reward"]
)
@pytest.mark.parametrize("moment", MOMENTS)
@settings(max_examples=10)
@given(seed=st.integers(0, 2**63 - 1), before=st.integers(0, 80))
def test_catch_goes_on(game, moment, seed, before):
    def make(seed=seed):
        return envs.make(game, num_envs=3, seed=seed, frame_size=42)

    player = Player.start(make(), before)
    player.moves(before)
    check(lambda: make(seed=0), player, moment, 50)


@pytest.mark.parametrize(
    ("game", "options", "moment"),
    [
        ("Breakout", {"sticky_actions": 0.25}, "after a reset"),
        ("Qbert", {"noop_max": 0}, "after an end"),
        ("YarsRevenge", {"sticky_actions": 0.25}, "after a step"),
        ("Seaquest", {}, "after an end"),
    ],
)
def test_atari_goes_on(game, options, moment):
    # Episodes of at most 25 steps, reseeded after 40: logs hold resets, are of different lengths, and all of
    # an environment's past was forgotten once or more.
    def make():
        return envs.make(game, num_envs=2, seed=1, frame_size=42, reseed_every=40, max_frames=100, **options)

    pytest.importorskip("ale_py")
    player = Player.start(make(), 2)
    player.moves(80)
    snapshot = check(make, player, moment, 50)
    assert snapshot["seeded_resets"].min() > 1
    assert (snapshot["events"] == RESET).any()
    assert len(set(snapshot["steps_since_seeded"].tolist())) == 2
    assert snapshot["ended"].any() == (moment == "after an end")


def test_atari_goes_on_from_a_game_that_is_over():
    # A real end, not the limit of frames; and a log that outgrows what is allocated at first.
    def make():
        return envs.make("Breakout", num_envs=1, seed=0, frame_size=42, noop_max=0)

    pytest.importorskip("ale_py")
    player = Player.start(make(), 0, others=0)
    player.moves(250)
    snapshot = check(make, player, "after an end", 50)
    assert snapshot["event_counts"][0] > 256 and snapshot["lives"][0] == 0 and snapshot["ended"][0]


def test_life_lost_after_a_snapshot():
    # The step before a lost life is the one that matters.
    pytest.importorskip("ale_py")
    options = {"num_envs": 1, "seed": 0, "frame_size": 42, "noop_max": 0}
    env = envs.make("Breakout", **options)
    env.reset()
    env.step(np.array([1]))
    lost, snapshot = False, None
    while not lost:
        snapshot = env.snapshot()
        lost = env.step(np.array([0]))[-1]["life_lost"][0]
    again = envs.make("Breakout", **options)
    again.restore(snapshot)
    assert again.step(np.array([0]))[-1]["life_lost"][0]


def make_catch():
    env = envs.make("CatchDistractor", num_envs=2, seed=0, frame_size=42)
    env.reset()
    for action in (0, 1, 2) * 3:
        env.step(np.full(2, action))
    return env


@pytest.fixture(scope="module")
def pong():
    """A snapshot of Pong, and an environment to restore it in."""
    pytest.importorskip("ale_py")
    made = [envs.make("Pong", num_envs=2, seed=0, frame_size=42) for _ in range(2)]
    made[0].reset()
    for action in (2, 3, 2, 2) * 8:
        made[0].step(np.full(2, action))
    made[0].reset(options={"reset_mask": np.array([True, False])})
    made[0].step(np.array([2, 3]))
    return made[0].snapshot(), made[1]


def spoiled(snapshot, name, index, value):
    array = snapshot[name].copy()
    array[index] = value
    return snapshot | {name: array}


COMMON = [("ended", 0, True), ("frames_sha256", (1, 5), 0)]


def check_refused(env, snapshot, name, which):
    """Refuses a snapshot whose array says something else of an environment than what is rebuilt."""
    with pytest.raises(ValueError, match=rf"environments \[{which}\] cannot be rebuilt: .*{name}") as raised:
        env.restore(snapshot)
    assert "\n" not in str(raised.value)
    with pytest.raises(ResetNeeded):
        env.step(np.ones(2, int))


@pytest.mark.parametrize(("name", "index", "value"), [*COMMON, ("paddle", 1, 40), ("ball_x", 0, 7)])
def test_catch_that_does_not_come_back_is_refused(name, index, value):
    env = envs.make("CatchDistractor", num_envs=2, seed=0, frame_size=42)
    shown = name if (name, index, value) in COMMON else "frames_sha256"
    check_refused(env, spoiled(make_catch().snapshot(), name, index, value), shown, np.ravel(index)[0])


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [*COMMON, ("lives", 1, 1), ("frame_number", 0, 1), ("events", slice(40, 67), 3), ("ale_seeds", 1, 5)],
)
def test_atari_that_does_not_come_back_is_refused(pong, name, index, value):
    # Another version of the emulator, say, plays another game after the same actions.
    shown = {"events": "frames_sha256", "ale_seeds": "frame_number"}.get(name, name)
    which = 1 if isinstance(index, slice) else np.ravel(index)[0]
    check_refused(pong[1], spoiled(pong[0], name, index, value), shown, which)


def test_another_game_refuses():
    plain, other = (
        envs.make(game, num_envs=2, seed=0, frame_size=42) for game in ("Catch", "CatchDistractor")
    )
    with pytest.raises(ValueError, match=r"environments \[0, 1\] cannot be rebuilt"):
        plain.restore(make_catch().snapshot())
    plain.reset()
    with pytest.raises(KeyError, match="background_time"):
        other.restore(plain.snapshot())
    with pytest.raises(ValueError, match="the snapshot is of 2 environments, not of 3"):
        envs.make("CatchDistractor", num_envs=3, seed=0, frame_size=42).restore(make_catch().snapshot())


def test_limits_of_snapshots():
    with pytest.raises(ValueError, match=r"seed must lie in \[0, 2\*\*63\), got 9223372036854775808"):
        envs.make("Catch", num_envs=2, seed=2**63)
    env = envs.make("Catch", num_envs=2, seed=0)
    with pytest.raises(ResetNeeded):
        env.snapshot()
    env.reset(seed=2**63 - 1)
    assert env.snapshot()["seeds"].tolist() == [2**63 - 1] * 2


def test_a_snapshot_is_a_file_of_plain_arrays(tmp_path):
    env = make_catch()
    path = tmp_path / "env.npz"
    np.savez(path, **env.snapshot())
    again = envs.make("CatchDistractor", num_envs=2, seed=7, frame_size=42)
    with np.load(path, allow_pickle=False) as arrays:
        again.restore(arrays)
    action = np.array([0, 2])
    assert same(env.step(action)[:4], again.step(action)[:4])


def test_two_environments_that_differ_are_noticed():
    def make(seed=0):
        return envs.make("Catch", num_envs=2, seed=seed, frame_size=42)

    class Forgets(type(make())):
        def _restore(self, arrays):
            return super()._restore(arrays | {"episodes": arrays["episodes"] + 1})

    player = Player.start(make(), 0)
    forgets = lambda: Forgets(num_envs=2, seed=0, size=42)  # noqa: E731
    difference, _ = goes_on(player, forgets, player.until("after a step"), 40)
    assert difference == "a second snapshot differs"
