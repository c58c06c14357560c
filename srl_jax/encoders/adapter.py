"""An `Encoder` of any flax module."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import functions
from srl_jax.types import Decoder, Encoder


def flax_encoder(
    network: nn.Module,
    decoder_network: nn.Module | None,
    shape: tuple[int, int, int],
    *,
    map_shape: tuple[int, int, int] | None = None,
    noisy: bool = False,
) -> Encoder:
    """An `Encoder` whose functions are a flax module's, and a decoder that is another one's.

    Args:
        network: observations [B, H, W, S * C], uint8 in 0..255 or float32 in [0, 1], -> float32 [B, D]. It
            divides bytes by 255 itself. All its variables are parameters: there are no running statistics.
        decoder_network: float32 [B, D + extra inputs] -> [B, H, W, S * C], or None: the encoder then serves
            all objectives but those that decode. The extra inputs are the last.
        shape: (H, W, S * C).
        map_shape: see `Encoder.map_shape`.
        noisy: whether the network takes a key behind the observations and then adds noise: `Encoder.train`.

    Raises:
        ValueError: the network's output is not [B, D], or it has other variables than parameters. Of the
            decoder's, when one is made.
    """
    image = jax.ShapeDtypeStruct((1, *shape), jnp.float32)
    latent = _checked(network, image)
    if len(latent.shape) != 2:
        raise ValueError(f"{_name(network)} must give latents [B, D], not {_text(latent.shape)}")
    features = latent.shape[1]

    def make_decoder(extra_inputs: int = 0) -> Decoder:
        if decoder_network is None:
            raise ValueError(f"the encoder {_name(network)} has no decoder, which this objective needs")
        z = jax.ShapeDtypeStruct((1, features + extra_inputs), jnp.float32)
        output = _checked(decoder_network, z)
        if output.shape != image.shape:
            wanted, given = _text(image.shape), _text(output.shape)
            raise ValueError(f"{_name(decoder_network)} must give images {wanted}, not {given}")
        return Decoder(*functions(decoder_network, z.shape))

    init, apply = functions(network, image.shape)
    encoder = Encoder(init, apply, features, tuple(shape), make_decoder, map_shape)
    return encoder._replace(train=apply) if noisy else encoder


def _checked(network: nn.Module, example: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """What the network gives for an input; compiles nothing, and takes no memory."""
    output, variables = jax.eval_shape(network.init_with_output, jax.random.key(0), example)
    if others := variables.keys() - {"params"}:
        raise ValueError(
            f"{_name(network)} has variables that are no parameters: {', '.join(sorted(others))}"
        )
    return output


def _name(network: nn.Module) -> str:
    return type(network).__name__


def _text(shape: tuple) -> str:
    return f"[{', '.join(map(str, ('B', *shape[1:])))}]"
