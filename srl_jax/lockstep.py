"""Several seeds in one process: each has a loop of its own in a thread; calls of the device are shared.

The loop is written for one seed. Here N of them run the same configuration in step: when all have asked for
an update (or an action), one of them makes the vmapped call for all, and each takes its part of the result.
Calls are collected by seed, not by arrival, so that no result depends on timing. Worth it on an accelerator;
on a CPU one process for each seed is faster.
"""

import concurrent.futures
import contextlib
import dataclasses
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import BrokenBarrierError
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.agent import Agent, make_agent
from srl_jax.checkpoint import Manifest
from srl_jax.config import Config
from srl_jax.loop import Result, make_env, train
from srl_jax.types import Params


def train_seeds(
    config: Config,
    seeds: Sequence[int],
    outs: Sequence[str | Path],
    *,
    progress: bool = True,
    resume: Sequence[Manifest | None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Result]:
    """Trains agents of several seeds in this process, in step.

    Each has replay, environments, and a run directory as from `train`. Only the first shows its progress. A
    return that ends a run early must be reached by all in one evaluation. What stops one stops all.

    Args:
        config: of the runs, resolved; its seed does not matter.
        seeds: distinct.
        outs: their run directories.
        progress: whether the first draws a progress bar on stderr.
        resume: a checkpoint of each to go on from, all of the same env step; None to begin.
        stop: see `srl_jax.loop.train`.

    Raises:
        srl_jax.errors.ConfigError: a spec or a checkpoint to start from does not fit.
    """
    number = len(seeds)
    configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
    with contextlib.closing(make_env(config, 1, 0)) as env:
        frame, num_actions = env.single_observation_space.shape, int(env.single_action_space.n)
    agent = make_agent(config, frame, num_actions)
    lockstep = Lockstep(agent, number)

    def one(i: int) -> Result:
        finished = False
        try:
            shown, manifest = progress and i == 0, resume[i] if resume else None
            agent = lockstep.agents[i]
            result = train(configs[i], outs[i], progress=shown, resume=manifest, stop=stop, agent=agent)
            finished = not result.interrupted
            return result
        finally:
            if not finished:
                lockstep.leave()

    with concurrent.futures.ThreadPoolExecutor(number, "seed") as threads:
        runs = [threads.submit(one, i) for i in range(number)]
        try:
            concurrent.futures.wait(runs)
        except KeyboardInterrupt:
            lockstep.leave()
    failed = [run.exception() for run in runs if run.exception()]
    # Those that waited for the one that failed have nothing to say.
    for error in sorted(failed, key=lambda e: isinstance(e, BrokenBarrierError)):
        raise error
    return [run.result() for run in runs]


class Together:
    """A function of N seeds' arguments that N threads call, each for its own seed.

    Args:
        function: list of N tuples of arguments, by seed -> N results, by seed.
        number: N.
    """

    def __init__(self, function: Callable[[list[tuple]], Any], number: int):
        self.call = function
        self._arguments: list[tuple] = [()] * number
        self._barrier = threading.Barrier(number, self._call)

    def member(self, seed: int) -> Callable:
        """One seed's side: takes its arguments, waits for the others, returns its result.

        The call raises what the function raised in the thread that called it, and `BrokenBarrierError` in
        the others, now and for good; likewise after `leave`.
        """

        def call(*arguments):
            self._arguments[seed] = arguments
            self._barrier.wait()
            return self._results[seed]

        return call

    def leave(self) -> None:
        """Ends it: whoever waits, or comes later, gets a `BrokenBarrierError`."""
        self._barrier.abort()

    def _call(self) -> None:
        arguments, self._arguments = self._arguments, [()] * len(self._arguments)
        self._results = self.call(arguments)


class Share:
    """One seed's part of a tree of stacked arrays [N, ...]; sliced when it is asked for."""

    def __init__(self, stacked: Any, seed: int):
        self.stacked, self.seed = stacked, seed

    @property
    def params(self) -> Params:
        """Of a `TrainState`: this seed's parameters."""
        return _slice(self.stacked.params, self.seed)


_slice = jax.jit(lambda tree, i: jax.tree.map(lambda x: x[i], tree))
_stack = jax.jit(lambda trees: jax.tree.map(lambda *x: jnp.stack(x), *trees))


class Lockstep:
    """The agents of N seeds that update and act together.

    Attributes:
        agents: by seed; each to be used by one loop, in threads of its own. States are `Share`s.
        together: their calls, by the name that they have in an agent.
    """

    def __init__(self, agent: Agent, number: int):
        self._number = number
        functions = {
            "init": self._init(agent),
            "update": self._update(agent.update),
            "follow": self._follow(agent),
            "act": self._act(agent),
            "adopt": self._adopt(),
            "agree": lambda arguments: [all(a for (a,) in arguments)] * number,
        }
        if agent.update_rl:
            functions["update_rl"] = self._update(agent.update_rl)
        self.together = {name: Together(function, number) for name, function in functions.items()}
        self.agents = [
            agent._replace(
                fetch=_fetch,
                export=lambda share: _slice(share.stacked, share.seed),
                **{name: c.member(i) for name, c in self.together.items()},
            )
            for i in range(number)
        ]

    def leave(self) -> None:
        """Ends all calls, so that no loop waits for one that has failed or was interrupted."""
        for together in self.together.values():
            together.leave()

    def _parts(self, stacked: Any) -> list[Share]:
        return [Share(stacked, i) for i in range(self._number)]

    def _init(self, agent: Agent) -> Callable:
        # One after the other, so that each seed starts as it would alone, to the bit.
        return lambda arguments: self._parts(_stack([agent.init(*a) for a in arguments]))

    def _adopt(self) -> Callable:
        return lambda arguments: self._parts(_stack([state for (state,) in arguments]))

    def _update(self, update: Callable) -> Callable:
        def lift(change: Callable) -> Callable:
            several = jax.vmap(change, in_axes=(0, 0, 0, 0, None))

            def stacked(opt_state, moving, still, windows: list, hyper):
                window = jax.tree.map(lambda *x: jnp.stack(x), *windows)  # on the device, not on the host
                return several(opt_state, moving, still, window, hyper)

            return stacked

        together = update.lifted(lift)

        def function(arguments: list[tuple]) -> list[tuple]:
            (share, _, hyper), *_ = arguments
            windows = [window for _, window, _ in arguments]
            state, td_error, metrics = together(share.stacked, windows, hyper)
            rows = [None] * self._number if td_error is None else np.asarray(td_error)
            return list(zip(self._parts(state), rows, self._parts(metrics), strict=True))

        return function

    def _follow(self, agent: Agent) -> Callable:
        follow = jax.jit(jax.vmap(agent.follow.__wrapped__))
        return lambda arguments: self._parts(follow(arguments[0][0].stacked))

    def _act(self, agent: Agent) -> Callable:
        several = jax.vmap(agent.act.__wrapped__, in_axes=(0, 0, 0, None, None))

        @jax.jit
        def stacked(params, frames: list, keys: list, step, epsilon):
            return several(params, jnp.stack(frames), jnp.stack(keys), step, epsilon)

        def function(arguments: list[tuple]) -> np.ndarray:
            shares, frames, keys, steps, epsilons = zip(*arguments, strict=True)
            return np.asarray(stacked(shares[0].stacked.params, frames, keys, steps[0], epsilons[0]))

        return function


def _fetch(log: list[Share]) -> list[dict[str, np.ndarray]]:
    """The metrics of a seed's updates, on the host."""
    return [{name: x[row.seed] for name, x in jax.device_get(row.stacked).items()} for row in log]
