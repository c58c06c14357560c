"""What several tests share: an encoder that compiles quickly, random windows, comparisons of trees."""

import dataclasses
import itertools
import json
import os
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.config import INFOS, Config
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics, strip_wall
from srl_jax.learning.agent import Agent, Seeds, make_agent, over_seeds
from srl_jax.run import ending
from srl_jax.run.ending import Ending
from srl_jax.types import Context, Decoder, Encoder, Latents, Objective, TrainState, Window
from srl_jax.window import to_unit

SIZE, STACK, NUM_ACTIONS = 6, 4, 3
"""Of the frames, observations and actions that the helpers make, unless told otherwise."""

SMALL = {
    "game": "Catch",
    "frame_size": 42,
    "encoder": "tiny:features=8",
    "rl": "rainbow:hidden=16,atoms=11,v_min=-2,v_max=2",
    "num_envs": 4,
    "buffer_size": 400,
    "batch_size": 8,
    "learn_start": 40,
    "updates_per_step": 0.125,
    "steps": 240,
    "log_every": 40,
    "eval_every": 120,
    "eval_games": 3,
    "slow_update_every": 5,
    "diagnostics": False,
}
JOINT = {"mode": "joint", "objectives": ("reconstruction", "latent_l2")}
"""Settings of short runs: whole ones share what jax compiles, as far as they can."""
NOT_FINITE = Ending("diverged", 330, "loss/rl is not finite after 330 env steps and 10 updates")
"""How a run ended that diverged."""


HOST_ONLY = (
    "game", "seed", "steps", "buffer_size", "updates_per_step", "learn_start", "gamma", "lr_final_share",
    "beta", "beta_final", "eval_every", "eval_games", "eval_max_steps", "final_games", "eval_envs",
    "stop_at_return", "log_every",
    "checkpoint_every", "keep_encoder_every", "keep_best", "keep_replay", "diagnostics", "diagnostics_kept",
    "loggers", "encoder_from", "heads_from", "policy_from", "pretrain_epsilon",
)  # fmt: skip
"""Fields of Config that `make_agent` does not read: runs that differ in these alone share an agent."""


@cache
def _agent(config: Config, frame_shape: tuple[int, ...], num_actions: int) -> Agent:
    return make_agent(config, frame_shape, num_actions)


def agent_of(config: Config, frame_shape=(42, 42, 1), num_actions: int = NUM_ACTIONS) -> Agent:
    """`make_agent`'s, once a session for all configurations that mean the same agent."""
    default = {name: getattr(Config(), name) for name in HOST_ONLY}
    return _agent(dataclasses.replace(config, **default), tuple(frame_shape), num_actions)


_seeds: dict[tuple[int, int], tuple] = {}


def seeds_of(agent: Agent, number: int) -> Seeds:
    """`over_seeds`', as often as `agent_of` makes the agent."""
    key = id(agent), number
    if key not in _seeds:  # with the agent, so that no other gets its id
        _seeds[key] = agent, over_seeds(agent, number)
    return _seeds[key][1]


@contextmanager
def optimised():
    """Has programs that run long compiled as they are outside of tests."""
    options = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
    fast = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    with mock.patch.object(jax, "jit", partial(jax.jit, compiler_options=options) if fast else jax.jit):
        yield


def forget_agents() -> None:
    """Has those of `agent_of` and `seeds_of` made anew."""
    _agent.cache_clear()
    _seeds.clear()


@contextmanager
def shared_agents():
    """Has the loop take the agents of `agent_of`."""
    from srl_jax.run import loop

    with mock.patch.multiple(loop, make_agent=agent_of, over_seeds=seeds_of):
        yield


@contextmanager
def stop_after(env_steps: int, times: int = 1):
    """A `stop` of a run that is obeyed after so many env steps, however often the loop asks before.

    While a row waits for an evaluation, it asks as long as that takes.

    Args:
        env_steps: done.
        times: when it is asked for the times-th time there.
    """
    from srl_jax.run import loop

    step, done, asked = loop.Run.step, [0], itertools.count(1)

    def counted(run):
        step(run)
        done[0] = run.env_steps

    with mock.patch.object(loop.Run, "step", counted):
        yield lambda: done[0] >= env_steps and next(asked) >= times


def make_context(features: int = 8) -> Context:
    """What objectives over `make_encoder`'s latents read, with NUM_ACTIONS actions."""
    return Context.of(make_encoder(features), NUM_ACTIONS)


def make_encoder(features: int = 8, shape=(SIZE, SIZE, STACK)) -> Encoder:
    """A linear encoder with a tanh and a linear decoder.

    Losses see latents and a decoder, whatever they are made of, and these compile quickly.
    """
    pixels = int(np.prod(shape))

    def linear(inputs: int, outputs: int):
        return lambda key: {"kernel": jax.random.normal(key, (inputs, outputs)) / np.sqrt(inputs)}

    def encode(params, observation):
        return jnp.tanh(to_unit(observation).reshape(-1, pixels) @ params["kernel"])

    def make_decoder(extra_inputs: int = 0) -> Decoder:
        decode = lambda params, x: (x @ params["kernel"]).reshape(-1, *shape)  # noqa: E731
        return Decoder(linear(features + extra_inputs, pixels), decode)

    return Encoder(linear(pixels, features), encode, features, shape, make_decoder)


def make_window(
    seed: int = 0, *, batch: int = 4, horizon: int = 3, size: int = SIZE, channels: int = 1
) -> Window:
    """A random window within one episode: every offset valid, nothing terminal."""
    rng = np.random.default_rng(seed)
    shape = (batch, horizon)
    return Window(
        frames=rng.integers(0, 256, (batch, STACK + horizon, size, size, channels), dtype=np.uint8),
        actions=rng.integers(0, NUM_ACTIONS, shape, dtype=np.int32),
        rewards=rng.normal(size=shape).astype(np.float32),
        discounts=np.full(shape, 0.99, np.float32),
        valid=np.ones(shape, np.float32),
        weight=np.ones(batch, np.float32),
    )


def random_params(init, seed: int = 0):
    """Parameters of the shapes that `init(key)` gives, without compiling a random draw for every shape."""
    return fill(jax.eval_shape(init, jax.random.key(0)), seed)


def fill(shapes, seed: int = 0):
    """Normal numbers over the root of the fan-in; LayerNorm's scale is 1, the size of noise 0.02."""
    rng = np.random.default_rng(seed)

    def draw(path, x):
        for name, value in (("scale", 1.0), ("sigma", 0.02)):
            if name in jax.tree_util.keystr(path):
                return np.full(x.shape, value, np.float32)
        fan_in = max(1, int(np.prod(x.shape[:-1])))
        return (rng.normal(size=x.shape) / np.sqrt(fan_in)).astype(np.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def random_state(init, seed: int = 0) -> TrainState:
    """What `init(key)` gives, from `make_init`, with `random_params` in place of the initialisers."""
    shapes = jax.eval_shape(init, jax.random.key(0))
    params = fill(shapes.params, seed)
    return TrainState(
        params=params,
        slow={
            name: {
                "encoder": to_numpy(params["encoder"]) if own["encoder"] else {},
                "head": to_numpy(params[name]),
            }
            | ({"read": fill(own["read"], seed)} if "read" in own else {})
            for name, own in shapes.slow.items()
        },
        opt_state=jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes.opt_state),
        step=np.int32(0),
        key=jax.random.key(seed),
        norms=jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes.norms),
    )


def count(params) -> int:
    """How many numbers a tree of arrays (or of their shapes) holds."""
    return sum(int(np.prod(x.shape)) for x in jax.tree.leaves(params))


def to_numpy(tree):
    """A copy on the host, which outlives the donation of the original."""
    return jax.tree.map(lambda x: np.array(x), tree)


def identical(a, b) -> bool:
    """Whether two trees have the same form and the same bits."""
    same = jax.tree.map(np.array_equal, a, b)
    return all(jax.tree.leaves(same))


def all_moved(a, b) -> bool:
    """Whether every leaf of a tree differs from the other tree's."""
    differs = jax.tree.map(lambda x, y: not np.array_equal(x, y), a, b)
    return all(jax.tree.leaves(differs))


def all_zero(tree) -> bool:
    """Whether every number is exactly zero."""
    return not any(np.any(np.asarray(x)) for x in jax.tree.leaves(tree))


def zero_leaves(tree) -> list[str]:
    """The names of the leaves that are zero throughout."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [jax.tree_util.keystr(path) for path, x in leaves if not np.any(np.asarray(x))]


def one_run(config: Config, path: Path | None = None, **options):
    """A `srl_jax.run.loop.Run` of one seed."""
    from srl_jax.run.loop import Run

    return Run([config], [path or Path()], **options)


def write_run(
    path: Path, returns=(1.0, 2.0), every: int = 100, ended: Ending | None = None, final=(), **values
) -> Path:
    """A run directory as training leaves it, less its checkpoints: evaluations every so many env steps.

    Args:
        path: to make.
        returns: mean return of each evaluation.
        every: env steps between two.
        ended: how, where it says so.
        final: returns of its final games.
        **values: fields of its Config.
    """
    path.mkdir(parents=True)
    config = Config(**{"game": "Catch", "frame_size": 42, **values})
    (path / "config.json").write_text(json.dumps({**dataclasses.asdict(config), "versions": {}}))
    rows = [
        {"kind": "eval", "env_steps": every * i, "updates": i, "wall_s": 0.5, "eval/return_mean": x}
        for i, x in enumerate(returns)
    ]
    if final:
        played = {"final/returns": list(final), "final/return_mean": sum(final) / len(final)}
        row = {"kind": "final", "env_steps": rows[-1]["env_steps"], "updates": 9, "wall_s": 1.0}
        rows.append(row | played | {"final/games": len(final)})
    rows.insert(1, {"kind": "train", "env_steps": every // 2, "updates": 0, "wall_s": 0.1})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if ended is not None:
        ending.write(path, ended)
    return path


def write_checkpoint(
    run: Path,
    *,
    env_steps: int = 240,
    folder: str = "checkpoints",
    only: Sequence[str] = (),
    channels: int = 1,
    **values,
) -> Path:
    """A checkpoint of random parameters of an agent on Catch, less the run around it.

    Args:
        run: its directory.
        env_steps: when it was written; also the seed of the parameters.
        folder: of the run, where it goes.
        only: groups of parameters that are kept; empty for all.
        channels: of its frames.
        **values: fields of its Config, in place of `SMALL`'s.
    """
    config = Config(**{**SMALL, **values})
    frame = (config.frame_size, config.frame_size, channels)
    params = fill(make_agent(config, frame, NUM_ACTIONS).shapes().params, env_steps)
    kept = {name: params[name] for name in only or params}
    counts = {"num_actions": NUM_ACTIONS, "env_steps": env_steps, "updates": 1}
    return checkpoint.save(run, kept, config, frame_shape=frame, folder=folder, **counts).path


def rows_of(run: Path) -> list[dict]:
    """A run's rows, less their times, which no other run has."""
    return [strip_wall(row) for row in read_metrics(run / "metrics.jsonl")]


def whole(path: Path) -> checkpoint.Manifest:
    """The manifest of a checkpoint, or of a run's newest, of which every file is what it says."""
    manifest = checkpoint.read_manifest(path)
    checkpoint.verify(manifest)
    return manifest


def latents_of(online: np.ndarray, slow: np.ndarray | None = None) -> Latents:
    """Latents that are known: float32 [K + 1, B, D], the online ones and the slow ones."""

    def give(z):
        return lambda k: jnp.stack([z[i] for i in k]) if isinstance(k, list) else z[k]

    return Latents(give(jnp.asarray(online)), give(jnp.asarray(online if slow is None else slow)))


def draw(*shape: int, seed: int = 0) -> np.ndarray:
    """Normal numbers, float32."""
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def loss_of(objective: Objective, latents: Latents, window: Window, *, seed: int = 0, key: int = 0):
    """The losses of a head of random numbers, that head, and its slow copy, which is another one."""
    head, slow = (random_params(objective.init, seed + i) for i in range(2))
    loss = jax.jit(lambda *heads: objective.loss(*heads, latents, window, jax.random.key(key))[0])
    return np.asarray(loss(head, slow)), head, slow


def last_of_each(arguments: Iterable[str]) -> tuple[str, ...]:
    """A command line less each flag that a later one of its name replaces; --objective may be repeated.

    For tests that add flags to others: a program refuses one that is given twice.
    """
    arguments = tuple(arguments)
    names = [text.partition("=")[0] for text in arguments]
    repeated = {f"--{info.flag or name}" for name, info in INFOS.items() if info.kind is tuple}
    return tuple(
        text
        for i, (name, text) in enumerate(zip(names, arguments, strict=True))
        if name in repeated or not name.startswith("--") or name not in names[i + 1 :]
    )
