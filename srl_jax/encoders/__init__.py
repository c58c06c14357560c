"""The encoders: `REGISTRY[name](observation_shape, **options) -> Encoder`, a row each.

`observation_shape` is (H, W, S * C), of any size from the least that the layers fit. Each comes with the
decoder that mirrors it, and all have the options `init`, `zero_sum`, `gain` and `decoder_scale`: see
`srl_jax.encoders.convolutional.Start`. `flax_encoder` makes an encoder of any flax module.
`from_npz` loads one that `srl-jax export` has written.
"""

from srl_jax.encoders.adapter import flax_encoder
from srl_jax.encoders.convolutional import Layer, Start, convolutional_encoder, starting
from srl_jax.encoders.files import from_npz, to_npz
from srl_jax.encoders.impala import impala
from srl_jax.plugins import Registry
from srl_jax.specs import check_size
from srl_jax.types import Encoder

__all__ = ["REGISTRY", "register", "flax_encoder", "from_npz", "impala", "nature", "sac_ae", "tiny", "to_npz"]


@starting
def nature(observation_shape: tuple[int, int, int], start: Start) -> Encoder:
    """The encoder of Mnih et al. (2015): no bottleneck, 3,136 features at 84 x 84.

    Its decoder ends in a sigmoid, as in the thesis' code.
    """
    layers = [Layer(32, 8, 4), Layer(64, 4, 2), Layer(64, 3, 1)]
    return convolutional_encoder(observation_shape, layers, start, sigmoid=True)


@starting
def sac_ae(
    observation_shape: tuple[int, int, int], start: Start, *, features: int = 256, layer_norm: bool = True
) -> Encoder:
    """The thesis' larger encoder, after SAC-AE (Yarats et al. 2021, appendix B.2).

    Args:
        features: size of the bottleneck; the thesis has 50 and 256.
        layer_norm: LayerNorm before the tanh (in the thesis' code, not in its text).

    Raises:
        ValueError: where features is out of range or the frames are too small.
    """
    check_size("features", features)
    layers = [Layer(32, 3, 2), Layer(32, 3, 1), Layer(32, 3, 1), Layer(32, 3, 1)]
    return convolutional_encoder(observation_shape, layers, start, features=features, layer_norm=layer_norm)


@starting
def tiny(observation_shape: tuple[int, int, int], start: Start, *, features: int = 64) -> Encoder:
    """A small encoder for tests and for Catch: two convolutions and a bottleneck.

    Args:
        features: size of the bottleneck; 0 leaves it out, as `nature` does.

    Raises:
        ValueError: where features is out of range or the frames are too small.
    """
    check_size("features", features, least=0)
    layers = [Layer(16, 6, 4), Layer(16, 4, 2)]
    return convolutional_encoder(observation_shape, layers, start, features=features)


REGISTRY = Registry("encoders", {"nature": nature, "sac_ae": sac_ae, "tiny": tiny, "impala": impala})
register = REGISTRY.register
