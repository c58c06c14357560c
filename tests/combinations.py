"""Random runs from the registries: what can be combined is trained and resumed, what cannot is refused."""

import inspect
import random
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from srl_jax import checks, encoders, objectives, rl, specs, train
from srl_jax.config import Config
from srl_jax.encoders.options import ENDS, POOLS
from srl_jax.envs.games import BACKGROUNDS
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.rundir import run_directory
from srl_jax.layers import INITIALISERS
from srl_jax.learning import modes
from srl_jax.run import loop
from srl_jax.training import completed
from tests.helpers import stop_after, write_checkpoint
from tests.soak.conftest import different, remains, rows_of

SMALL = {
    "frame_size": 42, "num_envs": 4, "buffer_size": 400, "batch_size": 4, "learn_start": 56,
    "updates_per_step": 0.25, "steps": 96, "log_every": 24, "eval_every": 48, "eval_games": 1,
    "eval_max_steps": 20, "slow_update_every": 3, "keep_replay": True,
}  # fmt: skip
"""Ten updates, from env step 60 on, on frames that Catch has at the least."""

GAMES = (
    "Catch", "CatchDistractor", *(f"catch:ball=2,background={kind}" for kind in BACKGROUNDS),
    "examples.own_environment:Dot-v0", "examples.own_environment:Dot-v0,grey=true,frame_skip=2", "Pong",
)  # fmt: skip

VIEWS = (
    "none",
    "shift",
    "intensity",
    "crop_pad_crop",
    "shift+intensity",
    "shift@each",
    "intensity@each",
    "crop_pad_crop@each",
)
WEIGHTS = ("0.5", "0", "1->0.01@80", "ratio:0.1", "ratio:0.1->0.01@80")

ALWAYS = {"hidden": 16, "atoms": 11, "outputs": 16, "quantiles": 8, "target_quantiles": 6}
ALWAYS |= {"act_quantiles": 4, "cosines": 8, "v_min": -2.0, "v_max": 2.0}
"""Options that keep networks small, wherever a row has them."""

OPTIONS = {
    # RL
    "n_step": (1, 2, 3), "noisy_std": (0.5,), "alpha": (1.0, 0.0), "init_std": (1.0, 0.1),
    "priority": ("cross_entropy", "kl", "batch_mean"), "munchausen_alpha": (0.5,), "munchausen_tau": (0.3,),
    "munchausen_clip": (-2.0,), "copies": (1, 2), "target_copies": (1, 2), "slow": rl.SLOW,
    "slow_tau": (0.5,), "act_with": rl.ACTORS, "rl target": tuple(rl.N_STEP_VIEWS),
    # Encoders
    "features": (0, 16, 20), "padding": ("valid", "same"), "width": (1,), "init": tuple(INITIALISERS),
    "gain": (4.0,), "decoder_scale": (0.1,), "end": ("default", *ENDS), "pool": POOLS, "lix": (1.0,),
    "lix_goal": (0.0, 0.5),
    # Objectives
    "weight": WEIGHTS, "moving": (5.0,), "noise": (0.1,), "masked": (0.3,), "patch": (6,),
    "gradient_penalty": (0.1,), "steps": (1, 2, 5), "action": ("joined", "multiplied"), "beta": (0.1,),
    "distance": ("squared", "cosine"), "tau": (0.0, 0.5), "view": VIEWS, "invariance": (1.0,),
    "variance": (1.0,), "covariance": (25.0,), "redundancy": (0.1,), "temporal": (0, 1, 3),
    "similarity": ("bilinear", "cosine"), "temperature": (0.1,), "variability": (0.0,), "discount": (0.5,),
    "norm": ("half_squared", "l2"), "forward_pixels target": ("observation", "difference"),
    "forward_latent target": ("slow", "periodic", "stopped", "gradient"), "spr target": ("slow", "stopped"),
    "every": (2, 3), "projection": ("own", "rl"),
    "latent_l2 target": ("zero", "slow"), "reward loss": ("two_hot", "squared"),
    "terminal loss": ("cross_entropy", "squared"),
}  # fmt: skip
"""{option, behind its row or registry where it means several things: what is drawn}."""

SETTINGS = {
    "encoder_optimizer": modes.ENCODER_OPTIMIZERS, "target_encoder": ("slow", "online"), "srl_every": (1, 2),
    "augment": ("none", "srl", "all"), "rl_view": VIEWS, "srl_view": VIEWS, "target_view": VIEWS,
    "reset": ("head", "head_last", "all"), "reset_last": (80,), "shrink": (0.8,), "lr_encoder": (1e-3,),
    "lr_encoder_srl": (1e-3,), "lr_final_share": (0.1,), "decoder_weight_decay": (1e-3,),
    "weight_decay": (0.1,), "max_grad_norm": (0.5, 10.0), "gamma_anneal": ("0.9->0.99@4",),
    "updates_per_step": (0.5,), "num_envs": (1,), "frame_stack": (1, 2), "diagnostics": (True,),
    "keep_encoder_every": (1,),
}  # fmt: skip
"""{field of Config: what is drawn, one time in ten}."""

NEEDED = {
    "munchausen": {"double": False}, "init_std": {"init_std": 1.0},
    **{f"target={name}": {"n_step": 2} for name in list(rl.N_STEP_VIEWS)[1:]},
}  # fmt: skip
"""{an option, or one of its values: what it needs beside it}; refused without."""


class Draw(NamedTuple):
    """A run.

    Attributes:
        name: its number.
        values: fields of its Config.
        source: whether it starts from an encoder.
    """

    name: str
    values: dict
    source: bool


def options_of(factory) -> dict:
    """{option: default} of a row."""
    parameters = inspect.signature(factory).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


def values_of(registry: str, row: str, option: str, default) -> tuple:
    """What an option may be."""
    for name in (f"{row} {option}", f"{registry} {option}", option):
        if name in OPTIONS:
            return OPTIONS[name]
    if option in ALWAYS:
        return ()
    if isinstance(default, bool):
        return (not default,)
    raise KeyError(f"{registry}: {row} has an option {option}, of which nothing is drawn")


def draw_spec(rng: random.Random, registry: str, row: str, factory, share: float) -> str:
    """A row with some of its options."""
    given = {}
    for option, default in options_of(factory).items():
        values = values_of(registry, row, option, default)
        if option in ALWAYS and isinstance(default, type(ALWAYS[option])):
            given[option] = ALWAYS[option]
        elif values and rng.random() < share:
            given[option] = rng.choice(values)
    for what, needed in NEEDED.items():
        option, equals, value = what.partition("=")
        if option in given and str(given[option]) == (value or str(given[option])) and rng.random() < 0.8:
            given |= needed
    return specs.join(row, given)


def with_ratio(text: str) -> str:
    """An objective with a ratio for a weight."""
    name, options = specs.split(text)
    return specs.join(name, options | {"weight": "ratio:0.1"})


def draw(number: int, encoder: str = "") -> Draw:
    """The number-th run: a mode, rows of all registries with options, and settings.

    Args:
        number: names the draw, which is the same every time.
        encoder: a row, in place of a drawn one.
    """
    rng = random.Random(f"combination {number}")
    mode = modes.MODES[rng.choice([*modes.MODES, "joint", "joint", "decoupled"])]
    values = {"mode": mode.name, "game": rng.choice(GAMES), "seed": rng.randrange(100)}
    for field, choices in SETTINGS.items():
        if rng.random() < 1 / 10:
            values[field] = rng.choice(choices)
    if rng.random() < (0.7 if mode.name == "joint" else 0.04):
        values["gate"] = rng.choice([*modes.GATES])
    # What has to be said of both is left out now and then, and is then refused.
    if "reset" in values and rng.random() < 0.9:
        values["reset_every"] = rng.choice((64, 76, 20))
    if values.get("gate") in modes.PROJECTING and rng.random() < 0.7:
        values["encoder_optimizer"] = rng.choice(("summed", "simultaneous"))
    row = rng.choice([*rl.REGISTRY])
    values["rl"] = draw_spec(rng, "rl", row, rl.REGISTRY[row], 0.12)
    if rng.random() < 0.15:
        n = specs.parse(values["rl"], rl.REGISTRY).resolved["n_step"]
        values["n_anneal"] = f"{n}->1@4"
    row = encoder or rng.choice([*encoders.REGISTRY, "tiny", "der"])
    values["encoder"] = draw_spec(rng, "encoder", row, encoders.REGISTRY[row], 0.2)
    if mode.representation or rng.random() < 0.05:
        names = rng.sample([*objectives.REGISTRY], rng.choice((1, 1, 2, 3)))
        values["objectives"] = tuple(
            draw_spec(rng, "objective", name, objectives.REGISTRY[name], 0.25) for name in names
        )
        if mode.name == "joint" and random.Random(f"ratios {number}").random() < 0.2:
            # With two Adams a ratio needs all the others, which chance alone rarely gives.
            values["objectives"] = tuple(with_ratio(text) for text in values["objectives"])
        ratios = [specs.has_ratio(text) for text in values["objectives"]]
        meet = mode.name == "joint" and (values.get("encoder_optimizer") == "summed" or all(ratios))
        if any(ratios) and not meet and rng.random() < 0.8:
            values["objectives"] = tuple(text.replace("ratio:", "") for text in values["objectives"])
    source = rng.random() < {"checkpoint": 0.9, "either": 0.2, "scratch": 0.03}[mode.encoder_start]
    return Draw(f"{number:03}", values, source)


def config_of(drawn: Draw, folder: Path) -> Config:
    """The Config of a draw; its source is written where it has one.

    Raises:
        ConfigError: it is no valid one.
    """
    values = SMALL | {"diagnostics": False} | drawn.values
    if not drawn.source:
        return in_force(values)
    alike = {name: values[name] for name in ("encoder", "frame_stack", "game") if name in values}
    alike["encoder"] = specs.parse(alike["encoder"], encoders.REGISTRY, "encoder").full
    colours = "own_environment" in values["game"] and "grey" not in values["game"]
    write_checkpoint(folder / "source", only=["encoder"], channels=3 if colours else 1, **alike)
    return in_force({**values, "encoder_from": str(folder / "source")})


def in_force(values: dict) -> Config:
    """A Config, with defaults for what was drawn and nothing reads; tests/needs_test.py has the refusals."""
    return completed(checks.check(Config(**values), given=()))


def sentence(error: ConfigError) -> str:
    """An error less what was drawn: specifications, paths and numbers are left out, so that like ones count
    as one.
    """
    text = re.sub(r"=\S*[:/]\S*(?=[:;,] )", "=…", str(error))
    return re.sub(r"=\d[\d.e@>-]*", "=N", text)


def not_finite(run: Path) -> list[str]:
    """A run's numbers that are none, but for means of no games and the direction of no gradient."""
    found = []
    for row in rows_of(run):
        for name, x in row.items():
            of_games = "return" in name or "length" in name  # none may have ended
            no_gradient = name.endswith("/cosine") and row.get(name.replace("cosine", "norm_ratio")) == 0
            if (x is None and not (of_games or no_gradient)) or (isinstance(x, float) and not np.isfinite(x)):
                found.append(f"{name} at {row['env_steps']}")
    return found


def run(drawn: Draw, folder: Path) -> str:
    """Trains a draw, and again with a stop in the middle; asserts that nothing differs.

    Returns:
        The sentence that it was refused with; empty where it ran.
    """
    whole, resumed = folder / "whole", folder / "resumed"
    try:
        config = config_of(drawn, folder)
        result = train(config, whole, progress=False)
    except ConfigError as error:
        assert not whole.exists(), f"refused, and {whole} was written: {error}"
        assert "\n" not in str(error), str(error)
        return sentence(error)
    assert result.updates >= 9 and result.env_steps == config.steps
    wrong = not_finite(whole)
    assert not wrong, wrong
    full = Config.load(whole)
    # Among the updates, the first of which is at env step 60 of 96.
    with run_directory(resumed, full), stop_after(random.Random(drawn.name).randrange(64, 92)) as stop:
        stopped = loop.train(full, resumed, progress=False, stop=stop)
    assert stopped.interrupted
    manifest = checkpoint.read_manifest(resumed)
    checkpoint.verify(manifest)
    loop.train(full, resumed, progress=False, resume=manifest)
    differs = different(remains(resumed), remains(whole))
    assert not differs, differs
    return ""
