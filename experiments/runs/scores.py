"""Scores at the end of runs, game by game, beside what others have published after 100,000 env steps.

`evaluated` makes JSON values of runs, and of nothing else, from which `reporting.score_table` makes text and
`drawing.dots` a picture. Imports no jax.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from srl_jax import data, envs, statistics

from . import collect
from .json_values import limits, plain
from .run_data import RunData

STEPS = 100_000
"""Env steps after which the published scores are taken."""
CUT = 27_000
"""Env steps after which games of the published scores are cut: 108,000 frames."""
FAR = 2.0
"""In standard deviations over published runs: how far beyond published means is still within them."""
BESIDE = {
    "der": ("DER, as reported", "DER, 100 runs"),
    "der_dopamine": ("DER, 100 runs", "DER, as reported"),
    "otrainbow": ("OTRainbow, as reported",),
    "drq": ("DrQ, 100 runs", "DrQ, as reported"),
    "drq_eps": ("DrQ(eps), 100 runs",),
    "curl": ("CURL, as reported", "CURL, 100 runs"),
    "spr": ("SPR, as reported", "SPR, 100 runs", "SPR in JAX, 49 runs"),
    "spr_resets": ("SPR + resets, 32 runs",),
    "sr_spr": ("SR-SPR",),
    "bbf": ("BBF, replay ratio 2", "BBF"),
    "a_lix": ("A-LIX",),
    "mrq": ("MR.Q",),
}
"""{preset atari100k/NAME: the published methods that its runs are laid beside}, the same recipe first."""


class Score(NamedTuple):
    """What a run scored at its end: the mean of some games, raw."""

    value: float
    games: int
    final: bool

    @property
    def of(self) -> str:
        """Of what it is the mean."""
        games = f"{self.games} game{'' if self.games == 1 else 's'}"
        return f"{games} at the end" if self.final else f"last evaluation, {games}"


def beside(preset: str) -> tuple[str, ...]:
    """The published methods that a preset's runs are laid beside, see `BESIDE`; none of another preset."""
    family, _, name = preset.partition("+")[0].partition("/")
    return BESIDE.get(name, ()) if family == "atari100k" else ()


def end_score(run: RunData) -> tuple[Score | None, str]:
    """The score of a run at its end, or None and why it has none.

    That of its final evaluation, a row of kind "final"; of a run without one, its last evaluation's.
    """
    if run.failed:
        return None, run.ended.reason
    done = max((row["env_steps"] for row in run.rows), default=0)
    if not run.over:
        left = ", without its final games" if run.config.final_games and done >= run.config.steps else ""
        return None, f"not at its end: {done:,} of {run.config.steps:,} env steps{left}"
    for kind, games in (("final", "final/games"), ("eval", None)):
        steps, values = collect.steps_and_values(run, f"{kind}/return_mean")
        if len(steps) and steps[-1] == done:
            counts = collect.steps_and_values(run, games)[1] if games else [run.config.eval_games]
            number = int(counts[-1]) if len(counts) else run.config.final_games
            return Score(float(values[-1]), number, kind == "final"), ""
    return None, f"not evaluated at its end, after {done:,} env steps"


def evaluated(
    figure: str,
    title: str,
    question: str,
    runs: Sequence[RunData],
    arms: Mapping[str, Sequence[str]],
    games: Sequence[str],
    *,
    force: bool = False,
    styles: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """The scores of arms on games beside published ones, as JSON values; None for what is not known.

    Args:
        figure, title, question: kept.
        runs: on disk; those of other arms and games are left out.
        arms: {name: the published methods that it is compared with}, keys of `data.atari100k_methods`.
        games: Atari games.
        force: take runs of different protocols together, and say what differs.
        styles: {arm: colour and line}.

    Raises:
        ConfigError: runs cannot be compared.
    """
    runs = [run for run in runs if run.arm in arms and run.game in games]
    collect.check_arms(runs)
    forced = collect.check_protocols(runs, force=force)
    forced += collect.check_protocols(runs, force=force, more=("steps",), across_games=True)
    scores = {run.key: end_score(run) for run in runs}
    groups = collect.grouped(run for run in runs if scores[run.key][0])
    known = [game for game in games if game in groups]
    methods = list(dict.fromkeys(name for others in arms.values() for name in others))
    common = [game for game in known if all(arm in groups[game] for arm in arms)]
    common = [game for game in common if all(game in data.atari100k(name) for name in methods)]
    result: dict[str, Any] = {
        "figure": figure,
        "title": title,
        "question": question,
        "level": 0.95,
        "games": known,
        "aggregated": common,
        "without_runs": [game for game in games if game not in known],
        "forced": forced,
        "left_out": [
            {"game": run.game, "arm": run.arm, "seed": run.seed, "reason": why}
            for run in runs
            if (why := scores[run.key][1])
        ],
        "styles": {arm: list(style) for arm, style in (styles or {}).items()},
        "reference": {game: list(data.reference_scores(game)) for game in known},
        "arms": {},
        "published": {name: _published(name, known, common) for name in methods},
    }
    for arm, others in arms.items():
        members = {game: groups[game][arm] for game in known if arm in groups[game]}
        if not members:
            continue
        own = {game: [scores[run.key][0] for run in its] for game, its in members.items()}
        values = {game: np.array([score.value for score in its]) for game, its in own.items()}
        config = next(iter(members.values()))[0].config
        everything = [run for its in members.values() for run in its]
        entry = result["arms"][arm] = {
            "beside": list(others),
            "steps": config.steps,
            "of": sorted({score.of for its in own.values() for score in its}),
            "cores": sorted({x or 0 for run in everything for x in _all(run, "cores")}),
            "revisions": sorted({str(x) for run in everything for x in _all(run, "git_revision")}),
            "differs": {name: _differs(name, members) for name in others},
            "games": {},
            "aggregates": _aggregates({game: values[game] for game in common}),
        }
        for game, its in members.items():
            found = statistics.estimate(statistics.mean, {game: values[game]})
            point, low, high = statistics.human_normalised(game, np.array(found[:3]))
            entry["games"][game] = {
                "seeds": [run.seed for run in its],
                "scores": values[game].tolist(),
                "of": [score.of for score in own[game]],
                **limits(found),
                "normalised": {"mean": plain(point), "low": plain(low), "high": plain(high)},
                "normalised_scores": statistics.human_normalised(game, values[game]).tolist(),
                **_distance(game, float(found.point), others),
            }
    return result


def _all(run: RunData, field: str) -> list[Any]:
    """What a run says of where and by what it ran, at its start and wherever it was resumed."""
    return collect.history(run).get(field) or [None]


def _published(name: str, games: Sequence[str], common: Sequence[str]) -> dict[str, Any]:
    about, scores = data.atari100k_methods()[name], data.atari100k(name)
    entry: dict[str, Any] = about._asdict() | {"games": {}}
    del entry["method"]
    for game in (game for game in games if game in scores):
        low, high = data.reference_scores(game)
        score = scores[game]
        entry["games"][game] = score._asdict() | {
            "normalised": float(statistics.human_normalised(game, score.mean)),
            "normalised_sd": score.sd and score.sd / (high - low),
        }
    if common:
        means = {game: statistics.human_normalised(game, [scores[game].mean]) for game in common}
        entry["aggregates"] = {name: float(of(means)) for name, of in _AGGREGATES.items()} | {
            "interquartile_mean": about.iqm_of_runs if set(common) == set(envs.SUITES["26"]) else None,
            "optimality_gap": None,
        }
    return entry


def _differs(name: str, members: Mapping[str, Sequence[RunData]]) -> str:
    """What differs between a published method's scores and these runs', by game where games differ."""
    texts: dict[str, list[str]] = {}
    for game, runs in members.items():
        rows = [row for row in data.published(game) if (row.method, row.env_steps) == (name, STEPS)]
        if rows:
            text = collect.differs(rows[0], runs[0].config, seeds=len(runs))
            if (cut := runs[0].config.eval_max_steps) != CUT:
                text = f"games cut after {CUT:,} env steps (here {cut:,}){'; ' if text else ''}{text}"
            texts.setdefault(text, []).append(game)
    if len(texts) > 1:
        return "; ".join(f"{', '.join(games)}: {text or 'nothing'}" for text, games in texts.items())
    return next(iter(texts), "no score of these games")


def _distance(game: str, mean: float, others: Sequence[str]) -> dict[str, Any]:
    """How far a mean is from published ones, in standard deviations over published runs of the game.

    A method without one of its own takes that of the method beside it of which most runs are known.

    Returns:
        distances: {method: (mean - its mean) / deviation}; verdict: "above" or "below" where it is further
        than `FAR` above, or below, all of them, else "within"; "" where no deviation is known.
    """
    scores = {name: data.atari100k(name)[game] for name in others if game in data.atari100k(name)}
    known = [score for score in scores.values() if score.sd]
    if not known:
        return {"distances": {}, "verdict": ""}
    usual = max(known, key=lambda score: score.runs or 0).sd
    distances = {name: (mean - score.mean) / (score.sd or usual) for name, score in scores.items()}
    low, high = min(distances.values()), max(distances.values())
    verdict = "above" if low > FAR else "below" if high < -FAR else "within"
    return {"distances": distances, "verdict": verdict}


def _of_means(statistic: statistics.aggregates.Statistic) -> statistics.aggregates.Statistic:
    return lambda scores: statistic({game: x.mean(-1, keepdims=True) for game, x in scores.items()})


_AGGREGATES: dict[str, statistics.aggregates.Statistic] = {
    "mean": statistics.mean,
    "median": statistics.median,
    "interquartile_mean": statistics.interquartile_mean,
    "interquartile_mean_of_means": _of_means(statistics.interquartile_mean),
    "optimality_gap": statistics.optimality_gap,
    "optimality_gap_of_means": _of_means(statistics.optimality_gap),
}


def _aggregates(raw: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Aggregates of human-normalised scores over games, each game weighted alike, with their intervals."""
    if not raw:
        return {}
    scores = {game: statistics.human_normalised(game, x) for game, x in raw.items()}
    return {name: limits(statistics.estimate(of, scores)) for name, of in _AGGREGATES.items()}
