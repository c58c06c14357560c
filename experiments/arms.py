"""The figures that runs are made for: which arms, and what is asked. Imports no jax.

The thesis' six are a table here; a figure of your own is a small JSON file:

    {"name": "sparse", "title": "Representation losses in every fourth update", "arms": [
        {"name": "joint_256", "preset": "thesis/joint_256", "thesis": "6.3/joint_256"},
        {"name": "joint_256_sparse", "preset": "thesis/joint_256", "flags": {"srl_every": 4}}]}

`preset` takes any preset, `flags` any flag of a run beside it, with a list where it may be repeated.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from srl_jax import envs
from srl_jax.config import INFOS
from srl_jax.data import thesis_curve, thesis_curves
from srl_jax.errors import ConfigError
from srl_jax.files.reading import SETTINGS, parse_json, read_bytes
from srl_jax.specs import choices_text, near

from .command_line import paths
from .command_line.flags import MOVED
from .presets import preset_values
from .sweeping.plan import OF_TRAINING, arm_of


class FigureArm(NamedTuple):
    """One line of a figure.

    Attributes:
        name: of the arm, and of the directory of its runs.
        preset: of its runs; empty for the thesis' arm of this name, at a size that fits the game.
        flags: over the preset, as on the command line.
        thesis: FIGURE/ARM, the curve of the thesis that is drawn beside it, where there is one.
    """

    name: str
    preset: str = ""
    flags: Mapping[str, str | tuple[str, ...]] = {}
    thesis: str = ""

    def preset_for(self, game: str) -> str:
        """The preset of its runs on a game: Catch is played by small networks."""
        return self.preset or f"{envs.known(game).presets}/{self.name}"

    def thesis_curve(self, game: str) -> tuple | None:
        """env steps and returns of the thesis' curve, or None."""
        figure, _, arm = self.thesis.partition("/")
        try:
            return thesis_curve(figure, game, arm)
        except ValueError:
            return None


class Figure(NamedTuple):
    """Arms that are compared.

    Attributes:
        name: also of its files.
        title: above it.
        question: what is asked of it, or empty.
        arms: the first one is what the others are compared with.
    """

    name: str
    title: str
    question: str
    arms: tuple[FigureArm, ...]


def _thesis(name: str, title: str, question: str, *others: str) -> Figure:
    arms = ("rl_only_nature", *others)
    return Figure(name, title, question, tuple(FigureArm(arm, thesis=f"{name}/{arm}") for arm in arms))


FIGURES: dict[str, Figure] = {
    figure.name: figure
    for figure in (
        _thesis(
            "6.1",
            "RL on a pretrained encoder",
            "What can an encoder give that was trained before?",
            "finetuned_from_rl_nature",
            "finetuned_256_aug",
            "frozen_256",
        ),
        _thesis(
            "6.2",
            "RL alone, two encoders",
            "Does the larger encoder, with a bottleneck, learn faster or slower under RL alone?",
            "rl_only_256",
            "rl_only_256_aug",
        ),
        _thesis(
            "6.3",
            "Joint training",
            "Does a reconstruction loss beside RL's make learning more sample-efficient (hypothesis 1)?",
            "joint_256",
            "joint_50",
        ),
        _thesis(
            "6.4",
            "Regularisation",
            "Does L2 on the latent help joint training (hypothesis 3)?",
            "joint_256",
            "joint_256_l2_aug",
            "joint_256_noreg",
        ),
        _thesis(
            "6.5",
            "Forward prediction",
            "Does predicting the next observation beat reconstructing this one (hypothesis 2)?",
            "joint_256",
            "joint_forward_256",
            "joint_forward_256_aug",
        ),
        _thesis(
            "A.1",
            "Joint training of a pretrained encoder",
            "Does pretraining help where both losses go on training the encoder?",
            "joint_from_pretrained_256",
        ),
    )
}
"""The thesis' figures; the arms' names are its presets'."""

SCORES = "atari100k"
"""The figure of scores at the end of runs, game by game, beside published ones; --presets are its arms."""


def scores_figure(presets: Sequence[str]) -> Figure:
    """The figure `SCORES` of these presets."""
    arms = tuple(FigureArm(arm_of(preset).name, preset) for preset in presets)
    question = "Do the presets score what was published of them?"
    return Figure(SCORES, "Scores beside the published ones after 100,000 env steps", question, arms)


def figures_named(text: str, presets: Sequence[str] = ()) -> list[Figure]:
    """The figures that --figure=TEXT asks for: "all", names of the thesis' figures with commas, or a file.

    Args:
        text: the flag's.
        presets: the arms of `SCORES`, which is a figure of its own.

    Raises:
        ConfigError: there is none of that name.
    """
    if text == SCORES:
        return [scores_figure(presets)]
    if text == "all":
        return list(FIGURES.values())
    if text.endswith(".json"):
        return [read_figure(paths.given("figure", text))]
    names = text.split(",")
    for name in names:
        if name not in FIGURES:
            raise ConfigError(
                f"--figure={text}: {choices_text(name, FIGURES)}; or all; or {SCORES} alone; or a file that "
                "ends in .json"
            )
    return [FIGURES[name] for name in dict.fromkeys(names)]


def read_figure(path: Path) -> Figure:
    """Reads a figure of your own, see this module's docstring.

    Raises:
        ConfigError: it is not such a file; one line that names what is wrong.
    """

    def refuse(reason: str) -> ConfigError:
        return ConfigError(f"--figure={path}: {reason}")

    def check(values: Any, kinds: Mapping[str, type], needed: tuple[str, ...], what: str) -> dict:
        if not isinstance(values, dict):
            raise refuse(f"{what} is not a JSON object")
        for key, value in values.items():
            if key not in kinds:
                raise refuse(f"{what} has no {key!r}; {choices_text(key, kinds)}")
            if not isinstance(value, kinds[key]):
                raise refuse(f"{key} of {what} is not of type {kinds[key].__name__}")
        for key in needed:
            if not values.get(key):
                raise refuse(f"{what} has no {key!r}")
        return values

    try:
        values = parse_json(read_bytes(path, SETTINGS))
    except OSError as error:
        raise refuse(error.strerror) from None
    except ValueError as error:
        raise refuse(f"not JSON: {error}") from None
    kinds = {"name": str, "title": str, "question": str, "arms": list}
    values = check(values, kinds, ("name", "arms"), "the figure")
    arms = []
    kinds = {"name": str, "preset": str, "flags": dict, "thesis": str}
    for number, arm in enumerate(values["arms"], 1):
        arm = check(arm, kinds, ("name", "preset"), f"arm {number}")
        try:
            preset_values(arm["preset"])
        except ConfigError as error:
            raise refuse(f"arm {number}: no preset {error}") from None
        flags = {
            flag: _flag_text(refuse, number, flag, value) for flag, value in arm.get("flags", {}).items()
        }
        if (curve := arm.get("thesis", "")) and curve not in (known := thesis_curves()):
            raise refuse(f"arm {number}: the thesis has no curve {curve}; {choices_text(curve, known)}")
        arms.append(FigureArm(arm["name"], arm["preset"], flags, curve))
    names = [arm.name for arm in arms]
    for name in (values["name"], *names):
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
            raise refuse(
                f"name {name!r:.120}: up to 100 letters, digits, dots, dashes and underscores make a name"
            )
    if len(set(names)) < len(names):
        raise refuse("two arms have the same name")
    return Figure(
        values["name"], values.get("title", values["name"]), values.get("question", ""), tuple(arms)
    )


def _flag_text(refuse: Any, number: int, flag: str, value: Any) -> str | tuple[str, ...]:
    known: dict[str, type] = {info.flag or name: info.kind for name, info in INFOS.items()}
    known |= dict.fromkeys(OF_TRAINING, str)
    if flag in MOVED:
        raise refuse(f"arm {number}: --{flag} is now {MOVED[flag]}")
    if flag not in known:
        close = near(flag, known)
        meant = f"did you mean {' or '.join(close)}? " if close else ""
        raise refuse(f"arm {number}: no flag {flag!r}; {meant}srl-jax train --help lists them")
    if isinstance(value, list) and all(isinstance(element, str) for element in value):
        if len(value) > 1 and known[flag] is not tuple:
            raise refuse(f"arm {number}: --{flag} is given {len(value)} times; give it once")
        return tuple(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str | int | float):
        return str(value)
    raise refuse(f"flag {flag} of arm {number}: not a text, a number, or a list of texts")
