"""The presets atari100k/* are what docs/atari100k.md says, value by value."""

import dataclasses
import re
from pathlib import Path

import pytest

from experiments.presets import PRESETS, preset_values
from experiments.protocols import PROTOCOLS
from srl_jax import encoders, objectives, rl, specs
from srl_jax.config import Config, resolve
from srl_jax.specs import split, value_text

PAGE = Path(__file__).resolve().parents[2] / "docs" / "atari100k.md"


def table() -> dict[str, dict[str, str]]:
    """{preset: {setting: value}} of the first table of the page."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    names = rows[0][1:]
    own = [row for row in rows[2:] if len(row) == len(rows[0])]
    return {name: {row[0]: row[i + 1] for row in own} for i, name in enumerate(names)}


def same(value: str, wanted: str) -> bool:
    """Whether two texts are equal, or equal numbers."""
    try:
        return float(value) == float(wanted)
    except ValueError:
        return value == wanted


TABLE = table()


def test_every_preset_has_its_column():
    assert [f"atari100k/{name}" for name in TABLE] == [n for n in PRESETS if n.startswith("atari100k/")]


@pytest.mark.parametrize("name", TABLE)
def test_presets_are_what_the_table_says(name):
    config = resolve(
        Config(**preset_values(f"atari100k/{name}")), rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY
    )
    values = {field.name: value_text(getattr(config, field.name)) for field in dataclasses.fields(config)}
    for kind in ("encoder", "rl"):
        own, options = split(getattr(config, kind))
        values |= {kind: own} | {f"{kind} {option}": text for option, text in options.items()}
    for own, options in map(split, config.objectives):
        values |= {f"{own} {option}": text for option, text in options.items()}
    if (protocol := TABLE[name]["protocol"]) != "-":
        own = PROTOCOLS[protocol]
        assert all(getattr(config, field) == x for field, x in own.items() if field != "eps_eval")
    values["protocol"] = protocol
    values["objective"] = " + ".join(split(text)[0] for text in config.objectives) or "-"
    for setting, wanted in TABLE[name].items():
        if wanted != "-":
            assert same(values[setting], wanted), (setting, values[setting], wanted)
    assert (config.steps, config.num_envs, config.reward_clip) == (100_000, 1, True)


def test_all_can_be_built_together_with_their_parts():
    for name in TABLE:
        config = Config(**preset_values(f"atari100k/{name}"))
        for text in config.objectives:
            assert specs.parse(text, objectives.REGISTRY, "objective")
        assert re.fullmatch(r"[a-z_0-9]+", name)
