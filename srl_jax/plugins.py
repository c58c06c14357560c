"""Registries, and how a user's own file adds rows to them. Imports no jax.

A file registers what it has when it is imported:

    import srl_jax.objectives

    @srl_jax.objectives.register("mine")
    def mine(context, *, weight: float = 1.0): ...

`--import=my_file.py --objective=mine` imports it, and so does a module's name, `--import=my_package.losses`.
An installed package names its rows as entry points of the groups `srl_jax.objectives`, `srl_jax.encoders`,
`srl_jax.rl`, `srl_jax.envs`, `srl_jax.augment` (views) and `srl_jax.loggers`; those are looked up where a
name is in no registry.
"""

import functools
import importlib
import importlib.metadata
import importlib.util
import os
import sys
import traceback
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from srl_jax.errors import ConfigError
from srl_jax.specs import Spec, SpecError, option_defaults


class Registry(dict[str, Callable]):
    """A registry, as of `srl_jax.specs`, to which others may add rows.

    Args:
        kind: of what it has rows, as its package is called: "objectives".
        rows: the package's own.
        reserved: names that mean something else already.
    """

    def __init__(self, kind: str, rows: Mapping[str, Callable], reserved: Collection[str] = ()):
        super().__init__(rows)
        self.kind, self._reserved = kind, reserved
        self._origins: dict[str, str] = {}

    def register(self, name: str, factory: Callable | None = None) -> Callable:
        """Adds a row: `register("mine", factory)`, or `@register("mine")` above the factory.

        Args:
            name: as it is written in `name:key=value,...`.
            factory: takes what the registry's other rows take; its keyword-only parameters, each with a
                default, are the options.

        Returns:
            The factory.

        Raises:
            ConfigError: the name is no identifier or has a row already, or an option has no default.
        """
        if not (isinstance(name, str) and name.isascii() and name.isidentifier()):
            raise ConfigError(
                f"srl_jax.{self.kind} takes no row {name!r}: a name is letters, digits and _, "
                'as in register("mine")'
            )
        if factory is None:
            return functools.partial(self.register, name)
        try:
            option_defaults(factory)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"srl_jax.{self.kind} takes no row {name!r}: {error}") from None
        file = origin(factory)
        # A module that is imported a second time, by another name, says the same again.
        if name in self._reserved or (super().__contains__(name) and self._origins.get(name) != file):
            whose = self._origins.get(name, "the package itself")
            raise ConfigError(
                f"{file} registers {name!r} in srl_jax.{self.kind}, where {whose} has a row of that name; "
                "choose another one"
            )
        self[name], self._origins[name] = factory, file
        return factory

    def __contains__(self, name: object) -> bool:
        """Whether there is such a row; looks for an entry point of that name where there is none.

        Raises:
            ConfigError: two packages have one, or it cannot be imported.
        """
        return super().__contains__(name) or (isinstance(name, str) and self._installed(name))

    def _installed(self, name: str) -> bool:
        group = f"srl_jax.{self.kind}"
        found = {point.value: point for point in importlib.metadata.entry_points(group=group, name=name)}
        if len(found) > 1:
            raise ConfigError(f"{name!r} of {group} is in {' and in '.join(sorted(found))}; uninstall one")
        for value, point in found.items():
            try:
                self.register(name, point.load())
            except Exception as error:
                raise ConfigError(f"{name!r} of {group}, the entry point {value}: {reason(error)}") from error
        return bool(found)


def build(spec: Spec, registry: Mapping[str, Callable], *context: Any, gives: type = object) -> Any:
    """Calls the row's factory: `factory(*context, **spec.resolved)`.

    Args:
        spec: of a row.
        registry: that it is in.
        context: what the registry's factories take.
        gives: what they give.

    Raises:
        SpecError: the factory raised ValueError (two options that do not fit together, say), or it is not of
            this package and raised anything, or gives something else.
    """
    factory = registry[spec.name]
    try:
        found = factory(*context, **spec.resolved)
    except SpecError:
        raise
    except Exception as error:
        if isinstance(error, ValueError):
            why = " ".join(str(error).split())
        elif foreign(factory):
            why = reason(error, Path(origin(factory)))
        else:
            raise
        raise SpecError(f"{spec.where}: {why}") from error
    if not isinstance(found, gives):
        raise SpecError(f"{spec.where}: its factory must give {gives.__name__}, not {type(found).__name__}")
    return found


def located(text: str, flag: str = "import") -> str:
    """What config.json keeps of a value of --import: a file's absolute path, or a module's name.

    Args:
        text: a path, which has a / or ends in .py; or the name of a file here, without .py; or a module's.
        flag: that it came from.

    Raises:
        ConfigError: there is no such file, or it is no Python file.
    """
    path = Path(os.path.abspath(os.path.expanduser(text)))
    if not _is_path(text):
        here = path.with_name(f"{path.name}.py")
        return str(here) if os.path.isfile(here) else text
    if path.suffix != ".py":
        raise ConfigError(f"--{flag}={text}: must be a file that ends in .py, or a module's name")
    return str(_checked(str(path), flag, "no such file"))


def load(imports: Iterable[str]) -> None:
    """Imports files and modules; see `imported`."""
    for text in imports:
        imported(text)


def imported(text: str, flag: str = "import") -> ModuleType:
    """A file or a module, imported once in a process.

    Args:
        text: as `located` gives it.
        flag: that it came from.

    Raises:
        ConfigError: it is missing, lies in a run directory, or raises an error; one line that names it.
    """
    if text not in _LOADED:
        moved = f"no such file; --{flag}=PATH says where it lies now"
        path = _checked(text, flag, moved) if _is_path(text) else None
        try:
            _LOADED[text] = _import_file(path) if path else importlib.import_module(text)
        except (Exception, SystemExit) as error:
            raise ConfigError(f"--{flag}={text}: {reason(error, path)}") from error
    return _LOADED[text]


_LOADED: dict[str, ModuleType] = {}


def _is_path(text: str) -> bool:
    return "/" in text or os.sep in text or text.endswith(".py")


def _checked(text: str, flag: str, missing: str) -> Path:
    """The path of a file that may be imported.

    Args:
        text: the path.
        flag: that it came from.
        missing: what is said where there is no such file.

    Raises:
        ConfigError: there is none, or it lies in a run directory, which may be somebody else's.
    """
    path = Path(text)
    if not path.is_file():
        raise ConfigError(f"--{flag}={text}: {missing}")
    for folder in path.resolve().parents:
        if (folder / "config.json").exists() and (folder / "metrics.jsonl").exists():
            raise ConfigError(
                f"--{flag}={text}: lies in a run directory, {folder}, from which nothing is imported; copy it"
            )
    return path


def _import_file(path: Path) -> ModuleType:
    # By a name that no other module has; what lies beside the file it may import.
    name = f"srl_jax_import_{path.stem}_{zlib.crc32(os.fsencode(path)):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def reason(error: BaseException, path: Path | None = None) -> str:
    """An error in a line, after the line of the file, if one is named, that it comes from."""
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)
    ]
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines = [error.lineno]
    what = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
    return " ".join(f"{f'line {lines[-1]}: ' if lines else ''}{what}".split())


def foreign(factory: Any) -> bool:
    """Whether a function is written outside this package."""
    return not Path(origin(factory)).is_relative_to(Path(__file__).parent)


def origin(factory: Any) -> str:
    """The file in which a function is written, or its module where that is not known."""
    while isinstance(factory, functools.partial):
        factory = factory.func
    code = getattr(factory, "__code__", None)
    return code.co_filename if code else getattr(factory, "__module__", "") or repr(factory)
