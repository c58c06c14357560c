"""Atari 2600 games on ALE's C++ vector environment.

Bellemare et al., 2013; Machado et al., 2018.
"""

import numpy as np
from gymnasium.vector import AutoresetMode

from srl_jax.envs.base import FrameVectorEnv
from srl_jax.envs.games import rom_name

try:
    from ale_py.vector_env import AtariVectorEnv
except ImportError as error:
    raise ImportError("Atari games need ale-py: pip install srl-jax[atari]") from error

FRAME_SKIP = 4
"""Emulator frames per env step."""


class Atari(FrameVectorEnv):
    """N copies of one Atari game.

    One env step is four emulator frames with the same action. The frame shown is the pixelwise
    maximum of the last two, in greyscale, reduced to `frame_size` by averaging areas. Rewards are
    the game's raw score; a lost life is reported and changes nothing else. After a reset FIRE is
    pressed once where the action set has it.

    Randomness. ALE reads the ROM again for a seeded reset, which takes about 100 ms against 6 ms
    for an unseeded one, so an environment gets a seeded reset only when at least `reseed_every` env
    steps have passed since its last one. In between, an episode depends on everything since that
    reset, because the emulator's random numbers go on and some games remember the past. The whole
    is a function of the seed, the actions and the masks all the same. To resume exactly, replay
    actions and resets from the last seeded reset, whose seed is in `ale_seeds`.

    ALE's own quirk: an episode that ends within the four frames keeps the last frames that were
    captured before the end, so its final frame may equal the one before.

    `info` holds arrays of shape [N]: `life_lost` bool; `lives` int32; `frame_number` (since the ROM
    was read) and `episode_frame_number` int32, in emulator frames.

    Attributes:
        ale_seeds: int64 [N], the seed that ALE got at each environment's last seeded reset.
        steps_since_seeded: int64 [N], env steps since then.
    """

    def __init__(
        self,
        game: str,
        *,
        num_envs: int,
        seed: int,
        frame_size: int = 84,
        sticky_actions: float = 0.0,
        noop_max: int = 30,
        full_action_space: bool = False,
        max_frames: int = 108_000,
        reseed_every: int = 5_000,
        num_threads: int = 0,
    ):
        """Loads the game.

        Args:
            game: one of `games.ATARI_57`.
            num_envs: how many copies, N.
            seed: the source of all randomness.
            frame_size: height and width of a frame in pixels.
            sticky_actions: probability of repeating the last action, per emulator frame.
            noop_max: an episode starts with a random number of no-ops below this (the FIRE counts
                as one); 0 and 1 mean none.
            full_action_space: all of the console's actions instead of those that the game uses.
            max_frames: emulator frames after which an episode is truncated.
            reseed_every: env steps between two seeded resets of one environment; 0 seeds every
                reset.
            num_threads: threads that step the emulators; 0 lets ALE choose.

        Raises:
            ValueError: unknown game, or an option out of its range.
        """
        for name, value, least in (
            ("num_envs", num_envs, 1),
            ("frame_size", frame_size, 1),
            ("noop_max", noop_max, 0),
            ("max_frames", max_frames, 1),
            ("reseed_every", reseed_every, 0),
            ("num_threads", num_threads, 0),
        ):
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        if not 0.0 <= sticky_actions <= 1.0:
            raise ValueError(f"sticky_actions must lie in [0, 1], got {sticky_actions}")
        # Every option is named: ALE's defaults clip rewards and differ from Gymnasium's.
        self._envs = AtariVectorEnv(
            rom_name(game),
            num_envs,
            batch_size=0,  # wait for all: results of smaller batches come in no fixed order
            num_threads=num_threads,
            thread_affinity_offset=-1,
            max_num_frames_per_episode=max_frames,
            repeat_action_probability=sticky_actions,
            full_action_space=full_action_space,
            continuous=False,
            # ALE has no mode without autoreset. In this one it would come a step late, and `step`
            # refuses to go on before an ended environment has been reset, so it never comes.
            autoreset_mode=AutoresetMode.NEXT_STEP,
            img_height=frame_size,
            img_width=frame_size,
            grayscale=True,
            stack_num=1,
            frameskip=FRAME_SKIP,
            maxpool=True,
            noop_max=noop_max,
            episodic_life=False,  # would reset the whole game at a lost life
            life_loss_info=False,  # would report a lost life as termination
            reward_clipping=False,
            use_fire_reset=True,
        )
        super().__init__(
            num_envs=num_envs,
            seed=seed,
            frame_size=frame_size,
            action_meanings=tuple(action.name for action in self._envs.ale.get_action_set()),
        )
        self._reseed_every = reseed_every
        self._lives = np.zeros(num_envs, np.int32)
        self._seeded_resets = np.zeros(num_envs, np.int64)
        self.ale_seeds = np.full(num_envs, -1, np.int64)
        self.steps_since_seeded = np.zeros(num_envs, np.int64)

    def _reset(self, mask, seeded):
        if seeded:
            self._seeded_resets[mask] = 0
        first = self._seeded_resets == 0
        due = mask & (first | (self.steps_since_seeded >= self._reseed_every))
        for i in np.flatnonzero(due):
            (word,) = self._stream(i, int(self._seeded_resets[i])).generate_state(1)
            # ALE wants a positive int32; -1 stands for an unseeded reset.
            self.ale_seeds[i] = max(1, int(word) & 0x7FFFFFFF)
        self._seeded_resets[due] += 1
        self.steps_since_seeded[due] = 0
        seeds = np.where(due, self.ale_seeds, -1)[mask]
        frames, info = self._envs.reset(seed=seeds, options={"reset_mask": mask})
        self._lives = np.array(info["lives"])
        return frames[:, 0].copy(), self._info(info, np.zeros(self.num_envs, bool))

    def _step(self, actions):
        frames, rewards, terminated, truncated, info = self._envs.step(actions)
        self.steps_since_seeded += 1
        life_lost = info["lives"] < self._lives
        self._lives = np.array(info["lives"])
        return (
            frames[:, 0].copy(),
            rewards.astype(np.float32),
            np.array(terminated),
            np.array(truncated),
            self._info(info, life_lost),
        )

    def _info(self, info, life_lost):
        names = ("lives", "frame_number", "episode_frame_number")
        return {"life_lost": life_lost} | {name: np.array(info[name]) for name in names}

    def close_extras(self, **kwargs):
        """Ends ALE's threads."""
        self._envs = None
