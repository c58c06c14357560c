"""Self-predictive representations: SPR (Schwarzer et al. 2021)."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import Conv, Dense, min_max
from srl_jax.objectives.networks import cosine_distance, functions, one_hot
from srl_jax.specs import check_choice, check_size
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.update import ema

TARGETS = ("slow", "stopped")


class Transition(nn.Module):
    """SPR's transition model: a map and an action -> the next map, float32 [B, D], [B, A] -> [B, D].

    Two convolutions, the action as planes beside the map; its output is renormalised as its input is.

    Attributes:
        shape: (H', W', C') of the map, H' W' C' = D. A latent behind a bottleneck is a map of one pixel.
    """

    shape: tuple[int, ...]

    @nn.compact
    def __call__(self, z: Array, action: Array) -> Array:
        height, width, channels = self.shape
        side = 3 if max(height, width) > 1 else 1
        planes = jnp.broadcast_to(action[:, None, None], (z.shape[0], height, width, action.shape[-1]))
        x = jnp.concatenate([z.reshape(-1, *self.shape), planes], -1)
        x = nn.relu(Conv(channels, side, 1, padding="SAME", name="first")(x))
        x = Conv(channels, side, 1, padding="SAME", name="second")(x)
        return min_max(x.reshape(z.shape))


def spr(
    context: Context,
    *,
    weight: float = 5.0,
    steps: int = 5,
    hidden: int = 512,
    target: str = "slow",
    tau: float = 0.99,
    mask: bool = True,
    importance: bool = False,
) -> Objective:
    """Predicts projections of the next `steps` latents (Schwarzer et al. 2021, section 2; figure 2).

    The loss of a row is the mean over the steps of `2 - 2 cos(q(p(z^_{t+k})), p(z~_{t+k}))`, where z^ comes
    from z_t by the transition model, z~ from the target encoder, p projects and q predicts; latents are
    renormalised into [0, 1]. The paper's lambda = 2 on a sum of five negative cosines is a weight of 5 here.
    The gradient flows into transition, projection and predictor, and through z_t into the encoder.

    Args:
        steps: K.
        hidden: outputs of projection and predictor.
        target: "slow", slow copies of encoder and projection (the paper's arm without augmentation);
            "stopped", the online ones without gradient (its arm with augmentation).
        tau: of the slow copies, see `srl_jax.update.ema`.
        mask: whether steps behind the end of an episode count 0, as in the authors' code.
        importance: whether the loss is multiplied by replay's importance weights, as in the authors' code.

    Raises:
        ValueError: where an option is out of range.
    """
    check_size("steps", steps)
    check_size("hidden", hidden)
    check_choice("target", target, TARGETS)
    features = context.features
    shape = context.map_shape or ()
    if math.prod(shape) != features or len(shape) != 3:
        shape = (1, 1, features)
    init_transition, transition = functions(Transition(tuple(shape)), features, context.num_actions)
    init_project, project = functions(Dense(hidden), features)
    init_predict, predict = functions(Dense(hidden), hidden)

    def init(key: jax.Array) -> Params:
        keys = jax.random.split(key, 3)
        return {
            "transition": init_transition(keys[0]),
            "projection": init_project(keys[1]),
            "predictor": init_predict(keys[2]),
        }

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        ahead = [k + 1 for k in range(steps)]
        behind = (latents.slow(ahead), slow_head) if target == "slow" else (latents.online(ahead), head)
        targets, below = jax.lax.stop_gradient(behind)
        z: Array = min_max(latents.online(0))
        losses: Array = jnp.zeros(len(z), jnp.float32)
        for k in range(steps):
            z = transition(head["transition"], z, one_hot(window.actions[:, k], context.num_actions))
            prediction = predict(head["predictor"], project(head["projection"], z))
            wanted = project(below["projection"], min_max(targets[k]))
            counts = window.valid[:, k] if mask else 1.0
            losses += counts * jax.vmap(cosine_distance)(prediction, wanted)
        return losses / steps * (window.weight if importance else 1.0), {}

    return Objective(init, loss, weight, horizon=steps, slow=ema(tau) if target == "slow" else None)
