"""What of a configuration is read, and what fits together. Imports no jax."""

import dataclasses
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

from srl_jax import specs
from srl_jax.errors import ConfigError
from srl_jax.learning import annealing, modes
from srl_jax.learning.modes import MODES, PROJECTING, Mode, both_train, of, ratios, two_optimizers
from srl_jax.needs import EVERYTHING, UNKNOWN, Run
from srl_jax.replay import least_capacity

if TYPE_CHECKING:
    from srl_jax.config import Config


def _of_mode(holds: Callable[[Mode], Any], why: str, *, such: bool = False) -> Callable[[Run], str]:
    """A fact of a run's mode: "" where it holds, else why it does not, with `such` modes in which it does."""
    names = (
        f" (modes that do: {', '.join(mode.name for mode in MODES.values() if holds(mode))})" if such else ""
    )

    def fact(run: Run) -> str:
        mode = MODES[run.config.mode]
        return "" if holds(mode) else f"in --mode={mode.name}, {why}{names}"

    return fact


_trains_rl = _of_mode(lambda mode: mode.rl, "which trains no RL")
_acts_at_random = _of_mode(lambda mode: not mode.rl, "which acts with the policy that it learns")
_trains_objectives = _of_mode(
    lambda mode: mode.representation, "which runs no representation loss", such=True
)
_moves_encoder = _of_mode(
    lambda mode: mode.rl_trains_encoder or mode.representation_trains_encoder, "which never moves the encoder"
)
_could_share = _of_mode(both_train, "where RL and representation do not both train the encoder", such=True)


def _shares(run: Run) -> str:
    if why := _could_share(run):
        return why
    gate = f"with --gate={run.config.gate}, where RL and representation do not both train the encoder"
    return "" if both_train(of(run.config)) else gate


def _second_rate(run: Run) -> str:
    if why := _shares(run):
        return why
    if not two_optimizers(run.config):
        return "with --encoder_optimizer=summed, where the encoder has one optimizer, of --lr_encoder"
    found = ratios(run.config)
    return f"where {found[0]} says how long the second Adam's step is" if found else ""


def _rate_of_objectives(run: Run) -> str:
    # Beside the heads', it is the encoder's where the representation has an Adam of it, and no rate is given.
    config, mode = run.config, of(run.config)
    second = two_optimizers(config) and not ratios(config) and not config.lr_encoder_srl
    first = mode.representation_trains_encoder and not mode.rl_trains_encoder and not config.lr_encoder
    heads = run.heads is None or run.heads
    return "" if heads or first or second else "where no objective has a head, nor the encoder its rate"


def _has_decoder(run: Run) -> str:
    terms = run.terms
    none = terms is not None and not any(term.is_decoder for term in terms.values())
    return "where no objective has a decoder" if none else ""


def _has_slow_copy(run: Run) -> str:
    mode = MODES[run.config.mode]
    if mode.rl and run.look("rl:slow") != "none" or mode.representation and _slow(run, own_views=True):
        return ""
    return "where nothing has a slow copy"


def _slow(run: Run, own_views: bool) -> bool:
    """Whether an objective has slow copies, one with views of its own counting or not; True if not known."""
    if run.terms is None:
        return True
    names = [spec.name for spec in run.objectives or () if own_views or "view" not in spec.resolved]
    return any(run.terms[name].slow for name in names)


def _rl_looks(run: Run) -> bool:
    """Whether RL sees what the run's views make of a window, and not views of its own; True if not known."""
    return MODES[run.config.mode].rl and run.look("rl:view") in ("none", UNKNOWN)


def _has_target(run: Run) -> str:
    mode = MODES[run.config.mode]
    stopped = any(spec.resolved.get("target") == "stopped" for spec in run.objectives or ())
    if _rl_looks(run) or mode.representation and (stopped or _slow(run, own_views=False)):
        return ""
    return "without RL or an objective that has later latents as its target and no views of its own"


def _view_of_rl(run: Run) -> str:
    own = f"with --rl=:view={run.look('rl:view')}, which draws views of a sequence as replay has it"
    return "" if _rl_looks(run) else own


def _view_of_objectives(run: Run) -> str:
    looks = run.objectives is None or any("view" not in spec.resolved for spec in run.objectives)
    return "" if looks else "where all objectives draw views of a sequence as replay has it"


def _augments(run: Run) -> str:
    config, mode = run.config, MODES[run.config.mode]
    if config.augment == "srl" and (why := _trains_objectives(run)):
        return why
    whys = []
    if mode.representation:
        whys.append("beside --srl_view" if config.srl_view else _view_of_objectives(run))
    if mode.rl and config.augment == "all":
        whys.append("beside --rl_view" if config.rl_view else _view_of_rl(run))
    return " and ".join(whys) if all(whys) else ""


def _target_apart(run: Run) -> str:
    config = run.config
    _, seen = modes.views(config)
    mixes = float(specs.split(config.encoder)[1].get("lix", 0)) != 0.0  # by other draws of each
    same = config.target_view == "same" or config.target_view == seen == "none"
    if config.target_encoder == "slow" or mixes or not same:
        return ""
    return "with --target_encoder=online, where the target is the latent itself"


def _heads(run: Run) -> str:
    return {"all": _trains_rl, "none": _trains_objectives}.get(run.config.heads_from, lambda run: "")(run)


def _changes(first: str, last: str) -> Callable[[Run], str]:
    def changes(run: Run) -> str:
        start, end = run.look(first), run.look(last)
        return f"where --{first} and --{last} are both {start}" if start == end else ""

    return changes


FACTS: dict[str, Callable[[Run], str]] = {
    "RL is trained": _trains_rl,
    "RL is not trained": _acts_at_random,
    "objectives are trained": _trains_objectives,
    "the encoder moves": _moves_encoder,
    "the encoder may be shared": _could_share,
    "the encoder is shared": _shares,
    "the second rate": _second_rate,
    "the objectives' rate": _rate_of_objectives,
    "a decoder": _has_decoder,
    "a slow copy": _has_slow_copy,
    "a target": _has_target,
    "a target apart": _target_apart,
    "RL has no views of its own": _view_of_rl,
    "objectives have no views of their own": _view_of_objectives,
    "augments": _augments,
    "heads": _heads,
    "beta changes": _changes("beta", "beta_final"),
    "epsilon changes": _changes("eps_train", "eps_final"),
}
"""{what a need may name: (Run) -> why it does not hold, to follow "nothing reads it", or ""}."""

_RL, _OBJECTIVES = "RL is trained", "objectives are trained"
_PRIORITIES = f"{_RL},rl:prioritized=true,rl:alpha!=0"

NEEDS = {
    **dict.fromkeys(
        ("rl", "gamma", "gamma_anneal", "n_anneal", "reset", "lr_rl", "eps_train", "eps_final", "eps_eval",
         "eval_games", "eval_envs", "eval_max_steps", "final_games", "stop_at_return", "keep_best"), _RL,
    ),
    "augment": "augments",
    "rl_view": f"{_RL},RL has no views of its own",
    "srl_view": f"{_OBJECTIVES},objectives have no views of their own",
    "target_view": "a target",
    "srl_every": f"{_OBJECTIVES},{_RL}",
    "gate": "the encoder may be shared",
    "encoder_optimizer": "the encoder is shared",
    "target_encoder": "a slow copy",
    "reset_every": "reset!=none",
    "reset_last": "reset!=none",
    "shrink": "reset=all",
    "lr_srl": f"{_OBJECTIVES},the objectives' rate",
    "lr_encoder": "the encoder moves",
    "lr_encoder_srl": "the encoder moves,the second rate",
    "decoder_weight_decay": f"{_OBJECTIVES},a decoder",
    "beta": _PRIORITIES,
    "beta_final": _PRIORITIES,
    "beta_anneal_steps": f"{_PRIORITIES},beta changes",
    "eps_anneal_steps": f"{_RL},epsilon changes",
    "slow_update_every": f"{_RL},rl:slow=periodic",
    "diagnostics_kept": "diagnostics=true",
    "heads_from": "encoder_from!=,heads",
    "policy_from": "RL is not trained",
    "pretrain_epsilon": "policy_from!=",
}  # fmt: skip
"""{field of Config that is not always read: what it needs}, see `srl_jax.needs`."""


def run_of(config: "Config", **known: Any) -> Run:
    """What is known of a run; `known` as of `srl_jax.needs.Run`."""
    return Run(config, NEEDS, FACTS, **known)


def check(
    config: "Config",
    *,
    given: Collection[str] = EVERYTHING,
    needs_encoder: bool = False,
    hint: str = "",
    complete: bool = True,
) -> "Config":
    """Whether the settings fit the mode, as far as can be said without the registries.

    Args:
        config: the run.
        given: the fields that were given, of which each has to be read.
        needs_encoder: the run must start from an encoder even where its mode may start from
            scratch.
        hint: how to make such an encoder; ends the error.
        complete: False asks for no encoder: the settings are only to be looked at.

    Returns:
        The config, with defaults for what nothing reads.

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
    if config.whole_rounds(config.steps) * config.updates_per_step >= 2**31:
        rate = specs.value_text(config.updates_per_step)
        raise ConfigError(
            f"--steps={config.steps}: with --updates_per_step={rate} that is 2^31 updates or more, which an "
            "int32 does not count; give fewer"
        )
    _check_rates(config, given)
    run_of(config).refuse(given)
    config = run_of(config).in_force()
    if not mode.rl and "rl" not in given:  # given, it is looked at where its row and defaults are known
        config = dataclasses.replace(config, rl=type(config).rl)
    annealing.check(config, mode)
    if config.gate in PROJECTING and config.encoder_optimizer == "separate":
        raise ConfigError(
            f"--gate={config.gate}: with --encoder_optimizer=separate the second gradient is taken after "
            "RL's step, so that the two do not meet; give --encoder_optimizer=summed or simultaneous"
        )
    _check_terminal(config)
    _check_corrupted(config)
    _check_ratios(config)
    return config


def check_replay(config: "Config", horizon: int) -> None:
    """Whether replay has room for the windows of a run; allocates nothing.

    Args:
        config: the run's.
        horizon: of the windows, in steps.

    Raises:
        ConfigError: it has not.
    """
    least = least_capacity(config.num_envs, config.frame_stack, horizon)
    if config.buffer_size < least:
        raise ConfigError(
            f"--buffer_size={config.buffer_size}: must be at least {least}; --num_envs={config.num_envs}, "
            f"--frame_stack={config.frame_stack} and the {horizon} steps ahead that "
            f"--rl={specs.split(config.rl)[0]}:n_step= or --objective looks say how much it takes"
        )


def _check_rates(config: "Config", given: Collection[str]) -> None:
    # Where nobody says what was given, 0 is the default like any other.
    for name in ("lr_encoder", "lr_encoder_srl") if given is not EVERYTHING else ():
        if name in given and not getattr(config, name):
            raise ConfigError(
                f"--{name}=0: 0 stands for the rate of what trains the encoder; leave it out or give a rate. "
                "With --mode=decoupled --objective=latent_l2:weight=0 the encoder stays as it is drawn"
            )


def _check_terminal(config: "Config") -> None:
    text = config.gamma_anneal
    start = annealing.parse(text, float).start if text else config.gamma
    if not min(start, config.gamma) and any(specs.split(x)[0] == "terminal" for x in config.objectives):
        flag = f"gamma_anneal={text}" if config.gamma else "gamma=0"
        why = "a discount of 0 is how --objective=terminal knows a terminal state"
        raise ConfigError(f"--{flag}: {why}; give a gamma above 0")


def _check_corrupted(config: "Config") -> None:
    if not (view := config.srl_view).endswith("@each"):
        return
    for name, options in map(specs.split, config.objectives):
        for option in ("noise", "masked") if name == "reconstruction" else ():
            if option in options and specs.parse_value(options[option], float):
                raise ConfigError(
                    f"--srl_view={view}: {name}:{option}={options[option]} corrupts observations as replay "
                    f"has them, which have no view of their own; give --srl_view={view.removesuffix('@each')}"
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
