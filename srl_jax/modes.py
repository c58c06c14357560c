"""The training modes: which losses run, where the encoder starts, and which train it. Imports no jax.

A mode is a row of `MODES`; the thesis' hypothesis 1 compares them.
"""

from typing import TYPE_CHECKING, NamedTuple

from srl_jax import annealing, specs
from srl_jax.errors import ConfigError

if TYPE_CHECKING:
    from srl_jax.config import Config


ENCODER_OPTIMIZERS = ("separate", "summed", "simultaneous")
"""How two kinds of loss step one encoder: see `srl_jax.update.passes`."""

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
    for flag, runs in (("rl_view", mode.rl), ("srl_view", mode.representation)):
        if (view := getattr(config, flag)) and not runs:
            raise ConfigError(f"--{flag}={view}: --mode={mode.name} has no loss that sees it; leave it out")
    _check_gate(config, mode)
    _check_ratios(config)
    moves = mode.rl_trains_encoder or mode.representation_trains_encoder
    for flag in ("lr_encoder", "lr_encoder_srl"):
        if (rate := getattr(config, flag)) and not moves:
            raise ConfigError(f"--{flag}={rate}: --mode={mode.name} never moves the encoder; give 0")
    if config.lr_encoder_srl and not two_optimizers(config):
        raise ConfigError(
            f"--lr_encoder_srl={config.lr_encoder_srl}: with --mode={mode.name}, --gate={config.gate} and "
            f"--encoder_optimizer={config.encoder_optimizer} the encoder has one optimizer, whose rate is "
            "--lr_encoder; give 0"
        )


def _check_gate(config: "Config", mode: Mode) -> None:
    if config.gate != "sum" and not both_train(mode):
        raise ConfigError(
            f"--gate={config.gate}: in --mode={mode.name} RL and representation do not both train the "
            "encoder, so that no two gradients meet; give sum, or --mode=joint"
        )
    if config.gate in PROJECTING and config.encoder_optimizer == "separate":
        raise ConfigError(
            f"--gate={config.gate}: with --encoder_optimizer=separate the second gradient is taken after "
            "RL's step, so that the two do not meet; give --encoder_optimizer=summed or simultaneous"
        )


def _check_ratios(config: "Config") -> None:
    if not (found := ratios(config)):
        return
    flag = f"--objective={found[0]}"
    if not both_train(of(config)):
        raise ConfigError(
            f"{flag}: a ratio is to RL's gradient on the encoder, and with --mode={config.mode} and "
            f"--gate={config.gate} RL and representation do not both train it; give a number"
        )
    if not two_optimizers(config):
        return
    if len(found) < len(config.objectives):
        raise ConfigError(
            f"{flag}: with --encoder_optimizer={config.encoder_optimizer} a ratio is of the length of the "
            "second Adam's step, which all objectives share; give all of them ratios, or "
            "--encoder_optimizer=summed"
        )
    if config.lr_encoder_srl:
        raise ConfigError(
            f"--lr_encoder_srl={config.lr_encoder_srl}: {found[0]} says how long the second Adam's step is; "
            "give 0"
        )
