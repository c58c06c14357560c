"""A side of the comparison in a process of its own, and what it is asked.

A side is a class: `side(**arguments)` builds it and warms it up, its methods take and give plain values and
numpy arrays. Requests and replies are pickles in the worker's standard input and output. Standard library
only: either end may run where the other's packages are missing.
"""

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


class WorkerError(RuntimeError):
    """A worker that failed; one line."""


class Worker:
    """A process that runs `serve`; a context manager, which ends it.

    Args:
        python: its interpreter.
        side: MODULE.CLASS of this package.
        arguments: the class'; what JSON can hold.
        env: variables added to this process' own.

    Raises:
        WorkerError: the interpreter cannot be started.
    """

    def __init__(self, python: str, side: str, arguments: Mapping[str, Any], env: Mapping[str, str]):
        self._side = side
        module, name = side.split(".")
        command = [python, "-m", f"{__package__}.{module}", name, json.dumps(arguments)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        try:
            self._process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **env}, **pipes)
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


def arguments() -> dict[str, Any]:
    """The side's arguments, in a worker."""
    return json.loads(sys.argv[2])


def serve(*sides: type) -> None:
    """Builds the side that the command line names when asked to "build", and answers until nobody asks.

    What is printed meanwhile goes to standard error. An exception becomes the reply, as "Type: message".
    """
    with os.fdopen(os.dup(1), "wb") as replies:
        os.dup2(2, 1)
        side = None
        while True:
            try:
                method, values = pickle.load(sys.stdin.buffer)
            except EOFError:
                return
            try:
                if method == "build":
                    side = next(one for one in sides if one.__name__ == sys.argv[1])(**arguments())
                reply = None if method == "build" else getattr(side, method)(**values), None
            except Exception as error:
                traceback.print_exc()
                reply = None, f"{type(error).__name__}: {' '.join(str(error).split())}"
            pickle.dump(reply, replies)
            replies.flush()
