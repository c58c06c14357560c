"""How fast updates and a whole run are on an accelerator: `python -m experiments.benchmarks.gpu`.

There is no other side here: each figure stands beside its goal. An update is timed as the loop sees it, from
a window in the host's memory to the temporal-difference errors back there.
"""

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.provenance import versions
from srl_jax.specs import Info

from .. import flags as config_flags
from .bench import check_out

FLAGS = flags.FLAGS
NATURE, JOINT = "thesis/rl_only_nature", "thesis/joint_256"


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_enum("device", "gpu", ["gpu", "cpu"], "cpu: only to try this program", flag_values=values)
    config_flags.define("updates", Info(int, "updates timed for each figure", minimum=1), 500, values)
    config_flags.define("seeds", Info(int, "seeds in one process", minimum=1, maximum=1_000), 8, values)
    seconds = Info(float, "length of the run that 5M env steps follow from", "s", above=0)
    config_flags.define("seconds", seconds, 180.0, values)
    flags.DEFINE_string("out", None, "directory for gpu.json; must be new or empty", flag_values=values)


def milliseconds(function: Any, repeats: int, warm_up: int = 20) -> list[float]:
    """The time of each call, after a few that do not count."""
    found = []
    for _ in range(warm_up + repeats):
        start = time.perf_counter()
        function()
        found.append(1e3 * (time.perf_counter() - start))
    return found[warm_up:]


def updates(preset: str, repeats: int, seeds: int = 1) -> list[float]:
    """Milliseconds of a preset's updates, of so many seeds in one call."""
    import jax

    from srl_jax.agent import make_agent, over_seeds

    from .jax_side import NUM_ACTIONS, config_of, frame_shape, random_window

    config = config_of(preset)
    agent = make_agent(config, frame_shape(config), NUM_ACTIONS)
    windows = [random_window(config, agent.horizon, i) for i in range(8)]
    count = iter(range(10**9))
    device = over_seeds(agent, seeds)
    state = [device.stack([agent.init(jax.random.key(i), None) for i in range(seeds)])]

    def once() -> None:
        some = [windows[next(count) % len(windows)] for _ in range(seeds)]
        state[0], td_error, _ = device.update(state[0], some, agent.hyper)
        np.asarray(td_error)

    return milliseconds(once, repeats)


def whole_run(seconds: float) -> dict[str, float]:
    """Projects 5M env steps of Pong from a stretch of the loop and one evaluation."""
    from srl_jax.loop import Run

    from .jax_side import config_of

    config = config_of(NATURE)
    with tempfile.TemporaryDirectory() as out:
        with Run([config], [Path(out)]) as run:
            run.begin()
            while run.updates < 20:
                run.step()
            first, start = run.env_steps, time.perf_counter()
            while time.perf_counter() - start < seconds:
                run.step()
            rate = (run.env_steps - first) / (time.perf_counter() - start)
            seconds = []
            for _ in range(2):  # the first compiles
                start = time.perf_counter()
                run.start_evaluation()
                run.finish_evaluation()
                seconds.append(time.perf_counter() - start)
    evaluation = seconds[1]
    evaluations = config.steps // config.eval_every + 1
    minutes = (config.steps / rate + evaluations * evaluation) / 60
    return {"env_steps_per_s": rate, "evaluation_s": evaluation, "minutes": minutes}


def measure(values: flags.FlagValues) -> dict[str, Any]:
    """All figures, with the goals of each."""
    import jax

    device = jax.devices()[0]
    if values["device"].value == "gpu" and device.platform == "cpu":
        raise ConfigError("--device=gpu: jax sees no accelerator; pip install 'srl-jax[cuda12]' or [cuda13]")
    repeats, seeds = values["updates"].value, values["seeds"].value
    figures = {}

    def note(name: str, found: list[float], goal: float) -> float:
        low, middle, high = (float(np.quantile(found, q)) for q in (0.25, 0.5, 0.75))
        figures[name] = {"median": middle, "quartiles": [low, high], "goal": goal, "unit": "ms"}
        print(f"{name}: {middle:.3f} ms ({low:.3f} to {high:.3f}), goal {goal}", flush=True)
        return middle

    one = note("update rl_only nature", updates(NATURE, repeats), 0.5)
    note("update joint 256", updates(JOINT, repeats), 1.0)
    several = note(f"update of {seeds} seeds, rl_only nature", updates(NATURE, repeats, seeds), 3 * one)
    figures["seeds / one"] = {"median": several / one, "goal": 3.0, "unit": "times"}
    run = whole_run(values["seconds"].value)
    figures["5M env steps, rl_only nature, projected"] = run | {"goal": 15.0, "unit": "minutes"}
    print(f"5M env steps: {run['minutes']:.1f} minutes ({run['env_steps_per_s']:.0f} env steps/s), goal 15")
    about = {"device": device.device_kind, "platform": device.platform, "versions": versions()}
    return about | {"figures": figures}


def main(argv: list[str]) -> None:
    """The entry point."""
    del argv
    path = check_out(FLAGS.out)
    found = measure(FLAGS)
    if path is not None:
        path.mkdir(parents=True, exist_ok=True)
        (path / "gpu.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    define_flags()
    config_flags.run(main)
