"""The options that every encoder has: how it starts, and how its last maps become a latent."""

import functools
import inspect
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from srl_jax.layers import INITIALISERS, MIN_RANGE, Dense, WideDense, min_max, sim_norm
from srl_jax.specs import check_choice, check_size
from srl_jax.types import Encoder

EPSILON = 1e-5
"""What LayerNorm adds to the variance."""

GROUP = 8
"""The numbers of a latent that `sim_norm` turns into shares of 1 (TD-MPC2's value)."""

ENDS = {
    "none": (),
    "relu": ("relu",),
    "tanh": ("tanh",),
    "elu": ("elu",),
    "layer_norm": ("layer_norm",),
    "layer_norm_tanh": ("layer_norm", "tanh"),
    "layer_norm_elu": ("layer_norm", "elu"),
    "min_max": ("min_max",),
    "sim_norm": ("sim_norm",),
}
"""{a value of the option `end`: the functions of a latent that it stands for, first to last}."""

POOLS = ("none", "average")

_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "relu": nn.relu,
    "tanh": jnp.tanh,
    "elu": nn.elu,
    "min_max": min_max,
    "sim_norm": functools.partial(sim_norm, group=GROUP),
}


class Start(NamedTuple):
    """How an encoder and its decoder start, and what the encoder sees; the defaults are the textbook's.

    Attributes:
        init: how convolutions start, a key of `srl_jax.layers.INITIALISERS`.
        zero_sum: whether the first layer's kernels start with a sum of 0, see `srl_jax.layers.zero_sum`.
        gain: factor of the pixels, which are in [0, 1] before it. Between the frames of a game only a ball
            and two paddles may move, a hundredth of the pixels; with a gain of 32 latents then differ by
            tenths.
        decoder_scale: factor of the initial kernel of the decoder's last layer. At full size the first
            images are all contrast; a tenth starts near black.
    """

    init: str = "pytorch"
    zero_sum: bool = False
    gain: float = 1.0
    decoder_scale: float = 1.0


class End(NamedTuple):
    """How an encoder ends, beside its own option `features`, the size of a linear layer (0 for none).

    Attributes:
        end: what is done with the latent at last. "default": what the row's paper has behind the linear
            layer, and nothing where there is no linear layer. Or a key of `ENDS`: "min_max" scales each
            latent into [0, 1] (Schwarzer et al. 2021); "sim_norm" turns every eight numbers into shares of 1
            by a softmax (Hansen et al. 2024, TD-MPC2, equation 5; Lavoie et al. 2023).
        pool: "average" takes the mean of each of the last maps (global average pooling; Sokar and Castro
            2025) before the linear layer; "none" flattens the maps.
    """

    end: str = "default"
    pool: str = "none"

    def latent(self, map_shape: tuple[int, int, int], features: int, own: str = "none") -> "Latent":
        """The latent of these options.

        Args:
            map_shape: (H', W', C') of the last maps.
            features: size of the linear layer; 0 for none.
            own: the end, a key of `ENDS`, that "default" means behind a linear layer.

        Raises:
            ValueError: features is out of range, or the end does not fit the latent's size.
        """
        check_size("features", features, least=0)
        end = self.end if self.end != "default" else own if features else "none"
        latent = Latent(map_shape, features, end, self.pool)
        if end == "sim_norm" and latent.size % GROUP:
            raise ValueError(f"end=sim_norm needs a multiple of {GROUP} numbers, and there are {latent.size}")
        return latent


class Latent(NamedTuple):
    """How the last maps become a latent, and a latent becomes maps again in a decoder.

    Attributes:
        map_shape: (H', W', C') of the maps.
        features: outputs of the linear layer; 0 for none.
        end: a key of `ENDS`.
        pool: one of `POOLS`.
    """

    map_shape: tuple[int, int, int]
    features: int
    end: str
    pool: str

    @property
    def size(self) -> int:
        """D, how many numbers the latent has."""
        return self.features or (self.map_shape[-1] if self.pool == "average" else math.prod(self.map_shape))

    @property
    def maps(self) -> tuple[int, int, int] | None:
        """The shape of the maps that the latent is, flattened; None behind a linear layer or a pool."""
        return None if self.features or self.pool != "none" else self.map_shape

    def encode(self, x: Array) -> Array:
        """[B, H', W', C'] -> [B, D]; its layers belong to the module whose compact method calls it."""
        if self.pool == "average":
            x = jnp.mean(x, (1, 2))
        x = x.reshape(x.shape[0], math.prod(x.shape[1:]))
        if self.features:
            x = Dense(self.features)(x)
        for name in ENDS[self.end]:
            x = nn.LayerNorm(epsilon=EPSILON)(x) if name == "layer_norm" else _FUNCTIONS[name](x)
        return x

    def decode(self, z: Array) -> Array:
        """[B, D + extra] -> [B, H', W', C'], or with C' + extra maps; called as `encode`.

        A linear layer and ReLU make maps of what the encoder pooled or sent through a linear layer. Other
        latents are reshaped, and the extra inputs become constant maps beside them.
        """
        if self.features or self.pool == "average":
            return nn.relu(WideDense(math.prod(self.map_shape))(z)).reshape(-1, *self.map_shape)
        extra = z[:, None, None, self.size :]
        x = z[:, : self.size].reshape(-1, *self.map_shape)
        extra = jnp.broadcast_to(extra, (*x.shape[:3], extra.shape[-1]))
        return jnp.concatenate([x, extra], -1)

    def steps(self) -> Iterator[dict[str, Any]]:
        """What `encode` computes, as the last of `Encoder.steps`."""
        yield {"step": "average" if self.pool == "average" else "flatten"}
        if self.features:
            yield {"step": "dense", "parameters": "Dense_0"}
        more: dict[str, dict[str, Any]] = {
            "layer_norm": {"parameters": "LayerNorm_0", "epsilon": EPSILON},
            "min_max": {"least": MIN_RANGE},
            "sim_norm": {"group": GROUP},
        }
        for name in ENDS[self.end]:
            yield {"step": name, **more.get(name, {})}


def with_options(factory: Callable[..., Encoder]) -> Callable[..., Encoder]:
    """A row of encoders: the fields of `Start` and `End` become options behind the factory's own.

    Args:
        factory: (observation_shape, start, end, **options) -> Encoder.

    Raises:
        ValueError: from the row, where a value of `Start` or `End` is out of range, or the shape is none.
    """
    shape, _, _, *own = inspect.signature(factory).parameters.values()

    @functools.wraps(factory)
    def row(observation_shape: tuple[int, int, int], **options: Any) -> Encoder:
        if len(observation_shape) != 3 or not all(side > 0 for side in observation_shape):
            raise ValueError(f"observation_shape must be (H, W, S * C), not {observation_shape}")
        start = Start(**{name: options.pop(name) for name in Start._fields if name in options})
        end = End(**{name: options.pop(name) for name in End._fields if name in options})
        check_choice("init", start.init, INITIALISERS)
        for name in ("gain", "decoder_scale"):
            if not 1e-3 <= getattr(start, name) <= 1e3:
                raise ValueError(f"{name} must be at least 0.001 and at most 1000")
        check_choice("end", end.end, ("default", *ENDS))
        check_choice("pool", end.pool, POOLS)
        return factory(observation_shape, start, end, **options)

    shared = [p for record in (Start, End) for p in inspect.signature(record).parameters.values()]
    options = [*own, *(p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in shared)]
    row.__dict__["__signature__"] = inspect.Signature([shape, *options])
    return row
