"""The representation objectives: `REGISTRY[name](context, **options) -> Objective`; a row each.

Each raises a ValueError where an option is out of range. `register` adds one of your own, see
`srl_jax.plugins`.
"""

from srl_jax.learning.optim import ENCODER, ENCODER_SRL, RL, RL_SRL
from srl_jax.objectives.bisimulation import bisimulation
from srl_jax.objectives.forward_latent import forward_latent
from srl_jax.objectives.forward_pixels import forward_pixels
from srl_jax.objectives.infonce import infonce
from srl_jax.objectives.inverse import inverse
from srl_jax.objectives.latent_l2 import latent_l2
from srl_jax.objectives.reconstruction import reconstruction
from srl_jax.objectives.reward import reward, terminal
from srl_jax.objectives.slowness import slowness
from srl_jax.objectives.spr import spr
from srl_jax.objectives.two_views import barlow, byol, vicreg
from srl_jax.objectives.vae import vae
from srl_jax.plugins import Registry

REGISTRY = Registry(
    "objectives",
    {
        "reconstruction": reconstruction,
        "forward_pixels": forward_pixels,
        "vae": vae,
        "forward_latent": forward_latent,
        "spr": spr,
        "byol": byol,
        "vicreg": vicreg,
        "barlow": barlow,
        "infonce": infonce,
        "slowness": slowness,
        "inverse": inverse,
        "reward": reward,
        "terminal": terminal,
        "bisimulation": bisimulation,
        "latent_l2": latent_l2,
    },
    reserved=("none", "total", RL, ENCODER, ENCODER_SRL, RL_SRL),
)
register = REGISTRY.register
