"""What one sees of a sweep: how far it is, how long it still takes, which arm did best.

Imports jax only where no speed is known but that of published runs.
"""

import contextlib
import functools
import graphlib
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from srl_jax import envs, specs, statistics
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.display import hms

from .. import packing
from ..runs import collect
from ..runs.run_data import RunData, runs_below
from . import states
from .manifest import Entry

RESULTS = Path(__file__).resolve().parents[1] / "results"
MOST = 12
"""Failed runs that are listed; the others are counted."""


class Progress(NamedTuple):
    """How far a run is, by its last rows.

    Attributes:
        env_steps: that it has done.
        seconds: that it took.
        evaluation: the last mean return, None where there is none.
    """

    env_steps: int = 0
    seconds: float = 0.0
    evaluation: float | None = None

    @property
    def per_s(self) -> float | None:
        """Env steps a second, evaluations and compilation included; None where it has only begun."""
        return self.env_steps / self.seconds if self.env_steps and self.seconds else None


def progress(run: Path, tail: int = 1 << 16) -> Progress:
    """How far the run in a directory is, from the rows in so many bytes at their end, or the last row."""
    try:
        with open(run / "metrics.jsonl", "rb") as file:
            size = file.seek(0, os.SEEK_END)
            while True:
                file.seek(max(size - tail, 0))
                lines = file.read().split(b"\n")[int(size > tail) : -1]
                if lines or tail >= size:
                    break
                tail *= 2  # a row may have the returns of thousands of games
    except OSError:
        return Progress()
    found = Progress()
    for line in lines:
        try:
            row = json.loads(line)
            score = row.get("eval/return_mean")
            score = found.evaluation if score is None else float(score)
            found = Progress(int(row["env_steps"]), float(row["wall_s"]), score)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
    return found


Sums = dict[tuple, tuple[float, float]]
"""{`alike`: (env steps, seconds)} of runs."""


def rates(
    root: Path, entries: Mapping[str, Entry], measured: Mapping[tuple, tuple[float, float]] = {}
) -> dict[str, float | None]:
    """{name: env steps a second} of runs: their own, else that of runs like them.

    These are here, or were measured, or have been published; None where there is none of these.
    """
    own = {name: progress(root / name) for name in entries}
    here = sums((entry.config, own[name]) for name, entry in entries.items())
    found: dict[str, float | None] = {}
    for name, (_, config) in entries.items():
        like = here.get(alike(config)) or measured.get(alike(config)) or _published_like(config)
        found[name] = own[name].per_s if _timed(config, own[name]) else like and like[0] / like[1]
    return found


def alike(config: Config) -> tuple:
    """What runs have in common that take equally long: game, network, losses, and updates for an env step."""
    losses = tuple(specs.split(text)[0] for text in config.objectives)
    work = config.updates_per_step, config.batch_size, config.srl_every, config.frame_size
    how = config.encoder, config.mode, config.encoder_optimizer, specs.split(config.rl)[0]
    return envs.known(config.game).kind, *how, losses, *work


def _timed(config: Config, got: Progress) -> bool:
    return got.seconds > 0 and got.env_steps > 2 * config.learn_start


def sums(runs: Iterable[tuple[Config, Progress]]) -> Sums:
    """Of each kind all runs that have learnt for a while."""
    found: Sums = {}
    for config, got in runs:
        if _timed(config, got):
            steps, seconds = found.get(alike(config), (0.0, 0.0))
            found[alike(config)] = steps + got.env_steps, seconds + got.seconds
    return found


def _published_like(config: Config) -> tuple[float, float] | None:
    """Env steps and seconds of published runs that are alike; None where there are none."""
    from srl_jax.training import completed

    try:
        return _published().get(alike(completed(config)))
    except ConfigError:  # it has something of a plug-in
        return None


@functools.cache
def _published() -> Sums:
    """`sums` of the runs that the project has published; options that are newer have their defaults."""
    from srl_jax.training import completed

    runs: list[RunData] = []
    for folder in runs_below(RESULTS, packing.CONFIGS):
        with contextlib.suppress(ConfigError):  # of an earlier version
            runs += packing.read(folder, only_last=True)
    found = []
    for run in runs:
        if run.rows:
            with contextlib.suppress(ConfigError):  # of an earlier version, or with something of a plug-in
                last = run.rows[-1]
                found.append((completed(run.config), Progress(last["env_steps"], last["wall_s"])))
    return sums(found)


def seconds_left(
    entries: Mapping[str, Entry], steps: Mapping[str, int], per_s: Mapping[str, float | None], workers: int
) -> tuple[float, int]:
    """The time until all runs are complete, if none stops early.

    It is the work over the number of workers, and at least that of the longest chain of runs that start from
    each other.

    Args:
        entries: {name: Entry}.
        steps: {name: env steps that are left}; none of those that nobody waits for.
        per_s: {name: env steps a second}; None where unknown.
        workers: runs at once.

    Returns:
        Seconds, and the number of runs that it does not count because their speed is not known.
    """
    left = {name: n / rate for name, n in steps.items() if (rate := per_s[name])}
    chains: dict[str, float] = {}
    for name in _sources_first(entries):
        sources = entries[name].run.sources
        chains[name] = left.get(name, 0.0) + max((chains[source] for source in sources), default=0.0)
    unknown = sum(1 for name, n in steps.items() if n and not per_s[name])
    return max(sum(left.values()) / max(workers, 1), max(chains.values(), default=0.0)), unknown


def _sources_first(entries: Mapping[str, Entry]) -> Iterable[str]:
    order = graphlib.TopologicalSorter({name: entry.run.sources for name, entry in entries.items()})
    return order.static_order()


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, their cells below each other; the first cell to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(cells))
        for cells in (list(zip(row, widths, strict=True)) for row in rows)
    ]


def view(root: Path, entries: Mapping[str, Entry]) -> dict[str, tuple[str, str]]:
    """{name: (what it is, which process or why)}, as the files say.

    A run is "done", "running", "failed", "blocked" or "waiting".
    """
    found: dict[str, tuple[str, str]] = {}
    for name in _sources_first(entries):
        run, config = entries[name]
        try:
            state, why = states.look(root / name, config), states.failure(root, name)
        except ConfigError as error:
            state, why = states.State("resumable"), str(error)
        bad = [source for source in run.sources if found[source][0] in ("failed", "blocked")]
        if state.kind in ("done", "busy"):
            found[name] = ("done" if state.kind == "done" else "running"), state.reason
        elif why:
            found[name] = "failed", why
        elif bad:
            kind, why = found[bad[0]]
            found[name] = "blocked", f"{bad[0]} failed" if kind == "failed" else why
        else:
            found[name] = "waiting", state.reason
    return {name: found[name] for name in entries}


def lines(root: Path, entries: Mapping[str, Entry], workers: int) -> list[str]:
    """A sweep in a line, then what runs in a table, then what failed and why, from its files alone.

    Args:
        root, entries: see `view`.
        workers: runs at once, for the time left where nothing runs.
    """
    seen = view(root, entries)
    counts = Counter(kind for kind, _ in seen.values())
    parts = [f"{counts['done']} of {len(seen)} runs done"]
    kinds = ("running", "waiting", "failed", "blocked")
    parts += [f"{counts[kind]} {kind}" for kind in kinds if counts[kind]]
    if counts["running"] or counts["waiting"]:
        steps = {
            name: max(entries[name].config.steps - progress(root / name).env_steps, 0)
            for name, (kind, _) in seen.items()
            if kind in ("running", "waiting")
        }
        at_once = counts["running"] or workers
        seconds, unknown = seconds_left(entries, steps, rates(root, entries), at_once)
        least = "at least " if unknown else ""
        parts.append(f"{least}{hms(seconds)} left" if seconds else "time left unknown")
        if seconds and unknown:
            parts[-1] += f", without those of unknown speed ({unknown})"
    rows = [("run", "env steps", "steps/s", "left", "evaluation", "by")]
    rows += [_row(root, entries[name], by) for name, (kind, by) in seen.items() if kind == "running"]
    told = [f"{name}: {kind}: {why}" for name, (kind, why) in seen.items() if kind != "running" and why]
    found = [", ".join(parts), *(columns(rows) if len(rows) > 1 else ()), *told[:MOST]]
    return found + ([f"and {len(told) - MOST} more"] if len(told) > MOST else [])


def _row(root: Path, entry: Entry, by: str) -> tuple[str, ...]:
    (run, config), got = entry, progress(root / entry.run.name)
    rate, left = got.per_s, max(config.steps - got.env_steps, 0)
    times = ("", "") if rate is None else (f"{rate:,.0f}", hms(left / rate))
    score = "" if got.evaluation is None else f"{got.evaluation:.4g}"
    return run.name, f"{got.env_steps:,}/{config.steps:,}", *times, score, by


def ended_text(run: Path) -> str:
    """What came of a run that is complete: `500 env steps in 0:00:05, last evaluation 0.5`."""
    got = progress(run)
    steps = checkpoint.read_manifest(run).env_steps  # the last row may be of before the end
    score = "" if got.evaluation is None else f", last evaluation {got.evaluation:.4g}"
    return f"{steps:,} env steps in {hms(got.seconds)}{score}"


def dry_run(
    root: Path,
    entries: Mapping[str, Entry],
    workers: int,
    measured: Mapping[tuple, tuple[float, float]] = {},
) -> list[str]:
    """What `launching.run_sweep` would do, as lines; writes nothing.

    Args:
        root, entries: see `states.look_at_all`.
        workers: runs at once.
        measured: see `rates`.

    Raises:
        ConfigError: see `states.look_at_all`.
    """
    found, per_s = states.look_at_all(root, entries), rates(root, entries, measured)
    # What a run has beyond its last checkpoint it does again.
    left = {
        name: max(entries[name].config.steps - state.env_steps, 0)
        for name, state in found.items()
        if state.kind != "done"
    }
    arms: dict[str, list[str]] = {}
    for name in entries:
        arms.setdefault(name.rpartition("/")[0], []).append(name)
    rows = [("arm", "runs", "done", "to run", "env steps", "steps/s", "time")]
    for arm, names in arms.items():
        todo = {name: left[name] for name in names if name in left}
        steps, (taken, unknown) = sum(todo.values()), seconds_left(entries, todo, per_s, 1)
        times = ("unknown", "unknown") if unknown else (f"{steps / taken:,.0f}" if taken else "-", hms(taken))
        counts = map(str, (len(names), len(names) - len(todo), len(todo)))
        rows.append((arm, *counts, f"{steps:,}", *times))
    lines = columns(rows)
    lines += [f"{name}: {state.reason}; would wait" for name, state in found.items() if state.kind == "busy"]
    seconds, unknown = seconds_left(entries, left, per_s, workers)
    line = f"{len(left)} of {len(entries)} runs to run, {sum(left.values()):,} env steps"
    if left:
        least = "at least " if seconds and unknown else ""
        line += f", {least}{hms(seconds) if seconds else 'unknown time'} with {workers} at once"
        line += f", without those of unknown speed ({unknown})" if least else ""
        line += "; each start takes up to a minute more" if seconds else ""
    lines.append(line)
    if unknown:
        lines.append(
            "unknown: no run of this game's kind, encoder, losses and updates has been timed, here or "
            f"among published ones; a few minutes after the start, srl-jax sweep --out={root} --status says "
            "how long it takes"
        )
    return lines


def best(runs: Sequence[RunData]) -> list[str]:
    """The arms of each game that has several, the best one first, by the area under the learning curve.

    Args:
        runs: on disk; those that are not `comparable` are left out, and the last lines say so.

    Returns:
        Lines of text; none where no game has two arms to compare.
    """
    found: list[str] = []
    for game, arms in collect.grouped(collect.comparable(runs)).items():
        if len(arms) < 2:
            continue
        try:
            collect.check_arms([run for members in arms.values() for run in members])
        except ConfigError as error:  # seeds of different settings have no mean
            found.append(f"{game}: {error}")
            continue
        curves = {arm: [collect.steps_and_returns(run) for run in its] for arm, its in arms.items()}
        try:
            until, ends = collect.ends(curves)
        except ConfigError as error:  # one has not got to where another one begins
            found.append(f"{game}: {error}")
            continue
        areas = {
            arm: statistics.estimate(statistics.mean, {game: its["area_under_curve"]})
            for arm, its in ends.items()
        }
        rows = [(game, "seeds", "area", "95 %", "at the end")]
        for arm, area in sorted(areas.items(), key=lambda item: -item[1].point):
            interval = f"[{area.low:.4g}, {area.high:.4g}]" if math.isfinite(area.low) else "-"
            last = f"{ends[arm]['at_the_end'].mean():.4g}"
            rows.append((arm, str(len(arms[arm])), f"{area.point:.4g}", interval, last))
        found += columns(rows)
        found.append(
            f"area: mean evaluation return up to {until:,} env steps. The best of {len(areas)} is flattered "
            "by having been chosen; new seeds say what it is worth."
        )
    if found:
        found += [f"{run.path}: left out: {why}" for run, why in collect.left_out(runs)]
        found += collect.check_protocols(runs, force=True)
    return found
