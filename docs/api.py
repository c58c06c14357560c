"""Builds the API reference, HTML of the public modules: `python docs/api.py build/docs`.

A warning is an error: an annotation that nothing resolves, or a module that is listed twice.
"""

import dataclasses
import importlib
import inspect
import sys
import typing
import warnings
from pathlib import Path

import jax
import numpy  # noqa: F401  annotations name it
import pdoc

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# `srl_jax` brings what its `__all__` names: `data`, `losses`, `objectives`, `encoders`, `envs`, `statistics`.
PUBLIC = (
    "srl_jax.rl", "!srl_jax.rl.losses", "srl_jax", "srl_jax.types", "srl_jax.loading",
    "srl_jax.learning.update", "srl_jax.learning.modes", "srl_jax.layers", "srl_jax.augment",
    "srl_jax.latents", "srl_jax.window", "srl_jax.envs.base", "srl_jax.specs", "srl_jax.files.metrics",
    "srl_jax.files.loggers", "srl_jax.diagnostics", "srl_jax.plugins", "srl_jax.errors",
)  # fmt: skip


def main(out: str) -> None:
    """Writes the pages.

    Args:
        out: the directory; pages that are there are replaced.

    Raises:
        UserWarning: an annotation cannot be resolved, or a module is listed twice.
    """
    import srl_jax

    # `Array` and `Offsets` have their types only where a type checker reads.
    typing.TYPE_CHECKING = True
    import srl_jax.types

    typing.TYPE_CHECKING = False
    jax.Array.__qualname__ = "Array"  # jax.Array, and not where it is built
    for module in map(importlib.import_module, pdoc.extract.walk_specs(PUBLIC)):
        for value in vars(module).values():
            if inspect.isclass(value) and hasattr(value, "_fields"):
                value.__new__.__module__ = value.__module__  # where its annotations are looked up
                for field in value._fields:  # the docstring has them, and not their numbers
                    getattr(value, field).__doc__ = ""
    # Every flax module has this one, and nobody who reads about it needs it.
    type(vars(srl_jax.layers.Dense)["parent"]).__doc__ = ""
    _document_fields(srl_jax.Config)

    warnings.simplefilter("error")
    pdoc.render.configure(docformat="google", include_undocumented=False, show_source=False)
    pdoc.pdoc(*PUBLIC, output_directory=Path(out))


def _document_fields(config: type) -> None:
    """Appends what `--help` says of each field, and its default, to the docstring of `srl_jax.Config`."""
    lines = [inspect.cleandoc(config.__doc__), "", "Attributes:"]
    for field in dataclasses.fields(config):
        info = field.metadata["info"]
        default = f"{field.default!r} {info.unit}".strip()
        lines.append(f"    {field.name}: {info.help} (default: {default}).")
    config.__doc__ = "\n".join(lines)


if __name__ == "__main__":
    main(*sys.argv[1:])
