"""A trained encoder as one npz file, for which numpy is enough."""

import functools
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.serialization import to_state_dict
from flax.traverse_util import flatten_dict, unflatten_dict

from srl_jax import encoders, plugins, specs
from srl_jax.errors import ConfigError, SaveError
from srl_jax.files import checkpoint
from srl_jax.types import Array, Encoder, Params
from srl_jax.window import check_observations

ABOUT = "about"
"""The name of the array that holds a JSON text; all others are parameters."""


def to_npz(path: str | os.PathLike[str], encoder: Encoder, params: Params, spec: str, **about: Any) -> None:
    """Writes an encoder's parameters, each by its path in the tree, as "Conv_0/kernel", and `ABOUT`.

    `ABOUT` has "steps", where the encoder says them: what a program without this one has to compute of uint8
    [B, H, W, S * C], one after the other. "multiply" has the number "by"; "conv" has "stride" and "padding",
    zeros [[above, below], [left, right]], of a cross-correlation by `kernel` [height, width, in, out] plus
    `bias`; "flatten" makes [B, D] in the order H, W, C, and "average" the means [B, C] over H and W; "dense"
    is x @ `kernel` + `bias`; "layer_norm" has "epsilon", which is added to the variance, `scale` and `bias`;
    "min_max" is (x - min) / max(max - min, "least"), of a row; "sim_norm" is the softmax of each "group"
    neighbours in a row; "relu", "tanh" and "elu" have nothing. A step's "parameters" is what comes before
    the / of their names.

    Args:
        path: of the file; what lies there is replaced, once the new one is whole.
        encoder: whose they are.
        params: a tree of arrays.
        spec: `name:key=value,...`, which makes the encoder.
        **about: more that `ABOUT` says beside "encoder" (the spec), "observation_shape" and "features".

    Raises:
        ConfigError: a parameter has the name of `ABOUT`.
        SaveError: it could not be written.
    """
    path = Path(path)
    arrays: dict[str, Any] = {
        name: np.asarray(x) for name, x in flatten_dict(to_state_dict(params), sep="/").items()
    }
    if ABOUT in arrays:
        raise ConfigError(f"{path}: the encoder {spec} has a parameter {ABOUT}, a name that the file needs")
    shape = list(encoder.observation_shape)
    text = {"encoder": spec, "observation_shape": shape, "features": encoder.features, **about}
    if encoder.steps is not None:
        text["steps"] = encoder.steps
    arrays[ABOUT] = np.array(json.dumps(text))
    partial = path.with_name(f".{path.name}.partial")
    try:
        with open(partial, "wb") as file:
            np.savez(file, **arrays)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise SaveError(f"{path}: not written: {error.strerror}") from error


def from_npz(path: str | os.PathLike[str]) -> tuple[Encoder, Params]:
    """Reads an encoder that `srl-jax export` has written.

        encoder, params = srl_jax.encoders.from_npz("enc.npz")
        latents = encoder.apply(params, observations)  # uint8 [B, H, W, S * C] -> float32 [B, D]

    An encoder of your own has to be registered first, as by importing its file. `apply` raises ValueError
    where observations have another shape or dtype, or are float32 beyond [0, 1]; under jax.jit values are not
    looked at.

    Raises:
        srl_jax.errors.ConfigError: there is no such file, or it is not what export writes, or does not fit
            this code; one line.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        about = json.loads(str(arrays.pop(ABOUT)))
        spec, shape = str(about["encoder"]), tuple(map(int, about["observation_shape"]))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except (ValueError, TypeError, KeyError, AttributeError, EOFError, zipfile.BadZipFile):
        raise ConfigError(f"{path}: not an encoder that srl-jax export has written") from None
    try:
        row = specs.parse(spec, encoders.REGISTRY)
        encoder = plugins.build(row, encoders.REGISTRY, shape, gives=Encoder)
        template = jax.eval_shape(encoder.init, jax.random.key(0))
    except (ConfigError, TypeError) as error:  # a TypeError is jax's, of shapes that cannot be
        raise ConfigError(f"{path}: {error}") from None
    params = checkpoint.load_into(template, unflatten_dict(arrays, sep="/"), os.fspath(path))
    return encoder._replace(apply=_checked(encoder.apply, shape)), params


def _checked(apply: Callable[[Params, Array], jax.Array], shape: tuple[int, ...]) -> Callable:
    @functools.wraps(apply)
    def checked(params: Params, observations: Array) -> jax.Array:
        check_observations(observations, shape, ahead="B")
        return apply(params, observations)

    return checked
