"""The host loop: act, step, add, sample, update; evaluate, log, checkpoint.

With `evaluator`, `reporting`, `snapshot` and `checkpoint` it moves data between numpy and the device. The
environments have a thread of their own, which acts and steps while the main thread has the device update.
Both work on the parameters and the replay of the step before, and meet before the next one; an evaluation
has a thread, too, and is awaited before the next row is written. So no result depends on timing.
"""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from threading import BrokenBarrierError
from typing import Any, NamedTuple

import jax
import numpy as np

from srl_jax import checkpoint, ending, envs, snapshot
from srl_jax.actor import FrameStack, Policy, linear, random_policy, seed_for, yielding_thread
from srl_jax.agent import Agent, make_agent
from srl_jax.config import Config
from srl_jax.diagnostics.measure import Diagnostics
from srl_jax.ending import Ending
from srl_jax.errors import ConfigError, Diverged, SaveError
from srl_jax.evaluator import Evaluator, Moment
from srl_jax.optim import ENCODER, RL
from srl_jax.replay import Replay
from srl_jax.reporting import Report
from srl_jax.types import Encoder, Params, Window
from srl_jax.update import Hyper, make_latents, named_key

PICTURES = 6
"""Examples in the picture of what an objective learnt."""


class Result(NamedTuple):
    """How a run ended.

    Attributes:
        env_steps, updates: done.
        interrupted: whether it was stopped before its end; its checkpoint is of that moment.
        pictures: {objective: (inputs, targets, outputs)}, float32 [B, H, W, S] each, of objectives that
            have one.
        recording: uint8 [T, H, W], the first games of the last evaluation; None without one.
    """

    env_steps: int
    updates: int
    interrupted: bool
    pictures: dict[str, tuple]
    recording: np.ndarray | None


def train(
    config: Config,
    out: str | Path,
    *,
    progress: bool = True,
    resume: checkpoint.Manifest | None = None,
    stop: Callable[[], bool] = lambda: False,
    agent: Agent | None = None,
) -> Result:
    """Trains one agent, writing `metrics.jsonl` and `checkpoints/` into a run directory that exists.

    How it ended goes to `ended.json`, see `srl_jax.ending`; a ConfigError changes nothing there.

    Args:
        config: of the run, resolved.
        out: the run directory.
        progress: whether to draw a progress bar on stderr.
        resume: the checkpoint of the same configuration to go on from, found whole by
            `srl_jax.checkpoint.verify`; what follows is what would have followed had the run not ended there.
        stop: asked after each step; once it says so, a checkpoint is written and training ends. A
            KeyboardInterrupt instead, in the middle of a step, leaves the last checkpoint.
        agent: of this configuration, where it is made already.

    Raises:
        ConfigError: a spec or a checkpoint to start from does not fit.
        Diverged: a loss is no longer finite; the last checkpoint is from before.
        SaveError: something could not be written; the last checkpoint is whole.
    """
    out, run = Path(out), None
    try:
        run = Run(config, out, progress, agent, resume=resume, stop=stop)
        result = run.train()
    except ConfigError:
        raise
    except BaseException as error:
        with contextlib.suppress(SaveError):  # what ended the run is what is told
            ending.write(out, ending.of(error, run.env_steps if run else 0))
        raise
    ending.write(out, Ending("stopped" if result.interrupted else "finished", result.env_steps))
    return result


def greedy_policy(agent: Agent, params: Any, key: jax.Array) -> Policy:
    """The epsilon-greedy policy of an agent's parameters, without noise, as a function of numpy arrays."""
    return _policy(agent.act_eval, params, key)


def _policy(act: Callable, params_or_state: Any, key: jax.Array) -> Policy:
    def policy(frames: np.ndarray, step: int, epsilon: float) -> np.ndarray:
        return np.asarray(act(params_or_state, frames, key, np.int32(step), np.float32(epsilon)))

    return policy


def act_and_step(policy: Policy, observations: np.ndarray, step: int, epsilon: float, env) -> tuple:
    """One step of all environments: actions int32 [N], and what `env.step` returned."""
    actions = policy(observations, step, epsilon)
    return actions, env.step(actions)


def make_env(config: Config, num_envs: int, seed: int, *, max_steps: int = 0):
    """The environments of a run's game and protocol, see `srl_jax.envs.make`.

    Args:
        config: of the run.
        num_envs: how many.
        seed: of the environments.
        max_steps: env steps that an episode must be allowed to take; those of training end where
            `srl_jax.envs.MAX_FRAMES` says.
    """
    return envs.make(
        config.game,
        num_envs=num_envs,
        seed=seed,
        frame_size=config.frame_size,
        sticky_actions=config.sticky_actions,
        noop_max=config.noop_max,
        max_frames=max(envs.MAX_FRAMES, envs.FRAME_SKIP * max_steps),
    )


def load_agent(path: str | Path) -> tuple[Agent, Any, checkpoint.Manifest]:
    """An agent, its parameters and the manifest of a checkpoint or of a run's newest one.

    Raises:
        srl_jax.errors.ConfigError: there is none, it is damaged, does not fit this code, or it is an encoder
            that was kept alone, see `load_encoder`.
    """
    manifest = checkpoint.read_manifest(path)
    agent, template = _agent_of(manifest)
    tree = checkpoint.load(manifest)
    if checkpoint.is_part(template, tree):
        raise ConfigError(
            f"{manifest.path}: a kept encoder, without a policy; name the run or one of its checkpoints "
            "(srl_jax.loop.load_encoder and --encoder_from take kept encoders)"
        )
    return agent, checkpoint.load_into(template, tree, str(manifest.path)), manifest


def load_encoder(path: str | Path) -> tuple[Encoder, Params, checkpoint.Manifest]:
    """The encoder of a run, of one of its checkpoints, or one that was kept, `RUN/encoders/ENV_STEPS`.

        encoder, params, manifest = load_encoder("runs/pong/encoders/000002000")
        latents = encoder.apply(params, observations)  # uint8 [B, H, W, S] -> float32 [B, encoder.features]

    Raises:
        srl_jax.errors.ConfigError: there is none, it is damaged, or does not fit this code.
    """
    manifest = checkpoint.read_manifest(path)
    encoder = _agent_of(manifest)[0].encoder
    return encoder, _encoder_params(encoder, manifest, str(manifest.path)), manifest


def _agent_of(manifest: checkpoint.Manifest) -> tuple[Agent, Any]:
    """The agent of a checkpoint's configuration, and the shapes of its parameters."""
    try:
        agent = make_agent(manifest.config, manifest.num_actions)
        return agent, agent.shapes().params
    except (ConfigError, TypeError) as error:  # a TypeError is jax's, of shapes that cannot be
        raise ConfigError(f"{manifest.path}: {error}") from None


def _encoder_params(encoder: Encoder, manifest: checkpoint.Manifest, what: str) -> Params:
    """A checkpoint's encoder in the form of this one; `what` names it in errors."""
    template = jax.eval_shape(encoder.init, jax.random.key(0))
    return checkpoint.load_into(template, checkpoint.load(manifest)["encoder"], what)


class Run:
    """One training run; its attributes are everything that changes while it runs: see `srl_jax.snapshot`."""

    def __init__(
        self,
        config: Config,
        out: Path,
        progress: bool,
        agent: Agent | None = None,
        *,
        resume: checkpoint.Manifest | None = None,
        stop: Callable[[], bool] = lambda: False,
    ):
        self.config, self.out, self.stop = config, out, stop
        self.checkpoint_every = config.checkpoint_every or config.eval_every
        # The environments are made in their thread, so that those that they start yield, too.
        self.env_thread = yielding_thread("environments")
        self.env = self.env_thread.submit(self.make_env, "train", config.num_envs).result()
        self.num_actions = int(self.env.single_action_space.n)
        self.agent = agent or make_agent(config, self.num_actions)
        self.learning_rates = {name: float(x) for name, x in self.agent.hyper.learning_rates.items()}
        self.key = jax.random.key(config.seed)
        self.state = self.agent.init(self.key, self.initial_params() if resume is None else None)
        frame = self.env.single_observation_space.shape
        try:
            self.replay = Replay(
                capacity=config.buffer_size,
                num_streams=config.num_envs,
                frame_shape=frame,
                stack=config.frame_stack,
                horizon=self.agent.horizon,
                gamma=config.gamma,
                alpha=self.agent.algorithm.alpha if self.agent.mode.rl else 0.0,
                seed=seed_for(config.seed, "replay"),
            )
        except (ValueError, MemoryError) as error:
            raise ConfigError(
                f"--buffer_size={config.buffer_size}: {error}; --num_envs={config.num_envs}, "
                f"--frame_stack={config.frame_stack} and --rl={config.rl} say how much it takes"
            ) from None
        self.random = np.random.default_rng(seed_for(config.seed, "random policy"))
        self.given = self.given_policy() if config.policy_from else None
        self.act_key = named_key(self.key, "act")
        self.eval_key = named_key(self.key, "eval")
        self.evaluator = Evaluator(
            config,
            lambda params: greedy_policy(self.agent, params, self.eval_key),
            functools.partial(self.make_env, "eval"),
        )
        self.stacks = FrameStack(config.num_envs, config.frame_stack, frame)
        self.score = np.zeros(config.num_envs)  # of the training episodes so far
        self.env_steps = self.updates = 0
        self.solved = False  # an evaluation has reached the return that ends the run
        self.report = Report(
            out, config.steps, self.agent.fetch, progress=progress, tensorboard=config.tensorboard
        )
        self.diagnostics: Diagnostics | None = None
        if config.diagnostics:
            self.diagnostics = Diagnostics(
                config, self.agent.measures, self.agent.horizon, out, self.report.progress.note
            )
        self.saved: checkpoint.Manifest | None = None  # the newest checkpoint
        self.saved_position = self.replay.next_position.copy()  # replay's, when it was written
        self.resumed = resume is not None
        if resume is not None:
            snapshot.put(self, resume)

    def train(self) -> Result:
        """Runs to the end, or until it is told to stop."""
        finished = False
        try:
            with self.report, self.env_thread, self.evaluator:
                ending.clear(self.out)
                try:
                    finished = self.run()
                except (KeyboardInterrupt, BrokenBarrierError):  # the latter where another seed was the first
                    last = "there is no checkpoint"
                    if self.saved is not None:
                        last = f"the last checkpoint is of {self.saved.env_steps}"
                    self.report.progress.note(f"interrupted after {self.env_steps} env steps; {last}")
                finally:
                    self.evaluator.leave()
                pictures = self.pictures()
        finally:
            self.env.close()
        return Result(self.env_steps, self.updates, not finished, pictures, self.evaluator.recording)

    def run(self) -> bool:
        """To the last env step, or to the return that ends the run; False where it was told to stop."""
        config = self.config
        if not self.resumed:
            self.start()
            self.start_evaluation(self.now())
        while self.env_steps < config.steps and not self.solved:
            if self.agent.agree(self.stop()):
                self.save()
                self.report.progress.note(
                    f"stopped after {self.env_steps} env steps; a checkpoint is written"
                )
                return False
            before = self.env_steps
            self.step()
            rows = self.passed(before, config.log_every), self.passed(before, config.eval_every)
            if any(rows):
                self.finish_evaluation()
                if self.solved:
                    break
            if rows[0]:
                self.write_train_row()
            if rows[1]:
                self.start_evaluation(self.now())
            if self.passed(before, self.checkpoint_every) and self.env_steps < config.steps:
                self.keep_encoder()  # first: a run that goes on from the checkpoint does not write it again
                self.save()
            self.report.progress.update(self.env_steps)
        self.finish_evaluation()
        self.check_losses()
        self.finish()
        return True

    def start(self) -> None:
        """Resets the training environments."""
        frames, _ = self.env.reset()
        self.stacks.begin(frames)
        self.replay.begin(frames)

    def step(self) -> None:
        """One step of every environment, and the updates that are due.

        Acting and stepping the environments have a thread of their own while the device updates. Both start
        from the parameters and the replay of the step before, so that no result depends on timing.
        """
        config, number = self.config, self.config.num_envs
        stepping = self.env_thread.submit(
            act_and_step, self.policy, self.stacks.observations(), self.env_steps, self.epsilon, self.env
        )
        for _ in range(self.due()):
            self.update()
        actions, (frames, rewards, terminated, truncated, info) = stepping.result()
        self.score += rewards
        self.stacks.push(frames)
        self.replay.add(
            actions,
            (np.sign(rewards) if config.reward_clip else rewards).astype(np.float32),
            terminated,
            truncated,
            info["life_lost"] if config.life_loss else np.zeros(number, bool),
            frames,
        )
        self.env_steps += number
        over = terminated | truncated
        if over.any():
            self.report.ended(self.score[over])
            self.score[over] = 0.0
            frames, _ = self.env.reset(options={"reset_mask": over})
            self.stacks.begin(frames, over)
            self.replay.begin(frames[over], np.flatnonzero(over))

    # Acting

    @property
    def policy(self) -> Policy:
        """The behaviour policy, of the parameters as they are now."""
        if self.agent.mode.rl:
            return _policy(self.agent.act, self.state, self.act_key)
        return self.given or random_policy(self.num_actions, self.random)

    @property
    def epsilon(self) -> float:
        """Of the training policy, now."""
        c = self.config
        if not self.agent.mode.rl:
            return c.pretrain_epsilon if self.given is not None else 1.0
        return linear(c.eps_train, c.eps_final, c.eps_anneal_steps, self.env_steps)

    @property
    def beta(self) -> float:
        """The importance weights' exponent, now."""
        c = self.config
        return linear(c.beta, c.beta_final, c.beta_anneal_steps, self.env_steps)

    # Learning

    @property
    def hyper(self) -> Hyper:
        """Numbers of the next update: the agent's, with learning rates on their way to `lr_final_share`."""
        hyper = self.agent.hyper
        if self.config.lr_final_share == 1.0:
            return hyper
        left = linear(1.0, self.config.lr_final_share, self.config.steps, self.env_steps)
        return hyper._replace(
            learning_rates={name: np.float32(rate * left) for name, rate in self.learning_rates.items()}
        )

    def due(self) -> int:
        """Updates to do now, so that there are `updates_per_step` for each env step since learning began."""
        config = self.config
        if self.env_steps < config.learn_start or not len(self.replay):
            return 0
        # Counted from the start of learning; the first comes with the first step after it.
        steps = self.env_steps - config.learn_start + config.num_envs
        return int(steps * config.updates_per_step + 1e-9) - self.updates

    def update(self) -> None:
        """One update, from sampling a window to setting its priorities; waits for the device."""
        window, indices = self.replay.sample(self.config.batch_size, self.beta)
        rl_alone = self.updates % self.config.srl_every
        update = self.agent.update_rl if rl_alone else self.agent.update
        self.state, td_error, metrics = update(self.state, window, self.hyper)
        self.updates += 1
        if self.agent.follow_every and self.updates % self.agent.follow_every == 0:
            self.state = self.agent.follow(self.state)
        self.report.means.add(metrics)
        if td_error is None:
            jax.block_until_ready(metrics)  # or windows would pile up
            return
        td_error = np.asarray(td_error)
        if not np.isfinite(td_error).all():
            self.check_losses("a temporal-difference error")
        self.replay.set_priorities(indices, td_error)

    # Reporting

    def passed(self, before: int, every: int) -> bool:
        """Whether a multiple of `every` env steps was reached since `before`."""
        return self.env_steps // every > before // every

    def write_train_row(self) -> None:
        """A "train" row: schedules, and means since the last one."""
        self.check_losses()
        values = {"epsilon": self.epsilon, "beta": self.beta, "replay/transitions": len(self.replay)}
        self.report.train_row(self.env_steps, self.updates, values)

    def check_losses(self, otherwise: str | None = None) -> None:
        """Whether all losses since the last row were finite.

        Args:
            otherwise: what else is not finite.

        Raises:
            Diverged: one was not, or there is something else.
        """
        if (name := self.report.means.broken() or otherwise) is not None:
            raise Diverged(
                f"{name} is not finite after {self.env_steps} env steps and {self.updates} updates; "
                "the checkpoints are from before"
            )

    def now(self) -> Moment:
        """What an evaluation that is due is of."""
        return Moment(self.state.params, self.env_steps, self.updates, self.diagnose())

    def diagnose(self) -> dict[str, Any]:
        """What `srl_jax.diagnostics` says of the run as it is now; changes nothing of it.

        Keeps the encoder and the decoders, if this evaluation is one of those whose are kept.
        """
        config, diagnostics = self.config, self.diagnostics
        if diagnostics is None:
            return {}
        self.check_losses()
        window = None
        if self.agent.measures.conflict is not None and len(self.replay):
            rng = np.random.default_rng(seed_for(config.seed, "diagnostics", self.env_steps))
            window, _ = self.replay.sample(config.batch_size, self.beta, rng)
        state = self.agent.export(self.state)
        values = diagnostics.measure(state, self.env_steps, window, self.hyper)
        if self.env_steps in diagnostics.steps:
            self.save_parameters("encoders", diagnostics.parts(state.params), keep=0)
        return values

    def start_evaluation(self, moment: Moment) -> None:
        """Has the policy of that moment evaluated while training goes on.

        In a mode without RL nothing is played, and a row of the diagnostics is written.
        """
        if self.agent.mode.rl:
            self.evaluator.start(moment)
        elif moment.diagnosed:
            self.report.eval_row(moment.env_steps, moment.updates, moment.diagnosed)

    def finish_evaluation(self) -> None:
        """Waits for the evaluation that is under way, writes its row; sets `solved`.

        Called before the next row is written, so that rows are in the same order however long games take.
        """
        if (finished := self.evaluator.finish()) is None:
            return
        moment, played, seconds = finished
        mean = float(np.mean(played.returns))
        values = {
            "eval/return_mean": mean,
            "eval/returns": played.returns,
            "eval/lengths": played.lengths,
            "wall_eval_s": round(seconds, 3),
        }
        self.report.eval_row(moment.env_steps, moment.updates, values | moment.diagnosed)
        self.report.progress.note(
            f"evaluation after {moment.env_steps} env steps: mean return {mean:.2f} "
            f"over {len(played.returns)} games, {seconds:.1f} s"
        )
        self.report.progress.update(self.env_steps, evaluation=mean)
        wanted = self.config.stop_at_return
        self.solved = self.agent.agree(wanted is not None and mean >= wanted)

    def save(self) -> None:
        """Writes a checkpoint that can be gone on from, unless there is one of this moment."""
        if self.saved is not None and self.saved.env_steps == self.env_steps:
            return
        self.check_losses()
        self.saved = checkpoint.save(
            self.out,
            self.state.params,
            self.config,
            num_actions=self.num_actions,
            env_steps=self.env_steps,
            updates=self.updates,
            state=snapshot.take(self),
            base=self.saved,
        )
        self.saved_position = self.replay.next_position.copy()

    def keep_encoder(self) -> None:
        """Writes the encoder, if the checkpoint that is due is one of every so many."""
        every = self.config.keep_encoder_every
        if self.diagnostics is not None and self.env_steps in self.diagnostics.steps:
            return  # it is there already
        if every and self.env_steps // self.checkpoint_every % every == 0:
            self.check_losses()
            self.save_parameters("encoders", {"encoder": self.state.params["encoder"]}, keep=0)

    def finish(self) -> None:
        """Writes the last checkpoint: of parameters alone, and leaves no more of the one before."""
        before = self.saved if self.saved and self.saved.env_steps < self.env_steps else None
        self.save_parameters("checkpoints", self.state.params, keep=2)
        self.agent.agree(True)  # all seeds have theirs; until then, they can go on from the one before
        if before is not None:
            checkpoint.slim(before)

    def save_parameters(self, folder: str, params: Params, keep: int) -> None:
        """Writes a checkpoint that has parameters alone."""
        checkpoint.save(
            self.out,
            params,
            self.config,
            num_actions=self.num_actions,
            env_steps=self.env_steps,
            updates=self.updates,
            keep=keep,
            folder=folder,
        )

    def pictures(self) -> dict[str, tuple]:
        """What the objectives make of a few observations from replay."""
        drawn = {n: o.image for n, o in self.agent.objectives.items() if o.image}
        if not drawn or not len(self.replay):
            return {}
        window, _ = self.replay.sample(PICTURES, self.beta)

        def draw(params: Any, window: Window):
            latents = make_latents(self.agent.encoder, params["encoder"], params["encoder"], window)
            return {name: image(params[name], latents, window) for name, image in drawn.items()}

        made = jax.device_get(jax.jit(draw)(self.state.params, window))
        stack = self.config.frame_stack
        inputs = np.moveaxis(window.frames[:, :stack], 1, -1).astype(np.float32) / 255.0
        return {name: (inputs, target, output) for name, (target, output) in made.items()}

    # Starting

    def make_env(self, purpose: str, num_envs: int):
        """Environments with seeds of their own for this purpose."""
        seed = seed_for(self.config.seed, purpose, "environments")
        max_steps = self.config.eval_max_steps if purpose == "eval" else 0
        return make_env(self.config, num_envs, seed, max_steps=max_steps)

    def initial_params(self) -> dict[str, Params]:
        """{group: tree} of what starts from another run: the encoder, and heads as `heads_from` says."""
        config = self.config
        if not config.encoder_from:
            return {}
        found = checkpoint.load(checkpoint.read_manifest(config.encoder_from))
        template = self.agent.shapes().params
        wanted = {"representation": template.keys() - {RL}, "all": template.keys(), "none": {ENCODER}}
        names = sorted(wanted[config.heads_from] & found.keys())
        hint = "" if config.heads_from == "none" else " (--heads_from=none starts from the encoder alone)"
        return checkpoint.load_into(
            {name: template[name] for name in names},
            {name: found[name] for name in names},
            f"--encoder_from={config.encoder_from}{hint}",
        )

    def given_policy(self) -> Policy:
        """The policy of `policy_from`, without noise."""
        agent, params, manifest = load_agent(self.config.policy_from)
        if manifest.num_actions != self.num_actions:
            raise ConfigError(
                f"--policy_from={self.config.policy_from}: its policy has {manifest.num_actions} actions, "
                f"{self.config.game} has {self.num_actions}"
            )
        return greedy_policy(agent, params, named_key(self.key, "given policy"))
