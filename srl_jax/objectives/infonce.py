"""Contrastive learning: which of the batch's observations belongs to this one?"""

import jax
import jax.numpy as jnp

from srl_jax.augment import make_view
from srl_jax.learning.update import ema
from srl_jax.objectives.networks import MLP, functions, masked_mean, unit
from srl_jax.specs import check_choice, check_size
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.window import only

SIMILARITIES = ("bilinear", "cosine")


def info_nce(logits: Array, valid: Array) -> jax.Array:
    """The cross-entropy of row i with column i: float32 [B, B], [B] -> float32 [B], in nats.

    Rows that are not valid give 0. Van den Oord et al. (2018), equation 4 (thesis, equation 3.1).
    """
    return -valid * jnp.diagonal(jax.nn.log_softmax(logits, -1))


def infonce(
    context: Context,
    *,
    weight: float = 1.0,
    temporal: int = 0,
    hidden: int = 256,
    outputs: int = 128,
    similarity: str = "bilinear",
    temperature: float = 1.0,
    view: str = "crop_pad_crop",
    tau: float = 0.999,
) -> Objective:
    """Tells an observation's second view from those of the rest of the batch.

    With `temporal=0` both views are of s_t, CURL (Laskin et al. 2020, section 4); with `temporal=k` the
    second is of s_{t+k}, ATC (Stooke et al. 2021, section 3). The second comes from slow copies of encoder
    and projection. The gradient flows into projection and similarity, and through the first view's latent
    into the encoder.

    Args:
        temporal: how many steps the second view lies ahead; rows whose episode ended before are left out.
        hidden: width of the projection's hidden layer, LayerNorm before its ReLU; 0 for a linear one.
        outputs: size of a projection.
        similarity: "bilinear", `p W p'` with a W that starts as the identity, or "cosine".
        temperature: what similarities are divided by.
        view: see `srl_jax.augment.make_view`.
        tau: of the slow copies, see `srl_jax.learning.update.ema`.
    """
    check_size("temporal", temporal, least=0)
    check_size("hidden", hidden, least=0)
    check_size("outputs", outputs)
    check_choice("similarity", similarity, SIMILARITIES)
    if temperature <= 0:
        raise ValueError("temperature must be above 0")
    draw = make_view(view)
    init_project, project = functions(MLP(hidden, outputs, layer_norm=True), context.features)

    def init(key: jax.Array) -> Params:
        head = {"projection": init_project(key)}
        return head | ({"bilinear": jnp.eye(outputs, dtype=jnp.float32)} if similarity == "bilinear" else {})

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        first, second = jax.random.split(key)
        anchor = project(head["projection"], latents.of(draw(only(window, 0), first)).online(0))
        positive = project(slow_head["projection"], latents.of(draw(only(window, temporal), second)).slow(0))
        positive = jax.lax.stop_gradient(positive)
        if similarity == "bilinear":
            logits = anchor @ head["bilinear"] @ positive.T
        else:
            logits = unit(anchor) @ unit(positive).T
        valid = window.valid[:, temporal - 1] if temporal else jnp.ones(len(anchor), jnp.float32)
        logits = jnp.where(valid > 0, logits / temperature, -1e9)
        found = (jnp.argmax(logits, -1) == jnp.arange(len(anchor))).astype(jnp.float32)
        metrics = {"accuracy": masked_mean(found, valid)}
        return info_nce(logits, valid), jax.lax.stop_gradient(metrics)

    return Objective(init, loss, weight, horizon=temporal, slow=ema(tau), own_views=True)
