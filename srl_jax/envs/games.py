"""The registry of games: what the rest of the library has to know of each, and how its environments are made.

Imports nothing heavy, so a command line can be checked at once: a row's factory only notes its options, and
`Game.make` imports what the environments need.
"""

import dataclasses
import functools
import importlib.util
import re
from collections.abc import Callable, Iterable
from typing import Any

from srl_jax import plugins, specs
from srl_jax.errors import ConfigError
from srl_jax.plugins import Registry

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

SUITES = {
    name: tuple(games.split())
    for name, games in {
        "26": """
            Alien Amidar Assault Asterix BankHeist BattleZone Boxing Breakout ChopperCommand CrazyClimber
            DemonAttack Freeway Frostbite Gopher Hero Jamesbond Kangaroo Krull KungFuMaster MsPacman Pong
            PrivateEye Qbert RoadRunner Seaquest UpNDown""",
        "5": "BattleZone DoubleDunk NameThisGame Phoenix Qbert",
        "3": "BattleZone NameThisGame Phoenix",
        "signed": "Boxing Jamesbond Breakout Asterix Gopher Pong",
        "thesis": "Breakout Enduro MsPacman Pong Qbert",
    }.items()
}
"""{what a list of games may say: the Atari games that it stands for}.

26: Atari 100k (Kaiser et al., "Model-based reinforcement learning for Atari", 2020). 5 and 3: Atari-5 and
Atari-3, from which the median over 57 games is predicted (Aitchison et al., 2023); published scores after
100,000 env steps are few for the games that are not of the 26. signed: where BBF's runs with and without SPR
(Schwarzer et al., 2023) say what a self-predictive loss does: helps in Boxing, Jamesbond and Breakout, hurts
in Asterix and Gopher, nothing in Pong; chosen by that outcome. thesis: the games of its curves.
"""

BACKGROUNDS = ("none", "static", "moving", "reward")
"""What `--game=catch:background=` takes, see `srl_jax.envs.catch.Background`."""

NAMES = {
    **{game: f"atari:game={game}" for game in ATARI_57},
    "Catch": "catch",
    "CatchDistractor": "catch:background=moving",
}
"""Games with a name of their own, which config.json and tables of results have."""


@dataclasses.dataclass(frozen=True)
class Game:
    """What a row of the registry makes of its options: a game as an experiment sees it.

    Attributes:
        make: makes the environments, `make(num_envs=, seed=, frame_size=, **options) -> FrameVectorEnv` of
            `srl_jax.envs.base`; imports what they need.
        check: raises ConfigError, a reason that follows `--game=NAME: `, where the environments cannot be
            made here, because something is not installed, say.
        options: the names of the options of `srl_jax.envs.make` that `make` takes beside these three.
        kind: what games have in common that take equally long; empty for the row's name.
        frame_sizes: the values of --frame_size that it knows; empty for any.
        own_size: whether --frame_size=0 leaves frames as large as they are.
        frames_per_step: frames of the emulator in one env step.
        lives: whether a life may be lost before the game is over.
        scores: the raw scores that count as 0 and 1 where games are averaged; None: those of
            `srl_jax.data.reference_scores`, or none.
        presets: the family of presets that the thesis' figures are run with.
    """

    make: Callable[..., Any]
    check: Callable[[], None] = lambda: None
    options: tuple[str, ...] = ()
    kind: str = ""
    frame_sizes: tuple[int, ...] = ()
    own_size: bool = False
    frames_per_step: int = 1
    lives: bool = False
    scores: tuple[float, float] | None = None
    presets: str = "thesis"


def atari(*, game: str = "Pong") -> Game:
    """An Atari 2600 game, see `srl_jax.envs.atari`; `--game=Pong` is short for `--game=atari:game=Pong`.

    Args:
        game: one of `ATARI_57`.
    """
    rom_name(game)

    def make(**options):
        from srl_jax.envs.atari import Atari

        if not options.pop("with_state"):
            return Atari(game, **options)
        from srl_jax.envs.ram import AtariWithState

        return AtariWithState(game, **options)

    def check():
        if importlib.util.find_spec("ale_py") is None:
            raise ConfigError(
                "Atari needs ale-py, pip install 'srl-jax[atari]'; valid without it: Catch, CatchDistractor"
            )

    options = ("sticky_actions", "full_actions", "noop_max", "max_frames", "reseed_every", "with_state")
    return Game(make, check, options, frames_per_step=FRAME_SKIP, lives=True)


def catch(*, ball: int = 3, background: str = "none") -> Game:
    """A ball to be caught, see `srl_jax.envs.catch`; `Catch` and `CatchDistractor` stand for two of them.

    Args:
        ball: height and width of the ball in pixels of a frame of 84 x 84.
        background: one of `BACKGROUNDS`.
    """
    if not 1 <= ball <= 12:
        raise ValueError("ball must be at least 1 and at most 12 (pixels of a frame of 84 x 84)")
    if background not in BACKGROUNDS:
        raise ValueError(f"background={background}: {specs.choices_text(background, BACKGROUNDS)}")

    def make(*, frame_size, **options):
        from srl_jax.envs.catch import Catch

        return Catch(size=frame_size, ball=ball, background=background, **options)

    return Game(make, frame_sizes=(42, 84), scores=(-1.0, 1.0), presets="small")


def gymnasium(
    *, id: str = "", grey: bool = False, render: bool = False, frame_skip: int = 1, max_steps: int = 0
) -> Game:
    """Any gymnasium environment with discrete actions that shows images, see `srl_jax.envs.adapter`.

    Its frames are resized to `--frame_size` squared (0: not), and `--frame_stack` of them are an observation.

    Args:
        id: that gymnasium.make takes; `module:Name-v0` imports the module first.
        grey: reduces colours to their luma.
        render: shows what the environment renders instead of what it observes (MiniGrid observes codes of
            objects, which make a dark image, and renders colours).
        frame_skip: steps of the environment in an env step, with the same action; their rewards are added.
        max_steps: env steps after which an episode is truncated; 0 leaves that to the environment.
    """
    if not re.fullmatch(r"[\w:./-]+", id):
        what = f"id={id!r} is none" if id else "id is missing"
        raise ValueError(f"{what}; write gymnasium:id=MiniGrid-Empty-5x5-v0, say")

    def make_one():
        from srl_jax.envs.adapter import made

        return made(id, render)

    row = adapted(make_one, grey=grey, render=render, frame_skip=frame_skip, max_steps=max_steps)
    return dataclasses.replace(row, kind=f"gymnasium {id}")


def adapted(
    make_one: Callable[[], Any],
    *,
    grey: bool = False,
    render: bool = False,
    frame_skip: int = 1,
    max_steps: int = 0,
) -> Game:
    """The game of a gymnasium environment that is made by a function, for a row of your own.

        def dot(*, speed: int = 1):
            return adapted(lambda: Dot(speed))

        register("dot", dot)  # --game=dot:speed=2

    Args:
        make_one: () -> gymnasium.Env.
        grey, render, frame_skip, max_steps: see `gymnasium`; render wants render_mode "rgb_array" of it.

    Raises:
        ValueError: frame_skip is 0.
    """
    if frame_skip < 1:
        raise ValueError("frame_skip must be at least 1")
    adaption: dict[str, Any] = {
        "grey": grey,
        "render": render,
        "frame_skip": frame_skip,
        "max_steps": max_steps,
    }

    def make(**options):
        from srl_jax.envs.adapter import Adapter

        return Adapter(make_one, **adaption, **options)

    def check():
        from srl_jax.envs.adapter import check

        check(make)

    return Game(make, check, own_size=True, frames_per_step=frame_skip)


REGISTRY = Registry("envs", {"atari": atari, "catch": catch, "gymnasium": gymnasium}, NAMES)
"""`REGISTRY[name](**options) -> Game`; keyword-only parameters are the options of `--game=name:key=value`.

A row's factory is called wherever a game's name is read, so it should import nothing heavy.
"""
register = REGISTRY.register


def parse(text: str, flag: str = "game") -> specs.Spec:
    """Reads the name of a game: one of `NAMES`, `row:key=value,...`, or `module:Name-v0` for gymnasium.

    Args:
        text: what was typed.
        flag: names the flag in errors, without dashes.

    Raises:
        SpecError: there is no such game; one line.
    """
    text = text.strip()
    name, colon, rest = text.partition(":")
    first, comma, options = rest.partition(",")
    if text in NAMES:
        text = NAMES[text]
    elif name not in REGISTRY and first and "=" not in first:
        text = f"gymnasium:id={name}:{first}{comma}{options}"
    elif name not in REGISTRY:
        raise specs.SpecError(
            f"--{flag}={' '.join(text.split())}: {_instead(name, colon)}valid: {_kinds(flag)}"
        )
    return specs.parse(text, REGISTRY, flag)


def _kinds(flag: str) -> str:
    """What games there are, for errors; of --games, which is a list, its suites, too."""
    others = [name for name in REGISTRY if name not in ("atari", "catch", "gymnasium")]
    kinds = (
        "an Atari-57 game (Pong, MsPacman, ...)",
        "Catch",
        "CatchDistractor",
        "catch:ball=2,background=moving",
    )
    suites = [f"or a suite of Atari games ({', '.join(SUITES)})"] if flag == "games" else []
    return ", ".join((*kinds, "gymnasium:id=Name-v0", "module:Name-v0", *others, *suites))


def _instead(name: str, colon: str) -> str:
    """`did you mean X? `, or nothing."""
    stem = re.sub(r"(NoFrameskip|Deterministic)?-v\d+$", "", name.rpartition("/")[2])
    # Of a name and a row that differ in capitals alone, Catch and catch, a row takes options.
    ordered = [*NAMES, *REGISTRY] if colon else [*REGISTRY, *NAMES]
    close = specs.near(stem, {name.lower(): name for name in ordered}.values())
    if not close and stem != name:
        close = [f"gymnasium:id={name}"]
    return f"did you mean {close[0]}? " if close else ""


def game(text: str, flag: str = "game") -> Game:
    """The game of a name, see `parse`.

    Raises:
        SpecError: there is no such game, or its options do not fit together; one line.
    """
    spec = parse(text, flag)
    row = plugins.build(spec, REGISTRY, gives=Game)
    return dataclasses.replace(row, kind=row.kind or spec.name)


def known(text: str) -> Game:
    """What is known here of a game: nothing, if its row is of a plug-in that this process does not import."""
    try:
        return game(text)
    except specs.SpecError:
        return Game(make=game, own_size=True)  # to make it raises the error


def canonical(text: str, flag: str = "game") -> str:
    """The one way to write a game's name that config.json has: with every option, or the game's own name.

    Raises:
        SpecError: see `game`.
    """
    game(text, flag)
    full = parse(text, flag).full
    return _own_names().get(full, full)


@functools.cache
def _own_names() -> dict[str, str]:
    return {specs.parse(text, REGISTRY).full: name for name, text in NAMES.items()}


def several(parts: Iterable[str], flag: str = "games", *, others: bool = False) -> list[str]:
    """The names, as of `canonical`, of a list that was cut at every comma, those between options included.

    Args:
        parts: of the list; a key of `SUITES` stands for its games.
        flag: names the flag in errors, without dashes.
        others: there may be games of plug-ins, whose names, unknown here, stay as they are.

    Raises:
        SpecError: see `game`.
    """
    whole: list[str] = []
    for part in parts:
        if whole and "=" in part.partition(":")[0]:
            whole[-1] += f",{part}"
        else:
            whole += SUITES.get(part.strip(), [part])

    def name(text: str) -> str:
        try:
            return canonical(text, flag)
        except specs.SpecError:
            if others and text.strip().partition(":")[0] not in REGISTRY:
                return text
            raise

    return list(dict.fromkeys(map(name, whole)))


def label(text: str) -> str:
    """A game's name for titles: `canonical` less the options that have their defaults."""
    try:
        name = canonical(text)
    except specs.SpecError:
        return text
    if name in NAMES:
        return name
    spec = parse(name)
    defaults = specs.option_defaults(REGISTRY[spec.name])
    return specs.join(spec.name, {key: x for key, x in spec.options.items() if x != defaults[key]})


def file_name(text: str) -> str:
    """A game's name as that of a directory."""
    return re.sub(r"[^A-Za-z0-9._=-]+", "_", text)


def rom_name(game: str) -> str:
    """The name of a game's ROM in ale_py: MsPacman -> ms_pacman, UpNDown -> up_n_down.

    Args:
        game: one of `ATARI_57`.

    Raises:
        ValueError: the game is not one of them.
    """
    if game not in ATARI_57:
        close = specs.near(game, ATARI_57)
        suggestion = f"; did you mean {close[0]}?" if close else ""
        raise ValueError(f"{game!r} is not one of the 57 Atari games{suggestion}")
    return re.sub(r"(?<!^)(?=[A-Z])", "_", game).lower()
