"""Layers that flax lacks, or whose gradient XLA's CPU backend computes badly, and how they start."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from srl_jax.layers.convolutions import Conv, ConvTranspose, Pads, padding_of
from srl_jax.layers.dense import Dense, NoisyDense, WideDense, factorised_noise
from srl_jax.layers.initialisers import INITIALISERS

__all__ = [
    "INITIALISERS",
    "Conv",
    "ConvTranspose",
    "Dense",
    "NoisyDense",
    "Pads",
    "WideDense",
    "factorised_noise",
    "functions",
    "min_max",
    "padding_of",
    "sim_norm",
]

MIN_RANGE = 1e-5
"""The least that `min_max` divides by."""


def functions(network: nn.Module, *shapes: tuple[int, ...]) -> tuple[Callable[[Array], Any], Callable]:
    """A module's functions: key -> params, and (params, *inputs) -> output.

    Args:
        network: of which all variables are parameters.
        shapes: of its inputs, float32, one by one; `apply` may be given more.
    """

    def init(key: Array) -> Any:
        examples = (jnp.zeros(shape, jnp.float32) for shape in shapes)
        return network.init(key, *examples).get("params", {})

    def apply(params: Any, *inputs: Any) -> Any:
        return network.apply({"params": params}, *inputs)

    return init, apply


def min_max(z: Array) -> Array:
    """Latents moved and scaled into [0, 1], each by its own range: float32 [..., D] -> [..., D] (SPR's code).

    A constant becomes 0.
    """
    low = jnp.min(z, -1, keepdims=True)
    return (z - low) / jnp.maximum(jnp.max(z, -1, keepdims=True) - low, MIN_RANGE)


def sim_norm(z: Array, group: int) -> Array:
    """Softmax over each `group` neighbouring numbers: float32 [..., D] -> [..., D], D a multiple of `group`.

    Simplicial normalisation (Lavoie et al. 2023; Hansen et al. 2024, TD-MPC2, equation 5).
    """
    return nn.softmax(z.reshape(*z.shape[:-1], -1, group)).reshape(z.shape)
