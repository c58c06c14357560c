"""One self-contained page about many runs: `python -m experiments.report runs/ --out=report.html`.

What was run, figures, statistics with intervals, learning curves, what the agents do and see, diagnostics,
cost, and every difference between the arms. It opens offline. Several directories are compared with each
other: `python -m experiments.report runs/a runs/b --out=report.html`.
"""

import os
from pathlib import Path

from absl import flags

from srl_jax.errors import ConfigError, SaveError

from . import flags as config_flags
from . import plots

FLAGS = flags.FLAGS


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_multi_string(
        "runs",
        None,
        "directory in or below which the runs are, or several; the name may be left out",
        flag_values=values,
    )
    flags.DEFINE_string("out", None, "file to write, must end in .html", flag_values=values)
    flags.DEFINE_boolean("overwrite", False, "replace the file if there is one", flag_values=values)
    flags.DEFINE_string(
        "baseline", None, "arm that the others are compared with; by default RL alone", flag_values=values
    )
    flags.DEFINE_multi_string(
        "reach",
        [],
        "GAME=SCORE, the score whose env steps are asked for; by default what the baseline ends with",
        flag_values=values,
    )
    flags.DEFINE_boolean("force", False, "compare runs with different protocols", flag_values=values)
    flags.DEFINE_boolean("finished_only", False, "compare only runs that have ended", flag_values=values)
    flags.DEFINE_boolean("media", True, "show the runs' own pictures", flag_values=values)


def check_out(out: str | None, *, overwrite: bool) -> Path:
    """Whether the page can be written there; writes nothing.

    Raises:
        ConfigError: it cannot, or there is a file that must not be overwritten.
    """
    if not out:
        raise ConfigError("--out: missing; name a file, --out=report.html")
    if Path(out).suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--out={out}: must end in .html")
    config_flags.check_name("out", out)
    path = Path(os.path.expanduser(out))
    config_flags.check_place("out", str(path.parent))
    try:
        if path.is_dir():
            raise ConfigError(f"--out={out}: is a directory")
        if os.path.lexists(path) and not overwrite:
            raise ConfigError(f"--out={out}: exists; name a new file, or --overwrite replaces it")
    except OSError as error:
        raise ConfigError(f"--out={out}: {error.strerror}") from None
    return path


def check_reach(texts: list[str]) -> dict[str, float]:
    """The scores of --reach by game.

    Raises:
        ConfigError: one is not GAME=SCORE.
    """
    found = {}
    for given in texts:
        game, _, score = given.partition("=")
        try:
            found[game] = float(score)
        except ValueError:
            raise ConfigError(f"--reach={given}: must be GAME=SCORE, --reach=Pong=0") from None
        if not game or not abs(found[game]) < float("inf"):
            raise ConfigError(f"--reach={given}: must be GAME=SCORE, --reach=Pong=0")
    return found


def write(path: Path, text: str) -> None:
    """Writes the page as a whole or not at all.

    Raises:
        SaveError: it cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise SaveError(f"--out={path}: {error.strerror}") from None


def report(values: flags.FlagValues) -> Path:
    """Checks the command line, reads the runs and writes the page.

    Args:
        values: parsed flags, as `define_flags` defines them.

    Returns:
        The file that was written.

    Raises:
        ConfigError: the command line or what the runs hold is not valid; nothing was written.
        SaveError: the page cannot be written.
    """
    runs = values["runs"].value
    if not runs:
        raise ConfigError("--runs: missing; name a directory of runs, python -m experiments.report runs/")
    path = check_out(values["out"].value, overwrite=values["overwrite"].value)
    reach = check_reach(values["reach"].value)
    for root in runs:
        if not Path(root).is_dir():
            raise ConfigError(f"--runs={root}: no such directory")
    if not plots.available():
        raise ConfigError("the pictures of a report need matplotlib and Pillow: pip install 'srl-jax[plots]'")
    from .reporting import page

    same = {name: values[name].value for name in ("baseline", "force", "finished_only", "media")}
    write(path, page.build(*runs, reach=reach, **same))
    return path


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    path = report(FLAGS)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def cli() -> None:
    """Runs this entry point as a program."""
    define_flags()
    config_flags.run(main, positional="runs")


if __name__ == "__main__":
    cli()
