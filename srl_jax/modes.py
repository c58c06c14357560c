"""The training modes: which losses run, where the encoder starts, and which train it. Imports no jax.

A mode is a row of `MODES`; the thesis' hypothesis 1 compares them.
"""

from typing import TYPE_CHECKING, NamedTuple

from srl_jax import annealing
from srl_jax.errors import ConfigError

if TYPE_CHECKING:
    from srl_jax.config import Config


ENCODER_OPTIMIZERS = ("separate", "summed", "simultaneous")
"""How two kinds of loss step one encoder: see `srl_jax.update.make_update`."""


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


def two_optimizers(config: "Config") -> bool:
    """Whether the encoder has an Adam of RL's and one of the representation's."""
    mode = MODES[config.mode]
    both = mode.rl_trains_encoder and mode.representation_trains_encoder
    return both and config.encoder_optimizer != "summed"


def second_learning_rate(config: "Config") -> float:
    """`lr_encoder_srl`, or `lr_srl` where that is 0; 0 where the encoder has no second optimizer."""
    return (config.lr_encoder_srl or config.lr_srl) if two_optimizers(config) else 0.0


def encoder_learning_rate(config: "Config") -> float:
    """`lr_encoder`, or its trainer's rate where that is 0; 0 where nobody trains the encoder."""
    mode = MODES[config.mode]
    if config.lr_encoder:
        return config.lr_encoder
    if mode.rl_trains_encoder:
        return config.lr_rl
    return config.lr_srl if mode.representation_trains_encoder else 0.0


def check(config: "Config", *, needs_encoder: bool = False, hint: str = "", complete: bool = True) -> None:
    """Whether the settings fit the mode.

    Args:
        config: the run.
        needs_encoder: the run must start from an encoder even where its mode may start from
            scratch.
        hint: how to make such an encoder; ends the error.
        complete: False asks for no encoder: the settings are only to be looked at.

    Raises:
        ConfigError: they do not; one line that names the flag.
    """
    mode = MODES[config.mode]
    needs_encoder = needs_encoder or mode.encoder_start == "checkpoint"
    if complete and needs_encoder and not config.encoder_from:
        hint = hint or "any run has an encoder, and --mode=pretrain trains nothing else"
        raise ConfigError(f"--encoder_from: --mode={mode.name} needs --encoder_from=PATH; {hint}")
    if config.encoder_from and mode.encoder_start == "scratch":
        others = ", ".join(m.name for m in MODES.values() if m.encoder_start != "scratch")
        raise ConfigError(
            f"--encoder_from={config.encoder_from}: --mode={mode.name} starts from scratch; "
            f"modes that start from an encoder: {others}"
        )
    if config.objectives and not mode.representation:
        others = ", ".join(m.name for m in MODES.values() if m.representation)
        raise ConfigError(
            f"--objective: --mode={mode.name} runs no representation loss (--objective=none drops "
            f"a preset's); modes that do: {others}"
        )
    if mode.representation and not config.objectives:
        raise ConfigError(
            f"--objective: --mode={mode.name} needs at least one, for example "
            "--objective=reconstruction:weight=1"
        )
    if config.srl_every > 1 and not (mode.rl and mode.representation):
        others = ", ".join(m.name for m in MODES.values() if m.rl and m.representation)
        raise ConfigError(
            f"--srl_every={config.srl_every}: --mode={mode.name} does not run both kinds of loss, give 1; "
            f"modes that do: {others}"
        )
    if config.policy_from and mode.rl:
        raise ConfigError(
            f"--policy_from={config.policy_from}: only --mode=pretrain reads it; "
            f"--mode={mode.name} acts with the policy that it learns"
        )
    annealing.check(config, mode)
    if config.augment == "srl" and not mode.representation:
        raise ConfigError(
            f"--augment=srl: --mode={mode.name} runs no representation loss; valid here: none, all"
        )
    if config.lr_encoder_srl and not two_optimizers(config):
        raise ConfigError(
            f"--lr_encoder_srl={config.lr_encoder_srl}: with --mode={mode.name} and "
            f"--encoder_optimizer={config.encoder_optimizer} the encoder has one optimizer, whose rate is "
            "--lr_encoder; give 0"
        )
    if config.lr_encoder and mode.encoder_start == "checkpoint" and not mode.rl_trains_encoder:
        raise ConfigError(
            f"--lr_encoder={config.lr_encoder}: --mode={mode.name} never moves the encoder; give 0"
        )
