"""Packs the runs of a campaign: `python -m experiments.packing runs/figures --out=experiments/results/NAME`.

Two files take the place of a directory for each run. configs.json has a configuration for each arm on each
game, and what is each run's own. rows.jsonl.gz has the rows of all runs, each with its game, arm and seed:
`pandas.read_json("rows.jsonl.gz", lines=True)`. Figures and reports read such a folder as they read run
directories. Whatever else lies in the folder stays, and runs of other seeds, arms and games can be added
later; a run that is under way is left out, and so is one that was stopped, which could be resumed, but for
`--stopped`. `--unpack` makes the run directories again.
"""

import gzip
import itertools
import json
import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from absl import flags

from srl_jax import config as config_file
from srl_jax.config import INFOS, Config
from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.metrics import parse_row
from srl_jax.files.reading import ROWS as MOST_BYTES
from srl_jax.files.reading import read_bytes, read_json, replace_bytes, replace_text
from srl_jax.run import ending
from srl_jax.run.ending import Ending

from .command_line import flags as config_flags
from .command_line import paths
from .runs.run_data import RunData, check_arm, check_rows, in_order, is_seed, load_run, run_directories

CONFIGS = "configs.json"
"""[{"arm": its name, "config": the fields that its runs on a game share, "runs": [{"path": below the folder,
"config": its own fields, "ended": as ended.json, or null}]}], sorted as the runs are."""
ROWS = "rows.jsonl.gz"
"""A row a line, {"game", "arm", "seed", and what metrics.jsonl has}: a run's rows follow each other."""
KEYS = ("game", "arm", "seed")
FIELDS = {name: place for place, name in enumerate(INFOS)}
OWN = ("seed", "started", "continued")
"""The fields of config.json that are a run's own, even where an arm has a single run."""


def is_packed(folder: Path) -> bool:
    """Whether runs are packed in this folder."""
    return (folder / CONFIGS).is_file()


def read(folder: Path, *, only_last: bool = False, mend: bool = False) -> list[RunData]:
    """Reads packed runs, as `run_data.load_run` gives them from their directories.

    Args:
        folder: that they are packed in.
        only_last: whether to read the last row of each run alone, which is ten times as fast.
        mend: whether to leave out rows of runs that configs.json does not have, of which it says so: an
            addition was killed between the two files, the second of which is configs.json.

    Raises:
        ConfigError: a file cannot be read, or is not what `write` writes.
    """
    entries, rows = _entries(folder), _rows(folder / ROWS, only_last)
    runs = []
    for arm, about, run in entries:
        path = folder / CONFIGS
        try:
            config = Config.from_values(about)
            ended = Ending(**run["ended"]) if run["ended"] else None
            below, arm = Path(run["path"]), check_arm(arm, path)
            if below.is_absolute() or ".." in below.parts:
                raise TypeError(f"{below} is not below the folder")
        except (KeyError, TypeError) as error:
            raise ConfigError(f"{path}: not what packing writes ({error})") from None
        except ConfigError as error:
            raise ConfigError(f"{path}: {run.get('path')}: {error}") from None
        its = rows.pop((config.game, arm, config.seed), [])
        check_rows(its, f"{folder / ROWS}: {run['path']}")
        runs.append(RunData(folder / below, config.game, arm, config.seed, config, its, ended, about))
    if rows:
        said = f"{folder / ROWS}: rows of {_name(*next(iter(rows)))}, which {CONFIGS} does not have"
        if not mend:
            raise ConfigError(f"{said}; packing the same runs again mends it")
        display.say(f"{said}: left out")
    return runs


def arms(folder: Path) -> list[str]:
    """The names of the arms that are packed in a folder, whose rows are not read.

    Raises:
        ConfigError: the file cannot be read, or is not what `write` writes.
    """
    return [arm for arm, _, _ in _entries(folder)]


def write(folder: Path, runs: Iterable[RunData]) -> None:
    """Writes packed runs in place of those that a folder has. The same runs give the same bytes.

    Args:
        folder: made if it is not there.
        runs: of paths below the folder; none twice.

    Raises:
        ConfigError: a row has a key that packing needs.
        OSError: a file could not be written.
    """
    runs = in_order(runs)
    lines = []
    for run in runs:
        if clash := next((key for row in run.rows for key in KEYS if key in row), None):
            raise ConfigError(f"{run.path}: its rows have a key {clash!r}, which packing needs")
        key = dict(zip(KEYS, run.key, strict=True))
        lines += [json.dumps({**key, **row}, allow_nan=False) + "\n" for row in run.rows]
    groups: dict[tuple, list[RunData]] = {}
    for run in runs:
        groups.setdefault((run.game, run.arm), []).append(run)
    configs = [_arm(folder, members) for members in groups.values()]
    folder.mkdir(parents=True, exist_ok=True)
    replace_bytes(folder / ROWS, gzip.compress("".join(lines).encode(), mtime=0))
    replace_text(folder / CONFIGS, json.dumps(configs, indent=1) + "\n")


def added(here: Sequence[RunData], more: Iterable[RunData]) -> list[RunData]:
    """Runs and those among others that they do not have.

    Raises:
        ConfigError: one of the others has the game, arm and seed of a run that has other rows or settings, or
            the path of one that has others.
    """
    runs = {run.key: run for run in here}
    places = {run.path: run for run in here}
    for run in more:
        if (there := places.setdefault(run.path, run)).key != run.key:
            raise ConfigError(
                f"{run.path}: the place of {_name(*there.key)} and of {_name(*run.key)}; pack them together, "
                "from the directory above both, or into two folders"
            )
        there = runs.setdefault(run.key, run)
        for what, same in (("rows", there.rows == run.rows), ("settings", there.config == run.config)):
            if not same:
                raise ConfigError(
                    f"{run.path}: {_name(*run.key)} is there with other {what}, from {there.path}; "
                    "pack it into another folder"
                )
    return list(runs.values())


def pack(root: Path, folder: Path, *, stopped: bool = False) -> tuple[int, int, list[Path]]:
    """Adds the runs in or below a directory to those that are packed in a folder.

    A run that is under way, was stopped or killed is left out: it may still get other rows.

    Args:
        root: a run keeps its path below it; where it is a run itself, its name, and that of its arm.
        folder: made if it is not there.
        stopped: whether to add runs that were stopped, too: nobody will resume them.

    Returns:
        How many runs were added, how many there are, and the directories of those that were left out.

    Raises:
        ConfigError: there is no run, or see `added`, `read` and `run_data.load_run`; nothing was written.
        OSError: a file could not be written.
    """
    root = Path(os.path.abspath(root))  # "." has a name, too
    found = [load_run(path) for path in run_directories(root)]
    if not found:
        raise ConfigError(f"--runs={root}: no run directory there (none has a config.json)")
    here = read(folder, mend=True) if is_packed(folder) else []
    ready = [run.over or (stopped and run.ended is not None) for run in found]
    whole = added([], itertools.compress(found, ready))
    above = root.parent if found[0].path == root else root
    if any(is_seed(run.path.relative_to(above).as_posix()) for run in found):
        above = above.parent  # which has the arm's name
    runs = added(here, (run._replace(path=folder / run.path.relative_to(above)) for run in whole))
    if len(runs) > len(here):
        write(folder, runs)
    left_out = [run.path for run, is_ready in zip(found, ready, strict=True) if not is_ready]
    return len(runs) - len(here), len(runs), left_out


def unpack(folder: Path, root: Path) -> int:
    """Makes the directories of packed runs: config.json, metrics.jsonl and ended.json.

    A run that had all its env steps before there was an ended.json gets one, by which sweeps and figures know
    that it is done.

    Args:
        folder: the packed one.
        root: where each run gets the path that it had; made if it is not there.

    Returns:
        How many runs there are.

    Raises:
        ConfigError: see `read`; or a run's directory is there, and nothing was written.
        OSError: a file could not be written.
    """
    runs = {root / run.path.relative_to(folder): run for run in read(folder)}
    if there := next((path for path in runs if (path / "config.json").exists()), None):
        raise ConfigError(f"{there}: a run is there; name another directory")
    for path, run in runs.items():
        path.mkdir(parents=True, exist_ok=True)
        config_file.write(path, run.about)
        replace_text(path / "metrics.jsonl", "".join(json.dumps(row) + "\n" for row in run.rows))
        if ended := run.ended or (Ending("finished", run.rows[-1]["env_steps"]) if run.over else None):
            ending.write(path, ended)
    return len(runs)


def _name(game: str, arm: str, seed: int) -> str:
    return f"{game}, {arm}, seed {seed}"


def _arm(folder: Path, runs: Sequence[RunData]) -> dict[str, Any]:
    """The entry of an arm on a game in configs.json."""
    abouts = [{name: run.about[name] for name in sorted(run.about, key=_place)} for run in runs]
    texts = [{name: json.dumps(value) for name, value in about.items()} for about in abouts]
    shared = [name for name in abouts[0] if name not in OWN and len({text.get(name) for text in texts}) == 1]
    return {
        "arm": runs[0].arm,
        "config": {name: abouts[0][name] for name in shared},
        "runs": [
            {
                "path": run.path.relative_to(folder).as_posix(),
                "config": {name: value for name, value in about.items() if name not in shared},
                "ended": run.ended and run.ended._asdict(),
            }
            for run, about in zip(runs, abouts, strict=True)
        ],
    }


def _place(name: str) -> tuple[int, str]:
    """A key for sorting what config.json holds: the fields of Config in their order, then the others."""
    return FIELDS.get(name, len(FIELDS)), name


def _entries(folder: Path) -> list[tuple[str, dict[str, Any], Mapping[str, Any]]]:
    """(arm, the content of config.json, the run's entry) of each run in configs.json."""
    path = folder / CONFIGS
    found = read_json(path, MOST_BYTES)
    try:
        return [(arm["arm"], {**arm["config"], **run["config"]}, run) for arm in found for run in arm["runs"]]
    except (TypeError, KeyError) as error:
        raise ConfigError(f"{path}: not what packing writes ({error})") from None


def _rows(path: Path, only_last: bool) -> dict[tuple[str, str, int], list[dict[str, Any]]]:
    """{(game, arm, seed): its rows, as metrics.jsonl has them}."""
    found: dict[tuple, list[dict[str, Any]]] = {}
    try:
        lines = gzip.decompress(read_bytes(path, MOST_BYTES)).splitlines()
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ConfigError(f"{path}: damaged ({error})") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    runs = [line.partition(b', "kind"')[0] for line in lines]
    for number, (line, run, after) in enumerate(zip(lines, runs, [*runs, b""][1:], strict=True), 1):
        if only_last and run == after:
            continue
        try:
            row = parse_row(line)
            key = tuple(row.pop(name) for name in KEYS)
            found.setdefault(key, []).append(row)
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}, line {number}: not what packing writes ({error})") from None
    return found


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, *_ = config_flags.kinds(values)
    text("runs", None, "directory in or below which the runs are")
    text("out", None, "folder of the campaign; runs are added to it")
    yes("unpack", False, "make the directories of the runs that are packed in --runs")
    yes("stopped", False, "pack runs that were stopped, too, which nobody will resume")


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    for name in ("runs", "out"):
        if not values[name].value:
            raise ConfigError(f"--{name}: missing; name a directory")
    if values.unpack and values.stopped:
        raise ConfigError("--stopped: --unpack makes all runs that are packed; leave it out")
    runs, out = paths.given("runs", values.runs), paths.check_place("out", values.out)
    if not runs.is_dir():
        raise ConfigError(f"--runs={values.runs}: no such directory")
    one, other = runs.resolve(), out.resolve()
    if one == other or (not values.unpack and (one in other.parents or other in one.parents)):
        raise ConfigError(f"--out={values.out}: name a folder that is neither in --runs nor around it")
    with saving(f"--out={out}"):
        if values.unpack:
            print(f"{out}: {unpack(runs, out)} runs unpacked")
        else:
            more, count, left_out = pack(runs, out, stopped=values.stopped)
            for path in left_out:
                display.say(f"{path}: left out: it is under way, or was stopped or killed and can be resumed")
            print(f"{out}: {more} runs added, {count} in all")


cli = config_flags.program(main, define_flags, positional="runs")

if __name__ == "__main__":
    cli()
