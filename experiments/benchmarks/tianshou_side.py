"""Training with Tianshou's Rainbow and the settings of `thesis/rl_only_nature`; a side of `worker`.

The loop is that of Tianshou's off-policy trainer, less its logging: collect one env step of all environments,
then update once. Tianshou collects with the noisy layers' means, so only epsilon-greedy explores.

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

NUM_ENVS, SEED, STACK, BATCH_SIZE = 10, 0, 4, 32
EPS_START, EPS_FINAL, EPS_ANNEAL_STEPS = 1.0, 0.05, 1_000_000
LEARN_START, WARM_STEPS = 320, 50  # env steps without updates, and with


def make_env() -> gym.Env:
    """Pong below Tianshou's own Atari wrappers, as in its examples: uint8 [4, 84, 84], newest last."""
    gym.register_envs(ale_py)
    env = gym.make(
        "ALE/Pong-v5",
        frameskip=1,  # the wrappers skip
        repeat_action_probability=0.0,
        max_num_frames_per_episode=108_000,
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
        self._policy = C51Policy(
            model=RainbowNet(c=STACK, h=84, w=84, action_shape=space.n, num_atoms=51, noisy_std=0.1),
            action_space=space,
            num_atoms=51,
            v_min=-10.0,
            v_max=10.0,
            eps_training=EPS_START,
        )
        self._algorithm = RainbowDQN(
            policy=self._policy,
            optim=AdamOptimizerFactory(lr=1e-4, eps=1e-8),
            gamma=0.99,
            n_step_return_horizon=3,
            target_update_freq=500,
        )
        self._buffer = PrioritizedVectorReplayBuffer(
            100_000,
            buffer_num=NUM_ENVS,
            ignore_obs_next=True,
            save_only_last_obs=True,
            stack_num=STACK,
            alpha=0.5,
            beta=0.4,
        )
        self._collector = Collector(self._algorithm, envs, self._buffer, exploration_noise=True)
        self._collector.reset()
        self._collector.collect(n_step=LEARN_START, random=True)
        self.turn(WARM_STEPS)

    def turn(self, env_steps: int) -> dict[str, list[float]]:
        """Goes on for so long, rounded up to whole steps of all environments.

        Returns:
            "rate", env steps a second.
        """
        steps = math.ceil(env_steps / NUM_ENVS)
        start = time.perf_counter()
        for _ in range(steps):
            share = min(1.0, self._collector.collect_step / EPS_ANNEAL_STEPS)
            self._policy.set_eps_training(EPS_START + share * (EPS_FINAL - EPS_START))
            with policy_within_training_step(self._policy):
                self._collector.collect(n_step=NUM_ENVS)
                self._algorithm.update(self._buffer, BATCH_SIZE)
        return {"rate": [steps * NUM_ENVS / (time.perf_counter() - start)]}
