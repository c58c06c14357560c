"""Draws a run's figures from its metrics.jsonl: `python -m experiments.draw --run=runs/pong`.

experiments.train does it by itself at the end of a run; this draws again, beside a curve of the thesis if
asked: `--thesis=6.2/rl_only_nature`.
"""

from collections.abc import Iterable
from pathlib import Path

from absl import flags

from experiments import flags as config_flags
from experiments import plots
from srl_jax.config import Config
from srl_jax.data import thesis_curve
from srl_jax.errors import ConfigError
from srl_jax.metrics import read_metrics

FLAGS = flags.FLAGS


def draw_run(run: Path, config: Config, *, thesis: str = "", pictures: dict | None = None) -> list[Path]:
    """Draws `figures/` of a run directory: learning curve, losses, and a panel for each objective.

    Args:
        run: the run directory.
        config: of the run.
        thesis: FIGURE/ARM, a curve of the thesis to draw beside the run's own; empty for none.
        pictures: {objective: (inputs, targets, outputs)}, see `srl_jax.loop.Result`.

    Returns:
        The files written; empty if matplotlib is not installed.

    Raises:
        ConfigError: the thesis has no such curve.
    """
    if not plots.available():
        return []
    rows = read_metrics(run / "metrics.jsonl")
    figures = run / "figures"
    title = f"{config.game}, {config.mode}, {config.encoder.partition(':')[0]}, seed {config.seed}"
    curve = plots.learning_curve(
        rows, figures / "learning_curve.png", title, _reference(config, thesis) if thesis else None
    )
    written = [curve, plots.losses(rows, figures / "losses.png")]
    for name, (inputs, targets, outputs) in (pictures or {}).items():
        path = figures / f"{name}.png"
        written.append(plots.image_panel(inputs, targets, outputs, path, f"{title}: {name}"))
    return [path for path in written if path]


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
    for path in draw_run(Path(FLAGS.run), config, thesis=FLAGS.thesis):
        print(path)


if __name__ == "__main__":
    flags.DEFINE_string("run", "", "run directory")
    flags.DEFINE_string("thesis", "", "FIGURE/ARM, a curve of the thesis to draw beside the run's")
    config_flags.run(main)
