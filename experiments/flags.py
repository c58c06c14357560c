"""The command line: absl flags made from the fields of Config, and errors of one line.

Flags are defined here, for the entry points, and nowhere else in the library. Imports no jax.
"""

import functools
import logging
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from absl import app, flags

from srl_jax import display, modes, plugins, specs
from srl_jax.config import INFOS, Config
from srl_jax.errors import EXIT_STATUS, ConfigError
from srl_jax.specs import Info

from .presets import ENCODER_PRESETS, PRESETS, preset_values

# The flags count as the entry point's own, so that --help shows them.
flags.disclaim_key_flags()

LONGEST = 4_000
"""Characters of an error that are shown."""

RL_OPTIONS: dict[str, tuple[str, Info]] = {
    "n_step": ("n_step", Info(int, "steps of the return", "env steps", minimum=1)),
    "num_atoms": ("atoms", Info(int, "atoms of the value distribution", "atoms", minimum=2)),
    "v_min": ("v_min", Info(float, "lowest atom", "discounted return")),
    "v_max": ("v_max", Info(float, "highest atom", "discounted return")),
    "noisy_std": ("noisy_std", Info(float, "noisy layers' initial noise", minimum=0)),
    "alpha": ("alpha", Info(float, "priorities' exponent", "exponent", minimum=0)),
}
"""Flags that stand for an option of --rl: flag -> (option, Info). All of table 5.1 is a flag."""


def with_rl_options(rl: str, given: Mapping[str, Any], explicit: bool) -> str:
    """The --rl text with the values of `RL_OPTIONS`' flags merged into it.

    Args:
        rl: a specification.
        given: flag -> value, for the flags that were given.
        explicit: `rl` was typed beside those flags, so the two may not contradict each other;
            otherwise (it came from a preset) the flags win.

    Raises:
        ConfigError: a contradiction, or `rl` is not the syntax.
    """
    if not given:
        return rl
    try:
        name, options = specs.split(rl)
    except specs.SpecError as error:
        raise ConfigError(f"--rl={rl}: {error}") from None
    for flag, value in given.items():
        option, info = RL_OPTIONS[flag]
        if explicit and option in options:
            try:
                same = specs.parse_value(options[option], info.kind) == value
            except ValueError:
                same = True  # Resolving --rl reports it, with the option's own type.
            if not same:
                raise ConfigError(
                    f"--{flag}={specs.value_text(value)}: contradicts --rl={rl}; give one of them"
                )
        else:
            options[option] = specs.value_text(value)
    return specs.join(name, options)


class _Parser(flags.ArgumentParser):
    """Reads a flag's text by its Info, so that absl's errors give our reasons."""

    def __init__(self, info: Info):
        self.info = info

    def parse(self, argument: Any) -> Any:
        return self.info.parse(argument) if isinstance(argument, str) else argument

    def flag_type(self) -> str:
        return self.info.kind.__name__


class _Serializer(flags.ArgumentSerializer):
    def serialize(self, value: Any) -> str:
        return "off" if value is None else specs.value_text(value)


def define(
    name: str, info: Info, default: Any, values: flags.FlagValues = flags.FLAGS, note: str = ""
) -> None:
    """Defines a flag whose values an Info describes and checks.

    Args:
        name: of the flag.
        info: its type, help and limits.
        default: its value where it is not given; need not keep to the limits.
        values: where to define it.
        note: more for --help.
    """
    text = info.help + (f" [{info.unit}]" if info.unit else "") + note
    if info.choices:
        text += f"; one of: {', '.join(info.choices)}"
    if info.kind is tuple:
        flags.DEFINE_multi_string(name, list(default) or None, text, flag_values=values)
        return
    flag = flags.Flag(_Parser(info), _Serializer(), name, default, text, boolean=info.kind is bool)
    flags.DEFINE_flag(flag, values)


def define_config_flags(values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines a flag for every field of Config, `RL_OPTIONS` and --preset."""
    for name, info in INFOS.items():
        define(info.flag or name, info, getattr(Config(), name), values)
    for name, (option, info) in RL_OPTIONS.items():
        define(name, info, None, values, f"; short for --rl=NAME:{option}=..., and as --rl says")
    flags.DEFINE_string(
        "preset",
        None,
        "named settings, which the flags given beside it override; one of: " + ", ".join(PRESETS),
        flag_values=values,
    )


def define_runtime_flag(values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines --tune_runtime, see `experiments.runtime`; no field of Config, for it changes no setting."""
    help_text = "whether to set variables that make jax faster on a CPU, and to restart once if need be"
    define("tune_runtime", Info(str, help_text, choices=("auto", "off")), "auto", values)


def config_from_flags(values: flags.FlagValues = flags.FLAGS, *, complete: bool = True) -> Config:
    """The settings that the command line asks for: defaults, then --preset, then the flags given.

    Args:
        values: parsed flags, as `define_config_flags` defines them.
        complete: also demand the encoder that the mode or the preset starts from.

    Returns:
        A checked Config; its specifications are not yet (that takes the registries, which import
        jax).

    Raises:
        ConfigError: unknown preset, a value out of its limits, or flags that do not fit together.
    """
    given = {
        name: values[info.flag or name].value
        for name, info in INFOS.items()
        if values[info.flag or name].present
    }
    for name in ("objectives", "imports"):
        if name in given:
            texts = tuple(given[name])
            given[name] = () if texts in (("none",), ("",)) else texts
    if "imports" in given:
        given["imports"] = tuple(map(plugins.located, given["imports"]))
    preset = values["preset"].value
    settings = dict(given)
    if values["preset"].present:
        if preset not in PRESETS:
            raise ConfigError(f"--preset={preset}: {specs.choices_text(preset, PRESETS)}")
        settings = {**preset_values(preset, given.get("game")), **given}
    shorts = {name: values[name].value for name in RL_OPTIONS if values[name].present}
    rl = settings.get("rl", Config.rl)
    config = Config(**{**settings, "rl": with_rl_options(rl, shorts, explicit="rl" in given)})

    source = ENCODER_PRESETS.get(preset)
    # A preset's encoder is only asked for while its mode is: --mode beside it may need none.
    if source and config.mode == PRESETS[preset]["mode"]:
        hint = f"--preset={source} --game={config.game} --out=PATH makes one"
        modes.check(config, needs_encoder=True, hint=hint, complete=complete)
    else:
        modes.check(config, complete=complete)
    return config


def check_place(flag: str, text: str) -> Path:
    """The path of a directory that is there and can be written to, or can be made there; writes nothing.

    Args:
        flag: that it came from.
        text: its value, with or without ~.

    Raises:
        ConfigError: neither holds.
    """
    check_name(flag, text)
    path = Path(os.path.expanduser(text))
    try:
        if path.is_dir():
            if not os.access(path, os.W_OK | os.X_OK):
                raise ConfigError(f"--{flag}={text}: no permission to write there")
            return path
        if os.path.lexists(path):
            raise ConfigError(f"--{flag}={text}: exists and is not a directory")
        parent = next(p for p in path.absolute().parents if os.path.lexists(p))
        if not parent.is_dir():
            raise ConfigError(f"--{flag}={text}: {parent} is not a directory")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise ConfigError(f"--{flag}={text}: no permission to write in {parent}")
    except OSError as error:
        raise ConfigError(f"--{flag}={text}: {error.strerror}") from None
    return path


def check_name(flag: str, text: str) -> None:
    """Whether a path that is to be written to can be shown in a line.

    Args:
        flag: that it came from.
        text: its value.

    Raises:
        ConfigError: it has a line break, another control character, or bytes that are no text.
    """
    odd = next((character for character in text if not character.isprintable()), None)
    if odd is not None:
        raise ConfigError(f"--{flag}={text}: has the character {odd!a}; name it with printable ones")


def fail(message: Any, status: int = 2) -> NoReturn:
    """Prints one line on stderr and exits.

    What cannot be printed is shown as Python would write it; a long line loses its middle.
    """
    line = " ".join(str(message).split())
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} [...] {line[-LONGEST // 2 :]}"
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    display.say(f"error: {line}")
    sys.exit(status)


def parse(
    argv: list[str], values: flags.FlagValues = flags.FLAGS, positional: str | None = None
) -> list[str]:
    """Parses a command line; exits with one line and status 2 where it is not valid.

    Args:
        argv: the program's name and its arguments.
        values: where the flags are defined.
        positional: a flag whose value, or values, may be given without its name; None for none.

    Returns:
        [the program's name].
    """
    # absl would wait for a pipe there, read a device without end, and end in tracebacks.
    if any(argument.lstrip("-").partition("=")[0] == "flagfile" for argument in argv[1:]):
        fail("--flagfile: not taken; write the flags themselves, or use --preset")
    # Else an argument without a name would end the flags.
    values.set_gnu_getopt(positional is not None)
    try:
        rest = values(argv)
        if positional and len(rest) > 1 and not values[positional].present:
            several = isinstance(values[positional], flags.MultiFlag)
            values[positional].parse(rest[1:] if several else rest[1])
            del rest[1 : None if several else 2]
    except flags.UnrecognizedFlagError as error:
        near = specs.near(error.flagname, values)
        suggestion = f"did you mean {' or '.join(f'--{name}' for name in near)}? " if near else ""
        fail(f"--{error.flagname}: no such flag; {suggestion}--helpfull lists them all")
    except (flags.Error, ValueError) as error:  # ValueError: a value behind --noNAME
        fail(str(error).removeprefix("flag "))
    for name in values:
        flag = values[name]
        if flag.present > 1 and not isinstance(flag, flags.MultiFlag):  # absl takes the last one
            hint = "separate values with commas" if isinstance(flag.value, list) else "give it once"
            fail(f"--{name}: given {flag.present} times; {hint}")
    if len(rest) > 1:
        fail(f"unexpected argument {rest[1]!r}: write every option as --name=value; see --help")
    return rest


def last_of_each(arguments: Iterable[str]) -> tuple[str, ...]:
    """A command line less each flag that a later one of its name replaces; --objective may be repeated.

    For programs that add flags to others: `parse` refuses one that is given twice.
    """
    arguments = tuple(arguments)
    names = [text.partition("=")[0] for text in arguments]
    repeated = {f"--{info.flag or name}" for name, info in INFOS.items() if info.kind is tuple}
    return tuple(
        text
        for i, (name, text) in enumerate(zip(names, arguments, strict=True))
        if name in repeated or not name.startswith("--") or name not in names[i + 1 :]
    )


def guarded(main: Callable[[list[str]], Any]) -> Callable[[list[str]], Any]:
    """The function, ending the process with a line and a status where it raises what `srl_jax.errors` has."""

    def call(argv: list[str]) -> Any:
        try:
            return main(argv)
        except tuple(EXIT_STATUS) as error:
            fail(error, next(n for kind, n in EXIT_STATUS.items() if isinstance(error, kind)))

    return call


def run(main: Callable[[list[str]], Any], positional: str | None = None) -> None:
    """Runs an entry point: parses the flags, and ends with a line and a status where it fails; see `guarded`.

    Args:
        main: takes [the program's name]; may return the exit status.
        positional: see `parse`.
    """
    # absl prints what libraries log, and jax logs every accelerator that it does not find.
    logging.getLogger("jax").setLevel(logging.WARNING)
    display.secure()
    app.run(guarded(main), flags_parser=functools.partial(parse, positional=positional))
