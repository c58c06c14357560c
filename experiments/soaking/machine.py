"""Replay as a state machine, against lists of whole episodes: does any order of operations break it?

hypothesis chooses the sizes of a replay and a sequence of operations. After each one everything that is cheap
to compare is compared, and a sample in every index, weight and window. As a choice of hypothesis takes longer
than an operation with its checks, one of the choices is a burst: a seed, from which numpy chooses up to 100
operations, each checked and counted like any other. A restore goes through bytes, JSON and frames kept as a
checkpoint keeps them; the next operations are done by both replays, which have to agree to the bit.
"""

import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from srl_jax.specs import ConfigError

from . import Count, Say
from .replay_reference import EVENTS, STEP, Driver

OPERATIONS, SHORT = 1_000_000, 2_000
"""To be done at least; a step of all streams, begin, sample, set_priorities and restore count one each."""

SAY_EVERY_S = 10.0
IN_STEP = 30
"""Operations that a restored replay does beside the one that it was restored from."""

ERRORS = (0.0, 1e-3, 0.5, -1.0, 3.0, -40.0, 1e3)


class Machine:
    """One replay beside its reference, and operations on both; each is checked when it is done.

    Args:
        sizes: of the Driver: num_streams, slots, ...
        done: called with the name of each operation that was done and held.
    """

    def __init__(self, sizes, done):
        self.driver, self.done = Driver(**sizes), done
        self.num_streams, self.slots = sizes["num_streams"], sizes["slots"]
        self.drawn = []  # indices that samples gave, old ones too
        self.in_step = 0

    def step(self, events):
        """events: for each stream, what happens to it."""
        self.driver.step(events[: self.num_streams])
        self._finish("steps")

    def begin(self, streams):
        """streams: bool for each stream; those begin an episode, whatever they are doing."""
        chosen = [i for i in range(self.num_streams) if streams[i]]
        if chosen:
            self.driver.begin(chosen)
            self._finish("begins")

    def lap(self):
        """Plain steps until every slot has been overwritten."""
        for _ in range(self.slots):
            self.step([STEP] * self.num_streams)

    def sample(self, batch_size, beta):
        if len(self.driver.replay):
            self.drawn = (self.drawn + self.driver.sample(batch_size, beta))[-200:]
            self._finish("samples")
            return
        try:
            self.driver.replay.sample(batch_size, beta)
        except ValueError:
            self._finish("samples")
        else:
            raise AssertionError("sample: drew from a replay with nothing to draw from")

    def set_priorities(self, choices, errors):
        """choices: int for each error; which of the indices drawn so far it is for, or one next to it."""
        indices = [self.drawn[c % len(self.drawn)] + (c % 11 == 0) for c in choices if self.drawn]
        self.driver.set_priorities(indices, list(errors[: len(indices)]))
        self._finish("priorities set")

    def restore(self):
        self.driver.restore()
        self.in_step = IN_STEP
        self.driver.check_windows()
        self._finish("restores")

    def burst(self, seed, number):
        """So many operations, of a generator's choice."""
        rng = np.random.default_rng(seed)
        common = rng.random() ** 2  # of events that are no plain step: many short episodes, or few long ones
        for _ in range(number):
            kind = rng.random()
            if kind < 0.5:
                events = rng.choice(EVENTS, self.num_streams)
                self.step(np.where(rng.random(self.num_streams) < common, events, STEP))
            elif kind < 0.55:
                self.begin(rng.random(self.num_streams) < 0.5)
            elif kind < 0.77:
                self.sample(int(rng.integers(1, 9)), rng.random())
            elif kind < 0.98:
                choices = rng.integers(0, 1000, rng.integers(1, 9)).tolist()
                self.set_priorities(choices, rng.choice(ERRORS, len(choices)).tolist())
            else:
                self.restore()
        self.driver.check_windows()

    def _finish(self, operation):
        self.driver.check()
        self.in_step -= 1
        if self.in_step < 0:
            self.driver.twin = None
        self.done(operation)


def make_rules(done):
    """Machine as hypothesis' RuleBasedStateMachine; `done` as there, and "replays" for each one made."""
    from hypothesis import stateful
    from hypothesis import strategies as st

    three = lambda of: st.lists(of, min_size=3, max_size=3)  # noqa: E731, one for each stream there can be
    event = st.one_of(st.just(STEP), st.sampled_from(EVENTS))
    few = st.integers(0, 8)
    choice = st.tuples(st.integers(0, 999), st.sampled_from(ERRORS))

    class Rules(stateful.RuleBasedStateMachine):
        @stateful.initialize(
            num_streams=st.integers(1, 3),
            stack=st.integers(1, 4),
            horizon=st.integers(1, 5),
            more_slots=st.one_of(few, few, st.integers(9, 60)),  # 64 leaves fill a block of the sum tree
            spare=st.integers(0, 2),
            alpha=st.sampled_from((0.5, 0.6, 1.0, 0.0)),
            seed=st.integers(0, 2**32 - 1),
        )
        def make(self, num_streams, stack, horizon, more_slots, spare, alpha, seed):
            sizes = {"num_streams": num_streams, "stack": stack, "horizon": horizon, "alpha": alpha}
            sizes |= {"slots": stack + horizon + 2 + more_slots, "spare": spare % num_streams, "seed": seed}
            self.machine = Machine(sizes, done)
            done("replays")

        @stateful.rule(events=three(event))
        def step(self, events):
            self.machine.step(events)

        @stateful.rule(streams=three(st.booleans()))
        def begin(self, streams):
            self.machine.begin(streams)

        @stateful.rule()
        def lap(self):
            self.machine.lap()

        @stateful.rule(batch_size=st.integers(1, 8), beta=st.floats(0, 1))
        def sample(self, batch_size, beta):
            self.machine.sample(batch_size, beta)

        @stateful.rule(chosen=st.lists(choice, max_size=8))
        def set_priorities(self, chosen):
            self.machine.set_priorities([c for c, _ in chosen], [e for _, e in chosen])

        @stateful.rule()
        def restore(self):
            self.machine.restore()

        @stateful.rule(seed=st.integers(0, 2**32 - 1), number=st.integers(1, 100))
        def burst(self, seed, number):
            self.machine.burst(seed, number)

    return Rules


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """Does a million operations (short: 2,000) on many small replays; stops at the first failure.

    Args:
        short: see experiments.soaking.Part; does not look for the shortest example of a failure.
        folder: gets machine_failure.txt, the example that failed, if one did.
        say: told the rate and the time left.

    Raises:
        ConfigError: hypothesis is not installed.
    """
    try:
        import hypothesis
        from hypothesis import stateful
    except ImportError:
        raise ConfigError("the machine part needs hypothesis: pip install 'srl-jax[dev]'") from None

    wanted = SHORT if short else OPERATIONS
    tally, started = Counter(), time.monotonic()
    progress = SimpleNamespace(operations=0, said=started)

    def done(operation):
        tally[operation] += 1
        progress.operations += operation != "replays"
        now = time.monotonic()
        if now - progress.said >= SAY_EVERY_S:
            progress.said, rate = now, progress.operations / (now - started)
            left = max(wanted - progress.operations, 0) / rate
            so_far = f"{progress.operations:,} of {wanted:,} replay operations"
            say(f"machine: {so_far}, {rate:,.0f}/s, {left:,.0f} s left")

    settings = hypothesis.settings(
        max_examples=3 if short else 100,
        stateful_step_count=30,
        deadline=None,
        database=None,
        derandomize=False,
        print_blob=False,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate] + [hypothesis.Phase.shrink] * (not short),
    )
    failure, seed = None, 0
    while progress.operations < wanted and failure is None:
        rules = hypothesis.seed(seed)(make_rules(done))
        try:
            stateful.run_state_machine_as_test(rules, settings=settings)
        except Exception as error:  # whatever a broken replay raises
            failure = error
        seed += 1

    seconds = time.monotonic() - started
    kinds = ", ".join(f"{tally[name]:,} {name}" for name in sorted(tally) if name != "replays")
    detail = f"{tally['replays']:,} replays: {kinds}; {seconds:,.0f} s"
    if failure is not None:
        first = str(failure).strip().splitlines()[0]
        path = folder / "machine_failure.txt"
        text = [f"{type(failure).__name__}: {failure}", *getattr(failure, "__notes__", [])]
        path.write_text("\n".join(text) + "\n", encoding="utf-8")
        say(f"machine: failed: {first}; the operations that led there: {path}")
        detail = f"{first} ({detail})"
    return [Count("replay operations", progress.operations, int(failure is not None), detail)]
