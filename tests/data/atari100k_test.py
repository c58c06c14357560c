"""The published scores after 100,000 env steps: complete, and their aggregates are the published ones."""

import numpy as np
import pytest

from srl_jax import statistics
from srl_jax.data import atari100k, atari100k_methods, published
from srl_jax.envs import ATARI_57, SUITES

METHODS = atari100k_methods()


def means(method):
    """{game: human-normalised mean} [1 run] of the 26 games."""
    scores = atari100k(method)
    return {game: statistics.human_normalised(game, [scores[game].mean]) for game in SUITES["26"]}


def test_every_method_has_the_26_games_and_says_what_it_is():
    assert len(METHODS) == 68 and len(SUITES["26"]) == 26
    for name, about in METHODS.items():
        scores = atari100k(name)
        assert set(SUITES["26"]) <= scores.keys() <= set(ATARI_57), name
        assert about.basis in ("as reported", "rerun by Agarwal et al. 2021", "own runs")
        assert about.source and about.protocol
        of_runs = about.level == "runs"
        assert of_runs == (about.iqm_of_runs is not None) and of_runs | (about.level == "means of games")
        if of_runs:
            assert all(x.runs >= 12 and x.sd >= 0 and x.median is not None for x in scores.values()), name
    assert sum(about.basis == "as reported" for about in METHODS.values()) == 42


def test_numbers_that_were_read_in_the_sources_by_hand():
    assert atari100k("DER, as reported")["RoadRunner"].mean == 9600
    assert atari100k("SPR, as reported")["Pong"].mean == -5.9
    assert atari100k("DER, 100 runs")["Boxing"] == (-0.3085, 2.09448, 0.135, 100)
    assert atari100k("DER, 100 runs")["Amidar"].mean == 125.905
    assert atari100k("BBF")["Breakout"].mean == 370.6
    runs = {x.runs for x in atari100k("BBF, replay ratio 8").values()}
    assert min(runs) == 16 and max(runs) == 60
    with pytest.raises(KeyError):
        atari100k("DER")


@pytest.mark.parametrize(
    "method, mean, median",
    [
        ("DER, as reported", 0.285, 0.161),  # Schwarzer et al. 2021, table 1
        ("CURL, as reported", 0.381, 0.175),
        ("SPR, as reported", 0.704, 0.415),
        ("DER, 100 runs", 0.350, 0.189),  # the run-level scores of Agarwal et al. 2021
        ("DrQ(eps), 100 runs", 0.465, 0.313),
        ("SPR, 100 runs", 0.616, 0.396),
    ],
)
def test_mean_and_median_are_the_published_ones(method, mean, median):
    assert statistics.mean(means(method)) == pytest.approx(mean, abs=0.001)
    assert statistics.median(means(method)) == pytest.approx(median, abs=0.001)


def test_the_interquartile_mean_of_runs_is_another_one_than_that_of_means():
    """It needs the runs, and is kept; from the games' means it cannot be had."""
    for method, of_runs, of_means in (("DER, 100 runs", 0.183, 0.196), ("SPR, 100 runs", 0.337, 0.415)):
        assert METHODS[method].iqm_of_runs == pytest.approx(of_runs, abs=5e-4)
        assert statistics.interquartile_mean(means(method)) == pytest.approx(of_means, abs=5e-4)
    assert METHODS["DER, as reported"].iqm_of_runs is None


def test_scores_that_are_more_than_twice_the_deviation_apart():
    """What srl_jax/data/README.md says of the two agents that are called DER."""
    one, other = atari100k("DER, as reported"), atari100k("DER, 100 runs")
    far = [game for game in one if abs(one[game].mean - other[game].mean) > 2 * other[game].sd]
    assert far == ["Amidar", "Assault", "Breakout", "CrazyClimber", "KungFuMaster"]


def test_they_are_among_the_published_scores_of_a_game():
    rows = {row.method: row for row in published("Boxing")}
    der = rows["DER, 100 runs"]
    assert (der.env_steps, der.score, der.spread, der.seeds) == (100_000, -0.3085, 2.09448, 100)
    assert (der.score_of, der.sticky_actions, der.epsilon) == ("evaluation", 0, 0.001)
    assert rows["DER, as reported"].score_of is None and rows["DER, as reported"].seeds is None
    assert np.isfinite([row.score for row in rows.values()]).all()
