"""An environment of your own, 64 x 64 pixels in colour: a red dot has to be led to a green place.

    python -m experiments.train --game=examples.own_environment:Dot-v0 --frame_size=84 \
        --encoder=tiny --steps=20000 --eps_anneal_steps=10000 --eval_every=2000 --out=runs/dot

`module:Name-v0` imports the module, which registers the environment with gymnasium. Frames are resized to
`--frame_size`; `--game=examples.own_environment:Dot-v0,grey=true,frame_skip=2` has more options. Since the
environment says what its state is, the diagnostics fit probes to it. One with options of its own is a row of
the registry of games: see `srl_jax.envs.register` and `srl_jax.envs.adapted`.
"""

import gymnasium
import numpy as np


class Dot(gymnasium.Env):
    """The dot goes four pixels left, right, up or down; at the green place it gets 1, and that is the end."""

    observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(4)
    state_names = ("dot_y", "dot_x", "place_y", "place_x")

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.dot, self.place = self.np_random.integers(0, 16, (2, 2))
        return self._seen()

    def step(self, action):
        move = [(0, -1), (0, 1), (-1, 0), (1, 0)][action]
        self.dot = np.clip(self.dot + move, 0, 15)
        there = bool((self.dot == self.place).all())
        observation, info = self._seen()
        return observation, float(there), there, False, info

    def _seen(self):
        frame = np.zeros((16, 16, 3), np.uint8)
        frame[tuple(self.place)] = 0, 255, 0
        frame[tuple(self.dot)] = 255, 0, 0
        return frame.repeat(4, 0).repeat(4, 1), {"state": np.concatenate((self.dot, self.place))}


gymnasium.register("Dot-v0", f"{__name__}:Dot", max_episode_steps=100)
