"""A progress bar on standard error: env steps, speed, time left, losses and returns."""

import math
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any, TextIO

from srl_jax.display import Display

BAR_WIDTH = 20
RATE_WINDOW_S = 10.0
"""Shortest stretch of time, in seconds, that the rate is taken over."""


class Progress:
    """Draws one line that is rewritten on a terminal, or a line now and then elsewhere.

    The rate is taken over the later half of the time since the first update (at least ten
    seconds): start-up and compilation drop out of it, and pauses for evaluation are spread over it,
    so that the time left stays steady.

    Args:
        total: what `done` will be at the end.
        unit: what `done` counts; its last word names the rate ("steps/s").
        stream: where to draw; None for stderr.
        clock: seconds, monotonic.
        width: of the terminal, in characters; None asks the terminal each time.
    """

    def __init__(
        self,
        total: int,
        unit: str = "env steps",
        stream: TextIO | Display | None = None,
        clock: Callable[[], float] = time.monotonic,
        width: int | None = None,
    ):
        self._total = total
        self._unit = unit
        self._stream = Display(sys.stderr if stream is None else stream)
        self._clock = clock
        self._width = width
        self._tty = self._stream.isatty()
        self._interval = 0.25 if self._tty else 10.0
        self._done = 0
        self._fields: dict[str, Any] = {}
        self._samples: deque[tuple[float, int]] = deque()
        self._first: float | None = None
        self._drawn_at = -math.inf
        self._drawn: int | None = None
        self._shown = 0  # characters of the bar that stand on the terminal's last line
        self._closed = False

    def update(self, done: int, **fields: Any) -> None:
        """Says how far it is; draws if the last drawing is old enough.

        Args:
            done: counted from the start of the run.
            **fields: numbers or strings to show, kept until given again; None takes one away. They
                are turned into text only when drawn, so that a device array is rarely waited for.
        """
        if self._closed:
            return
        now = self._clock()
        if self._first is None:
            self._first = now
        if not self._samples or now - self._samples[-1][0] >= 0.5:
            self._samples.append((now, done))
            oldest = min((now + self._first) / 2, now - RATE_WINDOW_S)
            while len(self._samples) > 2 and self._samples[1][0] <= oldest:
                self._samples.popleft()
        self._done = done
        self._fields.update(fields)
        if now - self._drawn_at >= self._interval:
            self._draw(now)

    def note(self, text: str) -> None:
        """Prints a line of its own above the bar."""
        self._clear()
        self._stream.write(text + "\n")
        if self._tty and not self._closed and self._first is not None:
            self._draw(self._clock())
        self._stream.flush()

    def close(self) -> None:
        """Draws the last state and ends the line. A second call does nothing."""
        if self._closed:
            return
        if self._first is not None:
            if self._tty or self._drawn != self._done:
                self._draw(self._clock())
            if self._tty:
                self._stream.write("\n")
                self._stream.flush()
        self._closed = True
        self._shown = 0

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def line(self, now: float) -> str:
        """The line as it would be drawn at `now` (seconds of the clock), not yet clipped."""
        share = min(max(self._done / self._total, 0.0), 1.0) if self._total > 0 else 1.0
        filled = int(share * BAR_WIDTH)
        rate = self._rate(now)
        parts = [
            f"[{'#' * filled}{'.' * (BAR_WIDTH - filled)}] {math.floor(share * 100):3d}%"
            f" {self._done:,}/{self._total:,} {self._unit}"
        ]
        if rate is not None:
            parts.append(f"{rate:,.0f} {self._unit.split()[-1]}/s")
        if rate and self._done < self._total:
            parts.append(f"{hms((self._total - self._done) / rate)} left")
        elif self._done >= self._total and self._first is not None:
            parts.append(f"{hms(now - self._first)} in all")
        shown = {key: value for key, value in self._fields.items() if value is not None}
        parts += [f"{key} {_text(value)}" for key, value in shown.items()]
        return " | ".join(parts)

    def _rate(self, now: float) -> float | None:
        """Units a second of late, None while unknown."""
        if not self._samples:
            return None
        then, done = self._samples[0]
        return (self._done - done) / (now - then) if now > then and self._done > done else None

    def _draw(self, now: float) -> None:
        line = self.line(now)
        if self._tty:
            # One column stays free: a terminal may wrap a line that is exactly full.
            columns = self._width or shutil.get_terminal_size().columns
            line = line[: max(columns - 1, 1)]
            self._stream.write("\r" + line + " " * (self._shown - len(line)))
            self._shown = len(line)
        else:
            self._stream.write(line + "\n")
        self._stream.flush()
        self._drawn_at = now
        self._drawn = self._done

    def _clear(self) -> None:
        if self._shown:
            self._stream.write("\r" + " " * self._shown + "\r")
            self._shown = 0


def hms(seconds: float) -> str:
    """A duration in seconds as h:mm:ss."""
    whole = max(int(round(seconds)), 0)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def _text(value: Any) -> str:
    if isinstance(value, str | int):
        return str(value)
    return f"{float(value):.3g}"
