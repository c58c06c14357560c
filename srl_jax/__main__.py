"""The command line: `python -m srl_jax`, and the script `srl-jax`."""

import importlib
import importlib.util
from pathlib import Path


def main() -> None:
    """Runs a command of `experiments.command_line.cli`, which is installed as a part of srl_jax."""
    here = Path(__file__).resolve().parent
    spec = importlib.util.find_spec("srl_jax.experiments")
    installed = spec.origin if spec else None
    # Where a checkout is run that is not the one that is installed, its own commands are meant.
    ours = installed and Path(installed).resolve().parents[1] in (here, here.parent)
    importlib.import_module(f"{'srl_jax.' if ours else ''}experiments.command_line.cli").main()


if __name__ == "__main__":
    main()
