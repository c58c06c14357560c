"""How long runs take on this machine, from short ones in a directory that is removed. Imports no jax."""

import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from srl_jax.config import Config
from srl_jax.errors import ConfigError

from ..runs.run_data import read_rows
from . import launching, manifest, status
from .manifest import Entry

LEARNING = 1_200
"""Env steps for which a short run learns; its speed is taken of all but the first `WARM`."""
WARM = 200


def measured(root: Path, entries: Mapping[str, Entry], how: Mapping[str, Any]) -> status.Sums:
    """How fast runs are that neither have a speed of their own in a directory, nor others like them.

    Of each kind of run, as many short ones work at once as the sweep would have, on a game each: what they
    take from each other is in their speed.

    Args:
        root: of the sweep, in which nothing is written.
        entries: of its runs.
        how: what `launching.run_sweep` takes.

    Returns:
        {`status.alike`: (env steps, seconds)} of whole runs, with their starts and evaluations.

    Raises:
        ConfigError: a short run failed, or was told to end.
    """
    if how["launcher"] != "local":
        return {}
    here = status.sums((config, status.progress(root / name)) for name, (_, config) in entries.items())
    found: status.Sums = {}
    for kind in dict.fromkeys(status.alike(entry.config) for entry in entries.values()):
        if kind in here:
            continue
        own: dict[str, Entry] = {}  # one of each game
        for entry in entries.values():
            if status.alike(entry.config) == kind and not entry.run.sources:
                own.setdefault(entry.config.game, entry)
        chosen = list(own.values())[: how["workers"] or launching.most_workers(how["cpus_per_run"])]
        if chosen:
            found[kind] = _measure(chosen, how)
    return found


def _measure(chosen: Sequence[Entry], how: Mapping[str, Any]) -> tuple[float, float]:
    short = [_short(entry) for entry in chosen]
    names = ", ".join(run.name for run in short)
    launching.say(f"measuring, some minutes: {short[0].flags['steps']} env steps of {names}")
    steps = seconds = 0.0
    with tempfile.TemporaryDirectory(prefix="srl-jax-") as folder:
        root, began = Path(folder), time.perf_counter()
        code = launching.run_sweep(root, manifest.resolve(short), **{**how, "retries": 0})
        elapsed = time.perf_counter() - began
        if code:
            raise ConfigError(f"--dry_run: the short runs that are timed ended with status {code}")
        all_rows = [read_rows(root / run.name / "metrics.jsonl") for run in short]
    start = max(elapsed - max(rows[-1]["wall_s"] for rows in all_rows), 0.0)
    for entry, rows in zip(chosen, all_rows, strict=True):
        steps += entry.config.steps
        seconds += start + whole(entry.config, rows)
    return steps, seconds


def _short(entry: Entry):
    steps = str(entry.config.learn_start + LEARNING)
    flags = {"steps": steps, "eval_every": steps, "log_every": str(WARM), "logger": ("none",)}
    return entry.run._replace(flags={**entry.run.flags, **flags})


def whole(config: Config, rows: Iterable[Mapping[str, Any]]) -> float:
    """How long a run takes, from the rows of a short one like it, in seconds.

    What it takes until it learns, as there; the env steps in which it learns, at that speed; its evaluations,
    each as long as the last one there, which nothing ran beside; what follows the last one, as there. With a
    core a run an evaluation takes its time from training, as this has it; with several, it takes less.

    Args:
        config: of the run itself.
        rows: of one with the same `learn_start`.
    """
    rows = list(rows)
    trains = [row for row in rows if row["kind"] == "train"]
    first = next(row for row in trains if row["env_steps"] >= config.learn_start + WARM)
    last = trains[-1]
    each = (last["wall_s"] - first["wall_s"]) / (last["env_steps"] - first["env_steps"])
    nobody = {"wall_eval_s": 0.0, "wall_s": last["wall_s"]}  # plays where RL is not trained
    games = next((row for row in reversed(rows) if "wall_eval_s" in row), nobody)
    evaluations = config.steps // config.eval_every
    rest = rows[-1]["wall_s"] - games["wall_s"]
    begun = first["wall_s"] + each * (config.steps - first["env_steps"])
    return begun + evaluations * games["wall_eval_s"] + rest
