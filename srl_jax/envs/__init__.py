"""Environments: many copies of one game behind one small interface (see `base.FrameVectorEnv`).

`REGISTRY[name](**options) -> Game`, a row for each kind of game; `register` adds one. Importing this package
imports none of gymnasium, ale_py, numpy or jax; `make` does.
"""

from srl_jax.envs.games import (
    ATARI_57,
    FRAME_SKIP,
    MAX_FRAMES,
    NAMES,
    REGISTRY,
    SUITES,
    Game,
    adapted,
    canonical,
    file_name,
    game,
    known,
    label,
    register,
    several,
)
from srl_jax.envs.games import game as _game
from srl_jax.errors import ConfigError

__all__ = [
    "ATARI_57", "FRAME_SKIP", "MAX_FRAMES", "NAMES", "REGISTRY", "SUITES", "Game", "adapted",
    "canonical", "file_name", "game", "known", "label", "make", "register", "several",
]  # fmt: skip


def make(
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
    with_state: bool = False,
):
    """Makes `num_envs` copies of a game.

    The options after `frame_size` are Atari's; other games have nothing that they could change and ignore
    them (`Game.options` says which a game takes), so that one configuration serves every game.

    Args:
        game: see `games.parse`.
        num_envs: how many copies, N.
        seed: the source of all randomness; different seeds share no environment.
        frame_size: height and width of a frame in pixels; for Catch 84 or 42.
        sticky_actions: probability of repeating the last action, per emulator frame.
        full_actions, noop_max: see `atari.Atari`.
        max_frames: emulator frames (4 per env step) after which an episode is truncated.
        reseed_every: env steps between two seeded resets of one environment, see `atari.Atari`.
        with_state: `info["state"]` also where it takes time to know it: see `ram.AtariWithState`.

    Returns:
        A `base.FrameVectorEnv`.

    Raises:
        ConfigError: unknown game, or one that cannot be made, or whose frames nobody here can use.
        ValueError: an option out of its range.
        ImportError: an Atari game without ale_py.
    """
    given = {
        "sticky_actions": sticky_actions,
        "full_actions": full_actions,
        "noop_max": noop_max,
        "max_frames": max_frames,
        "reseed_every": reseed_every,
        "with_state": with_state,
    }
    row = _game(game)
    known = {name: value for name, value in given.items() if name in row.options}
    try:
        return row.make(num_envs=num_envs, seed=seed, frame_size=frame_size, **known)
    except ConfigError as error:
        raise ConfigError(f"--game={game}: {error}") from error
