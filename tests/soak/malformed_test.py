"""Hostile files, each read by a process of its own, whose memory and time are limited.

`tests/malformed` tries these, and much more, in its own process; here what reads without end is ended.
"""

import os
import shutil
import subprocess
import sys

import pytest

from srl_jax.files import checkpoint
from tests.helpers import SMALL, write_checkpoint, write_run
from tests.malformed.conftest import DRAW, EVALUATE, OVERWRITE, START, listing
from tests.malformed.files_test import NO_FILES, TEXTS, TRAPS, put
from tests.soak.conftest import ROOT

MEMORY = 8 << 30
"""Bytes of address space."""
LIMIT_S = 120

HOSTILE = (*NO_FILES, *TRAPS, "a terabyte", "arrays in arrays", "objects in objects")
CASES = [(DRAW, file, thing) for file in ("config.json", "metrics.jsonl") for thing in HOSTILE]
CASES += [((*OVERWRITE, "--out=source"), "config.json", thing) for thing in HOSTILE]
CASES += [
    (command, file, thing)
    for command in (EVALUATE, START)
    for file in ("manifest.json", "params.msgpack")
    for thing in (*NO_FILES, *TRAPS)
]


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("valid") / "source", **SMALL)
    write_checkpoint(run)
    return run


@pytest.mark.parametrize(("command", "file", "thing"), CASES, ids=[f"{c[0]}-{f}-{t}" for c, f, t in CASES])
def test_a_hostile_file_is_refused_in_one_line(command, file, thing, valid, tmp_path):
    source = shutil.copytree(valid, tmp_path / "source")
    folder = source if file in ("config.json", "metrics.jsonl") else checkpoint.read_manifest(source).path
    put(folder / file, TEXTS[thing])
    before = listing(tmp_path)
    program, *arguments = command
    line = [sys.executable, "-m", f"experiments.{program}", *arguments]
    # A shell sets the limit: Python could do so between fork and exec alone, and jax does not like forks.
    limited = ["/bin/sh", "-c", f'ulimit -v {MEMORY >> 10}; exec "$@"', "sh", *line]
    environment = dict(os.environ, PYTHONPATH=str(ROOT), PYTHONSAFEPATH="1")
    done = subprocess.run(
        limited, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=LIMIT_S
    )
    assert (done.returncode, done.stdout) == (2, ""), done.stderr[-2000:]
    assert done.stderr.count("\n") == 1 and done.stderr[:-1].isprintable(), done.stderr[-2000:]
    assert listing(tmp_path) == before
