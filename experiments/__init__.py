"""What one types: training, evaluation, sweeps, figures, reports. `cli.py` has the table of commands.

The folder is the package `experiments` in a checkout and `srl_jax.experiments` where it is installed, so it
imports itself by relative names alone.
"""

PACKAGE = __name__
"""As which it was imported; processes are started with the same one."""
