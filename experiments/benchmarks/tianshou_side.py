"""Training with Tianshou's Rainbow and the thesis' settings; answers `worker` requests.

`python -m experiments.benchmarks.tianshou_side`. The loop is that of Tianshou's off-policy trainer, less its
logging: collect one env step of every environment, then update once. Tianshou collects with the noisy
layers' means, so only epsilon-greedy explores. It starts without our prior on values, and reads pixels in
0..255.

Of Tianshou's vector environments `DummyVectorEnv`, which steps them one after the other, is the fastest on
two cores: 10 environments of Pong take 4.8 ms, against 6.0 ms with `SubprocVectorEnv` and 5.7 ms with
`ShmemVectorEnv` (the least of 6 means over 30 steps, random actions). Gymnasium's `AtariPreprocessing` in the
place of Tianshou's wrappers changes nothing that can be measured (5.0 against 4.8 ms).
"""

import importlib.metadata
import math
import platform
import time
from functools import partial
from typing import Any

import ale_py
import gymnasium as gym
import numpy as np
import torch
from tianshou.algorithm.modelfree.c51 import C51Policy
from tianshou.algorithm.modelfree.rainbow import RainbowDQN
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, PrioritizedVectorReplayBuffer
from tianshou.env import DummyVectorEnv, ShmemVectorEnv, SubprocVectorEnv
from tianshou.env.atari.atari_network import RainbowNet
from tianshou.env.atari.atari_wrapper import wrap_deepmind
from tianshou.utils.torch_utils import policy_within_training_step

from .worker import serve

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

VECTORS = {"dummy": DummyVectorEnv, "subproc": SubprocVectorEnv, "shmem": ShmemVectorEnv}


def make_env(game: str) -> gym.Env:
    """One game below Tianshou's own Atari wrappers, as in its examples: uint8 [4, 84, 84], newest last."""
    gym.register_envs(ale_py)
    env = gym.make(
        f"ALE/{game}-v5",
        frameskip=1,  # the wrappers skip
        repeat_action_probability=0.0,
        max_num_frames_per_episode=MAX_FRAMES,
    )
    return wrap_deepmind(env, episode_life=True, clip_rewards=True, frame_stack=STACK)


class Side:
    """The handlers; `setup` comes first."""

    def setup(
        self,
        game: str = "Pong",
        num_envs: int = 10,
        seed: int = 0,
        threads: int = 2,
        vector: str = "dummy",
    ) -> dict[str, Any]:
        """Builds everything, and fills the buffer with `LEARN_START` random env steps.

        Args:
            game: as Gymnasium spells it.
            num_envs: environments; each moves one env step between updates.
            seed: of the environments, the network and the draws.
            threads: PyTorch's.
            vector: a key of `VECTORS`.

        Returns:
            "versions" of the packages; "parameters", how many numbers are trained; "actions".
        """
        torch.set_num_threads(threads)
        torch.manual_seed(seed)
        np.random.seed(seed)
        envs = VECTORS[vector]([partial(make_env, game)] * num_envs)
        envs.seed(seed)
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
            buffer_num=num_envs,
            ignore_obs_next=True,
            save_only_last_obs=True,
            stack_num=STACK,
            alpha=ALPHA,
            beta=BETA,
        )
        self._num_envs = num_envs
        self._collector = Collector(self._algorithm, envs, self._buffer, exploration_noise=True)
        self._collector.reset()
        self._collector.collect(n_step=math.ceil(LEARN_START / num_envs) * num_envs, random=True)
        names = ("tianshou", "torch", "gymnasium", "ale-py")
        versions = {name: importlib.metadata.version(name) for name in names}
        return {
            "versions": {**versions, "python": platform.python_version()},
            "parameters": sum(p.numel() for p in network.parameters() if p.requires_grad),
            "actions": int(space.n),
        }

    def run(self, env_steps: int) -> dict[str, Any]:
        """Goes on with training.

        Args:
            env_steps: how long, rounded up to whole steps of all environments.

        Returns:
            "seconds" by the wall clock, "env_steps" and "updates" done, and the "collect_s" and "update_s" of
            the seconds that were spent on each.
        """
        rounds = math.ceil(env_steps / self._num_envs)
        collect_s = update_s = 0.0
        start = now = time.perf_counter()
        for _ in range(rounds):
            share = min(1.0, self._collector.collect_step / EPS_ANNEAL_STEPS)
            self._policy.set_eps_training(EPS_START + share * (EPS_FINAL - EPS_START))
            with policy_within_training_step(self._policy):
                before = time.perf_counter()
                self._collector.collect(n_step=self._num_envs)
                between = time.perf_counter()
                self._algorithm.update(self._buffer, BATCH_SIZE)
                now = time.perf_counter()
            collect_s += between - before
            update_s += now - between
        return {
            "seconds": now - start,
            "env_steps": rounds * self._num_envs,
            "updates": rounds,
            "collect_s": collect_s,
            "update_s": update_s,
        }


if __name__ == "__main__":
    side = Side()
    serve({"setup": side.setup, "run": side.run})
