"""Draws a run's figures from its metrics.jsonl: `python -m experiments.draw --run=runs/pong`.

experiments.train does it by itself at the end of a run; this draws again, beside a curve of the thesis if
asked: `--thesis=6.2/rl_only_nature`.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import envs
from srl_jax.config import Config
from srl_jax.data import reference_policies, thesis_curve
from srl_jax.diagnostics.drift import STEPS, drift_matrix, drift_names
from srl_jax.errors import ConfigError
from srl_jax.metrics import KINDS, read_metrics
from srl_jax.specs import LIMITS

from . import diagnostic_plots, plots
from . import flags as config_flags

FLAGS = flags.FLAGS

GIF_SIZE = 84
"""Pixels: the longer side of play.gif, where frames are smaller by a whole factor."""


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
        pictures: {objective: (inputs, targets, outputs)}, see `srl_jax.loop.Result`.
        recording: uint8 [T, H, W, C], likewise; play.gif.

    Returns:
        The files written; empty if matplotlib is not installed.

    Raises:
        ConfigError: the thesis has no such curve, metrics.jsonl is not what training writes, or the figures
            cannot be written.
    """
    if not plots.available():
        return []
    rows = read_rows(run / "metrics.jsonl")
    figures = run / "figures"
    title = (
        f"{envs.label(config.game)}, {config.mode}, {config.encoder.partition(':')[0]}, seed {config.seed}"
    )
    reference, game = _reference(config, thesis) if thesis else None, config.game
    policies = {name: row.return_mean for name, row in reference_policies(game).items()}
    curve = figures / "learning_curve.png"
    written = [
        plots.learning_curve(rows, curve, title, reference, policies, game),
        plots.losses(rows, figures / "losses.png", game),
        diagnostic_plots.diagnostics(rows, figures / "diagnostics.png", title, game),
    ]
    written.append(diagnostic_plots.drift_matrix(rows, figures / "drift.png", title))
    for name, (inputs, targets, outputs) in (pictures or {}).items():
        path = figures / f"{name}.png"
        written.append(plots.image_panel(inputs, targets, outputs, path, f"{title}: {name}"))
    if recording is not None:
        scale = max(1, GIF_SIZE // max(recording.shape[1:3]))
        written.append(plots.gif(recording, figures / "play.gif", scale=scale))
    return [path for path in written if path]


def read_rows(path: Path) -> list[dict]:
    """`srl_jax.metrics.read_metrics`, with what is drawn of each row checked.

    Raises:
        ConfigError: it cannot be read, or holds something else than training writes; one line.
    """
    try:
        rows = read_metrics(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(str(error)) from None
    check_rows(rows, str(path))
    return rows


def check_rows(rows: list[dict], name: str) -> None:
    """Whether what is drawn of rows is what training writes.

    Args:
        rows: as `read_metrics` gives them.
        name: what they are the rows of, for errors.

    Raises:
        ConfigError: it is something else; one line.
    """
    for number, row in enumerate(rows, 1):
        if row.get("kind") not in KINDS:
            raise ConfigError(f"{name}, line {number}: kind is none of {', '.join(KINDS)}")
        if not _is_count(row.get("env_steps")):
            raise ConfigError(f"{name}, line {number}: env_steps is no count")
        for key, value in row.items():
            if key == "eval/returns":
                good = isinstance(value, list) and all(map(_is_number, value))
            elif key == STEPS:
                good = isinstance(value, list) and all(map(_is_count, value))
            elif key.startswith("diag/"):
                good = all(map(_is_number, value)) if isinstance(value, list) else _is_number(value)
            else:
                drawn = key == "eval/return_mean" or key.split("/")[0] in ("loss", "grad_norm")
                good = not drawn or _is_number(value)
            if not good:
                raise ConfigError(f"{name}, line {number}: {key} is not made of numbers of single precision")
    for kind in drift_names(rows):
        try:
            drift_matrix(rows, kind)
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= LIMITS[int]


def _is_number(value: Any) -> bool:
    """Whether a value is a number that single precision holds, or null."""
    return value is None or (type(value) in (int, float) and abs(value) <= LIMITS[float])


def _reference(config: Config, thesis: str) -> list[tuple[str, Iterable, Iterable]]:
    figure, _, arm = thesis.partition("/")
    try:
        steps, returns = thesis_curve(figure, config.game, arm)
    except ValueError as error:
        raise ConfigError(f"--thesis={thesis}: {error}") from None
    return [(f"thesis, figure {figure}, {arm} (one run)", steps, returns)]


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    if not FLAGS.run:
        raise ConfigError("--run: missing; name a run directory, --run=runs/NAME")
    config = Config.load(FLAGS.run)
    if not plots.available():
        raise ConfigError("figures need matplotlib and Pillow: pip install 'srl-jax[plots]'")
    try:
        written = draw_run(Path(FLAGS.run), config, thesis=FLAGS.thesis)
    except OSError as error:
        raise ConfigError(f"--run={FLAGS.run}: {error.filename}: {error.strerror}") from None
    for path in written:
        print(path)


def cli() -> None:
    """Runs this entry point as a program."""
    flags.DEFINE_string("run", "", "run directory")
    flags.DEFINE_string("thesis", "", "FIGURE/ARM, a curve of the thesis to draw beside the run's")
    config_flags.run(main, positional="run")


if __name__ == "__main__":
    cli()
