"""What every environment promises; on Catch, which costs nothing to run."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

from srl_jax import envs

LEFT, NOOP, RIGHT = range(3)
BOTH = pytest.mark.parametrize("game", ["Catch", "CatchDistractor"])


@BOTH
def test_interface(game):
    env = envs.make(game, num_envs=3, seed=0)
    assert isinstance(env, VectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert env.single_observation_space.shape == (84, 84, 1)
    assert env.single_action_space.n == 3 == len(env.action_meanings)
    frames, info = env.reset()
    assert env.observation_space.contains(frames)
    assert set(info) == {"life_lost", "state"}
    frames, rewards, terminated, truncated, info = env.step(np.full(3, NOOP))
    assert env.observation_space.contains(frames)
    assert rewards.dtype == np.float32 and rewards.shape == (3,)
    assert info["state"].dtype == np.float32 and info["state"].shape == (3, 5)
    for flag in (terminated, truncated, info["life_lost"]):
        assert flag.dtype == bool and flag.shape == (3,) and not flag.any()


@BOTH
def test_reset_with_a_seed_plays_the_same_games_again(game):
    actions = np.random.default_rng(0).integers(0, 3, (50, 4))
    env = envs.make(game, num_envs=4, seed=1)
    env.reset()
    for action in actions[15:25]:
        env.step(action)
    env.reset(seed=7)
    again = [env.step(action)[0] for action in actions[:15]]
    fresh = envs.make(game, num_envs=4, seed=7)
    fresh.reset()
    np.testing.assert_array_equal(again, [fresh.step(action)[0] for action in actions[:15]])


def test_neighbouring_seeds_share_no_environment():
    # Three episodes of every environment; a shared one would repeat a row somewhere.
    rows = []
    for seed in range(4):
        env = envs.make("Catch", num_envs=16, seed=seed)
        rows.append(np.hstack([env.reset()[1]["state"] for _ in range(3)]))
    rows = np.vstack(rows)
    assert len(np.unique(rows, axis=0)) == 64


@BOTH
def test_mask(game):
    env = envs.make(game, num_envs=4, seed=0)
    env.reset()
    before, _, _, _, info_before = env.step(np.full(4, RIGHT))
    mask = np.array([True, False, False, True])
    frames, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(frames[~mask], before[~mask])
    np.testing.assert_array_equal(info["state"][~mask], info_before["state"][~mask])
    assert (info["state"][mask] != info_before["state"][mask]).any(1).all()
    # With a seed, too: only the masked environments start afresh, and as in a full reset.
    seeded, info_seeded = env.reset(seed=5, options={"reset_mask": mask})
    np.testing.assert_array_equal(seeded[~mask], before[~mask])
    full, info_full = env.reset(seed=5)
    np.testing.assert_array_equal(info_seeded["state"][mask], info_full["state"][mask])
    np.testing.assert_array_equal(seeded[mask], full[mask])


@BOTH
def test_returned_arrays_are_copies(game):
    env = envs.make(game, num_envs=2, seed=0)
    frames, info = env.reset()
    kept = frames.copy(), info["state"].copy()
    env.step(np.full(2, LEFT))
    np.testing.assert_array_equal(frames, kept[0])
    frames[:] = 7
    info["state"][:] = 7
    again, info_again = env.reset(options={"reset_mask": np.zeros(2, bool)})
    assert not (again == 7).all() and not (info_again["state"] == 7).all()


def test_an_ended_game_is_not_stepped():
    env = envs.make("Catch", num_envs=2, seed=0)
    with pytest.raises(ResetNeeded):
        env.step(np.full(2, NOOP))
    with pytest.raises(ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset()
    for _ in range(5):
        env.step(np.full(2, NOOP))
    env.reset(options={"reset_mask": np.array([False, True])})  # out of step with the other
    ended = np.zeros(2, bool)
    while not ended.any():
        frames, _, ended, _, info = env.step(np.full(2, NOOP))
    assert ended.tolist() == [True, False]
    with pytest.raises(ResetNeeded, match=r"\[0\]"):
        env.step(np.full(2, NOOP))
    # The final frame is still the ended game's.
    current, _ = env.reset(options={"reset_mask": np.array([False, False])})
    np.testing.assert_array_equal(current, frames)
    env.reset(options={"reset_mask": ended})
    env.step(np.full(2, NOOP))


@pytest.mark.parametrize(
    "actions",
    [
        np.array([0, 3]),
        np.array([-1, 0]),
        np.array([0]),
        np.array([[0, 0]]),
        np.array([0.0, 1.0]),
        np.array([True, False]),
        np.array([0, 1], np.uint8),
        1,
    ],
)
def test_illegal_actions_change_nothing(actions):
    env = envs.make("Catch", num_envs=2, seed=0)
    _, before = env.reset()
    with pytest.raises(ValueError, match="actions must"):
        env.step(actions)
    _, after = env.reset(options={"reset_mask": np.zeros(2, bool)})
    np.testing.assert_array_equal(before["state"], after["state"])


@pytest.mark.parametrize(
    "options",
    [
        {"reset_mask": np.array([1, 0])},
        {"reset_mask": np.array([True])},
        {"reset_mask": True},
        {"mask": np.array([True, False])},
    ],
)
def test_illegal_reset_options(options):
    env = envs.make("Catch", num_envs=2, seed=0)
    env.reset()
    with pytest.raises(ValueError, match="reset"):
        env.reset(options=options)


@pytest.mark.parametrize("options", [{"num_envs": 0}, {"seed": -1}, {"seed": 0.5}, {"frame_size": 64}])
def test_illegal_options(options):
    with pytest.raises(ValueError, match="num_envs|seed|size"):
        envs.make("Catch", **{"num_envs": 1, "seed": 0} | options)
