"""The table of games, and what `make` does with a name."""

import json
import pathlib
import subprocess
import sys

import pytest

from srl_jax import envs
from srl_jax.envs import games


def test_the_57_games():
    assert len(games.ATARI_57) == len(set(games.ATARI_57)) == 57
    assert list(games.ATARI_57) == sorted(games.ATARI_57)
    assert envs.GAMES == games.ATARI_57 + ("Catch", "CatchDistractor")
    thesis = {"Breakout", "Enduro", "MsPacman", "Pong", "Qbert", "Seaquest", "SpaceInvaders"}
    assert thesis <= set(games.ATARI_57)


@pytest.mark.parametrize(
    ("game", "rom"),
    [
        ("Pong", "pong"),
        ("MsPacman", "ms_pacman"),
        ("UpNDown", "up_n_down"),
        ("Jamesbond", "jamesbond"),
        ("Riverraid", "riverraid"),
        ("WizardOfWor", "wizard_of_wor"),
    ],
)
def test_rom_name(game, rom):
    assert games.rom_name(game) == rom


@pytest.mark.parametrize("name", ["pong", "ALE/Pong-v5", "Catch", ""])
def test_rom_name_refuses(name):
    with pytest.raises(ValueError, match="not one of the 57"):
        games.rom_name(name)


def test_every_rom_is_bundled():
    ale_py = pytest.importorskip("ale_py")
    roms = {path.stem for path in (pathlib.Path(ale_py.__file__).parent / "roms").glob("*.bin")}
    names = [games.rom_name(game) for game in games.ATARI_57]
    assert len(set(names)) == 57
    assert set(names) <= roms


def test_make_refuses_an_unknown_name_and_lists_the_valid_ones():
    with pytest.raises(ValueError, match="unknown game 'pong'.*Pong.*CatchDistractor"):
        envs.make("pong", num_envs=1, seed=0)


def test_the_names_cost_no_import():
    code = (
        "import json, sys; from srl_jax.envs import GAMES; "
        "heavy = {'ale_py', 'jax', 'gymnasium', 'numpy'} & set(sys.modules); "
        "print(json.dumps([len(GAMES), sorted(heavy)]))"
    )
    root = pathlib.Path(envs.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, check=True)
    assert json.loads(done.stdout) == [59, []]


def test_without_ale_py_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ale_py", None)
    monkeypatch.setitem(sys.modules, "ale_py.vector_env", None)
    monkeypatch.delitem(sys.modules, "srl_jax.envs.atari", raising=False)
    monkeypatch.delattr(envs, "atari", raising=False)
    with pytest.raises(ImportError, match=r"pip install srl-jax\[atari\]"):
        envs.make("Pong", num_envs=1, seed=0)
    assert envs.make("Catch", num_envs=1, seed=0).num_envs == 1
