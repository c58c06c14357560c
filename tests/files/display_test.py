"""srl_jax/files/display.py: a display that is lost ends nothing; what a bar of progress says."""

import errno
import io
import os
import pathlib
import pty
import re
import select
import subprocess
import sys
import termios
import threading
import types

import pytest

from srl_jax.config import Config
from srl_jax.errors import SaveError
from srl_jax.files import display
from srl_jax.files.display import Display, Progress, hms
from srl_jax.files.metrics import read_metrics
from srl_jax.run.reporting import Report

ROOT = pathlib.Path(__file__).resolve().parents[2]


class Gone(io.StringIO):
    """A stream whose reader goes away after so many writes."""

    def __init__(self, after=0, error=errno.EPIPE):
        super().__init__()
        self.left, self.error = after, error

    def isatty(self):
        return True

    def write(self, text):
        if not self.left:
            raise OSError(self.error, os.strerror(self.error))
        self.left -= 1
        return super().write(text)


@pytest.mark.parametrize("error", [errno.EPIPE, errno.EIO, errno.ENOSPC, errno.EBADF])
def test_what_cannot_be_shown_is_not(error):
    stream = Gone(after=1, error=error)
    shown = Display(stream)
    for text in ("a", "b", "c"):
        assert shown.write(text) == 1
    shown.flush()
    assert stream.getvalue() == "a" and shown.lost.errno == error and not shown.isatty()


def test_a_stream_that_is_closed_or_missing_shows_nothing():
    closed = io.StringIO()
    closed.close()
    for stream in (closed, None):
        shown = Display(stream)
        assert shown.write("a") == 1 and not shown.isatty() and shown.lost
        shown.flush()
    with pytest.raises(OSError, match="fileno"):
        Display(None).fileno()


def test_letters_that_a_stream_does_not_know_are_escaped():
    raw = io.BytesIO()
    shown = Display(io.TextIOWrapper(raw, encoding="ascii", write_through=True))
    shown.write("in Gemälde\n")
    shown.write("more\n")
    assert raw.getvalue() == b"in Gem\\xe4lde\nmore\n" and shown.lost is None


@pytest.fixture
def clock(monkeypatch):
    """What tqdm takes for the time: `clock.now`, in seconds."""
    made = types.SimpleNamespace(now=100.0)
    monkeypatch.setattr("tqdm.std.time", lambda: made.now)
    return made


@pytest.mark.parametrize("after", range(6))
def test_progress_goes_on_without_its_reader(after, clock):
    with Progress(10, stream=Gone(after)) as progress:
        for done in range(4):
            clock.now += 10
            progress.update(done)
            progress.note("a line")


def test_progress_without_stderr_shows_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with Progress(10) as progress:
        progress.update(1)
        progress.note("a line")
    display.say("a line")


def test_a_result_that_is_lost_is_an_error_unless_its_reader_went(monkeypatch):
    for error in (errno.ENOSPC, errno.EIO):
        monkeypatch.setattr(sys, "stdout", Gone(error=error))
        with pytest.raises(SaveError, match=f"standard output: {os.strerror(error)}"):
            display.result("{}")
    monkeypatch.setattr(sys, "stdout", Display(None))
    with pytest.raises(SaveError, match="standard output: Bad file descriptor"):
        display.result("{}")
    monkeypatch.setattr(sys, "stdout", Gone(error=errno.EPIPE))
    display.result("{}")


# Progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal, and what would stand on its last line."""

    def isatty(self):
        return True

    def screen(self):
        """The lines that a reader sees: what follows a carriage return overwrites."""
        seen = []
        for line in self.getvalue().split("\n"):
            cells = []
            for text in line.split("\r"):
                cells[: len(text)] = text
            seen.append("".join(cells).rstrip())
        return seen


def test_a_bar_says_how_far_how_fast_how_well_and_how_long(clock):
    stream = Terminal()
    progress = Progress(50_000, stream=stream)
    progress.update(0)
    clock.now += 10
    progress.update(12_500, returns=-20.125, loss=0.5, epsilon=None)
    # 12,500 of 50,000 in 10 s: 1,250 a second; 37,500 / 1,250 = 30 s to go; 2.5 of 10 cells.
    (line,) = stream.screen()
    assert line.startswith(" 25%|##5       | 12500/50000 [00:10<00:30, 1250.00 env steps/s")
    assert line.endswith("returns=-20.1, loss=0.5]")
    clock.now += 10
    progress.update(25_000, loss=None)
    assert "returns=-20.1]" in stream.screen()[-1]


def test_the_rate_forgets_the_start_up(clock):
    stream = Terminal()
    progress = Progress(100_000, stream=stream)
    progress.update(0)
    clock.now += 60  # compiling
    for step in range(1, 1001):
        clock.now += 0.25
        progress.update(25 * step)
    # The last 250 s had 100 a second; 75,000 steps are left.
    left, rate = re.search(r"<([0-9:]+), +([0-9.]+) env steps/s", stream.screen()[-1]).groups()
    assert 99 < float(rate) <= 100 and left.startswith("12:3")


def test_a_run_that_is_resumed_has_the_rate_of_what_it_does_now(clock):
    stream = Terminal()
    progress = Progress(1000, stream=stream)
    progress.update(500)
    clock.now += 10
    progress.update(600)
    assert " 60%|######    | 600/1000 [00:10<00:40, 10.00 env steps/s]" in stream.screen()[-1]


def test_a_terminal_is_drawn_on_four_times_a_second_and_no_wider_than_it_is(clock):
    reader, writer = pty.openpty()
    termios.tcsetwinsize(writer, (10, 40))
    drawn = ""
    with open(writer, "w") as stream:
        progress = Progress(1000, stream=stream)
        for step in range(100):
            progress.update(step, note="x" * 50)
            clock.now += 0.01
        while select.select([reader], [], [], 0)[0]:
            drawn += os.read(reader, 1000).decode()
        progress.close()
    os.close(reader)
    assert drawn.count("\r") == 4 and "\n" not in drawn
    assert all(len(part) < 40 for part in drawn.split("\r"))


def test_a_file_gets_whole_lines_every_ten_seconds_and_the_last(clock):
    stream = io.StringIO()
    progress = Progress(1000, stream=stream)
    for step in range(250):
        progress.update(step)
        clock.now += 0.125
    progress.note("a line")
    progress.close()
    progress.close()
    assert "\r" not in stream.getvalue() and "\n\n" not in stream.getvalue()
    assert re.findall(r"(\d+)/1000", stream.getvalue()) == ["0", "80", "160", "240", "249"]
    assert stream.getvalue().splitlines()[-2] == "a line"


def test_a_note_stands_above_the_bar_and_nothing_of_a_longer_line_is_left(clock):
    stream = Terminal()
    with Progress(1000, stream=stream) as progress:
        progress.update(500, field="a long text")
        progress.note("evaluation: -21")
        clock.now += 75
        progress.update(1000, field=None)
    first, second, rest = stream.screen()
    assert first == "evaluation: -21" and rest == ""
    assert second == "100%|##########| 1000/1000 [01:15<00:00,  6.67 env steps/s]"


@pytest.mark.parametrize("total", [0, 4])
def test_nothing_breaks_without_a_total_or_beyond_it(total, clock):
    with Progress(total, stream=io.StringIO()) as progress:
        for done in (0, 5, 6):
            progress.update(done)
            clock.now += 20


def test_a_bar_that_is_not_used_draws_nothing_and_no_bar_has_a_thread(clock):
    stream, threads = Terminal(), threading.active_count()
    Progress(10, stream=stream).close()
    assert stream.getvalue() == ""
    with Progress(10, stream=stream) as progress:
        progress.update(1)
        assert threading.active_count() == threads


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00:00"), (59.6, "0:01:00"), (3661, "1:01:01"), (90000, "25:00:00")]
)
def test_hms(seconds, text):
    assert hms(seconds) == text


def test_a_run_loses_no_row_when_the_reader_of_its_progress_goes(tmp_path, monkeypatch, clock):
    read, write = os.pipe()
    stream = io.TextIOWrapper(io.FileIO(write, "w"), write_through=True)
    monkeypatch.setattr(sys, "stderr", Display(stream))
    with stream, Report(tmp_path, Config(steps=400), progress=True) as report:
        for step in range(100, 401, 100):
            clock.now += 20
            report.train_row(step, 1, {"loss/rl": 0.5})
            report.progress.note("evaluation")
            if step == 100:  # a line is there to be read; then nobody reads on
                assert os.read(read, 1000)
                os.close(read)
    assert [row["env_steps"] for row in read_metrics(tmp_path / "metrics.jsonl")] == [100, 200, 300, 400]


# Whole processes

CODE = """
from experiments.command_line import flags
def main(values):
    print("Gem\\u00e4lde " * 10_000, flush=True)
    with open("file", "w") as file:
        assert file.fileno() > 2
    return 7
flags.program(main, lambda values: None)()
"""


def _shell(line, path, **env):
    """The status of a shell command, `PY` being Python on CODE, in a directory."""
    command = line.replace("PY", '"$PYTHON" -c "$CODE"')
    env = {**os.environ, "PYTHON": sys.executable, "CODE": CODE, "PYTHONPATH": str(ROOT), **env}
    done = subprocess.run(
        ["bash", "-c", command], cwd=path, env=env, capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    "line",
    [
        "PY >&-",
        "PY 2>&-",
        "PY <&- >&- 2>&-",
        "PY > /dev/full",
        "PY 2> /dev/full",
        "PY | true; exit ${PIPESTATUS[0]}",
        "PY 2>&1 | head -c 1; exit ${PIPESTATUS[0]}",
    ],
)
def test_an_entry_point_ends_as_it_would_with_a_display(line, tmp_path):
    status, _, said = _shell(line, tmp_path)
    assert (status, said) == (7, "")


def test_an_entry_point_shows_what_it_can(tmp_path):
    status, shown, _ = _shell("PY", tmp_path, PYTHONIOENCODING="ascii")
    assert status == 7 and shown.startswith("Gem\\xe4lde Gem\\xe4lde ")
    status, _, said = _shell("PY", tmp_path, CODE=CODE.replace("return 7", "raise flags.ConfigError('bad')"))
    assert (status, said) == (2, "error: bad\n")
