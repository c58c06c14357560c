"""Atari: resets, seeds, ends and options. Frames and scores: envs_atari_emulator_test.py."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

from srl_jax import envs

pytest.importorskip("ale_py")
from srl_jax.envs import atari  # noqa: E402
from tests.envs.players import same  # noqa: E402


def test_interface():
    env = envs.make("Pong", num_envs=2, seed=0, frame_size=42)
    assert isinstance(env, VectorEnv)
    # ale_py changes the metadata of gymnasium's base class.
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert env.single_observation_space.shape == (42, 42, 1)
    frames, info = env.reset()
    assert env.observation_space.contains(frames) and not info["life_lost"].any()
    for dtype in (np.int32, np.int64):
        frames, rewards, terminated, truncated, info = env.step(np.zeros(2, dtype))
        assert env.observation_space.contains(frames)
        assert rewards.dtype == np.float32 and rewards.shape == (2,)
        for flag in (terminated, truncated, info["life_lost"]):
            assert flag.dtype == bool and flag.shape == (2,)
        for name in ("lives", "frame_number", "episode_frame_number"):
            assert info[name].shape == (2,)
    env.close()


def test_a_whole_game_of_pong_ends_at_21():
    env = envs.make("Pong", num_envs=1, seed=0)
    env.reset()
    won = lost = 0
    rng = np.random.default_rng(0)
    ended = [False]
    while not ended[0]:
        assert max(won, lost) < 21
        _, rewards, ended, truncated, info = env.step(rng.integers(0, 6, 1))
        won, lost = won + (rewards[0] == 1), lost + (rewards[0] == -1)
        assert not truncated[0] and not info["life_lost"][0]
    assert max(won, lost) == 21


def test_a_lost_life_resets_nothing():
    env = envs.make("Breakout", num_envs=2, seed=0)
    _, info = env.reset()
    rng = np.random.default_rng(1)
    losses = 0
    for _ in range(120):
        before = info
        _, _, terminated, _, info = env.step(rng.integers(0, 4, 2))
        steps = info["episode_frame_number"] - before["episode_frame_number"]
        assert (steps[~terminated] == 4).all()
        np.testing.assert_array_equal(info["life_lost"], info["lives"] < before["lives"])
        losses += (info["life_lost"] & ~terminated).sum()
        if terminated.any():
            break
    assert losses >= 4


def run(env, steps, mixed_masks=False):
    """Everything that a run with fixed actions returns; environments start anew at odd times."""
    rng = np.random.default_rng(0)
    n = env.num_envs
    frames, info = env.reset()
    out = [frames, *info.values()]
    for step in range(steps):
        frames, rewards, terminated, truncated, info = env.step(rng.integers(0, env.single_action_space.n, n))
        out += [frames, rewards, terminated, truncated, *info.values()]
        mask = terminated | truncated
        if mixed_masks:
            mask |= (step + 7 * np.arange(n)) % 19 == 0
        if mask.any():
            frames, info = env.reset(options={"reset_mask": mask})
            out += [frames, *info.values()]
    return out


@pytest.mark.parametrize("options", [{}, {"sticky_actions": 0.25}])
def test_same_seed_same_actions_same_run(options, monkeypatch):
    # Seeded and unseeded resets, mixed, with one thread and with two.
    options = options | {"num_envs": 2, "reseed_every": 50}
    first = run(envs.make("Seaquest", seed=1, **options), 100, mixed_masks=True)
    vector = atari.AtariVectorEnv
    monkeypatch.setattr(atari, "AtariVectorEnv", lambda *a, **kw: vector(*a, **{**kw, "num_threads": 1}))
    again = run(envs.make("Seaquest", seed=1, **options), 100, mixed_masks=True)
    assert same(first, again)


@pytest.mark.parametrize("game", ["YarsRevenge", "Qbert"])
def test_reset_with_a_seed_forgets_the_past(game):
    # Both games remember the past over an unseeded reset.
    def rollout(env):
        frames, _ = env.reset(seed=7)
        rng = np.random.default_rng(3)
        return [frames] + [env.step(rng.integers(0, 6, 2))[0] for _ in range(60)]

    env = envs.make(game, num_envs=2, seed=0)
    run(env, 150)
    assert same(rollout(env), rollout(envs.make(game, num_envs=2, seed=1)))


def test_neighbouring_seeds_share_no_environment():
    seeds = []
    for seed in range(2):
        env = envs.make("Pong", num_envs=2, seed=seed, reseed_every=0)
        for _ in range(2):
            env.reset()
            seeds += env.ale_seeds.tolist()
    assert len(set(seeds)) == len(seeds) == 8
    assert all(0 < seed < 2**31 for seed in seeds)
    # An environment does not depend on how many others there are.
    one = envs.make("Pong", num_envs=1, seed=0)
    one.reset()
    assert one.ale_seeds[0] == seeds[0]


def test_seeded_and_unseeded_resets():
    # A seeded reset reads the ROM again, which sets `frame_number` back.
    env = envs.make("Pong", num_envs=3, seed=0, reseed_every=10)

    def reset(*mask):
        _, info = env.reset(options={"reset_mask": np.array(mask)})
        return (info["frame_number"] == info["episode_frame_number"]).tolist()

    def step(times):
        for _ in range(times):
            env.step(np.zeros(3, int))

    assert reset(True, True, True) == [True, True, True]
    step(10)
    assert reset(True, False, False) == [True, True, True]
    assert env.steps_since_seeded.tolist() == [0, 10, 10]
    before = env.ale_seeds.copy()
    step(3)
    # 3, 13 and 13 steps: unseeded, seeded, left alone.
    frames_before, _, _, _, info_before = env.step(np.zeros(3, int))
    frames, info = env.reset(options={"reset_mask": np.array([True, True, False])})
    seeded = info["frame_number"] == info["episode_frame_number"]
    assert seeded.tolist() == [False, True, True]
    assert (env.ale_seeds != before).tolist() == [False, True, False]
    assert env.steps_since_seeded.tolist() == [4, 0, 14]
    np.testing.assert_array_equal(frames[2], frames_before[2])
    for name in info:
        assert info[name][2] == info_before[name][2]


def test_noops_vary_the_start_and_can_be_switched_off():
    def starts(num_envs, **options):
        env = envs.make("Pong", num_envs=num_envs, seed=0, **options)
        return env.reset()[1]["episode_frame_number"].tolist()

    with_noops, without = starts(4), starts(2, noop_max=0)
    assert len(set(with_noops)) > 2
    assert len(set(without)) == 1
    # The FIRE is the first of up to 29.
    assert all(0 <= start - without[0] <= 28 for start in with_noops)


def test_truncation():
    env = envs.make("Pong", num_envs=2, seed=0, max_frames=40)
    env.reset()
    for step in range(1, 11):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, int))
        assert not terminated.any()
        assert truncated.tolist() == [step == 10] * 2
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2, int))
    _, info = env.reset(options={"reset_mask": truncated})
    start = info["episode_frame_number"]
    _, _, _, truncated, info = env.step(np.zeros(2, int))
    assert not truncated.any()
    assert (info["episode_frame_number"] - start == 4).all()


def test_sticky_actions_reach_the_emulator():
    # At probability 1 no action ever gets through.
    def frames(action, **options):
        env = envs.make("Pong", num_envs=1, seed=0, noop_max=0, **options)
        env.reset()
        return [env.step(np.array([action]))[0] for _ in range(30)]

    assert same(frames(2, sticky_actions=1.0), frames(3, sticky_actions=1.0))
    assert not same(frames(2), frames(3))


def test_returned_arrays_are_copies():
    env = envs.make("Breakout", num_envs=2, seed=0)
    kept = [env.reset()[0]]
    copies = [kept[0].copy()]
    for action in (1, 2, 3) * 5:
        kept.append(env.step(np.full(2, action))[0])
        copies.append(kept[-1].copy())
    assert same(kept, copies)
    kept[-1][:] = 7
    current, _ = env.reset(options={"reset_mask": np.zeros(2, bool)})
    np.testing.assert_array_equal(current, copies[-1])


@pytest.mark.parametrize(
    "options",
    [
        {"num_envs": 0},
        {"seed": -1},
        {"frame_size": 0},
        {"sticky_actions": 1.5},
        {"noop_max": -1},
        {"max_frames": 0},
        {"reseed_every": -1},
    ],
)
def test_illegal_options(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        envs.make("Pong", **{"num_envs": 1, "seed": 0} | options)


@pytest.mark.parametrize(
    ("game", "count"),
    [("Freeway", 3), ("Skiing", 3), ("Surround", 5), ("Gopher", 8), ("Asteroids", 14), ("Alien", 18)],
)
def test_number_of_actions(game, count):
    env = envs.make(game, num_envs=1, seed=0)
    assert env.single_action_space.n == len(env.action_meanings) == count
