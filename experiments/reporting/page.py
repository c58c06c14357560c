"""The page as a whole: the same runs give the same bytes."""

import importlib.resources
from collections.abc import Mapping
from pathlib import Path

from srl_jax.errors import ConfigError

from .. import collect
from . import conditions, gallery, numbers, overview, tables
from .contents import Content, Report
from .markup import Markup, listed, plural, tag

SECTIONS = (
    ("run", "What was run", overview.what_was_run),
    ("says", "What the numbers say", overview.what_it_says),
    ("figures", "Figures", gallery.figures),
    ("statistics", "Statistics", tables.statistics_of),
    ("curves", "Learning curves", gallery.learning_curves),
    ("profiles", "Performance profiles", gallery.profiles),
    ("play", "The agents playing", gallery.playing),
    ("panels", "Reconstruction and prediction", gallery.panels),
    ("diagnostics", "Diagnostics", gallery.diagnostic_pictures),
    ("cost", "Time and cost", conditions.cost),
    ("settings", "Settings", conditions.settings),
    ("protocol", "Protocol", conditions.protocol),
)
"""Their names in links, their titles, and functions of a Report that give their contents, or nothing."""


def build(
    *roots: str | Path,
    baseline: str | None = None,
    reach: Mapping[str, float] | None = None,
    force: bool = False,
    finished_only: bool = False,
    media: bool = True,
) -> str:
    """The page of all runs in or below directories, as HTML.

    Args:
        *roots: the directories; their figures/*.png are shown, too.
        baseline: the arm that the others are compared with, or None for what `numbers.baseline_of` says.
        reach: game -> score, where the env steps to reach it are asked for.
        force: compare what differs in its protocol.
        finished_only: compare runs that have ended only.
        media: show the runs' own pictures.

    Raises:
        ConfigError: there is no run, something is not what training writes, protocols differ and it is not
            forced, or there is no such baseline or game.
    """
    report = gather(
        [Path(root) for root in roots],
        baseline=baseline,
        reach=reach or {},
        force=force,
        finished_only=finished_only,
        media=media,
    )
    sections = [(name, title, content(report)) for name, title, content in SECTIONS]
    return _page(report, [section for section in sections if section[2]])


def gather(
    roots: list[Path],
    *,
    baseline: str | None,
    reach: Mapping[str, float],
    force: bool,
    finished_only: bool,
    media: bool,
) -> Report:
    """Reads and compares the runs; see `build`."""
    runs = collect.load_runs(*roots)
    forced = collect.check_protocols(runs, force=force)
    try:
        collect.check_arms(runs)
    except ConfigError as error:
        if not force:
            raise ConfigError(f"{error}; --force compares them all the same") from None
        forced = [*forced, str(error)]
    games = list(collect.grouped(runs))
    if unknown := [game for game in reach if game not in games]:
        raise ConfigError(f"--reach={unknown[0]}: no run of that game; valid: {', '.join(games)}")
    arms = numbers.arms_of(runs)
    against = numbers.baseline_of(runs, arms, baseline)
    arms = sorted(arms, key=lambda arm: arm != against)  # it first, the others as they were
    compared = [run for run in runs if not finished_only or numbers.finished(run)]
    comparisons = numbers.compare(compared, arms)
    targets = numbers.targets(comparisons, against, reach)
    rows = numbers.rows(comparisons, arms, against, targets)
    return Report(roots, runs, arms, against, forced, finished_only, comparisons, rows, targets, media)


def _page(report: Report, sections: list[tuple[str, str, Content]]) -> str:
    title = f"{listed(report.games)}: {plural(len(report.arms), 'arm')}, {plural(len(report.runs), 'run')}"
    style = importlib.resources.files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    # Whatever a name in the runs may be: nothing is fetched and nothing is executed.
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),
        tag("style", Markup(style)),
    ]
    links = tag("nav", [tag("a", name, href=f"#{key}") for key, name, _ in sections], aria_label="Sections")
    parts = [tag("section", tag("h2", name), content, id=key) for key, name, content in sections]
    body = tag("main", tag("h1", title), links, parts)
    return f"<!doctype html>\n{tag('html', tag('head', head), tag('body', body), lang='en')}\n"
