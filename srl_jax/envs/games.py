"""The names of the games, and their time. Imports nothing heavy: a command line can be checked at once."""

import re

FRAME_SKIP = 4
"""Emulator frames per env step."""
MAX_FRAMES = 108_000
"""Emulator frames after which an episode is truncated, unless told otherwise: half an hour of play."""

ATARI_57 = tuple(
    """
    Alien Amidar Assault Asterix Asteroids Atlantis BankHeist BattleZone BeamRider Berzerk Bowling
    Boxing Breakout Centipede ChopperCommand CrazyClimber Defender DemonAttack DoubleDunk Enduro
    FishingDerby Freeway Frostbite Gopher Gravitar Hero IceHockey Jamesbond Kangaroo Krull
    KungFuMaster MontezumaRevenge MsPacman NameThisGame Phoenix Pitfall Pong PrivateEye Qbert
    Riverraid RoadRunner Robotank Seaquest Skiing Solaris SpaceInvaders StarGunner Surround Tennis
    TimePilot Tutankham UpNDown Venture VideoPinball WizardOfWor YarsRevenge Zaxxon
    """.split()
)
"""The 57 Atari games of Rainbow (Hessel et al., 2018) and Agent57, as Gymnasium spells them."""

CATCH = ("Catch", "CatchDistractor")
"""The games of `srl_jax.envs.catch`."""

GAMES = (*ATARI_57, *CATCH)
"""Every name that `srl_jax.envs.make` takes."""


def rom_name(game: str) -> str:
    """The name of a game's ROM in ale_py: MsPacman -> ms_pacman, UpNDown -> up_n_down.

    Args:
        game: one of `ATARI_57`.

    Raises:
        ValueError: the game is not one of them.
    """
    if game not in ATARI_57:
        raise ValueError(f"{game!r} is not one of the 57 Atari games: {', '.join(ATARI_57)}")
    return re.sub(r"(?<!^)(?=[A-Z])", "_", game).lower()
