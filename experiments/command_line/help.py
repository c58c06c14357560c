"""What --help prints: a program's flags in groups, with the rows of the registries and the presets."""

import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from absl import flags

from srl_jax import specs
from srl_jax.files import display

from .. import PACKAGE
from ..presets import OBJECTIVE, PIECES, PIECES_HELP, PRESETS, preset_values
from ..protocols import PROTOCOLS

GROUPS: dict[str, str] = {
    "Run": "preset protocol config mode steps seed seeds import",
    "Game": "game num_envs frame_size frame_stack reward_clip life_loss sticky_actions full_actions noop_max",
    "RL": "rl gamma gamma_anneal n_anneal target_encoder slow_update_every eps_train eps_final "
    "eps_anneal_steps",
    "Resets": "reset reset_every reset_last shrink",
    "Encoder": "encoder encoder_from heads_from",
    "Representation": "objective srl_every encoder_optimizer gate policy_from pretrain_epsilon",
    "Views": "augment rl_view srl_view target_view",
    "Replay": "buffer_size batch_size updates_per_step learn_start beta beta_final beta_anneal_steps",
    "Optimisation": "lr_rl lr_srl lr_encoder lr_encoder_srl lr_final_share decoder_weight_decay "
    "weight_decay max_grad_norm adam_eps",
    "Evaluation": "eval_every eval_games eval_max_steps eps_eval final_games eval_envs stop_at_return "
    "diagnostics diagnostics_kept",
    "Output": "out resume overwrite log_every checkpoint_every keep_encoder_every keep_best keep_replay "
    "logger print_config dry_run tune_runtime",
}
"""Flags of training, in the order in which they are shown; others are a program's own."""

HIDDEN = "not taken here"
"""The help of a flag that is not shown."""

_INDENT = " " * 26


def if_asked(argv: Sequence[str], about: str, values: flags.FlagValues | None = None) -> None:
    """Prints the page and ends with status 0 where a command line asks for it.

    Args:
        argv: the program's name and its arguments.
        about: see `text`.
        values: likewise; None for a program without flags of its own.
    """
    if {"-h", "--help", "-help", "--helpfull", "--helpshort"} & set(argv[1:]):
        display.result(text(about, values or flags.FlagValues()))
        sys.exit(0)


def text(about: str, values: flags.FlagValues) -> str:
    """The page.

    Args:
        about: what the program does; its first lines are shown.
        values: where its flags are defined. Where --rl is among them, jax is imported for what it may be.
    """
    from .cli import COMMANDS  # which imports this module

    own = [name for name in own_flags(values) if values[name].help != HIDDEN]
    trains = "rl" in own
    grouped = {title: names.split() for title, names in GROUPS.items()} if trains else {}
    known = {name for names in grouped.values() for name in names}
    grouped = {"Flags": [name for name in own if name not in known]} | grouped
    rows = _rows() if trains else {}
    commands = rf"python -m experiments\.({'|'.join(COMMANDS)})\b"
    about = re.sub(commands, r"srl-jax \1", about.strip())
    lines = [about.replace("python -m experiments.", f"python -m {PACKAGE}."), ""]
    for title, names in grouped.items():
        shown = [(*_flag(name, values), *_listed(rows.get(name, {}))) for name in names if name in own]
        if shown:
            lines += [f"{title}:", *(line for flag in shown for line in flag), ""]
    if trains:
        lines += ["Protocols:", *_protocols(), "", "Presets:", *_presets(rows["objective"])]
    return "\n".join(lines).rstrip()


def own_flags(values: flags.FlagValues) -> list[str]:
    """The names of a program's flags, sorted; those that absl has brought along are none of its own."""
    return sorted(n for n in values if not values.find_module_defining_flag(n, "absl").startswith("absl"))


def _flag(name: str, values: flags.FlagValues) -> Iterator[str]:
    """A flag's lines: its name, default and help."""
    flag = values[name]
    about = flag.help.replace("repeat this option to specify a list of values", "").rstrip(" ;\n")
    shown = f"--{name}"
    if flag.boolean:
        shown, about = f"--[no]{name}", f"{about} (default: {'yes' if flag.default else 'no'})"
    elif flag.default not in (None, "", []) and flag.serializer:
        shown += f"={flag.serializer.serialize(flag.default)}"
    wrapped = textwrap.wrap(about, 84)
    head = f"  {shown}"
    if len(head) < len(_INDENT) - 1:
        yield head.ljust(len(_INDENT)) + wrapped.pop(0)
    else:
        yield head
    yield from (_INDENT + line for line in wrapped)


def _rows() -> dict[str, dict[str, dict[str, Any]]]:
    """{flag: {row of its registry: {option: default}}}; imports jax."""
    from srl_jax import encoders, objectives, rl
    from srl_jax.files import loggers

    registries = {"rl": rl.REGISTRY, "encoder": encoders.REGISTRY, "objective": objectives.REGISTRY}
    registries["logger"] = loggers.REGISTRY
    return {
        flag: {name: specs.option_defaults(row) for name, row in registry.items()}
        for flag, registry in registries.items()
    }


def _listed(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A registry's rows; one that has an earlier one's options, by what differs."""
    for place, (name, options) in enumerate(rows.items()):
        line = specs.join(name, options)
        for other in list(rows)[:place]:
            if options and rows[other].keys() == options.keys():
                differing = {key: x for key, x in options.items() if x != rows[other][key]}
                line = f"{name}: as {specs.join(other, differing)}"
                break
        broken = textwrap.wrap(line.replace(",", ", "), 80, subsequent_indent="    ")
        yield from (_INDENT + part.replace(", ", ",") for part in broken)


def _presets(objectives: Iterable[str]) -> Iterator[str]:
    """A line for each preset and piece; presets that another family's and a piece make are told together."""
    for name in PRESETS:
        if not name.startswith("small/"):
            yield f"  {name:34}  {summary(name)}"
    yield f"  {'small/NAME':34}  thesis/NAME+small"
    for name in PIECES:
        yield f"  {'PRESET+' + name:34}  {PIECES_HELP[name]}"
    for name in objectives:
        line = f"with --objective=+{name}, at its default options; --mode=rl_only becomes joint"
        yield f"  {'PRESET+' + OBJECTIVE + name:34}  {line}"


def summary(name: str) -> str:
    """What a preset trains, in a line."""
    values = preset_values(name)
    rl, of_rl = specs.split(values.get("rl", "rainbow"))
    encoder, of_encoder = specs.split(values["encoder"])
    features = of_encoder.get("features", "0")
    what = [
        values["mode"],
        "" if values["mode"] == "pretrain" else rl,
        f"n of {of_rl['n_step']}" if "n_step" in of_rl else "",
        encoder + (f" of {features} features" if features != "0" else ""),
        " + ".join(specs.split(text)[0] for text in values.get("objectives", ())),
        "random shift" if values.get("augment") == "all" else "",
        f"resets of {reset}" if (reset := values.get("reset")) else "",
        f"epsilon to {values['eps_final']:g}" if "eps_final" in values and rl == "drq" else "",
        f"{values['steps']:,} env steps",
        f"{values['updates_per_step']:g} updates each" if values.get("updates_per_step", 0) > 1 else "",
    ]
    return f"{values['game']}: {', '.join(filter(None, what))}"


def _protocols() -> Iterator[str]:
    """What each protocol sets, as flags."""
    for name, values in PROTOCOLS.items():
        given = " ".join(f"--{field}={specs.value_text(value)}" for field, value in values.items())
        yield from textwrap.wrap(given, 100, initial_indent=f"  {name:16}", subsequent_indent=" " * 18)
