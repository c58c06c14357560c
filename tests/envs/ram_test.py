"""srl_jax/envs/ram.py: the emulator whose memory is read is in step with the environment."""

import numpy as np
import pytest

from srl_jax import envs


@pytest.mark.parametrize(("sticky_actions", "full_actions"), [(0.0, False), (0.25, True)])
def test_the_emulator_whose_memory_is_read_is_in_step(sticky_actions, full_actions):
    pytest.importorskip("ale_py")
    from srl_jax.envs.ram import OutOfStep, Twin

    options = {"sticky_actions": sticky_actions, "full_actions": full_actions}
    env = envs.make("Pong", num_envs=1, seed=0, reseed_every=120, **options)
    assert env.single_action_space.n == (18 if full_actions else 6)
    twin = Twin("Pong", noop_max=30, **options)
    rng = np.random.default_rng(0)
    for _ in range(3):  # the third of them has another seed
        frames, info = env.reset()
        twin.reset(int(env.ale_seeds[0]) if env.steps_since_seeded[0] == 0 else None)
        for _ in range(70):
            twin.check(frames[0, :, :, 0], int(info["frame_number"][0]), int(info["lives"][0]))
            action = rng.integers(env.single_action_space.n, size=1)
            frames, *_, info = env.step(action)
            twin.step(int(action[0]), look=True)
    wrong = frames[0, :, :, 0].copy()
    wrong[40, 40] += 5
    with pytest.raises(OutOfStep, match="a pixel differs by"):
        twin.check(wrong, int(info["frame_number"][0]), int(info["lives"][0]))
    with pytest.raises(OutOfStep, match="frame number"):
        twin.check(frames[0, :, :, 0], int(info["frame_number"][0]) - 4, int(info["lives"][0]))
    env.close()


def test_a_state_is_known_until_an_emulator_is_out_of_step():
    pytest.importorskip("ale_py")
    options = {"num_envs": 2, "seed": 0, "frame_size": 42, "noop_max": 0}
    env, plain = envs.make("Pong", with_state=True, **options), envs.make("Pong", **options)
    frames, info = env.reset()
    np.testing.assert_array_equal(frames, plain.reset()[0])
    assert "state" not in plain.reset()[1] and plain.state_names == ()
    for _ in range(4):
        frames, *_, info = env.step(np.array([2, 3]))
    names = env.state_names
    assert len(names) == 6 and info["state"].shape == (2, 6) and not env.state_problem
    assert info["state"][0, names.index("player_y")] != info["state"][1, names.index("player_y")]
    env._twins[1].step(0, look=False)  # it is ahead now
    for _ in range(2):  # each is compared at its turn
        *_, info = env.step(np.array([2, 3]))
    assert env.state_names == () and "out of step: frame number" in env.state_problem
    assert info["state"].shape == (2, 6)
    unlabelled = envs.make("Zaxxon", with_state=True, **options)
    assert unlabelled.reset()[1]["state"].shape == (2, 0)
    assert unlabelled.state_names == () and not unlabelled.state_problem
