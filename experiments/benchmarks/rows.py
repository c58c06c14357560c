"""What is measured: groups of workers that take turns, and the rows of the table that their answers make.

A series is named WORKER.NAME: what the worker's side returns as NAME from each turn. numpy only.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..command_line import runtime


class Program(NamedTuple):
    """A worker.

    Attributes:
        side: MODULE.CLASS.
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
        return self.side.rpartition(".")[0] in (".torch_side", ".tianshou_side")


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        title, unit: shown.
        ours: a series.
        theirs: {label: series}; of several the one with the least median counts, so they must be times.
        goal: shown: of the ratio, or of ours where it has a unit.
        speedup: the ratio is theirs to ours; else ours to theirs.
    """

    title: str
    unit: str
    ours: str
    theirs: Mapping[str, str] = {}
    goal: str = ""
    speedup: bool = False

    @property
    def series(self) -> tuple[str, ...]:
        """All that it is made of."""
        return self.ours, *self.theirs.values()

    def figures(self, replies: Mapping[str, Sequence[Sequence[float]]]) -> dict[str, Any]:
        """What the row shows.

        Args:
            replies: {series: the repetitions of each round}. What counts of a round is its median, and a
                ratio is formed round by round.

        Returns:
            "ours", "theirs" and "ratio", as of `spread`; "label", which of theirs counts. Nothing where a
            series was not measured.
        """
        if not replies.keys() >= set(self.series):
            return {}
        medians = {
            name: [float(np.median(repetitions)) for repetitions in replies[name]] for name in self.series
        }
        ours = medians[self.ours]
        if not self.theirs:
            return {"ours": spread(ours)}
        label = min(self.theirs, key=lambda label: np.median(medians[self.theirs[label]]))
        theirs = medians[self.theirs[label]]
        pairs = zip(theirs, ours, strict=True) if self.speedup else zip(ours, theirs, strict=True)
        ratio = spread([a / b for a, b in pairs])
        return {"ours": spread(ours), "theirs": spread(theirs), "ratio": ratio, "label": label}

    def cells(self, replies: Mapping[str, Sequence[Sequence[float]]]) -> list[str]:
        """The line of the table; without replies it says that the row was skipped."""
        found = self.figures(replies)
        if not found:
            return [self.title, "skipped", "not installed", "-", self.goal or "-"]
        ours, theirs, ratio = spread_text(found["ours"], self.unit), "-", "-"
        if "theirs" in found:
            theirs = f"{spread_text(found['theirs'], self.unit)}, {found['label']}"
            ratio = spread_text(found["ratio"])
        return [self.title, ours, theirs, ratio, self.goal or "-"]


def spread(values: Sequence[float]) -> dict[str, float]:
    """The median and the quartiles ("low", "high"; linearly interpolated) of one figure a round."""
    return dict(zip(("low", "median", "high"), np.percentile(values, (25, 50, 75)).tolist(), strict=True))


def number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}" if value else "0"


def spread_text(found: Mapping[str, float], unit: str = "") -> str:
    """`median unit (low to high)`."""
    low, median, high = (number(found[name]) for name in ("low", "median", "high"))
    return f"{median} {unit}".strip() + ("" if low == high else f" ({low} to {high})")


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
        names = {series.split(".")[0] for row in rows for series in self.rows[row].series}
        names |= {self.programs[name].twin for name in names}
        return {name: program for name, program in self.programs.items() if name in names}


THREADS = runtime.cores()
"""PyTorch's."""

FORMATS = {"PyTorch contiguous": "contiguous_format", "PyTorch channels last": "channels_last"}
"""Of images and kernels."""


def _ours(preset: str, updates: int, **overrides: Any) -> Program:
    """An update in this project."""
    return Program(".jax_side.Updates", {"preset": preset, **overrides}, {"updates": updates})


def _both(name: str, preset: str, updates: int, **overrides: Any) -> dict[str, Program]:
    """An update in this project and, in each format, in PyTorch."""
    found = {name: _ours(preset, updates, **overrides)}
    for label, memory_format in FORMATS.items():
        arguments = {"preset": preset, "threads": THREADS, "memory_format": memory_format, **overrides}
        found[f"{name} {label}"] = Program(".torch_side.Updates", arguments, {"updates": updates}, twin=name)
    return found


def _beside_pytorch(title: str, name: str, goal: str) -> Row:
    """The row of what `_both` has."""
    theirs = {label: f"{name} {label}.update" for label in FORMATS}
    return Row(f"update {title}", "ms", f"{name}.update", theirs, goal, speedup=True)


def _cost(title: str, ours: str, theirs: str, label: str, goal: str = "") -> Row:
    """The row of one update beside another one of this project."""
    return Row(title, "ms", f"{ours}.update", {label: f"{theirs}.update"}, goal)


NATURE, JOINT, SMALL = "thesis/rl_only_nature", "thesis/joint_256", "small/rl_only_256"
DER = "atari100k/der"

UPDATE = Group(
    _both("nature", NATURE, 60), {"update_nature": _beside_pytorch("rl_only nature", "nature", ">= 1.8")}
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
        "update_256": _beside_pytorch("rl_only 256", "256", ">= 1.25"),
        "update_joint": _beside_pytorch("joint 256, two Adams in turn", "joint", ">= 1.3"),
        "update_summed": _beside_pytorch("joint 256, one Adam", "summed", ">= 1.3"),
        "separate_cost": _cost("two Adams in turn / one Adam", "joint", "summed", "one Adam", "<= 1.35"),
        "simultaneous_cost": _cost("two Adams at once / one Adam", "simultaneous", "summed", "one Adam"),
        "joint_cost": _cost("joint 256, one Adam / rl_only 256", "summed", "256", "rl_only", "<= 1.7"),
        "joint_cost_4": _cost("two Adams and srl_every=4 / rl_only", "joint4", "256", "rl_only", "<= 1.2"),
    },
)

_TIANSHOU = {"Tianshou": "tianshou.rate"}
_HALF = {"acting or update alone": "loop.slower half"}
LOOP = Group(
    {
        "loop": Program(".host_side.Loop", {"preset": NATURE}, {"env_steps": 300, "iterations": 30}),
        "tianshou": Program(".tianshou_side.Loop", {"threads": THREADS}, {"env_steps": 300}),
    },
    {
        "loop": Row("loop Pong nature", "env steps/s", "loop.rate", _TIANSHOU, ">= 2.5"),
        "overlap": Row("loop / slower half", "ms", "loop.iteration", _HALF, "<= 1.12"),
        "busy": Row("cores that the loop keeps busy", "cores", "loop.busy"),
    },
)

_GATHER, _STEP = {"numpy gather": "replay.gather"}, {"env step": "replay.env step"}
REPLAY = Group(
    {"replay": Program(".host_side.Replay", {"preset": NATURE}, {"samples": 1000, "inserts": 200})},
    {
        "replay_sample": Row(
            "replay sample + set priorities", "ms", "replay.sample", _GATHER, "<= 2, <= 0.3 ms"
        ),
        "replay_insert": Row("replay insert", "ms", "replay.add", _STEP, "<= 0.05"),
    },
)

STARTUP = Group(
    {"startup": Program(".train_side.Startup", {"preset": JOINT})},
    {"startup": Row("start to first update, joint 256, warm cache", "s", "startup.seconds", goal="< 12 s")},
    rounds=3,
)


def _der_and(name: str) -> Program:
    """An update of DER and an objective, one Adam on the sum."""
    return _ours(DER, 100, mode="joint", objectives=(name,), encoder_optimizer="summed")


def _beside_der(name: str, goal: str) -> Row:
    return _cost(f"der and {name} / der", f"der {name}", "der", "der alone", goal)


_HALF_OF_DER = {"acting or update alone": "der loop.slower half"}
OF_DER = Group(
    {
        **_both("der", DER, 100),
        **{f"der {name}": _der_and(name) for name in ("spr", "reconstruction", "infonce")},
        "der loop": Program(".host_side.Loop", {"preset": DER}, {"env_steps": 200, "iterations": 200}),
    },
    {
        "update_der": _beside_pytorch("atari100k/der", "der", ">= 2.2, <= 6 ms"),
        "der_spr": _beside_der("spr", "<= 2.2"),
        "der_reconstruction": _beside_der("reconstruction", "<= 1.5"),
        "der_infonce": _beside_der("infonce", "<= 1.6"),
        "loop_der": Row("loop Pong der, one environment", "env steps/s", "der loop.rate"),
        "overlap_der": Row("loop der / slower half", "ms", "der loop.iteration", _HALF_OF_DER, "<= 1.1"),
    },
)

_FRAMES = {"the frames alone": "memory.frames"}
MEMORY = Group(
    {"memory": Program(".train_side.Memory", {"preset": NATURE}, {"buffer_size": 100_000})},
    {"memory": Row("peak memory, buffer 100,000", "GB", "memory.peak", _FRAMES, "<= 1.6 GB")},
    rounds=1,
)

GROUPS = (UPDATE, UPDATES_OF_256, OF_DER, LOOP, REPLAY, STARTUP, MEMORY)
"""The table, in order."""

NAMES = (
    "reconstruction forward_pixels vae forward_latent spr byol vicreg barlow infonce slowness inverse reward "
    "terminal bisimulation latent_l2"
).split()
OBJECTIVES = dict(zip(NAMES, NAMES, strict=True)) | {
    "reconstruction_moving": "reconstruction:moving=10",
    "forward_latent_5": "forward_latent:steps=5",
    "infonce_temporal": "infonce:temporal=3",
}
"""{name: specification}; the last ones are arms of results/catch_objectives."""


def _objective(name: str, text: str) -> Group:
    """What an objective adds to an update of RL alone, at the size of Catch, one Adam on the sum."""
    beside = _ours(SMALL, 60, mode="joint", objectives=(text,), encoder_optimizer="summed")
    alone = f"alone beside {name}"  # a name of its own: both take turns
    row = _cost(f"RL and {name} / RL", name, alone, "RL alone")
    return Group({alone: _ours(SMALL, 60), name: beside}, {f"objective_{name}": row})


OF_OBJECTIVES = tuple(_objective(*item) for item in OBJECTIVES.items())
"""Another table, `--only=objectives`."""
