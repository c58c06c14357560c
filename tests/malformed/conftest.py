"""Malformed input of train, evaluate and draw: one line, status 2; nothing is written and nothing executed.

What a message says exactly is tested where it is made; here it must name the flag or the file.
"""

import os
import shutil
import signal

import pytest

from experiments import draw, evaluate, train
from experiments.command_line import flags as config_flags
from tests.helpers import SMALL, last_of_each, write_checkpoint, write_run
from tests.in_process import parse

LIMIT_S = 20
"""A case that takes longer has failed; what waits for a pipe waits for ever."""
CODE = "__import__('os').system('touch CANARY')"
"""Makes a file in the working directory if anything evaluates it."""

FITTING = tuple(f"--{name}={SMALL[name]}" for name in ("game", "frame_size", "encoder", "rl", "num_envs"))
TRAIN = ("train", "--tune_runtime=off", "--out=run")
START = (*TRAIN, *FITTING, "--mode=finetuned", "--encoder_from=source")
GIVEN = (
    *TRAIN,
    *(flag for flag in FITTING if "--rl" not in flag),
    "--mode=pretrain",
    "--objective=latent_l2",
    "--policy_from=source",
)
EVALUATE = ("evaluate", "--tune_runtime=off", "--run=source", "--games=1")
DRAW = ("draw", "--run=source")
OVERWRITE = (*TRAIN, "--game=Catch", "--overwrite")


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """A run directory as training leaves it: config.json, metrics.jsonl and one checkpoint."""
    run = write_run(tmp_path_factory.mktemp("valid") / "source", **SMALL)
    write_checkpoint(run)
    return run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def source(valid, folder):
    """A copy of the valid run in the working directory, `source`."""
    return shutil.copytree(valid, folder / "source")


def call(program, *arguments):
    """Runs an entry point in this process, with flags of its own; returns its exit status."""
    module = {"train": train, "evaluate": evaluate, "draw": draw}[program]
    main = train.train if module is train else module.main

    def late(*_):
        raise TimeoutError(arguments)

    handler = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        values = parse(module, *last_of_each(arguments))
        return config_flags.guarded(lambda _: main(values))([program]) or 0
    except SystemExit as ended:
        return ended.code
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


def listing(folder):
    """Everything below a folder: what it is, its size and time."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            about = os.lstat(os.path.join(root, name))
            if name in folders:  # a file that was made there and removed again leaves another time
                found[root, name] = about.st_mode
            else:
                found[root, name] = about.st_mode, about.st_size, about.st_mtime_ns, about.st_ino
    return found


@pytest.fixture
def refused(folder, capsys):
    """refused(program, *arguments, names=what the line must hold)."""

    def check(program, *arguments, names):
        before = listing(folder)
        status, case = call(program, *arguments), (program, *(text[:200] for text in arguments))
        out, line = capsys.readouterr()
        assert (status, out) == (2, ""), (case, line)
        assert line.count("\n") == 1 and line.endswith("\n") and line[:-1].isprintable(), (case, line)
        assert names in line, (case, line)
        assert listing(folder) == before, case

    return check
