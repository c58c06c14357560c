"""Draws a run's figures from its metrics.jsonl: `python -m experiments.draw runs/pong`.

A run draws its figures when it ends. This command draws them again, and `--thesis=6.2/rl_only_nature` adds a
curve of the thesis. `srl-jax compare` draws several runs.
"""

from absl import flags

from srl_jax.config import Config
from srl_jax.errors import ConfigError

from .command_line import flags as config_flags
from .command_line import paths
from .drawing import plots, run_figures


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    if not values.run:
        raise ConfigError("--run: missing; name a run directory, srl-jax draw runs/NAME")
    path = paths.given("run", values.run)
    config = Config.load(path)
    if not plots.available():
        raise ConfigError("figures need matplotlib and Pillow: pip install 'srl-jax[plots]'")
    try:
        written = run_figures.draw_run(path, config, thesis=values.thesis)
    except OSError as error:
        raise ConfigError(f"--run={values.run}: {error.filename}: {error.strerror}") from None
    for path in written:
        print(path)


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_string("run", "", "run directory", values)
    flags.DEFINE_string("thesis", "", "FIGURE/ARM, a curve of the thesis to draw beside the run's", values)


cli = config_flags.program(main, define_flags, positional="run")

if __name__ == "__main__":
    cli()
