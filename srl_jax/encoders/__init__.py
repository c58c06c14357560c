"""The encoders: `REGISTRY[name](observation_shape, **options) -> Encoder`, a row each.

`observation_shape` is (H, W, S * C), of any size from the least that the layers fit. A ValueError says that
it is smaller, or that an option is out of range. Each row comes with the decoder that mirrors it, and all
have the option `features` and those of `srl_jax.encoders.options.Start` and `End`. `flax_encoder` makes an
encoder of any flax module. `from_npz` loads one that `srl-jax export` has written.
"""

from srl_jax.encoders.adapter import flax_encoder
from srl_jax.encoders.convolutional import Layer, convolutional_encoder
from srl_jax.encoders.files import from_npz, to_npz
from srl_jax.encoders.impala import impala
from srl_jax.encoders.lix import MOST, Mixing
from srl_jax.encoders.options import End, Start, with_options
from srl_jax.plugins import Registry
from srl_jax.specs import needs
from srl_jax.types import Encoder

__all__ = [
    "REGISTRY", "register", "flax_encoder", "from_npz", "to_npz",
    "a_lix", "der", "impala", "mrq", "nature", "sac_ae", "tiny",
]  # fmt: skip


@with_options
def nature(
    observation_shape: tuple[int, int, int],
    start: Start,
    end: End,
    *,
    features: int = 0,
    padding: str = "valid",
) -> Encoder:
    """The encoder of Mnih et al. (2015): no bottleneck, 3,136 features at 84 x 84.

    Its decoder ends in a sigmoid, as in the thesis' code.

    Args:
        features: size of a linear layer; 0 for none.
        padding: "valid"; or "same", zeros around every layer's input, 7,744 features at 84 x 84: what
            Dopamine's JAX agents and those built on it run, flax's default.
    """
    layers = [Layer(32, 8, 4), Layer(64, 4, 2), Layer(64, 3, 1)]
    return convolutional_encoder(
        observation_shape, layers, start, end, features=features, sigmoid=True, padding=padding
    )


@with_options
def der(observation_shape: tuple[int, int, int], start: Start, end: End, *, features: int = 0) -> Encoder:
    """The encoder of data-efficient Rainbow (van Hasselt et al. 2019, appendix E): 576 features at 84 x 84.

    As published it has no padding, and at 84 x 84 it does not see the last 9 rows and columns. Sizes of which
    it would see less have zeros below and on the right. Its decoder is linear at the end; the paper has none.

    Args:
        features: size of a linear layer; 0 for none.
    """
    layers = [Layer(32, 5, 5), Layer(64, 5, 5)]
    return convolutional_encoder(observation_shape, layers, start, end, features=features, least_seen=75 / 84)


LIX_GOAL = 0.75
"""The discontinuity of gradients that the paper's table 7 asks for."""


@with_options
@needs(lix_goal="lix!=0")
def a_lix(
    observation_shape: tuple[int, int, int],
    start: Start,
    end: End,
    *,
    features: int = 50,
    lix: float = 0.0,
    lix_goal: float = LIX_GOAL,
) -> Encoder:
    """The encoder of A-LIX on Atari (Cetin et al. 2022, table 7).

    In updates its LIX layers mix neighbouring pixels of the maps, see `srl_jax.encoders.lix`. The authors
    have not published their Atari code; in their code for control LayerNorm and tanh follow the linear layer,
    as `end=layer_norm_tanh` does.

    Args:
        features: size of the linear layer; 0 leaves it out.
        lix: the radius S, in pixels of the maps, that mixing starts with, 1 in the paper; 0 leaves the LIX
            layers out.
        lix_goal: the discontinuity of the gradient that S is tuned to; 0 lets S stay as it is.
    """
    if lix > MOST:
        raise ValueError(f"lix must be at most {MOST:g}")
    layers = [Layer(32, 3, 2), Layer(32, 3, 1), Layer(32, 3, 1)]
    mixing = Mixing(lix, lix_goal) if lix else None
    return convolutional_encoder(observation_shape, layers, start, end, features=features, lix=mixing)


@with_options
def mrq(observation_shape: tuple[int, int, int], start: Start, end: End, *, features: int = 512) -> Encoder:
    """The encoder of MR.Q (Fujimoto et al. 2025, appendix B): four layers with ELU.

    At 84 x 84 it sees all but the last 5 rows and columns. Its decoder has ELU, too, and is linear at the
    end; the paper has none.

    Args:
        features: size of the linear layer, behind which the default end is LayerNorm and ELU; 0 leaves it
            out. The authors' LayerNorm has no scale and no bias to learn.
    """
    layers = [Layer(32, 3, 2), Layer(32, 3, 2), Layer(32, 3, 2), Layer(32, 3, 1)]
    return convolutional_encoder(
        observation_shape, layers, start, end, features=features, own_end="layer_norm_elu", activation="elu",
        least_seen=79 / 84,
    )  # fmt: skip


@with_options
@needs(layer_norm="features!=0,end=default")
def sac_ae(
    observation_shape: tuple[int, int, int],
    start: Start,
    end: End,
    *,
    features: int = 256,
    layer_norm: bool = True,
) -> Encoder:
    """The thesis' larger encoder, after SAC-AE (Yarats et al. 2021, appendix B.2).

    Args:
        features: size of the bottleneck; the thesis has 50 and 256. 0 leaves it out.
        layer_norm: LayerNorm before the tanh of the default end (in the thesis' code, not in its text).
    """
    layers = [Layer(32, 3, 2), Layer(32, 3, 1), Layer(32, 3, 1), Layer(32, 3, 1)]
    own_end = "layer_norm_tanh" if layer_norm else "tanh"
    return convolutional_encoder(observation_shape, layers, start, end, features=features, own_end=own_end)


@with_options
def tiny(observation_shape: tuple[int, int, int], start: Start, end: End, *, features: int = 64) -> Encoder:
    """A small encoder for tests and for Catch: two convolutions and a bottleneck.

    Args:
        features: size of the bottleneck, behind which the default end is LayerNorm and tanh; 0 leaves it out,
            as `nature` does.
    """
    layers = [Layer(16, 6, 4), Layer(16, 4, 2)]
    own_end = "layer_norm_tanh"
    return convolutional_encoder(observation_shape, layers, start, end, features=features, own_end=own_end)


REGISTRY = Registry(
    "encoders",
    {
        "nature": nature,
        "der": der,
        "a_lix": a_lix,
        "sac_ae": sac_ae,
        "tiny": tiny,
        "impala": impala,
        "mrq": mrq,
    },
)
register = REGISTRY.register
