"""What others measured, to draw beside your own, and where Atari games keep positions in memory.

README.md beside this file says what each column of the tables means, and its unit.
"""

import csv
import functools
import importlib.resources
import io
import typing
from collections.abc import Iterable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from srl_jax import envs


class Published(NamedTuple):
    """A published score of one method in one game, a row of published.csv, whose columns README.md explains.

    None: not known here; as env_steps, of Random and Human, who do not learn.
    """

    game: str
    method: str
    env_steps: int | None
    score: float
    spread: float | None
    seeds: int | None
    score_of: str | None
    sticky_actions: float | None
    epsilon: float | None
    protocol: str
    source: str


POLICIES = ("random", "no-op")
"""Policies that learn nothing: uniformly random actions; always the action that does nothing."""


class ReferencePolicy(NamedTuple):
    """What a policy that learns nothing scores: a row of reference_policies.csv, see README.md.

    None: not known here, or the game has none. `source` is the command that plays these games again, or where
    the number was published.
    """

    game: str
    policy: str
    return_mean: float
    return_std: float | None
    episodes: int | None
    length_mean: float | None
    sticky_actions: float | None
    noop_max: int | None
    eval_max_steps: int | None
    source: str


def reference_policies(game: str) -> dict[str, ReferencePolicy]:
    """What policies that learn nothing score in a game, by the names in `POLICIES`.

    Both for Catch, CatchDistractor and the thesis' seven games, which this project played; "random" alone, as
    published, for the other Atari-57 games; {} for any other.
    """
    found = {row.policy: row for row in _reference_policies() if row.game == game}
    if not found and game in (scores := _reference_scores()):
        unknown = (None,) * 6
        found["random"] = ReferencePolicy(game, "random", scores[game][0], *unknown, _DQN_ZOO)
    return {name: found[name] for name in POLICIES if name in found}


def policies_from(lines: Iterable[str]) -> list[ReferencePolicy]:
    """The rows of a table that `experiments.reference_policies` wrote.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    rows = csv.DictReader(lines)
    if rows.fieldnames != list(ReferencePolicy._fields):
        raise ValueError("its columns are others")
    return [_record(ReferencePolicy, row) for row in rows]


@functools.cache
def _reference_policies() -> list[ReferencePolicy]:
    source = importlib.resources.files(__package__) / "reference_policies.csv"
    return policies_from(source.read_text(encoding="utf-8").splitlines())


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


def thesis_curves() -> list[str]:
    """What `thesis_curve` has of some game, as FIGURE/ARM: "6.2/rl_only_nature"."""
    return list(dict.fromkeys(f"{figure}/{arm}" for figure, _, arm in _curves()))


def reference_scores(game: str) -> tuple[float, float]:
    """The raw scores that count as 0 and 1: a random policy's and a human's; a miss and a catch in Catch.

    Args:
        game: an Atari-57 game, one of Catch's, or one whose row declares them, see `srl_jax.envs.Game`.

    Raises:
        ValueError: the game is none of them.
    """
    if scores := _reference_scores().get(game) or envs.known(game).scores:
        return scores
    known = ", ".join(_reference_scores())
    raise ValueError(f"no reference scores for game {game}; there are some for {known}")


def with_reference_scores(games: Iterable[str]) -> list[str]:
    """Those of the games that `reference_scores` knows."""
    return [game for game in games if game in _reference_scores() or envs.known(game).scores]


class Method100k(NamedTuple):
    """A method with scores after 100,000 env steps, a row of atari100k_methods.csv, see README.md.

    None: not known here.
    """

    method: str
    basis: str
    level: str
    runs: str | None
    iqm_of_runs: float | None
    sticky_actions: float | None
    epsilon: float | None
    protocol: str
    source: str


class Score100k(NamedTuple):
    """A method's score in a game after 100,000 env steps, raw; None: not known here.

    Attributes:
        mean: over runs.
        sd: standard deviation over runs (n - 1).
        median: over runs.
        runs: how many.
    """

    mean: float
    sd: float | None = None
    median: float | None = None
    runs: int | None = None


@functools.cache
def atari100k_methods() -> dict[str, Method100k]:
    """{name: what is known of it} of the methods with published scores after 100,000 env steps."""
    return {row["method"]: _record(Method100k, row) for row in _rows("atari100k_methods.csv")}


def atari100k(method: str) -> dict[str, Score100k]:
    """{game: published score after 100,000 env steps} of a method: the 26 games at least.

    Args:
        method: a key of `atari100k_methods`.

    Raises:
        KeyError: there is no such method.
    """
    return _atari100k()[method]


@functools.cache
def _atari100k() -> dict[str, dict[str, Score100k]]:
    found: dict[str, dict[str, Score100k]] = {}
    for name, about in atari100k_methods().items():
        statistics = {row["statistic"]: row for row in _rows("atari100k.csv") if row["method"] == name}
        own = found[name] = {}
        for game in envs.ATARI_57:
            values = {key: float(row[game]) for key, row in statistics.items() if row[game]}
            if values:
                runs = values.pop("runs", None) or about.runs
                own[game] = Score100k(**values, runs=int(runs) if runs else None)
    return found


def published(game: str) -> list[Published]:
    """Published scores of a game, Random and Human first; [] for one that has none.

    Args:
        game: "Pong", say; 55 Atari games have results of learned policies, seven of them of long runs.
    """
    rows = [
        row | {"method": name, "score": row[name.lower()], "score_of": "evaluation", "protocol": _NO_OPS}
        for row in _rows("atari_scores.csv")
        if row["game"] == game and row["source"] == _DQN_ZOO
        for name in ("Random", "Human")
    ]
    rows += [row for row in _rows("published.csv") if row["game"] == game]
    of_100k = [
        Published(
            game, name, 100_000, score.mean, score.sd, score.runs,
            "evaluation" if about.level == "runs" else None,
            about.sticky_actions, about.epsilon, about.protocol, about.source,
        )
        for name, about in atari100k_methods().items()
        if (score := atari100k(name).get(game))
    ]  # fmt: skip
    return [_record(Published, row) for row in rows] + of_100k


_Record = TypeVar("_Record", Published, ReferencePolicy, Method100k)


def _record(kind: type[_Record], row: Mapping[str, str]) -> _Record:
    """A row of a table as a named tuple, each field of the type that it is declared with; empty is None."""
    hints = typing.get_type_hints(kind)
    values = []
    for name in kind._fields:
        types = typing.get_args(hints[name]) or (hints[name],)
        read = int if int in types else float if float in types else str
        values.append(read(row[name]) if row.get(name) else None)
    return kind._make(values)


_DQN_ZOO = "google-deepmind/dqn_zoo dqn_zoo/atari_data.py"
_NO_OPS = "mean of at least 3 games of at most 108,000 frames, after up to 30 no-ops"


@functools.cache
def _reference_scores() -> dict[str, tuple[float, float]]:
    return {row["game"]: (float(row["random"]), float(row["human"])) for row in _rows("atari_scores.csv")}


@functools.cache
def _rows(name: str) -> list[dict[str, str]]:
    source = importlib.resources.files(__package__) / name
    return list(csv.DictReader(io.StringIO(source.read_bytes().decode(), newline="")))


def ram_labels(game: str) -> dict[str, int]:
    """Which bytes of an Atari game's memory hold positions, after AtariARI (Anand et al. 2019).

    Returns:
        {variable: byte}; empty for a game that nobody has labelled.
    """
    return {row["variable"]: int(row["byte"]) for row in _rows("ram_labels.csv") if row["game"] == game}


@functools.cache
def _curves() -> dict[tuple[str, str, str], tuple[list[int], list[float]]]:
    curves: dict[tuple[str, str, str], tuple[list[int], list[float]]] = {}
    for row in _rows("thesis_curves.csv"):
        steps, returns = curves.setdefault((row["figure"], row["game"], row["arm"]), ([], []))
        steps.append(int(row["env_steps"]))
        returns.append(float(row["mean_return"]))
    return curves
