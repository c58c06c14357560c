"""A record of everything that environments gave, beside what a run's replay and its policy make of it."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

import srl_jax
from srl_jax import envs
from srl_jax.config import Config
from srl_jax.envs.atari import COUNTERS
from srl_jax.replay import Replay
from srl_jax.run.actor import FrameStack
from srl_jax.types import Window

Count = Counter[str]


class Recorder:
    """Environments whose every frame has a name, and an obvious record of all that they gave.

    A frame's first 12 bytes are overwritten with three int32, its name: environment, episode, step, the
    latter two from 0 on. The record has a row for every frame of an environment, in order.

    Attributes:
        rows: int64 [N], frames so far; row 0 is the first one.
        frames: uint8 [N, R, H, W, 1], named. names: int64 [N, R, 3].
        actions, rewards: of the step that followed a frame. terminal: bool, its return ends there.
            truncated: bool. All [N, R].
        first_row, length: int64 [N, R], of an episode: the row of its first frame, and its steps so far.
        steps: env steps of one environment.
        phantoms: steps that were none of a game's, by the emulator's own counters of frames.
        wrong_resets: resets of an environment that had not ended, or that changed another one.
    """

    def __init__(self, env, steps: int):
        self._env = env
        self.num_envs, self.single_action_space = env.num_envs, env.single_action_space
        self.single_observation_space = env.single_observation_space
        rows = 2 * steps + 2
        shape = (self.num_envs, rows)
        self.rows = np.zeros(self.num_envs, np.int64)
        self.frames = np.zeros((*shape, *self.single_observation_space.shape), np.uint8)
        self.names = np.zeros((*shape, 3), np.int64)
        self.actions = np.zeros(shape, np.int64)
        self.rewards = np.zeros(shape)
        self.terminal, self.truncated = np.zeros(shape, bool), np.zeros(shape, bool)
        self.first_row, self.length = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        self.steps = self.phantoms = self.wrong_resets = 0
        self._episode = np.full(self.num_envs, -1)
        self._step = np.zeros(self.num_envs, np.int64)
        self._ended = np.ones(self.num_envs, bool)
        self._all = np.arange(self.num_envs)
        self._info = None

    def reset(self, *, options=None):
        """As `srl_jax.envs` has it."""
        frames, info = self._env.reset(options=options)
        mask = options["reset_mask"] if options else np.ones(self.num_envs, bool)
        self.wrong_resets += np.count_nonzero(mask & ~self._ended)
        if self._info is not None:
            others = ~mask
            for name in COUNTERS:
                self.wrong_resets += np.count_nonzero((info[name] != self._info[name]) & others)
        self._episode[mask] += 1
        self._step[mask] = 0
        self._ended[mask] = False
        self._info = info
        which = np.flatnonzero(mask)
        self.first_row[which, self._episode[which]] = self.rows[which]
        self._name(frames)
        self._keep(frames, which)
        return frames, info

    def step(self, actions):
        """As `srl_jax.envs` has it."""
        frames, rewards, terminated, truncated, info = self._env.step(actions)
        ended = terminated | truncated
        for counter in ("frame_number", "episode_frame_number"):
            played = info[counter] - self._info[counter]
            # A game may end within the four frames of a step.
            self.phantoms += np.count_nonzero((played > 4) | (played < np.where(ended, 1, 4)))
        newest = self._all, self.rows - 1
        self.actions[newest], self.rewards[newest] = actions, rewards
        self.terminal[newest], self.truncated[newest] = terminated | info["life_lost"], truncated
        self._step += 1
        self.length[self._all, self._episode] += 1
        self._ended, self._info = ended, info
        self.steps += 1
        self._name(frames)
        self._keep(frames, self._all)
        return frames, rewards, terminated, truncated, info

    def close(self):
        """Ends ALE's threads."""
        self._env.close()

    def _name(self, frames):
        names = np.stack((self._all, self._episode, self._step), axis=1).astype("<i4")
        frames[:, 0, :12, 0] = names.view(np.uint8)

    def _keep(self, frames, which):
        rows = self.rows[which]
        self.frames[which, rows] = frames[which]
        self.names[which, rows] = np.stack((which, self._episode[which], self._step[which]), axis=1)
        self.rows[which] += 1

    def right_stacks(self, stacks: np.ndarray) -> np.ndarray:
        """Whether the stacks uint8 [N, S, H, W, 1] are those of the newest frames: bool [N]."""
        back = np.arange(1 - stacks.shape[1], 1)
        steps = np.maximum(self._step[:, None] + back, 0)
        names = np.stack(np.broadcast_arrays(self._all[:, None], self._episode[:, None], steps), axis=-1)
        return (names_of(stacks) == names).all((1, 2))

    def right_windows(self, window: Window, indices: np.ndarray, stack: int, gamma: float) -> np.ndarray:
        """Whether the windows of replay's indices are what the record says: bool [B]."""
        rows, streams = np.divmod(indices, self.num_envs)
        episodes, steps = self.names[streams, rows, 1], self.names[streams, rows, 2]
        first, length = self.first_row[streams, episodes, None], self.length[streams, episodes, None]
        horizon = window.actions.shape[1]
        # Every frame is of this episode, and they are consecutive but for repetitions at its ends.
        times = np.clip(steps[:, None] + np.arange(1 - stack, horizon + 1), 0, length)
        names = np.stack(np.broadcast_arrays(streams[:, None], episodes[:, None], times), axis=-1)
        right = (names_of(window.frames) == names).all((1, 2))
        right &= (self.frames[streams[:, None], first + times] == window.frames).all((1, 2, 3, 4))
        # So many steps were taken after it; where the episode goes on, all that the window shows.
        at = steps[:, None] + np.arange(horizon)
        valid = at < length
        over = episodes < self._episode[streams]
        right &= valid.all(1) | over | self._ended[streams]
        right &= valid[:, 0]
        at = streams[:, None], first + np.where(valid, at, 0)
        discounts = np.where(self.terminal[at], np.float32(0), np.float32(gamma))
        for found, expected in (
            (window.actions, self.actions[at]),
            (window.rewards, np.sign(self.rewards[at])),
            (window.discounts, discounts),
        ):
            right &= (found == np.where(valid, expected, 0)).all(1)
        return right & (window.valid == valid).all(1)


def names_of(frames: np.ndarray) -> np.ndarray:
    """The names of frames uint8 [..., H, W, 1]: int32 [..., 3]."""
    return np.ascontiguousarray(frames[..., 0, :12, 0]).view("<i4")


class Watched:
    """A run of `srl_jax.train` on a Recorder, with random actions and the smallest agent there is.

    The windows of replay are compared with the record: those of every batch that the run samples, and all
    that can be sampled, so often that every transition is among them before it is overwritten. So are the
    observations that the policy gets.

    Args:
        game: of Atari.
        num_envs: of the run.
        slots: frames that replay keeps of each environment.
        max_steps: after which an episode is cut, so that there are many ends of both kinds.
        reseed_every: see `srl_jax.envs.make`.
        say: called with the env steps done.

    Attributes:
        counts: what was seen, and what was wrong with it: see `WRONG`.
    """

    WRONG = (
        "phantom steps or early resets",
        "missing transitions",
        "wrong windows",
        "unseen",
        "wrong stacks",
    )

    def __init__(
        self,
        game: str,
        *,
        num_envs: int,
        slots: int,
        max_steps: int,
        reseed_every: int,
        say: Callable[[int], None] = lambda done: None,
    ):
        self.game, self.num_envs, self.slots, self.say = game, num_envs, slots, say
        self.options = {"max_frames": envs.FRAME_SKIP * max_steps, "reseed_every": reseed_every}
        self.counts: Count = Counter()
        self._sampled: list[tuple[Window, np.ndarray]] = []

    def run(self, out: Path, steps: int, seed: int) -> Count:
        """Trains so many steps of all environments; returns the counts."""
        total = steps * self.num_envs
        self.config = Config(
            game=self.game, rl="dqn:hidden=1,prioritized=true,n_step=3", encoder="tiny:features=1",
            frame_size=18, num_envs=self.num_envs, buffer_size=self.slots * self.num_envs,
            batch_size=32, learn_start=32,
            updates_per_step=1 / self.num_envs, eps_final=1.0, steps=total, seed=seed, diagnostics=False,
            log_every=total, eval_every=total, eval_games=1, eval_max_steps=10,
        )  # fmt: skip
        make, begin, sample, observations = envs.make, Replay.begin, Replay.sample, FrameStack.observations

        def make_watched(game, **options):
            if options["num_envs"] != self.num_envs:  # of an evaluation
                return make(game, **options)
            self.record = Recorder(make(game, **{**options, **self.options}), steps)
            return self.record

        def begin_watched(replay, *arguments):
            self.replay = replay
            return begin(replay, *arguments)

        def sample_watched(*arguments):
            self._sampled.append(sample(*arguments))
            return self._sampled[-1]

        def observations_watched(stacks):
            found = observations(stacks)
            if len(found) == self.num_envs:
                self._before_a_step(found)
            return found

        with (
            mock.patch.object(envs, "make", make_watched),
            mock.patch.object(Replay, "begin", begin_watched),
            mock.patch.object(Replay, "sample", sample_watched),
            mock.patch.object(FrameStack, "observations", observations_watched),
        ):
            result = srl_jax.train(self.config, out, progress=False)
        self._look_at_everything()
        self._add_up(result.env_steps)
        return self.counts

    def _before_a_step(self, stacks: np.ndarray) -> None:
        # Here no environment moves; batches are sampled while they do.
        self.counts["wrong stacks"] += int(np.count_nonzero(~self.record.right_stacks(stacks)))
        for window, indices in self._sampled:
            self._look(window, indices)
        self._sampled.clear()
        if self.record.steps % (self.slots // 2) == 0:
            self._look_at_everything()
        self.say(self.record.steps * self.num_envs)

    def _look_at_everything(self) -> None:
        for indices in np.array_split(self.replay.sampleable(), 10):
            self._look(self.replay.gather(indices), indices)

    def _look(self, window: Window, indices: np.ndarray) -> None:
        if not hasattr(self, "_seen"):
            self._seen = np.zeros(self.record.actions.shape, bool)
        right = self.record.right_windows(window, indices, self.config.frame_stack, self.config.gamma)
        self.counts["windows"] += len(indices)
        self.counts["wrong windows"] += int(np.count_nonzero(~right))
        rows, streams = np.divmod(indices, self.num_envs)
        self._seen[streams, rows] = True

    def _add_up(self, env_steps: int) -> None:
        record, replay, counts = self.record, self.replay, self.counts
        # Frames that no step followed are no transitions; the newest ones' horizon is not yet complete.
        took = np.zeros_like(self._seen)
        for i, row in enumerate(record.rows):
            steps_left = record.length[i, record.names[i, :row, 1]] - record.names[i, :row, 2]
            complete = steps_left >= replay.horizon
            complete |= record.names[i, :row, 1] < record.names[i, row - 1, 1]
            took[i, :row] = (steps_left > 0) & complete
        counts["transitions seen"] += int(np.count_nonzero(took))
        counts["unseen"] += int(np.count_nonzero(took != self._seen))
        steps = record.steps * record.num_envs
        counts["env steps"] += steps
        counts["phantom steps or early resets"] += int(record.phantoms + record.wrong_resets)
        counts["missing transitions"] += abs(replay.num_transitions - steps) + abs(env_steps - steps)
        counts["missing transitions"] += int(np.abs(replay.next_position - record.rows).sum())
        counts["episodes"] += int(record.names[np.arange(record.num_envs), record.rows - 1, 1].sum())
        counts["episodes cut"] += int(np.count_nonzero(record.truncated))
