"""The learning curves of the thesis, to draw beside one's own; where Atari games keep positions in memory."""

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


def ram_labels(game: str) -> dict[str, int]:
    """Which bytes of an Atari game's memory hold positions, after AtariARI (Anand et al. 2019).

    Returns:
        {variable: byte}; empty for a game that nobody has labelled.
    """
    source = importlib.resources.files(__package__) / "ram_labels.csv"
    with source.open(encoding="utf-8", newline="") as file:
        return {row["variable"]: int(row["byte"]) for row in csv.DictReader(file) if row["game"] == game}


@functools.cache
def _curves() -> dict[tuple[str, str, str], tuple[list[int], list[float]]]:
    source = importlib.resources.files(__package__) / "thesis_curves.csv"
    curves: dict[tuple[str, str, str], tuple[list[int], list[float]]] = {}
    with source.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            key = row["figure"], row["game"], row["arm"]
            steps, returns = curves.setdefault(key, ([], []))
            steps.append(int(row["env_steps"]))
            returns.append(float(row["mean_return"]))
    return curves
