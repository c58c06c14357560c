"""Atari against the emulator, driven by hand."""

import functools

import numpy as np
import pytest

from srl_jax import envs
from srl_jax.envs import games

ale_py = pytest.importorskip("ale_py")


def small(screen):
    """uint8 [210, 160] -> float64 [84, 84]."""
    height, width = screen.shape
    # Not by BLAS, whose threads would wait for those of other tests.
    rows = np.einsum("ih,hw->iw", overlap(height, 84), screen)
    return np.einsum("iw,jw->ij", rows, overlap(width, 84))


@functools.cache
def overlap(source, target):
    """float64 [target, source]: rows that average `source` pixels into `target` by area."""
    edges = np.arange(target + 1) * source / target
    low = np.maximum(edges[:-1, None], np.arange(source))
    high = np.minimum(edges[1:, None], np.arange(source) + 1)
    return np.clip(high - low, 0, None) * target / source


class ByHand:
    """One game, the slow and obvious way: FIRE at the start, four frames a step, maximum of two."""

    def __init__(self, game, ale_seed):
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self.ale = ale_py.ALEInterface()
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("random_seed", int(ale_seed))
        self.ale.loadROM(ale_py.roms.get_rom_path(games.rom_name(game)))
        self.actions = self.ale.getMinimalActionSet()

    def reset(self):
        self.ale.reset_game()
        if ale_py.Action.FIRE in self.actions:
            self.ale.act(ale_py.Action.FIRE)
        return self.ale.getScreenGrayscale()

    def step(self, action):
        score, screens = 0, []
        for _ in range(4):
            score += self.ale.act(self.actions[action])
            screens.append(self.ale.getScreenGrayscale())
            if self.ale.game_over():
                break
        return np.max(screens[-2:], axis=0), score, self.ale.game_over()


@pytest.mark.parametrize(("game", "steps"), [("Breakout", 450), ("MsPacman", 150), ("Pong", 150)])
def test_against_the_emulator_by_hand(game, steps):
    # Frames, raw scores, lives, ends and frame numbers; over several games of Breakout, so that a
    # phantom transition or a reset at a lost life would put the two out of step.
    env = envs.make(game, num_envs=1, seed=3, noop_max=0)
    frames, info = env.reset()
    hand = ByHand(game, env.ale_seeds[0])
    np.testing.assert_allclose(frames[0, :, :, 0], small(hand.reset()), atol=1)
    lives, scores, ends, lost = hand.ale.lives(), [], 0, 0
    rng = np.random.default_rng(0)
    for step in range(steps):
        action = rng.integers(env.single_action_space.n)
        frames, rewards, terminated, truncated, info = env.step(np.array([action]))
        frame, score, over = hand.step(action)
        assert rewards[0] == score and terminated[0] == over and not truncated[0]
        assert info["lives"][0] == hand.ale.lives()
        assert info["life_lost"][0] == (hand.ale.lives() < lives)
        assert info["frame_number"][0] == hand.ale.getFrameNumber()
        assert info["episode_frame_number"][0] == hand.ale.getEpisodeFrameNumber()
        lives = hand.ale.lives()
        scores.append(score)
        lost += info["life_lost"][0]
        if over:  # ALE's last frame is an older one
            ends += 1
            frames, info = env.reset(options={"reset_mask": terminated})
            frame, lives = hand.reset(), hand.ale.lives()
            assert info["episode_frame_number"][0] == hand.ale.getEpisodeFrameNumber()
        if over or step % 4 == 0:
            np.testing.assert_allclose(frames[0, :, :, 0], small(frame), atol=1)
    assert env.action_meanings == tuple(action.name for action in hand.actions)
    if game == "Breakout":
        assert ends >= 2 and lost >= 5 * ends
    if game == "MsPacman":
        assert max(scores) >= 10
    if game == "Pong":
        assert min(scores) == -1 and lost == 0
