"""Runs that are killed with SIGKILL, again and again, against the same run left alone.

Half of the kills come after a random time, the others at a random point of writing a checkpoint: before,
within and after a file, before and after flushing, linking, renaming and removing. What the resumed run is in
the end (parameters, optimizer, replay with priorities, generators, environments, metrics but for wall time)
must be what the other one is, bit for bit.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from srl_jax.metrics import read_metrics, strip_wall

from ..flags import last_of_each
from . import Count, Say
from .victim import POINTS

ROOT = Path(__file__).resolve().parents[2]

SMALL = (
    "--encoder=tiny:features=16", "--rl=rainbow:hidden=32,atoms=11", "--mode=joint",
    "--objective=reconstruction",
    "--num_envs=4", "--buffer_size=1000", "--batch_size=8", "--updates_per_step=0.1", "--learn_start=80",
    "--steps=2400", "--log_every=200", "--eval_every=600", "--eval_games=2", "--eval_max_steps=150",
    "--checkpoint_every=140", "--slow_update_every=20", "--tune_runtime=off",
)  # fmt: skip
"""A run in which everything happens several times: the buffer wraps, episodes end, evaluations are under way
when checkpoints are written."""

ARMS = {
    "Catch, nodiagnostics": ("--nodiagnostics",),
    "Catch": (),
    "CatchDistractor, srl_every=3": ("--game=CatchDistractor", "--srl_every=3"),
    "Pong": (),
    "Breakout, sticky": ("--sticky_actions=0.25",),
    "Qbert": (),
    "Qbert, sticky": ("--sticky_actions=0.25",),
    "YarsRevenge": (),
    "YarsRevenge, sticky": ("--sticky_actions=0.25",),
    "Seaquest, sticky": ("--sticky_actions=0.25",),
    "MsPacman, pretrain": ("--mode=pretrain",),
    "Catch, three seeds": ("--seeds=0,1,2",),
    "Pong, two seeds": ("--seeds=0,1",),
}
"""{name: flags}; the game is the name's first word."""

SHORT = ("--steps=1200",)
"""Enough for the buffer to wrap."""
SHORT_SEED = 12144
"""Found by trying: draws a fault in the third checkpoint, a kill soon after the run went on, and one near its
end. With other `POINTS` it draws something else, and the short version may take more runs."""
KILLS = 110
FAULTS = 45
"""Of the kills, those inside a checkpoint being written."""


def command(out: Path, flags: tuple[str, ...], fault: str = "") -> list[str]:
    """A victim's command line; OUT.digest and OUT.digest.fault are what it leaves."""
    victim = [sys.executable, "-m", "experiments.soaking.victim", f"{out}.digest", fault]
    return [*victim, *flags, f"--out={out}", "--resume=auto"]


def flags_of(arm: str) -> tuple[str, ...]:
    """Of an arm: the run's flags; where one is given twice, the last one counts."""
    own = ARMS[arm]
    game = () if any(flag.startswith("--game=") for flag in own) else (f"--game={arm.split(',')[0]}",)
    return last_of_each((*SMALL, *game, *own))


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    arms = list(ARMS)[:1] if short else list(ARMS)
    kills, faults = (2, 1) if short else (KILLS, FAULTS)
    draw = random.Random(SHORT_SEED if short else 0)
    environment = dict(os.environ, JAX_COMPILATION_CACHE_DIR=str(folder / "compiled"))
    environment |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "TF_CPP_MIN_LOG_LEVEL": "3"}
    flags = {arm: last_of_each(flags_of(arm) + (SHORT if short else ())) for arm in arms}
    alone = {}
    for i, arm in enumerate(arms):
        say(f"kills: {arm}, left alone")
        alone[arm] = reference(folder / f"alone_{i}", flags[arm], environment)
    counts = {arm: Counter() for arm in arms}
    points = Counter()
    runs = 0
    started = time.monotonic()
    total = Counter()
    while total["kills"] < kills or total["faults"] < faults:
        arm = arms[runs % len(arms)]
        out = folder / f"killed_{runs}"
        runs += 1
        while not (result := one_life(out, flags[arm], draw, alone[arm]["seconds"], environment))["ended"]:
            counts[arm][result["kind"]] += 1
            total["kills"] += 1
            total["faults"] += result["kind"] == "fault"
            if result["kind"] == "fault":
                points[result["point"]] += 1
        wrong = differing(out, alone[arm])
        counts[arm]["runs"] += 1
        counts[arm]["wrong"] += bool(wrong)
        if wrong:
            say(f"kills: {arm}: {out} differs in {', '.join(wrong[:8])}")
        left = (time.monotonic() - started) / max(total["kills"], 1) * max(kills - total["kills"], 0)
        say(f"kills: {total['kills']} of {kills}, {total['faults']} faults; about {left / 60:.1f} min left")
    rows = []
    for arm, count in counts.items():
        number = count["random"] + count["fault"]
        detail = f"{number} kills, {count['fault']} of them inside a checkpoint"
        rows.append(Count(f"killed and resumed: {arm}", count["runs"], count["wrong"], detail))
    kinds = ", ".join(f"{n} {name}" for name, n in sorted(points.items()))
    number, wrong = (sum(count[name] for count in counts.values()) for name in ("runs", "wrong"))
    rows.append(
        Count("killed and resumed, in all", number, wrong, f"{total['kills']} kills; faults: {kinds}")
    )
    return rows


def reference(out: Path, flags: tuple[str, ...], environment: dict) -> dict:
    """The run left alone: its digest, rows, and the seconds that it trained."""
    process = subprocess.Popen(
        command(out, flags), cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.readline()
    began = time.monotonic()
    _, errors = process.communicate(timeout=600)
    seconds = time.monotonic() - began
    if process.returncode:
        raise RuntimeError(f"{out}: status {process.returncode}: {errors.decode()[-500:]}")
    return {**ended(out), "seconds": seconds}


def ended(out: Path) -> dict:
    """What a run that has ended left."""
    files = sorted([*out.glob("metrics.jsonl"), *out.glob("seed*/metrics.jsonl")])
    rows = [strip_wall(row) for file in files for row in read_metrics(file)]
    return {"digest": json.loads(Path(f"{out}.digest").read_text(encoding="utf-8")), "rows": rows}


def one_life(
    out: Path, flags: tuple[str, ...], draw: random.Random, seconds: float, environment: dict
) -> dict:
    """Starts or resumes a run and kills it, or sees it end."""
    fault = ""
    if draw.random() < 0.5:
        # Points come once or twice a checkpoint, but for files and flushes.
        fault = f"{draw.choice(POINTS)}#{draw.randrange(3)}"
    delay = draw.uniform(0.0, 0.5 * seconds)
    mark = Path(f"{out}.digest.fault")
    mark.unlink(missing_ok=True)
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            command(out, flags, fault),
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=errors,
        )
        line = process.stdout.readline()
        if not fault and line == b"begun\n":
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
        process.communicate(timeout=600)
        if process.returncode == -signal.SIGKILL:
            kind = "fault" if mark.exists() else "random"
            return {"ended": False, "kind": kind, "point": mark.read_text() if mark.exists() else ""}
        if process.returncode:
            errors.seek(0)
            raise RuntimeError(f"{out}: status {process.returncode}: {errors.read().decode()[-1000:]}")
    return {"ended": True}


def differing(out: Path, alone: dict) -> list[str]:
    """What of a resumed run is not what it is in the run left alone."""
    found = ended(out)
    names = sorted(set(found["digest"]) | set(alone["digest"]))
    wrong = [name for name in names if found["digest"].get(name) != alone["digest"].get(name)]
    return wrong + (["metrics.jsonl"] if found["rows"] != alone["rows"] else [])
