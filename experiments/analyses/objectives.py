"""The table of objectives, of results/catch_objectives: `python -m experiments.analyses.objectives`.

Each objective beside RL (the figure `joint`) is compared with RL alone, and each alone on the encoder (the
figure `decoupled`) with an encoder that stays as it was drawn: the area under the learning curve, Welch's
test, and Holm's correction over the objectives of a figure and game. A figure of which a run is missing is
left out. `--out` writes DIRECTORY/objectives.json and .md, and a picture of each figure. Imports no jax.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import data, statistics
from srl_jax.files import display
from srl_jax.files.reading import ROWS, read_json

from .. import arms, packing
from ..command_line import flags as config_flags
from ..drawing import plots
from ..runs import collect
from ..runs.json_values import json_text, limits
from ..runs.run_data import RunData
from . import output
from .populations import LEVEL, RESULTS

CAMPAIGN = RESULTS / "catch_objectives"
RL_ALONE = "rl_only_256"
"""No objective: it is shown, and not corrected for."""
BASELINES = {"joint": RL_ALONE, "decoupled": "frozen_random"}
"""{figure: what its objectives are compared with}."""
GAMES = ("Catch", "CatchDistractor")
SEEDS = range(20, 25)
SHARE = 0.9
"""Of what RL alone has at its end above a random policy, that is waited for."""
BALL = ("diag/probe/ball_x", "diag/probe/ball_y")


def analyse(campaign: Path = CAMPAIGN) -> dict[str, Any]:
    """{figure: {game: {arm: its numbers}}} of the figures whose runs are all there, as JSON values.

    Raises:
        ConfigError: runs cannot be read or compared.
    """
    runs = collect.grouped(packing.read(campaign))
    found: dict[str, Any] = {}
    for name, baseline in BASELINES.items():
        names = [arm.name for arm in arms.read_figure(campaign / f"{name}.json").arms]
        games = {game: {arm: runs.get(game, {}).get(arm, []) for arm in names} for game in GAMES}
        members = [its for of_game in games.values() for its in of_game.values()]
        if all({run.seed for run in its if run.over and not run.failed} >= {*SEEDS} for its in members):
            found[name] = {game: of_game(game, its, baseline) for game, its in games.items()}
    return found


def of_game(game: str, members: Mapping[str, Sequence[RunData]], baseline: str) -> dict[str, dict[str, Any]]:
    """The numbers of a figure's arms on a game.

    Args:
        game: its name.
        members: arm -> its runs, of one protocol.
        baseline: the arm that the others are compared with.
    """
    every = [run for runs in members.values() for run in runs]
    collect.check_arms(every)
    collect.check_protocols(every)
    curves = {arm: [collect.steps_and_returns(run) for run in runs] for arm, runs in members.items()}
    ends = collect.ends(curves)[1]
    random = data.reference_policies(game)["random"].return_mean
    target = random + SHARE * (ends[RL_ALONE]["at_the_end"].mean() - random)
    rows: dict[str, dict[str, Any]] = {}
    for arm, runs in members.items():
        area = ends[arm]["area_under_curve"]
        taken = [float(statistics.steps_to(*curve, target)) for curve in curves[arm]]
        row: dict[str, Any] = {
            "seeds": [run.seed for run in runs],
            "area": limits(statistics.contrast([area], [1])),
            "at the end": float(ends[arm]["at_the_end"].mean()),
            "target": float(target),
            "reached": int(np.isfinite(taken).sum()),
            "steps to target": _median(taken),
            "probe of the ball": last(runs, *BALL),
            "effective rank": last(runs, "diag/effective_rank"),
        }
        if arm != baseline:
            areas = area, ends[baseline]["area_under_curve"]
            row["difference"] = limits(statistics.contrast(areas, [1, -1]))
            row["p"] = float(statistics.welch_p(*areas))
        rows[arm] = row
    tested = [row for arm, row in rows.items() if "p" in row and arm != RL_ALONE]
    for row, p in zip(tested, statistics.holm([row["p"] for row in tested]), strict=True):
        row["significant"] = bool(p <= LEVEL)
    return rows


def _median(steps: Sequence[float]) -> float | None:
    """The median of env steps, NaN being never; None where that is never."""
    median = float(np.median(np.nan_to_num(steps, nan=np.inf)))
    return median if np.isfinite(median) else None


def last(runs: Sequence[RunData], *keys: str) -> float | None:
    """The mean over runs and keys of the last value of each key; None where a run has none."""
    values = [[row[key] for row in run.rows if row.get(key) is not None][-1:] for run in runs for key in keys]
    return float(np.mean(values)) if all(values) else None


def costs() -> dict[str, float]:
    """Times that an update of RL takes with an objective beside it, as results/bench measured them."""
    rows = read_json(RESULTS / "bench" / "objectives.json", ROWS)["rows"]
    return {name.removeprefix("objective_"): row["figures"]["ratio"]["median"] for name, row in rows.items()}


def tables(found: Mapping[str, Any]) -> str:
    """The numbers as tables in Markdown, the largest difference first."""
    cost, parts = costs(), []
    for name, games in found.items():
        for game, rows in games.items():
            head = [
                "objective", "area under the curve", f"less {BASELINES[name]}", "p", "at the end",
                "env steps to 90 %", "probe of the ball", "effective rank", "cost",
            ]  # fmt: skip
            order = sorted(rows, key=lambda arm: -rows[arm]["area"]["mean"])
            body = [_line(arm, rows[arm], cost) for arm in order]
            target = next(iter(rows.values()))["target"]
            title = f"**{name}, {game}** (90 %: a mean return of {target:.2f})"
            parts.append(f"{title}\n\n{output.markdown(head, body)}")
    return "\n\n".join(parts)


def _line(arm: str, row: Mapping[str, Any], cost: Mapping[str, float]) -> list[str]:
    def number(x: float | None, form: str) -> str:
        return "-" if x is None else format(x, form)

    objective = _title(arm)
    difference = output.interval(row["difference"], "+.2f") if "difference" in row else "-"
    steps = number(row["steps to target"], ",.0f")
    return [
        objective,
        output.interval(row["area"], ".2f"),
        f"**{difference}**" if row.get("significant") else difference,
        number(row.get("p"), ".3f"),
        f"{row['at the end']:.2f}",
        f"{steps} ({row['reached']} of {len(row['seeds'])})",
        number(row["probe of the ball"], ".2f"),
        number(row["effective rank"], ".0f"),
        number(cost.get(objective), ".2f"),
    ]


def _title(arm: str) -> str:
    """The objective of an arm, or the arm itself where it has none."""
    figure, _, objective = arm.partition("_")
    return objective if figure in BASELINES else arm


def draw(name: str, games: Mapping[str, Any], path: Path) -> Path:
    """Draws the differences of a figure's objectives, in the order of those on the first game."""
    first, *_ = games.values()
    order = [arm for arm in first if "difference" in first[arm]]
    order.sort(key=lambda arm: -first[arm]["difference"]["mean"])
    panels = {
        game: {_title(arm): statistics.Interval(*rows[arm]["difference"].values()) for arm in order}
        for game, rows in games.items()
    }
    remain = {game: [bool(rows[arm].get("significant")) for arm in order] for game, rows in games.items()}
    looks = {game: [("#d55e00" if it else "#0072b2", "-") for it in its] for game, its in remain.items()}
    title = f"{name}: area under the curve"
    if any(map(any, remain.values())):
        title += " (orange: told apart)"
    return plots.differences(title, BASELINES[name], panels, looks, path)


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    output.define_out("objectives.json and .md, and a picture a figure", values)


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    out = output.place(values.out, drawn=True)
    found = analyse()
    display.result(tables(found))
    if out is not None:
        texts = {"objectives.json": json_text(found), "objectives.md": tables(found)}
        output.write(out, texts)
        for name, games in found.items():
            draw(name, games, out / f"{name}.png")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
