"""A training run that kills itself: `python -m tests.soak.victim N --out=RUN FLAGS...`.

It is `experiments.train` with the given flags. It says "begun" on stdout at its first operation on a file
below RUN. N is the number of the operation at which it kills itself; or "", and it leaves in RUN.operations
how many there were.
"""

import os
import signal
import sys
from pathlib import Path

from experiments import train
from experiments.command_line import flags as config_flags
from tests.in_process import parse
from tests.soak.faults import Faults


def main(arguments: list[str]) -> int:
    number, *rest = arguments
    values = parse(train, *rest)

    from srl_jax import replay

    replay.CHUNK_BYTES = 1 << 20  # so that there are several in a small buffer
    run = Path(values["out"].value)

    def die(name: str) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with Faults(run, int(number) if number else None, die, lambda: print("begun", flush=True)) as faults:
        status = train.train(values)
    Path(f"{run}.operations").write_text(str(faults.number), encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(config_flags.guarded(main)(sys.argv[1:]))
