"""What is measured: groups of workers that take turns, and the rows of the table that their answers make.

A series is named WORKER.NAME: what the worker's side returns as NAME from each turn. numpy only.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import runtime


class Program(NamedTuple):
    """A worker.

    Attributes:
        side: MODULE.CLASS of this package.
        arguments: the class'.
        turn: how much is done in a turn, {what is counted: number}.
        twin: this project's worker whose weights it loads, and whose losses its own must equal; "" for none.
    """

    side: str
    arguments: Mapping[str, Any]
    turn: Mapping[str, int] = {}
    twin: str = ""

    @property
    def is_other(self) -> bool:
        """Whether it runs in the environment of `make bench-install`."""
        return self.side.split(".")[0] in ("torch_side", "tianshou_side")


class Spread(NamedTuple):
    """A median over rounds and its quartiles, linearly interpolated."""

    median: float
    low: float
    high: float


class Row(NamedTuple):
    """A row of the table, and its goals.

    Attributes:
        title, unit: shown.
        ours: a series.
        theirs: {label: series}; of several the one with the least median counts, so they must be times.
        faster: the least that the ratio should be, which is then that of theirs to ours for a time.
        cost: the most that the ratio, ours to theirs, should be.
        limit: the most that ours should be, in the unit.
    """

    title: str
    unit: str
    ours: str
    theirs: Mapping[str, str] = {}
    faster: float | None = None
    cost: float | None = None
    limit: float | None = None

    @property
    def goal(self) -> str:
        """The goals in words; a ratio has no unit."""
        found = [] if self.faster is None else [f">= {self.faster:g}"]
        found += [] if self.cost is None else [f"<= {self.cost:g}"]
        found += [] if self.limit is None else [f"<= {self.limit:g} {self.unit}"]
        return ", ".join(found) or "-"

    def figures(self, replies: Mapping[str, Sequence[Sequence[float]]]) -> dict[str, Any]:
        """What the row shows.

        Args:
            replies: {series: the repetitions of each round}. What counts of a round is its median.

        Returns:
            "ours" and, where there is another side, "theirs" and "ratio", each a `Spread`; ratios are formed
            round by round. "label", which of the other side's series counts; "met", whether the goals are.
        """
        medians = {name: [float(np.median(x)) for x in rounds] for name, rounds in replies.items()}
        ours = medians[self.ours]
        found: dict[str, Any] = {"ours": spread(ours), "theirs": None, "ratio": None, "label": ""}
        if self.theirs:
            label = min(self.theirs, key=lambda name: np.median(medians[self.theirs[name]]))
            theirs = medians[self.theirs[label]]
            of_times = self.faster is not None and not self.unit.endswith("/s")
            ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
            ratios = [1 / ratio for ratio in ratios] if of_times else ratios
            found |= {"theirs": spread(theirs), "ratio": spread(ratios), "label": label}
        ratio = found["ratio"].median if found["ratio"] else math.nan
        met = (
            self.faster is None or ratio >= self.faster,
            self.cost is None or ratio <= self.cost,
            self.limit is None or found["ours"].median <= self.limit,
        )
        return found | {"met": all(met)}

    def cells(self, found: Mapping[str, Any] | None) -> list[str]:
        """The line of the table; without figures it says that the row was skipped."""
        if found is None:
            return [self.title, "skipped", "not installed", "-", self.goal, "-"]
        theirs = "-"
        if found["theirs"]:
            theirs = f"{spread_text(found['theirs'], self.unit)}, {found['label']}"
        ratio = spread_text(found["ratio"]) if found["ratio"] else "-"
        met = "-" if self.goal == "-" else "yes" if found["met"] else "no"
        return [self.title, spread_text(found["ours"], self.unit), theirs, ratio, self.goal, met]


def spread(values: Sequence[float]) -> Spread:
    """Of one figure a round."""
    low, median, high = np.percentile(values, (25, 50, 75)).tolist()
    return Spread(median, low, high)


def number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}" if value else "0"


def spread_text(found: Spread, unit: str = "") -> str:
    """`median unit (low to high)`."""
    middle = f"{number(found.median)} {unit}".strip()
    return middle if found.low == found.high else f"{middle} ({number(found.low)} to {number(found.high)})"


class Group(NamedTuple):
    """Workers that are alive together and take turns.

    Attributes:
        programs: {name: worker}; a twin comes before what loads from it.
        rows: {name that --only takes: row}.
        rounds: takes part in at most so many.
    """

    programs: Mapping[str, Program]
    rows: Mapping[str, Row]
    rounds: int = 1_000_000

    def needed(self, rows: Sequence[str]) -> dict[str, Program]:
        """The workers of some of its rows."""
        series = {name for row in rows for name in (self.rows[row].ours, *self.rows[row].theirs.values())}
        names = {name.split(".")[0] for name in series}
        names |= {self.programs[name].twin for name in names}
        return {name: program for name, program in self.programs.items() if name in names}


THREADS = runtime.cores()
"""PyTorch's."""

FORMATS = {"PyTorch contiguous": "contiguous_format", "PyTorch channels last": "channels_last"}
"""Of images and kernels."""


def _ours(preset: str, updates: int, **overrides: Any) -> Program:
    """An update in this project."""
    return Program("jax_side.Updates", {"preset": preset, **overrides}, {"updates": updates})


def _both(name: str, preset: str, updates: int, **overrides: Any) -> dict[str, Program]:
    """An update in this project and, in each format, in PyTorch."""
    found = {name: _ours(preset, updates, **overrides)}
    for label, memory_format in FORMATS.items():
        arguments = {"preset": preset, "threads": THREADS, "memory_format": memory_format, **overrides}
        found[f"{name} {label}"] = Program("torch_side.Updates", arguments, {"updates": updates}, twin=name)
    return found


def _beside_pytorch(title: str, name: str, faster: float) -> Row:
    """The row of what `_both` has."""
    theirs = {label: f"{name} {label}.update" for label in FORMATS}
    return Row(f"update {title}", "ms", f"{name}.update", theirs, faster=faster)


def _cost(title: str, ours: str, theirs: str, label: str, cost: float | None = None) -> Row:
    """The row of one update beside another one of this project."""
    return Row(title, "ms", f"{ours}.update", {label: f"{theirs}.update"}, cost=cost)


NATURE, JOINT = "thesis/rl_only_nature", "thesis/joint_256"

UPDATE = Group(
    _both("nature", NATURE, 60),
    {"update_nature": _beside_pytorch("rl_only nature", "nature", 1.8)},
)

UPDATES_OF_256 = Group(
    {
        **_both("256", "thesis/rl_only_256", 24),
        **_both("joint", JOINT, 12),
        **_both("summed", JOINT, 12, encoder_optimizer="summed"),
        "simultaneous": _ours(JOINT, 12, encoder_optimizer="simultaneous"),
        "joint4": _ours(JOINT, 4, srl_every=4),
    },
    {
        "update_256": _beside_pytorch("rl_only 256", "256", 1.25),
        "update_joint": _beside_pytorch("joint 256, two Adams in turn", "joint", 1.3),
        "update_summed": _beside_pytorch("joint 256, one Adam", "summed", 1.3),
        "separate_cost": _cost(
            "two Adams in turn / one Adam, joint 256", "joint", "summed", "one Adam", 1.35
        ),
        "simultaneous_cost": _cost("two Adams at once / one Adam", "simultaneous", "summed", "one Adam"),
        "joint_cost": _cost("joint, one Adam / rl_only, updates of 256", "summed", "256", "rl_only", 1.7),
        "joint_cost_4": _cost("two Adams and srl_every=4 / rl_only", "joint4", "256", "rl_only", 1.2),
    },
)

_RATE = "env_steps_per_s"
LOOP = Group(
    {
        "loop": Program("host_side.Loop", {"preset": NATURE}, {"env_steps": 300, "iterations": 30}),
        "tianshou": Program("tianshou_side.Loop", {"threads": THREADS}, {"env_steps": 300}),
    },
    {
        "loop": Row(
            "loop Pong nature", "env steps/s", f"loop.{_RATE}", {"Tianshou": f"tianshou.{_RATE}"}, faster=2.5
        ),
        "overlap": Row(
            "loop / slower half",
            "ms",
            "loop.iteration",
            {"acting or update alone": "loop.slower half"},
            cost=1.12,
        ),
        "busy": Row("cores that the loop keeps busy", "cores", "loop.busy"),
    },
)

_SAMPLE, _INSERT = {"numpy gather": "replay.gather"}, {"env step": "replay.env step"}
REPLAY = Group(
    {"replay": Program("host_side.Replay", {"preset": NATURE}, {"samples": 1000, "inserts": 200})},
    {
        "replay_sample": Row(
            "replay sample + set priorities", "ms", "replay.sample", _SAMPLE, cost=2.0, limit=0.3
        ),
        "replay_insert": Row("replay insert", "ms", "replay.add", _INSERT, cost=0.05),
    },
)

STARTUP = Group(
    {"run": Program("train_side.Startup", {"preset": JOINT})},
    {"startup": Row("start to first update, joint 256, warm cache", "s", "run.startup", limit=12.0)},
    rounds=3,
)

_FRAMES = {"the frames alone": "run.frames"}
MEMORY = Group(
    {"run": Program("train_side.Memory", {"preset": NATURE}, {"buffer_size": 100_000})},
    {"memory": Row("peak memory, buffer 100,000", "GB", "run.memory", _FRAMES, limit=1.6)},
    rounds=1,
)

GROUPS = (UPDATE, UPDATES_OF_256, LOOP, REPLAY, STARTUP, MEMORY)
"""The table, in order."""
