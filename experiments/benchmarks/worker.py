"""A side of the comparison in a process of its own, and what it is asked.

A side is a class of one of the modules `*_side`: `Side(**arguments)` builds it and warms it up, its methods
take and give plain values and numpy arrays. Requests and replies are pickles in the worker's standard input
and output. Standard library only: either end may run where the other's packages are missing.
"""

import importlib
import json
import os
import pickle
import subprocess
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
"""The repository's root, where workers start."""

TUNED = (".jax_side", ".host_side")
"""Modules that run in the environment that a run of their preset gives itself."""


class WorkerError(RuntimeError):
    """A worker that failed; one line."""


class Worker:
    """A process that answers; a context manager, which ends it.

    Args:
        side: MODULE.CLASS, `.jax_side.Updates`.
        arguments: the class'; what JSON can hold.
        python: another interpreter; None for this one, where jax is to compute on the CPU.

    Raises:
        WorkerError: the interpreter cannot be started.
    """

    def __init__(self, side: str, arguments: Mapping[str, Any], python: str | None = None):
        self._side = side
        command = [python or sys.executable, "-m", __name__, side, json.dumps(arguments)]
        env = os.environ if python else {**os.environ, "JAX_PLATFORMS": "cpu"}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        try:
            self._process = subprocess.Popen(command, cwd=ROOT, env=env, **pipes)
        except OSError as error:
            raise WorkerError(f"{python}: {error.strerror}") from None

    def ask(self, method: str, **values: Any) -> Any:
        """Calls a method of the side, and waits for what it returns; "build" comes first.

        Raises:
            WorkerError: the method failed, or the worker has ended.
        """
        try:
            pickle.dump((method, values), self._process.stdin)
            self._process.stdin.flush()
            reply, error = pickle.load(self._process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            raise WorkerError(f"{self._side}: ended without a reply to {method!r}; see above") from None
        if error:
            raise WorkerError(f"{self._side}: {method}: {error}")
        return reply

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.communicate()


def main(side: str, arguments: Mapping[str, Any]) -> None:
    """Answers requests until nobody asks any more.

    What is printed meanwhile goes to standard error. An exception becomes the reply, as "Type: message".
    """
    module, _, name = side.rpartition(".")
    if module in TUNED:
        from .. import presets
        from ..command_line import runtime

        runtime.prepare("auto", presets.PRESETS[arguments["preset"]]["encoder"])
    built = None
    with os.fdopen(os.dup(1), "wb") as replies:
        os.dup2(2, 1)
        while True:
            try:
                method, values = pickle.load(sys.stdin.buffer)
            except EOFError:
                return
            try:
                if method == "build":
                    built = getattr(importlib.import_module(module, __package__), name)(**arguments)
                    reply = None, None
                else:
                    reply = getattr(built, method)(**values), None
            except Exception as error:
                traceback.print_exc()
                reply = None, f"{type(error).__name__}: {' '.join(str(error).split())}"
            pickle.dump(reply, replies)
            replies.flush()


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
