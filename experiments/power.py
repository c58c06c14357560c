"""How many seeds a difference takes: `srl-jax power --effect=0.1 --seeds=5 --spread=0.12`.

For two arms that Welch's t test compares: how likely it finds a difference of that size with that many seeds
an arm, the smallest difference that it finds in 80 % of experiments, and the seeds that this one needs.
Spreads over seeds are given, or come from runs, `--from=experiments/results/catch_separate`, of which it is
that of the area under the learning curve, or from published scores, `--from=published --game=Boxing`.

A spread of five runs is itself only known to a factor of two or so. The row of all arms together knows it
better where arms spread alike. The effect is the one that would matter: with the one that was measured, power
says what p does.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from absl import flags

from srl_jax import envs, statistics
from srl_jax.data import published
from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.specs import Info, choices_text

from .command_line import flags as config_flags
from .command_line import paths
from .runs import collect

PUBLISHED = "published"
POOLED = "all arms"
FEWEST = 3
"""Runs that a spread is shown of."""


class Spread(NamedTuple):
    """How far the runs of an arm lie apart.

    Attributes:
        name: of the arm, or the method.
        runs: of how many; 0 is not known.
        deviation: standard deviation over runs.
    """

    name: str
    runs: int
    deviation: float


def of_runs(root: Path, only: str | None = None, *, force: bool = False) -> dict[str, list[Spread]]:
    """The spread of each arm's area under the learning curve, and of all arms of a game together.

    Says which runs, and which arms, are left out.

    Args:
        root: run directories, or packed runs.
        only: the game that counts; None for all.
        force: take runs of different protocols together, and say what differs.

    Raises:
        ConfigError: there are no runs, no arm has enough of them, or they are unlike.
    """
    try:
        there = collect.load_runs(root)
    except ConfigError as error:
        raise ConfigError(f"--from={root}: {str(error).removeprefix(f'{root}: ')}") from None
    runs = [run for run in there if collect.has_policy(run) and only in (None, run.game)]
    collect.check_arms(runs)
    for line in collect.check_protocols(runs, force=force) + collect.left_out_lines(runs):
        display.say(line)
    found: dict[str, list[Spread]] = {}
    for game, arms in collect.grouped(collect.comparable(runs)).items():
        curves = {arm: [collect.steps_and_returns(run) for run in its] for arm, its in arms.items()}
        areas = {arm: its["area_under_curve"] for arm, its in collect.ends(curves)[1].items()}
        for arm, x in areas.items():
            if len(x) < FEWEST:
                display.say(
                    f"{game}, {arm}: left out: {len(x)} run{'s'[: len(x) > 1]}, a spread takes {FEWEST}"
                )
        spreads = [  # less the first, of which those that are equal leave no rounding
            Spread(arm, len(x), float((x - x[0]).std(ddof=1))) for arm, x in areas.items() if len(x) >= FEWEST
        ]
        if spreads:
            found[game] = [*spreads, pooled(spreads)]
    if not found:
        raise ConfigError(f"--from={root}: no arm{f' of {only}' if only else ''} has {FEWEST} runs")
    return found


def of_published(game: str) -> list[Spread]:
    """The spreads over runs that were published for a game, `srl_jax.data.published`, of raw scores."""
    rows = [row for row in published(game) if row.spread]
    steps = {row.env_steps for row in rows}
    return [
        Spread(
            f"{row.method}, {row.env_steps or 0:,} env steps" if len(steps) > 1 else row.method,
            row.seeds or 0,
            float(row.spread or 0),
        )
        for row in rows
    ]


def pooled(spreads: Sequence[Spread]) -> Spread:
    """The root of the mean variance, each arm weighing as much as it has degrees of freedom."""
    freedom = np.array([spread.runs - 1 for spread in spreads])
    variance = freedom @ np.square([spread.deviation for spread in spreads]) / freedom.sum()
    return Spread(POOLED, sum(spread.runs for spread in spreads), float(np.sqrt(variance)))


def table(
    title: str,
    rows: Sequence[tuple[str, int, tuple[float, float]]],
    effect: float | None,
    seeds: int,
    power: float,
) -> list[str]:
    """Lines of text: what two arms that spread like each row can show.

    Args:
        title: over the names.
        rows: (name, runs behind it, standard deviation of each of the two arms).
        effect: see `srl_jax.statistics.welch_power`; None leaves out what depends on it.
        seeds: of each arm.
        power: how likely the smallest effect is found.
    """
    head = [title, "runs", "SD", f"found in {100 * power:g}% with {seeds} seeds"]
    if effect is not None:
        head += [f"{effect:g} is found in", f"seeds for {effect:g}"]
    lines = [head]
    for name, runs, spreads in rows:
        same = spreads[0] == spreads[1]
        line = [
            name,
            str(runs or "-"),
            f"{spreads[0]:.3g}" if same else " and ".join(f"{x:.3g}" for x in spreads),
        ]
        if min(spreads) <= 0:
            lines.append([*line, *["-"] * (len(head) - 3)])  # runs that are all alike
            continue
        line.append(f"{statistics.smallest_effect(spreads, (seeds, seeds), power):.3g}")
        if effect is not None:
            needed = statistics.runs_needed(effect, spreads, power)
            line.append(f"{statistics.welch_power(effect, spreads, (seeds, seeds)):.0%}")
            line.append(f"over {statistics.MOST:,}" if needed is None else str(needed))
        lines.append(line)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(map(str.ljust, line, widths)).rstrip() for line in lines]


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, names, texts = config_flags.kinds(values)
    positive = Info(
        float, "true difference between the means of the two arms", unit="of the score", minimum=1e-9
    )
    config_flags.define("effect", positive, None, values)
    seeds = Info(int, "of each arm", minimum=2, maximum=statistics.MOST)
    config_flags.define("seeds", seeds, 5, values)
    power = Info(float, "how likely a difference is to be found", minimum=0.06, maximum=0.999)
    config_flags.define("power", power, 0.8, values)
    names("spread", [], "standard deviation over seeds, or one for each arm: 0.1,0.2")
    text("from", "", f"where spreads come from: a directory of runs, or {PUBLISHED}")
    text("game", None, "the game that counts; by default all of --from")
    texts("arm", [], "of --from, given twice: the two that differ; by default each beside one like it")
    yes("force", False, "of --from: take runs of different protocols of evaluation together")


def report(values: flags.FlagValues) -> list[str]:
    """The tables that the command line asks for.

    Raises:
        ConfigError: it is not valid, or there is no spread.
    """
    effect, seeds, power = (values[name].value for name in ("effect", "seeds", "power"))
    source, given, arms = values["from"].value, values["spread"].value, values["arm"].value
    if bool(source) == bool(given):
        raise ConfigError("--spread or --from: give one of them, --spread=0.12 or --from=DIRECTORY")
    if values["force"].value and source in ("", PUBLISHED):
        raise ConfigError("--force: only beside --from=DIRECTORY, whose runs may differ")
    if given:
        own = [_positive(text, given) for text in given]
        if len(own) > 2 or arms or values["game"].present:
            raise ConfigError(f"--spread={','.join(given)}: one or two numbers, without --game and --arm")
        return table("", [("", 0, (own[0], own[-1]))], effect, seeds, power)
    if len(arms) not in (0, 2):
        raise ConfigError(f"--arm={arms[0]}: give it twice, for the two arms, or not at all")
    text = values["game"].value
    (game,) = envs.several([text], "game", others=source != PUBLISHED) if text else (None,)
    if source != PUBLISHED:
        found = of_runs(paths.given("from", source), game, force=values["force"].value)
    elif game and (spreads := of_published(game)):
        found = {game: spreads}
    else:
        raise ConfigError(
            f"--game={game or ''}: --from={PUBLISHED} needs a game with published spreads, Pong say"
        )
    lines = []
    for game, spreads in found.items():
        rows = [(x.name, x.runs, (x.deviation, x.deviation)) for x in spreads]
        if arms:
            named = {x.name: x for x in spreads}
            if missing := [arm for arm in arms if arm not in named]:
                error = f"{game}: {choices_text(missing[0], named)}"
                if not any({*arms} <= {x.name for x in there} for there in found.values()):
                    raise ConfigError(f"--arm={missing[0]}: {error}")
                display.say(f"--arm={missing[0]}: left out: {error}")
                continue
            two = [named[arm] for arm in arms]
            deviations = (two[0].deviation, two[1].deviation)
            rows = [(" and ".join(arms), min(x.runs for x in two), deviations)]
        lines += [*table(game, rows, effect, seeds, power), ""]
    return lines[:-1]


def _positive(text: str, given: Sequence[str]) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < np.inf:
        raise ConfigError(
            f"--spread={','.join(given)}: a standard deviation is a positive number, not {text!r}"
        )
    return number


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    display.result("\n".join(report(values)))


cli = config_flags.program(main, define_flags)

if __name__ == "__main__":
    cli()
