"""Tests of experiments.protocols: --protocol, pieces, and the table of docs/atari100k.md."""

import dataclasses
from pathlib import Path

import pytest
from absl import flags

from experiments import train
from experiments.command_line import flags as config_flags
from experiments.command_line import help
from experiments.presets import PRESETS, preset_values
from experiments.protocols import PROTOCOLS, PROTOCOLS_HELP
from srl_jax.config import Config
from srl_jax.specs import value_text
from tests.in_process import parse

PAGE = Path(__file__).resolve().parents[2] / "docs" / "atari100k.md"


def config_of(*arguments):
    return config_flags.config_from_flags(parse(train, *arguments))


def test_the_table_of_the_page_is_the_code():
    lines = PAGE.read_text(encoding="utf-8").partition("## Protocols")[2].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    names, own = rows[0][1:], {row[0]: row[1:] for row in rows[2:]}
    assert names == list(PROTOCOLS) == list(PROTOCOLS_HELP)
    for i, name in enumerate(names):
        found = {field: value_text(value) for field, value in PROTOCOLS[name].items()}
        assert found == {field: values[i] for field, values in own.items()}, name


def test_the_thesis_protocol_is_the_defaults():
    assert all(getattr(Config(), field) == value for field, value in PROTOCOLS["thesis"].items())
    for name in PRESETS:
        if not name.startswith("atari100k/"):  # nothing changes for those
            assert not {"final_games", "full_actions", "sticky_actions"} & preset_values(name).keys()


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_flag_and_a_piece_set_the_same_and_nothing_else(name):
    plain, own = config_of("--preset=atari100k/drq"), PROTOCOLS[name]
    by_flag = config_of("--preset=atari100k/drq", f"--protocol={name}")
    assert by_flag == Config(**preset_values(f"atari100k/drq+protocol/{name}"))
    assert by_flag == dataclasses.replace(plain, **own)
    assert config_of(f"--protocol={name}") == dataclasses.replace(Config(), **own)


def test_flags_beside_a_protocol_win():
    config = config_of("--protocol=machado", "--sticky_actions=0.1", "--final_games=7")
    assert (config.sticky_actions, config.final_games, config.full_actions) == (0.1, 7, True)


def test_a_protocol_over_a_config(tmp_path):
    Config(game="Boxing", gamma=0.9).save(tmp_path)
    config = config_of(f"--config={tmp_path}", "--protocol=spr_100k")
    assert (config.game, config.gamma, config.noop_max) == ("Boxing", 0.9, 31)


def test_a_protocol_that_there_is_not_is_refused_in_a_line(capsys):
    with pytest.raises((SystemExit, config_flags.ConfigError)) as error:
        config_of("--protocol=machdo")
    told = capsys.readouterr().err or str(error.value)
    assert "--protocol=machdo" in told and "machado" in told


def test_help_says_what_each_sets():
    values = flags.FlagValues()
    config_flags.define_config_flags(values)
    text = " ".join("\n".join(help._protocols()).split())
    for name, own in PROTOCOLS.items():
        assert " ".join([name, *(f"--{x}={value_text(value)}" for x, value in own.items())]) in text
