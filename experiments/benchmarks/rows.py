"""What is measured: workers, what each is asked once a round, and the rows of the table."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .table import Goal


class Side(NamedTuple):
    """A worker.

    Attributes:
        group: workers of one group are alive together and take turns.
        module: of `experiments.benchmarks`.
        arguments: of its command.
        setup: the first request, {"do": ..., arguments}; of PyTorch's side without what it loads.
        warm: requests whose replies are thrown away.
        needs: the package that it is about, "" for this project.
        twin: this project's worker whose weights it loads, and whose losses its own must equal.
        rounds: takes part in at most so many.
        seconds: roughly, of setting up and of a round, for the time left.
    """

    group: str
    module: str
    arguments: tuple[str, ...] = ()
    setup: dict[str, Any] | None = None
    warm: tuple[dict[str, Any], ...] = ()
    needs: str = ""
    twin: str = ""
    rounds: int = 1_000_000
    seconds: tuple[float, float] = (15.0, 3.0)


class Series(NamedTuple):
    """One thing that is measured.

    Attributes:
        side: the worker.
        request: asked once a round; series of one worker with equal requests share the reply.
        pick: the reply -> the round's repetitions, in the row's unit.
    """

    side: str
    request: dict[str, Any]
    pick: Callable[[dict[str, Any]], list[float]]


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        title, unit: shown.
        ours: a series.
        theirs: {label: series}; see `table.figures`.
        goals: as there.
        speedup: as there.
    """

    title: str
    unit: str
    ours: str
    theirs: dict[str, str]
    goals: tuple[Goal, ...]
    speedup: bool = False


def _scaled(name: str, factor: float) -> Callable[[dict[str, Any]], list[float]]:
    return lambda reply: [factor * value for value in reply[name]]


def _means_of_4(reply: dict[str, Any]) -> list[float]:
    return (1e3 * np.reshape(reply["seconds"], (-1, 4)).mean(1)).tolist()


def _rate(reply: dict[str, Any]) -> list[float]:
    return [reply["env_steps"] / reply["seconds"]]


def _slower_part(reply: dict[str, Any]) -> list[float]:
    return [1e3 * max(float(np.median(reply[name])) for name in ("acting", "update"))]


ARMS = {
    "nature": ("rl_only_nature", "separate"),
    "256": ("rl_only_256", "separate"),
    "joint": ("joint_256", "separate"),
    "summed": ("joint_256", "summed"),
}
"""{short name: (arm of the thesis, how its encoder is stepped)} of the updates that are compared."""

_UPDATES = {
    "nature": 60,
    "256": 24,
    "joint": 12,
    "summed": 12,
    "simultaneous": 12,
    "joint4": 16,
}  # in a round
_SECONDS = {"nature": (10, 1.5), "256": (20, 2), "joint": (35, 4), "summed": (35, 3)}
FORMATS = ("contiguous", "channels_last")
CHECK_UPDATES = 2
"""Updates whose losses must be equal; the second one's depend on the first one's gradients."""


def _ours(group: str, short: str, arm: str, **overrides: Any) -> Side:
    return Side(
        group,
        "jax_side",
        ("nature" if arm.endswith("nature") else "sac_ae",),
        {"do": "setup", "preset": f"thesis/{arm}", **overrides},
        ({"do": "time", "updates": 8},),
        seconds=_SECONDS.get(short, _SECONDS["joint"]),
    )


def _torch(group: str, short: str, arm: str, form: str, memory_format: str) -> Side:
    return Side(
        group,
        "torch_side",
        setup={"do": "setup", "arm": arm, "memory_format": memory_format, "encoder_optimizer": form},
        warm=({"do": "time", "updates": 5},),
        needs="torch",
        twin=f"jax {short}",
        seconds=(8, 1.8 * _SECONDS[short][1]),
    )


SIDES: dict[str, Side] = {}
SERIES: dict[str, Series] = {}
for _short, (_arm, _form) in ARMS.items():
    _group = "nature" if _short == "nature" else "256"
    SIDES[f"jax {_short}"] = _ours(_group, _short, _arm, encoder_optimizer=_form)
    for _format in FORMATS:
        SIDES[f"torch {_short} {_format}"] = _torch(_group, _short, _arm, _form, _format)
SIDES["jax simultaneous"] = _ours("256", "simultaneous", "joint_256", encoder_optimizer="simultaneous")
SIDES["jax joint4"] = _ours("256", "joint4", "joint_256", srl_every=4)
for _name in SIDES:
    _request = {"do": "time", "updates": _UPDATES[_name.split()[1]]}
    SERIES[_name] = Series(_name, _request, _scaled("seconds", 1e3))
SERIES["jax joint4"] = SERIES["jax joint4"]._replace(pick=_means_of_4)

_LOOP = {"do": "setup", "preset": "thesis/rl_only_nature"}
_REPLAY = {"do": "fill"}
_STARTUP = {"do": "startup", "preset": "thesis/joint_256"}
_MEMORY = {"do": "memory", "preset": "thesis/rl_only_nature", "updates_per_step": 0.005}
_RUN = {"do": "run", "env_steps": 300}
_PARTS = {"do": "parts", "iterations": 30}
_SAMPLE = {"do": "sample", "repetitions": 1000}
_INSERT = {"do": "insert", "steps": 200}
SIDES |= {
    "loop": Side("loop", "host_side", ("nature",), _LOOP, (_RUN,), seconds=(15, 4)),
    "tianshou": Side("loop", "tianshou_side", (), {"do": "setup"}, (_RUN,), "tianshou", seconds=(15, 4)),
    "replay": Side("replay", "host_side", ("nature",), _REPLAY, seconds=(10, 2)),
    # The first start fills jax' cache.
    "startup": Side("startup", "train_side", warm=(_STARTUP,), rounds=3, seconds=(25, 12)),
    "memory": Side("memory", "train_side", rounds=1, seconds=(1, 120)),
}
SERIES |= {
    "loop": Series("loop", _RUN, _rate),
    "tianshou": Series("tianshou", _RUN, _rate),
    "iteration": Series("loop", _PARTS, _scaled("iteration", 1e3)),
    "slower part": Series("loop", _PARTS, _slower_part),
    "busy": Series("loop", _PARTS, _scaled("busy", 1.0)),
    "sample": Series("replay", _SAMPLE, _scaled("sample", 1e3)),
    "gather": Series("replay", _SAMPLE, _scaled("gather", 1e3)),
    "add": Series("replay", _INSERT, _scaled("add", 1e3)),
    "env step": Series("replay", _INSERT, _scaled("step", 1e3)),
    "startup": Series("startup", _STARTUP, _scaled("seconds", 1.0)),
    "memory": Series("memory", _MEMORY, _scaled("bytes", 1e-9)),
    "frames": Series("memory", _MEMORY, _scaled("frames", 1e-9)),
}


def _update(short: str, title: str, least: float) -> Row:
    theirs = {f"PyTorch {name.replace('_', ' ')}": f"torch {short} {name}" for name in FORMATS}
    return Row(f"update {title}", "ms", f"jax {short}", theirs, (Goal("ratio", ">=", least),), speedup=True)


def _at_most(limit: float) -> tuple[Goal, ...]:
    return (Goal("ratio", "<=", limit),)


ROWS: dict[str, Row] = {
    "update_nature": _update("nature", "rl_only nature", 1.8),
    "update_256": _update("256", "rl_only 256", 1.25),
    "update_joint": _update("joint", "joint 256, two Adams in turn", 1.3),
    "update_summed": _update("summed", "joint 256, one Adam", 1.3),
    "separate_cost": Row(
        "two Adams in turn / one Adam, joint 256",
        "ms",
        "jax joint",
        {"one Adam": "jax summed"},
        _at_most(1.35),
    ),
    "simultaneous_cost": Row(
        "two Adams at once / one Adam", "ms", "jax simultaneous", {"one Adam": "jax summed"}, ()
    ),
    "loop": Row(
        "loop Pong nature", "env steps/s", "loop", {"Tianshou": "tianshou"}, (Goal("ratio", ">=", 2.5),)
    ),
    "overlap": Row(
        "loop / slower part", "ms", "iteration", {"acting or update alone": "slower part"}, _at_most(1.12)
    ),
    "busy": Row("cores that the loop keeps busy", "cores", "busy", {}, ()),
    "joint_cost": Row(
        "joint, one Adam / rl_only, updates of 256", "ms", "jax summed", {"rl_only": "jax 256"}, _at_most(1.7)
    ),
    "joint_cost_4": Row(
        "two Adams and srl_every=4 / rl_only", "ms", "jax joint4", {"rl_only": "jax 256"}, _at_most(1.2)
    ),
    "replay_sample": Row(
        "replay sample + set priorities",
        "ms",
        "sample",
        {"numpy gather": "gather"},
        (*_at_most(2.0), Goal("ours", "<=", 0.3)),
    ),
    "replay_insert": Row("replay insert", "ms", "add", {"env step": "env step"}, _at_most(0.05)),
    "startup": Row(
        "start to first update, joint 256, warm cache", "s", "startup", {}, (Goal("ours", "<", 12.0),)
    ),
    "memory": Row(
        "peak memory, buffer 100,000",
        "GB",
        "memory",
        {"the frames alone": "frames"},
        (Goal("ours", "<=", 1.6),),
    ),
}
"""The table, in order; the keys are what --only takes."""


def series_of(row: Row) -> list[str]:
    """The series that a row is made of."""
    return [row.ours, *row.theirs.values()]


def sides_of(rows: list[str]) -> list[str]:
    """The workers that rows need, in order; PyTorch's with the twin that they load from."""
    names = {SERIES[series].side for row in rows for series in series_of(ROWS[row])}
    names |= {SIDES[name].twin for name in names}
    return [name for name in SIDES if name in names]
