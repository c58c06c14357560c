"""Tries to break what the project promises about runs that are killed, disks and inputs, and prints a table.

`python -m experiments.soak --out=DIR` runs everything, about an hour on two cores; `--only=kills,damage` some
of it; `--short` the versions that the test suite runs. Exit status 1 if a promise did not hold.
"""

import importlib
import json
import tempfile
import time
from pathlib import Path

from absl import flags

from experiments import flags as config_flags
from experiments.soaking import Count
from srl_jax.config import git_revision, versions
from srl_jax.errors import ConfigError
from srl_jax.specs import choices_text

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
}
"""{module of `experiments.soaking`: what it tries to break}, in the order in which they run."""


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_list(
        "only", None, f"parts to run, of {', '.join(PARTS)}; all if not given", flag_values=values
    )
    flags.DEFINE_boolean("short", False, "the short versions, a minute in all", flag_values=values)
    flags.DEFINE_string("out", None, "new directory for soak.md and soak.json", flag_values=values)


def table(counts: dict[str, list[Count]], seconds: dict[str, float]) -> str:
    """Markdown."""
    lines = ["| part | tried | times | failed | |", "|---|---|---|---|---|"]
    for part, rows in counts.items():
        for row in rows:
            lines.append(f"| {part} | {row.what} | {row.number:,} | {row.failed:,} | {row.detail} |")
    took = ", ".join(f"{part} {value / 60:.1f}" for part, value in seconds.items())
    return "\n".join(lines) + f"\n\nMinutes: {took}.\n"


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
    if out is not None and out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"--out={FLAGS.out}: not empty; name a new directory")
    counts, seconds = {}, {}
    for part in parts:
        soak = importlib.import_module(f"experiments.soaking.{part}").soak
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix=f"soak_{part}_") as folder:
            counts[part] = soak(FLAGS.short, Path(folder), lambda line: print(line, flush=True))
        seconds[part] = time.monotonic() - began
        if out is not None:  # after each part, so that what was found is not lost
            write(out, counts, seconds)
    print(table(counts, seconds), end="")
    return int(any(row.failed for rows in counts.values() for row in rows))


def write(out: Path, counts: dict[str, list[Count]], seconds: dict[str, float]) -> None:
    """soak.md and soak.json."""
    out.mkdir(parents=True, exist_ok=True)
    revision = git_revision()
    head = f"`python -m experiments.soak`{' --short' if FLAGS.short else ''}, revision {revision}.\n\n"
    (out / "soak.md").write_text(head + table(counts, seconds), encoding="utf-8")
    content = {
        "revision": revision,
        "versions": versions(),
        "short": FLAGS.short,
        "seconds": seconds,
        "counts": {part: [row._asdict() for row in rows] for part, rows in counts.items()},
    }
    (out / "soak.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    define_flags()
    config_flags.run(main)
