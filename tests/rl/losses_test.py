"""srl_jax/rl/losses.py against rlax, a slow reference, and numbers worked by hand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srl_jax.rl.losses import (
    categorical_projection,
    categorical_q_learning,
    huber,
    munchausen_return,
    n_step,
    n_step_end_unnoticed,
    n_step_one_early,
    n_step_one_reward,
    q_learning,
    quantile_q_learning,
    soft_policy,
)
from tests.references import rlax

# rlax's categorical losses call a function of its own that it means to drop one day.
pytestmark = pytest.mark.filterwarnings("ignore:Rlax categorical_cross_entropy:PendingDeprecationWarning")

BATCH, ACTIONS, ATOMS = 64, 5, 11


def transitions(seed=0):
    """Random arguments of the losses; a fifth of the states bootstrapped from are terminal."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return {
        "q_tm1": 3 * normal(BATCH, ACTIONS),
        "q_logits_tm1": 3 * normal(BATCH, ACTIONS, ATOMS),
        "a_tm1": rng.integers(0, ACTIONS, BATCH, dtype=np.int32),
        "r_t": 3 * normal(BATCH),
        "discount_t": (rng.random(BATCH) * (rng.random(BATCH) > 0.2)).astype(np.float32),
        "q_slow_t": 3 * normal(BATCH, ACTIONS),
        "q_logits_slow_t": 3 * normal(BATCH, ACTIONS, ATOMS),
        "q_selector_t": normal(BATCH, ACTIONS),
        "atoms": np.linspace(-4, 4, ATOMS, dtype=np.float32),
    }


def close(ours, theirs):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), ours, theirs)


def values_and_gradients(loss, floats, *integers):
    """(losses [B], gradients of a mean of their squares): the latter tells the chain rule apart, too."""

    def mean(floats):
        losses = jax.vmap(loss)(*floats, *integers)
        return jnp.mean(losses**2), losses

    (_, losses), grads = jax.value_and_grad(mean, has_aux=True)(floats)
    return losses, grads


def test_q_learning_is_rlax_double_q_learning():
    x = transitions()
    floats = [x[n] for n in ("q_tm1", "r_t", "discount_t", "q_slow_t", "q_selector_t")]
    ours = lambda q, r, d, slow, sel, a: q_learning(q, a, r, d, slow, sel)  # noqa: E731
    theirs = lambda q, r, d, slow, sel, a: rlax.double_q_learning(q, a, r, d, slow, sel)  # noqa: E731
    run = jax.jit(lambda floats, a: [values_and_gradients(f, floats, a) for f in (ours, theirs)])
    (ours, grads), (theirs, _) = run(floats, x["a_tm1"])
    close(ours, theirs)
    # td = target - q: the gradient of the mean square is -2 td / B at the action taken, and nothing else.
    expected = np.zeros((BATCH, ACTIONS), np.float32)
    expected[np.arange(BATCH), x["a_tm1"]] = -2 * np.asarray(theirs) / BATCH
    close(grads[0], expected)
    for gradient in grads[1:]:
        assert not np.any(gradient)


def test_q_learning_with_the_slow_values_as_selector_is_rlax_q_learning():
    x = transitions(1)

    @jax.jit
    def both(q, a, r, d, slow):
        return jax.vmap(q_learning)(q, a, r, d, slow, slow), jax.vmap(rlax.q_learning)(q, a, r, d, slow)

    close(*both(x["q_tm1"], x["a_tm1"], x["r_t"], x["discount_t"], x["q_slow_t"]))


def test_q_learning_by_hand():
    # The selector prefers action 1, which the slow network values at 4; action 0 was taken, worth 2.
    # 0.5 + 0.9 * 4 - 2 = 2.1.  With its own values as selector the slow network would bootstrap from 10:
    # 0.5 + 0.9 * 10 - 2 = 7.5.
    q, slow = jnp.array([2.0, -1.0]), jnp.array([10.0, 4.0])
    arguments = (q, jnp.int32(0), jnp.float32(0.5), jnp.float32(0.9), slow)
    assert float(jax.jit(q_learning)(*arguments, jnp.array([1.0, 3.0]))) == pytest.approx(2.1)
    assert float(jax.jit(q_learning)(*arguments, slow)) == pytest.approx(7.5)


@pytest.mark.parametrize("delta", [0.5, 1.0, 2.0])
def test_huber_is_rlax_huber_loss(delta):
    x = np.concatenate([np.linspace(-4, 4, 97), [delta, -delta]]).astype(np.float32)
    weight = np.linspace(1, 2, len(x), dtype=np.float32)

    @jax.jit
    def both(x):
        return [
            jax.value_and_grad(lambda x, f=f: jnp.sum(weight * f(x, delta)))(x) + (f(x, delta),)
            for f in (huber, rlax.huber_loss)
        ]

    ours, theirs = both(x)
    close(ours, theirs)


def test_huber_by_hand():
    # Within delta 0.5 x^2: 0.125; beyond it delta (|x| - delta / 2): 3 - 0.5 = 2.5 with delta 1.
    np.testing.assert_allclose(jax.jit(huber)(jnp.array([0.5, -3.0])), [0.125, 2.5])


def same_and_alone_in_the_first(ours, theirs, x):
    """Two losses and their gradients are the same, and a gradient flows into the first argument alone."""
    floats = [x[n] for n in ("q_logits_tm1", "r_t", "discount_t", "q_logits_slow_t", "q_selector_t")]
    run = jax.jit(lambda floats, a: [values_and_gradients(f, floats, a) for f in (ours, theirs)])
    (losses, grads), reference = run(floats, x["a_tm1"])
    close((losses, grads), reference)
    assert np.any(grads[0])
    for gradient in grads[1:]:
        assert not np.any(gradient)


def test_categorical_q_learning_is_rlax_categorical_double_q_learning():
    x = transitions()
    atoms = jnp.asarray(x["atoms"])
    ours = lambda q, r, d, slow, sel, a: categorical_q_learning(q, atoms, a, r, d, slow, sel)  # noqa: E731
    theirs = lambda q, r, d, slow, sel, a: rlax.categorical_double_q_learning(  # noqa: E731
        atoms, q, a, r, d, atoms, slow, sel
    )
    same_and_alone_in_the_first(ours, theirs, x)


def test_categorical_q_learning_selecting_for_itself_is_rlax_categorical_q_learning():
    x = transitions(1)
    atoms = jnp.asarray(x["atoms"])

    @jax.jit
    def both(q, a, r, d, slow):
        selector = jax.nn.softmax(slow) @ atoms
        ours = jax.vmap(categorical_q_learning, (0, None, 0, 0, 0, 0, 0))(q, atoms, a, r, d, slow, selector)
        theirs = jax.vmap(rlax.categorical_q_learning, (None, 0, 0, 0, 0, None, 0))(
            atoms, q, a, r, d, atoms, slow
        )
        return ours, theirs

    close(*both(x["q_logits_tm1"], x["a_tm1"], x["r_t"], x["discount_t"], x["q_logits_slow_t"]))


def test_categorical_q_learning_by_hand():
    # A terminal state and a return of 0.5: all mass at 0.5, so half of it at the atoms 0 and 1. The online
    # distribution is uniform over 3 atoms: the cross-entropy is log 3 = 1.0986, whatever the target.
    # With logits (0, 0, log 2) it is uniform over 4: -(0.5 log 1/4 + 0.5 log 2/4) = 1.0397.
    atoms = jnp.array([-1.0, 0.0, 1.0])
    logits = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.log(2)]], jnp.float32)
    slow, selector = jnp.zeros((2, 3)), jnp.zeros(2)
    loss = jax.jit(
        lambda a: categorical_q_learning(logits, atoms, a, jnp.float32(0.5), jnp.float32(0), slow, selector)
    )
    assert float(loss(0)) == pytest.approx(np.log(3), rel=1e-5)
    assert float(loss(1)) == pytest.approx(0.5 * np.log(4) + 0.5 * np.log(2), rel=1e-5)


@pytest.mark.parametrize(("kappa", "drawn"), [(0.5, False), (1.0, False), (2.0, False), (1.0, True)])
def test_quantile_q_learning_is_rlax_quantile_q_learning(kappa, drawn):
    x = transitions()
    taus = np.random.default_rng(1).random(ATOMS, np.float32) if drawn else (np.arange(ATOMS) + 0.5) / ATOMS

    def ours(q, r, d, slow, selector, a):
        return quantile_q_learning(q, a, r, d, slow, selector, kappa, taus if drawn else None)

    def theirs(q, r, d, slow, selector, a):  # [M, A]; a distribution of one number is its own mean
        return rlax.quantile_q_learning(q.T, jnp.asarray(taus), a, r, d, selector[None], slow.T, kappa)

    same_and_alone_in_the_first(ours, theirs, x)


def test_quantile_q_learning_by_hand():
    # A terminal state. Two quantiles, 0 and 1, are at the shares 1/4 and 3/4 of probability.
    # A return of 0.5 is above the first and below the second, each at 1/4 of the Huber loss 0.125: 0.0625.
    # A return of 3 is above both: 1/4 * 2.5 + 3/4 * 1.5 = 1.75.
    quantiles, slow, selector = jnp.array([[0.0, 1.0]]), jnp.zeros((1, 2)), jnp.zeros(1)
    loss = jax.jit(lambda r: quantile_q_learning(quantiles, jnp.int32(0), r, jnp.float32(0), slow, selector))
    assert float(loss(jnp.float32(0.5))) == pytest.approx(0.0625)
    assert float(loss(jnp.float32(3.0))) == pytest.approx(1.75)
    # The selector prefers action 1, of slow quantiles 2 and 4: the targets are 1 + 0.5 * 2 and 1 + 0.5 * 4.
    # Action 0 was taken. Its quantile 0 has the errors 2 and 3: 1/4 * (1.5 + 2.5) / 2. Its quantile 1 has the
    # errors 1 and 2: 3/4 * (0.5 + 1.5) / 2.
    quantiles, slow = jnp.array([[0.0, 1.0], [9.0, 9.0]]), jnp.array([[7.0, 7.0], [2.0, 4.0]])
    value = quantile_q_learning(
        quantiles, jnp.int32(0), jnp.float32(1), jnp.float32(0.5), slow, jnp.array([0.0, 1.0])
    )
    assert float(value) == pytest.approx(0.5 + 0.75)


def test_munchausen_by_hand_and_as_the_paper_writes_it():
    # Two actions of one value: log(1/2) = -0.6931 each. At tau = 0.5 the bonus is -0.3466 of which nine
    # tenths count, and the entropy adds 0.5 * 0.6931: with a discount of 0.5, 1 - 0.3119 + 0.1733 = 0.8614.
    q, policy = jnp.zeros(2), soft_policy(jnp.zeros(2), 0.5)
    value = munchausen_return(jnp.float32(1), jnp.float32(0.5), q, 0, policy, tau=0.5)
    assert float(value) == pytest.approx(0.8614, abs=1e-4)
    # The other action is worth 2 more; 0.5 log pi = -2.009 is cut off at -1.
    value = munchausen_return(jnp.float32(1), jnp.float32(0), jnp.array([0.0, 2.0]), 0, policy, tau=0.5)
    assert float(value) == pytest.approx(0.1)

    # r + alpha clip(tau log pi(a | s)) + discount sum_b pi(b) (q(b) - tau log pi(b))
    x, (alpha, tau, clip) = transitions(), (0.9, 0.7, -1.5)
    log_pi = [q / tau - np.log(np.exp(q / tau).sum(-1, keepdims=True)) for q in (x["q_tm1"], x["q_slow_t"])]
    bonus = np.clip(tau * log_pi[0][np.arange(BATCH), x["a_tm1"]], clip, 0)
    soft = (np.exp(log_pi[1]) * (x["q_slow_t"] - tau * log_pi[1])).sum(-1)
    expected = x["r_t"] + alpha * bonus + x["discount_t"] * soft
    assert (bonus == clip).any() and (bonus > clip).any()

    def target(q_tm1, a_tm1, r_t, discount_t, q_slow_t):
        policy = soft_policy(q_slow_t, tau)
        r_t = munchausen_return(r_t, discount_t, q_tm1, a_tm1, policy, alpha, tau, clip)
        return r_t + discount_t * policy @ q_slow_t

    ours = jax.jit(jax.vmap(target))(*(x[n] for n in ("q_tm1", "a_tm1", "r_t", "discount_t", "q_slow_t")))
    close(ours, expected)


def test_categorical_projection_by_hand():
    # 0.25 lies between 0 and 1: three quarters of its mass go to 0. -0.5 is half-way; 7 is beyond the end.
    atoms = jnp.array([-1.0, 0.0, 1.0])
    support, probs = jnp.array([0.25, -0.5, 7.0]), jnp.array([0.4, 0.2, 0.4])
    # -1: 0.2 / 2;  0: 0.3 + 0.2 / 2;  1: 0.1 + 0.4.
    np.testing.assert_allclose(
        jax.jit(categorical_projection)(support, probs, atoms), [0.1, 0.4, 0.5], atol=1e-6
    )


_project = jax.jit(lambda *x: (categorical_projection(*x), rlax.categorical_l2_project(*x)))


@given(
    st.lists(st.integers(-20, 20), min_size=7, max_size=7),
    st.lists(st.integers(0, 10), min_size=7, max_size=7).filter(any),
)
def test_categorical_projection_is_rlax_categorical_l2_project(quarters, masses):
    # Quarters of the atoms' spacing (so often exactly on one), up to twice as far as the atoms reach.
    atoms = np.linspace(-2.5, 2.5, 6, dtype=np.float32)
    support = np.array(quarters, np.float32) / 4
    probs = np.array(masses, np.float32) / sum(masses)
    ours, theirs = _project(support, probs, atoms)
    close(ours, theirs)
    np.testing.assert_allclose(np.sum(ours), 1, rtol=1e-5)
    # Splitting by distance keeps the mean of what lies within the atoms.
    np.testing.assert_allclose(ours @ atoms, probs @ np.clip(support, -2.5, 2.5), atol=1e-5)


GAMMA, HORIZON = 0.5, 5  # powers of it are exact


def window_of(steps, truncated):
    """What `Window` holds at an episode's state, given its remaining (reward, is_terminal) steps.

    A terminal step that is not the last one is a lost life that counts as terminal: the episode goes on.
    Where the episode is cut short of the window, the rows after its end are zero.
    """
    rows = [(r, 0.0 if terminal else GAMMA, 1.0) for r, terminal in steps]
    if not truncated:
        rows[-1] = (rows[-1][0], 0.0, 1.0)
    rows = (rows + [(0.0, 0.0, 0.0)] * HORIZON)[:HORIZON]
    return [np.array(column, np.float32) for column in zip(*rows, strict=True)]


def slow_n_step(steps, truncated, n):
    """(return, factor of the bootstrap value, offset or None where it does not matter), step by step."""
    total, factor = 0.0, 1.0
    for k in range(n):
        if k == len(steps):  # the episode was cut: its final observation
            return total, factor, k
        reward, terminal = steps[k]
        total += factor * reward
        factor *= GAMMA
        if terminal or (k == len(steps) - 1 and not truncated):
            return total, 0.0, None
    return total, factor, n


_n_step = [jax.jit(partial(n_step, n=n)) for n in range(1, HORIZON + 1)]


@given(
    st.lists(st.tuples(st.integers(-3, 3), st.sampled_from([False] * 5 + [True])), min_size=1, max_size=7),
    st.booleans(),
    st.integers(1, HORIZON),
)
def test_n_step_is_the_slow_one(steps, truncated, n):
    rewards, discounts, valid = window_of(steps, truncated)
    r_t, discount_t, offset = _n_step[n - 1](rewards, discounts, valid)
    expected_return, expected_discount, expected_offset = slow_n_step(steps, truncated, n)
    assert float(r_t) == expected_return
    assert float(discount_t) == expected_discount
    assert offset.dtype == jnp.int32
    assert 1 <= int(offset) <= n
    if expected_offset is not None:
        assert int(offset) == expected_offset


_annealed_n_step = jax.jit(n_step)


@given(
    st.lists(st.tuples(st.integers(-3, 3), st.sampled_from([False] * 5 + [True])), min_size=1, max_size=7),
    st.booleans(),
    st.integers(1, HORIZON),
)
def test_n_that_is_known_when_it_runs_is_n(steps, truncated, n):
    window = window_of(steps, truncated)
    annealed = _annealed_n_step(*(np.stack([x, x]) for x in window), np.array([n, HORIZON], np.int32))
    for i, fixed in enumerate((_n_step[n - 1](*window), _n_step[-1](*window))):
        for ours, theirs in zip(annealed, fixed, strict=True):
            assert ours[i] == theirs


def test_n_step_by_hand():
    # gamma 0.5, n = 3, rewards 1, 2, 4.
    rewards = np.array([[1, 2, 4, 8], [1, 2, 4, 8], [1, 2, 0, 0]], np.float32)
    discounts = np.array([[0.5] * 4, [0.5, 0, 0.5, 0.5], [0.5, 0.5, 0, 0]], np.float32)
    valid = np.array([[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 0, 0]], np.float32)
    r_t, discount_t, offset = jax.jit(partial(n_step, n=3))(rewards, discounts, valid)
    # Going on: 1 + 0.5 * 2 + 0.25 * 4 = 3, bootstrap from s_{t+3} with 0.125.
    # A lost life after the second step: 1 + 0.5 * 2 = 2, no bootstrap.
    # Truncated after the second step: 2 as well, but bootstrap from s_{t+2} with 0.25.
    np.testing.assert_array_equal(r_t, [3, 2, 2])
    np.testing.assert_array_equal(discount_t, [0.125, 0, 0.25])
    assert int(offset[0]) == 3 and int(offset[2]) == 2
    for n in (0, 5):
        with pytest.raises(ValueError, match=rf"n must be in 1..4, the window's steps, not {n}"):
            n_step(rewards, discounts, valid, n)


def test_the_defects_of_public_codes_by_hand():
    # gamma 0.5, rewards 1, 2, 4, n = 3. Going on, and a terminal state after the third step, which is not
    # noticed: 3, and s_{t+2} with 0.125. After the second it is: 2, no bootstrap. Truncated after the second:
    # 2, and s_{t+1} with 0.25.
    rewards = np.array([[1, 2, 4], [1, 2, 4], [1, 2, 0], [1, 2, 0]], np.float32)
    discounts = np.array([[0.5] * 3, [0.5, 0.5, 0], [0.5, 0, 0], [0.5, 0.5, 0]], np.float32)
    valid = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 0]], np.float32)
    views = (n_step_one_early, n_step_one_reward, n_step_end_unnoticed)
    rows = jax.jit(lambda *window: [view(*window, 3) for view in views])(rewards, discounts, valid)
    # SPR in Dopamine has the first reward alone; the third view has the right state.
    for (r_t, discount_t, offset), wanted, late in zip(
        rows, ([3, 3, 2, 2], [1] * 4, [3, 3, 2, 2]), (0, 0, 1), strict=True
    ):
        np.testing.assert_array_equal(r_t, wanted)
        np.testing.assert_array_equal(discount_t, [0.125, 0.125, 0, 0.25])
        np.testing.assert_array_equal(offset[np.array([0, 1, 3])] - late, [2, 2, 1])
