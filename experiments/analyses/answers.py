"""Draws again what the answers stand on: `python -m experiments.analyses.answers`, or `make answers`.

Every figure whose numbers and packed runs are in results/ is drawn again, every analysis is made again, and
every number that docs/answers.md marks is computed again. The table at the head of that page is README's as
well. It says which files have changed; the status is 1 if one has.

A mark is a comment that says what the text behind it is, up to the next empty comment. It is the difference
of two arms' areas under the learning curve, an arm less its baseline, of all seeds or of those that are
named. Two of them with a minus between are the difference of two differences. What is told from 0 after a
correction for all differences of the page is bold. Or it is a number of a JSON file, found by keys, with a
format at the end:

    <!--catch_separate Catch joint_256 rl_only_256 10-14-->-0.55 [-0.71, -0.39]<!---->
    <!--interval_claims/claims.json; nothing; 5; bootstrap; share; .0%-->11 %<!---->
"""

import functools
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import statistics
from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.files.reading import ROWS, read_json, replace_text

from .. import packing
from ..arms import SCORES
from ..command_line import flags as config_flags
from ..runs import collect
from ..runs.run_data import RunData
from .criteria import CRITERIA, WRITTEN
from .populations import LEVEL, RESULTS

ROOT = RESULTS.parents[1]
PAGE, README = ROOT / "docs" / "answers.md", ROOT / "README.md"
ANALYSES = {
    "claims": "interval_claims",
    "coverage": "coverage",
    "objectives": "catch_objectives_table",
    "predictors": "diagnostics_predict",
}
"""{module: the folder of results that it writes}."""
MARK = re.compile(r"(<!--(?P<what>[^>]+?)-->)(?P<text>[^<]*)(<!---->)")
WEIGHTS = (1, -1, -1, 1)
"""Of an arm and its baseline, and of those whose difference is taken off."""
HEAD = re.compile(r"(<!--head-->\n)(.*?)(\n<!--end-->)", re.DOTALL)
"""The table at the head of the page, in README, too."""


def filled(page: str, results: Path = RESULTS) -> str:
    """A page, its marked numbers computed again.

    Args:
        page: Markdown with marks.
        results: where campaigns are.

    Raises:
        ConfigError: a mark means nothing, or runs or a number are not there.
    """
    marks = dict.fromkeys(mark["what"] for mark in MARK.finditer(page))
    texts = {what: number(what, results) for what in marks if ";" in what}
    groups = {what: difference(what, results) for what in marks if ";" not in what}
    bold = surviving(groups)
    for what, arms in groups.items():
        found = statistics.contrast(arms, WEIGHTS[: len(arms)])
        text = f"{found.point:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"
        texts[what] = f"**{text}**" if what in bold else text
    return MARK.sub(lambda mark: f"{mark[1]}{texts[mark['what']]}{mark[4]}", page)


def surviving(differences: Mapping[str, Sequence[np.ndarray]]) -> set[str]:
    """The differences that are told from 0 after Holm's correction for all of them (Holm 1979).

    Args:
        differences: name -> runs of each arm, as `difference` gives them.
    """
    tests = [statistics.contrast_p(arms, WEIGHTS[: len(arms)]) for arms in differences.values()]
    return {name for name, p in zip(differences, statistics.holm(tests), strict=True) if p < LEVEL}


def number(what: str, results: Path = RESULTS) -> str:
    """The number of a JSON file that a mark means, see `filled`."""
    path, *keys, form = (part.strip() for part in what.split(";"))
    found = read_json(results / path, ROWS)
    for key in keys:
        found = _inside(found, key, what)
    try:
        return format(found, form).replace("%", " %")
    except (TypeError, ValueError) as error:
        raise ConfigError(f"<!--{what}-->: {error}") from None


def difference(what: str, results: Path = RESULTS) -> list[np.ndarray]:
    """The areas of the two or four arms that a mark means, float64 [runs] each, see `filled`."""
    parts = [part.split() for part in what.split(" - ")]
    if len(parts) > 2 or any(len(words) not in (4, 5) for words in parts):
        raise ConfigError(
            f"<!--{what}-->: expected CAMPAIGN GAME ARM BASELINE, a second one behind a minus if need be, "
            "each with FIRST-LAST behind it where not all seeds count; or FILE; KEY; ...; FORMAT"
        )
    return [
        area
        for campaigns, game, *arms, seeds in ((*words[:4], words[4:]) for words in parts)
        for area in areas(results, campaigns, game, arms, *seeds)
    ]


def _inside(values: Any, key: str, what: str) -> Any:
    """A value of an object or a list; of a list of objects those in which one value is the key."""
    if isinstance(values, dict) and key in values:
        return values[key]
    if isinstance(values, list) and all(isinstance(row, dict) for row in values):
        if kept := [row for row in values if key in map(str, row.values())]:
            return kept if len(kept) > 1 else kept[0]
    elif isinstance(values, list) and key.isdigit() and int(key) < len(values):
        return values[int(key)]
    raise ConfigError(f"<!--{what}-->: there is no {key!r}")


def areas(results: Path, campaigns: str, game: str, arms: Sequence[str], seeds: str = "") -> list[np.ndarray]:
    """The areas under the learning curves of arms, as figures compare them, float64 [runs] each.

    Args:
        results: where campaigns are.
        campaigns: in which the runs are, with + between them.
        game: that they are of.
        arms: their names.
        seeds: FIRST-LAST; "" for all.

    Raises:
        ConfigError: a run is not there, is there twice or failed, or runs cannot be compared.
    """
    every = [run for part in campaigns.split("+") for run in _runs(results / part)]
    first, _, last = seeds.partition("-")
    if seeds and not (first.isdigit() and last.isdigit()):
        raise ConfigError(f"{seeds}: expected the seeds as FIRST-LAST, 10-14")
    found: dict[str, list[RunData]] = {}
    for arm in arms:
        own = [run for run in every if (run.game, run.arm) == (game, arm)]
        there = sorted(run.seed for run in own)
        wanted = list(range(int(first), int(last) + 1)) if seeds else sorted(set(there))
        missing = [seed for seed in wanted if there.count(seed) != 1]
        if missing or not own:
            where = f"{results / campaigns}: {arm} on {game}"
            raise ConfigError(f"{where} has not one run of each of its seeds, see {missing or 'none'}")
        found[arm] = [run for run in own if run.seed in wanted]
    compared = [run for runs in found.values() for run in runs]
    collect.check_arms(compared)
    collect.check_protocols(compared)
    if left := collect.left_out(compared):
        raise ConfigError(f"{left[0][0].path}: cannot be compared: {left[0][1]}")
    curves = {arm: [collect.steps_and_returns(run) for run in runs] for arm, runs in found.items()}
    return [ends["area_under_curve"] for ends in collect.ends(curves)[1].values()]


@functools.cache
def _runs(folder: Path) -> Sequence[RunData]:
    return packing.read(folder)


def head(page: str) -> str:
    """The table at the head of the page as README has it: without marks, its links from there."""
    found = HEAD.search(page)
    if found is None:
        raise ConfigError(f"{PAGE}: has no table between <!--head--> and <!--end-->")
    return MARK.sub(lambda mark: mark["text"], found[2]).replace("](../", "](")


def commands(results: Path = RESULTS) -> Iterator[tuple[str, list[str]]]:
    """(what it is, the arguments of Python) of each program that draws or computes again."""
    for path in sorted(results.glob("*/figures/*.json")):
        numbers = read_json(path, ROWS)
        if not isinstance(numbers, dict) or not packing.is_packed(path.parents[1]):
            continue
        given = path.parents[1] / path.name
        scores = numbers["figure"] == SCORES
        arms = numbers["arms"].values() if scores else numbers["games"].values()
        of_game = [values for arm in arms for values in arm["games" if scores else "arms"].values()]
        left = numbers.get("left_out", ())
        games = dict.fromkeys([*numbers["games"], *(run["game"] for run in left)])
        seeds = sorted(
            {run["seed"] for run in left} | {seed for values in of_game for seed in values["seeds"]}
        )
        figure = str(given) if given.exists() else numbers["figure"]
        arguments = [f"--figure={figure}", f"--games={','.join(games)}"]
        if scores:
            arguments.append(f"--presets={','.join(numbers['presets'].values())}")
        if numbers["forced"]:
            arguments.append("--force")
        yield (
            f"{path.parents[1].name}/{path.stem}",
            [
                "-m", "experiments.figures", "--redraw", *arguments,
                f"--seeds={','.join(map(str, seeds))},", f"--out={path.parents[1]}",
            ],
        )  # fmt: skip
    for module, folder in ANALYSES.items():
        yield folder, ["-m", f"experiments.analyses.{module}", f"--out={results / folder}"]
    for folder in with_criteria(results):
        given = [f"--campaign={folder}", f"--out={folder}"]
        yield f"criteria of {folder.name}", ["-m", "experiments.analyses.criteria", *given]


def with_criteria(results: Path = RESULTS) -> list[Path]:
    """The packed campaigns whose criteria are data and were computed before: not those that are under way."""
    found = [path.parent for path in sorted(results.glob(f"*/{CRITERIA}"))]
    return [path for path in found if packing.is_packed(path) and (path / WRITTEN[0]).is_file()]


def contents(results: Path = RESULTS) -> dict[Path, bytes]:
    """What is drawn or computed again: the pages, and numbers and pictures of campaigns and analyses."""
    names = [name.split("/") for name, _ in commands(results) if "/" in name]
    paths = [path for folder, name in names for path in (results / folder / "figures").glob(f"{name}.*")]
    paths += [
        path
        for folder in ANALYSES.values()
        for path in (results / folder).iterdir()
        if path.name != "README.md"
    ]
    paths += [
        folder / name for folder in with_criteria(results) for name in WRITTEN if (folder / name).exists()
    ]
    return {path: path.read_bytes() for path in [PAGE, README, *paths]}


def main(_: flags.FlagValues) -> int:
    """The entry point."""
    before, todo = contents(), list(commands())
    with display.Progress(len(todo), "redrawn") as progress:
        for done, (what, arguments) in enumerate(todo):
            progress.update(done, now=what)
            ran = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True)
            if ran.returncode:
                said = ran.stderr.strip().splitlines() or [f"exit status {ran.returncode}"]
                raise ConfigError(f"{what}: {said[-1]}")
        progress.update(len(todo))
    page = filled(PAGE.read_text(encoding="utf-8"))
    replace_text(PAGE, page)
    readme = README.read_text(encoding="utf-8")
    replace_text(README, HEAD.sub(lambda found: f"{found[1]}{head(page)}{found[3]}", readme))
    after = contents()
    changed = [str(path.relative_to(ROOT)) for path in after if after[path] != before.get(path)]
    lines = [f"{len(after) - len(changed)} files are as they were, byte for byte"]
    display.result("\n".join(lines + [f"changed: {name}" for name in changed]))
    return int(bool(changed))


if __name__ == "__main__":
    config_flags.program(main, lambda values: None)()
