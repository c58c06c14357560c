"""Where rows go beside metrics.jsonl: `REGISTRY[name](out, config, **options) -> Logger`. Imports no jax.

`--logger=csv,wandb:project=mine` names rows of the registry, `--logger=my_file.py:Mine` a class of your own.
`register` adds a row, see `srl_jax.plugins`.
"""

import csv
import importlib
import io
import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from srl_jax import plugins
from srl_jax.errors import ConfigError, saving
from srl_jax.files.reading import SETTINGS, parse_json, read_bytes, replace_text
from srl_jax.plugins import Registry
from srl_jax.specs import parse

FILE = "loggers.json"
"""In a run directory: {logger: how many rows of metrics.jsonl it has been given}, without final ones, of
which "LOGGER final" has the env step of the last, and one."""
WRITTEN = (FILE, "metrics.csv", "tensorboard", "wandb")
"""What this module writes into a run directory."""


class Logger(Protocol):
    """Takes a run's rows while it goes; made with the run directory and config.json's fields.

    It is called from the training loop, and should not keep it waiting. These methods may be missing:
    `hyperparameters(config)`, called each time that the run starts or is resumed, and
    `picture(key, env_step, array)`, of a uint8 array [H, W, C] with C of 1 or 3.
    """

    def row(self, env_step: int, values: Mapping[str, float]) -> None:
        """Takes the numbers of a row of metrics.jsonl by their keys, `updates` and `wall_s` among them."""

    def close(self) -> None:
        """Ends the log; the run is over, or stopped."""


class CSV:
    """metrics.csv: a column for each key, in the order of their first appearance; a row has empty cells."""

    def __init__(self, out: Path, config: Mapping[str, Any]):
        self._path = out / "metrics.csv"
        text = self._path.read_text(encoding="utf-8") if self._path.exists() else ""
        whole = text[: text.rfind("\n") + 1]  # a process that was killed may have left half a line
        if whole != text:
            replace_text(self._path, whole)
        self._columns = next(csv.reader(io.StringIO(whole)), [])

    def row(self, env_step: int, values: Mapping[str, float]) -> None:
        """Appends a line; the file is written anew where a key is new."""
        row = {"env_steps": env_step, **values}
        new = [key for key in row if key not in self._columns]
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns + new, lineterminator="\n")
        if new:
            writer.writeheader()
            if self._columns:
                writer.writerows(csv.DictReader(io.StringIO(self._path.read_text(encoding="utf-8"))))
            self._columns += new
        writer.writerow(row)
        if new:
            replace_text(self._path, text.getvalue())
        else:
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(text.getvalue())

    def close(self) -> None:
        """Does nothing: each line is in the file already."""


class TensorBoard:
    """Event files in tensorboard/, with env steps as the step, written without TensorFlow."""

    requires = "tensorboardX"

    def __init__(self, out: Path, config: Mapping[str, Any]):
        from tensorboardX import SummaryWriter

        self._events = SummaryWriter(str(out / "tensorboard"))

    def row(self, env_step: int, values: Mapping[str, float]) -> None:
        """Writes a scalar for each number."""
        for key, value in values.items():
            self._events.add_scalar(key, value, env_step)
        self._events.flush()

    def hyperparameters(self, config: Mapping[str, Any]) -> None:
        """Writes what the HParams tab shows, beside the last evaluation and the final one."""
        from tensorboardX.summary import hparams

        texts = {name: x if isinstance(x, bool | int | float) else str(x) for name, x in config.items()}
        kinds = ("eval", "final") if config.get("final_games") else ("eval",)
        for summary in hparams(texts, {f"{kind}/return_mean": None for kind in kinds}):
            self._events.file_writer.add_summary(summary)

    def picture(self, key: str, env_step: int, array: np.ndarray) -> None:
        """Writes an image; needs Pillow."""
        self._events.add_image(key, array, env_step, dataformats="HWC")
        self._events.flush()

    def close(self) -> None:
        """Closes the event file."""
        self._events.close()


class WandB:
    """A run of Weights & Biases. Its id is kept in wandb/run_id: a resumed run resumes it there, too.

    Args:
        out: the run directory, which names the run.
        config: not read; `hyperparameters` gets it.
        project: empty: the environment variable WANDB_PROJECT, or srl_jax.
    """

    requires = "wandb"

    def __init__(self, out: Path, config: Mapping[str, Any], *, project: str = ""):
        import wandb

        self._image = wandb.Image
        file = out.absolute() / "wandb/run_id"
        file.parent.mkdir(exist_ok=True)
        if not file.exists():
            replace_text(file, uuid.uuid4().hex)
        self._run = wandb.init(
            project=project or os.environ.get("WANDB_PROJECT", "srl_jax"),
            name=str(out),
            dir=str(out.absolute()),
            id=file.read_text().strip(),
            resume="allow",
            reinit="create_new",  # several seeds in one process are a run each
        )
        self._run.define_metric("*", step_metric="env_steps")

    def row(self, env_step: int, values: Mapping[str, float]) -> None:
        """Logs the numbers, with env_steps as the axis of their charts."""
        self._run.log({"env_steps": env_step, **values})

    def hyperparameters(self, config: Mapping[str, Any]) -> None:
        """Sets the run's config."""
        self._run.config.update(dict(config), allow_val_change=True)

    def picture(self, key: str, env_step: int, array: np.ndarray) -> None:
        """Logs an image."""
        self._run.log({"env_steps": env_step, key: self._image(array)})

    def close(self) -> None:
        """Finishes the run there, once everything is sent."""
        self._run.finish()


REGISTRY = Registry("loggers", {"tensorboard": TensorBoard, "wandb": WandB, "csv": CSV})
register = REGISTRY.register


def listed(texts: Iterable[str]) -> tuple[str, ...]:
    """What config.json keeps of the values of --logger, each of which may be a list with commas.

    Raises:
        ConfigError: a file of `my_file.py:Mine` is not there.
    """
    found = []
    for text in (part.strip() for list_ in texts for part in re.split(",(?![^,:]*=)", list_)):
        if text not in ("", "none"):
            module, name = _own(text)
            found.append(f"{plugins.located(module, 'logger')}:{name}" if module else text)
    return tuple(found)


def factory(text: str) -> Callable[[Path, Mapping[str, Any]], Logger]:
    """What makes a logger of a run directory and config.json's fields.

    Args:
        text: `name:key=value,...` of a row, or `module:Class`, as `listed` gives it.

    Raises:
        ConfigError: there is no such row, option, module or class, or a package is missing.
    """
    module, name = _own(text)
    if module:
        found = getattr(plugins.imported(module, "logger"), name, None)
        if not callable(found):
            raise ConfigError(f"--logger={text}: {module} has no class {name}")
        return found
    spec = parse(text, REGISTRY, "logger")
    row = REGISTRY[spec.name]
    if package := getattr(row, "requires", ""):
        try:
            importlib.import_module(package)
        except ImportError:
            raise ConfigError(f"--logger={text}: needs {package}: pip install {package}") from None
    return lambda out, config: row(out, config, **spec.resolved)


def check(texts: Sequence[str]) -> None:
    """Whether loggers can be made, as far as that is known before a run begins.

    Raises:
        ConfigError: see `factory`; or one is given twice, or two of the same name.
    """
    for number, text in enumerate(texts):
        if texts.count(text) > 1:
            raise ConfigError(f"--logger={text}: given twice")
        if other := next((other for other in texts[:number] if _key(other) == _key(text)), None):
            raise ConfigError(f"--logger={text}: named as {other} is; rename one of the two")
    for text in texts:
        factory(text)


class Loggers:
    """The loggers of a run, each of which is given each row of metrics.jsonl once.

    How many rows each one has is kept in `FILE`. Rows that a killed run had written after its last checkpoint
    come again once it is resumed, and are not given again. What a logger lacks, because it raised an error or
    was not there before, it is given when the run is resumed.

    A logger that raises an error is left out from then on, which a line says: it ends no run. One that cannot
    even be made is an error where a run begins.

    Args:
        texts: as `listed` gives them.
        out: the run directory.
        config: config.json's fields.
        say: takes a line for whoever watches.
        resumed: whether the run is.

    Raises:
        ConfigError: one cannot be made, or `FILE` is not what this class writes.
    """

    def __init__(
        self,
        texts: Sequence[str],
        out: Path,
        config: Mapping[str, Any],
        say: Callable[[str], None],
        resumed: bool = False,
    ):
        self._path, self._say = out / FILE, say
        self._had = _read(self._path) if texts else {}
        self._rows = 0
        self._loggers: dict[str, Logger] = {}
        for text in texts:
            try:
                self._loggers[text] = factory(text)(out, config)
            except Exception as error:
                if not resumed:
                    raise ConfigError(f"--logger={text}: {plugins.reason(error)}") from error
                self._leave_out(text, error)
        self._each("hyperparameters", config)

    def rows(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Takes the next rows of metrics.jsonl, beginning with its first.

        Raises:
            SaveError: `FILE` could not be written.
        """
        for row in rows:
            numbers = {key: x for key, x in row.items() if isinstance(x, int | float) and key != "env_steps"}
            place, kind = self._rows, ""
            if row.get("kind") == "final":  # counted apart: an extended run has another row in its place
                place, kind = row["env_steps"], " final"
            lack = [text for text in self._loggers if self._had.get(_key(text) + kind, 0) <= place]
            self._rows += not kind
            self._each("row", row["env_steps"], numbers, among=lack)
            self._had |= {_key(text) + kind: place + 1 for text in lack if text in self._loggers}
        if self._loggers:
            with saving(self._path):
                replace_text(self._path, json.dumps(self._had) + "\n")

    def picture(self, key: str, env_step: int, array: np.ndarray) -> None:
        """Gives a picture, uint8 [H, W, C], to those that take some."""
        self._each("picture", key, env_step, array)

    def close(self) -> None:
        """Closes all of them."""
        self._each("close")
        self._loggers = {}

    def _each(self, method: str, *arguments: Any, among: Iterable[str] | None = None) -> None:
        for text in list(self._loggers) if among is None else among:
            try:
                getattr(self._loggers[text], method, lambda *_: None)(*arguments)
            except Exception as error:
                del self._loggers[text]
                self._leave_out(text, error)

    def _leave_out(self, text: str, error: Exception) -> None:
        self._say(f"logger {text}: {plugins.reason(error)}; it is left out from now on")


def _own(text: str) -> tuple[str, str]:
    """The module and the class of `module:Class`; empty where a text is not of that form."""
    module, colon, name = text.rpartition(":")
    return (module, name) if colon and name.isidentifier() else ("", "")


def _key(text: str) -> str:
    """A logger's name in `FILE`: the same where its file has moved."""
    file, _, name = text.rpartition(":")
    return f"{file.rpartition('/')[2]}:{name}" if file.endswith(".py") else text


def _read(path: Path) -> dict[str, int]:
    try:
        had = parse_json(read_bytes(path, SETTINGS))
        if not (isinstance(had, dict) and all(type(x) is int for x in had.values())):
            raise ValueError("not numbers of rows")
        return had
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: {reason}; without it, loggers are given all rows again") from None
