"""ALE's vector environment, as `srl_jax.envs` uses it, beside gymnasium's own AtariPreprocessing.

Both get the same ALE seeds and actions; games that are over are reset, and all of them after 20 and 40 steps,
the latter with a seed. What differs between the two by design, and is predicted:

- gymnasium makes ALE's seed of the seed it is given; here ALE gets `ale_seeds`.
- gymnasium presses no FIRE at the start; ALE's vector environment presses it once, where the game has it.
- gymnasium draws 1 to 30 no-ops at the start, with numpy; ALE draws 0 to 29, the FIRE among them, with C++'s
  mt19937 of the same seed, which goes on where a reset has no seed.
- gymnasium's limit of frames counts those of the start; the episodes here are too short for either.

Nothing else differs: the same two frames are pooled, at a game's end too, where both show older ones, and
both shrink frames with OpenCV's INTER_AREA.
"""

from collections.abc import Iterator
from typing import NamedTuple

import ale_py
import gymnasium
import numpy as np
from gymnasium.wrappers import AtariPreprocessing

from srl_jax import envs
from srl_jax.envs.atari import COUNTERS

NOOP_MAX = 30
TWISTER = np.random.RandomState
"""A Mersenne twister that is seeded as C++'s mt19937 is."""


class StartLikeALE(gymnasium.Wrapper):
    """Starts episodes of "ALE/*-v5" the way that ALE's vector environment does, below AtariPreprocessing.

    Args:
        env: with frameskip 1.

    Attributes:
        seed: for ALE at the next reset, which reads the ROM again; None for a reset without one.
    """

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        names = env.unwrapped.get_action_meanings()
        self._fire = names.index("FIRE") if "FIRE" in names else None
        self.seed, self._draws = None, None

    def reset(self, *, seed=None, options=None):
        if self.seed is not None:
            self.unwrapped.ale.setInt("random_seed", self.seed)
            self.unwrapped.load_game()
            self._draws = TWISTER(self.seed)
        result = self.env.reset()
        # How libstdc++ makes a number below NOOP_MAX of 32 random bits.
        noops = int(self._draws.randint(0, 2**32, dtype=np.uint32)) * NOOP_MAX >> 32
        if self._fire is not None:
            result = self._press(self._fire)
            noops -= 1
        for _ in range(noops):
            result = self._press(0)
            if self.unwrapped.ale.game_over():
                result = self.env.reset()
        return result

    def _press(self, action):
        frame, _, _, _, info = self.env.step(action)
        return frame, info


class Frame(NamedTuple):
    """One frame of both.

    Attributes:
        begins: whether it begins an episode.
        over: whether the game is over.
        difference: by how much the two differ, int [84, 84].
        agree: whether rewards, ends, lives and counters of frames agree.
    """

    begins: bool
    over: bool
    difference: np.ndarray
    agree: bool


def beside(game: str, steps: int) -> Iterator[Frame]:
    """Plays a game in both with random actions, for so many env steps."""
    gymnasium.register_envs(ale_py)
    ours = envs.make(game, num_envs=1, seed=0, noop_max=NOOP_MAX, reseed_every=40)
    made = gymnasium.make(
        f"ALE/{game}-v5", frameskip=1, repeat_action_probability=0.0, disable_env_checker=True
    )
    like_ale = StartLikeALE(made)
    theirs = AtariPreprocessing(like_ale, noop_max=0)
    ale = like_ale.unwrapped.ale
    rng = np.random.default_rng(0)

    def compare(frame, info, their_frame):
        counters = ale.lives(), ale.getFrameNumber(), ale.getEpisodeFrameNumber()
        agree = tuple(int(info[name][0]) for name in COUNTERS) == counters
        return np.abs(frame[0, :, :, 0].astype(int) - their_frame), agree

    def start():
        frame, info = ours.reset()
        like_ale.seed = int(ours.ale_seeds[0]) if ours.steps_since_seeded[0] == 0 else None
        return Frame(True, False, *compare(frame, info, theirs.reset()[0]))

    yield start()
    for step in range(1, steps + 1):
        action = int(rng.integers(ours.single_action_space.n))
        frame, reward, terminated, truncated, info = ours.step(np.array([action]))
        their_frame, *outcome, _ = theirs.step(action)
        difference, agree = compare(frame, info, their_frame)
        agree &= [reward[0], terminated[0], truncated[0]] == outcome
        yield Frame(False, bool(terminated[0]), difference, agree)
        if terminated[0] or truncated[0] or step in (20, 40):
            yield start()
    ours.close()
    theirs.close()
