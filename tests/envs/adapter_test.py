"""Any gymnasium environment behind the interface that Atari and Catch have, on small ones written here."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary

from srl_jax import envs
from srl_jax.envs import adapter, games, pixels
from srl_jax.errors import ConfigError
from tests.envs.players import MOMENTS, Player, goes_on


class Square(gymnasium.Env):
    """A bright square of 8 pixels goes left or right over a 64 x 64 RGB image of two colours; the right edge
    ends the episode and pays 2. Actions are 5 and 6.
    """

    observation_space = Box(0, 255, (64, 64, 3), np.uint8)
    action_space = Discrete(2, start=5)
    state_names = ("column",)
    render_mode = "rgb_array"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.column, self.closed = int(self.np_random.integers(1, 5)), False
        return self.shown(), self.info()

    def step(self, action):
        assert action in (5, 6)
        self.column = max(0, self.column + (1 if action == 6 else -1))
        over = self.column == 7
        return self.shown(), 2 * over, over, False, self.info()

    def info(self):
        return {"state": [self.column]}

    def image(self):
        image = np.full((64, 64, 3), (100, 0, 40), np.uint8)
        image[24:32, 8 * self.column : 8 * self.column + 8] = (0, 200, 250)
        return image

    def shown(self):
        return self.image()

    def render(self):
        return self.image()[::2, ::2]

    def close(self):
        self.closed = True


class Flaky(Square):
    """Starts where chance wants, whatever the seed."""

    def reset(self, *, seed=None, options=None):
        self.column = int(np.random.default_rng().integers(0, 2**62)) % 5
        return self.image(), self.info()

    def image(self):
        return np.random.default_rng().integers(0, 256, (64, 64, 3)).astype(np.uint8)


def shows(space, shown, **attributes):
    """A Square that shows something else."""
    return type("Other", (Square,), {"observation_space": space, "shown": shown, **attributes})


def other(**attributes):
    """A Square that does something else."""
    return shows(Square.observation_space, Square.image, **attributes)


class Turns(gymnasium.Env):
    """Turned by a number; shows a vector of three, and is over once they add up to 2."""

    observation_space = Box(0, 9, (3,))
    action_space = Box(-1, 1, ())
    state_names = ("sum",)
    total = 0.0

    def reset(self, *, seed=None, options=None):
        self.total = 0.0
        return np.zeros(3, np.float32), {"state": [self.total]}

    def step(self, action):
        self.total += float(action)
        return np.full(3, self.total, np.float32), 0.0, self.total >= 2, False, {"state": [self.total]}


def shown_turns():
    """Turns behind wrappers that make its vector an image, and its action one of three."""
    seen = gymnasium.wrappers.TransformObservation(
        Turns(), lambda x: np.full((4, 4), 10 * x[0], np.uint8), Box(0, 255, (4, 4), np.uint8)
    )
    return gymnasium.wrappers.TransformAction(seen, lambda action: action / 2, Discrete(3))


class Fewer(gymnasium.ActionWrapper):
    """The right one of a Square's two actions."""

    action_space = Discrete(1)

    def action(self, action):
        return (6,)[action]

    def get_action_meanings(self):
        return ["RIGHT"]


def make(kind=Square, frame_size=64, num_envs=2, seed=0, **options):
    return envs.adapted(kind, **options).make(num_envs=num_envs, seed=seed, frame_size=frame_size)


def test_there_must_be_environments():
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        make(num_envs=0)


def test_the_interface():
    env = make(num_envs=3)
    assert env.single_observation_space == Box(0, 255, (64, 64, 3), np.uint8)
    assert env.single_action_space == Discrete(2) and env.action_meanings == ("5", "6")
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(3, int))
    frames, info = env.reset()
    assert env.observation_space.contains(frames) and set(info) == {"life_lost", "state"}
    np.testing.assert_array_equal(frames[0], env._envs[0].image())
    steps = 7 - info["state"][:, 0].astype(int)
    total, ends = np.zeros(3), np.zeros(3, int)
    for step in range(1, 8):
        frames, rewards, terminated, truncated, info = env.step(np.ones(3, np.int32))
        assert rewards.dtype == np.float32 and info["state"].dtype == np.float32
        for flag in (terminated, truncated, info["life_lost"]):
            assert flag.dtype == bool and flag.shape == (3,)
        assert not truncated.any() and not info["life_lost"].any()
        total += rewards
        ends[terminated] = step
        if terminated.any():
            np.testing.assert_array_equal(frames[terminated.argmax(), 24:32, 56:], [[[0, 200, 250]] * 8] * 8)
            with pytest.raises(ResetNeeded):
                env.step(np.ones(3, np.int32))
            kept = frames.copy()
            frames, _ = env.reset(options={"reset_mask": terminated})
            np.testing.assert_array_equal(frames[~terminated], kept[~terminated])
        if (ends > 0).all():
            break
    assert ends.tolist() == steps.tolist() and (total >= 2).all()
    env.close()
    assert all(env.closed for env in env._envs)


def test_an_episode_depends_on_seed_environment_and_its_number_alone():
    def episodes(num_envs, seed, number=6):
        env = make(num_envs=num_envs, seed=seed)
        columns = []
        for _ in range(number):
            columns.append(env.reset()[1]["state"][:, 0])
            env.step(np.zeros(num_envs, int))
        return np.array(columns)

    many = episodes(4, seed=3)
    np.testing.assert_array_equal(episodes(2, seed=3), many[:, :2])
    assert (episodes(4, seed=4) != many).any()
    assert (many[1:] != many[:-1]).any() and (many[:, 1:] != many[:, :-1]).any()
    env = make(num_envs=2, seed=9)
    env.reset()
    np.testing.assert_array_equal(env.reset(seed=3)[1]["state"][:, 0], many[0, :2])


def test_frames_that_are_skipped_and_the_limit_of_steps():
    class Long(Square):
        def step(self, action):
            self.column += 1
            return self.image(), 0.5, self.column >= 8, False, self.info()

    env = make(Long, num_envs=1, frame_skip=3, max_steps=2)
    _, info = env.reset()
    start = int(info["state"][0, 0])
    env._envs[0].column = 1
    _, rewards, terminated, truncated, info = env.step(np.array([0]))
    assert (rewards[0], terminated[0], truncated[0], info["state"][0, 0]) == (1.5, False, False, 4)
    _, rewards, terminated, truncated, _ = env.step(np.array([0]))
    assert (rewards[0], terminated[0], truncated[0]) == (1.5, False, True)
    env.reset()
    env._envs[0].column = 6  # two steps, and it is over
    _, rewards, terminated, truncated, _ = env.step(np.array([0]))
    assert (rewards[0], terminated[0], truncated[0]) == (1.0, True, False)
    assert 1 <= start < 5


@pytest.mark.parametrize(
    ("space", "shown"),
    [
        (Box(0, 255, (64, 64), np.uint8), lambda self: self.image()[..., 1]),
        (Box(0, 255, (64, 64, 1), np.uint8), lambda self: self.image()[..., 1:2]),
        (
            Dict({"image": Box(0, 255, (64, 64), np.uint8), "mission": Discrete(2)}),
            lambda self: {"image": self.image()[..., 1], "mission": 1},
        ),
    ],
)
def test_grey_images_in_all_their_forms(space, shown):
    env = make(shows(space, shown), num_envs=1)
    frames, _ = env.reset()
    np.testing.assert_array_equal(frames.reshape(64, 64), env._envs[0].image()[..., 1])
    assert frames.shape[1:] == env.single_observation_space.shape


def test_what_is_rendered_and_colours_made_grey_and_small():
    env = make(num_envs=1, render=True, frame_size=32)
    frames, info = env.reset()
    np.testing.assert_array_equal(frames[0], env._envs[0].render())
    # 0.299 * 100 + 0.114 * 40 = 34.46; 0.587 * 200 + 0.114 * 250 = 145.9. A pixel of 16 is the mean of 4 x 4.
    env = make(num_envs=1, grey=True, frame_size=16)
    frames, info = env.reset()
    column = int(info["state"][0, 0])
    expected = np.full((16, 16), 34)
    expected[6:8, 2 * column : 2 * column + 2] = 146
    np.testing.assert_array_equal(frames.reshape(16, 16), expected)


def test_pixels_are_means_of_areas():
    row = np.array([[0, 30, 60]], np.uint8)[..., None].repeat(3, 0)
    # Stretches of 1.5 pixels: (0 + 15) / 1.5 and (15 + 60) / 1.5.
    np.testing.assert_array_equal(pixels.resized(row, 2)[..., 0], [[10, 50]] * 2)
    np.testing.assert_array_equal(pixels.resized(row, 6)[..., 0], [[0, 0, 30, 30, 60, 60]] * 6)
    np.testing.assert_array_equal(pixels.resized(row, 3), row)
    # Not square: columns are averaged in pairs, rows in threes.
    tall = np.arange(6 * 4 * 3).reshape(6, 4, 3).astype(np.uint8)
    np.testing.assert_allclose(pixels.averaged(tall, 2), tall.reshape(2, 3, 2, 2, 3).mean((1, 3)))


def test_what_the_wrappers_show_and_take_counts():
    env = make(shown_turns, frame_size=4, num_envs=1)
    assert env.single_action_space == Discrete(3) and env.state_names == ("sum",)
    env.reset()
    frames, _, terminated, _, info = env.step(np.array([2]))
    assert frames.ravel().tolist() == [10] * 16 and info["state"] == [[1]] and not terminated
    assert env.step(np.array([2]))[2]
    env = make(lambda: Fewer(Square()), num_envs=1)
    assert env.single_action_space == Discrete(1) and env.action_meanings == ("RIGHT",)
    before = env.reset()[1]["state"]
    assert env.step(np.array([0]))[4]["state"] == before + 1


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("before", [0, 13])
def test_goes_on_from_a_snapshot(moment, before):
    def make_one():
        return make(num_envs=3, seed=5, grey=True, frame_size=16, max_steps=9)

    player = Player.start(make_one(), before)
    player.moves(before)
    difference, snapshot = goes_on(player, make_one, player.until(moment), 40)
    assert not difference
    assert snapshot["actions"].dtype == np.int32 and snapshot["ended"].any() == (moment == "after an end")


def test_an_environment_that_is_not_deterministic_is_not_resumed():
    env = make(Flaky)
    env.reset()
    env.step(np.zeros(2, int))
    again = make(Flaky)
    with pytest.raises(ValueError) as raised:
        again.restore(env.snapshot())
    assert str(raised.value) == (
        "environments [0, 1] cannot be rebuilt: not the snapshot's frames_sha256; the same seed and actions "
        "did not lead there again, so the environment is not deterministic and a run cannot be resumed"
    )
    with pytest.raises(ResetNeeded):
        again.step(np.zeros(2, int))


def broken(self):
    raise KeyError("a\nb")


ONE = Square()


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (
            shows(Box(-1, 1, (4,)), None),
            "observations are Box(-1.0, 1.0, (4,), float32); they must be images",
        ),
        (shows(Box(0, 255, (3, 64, 64), np.uint8), None), "(3, 64, 64), uint8); they must be images"),
        (shows(Box(0, 1, (64, 64)), None), "float32); they must be images"),
        (
            shows(Dict({"pixels": Box(0, 255, (64, 64), np.uint8)}), None),
            "or a Dict with one of these under",
        ),
        (
            shows(Square.observation_space, None, action_space=MultiBinary(3)),
            "takes actions of MultiBinary(3)",
        ),
        (shows(Square.observation_space, None, __init__=broken), "cannot be made: KeyError: 'a\\nb'"),
        (list, "is no gymnasium.Env: its function makes a list"),
        (lambda: ONE, "gives one environment twice"),
        (other(get_action_meanings=[1, 2]), "its get_action_meanings must be a list of names"),
        (other(state_names="column"), "its state_names must be a list of names"),
        (
            other(step=lambda self, action: (self.image(), 0, False, {})),
            "cannot be reset and stepped: ValueError: not enough values to unpack",
        ),
        (other(reset=lambda self: (self.image(), {})), "unexpected keyword argument 'seed'"),
        (other(info=lambda self: None), "info['state'] must hold the 1 numbers"),
    ],
)
def test_what_cannot_be_played_is_refused_in_one_line(kind, says):
    game = envs.adapted(kind)
    with pytest.raises(ConfigError) as raised:
        game.check()
    assert says in str(raised.value) and "\n" not in str(raised.value)
    envs.adapted(Square).check()


def test_names_are_given_as_a_list_or_by_a_function():
    for names in (["left", "right"], lambda self: ["left", "right"]):
        env = make(other(get_action_meanings=names, state_names=lambda self: ("x",)))
        assert list(env.action_meanings) == ["left", "right"] and env.state_names == ("x",)


def test_what_is_rendered_in_its_own_size_must_be_an_image():
    game = envs.adapted(other(render=lambda self: None), render=True)
    with pytest.raises(ConfigError, match=r"must render images; it gave object \[\]"):
        game.make(num_envs=1, seed=0, frame_size=0)


def test_what_is_shown_must_be_what_was_announced():
    env = make(shows(Square.observation_space, lambda self: self.image()[..., 0]))
    with pytest.raises(ConfigError, match=r"shows uint8 \[64, 64\], but an image of uint8 with 3 channels"):
        env.reset()
    env = make(shows(Square.observation_space, Square.image, info=lambda self: {}))
    with pytest.raises(ConfigError, match=r"info\['state'\] must hold the 1 numbers of its state_names"):
        env.reset()


@pytest.mark.parametrize("reward", [-np.inf, np.nan, 1e39])
def test_a_reward_that_32_bits_cannot_hold_is_refused(reward):
    env = make(
        shows(Square.observation_space, Square.image, step=lambda self, _: (0, reward, False, False, {}))
    )
    env.reset()
    with pytest.raises(ConfigError, match="gives a reward of .*; rewards must be finite in 32 bits"):
        env.step(np.zeros(2, np.int32))


def test_every_environment_is_closed_though_one_raises(capsys):
    def close(self):
        closed.append(self)
        raise RuntimeError("no display")

    closed = []
    make(shows(Square.observation_space, Square.image, close=close)).close()
    assert len(closed) == 2
    assert capsys.readouterr().err.count("an environment was not closed: RuntimeError: no display") == 2


def test_an_environment_by_its_id(tmp_path, monkeypatch):
    (tmp_path / "srl_jax_own.py").write_text(
        "import gymnasium\n"
        "from tests.envs.adapter_test import Square\n"
        "gymnasium.register('SrlJaxSquare-v0', Square, max_episode_steps=3)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("srl_jax_own:SrlJaxSquare-v0,grey=true", num_envs=1, seed=0, frame_size=32, noop_max=3)
    env.reset()
    ends = [env.step(np.array([0]))[3][0] for _ in range(3)]
    assert ends == [False, False, True]  # gymnasium's own limit
    assert "SrlJaxSquare-v0" in gymnasium.registry
    monkeypatch.delitem(gymnasium.registry, "SrlJaxSquare-v0")
    monkeypatch.delitem(sys.modules, "srl_jax_own")
    monkeypatch.setitem(adapter.PACKAGES, "SrlJaxSquare", "srl_jax_own")
    games.game("gymnasium:id=SrlJaxSquare-v0").check()  # the package is known
    for text, says in (
        ("gymnasium:id=Nonesuch-v0", "cannot be made: NameNotFound: Environment `Nonesuch` doesn't exist"),
        (
            "nonesuch_module:A-v0",
            "cannot be made: ModuleNotFoundError: No module named 'nonesuch_module'",
        ),
        ("srl_jax_own:Other-v0", "cannot be made: NameNotFound"),
    ):
        with pytest.raises(ConfigError) as raised:
            games.game(text).check()
        assert str(raised.value).startswith(says) and "\n" not in str(raised.value)
        assert ("--import=PATH/FILE.py" in str(raised.value)) == ("nonesuch_module" in text)
