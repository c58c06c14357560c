"""Which diagnostic predicts the return: `python -m experiments.analyses.predictors`.

Rank correlations of what a run says of its latent early in training, `diag/...`, with the area under its
learning curve from then on, over the runs of results/catch_runs.json: within arms and across them. `--out`
writes DIRECTORY/predictors.json, predictors.md and predictors.png. Imports no jax.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from absl import flags

from srl_jax.files import display
from srl_jax.statistics import ENOUGH, holm

from ..command_line import flags as config_flags
from ..drawing import plots
from ..runs.json_values import json_text
from ..runs.run_data import RunData
from . import output, populations
from .populations import LEVEL, ChosenArm

MOMENTS = (9_000, 18_000)
"""Env steps of the evaluations that predict."""
GAMES = ("Catch", "CatchDistractor")
PIXELS = ("reconstruction", "forward_pixels")
"""Objectives with a decoder, of which a run has one: * in `KEYS`."""
KEYS = (
    "diag/effective_rank", "diag/dormant_share", "diag/constant_share", "diag/drift/cosine", "diag/drift/cka",
    "diag/probe/ball_x", "diag/probe/ball_y", "diag/probe/ball_velocity_x", "diag/probe/ball_velocity_y",
    "diag/probe/paddle_x", "diag/probe/mean", "diag/error/*/moving_explained", "diag/error/*/static",
    "diag/gradient/*/cosine", "diag/gradient/*/norm_ratio",
)  # fmt: skip
SO_FAR = "return so far"
"""The area under the learning curve up to that moment: no diagnostic."""
LEVELS = ("within arms", "across arms")
BLOCK = 5
"""Seeds that change places with each other: 0 to 4, 5 to 9, and so on."""
PERMUTATIONS = 100_000
REPETITIONS = 10_000
"""Of the bootstrap of arms."""
_AT_ONCE = 2_000


class Stratum(NamedTuple):
    """What is ranked together: the runs of an arm, or arms.

    Attributes:
        x, y, z: float64 [N], the predictor, what is predicted, and the return so far.
        names: int [N], the runs' seeds, or the arms' places.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    names: np.ndarray


def ranks(values: np.ndarray) -> np.ndarray:
    """Ranks less their mean, of equal values the mean of theirs, float64 [..., N] of values [..., N]."""
    mine, others = values[..., :, None], values[..., None, :]
    return ((mine > others).sum(-1) - (mine < others).sum(-1)) / 2


def moments(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Sums of products of ranks, float64 [..., 6], of numbers [..., N]: xx, yy, zz, xy, xz, yz."""
    a, b, c = ranks(x), ranks(y), ranks(z)
    return np.stack([(u * v).sum(-1) for u, v in ((a, a), (b, b), (c, c), (a, b), (a, c), (b, c))], axis=-1)


def correlations(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Spearman's correlation of x and y, and the partial one given z, [...] of `moments`; NaN: none."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(sums, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        r, s, t = xy / np.sqrt(xx * yy), xz / np.sqrt(xx * zz), yz / np.sqrt(yy * zz)
        partial = (r - s * t) / np.sqrt((1 - s**2) * (1 - t**2))
    return r, np.where(np.isfinite(partial) & (np.abs(partial) <= 1), partial, np.nan)


def value(run: RunData, key: str, moment: int) -> float | None:
    """What the evaluation at an env step says; of a list, the last; None where it says nothing."""
    names = [key.replace("*", name) for name in PIXELS] if "*" in key else [key]
    row = next(row for row in run.rows if row["kind"] == "eval" and row["env_steps"] == moment)
    found = next((row[name] for name in names if row.get(name) is not None), None)
    return found[-1] if isinstance(found, list) else found


def within(arms: Sequence[ChosenArm], key: str, moment: int) -> list[Stratum]:
    """A stratum an arm that has the key in each run."""
    strata = []
    for arm in arms:
        y, z = populations.areas(arm, start=moment), populations.areas(arm, until=moment)
        x = [value(run, key, moment) for run in arm.runs] if key != SO_FAR else list(z)
        if None not in x:
            strata.append(Stratum(np.array(x, float), y, z, np.array([run.seed for run in arm.runs])))
    return strata


def across(arms: Sequence[ChosenArm], key: str, moment: int) -> list[Stratum]:
    """A stratum of arms' means for the campaigns of one Adam, and one for those of two."""
    strata = []
    for two in (False, True):
        its = [arm for arm in arms if arm.campaign.startswith("catch_separate") == two]
        found = within(its, key, moment)
        means = (np.array([getattr(one, name).mean() for one in found]) for name in ("x", "y", "z"))
        strata.append(Stratum(*means, np.arange(len(found))))
    return strata


def seeds_change_places(strata: Sequence[Stratum], rng: np.random.Generator, count: int) -> np.ndarray:
    """The places [count, N] from which each run gets another's return, the same seed's in all arms.

    Seeds change places within blocks of `BLOCK`.

    Raises:
        ValueError: an arm has a part of a block.
    """
    most = max(int(one.names.max()) for one in strata) + 1
    blocks = -(-most // BLOCK)
    taken = rng.permuted(np.tile(np.arange(BLOCK), (count * blocks, 1)), axis=1).reshape(count, blocks, BLOCK)
    taken = (taken + BLOCK * np.arange(blocks)[:, None]).reshape(count, -1)
    places, start = [], 0
    for one in strata:
        place = np.full(blocks * BLOCK, -1)
        place[one.names] = np.arange(start, start + len(one.names))
        places.append(place[taken[:, one.names]])
        start += len(one.names)
    found = np.concatenate(places, axis=1)
    if (found < 0).any():
        raise ValueError(f"an arm has a part of a block of {BLOCK} seeds")
    return found


def arms_change_places(strata: Sequence[Stratum], rng: np.random.Generator, count: int) -> np.ndarray:
    """Likewise of arms, within each stratum."""
    sizes = [len(one.names) for one in strata]
    starts = np.cumsum([0, *sizes])
    return np.concatenate(
        [
            rng.permuted(np.tile(np.arange(a, b), (count, 1)), axis=1)
            for a, b in zip(starts, starts[1:], strict=False)
        ],
        axis=1,
    )


def p_value(strata: Sequence[Stratum], change, seed: int) -> float:
    """How often returns that changed places correlate as much: two-sided, at least 1 / (`PERMUTATIONS` + 1).

    Args:
        strata: see `Stratum`.
        change: `seeds_change_places` or `arms_change_places`.
        seed: of the permutations.
    """
    x, y = (np.concatenate([ranks(getattr(one, name)) for one in strata]) for name in ("x", "y"))
    rng, own, count = np.random.default_rng(seed), abs(x @ y), 0
    for _ in range(0, PERMUTATIONS, _AT_ONCE):
        others = y[change(strata, rng, _AT_ONCE)] @ x
        count += int((np.abs(others) >= own - 1e-9).sum())
    return (1 + count) / (1 + PERMUTATIONS)


def drawn_again(strata: Sequence[Stratum], level: str, seed: int) -> np.ndarray:
    """`moments` where whole arms are drawn again, [`REPETITIONS`, 6]."""
    rng = np.random.default_rng(seed)
    if level == LEVELS[0]:
        own = np.stack([moments(*one[:3]) for one in strata])
        return rng.multinomial(len(own), np.full(len(own), 1 / len(own)), REPETITIONS) @ own
    total = np.zeros((REPETITIONS, 6))
    for one in strata:
        draws = rng.integers(len(one.x), size=(REPETITIONS, len(one.x)))
        total += moments(one.x[draws], one.y[draws], one.z[draws])
    return total


def analyse(arms: Sequence[ChosenArm]) -> list[dict[str, Any]]:
    """A row a level, moment, game and key, as JSON has it; the return so far is in it and is not tested."""
    rows = []
    for level in LEVELS:
        for moment in MOMENTS:
            for game in GAMES:
                for key in (*KEYS, SO_FAR):
                    its = [arm for arm in arms if arm.game == game]
                    strata = (within if level == LEVELS[0] else across)(its, key, moment)
                    row = {"level": level, "moment": moment, "game": game, "key": key}
                    rows.append(row | _row(strata, level, key))
    tested = [row for row in rows if row["p"] is not None]
    for row, p in zip(tested, holm([row["p"] for row in tested]), strict=True):
        row["holm"] = round(float(p), 5)
    return rows


def _row(strata: Sequence[Stratum], level: str, key: str) -> dict[str, Any]:
    arms = len(strata) if level == LEVELS[0] else sum(len(one.x) for one in strata)
    sums = np.sum([moments(*one[:3]) for one in strata], axis=0)
    vary = _varying(strata, level)
    row: dict[str, Any] = {"arms": arms, "vary": vary}
    again = correlations(drawn_again(strata, level, 0))
    for name, point, values in zip(("correlation", "beyond"), correlations(sums), again, strict=True):
        row[name] = [None] * 3
        if np.isfinite(point) and (name, key) != ("beyond", SO_FAR):
            limits = np.percentile(values[np.isfinite(values)], [2.5, 97.5])
            row[name] = [round(float(x), 4) for x in (point, *limits)]
            if vary < ENOUGH:  # a bootstrap of so few says nothing
                row[name][1:] = None, None
    change = seeds_change_places if level == LEVELS[0] else arms_change_places
    tested = key != SO_FAR and row["correlation"][0] is not None
    return row | {"p": round(p_value(strata, change, 0), 7) if tested else None, "holm": None}


def _varying(strata: Sequence[Stratum], level: str) -> int:
    """The arms of whose runs the predictor tells some apart; across arms, those that are not as most are."""
    if level == LEVELS[0]:
        return sum(bool(np.ptp(one.x)) for one in strata)
    _, counts = np.unique(np.concatenate([one.x for one in strata]), return_counts=True)
    return int(counts.sum() - (counts.max() if counts.max() > 1 else 0))


def verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the criterion says of a key's rows of all games at one level and moment: "yes", and whether beside
    the learning curve; "no"; or "" of what is not tested."""
    if any(row["key"] == SO_FAR for row in rows):
        return ""
    if any(row["holm"] is None or row["holm"] >= LEVEL for row in rows):
        return "no"
    signs = {np.sign(row["correlation"][0]) for row in rows}
    if len(signs) > 1:
        return "no: another sign"
    (sign,) = signs
    beyond = all(
        row["beyond"][1] is not None and min(sign * x for x in row["beyond"][1:]) > 0 for row in rows
    )
    return "yes, beyond the return so far" if beyond else "yes"


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """The numbers as Markdown."""

    def limits(of: Sequence[float | None]) -> str:
        if of[0] is None:
            return "-"
        return f"{of[0]:+.2f}" + ("" if of[1] is None else f" [{of[1]:+.2f}, {of[2]:+.2f}]")

    parts = [f"{sum(row['holm'] is not None for row in rows)} tests; p is Holm's over all of them."]
    head = ["key"]
    for game in GAMES:
        head += [game, "p", "beyond the return so far", "varies in"]
    for level in LEVELS:
        for moment in MOMENTS:
            lines = []
            for key in (*KEYS, SO_FAR):
                its = [
                    row for row in rows if (row["level"], row["moment"], row["key"]) == (level, moment, key)
                ]
                line = [f"`{key}`" if key != SO_FAR else key]
                for row in its:
                    p = (
                        "-"
                        if row["holm"] is None
                        else f"{row['holm']:.3f}"
                        if row["holm"] >= 0.001
                        else "< 0.001"
                    )
                    line += [
                        limits(row["correlation"]),
                        p,
                        limits(row["beyond"]),
                        f"{row['vary']} of {row['arms']} arms",
                    ]
                lines.append([*line, verdict(its)])
            title = f"**{level[0].upper()}{level[1:]}, at {moment:,} env steps**"
            parts.append(f"{title}\n\n{output.markdown([*head, 'predicts'], lines)}")
    return "\n\n".join(parts)


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Draws the correlations: a panel a level and game, a line a key, a colour a moment."""
    figure = plots.new_figure(11.5, 4.8)
    grid = figure.subplots(1, len(LEVELS) * len(GAMES), sharey=True)
    looks = dict(zip(MOMENTS, (("#d55e00", -0.17), ("#0072b2", 0.17)), strict=True))
    keys = [*KEYS, SO_FAR]
    for axes, (level, game) in zip(grid, [(level, game) for level in LEVELS for game in GAMES], strict=True):
        plots.plain(axes)
        axes.axvline(0, color="#555555", linewidth=1)
        for row in rows:
            if (row["level"], row["game"]) != (level, game) or row["correlation"][0] is None:
                continue
            (colour, shift), (point, low, high) = looks[row["moment"]], row["correlation"]
            at = keys.index(row["key"]) + shift
            filled = row["holm"] is not None and row["holm"] < LEVEL
            if low is not None:
                axes.plot([low, high], [at, at], color=colour, linewidth=1.4)
            axes.plot(
                [point], [at], "o", color=colour, markersize=5, markerfacecolor=colour if filled else "white"
            )
        axes.set_title(f"{level}, {game}", fontsize=9)
        axes.set_xlim(-1, 1)
        axes.tick_params(labelsize=8)
    labels = [key.removeprefix("diag/").replace("*/", "") for key in keys]
    grid[0].set_yticks(range(len(keys)), labels, fontsize=8)
    grid[0].set_ylim(len(keys) - 0.5, -0.5)
    for moment, (colour, _) in looks.items():
        grid[0].plot([], [], "o-", color=colour, markersize=5, label=f"at {moment:,} env steps")
    figure.legend(
        *grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=8, frameon=False
    )
    note = (
        "Spearman's rank correlation with the area under the learning curve from then on; "
        "95 % intervals over arms; filled: Holm's p below 5 %"
    )
    figure.supxlabel(note, fontsize=8)
    return plots.save(figure, path)


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    output.define_out("predictors.json, .md and .png", values)


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    out = output.place(values.out, drawn=True)
    rows = analyse(populations.chosen())
    display.result(tables(rows))
    if out is not None:
        lines = ",\n".join(f" {json_text(row, None)}" for row in rows)
        output.write(out, {"predictors.json": f"[\n{lines}\n]", "predictors.md": tables(rows)})
        draw(rows, out / "predictors.png")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
