"""Replay as hypothesis' state machine, beside a reference: does any order of operations break it?

hypothesis chooses the sizes of a replay and a sequence of operations. After each one everything that is cheap
to compare is compared, and a sample in every index, weight and window. As a choice of hypothesis takes longer
than an operation with its checks, one of the choices is a burst: a seed, from which numpy chooses up to 100
operations, each checked and counted like any other. A restore goes through bytes, JSON and frames kept as a
checkpoint keeps them; both replays do the next operations, and have to agree to the bit.
"""

from collections import Counter

import hypothesis
import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from tests.replay.reference import EVENTS, STEP, Driver

IN_STEP = 30
"""Operations that a restored replay does beside the one that it was restored from."""
ERRORS = (0.0, 1e-3, 0.5, -1.0, 3.0, -40.0, 1e3)

SETTINGS = hypothesis.settings(
    deadline=None, database=None, print_blob=False, suppress_health_check=list(hypothesis.HealthCheck)
)

_three = lambda of: st.lists(of, min_size=3, max_size=3)  # noqa: E731, one for each stream there can be
_event = st.one_of(st.just(STEP), st.sampled_from(EVENTS))
_few = st.integers(0, 8)
_slots = st.one_of(_few, _few, st.integers(9, 60))  # 64 leaves fill a block of the sum tree
_priority = st.tuples(st.integers(0, 999), st.sampled_from(ERRORS))


class ReplayMachine(RuleBasedStateMachine):
    """One replay beside its reference, and operations on both; each is checked when it is done.

    Attributes:
        done: how often each operation was done and held, of all replays together.
    """

    done: Counter[str] = Counter()

    @initialize(
        num_streams=st.integers(1, 3),
        stack=st.integers(1, 4),
        horizon=st.integers(1, 5),
        more_slots=_slots,
        spare=st.integers(0, 2),
        alpha=st.sampled_from((0.5, 0.6, 1.0, 0.0)),
        seed=st.integers(0, 2**32 - 1),
    )
    def make(self, num_streams, stack, horizon, more_slots, spare, alpha, seed):
        self.num_streams, self.slots = num_streams, stack + horizon + 2 + more_slots
        sizes = {"num_streams": num_streams, "slots": self.slots, "stack": stack, "horizon": horizon}
        self.driver = Driver(**sizes, alpha=alpha, spare=spare % num_streams, seed=seed)
        self.drawn = []  # indices that samples gave, old ones too
        self.in_step = 0

    @rule(events=_three(_event))
    def step(self, events):
        """events: for each stream, what happens to it."""
        self.driver.step(events[: self.num_streams])
        self.finish("steps")

    @rule(streams=_three(st.booleans()))
    def begin(self, streams):
        """streams: bool for each stream; those begin an episode, whatever they are doing."""
        chosen = [i for i in range(self.num_streams) if streams[i]]
        if chosen:
            self.driver.begin(chosen)
            self.finish("begins")

    @rule()
    def lap(self):
        """Plain steps until every slot has been overwritten."""
        for _ in range(self.slots):
            self.step([STEP] * self.num_streams)

    @rule(batch_size=st.integers(1, 8), beta=st.floats(0, 1))
    def sample(self, batch_size, beta):
        if len(self.driver.replay):
            self.drawn = (self.drawn + self.driver.sample(batch_size, beta))[-200:]
            self.finish("samples")
            return
        try:
            self.driver.replay.sample(batch_size, beta)
        except ValueError:
            self.finish("samples")
        else:
            raise AssertionError("sample: drew from a replay with nothing to draw from")

    @rule(chosen=st.lists(_priority, max_size=8))
    def set_priorities(self, chosen):
        """chosen: (which of the indices drawn so far it is for, or one next to it; the error)."""
        chosen = chosen if self.drawn else []
        indices = [self.drawn[c % len(self.drawn)] + (c % 11 == 0) for c, _ in chosen]
        self.driver.set_priorities(indices, [error for _, error in chosen])
        self.finish("priorities set")

    @rule()
    def restore(self):
        self.driver.restore()
        self.in_step = IN_STEP
        self.driver.check_windows()
        self.finish("restores")

    @rule(seed=st.integers(0, 2**32 - 1), number=st.integers(1, 100))
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
                number_of = int(rng.integers(1, 9))
                choices = rng.integers(0, 1000, number_of).tolist()
                self.set_priorities(list(zip(choices, rng.choice(ERRORS, number_of).tolist(), strict=True)))
            else:
                self.restore()
        self.driver.check_windows()

    def finish(self, operation):
        """An operation was done: compares the two, and counts it."""
        self.driver.check()
        self.in_step -= 1
        if self.in_step < 0:
            self.driver.twin = None
        self.done[operation] += 1
