"""The page: a section each for what was run, the figures, the numbers, the pictures and the settings."""

import importlib.resources
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import collect, curves
from experiments.collect import RunData
from experiments.reporting import diagnostics, numbers, pictures
from experiments.reporting.markup import Markup, details, figure, listed, number, plural, table, tag
from experiments.reporting.numbers import Comparison, Row
from srl_jax import statistics
from srl_jax.data import published
from srl_jax.errors import ConfigError
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.statistics import Interval

MEDIA_BYTES = 5_000_000
"""Of pictures taken from the runs, in all; base64 adds a third."""
LARGEST_PICTURE, SMALLEST_PICTURE = 400_000, 40_000
"""Bytes that one of them may have where there are few, and may always have."""
OWN = ("learning_curve.png", "losses.png")
"""Pictures of a run that the report draws better from all seeds."""

Content = Markup | list | None


class Report(NamedTuple):
    """What all sections start from.

    Attributes:
        root: where the runs are.
        runs: all of them.
        arms: in their order.
        baseline: what others are compared with, or None.
        forced: lines on protocols and arms that do not fit together, and were compared all the same.
        comparisons: game -> learning curves at equal steps.
        rows: the table of each game.
        targets: game -> the score to be reached.
        media: whether pictures of the runs are shown.
    """

    root: Path
    runs: list[RunData]
    arms: list[str]
    baseline: str | None
    forced: list[str]
    comparisons: dict[str, Comparison | None]
    rows: list[Row]
    targets: dict[str, float]
    media: bool

    @property
    def games(self) -> list[str]:
        """In their order."""
        return list(collect.grouped(self.runs))

    def of(self, game: str, arm: str | None = None) -> list[RunData]:
        """The runs of a game, or of one arm on it."""
        return [run for run in self.runs if run.game == game and arm in (None, run.arm)]


def build(
    root: str | Path,
    *,
    baseline: str | None = None,
    reach: Mapping[str, float] | None = None,
    force: bool = False,
    finished_only: bool = False,
    media: bool = True,
) -> str:
    """The page of all runs in or below a directory, as HTML; the same runs give the same bytes.

    Args:
        root: the directory; its figures/*.png are shown, too.
        baseline: the arm that the others are compared with, or None for what `numbers.baseline_of` says.
        reach: game -> score, where the env steps to reach it are asked for.
        force: compare what differs in its protocol.
        finished_only: compare runs that have ended only.
        media: show the runs' own pictures.

    Raises:
        ConfigError: there is no run, something is not what training writes, protocols differ and it is not
            forced, or there is no such baseline.
    """
    root = Path(root)
    runs = collect.load_runs(root)
    forced = collect.check_protocols(runs, force=force)
    try:
        collect.check_arms(runs)
    except ConfigError as error:
        if not force:
            raise ConfigError(f"{error}; --force compares them all the same") from None
        forced.append(str(error))
    arms = numbers.arms_of(runs)
    against = numbers.baseline_of(runs, arms, baseline)
    compared = [run for run in runs if not finished_only or numbers.finished(run)]
    comparisons = numbers.compare(compared, arms)
    wanted = numbers.targets(comparisons, against, reach or {}) if against else {}
    rows = numbers.rows(comparisons, arms, against, wanted) if against else []
    report = Report(root, runs, arms, against, forced, comparisons, rows, wanted, media)
    sections = [
        ("run", "What was run", what_was_run(report)),
        ("says", "What the numbers say", what_it_says(report)),
        ("figures", "Figures", figures(report)),
        ("statistics", "Statistics", tables(report)),
        ("curves", "Learning curves", learning_curves(report)),
        ("pictures", "What the agents do and see", run_pictures(report)),
        ("diagnostics", "Diagnostics", diagnostic_pictures(report)),
        ("cost", "Time and cost", cost(report)),
        ("settings", "Settings", settings(report)),
        ("protocol", "Protocol", protocol(report)),
    ]
    return _page(report, [(name, title, content) for name, title, content in sections if content])


def _page(report: Report, sections: list[tuple[str, str, Content]]) -> str:
    title = f"{listed(report.games)}: {plural(len(report.arms), 'arm')}, {plural(len(report.runs), 'run')}"
    style = importlib.resources.files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        # Whatever a name in the runs may be: nothing is fetched and nothing is executed.
        tag(
            "meta",
            http_equiv="Content-Security-Policy",
            content="default-src 'none'; img-src data:; style-src 'unsafe-inline'",
        ),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),
        tag("style", Markup(style)),
    ]
    links = tag("nav", [tag("a", name, href=f"#{key}") for key, name, _ in sections], aria_label="Sections")
    parts = [tag("section", tag("h2", name), content, id=key) for key, name, content in sections]
    body = tag("main", tag("h1", title), links, parts)
    return f"<!doctype html>\n{tag('html', tag('head', head), tag('body', body), lang='en')}\n"


# What was run


def what_was_run(report: Report) -> Content:
    """Games, arms, seeds, env steps, revisions, when, on what; runs that have not ended, by name."""
    abouts = [numbers.about(run) for run in report.runs]
    done = [run for run in report.runs if numbers.finished(run)]
    planned = sorted({run.config.steps for run in report.runs})
    total = sum(numbers.reached_step(run) for run in report.runs)
    began = sorted({about.started for about in abouts if about.started})
    revisions = sorted({about.revision or "not recorded" for about in abouts})
    facts = [
        ("Games", listed(report.games)),
        ("Arms", ", ".join(report.arms)),
        ("Seeds", _seeds_text(report)),
        (
            "Env steps",
            f"{listed(f'{n:,}' for n in planned)} a run; {total:,} in all (4 frames each in Atari)",
        ),
        ("Complete", f"{len(done)} of {plural(len(report.runs), 'run')}"),
        ("Compared with", report.baseline or "nothing: no arm has a policy"),
        ("Begun (UTC)", _from_to(began) if began else "not recorded"),
        (
            "Revisions",
            [[", " if i else "", tag("code", name[:12])] for i, name in enumerate(_short(revisions))],
        ),
        ("Machine", _machine(abouts)),
        ("Directory", tag("code", report.root.name or report.root)),
    ]
    left = [run for run in report.runs if run not in done]
    parts: list = [tag("dl", [[tag("dt", name), tag("dd", value)] for name, value in facts])]
    if left:
        items = [
            tag("li", f"{_name(run)}: {numbers.reached_step(run):,} of {run.config.steps:,} env steps")
            for run in left
        ]
        parts.append(tag("div", tag("strong", "Not finished:"), tag("ul", items), class_="warn"))
    if len(revisions) > 1:
        parts.append(tag("p", "The runs are of several revisions of the code.", class_="note"))
    parts.append(details("Every run", _all_runs(report)))
    versions = sorted({f"{name} {version}" for about in abouts for name, version in about.versions})
    if versions:
        parts.append(details("Versions", tag("p", ", ".join(versions), class_="note")))
    return parts


def _short(revisions: Sequence[str]) -> list[str]:
    return [
        name if name == "not recorded" else name[:10] + ("-dirty" if name.endswith("-dirty") else "")
        for name in revisions
    ]


def _name(run: RunData) -> str:
    return f"{run.game} / {run.arm} / seed {run.seed}"


def _from_to(ordered: Sequence[str]) -> str:
    return ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def _seeds_text(report: Report) -> str:
    counts = {len(report.of(game, arm)) for game in report.games for arm in report.arms} - {0}
    seeds = ", ".join(map(str, sorted({run.seed for run in report.runs})))
    each = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"
    return f"{each} of each arm on each game ({seeds})"


def _machine(abouts: Sequence[numbers.About]) -> str:
    found = []
    for about in abouts:
        versions = dict(about.versions)
        parts = [versions.get("platform", ""), f"{about.cpus} CPUs" if about.cpus else ""]
        parts += [f"{name} {versions[name]}" for name in ("python", "jax") if name in versions]
        found.append(", ".join(filter(None, parts)))
    return "; ".join(sorted(set(found) - {""})) or "not recorded"


def _all_runs(report: Report) -> Markup:
    rows = []
    for run in report.runs:
        steps, returns = collect.steps_and_returns(run)
        about = numbers.about(run)
        last = f"{number(float(returns[-1]))} at {steps[-1]:,}" if len(steps) else "–"
        rows.append(
            [
                _name(run),
                f"{numbers.reached_step(run):,} of {run.config.steps:,}",
                "yes" if numbers.finished(run) else "no",
                str(len(steps)),
                last,
                _short([about.revision or "not recorded"])[0],
                about.started or "–",
                tag("code", run.path.relative_to(report.root) if run.path != report.root else run.path.name),
            ]
        )
    head = (
        "run",
        "env steps",
        "finished",
        "evaluations",
        "last return",
        "revision",
        "begun (UTC)",
        "directory",
    )
    return table(head, rows)


# What the numbers say


def what_it_says(report: Report) -> Content:
    """The comparison in sentences: only what follows from an interval."""
    if not report.rows:
        return None
    parts: list = []
    total = max(row.seeds for row in report.rows)
    for game in report.comparisons:
        rows = [row for row in report.rows if row.game == game and row.arm != report.baseline]
        base = next((r for r in report.rows if r.game == game and r.arm == report.baseline), None)
        if base is None or not rows:
            continue
        end = int(report.comparisons[game].steps[-1])
        items = []
        for what, of in (("final return", "final"), ("return averaged over env steps", "area")):
            clear = []
            for row in rows:
                found = getattr(row, f"{of}_difference")
                if found is not None and (side := _side(found)):
                    word = "above" if side > 0 else "below"
                    clear.append(f"{row.arm} is {number(abs(float(found.point)))} {word} ({_limits(found)})")
            own = getattr(base, of)
            start = f"{what} of {report.baseline}: {number(float(own.point))} {_limits(own)}. "
            items.append(tag("li", start, _clear(clear, rows, of)))
        parts.append(
            tag("p", tag("strong", game), f", at {end:,} env steps, by {_seed_counts(report, game)}:")
        )
        parts.append(tag("ul", items))
    parts.append(_aggregate_sentence(report))
    if total < 10:
        parts.append(
            tag(
                "p",
                "Intervals are 95 % stratified-bootstrap intervals over seeds. With so few seeds they are too "
                "narrow, and many comparisons at once find some difference by chance: read a difference "
                "whose interval only just leaves 0 out as a hint.",
                class_="note",
            )
        )
    return parts if any(parts) else None


def _clear(clear: list[str], rows: Sequence[Row], of: str) -> str:
    found = [getattr(row, f"{of}_difference") for row in rows]
    unknown = sum(x is None or np.isnan(x.low) for x in found)
    if unknown == len(rows):
        return "With one seed there is no interval, so no difference can be told from chance."
    text = f"{'; '.join(clear)}." if clear else "No arm's difference has an interval that excludes 0."
    if clear and len(clear) + unknown < len(rows):
        text += " All other intervals contain 0."
    return text + (f" {plural(unknown, 'arm')} without an interval." if unknown else "")


def _aggregate_sentence(report: Report) -> Content:
    found = _summary(report, "area")
    rows = [row for row in found if row["game"] is None and row["statistic"] == "interquartile_mean"]
    if len({game for game, x in report.comparisons.items() if x}) < 2 or not rows:
        return None
    best = max(rows, key=lambda row: row["point"])
    return tag(
        "p",
        f"Over all games, human-normalised and averaged over env steps, the interquartile mean is highest for "
        f"{best['arm']}: {number(best['point'])} {_limits(_interval(best))}.",
    )


def _seed_counts(report: Report, game: str) -> str:
    counts = sorted({row.seeds for row in report.rows if row.game == game})
    return f"{listed(counts)} seed{'' if counts == [1] else 's'} an arm"


# Figures


def figures(report: Report) -> Content:
    """What experiments.figures has drawn, with the title and the question beside it."""
    found = []
    for path in sorted((report.root / "figures").glob("*.png")):
        picture = pictures.taken(path, pictures.LARGEST)
        about = _beside(path.with_suffix(".json"))
        title = str(about.get("title") or path.stem)
        name = f"Figure {about['figure']}. " if about.get("figure") else ""
        caption = [tag("strong", name, title), " ", str(about.get("question") or "")]
        found.append(figure(picture.source, caption, f"{name}{title}", picture.size))
    return tag("div", found, class_="grid wide") if found else None


def _beside(path: Path) -> dict[str, Any]:
    try:
        values = parse_json(read_bytes(path, SETTINGS))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return values


# Statistics


def tables(report: Report) -> Content:
    """Per game, over games, and what others have published."""
    if not report.rows:
        return tag("p", "No run has a policy that was evaluated, so there is nothing to compare.")
    parts: list = [
        tag(
            "p",
            "Curves are compared at env steps that all runs of a game have. In brackets: 95 % "
            "stratified-bootstrap intervals over seeds; none from a single seed. Differences are from ",
            tag("strong", report.baseline),
            "; ▲ and ▼ mark those whose interval excludes 0.",
        )
    ]
    for game, comparison in report.comparisons.items():
        parts.append(tag("h3", game))
        if comparison is None:
            parts.append(tag("p", "There is no env step that all runs of this game have."))
            continue
        parts += _game_table(report, game, comparison)
    parts += _aggregates(report)
    for game in report.comparisons:
        parts += _published(report, game)
    return parts


def _game_table(report: Report, game: str, comparison: Comparison) -> list:
    end, score = int(comparison.steps[-1]), report.targets.get(game)
    head = ["arm", "seeds", f"return at {end:,}", "difference", "mean return until then", "difference"]
    head += [f"env steps to reach {number(score)}"] if score is not None else []
    body = []
    for row in report.rows:
        if row.game != game:
            continue
        cells = [row.arm, row.seeds, _cell(row.final), _difference(row.final_difference)]
        cells += [_cell(row.area), _difference(row.area_difference)]
        if score is not None:
            shown = [_steps(float(x), end) for x in row.reaching]
            span = "" if np.isnan(row.reaching.low) else f"[{shown[1]}, {shown[2]}]; "
            note = tag("span", f"{span}{row.reached} of {row.seeds} did", class_="ci")
            cells.append([shown[0], note])
        body.append(cells)
    notes = []
    if comparison.cut_by is not None:
        cut = comparison.cut_by
        state = "ended" if numbers.finished(cut) else "has got to, unfinished,"
        notes.append(f"Compared up to {end:,} env steps, where {cut.arm}, seed {cut.seed} {state}. ")
    if score is not None:
        notes.append(
            f"The score to be reached is {number(score)}"
            + (f", what {report.baseline} ends with on average" if _is_baseline_score(report, game) else "")
            + "; env steps are the median over seeds, where never counts as more than any number."
        )
    caption = f"{game}: mean over seeds"
    return [table(head, body, caption), tag("p", notes, class_="note")]


def _is_baseline_score(report: Report, game: str) -> bool:
    comparison = report.comparisons[game]
    curves_of = comparison.returns.get(report.baseline) if comparison else None
    return curves_of is not None and float(np.mean(curves_of[:, -1])) == report.targets[game]


def _steps(value: float, end: int) -> str:
    return "–" if np.isnan(value) else f"> {end:,}" if value > end else f"{value:,.0f}"


def _limits(interval: Interval) -> str:
    if np.isnan(interval.low):
        return "(no interval)"
    return f"[{number(float(interval.low))}, {number(float(interval.high))}]"


def _cell(interval: Interval) -> list:
    return [number(float(interval.point)), tag("span", _limits(interval), class_="ci")]


def _side(interval: Interval) -> int:
    """1 or -1 where the interval is above or below 0, else 0."""
    return int(interval.low > 0) - int(interval.high < 0)


def _difference(interval: Interval | None) -> Content:
    if interval is None:
        return Markup("–")
    shown = number(float(interval.point))
    shown = "+" + shown if float(interval.point) > 0 else shown
    side = _side(interval)
    first = (
        tag("span", f"{shown} {'▲' if side > 0 else '▼'}", class_="up" if side > 0 else "down")
        if side
        else shown
    )
    return [first, tag("span", _limits(interval), class_="ci")]


def _interval(row: Mapping[str, Any]) -> Interval:
    values = (row[name] for name in ("point", "low", "high"))
    return Interval(*(np.float64(np.nan if value is None else value) for value in values))


def _summary(report: Report, of: str) -> list[dict]:
    given = numbers.scores(report.comparisons, of, report.arms)
    return statistics.summary(given, baseline=report.baseline if report.baseline in given else None)


AGGREGATES = (
    ("mean", "mean"),
    ("median", "median"),
    ("interquartile_mean", "interquartile mean"),
    ("optimality_gap", "optimality gap"),
    ("probability_of_improvement", "probability of improvement"),
)
"""Statistics over games and how they are called."""


def _aggregates(report: Report) -> list:
    parts: list = [tag("h3", "Over games")]
    shown = False
    for of, title in (
        ("final", "Of the last return that all have"),
        ("area", "Of the return averaged over env steps"),
    ):
        rows = [row for row in _summary(report, of) if row["game"] is None]
        if not rows:
            continue
        shown = True
        found = {(row["arm"], row["statistic"]): row for row in rows}
        body = []
        for arm in dict.fromkeys(row["arm"] for row in rows):
            cells = [arm, found[arm, "mean"]["runs"]]
            for name, _ in AGGREGATES:
                row = found.get((arm, name))
                cells.append(_cell(_interval(row)) if row else "–")
            body.append(cells)
        parts.append(table(["arm", "runs", *(name for _, name in AGGREGATES)], body, title))
    if not shown:
        return [*parts, tag("p", "No game has runs of every arm, so nothing is aggregated.")]
    note = (
        "Human-normalised: 0 is a random policy, 1 a human; in Catch, a miss and a catch. The optimality gap "
        "is what is missing to 1. The probability of improvement is that of a run over one of "
        f"{report.baseline}; 0.5 is no difference. Only games with runs of every arm count."
    )
    return [*parts, tag("p", note, class_="note")]


def _published(report: Report, game: str) -> list:
    comparison = report.comparisons[game]
    rows = published(game)
    if comparison is None or not rows:
        return []
    end = int(comparison.steps[-1])
    config = next(run.config for run in report.of(game) if numbers.has_policy(run))
    seeds = max(len(x) for x in comparison.returns.values())

    def cells(row) -> list:
        spread = f" ± {number(row.spread)}" if row.spread is not None else ""
        steps = "–" if row.env_steps is None else f"{row.env_steps:,}"
        differs = row.differs_from(config, end, seeds)
        return [row.method, f"{number(row.score)}{spread}", steps, differs, row.protocol or "", row.source]

    near = [row for row in rows if row.env_steps is None or end / 2.5 <= row.env_steps <= 2.5 * end]
    far = [row for row in rows if row not in near]
    head = ("method", "score", "env steps", "differs from these runs", "protocol", "source")
    parts = [tag("h3", f"{game}: published results")]
    parts.append(table(head, map(cells, near), f"{game}: at up to 2.5 times as many or as few env steps"))
    if far:
        more = table(head, map(cells, far))
        parts.append(details(f"{plural(len(far), 'result')} at other numbers of env steps", more))
    return parts


# Pictures


def learning_curves(report: Report) -> Content:
    """A picture a game; of the baseline and a few arms each, where there are many."""
    drawn = []
    for game, comparison in report.comparisons.items():
        if comparison is None:
            continue
        arms = [arm for arm in report.arms if arm in comparison.returns]
        levels = [
            curves.Level("random policy, published", p.score) for p in published(game) if p.method == "Random"
        ]
        for group in _groups(arms, report.baseline):
            lines = []
            for arm in group:
                found = statistics.curve_interval(comparison.returns[arm])
                lines.append(curves.Line(arm, comparison.steps, *found, seeds=len(comparison.returns[arm])))
            picture = pictures.learning_curves(game, lines, levels)
            caption = [tag("strong", game), ", mean evaluation return and 95 % interval over seeds"]
            drawn.append(
                figure(
                    picture.source, caption, f"Learning curves on {game}: {', '.join(group)}", picture.size
                )
            )
    return tag("div", drawn, class_="grid wide") if drawn else None


def _groups(arms: Sequence[str], baseline: str | None) -> list[list[str]]:
    """The arms in groups of at most `pictures.ARMS_A_PICTURE`, the baseline in each."""
    size = pictures.ARMS_A_PICTURE
    if len(arms) <= size:
        return [list(arms)]
    first = [arm for arm in arms if arm == baseline]
    others = [arm for arm in arms if arm != baseline]
    count = -(-len(others) // (size - 1))
    size = -(-len(others) // count)
    return [first + others[i : i + size] for i in range(0, len(others), size)]


def run_pictures(report: Report) -> Content:
    """What the objectives make of an observation, and the agent playing: of each arm's first seed."""
    if not report.media:
        return tag("p", "Pictures of the runs were left out (--no_media).", class_="note")
    shown = [(game, arm, report.of(game, arm)) for game in report.games for arm in report.arms]
    shown = [(game, arm, runs[0], _files(runs[0])) for game, arm, runs in shown if runs]
    count = sum(len(files) for *_, files in shown)
    if not count:
        return tag("p", "The runs have left no pictures.", class_="note")
    limit = min(max(MEDIA_BYTES // count, SMALLEST_PICTURE), LARGEST_PICTURE)
    parts: list = []
    for game in report.games:
        cards = []
        for of, arm, run, files in shown:
            if of != game:
                continue
            items = [_run_picture(run, path, limit) for path in files]
            none = tag("p", "No pictures.", class_="note")
            cards.append(tag("div", tag("h4", f"{arm}, seed {run.seed}"), items or none, class_="arm"))
        parts += [tag("h3", game), tag("div", cards, class_="grid media")]
    return parts


def _files(run: RunData) -> list[Path]:
    found = sorted(path for path in (run.path / "figures").glob("*.png") if path.name not in OWN)
    found = [path for path in found if not path.name.startswith("drift")]
    play = run.path / "figures" / "play.gif"
    return [*([play] if play.is_file() else []), *found]


def _run_picture(run: RunData, path: Path, limit: int) -> Markup:
    picture = pictures.taken(path, limit)
    if path.suffix == ".gif":
        caption = "playing: the last evaluation's first games"
        return figure(picture.source, caption, f"{_name(run)}, playing", None, "play")
    caption = f"{path.stem}: input, target, output and their difference"
    return figure(picture.source, caption, f"{_name(run)}, {path.stem}", picture.size)


def diagnostic_pictures(report: Report) -> Content:
    """A small picture for each number, a line an arm; drift as a picture of the first seed."""
    parts: list = []
    for game in report.games:
        runs = report.of(game)
        if panels := diagnostics.panels(runs, report.arms):
            cells = [
                figure(panel.picture.source, panel.meaning, f"{game}: {panel.title}", panel.picture.size)
                for panel in panels
            ]
            parts += [tag("h3", game), _legend(report, game), tag("div", cells, class_="grid small")]
            parts.append(_drift(report, game))
    without = diagnostics.missing(report.runs)
    if without and len(without) == len(
        [run for run in report.runs if len(collect.steps_and_returns(run)[0])]
    ):
        return tag(
            "p", "The runs have no diagnostics: they were made before there were any, or without them."
        )
    if without:
        parts.append(tag("p", f"Without diagnostics: {', '.join(map(_name, without))}.", class_="note"))
    return parts or None


def _drift(report: Report, game: str) -> Content:
    """The drift pictures that the first seed of each arm has left."""
    if not report.media:
        return None
    found = []
    for arm in report.arms:
        for run in report.of(game, arm)[:1]:
            for path in sorted((run.path / "figures").glob("drift*.png")):
                picture = pictures.taken(path, LARGEST_PICTURE)
                caption = [tag("strong", arm), f", seed {run.seed}: {path.stem}"]
                found.append(figure(picture.source, caption, f"{_name(run)}, {path.stem}", picture.size))
    return tag("div", found, class_="grid media") if found else None


def _legend(report: Report, game: str) -> Markup:
    words = {"-": "solid", "--": "dashed", ":": "dotted"}
    items = []
    for place, arm in enumerate(report.arms):
        if runs := report.of(game, arm):
            colour, line = pictures.style(place)
            mark = tag("span", style=f"border-top-color: {colour}; border-top-style: {words[line]}")
            items.append(tag("li", mark, f"{arm} ({plural(len(runs), 'seed')})"))
    return tag("ul", items, class_="legend")


# Cost, settings, protocol


def cost(report: Report) -> Content:
    """Hours, and speed beside the baseline's."""
    body = []
    for game in report.games:
        for row in numbers.costs(report.of(game), report.arms, report.baseline):
            body.append(
                [
                    f"{game} / {row.arm}",
                    row.runs,
                    number(row.hours),
                    number(row.per_run, 3),
                    number(row.speed, 0),
                    "–" if row.relative is None else f"{number(row.relative)} times",
                    f"the encoder of {row.source}, which adds its cost" if row.source else "",
                ]
            )
    head = ("arm", "runs", "hours, all", "hours, one", "env steps/s", "time an env step", "starts from")
    note = (
        "Hours by the runs' own clocks, evaluations included. Env steps/s is the median over rows of training, "
        f"which leaves out what other jobs on the machine held up only briefly; the time for an env step is a "
        f"multiple of {report.baseline}'s."
    )
    return [table(head, body), tag("p", note, class_="note")]


def settings(report: Report) -> Content:
    """Every difference between the arms; what all share behind it."""
    differing, shared = numbers.settings(report.runs, report.arms)
    parts: list = []
    if differing:
        body = [[field, *cells] for field, cells in differing]
        parts.append(
            Markup(table(("field", *report.arms), body).replace("<table>", '<table class="settings">'))
        )
    else:
        parts.append(tag("p", "No two arms differ in a setting."))
    body = [[field, value] for field, value in shared]
    parts.append(
        details(f"What all arms share: {plural(len(shared), 'field')}", table(("field", "value"), body))
    )
    return parts


def protocol(report: Report) -> Content:
    """How policies were evaluated, and what was compared though it differs."""
    parts: list = []
    if report.forced:
        items = [tag("li", line) for line in report.forced]
        why = tag("strong", "Compared by force (--force), though these differ:")
        parts.append(tag("div", why, tag("ul", items), class_="warn"))
    for game in report.games:
        texts = dict.fromkeys(
            numbers.protocol_text(run.config) for run in report.of(game) if numbers.has_policy(run)
        )
        parts += [tag("p", tag("strong", game), f": {text}.") for text in texts]
    return parts or None
