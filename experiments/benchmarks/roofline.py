"""What an update could cost at best on this CPU: `python -m experiments.benchmarks.roofline`.

Counts the operations and the least bytes of an update, measures in the same run the best rates of a large
product, of a convolution and of a pass over memory, and prints the floor beside the update's own time. The
floor takes all products to run at the best rate and all passes to run at the memory's, one after the other;
it leaves out activations, noise and the loss.
"""

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .. import runtime

PRESETS = ("thesis/rl_only_nature", "thesis/rl_only_256", "thesis/joint_256")
ROUNDS = 15
PASSES = 7
"""Of Adam over each parameter: reads gradient, parameter and two moments, writes all but the gradient."""


class Cost(NamedTuple):
    """Of one update: operations (a multiplication and an addition are two), and bytes of parameters moved."""

    operations: float
    nbytes: float


def update_cost(preset: str) -> Cost:
    """Counts a preset's update: XLA's count of operations before it optimises, and passes over parameters."""
    import jax

    from srl_jax.agent import make_agent

    from .jax_side import NUM_ACTIONS, config_of, frame_shape, random_window

    config = config_of(preset)
    agent = make_agent(config, frame_shape(config), NUM_ACTIONS)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    window = random_window(config, agent.horizon, 0)
    operations = jax.jit(agent.update.pure).lower(state, window, agent.hyper).cost_analysis()["flops"]
    trained, slow = (4 * sum(x.size for x in jax.tree.leaves(tree)) for tree in (state.params, state.slow))
    return Cost(float(operations), float(PASSES * trained + slow))


def best(function: Callable, *arguments) -> float:
    """The least of the seconds that a jitted function takes."""
    import jax

    jitted = jax.jit(function)
    arguments = jax.device_put(arguments)
    seconds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        jax.block_until_ready(jitted(*arguments))
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def rates() -> dict[str, float]:
    """The best seen: operations per second of a product and of a convolution, bytes per second of a pass."""
    import jax

    rng = np.random.default_rng(0)

    def draw(*shape):
        return rng.standard_normal(shape, np.float32)

    def convolve(x, kernel):
        return jax.lax.conv_general_dilated(
            x, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    big = draw(30_000_000)
    return {
        "product": 2 * 512 * 3136 * 1024 / best(lambda a, b: a @ b, draw(512, 3136), draw(3136, 1024)),
        "convolution": 2 * 32 * 39**2 * 9 * 32**2 / best(convolve, draw(32, 41, 41, 32), draw(3, 3, 32, 32)),
        "memory": 2 * big.nbytes / best(lambda x: 2 * x, big),
    }


def main() -> None:
    """Prints the rates, and each preset's floor and time."""
    from .jax_side import Updates

    found = rates()
    print(
        f"best rates: product {found['product'] / 1e9:.0f} GFLOP/s, convolution "
        f"{found['convolution'] / 1e9:.0f} GFLOP/s, memory {found['memory'] / 1e9:.1f} GB/s"
    )
    for preset in PRESETS:
        cost = update_cost(preset)
        products = 1e3 * cost.operations / max(found["product"], found["convolution"])
        passes = 1e3 * cost.nbytes / found["memory"]
        side = Updates()
        side.setup(preset)
        seconds = side.time(30)["seconds"][5:]
        print(
            f"{preset}: {cost.operations / 1e9:.1f} GFLOP {products:.0f} ms + {cost.nbytes / 1e6:.0f} MB "
            f"{passes:.0f} ms = floor {products + passes:.0f} ms; update {1e3 * np.median(seconds):.0f} ms "
            f"(best {1e3 * min(seconds):.0f})"
        )


if __name__ == "__main__":
    runtime.prepare("auto", sys.argv[1] if len(sys.argv) > 1 else "nature")
    main()
