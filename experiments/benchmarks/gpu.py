"""How fast updates and a whole run are on an accelerator: `python -m experiments.benchmarks.gpu`.

There is no other side here: each figure stands beside its goal. An update is timed as the loop sees it, from
a window in the host's memory to the temporal-difference errors back there.
"""

import json
import tempfile
import time
from pathlib import Path
from typing import Any

from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.files.provenance import versions
from srl_jax.specs import Info

from ..command_line import flags as config_flags
from .bench import check_out
from .rows import JOINT, NATURE, number, spread, spread_text

WARM_UPDATES = 20


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_enum("device", "gpu", ["gpu", "cpu"], "cpu: only to try this program", values)
    config_flags.define("updates", Info(int, "updates timed for each figure", minimum=1), 500, values)
    config_flags.define("seeds", Info(int, "seeds in one process", minimum=1, maximum=1_000), 16, values)
    seconds = Info(float, "length of the run that 5M env steps follow from", "s", above=0)
    config_flags.define("seconds", seconds, 180.0, values)
    flags.DEFINE_string("out", None, "directory for gpu.json; must be new or empty", values)


def whole_run(seconds: float) -> dict[str, float]:
    """Projects a whole run of Pong, 5M env steps, from a stretch of the loop and one evaluation."""
    from srl_jax.run.loop import Run

    from .jax_side import config_of

    config = config_of(NATURE)
    with tempfile.TemporaryDirectory() as out, Run([config], [Path(out)]) as run:
        while run.updates < WARM_UPDATES:
            run.step()
        first, start = run.env_steps, time.perf_counter()
        while time.perf_counter() - start < seconds:
            run.step()
        rate = (run.env_steps - first) / (time.perf_counter() - start)
        for _ in range(2):  # the first compiles
            start = time.perf_counter()
            run.start_evaluation()
            run.finish_evaluation()
            evaluation = time.perf_counter() - start
    evaluations = config.steps // config.eval_every + 1
    minutes = (config.steps / rate + evaluations * evaluation) / 60
    return {"env_steps_per_s": rate, "evaluation_s": evaluation, "minutes": minutes}


def measure(values: flags.FlagValues) -> dict[str, Any]:
    """All figures, with the goals of each."""
    import jax

    from .jax_side import Updates

    device = jax.devices()[0]
    if values["device"].value == "gpu" and device.platform == "cpu":
        raise ConfigError("--device=gpu: jax sees no accelerator; pip install 'srl-jax[cuda12]' or [cuda13]")
    seeds = values["seeds"].value
    figures: dict[str, Any] = {}

    def update(name: str, preset: str, goal: float, seeds: int = 1) -> float:
        side = Updates(preset, seeds)
        side.turn(WARM_UPDATES)
        found = spread(side.turn(values["updates"].value)["update"])
        quartiles = [found["low"], found["high"]]
        figures[name] = {"median": found["median"], "quartiles": quartiles, "goal": goal, "unit": "ms"}
        print(f"{name}: {spread_text(found, 'ms')}, goal {number(goal)}", flush=True)
        return found["median"]

    one = update("update rl_only nature", NATURE, 0.5)
    update("update joint 256", JOINT, 1.0)
    several = update(f"update of {seeds} seeds, rl_only nature", NATURE, 3 * one, seeds)
    figures["seeds / one"] = {"median": several / one, "goal": 3.0, "unit": "times"}
    run = whole_run(values["seconds"].value)
    figures["5M env steps, rl_only nature, projected"] = run | {"goal": 15.0, "unit": "minutes"}
    print(f"5M env steps: {run['minutes']:.1f} minutes ({run['env_steps_per_s']:.0f} env steps/s), goal 15")
    about = {"device": device.device_kind, "platform": device.platform, "versions": versions()}
    return about | {"figures": figures}


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    path = check_out(values.out)
    found = measure(values)
    if path is not None:
        path.mkdir(parents=True, exist_ok=True)
        (path / "gpu.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
