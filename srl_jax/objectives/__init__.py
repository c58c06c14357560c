"""The representation objectives: `REGISTRY[name](context, **options) -> Objective`; a file and a row each.

`register` adds one of your own, see `srl_jax.plugins`.
"""

from srl_jax.objectives.forward_pixels import forward_pixels
from srl_jax.objectives.inverse import inverse
from srl_jax.objectives.latent_l2 import latent_l2
from srl_jax.objectives.reconstruction import reconstruction
from srl_jax.plugins import Registry

REGISTRY = Registry(
    "objectives",
    {
        "reconstruction": reconstruction,
        "forward_pixels": forward_pixels,
        "latent_l2": latent_l2,
        "inverse": inverse,
    },
)
register = REGISTRY.register
