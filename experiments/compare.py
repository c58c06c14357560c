"""Draws the curves of several runs: `srl-jax compare runs/a runs/b --key=eval/return_mean --out=ab.png`.

Each argument is a run directory, a folder of seeds, or a folder of several arms; its runs may be packed. A
curve is named by what its settings have that the others have not. Of several seeds, the mean and its 95 % t
interval are drawn. A table has the last value and the area under the curve, and says which settings differ;
without --out, it is all that is made.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from absl import flags

from srl_jax import specs, statistics
from srl_jax.config import INFOS, SOURCES, Config
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.metrics import LEADING

from .command_line import flags as config_flags
from .command_line import paths
from .drawing import plots
from .drawing.colours import styles
from .runs import collect
from .runs.run_data import RunData

LONGEST = 40
"""Characters of a label that says what differs; where it would be longer, it is the arm's name."""

ABSENT = "-"
"""Of an option of a row, in an arm that has not the row."""


class Arm(NamedTuple):
    """One arm on one game below one of the arguments.

    Attributes:
        game: what is played.
        name: of the arm.
        place: the directory of its first seed.
        config: of that.
        curves: env steps [N] and values [N] of each seed, at least one.
        label: says in what it differs from the others.
    """

    game: str
    name: str
    place: str
    config: Config
    curves: list[tuple[np.ndarray, np.ndarray]]
    label: str = ""


def read(roots: Sequence[Path], key: str, *, force: bool = False) -> tuple[list[Arm], list[str]]:
    """The arms below directories, and lines that say which runs are left out, or are of another protocol.

    Args:
        roots: the directories.
        key: of metrics.jsonl, whose values are numbers.
        force: whether games and protocols may differ.

    Raises:
        ConfigError: there is one curve, no run has the key, or runs cannot be compared.
    """
    found: list[list[RunData]] = []
    seen: set[str] = set()  # a run by two names is one
    for root in roots:
        runs = [run for run in collect.load_runs(root) if os.path.realpath(run.path) not in seen]
        seen |= {os.path.realpath(run.path) for run in runs}
        collect.check_arms(runs)
        found += [members for arms in collect.grouped(runs).values() for members in arms.values()]
    if len(found) < 2:
        raise ConfigError(
            f"{roots[0]}: one curve; name a second run, or a folder of several; srl-jax draw draws one run"
        )
    runs = [run for members in found for run in members]
    rows = [row for run in runs for row in run.rows]
    known = {name for row in rows for name in row} - {*LEADING[:2]}
    if key not in known:
        known -= {name for row in rows for name, x in row.items() if not isinstance(x, int | float | None)}
        near = specs.near(key, known) or sorted(known)
        raise ConfigError(f"--key={key}: no run has it; there are {', '.join(near)}")
    if len(games := dict.fromkeys(run.game for run in runs)) > 1 and not force:
        raise ConfigError(
            f"--runs: of different games, {', '.join(games)}; --force compares them all the same"
        )
    notes = []
    if key.startswith(("eval/", "final/")):
        more = ("final_games",) if key.startswith("final/") else ()
        notes = collect.check_protocols(runs, force=force, more=more)
    whys = {run.path: why for run, why in collect.left_out(runs, key)}
    arms = []
    for members in found:
        path, game, name, _, config, *_ = members[0]
        if out := {run.seed: whys[run.path] for run in members if run.path in whys}:
            notes.append(f"{game}, {collect.left_out_text(name, out, len(members))}")
        curves = [collect.steps_and_values(run, key) for run in members if run.path not in whys]
        if curves := [curve for curve in curves if len(curve[0])]:
            arms.append(Arm(game, name, str(path), config, curves))
        elif not out:
            notes.append(f"{game}, {name}: has no policy")
    if not arms:
        raise ConfigError(f"--runs: nothing to draw; {'; '.join(notes)}")
    return [arm._replace(label=label) for arm, label in zip(arms, _labels(arms), strict=True)], notes


def _labels(arms: Sequence[Arm]) -> list[str]:
    """The settings that tell arms of a game apart, the first ones that do; names where these are too long."""
    labels = [""] * len(arms)
    for flag, values in differing(arms).items():
        longer = [
            old if x == ABSENT else f"{old}, {flag}={x}".removeprefix(", ")
            for old, x in zip(labels, values, strict=True)
        ]
        if len(set(longer)) > len(set(labels)):
            labels = longer
    if not all(0 < len(label) <= LONGEST for label in labels):
        labels = [arm.name for arm in arms]
    for other in ([arm.name for arm in arms], [arm.place for arm in arms]):
        if len({(arm.game, label) for arm, label in zip(arms, labels, strict=True)}) < len(arms):
            labels = other
    return labels


def differing(arms: Sequence[Arm]) -> dict[str, list[str]]:
    """The settings in which two arms that have them differ: {flag: its value in each arm, or `ABSENT`}.

    An option of a specification is a setting, too: rainbow:n_step. Of a run that they start from its arm is.
    Games, seeds, and what is written beside rows do not count.
    """
    each = [_settings(arm.config) for arm in arms]
    names = dict.fromkeys(name for settings in each for name in settings)
    found = {name: [settings.get(name, ABSENT) for settings in each] for name in names}
    return {name: values for name, values in found.items() if len({*values} - {ABSENT}) > 1}


def _settings(config: Config) -> dict[str, str]:
    return {
        f"{row}:{option}" if row else INFOS[field].flag or field: value if row else _text(field, value)
        for field, row, option, value in collect.settings(config)
        if field not in (*collect.WRITTEN, "seed")
    }


def _text(field: str, value: Any) -> str:
    """A setting; a small number as 1e-4, and of a run that it starts from, the arm."""
    if field in SOURCES:
        return collect.source_arm(value) if value else "none"
    if field == "imports":
        return " + ".join(Path(text).name for text in value) or "none"
    if isinstance(value, float) and 0 < abs(value) < 0.01:
        digits, _, power = f"{value:e}".partition("e")
        return f"{float(digits):g}e{int(power)}"
    return "off" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def table(arms: Sequence[Arm], key: str) -> str:
    """The last value and the area under the curve of each arm, and the settings in which arms differ.

    Both are up to the last env step that all curves of a game have; the area is the mean over env steps.

    Raises:
        ConfigError: curves of a game have no env step in common.
    """
    lines = []
    for game in dict.fromkeys(arm.game for arm in arms):
        members = [arm for arm in arms if arm.game == game]
        until, ends = collect.ends({i: arm.curves for i, arm in enumerate(members)})
        rows = [(f"{game}, {key}", "seeds", f"at {until:,} env steps", "area under the curve", "")]
        for i, arm in enumerate(members):
            both = (statistics.estimate(statistics.mean, {game: x}) for x in ends[i].values())
            area, last = map(_interval, both)
            rows.append((arm.label, str(len(arm.curves)), last, area, arm.place))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines += [f"  {flag}: {', '.join(values)}" for flag, values in differing(members).items()]
    return "\n".join(lines)


def _interval(interval: statistics.Interval) -> str:
    limits = "" if np.isnan(interval.low) else f" [{interval.low:.4g}, {interval.high:.4g}]"
    return f"{interval.point:.4g}{limits}"


def draw(arms: Sequence[Arm], key: str, notes: Sequence[str], path: Path, among: Iterable[str] = ()) -> None:
    """Draws the curves, a panel a game.

    An arm whose name is its own has the colour that it has in all figures of a directory; `among` is all arms
    there.
    """
    names = {arm.label: arm.name for arm in arms}
    own = len({*names.values()}) == len(names)
    looks = styles(list(names.values() if own else names), among if own else ()).values()
    panels = []
    for game in dict.fromkeys(arm.game for arm in arms):
        members = [arm for arm in arms if arm.game == game]
        policies = plots.policy_levels(members[0].config) if key == collect.RETURN else ()
        lines = [plots.Line(x.label, plots.interval_curve(x.curves), len(x.curves)) for x in members]
        panels.append(plots.Panel(game, lines, (), policies))
    bands = ["bands: 95 % t intervals over seeds"] if any(len(arm.curves) > 1 for arm in arms) else []
    note = "\n".join([*bands, *notes])
    plots.draw_panels(panels, path, "", note, dict(zip(names, looks, strict=True)), key)


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, _, texts = config_flags.kinds(values)
    texts("runs", None, "directories of runs, at least two curves; the name may be left out")
    text("key", collect.RETURN, "of metrics.jsonl, any with numbers")
    text("out", "", "picture to write, which ends in .png")
    yes("overwrite", False, "replace the picture if there is one")
    yes("force", False, "compare runs of different games, or protocols of evaluation")


def compare(values: flags.FlagValues) -> None:
    """Checks the command line, reads the runs, draws them and prints the table.

    Raises:
        ConfigError: the command line or what the runs hold is not valid; nothing was written.
        SaveError: the picture cannot be written.
    """
    if not values["runs"].value:
        raise ConfigError("--runs: missing; name two, srl-jax compare runs/a runs/b")
    roots = [paths.given("runs", text) for text in values["runs"].value]
    key, out = values["key"].value, values["out"].value
    path = paths.check_file("out", out, ".png", overwrite=values["overwrite"].value) if out else None
    if path and not plots.available():
        raise ConfigError("--out: needs matplotlib and Pillow: pip install 'srl-jax[plots]'")
    arms, notes = read(roots, key, force=values["force"].value)
    text = table(arms, key)
    for note in notes:
        display.say(note)
    if path:
        among = {name for root in roots for name in collect.arm_names(root)}
        with saving(f"--out={out}"):
            draw(arms, key, notes, path, among)
    display.result(text)


cli = config_flags.program(compare, define_flags, positional="runs")

if __name__ == "__main__":
    cli()
