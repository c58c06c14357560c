"""Training with Tianshou's Rainbow and the thesis' settings; a `worker`.

The loop is that of Tianshou's off-policy trainer, less its logging: collect one env step of all environments,
then update once. Tianshou collects with the noisy layers' means, so only epsilon-greedy explores. It starts
without our prior on values, and reads pixels in 0..255.

Of Tianshou's vector environments `DummyVectorEnv`, which steps them one after the other, is the fastest on
two cores: 10 environments of Pong take 4.8 ms, against 6.0 ms with `SubprocVectorEnv` and 5.7 ms with
`ShmemVectorEnv` (the least of 6 means over 30 steps, random actions). Gymnasium's `AtariPreprocessing` in the
place of Tianshou's wrappers changes nothing that can be measured (5.0 against 4.8 ms).
"""

import math
import time

import ale_py
import gymnasium as gym
import numpy as np
import torch
from tianshou.algorithm.modelfree.c51 import C51Policy
from tianshou.algorithm.modelfree.rainbow import RainbowDQN
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, PrioritizedVectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.env.atari.atari_network import RainbowNet
from tianshou.env.atari.atari_wrapper import wrap_deepmind
from tianshou.utils.torch_utils import policy_within_training_step

from .worker import serve

GAME, NUM_ENVS, SEED = "Pong", 10, 0
STACK = 4  # frames
MAX_FRAMES = 108_000  # of an episode
ATOMS, V_MIN, V_MAX = 51, -10.0, 10.0
NOISY_STD = 0.1
GAMMA, N_STEP = 0.99, 3
LEARNING_RATE, ADAM_EPS = 1e-4, 1e-8
SLOW_UPDATE_EVERY = 500  # updates
BUFFER_SIZE = 100_000  # transitions
ALPHA, BETA = 0.5, 0.4
BATCH_SIZE = 32
LEARN_START = 320  # env steps
EPS_START, EPS_FINAL, EPS_ANNEAL_STEPS = 1.0, 0.05, 1_000_000
WARM_STEPS = 50  # env steps with updates


def make_env() -> gym.Env:
    """The game below Tianshou's own Atari wrappers, as in its examples: uint8 [4, 84, 84], newest last."""
    gym.register_envs(ale_py)
    env = gym.make(
        f"ALE/{GAME}-v5",
        frameskip=1,  # the wrappers skip
        repeat_action_probability=0.0,
        max_num_frames_per_episode=MAX_FRAMES,
    )
    return wrap_deepmind(env, episode_life=True, clip_rewards=True, frame_stack=STACK)


class Loop:
    """Training, past its first updates.

    Args:
        threads: PyTorch's.
    """

    def __init__(self, threads: int):
        torch.set_num_threads(threads)
        torch.manual_seed(SEED)
        np.random.seed(SEED)
        envs = DummyVectorEnv([make_env] * NUM_ENVS)
        envs.seed(SEED)
        space = envs.action_space[0]
        network = RainbowNet(c=STACK, h=84, w=84, action_shape=space.n, num_atoms=ATOMS, noisy_std=NOISY_STD)
        self._policy = C51Policy(
            model=network,
            action_space=space,
            num_atoms=ATOMS,
            v_min=V_MIN,
            v_max=V_MAX,
            eps_training=EPS_START,
        )
        self._algorithm = RainbowDQN(
            policy=self._policy,
            optim=AdamOptimizerFactory(lr=LEARNING_RATE, eps=ADAM_EPS),
            gamma=GAMMA,
            n_step_return_horizon=N_STEP,
            target_update_freq=SLOW_UPDATE_EVERY,
        )
        self._buffer = PrioritizedVectorReplayBuffer(
            BUFFER_SIZE,
            buffer_num=NUM_ENVS,
            ignore_obs_next=True,
            save_only_last_obs=True,
            stack_num=STACK,
            alpha=ALPHA,
            beta=BETA,
        )
        self._collector = Collector(self._algorithm, envs, self._buffer, exploration_noise=True)
        self._collector.reset()
        self._collector.collect(n_step=math.ceil(LEARN_START / NUM_ENVS) * NUM_ENVS, random=True)
        self.turn(WARM_STEPS)

    def turn(self, env_steps: int) -> dict[str, list[float]]:
        """Goes on for so long, rounded up to whole steps of all environments. Returns "env_steps_per_s"."""
        steps = math.ceil(env_steps / NUM_ENVS)
        start = time.perf_counter()
        for _ in range(steps):
            share = min(1.0, self._collector.collect_step / EPS_ANNEAL_STEPS)
            self._policy.set_eps_training(EPS_START + share * (EPS_FINAL - EPS_START))
            with policy_within_training_step(self._policy):
                self._collector.collect(n_step=NUM_ENVS)
                self._algorithm.update(self._buffer, BATCH_SIZE)
        return {"env_steps_per_s": [steps * NUM_ENVS / (time.perf_counter() - start)]}


if __name__ == "__main__":
    serve(Loop)
