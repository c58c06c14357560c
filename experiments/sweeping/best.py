"""Which arm of a sweep did best: a table for each game. Imports no jax."""

import math
from collections.abc import Sequence

from srl_jax import statistics

from .. import collect
from ..collect import RunData
from .table import columns


def lines(runs: Sequence[RunData]) -> list[str]:
    """The arms of each game that has several, the best one first, by the area under the learning curve.

    Args:
        runs: on disk; those that are not `comparable` are left out, and the last lines say so.

    Returns:
        Lines of text; none where no game has two arms to compare.
    """
    found: list[str] = []
    for game, arms in collect.grouped(collect.comparable(runs)).items():
        if len(arms) < 2:
            continue
        curves = {arm: [collect.steps_and_returns(run) for run in members] for arm, members in arms.items()}
        until = min(int(steps[-1]) for arm in curves.values() for steps, _ in arm)
        ends = {arm: collect.ends(its, until) for arm, its in curves.items()}
        areas = {
            arm: statistics.estimate(statistics.mean, {game: its["area_under_curve"]})
            for arm, its in ends.items()
        }
        rows = [(game, "seeds", "area", "95 %", "at the end")]
        for arm in sorted(areas, key=lambda arm: -areas[arm].point):
            area = areas[arm]
            interval = f"[{area.low:.4g}, {area.high:.4g}]" if math.isfinite(area.low) else "-"
            last = f"{ends[arm]['at_the_end'].mean():.4g}"
            rows.append((arm, str(len(arms[arm])), f"{area.point:.4g}", interval, last))
        found += columns(rows)
        found.append(
            f"area: mean evaluation return up to {until:,} env steps. The best of {len(areas)} is flattered "
            "by having been chosen; new seeds say what it is worth."
        )
    if found:
        found += [f"{run.path}: left out: {why}" for run, why in collect.left_out(runs)]
        found += collect.check_protocols(runs, force=True)
    return found
