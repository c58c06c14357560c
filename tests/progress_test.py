import io

import pytest

from srl_jax.display import Progress, hms


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


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


def make(stream, total=1000, **options):
    clock = Clock()
    return clock, Progress(total, stream=stream, clock=clock, **options)


def test_line_says_how_far_how_fast_how_well_how_long():
    stream = Terminal()
    clock, progress = make(stream, total=50_000, width=200)
    progress.update(0)
    clock.now += 10
    progress.update(12_500, returns=-20.125, loss=0.5, epsilon=None)
    # 12,500 of 50,000 in 10 s: 1,250 a second; 37,500 / 1,250 = 30 s to go; 5 of 20 cells.
    assert stream.screen() == [
        "[#####...............]  25% 12,500/50,000 env steps | 1,250 steps/s | 0:00:30 left"
        " | returns -20.1 | loss 0.5"
    ]


def test_rate_forgets_the_start_up():
    stream = Terminal()
    clock, progress = make(stream, total=100_000, width=200)
    progress.update(0)
    clock.now += 60  # compiling
    for step in range(1, 101):
        clock.now += 1
        progress.update(100 * step)
    # At 160 s the window is the last 80 s, all of it at 100 a second.
    assert "| 100 steps/s | 0:15:00 left" in stream.screen()[-1]


def test_terminal_is_redrawn_four_times_a_second_and_clipped():
    stream = Terminal()
    clock, progress = make(stream, width=40)
    for step in range(100):
        progress.update(step, note="x" * 50)
        clock.now += 0.01
    assert stream.getvalue().count("\r") == 4
    assert "\n" not in stream.getvalue()
    assert all(len(part) <= 39 for part in stream.getvalue().split("\r"))


def test_a_shorter_line_leaves_no_rest_of_a_longer_one():
    stream = Terminal()
    clock, progress = make(stream, width=200)
    progress.update(1, note="a long note")
    clock.now += 1
    progress.update(2, note=None)
    assert stream.screen()[-1].endswith("steps/s | 0:16:38 left")


def test_file_gets_whole_lines_every_ten_seconds_and_the_last():
    stream = io.StringIO()
    clock, progress = make(stream)
    for step in range(250):
        progress.update(step)
        clock.now += 0.125
    progress.close()
    progress.close()
    assert "\r" not in stream.getvalue()
    done = [line.split()[2].split("/")[0] for line in stream.getvalue().splitlines()]
    assert done == ["0", "80", "160", "240", "249"]


def test_note_stands_above_the_bar_and_the_end_says_the_whole_time():
    stream = Terminal()
    clock, progress = make(stream, width=200)
    with progress:
        progress.update(500)
        progress.note("evaluation: -21")
        clock.now += 75
        progress.update(1000)
    first, second, rest = stream.screen()
    assert first == "evaluation: -21" and rest == ""
    assert second.startswith("[####################] 100% 1,000/1,000 env steps")
    assert second.endswith("| 0:01:15 in all")


def test_fields_are_turned_into_text_only_when_drawn():
    class Costly:
        asked = 0

        def __float__(self):
            self.asked += 1
            return 1.0

    value = Costly()
    _, progress = make(Terminal(), width=200)
    for step in range(10):
        progress.update(step, loss=value)
    assert value.asked == 1


@pytest.mark.parametrize("done", [0, 5])
def test_nothing_breaks_without_a_total_or_beyond_it(done):
    stream = io.StringIO()
    clock, progress = make(stream, total=0)
    progress.update(done)
    clock.now += 20
    progress.update(done + 1)
    progress.close()
    assert "100%" in stream.getvalue()


def test_closing_unused_draws_nothing():
    stream = Terminal()
    make(stream)[1].close()
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00:00"), (59.6, "0:01:00"), (3661, "1:01:01"), (90000, "25:00:00")]
)
def test_hms(seconds, text):
    assert hms(seconds) == text
