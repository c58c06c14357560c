"""Figures whose sweep is killed and started again, against the same figures from a sweep left alone.

Half of the kills take the sweep's process alone, whose runs then write a checkpoint and end; the others
take its runs with it, as a machine does that loses power. In the end every run must be complete once, with
the rows and parameters that it has in the other sweep, bit for bit; and the figures and their numbers must be
the same files.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from srl_jax import checkpoint
from srl_jax.metrics import read_metrics, strip_wall

from ..flags import last_of_each
from ..sweeping import manifest, states
from . import Count, Say

CHECKOUT = Path(__file__).resolve().parents[2]

SMALL = (
    "--encoder=tiny:features=16", "--rl=rainbow:hidden=32,atoms=11,v_min=-2,v_max=2", "--num_envs=4",
    "--buffer_size=1000", "--batch_size=8", "--learn_start=80", "--steps=4000", "--log_every=200",
    "--eval_every=800", "--eval_games=4", "--checkpoint_every=160", "--slow_update_every=20",
    "--games=Catch",
)  # fmt: skip
"""Settings of runs that take some seconds once they have begun."""

FIGURES = ("--figure=6.3,A.1", "--seeds=2", *SMALL)
"""Ten runs, two seeds each: three arms, a fourth that starts from a pretrained encoder, and its pretraining
on frames of the first."""

KILLS = 20


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    flags = last_of_each((*FIGURES, "--seeds=1", "--steps=1600")) if short else FIGURES
    alone, killed = folder / "alone", folder / "killed"
    seconds = left_alone(command("figures", alone, flags), say)
    line = command("figures", killed, flags)
    kills = until_done(line, 2 if short else KILLS, seconds, random.Random(0), say)
    detail = f"{sum(kills)} kills, {kills[1]} of them with everything that ran"
    return [compared("runs of a killed sweep", alone, killed, say, detail), same_files(alone, killed, say)]


def command(entry_point: str, root: Path, flags: Sequence[str]) -> list[str]:
    """A sweep's command line, of experiments.sweep or experiments.figures."""
    return [sys.executable, "-m", f"experiments.{entry_point}", *flags, f"--out={root}", "--workers=2"]


def left_alone(line: Sequence[str], say: Say) -> float:
    """Runs a sweep to its end; returns how long it took, in seconds.

    Raises:
        RuntimeError: it failed.
    """
    say(f"sweeps: left alone: {' '.join(line)}")
    began = time.monotonic()
    done = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"status {done.returncode}: {done.stderr[-2000:]}")
    return time.monotonic() - began


def until_done(
    line: Sequence[str], kills: int, seconds: float, draw: random.Random, say: Say
) -> tuple[int, int]:
    """Starts a command, which has to end with status 0 in the end, and kills it up to so many times.

    Args:
        line: the command; any that runs a sweep.
        kills: how often; fewer if it ends before.
        seconds: about how long it takes when it is left alone.
        draw: when it is killed, and how.
        say: see `experiments.soaking`.

    Returns:
        How often it was killed alone, and how often with everything that it had started.

    Raises:
        RuntimeError: it ended with another status.
    """
    counts = [0, 0]
    while True:
        process = subprocess.Popen(line, cwd=CHECKOUT, stderr=subprocess.PIPE, text=True)
        try:
            # Long enough for something to begin, and short enough for the kills to fall within the sweep.
            last = sum(counts) >= kills
            _, errors = process.communicate(
                timeout=None if last else draw.uniform(2.0, min(5.0 + seconds / 8, 30.0))
            )
            if process.returncode:
                raise RuntimeError(f"status {process.returncode}: {errors[-2000:]}")
            return counts[0], counts[1]
        except subprocess.TimeoutExpired:
            everything = draw.random() < 0.5
            for pid in descendants(process.pid) if everything else ():
                _kill(pid)
            _kill(process.pid)
            process.communicate()
            counts[everything] += 1
            say(f"sweeps: killed {'with its runs' if everything else 'alone'}, {sum(counts)} of {kills}")


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            after_name = (folder / "stat").read_text().rpartition(")")[2].split()
            parents[int(folder.name)] = int(after_name[1])
        except (OSError, ValueError, IndexError):
            continue
    found, new = [], [pid]
    while new:
        new = [child for child, parent in parents.items() if parent in new]
        found += new
    return found


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def compared(what: str, alone: Path, other: Path, say: Say, detail: str) -> Count:
    """The runs of a sweep against those of the same sweep left alone."""
    names = list(manifest.read(alone))
    wrong = 0
    for name in names:
        if problems := differing(alone, other, name):
            wrong += 1
            say(f"sweeps: {name}: {', '.join(problems)}")
    aside = len(list(other.glob("*/*/*.broken-*")))
    return Count(what, len(names), wrong + aside, detail)


def same_files(alone: Path, other: Path, say: Say) -> Count:
    """The figures of a sweep against those of the sweep left alone, byte for byte."""
    names = sorted(path.relative_to(alone) for path in (alone / "figures").rglob("*.*"))
    wrong = [name for name in names if _bytes(alone / name) != _bytes(other / name)]
    for name in wrong:
        say(f"sweeps: {name} differs")
    return Count("their figures and the figures' numbers", len(names), len(wrong), "compared byte for byte")


def _bytes(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""


def differing(alone: Path, other: Path, name: str) -> list[str]:
    """What of a run is not as in the sweep left alone, or not as it has to be."""
    found = []
    rows = [
        [strip_wall(row) for row in read_metrics(root / name / "metrics.jsonl")] for root in (alone, other)
    ]
    if rows[0] != rows[1]:
        found.append("metrics.jsonl differs")
    last = [checkpoint.read_manifest(root / name) for root in (alone, other)]
    if last[0].files != last[1].files or last[0].env_steps != last[1].env_steps:
        found.append("the last checkpoint differs")
    if last[0].config != last[1].config:
        found.append("the configuration differs")
    config = manifest.read(other)[name].config
    if states.look(other / name, config).kind != "done":
        found.append("not complete")
    if (times := ends(other, name)) > 1:
        found.append(f"run to its end {times} times")
    return found


def ends(root: Path, name: str) -> int:
    """How often a run has said that it has come to its end.

    That is the last thing that it does: one that was killed between its last checkpoint and that line is
    complete, and says nothing.
    """
    text = states.log_path(root, name).read_text(encoding="utf-8", errors="replace")
    return text.count("everything is in ")
