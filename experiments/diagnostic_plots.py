"""The figures of a run's diagnostics (see `srl_jax.diagnostics`), as small PNG files."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax.diagnostics import drift

from .plots import COLOURS, count_axis, log_axis, new_figure, save, steps_label

WRITTEN_IN = 11
"""Epochs up to which a matrix has its numbers written in."""
PROBE = "linear probe of the state, R²"
MOST_VARIABLES = 8
"""Of the game's state up to which each is drawn, and not their mean alone."""


def drift_matrix(rows: Sequence[Mapping[str, Any]], path: str | os.PathLike, title: str) -> Path | None:
    """Draws the error of each epoch's decoder on each epoch's encoder, a panel for each objective.

    Args:
        rows: of metrics.jsonl.
        path: of the PNG file.
        title: of the figure.

    Returns:
        The path, or None if fewer than two epochs were kept of every objective (nothing is written then).

    Raises:
        ValueError: rows whose lists do not fit together.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import EngFormatter

    found = {name: drift.drift_matrix(rows, name) for name in drift.drift_names(rows)}
    found = {n: (steps, m) for n, (steps, m) in found.items() if len(steps) > 1 and (m > 0).any()}
    if not found:
        return None
    figure = new_figure(4.6 * len(found) + 0.4, 4.3)
    figure.suptitle(title, fontsize=10).set_parse_math(False)
    count = EngFormatter(sep="")
    for axes, (name, (steps, matrix)) in zip(
        figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True
    ):
        low, high = np.nanmin(matrix[matrix > 0]), np.nanmax(matrix)
        shown = axes.imshow(matrix, cmap="viridis", norm=LogNorm(low, high if high > low else 2 * low))
        axes.set_title(f"error of {name}", fontsize=9, parse_math=False)
        labels = [count(step) for step in steps]
        axes.set_xticks(range(len(steps)), labels, rotation=60, fontsize=7)
        axes.set_yticks(range(len(steps)), labels, fontsize=7)
        axes.set_xlabel("encoder of env step", fontsize=8)
        axes.set_ylabel("decoder of env step", fontsize=8)
        if len(steps) <= WRITTEN_IN:
            for (i, j), error in np.ndenumerate(matrix):
                dark = np.isfinite(error) and error > 0 and np.log(error / low) * 2 < np.log(high / low)
                text = f"{error:.1e}".replace("e-0", "e-") if np.isfinite(error) else "?"
                axes.text(
                    j, i, text, ha="center", va="center", fontsize=5, color="white" if dark else "black"
                )
        bar = figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.03)
        bar.set_label("mean squared error", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    return save(figure, path)


def diagnostics(
    rows: Iterable[Mapping[str, Any]], path: str | os.PathLike, title: str, game: str = ""
) -> Path | None:
    """Draws the numbers among a run's diagnostics against env steps of its game, a panel for each kind.

    Returns:
        The path, or None if there are none (nothing is written then).
    """
    panels = {name: lines for name, lines in _panels(list(rows)).items() if lines}
    if not panels:
        return None
    columns = min(len(panels), 3)
    lines = -(-len(panels) // columns)
    figure = new_figure(3.4 * columns + 0.4, 2.5 * lines + 0.4)
    figure.suptitle(title, fontsize=10).set_parse_math(False)
    for i, (name, curves) in enumerate(panels.items()):
        axes = figure.add_subplot(lines, columns, i + 1)
        axes.set_title(name, fontsize=9, parse_math=False)
        for number, (label, (at, values)) in enumerate(curves.items()):
            style = {"linestyle": ("-", "--", ":")[number // len(COLOURS) % 3], "linewidth": 1.3}
            marker = "." if len(at) <= 30 else ""
            axes.plot(at, values, color=COLOURS[number % len(COLOURS)], marker=marker, label=label, **style)
        drawn = [value for _, values in curves.values() for value in values]
        if "ratio" in name and min(drawn) > 0:
            log_axis(axes, max(drawn) / min(drawn))
        if len(curves) > 1 or next(iter(curves)) != name:
            for text in axes.legend(fontsize=6, framealpha=0.7, ncols=1 + len(curves) // 7).get_texts():
                text.set_parse_math(False)
        count_axis(axes)
        axes.tick_params(labelsize=7)
        if i + columns >= len(panels):
            axes.set_xlabel(steps_label(game), fontsize=8)
    return save(figure, path)


def _panels(rows: list[Mapping[str, Any]]) -> dict[str, dict[str, tuple[list, list]]]:
    """{panel: {label: (env steps, values)}}."""
    rows = [row for row in rows if any(key.startswith("diag/") for key in row)]
    keys = sorted({key for row in rows for key in row if key.startswith("diag/")})

    def curve(key: str, of_list: int | None = None) -> tuple[list, list]:
        at, values = [], []
        for row in rows:
            value = row.get(key)
            if of_list is not None and isinstance(value, list):
                value = value[of_list] if value else None
            if isinstance(value, int | float):
                at.append(row["env_steps"])
                values.append(value)
        return at, values

    def group(start: str, end: str = "") -> dict[str, tuple[list, list]]:
        chosen = [key for key in keys if key.startswith(start) and key.endswith(end)]
        return {key.removeprefix(start).removesuffix(end).strip("/"): curve(key) for key in chosen}

    drift = {
        f"{measure}, {words}": curve(f"diag/drift/{measure}", place)
        for measure in ("cosine", "cka")
        for words, place in (("first kept", 0), ("last kept", -1))
    }
    panels = {
        "effective rank of the latent": group("diag/effective_rank"),
        "share of units": {what: curve(f"diag/{what}_share") for what in ("dormant", "constant")},
        "latents now and then": drift,
        "gradient's cosine with RL's": group("diag/gradient/", "/cosine"),
        "gradient's norm, ratio to RL's": group("diag/gradient/", "/norm_ratio"),
        "error on moving pixels": group("diag/error/", "/moving"),
        "error on static pixels": group("diag/error/", "/static"),
        "explained of what moves": group("diag/error/", "/moving_explained"),
        PROBE: group("diag/probe/"),
    }
    probes = panels[PROBE]
    if len(probes) > MOST_VARIABLES + 1:
        panels[PROBE] = {"mean": probes["mean"]}
    return {
        panel: {label or panel: curve for label, curve in curves.items() if curve[0]}
        for panel, curves in panels.items()
    }
