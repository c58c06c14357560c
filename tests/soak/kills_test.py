"""Runs that are killed with SIGKILL, again and again, against the same run left alone.

Half of the kills come at a random operation on a file (before one is opened, within it, before it is flushed,
linked, renamed or removed), the others after a random time. What the resumed run is in the end (parameters,
optimizer, replay with priorities, generators, environments, metrics but for wall time) must be what the other
one is, bit for bit.
"""

import math
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers import last_of_each
from tests.soak.conftest import ROOT, different, remains

SMALL = (
    "--encoder=tiny:features=16", "--rl=rainbow:hidden=32,atoms=11", "--mode=joint",
    "--objective=reconstruction", "--num_envs=4", "--buffer_size=1000", "--batch_size=8",
    "--updates_per_step=0.1", "--learn_start=80", "--steps=2400", "--log_every=200", "--eval_every=600",
    "--eval_games=2", "--eval_max_steps=150", "--checkpoint_every=140", "--slow_update_every=20",
    "--tune_runtime=off", "--keep_replay",
)  # fmt: skip
"""A run in which everything happens several times: the buffer wraps, episodes end, evaluations are under way
when checkpoints are written."""

KINDS = {
    "Catch, nodiagnostics": ("--nodiagnostics",),
    "Catch": (),
    "CatchDistractor, srl_every=3": ("--srl_every=3",),
    "Pong": (),
    "Breakout, sticky": ("--sticky_actions=0.25",),
    "Qbert": (),
    "Qbert, sticky": ("--sticky_actions=0.25",),
    "YarsRevenge": (),
    "YarsRevenge, sticky": ("--sticky_actions=0.25",),
    "Seaquest, sticky": ("--sticky_actions=0.25",),
    "MsPacman, pretrain": ("--mode=pretrain", "!rl", "!eval_games", "!eval_max_steps", "!slow_update_every"),
    "Catch, three seeds": ("--seeds=0,1,2",),
    "Pong, two seeds": ("--seeds=0,1",),
}
"""{name: flags, and behind a ! those that are left out}; the game is the name's first word."""

ENVIRONMENT = dict(os.environ, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0", TF_CPP_MIN_LOG_LEVEL="3")


def flags_of(kind):
    """Of a kind of run: its flags; where one is given twice, the last one counts."""
    given = last_of_each((*SMALL, f"--game={kind.split(',')[0]}", *KINDS[kind]))
    left_out = {f"--{flag[1:]}" for flag in given if flag.startswith("!")}
    return tuple(flag for flag in given if flag[0] != "!" and flag.partition("=")[0] not in left_out)


def command(out, flags, at=""):
    """The command line that starts or resumes a run; see `tests/soak/victim.py`."""
    return [sys.executable, "-m", "tests.soak.victim", str(at), *flags, f"--out={out}", "--resume=auto"]


def life(out, flags, at="", after=None):
    """Starts or resumes a run; kills it at an operation, or so many seconds after it has begun.

    Returns:
        Its exit status, and the seconds that it took once it had begun.
    """
    line = command(out, flags, at)
    with open(f"{out}.errors", "w+") as errors:
        process = subprocess.Popen(line, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=errors)
        process.stdout.readline()  # "begun"
        began = time.monotonic()
        try:
            process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        errors.seek(0)
        assert process.returncode in (0, -signal.SIGKILL), errors.read()[-1000:]
    return process.returncode, time.monotonic() - began


@pytest.mark.parametrize("kind", KINDS)
def test_a_killed_run_ends_as_if_it_had_not_been(kind, tmp_path, amount, progress, record_property):
    flags, draw = flags_of(kind), random.Random(kind)
    status, seconds = life(tmp_path / "alone", flags)
    assert status == 0
    alone = remains(tmp_path / "alone")
    operations = int(Path(f"{tmp_path}/alone.operations").read_text())
    wanted = math.ceil(amount("kills") / len(KINDS))
    kills, at_operations, runs, wrong = 0, 0, 0, []
    while kills < wanted:
        out, runs, status = tmp_path / f"killed_{runs}", runs + 1, None
        while status != 0:
            at, after = "", None
            if kills < wanted and 2 * at_operations <= kills:
                at = draw.randrange(operations // 2)
            elif kills < wanted:
                after = draw.uniform(0.0, 0.5 * seconds)
            status, _ = life(out, flags, at, after)
            kills += status != 0
            at_operations += status != 0 and at != ""
            progress(kills, wanted, "kills")
        wrong += different(remains(out), alone)
    record_property("SIGKILLs", kills)
    record_property("of them at an operation on a file", at_operations)
    record_property("runs resumed to their end", runs)
    assert not wrong


def test_a_difference_between_two_runs_is_found(tmp_path):
    alone = {"rows": [{"env_steps": 1}], "run": (10, 1, {"best": 1.0}, {"params.msgpack": "a", "x.npy": "b"})}
    assert different(dict(alone), alone) == []
    other = {"rows": [], "run": (10, 1, {"best": 1.0}, {"params.msgpack": "a", "x.npy": "c"})}
    assert different(other, alone) == ["rows", "run: files"]
