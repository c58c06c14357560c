"""`import srl_jax.losses` gives `srl_jax.rl.losses`, as the attribute of that name does."""

import sys

from srl_jax.rl import losses
from srl_jax.rl.losses import *  # noqa: F403  what a type checker sees

sys.modules[__name__] = losses
