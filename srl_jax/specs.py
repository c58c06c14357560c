"""One syntax, `name:key=value,key=value`, for the rows of a registry. Nothing here imports jax.

A registry is a dict from a name to a factory: a function, or a functools.partial of one. The
factory's keyword-only parameters are the options, and their defaults give both the default and the
type. So a new option needs no new flag, and a typo is answered with a list of what there is.
"""

import dataclasses
import difflib
import functools
import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Set
from typing import Any, NamedTuple

from srl_jax.errors import ConfigError

LIMITS = {int: 2**31 - 1, float: 3.4028234663852886e38}
"""The largest number of each kind, where no smaller one is set: what 32 bits hold, as devices and emulators
count and compute."""

MOST_UNITS = 2**16
"""The largest size of a layer that an option may ask for."""

WEIGHT = "weight"
"""The option of an objective that may be a `Weight` where its default is a number."""

KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


class SpecError(ConfigError):
    """A specification, `name:key=value,...`, that cannot be read or built."""


@dataclasses.dataclass(frozen=True)
class Spec:
    """A row of a registry with its options.

    Attributes:
        name: the row.
        options: the options that were given, by name, of their default's type.
        resolved: every option of the row, the defaults included, in the factory's order.
        flag: where it came from, without dashes; names the flag in errors. May be empty.
        needs: {option: what it needs beside it}, see `srl_jax.needs`.
        defaults: of all options.
    """

    name: str
    options: Mapping[str, Any]
    resolved: Mapping[str, Any]
    flag: str = dataclasses.field(default="", compare=False)
    needs: Mapping[str, str] = dataclasses.field(default_factory=dict, compare=False)
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        """The given options in the factory's order; parsing it gives this Spec again."""
        return join(self.name, self.options)

    @property
    def full(self) -> str:
        """Like str, with every option: config.json keeps it, so no later default changes a run."""
        return join(self.name, self.resolved)

    @property
    def changed(self) -> list[str]:
        """The options whose value is not the default."""
        return [name for name, value in self.resolved.items() if value != self.defaults[name]]

    @property
    def where(self) -> str:
        """What begins an error about it."""
        return _where(self.flag, str(self))

    def without(self, names: Iterable[str]) -> "Spec":
        """The same with the defaults of these options."""
        options = {name: value for name, value in self.options.items() if name not in [*names]}
        return dataclasses.replace(self, options=options, resolved={**self.defaults, **options})


def choices_text(given: str, names: Iterable[str], between: str = ", ") -> str:
    """`did you mean X? valid: ...`; suggests only where a name is near (letter case aside).

    Of more than 20 names, which nobody would read, only the near ones are listed; `between` is between two.
    """
    names = sorted(names) if isinstance(names, Set) else list(names)
    close = near(given, names)
    suggestion = f"did you mean {close[0]}? " if close else ""
    if close and len(names) > 20:
        return f"{suggestion}near: {between.join(close)}; {len(names)} are valid"
    return f"{suggestion}valid: {between.join(names)}"


def near(given: str, names: Iterable[str], most: int = 5) -> list[str]:
    """The names that may have been meant: spelt nearly so, then those with it as a word, as lr in lr_rl."""
    lowered = {name.lower(): name for name in sorted(names)}
    found = difflib.get_close_matches(given.lower(), lowered, n=most, cutoff=0.6)
    found += [name for name in lowered if given.lower() in re.split("[^a-z0-9]", name)]
    return [lowered[name] for name in dict.fromkeys(found)][:most]


def parse_value(text: str, kind: type) -> bool | int | float | str:
    """Reads one value.

    Args:
        text: what was typed. Whole numbers may be written 1000000, 1_000_000 or 1e6.
        kind: bool, int, float or str.

    Returns:
        The value; numbers are finite.

    Raises:
        ValueError: it is not of that kind. The message is a reason to follow the value.
    """
    if kind is str:
        return text
    wrong = ValueError(f"not {KINDS[kind]}")
    text = text.strip()
    if kind is bool:
        try:
            return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
        except KeyError:
            raise wrong from None
    if kind is int:
        try:
            return int(text)
        except ValueError:
            pass  # 1e6 is a whole number too.
    try:
        number = float(text)
    except ValueError:
        raise wrong from None
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    if kind is int:
        if number != int(number):
            raise wrong
        return int(number)
    return number


def linear(start: float, end: float, steps: int, now: int) -> float:
    """The linear schedule from start to end over so many env steps, constant afterwards."""
    return end if now >= steps else start + (end - start) * (now / steps)


class Weight(float):
    """The weight of an objective that is more than one number; as a float it is that of the first env step.

    Attributes:
        final: where it goes to, linearly, and then stays.
        steps: env steps until it is there; 0 where it does not change.
        ratio: whether it is the share of RL's gradient on the encoder that the objective's is held at, see
            `srl_jax.learning.weights`, and not a factor of the loss.
    """

    final: float
    steps: int
    ratio: bool

    def __new__(cls, start: float, final: float | None = None, steps: int = 0, ratio: bool = False):
        weight = super().__new__(cls, start)
        weight.final, weight.steps, weight.ratio = float(start if final is None else final), steps, ratio
        return weight

    def __repr__(self) -> str:
        """What `parse_weight` reads."""
        changes = f"->{self.final!r}@{self.steps}" if self.steps else ""
        return f"{'ratio:' if self.ratio else ''}{float(self)!r}{changes}"

    def at(self, env_steps: int) -> float:
        """The number after so many env steps."""
        return linear(float(self), self.final, self.steps, env_steps)

    def __eq__(self, other: object) -> bool:
        return repr(self) == repr(other)

    def __ne__(self, other: object) -> bool:  # float has its own
        return not self == other

    __hash__ = float.__hash__


def parse_change(text: str, kind: type) -> tuple[Any, Any, int]:
    """The two numbers and the count of `start->end@count`.

    Raises:
        ValueError: it is not such a text.
    """
    start, _, rest = text.partition("->")
    end, _, count = rest.partition("@")
    return parse_value(start, kind), parse_value(end, kind), parse_value(count, int)  # type: ignore[return-value]


def parse_weight(text: str) -> float:
    """Reads a weight: `0.5`, `1->0.01@200000` (over env steps), `ratio:0.1` or `ratio:0.1->0.01@200000`.

    Raises:
        ValueError: it is none of these. The message is a reason to follow the value.
    """
    kind, colon, numbers = text.strip().rpartition(":")
    changes = "->" in numbers
    if not (colon or changes):
        return parse_value(text, float)  # type: ignore[return-value]
    wrong = ValueError("not a weight: a number, 1->0.01@200000 (until that env step), or ratio: before these")
    if kind != ("ratio" if colon else ""):
        raise wrong
    try:
        if changes:
            start, final, until = parse_change(numbers, float)
        else:
            start, until = parse_value(numbers, float), 0
            final = start
        for number in (start, final):
            Info(float, "", minimum=0).check(number)
        Info(int, "", minimum=1 if changes else 0).check(until)
    except ValueError:
        raise wrong from None
    return Weight(start, final, until, bool(colon))


def has_ratio(text: str) -> bool:
    """Whether a specification's option `weight` is a ratio; False where it cannot be read."""
    try:
        return getattr(parse_weight(split(text)[1][WEIGHT]), "ratio", False)
    except (ValueError, KeyError, SpecError):
        return False


def value_text(value: bool | int | float | str) -> str:
    """The inverse of `parse_value`, exact for floats."""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value)


class Info(NamedTuple):
    """What a value may be.

    Attributes:
        kind: bool, int, float, str, or tuple (of str: a flag that may be repeated).
        help: one line for --help.
        unit: "env steps", say; empty where there is none.
        minimum: the smallest value; None for no limit but `LIMITS`. Likewise `maximum`.
        above: the value must be larger than this.
        choices: the valid texts; empty for any.
        optional: the value may be None, written "off".
        flag: the flag's name where it is not the field's.
    """

    kind: type
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    optional: bool = False
    flag: str = ""

    def check(self, value: Any) -> None:
        """Raises ValueError, a reason that follows the value, where the value is not allowed."""
        if value is None and self.optional:
            return
        if self.choices and value not in self.choices:
            raise ValueError(choices_text(str(value), self.choices))
        unit = f" ({self.unit})" if self.unit else ""
        if self.minimum is not None and not value >= self.minimum:
            raise ValueError(f"must be at least {self.minimum:g}{unit}")
        if self.above is not None and not value > self.above:
            raise ValueError(f"must be above {self.above:g}{unit}")
        maximum = LIMITS.get(self.kind) if self.maximum is None else self.maximum
        if maximum is not None and not value <= maximum:
            raise ValueError(f"must be at most {maximum:.10g}{unit}")
        if self.kind in LIMITS and not value >= -LIMITS[self.kind]:
            raise ValueError(f"must be at least {-LIMITS[self.kind]:.10g}{unit}")

    def parse(self, text: str) -> Any:
        """The value of a text, checked; of one element's text where the kind is tuple.

        Raises:
            ValueError: a reason that follows the text.
        """
        if self.optional and text.strip().lower() in ("off", "none"):
            return None
        try:
            value = parse_value(text, str if self.kind is tuple else self.kind)
        except ValueError as error:
            unit = f" ({self.unit})" if self.unit else ""
            raise ValueError(f"{error}{unit}") from None
        self.check(value)
        return value


def check_size(name: str, value: int, least: int = 1) -> None:
    """Raises ValueError where a layer's size is below `least` or so large that a typing error is likelier."""
    if not least <= value <= MOST_UNITS:
        raise ValueError(f"{name} must be at least {least} and at most {MOST_UNITS}")


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Raises ValueError where an option's value is none of those that it may have."""
    if value not in choices:
        raise ValueError(f"{name}: {choices_text(value, choices)}")


def split(text: str) -> tuple[str, dict[str, str]]:
    """Cuts `name:key=value,...` into the name and the texts of its options; knows no registry.

    Raises:
        SpecError: no name, an option that is not key=value, or a key given twice.
    """
    name, colon, rest = text.strip().partition(":")
    name = name.strip()
    if not name:
        raise SpecError("has no name; write name or name:key=value,key=value")
    options: dict[str, str] = {}
    for part in rest.split(",") if colon else ():
        key, equals, value = part.partition("=")
        key = key.strip()
        if not equals or not key:
            raise SpecError(f"{part.strip()!r} is not key=value; write name:key=value,key=value")
        if key in options:
            raise SpecError(f"{key} is given twice")
        options[key] = value.strip()
    return name, options


def join(name: str, options: Mapping[str, Any]) -> str:
    """The inverse of `split`, for values of any kind."""
    if not options:
        return name
    return name + ":" + ",".join(f"{key}={value_text(value)}" for key, value in options.items())


def overlaid(base: str, text: str) -> str:
    """What a specification is that is given beside another one.

    Args:
        base: `name:key=value,...`, of a preset, say.
        text: `:key=value,...` changes these options of the base; anything else takes its place.

    Raises:
        SpecError: either is not the syntax, where the base is changed.
    """
    if not text.lstrip().startswith(":"):
        return text
    name, options = split(base)
    return join(name, options | split(name + text.lstrip())[1])


def needs(**options: str) -> Callable[[Callable], Callable]:
    """Says above a factory what its options need: `@needs(tau="target=slow")`, see `srl_jax.needs`."""

    def declared(factory: Callable) -> Callable:
        factory.__dict__["needs"] = options
        return factory

    return declared


def needs_of(factory: Callable) -> dict[str, str]:
    """{option: what it needs} of a factory, or of a functools.partial of one."""
    while isinstance(factory, functools.partial):
        factory = factory.func
    return getattr(factory, "__dict__", {}).get("needs", {})


def option_defaults(factory: Callable) -> dict[str, Any]:
    """The options of a factory: its keyword-only parameters with their defaults, in order.

    Raises:
        TypeError: a keyword-only parameter whose default is not a bool, int, float or str.
    """
    defaults = {}
    for parameter in inspect.signature(factory).parameters.values():
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
            if type(parameter.default) not in KINDS:
                name = getattr(factory, "__name__", factory)
                raise TypeError(f"{name}: {parameter.name} needs a bool, int, float or str default")
            defaults[parameter.name] = parameter.default
    return defaults


def parse(text: str, registry: Mapping[str, Callable], flag: str = "") -> Spec:
    """Reads `name:key=value,...` against a registry.

    Args:
        text: the specification, for example `sac_ae:features=256`.
        registry: name -> factory; its keyword-only parameters with defaults are the options.
        flag: names the flag in errors, without dashes.

    Returns:
        The Spec. Options have their default's type; numbers are within `LIMITS`, and not negative
        unless the default is.

    Raises:
        SpecError: unknown name or option, wrong type, out of range, or not the syntax; one line.
    """
    where = _where(flag, text)
    try:
        name, texts = split(text)
    except SpecError as error:
        raise SpecError(f"{where}: {error}") from None
    if name not in registry:
        raise SpecError(
            f"{where}: no {name!r}; {choices_text(name, registry)}; --import=FILE.py registers your own"
        )
    defaults = option_defaults(registry[name])
    options: dict[str, Any] = {}
    for key, value in texts.items():
        if key not in defaults:
            known = ", ".join(f"{k}={value_text(v)}" for k, v in defaults.items()) or "none"
            close = near(key, defaults, most=1)
            suggestion = f"did you mean {close[0]}? " if close else ""
            raise SpecError(
                f"{where}: {name} has no option {key!r}; {suggestion}options and defaults: {known}"
            )
        default = defaults[key]
        hint = f" (default {value_text(default)})"
        try:
            read = parse_weight if key == WEIGHT and type(default) is float else None
            options[key] = read(value) if read else parse_value(value, type(default))
        except ValueError as error:
            raise SpecError(f"{where}: {key}={value} is {error}{hint}") from None
        if type(default) in (int, float):
            if options[key] < 0 <= default:
                raise SpecError(f"{where}: {key}={value} must not be negative{hint}")
            try:
                Info(type(default), "").check(options[key])
            except ValueError as error:
                raise SpecError(f"{where}: {key}={value} {error}") from None
    options = {key: options[key] for key in defaults if key in options}
    return Spec(name, options, {**defaults, **options}, flag, needs_of(registry[name]), defaults)


def _where(flag: str, text: str) -> str:
    text = " ".join(text.split())
    return f"--{flag}={text}" if flag else repr(text)
