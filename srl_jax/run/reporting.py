"""Reports of a run: rows of metrics.jsonl and of loggers, progress, and the means between two rows."""

import contextlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax.config import Config
from srl_jax.errors import saving
from srl_jax.files import display
from srl_jax.files.display import Display, Progress
from srl_jax.files.loggers import Loggers
from srl_jax.files.metrics import Mark, MetricsWriter, read_metrics
from srl_jax.run.evaluate import Evaluation

SOMETIMES = ("grad_norm/", "step_ratio/")
"""How the names of metrics begin that only some updates measure: `srl_jax.learning.optim.NOT_MEASURED`."""


class Means:
    """The mean of each metric over the updates that measured it.

    Metrics whose names begin with one of `SOMETIMES` are negative where they were not measured. Sums are
    float64, in the order of the updates.
    """

    def __init__(self):
        self._sums: dict[str, tuple[float, int]] = {}
        self._broken: list[str] = []

    def add(self, metrics: Mapping[str, Any]) -> None:
        """Takes an update's metrics, scalars on the host."""
        # After the first update with one that is not finite no loss is: its parameters are not, either.
        self._broken = self._broken or [
            name for name, x in metrics.items() if name.startswith("loss/") and not np.isfinite(x)
        ]
        for name, x in metrics.items():
            if not (name.startswith(SOMETIMES) and x < 0):
                total, count = self._sums.get(name, (0.0, 0))
                self._sums[name] = total + float(x), count + 1

    def broken(self) -> str | None:
        """The losses that were NaN or infinite in the first update, since the last row, with one; or None."""
        parts = [name for name in self._broken if name != "loss/total"]
        return ", ".join(sorted(parts or self._broken)) or None

    def take(self) -> dict[str, np.float32]:
        """The means, and starts anew."""
        sums, self._sums, self._broken = self._sums, {}, []
        return {name: np.float32(total / count) for name, (total, count) in sums.items()}

    def snapshot(self) -> dict[str, list]:
        """As JSON values, exact."""
        return {name: [total.hex(), count] for name, (total, count) in self._sums.items()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from there."""
        self._sums = {name: (float.fromhex(total), count) for name, (total, count) in snapshot.items()}


class Report:
    """metrics.jsonl, loggers and progress of one run; a context in which they are open.

    Args:
        out: the run directory.
        config: of the run.
        progress: whether to draw a progress bar on stderr.
    """

    def __init__(self, out: Path, config: Config, *, progress: bool):
        self.path = Path(out or ".") / "metrics.jsonl"
        self._config = config
        self._stream = None if progress else Display(None)
        self.progress = Progress(config.steps, stream=self._stream)
        self._say = self.progress.note if progress else display.say
        self.means = Means()
        self._started = time.perf_counter()
        self._return_sum, self._episodes = 0.0, 0  # of training episodes that ended since the last row
        self._last_row = 0.0, 0  # seconds, env steps
        self._mark: Mark | None = None

    def __enter__(self) -> "Report":
        """Opens them.

        Raises:
            ConfigError: a logger cannot be made, or metrics.jsonl is not what a checkpoint knows.
            SaveError: it cannot be opened.
        """
        texts, config = self._config.loggers, json.loads(self._config.to_json())
        resumed = self._mark is not None
        with contextlib.ExitStack() as stack:
            # First: what refuses a run that begins leaves nothing there.
            self._loggers = Loggers(texts, self.path.parent, config, self._say, resumed=resumed)
            stack.callback(self._loggers.close)
            self._writer = stack.enter_context(MetricsWriter(self.path, self._mark))
            if texts:
                self._loggers.rows(read_metrics(self.path))
            self._opened = stack.pop_all()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: Any) -> None:
        self.progress.close()
        # After an error a row was not written, or worse, and the caller is told that.
        with saving(self.path, "not closed") if error is None else contextlib.suppress(OSError):
            self._opened.close()

    @property
    def seconds(self) -> float:
        """Since the run began, without those between being killed and being resumed."""
        return time.perf_counter() - self._started

    def ended(self, returns: np.ndarray) -> None:
        """Takes the raw scores of training episodes that have ended, float64 [n]."""
        for score in returns.tolist():
            self._return_sum += score
            self._episodes += 1

    def train_row(self, env_steps: int, updates: int, values: Mapping[str, Any]) -> None:
        """A "train" row: the values, and means over the updates and episodes since the last one."""
        now = self.seconds
        wall, steps = self._last_row
        mean = self._return_sum / self._episodes if self._episodes else None
        own = {
            "train/episodes": self._episodes,
            "train/return_mean": mean,
            "wall_steps_per_s": (env_steps - steps) / max(now - wall, 1e-9),
        }
        values = {**values, **own, **self.means.take()}
        self._write("train", env_steps, updates, now, values)
        shown = {n.removeprefix("loss/"): v for n, v in values.items() if n.startswith("loss/")}
        shown.pop("total", None)
        if mean is not None:
            shown["return"] = mean
        self.progress.update(env_steps, **shown)
        self._last_row = now, env_steps
        self._return_sum, self._episodes = 0.0, 0

    def bar(self, total: int, unit: str) -> Progress:
        """A progress bar in place of the run's, whose last state stays, that counts so many of something."""
        self.progress.close()
        return Progress(total, unit, stream=self._stream)

    def eval_row(self, env_steps: int, updates: int, values: Mapping[str, Any], kind: str = "eval") -> None:
        """A row of an evaluation."""
        self._write(kind, env_steps, updates, self.seconds, values)

    def evaluation(
        self,
        kind: str,
        env_steps: int,
        updates: int,
        played: Evaluation,
        seconds: float,
        values: Mapping[str, Any],
    ) -> float:
        """A row of games and of other values of the same moment; the mean return.

        Args:
            kind: "eval" or "final", with which the keys begin; a final one also has other statistics.
            env_steps, updates: of that moment.
            played: the games.
            seconds: that they took.
            values: others of the row.
        """
        returns, games = np.array(played.returns), len(played.returns)
        mean = float(returns.mean())
        own = {"return_mean": mean, "returns": played.returns, "lengths": played.lengths}
        if kind == "final":
            own |= {
                "return_std": returns.std(ddof=1) if games > 1 else None,
                "return_median": np.median(returns),
                "length_mean": np.mean(played.lengths),
                "games": games,
            }
        row = {f"{kind}/{name}": value for name, value in own.items()} | {f"wall_{kind}_s": round(seconds, 3)}
        self.eval_row(env_steps, updates, row | dict(values), kind)
        what = "final evaluation" if kind == "final" else "evaluation"
        took = f"{games} games, {seconds:.1f} s"
        if played.cut:
            took += f", {played.cut} of them cut at {self._config.eval_max_steps} env steps"
        self.progress.note(f"{what} after {env_steps} env steps: mean return {mean:.2f} over {took}")
        return mean

    def pictures(self, env_steps: int, drawn: Mapping[str, tuple[np.ndarray, ...]]) -> None:
        """Gives loggers a picture for each objective: a row of examples for each of its arrays.

        Args:
            env_steps: of now.
            drawn: {objective: (inputs, targets, outputs)}, float [B, H, W, C] each, 1 white.
        """
        for name, arrays in drawn.items() if self._config.loggers else ():
            picture = np.concatenate([np.concatenate(list(images), 1) for images in arrays])
            picture = np.rint(picture.clip(0, 1) * 255).astype(np.uint8)
            self._loggers.picture(f"pictures/{name}", env_steps, picture)

    def _write(self, kind: str, env_steps: int, updates: int, seconds: float, values: Mapping) -> None:
        with saving(self.path, "a row was not written"):
            row = self._writer.write(kind, env_steps, updates, seconds, values)
        self._loggers.rows([row])

    def snapshot(self) -> dict[str, Any]:
        """As JSON values; rows written so far are flushed to disk."""
        with saving(self.path, "not flushed"):
            mark = self._writer.mark()
        return {
            "metrics": mark._asdict(),
            "seconds": self.seconds,
            "last_row": list(self._last_row),
            "returns": [self._return_sum, self._episodes],
            "means": self.means.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from there, by way of JSON; before the report is entered, which cuts metrics.jsonl back."""
        self._mark = Mark(**snapshot["metrics"])
        self._started = time.perf_counter() - snapshot["seconds"]
        self._last_row = tuple(snapshot["last_row"])
        self._return_sum, self._episodes = snapshot["returns"]
        self.means.restore(snapshot["means"])
