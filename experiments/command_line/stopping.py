"""Signals that ask a program to write its checkpoints and to end. Imports no jax."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

ASKING = (signal.SIGINT, signal.SIGTERM)
WARNING = (signal.SIGHUP, signal.SIGUSR1)
"""Of a terminal that closes, and of a queue before a job's time is up. Left alone where somebody has another
use for them: `nohup` has SIGHUP ignored."""


@contextlib.contextmanager
def signals(again: Callable[[], None] = lambda: None) -> Iterator[list[int]]:
    """A list that gets the first of `ASKING` and `WARNING` that comes, and the second and later of `ASKING`.

    Those of `WARNING` may come more than once, or beside another one, and nobody is impatient then.

    Args:
        again: called in the signal's handler when a second or later one of `ASKING` comes.
    """
    caught: list[int] = []
    asked = False

    def handle(number: int, frame: Any) -> None:
        nonlocal asked
        insists, asked = number in ASKING and asked, asked or number in ASKING
        if insists or not caught:
            caught.append(number)
        if insists:
            again()

    if threading.current_thread() is not threading.main_thread():  # which has the signals
        yield caught
        return
    free = [number for number in WARNING if signal.getsignal(number) is signal.SIG_DFL]
    old = {number: signal.signal(number, handle) for number in (*ASKING, *free)}
    try:
        yield caught
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
