"""The numbers of others: complete, with sources, and compared with a protocol in a line."""

from dataclasses import replace

import pytest

from experiments.runs.collect import differs
from srl_jax.config import Config
from srl_jax.data import (
    Published,
    published,
    reference_policies,
    reference_scores,
    with_reference_scores,
)
from srl_jax.envs import ATARI_57

CATCH = ("Catch", "CatchDistractor")

PONG = Config(game="Pong", steps=1_000_000)


def test_games_that_nobody_has_measured():
    assert reference_scores("catch:ball=1,background=static") == (-1, 1)
    games = ["Pong", "gymnasium:id=A-v0", "catch:ball=2,background=none", "nothing"]
    assert with_reference_scores(games) == ["Pong", "catch:ball=2,background=none"]
    for game in games[1:]:
        assert published(game) == [] and reference_policies(game) == {}
    with pytest.raises(ValueError, match="no reference scores for game gymnasium:id=A-v0; there are"):
        reference_scores("gymnasium:id=A-v0")


def test_every_game_has_a_lower_and_a_higher_reference_score():
    for game in (*ATARI_57, *CATCH):
        low, high = reference_scores(game)
        assert low < high, game
    assert reference_scores("UpNDown") == (533.4, 11693.2)
    assert reference_scores("CatchDistractor") == (-1, 1)


def test_published_scores_begin_with_random_and_human():
    rows = published("Pong")
    assert [(row.method, row.score, row.env_steps) for row in rows[:2]] == [
        ("Random", -20.7, None),
        ("Human", 14.6, None),
    ]
    alien = published("Alien")
    assert [row.method for row in alien[:2]] == ["Random", "Human"]
    assert {row.env_steps for row in alien[2:]} == {100_000}
    assert published("Catch") == []


@pytest.mark.parametrize(
    "game", ["Breakout", "Enduro", "MsPacman", "Pong", "Qbert", "Seaquest", "SpaceInvaders"]
)
def test_published_scores_have_a_source_and_are_there_once(game):
    rows = published(game)
    assert len({(row.method, row.env_steps) for row in rows}) == len(rows) > 20
    for row in rows:
        assert row.source and row.protocol and row.game == game
        assert row.score_of in (None, "training", "evaluation", "best evaluation")
        assert row.sticky_actions in (None, 0.0, 0.25)
        assert row.env_steps is None or 100_000 <= row.env_steps <= 10_000_000


def test_what_differs_is_said_in_a_line():
    (rainbow,) = [r for r in published("Pong") if r[1:3] == ("Dopamine Rainbow", 1_000_000)]
    assert (rainbow.score, rainbow.spread, rainbow.seeds) == (-16.73, 1.85, 5)
    assert differs(rainbow, PONG, seeds=3) == (
        "sticky actions 0.25 (here 0.0), epsilon 0.01 (here 0.005), seeds 5 (here 3), "
        "training score (here the mean of 10 evaluation games)"
    )
    assert "env steps 1,000,000 (here 50,000)" in differs(rainbow, PONG, env_steps=50_000)
    assert "whole games (here cut at 300 env steps)" in differs(rainbow, replace(PONG, eval_max_steps=300))
    same = Published("Pong", "x", 1_000_000, 0.0, None, 3, "evaluation", 0.25, 0.005, "", "")
    assert differs(same, replace(PONG, sticky_actions=0.25), seeds=3) == ""
    unknown = same._replace(seeds=None, score_of=None, sticky_actions=None)
    assert differs(unknown, PONG) == "not known: sticky actions, seeds, kind of score"
    assert differs(published("Pong")[0], PONG) == "not known: sticky actions"
