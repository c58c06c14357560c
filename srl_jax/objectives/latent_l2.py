"""L2 regularisation of the latent: towards 0, or towards where a slow encoder has it."""

import jax
import jax.numpy as jnp

from srl_jax.learning.update import ema
from srl_jax.specs import check_choice, needs
from srl_jax.types import Array, Context, Latents, Objective, Window

TARGETS = ("zero", "slow")


def half_squared_norm(z: Array) -> jax.Array:
    """`0.5 * sum(z ** 2)` of one latent: float32 [D] -> float32 []. A sum over D, as in SAC-AE."""
    return 0.5 * jnp.sum(z**2)


def l2_norm(z: Array) -> jax.Array:
    """`sqrt(sum(z ** 2))` of one latent: float32 [D] -> float32 []; its gradient at 0 is 0."""
    square = jnp.sum(z**2)
    zero = square == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


NORMS = {"half_squared": half_squared_norm, "l2": l2_norm}


@needs(target="a target apart", tau="target=slow,target_encoder=slow")
def latent_l2(
    context: Context,
    *,
    weight: float = 1e-6,
    norm: str = "half_squared",
    target: str = "zero",
    tau: float = 0.99,
) -> Objective:
    """Pulls z_t towards a target (thesis, section 5.4; Ghosh et al. 2020, section 3).

    It has no parameters of its own. The gradient flows into the encoder.

    Args:
        norm: "half_squared", half the squared length of what separates them, or "l2", its length.
        target: "zero", or "slow", the latent of a slow copy of the encoder: against its drift (thesis,
            section 6.4).
        tau: of the slow copy, see `srl_jax.learning.update.ema`.
    """
    check_choice("norm", norm, NORMS)
    check_choice("target", target, TARGETS)

    def loss(head, slow_head, latents: Latents, window: Window, key):
        z = latents.online(0)
        if target == "slow":
            z = z - latents.slow(0)
        return jax.vmap(NORMS[norm])(z), {}

    return Objective(lambda key: {}, loss, weight, slow=ema(tau) if target == "slow" else None)
