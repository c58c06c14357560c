"""Named settings for experiments.train: every arm of the thesis, a demonstration, small Catch runs.

A preset is a dict of `srl_jax.config.Config` fields; what it leaves out keeps its default, and
flags given beside it override it. `thesis/joint_256+small` is a preset that the parts behind it change, one
after the other: `PIECES`, `objective/NAME`, or presets. The thesis is Guberina & Desta, 2022; its figures'
arms keep their names here.
"""

import contextlib
import functools
from collections.abc import Callable, Mapping
from typing import Any

from srl_jax import checks, envs
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.learning.modes import GATES, MODES, PROJECTING, both_train
from srl_jax.specs import SpecError, choices_text, join, split

from .protocols import PROTOCOLS, PROTOCOLS_HELP

_RECONSTRUCTION = "reconstruction:weight=1"
_FORWARD = "forward_pixels:weight=1"
_L2 = "latent_l2:weight=1e-6"

# As the authors' code: PyTorch's initialisation, and pixels in 0..255.
_NATURE = "nature:gain=255"

# 50 epochs of 100,000 env steps. Pong is one of the thesis' seven games; --game takes another.
_THESIS = {"game": "Pong", "rl": "rainbow", "steps": 5_000_000, "eval_every": 100_000}
_256 = {**_THESIS, "encoder": "sac_ae:features=256,gain=255"}
# What the authors ran as augmentation shifts the RL batch too. --augment=srl shifts only what the
# representation losses see.
_AUG = {"augment": "all"}
_JOINT = {"mode": "joint", "objectives": (_RECONSTRUCTION, _L2), "decoder_weight_decay": 1e-7}
_JOINT_FORWARD = {**_JOINT, "objectives": (_FORWARD, _L2)}
# 15 epochs. The thesis takes its frames from a trained agent: --policy_from=RUN, with a run of
# thesis/rl_only_nature, say. Without it the policy is random.
_PRETRAIN = {
    **_JOINT,
    "mode": "pretrain",
    "steps": 1_500_000,
    "batch_size": 64,
    "updates_per_step": 0.3,
    "pretrain_epsilon": 0.3,
}

# Catch in one to three minutes on two cores. Exploration, importance weights and learning rates are annealed
# within the run; returns are -1 or 1.
_CATCH = {
    "game": "Catch",
    "rl": "rainbow:v_min=-2,v_max=2,hidden=128",
    "encoder": "tiny",
    "frame_size": 42,
    "lr_rl": 2e-3,
    "lr_srl": 2e-3,
    "lr_final_share": 0.05,
    "steps": 70_000,
    "batch_size": 64,
    "buffer_size": 50_000,
    "slow_update_every": 100,
    "eval_every": 10_000,
    "eps_anneal_steps": 20_000,
    "eps_final": 0.02,
    "beta_anneal_steps": 70_000,
    "eval_games": 200,
    "eval_envs": 100,  # a third of a short run's time went into playing them ten at once
}
# While it is being learnt: what is left to learn after these steps says little about an encoder.
_SHORT = {"steps": 30_000, "eval_every": 3_000, "eval_games": 100}
_SHORT |= {"eps_anneal_steps": 10_000, "beta_anneal_steps": 30_000}

_DEMO = {"steps": 20_000, "eval_every": 10_000, "eval_games": 5}

# Atari 100k: 100,000 decisions with one environment, as published codes have it; docs/atari100k.md has where
# each value comes from, and protocols.py how it is evaluated.
_100K = {
    **PROTOCOLS["dopamine_100k"],
    "mode": "rl_only",
    "game": "Pong",
    "steps": 100_000,
    "num_envs": 1,
    "buffer_size": 100_000,
    "batch_size": 32,
    "updates_per_step": 1,
    "learn_start": 1_600,
    "lr_rl": 1e-4,
    "lr_srl": 1e-4,
    "adam_eps": 1.5e-4,
    "eps_train": 0.0,
    "eps_final": 0.0,
    "eval_every": 10_000,
    "eval_envs": 32,
}
_DER = {
    **_100K,
    "encoder": "der",
    "rl": "rainbow:n_step=20,noisy_std=0.1,hidden=256",
    "max_grad_norm": 10.0,
    "beta_anneal_steps": 100_000,
    "slow_update_every": 2_000,
}
_VIEW = {"rl_view": "shift+intensity@each", "srl_view": "shift+intensity@each"}
_JOINT_100K = {"mode": "joint", "encoder_optimizer": "summed"}
_DOPAMINE = {**_100K, "encoder": "nature:padding=same,init=xavier", "beta": 0.5, "beta_final": 0.5}
_DRQ = {
    **_100K,
    "encoder": _DOPAMINE["encoder"],
    "rl": "drq:shared_hidden=true,init=xavier,slow=none,copies=1,target_copies=1,view=shift+intensity",
    "eps_train": 1.0,
    "eps_final": 0.1,
    "eps_anneal_steps": 6_600,
    "eps_eval": 0.05,
}
_OF_SPR = {**_JOINT_100K, **_VIEW, "updates_per_step": 2, "learn_start": 2_000, "eps_train": 1.0}
_SPR = {
    **_100K,
    **PROTOCOLS["spr_100k"],
    **_OF_SPR,
    "objectives": ("spr:projection=rl,target=stopped,importance=true",),
    "encoder": "nature:end=min_max",
    "rl": "rainbow:n_step=10,noisy_std=0.5,hidden=256,priority=kl,slow=none",
    "eps_anneal_steps": 2_000,
    "beta_anneal_steps": 100_000,
    "max_grad_norm": 10.0,
}
_SPR_JAX = {
    **_DOPAMINE,
    **_OF_SPR,
    "objectives": ("spr:projection=rl,target=stopped,importance=true,init=xavier",),
    "encoder": "nature:padding=same,init=xavier,end=min_max",
    "rl": "rainbow:n_step=10,noisy_std=0.5,shared_hidden=true,slow=none",
    "eps_anneal_steps": 4_000,
}
_SR_SPR = {
    **_SPR_JAX,
    "rl": "rainbow:noisy=false,n_step=10,shared_hidden=true,init=xavier,slow=ema,act_with=slow",
    "objectives": ("spr:projection=rl,tau=0.995,importance=true,init=xavier",),
    "reset": "all",
}

_ATARI100K: dict[str, dict[str, Any]] = {
    "der": _DER,
    "der_dopamine": {
        **_DOPAMINE,
        "rl": "rainbow:n_step=10,noisy_std=0.1,shared_hidden=true",
        "slow_update_every": 2_000,
    },
    "otrainbow": {
        **_DOPAMINE,
        "rl": "rainbow:double=false,dueling=false,noisy=false,n_step=3,init=xavier",
        "updates_per_step": 8,
        "learn_start": 20_000,
        "slow_update_every": 4_000,  # of eight updates an env step
        "lr_rl": 6.25e-5,
        "eps_train": 1.0,
        "eps_final": 0.01,
        "eps_anneal_steps": 70_000,
    },
    "drq": _DRQ,
    "drq_eps": {**_DRQ, "eps_final": 0.01, "eps_eval": 0.001},
    "curl": {**_DER, **_JOINT_100K, "objectives": ("infonce:temperature=10",)},
    "spr": _SPR,
    "spr_resets": {**_SPR_JAX, "reset": "head_last", "reset_every": 20_000, "reset_last": 80_000},
    "sr_spr": {
        **_SR_SPR,
        "updates_per_step": 8,
        "reset_every": 5_000,
        "reset_last": 95_000,
        "shrink": 0.8,
    },
    "bbf": {
        **_SR_SPR,
        "encoder": "impala:width=4,features=0,end=min_max,init=xavier",
        "rl": f"{_SR_SPR['rl']},hidden=2048",
        "n_anneal": "10->3@10000",
        "gamma": 0.997,
        "gamma_anneal": "0.97->0.997@10000",
        "weight_decay": 0.1,
        "reset_every": 20_000,
        "reset_last": 80_000,
        "shrink": 0.5,
    },
    "a_lix": {
        **{name: value for name, value in _DER.items() if name != "slow_update_every"},
        "encoder": "a_lix:lix=1",
        "rl": "rainbow:n_step=3,noisy_std=0.1,hidden=256,slow=none",
        "updates_per_step": 2,
        "adam_eps": 1.5e-5,
    },
    # Its own protocol: sticky actions, lives that do not matter, no no-ops.
    "mrq": {
        **_100K,
        "mode": "decoupled",
        "objectives": (
            "forward_latent:steps=5,target=periodic,every=250",
            "reward:weight=0.1,hidden=512",
            "terminal:weight=0.1,hidden=512,loss=squared",
        ),
        "encoder": "mrq:init=xavier",
        "rl": "dqn:n_step=3,prioritized=true,alpha=0.4",
        "slow_update_every": 250,
        "batch_size": 256,
        "learn_start": 10_000,
        "lr_rl": 3e-4,
        "adam_eps": 1e-8,
        "weight_decay": 1e-4,
        "max_grad_norm": 20.0,
        "beta": 0.0,
        "beta_final": 0.0,
        "rl_view": "shift@each",
        "srl_view": "shift@each",
        "eps_train": 1.0,
        "eps_final": 0.05,
        "eps_anneal_steps": 10_000,
        "sticky_actions": 0.25,
        "life_loss": False,
        "noop_max": 0,
    },
}

_ARMS: dict[str, dict[str, Any]] = {
    # Figure 6.1, what a pretrained encoder can give, and its encoders.
    "rl_only_nature": {**_THESIS, "encoder": _NATURE, "mode": "rl_only"},
    "finetuned_from_rl_nature": {**_THESIS, "encoder": _NATURE, "mode": "finetuned"},
    "finetuned_256_aug": {**_256, **_AUG, "mode": "finetuned"},
    "frozen_256": {**_256, "mode": "frozen"},
    "pretrain_256": {**_256, **_PRETRAIN},
    "pretrain_256_aug": {**_256, **_PRETRAIN, **_AUG},
    # Figure 6.2, the encoder's size under RL alone.
    "rl_only_256": {**_256, "mode": "rl_only"},
    "rl_only_256_aug": {**_256, **_AUG, "mode": "rl_only"},
    # Figure 6.3, joint training.
    "joint_256": {**_256, **_JOINT},
    "joint_50": {**_256, **_JOINT, "encoder": "sac_ae:features=50,gain=255"},
    # Figure 6.4, regularisation.
    "joint_256_l2_aug": {**_256, **_JOINT, **_AUG},
    "joint_256_noreg": {
        **_256,
        **_JOINT,
        "objectives": (_RECONSTRUCTION,),
        "decoder_weight_decay": 0.0,
    },
    # Figure 6.5, forward prediction.
    "joint_forward_256": {**_256, **_JOINT_FORWARD},
    "joint_forward_256_aug": {**_256, **_JOINT_FORWARD, **_AUG},
    # Figure A.1, pretrained and still updated by both losses.
    "joint_from_pretrained_256": {**_256, **_JOINT},
}
"""The arms of the thesis' figures by name, and the runs that make their encoders."""


def _small(values: dict[str, Any]) -> dict[str, Any]:
    """An arm at the size of Catch, for a whole figure in an hour: `tiny` stands for both encoders, without a
    bottleneck for nature, with as many features for the larger one. All start as the textbook's."""
    name, options = split(values["encoder"])
    encoder = "tiny" if name == "tiny" else f"tiny:features={options.get('features', 0)}"
    own = {**_CATCH, **_SHORT, "encoder": encoder}
    if values["mode"] == "pretrain":
        own["steps"] = 3 * own["steps"] // 10  # as 15 epochs to 50
    return {**values, **own}


def _with_options(own: Mapping[str, Mapping[str, str | None]], values: dict[str, Any]) -> dict[str, Any]:
    """Settings whose specifications have these options; None takes one back to its default."""
    changed = {}
    for field, options in own.items():
        name, there = split(values[field])
        changed[field] = join(name, {key: x for key, x in {**there, **options}.items() if x is not None})
    return {**values, **changed}


# A decoder that starts near black is not one of the five, and came with them.
_FIVE_CHOICES = {
    "encoder": {"init": "he", "zero_sum": "true", "gain": "32", "decoder_scale": "0.1"},
    "rl": {"init_std": "1", "priority": "kl"},
}


def _over(own: Mapping[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    return {**values, **own}


def _with_objective(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Settings with one more objective; RL alone becomes joint training."""
    mode = "joint" if values["mode"] == "rl_only" else values["mode"]
    if not MODES[mode].representation:
        raise ConfigError(f"the preset is of --mode={mode}, which runs no representation loss")
    there = values.get("objectives", ())
    if name in (split(text)[0] for text in there):
        raise ConfigError(f"the preset has it; --objective=+{name}:key=value beside it changes its options")
    return {**values, "mode": mode, "objectives": (*there, name)}


def _with_gate(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Settings with a gate, and one Adam of the encoder where it cannot do with two that step in turn."""
    if not both_train(MODES[mode := values["mode"]]):
        joint = "; write objective/NAME before it, for --mode=joint" if mode == "rl_only" else ""
        raise ConfigError(f"in --mode={mode} RL and representation do not both train the encoder{joint}")
    if name in PROJECTING and values.get("encoder_optimizer", Config.encoder_optimizer) == "separate":
        values = {**values, "encoder_optimizer": "summed"}
    return {**values, "gate": name}


def _augmented(values: dict[str, Any]) -> dict[str, Any]:
    """Settings with random shift of all frames, where nothing else says what is seen."""
    row, options = split(values["rl"])
    if "rl_view" in values or "srl_view" in values or "view" in options or row == "drq":
        raise ConfigError("the preset has views of its own, which --augment would not change")
    return {**values, **_AUG}


PIECES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "small": _small,
    "textbook": functools.partial(
        _with_options, {field: dict.fromkeys(options) for field, options in _FIVE_CHOICES.items()}
    ),
    "five_choices": functools.partial(_with_options, _FIVE_CHOICES),
    "aug": _augmented,
    **{f"protocol/{name}": functools.partial(_over, own) for name, own in PROTOCOLS.items()},
    **{f"gate/{name}": functools.partial(_with_gate, name) for name in GATES},
}
"""What may stand behind a preset and a +, beside `objective/NAME`: functions of its settings."""

PIECES_HELP = {
    "small": "at the size of Catch, minutes a run",
    "textbook": "with pixels in [0, 1] and PyTorch's initialisation, as a textbook's Rainbow",
    "five_choices": "with the five choices of results/pong_choices, of Rainbow's and C51's presets",
    "aug": "with random shift of all frames",
    **{f"protocol/{name}": text for name, text in PROTOCOLS_HELP.items()},
    **{f"gate/{name}": f"with --gate={name}: {text}" for name, text in GATES.items()},
}

OBJECTIVE = "objective/"
"""Begins the pieces that add a loss; whether there is one is asked where the registry, and so jax, is."""

PRESETS: dict[str, dict[str, Any]] = {
    **{f"thesis/{name}": values for name, values in _ARMS.items()},
    **{f"small/{name}": _small(values) for name, values in _ARMS.items()},
    **{f"atari100k/{name}": values for name, values in _ATARI100K.items()},
    # What `make train` runs: a look at the whole in about three minutes on two cores.
    "demo": {**_JOINT, "game": "Pong", "rl": "rainbow", "encoder": _NATURE, **_DEMO},
    # One for each mode. With one Adam on the sum of the losses: with two, these settings learn more slowly.
    "catch/rl_only": {**_CATCH, "mode": "rl_only"},
    "catch/pretrain": {**_CATCH, **_JOINT, "mode": "pretrain"},
    "catch/frozen": {**_CATCH, "mode": "frozen"},
    "catch/finetuned": {**_CATCH, "mode": "finetuned"},
    "catch/joint": {**_CATCH, **_JOINT, "encoder_optimizer": "summed"},
    "catch/decoupled": {**_CATCH, **_JOINT, "mode": "decoupled"},
}

_FAMILIES = ("thesis", "small")

ENCODER_PRESETS: dict[str, str] = {
    **{
        f"{family}/{arm}": f"{family}/{source}"
        for family in _FAMILIES
        for arm, source in {
            "finetuned_from_rl_nature": "rl_only_nature",
            "finetuned_256_aug": "pretrain_256_aug",
            "frozen_256": "pretrain_256",
            "joint_from_pretrained_256": "pretrain_256",
        }.items()
    },
    "catch/frozen": "catch/pretrain",
    "catch/finetuned": "catch/pretrain",
}
"""Presets that need --encoder_from, and the preset whose run makes that encoder."""

POLICY_PRESETS: dict[str, str] = {
    f"{family}/{arm}": f"{family}/rl_only_nature"
    for family in _FAMILIES
    for arm in ("pretrain_256", "pretrain_256_aug")
}
"""Presets that the thesis ran on the frames of a trained agent, --policy_from, and the preset of its run."""

_SOLVED = {"Pong": 20.0}
"""Mean evaluation return at which the thesis' runs of a game stop early."""


def _piece(part: str) -> Callable[[dict[str, Any]], dict[str, Any]] | None:
    """What a part behind a preset does to its settings, or None."""
    if part.startswith(OBJECTIVE) and (name := part.removeprefix(OBJECTIVE)).isidentifier():
        return functools.partial(_with_objective, name)
    return PIECES.get(part)


def preset_values(name: str, game: str | None = None) -> dict[str, Any]:
    """The fields that a preset sets.

    Args:
        name: a key of `PRESETS`, or several with + between them; later ones override.
        game: the game, where it is not the preset's own; a thesis run stops early in some games
            only.

    Raises:
        ConfigError: a part is unknown, or cannot change what stands before it; the line begins with the name.
    """
    first, *rest = name.split("+")
    if _piece(first):
        raise ConfigError(f"{name}: {first} changes a preset; write it behind one, thesis/joint_256+{first}")
    if first not in PRESETS:
        raise ConfigError(f"{name}: {choices_text(first, PRESETS)}")
    values = dict(PRESETS[first])
    for part in rest:
        piece = functools.partial(_over, PRESETS[part]) if part in PRESETS else _piece(part)
        if piece is None:
            raise ConfigError(f"{name}: {choices_text(part, [*PIECES, f'{OBJECTIVE}NAME', *PRESETS])}")
        try:
            values = piece(values)
        except ConfigError as error:
            raise ConfigError(f"{name}: {part}: {error}") from None
    with contextlib.suppress(SpecError):  # a game of a plug-in that is not imported yet
        game = envs.canonical(game or values["game"])
    whole = first.startswith("thesis/") and "small" not in rest
    if whole and values["mode"] != "pretrain" and game in _SOLVED:
        values["stop_at_return"] = _SOLVED[game]
    return values


def preset_config(name: str, **fields: Any) -> Config:
    """The configuration of a preset, for `srl_jax.train`: as `srl-jax train --preset=NAME` has it.

    Args:
        name: see `preset_values`.
        fields: of Config, in place of the preset's.

    Raises:
        ConfigError: there is no such preset, or it cannot be run like that, or nothing reads a field.
    """
    values = preset_values(name, fields.get("game"))
    return checks.check(Config(**{**values, **fields}), given=fields)


def source_preset(name: str, table: Mapping[str, str]) -> str:
    """The preset of the run that a preset's needs, changed likewise; "" where it needs none.

    Objectives and gates that pieces add are of the run that needs it alone.

    Args:
        name: see `preset_values`.
        table: `ENCODER_PRESETS` or `POLICY_PRESETS`.
    """
    first, *rest = name.split("+")
    rest = [part for part in rest if not part.startswith((OBJECTIVE, "gate/"))]
    return "+".join((table[first], *rest)) if first in table else ""
