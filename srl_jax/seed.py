"""What one seed of a run has on the host: environments, replay, rows, and the files that they go to."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from srl_jax import checkpoint
from srl_jax.actor import FrameStack, Policy, make_env, random_policy, seed_for
from srl_jax.agent import Agent
from srl_jax.checkpoint import Manifest
from srl_jax.config import Config
from srl_jax.diagnostics.measure import Diagnostics
from srl_jax.errors import ConfigError
from srl_jax.evaluate import Evaluation, evaluate
from srl_jax.optim import real_copy
from srl_jax.replay import Replay, fitting
from srl_jax.reporting import Report
from srl_jax.types import Params, TrainState

RECORDED = 501
"""Frames of the last evaluation that are kept: of 500 env steps."""


class Step(NamedTuple):
    """One step of N environments.

    Attributes:
        actions: int32 [N].
        frames, rewards, terminated, truncated: what `env.step` returned.
        life_lost: bool [N].
        begun: the frames after those games that ended were reset; None where none ended.
    """

    actions: np.ndarray
    frames: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    life_lost: np.ndarray
    begun: np.ndarray | None


class Seed:
    """One seed of a run; `parts` is all of it that changes while it runs, and so what a checkpoint holds.

    Attributes:
        best: the largest mean return of an evaluation so far.
        solved: whether the last evaluation reached the return that ends the run.
        saved: the newest checkpoint that can be resumed from; None before there is one.
        evaluation_due: whether that checkpoint was written before an evaluation of the same moment.

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
        except (ValueError, MemoryError) as error:
            raise ConfigError(
                f"--buffer_size={config.buffer_size}: {error}; --num_envs={config.num_envs}, "
                f"--frame_stack={config.frame_stack} and --rl={config.rl} say how much it takes"
            ) from None
        self.stacks = FrameStack(config.num_envs, config.frame_stack, frame)
        self.score = np.zeros(config.num_envs)  # of the training episodes so far
        self.rng = np.random.default_rng(seed_for(config.seed, "random policy"))
        self.policy: Policy = random_policy(int(env.single_action_space.n), self.rng)  # without RL
        self.report = Report(out, config, progress=progress)
        self.diagnostics: Diagnostics | None = None
        if config.diagnostics:
            say = self.report.progress.note
            self.diagnostics = Diagnostics(config, agent.measures, agent.horizon, out, say)
        self.recording: np.ndarray | None = None  # uint8 [T, H, W, C], the first games of the last evaluation
        self.best = -np.inf
        self.solved = self.evaluation_due = False
        self.saved: Manifest | None = None
        self.saved_position = self.replay.next_position.copy()  # replay's, when it was written

    def begin(self) -> None:
        """Resets the training environments."""
        frames, _ = self.env.reset()
        self.stacks.begin(frames)
        self.replay.begin(frames)

    def step_env(self, actions: np.ndarray) -> Step:
        """Takes a step of the environments and resets those whose game ended; touches nothing else."""
        frames, rewards, terminated, truncated, info = self.env.step(actions)
        over, begun = terminated | truncated, None
        if over.any():
            begun, _ = self.env.reset(options={"reset_mask": over})
        return Step(actions, frames, rewards, terminated, truncated, info["life_lost"], begun)

    def take(self, step: Step) -> None:
        """Adds a step to replay, to the stacks of frames and to the scores."""
        config, over = self.config, step.terminated | step.truncated
        self.score += step.rewards
        self.stacks.push(step.frames)
        self.replay.add(
            step.actions,
            (np.sign(step.rewards) if config.reward_clip else step.rewards).astype(np.float32),
            step.terminated,
            step.truncated,
            step.life_lost if config.life_loss else np.zeros(config.num_envs, bool),
            step.frames,
        )
        if step.begun is not None:
            self.report.ended(self.score[over])
            self.score[over] = 0.0
            self.stacks.begin(step.begun, over)
            self.replay.begin(step.begun[over], np.flatnonzero(over))

    @functools.cached_property
    def eval_env(self) -> Any:
        """The environments of evaluations, made when there is something to play."""
        return make_env(self.config, "eval", min(self.config.num_envs, self.config.eval_games))

    def evaluate(self, policy: Policy, env_steps: int, stop: Callable[[], bool]) -> Evaluation | None:
        """Plays the evaluation of an env step; None once `stop` says so."""
        config = self.config
        return evaluate(
            policy,
            self.eval_env,
            games=config.eval_games,
            seed=seed_for(config.seed, "eval", env_steps),
            epsilon=config.eps_eval,
            stack=config.frame_stack,
            max_steps=config.eval_max_steps,
            record=RECORDED,
            stop=stop,
        )

    def close(self) -> None:
        """Closes the environments."""
        for env in {"env", "eval_env"} & vars(self).keys():
            vars(self)[env].close()

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
        recording = {} if self.recording is None else {"recording": self.recording}
        numbers = {name: getattr(self, name) for name in ("solved", "evaluation_due")}
        numbers["best"] = self.best if np.isfinite(self.best) else None
        numbers["rng"] = self.rng.bit_generator.state
        return {"stacks": self.stacks.frames, "score": self.score, **recording}, numbers

    def _restore(self, arrays: Mapping[str, np.ndarray], numbers: Mapping[str, Any]) -> None:
        for name, own in (("stacks", self.stacks.frames), ("score", self.score)):
            found = fitting(arrays, name, own)
            if not np.isfinite(found).all():
                raise ValueError(f"snapshot: {name} is not finite")
            own[:] = found
        self.recording = arrays["recording"] if "recording" in arrays else None
        self.rng.bit_generator.state = numbers["rng"]
        self.best = -np.inf if numbers["best"] is None else float(numbers["best"])
        self.solved, self.evaluation_due = bool(numbers["solved"]), bool(numbers["evaluation_due"])

    def save(self, state: TrainState, env_steps: int, updates: int) -> None:
        """Writes a checkpoint that can be resumed from."""
        full = self.snapshot(state, env_steps)
        self.saved = self.save_parameters(state.params, env_steps, updates, state=full, base=self.saved)
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
        return checkpoint.State({"learner": _learner(state)}, arrays, numbers, names)

    def save_parameters(self, params: Params, env_steps: int, updates: int, **options: Any) -> Manifest:
        """Writes a checkpoint, without options of parameters alone; see `srl_jax.checkpoint.save`."""
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
        where, shapes = str(manifest.path), self.agent.shapes()
        try:
            params = checkpoint.load_into(shapes.params, checkpoint.load(manifest), where)
            template = jax.eval_shape(_learner, shapes)
            learner = checkpoint.load_into(template, checkpoint.load_tree(manifest, "learner"), where)
            numbers = checkpoint.load_numbers(manifest)
            for part, (_, restore) in self.parts(manifest.env_steps).items():
                restore(checkpoint.Arrays(manifest, f"{part}_"), numbers[part])
        except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
            if isinstance(error, ConfigError):
                raise
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(f"{where}: cannot be resumed from: {reason}") from None
        if manifest.config.stop_at_return != self.config.stop_at_return:
            self.solved = False
        self.saved, self.saved_position = manifest, self.replay.next_position.copy()
        key = jax.random.wrap_key_data(learner.pop("key"))
        return real_copy(shapes._replace(params=params, key=key, **learner))


def _learner(state: TrainState) -> dict[str, Any]:
    """What a checkpoint holds of the learner beside its parameters."""
    learner = {name: getattr(state, name) for name in ("slow", "opt_state", "step")}
    return learner | {"key": jax.random.key_data(state.key)}
