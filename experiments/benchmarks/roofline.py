"""What an update could cost at best on this CPU: `python -m experiments.benchmarks.roofline`.

Counts the operations (XLA's, before it optimises) and the least bytes of an update, measures in the same run
the best rates of a large product, of a convolution and of a pass over memory, and prints the floor beside the
update's own time. The floor takes all products to run at the best rate and all passes over parameters to run
at the memory's, one after the other; it leaves out activations, noise and the loss.
"""

import sys
from collections.abc import Callable

import numpy as np

from ..command_line import runtime
from .host_side import timed
from .rows import JOINT, NATURE

PRESETS = ((NATURE, "separate"), ("thesis/rl_only_256", "separate"), (JOINT, "summed"), (JOINT, "separate"))
"""With how their encoder is stepped."""
ROUNDS, UPDATES = 15, 25
PASSES = 7
"""Of an Adam over what it moves: reads gradient, parameter and two moments, writes all but the gradient."""


def best(function: Callable, *arguments: np.ndarray) -> float:
    """The least milliseconds that a jitted function takes."""
    import jax

    jitted, arguments = jax.jit(function), jax.device_put(arguments)
    return min(timed(lambda: jax.block_until_ready(jitted(*arguments)))[0] for _ in range(ROUNDS))


def main() -> None:
    """Prints the rates, and each preset's floor and time."""
    import jax

    from .jax_side import Updates

    def convolve(x, kernel):
        layout = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), "VALID", dimension_numbers=layout)

    draw = np.random.default_rng(0).standard_normal
    a, b, big = draw((512, 3136), np.float32), draw((3136, 1024), np.float32), draw(30_000_000, np.float32)
    x, kernel = draw((32, 41, 41, 32), np.float32), draw((3, 3, 32, 32), np.float32)
    rates = {
        "product": 2e-6 * 512 * 3136 * 1024 / best(lambda a, b: a @ b, a, b),
        "convolution": 2e-6 * 32 * 39**2 * 9 * 32**2 / best(convolve, x, kernel),
        "memory": 2e-6 * big.nbytes / best(lambda x: 2 * x, big),
    }
    print("best rates, GFLOP/s and GB/s:", ", ".join(f"{name} {rate:.0f}" for name, rate in rates.items()))
    for preset, form in PRESETS:
        side = Updates(preset, encoder_optimizer=form)
        update = jax.jit(side.agent.update.pure).lower(side.state, side.windows[0], side.agent.hyper)
        gflop = update.cost_analysis()["flops"] / 1e9
        # An Adam's two moments are as large as what it moves.
        opt_state, slow = (
            sum(x.nbytes for x in jax.tree.leaves(tree)) for tree in (side.state.opt_state, side.state.slow)
        )
        megabytes = (PASSES * opt_state / 2 + slow) / 1e6
        products = 1e3 * gflop / max(rates["product"], rates["convolution"])
        passes = megabytes / rates["memory"]
        found = side.turn(UPDATES)["update"]
        print(
            f"{preset}, {form}: {gflop:.1f} GFLOP {products:.0f} ms + {megabytes:.0f} MB {passes:.0f} ms = "
            f"floor {products + passes:.0f} ms; update {np.median(found):.0f} ms (best {min(found):.0f})"
        )


if __name__ == "__main__":
    runtime.prepare("auto", sys.argv[1] if len(sys.argv) > 1 else "nature")
    main()
