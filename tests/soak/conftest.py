"""What soak tests share: how much of everything is tried, progress, and the table at the end.

A test says what it has counted with `record_property(what, number or text)`; numbers of a parametrised test
are added up. `--table=FILE` writes the table, too.
"""

import json
import platform
import sys
import time
from pathlib import Path
from unittest import mock

import pytest

from experiments import train
from srl_jax.config import Config
from srl_jax.files import checkpoint
from srl_jax.files.provenance import git_revision
from tests import helpers
from tests.in_process import parse

ROOT = Path(__file__).resolve().parents[2]

AMOUNTS = {
    "kills": (100, "SIGKILLs to runs, of all kinds of run together"),
    "flips": (1000, "flipped bits of a checkpoint"),
    "every": (1, "1: the disk is full at each operation in turn; k: at every k-th"),
    "games": (57, "games beside gymnasium's wrappers and out of snapshots"),
    "loop_steps": (100_000, "env steps of each of ten games through the loop"),
    "operations": (1_000_000, "operations of replay"),
    "memory_steps": (60_000, "env steps in which memory may not grow"),
    "buffer": (100_000, "transitions in the buffer whose checkpoints are timed"),
    "sweep_kills": (20, "SIGKILLs to a sweep below a figure"),
    "combinations": (300, "random runs from the registries"),
    "worker_kills": (5, "SIGKILLs to workers of a Ray cluster"),
}
"""{option: (the campaign's, help)}."""


def pytest_addoption(parser):
    group = parser.getgroup("soak", "how much is tried")
    for name, (number, text) in AMOUNTS.items():
        group.addoption(f"--{name}", type=int, default=number, help=f"{text} (default: {number:,})")
    group.addoption("--table", type=Path, help="file to write the table to")
    group.addoption("--pictures", type=Path, help="folder to keep pictures of pages in")


def pytest_collection_modifyitems(items):
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.soak)


@pytest.fixture(scope="session")
def amount(pytestconfig):
    """amount(option) -> int; see AMOUNTS."""
    return pytestconfig.getoption


@pytest.fixture
def say(pytestconfig):
    """Says a line on stderr at once, which pytest would keep."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")

    def line(text):
        with capture.global_and_fixture_disabled():
            print(text, file=sys.stderr, flush=True)

    return line


@pytest.fixture
def progress(request, say):
    """progress(done, total, unit): a line with the rate and the time left, every ten seconds."""
    began = shown = time.monotonic()

    def tell(done, total, unit):
        nonlocal shown
        now = time.monotonic()
        if done and now - shown > 10:
            rate = done / (now - began)
            left = time.strftime("%H:%M:%S", time.gmtime(max(total - done, 0) / rate))
            say(f"{request.node.name}: {done:,} of {total:,} {unit}, {rate:,.3g} a second, {left} left")
            shown = now

    return tell


# A small run, and what a run has left


SMALL_RUN = (
    "--game=Catch", "--frame_size=42", "--encoder=tiny:features=16", "--rl=rainbow:hidden=16,atoms=11",
    "--mode=joint", "--objective=reconstruction", "--num_envs=4", "--buffer_size=400", "--batch_size=8",
    "--updates_per_step=0.2", "--learn_start=40", "--eval_every=80", "--eval_games=2", "--eval_max_steps=30",
    "--log_every=40", "--checkpoint_every=40", "--slow_update_every=7", "--nodiagnostics", "--keep_replay",
    "--tune_runtime=off",
)  # fmt: skip
"""Of the seconds that tests take, most are of its compilation."""


small_chunks = mock.patch("srl_jax.replay.CHUNK_BYTES", 200_000)
"""Cuts the frames of such a run into several files; one that is resumed needs what it began with."""


def train_here(*arguments):
    """`experiments.train` in this process; returns its status, raises what it raises."""
    return train.train(parse(train, *helpers.last_of_each(arguments)))


@pytest.fixture(scope="session")
def small_run(tmp_path_factory):
    """The directory of a small run of 160 env steps that can be resumed, and is not to be changed."""
    run = tmp_path_factory.mktemp("small") / "run"
    with small_chunks:
        assert train_here(*SMALL_RUN, "--steps=160", f"--out={run}") == 0
    return run


def rows_of(run):
    """The rows of a run, or of its seeds, less what depends on the clock."""
    files = sorted([*run.glob("metrics.jsonl"), *run.glob("seed*/metrics.jsonl")])
    return [row for file in files for row in helpers.rows_of(file.parent)]


def remains(run):
    """All that a run with --keep_replay has left: rows, and the sums and numbers of its last checkpoints.

    The checkpoint of a run that has ended holds parameters, optimizer, replay with priorities, generators of
    random numbers and environments.
    """
    found = {"rows": rows_of(run)}
    for folder in sorted(path.parent for path in run.glob("**/config.json")):
        last = checkpoint.newest_good(folder, pytest.fail)
        # The report's numbers are rows, which are compared, and seconds.
        numbers = {name: x for name, x in checkpoint.load_numbers(last).items() if name != "report"}
        sums = {name: entry for name, entry in last.files.items() if name != "run.json"}
        found[folder.name if folder != run else "run"] = last.env_steps, last.updates, numbers, sums
        assert last.config == Config.load(folder)
    return found


def different(found, alone):
    """The names of what differs between the `remains` of two runs."""
    names = []
    for key in sorted(found.keys() | alone.keys()):
        if found.get(key) != alone.get(key):
            parts = zip(("env_steps", "updates", "numbers", "files"), found[key], alone[key], strict=False)
            names += [f"{key}: {what}" for what, a, b in parts if a != b] if key != "rows" else [key]
    return names


# The table


def pytest_terminal_summary(terminalreporter, config):
    rows = {}
    for outcome in ("passed", "failed", "error", "skipped"):
        for report in terminalreporter.stats.get(outcome, ()):
            module, _, name = report.nodeid.partition("::")
            row = rows.setdefault((Path(module).stem, name.partition("[")[0]), {"outcomes": [], "counts": {}})
            row["outcomes"].append(outcome)
            row["seconds"] = row.get("seconds", 0.0) + report.duration
            for what, value in report.user_properties:
                known = row["counts"].get(what)
                row["counts"][what] = known + value if isinstance(known, int) else value
            if outcome == "skipped":
                row["counts"]["skipped"] = report.longrepr[2] if isinstance(report.longrepr, tuple) else ""
    if not rows:
        return
    lines = ["| part | test | times | failed | what was counted | minutes |", "|---|---|---|---|---|---|"]
    for (module, name), row in sorted(rows.items()):
        bad = sum(outcome in ("failed", "error") for outcome in row["outcomes"])
        counts = [
            f"{value:,} {what}" if isinstance(value, int) else f"{what}: {value}"
            for what, value in row["counts"].items()
        ]
        part, title = module.removesuffix("_test"), name.removeprefix("test_").replace("_", " ")
        cells = part, title, len(row["outcomes"]), bad, "<br>".join(counts), f"{row['seconds'] / 60:.1f}"
        lines.append(f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |")
    about = {"revision": git_revision(), "python": platform.python_version(), "machine": platform.machine()}
    changed = {name: config.getoption(name) for name, (number, _) in AMOUNTS.items()}
    changed = {name: n for name, n in changed.items() if n != AMOUNTS[name][0]}
    note = f"{json.dumps(about)}{f'; less than the campaign: {json.dumps(changed)}' if changed else ''}"
    text = "\n".join([*lines, "", note, ""])
    terminalreporter.write_sep("=", "soak")
    terminalreporter.write(text)
    if path := config.getoption("table"):
        path.write_text(text, encoding="utf-8")
