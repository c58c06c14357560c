"""Self-prediction: the latents of the next steps from the latent and the actions, without pixels."""

from collections.abc import Callable
from typing import TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.learning.update import ema, periodic
from srl_jax.objectives.networks import DISTANCES, MLP, functions, join, one_hot
from srl_jax.specs import check_choice, check_size, needs
from srl_jax.types import Array, Context, Latents, Objective, Params, Window

Rule: TypeAlias = Callable[[Params, Params, Array], Params]
TARGETS = ("slow", "periodic", "stopped", "gradient")


class LatentDynamics(nn.Module):
    """A latent and a one-hot action -> the next latent: float32 [B, D], [B, A] -> [B, D].

    Attributes:
        hidden: width of its hidden layer; 0 makes it linear.
        residual: whether it predicts the change of the latent.
    """

    hidden: int
    residual: bool

    @nn.compact
    def __call__(self, z: Array, action: Array) -> Array:
        step = MLP(self.hidden, z.shape[-1])(join(z, action))
        return z + step if self.residual else step


@needs(tau="target=slow,target_encoder=slow", every="target=periodic,target_encoder=slow")
def forward_latent(
    context: Context,
    *,
    weight: float = 1.0,
    steps: int = 1,
    hidden: int = 512,
    residual: bool = False,
    distance: str = "squared",
    target: str = "slow",
    tau: float = 0.99,
    every: int = 250,
) -> Objective:
    """Predicts z_{t+1}, ..., z_{t+steps} from z_t and the actions (thesis, sections 3.2.2 and 7.3).

    The dynamics are unrolled in the latent, and the loss is the mean over the steps of the distance to the
    target; steps behind the end of an episode count 0. The gradient flows through z_t and, with
    `target=gradient` alone, through the targets.

    Args:
        steps: how many latents are predicted.
        hidden: width of the dynamics' hidden layer; 0 for linear dynamics (Tang et al. 2023, equation 3).
        residual: whether the dynamics predict the change.
        distance: "squared", a mean over D, or "cosine", `2 - 2 cos`.
        target: "slow", the latents of a slow copy of the encoder (Ni et al. 2024, section 4); "periodic",
            likewise, but a copy that is replaced in every k-th update (Fujimoto et al. 2025, MR.Q, algorithm
            1); "stopped", the online encoder's, without gradient; "gradient", the online encoder's with
            gradient, whose least loss is where all latents are the same: it is there to show that they
            collapse.
        tau: of the slow copy, see `srl_jax.learning.update.ema`.
        every: k of the periodic one, in updates.
    """
    check_size("steps", steps)
    check_size("hidden", hidden, least=0)
    check_choice("distance", distance, DISTANCES)
    check_size("every", every)
    check_choice("target", target, TARGETS)
    rules: dict[str, Rule] = {"slow": ema(tau), "periodic": periodic(every)}
    rule = rules.get(target)
    init, apply = functions(LatentDynamics(hidden, residual), context.features, context.num_actions)
    between = jax.vmap(DISTANCES[distance])

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        ahead = [k + 1 for k in range(steps)]
        targets = latents.online(ahead) if target == "gradient" else latents.slow(ahead)
        z = latents.online(0)
        losses: Array = jnp.zeros(len(z), jnp.float32)
        for k in range(steps):
            z = apply(head, z, one_hot(window.actions[:, k], context.num_actions))
            losses += window.valid[:, k] * between(z, targets[k])
        return losses / steps, {}

    return Objective(init, loss, weight, horizon=steps, slow=rule)
