"""What an analysis writes: --out, and tables and numbers as files."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from absl import flags

from srl_jax.errors import ConfigError, saving
from srl_jax.files.reading import replace_text

from ..command_line import paths
from ..drawing import plots


def define_out(files: str, values: flags.FlagValues) -> None:
    """Defines --out; `files` names what is written there."""
    flags.DEFINE_string("out", "", f"directory for {files}", values)


def place(given: str, *, drawn: bool) -> Path | None:
    """The directory of --out, which can be written to; None without one.

    Args:
        given: the value of --out.
        drawn: whether a picture goes there, which needs the extra plots.

    Raises:
        ConfigError: it cannot, or a picture cannot be drawn.
    """
    out = paths.check_place("out", given) if given else None
    if drawn and out is not None and not plots.available():
        raise ConfigError("--out: needs matplotlib and Pillow: pip install 'srl-jax[plots]'")
    return out


def write(out: Path, texts: Mapping[str, str]) -> None:
    """Writes texts into a directory, which is made if it is not there; files that are there are replaced.

    Args:
        out: the directory, of --out.
        texts: name of the file -> what it holds, less the last line's end.

    Raises:
        SaveError: one cannot be written.
    """
    with saving(f"--out={out}"):
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            replace_text(out / name, text + "\n")


def interval(values: Mapping[str, Any], form: str) -> str:
    """The text of an interval's mean and limits, of `json_values.limits`; - for a limit that there is not."""
    low, high = ("-" if values[key] is None else format(values[key], form) for key in ("low", "high"))
    return f"{values['mean']:{form}} [{low}, {high}]"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
