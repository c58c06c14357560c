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
from pathlib import Path

from srl_jax.files import checkpoint
from srl_jax.run import ending
from tests.helpers import write_checkpoint, write_run
from tests.soak.conftest import ROOT, rows_of

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


def command(entry_point, root, flags):
    """A sweep's command line, of experiments.sweep or experiments.figures."""
    return [sys.executable, "-m", f"experiments.{entry_point}", *flags, f"--out={root}"]


def left_alone(line):
    """Runs a sweep to its end; returns how long it took, in seconds."""
    began = time.monotonic()
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return time.monotonic() - began


def parent(pid):
    """The process that has started one; None where that one has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else int(fields[1])


def descendants(pid):
    """Processes that a process has started, and theirs."""
    parents = {int(path.name): parent(path.name) for path in Path("/proc").glob("[0-9]*")}
    found, new = [], [pid]
    while new:
        new = [child for child, its in parents.items() if its in new]
        found += new
    return found


def until_done(line, kills, seconds, draw, say):
    """Starts a command, which has to end with status 0, and kills it up to so many times before.

    Returns:
        How often it was killed alone, and how often with everything that it had started.
    """
    counts = [0, 0]
    while True:
        process = subprocess.Popen(line, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        # Long enough for something to begin, and short enough for the kills to fall within the sweep.
        wait = draw.uniform(2.0, min(5.0 + seconds / 8, 30.0)) if sum(counts) < kills else None
        try:
            _, errors = process.communicate(timeout=wait)
            assert process.returncode == 0, errors[-2000:]
            return counts
        except subprocess.TimeoutExpired:
            everything = draw.random() < 0.5
            for pid in descendants(process.pid) if everything else ():
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    pass
            process.kill()
            process.communicate()
            counts[everything] += 1
            say(f"killed {'with its runs' if everything else 'alone'}, {sum(counts)} of {kills}")


def runs_of(root):
    """The names of a sweep's runs."""
    return sorted(str(path.parent.relative_to(root)) for path in root.glob("*/*/seed*/config.json"))


def differing(alone, other, name):
    """What of a run is not as in the sweep left alone, or not as it has to be."""
    found, roots = [], (alone / name, other / name)
    if rows_of(roots[0]) != rows_of(roots[1]):
        found.append("metrics.jsonl differs")
    last = [checkpoint.read_manifest(root) for root in roots]
    if last[0]._replace(path=None) != last[1]._replace(path=None):
        found.append("the last checkpoint differs")
    checkpoint.verify(last[1])
    if (ended := ending.read(roots[1])) is None or ended.status != "finished":
        found.append("not complete")
    # The last thing that a run says; one that was killed just before is complete and has not said it.
    log = "".join(path.read_text(errors="replace") for path in (other / "logs").glob(f"{name}*"))
    if (times := log.count("everything is in ")) > 1:
        found.append(f"run to its end {times} times")
    return found


def check_runs(alone, other, record_property):
    """All runs of a sweep against those of the same sweep left alone."""
    names = runs_of(alone)
    assert names and runs_of(other) == names  # none is another's, or moved aside
    record_property("runs compared bit for bit", len(names))
    wrong = {name: differing(alone, other, name) for name in names}
    assert not any(wrong.values()), wrong


def test_a_killed_sweep_ends_with_the_same_figures(tmp_path, amount, say, record_property):
    kills = amount("sweep_kills")
    # A few kills are spent before much has begun, so a sweep of one seed is enough for them.
    flags = FIGURES if kills > 5 else (*FIGURES[:1], "--seeds=1", *SMALL)
    alone, killed = tmp_path / "alone", tmp_path / "killed"
    seconds = left_alone([*command("figures", alone, flags), "--workers=2"])
    line = [*command("figures", killed, flags), "--workers=2"]
    counts = until_done(line, kills, seconds, random.Random(0), say)
    record_property("SIGKILLs", sum(counts))
    record_property("of them with everything that ran", counts[1])
    check_runs(alone, killed, record_property)
    files = [path.relative_to(alone) for path in (alone / "figures").rglob("*.*")]
    record_property("figures and their numbers, equal byte for byte", len(files))
    different = [name for name in files if (alone / name).read_bytes() != (killed / name).read_bytes()]
    assert files and not different


def test_a_difference_between_two_sweeps_is_found(tmp_path):
    name, roots = "Catch/rl_only/seed0", (tmp_path / "alone", tmp_path / "other")
    done = ending.Ending("finished", 240)
    for root in roots:
        write_checkpoint(write_run(root / name, ended=done))
    assert runs_of(roots[1]) == [name] and differing(*roots, name) == []
    log = roots[1] / "logs" / f"{name}.log"
    log.parent.mkdir(parents=True)
    log.write_text("240 env steps; everything is in it\n" * 2)
    (roots[1] / name / "ended.json").unlink()
    (roots[1] / name / "metrics.jsonl").write_text("")
    write_checkpoint(roots[1] / name, only=["rl"])
    assert differing(*roots, name) == [
        "metrics.jsonl differs", "the last checkpoint differs", "not complete", "run to its end 2 times",
    ]  # fmt: skip
