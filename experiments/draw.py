"""Draws a run's figures from its metrics.jsonl: `python -m experiments.draw runs/pong`.

A run draws its figures when it ends. This command draws them again, and `--thesis=6.2/rl_only_nature` adds a
curve of the thesis. `srl-jax compare` draws several runs.
"""

from pathlib import Path

from absl import flags

from srl_jax.config import Config
from srl_jax.errors import ConfigError

from .command_line import flags as config_flags
from .drawing import plots, run_figures

FLAGS = flags.FLAGS


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    if not FLAGS.run:
        raise ConfigError("--run: missing; name a run directory, srl-jax draw runs/NAME")
    config = Config.load(FLAGS.run)
    if not plots.available():
        raise ConfigError("figures need matplotlib and Pillow: pip install 'srl-jax[plots]'")
    try:
        written = run_figures.draw_run(Path(FLAGS.run), config, thesis=FLAGS.thesis)
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
