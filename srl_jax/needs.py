"""What an option or a flag needs beside it to be read at all; where that is missing, it is refused.

A need is a text: `noisy=true`, `masked!=0`, the name of a fact of the run, or several of these with commas,
all of which must hold. `srl_jax.checks.NEEDS` has those of the fields of Config, and `FACTS` beside it the
facts; an option of a row has its need by `srl_jax.specs.needs`. What a need names is another option of the
same row, a field of Config, or an option of --rl, `rl:prioritized=true`. Imports no jax.

A value that was given and that nothing reads is refused, unless it is the default. One that a preset or an
earlier run brings is not: it takes its default, so that config.json says what holds.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from srl_jax.errors import ConfigError
from srl_jax.specs import Spec, SpecError, parse_value, value_text

if TYPE_CHECKING:
    from srl_jax.config import Config
    from srl_jax.types import Objective


class _Everything(frozenset[str]):
    def __contains__(self, name: object) -> bool:
        return True


EVERYTHING: Collection[str] = _Everything()
"""What was given, where nobody says what was: all that differs from its default."""


class Unread(ConfigError):
    """A flag that was given and that nothing reads; one line.

    Attributes:
        field: of Config.
    """

    def __init__(self, field: str, message: str):
        super().__init__(message)
        self.field = field


UNKNOWN = object()
"""The value of what is not known, or is not there; every need of it holds."""


class Run(NamedTuple):
    """What is known of a run when it is asked what that reads.

    Attributes:
        config: its configuration.
        needs: {field: need}; what is not there is always read.
        facts: {name: (Run) -> why it does not hold, or ""}.
        rl: --rl, where the registry is known.
        objectives: likewise.
        terms: the objectives by name, where they have been built.
        heads: whether one of them has parameters of its own; None where nobody knows.
    """

    config: "Config"
    needs: Mapping[str, str]
    facts: "Mapping[str, Callable[[Run], str]]"
    rl: Spec | None = None
    objectives: tuple[Spec, ...] | None = None
    terms: "Mapping[str, Objective] | None" = None
    heads: bool | None = None

    def look(self, name: str) -> Any:
        """The value of a field, or of an option of --rl; or `UNKNOWN`."""
        _, colon, option = name.partition(":")
        if colon:
            return self.rl.resolved.get(option, UNKNOWN) if self.rl else UNKNOWN
        return getattr(self.config, name, UNKNOWN)

    def lacks(self, need: str, own: Mapping[str, Any] | None = None) -> str:
        """Why nothing reads what has this need, "without noisy=true", say; "" where something does.

        Args:
            need: see above.
            own: the options of the row whose option has it; None for a field.
        """
        for part in filter(None, need.split(",")):
            if part in self.facts:
                if why := self.facts[part](self):
                    return why
                continue
            name, sign, text = re.split("(!?=)", part, maxsplit=1)
            of_row = own is not None and name in own
            value = own[name] if own is not None and of_row else self.look(name)
            if value is UNKNOWN or (value == parse_value(text, type(value))) == (sign == "="):
                continue
            shown = name if of_row else f"--{name.replace(':', '=:')}"
            if sign == "!=" and text:
                return f"with {shown}={text}"
            return f"without {shown}={text}" if text else f"without {shown}"
        return ""

    def unread(self) -> Iterator[tuple[str, str]]:
        """(field, why nothing reads it), of each whose value is not the default."""
        defaults = _defaults()
        for name, need in self.needs.items():
            default = getattr(defaults, name)
            changed = getattr(self.config, name) != default
            if name == "rl":  # which may be the default written out
                changed = self.rl is not None and (self.rl.name != default or bool(self.rl.changed))
            if changed and (why := self.lacks(need)):
                yield name, why

    def unread_options(self, spec: Spec) -> Iterator[tuple[str, str]]:
        """(option, why nothing reads it), of each whose value is not the default."""
        for option in spec.changed:
            if why := self.lacks(spec.needs.get(option, ""), spec.resolved):
                yield option, why

    def refuse(self, given: Collection[str]) -> None:
        """Raises `Unread` where a field was given that nothing reads.

        Args:
            given: names of fields, of options of --rl, `rl:alpha`, and of objectives', `spr:tau`.
        """
        for name, why in self.unread():
            if name in given:
                value = value_text(getattr(self.config, name))
                raise Unread(name, f"--{name}={value}: nothing reads it {why}; leave it out")

    def in_force(self) -> "Config":
        """The configuration, with defaults where nothing reads what it has."""
        run, defaults = self, _defaults()
        unread: dict[str, Any]
        while unread := {name: getattr(defaults, name) for name, _ in run.unread()}:
            config = dataclasses.replace(run.config, **unread)
            run = run._replace(config=config, rl=None if "rl" in unread else run.rl)
        return run.config

    def spec_in_force(self, spec: Spec, given: Collection[str] = ()) -> Spec:
        """A row, with defaults where nothing reads what its options are.

        Args:
            spec: of --rl, --encoder or an objective.
            given: see `refuse`.

        Raises:
            SpecError: one of these is an option that nothing reads; one line that names the flag.
        """
        prefix = spec.name if spec.flag == "objective" else spec.flag
        for option, why in self.unread_options(spec):
            if f"{prefix}:{option}" in given:
                raise SpecError(f"{spec.where}: nothing reads {option} {why}; leave it out")
        while unread := [option for option, _ in self.unread_options(spec)]:
            spec = spec.without(unread)
        return spec


@functools.cache
def _defaults() -> "Config":
    from srl_jax.config import Config

    return Config()
