"""Any gymnasium environment with discrete actions that shows images, as a `base.FrameVectorEnv`."""

import re
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Space

from srl_jax.envs import pixels
from srl_jax.envs.base import FrameVectorEnv, check_number
from srl_jax.errors import ConfigError
from srl_jax.files import display

PACKAGES = {"MiniGrid": "minigrid", "BabyAI": "minigrid", "MiniWorld": "miniworld", "ALE": "ale_py"}
"""The first word of ids: the package that has to be imported for gymnasium to know them."""
LARGEST = float(np.finfo(np.float32).max)
"""The largest reward, which replay keeps in 32 bits."""


def made(id: str, render: bool) -> gymnasium.Env:
    """An environment by its id; `module:Name-v0` imports the module first, which is known for `PACKAGES`."""
    package = PACKAGES.get(re.split("[-/]", id)[0])
    if package and id not in gymnasium.registry:
        id = f"{package}:{id}"
    mode: dict[str, Any] = {"render_mode": "rgb_array"} if render else {}
    return gymnasium.make(id, disable_env_checker=True, **mode)


class Adapter(FrameVectorEnv):
    """N copies of a gymnasium environment, with the wrappers around it: what they show and take counts.

    One env step is `frame_skip` steps of the environment with the same action, fewer where it ends; their
    rewards are added, and the last image counts. Images are resized to squares by averaging areas; those that
    are not square are squeezed.

    Every reset is seeded: the k-th episode of an environment is a function of the seed, the environment's
    index and k, as far as the environment keeps gymnasium's promise about `reset(seed=)`.

    Snapshots hold the number of the episode, which gives the seed of its reset, and its actions so far;
    `restore` takes the same actions again, which takes as long as they took, and compares the frames. Where
    they differ, it says that the environment is not deterministic: a run cannot be resumed from there. The
    log of an episode that never ends grows without end; `max_steps` ends it.

    `info` holds `life_lost` bool [N], always False. An environment may tell its true state, which probes are
    fitted to: an attribute `state_names`, the names of the V numbers in `info["state"]` of its reset and
    step. `info` here then holds `state` float32 [N, V].
    """

    _restored_by = (
        "; the same seed and actions did not lead there again, so the environment is not deterministic and a "
        "run cannot be resumed"
    )

    def __init__(
        self,
        make_one: Callable[[], gymnasium.Env],
        *,
        num_envs: int,
        seed: int,
        frame_size: int = 84,
        grey: bool = False,
        render: bool = False,
        frame_skip: int = 1,
        max_steps: int = 0,
    ):
        """Makes the environments; for what is not named here see `envs.make` and `games.adapted`.

        Args:
            make_one: () -> one environment.
            frame_size: in pixels; 0 for the environment's own.

        Raises:
            ConfigError: an environment cannot be made, its actions are not discrete, or it shows no images; a
                reason that follows the game's name.
            ValueError: num_envs or seed is out of its range.
        """
        check_number(num_envs)
        try:
            self._envs = [make_one() for _ in range(num_envs)]
        except Exception as error:
            what = _line(error)
            if isinstance(error, ModuleNotFoundError):
                what += " A file is found in the working directory, or by --import=PATH/FILE.py"
            raise ConfigError(f"cannot be made: {what}") from error
        for env in self._envs:
            if not isinstance(env, gymnasium.Env):
                raise ConfigError(f"is no gymnasium.Env: its function makes a {type(env).__name__}")
        if len({id(env) for env in self._envs}) < num_envs:
            raise ConfigError("its function gives one environment twice; it must make another at each call")
        self._grey, self._render, self._skip, self._max_steps = grey, render, frame_skip, max_steps
        first = self._envs[0]
        actions = _actions(first)
        self._colours = 3 if render else _colours(first)
        start = int(actions.start)
        names = _names(first, "get_action_meanings")
        height, width = (frame_size, frame_size) if frame_size else self._own_size()
        super().__init__(
            num_envs=num_envs,
            seed=seed,
            frame_shape=(height, width, 1 if grey else self._colours),
            action_meanings=names if len(names) == actions.n else map(str, range(start, start + actions.n)),
        )
        self._first_action = start
        self.state_names = _names(first, "state_names")
        self._resize = bool(frame_size)
        self._frames = np.zeros((num_envs, *self.single_observation_space.shape), np.uint8)
        self._states = np.zeros((num_envs, len(self.state_names)), np.float32)
        self._episodes = np.zeros(num_envs, np.int64)
        self._actions: list[list[int]] = [[] for _ in range(num_envs)]  # of the episode that goes on

    def _own_size(self) -> tuple[int, int]:
        """Height and width of what the environment shows."""
        env = self._envs[0]
        image: Any = env.observation_space
        if self._render:
            env.reset(seed=0)
            image = np.asarray(env.render())
            if image.ndim not in (2, 3):
                raise ConfigError(f"must render images; it gave {image.dtype} {list(image.shape)}")
        elif isinstance(image, Dict):
            image = image["image"]
        height, width = image.shape[:2]
        return height, width

    def _reset(self, mask, seeded):
        if seeded:
            self._episodes[mask] = 0
        for i in np.flatnonzero(mask):
            self._begin(i)
            self._episodes[i] += 1
        return self._seen(), self._info()

    def _step(self, actions):
        rewards = np.zeros(self.num_envs, np.float32)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        for i, action in enumerate(actions.tolist()):
            rewards[i], terminated[i], truncated[i] = self._move(i, action)
        return self._seen(), rewards, terminated, truncated, self._info()

    def _begin(self, i):
        """Starts the environment's episode of the number that is next."""
        (word,) = self._stream(i, int(self._episodes[i])).generate_state(1)
        observation, info = self._envs[i].reset(seed=int(word) >> 1)
        self._actions[i] = []
        self._look(i, observation, info)

    def _move(self, i, action):
        """One env step of one environment: reward, terminated, truncated."""
        total, terminated, truncated = 0.0, False, False
        for _ in range(self._skip):
            observation, reward, terminated, truncated, info = self._envs[i].step(self._first_action + action)
            total += float(reward)
            if not abs(total) <= LARGEST:
                raise ConfigError(
                    f"the environment gives a reward of {reward}; rewards must be finite in 32 bits"
                )
            if terminated or truncated:
                break
        self._actions[i].append(action)
        self._look(i, observation, info)
        limit = 0 < self._max_steps <= len(self._actions[i])
        return total, bool(terminated), bool((truncated or limit) and not terminated)

    def _look(self, i, observation, info):
        """Keeps what an environment shows, and its state."""
        if self._render:
            image = self._envs[i].render()
        else:
            image = observation["image"] if isinstance(observation, dict) else observation
        image = np.asarray(image)
        colours = image.shape[2] if image.ndim == 3 else 1
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or colours != self._colours:
            raise ConfigError(
                f"the environment shows {image.dtype} {list(image.shape)}, but an image of uint8 with "
                f"{self._colours} channels was announced"
            )
        image = image.reshape(*image.shape[:2], colours)
        if self._grey and colours == 3:
            image = pixels.grey(image)
        if self._resize:
            image = pixels.resized(image, self._frames.shape[1])
        elif image.shape != self._frames[i].shape:
            raise ConfigError(
                f"the environment shows images of {list(image.shape)} and of {list(self._frames[i].shape)}; "
                "--frame_size=84, say, makes them equal"
            )
        self._frames[i] = image
        if self.state_names:
            state = np.asarray((info or {}).get("state", ()), np.float32)
            if state.shape != self._states[i].shape:
                raise ConfigError(
                    f"the environment's info['state'] must hold the {len(self.state_names)} numbers of its "
                    f"state_names, got {list(state.shape)}"
                )
            self._states[i] = state

    def _info(self):
        info = {"life_lost": np.zeros(self.num_envs, bool)}
        return info | ({"state": self._states.copy()} if self.state_names else {})

    def _seen(self):
        return self._frames.copy()

    def _snapshot(self):
        return {
            "episodes": self._episodes.copy(),
            "actions": np.array(sum(self._actions, []), np.int32),
            "action_counts": np.array([len(actions) for actions in self._actions], np.int64),
        }

    def _restore(self, arrays):
        self._episodes = arrays["episodes"] - 1
        ended = np.zeros(self.num_envs, bool)
        logs = np.split(arrays["actions"], np.cumsum(arrays["action_counts"])[:-1])
        for i, log in enumerate(logs):
            self._begin(i)
            for action in log.tolist():
                if not ended[i]:
                    _, terminated, truncated = self._move(i, action)
                    ended[i] = terminated or truncated
        self._episodes = arrays["episodes"].copy()
        return {"ended": ended}

    def close_extras(self, **kwargs):
        """Closes the environments; what one of them raises is said, and ends nothing."""
        for env in self._envs:
            try:
                env.close()
            except Exception as error:
                display.say(f"an environment was not closed: {_line(error)}")


def check(make: Callable[..., FrameVectorEnv]) -> None:
    """Makes two environments and takes a step in each.

    Raises:
        ConfigError: they cannot be made, reset or stepped; a reason that follows the game's name.
    """
    envs = make(num_envs=2, seed=0, frame_size=1)
    try:
        envs.reset(seed=0)
        envs.step(np.zeros(2, np.int64))
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(f"cannot be reset and stepped: {_line(error)}") from error
    finally:
        envs.close()


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _names(env: gymnasium.Env, name: str) -> tuple[str, ...]:
    """A list of names, or what a function gives, of the outermost wrapper that has it; () of none."""
    found = env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else ()
    found = found() if callable(found) else found
    if not isinstance(found, list | tuple) or not all(isinstance(each, str) for each in found):
        raise ConfigError(f"its {name} must be a list of names")
    return tuple(found)


def _actions(env: gymnasium.Env) -> Discrete:
    if not isinstance(env.action_space, Discrete):
        raise ConfigError(f"takes actions of {_text(env.action_space)}; they must be Discrete(n)")
    return env.action_space


def _colours(env: gymnasium.Env) -> int:
    """How many channels its images have: 1 or 3."""
    space: Any = env.observation_space
    image = space.spaces.get("image") if isinstance(space, Dict) else space
    shape = image.shape if isinstance(image, Box) and image.dtype == np.uint8 else ()
    if len(shape) not in (2, 3) or shape[2:] not in ((), (1,), (3,)):
        raise ConfigError(
            f"observations are {_text(space)}; they must be images, uint8 [H, W], [H, W, 1] or [H, W, 3], or "
            "a Dict with one of these under 'image'; gymnasium:...,render=true takes what it renders instead"
        )
    return (*shape, 1)[2]


def _text(space: Space) -> str:
    return " ".join(str(space).split())
