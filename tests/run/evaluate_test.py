"""srl_jax/run/evaluate.py on games whose whole course is written down."""

import numpy as np
import pytest
from gymnasium.spaces import Box

from srl_jax import envs
from srl_jax.run import evaluate as module
from srl_jax.run.evaluate import evaluate, telling


class Scripted:
    """N environments that play given games, each a list of rewards; None for one that never ends.

    Every frame names its environment, game and step, as the pixel 100 * i + 10 * game + step (below 256).
    """

    single_observation_space = Box(0, 255, (1, 1, 1), np.uint8)

    def __init__(self, scripts, truncate=False):
        self.scripts, self.num_envs, self.truncate = scripts, len(scripts), truncate
        self.game, self.time = np.zeros((2, self.num_envs), int)
        self.ended = np.zeros(self.num_envs, bool)
        self.seeds, self.actions = [], []

    def frames(self):
        pixels = 100 * np.arange(self.num_envs) + 10 * self.game + self.time
        return pixels.astype(np.uint8)[:, None, None, None]

    def script(self, i):
        return self.scripts[i][self.game[i] % len(self.scripts[i])]

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        if options is None:
            self.game[:], self.time[:], self.ended[:] = 0, 0, False
        else:
            mask = options["reset_mask"]
            self.game[mask] += 1
            self.time[mask], self.ended[mask] = 0, False
        return self.frames(), {}

    def step(self, actions):
        assert not self.ended.any(), "stepped after its end"
        self.actions.append(actions)
        scripts = [self.script(i) for i in range(self.num_envs)]
        rewards = [1.0 if s is None else s[t] for s, t in zip(scripts, self.time, strict=True)]
        self.time += 1
        over = np.array([s is not None and t == len(s) for s, t in zip(scripts, self.time, strict=True)])
        self.ended = over
        never = np.zeros_like(over)
        ends = (never, over) if self.truncate else (over, never)
        info = {"life_lost": np.ones(self.num_envs, bool)}
        return self.frames(), np.array(rewards, np.float32), *ends, info


def watching(seen):
    """A policy that notes what it is shown and always does 1."""

    def policy(frames, step, epsilon):
        seen.append((frames[..., 0, 0, 0].tolist(), step, epsilon))
        return np.ones(len(frames), np.int32)

    return policy


def play(env, **options):
    return evaluate(watching([]), env, **{"seed": 3, "epsilon": 0.1} | options)


@pytest.mark.parametrize("truncate", [False, True])
def test_short_games_are_not_favoured_and_scores_are_raw(truncate):
    # Environment 0 plays games of one step worth 7, environment 1 games of three steps worth -2 + 0 + 5.5.
    # Five games: three of the short ones and two of the long ones, though five short ones end before two long
    # ones do. A lost life (in every step here) ends nothing.
    env = Scripted([[[7.0]], [[-2.0, 0.0, 5.5]]], truncate)
    result = play(env, games=5)
    assert result.returns == [7.0, 3.5, 7.0, 3.5, 7.0]
    assert result.lengths == [1, 3, 1, 3, 1]
    assert result.frames.shape == (0, 1, 1, 1)
    assert len(env.actions) == 6  # not a step longer than the second long game


def test_games_are_counted_from_zero():
    # Scores do not leak into the next game: 1, then 2, then 4 in one environment.
    env = Scripted([[[1.0], [1.0, 1.0], [4.0]]])
    assert play(env, games=3).returns == [1.0, 2.0, 4.0]


def test_fewer_games_than_environments():
    env = Scripted([[[1.0, 1.0]], [[5.0]], [None]])
    assert play(env, games=2).returns == [2.0, 5.0]  # and the endless third one is not waited for


def test_an_endless_game_is_cut_with_its_score_as_it_stands():
    env = Scripted([[None, [3.0]], [[1.0, 1.0, 1.0, 1.0]]])
    result = play(env, games=4, max_steps=4)
    assert result.returns == [4.0, 4.0, 3.0, 4.0]
    assert result.lengths == [4, 4, 1, 4] and result.cut == 1  # the others are of four steps by themselves


@pytest.mark.parametrize(("max_steps", "cut"), [(4, 2), (5, 0)])
def test_a_game_that_the_environment_cuts_in_the_same_step_counts_as_cut(max_steps, cut):
    # As Atari does, whose limit of frames is that of --eval_max_steps.
    result = play(Scripted([[[1.0] * 4, [1.0] * 4]], truncate=True), games=2, max_steps=max_steps)
    assert result.lengths == [4, 4] and result.cut == cut


@pytest.mark.parametrize("record", [1, 4, 5, 6, 100])
def test_games_of_the_first_environment_are_recorded_from_their_first_frame_to_their_last(record):
    # Two games of it, of three and two steps; it goes on into a third one, which does not count.
    env = Scripted([[[0.0] * 3, [0.0] * 2], [[0.0] * 4]])
    result = play(env, games=4, record=record)
    assert result.frames.dtype == np.uint8
    assert result.frames.ravel().tolist() == [0, 1, 2, 3, 10, 11, 12][:record]


def test_what_is_recorded_is_a_copy():
    class Reusing(Scripted):
        buffer = np.zeros((1, 1, 1, 1), np.uint8)

        def frames(self):
            self.buffer[:] = super().frames()
            return self.buffer

    result = play(Reusing([[[0.0] * 3]]), games=1, record=10)
    assert result.frames.ravel().tolist() == [0, 1, 2, 3] and result.frames.base is None


def test_what_the_policy_sees():
    # Two steps a game. Stacks begin with the first frame of each game, and steps go on counting.
    seen = []
    env = Scripted([[[0.0] * 2]])
    evaluate(watching(seen), env, games=2, seed=3, epsilon=0.25, stack=3)
    frames, steps, epsilons = zip(*seen, strict=True)
    assert [f[0] for f in frames] == [[0, 0, 0], [0, 0, 1], [10, 10, 10], [10, 10, 11]]
    assert steps == (0, 1, 2, 3) and set(epsilons) == {0.25}
    assert env.seeds[0] == 3 and not any(env.seeds[1:])  # later games go on with the streams it started
    assert all(actions.tolist() == [1] for actions in env.actions)


def test_same_seed_same_games():
    def policy(frames, step, epsilon):
        return ((frames[:, -1].astype(int).sum((1, 2, 3)) + step) % 3).astype(np.int32)

    env = envs.make("CatchDistractor", num_envs=2, seed=0, frame_size=42, sticky_actions=0.0, noop_max=0)
    options = {"games": 3, "epsilon": 0.0, "max_steps": 40, "record": 30}
    first, other, again = (evaluate(policy, env, seed=seed, **options) for seed in (5, 6, 5))
    assert (first.returns, first.lengths) == (again.returns, again.lengths)
    np.testing.assert_array_equal(first.frames, again.frames)
    assert not np.array_equal(first.frames, other.frames)
    env.close()


def test_progress_is_told_after_every_step():
    # Environment 0 plays two games of one step that count, and then others; environment 1 one of three steps.
    told = []
    play(
        Scripted([[[7.0]], [[1.0, 1.0, 1.0]]]), games=3, told=lambda steps, games: told.append((steps, games))
    )
    assert told == [(1, 1), (2, 2), (3, 3)]


class Shown:
    """A progress bar that keeps what it is told."""

    def update(self, done, **fields):
        self.done, self.fields = done, fields


@pytest.mark.parametrize(("games", "left"), [(2, "0:00:50 left"), (4, "0:01:50 left")])
def test_the_time_left_is_bounded_until_games_have_ended(monkeypatch, games, left):
    # Two environments take 50 steps in 10 s; games are cut after 300, and four of them take two rounds.
    clock = iter([100.0, 110.0, 120.0, 130.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    shown = Shown()
    told = telling(shown, games, 2, 300)
    told(50, 0)
    assert shown.done == 0 and shown.fields["env steps"] == "100" and shown.fields["steps/s"] == "10"
    assert shown.fields["at most"] == left
    told(100, 1)
    assert shown.done == 1 and (shown.fields["at most"] is None) == (games == 4)
    told(150, games)
    assert shown.fields["at most"] is None
