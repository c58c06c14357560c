"""Policies that learn nothing: their scores in Catch are worked out without playing; the table is whole."""

import csv

import numpy as np
import pytest

from experiments import reference_policies as played
from experiments.runs.collect import differs
from srl_jax.config import Config
from srl_jax.data import POLICIES, published, reference_policies
from srl_jax.envs import ATARI_57
from srl_jax.errors import ConfigError
from tests.in_process import parse

CATCH = ("Catch", "CatchDistractor")
THESIS = ("Breakout", "Enduro", "MsPacman", "Pong", "Qbert", "Seaquest", "SpaceInvaders")


def catch_mean(moves):
    """The exact mean return in Catch of a policy that moves the paddle by any of `moves`, all as likely.

    Over first columns of the ball (1 to 82), drifts (-3 to 3), falls (7) and places of the paddle (24 to 59).
    """
    columns = np.arange(84)
    x, drift = np.arange(1, 83)[:, None], np.arange(-3, 4)
    means = []
    for steps in (20, 21, 22, 23, 24, 17, 18):
        paddle = ((columns >= 24) & (columns < 60)) / 36
        for _ in range(steps):
            moved = np.zeros(84)
            for move in moves:
                np.add.at(moved, np.clip(columns + move, 6, 77), paddle / len(moves))
            paddle = moved
        # The walls fold the ball's way: there and back are 162 columns.
        way = (x - 1 + drift * steps) % 162
        ball = 1 + np.minimum(way, 162 - way)
        caught = (np.abs(ball[..., None] - columns) <= 7) @ paddle
        means.append(2 * caught.mean() - 1)
    return np.mean(means)


EXACT = {"random": catch_mean([-4, 0, 4]), "no-op": catch_mean([0])}


def test_a_fixed_paddle_by_hand():
    # It covers 15 of the 84 columns, none of them near a wall, and the ball is nearly as likely in any of 82.
    assert EXACT["no-op"] == pytest.approx(2 * 15 / 82 - 1, abs=0.01)


@pytest.mark.parametrize("game", CATCH)
@pytest.mark.parametrize("policy", POLICIES)
def test_catch_agrees_with_the_exact_value(game, policy):
    row = reference_policies(game)[policy]
    assert row.episodes == 5_000
    # Of returns that are -1 or 1 the mean says all.
    assert row.return_std == pytest.approx(np.sqrt((1 - row.return_mean**2) * 5_000 / 4_999), abs=1e-5)
    assert abs(row.return_mean - EXACT[policy]) < 3 * row.return_std / np.sqrt(row.episodes)
    assert 17 <= row.length_mean <= 24


@pytest.mark.parametrize("game", [*THESIS, *CATCH])
def test_the_table_is_complete(game):
    rows = reference_policies(game)
    assert tuple(rows) == POLICIES
    for policy, row in rows.items():
        assert (row.game, row.policy) == (game, policy)
        assert row.source.startswith(f"python -m experiments.reference_policies --games={game} ")
        assert None not in (row.return_std, row.length_mean, row.eval_max_steps)
        if game in THESIS:
            assert row.episodes == {"random": 30, "no-op": 10}[policy]
            assert (row.sticky_actions, row.noop_max) == (0.0, 30)
            assert differs(row, Config(game=game)) == ""
            told = differs(row, Config(game=game, sticky_actions=0.25))
            assert told == "sticky actions 0.0 (here 0.25)"
        else:  # which has no such thing
            assert differs(row, Config(game=game, sticky_actions=0.25, noop_max=1)) == ""


def test_other_games_have_the_published_score_of_a_random_policy():
    for game in set(ATARI_57) - set(THESIS):
        (row,) = reference_policies(game).values()
        assert (row.policy, row.return_mean) == ("random", published(game)[0].score)
        assert "dqn_zoo" in row.source and row.episodes is None
        assert differs(row, Config(game=game)).startswith("published, ")
    assert reference_policies("Chess") == {}


def _run(*arguments):
    return played.run(parse(played, *arguments))


def test_the_same_games_at_any_frame_size():
    rows = [played.play("random", Config(game="Catch", frame_size=size), 50) for size in (42, 84)]
    assert rows[0] == rows[1]


def test_rows_are_printed_and_put_into_a_file(tmp_path, capsys):
    path = tmp_path / "mine.csv"
    assert _run("--games=Catch", "--episodes=20", f"--out={path}") == 0
    printed = capsys.readouterr().out.splitlines()
    assert sorted(printed) == sorted(path.read_text().splitlines()) and len(printed) == 3
    # The command in a row plays its games again; other rows stay.
    with path.open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["policy"], second["policy"]) == POLICIES
    before = path.read_text()
    assert _run(*second["source"].split()[3:], f"--out={path}") == 0
    assert path.read_text() == before
    assert (
        _run("--games=CatchDistractor", "--policies=no-op", "--episodes=1", "--seed=3", f"--out={path}") == 0
    )
    *old, new = path.read_text().splitlines(keepends=True)
    assert "".join(old) == before and "--episodes=1 --seed=3" in new
    assert played._read(path)[2].return_std is None  # of a single game


def test_what_was_played_until_a_signal_is_kept(tmp_path, capsys, monkeypatch):
    caught = []
    monkeypatch.setattr(played, "signals", lambda: played.contextlib.nullcontext(caught))
    update = played.update
    monkeypatch.setattr(played, "update", lambda *row: caught.append(15) or update(*row))
    path = tmp_path / "mine.csv"
    assert _run("--games=Catch", "--episodes=2", f"--out={path}") == 128 + 15
    assert [row.policy for row in played._read(path)] == ["random"]
    assert "no-op" not in capsys.readouterr().out


def test_a_game_without_an_action_that_does_nothing(tmp_path, capsys):
    arguments = "--games=examples.own_environment:Dot-v0,grey=true", "--episodes=2", "--eval_max_steps=5"
    with pytest.raises(ConfigError, match="--policies=no-op: gymnasium:id=.* has no action NOOP; valid"):
        _run(*arguments)
    (_, row) = csv.reader(capsys.readouterr().out.splitlines())  # it was played before
    assert row[0].startswith("gymnasium:id=examples.own_environment:Dot-v0,grey=true")
    assert row[1] == "random" and row[6:8] == ["", ""]  # it has no sticky actions, and no no-ops


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--games=Pnog"], "--games=Pnog: did you mean Pong"),
        (["--games="], "--games: names none"),
        (["--policies=noop"], "--policies=noop: did you mean no-op"),
        (["--out=FOLDER/x.txt"], "--out=FOLDER/x.txt: must end in .csv"),
        (["--out=FOLDER/no/x.csv"], "--out=FOLDER/no/x.csv: no such directory"),
        (["--out=FOLDER/other.csv"], "--out=FOLDER/other.csv: no table of this command"),
        (["--out=FOLDER/folder.csv"], "--out=FOLDER/folder.csv: exists and is not a file"),
    ],
)
def test_bad_input_is_refused_and_nothing_written(tmp_path, capsys, arguments, told):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigError) as error:
        _run(*(text.replace("FOLDER", str(tmp_path)) for text in arguments))
    assert str(error.value).replace(str(tmp_path), "FOLDER").startswith(told)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.csv", "other.csv"]
    assert capsys.readouterr().out == ""
