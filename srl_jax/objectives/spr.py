"""Self-predictive representations: SPR (Schwarzer et al. 2021)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import INITIALISERS, Conv, Dense, min_max
from srl_jax.learning.update import ema
from srl_jax.objectives.networks import cosine_distance, functions, one_hot
from srl_jax.specs import check_choice, check_size, needs
from srl_jax.types import Array, Context, Latents, Layer, Objective, Params, Window

TARGETS = ("slow", "stopped")
PROJECTIONS = ("own", "rl")
HIDDEN = 512
"""The paper's outputs of projection and predictor."""


class Transition(nn.Module):
    """SPR's transition model: a map and an action -> the next map, float32 [B, D], [B, A] -> [B, D].

    Two convolutions with a ReLU behind each, the action as planes beside the map; what comes out is
    renormalised as the latents are (the authors' code, `src/models.py`, which has BatchNorm, too).

    Attributes:
        shape: (H', W', C') of the map, H' W' C' = D. A latent behind a bottleneck is a map of one pixel.
        initial: how its layers start, a key of `srl_jax.layers.INITIALISERS`.
    """

    shape: tuple[int, ...]
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, z: Array, action: Array) -> Array:
        height, width, channels = self.shape
        side = 3 if max(height, width) > 1 else 1
        planes = jnp.broadcast_to(action[:, None, None], (z.shape[0], height, width, action.shape[-1]))
        x = jnp.concatenate([z.reshape(-1, *self.shape), planes], -1)
        x = nn.relu(Conv(channels, side, 1, self.initial, padding="SAME", name="first")(x))
        x = nn.relu(Conv(channels, side, 1, self.initial, padding="SAME", name="second")(x))
        return min_max(x.reshape(z.shape))


@needs(hidden="projection=own", tau="target=slow", importance="RL is trained,rl:prioritized=true,rl:alpha!=0")
def spr(
    context: Context,
    *,
    weight: float = 5.0,
    steps: int = 5,
    hidden: int = HIDDEN,
    projection: str = "own",
    target: str = "slow",
    tau: float = 0.99,
    mask: bool = True,
    importance: bool = False,
    init: str = "pytorch",
) -> Objective:
    """Predicts projections of the next `steps` latents (Schwarzer et al. 2021, section 2; figure 2).

    The loss of a row is the mean over the steps of `2 - 2 cos(q(p(z^_{t+k})), p(z~_{t+k}))`, where z^ comes
    from z_t by the transition model, z~ from the target encoder, p projects and q predicts; latents are
    renormalised into [0, 1]. The paper's lambda = 2 on a sum of five negative cosines is a weight of 5 here.
    The gradient flows into transition, projection and predictor, and through z_t into the encoder.

    Args:
        steps: K.
        hidden: outputs of projection and predictor; of `projection=own`.
        projection: "own", a linear layer; or "rl", the first layer of RL's head (of a dueling one both
            streams' layers side by side), as in the paper and in its authors' code: by the means of noisy
            weights and without ReLU, and the predictor has as many outputs. The gradient flows into that
            layer, wherever the mode and the gate let it into the encoder.
        target: "slow", slow copies of encoder and projection (the paper's arm without augmentation);
            "stopped", the online ones without gradient (its arm with augmentation).
        tau: of the slow copies, see `srl_jax.learning.update.ema`.
        mask: whether steps behind the end of an episode count 0; the authors' code leaves out the last
            observation of an episode, too, and takes a lost life for an end.
        importance: whether the loss is multiplied by replay's importance weights, as in the authors' code.
        init: how transition, predictor and an own projection start, a key of `srl_jax.layers.INITIALISERS`.

    Raises:
        ValueError: with `projection=rl`, where RL's head is not trained or has no such layer.
    """
    check_size("steps", steps)
    check_size("hidden", hidden)
    check_choice("projection", projection, PROJECTIONS)
    check_choice("target", target, TARGETS)
    check_choice("init", init, INITIALISERS)
    features = context.features
    shape = context.map_shape or (1, 1, features)
    init_transition, transition = functions(Transition(shape, init), features, context.num_actions)
    parts = {"transition": init_transition}
    if projection == "own":
        parts["projection"], project = functions(Dense(hidden, init), features)
        where, outputs, reads = "projection", hidden, {}
    else:
        where, outputs, part, project = _rl_layer(context)
        reads = {where: part}
    parts["predictor"], predict = functions(Dense(outputs, init), outputs)

    def drawn(key: jax.Array) -> Params:
        keys = jax.random.split(key, len(parts))
        return {name: draw(k) for (name, draw), k in zip(parts.items(), keys, strict=True)}

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        ahead = [k + 1 for k in range(steps)]
        below = jax.lax.stop_gradient(slow_head if target == "slow" else head)
        targets = latents.slow(ahead)
        predicted = [min_max(latents.online(0))]
        for k in range(steps):
            action = one_hot(window.actions[:, k], context.num_actions)
            predicted.append(transition(head["transition"], predicted[-1], action))
        # All steps at once, [K, B, D]: one product each.
        prediction = predict(head["predictor"], project(head[where], jnp.stack(predicted[1:])))
        wanted = project(below[where], min_max(targets))
        losses = jax.vmap(jax.vmap(cosine_distance))(prediction, wanted)
        if mask:
            losses *= window.valid[:, :steps].T
        return jnp.mean(losses, 0) * (window.weight if importance else 1.0), {}

    slow = ema(tau) if target == "slow" else None
    return Objective(drawn, loss, weight, horizon=steps, slow=slow, reads=reads)


def _rl_layer(context: Context) -> Layer:
    """The first layer of RL's head."""
    if context.rl_layer is None:
        raise ValueError(
            "projection=rl needs an RL head that is trained beside it and begins with a linear layer over "
            "the latent, as those of all rows but iqn do; give projection=own"
        )
    return context.rl_layer
