"""Environments: many copies of one game behind one small interface (see `base.FrameVectorEnv`).

Importing this package imports none of gymnasium, ale_py or jax; `make` does.
"""

from srl_jax.envs.games import ATARI_57, CATCH, FRAME_SKIP, GAMES, MAX_FRAMES

__all__ = ["ATARI_57", "CATCH", "FRAME_SKIP", "GAMES", "MAX_FRAMES", "make"]


def make(
    game: str,
    *,
    num_envs: int,
    seed: int,
    frame_size: int = 84,
    sticky_actions: float = 0.0,
    noop_max: int = 30,
    full_action_space: bool = False,
    max_frames: int = MAX_FRAMES,
    reseed_every: int = 5_000,
    num_threads: int = 0,
):
    """Makes `num_envs` copies of a game.

    The options after `frame_size` are Atari's; Catch has nothing that they could change and ignores
    them, so that one configuration serves every game.

    Args:
        game: one of `GAMES`.
        num_envs: how many copies, N.
        seed: the source of all randomness; different seeds share no environment.
        frame_size: height and width of a frame in pixels; for Catch 84 or 42.
        sticky_actions: probability of repeating the last action, per emulator frame.
        noop_max: see `atari.Atari`.
        full_action_space: all of the console's actions instead of those that the game uses.
        max_frames: emulator frames (4 per env step) after which an episode is truncated.
        reseed_every: env steps between two seeded resets of one environment, see `atari.Atari`.
        num_threads: threads that step the emulators; 0 lets ALE choose.

    Returns:
        A `base.FrameVectorEnv`.

    Raises:
        ValueError: unknown game, or an option out of its range.
        ImportError: an Atari game without ale_py.
    """
    if game in CATCH:
        from srl_jax.envs.catch import Catch

        return Catch(num_envs=num_envs, seed=seed, size=frame_size, distractor=game == "CatchDistractor")
    if game in ATARI_57:
        from srl_jax.envs.atari import Atari

        return Atari(
            game,
            num_envs=num_envs,
            seed=seed,
            frame_size=frame_size,
            sticky_actions=sticky_actions,
            noop_max=noop_max,
            full_action_space=full_action_space,
            max_frames=max_frames,
            reseed_every=reseed_every,
            num_threads=num_threads,
        )
    raise ValueError(f"unknown game {game!r}; valid: {', '.join(GAMES)}")
