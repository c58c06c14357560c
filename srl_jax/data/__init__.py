"""What others measured, to draw beside one's own: the thesis' curves, scores of humans and of chance."""

import csv
import functools
import importlib.resources

import numpy as np


def thesis_curve(figure: str, game: str, arm: str) -> tuple[np.ndarray, np.ndarray]:
    """One learning curve of the thesis: a single run, evaluated after each epoch.

    Args:
        figure: the thesis' figure, "6.1" to "6.5" or "A.1".
        game: "Pong", say; five games have curves.
        arm: the name used for it here, such as "rl_only_nature".

    Returns:
        env steps, int64 [N], ascending; mean return over 10 evaluation games, float64 [N].

    Raises:
        ValueError: if there is no such curve, with the arms that the figure has for the game, or
            the figures and games that there are.
    """
    curves = _curves()
    try:
        steps, returns = curves[figure, game, arm]
    except KeyError:
        arms = [a for f, g, a in curves if (f, g) == (figure, game)]
        raise ValueError(
            f"figure {figure} has no arm {arm} for {game}; valid: {', '.join(arms)}"
            if arms
            else f"no curves for figure {figure} and {game}; valid figures: "
            f"{', '.join(sorted({f for f, _, _ in curves}))}; valid games: "
            f"{', '.join(sorted({g for _, g, _ in curves}))}"
        ) from None
    return np.array(steps, np.int64), np.array(returns, np.float64)


def reference_scores(game: str) -> tuple[float, float]:
    """The raw scores that count as 0 and 1: a random policy's and a human's; a miss and a catch in Catch.

    Args:
        game: an Atari-57 game, Catch or CatchDistractor.

    Raises:
        ValueError: the game is none of them.
    """
    scores = _reference_scores()
    if game not in scores:
        raise ValueError(f"no reference scores for game {game}; there are some for {', '.join(scores)}")
    return scores[game]


@functools.cache
def _reference_scores() -> dict[str, tuple[float, float]]:
    return {row["game"]: (float(row["random"]), float(row["human"])) for row in _rows("atari_scores.csv")}


def _rows(name: str) -> list[dict[str, str]]:
    source = importlib.resources.files(__package__) / name
    with source.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@functools.cache
def _curves() -> dict[tuple[str, str, str], tuple[list[int], list[float]]]:
    curves: dict[tuple[str, str, str], tuple[list[int], list[float]]] = {}
    for row in _rows("thesis_curves.csv"):
        steps, returns = curves.setdefault((row["figure"], row["game"], row["arm"]), ([], []))
        steps.append(int(row["env_steps"]))
        returns.append(float(row["mean_return"]))
    return curves
