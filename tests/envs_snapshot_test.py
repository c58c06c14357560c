"""Snapshots: a new environment goes on from one as the old one does, to the bit, or says why not."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.soaking.snapshots import MOMENTS, Player, goes_on, same
from srl_jax import envs

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
        ("Pong", {"sticky_actions": 0.25, "noop_max": 0}, "after a step"),
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
    snapshot = check(make, player, moment, 100)
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


def without(name):
    return lambda s: s.pop(name)


def put(name, value):
    return lambda s: s.__setitem__(name, value)


def change(name, function):
    return lambda s: s.__setitem__(name, function(s[name].copy()))


def at(index, value):
    def function(array):
        array[index] = value
        return array

    return function


COMMON = [
    (without("ended"), r"the snapshot lacks arrays: ended$"),
    (put("more", np.zeros(2)), r"the snapshot has unknown arrays: more$"),
    (put("seeds", [0, 0]), r"seeds of the snapshot must be an array, got list"),
    (change("seeds", lambda a: a.astype(object)), r"seeds .* must be int64 \[2\], got object \[2\]"),
    (change("seeds", lambda a: a.astype(np.int32)), r"seeds .* must be int64 \[2\], got int32 \[2\]"),
    (change("seeds", at(1, -1)), r"seeds .* must be at least 0"),
    (change("ended", lambda a: a[:1]), r"ended .* must be bool \[2\], got bool \[1\]"),
    (change("ended", lambda a: a[:, None]), r"ended .* must be bool \[2\], got bool \[2, 1\]"),
    (change("ended", at(0, True)), r"environments \[0\] cannot be rebuilt: not the snapshot's ended"),
    (change("frames_sha256", at((1, 5), 0)), r"environments \[1\] cannot be rebuilt: .* frames_sha256"),
    (change("frames_sha256", lambda a: a[:, :31]), r"frames_sha256 .* uint8 \[2, 32\], got uint8 \[2, 31\]"),
]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        *COMMON,
        (without("background_offset"), r"lacks arrays: background_offset$"),
        (change("ball_x", at(0, 83)), r"ball_x .* must be at most 82"),
        (change("ball_y", at(1, 90)), r"ball_y .* must be at most 74"),
        (change("paddle", at(1, 5)), r"paddle .* must be at least 6"),
        (change("background_offset", at((1, 1, 0), 168)), r"background_offset .* must be at most 167"),
        (change("background_time", at(1, -1)), r"background_time .* must be at least 0"),
        (change("paddle", lambda a: a + [0, 2]), r"environments \[1\] cannot be rebuilt: .* frames_sha256"),
    ],
)
def test_catch_refuses(spoil, message):
    snapshot = make_catch().snapshot()
    spoil(snapshot)
    env = envs.make("CatchDistractor", num_envs=2, seed=0, frame_size=42)
    with pytest.raises(ValueError, match=message) as raised:
        env.restore(snapshot)
    assert "\n" not in str(raised.value)
    with pytest.raises(ResetNeeded):
        env.step(np.ones(2, int))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        *COMMON,
        (change("events", lambda a: a[:-1]), r"event_counts .* add up to 67, events are 66"),
        (change("event_counts", at(0, 35)), r"event_counts .* add up to 68, events are 67"),
        (change("event_counts", lambda a: a[::-1]), r"steps_since_seeded .* must be \[32, 34\]"),
        (change("events", at(3, 6)), r"events .* are no actions of the game: 6"),
        (change("events", at(3, RESET)), r"steps_since_seeded .* must be \[32, 33\], got \[33, 33\]"),
        (change("seeded_resets", at(0, 2)), r"ale_seeds of the snapshot must be"),
        (change("seeded_resets", at(0, 0)), r"seeded_resets .* must be at least 1"),
        (change("seeds", at(1, 5)), r"ale_seeds of the snapshot must be"),
        (change("lives", at(1, 1)), r"environments \[1\] cannot be rebuilt: not the snapshot's lives"),
        (change("frame_number", at(0, 1)), r"environments \[0\] cannot be rebuilt: .* frame_number"),
        (change("events", at(slice(40, 67), 3)), r"environments \[1\] cannot be rebuilt: .* frames_sha256"),
    ],
)
def test_atari_refuses(pong, spoil, message):
    snapshot, env = dict(pong[0]), pong[1]
    spoil(snapshot)
    with pytest.raises(ValueError, match=message) as raised:
        env.restore(snapshot)
    assert "\n" not in str(raised.value)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2, int))


def test_another_game_refuses():
    # Catch's arrays are among CatchDistractor's.
    with pytest.raises(ValueError, match="unknown arrays: background_offset, background_time"):
        envs.make("Catch", num_envs=2, seed=0, frame_size=42).restore(make_catch().snapshot())
    with pytest.raises(ValueError, match=r"must be int64 \[3\], got int64 \[2\]"):
        envs.make("CatchDistractor", num_envs=3, seed=0, frame_size=42).restore(make_catch().snapshot())


def test_limits_of_snapshots():
    env = envs.make("Catch", num_envs=2, seed=2**63)
    with pytest.raises(ResetNeeded):
        env.snapshot()
    env.reset()
    with pytest.raises(
        ValueError, match=r"seeds of a snapshot must be below 2\*\*63, got 9223372036854775808"
    ):
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
