"""What one seed of a run has on the host: environments, replay, rows, and the files that they go to."""

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from srl_jax.checks import check_replay
from srl_jax.config import Config, difference
from srl_jax.diagnostics.run import Diagnostics
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.checkpoint import Manifest
from srl_jax.files.resuming import ENDS
from srl_jax.learning.agent import Agent
from srl_jax.replay import Replay, fitting
from srl_jax.run import saving
from srl_jax.run.actor import FrameStack, Policy, random_policy, seed_for
from srl_jax.run.evaluations import FINAL, Evaluating, Evaluations
from srl_jax.run.reporting import Report
from srl_jax.run.schedules import Now
from srl_jax.types import Params, TrainState


class Seed:
    """One seed of a run; `parts` is all of it that changes while it runs, and so what a checkpoint holds.

    Attributes:
        evaluations: of its policy, whose games are played in a thread.
        saved: the newest checkpoint that can be resumed from; None before there is one.

    Args:
        config: of this seed.
        out: its run directory.
        agent: of its configuration.
        env: its training environments.
        progress: whether to draw a progress bar on stderr.

    Raises:
        ConfigError: replay cannot be so small or so large.
    """

    def __init__(self, config: Config, out: Path, agent: Agent, env: Any, progress: bool):
        self.config, self.out, self.agent, self.env = config, out, agent, env
        self.key = jax.random.key(config.seed)
        frame = env.single_observation_space.shape
        check_replay(config, agent.horizon)
        try:
            self.replay = Replay(
                capacity=config.buffer_size,
                num_streams=config.num_envs,
                frame_shape=frame,
                stack=config.frame_stack,
                horizon=agent.horizon,
                gamma=config.gamma,
                alpha=agent.algorithm.alpha if agent.mode.rl else 0.0,
                seed=seed_for(config.seed, "replay"),
            )
        except MemoryError as error:
            raise ConfigError(f"--buffer_size={config.buffer_size}: {error}; give fewer") from None
        self.stacks = FrameStack(config.num_envs, config.frame_stack, frame)
        self.score = np.zeros(config.num_envs)  # of the training episodes so far
        self.rng = np.random.default_rng(seed_for(config.seed, "random policy"))
        self.policy: Policy = random_policy(int(env.single_action_space.n), self.rng)  # without RL
        self.report = Report(out, config, progress=progress)
        self.diagnostics: Diagnostics | None = None
        if config.diagnostics:
            say = self.report.progress.note
            self.diagnostics = Diagnostics(config, agent.measures, agent.horizon, out, say)
        self.evaluations = Evaluations(config, agent, self.report, self._keep_best)
        self.saved: Manifest | None = None
        self.saved_position = self.replay.next_position.copy()  # replay's, when it was written

    def begin(self) -> None:
        """Resets the training environments."""
        frames, _ = self.env.reset()
        self.stacks.begin(frames)
        self.replay.begin(frames)

    def step_env(self, actions: np.ndarray) -> tuple[tuple, np.ndarray, np.ndarray | None]:
        """Takes a step of the environments and resets those whose game ended; touches nothing else.

        Returns:
            The arguments of `Replay.add`, the raw rewards, and the frames after those games that ended were
            reset; None where none ended.
        """
        frames, rewards, terminated, truncated, info = self.env.step(actions)
        learnt = np.sign(rewards) if self.config.reward_clip else rewards
        lost = info["life_lost"] if self.config.life_loss else np.zeros(len(actions), bool)
        over, begun = terminated | truncated, None
        if over.any():
            begun, _ = self.env.reset(options={"reset_mask": over})
        return (actions, learnt.astype(np.float32), terminated, truncated, lost, frames), rewards, begun

    def take(self, step: tuple, rewards: np.ndarray, begun: np.ndarray | None) -> None:
        """Adds what `step_env` gave to replay, to the stacks of frames and to the scores."""
        _, _, terminated, truncated, _, frames = step
        self.replay.add(*step)
        self.score += rewards
        self.stacks.push(frames)
        if begun is not None:
            over = terminated | truncated
            self.report.ended(self.score[over])
            self.score[over] = 0.0
            self.stacks.begin(begun, over)
            self.replay.begin(begun[over], np.flatnonzero(over))

    def start_evaluation(self, state: TrainState, env_steps: int, updates: int, now: Now) -> None:
        """Measures the latent of now, and has the policy of now play while training goes on."""
        values: dict[str, Any] = {}
        if self.diagnostics is not None:
            own = now.gamma_and_n
            values = self.diagnostics.measure(state, env_steps, self.replay, now.beta, now.hyper, **own)
            if env_steps in self.diagnostics.steps:
                self.keep(self.diagnostics.parts(state.params), env_steps, updates)
        if self.agent.mode.rl:
            self.evaluations.start(Evaluating(self.agent.acting(state), env_steps, updates, values))
        elif values:
            self.report.eval_row(env_steps, updates, values)

    def open(self, stack: contextlib.ExitStack) -> None:
        """Opens rows and threads in a context, which closes them and the environments."""
        stack.callback(self.close)
        stack.enter_context(self.report)
        stack.enter_context(self.evaluations.thread)
        stack.callback(self.evaluations.leave)

    def close(self) -> None:
        """Closes the environments."""
        self.env.close()
        self.evaluations.close()

    def parts(self, env_steps: int) -> dict[str, tuple[Callable, Callable]]:
        """{name: (snapshot, restore)} of all that changes on the host; `env_steps` is of now.

        `snapshot` is () -> ({name: array}, JSON value), `restore` its inverse, (arrays, value) -> None.
        """
        return {
            "replay": (self.replay.snapshot, self.replay.restore),
            "env": (lambda: (self.env.snapshot(), None), lambda arrays, _: self.env.restore(arrays)),
            "play": (self._snapshot, self._restore),
            "report": (lambda: ({}, self.report.snapshot()), lambda _, x: self.report.restore(x)),
        }

    def _snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, numbers = self.evaluations.snapshot()
        own = {"stacks": self.stacks.frames, "score": self.score}
        return own | arrays, numbers | {"rng": self.rng.bit_generator.state}

    def _restore(self, arrays: Mapping[str, np.ndarray], numbers: Mapping[str, Any]) -> None:
        self.stacks.frames[:] = fitting(arrays, "stacks", self.stacks.frames)
        self.score[:] = fitting(arrays, "score", self.score)
        self.evaluations.restore(arrays, numbers)
        self.rng.bit_generator.state = numbers["rng"]

    def save(self, state: TrainState, env_steps: int, updates: int) -> None:
        """Writes a checkpoint that can be resumed from."""
        full = self.snapshot(state, env_steps)
        params = self.agent.acting(state)  # what others load
        self.saved = self.save_parameters(params, env_steps, updates, state=full, base=self.saved)
        self.saved_position = self.replay.next_position.copy()

    def snapshot(self, state: TrainState, env_steps: int) -> checkpoint.State:
        """What a run needs beside its parameters to resume: the rest of the learner's state, and `parts`."""
        arrays: dict[str, np.ndarray] = {}
        numbers: dict[str, Any] = {}
        for part, (snapshot, _) in self.parts(env_steps).items():
            found, numbers[part] = snapshot()
            arrays |= {f"{part}_{name}": x for name, x in found.items()}
        unchanged = self.replay.unchanged_chunks(self.saved_position) if self.saved else ()
        names = frozenset(f"replay_{name}" for name in unchanged)
        trees = {"learner": saving.rest(self.agent, state)}
        under_way = self.evaluations.under_way
        if under_way and under_way.env_steps != env_steps:
            trees["evaluating"] = under_way.params
        return checkpoint.State(trees, arrays, numbers, names)

    def keep(self, params: Params, env_steps: int, updates: int) -> None:
        """Writes parameters into `encoders/`, where they stay."""
        self.save_parameters(params, env_steps, updates, folder="encoders", keep=0)

    def _keep_best(self, params: Params, env_steps: int, updates: int) -> None:
        if self.config.keep_best:
            self.save_parameters(params, env_steps, updates, folder="best", keep=1)

    def save_parameters(self, params: Params, env_steps: int, updates: int, **options: Any) -> Manifest:
        """Writes a checkpoint, without options of parameters alone; see `srl_jax.files.checkpoint.save`."""
        return checkpoint.save(
            self.out,
            params,
            self.config,
            frame_shape=self.replay.frame_shape,
            num_actions=int(self.env.single_action_space.n),
            env_steps=env_steps,
            updates=updates,
            **options,
        )

    def restore(self, manifest: Manifest) -> TrainState:
        """Brings a new seed to where a checkpoint was written; the report must not be open yet.

        Args:
            manifest: verified, of the same configuration.

        Raises:
            ConfigError: the checkpoint is not of such a run, or the environments do not come back to what was
                seen; names the file or says what differs.
        """
        with saving.resumable(manifest):
            state = saving.restored(self.agent, manifest)
            numbers = checkpoint.load_numbers(manifest)
            for part, (_, restore) in self.parts(manifest.env_steps).items():
                restore(checkpoint.Arrays(manifest, f"{part}_"), numbers[part])
            # What ended the run, or was the last of it, does not where it is extended.
            extended = difference(manifest.config, self.config, ENDS)
            if extended:
                self.evaluations.last = -np.inf
            if evaluating := numbers["play"]["evaluating"]:
                then = "params" if evaluating[0] == manifest.env_steps else "evaluating"
                params = saving.params(self.agent, manifest, then)
                under_way = Evaluating(params, *evaluating)
                if under_way.kind != FINAL or not extended:
                    self.evaluations.under_way = under_way
        self.saved, self.saved_position = manifest, self.replay.next_position.copy()
        return state
