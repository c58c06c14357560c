"""Catch and CatchDistractor, and with them the interface that Atari shares."""

import hashlib

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srl_jax import encoders, envs
from srl_jax.envs import catch
from srl_jax.envs.games import BACKGROUNDS
from tests.envs.players import same
from tests.helpers import random_params

LEFT, NOOP, RIGHT = range(3)
BOTH = pytest.mark.parametrize("game", ["Catch", "CatchDistractor"])


def follow(state):
    """A player that is told the state: keep the paddle under the ball."""
    gap = state[:, 0] - state[:, 4]
    return np.where(gap > 2, RIGHT, np.where(gap < -2, LEFT, NOOP))


def play(env, policy, episodes):
    """Returns of whole games."""
    _, info = env.reset()
    returns = []
    while len(returns) < episodes:
        _, rewards, ended, _, info = env.step(policy(info["state"]))
        returns += rewards[ended].tolist()
        assert not rewards[~ended].any()
        if ended.any():
            _, info = env.reset(options={"reset_mask": ended})
    return np.array(returns)


def record(env, actions):
    """Everything that a run with these actions returns, as a list of arrays."""
    frames, info = env.reset()
    out = [frames, info["state"]]
    for action in actions:
        frames, rewards, terminated, truncated, info = env.step(action)
        out += [frames, rewards, terminated, truncated, info["state"]]
        if terminated.any():
            frames, info = env.reset(options={"reset_mask": terminated})
            out += [frames, info["state"]]
    return out


def put(env, ball_x, ball_y, drift, fall, paddle):
    """Puts all games into one state."""
    env.reset()
    env._ball_x[:], env._ball_y[:], env._drift[:] = ball_x, ball_y, drift
    env._fall[:], env._paddle[:] = fall, paddle


def test_a_hand_worked_game():
    env = envs.make("Catch", num_envs=1, seed=0)
    # 81 + 3 is 84, 2 beyond the last column for a centre, 82: reflected to 80. Row 65 + 3 * 3 = 74,
    # where the ball lies on the paddle. The paddle goes from 70 to 74, stays, and goes to 77, its
    # last column, not to 78. |74 - 77| <= 7: caught.
    put(env, ball_x=81, ball_y=65, drift=3, fall=3, paddle=70)
    states, rewards, ends = [], [], []
    for action in (RIGHT, NOOP, RIGHT):
        _, reward, terminated, truncated, info = env.step(np.array([action]))
        states.append(info["state"][0].tolist())
        rewards.append(reward[0])
        ends.append(bool(terminated[0]))
        assert not truncated[0]
    assert states == [[80, 68, -3, 3, 74], [77, 71, -3, 3, 74], [74, 74, -3, 3, 77]]
    assert rewards == [0, 0, 1]
    assert ends == [False, False, True]


def test_left_wall_and_paddle_at_the_left():
    env = envs.make("Catch", num_envs=1, seed=0)
    put(env, ball_x=2, ball_y=10, drift=-3, fall=4, paddle=8)
    _, _, _, _, info = env.step(np.array([LEFT]))
    # 2 - 3 = -1, reflected at 1 to 3; the paddle stops at 6.
    assert info["state"][0].tolist() == [3, 14, 3, 4, 6]


@BOTH
def test_a_perfect_player_catches_every_ball(game):
    returns = play(envs.make(game, num_envs=100, seed=0), follow, episodes=1000)
    assert (returns == 1).all()


@pytest.mark.parametrize("size", [42, 84])
@pytest.mark.parametrize("name", encoders.REGISTRY)
def test_every_encoder_sees_the_paddle(name, size):
    # A VALID convolution with a stride may leave out the last rows of an image. The paddle once lay there. In
    # the published network of DER, which leaves out 9 rows of 84, it still does (docs/deviations.md).
    if (name, size) == ("der", 84):
        return
    env = envs.make("Catch", num_envs=1, seed=0, frame_size=size)
    encoder = encoders.REGISTRY[name]((size, size, 4))
    params, apply = random_params(encoder.init), jax.jit(encoder.apply)
    latents = []
    for paddle in (30, 40):
        put(env, ball_x=50, ball_y=20, drift=0, fall=3, paddle=paddle)
        latents.append(apply(params, np.repeat(env._frames(), 4, -1)))
    assert np.abs(latents[0] - latents[1]).max() > 1e-4


@pytest.mark.parametrize("ball", [1, 3, 12])
def test_every_start_can_be_won(ball):
    # All starts at once, without the drawing: fall, steps, column, drift, paddle. The ball lands on row 75.
    before, after = (ball - 1) // 2, ball // 2
    starts = np.array(
        [
            (x, 75 - after - steps * fall, drift, fall, paddle)
            for fall, steps in catch.DROPS
            if 75 - after - steps * fall >= before
            for x in range(before, 84 - after)
            for drift in range(-catch.MAX_DRIFT, catch.MAX_DRIFT + 1)
            for paddle in (24, 42, 59)
        ]
    )
    env = envs.make(f"catch:ball={ball}", num_envs=len(starts), seed=0, frame_size=42)
    env._frames = lambda: None
    put(env, *starts.T)
    caught = np.zeros(len(starts), bool)
    done = np.zeros(len(starts), bool)
    state = starts
    for _ in range(25):
        env._ended[:] = False
        _, rewards, ended, _, info = env.step(follow(state))
        state = info["state"]
        caught |= (rewards > 0) & ~done
        done |= ended
    assert done.all() and caught.all()


def test_a_random_player_misses_most():
    rng = np.random.default_rng(0)
    env = envs.make("Catch", num_envs=100, seed=0)
    returns = play(env, lambda state: rng.integers(0, 3, 100), episodes=1500)
    assert 0.1 < (returns == 1).mean() < 0.3


def test_length_of_an_episode():
    env = envs.make("Catch", num_envs=200, seed=0)
    env._frames = lambda: None  # balls fall on, out of the picture
    env.reset()
    length = np.zeros(200, int)
    done = np.zeros(200, bool)
    for step in range(1, 26):
        env._ended[:] = False
        _, _, ended, _, _ = env.step(np.full(200, NOOP))
        length[ended & ~done] = step
        done |= ended
    assert set(length) == {17, 18, 20, 21, 22, 23, 24}


@BOTH
@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**63 - 1), actions_seed=st.integers(0, 2**32))
def test_same_seed_same_actions_same_run(game, seed, actions_seed):
    actions = np.random.default_rng(actions_seed).integers(0, 3, (40, 3))
    first = record(envs.make(game, num_envs=3, seed=seed), actions)
    assert same(first, record(envs.make(game, num_envs=3, seed=seed), actions))
    # An environment does not depend on how many others there are.
    single = record(envs.make(game, num_envs=1, seed=seed), actions[:, :1])
    assert np.array_equal(single[0][0], first[0][0])


@pytest.mark.parametrize("size", [84, 42])
def test_the_distractor_ignores_actions_and_episodes(size):
    def backgrounds(policy):
        env = envs.make("CatchDistractor", num_envs=3, seed=4, frame_size=size)
        env._draw = lambda *args: None  # nothing in front
        out = [env.reset()[0]]
        for step in range(70):
            frames, _, ended, _, _ = env.step(np.full(3, policy(step)))
            out.append(frames)
            if ended.any():
                frames, _ = env.reset(options={"reset_mask": ended})
                np.testing.assert_array_equal(frames, out[-1])
        return np.array(out)

    first = backgrounds(lambda step: step % 3)
    np.testing.assert_array_equal(first, backgrounds(lambda step: LEFT))
    # It moves at every step, at 42 at least at every second one, in every environment.
    moved = (first[2:] != first[:-2]).any((2, 3, 4))
    assert moved.all()
    # The environments see different stretches of it.
    assert not np.array_equal(first[:, 0], first[:, 1])


@pytest.mark.parametrize("size", [84, 42])
def test_the_distractor_dominates_and_hides_nothing(size):
    options = {"num_envs": 32, "seed": 0, "frame_size": size}
    plain, _ = envs.make("Catch", **options).reset()
    frames, _ = envs.make("CatchDistractor", **options).reset()
    behind = plain == 0
    # Of the squared error of an image that is all grey, the background has several times the ball's part.
    ball = plain[:, : size * 3 // 4].astype(float)
    assert frames[behind].var() * size**2 > 3 * (ball**2).sum((1, 2, 3)).mean() > 0
    assert frames[behind].max() <= 2 * catch.LAYER_BRIGHTNESS < catch.BRIGHTNESS - 50
    # What is covered in full looks the same in both; what is half covered is a blend.
    full = plain == catch.BRIGHTNESS
    assert (frames[full] == catch.BRIGHTNESS).all() and full.any((1, 2, 3)).all()


def test_both_games_drop_the_same_balls():
    actions = np.random.default_rng(1).integers(0, 3, (60, 5))
    runs = []
    for game in ("Catch", "CatchDistractor"):
        out = record(envs.make(game, num_envs=5, seed=9), actions)
        runs.append([x for x in out if x.dtype != np.uint8])
    assert same(*runs)


@pytest.mark.parametrize(
    ("game", "size", "digest"),
    [
        ("Catch", 84, "0eea7902ec36ce16"),
        ("Catch", 42, "39ad75bebd34e476"),
        ("CatchDistractor", 84, "20a75d94ca16c940"),
        ("CatchDistractor", 42, "bb3e19f006b7ab92"),
    ],
)
def test_the_games_with_a_name_are_what_they_were(game, size, digest):
    # As they were when Catch had one ball and two backgrounds (revision 2612025): published runs are of them.
    env = envs.make(game, num_envs=3, seed=7, frame_size=size)
    found = hashlib.sha256()
    frames, info = env.reset()
    arrays = [frames, info["state"]]
    for action in np.random.default_rng(0).integers(0, 3, (100, 3)):
        frames, rewards, terminated, _, info = env.step(action)
        arrays += [frames, rewards, terminated, info["state"]]
        if terminated.any():
            frames, info = env.reset(options={"reset_mask": terminated})
            arrays += [frames, info["state"]]
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    assert found.hexdigest()[:16] == digest


@pytest.mark.parametrize("ball", [1, 2, 3, 12])
def test_the_drawing_is_the_state(ball):
    # As many pixels of full brightness as the ball has, around its state, or half a pixel more to the right
    # and below where its size is even; 3 x 13 of the paddle, in rows 76 to 78; at 42 x 42 the mean of 2 x 2.
    actions = np.random.default_rng(0).integers(0, 3, (40, 8))
    large = record(envs.make(f"catch:ball={ball}", num_envs=8, seed=3), actions)
    frames = np.concatenate([x[..., 0] for x in large if x.ndim == 4]).astype(float)
    states = np.concatenate([x for x in large if x.shape == (8, 5)])
    assert set(np.unique(frames)) == {0, catch.BRIGHTNESS}
    above, paddle = frames[:, :76], frames[:, 76:]
    assert (paddle > 0).sum((1, 2)).tolist() == [39] * len(frames)
    np.testing.assert_allclose(paddle.sum(1) @ np.arange(84) / paddle.sum((1, 2)), states[:, 4])
    assert (above > 0).sum((1, 2)).tolist() == [ball**2] * len(frames)
    index, mass, shift = np.arange(84), above.sum((1, 2)), (ball + 1) % 2 / 2
    np.testing.assert_allclose(above.sum(1) @ index / mass, states[:, 0] + shift)
    np.testing.assert_allclose(above.sum(2) @ index[:76] / mass, states[:, 1] + shift)
    small = record(envs.make(f"catch:ball={ball}", num_envs=8, seed=3, frame_size=42), actions)
    means = [x.reshape(8, 42, 2, 42, 2, 1).mean((2, 4)) if x.ndim == 4 else x for x in large]
    assert same(means, small)


# A paddle at 50 covers columns 44 to 56. A ball of 2 at 43 covers 43 and 44, one of 4 at 42 covers 41 to 44,
# and at 57 it covers 56 to 59.
@pytest.mark.parametrize(
    ("ball", "column", "reward"),
    [(1, 44, 1), (1, 43, -1), (1, 56, 1), (1, 57, -1), (2, 43, 1), (2, 42, -1), (2, 56, 1), (2, 57, -1)]
    + [(3, 43, 1), (3, 42, -1), (3, 57, 1), (3, 58, -1), (4, 42, 1), (4, 41, -1), (4, 57, 1), (4, 58, -1)],
)
def test_a_catch_is_one_shared_column(ball, column, reward):
    env = envs.make(f"catch:ball={ball}", num_envs=1, seed=0)
    put(env, ball_x=column, ball_y=75 - ball // 2 - 4, drift=0, fall=4, paddle=50)
    frames, rewards, terminated, _, _ = env.step(np.array([NOOP]))
    assert rewards[0] == reward and terminated[0]
    assert ((frames[0, 75] > 0) & (frames[0, 76] > 0)).any() == (reward == 1)


def behind(env):
    """The environment, with nothing in front of its background."""
    env._draw = lambda *args: None
    return env


def scrolled(env, action):
    """By how many rows down, and columns to the right, each texture went in one env step: [N, layer, 2]."""
    before = env._background.arrays()["background_offset"].copy()
    env.step(np.full(env.num_envs, action))
    after = env._background.arrays()["background_offset"]
    return (before - after + catch.TORUS // 2) % catch.TORUS - catch.TORUS // 2


@pytest.mark.parametrize("size", [84, 42])
def test_a_static_background_changes_with_episodes_alone(size):
    def pictures(policy):
        env = behind(envs.make("catch:background=static", num_envs=3, seed=4, frame_size=size))
        frames, _ = env.reset()
        found = [[frame] for frame in frames]
        for step in range(60):
            frames, _, ended, _, _ = env.step(np.full(3, policy(step)))
            assert all(np.array_equal(frame, seen[-1]) for frame, seen in zip(frames, found, strict=True))
            if ended.any():
                frames, _ = env.reset(options={"reset_mask": ended})
                for i in np.flatnonzero(ended):
                    found[i].append(frames[i])
        return found

    first, again = pictures(lambda step: step % 3), pictures(lambda step: LEFT)
    assert min(map(len, first)) >= 3
    for seen, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(seen, other)
        assert (np.diff(np.array(seen, int), axis=0) != 0).any((1, 2)).all()
    assert not np.array_equal(first[0], first[1][: len(first[0])])


def test_a_moving_background_says_nothing_of_the_game():
    # The hand-worked state of a sure catch and of a sure miss: the same scrolling.
    found = []
    for paddle in (50, 10):
        env = envs.make("CatchDistractor", num_envs=4, seed=1)
        put(env, ball_x=50, ball_y=40, drift=0, fall=3, paddle=paddle)
        found.append(scrolled(env, NOOP))
    np.testing.assert_array_equal(*found)
    assert (found[0] != 0).all()


@pytest.mark.parametrize("size", [84, 42])
def test_a_background_of_the_reward_scrolls_to_the_right_where_a_paddle_that_stays_catches(size):
    # 50 + 3 * 8 = 74 after 8 steps, at row 74. The paddle catches from 67 to 81; it goes on 4 columns a step.
    env = envs.make("catch:background=reward", num_envs=3, seed=1, frame_size=size)
    for paddle, action, right in ((70, NOOP, True), (66, NOOP, False), (63, RIGHT, True), (70, LEFT, False)):
        put(env, ball_x=50, ball_y=50, drift=3, fall=3, paddle=paddle)
        moved = scrolled(env, action)
        assert (np.sign(moved[..., 1]) == (1 if right else -1)).all()
        assert ((1 <= np.abs(moved)) & (np.abs(moved) <= catch.MAX_SCROLL)).all()
    # With a wall on the way: 80 + 3 * 8 = 104, reflected at 82 to 60.
    put(env, ball_x=80, ball_y=50, drift=3, fall=3, paddle=54)
    assert (scrolled(env, NOOP)[..., 1] > 0).all()
    # In the frames, too: each texture alone is the one of before, moved.
    env = behind(envs.make("catch:background=reward", num_envs=1, seed=1, frame_size=84))
    put(env, ball_x=50, ball_y=50, drift=3, fall=3, paddle=70)
    env._background._layers[1] = np.zeros_like(env._background._layers[1])
    before = env._frames()[0]
    down, right = scrolled(env, NOOP)[0, 0]
    after = env._frames()[0]
    assert right > 0
    np.testing.assert_array_equal(after[10:74, 10:74], before[10 - down : 74 - down, 10 - right : 74 - right])


def test_the_last_scrolling_of_an_episode_is_that_of_its_reward():
    env = envs.make("catch:background=reward", num_envs=50, seed=2)
    env.reset()
    rng, seen = np.random.default_rng(0), []
    for _ in range(60):
        before = env._background.arrays()["background_offset"].copy()
        _, rewards, ended, _, _ = env.step(rng.integers(0, 3, 50))
        moved = before - env._background.arrays()["background_offset"]
        right = np.sign((moved[:, 0, 1] + catch.TORUS // 2) % catch.TORUS - catch.TORUS // 2)
        np.testing.assert_array_equal(right[ended], rewards[ended])
        seen += rewards[ended].tolist()
        if ended.any():
            env.reset(options={"reset_mask": ended})
    assert {-1, 1} == set(seen)


def test_every_background_has_the_same_balls_and_is_dark():
    actions = np.random.default_rng(1).integers(0, 3, (40, 5))
    runs = [
        record(envs.make(f"catch:background={name}", num_envs=5, seed=9), actions) for name in BACKGROUNDS
    ]
    plain = [x for x in runs[0] if x.dtype != np.uint8]
    for run in runs[1:]:
        assert same(plain, [x for x in run if x.dtype != np.uint8])
        for frame, bare in zip(run, runs[0], strict=True):
            if frame.dtype == np.uint8:
                assert (frame[bare > 0] == catch.BRIGHTNESS).all()
                assert frame[bare == 0].max() <= 2 * catch.LAYER_BRIGHTNESS
