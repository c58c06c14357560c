"""The registry of games: names, their canonical text, rows of one's own, and what `make` does with them."""

import pathlib
import re
import sys

import pytest

from srl_jax import envs
from srl_jax.envs import games
from srl_jax.errors import ConfigError
from srl_jax.plugins import Registry
from srl_jax.specs import SpecError

GYM = "gymnasium:id={},grey=false,render=false,frame_skip=1,max_steps=0"


def test_the_57_games():
    assert len(games.ATARI_57) == len(set(games.ATARI_57)) == 57
    assert list(games.ATARI_57) == sorted(games.ATARI_57)
    assert tuple(envs.NAMES) == games.ATARI_57 + ("Catch", "CatchDistractor")
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


@pytest.mark.parametrize(
    ("typed", "canonical"),
    [
        ("Pong", "Pong"),
        ("atari:game=Pong", "Pong"),
        ("Catch", "Catch"),
        ("catch", "Catch"),
        (" catch:background=none,ball=3 ", "Catch"),
        ("catch:background=moving", "CatchDistractor"),
        ("catch:background=static,ball=1e0", "catch:ball=1,background=static"),
        ("gymnasium:id=MiniGrid-Empty-5x5-v0", GYM.format("MiniGrid-Empty-5x5-v0")),
        ("my.module:ns/MyEnv-v0", GYM.format("my.module:ns/MyEnv-v0")),
        ("my:E-v0,grey=1", GYM.format("my:E-v0").replace("grey=false", "grey=true")),
    ],
)
def test_a_game_has_one_canonical_name(typed, canonical):
    assert envs.canonical(typed) == canonical == envs.canonical(canonical)


@pytest.mark.parametrize("name", envs.NAMES)
def test_a_name_of_its_own_is_canonical(name):
    assert envs.canonical(name) == name


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("Pogn", "did you mean Pong? valid: an Atari-57 game (Pong, MsPacman, ...), Catch, "),
        ("pong", "did you mean Pong?"),
        ("ALE/Pong-v5", "did you mean Pong?"),
        ("PongNoFrameskip-v4", "did you mean Pong?"),
        ("MiniGrid-Empty-5x5-v0", "did you mean gymnasium:id=MiniGrid-Empty-5x5-v0?"),
        ("cath:ball=2", "did you mean catch?"),
        ("Ctach", "did you mean Catch?"),
        ("Asterixx", "did you mean Asterix?"),
        ("", "valid: an Atari-57 game"),
        ("nothing:", "valid: an Atari-57 game"),
        ("Catch:ball=2", "did you mean catch?"),
        ("catch:bal=2", "catch has no option 'bal'; did you mean ball?"),
        ("catch:ball=0", "ball must be at least 1 and at most 12 (pixels of a frame of 84 x 84)"),
        ("catch:ball=13", "ball must be at least 1"),
        ("catch:background=mving", "did you mean moving? valid: none, static, moving, reward"),
        ("atari:game=Pogn", "'Pogn' is not one of the 57 Atari games; did you mean Pong?"),
        ("gymnasium", "id is missing; write gymnasium:id=MiniGrid-Empty-5x5-v0, say"),
        ("my:E v0", "id='my:E v0' is none"),
        ("my:E-v0,gray=1", "gymnasium has no option 'gray'; did you mean grey?"),
        ("my:E-v0,frame_skip=0", "frame_skip must be at least 1"),
    ],
)
def test_what_is_no_game_is_refused_in_one_line(typed, says):
    for call in (envs.game, envs.canonical, lambda text: envs.make(text, num_envs=1, seed=0)):
        with pytest.raises(SpecError, match=rf"^--game=(gymnasium:id=)?{re.escape(typed)}: ") as raised:
            call(typed)
        assert says in str(raised.value)
        assert "\n" not in str(raised.value) and len(str(raised.value)) < 250


def test_a_list_that_was_cut_at_commas():
    parts = "catch:ball=2,background=static,Pong,my:E-v0,grey=true,catch,Catch".split(",")
    expected = ["catch:ball=2,background=static", "Pong", envs.canonical("my:E-v0,grey=true"), "Catch"]
    assert envs.several(parts) == expected and envs.several([]) == []
    assert envs.several(["Pong", "3"]) == ["Pong", "BattleZone", "NameThisGame", "Phoenix"]
    with pytest.raises(SpecError, match="^--games=Pang: did you mean Pong"):
        envs.several(["Pang"])
    # A plug-in may bring along what is not known here, and no more.
    assert envs.several(["mine", "catch", "catch:ball=3"], others=True) == ["mine", "Catch"]
    assert envs.several(["my:E-v0"], others=True) == envs.several(["my:E-v0"]) == [envs.canonical("my:E-v0")]
    with pytest.raises(SpecError, match="^--games=catch:bal=2: catch has no option"):
        envs.several(["catch:bal=2"], others=True)
    with pytest.raises(SpecError, match=r"^--games=7: valid: .* suite .*\(26, 5, 3, signed, thesis\)"):
        envs.several(["7"])


def test_suites_are_of_atari_games_and_as_large_as_their_names_say():
    for name, its in envs.SUITES.items():
        assert set(its) <= set(envs.ATARI_57) and len(set(its)) == len(its)
        assert not name.isdigit() or len(its) == int(name)
    assert set(envs.SUITES["3"]) < set(envs.SUITES["5"])
    assert set(envs.SUITES["signed"]) < set(envs.SUITES["26"])


def test_directories_of_games():
    assert envs.file_name("Pong") == "Pong"
    assert envs.file_name("catch:ball=2,background=static") == "catch_ball=2_background=static"
    assert "/" not in envs.file_name("gymnasium:id=ns/E-v0")


def test_what_rows_say_of_their_games():
    pong, catch, own = (envs.game(text) for text in ("Pong", "catch:ball=2", "my:E-v0,frame_skip=3"))
    assert (pong.frames_per_step, catch.frames_per_step, own.frames_per_step) == (4, 1, 3)
    assert (pong.lives, catch.lives, own.lives) == (True, False, False)
    assert {"sticky_actions", "noop_max"} <= set(pong.options) and catch.options == own.options == ()
    assert (pong.kind, catch.kind, own.kind) == ("atari", "catch", "gymnasium my:E-v0")
    assert catch.frame_sizes == (42, 84) and not pong.frame_sizes and not own.frame_sizes
    assert (pong.presets, catch.presets, own.presets) == ("thesis", "small", "thesis")


def test_a_row_of_ones_own(monkeypatch):
    registry = Registry("envs", games.REGISTRY, games.NAMES)
    monkeypatch.setattr(games, "REGISTRY", registry)
    register, made = registry.register, []

    def factory(*, speed: int = 1):
        if speed > 9:
            raise ValueError("speed must be at most 9")
        return envs.Game(make=lambda **options: made.append((speed, options)), scores=(0.0, 5.0))

    register("dot", factory)
    register("dot", factory)  # a file that is imported twice
    assert envs.canonical("dot") == "dot:speed=1"
    assert envs.game("dot").kind == "dot"
    envs.make("dot:speed=2", num_envs=3, seed=4, sticky_actions=0.5)
    assert made == [(2, {"num_envs": 3, "seed": 4, "frame_size": 84})]
    with pytest.raises(SpecError, match="did you mean dot.*module:Name-v0, dot$"):
        envs.game("dott")
    with pytest.raises(SpecError, match="--game=dot:speed=10: speed must be at most 9"):
        envs.game("dot:speed=10")
    for name in ("catch", "Pong", "a:b", ""):
        with pytest.raises(ConfigError, match="has a row of that name|letters, digits"):
            register(name, lambda: None)
    with pytest.raises(ConfigError, match="speed needs a bool, int, float or str default"):
        register("other", lambda *, speed: None)
    assert "other" not in registry


def test_make_names_the_game_that_cannot_be_made(monkeypatch):
    def refuse(**options):
        raise ConfigError("cannot be made: why")

    monkeypatch.setattr(games, "REGISTRY", {**games.REGISTRY, "dot": lambda: envs.Game(make=refuse)})
    with pytest.raises(ConfigError, match="^--game=dot: cannot be made: why$"):
        envs.make("dot", num_envs=1, seed=0)


def test_without_ale_py_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ale_py", None)
    monkeypatch.setitem(sys.modules, "ale_py.vector_env", None)
    monkeypatch.delitem(sys.modules, "srl_jax.envs.atari", raising=False)
    monkeypatch.delattr(envs, "atari", raising=False)
    with pytest.raises(ImportError, match=r"pip install srl-jax\[atari\]"):
        envs.make("Pong", num_envs=1, seed=0)
    assert envs.make("Catch", num_envs=1, seed=0).num_envs == 1


@pytest.mark.parametrize(
    ("game", "label"),
    [
        ("Pong", "Pong"),
        ("catch:background=moving", "CatchDistractor"),
        ("catch:ball=2", "catch:ball=2"),
        ("gymnasium:grey=false,id=A-v0,frame_skip=2", "gymnasium:id=A-v0,frame_skip=2"),
    ],
)
def test_a_label_leaves_out_what_is_as_always(game, label):
    assert envs.label(game) == label
