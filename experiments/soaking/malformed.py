"""Malformed input: refused in one line and with status 2; nothing is written, and nothing executed."""

import contextlib
import hashlib
import io
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from absl import flags

from . import Count, Say
from .malformed_cases import (
    CANARY,
    CHECKPOINTS,
    FLAGS,
    KINDS,
    LINKS,
    NAMES,
    PICKLES,
    PRESETS,
    SPECS,
    TOGETHER,
    VALID,
    Case,
    cases,
    checkpoint_of,
    make_valid_run,
)

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 20
"""A case that takes longer has failed."""
MEMORY = 8 << 30
"""Bytes of address space of a case's process: what reads without end shall not take the machine's memory."""
HASHED = 1 << 26
"""Files of more bytes are compared by size and time alone."""
SHORT = (
    (FLAGS, "steps: huge"),
    (FLAGS, "lr_rl: beyond single precision"),
    (PRESETS, "code"),
    (SPECS, "encoder 'sac_ae:features=2147483647'"),
    (TOGETHER, "a batch larger than the buffer"),
    (CHECKPOINTS, "manifest.json: one bit differs, to encoder_from"),
    (CHECKPOINTS, "params.msgpack: cut short, to encoder_from"),
    (PICKLES, "params.msgpack (binary), to train"),
    (NAMES, "out: with a line break"),
    (NAMES, "overwrite: a config 100,000 deep"),
    (LINKS, "manifest.json is a pipe, to train"),
    (LINKS, "out is a link to itself, to overwrite"),
)
"""The cases of the short version: all are for `train`, which runs in this process too."""


class Outcome(NamedTuple):
    """How a program ended.

    Attributes:
        status: of the process; None where it took too long.
        stdout, stderr: what it printed.
    """

    status: int | None
    stdout: str
    stderr: str


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """Runs the cases; a count for each of their kinds.

    Args:
        short: run `SHORT` alone, in this process.
        folder: empty; every case gets a folder in it.
        say: takes a line for each case that fails, and one in a while.
    """
    table = cases()
    if short:
        table = [case for case in table if (case.kind, case.name) in SHORT]
        assert len(table) == len(SHORT)
    valid = folder / "valid"
    make_valid_run(valid)
    failed: dict[str, list[str]] = {kind: [] for kind in KINDS}
    slowest, began = 0.0, time.monotonic()
    for i, case in enumerate(table):
        start = time.monotonic()
        problems = run_case(case, folder / f"{i:04d}", valid, call if short else execute)
        slowest = max(slowest, time.monotonic() - start)
        if problems:
            failed[case.kind].append(case.name)
            say(f"{case.kind}, {case.name!r} ({i:04d}): {'; '.join(problems)}")
        if i % 50 == 49:
            bad = sum(map(len, failed.values()))
            say(f"{i + 1} of {len(table)} cases in {time.monotonic() - began:.0f} s, {bad} failed")
    counts = []
    for kind in KINDS:
        number = sum(case.kind == kind for case in table)
        if number:
            counts.append(Count(kind, number, len(failed[kind]), ", ".join(failed[kind])))
    say(f"{len(table)} cases in {time.monotonic() - began:.0f} s; the slowest took {slowest:.1f} s")
    return counts


def run_case(case: Case, folder: Path, valid: Path, run=None) -> list[str]:
    """Prepares a case's folder and runs it there; what was wrong with the outcome.

    Args:
        case: to run.
        folder: of the case; must not exist.
        valid: from `make_valid_run`.
        run: `execute` or `call`.
    """
    folder.mkdir(parents=True)
    if case.prepare is not None:
        case.prepare(folder, valid)
    places = {
        "{folder}": str(folder),
        "{source}": str(folder / "source"),
        "{checkpoint}": str(folder / "source" / checkpoint_of(valid).relative_to(valid)),
    }
    arguments, names = [filled(text, places) for text in case.arguments], filled(case.names, places)
    before = listing(folder)
    outcome = (run or execute)(case.program, arguments, folder)
    return judge(outcome, names, before, listing(folder), accepted=case.kind == VALID)


def filled(text: str, places: dict[str, str]) -> str:
    """The text with its places filled in; code may hold other braces."""
    for place, value in places.items():
        text = text.replace(place, value)
    return text


def judge(outcome: Outcome, names: str, before: dict, after: dict, accepted: bool = False) -> list[str]:
    """What is wrong with an outcome, in words; nothing where the promise holds.

    Args:
        outcome: of the program.
        names: what its line must hold.
        before, after: `listing` of the folder.
        accepted: the input was valid: status 0, and new files are no fault.
    """
    problems = []
    lines = outcome.stderr.splitlines()
    if outcome.status is None:
        problems.append(f"took more than {LIMIT_S} s")
    elif outcome.status != (0 if accepted else 2):
        problems.append(f"status {outcome.status}")
    if "Traceback" in outcome.stderr:
        problems.append(f"a traceback, {lines[-1][:200]}")
    elif len(lines) != (0 if accepted else 1) or not all(line.strip() for line in lines):
        problems.append(f"{len(lines)} lines on stderr, {outcome.stderr[-200:]!r}")
    elif names not in outcome.stderr:
        problems.append(f"{names[:80]!r} is not in {outcome.stderr[:300]!r}")
    elif not all(character.isprintable() for line in lines for character in line):
        problems.append(f"control characters in {outcome.stderr[:200]!r}")
    if not accepted:
        if outcome.stdout:
            problems.append(f"printed {outcome.stdout[:80]!r}")
        changed = {path for path in before.keys() | after if before.get(path) != after.get(path)}
        if changed:
            problems.append(f"changed {', '.join(sorted(changed)[:5])!r}")
    if any(Path(path).name == CANARY for path in after):
        problems.append("executed what the input holds")
    return problems


def listing(folder: Path) -> dict[str, tuple]:
    """Everything below a folder: what it is, size, time and sum of files, where links lead.

    Of folders not the time: one that was made and removed again left no trace but that.
    """
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root, name)
            info = path.lstat()
            if stat.S_ISLNK(info.st_mode):
                content: tuple = (os.readlink(path),)
            elif stat.S_ISREG(info.st_mode):
                summed = info.st_size <= HASHED and hashlib.sha256(path.read_bytes()).hexdigest()
                content = (info.st_size, info.st_mtime_ns, summed)
            else:
                content = ()
            found[str(path.relative_to(folder))] = (stat.S_IFMT(info.st_mode), *content)
    return found


def execute(program: str, arguments: Iterable[str], folder: Path) -> Outcome:
    """Runs an entry point in a process of its own, in a folder; ends all of it after `LIMIT_S`."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
    env |= {"PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "JAX_PLATFORMS": "cpu"}
    # A shell sets the limit: Python could do so between fork and exec alone, and jax does not like forks.
    limited = ["/bin/sh", "-c", f'ulimit -v {MEMORY >> 10}; exec "$@"', "sh"]
    process = subprocess.Popen(
        [*limited, sys.executable, "-m", f"experiments.{program}", *arguments],
        cwd=folder,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="backslashreplace",
        start_new_session=True,
    )
    try:
        stdout, stderr = process.communicate(timeout=LIMIT_S)
        return Outcome(process.returncode, stdout, stderr)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        stdout, stderr = process.communicate()
        return Outcome(None, stdout, stderr)


def call(program: str, arguments: Iterable[str], folder: Path) -> Outcome:
    """Runs `train` in this process, with flags of its own; another program is not known here."""
    from srl_jax.specs import ConfigError

    from .. import flags as config_flags
    from .. import train

    if program != "train":
        raise ValueError(f"{program} runs in a process of its own only")
    stdout, stderr, status = io.StringIO(), io.StringIO(), 0
    with contextlib.chdir(folder), contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            values = flags.FlagValues()
            train.define_flags(values)
            config_flags.parse([program, *arguments], values)
            try:
                train.train(values)
            except ConfigError as error:
                config_flags.fail(error)
        except SystemExit as ended:
            status = ended.code
    return Outcome(status, stdout.getvalue(), stderr.getvalue())
