"""`experiments.train` up to the end of its first update: says so on standard output, and leaves.

`python -m experiments.benchmarks.startup --preset=thesis/joint_256 --out=DIR`, with train's flags.
"""

import functools
import os

from .. import flags as config_flags
from .. import runtime, train

MARK = "first update done"
"""The line that is printed."""


def prepare(tune: str, encoder: str) -> None:
    """As `runtime.prepare`; the run that follows ends after its first update."""
    runtime.prepare(tune, encoder)
    from srl_jax.loop import Run

    update = Run.update

    def once(self) -> None:
        update(self)
        print(MARK, flush=True)
        os._exit(0)

    Run.update = once


if __name__ == "__main__":
    train.define_flags()
    config_flags.run(functools.partial(train.main, prepare=prepare))
