"""Tests of srl_jax.statistics.power, and of experiments.power."""

import shutil

import numpy as np
import pytest

from experiments import power
from srl_jax import data
from srl_jax.errors import ConfigError
from srl_jax.statistics import MOST, runs_needed, smallest_effect, welch_p, welch_power
from tests.helpers import NOT_FINITE, write_run
from tests.in_process import parse
from tests.references import stats


def _lines(*arguments):
    return [line.split() for line in power.report(parse(power, *arguments))]


def test_of_many_runs_it_is_the_noncentral_t_of_equal_spreads():
    """Cohen (1988), table 2.3: d = 0.5 is found in 80 % with 64 runs an arm."""
    freedom, quantile = 126, stats.t.ppf(0.975, 126)
    beyond = stats.nct.sf(quantile, freedom, 0.5 * 32**0.5) + stats.nct.cdf(-quantile, freedom, 0.5 * 32**0.5)
    assert welch_power(0.5, (1, 1), (64, 64)) == pytest.approx(beyond, abs=2e-4)
    assert runs_needed(0.5, (1, 1)) == 64 and runs_needed(-5.0, (10, 10)) == 64
    assert welch_power(5, (10, 10), (64, 64)) == pytest.approx(welch_power(0.5, (1, 1), (64, 64)))


@pytest.mark.parametrize(
    "runs, spreads, effect", [((3, 3), (1, 1), 2), ((2, 4), (1, 3), 4), ((5, 5), (2, 1), 0)]
)
def test_it_is_how_often_the_test_finds_a_difference(runs, spreads, effect):
    """With 40,000 experiments the standard error of a share is at most 0.0025."""
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=(40_000, n)) * spread for n, spread in zip(runs, spreads, strict=True))
    found = float(np.mean(welch_p(x + effect, y) < 0.05))
    assert welch_power(effect, spreads, runs) == pytest.approx(found, abs=0.0075)
    assert welch_power(effect, spreads[::-1], runs[::-1]) == pytest.approx(welch_power(effect, spreads, runs))


def test_two_runs_an_arm_by_an_integral_over_their_variances():
    """Of two runs the variances' ratio is the squared tangent of a uniform angle: by scipy.quad."""
    assert welch_power(4, (1, 1), (2, 2)) == pytest.approx(0.3027715, abs=2e-6)


def test_the_smallest_effect_and_the_runs_needed_are_where_power_reaches_what_is_asked():
    effect = smallest_effect((1, 2), (4, 6), power=0.9, level=0.99)
    assert welch_power(effect, (1, 2), (4, 6), level=0.99) == pytest.approx(0.9, abs=1e-3)
    runs = runs_needed(1.3, (1, 2), power=0.9)
    found = [welch_power(1.3, (1, 2), (n, n)) for n in (runs - 1, runs)]
    assert found[0] < 0.9 <= found[1]
    assert runs_needed(100, (1, 1)) == 2 + (welch_power(100, (1, 1), (2, 2)) < 0.8)
    assert runs_needed(1e-4, (1, 1)) is None


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: welch_power(1, (1, 0), (2, 2)), "positive"),
        (lambda: welch_power(1, (1, 1), (2, 1)), "at least 2"),
        (lambda: smallest_effect((1, 1), (2, 2), power=0.05), "between 0.05 and 1"),
        (lambda: runs_needed(0, (1, 1)), "effect=0"),
    ],
)
def test_what_it_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_table_of_a_spread():
    head, row = _lines("--spread=2", "--effect=1", "--seeds=64")
    assert row == ["-", "2", f"{smallest_effect((2, 2), (64, 64)):.3g}", "80%", "64"]
    assert _lines("--spread=1,2", "--seeds=4")[1][:4] == ["-", "1", "and", "2"]
    assert _lines("--spread=1", "--effect=1e-3")[1][-2:] == ["over", f"{MOST:,}"]


def test_the_spread_of_runs_is_that_of_their_area(tmp_path, capsys):
    """Areas of a: 0, 1 and 2, SD 1; of b 0, 3 and 6, SD 3; together the root of (1 + 9) / 2."""
    for arm, step in (("a", 1), ("b", 3)):
        for seed in range(3):
            write_run(tmp_path / arm / f"seed{seed}", (step * seed, step * seed), seed=seed)
    write_run(tmp_path / "few/seed0", (0, 0))
    for seed in range(3):  # a mean of three of which is another number by a rounding
        write_run(
            tmp_path / f"CatchDistractor/same/seed{seed}", (0.1, 0.1), seed=seed, game="CatchDistractor"
        )
    assert _lines(f"--from={tmp_path}", "--effect=2", "--game=CatchDistractor")[1][2] == "0"
    shutil.rmtree(tmp_path / "CatchDistractor")
    head, *rows = _lines(f"--from={tmp_path}", "--effect=2")
    assert head[0] == "Catch" and _lines(f"--from={tmp_path}", "--effect=2", "--game=") == [head, *rows]
    assert [row[:3] for row in rows[:2]] == [["a", "3", "1"], ["b", "3", "3"]]
    assert rows[2][:4] == ["all", "arms", "6", f"{5**0.5:.3g}"] and len(rows) == 3
    assert rows[0][-1] == str(runs_needed(2, (1, 1)))
    (_, row) = _lines(f"--from={tmp_path}", "--effect=2", "--arm=b", "--arm=a", "--game=Catch")
    assert row[:7] == ["b", "and", "a", "3", "3", "and", "1"]
    assert row[-1] == str(runs_needed(2, (3, 1)))
    for seed in range(3):
        write_run(tmp_path / f"CatchDistractor/a/seed{seed}", (0, seed), seed=seed, game="CatchDistractor")
    assert len(_lines(f"--from={tmp_path}", "--effect=2", "--arm=b", "--arm=a")) == 2
    assert "--arm=b: left out: CatchDistractor: " in capsys.readouterr().err


def test_runs_are_compared_as_in_figures_and_what_is_left_out_is_said(tmp_path, capsys):
    for seed in range(3):
        write_run(tmp_path / f"Catch/a/seed{seed}", (seed, seed), seed=seed)
    before = _lines(f"--from={tmp_path}")
    assert capsys.readouterr().err == ""
    write_run(tmp_path / "Catch/a/seed3", (9, 9), seed=3, ended=NOT_FINITE)
    write_run(tmp_path / "Catch/few/seed0", (0, 0))
    assert _lines(f"--from={tmp_path}") == before
    assert capsys.readouterr().err.splitlines() == [
        f"Catch, a: 1 of 4 seeds left out: {NOT_FINITE.reason} (seed 3)",
        "Catch, few: left out: 1 run, a spread takes 3",
    ]
    write_run(tmp_path / "Catch/noisy/seed0", (0, 0), eps_eval=0.5)
    with pytest.raises(
        ConfigError, match="another protocol than .*eps_eval is 0.005 there and 0.5 here; --f"
    ):
        _lines(f"--from={tmp_path}")
    assert _lines(f"--from={tmp_path}", "--force") == before
    assert "another protocol" in capsys.readouterr().err
    write_run(tmp_path / "Catch/a/seed4", (0, 0), seed=4, gamma=0.5)
    with pytest.raises(ConfigError, match="of the same arm, a on Catch, .*gamma is 0.99 there and 0.5 here"):
        _lines(f"--from={tmp_path}", "--force")


def test_spreads_may_be_as_large_and_small_as_numbers_are(capsys):
    for unit in (1e300, 1e-300):
        assert smallest_effect((unit, 2 * unit), (3, 4)) == pytest.approx(
            unit * smallest_effect((1, 2), (3, 4))
        )
    assert welch_power(0.1, (1e300, 1e-300), (5, 5)) == pytest.approx(0.05, abs=0.02)
    assert _lines("--spread=1e300", "--effect=0.1")[1][-3:] == ["4%", "over", f"{MOST:,}"]


def test_the_head_has_the_power_that_was_asked_for():
    heads = [" ".join(_lines("--spread=1", *more)[0]) for more in ([], ["--power=0.999"])]
    assert heads == ["runs SD found in 80% with 5 seeds", "runs SD found in 99.9% with 5 seeds"]


def test_published_spreads_are_those_of_the_tables():
    found = power.of_published("Boxing")
    der = next(x for x in found if x.name == "DER, 100 runs")
    assert (der.runs, der.deviation) == (100, data.atari100k("DER, 100 runs")["Boxing"].sd)
    found = power.of_published("Pong")
    assert len({x.name for x in found}) == len(found) and all(x.deviation > 0 for x in found)
    long = next(x for x in found if x.name == "Dopamine Rainbow, 10,000,000 env steps")
    assert (long.runs, long.deviation) == (5, 0.55)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "give one of them"),
        (["--spread=1", "--from=x"], "give one of them"),
        (["--spread=0"], "a positive number, not '0'"),
        (["--spread=1,2,3"], "one or two numbers"),
        (["--spread=1", "--force"], "^--force: only beside --from=DIRECTORY"),
        (["--from=published", "--game=Pong", "--force"], "^--force: only beside"),
        (["--spread=1", "--game="], "without --game"),
        (["--from=published", "--game=mine:x=1"], "--game=mine:x=1: "),
        (["--from=published"], "needs a game"),
        (["--from=no/where"], "^--from=no/where: no run directory there"),
        (["--from=published", "--game=Catch"], "--game=Catch: .* needs a game with published spreads"),
        (["--from=published", "--game=Pong", "--arm=x"], "--arm=x: give it twice"),
        (["--from=published", "--game=Pong", "--arm=x", "--arm=y"], "--arm=x: Pong: "),
    ],
)
def test_what_the_command_line_refuses(arguments, message):
    with pytest.raises(ConfigError, match=message):
        _lines(*arguments)
