"""Writes one page about many runs: `python -m experiments.report runs/ --out=report.html`.

The page begins with the question and the answer, which are the directory's README.md. Then come what the
numbers say, with intervals; curves of every seed; training; diagnostics; what the agents do and see; cost;
and every difference between the arms. It opens offline. All rows lie beside it as a table, report.csv.
Several directories are compared with each other:
`python -m experiments.report runs/a runs/b --out=report.html`.
"""

import importlib.util
import math
from pathlib import Path

from absl import flags

from srl_jax.errors import ConfigError, saving
from srl_jax.files.reading import replace_text

from .command_line import flags as config_flags
from .command_line import paths

NEEDED = {"jinja2": "Jinja2", "markdown_it": "markdown-it-py", "matplotlib": "matplotlib", "PIL": "Pillow"}
"""Modules of the extra `plots`, by which a page is made, and their packages."""


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, _, texts = config_flags.kinds(values)
    texts("runs", None, "directory in or below which the runs are, or several; the name may be left out")
    text("out", None, "file to write, must end in .html or .htm; beside it goes a .csv")
    yes("overwrite", False, "replace the files if they are there")
    text("baseline", None, "arm that the others are compared with; by default one that is RL alone")
    texts(
        "reach",
        [],
        "GAME=SCORE, the score whose env steps are asked for; by default what the baseline ends with",
    )
    yes("force", False, "compare runs with different protocols")
    yes("finished_only", False, "compare only runs that have ended")
    yes("media", True, "show the runs' own pictures")


def check_reach(texts: list[str]) -> dict[str, float]:
    """The scores of --reach by game.

    Raises:
        ConfigError: one is not GAME=SCORE.
    """
    found = {}
    for given in texts:
        game, _, score = given.rpartition("=")
        if game in found:
            raise ConfigError(f"--reach={given}: {game} has a score already; give it once")
        try:
            found[game] = float(score)
        except ValueError:
            found[game] = math.nan
        if not game or not math.isfinite(found[game]):
            raise ConfigError(f"--reach={given}: must be GAME=SCORE, --reach=Pong=0")
    return found


def report(values: flags.FlagValues) -> Path:
    """Checks the command line, reads the runs and writes the page, and the table beside it.

    Args:
        values: parsed flags, as `define_flags` defines them.

    Returns:
        The page's file.

    Raises:
        ConfigError: the command line or what the runs hold is not valid; nothing was written.
        SaveError: a file cannot be written.
    """
    runs = values["runs"].value
    if not runs:
        raise ConfigError("--runs: missing; name a directory of runs, srl-jax report runs")
    if not (out := values["out"].value):
        raise ConfigError("--out: missing; name the page to write, --out=report.html")
    path = paths.check_file(
        "out", out, ".html", ".htm", overwrite=values["overwrite"].value, beside=".csv", deep=True
    )
    reach = check_reach(values["reach"].value)
    roots = [paths.given("runs", root) for root in runs]
    for root in roots:
        if not root.is_dir():
            raise ConfigError(f"--runs={root}: no such directory")
    if missing := [name for module, name in NEEDED.items() if not importlib.util.find_spec(module)]:
        raise ConfigError(f"a report needs {', '.join(missing)}: pip install 'srl-jax[plots]'")
    from .reporting import page

    table = path.with_suffix(".csv")
    same = {name: values[name].value for name in ("baseline", "force", "finished_only", "media")}
    html, rows = page.build(*roots, reach=reach, data=table.name, **same)
    with saving(f"--out={path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        for file, text in ((table, rows), (path, html)):
            replace_text(file, text)
    return path


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    path = report(values)
    for file in (path, path.with_suffix(".csv")):
        print(f"{file}: {file.stat().st_size / 1e3:,.0f} kB")


cli = config_flags.program(main, define_flags, positional="runs")

if __name__ == "__main__":
    cli()
