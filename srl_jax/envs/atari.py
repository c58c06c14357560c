"""Atari 2600 games on ALE's C++ vector environment.

Bellemare et al., 2013; Machado et al., 2018.
"""

from collections.abc import Mapping

import numpy as np
from gymnasium.vector import AutoresetMode

from srl_jax.envs.base import FrameVectorEnv
from srl_jax.envs.games import FRAME_SKIP, MAX_FRAMES, rom_name

try:
    from ale_py.vector_env import AtariVectorEnv
except ImportError as error:
    raise ImportError("Atari games need ale-py: pip install srl-jax[atari]") from error

COUNTERS = ("lives", "frame_number", "episode_frame_number")
"""What ALE says of an environment beside its frame, int32 each."""
RESET = 255
"""Stands for an unseeded reset among the actions of a log."""


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
    is a function of the seed, the actions and the masks all the same.

    Snapshots. ALE's own saved states are not exact: they lose the last action, which sticky actions
    repeat, and some of what Qbert and YarsRevenge remember. So every environment keeps a log of
    actions and unseeded resets since its last seeded reset, a byte each, and `restore` plays it
    again; that takes as long as playing it took, up to `reseed_every` steps and an episode.

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
        full_actions: bool = False,
        noop_max: int = 30,
        max_frames: int = MAX_FRAMES,
        reseed_every: int = 5_000,
    ):
        """Loads the game; for what is not named here see `envs.make`.

        Args:
            game: one of `games.ATARI_57`.
            full_actions: all 18 actions of the joystick, FIRE among them, instead of those that the game
                knows.
            noop_max: an episode starts with a random number of no-ops below this (the FIRE counts
                as one); 0 and 1 mean none.
            reseed_every: env steps between two seeded resets of one environment; 0 seeds every
                reset.

        Raises:
            ValueError: unknown game, or an option out of its range.
        """
        for name, value, least in (
            ("num_envs", num_envs, 1),
            ("frame_size", frame_size, 1),
            ("noop_max", noop_max, 0),
            ("max_frames", max_frames, 1),
            ("reseed_every", reseed_every, 0),
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
            num_threads=0,  # as ALE chooses; results do not depend on it
            thread_affinity_offset=-1,
            max_num_frames_per_episode=max_frames,
            repeat_action_probability=sticky_actions,
            full_action_space=full_actions,
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
            frame_shape=(frame_size, frame_size, 1),
            action_meanings=tuple(action.name for action in self._envs.ale.get_action_set()),
        )
        self._reseed_every = reseed_every
        self._lives = np.zeros(num_envs, np.int32)
        self._seeded_resets = np.zeros(num_envs, np.int64)
        self.ale_seeds = np.full(num_envs, -1, np.int64)
        self.steps_since_seeded = np.zeros(num_envs, np.int64)
        self._log = np.zeros((num_envs, 256), np.uint8)  # grows
        self._log_lengths = np.zeros(num_envs, np.int64)
        self._log_longest = 0  # at least the largest of them
        self._rows = np.arange(num_envs)

    def _reset(self, mask, seeded):
        if seeded:
            self._seeded_resets[mask] = 0
        first = self._seeded_resets == 0
        due = mask & (first | (self.steps_since_seeded >= self._reseed_every))
        for i in np.flatnonzero(due):
            self.ale_seeds[i] = self._ale_seed(i, int(self._seeded_resets[i]))
        self._seeded_resets[due] += 1
        self.steps_since_seeded[due] = 0
        frames, info = self._reset_ale(mask, np.where(due, self.ale_seeds, -1))
        self._lives = np.array(info["lives"])
        self._log_lengths[due] = 0
        self._log_longest = int(self._log_lengths.max())
        self._append(np.flatnonzero(mask & ~due), RESET)
        return shown(frames), self._info(info, np.zeros(self.num_envs, bool))

    def _step(self, actions):
        frames, rewards, terminated, truncated, info = self._envs.step(actions)
        self.steps_since_seeded += 1
        self._append(self._rows, actions)
        life_lost = info["lives"] < self._lives
        self._lives = np.array(info["lives"])
        return (
            shown(frames),
            rewards.astype(np.float32),
            np.array(terminated),
            np.array(truncated),
            self._info(info, life_lost),
        )

    def _ale_seed(self, env, number):
        """The seed of an environment's seeded reset of that number, counted from 0."""
        (word,) = self._stream(env, number).generate_state(1)
        return max(1, int(word) & 0x7FFFFFFF)  # ALE wants a positive int32

    def _reset_ale(self, mask, seeds):
        """Resets the environments of the mask, bool [N]; seeds are int64 [N], -1 for an unseeded reset."""
        return self._envs.reset(seed=seeds[mask], options={"reset_mask": mask})

    def _append(self, envs, events):
        """Adds one event each to the logs of the environments envs, int64 [M]."""
        if self._log_longest == self._log.shape[1]:
            self._log = np.concatenate((self._log, np.zeros_like(self._log)), axis=1)
        self._log[envs, self._log_lengths[envs]] = events
        self._log_lengths[envs] += 1
        self._log_longest += 1

    def _info(self, info, life_lost):
        return {"life_lost": life_lost} | {name: np.array(info[name]) for name in COUNTERS}

    def _look(self):
        """Frames and info as they were last seen: resets nothing."""
        return self._reset_ale(np.zeros(self.num_envs, bool), self.ale_seeds)

    def _seen(self):
        return shown(self._look()[0])

    def _snapshot(self):
        info = self._look()[1]
        written = np.arange(self._log.shape[1]) < self._log_lengths[:, None]
        return {
            "ale_seeds": self.ale_seeds.copy(),
            "seeded_resets": self._seeded_resets.copy(),
            "steps_since_seeded": self.steps_since_seeded.copy(),
            "events": self._log[written],
            "event_counts": self._log_lengths.copy(),
        } | {name: np.array(info[name]) for name in COUNTERS}

    def _restore(self, arrays):
        logs = logs_of(arrays)
        self.ale_seeds = arrays["ale_seeds"].copy()
        self._seeded_resets = arrays["seeded_resets"].copy()
        self.steps_since_seeded = arrays["steps_since_seeded"].copy()
        self._log_lengths = arrays["event_counts"].copy()
        self._log_longest = int(self._log_lengths.max())
        self._log = np.zeros((self.num_envs, 256 + self._log_longest), np.uint8)
        for row, log in zip(self._log, logs, strict=True):
            row[: len(log)] = log
        ended = self._replay(logs)
        info = self._look()[1]
        self._lives = np.array(info["lives"])
        return {"ended": ended} | {name: info[name] for name in COUNTERS}

    def _replay(self, logs):
        """Plays the logs, uint8 arrays, each from a seeded reset on; says who has ended then, bool [N].

        ALE steps all environments together, so the logs are aligned at their ends: an environment whose
        log is shorter plays anything until its seeded reset, which forgets it.
        """
        ticks = int(self.steps_since_seeded.max())
        starts = ticks - self.steps_since_seeded
        actions = np.zeros((ticks, self.num_envs), np.int64)
        resets = np.zeros((ticks + 1, self.num_envs), np.int64)  # unseeded ones, before that tick
        for i, log in enumerate(logs):
            steps = log != RESET
            actions[starts[i] :, i] = log[steps]
            np.add.at(resets[:, i], starts[i] + np.cumsum(steps)[~steps], 1)
        ended = np.zeros(self.num_envs, bool)
        unseeded = np.full(self.num_envs, -1, np.int64)
        # All at once, since ALE wants a first reset of all.
        self._reset_ale(np.ones(self.num_envs, bool), np.where(starts == 0, self.ale_seeds, -1))
        for tick in range(ticks + 1):
            if tick:
                _, _, terminated, truncated, _ = self._envs.step(actions[tick - 1])
                ended = terminated | truncated
                starting = starts == tick
                if starting.any():
                    self._reset_ale(starting, self.ale_seeds)
                    ended &= ~starting
            for number in range(resets[tick].max()):
                again = resets[tick] > number
                self._reset_ale(again, unseeded)
                ended &= ~again
        return ended

    def close_extras(self, **kwargs):
        """Ends ALE's threads."""
        vars(self).pop("_envs", None)


def shown(frames: np.ndarray) -> np.ndarray:
    """ALE's stacks of one frame, uint8 [N, 1, H, W], as frames of the caller's own, uint8 [N, H, W, 1]."""
    return frames[:, 0, :, :, None].copy()


def logs_of(arrays: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """The log of each environment, uint8, from the arrays of a snapshot."""
    return np.split(arrays["events"], np.cumsum(arrays["event_counts"])[:-1])
