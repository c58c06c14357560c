"""Emulators: against gymnasium's own wrappers, through the loop into replay, and out of snapshots.

The last of these is in `snapshots.py`.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import gymnasium
import numpy as np
from gymnasium.wrappers import AtariPreprocessing

from srl_jax import envs, loop
from srl_jax.actor import seed_for
from srl_jax.agent import make_agent
from srl_jax.config import Config
from srl_jax.display import Progress
from srl_jax.envs.atari import COUNTERS
from srl_jax.loop import Run
from srl_jax.types import Window

from . import Count, Say
from .snapshots import NOOP_MAX, Lines, out_of_snapshots

TWISTER = np.random.RandomState
"""A Mersenne twister that is seeded as C++'s mt19937 is."""
THREE_GAMES = ("Breakout", "Berzerk", "Freeway")
"""Starts with FIRE; with frames of ALE's own, before the first; without FIRE."""
TEN_GAMES = (
    "Breakout", "SpaceInvaders", "Qbert", "Pong", "MsPacman", "Seaquest", "Enduro", "YarsRevenge", "Asterix",
    "Boxing",
)  # fmt: skip


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """Three parts, see `against_gymnasium`, `through_the_loop` and `snapshots.out_of_snapshots`."""
    return [
        *against_gymnasium(short, say),
        *through_the_loop(short, folder, say),
        *out_of_snapshots(short, say),
    ]


# Against gymnasium


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


def against_gymnasium(short: bool, say: Say) -> list[Count]:
    """ALE's vector environment, as `srl_jax.envs` uses it, against gymnasium's AtariPreprocessing.

    All 57 games, 200 env steps each, with the same ALE seeds and actions; resets of games that are over, and
    after 20 and 40 steps, the latter with a seed. Compared bit for bit: frames, rewards, both kinds of end,
    lives, and the emulators' counters of frames. What differs between the two by design, and is predicted:

    - gymnasium makes ALE's seed of the seed it is given; here ALE gets `ale_seeds`.
    - gymnasium presses no FIRE at the start; ALE's vector environment presses it once, where the game has it.
    - gymnasium draws 1 to 30 no-ops at the start, with numpy; ALE draws 0 to 29, the FIRE
      among them, with C++'s mt19937 of the same seed, which goes on where a reset has no seed.
    - gymnasium's limit of frames counts those of the start; the episodes here are too short for either.

    Nothing else differs: the same two frames are pooled, at a game's end too, where both show older ones, and
    both shrink frames with OpenCV's INTER_AREA.
    """
    what = "frames of ALE's vector environment against gymnasium's AtariPreprocessing"
    try:
        import ale_py
        import cv2
    except ImportError as error:
        say(f"not run: {what}: {error.name} is missing; pip install srl-jax[soak]")
        return [Count(what, 0, 0, "not run: needs the extra soak")]
    gymnasium.register_envs(ale_py)
    games, steps = (THREE_GAMES, 60) if short else (envs.ATARI_57, 200)
    frames = numbers = wrong_frames = wrong_numbers = starts = lost_games = pixels = largest = 0
    with Progress(len(games) * steps, stream=Lines(say)) as progress:
        for index, game in enumerate(games):
            for begins, over, difference, agree in beside_gymnasium(game, steps):
                frames, numbers = frames + 1, numbers + 1
                starts, lost_games = starts + begins, lost_games + over
                wrong_frames += bool(difference.any())
                wrong_numbers += not agree
                pixels += int(np.count_nonzero(difference))
                largest = max(largest, int(difference.max()))
                if difference.any() or not agree:
                    progress.note(f"{game}: differs")
            progress.update((index + 1) * steps, game=game)
    detail = f"{len(games)} games, {starts} starts, {lost_games} games over; OpenCV {cv2.__version__}"
    by = f"; {pixels} pixels differ, by {largest} at most"
    return [
        Count(what, frames, wrong_frames, detail + by),
        Count("rewards, ends, lives and counters of frames beside them", numbers, wrong_numbers),
    ]


def beside_gymnasium(game: str, steps: int) -> Iterator[tuple[bool, bool, np.ndarray, bool]]:
    """Plays a game in both.

    Yields:
        for every frame whether it begins an episode, whether the game is over, by how much the two frames
        differ, int [84, 84], and whether all numbers agree.
    """
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
        return True, False, *compare(frame, info, theirs.reset()[0])

    yield start()
    for step in range(1, steps + 1):
        action = int(rng.integers(ours.single_action_space.n))
        frame, reward, terminated, truncated, info = ours.step(np.array([action]))
        their_frame, *outcome, _ = theirs.step(action)
        difference, agree = compare(frame, info, their_frame)
        agree &= [reward[0], terminated[0], truncated[0]] == outcome
        yield False, bool(terminated[0]), difference, agree
        if terminated[0] or truncated[0] or step in (20, 40):
            yield start()
    ours.close()
    theirs.close()


# Through the loop


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


class Recorded(Run):
    """The loop's own run, of random actions and without updates, on a Recorder.

    Attributes:
        wrong_stacks: observations that the policy got and that were not those of the newest frames.
    """

    def __init__(self, config: Config, folder: Path, steps: int, options: dict):
        self.wrong_stacks = 0
        # Parameters would only have to be compiled and drawn; nobody asks for them.
        frame = (config.frame_size, config.frame_size, 1)
        agent = make_agent(config, frame, 18)._replace(init=lambda *_: SimpleNamespace(params=None))

        def make_env(config: Config, purpose: str, num_envs: int) -> Recorder:
            env = envs.make(
                config.game,
                num_envs=num_envs,
                seed=seed_for(config.seed, purpose, "environments"),
                frame_size=config.frame_size,
                noop_max=config.noop_max,
                **options,
            )
            return Recorder(env, steps)

        with mock.patch.object(loop, "make_env", make_env):
            super().__init__([config], [folder], agent=agent)

    def act_and_step(self, params, frames, step, epsilon) -> list:
        """Random actions; looks at what the policy is shown."""
        (seed,), (stacks,) = self.seeds, frames
        self.wrong_stacks += np.count_nonzero(~seed.env.right_stacks(stacks))
        return [seed.step_env(seed.policy(stacks, step, epsilon))]


def through_the_loop(short: bool, folder: Path, say: Say) -> list[Count]:
    """A million env steps of ten games through the loop's own step into replay, against a `Recorder`.

    Actions are random, and no update is made, but every step a batch is sampled and given random priorities.
    Episodes are cut after 500 steps, so that there are many ends of both kinds, and environments reseeded
    as often. Windows are compared with the record: those of every batch, and all that can be sampled, so
    often that every transition is among them before it is overwritten.
    """
    games, total = (TEN_GAMES[:3], 600) if short else (TEN_GAMES, 100_000)
    episode, reseed, capacity, number = (20, 100, 90, 3) if short else (500, 500, 10_000, 10)
    steps = total // number
    options = {"max_frames": 4 * episode, "reseed_every": reseed}
    counts: Counter[str] = Counter()
    with Progress(len(games) * total, stream=Lines(say)) as progress:
        for index, game in enumerate(games):
            config = Config(
                game=game,
                rl="rainbow:hidden=1,atoms=2",
                encoder="tiny:features=1",
                frame_size=18,
                num_envs=number,
                buffer_size=capacity,
                learn_start=capacity,
                updates_per_step=1e-12,
                seed=index,
            )
            with Recorded(config, folder, steps, options) as run:
                done = index * total
                drive(run, steps, counts, lambda env_steps: progress.update(done + env_steps, game=game))  # noqa: B023
    detail = f"{len(games)} games; {counts['ends']:,} episodes, {counts['cuts']:,} of them cut"
    return [
        Count(
            "env steps through the loop; not one phantom, no early reset",
            counts["steps"],
            counts["phantoms"],
            detail,
        ),
        Count("transitions in replay, one for each env step", counts["transitions"], counts["missing"]),
        Count("windows of replay, frame by frame against a record", counts["windows"], counts["wrong"]),
        Count("transitions that were in one of these windows", counts["seen"], counts["unseen"]),
        Count("observations that the policy saw, against the record", counts["steps"], counts["stacks"]),
    ]


def drive(run: Recorded, steps: int, counts: Counter[str], say_how_far: Callable[[int], None]) -> None:
    """Runs so many steps of all environments, and adds up what was counted."""
    record, replay = run.seeds[0].env, run.seeds[0].replay
    stack, gamma = run.config.frame_stack, run.config.gamma
    rng = np.random.default_rng(run.config.seed)
    seen = np.zeros(record.actions.shape, bool)

    def look(window, indices):
        right = record.right_windows(window, indices, stack, gamma)
        counts["windows"] += len(indices)
        counts["wrong"] += int(np.count_nonzero(~right))
        rows, streams = np.divmod(indices, record.num_envs)
        seen[streams, rows] = True

    run.begin()
    for step in range(1, steps + 1):
        run.step()
        if len(replay):
            window, indices = replay.sample(run.config.batch_size, 0.4)
            look(window, indices)
            replay.set_priorities(indices, rng.exponential(size=len(indices)))
        if step % (replay.slots // 2) == 0 or step == steps:
            for indices in np.array_split(replay.sampleable(), 10):
                look(replay.gather(indices), indices)
        say_how_far(run.env_steps)
    # Frames that no step followed are no transitions; the newest ones' horizon is not yet complete.
    took = np.zeros_like(seen)
    for i, row in enumerate(record.rows):
        steps_left = record.length[i, record.names[i, :row, 1]] - record.names[i, :row, 2]
        complete = steps_left >= run.agent.horizon
        complete |= record.names[i, :row, 1] < record.names[i, row - 1, 1]
        took[i, :row] = (steps_left > 0) & complete
    counts["seen"] += int(np.count_nonzero(took))
    counts["unseen"] += int(np.count_nonzero(took != seen))
    counts["steps"] += record.steps * record.num_envs
    counts["phantoms"] += int(record.phantoms + record.wrong_resets)
    counts["transitions"] += replay.num_transitions
    taken = record.steps * record.num_envs
    counts["missing"] += abs(replay.num_transitions - taken) + abs(run.env_steps - taken)
    counts["missing"] += int(np.abs(replay.next_position - record.rows).sum())
    counts["stacks"] += int(run.wrong_stacks)
    counts["ends"] += int(record.names[np.arange(record.num_envs), record.rows - 1, 1].sum())
    counts["cuts"] += int(np.count_nonzero(record.truncated))
