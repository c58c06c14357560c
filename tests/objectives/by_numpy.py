"""Layers and distances by numpy, as equations have them: what references of whole losses are made of."""

from collections.abc import Callable, Sequence

import numpy as np

from tests.helpers import NUM_ACTIONS


def dense(tree, x: np.ndarray) -> np.ndarray:
    """A linear layer over the last axis."""
    return x @ tree["kernel"] + tree["bias"]


def mlp(tree, x: np.ndarray, layer_norm: bool = False) -> np.ndarray:
    """Two linear layers with a ReLU between them, and LayerNorm before it where that is asked for."""
    x = dense(tree["hidden"], x)
    if layer_norm:
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        x = x * tree["norm"]["scale"] + tree["norm"]["bias"]
    return dense(tree["out"], np.maximum(x, 0))


def with_action(z: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """[..., D] and int [...] -> [..., D + NUM_ACTIONS]: one-hot actions beside latents."""
    return np.concatenate([z, np.eye(NUM_ACTIONS)[actions]], -1)


def conv(tree, x: np.ndarray) -> np.ndarray:
    """A convolution [B, H, W, C] -> [B, H, W, features] of an odd kernel, zeros around the image."""
    kernel, (height, width) = tree["kernel"], x.shape[1:3]
    side = len(kernel)
    padded = np.pad(x, [(0, 0), (side // 2, side // 2), (side // 2, side // 2), (0, 0)])
    taps = [(i, j) for i in range(side) for j in range(side)]
    return sum(padded[:, i : i + height, j : j + width] @ kernel[i, j] for i, j in taps) + tree["bias"]


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def cosine_distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """`2 - 2 cos`, over the last axis (Grill et al. 2020, equation 2)."""
    return 2 - 2 * (unit(x) * unit(y)).sum(-1)


def log_softmax(logits: np.ndarray) -> np.ndarray:
    return logits - np.log(np.exp(logits).sum(-1, keepdims=True))


def min_max(x: np.ndarray) -> np.ndarray:
    """Each latent into [0, 1] by its own extremes (SPR, section 2.3)."""
    low, high = x.min(-1, keepdims=True), x.max(-1, keepdims=True)
    return (x - low) / (high - low)


def spr_distances(
    head, project: Callable, goals: Sequence[np.ndarray], z: np.ndarray, actions: np.ndarray, shape=None
) -> np.ndarray:
    """SPR's cosine distances from z_t on (Schwarzer et al. 2021, section 2; figure 2): [K, B].

    Args:
        head: has a transition and a predictor.
        project: latents in [0, 1] -> their projections under the online parameters.
        goals: the projections that K steps are to predict, [B, outputs] each.
        z: [B, D].
        actions: [B, K].
        shape: of the map that a latent is; None for one of a single pixel.
    """
    state, distances = min_max(z), []
    for k, goal in enumerate(goals):
        maps = state.reshape(len(z), *(shape or (1, 1, -1)))
        maps = with_action(maps, np.broadcast_to(actions[:, k, None, None], maps.shape[:3]))
        for layer in ("first", "second"):
            maps = np.maximum(conv(head["transition"][layer], maps), 0)
        state = min_max(maps.reshape(z.shape))
        distances.append(cosine_distance(dense(head["predictor"], project(state)), goal))
    return np.stack(distances)
