"""The figures of one run, from the rows of its metrics.jsonl: `figures/` of its directory."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax import envs
from srl_jax.config import Config
from srl_jax.data import thesis_curve
from srl_jax.diagnostics import drift
from srl_jax.errors import ConfigError

from ..runs.run_data import read_rows
from . import images, plots

GIF_SIZE = 84
"""Pixels: the longer side of play.gif, where frames are smaller by a whole factor."""
MOST_LINES = 9
"""Of a panel of diagnostics; one with more draws their mean alone, if there is one."""
LOGARITHMIC = ("loss/", "norm", "error/")
"""What is in a key whose axis may be logarithmic."""


def draw_run(
    run: Path,
    config: Config,
    *,
    thesis: str = "",
    pictures: dict | None = None,
    recording: np.ndarray | None = None,
) -> list[Path]:
    """Draws `figures/` of a run directory: learning curve, losses, diagnostics, panels of objectives, games.

    Args:
        run: the run directory.
        config: of the run.
        thesis: FIGURE/ARM, a curve of the thesis to draw beside the run's own; empty for none.
        pictures: {objective: (inputs, targets, outputs)}, see `srl_jax.run.loop.Result`.
        recording: uint8 [T, H, W, C], likewise; play.gif.

    Returns:
        The files written; empty if matplotlib is not installed.

    Raises:
        ConfigError: the thesis has no such curve, or metrics.jsonl is not what training writes.
        OSError: a figure cannot be written.
    """
    if not plots.available():
        return []
    rows, figures, game = read_rows(run / "metrics.jsonl"), run / "figures", config.game
    title = f"{envs.label(game)}, {config.mode}, {config.encoder.partition(':')[0]}, seed {config.seed}"
    written = [
        learning_curve(rows, figures / "learning_curve.png", title, config, thesis),
        numbers(rows, ("loss", "grad_norm"), figures / "losses.png", title, game),
        numbers(rows, ("diag",), figures / "diagnostics.png", title, game),
        drift_matrix(rows, figures / "drift.png", title),
    ]
    for name, shown in (pictures or {}).items():
        written.append(images.image_panel(*shown, figures / f"{name}.png", f"{title}: {name}"))
    if recording is not None:
        scale = max(1, GIF_SIZE // max(recording.shape[1:3]))
        written.append(images.gif(recording, figures / "play.gif", scale=scale))
    return [path for path in written if path]


def learning_curve(
    rows: Sequence[Mapping[str, Any]], path: Path, title: str, config: Config, thesis: str = ""
) -> Path | None:
    """Draws the mean evaluation return, and the worst to the best game, against env steps.

    Args:
        rows: of metrics.jsonl; those of kind "eval" with `eval/return_mean` count.
        path: of the PNG file.
        title: of the figure.
        config: of the run.
        thesis: see `draw_run`.

    Returns:
        The path, or None if there is no evaluation to draw (then nothing is written).

    Raises:
        ConfigError: the thesis has no such curve.
    """
    figure, _, arm = thesis.partition("/")
    try:
        reference = thesis_curve(figure, config.game, arm) if thesis else None
    except ValueError as error:
        raise ConfigError(f"--thesis={thesis}: {error}") from None
    evals = [row for row in rows if row["kind"] == "eval" and "eval/return_mean" in row]
    if not evals:
        return None
    games = [np.array(row.get("eval/returns") or [np.nan], float) for row in evals]
    points = [(row["env_steps"], row["eval/return_mean"]) for row in evals]
    bands = [(game.min(), game.max()) for game in games]
    curve = plots.Curve(*np.array(points, float).T, *np.array(bands).T)
    counts = sorted({len(game) for game in games if np.isfinite(game).all()})
    notes = [f"band: worst to best of {' or '.join(map(str, counts))} games"] if counts else []
    notes += [f"dashed: the thesis, figure {figure}, {arm} (one run)"] if thesis else []
    for row in rows:
        if (final := row.get("final/return_mean")) is not None:
            notes.append(f"final: {final:.4g}, the mean of {row.get('final/games', '?')} games")
    line = plots.Line("this run", curve, thesis=reference)
    panel = plots.Panel(config.game, [line], (), plots.policy_levels(config))
    return plots.draw_panels([panel], path, title, "; ".join(notes))


def numbers(
    rows: Sequence[Mapping[str, Any]], kinds: Sequence[str], path: Path, title: str, game: str = ""
) -> Path | None:
    """Draws numbers of rows that have no picture of their own, a panel each.

    Keys that differ in the name of an objective, or of a variable, alone share one: diag/error/*/moving. Of a
    list, which is over the kept encoders, both ends are drawn. Of many values a running mean is drawn, and
    a band from the least to the largest of those that it is of.

    Args:
        rows: of metrics.jsonl.
        kinds: what keys begin with, up to the first slash.
        path: of the PNG file.
        title: of the figure.
        game: of the run.

    Returns:
        The path, or None if there is nothing to draw (then nothing is written).
    """
    known = sorted({key for row in rows for key in row})
    elsewhere = (drift.STEPS, drift.DECODER_NOW, drift.ENCODER_NOW)  # in `drift_matrix`
    keys = [key for kind in kinds for key in known if key.partition("/")[0] == kind]
    panels: dict[str, list[plots.Line]] = {}
    for key in (key for key in keys if not key.startswith(elsewhere)):
        name, label = key, "this run"
        if key.startswith("diag/") and key.count("/") > 1:
            diag, measure, label, *rest = key.split("/")
            name = "/".join([diag, measure, "*", *rest])
        ends = {"": 0}
        if any(isinstance(row.get(key), list) for row in rows):
            ends = {", first kept": 0, ", last kept": -1}
        for end, place in ends.items():
            if (curve := _curve(rows, key, place)) is not None:
                panels.setdefault(name, []).append(plots.Line(label + end, curve))
    for name, lines in panels.items():
        if len(lines) > MOST_LINES:
            panels[name] = [line for line in lines if line.label == "mean"] or lines
    if not panels:
        return None
    shown = [
        plots.Panel(game, lines, title=name, log=any(word in name for word in LOGARITHMIC))
        for name, lines in panels.items()
    ]
    return plots.draw_panels(shown, path, title, label="")


def _curve(rows: Sequence[Mapping[str, Any]], key: str, place: int) -> plots.Curve | None:
    """A key's values, or an element's of its lists, without nulls; None if there are none."""
    found = [(row["env_steps"], row[key]) for row in rows if row.get(key) not in (None, [])]
    found = [(at, value[place] if isinstance(value, list) else value) for at, value in found]
    found = [(at, value) for at, value in found if value is not None]
    if not found:
        return None
    window = max(len(found) // 25, 1)
    at, values = np.lib.stride_tricks.sliding_window_view(np.array(found, float).T, window, axis=1)
    return plots.Curve(at.mean(1), values.mean(1), values.min(1), values.max(1))


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
    figure = plots.new_figure(4.6 * len(found) + 0.4, 4.3)
    plots.head(figure, title, 10)
    grid = figure.subplots(1, len(found), squeeze=False)[0]
    for axes, (name, (steps, matrix)) in zip(grid, found.items(), strict=True):
        low, high = np.nanmin(matrix[matrix > 0]), np.nanmax(matrix)
        shown = axes.imshow(matrix, cmap="viridis", norm=LogNorm(low, high if high > low else 2 * low))
        axes.set_title(f"error of {name}", fontsize=9, parse_math=False)
        labels = [EngFormatter(sep="")(step) for step in steps]
        axes.set_xticks(range(len(steps)), labels, rotation=60, fontsize=7)
        axes.set_yticks(range(len(steps)), labels, fontsize=7)
        axes.set_xlabel("encoder of env step", fontsize=8)
        axes.set_ylabel("decoder of env step", fontsize=8)
        bar = figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.03)
        bar.set_label("mean squared error", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    return plots.save(figure, path)
