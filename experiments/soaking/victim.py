"""A training run that is meant to be killed: `python -m experiments.soaking.victim DIGEST FAULT FLAGS...`.

It is `experiments.train` with the given flags, and says "begun" on stdout when training begins. When the run
ends it writes DIGEST, a JSON object of sums of everything that the run is. FAULT is a point of writing
checkpoints at which it kills itself, "NAME#n" for the n-th time that it comes there, or "": see `POINTS`. It
leaves the name in DIGEST.fault.
"""

import hashlib
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from .. import flags as config_flags
from .. import train


def digest(run: Any) -> dict[str, str]:
    """Sums of parameters, slow copies, optimizer, keys, and of all that the seeds have on the host."""
    import jax

    def of(array: Any) -> str:
        return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()

    sums = {"counts": json.dumps([run.env_steps, run.updates])}
    for i, (seed, state) in enumerate(run.each(run.state)):
        state = state._replace(key=jax.random.key_data(state.key))
        leaves = jax.tree_util.tree_leaves_with_path(state)
        sums |= {f"seed {i} state{jax.tree_util.keystr(k)}": of(x) for k, x in leaves}
        for name, (snapshot, _) in seed.parts(run.env_steps).items():
            if name != "report":  # whose rows are compared
                arrays, numbers = snapshot()
                sums |= {f"seed {i} {name} {key}": of(x) for key, x in arrays.items()}
                sums[f"seed {i} {name}"] = json.dumps(numbers)
    return sums


_CALLS, _KINDS = ("os.replace", "os.fsync", "os.link", "rmtree"), ("npy", "msgpack", "json")
POINTS = (
    *(f"{when} {call}" for call in _CALLS for when in ("before", "after")),
    *(f"{when} a file ({kind})" for kind in _KINDS for when in ("before", "within", "after")),
    "after a file (sha256)",
)
"""Where a process that writes checkpoints may be killed."""


class Faults:
    """Kills the process when it comes to a point for the n-th time.

    Args:
        at: "NAME#n", n from 0.
        fault: called there with the point's name.
    """

    def __init__(self, at: str, fault: Callable[[str], None]):
        self._name, number = at.split("#")
        self._left, self._fault = int(number), fault

    def point(self, name: str) -> None:
        """The process is there."""
        if name == self._name:
            if self._left == 0:
                self._fault(name)
            self._left -= 1

    def install(self) -> None:
        """Puts points around what `srl_jax.checkpoint` calls, in this process, for good."""
        from srl_jax import checkpoint

        for name in ("fsync", "replace", "link"):
            setattr(os, name, self._around(f"os.{name}", getattr(os, name)))
        checkpoint.shutil.rmtree = self._around("rmtree", checkpoint.shutil.rmtree)
        checkpoint.write = self._writing(checkpoint.write)

    def _around(self, name: str, function: Callable) -> Callable:
        def call(*arguments, **options):
            self.point(f"before {name}")
            result = function(*arguments, **options)
            self.point(f"after {name}")
            return result

        return call

    def _writing(self, function: Callable) -> Callable:
        def write(path: Path, *pieces):
            kind = path.suffix.removeprefix(".")
            self.point(f"before a file ({kind})")
            data = b"".join(pieces)
            path.write_bytes(data[: len(data) // 2])
            self.point(f"within a file ({kind})")
            entry = function(path, *pieces)
            self.point(f"after a file ({kind})")
            return entry

        return write


def main(arguments: list[str]) -> int:
    """Trains; see the module."""
    path, fault, *rest = arguments
    values = flags.FlagValues()
    train.define_flags(values)
    config_flags.parse(["train", *rest], values)

    from srl_jax import loop, replay

    replay.CHUNK_BYTES = 1 << 20  # so that there are several in a small buffer

    class Victim(loop.Run):
        def run(self) -> bool:
            print("begun", flush=True)
            return super().run()

        def finish(self) -> None:
            # First: a run that is killed after its last checkpoint has ended, and does not come here again.
            Path(path).write_text(json.dumps(digest(self)), encoding="utf-8")
            super().finish()

    def die(name: str) -> None:
        Path(f"{path}.fault").write_text(name, encoding="utf-8")
        os.kill(os.getpid(), signal.SIGKILL)

    loop.Run = Victim
    if fault:
        Faults(fault, die).install()
    return train.train(values)


if __name__ == "__main__":
    sys.exit(config_flags.guarded(main)(sys.argv[1:]))
