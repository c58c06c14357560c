"""The host loop of one seed, or of several in step: act, step, add, sample, update; evaluate and checkpoint.

The device's state has an axis of seeds (`srl_jax.learning.agent.over_seeds`), and the host keeps a `Seed`
for each. Threads act, step and reset the environments while the main thread has the device update. Both start
from the parameters and the replay of the step before, and they meet before the next step. Evaluations have
threads of their own and are awaited before the next row is written. So no result depends on timing.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from srl_jax.config import Config
from srl_jax.diagnostics.pictures import pictures
from srl_jax.errors import ConfigError, Diverged, SaveError
from srl_jax.files.checkpoint import Manifest
from srl_jax.learning.agent import Agent, make_agent, over_seeds
from srl_jax.learning.resets import reset, reset_key
from srl_jax.learning.update import NORM_EVERY, named_key
from srl_jax.loading import given_policy, initial_params
from srl_jax.run import ending, saving
from srl_jax.run.actor import make_env, yielding_threads
from srl_jax.run.ending import Ending
from srl_jax.run.evaluations import FINAL, Evaluating
from srl_jax.run.schedules import Now, Schedules, passed
from srl_jax.run.seed import Seed
from srl_jax.types import Params

FETCH_EVERY = 100
"""Updates after which their metrics are fetched from the device, so that few wait there between two rows."""


class Result(NamedTuple):
    """How a run ended.

    Attributes:
        env_steps, updates: done.
        interrupted: whether it was stopped before its end.
        saved: env steps of the newest checkpoint that can be resumed from; None without one.
        pictures: {objective: (inputs, targets, outputs)}, see `srl_jax.diagnostics.pictures`.
        recording: uint8 [T, H, W, C], the first games of the last evaluation; None without one.
    """

    env_steps: int
    updates: int
    interrupted: bool
    saved: int | None
    pictures: dict[str, tuple]
    recording: np.ndarray | None

    def __repr__(self) -> str:
        """Without its pictures."""
        return f"Result({', '.join(f'{name}={getattr(self, name)}' for name in self._fields[:4])})"


def train(config: Config, out: str | Path, *, resume: Manifest | None = None, **options: Any) -> Result:
    """Trains one agent, of the configuration's seed; otherwise as `train_seeds`."""
    return train_seeds(config, [config.seed], [out], resume=resume and [resume], **options)[0]


def train_seeds(
    config: Config,
    seeds: Sequence[int],
    outs: Sequence[str | Path],
    *,
    progress: bool = True,
    resume: Sequence[Manifest] | None = None,
    stop: Callable[[], bool] = lambda: False,
    begun: Callable[[], None] = lambda: None,
    agent: Agent | None = None,
) -> list[Result]:
    """Trains an agent of each seed, in step, writing rows and checkpoints into run directories.

    How a run ended goes to its `ended.json`, see `srl_jax.run.ending`. A ConfigError before its first step
    changes nothing there, and nor does anything else before that of a run that is resumed.
    What stops one seed stops all; a return that ends a run early must be reached by all in one evaluation.

    Args:
        config: of the runs, resolved; its seed does not matter.
        seeds: distinct.
        outs: their run directories, which exist.
        progress: whether to draw a progress bar on stderr, the first seed's.
        resume: a checkpoint of each to resume from, of the same configuration and env step, found whole by
            `checkpoint.verify`; what follows is what would have followed had the run not ended there.
        stop: asked before each step; once it says so, a checkpoint is written and training ends. A
            KeyboardInterrupt instead leaves the last checkpoint.
        begun: called once nothing refuses the configuration any more, before the first step.
        agent: of this configuration, where it is made already.

    Raises:
        ConfigError: a spec or a checkpoint to start from does not fit.
        Diverged: a loss is no longer finite; the last checkpoint is from before.
        SaveError: something could not be written; the last checkpoint is whole.
    """
    paths, run = [Path(out) for out in outs], None
    configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
    try:
        run = Run(configs, paths, progress=progress, agent=agent, resume=resume, stop=stop)
        results = run.train(begun)
    except BaseException as error:
        if not (run and run.begun) and (resume or isinstance(error, ConfigError)):
            raise
        for path in paths:  # of several, those that did nothing wrong were stopped
            own = error if getattr(error, "run", path) == path else KeyboardInterrupt()
            with contextlib.suppress(SaveError):  # what ended the run is what is told
                ending.write(path, ending.of(own, run.env_steps if run else 0))
        raise
    for path, result in zip(paths, results, strict=True):
        ending.write(path, Ending("stopped" if result.interrupted else "finished", result.env_steps))
    return results


class Run:
    """A run of one seed or several; a context in which its files and threads are open.

    `state`, `env_steps`, `updates`, `seeds` and `waiting` are all that changes in it.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        outs: Sequence[Path],
        *,
        progress: bool = False,
        agent: Agent | None = None,
        resume: Sequence[Manifest] | None = None,
        stop: Callable[[], bool] = lambda: False,
    ):
        config = self.config = configs[0]
        self.stop = stop
        self.checkpoint_every = config.checkpoint_every or config.eval_every
        self.env_threads = yielding_threads("environments", len(configs))
        # Environments are made in their threads, so that the threads that they start yield, too.
        envs = list(self.env_threads.map(lambda c: make_env(c, "train", c.num_envs), configs))
        with contextlib.ExitStack() as refused:
            refused.enter_context(self.env_threads)
            for env in envs:
                refused.callback(env.close)
            num_actions = int(envs[0].single_action_space.n)
            frame = envs[0].single_observation_space.shape
            self.agent = agent or make_agent(config, frame, num_actions)
            self.device = over_seeds(self.agent, len(configs))
            self.seeds = [
                Seed(own, Path(out), self.agent, env, progress and i == 0)
                for i, (own, out, env) in enumerate(zip(configs, outs, envs, strict=True))
            ]
            self.schedules = Schedules(config, self.agent.hyper, self.agent.objectives)
            self.act_keys = [named_key(seed.key, "act") for seed in self.seeds]
            if policy := given_policy(config, frame, num_actions):
                for seed in self.seeds:
                    seed.policy = policy(named_key(seed.key, "given policy"))
            self.env_steps = self.updates = 0
            self.begun = False  # whether its directories say that it is under way
            self.waiting: list[dict] = []  # metrics of updates, on the device
            if resume is None:
                start = initial_params(config, frame, self.agent)
                states = [self.agent.init(seed.key, start) for seed in self.seeds]
                for seed in self.seeds:
                    seed.begin()
            else:
                states = list(self.env_threads.map(Seed.restore, self.seeds, resume))
                self.env_steps, self.updates = resume[0].env_steps, resume[0].updates
            self.state = self.device.stack(states)
            refused.pop_all()

    def __enter__(self) -> "Run":
        with contextlib.ExitStack() as stack:
            for seed in self.seeds:
                seed.open(stack)
            stack.enter_context(self.env_threads)  # last: environments close when no thread steps them
            self.opened = stack.pop_all()
        return self

    def __exit__(self, *exception) -> None:
        self.opened.__exit__(*exception)

    @property
    def now(self) -> Now:
        """The numbers of the schedules, now."""
        return self.schedules.at(self.env_steps, self.updates)

    def each(self, tree: Any) -> Iterator[tuple[Seed, Any]]:
        """The seeds, each with its own of a tree on the device."""
        return zip(self.seeds, self.device.parts(tree), strict=True)

    def train(self, begun: Callable[[], None] = lambda: None) -> list[Result]:
        """Runs to the end, or until it is told to stop; `begun` as of `train_seeds`."""
        first, finished = self.seeds[0], False
        with self:
            begun()
            for seed in self.seeds:
                ending.clear(seed.out)
                if seed.saved and saving.drop_after(seed.out, self.env_steps):
                    seed.evaluations.best = -np.inf  # nothing is kept of what was best before
            self.begun = True
            try:
                finished = self.run()
            except KeyboardInterrupt:
                last = f"the last checkpoint is of {first.saved.env_steps}" if first.saved else ""
                done = f"interrupted after {self.env_steps} env steps"
                first.report.progress.note(f"{done}; {last or 'there is no checkpoint'}")
            results = []
            for seed, params in self.each(self.state.params):
                drawn = pictures(self.agent, params, seed.replay, self.now.beta)
                seed.report.pictures(self.env_steps, drawn)
                counts = self.env_steps, self.updates, not finished, seed.saved and seed.saved.env_steps
                results.append(Result(*counts, drawn, seed.evaluations.recording))
        return results

    def run(self) -> bool:
        """To the last env step, or to the return that ends the run, and the final evaluation behind it.

        Returns:
            Whether it got there; False where it was told to stop.
        """
        config, first = self.config, self.seeds[0]
        if first.saved is None:
            self.start_evaluation()
        else:
            for seed in self.seeds:
                seed.evaluations.play()
        final = first.evaluations.final  # under way already, where it is resumed
        while self.env_steps < config.steps and not (final or self.reached()):
            if self.stopped():
                return False
            log, evaluate, save = (
                passed(self.env_steps, self.env_steps + config.num_envs, every)
                for every in (config.log_every, config.eval_every, self.checkpoint_every)
            )
            if (log or evaluate) and not self.played():  # its rows come before the next ones
                return False
            self.step()
            if log or evaluate:
                self.finish_evaluation()
            if log:
                self.write_train_rows()
            if self.reached():
                break
            save = save and self.env_steps < config.steps
            if save:
                self.keep_encoders()
            if evaluate:
                self.start_evaluation()
            if save:  # last: a run that resumes from it does none of this again
                self.save()
            first.report.progress.update(self.env_steps)
        if not self.played():
            return False
        self.finish_evaluation()
        if not final:
            self.start_final()
            if not self.played():
                return False
            self.finish_evaluation()
        self.finish()
        return True

    def stopped(self) -> bool:
        """Whether it was told to stop; then a checkpoint is written."""
        if self.stop():
            self.save()
            return True
        return False

    def played(self) -> bool:
        """Waits for the games of the evaluation under way; False where it was told to stop instead."""
        playing = [seed.evaluations.games for seed in self.seeds if seed.evaluations.games]
        while futures.wait(playing, timeout=0.1).not_done:
            if self.stopped():
                return False
        return True

    def start_final(self) -> None:
        """Has the policies of the end play the final games, if there are any.

        A checkpoint comes behind. A run that is killed meanwhile resumes there, and so does one that is
        extended, which therefore goes on without these games' rows.
        """
        if self.config.final_games and self.agent.mode.rl:
            self.fetch()
            for seed, state in self.each(self.state):
                params = self.agent.acting(state)
                seed.evaluations.start(Evaluating(params, self.env_steps, self.updates, {}, FINAL))
            self.save()

    # A step

    def step(self) -> None:
        """One step of every environment, and the updates that are due; before them a reset that is due."""
        number = self.schedules.resets(self.env_steps)
        if number > self.schedules.resets(self.env_steps - self.config.num_envs):
            self.reset(number)
        frames = [seed.stacks.observations() for seed in self.seeds]
        now = self.agent.acting(self.state), frames, self.env_steps, self.now.epsilon
        stepping = self.env_threads.submit(self.act_and_step, *now)
        if all(len(seed.replay) for seed in self.seeds):
            for _ in range(self.schedules.updates_due(self.env_steps) - self.updates):
                self.update()
        for seed, step in zip(self.seeds, stepping.result(), strict=True):
            seed.take(*step)
        self.env_steps += self.config.num_envs

    def reset(self, number: int) -> None:
        """The number-th reset of the run; see `srl_jax.learning.resets`."""
        fresh = [self.agent.init(reset_key(seed.key, number), {}) for seed in self.seeds]
        self.state = reset(self.state, self.device.stack(fresh), self.config.reset, self.config.shrink)
        self.seeds[0].report.progress.note(f"reset {number} after {self.env_steps} env steps")

    def act_and_step(
        self, params: Params, frames: list[np.ndarray], step: int, epsilon: float
    ) -> list[tuple]:
        """Acts, and steps the environments, those of each seed in a thread; runs in one of these threads."""
        if self.agent.mode.rl:
            now = np.int32(step), np.float32(epsilon)
            actions = self.device.rows(self.device.act(params, frames, self.act_keys, *now))
        else:
            actions = [seed.policy(f, step, epsilon) for seed, f in zip(self.seeds, frames, strict=True)]
        first, *others = zip(self.seeds, actions, strict=True)
        beside = [self.env_threads.submit(seed.step_env, action) for seed, action in others]
        return [Seed.step_env(*first), *(future.result() for future in beside)]

    def update(self) -> None:
        """One update, from sampling windows to setting their priorities; waits for the device."""
        _, beta, hyper, own = self.now
        sampled = [seed.replay.sample(self.config.batch_size, beta, **own) for seed in self.seeds]
        if self.device.norms and self.updates % NORM_EVERY == 0:
            windows = [window for window, _ in sampled]
            self.state = self.state._replace(norms=self.device.norms(self.state, windows, hyper))
        both, rl_alone = self.device.update, self.device.update_rl
        update = rl_alone if rl_alone and self.updates % self.config.srl_every else both
        self.state, td_errors, metrics = update(self.state, [window for window, _ in sampled], hyper)
        self.updates += 1
        if self.agent.follow_every and self.updates % self.agent.follow_every == 0:
            self.state = self.device.follow(self.state)
        self.waiting.append(metrics)
        if len(self.waiting) >= FETCH_EVERY:
            self.fetch()
        if td_errors is None:
            jax.block_until_ready(metrics)  # or windows would pile up
            return
        rows = self.device.rows(td_errors)
        for seed, (_, indices), td_error in zip(self.seeds, sampled, rows, strict=True):
            if not np.isfinite(td_error).all():
                self.fetch()  # a loss says more
                raise self.diverged(seed, "a temporal-difference error")
            seed.replay.set_priorities(indices[: len(td_error)], td_error)

    # Rows and checkpoints

    def fetch(self) -> None:
        """Adds the metrics that wait on the device to the seeds' means; before anything is written.

        Raises:
            Diverged: a loss since the last row was not finite.
        """
        waiting, self.waiting = self.waiting, []
        for seed, rows in zip(self.seeds, self.device.rows(waiting), strict=True):
            for row in rows:
                seed.report.means.add(row)
        for seed in self.seeds:
            if name := seed.report.means.broken():
                raise self.diverged(seed, name)

    def diverged(self, seed: Seed, what: str) -> Diverged:
        """The error of a seed that has something that is not finite."""
        when = f"{self.env_steps} env steps and {self.updates} updates"
        return Diverged(f"{what} is not finite after {when}; the checkpoints are from before", seed.out)

    def write_train_rows(self) -> None:
        """A "train" row of each seed: means since the last one, and schedules.

        Epsilon and beta are those of the step that begins now; resets, n and gamma, of the one that ended.
        """
        self.fetch()
        epsilon, beta, *_ = self.now
        weights = self.schedules.weights(self.env_steps)
        own = {"epsilon": epsilon, "beta": beta, **{f"weight/{name}": x for name, x in weights.items()}}
        own |= self.schedules.row(self.env_steps, self.updates)
        for seed in self.seeds:
            values = {**own, "replay/transitions": len(seed.replay)}
            seed.report.train_row(self.env_steps, self.updates, values)

    def start_evaluation(self) -> None:
        """Measures the latents of now, and has the policies of now evaluated while training goes on.

        A reset that is due is made by the next step: what is measured has the n and gamma of the last one.
        """
        self.fetch()
        now = self.now._replace(gamma_and_n=self.schedules.ended(self.env_steps, self.updates))
        for seed, state in self.each(self.state):
            seed.start_evaluation(state, self.env_steps, self.updates, now)

    def finish_evaluation(self) -> None:
        """Waits for the evaluation that is under way, if one is, and writes its rows.

        Called before the next row is written, so that rows are in the same order however long games take.
        """
        for seed in self.seeds:
            seed.evaluations.finish(self.env_steps)

    def reached(self) -> bool:
        """Whether in the last evaluation all seeds had the return that ends the run."""
        wanted = self.config.stop_at_return
        return wanted is not None and min(seed.evaluations.last for seed in self.seeds) >= wanted

    def save(self) -> None:
        """Writes checkpoints that can be resumed from, unless there are some of this moment."""
        saved = self.seeds[0].saved
        if saved is None or saved.env_steps != self.env_steps:
            self.fetch()
            for seed, state in self.each(self.state):
                seed.save(state, self.env_steps, self.updates)

    def keep_encoders(self) -> None:
        """Writes the encoders, if the checkpoint that is due is one of every `keep_encoder_every`."""
        every = self.config.keep_encoder_every
        if every and self.env_steps // max(self.checkpoint_every, self.config.num_envs) % every == 0:
            self.fetch()
            for seed, params in self.each(self.state.params):
                seed.keep({"encoder": params["encoder"]}, self.env_steps, self.updates)

    def finish(self) -> None:
        """Writes the last checkpoints, without `keep_replay` of parameters alone, and slims those before."""
        if self.config.keep_replay:
            return self.save()
        self.fetch()
        for seed, params in self.each(self.agent.acting(self.state)):
            seed.save_parameters(params, self.env_steps, self.updates)
        for seed in self.seeds:  # until all have theirs, they can be resumed from the ones before
            saving.slim_before(seed.out, self.env_steps)
            seed.saved = None
