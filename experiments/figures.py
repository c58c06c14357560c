"""Draws a figure of the thesis, from runs that it starts where they are missing.

    python -m experiments.figures --figure=6.3 --games=Pong,Breakout --seeds=3 --steps=500000

Every arm that has not been run yet is run, each seed in a process of its own that can be killed and resumed.
Then the figure is drawn: the mean evaluation return over seeds against env steps, with 95 % t intervals. The
thesis' own curve lies below it where there is one, and lines show what a random and a no-op policy score.
OUT/figures gets FIGURE.png and FIGURE.json, its numbers. The runs lie in OUT/GAME/ARM/seedN, and all figures
share them. Flags of `srl-jax train` beside these go to all runs.

    python -m experiments.figures --figure=atari100k --presets=atari100k/der --games=26 --seeds=2

This figure is of scores at the end of runs, game by game, beside published ones: a picture, a table as
atari100k.md and atari100k.csv, and its numbers. --games=26, 5, 3, signed or thesis names a suite.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import envs, statistics
from srl_jax.config import Config
from srl_jax.data import atari100k_methods, published, reference_policies
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.reading import replace_text
from srl_jax.specs import choices_text

from . import packing
from .arms import FIGURES, SCORES, Figure, figures_named
from .command_line import flags as config_flags
from .command_line import paths
from .drawing import dots, plots
from .drawing.colours import styles
from .reporting import score_table
from .runs import collect, scores
from .runs.collect import FINAL, RunData, comparable, steps_and_returns, steps_and_values
from .runs.json_values import json_text, limits, plain, rounded
from .sweeping import launching, manifest, options, probe, status
from .sweeping.plan import OWN, Arm, Planned, parse_seeds, plan
from .sweeping.plan import presets as matching

TWO = 2
"""So many runs are drawn themselves: their t interval is nine standard deviations wide to either side."""


def planned(
    figures: Sequence[Figure], games: Sequence[str], seeds: Sequence[int], given: dict
) -> list[Planned]:
    """The runs that figures need, each once.

    Args:
        figures: whose arms are run.
        games: each arm is run on all of them.
        seeds: and with all of these.
        given: flags for all runs.
    """
    runs: dict[str, Planned] = {}
    for seed in seeds:  # one of everything, then the next: what is there of a sweep can be compared
        for figure in figures:
            for game in games:
                arms = [Arm(arm.name, arm.preset_for(game), dict(arm.flags)) for arm in figure.arms]
                for run in plan(arms, [game], [seed], given):
                    if runs.setdefault(run.name, run) != run:
                        raise ConfigError(f"--figure: two figures mean different runs by {run.name}")
    return list(runs.values())


def evaluated(
    figure: Figure,
    runs: Sequence[RunData],
    games: Sequence[str],
    *,
    methods: Sequence[str] = (),
    force: bool = False,
    among: Iterable[str] = (),
) -> dict[str, Any]:
    """The numbers of a figure, as JSON values; what has no interval (a single seed) has None there.

    Beside the limits of an interval stands its kind, see `srl_jax.statistics.Interval`; a difference of means
    has the p value of Welch's test.

    Args:
        figure: its first arm is the baseline.
        runs: on disk; those of other arms and games are left out, and those that are not `comparable`, of
            which it is said.
        games: in this order.
        methods: whose published scores are given, with what differs.
        force: compare runs of different protocols, and say what differs.
        among: all arms of the directory, beside which an arm has the same colour in all figures.

    Raises:
        ConfigError: runs cannot be compared.
    """
    names = [arm.name for arm in figure.arms]
    runs = [run for run in runs if run.arm in names and run.game in games]
    collect.check_arms([run for run in runs if len(steps_and_returns(run)[0])])
    forced = collect.check_protocols(runs, force=force)
    groups = collect.grouped(comparable(runs))
    result: dict[str, Any] = {
        "figure": figure.name,
        "title": figure.title,
        "question": figure.question,
        "baseline": names[0],
        "arms": names,
        "styles": {name: list(style) for name, style in styles(names, among).items()},
        "level": 0.95,
        "forced": forced,
        "left_out": [
            {"game": run.game, "arm": run.arm, "seed": run.seed, "reason": why}
            for run, why in collect.left_out(runs)
        ],
        "games": {},
    }
    for game in games:
        members = {name: groups[game][name] for name in names if name in groups.get(game, {})}
        if not members:
            continue
        found = {name: [steps_and_returns(run) for run in arm] for name, arm in members.items()}
        until, ends = collect.ends(found)
        entry: dict[str, Any] = {"equal_until": until, "arms": {}}
        for name, arm in found.items():
            values = {"seeds": [run.seed for run in members[name]]} | _curve(arm)
            values |= {
                of: limits(statistics.estimate(statistics.mean, {game: x})) for of, x in ends[name].items()
            }
            final = [steps_and_values(run, FINAL)[1] for run in members[name]]
            if all(len(x) for x in final):  # the games after the last env step
                last = np.array([x[-1] for x in final])
                interval = limits(statistics.estimate(statistics.mean, {game: last}))
                values["final"] = interval | {"games": members[name][0].config.final_games}
            if name != names[0] and names[0] in found:
                values["against_baseline"] = _against(game, ends[name], ends[names[0]])
            entry["arms"][name] = values
        config = next(iter(members.values()))[0].config
        entry["policies"] = {
            name: {"mean": row.return_mean, "differs": collect.differs(row, config), "source": row.source}
            for name, row in reference_policies(game).items()
        }
        entry["published"] = [level._asdict() for level in published_levels(game, methods, config, until)]
        result["games"][game] = entry
    return result


def _curve(arm: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """The learning curve of an arm on a game: at its own steps, that all of its runs have."""
    grid, returns = statistics.at_equal_steps(arm)
    interval = statistics.mean_interval(returns.T)
    return {"env_steps": grid.tolist(), **limits(interval), "runs": plain(returns)}


def _against(game: str, ours: Mapping[str, np.ndarray], base: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """An arm's `collect.ends` against the baseline's."""
    found = {}
    for of in ours:
        difference = statistics.estimate_difference({game: ours[of]}, {game: base[of]})
        found[of] = limits(difference) | {"p": plain(statistics.welch_p(ours[of], base[of]))}
    areas = ({game: x["area_under_curve"]} for x in (ours, base))
    better = statistics.estimate(statistics.probability_of_improvement, *areas)
    return found | {"probability_of_improvement": limits(better)}


def published_levels(game: str, methods: Sequence[str], config: Config, until: int) -> list[plots.Level]:
    """Published scores as lines that say what differs from these runs.

    Args:
        game: of the runs.
        methods: names in srl_jax/data/published.csv, Random, or Human; one without a score here is left out.
        config: of one of the runs.
        until: env steps; of several scores of a method, the one that is nearest counts.
    """
    levels = []
    for method in methods:
        found = [entry for entry in published(game) if entry.method == method]
        if found:
            entry = min(found, key=lambda entry: abs((entry.env_steps or 0) - until))
            levels.append(plots.Level(method, entry.score, collect.differs(entry, config, until)))
    return levels


def draw(figure: Figure, numbers: Mapping[str, Any], path: Path) -> Path:
    """Draws what `evaluated` gave.

    Args:
        figure: for the thesis' curves.
        numbers: at least one game.
        path: of the PNG file.
    """
    panels = []
    for game, entry in numbers["games"].items():
        lines = []
        for arm in figure.arms:
            if (values := entry["arms"].get(arm.name)) is not None:
                ends = (np.array(values[key], float) for key in ("mean", "low", "high"))
                curve = plots.Curve(values["env_steps"], *ends)
                runs = values["runs"] if len(values["seeds"]) == TWO else ()
                lines.append(plots.Line(arm.name, curve, len(values["seeds"]), arm.thesis_curve(game), runs))
        policies = [plots.Level(name, x["mean"], x["differs"]) for name, x in entry["policies"].items()]
        levels = [plots.Level(**level) for level in entry["published"]]
        panels.append(plots.Panel(game, lines, levels, policies))
    arms = [arm for entry in numbers["games"].values() for arm in entry["arms"].values()]
    kinds = {arm["kind"] for arm in arms if len(arm["seeds"]) > TWO} - {statistics.NONE}
    notes = [f"bands: 95 % intervals over seeds at each point, {', '.join(sorted(kinds))}"] if kinds else []
    if any(len(arm["seeds"]) == TWO for arm in arms):
        notes.append("thin: both runs of an arm of two")
    note = "; ".join(notes) or "single seeds: no bands"
    if any(panel.policies for panel in panels):
        note += "; dash-dotted: policies that learn nothing"
    if numbers["forced"]:
        note += "; PROTOCOLS DIFFER between runs"
    looks = {arm: tuple(style) for arm, style in numbers["styles"].items()}
    note = "\n".join([note, *left_out_lines(numbers)])
    return plots.draw_panels(panels, path, f"{figure.name}  {figure.title}", note, looks)


def left_out_lines(numbers: Mapping[str, Any]) -> list[str]:
    """A line for each arm on a game of which seeds are left out, from what `evaluated` gave."""
    whys: dict[tuple[str, str], dict[int, str]] = {}
    for run in numbers.get("left_out", ()):
        whys.setdefault((run["game"], run["arm"]), {})[run["seed"]] = run["reason"]
    lines = []
    for (game, arm), seeds in whys.items():
        there = numbers["games"].get(game, {"arms": {}})["arms"].get(arm, {"seeds": ()})
        lines.append(f"{game}, {collect.left_out_text(arm, seeds, len(seeds) + len(there['seeds']))}")
    return lines


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, names, *_ = config_flags.kinds(values)
    options.define_flags(values)
    text(
        "figure",
        None,
        f"all; {', '.join(FIGURES)}, several with commas; {SCORES}, scores beside published ones; or a JSON "
        "file, see experiments/arms.py",
    )
    names("presets", ["atari100k/der"], f"the arms of --figure={SCORES}, may have *")
    suites = f"{', '.join(envs.SUITES)} stand for suites of Atari games"
    names("games", ["Pong"], f"to run each arm on; with --redraw all that are there; {suites}")
    text("seeds", "3", "how many seeds, 5, or which ones: 0,3,7 or 3,; with --redraw all that are there")
    text("out", "runs/figures", "directory of runs and figures")
    text(
        "published",
        "Human,Dopamine Rainbow",
        "published results to draw as lines where a game has them, names with ; or commas, as in "
        f"srl_jax/data/published.csv; of --figure={SCORES} those of its presets, or names with ;, as in "
        "srl_jax/data/atari100k_methods.csv",
    )
    yes("redraw", False, "draw from the runs that are there; start none")
    yes("force", False, "compare runs of different protocols, and say so in the figure")


def run(values: flags.FlagValues) -> int:
    """Runs what is missing of the figures that the command line asks for, and draws them.

    Args:
        values: parsed flags, as `define_flags` defines them.

    Returns:
        The exit status, the sweep's.

    Raises:
        ConfigError: the command line is not valid, and nothing was written; or runs cannot be compared.
        SaveError: a file cannot be written.
    """
    if not values["figure"].value:
        raise ConfigError(f"--figure: missing; one of all, {', '.join(FIGURES)}, {SCORES}, or a JSON file")
    of_scores = values["figure"].value == SCORES
    if values["presets"].present and not of_scores:
        raise ConfigError(f"--presets: only --figure={SCORES} takes it; a JSON file names arms of your own")
    figures = figures_named(values["figure"].value, matching(values["presets"].value) if of_scores else ())
    out = values["out"].value
    root = paths.check_place("out", out)
    if packing.is_packed(root) and not values["redraw"].value:
        raise ConfigError(
            f"--out={out}: its runs are packed; draw them with --redraw, or name another directory"
        )
    how = options.launcher_options(values)
    seeds, games = (
        parse_seeds(values["seeds"].value),
        envs.several(values["games"].value, others=bool(values["import"].value)),
    )
    given = options.given_flags(values)
    if arms := [flag for flag, mine in OWN.items() if mine == "presets" and flag in given and not of_scores]:
        raise ConfigError(f"--{arms[0]}: the figure's arms decide it; a JSON file names arms of your own")
    if values["redraw"].value:
        own = (flag for flag in ("dry_run", *options.LAUNCHER, *given) if values[flag].present)
        if flag := next((flag for flag in own if flag != "import"), None):
            raise ConfigError(f"--{flag}: --redraw starts no run; leave one of them out")
        if not (values["seeds"].present and values["games"].present):
            drawn = {arm.name for figure in figures for arm in figure.arms}
            there = [run for run in collect.load_runs(root) if run.arm in drawn]
            if not values["games"].present:
                games = sorted({run.game for run in there}) or games
            if not values["seeds"].present:
                seeds = sorted({run.seed for run in there if run.game in games}) or seeds
    runs = planned(figures, games, seeds, given)
    options.say_what_is_replaced(values, runs)
    text = values["published"].value
    if of_scores:
        if other := next((game for game in games if game not in envs.ATARI_57), None):
            raise ConfigError(f"--games={other}: published scores of --figure={SCORES} are of Atari games")
        methods = _names(text, atari100k_methods()) if values["published"].present else None
    else:
        methods = _names(text, (entry.method for game in envs.ATARI_57 for entry in published(game)))
    if values["dry_run"].value:
        workers = how["workers"] or launching.most_workers(how["cpus_per_run"])
        entries = manifest.resolve(runs)
        measured = probe.measured(root, entries, how) if of_scores else {}
        display.result("\n".join(status.dry_run(root, entries, workers, measured)))
        return 0
    if not plots.available():
        raise ConfigError("figures need matplotlib and Pillow: pip install 'srl-jax[plots]'")
    code = 0
    with saving(f"--out={out}", "stopped"):
        if not values["redraw"].value:
            code = launching.run_sweep(root, manifest.resolve(runs), **how)
            if code >= 128:  # told to end
                return code
        read = collect.load_named(root, [run.name for run in runs])
        # A game of a plug-in may have options beside those that were given, and that its directory has.
        whole = {run.path.relative_to(root).parts[0]: run.game for run in read}
        games = [whole.get(envs.file_name(game), game) for game in games]
        for line in absent(figures, games, seeds, read):
            display.say(line)
        asked = {"methods": methods, "force": values["force"].value, "among": collect.arm_names(root)}
        for figure in figures:
            draws = write_scores if of_scores else write
            try:
                print(draws(figure, read, games, root / "figures", **asked))
            except ConfigError as error:
                if not code:
                    raise
                display.say(str(error))  # of runs that failed, which the status says
    return code


def absent(
    figures: Sequence[Figure], games: Sequence[str], seeds: Sequence[int], runs: Sequence[RunData]
) -> list[str]:
    """A line for each arm on a game of which seeds that were asked for have no run; none where there is none.

    They are not in a figure's numbers: a campaign may have fewer seeds of an arm.
    """
    there = {run.key for run in runs}
    lines = []
    for game in games if there else ():
        for arm in dict.fromkeys(arm.name for figure in figures for arm in figure.arms):
            if gone := {seed: "not there" for seed in seeds if (game, arm, seed) not in there}:
                lines.append(f"{game}, {collect.left_out_text(arm, gone, len(seeds))}")
    return lines


def write(figure: Figure, runs: Sequence[RunData], games: Sequence[str], directory: Path, **how: Any) -> Path:
    """Writes a figure's numbers and its picture.

    Args:
        figure: see `evaluated`, as for runs, games and what else there is.
        directory: for NAME.json and NAME.png, which are replaced.

    Returns:
        The path of the picture.

    Raises:
        ConfigError: none of its arms has been evaluated, or see `evaluated`.
    """
    numbers = evaluated(figure, runs, games, **how)
    if not numbers["games"]:
        why = "".join(f"; {line}" for line in left_out_lines(numbers))
        raise ConfigError(f"no evaluation of any arm of {_where(figure, games, directory)}{why}")
    directory.mkdir(exist_ok=True)
    replace_text(directory / f"{figure.name}.json", json_text(numbers) + "\n")
    return draw(figure, numbers, directory / f"{figure.name}.png")


def write_scores(
    figure: Figure,
    runs: Sequence[RunData],
    games: Sequence[str],
    directory: Path,
    *,
    methods: Sequence[str] | None,
    force: bool,
    among: Iterable[str],
) -> Path:
    """Writes the scores at the end of runs beside published ones: their numbers, two tables, a picture.

    Args:
        figure: `arms.scores_figure`.
        runs, games: see `runs.scores.evaluated`.
        directory: for NAME.json, NAME.csv, NAME.md and NAME.png, which are replaced.
        methods: published ones to be beside each arm; None for those of its preset.
        force, among: see `evaluated`.

    Returns:
        The path of the picture.

    Raises:
        ConfigError: no run has a score, or see `runs.scores.evaluated`.
    """
    own = {arm.name: scores.beside(arm.preset) if methods is None else methods for arm in figure.arms}
    numbers = scores.evaluated(
        figure.name, figure.title, figure.question, runs, own, games,
        force=force, styles=styles(list(own), among),
    )  # fmt: skip
    if not numbers["games"]:
        whys = (f"; {run['game']}, {run['arm']}: {run['reason']}" for run in numbers["left_out"][:3])
        raise ConfigError(f"no score of any arm of {_where(figure, games, directory)}{''.join(whys)}")
    numbers = rounded(numbers) | {"presets": {arm.name: arm.preset for arm in figure.arms}}
    directory.mkdir(exist_ok=True)
    name = directory / figure.name
    replace_text(name.with_suffix(".json"), json_text(numbers) + "\n")
    replace_text(name.with_suffix(".csv"), score_table.as_csv(numbers))
    replace_text(name.with_suffix(".md"), score_table.as_markdown(numbers))
    return dots.draw(numbers, name.with_suffix(".png"))


def _where(figure: Figure, games: Sequence[str], directory: Path) -> str:
    return f"figure {figure.name} on {', '.join(games)} in {directory.parent}"


def _names(text: str, known: Iterable[str]) -> list[str]:
    """The names in --published: with ; between them they may have commas."""
    names = [name.strip() for name in text.split(";" if ";" in text else ",") if name.strip()]
    known = dict.fromkeys(known)
    if text.strip() in known:
        return [text.strip()]
    for name in names:
        if name not in known:
            raise ConfigError(f"--published={text}: {choices_text(name, known, '; ')}")
    return names


cli = config_flags.program(run, define_flags)

if __name__ == "__main__":
    cli()
