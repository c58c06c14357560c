"""What a claim of few seeds is worth: `python -m experiments.analyses.claims`.

Splits the runs of results/catch_runs.json into the few seeds that a paper would have had and others that look
again, and draws runs of published spreads: how often a rule claims that two arms differ where nothing does,
with the wrong sign, and by how much the difference is overstated. `--out` writes DIRECTORY/claims.json,
claims.md and claims.png. Imports no jax.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import data, statistics
from srl_jax.files import display

from ..command_line import flags as config_flags
from ..drawing import plots
from ..runs.json_values import json_text
from . import coverage, output, populations

SEEDS = (3, 5)
"""Of each arm, that a claim is made from."""
REPETITIONS = 10_000
"""Of a bootstrap."""
SPLITS = 2_000
"""Random ones of a pair of arms, and experiments of a pair of published spreads."""
ROBUST = 0.075
"""The largest share of false claims of a rule that is fit for use (Bradley 1978)."""
RULES = ("standard errors apart", "deviations apart", "bootstrap", "bootstraps apart", "Welch's t")
METHODS = ("DER, 100 runs", "SPR, 100 runs")
_BLOCK = 200
"""Splits at once."""


def claims(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What each rule claims of two arms: 1 that x is better, -1 that y is, 0 nothing; int64 [splits].

    Args:
        x: float64 [splits, runs] of one arm.
        y: of the other one.
        rng: of the bootstrap.
    """
    runs = x.shape[1]
    difference = x.mean(1) - y.mean(1)
    deviations = x.std(1, ddof=1) + y.std(1, ddof=1)
    welch = statistics.mean_difference(x, y)
    found = {
        "standard errors apart": np.abs(difference) > deviations / np.sqrt(runs),
        "deviations apart": np.abs(difference) > deviations,
        "Welch's t": (welch.low > 0) | (welch.high < 0),
    }
    together, apart = [], []
    for start in range(0, len(x), _BLOCK):
        means = []
        for arm in (x, y):
            counts = rng.multinomial(runs, np.full(runs, 1 / runs), REPETITIONS)  # how often a run is drawn
            means.append(arm[start : start + _BLOCK] @ counts.T / runs)
        low, high = np.percentile(means[0] - means[1], [2.5, 97.5], axis=1)
        together.append((low > 0) | (high < 0))
        (a, b), (c, d) = (np.percentile(arm, [2.5, 97.5], axis=1) for arm in means)
        apart.append((a > d) | (b < c))
    found |= {"bootstrap": np.concatenate(together), "bootstraps apart": np.concatenate(apart)}
    return {rule: found[rule] * np.sign(difference).astype(int) for rule in RULES}


def of_nothing(runs: np.ndarray, seeds: int, rng: np.random.Generator) -> dict[str, float]:
    """How often each rule claims a difference between two groups of an arm's runs, over all such pairs.

    Args:
        runs: float64 [runs] of the arm.
        seeds: of each group.
        rng: of the bootstrap.
    """
    places = range(len(runs))
    pairs = [
        (mine, theirs)
        for mine in itertools.combinations(places, seeds)
        for theirs in itertools.combinations([i for i in places if i not in mine], seeds)
        if mine < theirs
    ]
    x, y = (runs[list(groups)] for groups in zip(*pairs, strict=True))
    return {rule: float(np.abs(claim).mean()) for rule, claim in claims(x, y, rng).items()}


def seen_again(x: np.ndarray, y: np.ndarray, seeds: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What fresh runs say of each rule's claims, summed over random splits of two arms.

    Args:
        x: float64 [runs] of one arm, at least twice the seeds.
        y: of the other one.
        seeds: of each arm that claim, and as many that look again.
        rng: of the splits and the bootstrap.

    Returns:
        rule -> [claims made, with the other sign in the fresh runs, claimed again with the same sign, the
        claimed differences without their signs, those of the fresh runs with the claim's sign].
    """
    parts = [rng.permuted(np.tile(arm, (SPLITS, 1)), axis=1) for arm in (x, y)]
    first, fresh = ([part[:, at : at + seeds] for part in parts] for at in (0, seeds))
    again, sizes = claims(*fresh, rng), [mine.mean(1) - theirs.mean(1) for mine, theirs in (first, fresh)]
    found = {}
    for rule, claim in claims(*first, rng).items():
        signed = sizes[1] * claim
        values = (claim != 0, signed < 0, claim * again[rule] > 0, sizes[0] * claim, signed)
        found[rule] = np.array([float(value.sum()) for value in values])
    return found


def of_published(
    pairs: Mapping[str, tuple[np.ndarray, np.ndarray]], seeds: int, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """How many games each rule claims, of those of a suite, where runs come from populations.

    Args:
        pairs: game -> populations of the baseline and of what is compared with it.
        seeds: of each of the two.
        rng: of all draws.

    Returns:
        rule -> games claimed, of these with the wrong sign, those that are missed or wrong, and the claimed
        differences over the true ones, both in units of the spread; and games claimed where the baseline
        meets itself.
    """
    totals = {rule: np.zeros(5) for rule in RULES}
    for base, other in pairs.values():
        shape, true = (SPLITS, seeds), other.mean() - base.mean()
        spread = np.sqrt((base.var() + other.var()) / 2)
        x, y = rng.choice(other, shape), rng.choice(base, shape)
        size = (x.mean(1) - y.mean(1)) / spread
        itself = claims(rng.choice(base, shape), y, rng)
        for rule, claim in claims(x, y, rng).items():
            wrong = claim * true < 0
            sums = np.abs(claim).sum(), wrong.sum(), (claim * size).sum(), (claim * true / spread).sum()
            totals[rule] += [*sums, np.abs(itself[rule]).sum()]
    found = {}
    for rule, (made, wrong, claimed, true, nothing) in totals.items():
        found[rule] = {
            "claimed": made / SPLITS,
            "wrong sign": wrong / SPLITS,
            "missed": len(pairs) - (made - wrong) / SPLITS,
            "exaggeration": claimed / true,
            "claimed of nothing": nothing / SPLITS,
        }
    return found


def analyse(arms: Sequence[populations.ChosenArm]) -> dict[str, Any]:
    """All numbers, as JSON has them.

    Args:
        arms: those of ten runs count.
    """
    tens = [arm for arm in arms if len(arm.runs) == 10]
    areas = {(arm.game, arm.name): populations.areas(arm) for arm in tens}
    found: dict[str, Any] = {"nothing": {}, "again": {}, "published": {}, "interquartile mean": {}}
    scores = [data.atari100k(method) for method in METHODS]
    pairs = {
        game: (populations.like(scores[0][game]), populations.like(scores[1][game])) for game in scores[0]
    }
    normal = [statistics.human_normalised(game, base) for game, (base, _) in pairs.items()]
    for seeds in SEEDS:
        rng = np.random.default_rng(seeds)
        each = {key: of_nothing(x, seeds, rng) for key, x in areas.items()}
        rows = found["nothing"][str(seeds)] = {}
        for rule in RULES:
            rates = np.array([rates[rule] for rates in each.values()])
            mean, low, high, _ = statistics.mean_interval(rates)
            limits = {"low": low, "high": high}  # none where all arms are alike
            rows[rule] = {"share": _round(mean)}
            rows[rule] |= {name: None if np.isnan(x) else _round(x) for name, x in limits.items()}
            rows[rule]["arms"] = {f"{game} {arm}": _round(rates[i]) for i, (game, arm) in enumerate(areas)}
        sums = {
            (mine, theirs): seen_again(areas[mine], areas[theirs], seeds, rng)
            for mine, theirs in itertools.combinations(areas, 2)
            if mine[0] == theirs[0]
        }
        found["again"][str(seeds)] = {rule: _again(sums, areas, rule) for rule in RULES}
        found["published"][str(seeds)] = {
            rule: {name: _round(value, 3) for name, value in row.items()}
            for rule, row in of_published(pairs, seeds, rng).items()
        }
        drawn = [np.stack([rng.choice(game, (SPLITS, seeds)) for game in normal], axis=-1) for _ in range(2)]
        shares = coverage.covered(rng, drawn, coverage.interquartile_mean, 0.0)
        found["interquartile mean"][str(seeds)] = {kind: _round(1 - x) for kind, x in shares.items()}
    return found


def _again(
    sums: Mapping[tuple, Mapping[str, np.ndarray]], areas: Mapping[tuple, Any], rule: str
) -> dict[str, Any]:
    """What `seen_again` sums to over pairs of arms, and the range of it as any one arm is left out."""

    def shares(without: tuple | None) -> list[float]:
        kept = [found[rule] for pair, found in sums.items() if without not in pair]
        made, other, again, claimed, fresh = np.sum(kept, axis=0)
        return [made / (SPLITS * len(kept)), other / made, again / made, claimed / fresh]

    names = ("claimed", "other sign", "claimed again", "exaggeration")
    every = np.array([shares(without) for without in areas])
    return {
        name: {"all": _round(value), "low": _round(low), "high": _round(high)}
        for name, value, low, high in zip(names, shares(None), every.min(0), every.max(0), strict=True)
    }


def _round(value: float, digits: int = 4) -> float:
    return round(float(value), digits)


def tables(found: Mapping[str, Any]) -> str:
    """The numbers as Markdown."""

    def percent(row: Mapping[str, Any], of: str) -> str:
        limits = "" if row["low"] is None else f" ({100 * row['low']:.1f} to {100 * row['high']:.1f})"
        return f"{100 * row[of]:.1f} %{limits}"

    parts = []
    for seeds in map(str, SEEDS):
        nothing = found["nothing"][seeds]
        head = ["rule", "false claims", "arms: lowest, highest", f"fit (at most {100 * ROBUST:g} %)"]
        rows = []
        for rule, row in nothing.items():
            ends = [100 * f(row["arms"].values()) for f in (min, max)]
            fit = "yes" if row["share"] <= ROBUST else "no"
            rows.append([rule, percent(row, "share"), f"{ends[0]:.1f}, {ends[1]:.1f} %", fit])
        parts.append(f"**Nothing to find, {seeds} seeds an arm**\n\n{output.markdown(head, rows)}")
    for seeds in map(str, SEEDS):
        head = ["rule", "claims made", "other sign in fresh runs", "claimed again", "exaggeration"]
        rows = []
        for rule, row in found["again"][seeds].items():
            cells = [percent(row[name], "all") for name in ("claimed", "other sign", "claimed again")]
            size = row["exaggeration"]
            rows.append([rule, *cells, f"{size['all']:.2f} ({size['low']:.2f} to {size['high']:.2f})"])
        parts.append(f"**Two arms of a game, {seeds} seeds an arm**\n\n{output.markdown(head, rows)}")
    for seeds in map(str, SEEDS):
        head = [
            "rule",
            "games claimed",
            "with the wrong sign",
            "missed or wrong",
            "exaggeration",
            "DER against itself",
        ]
        rows = [
            [rule, *(f"{value:.2f}" for value in row.values())]
            for rule, row in found["published"][seeds].items()
        ]
        parts.append(f"**SPR less DER, 26 games, {seeds} seeds an arm**\n\n{output.markdown(head, rows)}")
    kinds = found["interquartile mean"]
    rows = [[kind, *(f"{100 * kinds[str(n)][kind]:.1f} %" for n in SEEDS)] for kind in kinds[str(SEEDS[0])]]
    head = ["interval of the difference", *(f"{n} seeds" for n in SEEDS)]
    parts.append(
        "**Interquartile mean of 26 games, DER against itself: how often an interval leaves out 0**\n\n"
        + output.markdown(head, rows)
    )
    return "\n\n".join(parts)


def draw(found: Mapping[str, Any], path: Path) -> Path:
    """Draws false claims, and what fresh runs say of claims."""
    figure = plots.new_figure(9.2, 3.4)
    axes = figure.subplots(1, 2, sharey=True)
    looks = dict(zip(map(str, SEEDS), (("#d55e00", -0.16), ("#0072b2", 0.16)), strict=False))
    for seeds, (colour, shift) in looks.items():
        for i, rule in enumerate(RULES):
            row, at = found["nothing"][seeds][rule], i + shift
            each = [100 * share for share in row["arms"].values()]
            axes[0].plot(
                each, [at] * len(each), "o", color=colour, alpha=0.25, markersize=4, markeredgewidth=0
            )
            if row["low"] is not None:
                limits = [100 * row["low"], 100 * row["high"]]
                axes[0].plot(limits, [at, at], color=colour, linewidth=2)
            label = f"{seeds} seeds an arm" if not i else None
            axes[0].plot([100 * row["share"]], [at], "o", color=colour, markersize=6, label=label)
            again = found["again"][seeds][rule]["claimed again"]
            axes[1].plot([100 * again["low"], 100 * again["high"]], [at, at], color=colour, linewidth=2)
            axes[1].plot([100 * again["all"]], [at], "o", color=colour, markersize=6)
    axes[0].axvline(5, color="#555555", linewidth=1, linestyle=":")
    axes[0].axvline(100 * ROBUST, color="#555555", linewidth=1)
    titles = ("nothing to find: false claims", "of claims of two arms: claimed again by fresh runs")
    for side, title in zip(axes, titles, strict=True):
        plots.plain(side)
        side.set_title(title, fontsize=9)
        side.set_xlabel("percent", fontsize=8)
        side.tick_params(labelsize=8)
        side.set_xlim(left=0)
    axes[1].set_xlim(0, 100)
    axes[0].set_yticks(range(len(RULES)), RULES, fontsize=8)
    axes[0].set_ylim(len(RULES) - 0.5, -0.5)
    axes[0].legend(fontsize=8, frameon=False, loc="lower right")
    note = (
        "left: 5 % is dotted, at most 7.5 % is fit for use; faint: each arm; lines: t intervals over arms. "
        "right: lines: the range as any one arm is left out"
    )
    figure.supxlabel(note, fontsize=7)
    return plots.save(figure, path)


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    output.define_out("claims.json, .md and .png", values)


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    out = output.place(values.out, drawn=True)
    found = analyse(populations.chosen())
    display.result(tables(found))
    if out is not None:
        output.write(out, {"claims.json": json_text(found), "claims.md": tables(found)})
        draw(found, out / "claims.png")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
