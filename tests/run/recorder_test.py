"""recorder.py: a run's replay and policy see what its environments gave; a Recorder notices if not."""

import numpy as np
import pytest

from srl_jax.replay import Replay
from tests.run.recorder import Recorder, Watched

N, SIZE, STACK, GAMMA = 3, 18, 4, 0.99


class Game:
    """What a Recorder asks of environments: random frames, and the emulator's counters."""

    num_envs, single_action_space = N, None

    class single_observation_space:
        shape = (SIZE, SIZE, 1)

    def __init__(self):
        self.rng = np.random.default_rng(0)
        self.played = np.zeros(N, np.int32)
        self.phantom = np.zeros(N, bool)  # resets itself in the next step

    def _info(self):
        lives = np.zeros(N, np.int32)
        counters = {"frame_number": self.played.copy(), "episode_frame_number": self.played.copy()}
        return {"life_lost": self.rng.random(N) < 0.1, "lives": lives} | counters

    def _frames(self):
        return self.rng.integers(0, 256, (N, SIZE, SIZE, 1), dtype=np.uint8)

    def reset(self, *, options=None):
        self.played[options["reset_mask"] if options else slice(None)] = 0
        return self._frames(), self._info()

    def step(self, actions):
        self.played = np.where(self.phantom, np.int32(0), self.played + np.int32(4))
        ended = self.rng.random(N) < 0.15
        truncated = ended & (self.rng.random(N) < 0.5)
        rewards = self.rng.normal(size=N).astype(np.float32)
        return self._frames(), rewards, ended & ~truncated, truncated, self._info()


def played(steps=60, slots=30):
    """A record of a game, and a replay that got the same."""
    record = Recorder(Game(), steps)
    replay = Replay(capacity=N * slots, num_streams=N, frame_shape=(SIZE, SIZE, 1), stack=STACK, gamma=GAMMA)
    replay.begin(record.reset()[0])
    rng = np.random.default_rng(1)
    for _ in range(steps):
        actions = rng.integers(0, 5, N)
        frames, rewards, terminated, truncated, info = record.step(actions)
        replay.add(actions, np.sign(rewards), terminated, truncated, info["life_lost"], frames)
        ended = terminated | truncated
        if ended.any():
            frames, _ = record.reset(options={"reset_mask": ended})
            replay.begin(frames[ended], np.flatnonzero(ended))
    return record, replay


def test_a_run_sees_what_its_environments_gave(tmp_path):
    pytest.importorskip("ale_py")
    watched = Watched("Breakout", num_envs=3, slots=30, max_steps=20, reseed_every=100)
    counts = watched.run(tmp_path / "run", steps=200, seed=0)
    assert counts["env steps"] == 600 and counts["episodes cut"] > 10
    assert counts["windows"] > 3000 and counts["transitions seen"] > 590
    assert [counts[name] for name in watched.WRONG] == [0] * 5


def test_a_record_knows_the_windows_of_its_replay():
    record, replay = played()
    indices = replay.sampleable()
    window = replay.gather(indices)
    assert record.right_windows(window, indices, STACK, GAMMA).all()
    assert (window.valid == 0).any() and (window.discounts[window.valid == 1] == 0).any()
    # The window of a neighbour is not: one step later, or of the next environment.
    for shift in (N, -N, 1):
        assert not record.right_windows(window, indices + shift, STACK, GAMMA).any()


@pytest.mark.parametrize("field", ["frames", "actions", "rewards", "discounts", "valid"])
def test_a_record_notices_one_wrong_number(field):
    record, replay = played()
    indices = replay.sampleable()
    window = replay.gather(indices)
    rng = np.random.default_rng(2)
    for row in range(len(indices)):
        array = getattr(window, field).copy()
        # Not of a frame's name: its other pixels count, too.
        at = (rng.integers(array.shape[1]), *(side - 1 for side in array.shape[2:]))
        array[(row, *at)] += 1
        right = record.right_windows(window._replace(**{field: array}), indices, STACK, GAMMA)
        assert np.flatnonzero(~right).tolist() == [row]


def test_a_record_notices_frames_of_another_episode():
    # A stack that goes on over a reset has the right pixels in the wrong place.
    record, replay = played()
    indices = replay.sampleable()
    window = replay.gather(indices)
    positions, streams = np.divmod(indices, N)
    first = (record.names[streams, positions, 2] == 0) & (positions > 0)
    frames = window.frames.copy()
    frames[first, STACK - 2] = record.frames[streams[first], positions[first] - 1]
    right = record.right_windows(window._replace(frames=frames), indices, STACK, GAMMA)
    assert first.any() and (right == ~first).all()


def test_a_record_notices_wrong_stacks():
    record, _ = played()
    now = [[record.frames[i, row] for row in range(record.rows[i] - 4, record.rows[i])] for i in range(N)]
    stacks = np.array(now)
    steps = record.names[np.arange(N), record.rows - 1, 2]
    assert record.right_stacks(stacks).tolist() == (steps >= 3).tolist()
    assert not record.right_stacks(stacks[:, ::-1]).any()


def test_a_record_notices_phantoms_and_early_resets():
    game = Game()
    record = Recorder(game, 10)
    record.reset()
    record.step(np.zeros(N, int))
    assert record.phantoms == 0
    # A step that was a reset in truth, of one environment: seen in both counters.
    game.phantom[1] = True
    record.step(np.zeros(N, int))
    assert record.phantoms == 2
    before = record.wrong_resets
    record._ended = np.array([False, True, False])
    record.reset(options={"reset_mask": np.array([True, True, False])})
    assert record.wrong_resets == before + 1
