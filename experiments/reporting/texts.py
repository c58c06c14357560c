"""Tables and numbers of an analysis as files."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from srl_jax.errors import SaveError
from srl_jax.files.reading import replace_text


def write(out: Path, texts: Mapping[str, str]) -> None:
    """Writes texts into a directory, which is made if it is not there; files that are there are replaced.

    Args:
        out: the directory, of --out.
        texts: name of the file -> what it holds, less the last line's end.

    Raises:
        SaveError: one cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            replace_text(out / name, text + "\n")
    except OSError as error:
        raise SaveError(f"--out={out}: {error.strerror or error}") from error


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
