"""experiments/command_line/help.py: what --help prints."""

import importlib
import re
import subprocess
import sys

import pytest
from absl import flags

from experiments import figures, reference_policies, sweep, train
from experiments.command_line import flags as config_flags
from experiments.command_line import help
from experiments.command_line.cli import COMMANDS
from experiments.presets import PIECES, PIECES_HELP, PRESETS
from srl_jax import encoders, objectives, rl
from srl_jax.config import INFOS
from tests.in_process import parse


def _text(module):
    return help.text("Does a thing.", parse(module))


def test_every_flag_of_training_is_in_one_group():
    names = " ".join(help.GROUPS.values()).split()
    assert len(names) == len(set(names))
    assert set(names) == set(parse(train))
    assert {info.flag or name for name, info in INFOS.items()} <= set(names)


def test_a_flag_is_shown_with_its_default_unit_and_help():
    page = _text(train)
    assert page.startswith("Does a thing.\n\nRun:\n  --preset ")
    assert "\n  --steps=5000000         length of the run [env steps]\n" in page
    assert "\n  --[no]reward_clip       learn from the sign of the reward (default: yes)\n" in page
    assert "repeat this option" not in page
    assert max(map(len, page.split("\nPresets:\n")[0].splitlines())) <= 110


def test_rows_and_their_options_are_listed_below_their_flag():
    page = " ".join(_text(train).split())
    for registry in (rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY):
        for name in registry:
            assert f" {name}:" in page
    assert " inverse:weight=1.0,hidden=256,steps=1 " in page
    assert " sac_ae:features=256,layer_norm=true," in page
    assert " none stands for no logger tensorboard wandb:project= csv --" in page
    assert " double:double=true,dueling=false,noisy=false," in page


def test_every_preset_has_a_line():
    lines = _text(train).split("\nPresets:\n")[1].splitlines()
    names = [line.split()[0] for line in lines]
    assert names == [
        *(name for name in PRESETS if not name.startswith("small/")),
        "small/NAME",
        *(f"PRESET+{piece}" for piece in PIECES),
        *(f"PRESET+objective/{name}" for name in objectives.REGISTRY),
    ]
    assert PIECES_HELP.keys() == PIECES.keys()


def test_a_programs_own_flags_come_first():
    page = _text(sweep)
    assert page.index("\nFlags:\n") < page.index("  --grid") < page.index("\nRun:\n")


@pytest.mark.parametrize("module", [sweep, figures])
def test_what_a_sweep_gives_to_each_run_is_not_shown(module):
    page = _text(module)
    for name in ("game", "seed", "preset", "config", "encoder_from", "policy_from"):
        assert re.search(rf"^  --{name}\b", _text(train), re.M)
        assert not re.search(rf"^  --{name}\b", page, re.M)
    assert "\n  --heads_from=" in page and "\n  --games" in page and help.HIDDEN not in page


@pytest.mark.parametrize("given", ["--verbosity=1", "--verbosit=1"])
def test_flags_that_absl_brings_along_are_neither_taken_nor_suggested(given, capsys):
    values = flags.FlagValues()
    train.define_flags(values)
    of_absl = flags.Flag(flags.IntegerParser(), None, "verbosity", 0, "of logging")
    flags.DEFINE_flag(of_absl, values, module_name="absl.logging")
    with pytest.raises(SystemExit):
        config_flags.parse(["train", given], values)
    name = given.partition("=")[0]
    assert capsys.readouterr().err == f"error: {name}: no such flag; --help lists them all\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_what_it_does_first(name):
    module = importlib.import_module(f"experiments.{COMMANDS[name].module or name}")
    first = help.text(module.__doc__, flags.FlagValues()).splitlines()[0]
    assert f"`srl-jax {name}" in first or name == "figures"


def test_what_is_no_command_is_called_as_the_module_that_it_is():
    about = "`python -m experiments.power`, `python -m experiments.powers.x`"
    told = help.text(about, flags.FlagValues())
    assert told == "`srl-jax power`, `python -m experiments.powers.x`"
    first = help.text(reference_policies.__doc__, flags.FlagValues())
    assert "\n    python -m experiments.reference_policies --games=" in first


def test_help_ends_with_status_0():
    line = [sys.executable, "-m", "srl_jax", "export", "--help"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert "`srl-jax export" in done.stdout.splitlines()[0] and "\n  --encoder " in done.stdout
