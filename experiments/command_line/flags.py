"""The command line: absl flags, which are made from the fields of Config, and errors of one line.

Entry points define their flags with these functions; the library defines none. Imports no jax.
"""

import contextlib
import functools
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from absl import app, flags

from srl_jax import checks, plugins, specs
from srl_jax.config import INFOS, Config, unresolved
from srl_jax.errors import EXIT_STATUS, ConfigError
from srl_jax.files import display, loggers
from srl_jax.files.reading import SETTINGS, read_bytes
from srl_jax.specs import Info

from ..presets import ENCODER_PRESETS, PIECES, preset_values, source_preset
from ..protocols import PROTOCOLS
from . import help

# The flags count as the entry point's own, so that --help shows them.
flags.disclaim_key_flags()

LONGEST = 4_000
"""Characters of an error that are shown."""

MOVED = {
    **{name: f"--rl=:{name}=..." for name in ("n_step", "v_min", "v_max", "noisy_std", "alpha")},
    "num_atoms": "--rl=:atoms=...",
    "lr_final": "--lr_final_share=...",
    "tensorboard": "--logger=tensorboard",
}
"""{flag that there was: how its value is given now}; `--rl=:KEY=...` leaves the other options as they are."""


def unknown(name: str, known: Iterable[str]) -> str:
    """What is said of a flag that there is not: what may have been meant, or where its value has gone to."""
    if name in MOVED:
        return f"is now {MOVED[name]}"
    known = set(known)
    meant = specs.near(name, known) or [flag for flag in _of_help(name) if flag in known][:5]
    close = " or ".join(f"--{flag}" for flag in meant)
    return f"no such flag; {f'did you mean {close}? ' if close else ''}--help lists them all"


def _of_help(name: str) -> list[str]:
    """The flags whose help has these words, as learning_rate; none for a name of up to three letters."""
    words = re.compile(rf"\b{re.escape(name.replace('_', ' '))}\b")
    return [info.flag or field for field, info in INFOS.items() if len(name) > 3 and words.search(info.help)]


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


def define(name: str, info: Info, default: Any, values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines a flag whose values an Info describes and checks.

    Args:
        name: of the flag.
        info: its type, help and limits.
        default: its value where it is not given; need not keep to the limits.
        values: where to define it.
    """
    text = info.help + (f" [{info.unit}]" if info.unit else "")
    if info.choices:
        text += f"; one of: {', '.join(info.choices)}"
    if info.kind is tuple:
        flags.DEFINE_multi_string(name, list(default) or None, text, values)
        return
    flag = flags.Flag(_Parser(info), _Serializer(), name, default, text, boolean=info.kind is bool)
    flags.DEFINE_flag(flag, values)


def kinds(values: flags.FlagValues) -> tuple[Callable[..., Any], ...]:
    """Four functions of (name, default, help) that define a flag.

    Args:
        values: where to define it.

    Returns:
        Those for a text, for yes or no, for texts with commas between them, and for texts of a repeated flag.
    """
    defining = (flags.DEFINE_string, flags.DEFINE_boolean, flags.DEFINE_list, flags.DEFINE_multi_string)
    return tuple(functools.partial(define, flag_values=values) for define in defining)


def define_config_flags(values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines a flag for every field of Config, --preset and --config."""
    for name, default in vars(Config()).items():
        define(INFOS[name].flag or name, INFOS[name], default, values)
    flags.DEFINE_string(
        "preset",
        None,
        "named settings; flags beside it override them, pieces behind + change them: thesis/joint_256+small",
        values,
    )
    told = "how games are played and what is reported, over --preset or --config; flags beside it override it"
    define("protocol", Info(str, told, choices=tuple(PROTOCOLS)), None, values)
    flags.DEFINE_string(
        "config",
        None,
        "config.json of a run, or the run's directory: its settings, which flags beside it override",
        values,
    )


def define_runtime_flag(values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines --tune_runtime, see `runtime`; no field of Config, for it changes no setting."""
    help_text = "auto: set variables that make jax faster on a CPU, restarting once if need be; off: set none"
    define("tune_runtime", Info(str, help_text, choices=("auto", "off")), "auto", values)


def define_import_flag(values: flags.FlagValues = flags.FLAGS) -> None:
    """Defines --import of programs that read a run; None where it was not given."""
    help_text = "what to import in place of what the run's config.json names; may be repeated"
    flags.DEFINE_multi_string("import", None, help_text, values)


def _base(values: flags.FlagValues, game: str | None) -> tuple[dict[str, Any], str]:
    """The settings that flags override, and where they are from: --preset, --config, or neither.

    Raises:
        ConfigError: there is no such preset or file, or both were given.
    """
    preset, path = values["preset"].value, values["config"].value
    if path is None:
        try:
            return ({}, "") if preset is None else (preset_values(preset, game), f"--preset={preset}")
        except ConfigError as error:
            raise ConfigError(f"--preset={error}") from None
    if preset is not None:
        raise ConfigError(f"--config={path}: given beside --preset={preset}; give one of them")
    file = Path(os.path.expanduser(path))
    try:
        text = read_bytes(file / "config.json" if file.is_dir() else file, SETTINGS)
        config = Config.from_json(text)
    except OSError as error:
        raise ConfigError(f"--config={path}: {error.strerror}; give a run's config.json") from None
    except ConfigError as error:
        raise ConfigError(f"--config={path}: {error}") from None
    return {name: getattr(unresolved(config), name) for name in INFOS}, f"--config={path}"


def with_objectives(base: Sequence[str], given: Sequence[str]) -> tuple[str, ...]:
    """The objectives of --objective beside a preset's.

    Args:
        base: the preset's.
        given: `+name:key=value,...` adds one, or replaces the one of its name; `-name` leaves one out; plain
            ones replace all.

    Raises:
        ConfigError: plain ones are among those with a sign, or there is none to leave out.
    """
    signed = [text[:1] in ("+", "-") for text in given]
    if not any(signed):
        return tuple(given)
    if not all(signed):
        plain = given[signed.index(False)]
        raise ConfigError(
            f"--objective={plain}: replaces all, beside --objective={given[signed.index(True)]}"
        )
    found = {text.partition(":")[0].strip(): text for text in base}
    names = [text[1:].partition(":")[0].strip() for text in given]
    for name, text in zip(names, given, strict=True):
        sign = text[0]
        if names.count(name) > 1:
            raise ConfigError(f"--objective={text}: {name} is given {names.count(name)} times; give it once")
        if sign == "+":
            found[name] = text[1:]
        elif name != text[1:].strip() or found.pop(name, None) is None:
            raise ConfigError(f"--objective={text}: names none to leave out; there are: {', '.join(found)}")
    return tuple(found.values())


def replaced_objectives(given: Sequence[str], base: Sequence[str], whose: str) -> str:
    """A line that says which objectives plain ones replace; "" where they replace none.

    Args:
        given: --objective's values.
        base: what a preset or a config has.
        whose: it is.
    """
    plain = [text for text in given if text[:1] not in ("+", "-")]
    if not plain or not base or tuple(plain) in (("none",), ("",), tuple(base)):
        return ""
    hint = "; --objective=+NAME adds to them" if len(plain) == 1 else ""
    return f"objective: {' and '.join(plain)} in place of {' and '.join(base)} of {whose}{hint}"


def say_what_is_replaced(values: flags.FlagValues) -> None:
    """Says in a line which objectives of --preset or --config are replaced."""
    base, whose = _base(values, None)
    if line := replaced_objectives(values["objective"].value or (), base.get("objectives", ()), whose):
        display.say(line)


def config_from_flags(values: flags.FlagValues = flags.FLAGS, *, complete: bool = True) -> Config:
    """The settings that the command line asks for: defaults, --preset or --config, --protocol, other flags.

    `--rl=:key=value` and `--encoder=:key=value` change options of what the preset has, for --objective see
    `with_objectives`.

    Args:
        values: parsed flags, as `define_config_flags` defines them.
        complete: also demand the encoder that the mode or the preset starts from.

    Returns:
        A checked Config, with defaults where nothing reads what --preset or --config has; its specifications
        are not checked yet (that takes the registries, which import jax).

    Raises:
        ConfigError: unknown preset, a value out of its limits, flags that do not fit together, or one that
            nothing reads.
    """
    given = {name: values[INFOS[name].flag or name].value for name in given_fields(values)}
    base, _ = _base(values, given.get("game"))
    if protocol := values["protocol"].value:
        if protocol not in PROTOCOLS:
            raise ConfigError(f"--protocol={protocol}: {specs.choices_text(protocol, PROTOCOLS)}")
        base = PIECES[f"protocol/{protocol}"](base)
    for name in ("objectives", "imports"):
        if name in given:
            texts = tuple(given[name])
            given[name] = () if texts in (("none",), ("",)) else texts
    if "imports" in given:
        given["imports"] = tuple(map(plugins.located, given["imports"]))
    if "loggers" in given:
        given["loggers"] = loggers.listed(given["loggers"])
    if "objectives" in given:
        given["objectives"] = with_objectives(base.get("objectives", ()), given["objectives"])
    for name in ("rl", "encoder"):
        if name in given:
            try:
                given[name] = specs.overlaid(base.get(name, getattr(Config, name)), given[name])
            except specs.SpecError as error:
                raise ConfigError(f"--{name}={given[name]}: {error}") from None
    config = Config(**{**base, **given})

    preset = values["preset"].value or ""
    source = source_preset(preset, ENCODER_PRESETS)
    # A preset's encoder is only asked for while its mode is: --mode beside it may need none.
    if source and config.mode == preset_values(preset.partition("+")[0])["mode"]:
        hint = f"--preset={source} --game={config.game} --out=PATH makes one"
        return checks.check(config, given=given, needs_encoder=True, hint=hint, complete=complete)
    return checks.check(config, given=given, complete=complete)


def given_fields(values: flags.FlagValues) -> list[str]:
    """The fields of Config whose flags were given."""
    return [name for name, info in INFOS.items() if values[info.flag or name].present]


def what_is_given(values: flags.FlagValues) -> set[str]:
    """What the command line gives, as `srl_jax.needs.Run.refuse` takes it; no options that cannot be read."""
    found = set(given_fields(values))
    for prefix, text in (
        *((name, values[name].value) for name in ("rl", "encoder") if name in found),
        *(("", text.lstrip("+")) for text in values["objective"].value or () if "objectives" in found),
    ):
        with contextlib.suppress(specs.SpecError):
            name, options = specs.split(text if not text.lstrip().startswith(":") else prefix + text.lstrip())
            found |= {f"{prefix or name}:{option}" for option in options}
    return found


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
    argv: list[str],
    values: flags.FlagValues = flags.FLAGS,
    positional: str | None = None,
    about: str = "",
) -> list[str]:
    """Parses a command line; exits with one line and status 2 where it is not valid, with 0 after --help.

    Args:
        argv: the program's name and its arguments.
        values: where the flags are defined.
        positional: a flag whose value, or values, may be given without its name; None for none.
        about: what the program does, for --help.

    Returns:
        [the program's name].
    """
    help.if_asked(argv, about, values)
    # absl would wait for a pipe there, read a device without end, and end in tracebacks.
    if any(argument.lstrip("-").partition("=")[0] == "flagfile" for argument in argv[1:]):
        fail("--flagfile: not taken; write the flags themselves, or use --preset")
    # Else an argument without a name would end the flags.
    values.set_gnu_getopt(positional is not None)
    own = help.own_flags(values)
    try:
        rest = values(argv)
        if positional and len(rest) > 1 and not values[positional].present:
            several = isinstance(values[positional], flags.MultiFlag)
            values[positional].parse(rest[1:] if several else rest[1])
            del rest[1 : None if several else 2]
    except flags.UnrecognizedFlagError as error:
        fail(f"--{error.flagname}: {unknown(error.flagname, own)}")
    except (flags.Error, ValueError) as error:  # ValueError: a value behind --noNAME
        line = str(error).removeprefix("flag ")
        several = re.match(r"--((\w+)=[^:\s]+,[^:\s]+): ", line)
        if several and several[2] in INFOS and "grid" in values:
            line += f"; --grid {several[1]} tries each"
        fail(line)
    for name in values:
        flag = values[name]
        if flag.present and name not in own:
            fail(f"--{name}: {unknown(name, own)}")
        if flag.present > 1 and not isinstance(flag, flags.MultiFlag):  # absl takes the last one
            hint = "separate values with commas" if isinstance(flag.value, list) else "give it once"
            fail(f"--{name}: given {flag.present} times; {hint}")
    if len(rest) > 1:
        fail(f"unexpected argument {rest[1]!r}: write every option as --name=value; see --help")
    return rest


def guarded(main: Callable[[list[str]], Any]) -> Callable[[list[str]], Any]:
    """The function, ending the process with a line and a status where it raises what `srl_jax.errors` has."""

    def call(argv: list[str]) -> Any:
        try:
            return main(argv)
        except tuple(EXIT_STATUS) as error:
            fail(error, next(n for kind, n in EXIT_STATUS.items() if isinstance(error, kind)))

    return call


def program(
    run: Callable[[flags.FlagValues], Any],
    define_flags: Callable[[flags.FlagValues], Any],
    positional: str | None = None,
) -> Callable[[], None]:
    """What runs an entry point: it defines and parses the flags, and ends as `guarded` does.

    Args:
        run: takes the flags; may return the exit status. Its module's docstring begins --help.
        define_flags: defines them.
        positional: see `parse`.
    """

    def cli() -> None:
        # absl prints what libraries log, and jax logs every accelerator that it does not find.
        logging.getLogger("jax").setLevel(logging.WARNING)
        display.secure()
        define_flags(flags.FLAGS)
        function = run.func if isinstance(run, functools.partial) else run
        about = sys.modules[function.__module__].__doc__ or ""
        main = guarded(lambda _: run(flags.FLAGS))
        app.run(main, flags_parser=functools.partial(parse, positional=positional, about=about))

    return cli
