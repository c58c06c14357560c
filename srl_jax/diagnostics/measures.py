"""Measures of a latent, of numpy arrays, in float64. N observations, D units."""

import numpy as np

DORMANT = 0.025
"""Sokar et al. (2023), section 3: the score up to which a unit is called dormant."""
CONSTANT = 1e-6
"""Standard deviation, in units of the latent, up to which a unit counts as constant."""
MOVING = 0.1
"""A pixel moves if it differs by more than this, in units of full brightness, from the frame before: 26
levels of 255. In Pong and Catch 0.5 % of the pixels do, in front of CatchDistractor's background 28 %."""
RIDGES = tuple(10.0**k for k in range(-4, 4))
"""What a probe's regularisation is chosen from, in units of the mean squared norm of an observation's
standardised latent."""
QUIET = 0.1
"""A probe gives a unit at most the scale that one of this standard deviation would have, in units of the root
mean square over all units: see `probe`."""


def effective_rank(latents: np.ndarray) -> float:
    """The exponential of the entropy of the normalised singular values (Roy and Vetterli 2007, section 2).

    Args:
        latents: [N, D]; their mean is taken off first.

    Returns:
        Between 1 and min(N - 1, D); 0 where all latents are the same.
    """
    z = latents.astype(np.float64)
    z -= z.mean(0)
    gram = z @ z.T if len(z) < z.shape[1] else z.T @ z
    eigenvalues = np.linalg.eigvalsh(gram).clip(0.0)
    # What is rounding of the largest is none: its root would not be small.
    eigenvalues[eigenvalues <= eigenvalues.max() * 1e-13] = 0.0
    values = np.sqrt(eigenvalues)
    if not values.any():
        return 0.0
    shares = values[values > 0] / values.sum()
    return float(np.exp(-(shares * np.log(shares)).sum()))


def dormant_share(latents: np.ndarray) -> float:
    """The share of units whose mean |activation| is at most `DORMANT` of the layer's (Sokar et al. 2023).

    After a ReLU, as in `nature`, a dormant unit is one that is off nearly everywhere. After a tanh a dead
    unit is rather one that is stuck at 1 or -1, which this cannot see: `constant_share` does.

    Args:
        latents: [N, D].

    Returns:
        In [0, 1]; 1 where all latents are 0.
    """
    scores = np.abs(latents.astype(np.float64)).mean(0)
    return float((scores <= DORMANT * scores.mean()).mean())


def constant_share(latents: np.ndarray) -> float:
    """The share of units that say the same of every observation: standard deviation up to `CONSTANT`."""
    return float((latents.astype(np.float64).std(0) <= CONSTANT).mean())


def mean_cosine(a: np.ndarray, b: np.ndarray) -> float:
    """The mean over observations of the cosine of two latents, [N, D] each, not centred. In [-1, 1].

    The part of a latent that all observations share decides it, where that part is large.
    """
    a, b = a.astype(np.float64), b.astype(np.float64)
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    with np.errstate(invalid="ignore"):
        return float(((a * b).sum(1) / norms).mean())


def centred(x: np.ndarray) -> np.ndarray:
    """Latents [N, D], less their mean over observations, float64."""
    x = x.astype(np.float64)
    return x - x.mean(0)


def centred_gram(x: np.ndarray) -> np.ndarray:
    """Inner products of the rows of `centred`: [N, D] -> float64 [N, N] of norm 1, or NaN."""
    x = centred(x)
    gram = x @ x.T
    with np.errstate(invalid="ignore"):
        return gram / np.sqrt((gram * gram).sum())


def alignment(a: np.ndarray, b: np.ndarray) -> float:
    """Linear centred kernel alignment (Kornblith et al. 2019, section 3) of two `centred_gram`s.

    Rotations of a latent and its scale do not matter to it. In [0, 1]; NaN where one is constant.
    """
    return float((a * b).sum())


def moving_errors(before: np.ndarray, target: np.ndarray, output: np.ndarray) -> dict[str, float]:
    """Errors of predicted frames, apart on pixels that have just moved and on those that have not.

    A decoder may give a game's background to the last detail and lose the ball: a hundredth of the pixels.

    Args:
        before, target, output: float [N, H, W, C] in units of full brightness: the frame before the target's,
            the target, and what was predicted.

    Returns:
        `moving`, `static`: mean squared error on the pixels of the target that differ from the frame before
        by more than `MOVING` in any channel, and on the others. `moving_explained`: 1 - `moving` over the
        same error of the targets' mean image, which knows nothing of an observation: 1 is perfect, 0 has lost
        what moves. NaN where there is no such pixel.
    """
    target, output = target.astype(np.float64), output.astype(np.float64)
    moves = (np.abs(target - before) > MOVING).any(-1)
    error, baseline = (output - target) ** 2, (target.mean(0) - target) ** 2

    def mean(values: np.ndarray, where: np.ndarray) -> float:
        return float(values[where].mean()) if where.any() else float("nan")

    moving, of_mean = mean(error, moves), mean(baseline, moves)
    return {
        "moving": moving,
        "static": mean(error, ~moves),
        "moving_explained": 1.0 - moving / of_mean if of_mean else float("nan"),
    }


def moving_share(observations: np.ndarray) -> float:
    """The share of pixels of the newest frame that move, in any channel: uint8 [N, S, H, W, C], S at
    least 2."""
    before, now = (observations[:, i].astype(np.float32) / 255.0 for i in (-2, -1))
    return float((np.abs(now - before) > MOVING).any(-1).mean())


def probe(latents: np.ndarray, states: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """How well a linear function of the latent gives each variable of the state, on episodes not seen before.

    Ridge regression from standardised units to standardised variables, fitted on every second episode. Its
    regularisation is the one of `RIDGES` with the smallest error there when each episode is predicted from
    the others, for each variable: observations of one episode look alike. A unit that hardly moves on those
    episodes is not blown up to the size of the others (`QUIET`): on a new episode it may be far out, and
    would decide alone.

    Args:
        latents: [N, D].
        states: [N, V].
        episodes: int [N], which one an observation is of.

    Returns:
        R^2 on the other episodes, float64 [V]: 1 is perfect, 0 is as good as their mean, and it may be
        negative. NaN for a variable that is constant in either half, or where a half has no two observations.
    """
    order = np.unique(episodes, return_inverse=True)[1]
    fits = order % 2 == 0
    z, y = latents.astype(np.float64), states.astype(np.float64)
    scores = np.full(y.shape[1], np.nan)
    if min(fits.sum(), (~fits).sum()) < 2:
        return scores
    known = (y[fits].std(0) > 0) & (y[~fits].std(0) > 0)
    mean, scale = z[fits].mean(0), z[fits].std(0)
    varies = scale > CONSTANT
    if not (known.any() and varies.any()):
        return scores
    scale = scale[varies]
    z = (z[:, varies] - mean[varies]) / np.maximum(scale, QUIET * np.sqrt((scale**2).mean()))
    y_mean, y_scale = y[fits].mean(0)[known], y[fits].std(0)[known]
    y = (y[:, known] - y_mean) / y_scale
    # The dual form, in the eigenvectors of the inner products: as many unknowns as observations.
    eigenvalues, vectors = np.linalg.eigh(z[fits] @ z[fits].T)
    eigenvalues, turned = eigenvalues.clip(0.0), vectors.T @ y[fits]
    unit = eigenvalues.sum() / len(eigenvalues)
    together = [np.flatnonzero(order[fits] == episode) for episode in np.unique(order[fits])]
    best, weights = np.full(y.shape[1], np.inf), np.zeros((fits.sum(), y.shape[1]))
    for ridge in RIDGES:
        inverse = 1.0 / (eigenvalues + ridge * unit)
        dual = vectors @ (inverse[:, None] * turned)
        # The errors on observations that are left out together: the block of the inverse, inverted (Allen's
        # PRESS is the case of one).
        inverted = (vectors * inverse) @ vectors.T
        errors = ((np.linalg.solve(inverted[np.ix_(one, one)], dual[one]) ** 2).sum(0) for one in together)
        left_out = sum(errors, np.zeros(()))
        better = left_out < best
        best[better], weights[:, better] = left_out[better], dual[:, better]
    error = ((z[~fits] @ (z[fits].T @ weights) - y[~fits]) ** 2).sum(0)
    scores[known] = 1.0 - error / ((y[~fits] - y[~fits].mean(0)) ** 2).sum(0)
    return scores
