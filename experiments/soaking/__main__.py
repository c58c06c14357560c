"""Tries to break what the project promises about runs that are killed, disks and inputs, and prints a table.

`python -m experiments.soaking --out=DIR` runs everything, 97 minutes on two cores; `--only=kills,damage` some
of it; `--short` the versions that the test suite runs. Exit status 1 if a promise did not hold.
"""

import importlib
import json
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.provenance import git_revision
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.specs import choices_text

from .. import flags as config_flags
from . import Count

FLAGS = flags.FLAGS

PARTS = {
    "kills": "killed runs end as if they had not been",
    "damage": "a damaged checkpoint is refused",
    "disk": "a full disk loses nothing",
    "malformed": "bad input gets one line and status 2, and nothing is written or executed",
    "emulators": "environments are the wrappers' that everybody uses; no phantom transition in replay",
    "machine": "replay does what an obvious reference does",
    "memory": "resident memory does not grow once the buffer is full",
    "cost": "checkpoints and going on are cheap",
    "sweeps": "a killed sweep, started again, ends with the same figures",
    "cluster": "a sweep on a Ray cluster survives the loss of workers and of a node",
}
"""{module of `experiments.soaking`: what it tries to break}, in the order in which they run."""


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_list(
        "only", None, f"parts to run, of {', '.join(PARTS)}; all if not given", flag_values=values
    )
    flags.DEFINE_boolean("short", False, "the short versions, a minute in all", flag_values=values)
    flags.DEFINE_string(
        "out", None, "directory for soak.md and soak.json; other parts there stay", flag_values=values
    )


class Result(NamedTuple):
    """Of one part.

    Attributes:
        revision: of the project, None where it is not known.
        short: whether it was the short version.
        seconds: it took.
        counts: its lines of the table.
    """

    revision: str | None
    short: bool
    seconds: float
    counts: list[Count]


def table(results: dict[str, Result]) -> str:
    """Markdown."""
    lines = ["| part | tried | times | failed | |", "|---|---|---|---|---|"]
    notes = []
    for part in sorted(results, key=list(PARTS).index):
        found = results[part]
        for row in found.counts:
            lines.append(f"| {part} | {row.what} | {row.number:,} | {row.failed:,} | {row.detail} |")
        short = ", short" if found.short else ""
        notes.append(f"{part} {found.seconds / 60:.1f} minutes ({str(found.revision)[:7]}{short})")
    return "\n".join(lines) + "\n\n" + ", ".join(notes) + ".\n"


def read(out: Path) -> dict[str, Result]:
    """What soak.json holds; nothing where there is none.

    Raises:
        ConfigError: the directory has something else.
    """
    if not out.is_dir() or not any(out.iterdir()):
        return {}
    try:
        content = parse_json(read_bytes(out / "soak.json", SETTINGS))
        return {
            part: Result(**{**x, "counts": [Count(**row) for row in x["counts"]]})
            for part, x in content.items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        raise ConfigError(f"--out={out}: not empty and without a soak.json; name a new directory") from None


def write(out: Path, results: dict[str, Result]) -> None:
    """soak.md and soak.json."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "soak.md").write_text(table(results), encoding="utf-8")
    content = {
        part: {**x._asdict(), "counts": [row._asdict() for row in x.counts]} for part, x in results.items()
    }
    (out / "soak.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def chosen(only: list[str] | None) -> list[str]:
    """The parts of --only, in the table's order.

    Raises:
        ConfigError: one is unknown.
    """
    for name in only or ():
        if name not in PARTS:
            raise ConfigError(f"--only={name}: {choices_text(name, PARTS)}")
    return [name for name in PARTS if not only or name in only]


def main(argv: list[str]) -> int:
    """The entry point."""
    del argv
    parts = chosen(FLAGS.only)
    out = config_flags.check_place("out", FLAGS.out) if FLAGS.out else None
    results = read(out) if out else {}
    for part in parts:
        if part in results:
            raise ConfigError(
                f"--out={FLAGS.out}: has {part} already; name a new directory, or others with --only"
            )
    for part in parts:
        soak = importlib.import_module(f"{__package__}.{part}").soak
        began, revision = time.monotonic(), git_revision()
        with tempfile.TemporaryDirectory(prefix=f"soak_{part}_") as folder:
            counts = soak(FLAGS.short, Path(folder), lambda line: print(line, flush=True))
        results[part] = Result(revision, FLAGS.short, round(time.monotonic() - began, 1), counts)
        if out is not None:  # after each part, so that what was found is not lost
            write(out, results)
    print(table(results), end="")
    return int(any(row.failed for part in parts for row in results[part].counts))


if __name__ == "__main__":
    define_flags()
    config_flags.run(main)
