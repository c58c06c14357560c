"""The training modes: which losses run, where the encoder starts, and which train it. Imports no jax.

A mode is a row of `MODES`; the thesis' hypothesis 1 compares them.
"""

from typing import TYPE_CHECKING, NamedTuple

from srl_jax import specs

if TYPE_CHECKING:
    from srl_jax.config import Config


ENCODER_OPTIMIZERS = ("separate", "summed", "simultaneous")
"""How two kinds of loss step one encoder: see `srl_jax.learning.update.passes`."""

GATES = {
    "sum": "whatever the mode lets through is added up",
    "rl_stopped": "RL's stops at the latent, which is what --mode=decoupled is",
    "srl_stopped": "the objectives' stops there, so that they only look on",
    "pcgrad": "where the two point apart, each loses its component along the other",
    "orthogonal": "the objectives' loses its component along RL's, which stays as it is",
}
"""How the gradients of RL and of the objectives meet in an encoder that both train."""
PROJECTING = ("pcgrad", "orthogonal")
"""The gates that need both gradients at the same parameters."""


class Mode(NamedTuple):
    """One training mode.

    Attributes:
        name: as written after --mode=.
        rl: whether the RL loss runs.
        representation: whether the representation losses (the objectives) run.
        encoder_start: where the encoder's parameters come from: "scratch", "checkpoint" or
            "either".
        rl_trains_encoder: whether the RL loss sends gradients into the encoder.
        representation_trains_encoder: whether the objectives do.
        help: one line.
    """

    name: str
    rl: bool
    representation: bool
    encoder_start: str
    rl_trains_encoder: bool
    representation_trains_encoder: bool
    help: str


MODES = {
    mode.name: mode
    for mode in (
        Mode("rl_only", True, False, "scratch", True, False, "RL alone"),
        Mode(
            "pretrain", False, True, "either", False, True,
            "representation losses alone, on frames of a random or a trained behaviour policy",
        ),
        Mode(
            "frozen", True, False, "checkpoint", False, False,
            "RL on a pretrained encoder that stays frozen",
        ),
        Mode(
            "finetuned", True, False, "checkpoint", True, False,
            "RL on a pretrained encoder, which RL trains further",
        ),
        Mode(
            "joint", True, True, "either", True, True,
            "both in every update, and both train the encoder",
        ),
        Mode(
            "decoupled", True, True, "either", False, True,
            "both in every update, but RL's gradients stop at the latent",
        ),
    )
}  # fmt: skip


def of(config: "Config") -> Mode:
    """The mode of a run, as `--gate` leaves it."""
    mode = MODES[config.mode]
    return mode._replace(
        rl_trains_encoder=mode.rl_trains_encoder and config.gate != "rl_stopped",
        representation_trains_encoder=mode.representation_trains_encoder and config.gate != "srl_stopped",
    )


def both_train(mode: Mode) -> bool:
    """Whether RL and representation both train the encoder."""
    return mode.rl_trains_encoder and mode.representation_trains_encoder


def two_optimizers(config: "Config") -> bool:
    """Whether the encoder has an Adam of RL's and one of the representation's."""
    return both_train(of(config)) and config.encoder_optimizer != "summed"


def views(config: "Config") -> tuple[str, str]:
    """What RL and the objectives see: --rl_view and --srl_view, or what --augment stands for."""
    rl = config.rl_view or ("shift" if config.augment == "all" else "none")
    return rl, config.srl_view or ("none" if config.augment == "none" else "shift")


def ratios(config: "Config") -> list[str]:
    """The objectives whose weight is a ratio, as they are written."""
    return [text for text in config.objectives if specs.has_ratio(text)]


def second_learning_rate(config: "Config") -> float:
    """`lr_encoder_srl`, or `lr_srl` where that is 0; 0 without a second optimizer, or where ratios rule."""
    ruled = not two_optimizers(config) or ratios(config)
    return 0.0 if ruled else config.lr_encoder_srl or config.lr_srl


def encoder_learning_rate(config: "Config") -> float:
    """`lr_encoder`, or its trainer's rate where that is 0; 0 where nobody trains the encoder."""
    mode = of(config)
    if config.lr_encoder:
        return config.lr_encoder
    if mode.rl_trains_encoder:
        return config.lr_rl
    return config.lr_srl if mode.representation_trains_encoder else 0.0
