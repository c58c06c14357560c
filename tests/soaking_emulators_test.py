"""The soak parts about emulators: they pass in short, and each notices what it is there for."""

import numpy as np
import pytest

from experiments.soaking import snapshots
from srl_jax import envs
from srl_jax.replay import Replay

pytest.importorskip("ale_py")

from experiments.soaking import emulators  # noqa: E402

N, SIZE, STACK, GAMMA = 3, 18, 4, 0.99


def failed(counts):
    return [count.failed for count in counts]


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
    record = emulators.Recorder(Game(), steps)
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


def test_against_gymnasium(monkeypatch):
    pytest.importorskip("cv2")
    assert failed(emulators.against_gymnasium(True, lambda line: None)) == [0, 0]
    # The rules are needed: without the no-ops that they predict, every frame is another one.
    monkeypatch.setattr(emulators, "THREE_GAMES", ("Freeway",))
    monkeypatch.setattr(emulators, "TWISTER", lambda seed: np.random.RandomState(seed + 1))
    frames, numbers = emulators.against_gymnasium(True, lambda line: None)
    assert frames.failed > frames.number / 2 and numbers.failed > numbers.number / 2


def test_through_the_loop(tmp_path):
    said = []
    counts = emulators.through_the_loop(True, tmp_path, said.append)
    assert failed(counts) == [0] * 5
    assert [count.number for count in counts[:2]] == [1800, 1800]
    assert all(count.number > 1000 for count in counts)
    assert "1,800/1,800 env steps" in said[-1]


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
    record = emulators.Recorder(game, 10)
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


def test_out_of_snapshots():
    assert failed(snapshots.out_of_snapshots(True, lambda line: None)) == [0]


def test_two_environments_that_differ_are_noticed():
    def make(seed=0):
        return envs.make("Catch", num_envs=2, seed=seed, frame_size=42)

    class Forgets(type(make())):
        def _restore(self, arrays):
            return super()._restore(arrays | {"episodes": arrays["episodes"] + 1})

    player = snapshots.Player.start(make(), 0)
    forgets = lambda: Forgets(num_envs=2, seed=0, size=42)  # noqa: E731
    difference, _ = snapshots.goes_on(player, forgets, player.until("after a step"), 40)
    assert difference == "a second snapshot differs"
