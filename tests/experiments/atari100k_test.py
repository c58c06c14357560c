"""The presets atari100k/* are what docs/atari100k.md says, value by value, and nothing beside."""

import dataclasses
import itertools
import re
from pathlib import Path
from typing import Any

import pytest

from experiments.presets import PRESETS, preset_values
from experiments.protocols import PROTOCOLS
from srl_jax import encoders, objectives, rl, specs
from srl_jax.config import Config, resolve, unresolved
from srl_jax.specs import value_text

PAGE = Path(__file__).resolve().parents[2] / "docs" / "atari100k.md"


def table(corner: str) -> dict[str, dict[str, str]]:
    """{column: {row: cell}} of the page's table that has this in its corner, less the marks of its notes."""
    lines = itertools.dropwhile(
        lambda line: not line.startswith(f"| {corner} |"), PAGE.read_text(encoding="utf-8").splitlines()
    )
    found = itertools.takewhile(lambda line: line.startswith("|"), lines)
    names, _, *rows = [[cell.strip(" ¹²³⁴⁵⁶") for cell in line.strip("|").split("|")] for line in found]
    return {name: {row[0]: row[i] for row in rows} for i, name in enumerate(names) if i}


def same(value: str, wanted: str) -> bool:
    """Whether two texts are equal, or equal numbers."""
    try:
        return float(value) == float(wanted)
    except ValueError:
        return value == wanted


TABLE = table("setting")
OF_ALL = table("of all presets")["value"]


def settings(config: Config) -> dict[str, tuple[Any, Any]]:
    """{setting: its value and its default} of a resolved configuration: fields, and options of its rows."""
    found = {field.name: (getattr(config, field.name), field.default) for field in dataclasses.fields(config)}
    names = [specs.split(text)[0] for text in config.objectives]
    del found["objectives"]
    found["objective"] = " + ".join(names) or "-", "-"
    registries = {"rl": rl.REGISTRY, "encoder": encoders.REGISTRY}
    parsed = {kind: specs.parse(getattr(config, kind), rows, kind) for kind, rows in registries.items()}
    found |= {kind: (spec.name, getattr(Config, kind)) for kind, spec in parsed.items()}
    parsed |= {
        name: specs.parse(text, objectives.REGISTRY)
        for name, text in zip(names, config.objectives, strict=True)
    }
    for owner, spec in parsed.items():
        found |= {f"{owner} {name}": (x, spec.defaults[name]) for name, x in spec.resolved.items()}
    return found


def test_every_preset_has_its_column_and_a_source():
    assert [f"atari100k/{name}" for name in TABLE] == [n for n in PRESETS if n.startswith("atari100k/")]
    (sources,) = table("preset").values()
    assert [name for cell in sources for name in re.findall(r"`(\w+)`", cell)] == [*TABLE]


@pytest.mark.parametrize("name", TABLE)
def test_a_preset_has_the_tables_values_and_else_defaults(name):
    config = Config(**preset_values(f"atari100k/{name}"))
    config = unresolved(resolve(config, rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY))
    told = {**OF_ALL, **TABLE[name]}
    protocol = PROTOCOLS.get(told.pop("protocol"), {})
    assert all(getattr(config, field) == x for field, x in protocol.items() if field != "eps_eval")
    for setting, (value, default) in settings(config).items():
        wanted = told.pop(setting, "-")
        if wanted == "-":
            assert value == protocol.get(setting, default), setting
        else:
            assert same(value_text(value), wanted), (setting, value, wanted)
    assert set(told.values()) <= {"-"}, told
