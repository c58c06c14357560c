"""The scores of arms on games, beside published ones, as Markdown and CSV: of what `runs.scores` gives."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..runs.scores import FAR

NAMES = {
    "mean": "mean",
    "median": "median",
    "interquartile_mean": "interquartile mean of runs",
    "interquartile_mean_of_means": "interquartile mean of games' means",
    "optimality_gap": "optimality gap of runs",
    "optimality_gap_of_means": "optimality gap of games' means",
}
COLUMNS = (
    "game", "statistic", "of", "value", "low", "high", "interval", "sd", "median", "runs", "scores",
    "normalised", "verdict", "basis", "level", "source",
)  # fmt: skip


def as_csv(numbers: Mapping[str, Any]) -> str:
    """What `evaluated` gave as CSV of `COLUMNS`: a row a game, or an aggregate, and arm or method."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in _rows(numbers):
        writer.writerow({name: value for name, value in row.items() if value is not None})
    return file.getvalue()


def _rows(numbers: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for name, entry in numbers["published"].items():
        about = {"of": name, **{key: entry[key] for key in ("basis", "level", "source")}}
        for game, x in entry["games"].items():
            values = {"value": x["mean"], **{key: x[key] for key in ("sd", "median", "runs", "normalised")}}
            yield {"game": game, "statistic": "score", **about, **values}
        for statistic, value in entry.get("aggregates", {}).items():
            yield {"statistic": statistic, **about, "value": value}
    for arm, entry in numbers["arms"].items():
        for game, x in entry["games"].items():
            yield {
                "game": game, "statistic": "score", "of": arm, **_interval(x), "runs": len(x["seeds"]),
                "scores": " ".join(f"{score:.8g}" for score in x["scores"]),
                "normalised": x["normalised"]["mean"], "verdict": x["verdict"] or None,
                "basis": "; ".join(dict.fromkeys(x["of"])), "level": "runs",
            }  # fmt: skip
        for statistic, x in entry["aggregates"].items():
            yield {"statistic": statistic, "of": arm, **_interval(x), "level": "runs"}


def _interval(x: Mapping[str, Any]) -> dict[str, Any]:
    return {"value": x["mean"], "low": x["low"], "high": x["high"], "interval": x["kind"]}


def as_markdown(numbers: Mapping[str, Any]) -> str:
    """What `evaluated` gave as Markdown: notes, a table of games, one of aggregates, the sources."""
    arms, published = numbers["arms"], numbers["published"]
    found = [f"# {numbers['title']}", "", *_notes(numbers), ""]
    head = ["game", "random", "human"]
    for arm in arms:
        head += [arm, "each seed", "95 %"]
    head += list(published)
    judged = [arm for arm in arms if any(x["verdict"] for x in arms[arm]["games"].values())]
    head += [f"{arm}: deviations from these" for arm in judged]
    rows = []
    for game in numbers["games"]:
        row = [game, *(f"{score:g}" for score in numbers["reference"][game])]
        for arm in arms:
            x = arms[arm]["games"].get(game)
            row += [_number(x["mean"]), " / ".join(map(_number, x["scores"])), _range(x)] if x else ["-"] * 3
        for entry in published.values():
            x = entry["games"].get(game)
            row.append("-" if not x else _number(x["mean"]) + (f" ± {_number(x['sd'])}" if x["sd"] else ""))
        for arm in judged:
            x = arms[arm]["games"].get(game, {"distances": {}, "verdict": ""})
            far = ", ".join(f"{distance:+.1f}" for distance in x["distances"].values())
            row.append(f"{far}: {x['verdict']}" if far else "-")
        rows.append(row)
    found += _markdown(head, rows)
    if numbers["aggregated"]:
        count = len(numbers["aggregated"])
        text = f"Human-normalised, over {count} game{'s' if count > 1 else ''}, each weighted alike:"
        rows = []
        for name, label in NAMES.items():
            own = [arms[arm]["aggregates"][name] for arm in arms]
            cells = [f"{x['mean']:.3f} {_range(x, '.3f')} ({x['kind']})" for x in own]
            others = [entry["aggregates"][name] for entry in published.values()]
            rows.append([label, *cells, *("-" if x is None else f"{x:.3f}" for x in others)])
        found += ["", text, "", *_markdown(["", *arms, *published], rows)]
    return "\n".join([*found, "", *_sources(numbers)]) + "\n"


def _notes(numbers: Mapping[str, Any]) -> list[str]:
    found = []
    for arm, entry in numbers["arms"].items():
        cores = ", ".join(str(n or "not known") for n in entry["cores"])
        text = f"{arm}: {len(entry['games'])} games, {entry['steps']:,} env steps; {'; '.join(entry['of'])}"
        revisions = ", ".join(revision[:10] for revision in entry["revisions"])
        found.append(f"- {text}; cores of a run: {cores}; revision {revisions}.")
        verdicts = [x["verdict"] for x in entry["games"].values() if x["verdict"]]
        if verdicts:
            counts = ", ".join(f"{verdicts.count(kind)} {kind}" for kind in ("within", "above", "below"))
            found.append(
                f"- {arm}, {len(verdicts)} games: {counts}. Above and below is further than {FAR:g} standard "
                "deviations over published runs beyond all published means."
            )
    if numbers["without_runs"]:
        found.append(f"- No run yet: {', '.join(numbers['without_runs'])}.")
    for run in numbers["left_out"]:
        found.append(f"- Left out: {run['arm']} on {run['game']}, seed {run['seed']}: {run['reason']}.")
    return found + [f"- Protocols differ: {line}" for line in numbers["forced"]]


def _sources(numbers: Mapping[str, Any]) -> list[str]:
    found = []
    for name, entry in numbers["published"].items():
        runs = f", {entry['runs']} runs" if entry["runs"] else ""
        found.append(
            f"- {name}: {entry['basis']}, {entry['level']}{runs}; {entry['protocol']}. {entry['source']}."
        )
        for arm, own in numbers["arms"].items():
            if own["differs"].get(name):
                found.append(f"  Against {arm}: {own['differs'][name]}.")
    rule = "A dash is not known: an interquartile mean or an optimality gap of runs needs the runs."
    return [*found, "", rule]


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]


def _range(x: Mapping[str, Any], form: str = "") -> str:
    if x["low"] is None:
        return "-"
    low, high = (format(x[end], form) if form else _number(x[end]) for end in ("low", "high"))
    return f"[{low}, {high}]"


def _number(value: float) -> str:
    """About three digits, and no power of ten: 12,300, 185, 9.21."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
