"""Both ends of a line protocol, so that programs of different environments can be timed from one.

A request is one line of JSON, `{"do": NAME, ...}`, on the worker's standard input; the reply is one line of
JSON on its standard output. Standard library only: either end may run where the other's packages are missing.
"""

import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
"""The repository's root, where workers start."""

CLOSE_SECONDS = 10.0
"""How long a worker may take to end once its input has, before it is killed."""


class WorkerError(RuntimeError):
    """A worker that replied with an error, or ended before its reply; one line."""


class Worker:
    """A subprocess that runs `serve`, and what may be asked of it. A context manager, which closes it."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str] | None = None):
        """Starts it, in the repository's root.

        Args:
            command: the program and its arguments.
            env: variables added to this process' own.

        Raises:
            WorkerError: the program cannot be started.
        """
        self._name = " ".join(" ".join(command).split())
        self._errors = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                cwd=ROOT,
                env={**os.environ, **(env or {})},
                encoding="utf-8",
            )
        except OSError as error:
            self._errors.close()
            raise WorkerError(f"{self._name}: {error.strerror}") from None

    def ask(self, do: str, **values: Any) -> dict[str, Any]:
        """Has one handler called, and waits for its reply.

        Args:
            do: the handler's name.
            **values: its arguments; what JSON can hold.

        Raises:
            WorkerError: the handler failed, or the worker has ended.
        """
        try:
            self._process.stdin.write(json.dumps({"do": do, **values}) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except OSError:
            line = ""
        if not line.endswith("\n"):
            raise WorkerError(f"{self._name}: ended without a reply to {do!r}: {self._last_error()}")
        reply = json.loads(line)
        if "error" in reply:
            raise WorkerError(f"{self._name}: {do}: {reply['error']}")
        return reply

    def close(self) -> None:
        """Ends the worker; once it has ended, does nothing."""
        if self._errors.closed:
            return
        try:
            self._process.stdin.close()
        except OSError:
            pass  # It has ended with a request unread.
        self._wait()
        self._process.stdout.close()
        self._errors.close()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _wait(self) -> None:
        """Waits for its end, which may be brought about."""
        try:
            self._process.wait(CLOSE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _last_error(self) -> str:
        """The last line of its standard error that is not blank."""
        self._wait()
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").split("\n")
        lines = [line.strip() for line in lines if line.strip()]
        return lines[-1] if lines else f"exit status {self._process.returncode}, nothing on standard error"


def serve(handlers: Mapping[str, Callable[..., dict[str, Any]]]) -> None:
    """Answers requests until the input ends: `handlers[do](**values)`, a dict that JSON can hold.

    The protocol takes standard output over; whatever else is printed goes to standard error, by this process
    or those that it starts. An exception becomes the reply `{"error": "Type: message"}`, its traceback goes
    to standard error, and the next request is waited for.
    """
    sys.stdout.flush()
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as replies:
        os.dup2(2, 1)
        for line in sys.stdin:
            replies.write(_reply(handlers, line) + "\n")
            replies.flush()


def _reply(handlers: Mapping[str, Callable[..., dict[str, Any]]], line: str) -> str:
    try:
        values = json.loads(line)
        do = values.pop("do")
        if do not in handlers:
            raise ValueError(f"no handler {do!r}; there are {', '.join(handlers)}")
        return json.dumps(handlers[do](**values))
    except Exception as error:
        traceback.print_exc()
        message = " ".join(str(error).split())
        return json.dumps({"error": f"{type(error).__name__}: {message}"})
