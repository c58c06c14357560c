"""srl_jax/rl: taus, Munchausen, copies of a batch, slow networks, defects of public codes, sizes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import rl
from srl_jax.latents import named_key
from srl_jax.learning.agent import slow_params
from srl_jax.learning.optim import RL
from srl_jax.learning.update import periodic
from srl_jax.rl import values
from srl_jax.rl.losses import n_step
from srl_jax.types import Context, Latents, TrainState, Window
from tests.helpers import count, random_params
from tests.references import rlax
from tests.rl.rl_test import (
    ACTIONS,
    ATOMS,
    BATCH,
    CONTEXT,
    FEATURES,
    check_gradient,
    losses_and_gradient,
    make_case,
    make_latents,
    network,
    slope_of,
    softmax,
)

pytestmark = pytest.mark.filterwarnings("ignore:Rlax categorical_cross_entropy:PendingDeprecationWarning")

EPISODE = [  # gamma 0.5, rewards 1, 2, 4, 8, and s_{t+k} is worth 10 k to the slow network
    # the episode's end, and the targets of n = 1 to 4
    ("none", [6, 7, 6.75, 6.5]),  # 1 + 5;  1 + 1 + 5;  1 + 1 + 1 + 3.75;  1 + 1 + 1 + 1 + 2.5
    ("terminal 1", [1, 1, 1, 1]),
    ("terminal 2", [6, 2, 2, 2]),
    ("terminal 3", [6, 7, 3, 3]),
    ("truncated 1", [6, 6, 6, 6]),
    ("truncated 2", [6, 7, 7, 7]),
    ("truncated 3", [6, 7, 6.75, 6.75]),
]
ONE_EARLY = {  # n = 2 and 3, where s_t itself is worth 4
    "none": [4.5, 5.5],  # 1 + 1 + 0.25 * 10;  1 + 1 + 1 + 0.125 * 20
    "terminal 1": [1, 1],
    "terminal 2": [4.5, 2],  # not noticed where it is the n-th
    "terminal 3": [4.5, 5.5],
    "truncated 1": [3, 3],  # 1 + 0.5 * 4
    "truncated 2": [4.5, 4.5],
    "truncated 3": [4.5, 5.5],
}


def test_the_whole_target_of_a_three_step_episode_by_hand():
    number = len(EPISODE)
    rewards = np.tile(np.array([1, 2, 4, 8], np.float32), (number, 1))
    discounts, valid = np.full_like(rewards, 0.5), np.ones_like(rewards)
    for row, (end, _) in enumerate(EPISODE):
        if end != "none":
            how, steps = end.split()
            valid[row, int(steps) :] = 0
            if how == "terminal":
                discounts[row, int(steps) - 1] = 0
    zeros = np.zeros((number, 4), np.int32), np.ones(number, np.float32)
    frames = np.zeros((number, 8, 1, 1, 1), np.uint8)
    window = Window(frames, zeros[0], rewards * valid, discounts * valid, valid, zeros[1])
    # A network of two layers that gives (z, -z), and one that gives nothing, so that errors are targets.
    layers = {"q_hidden": ([[1.0]], [0.0]), "q_out": ([[1.0, -1.0]], [0.0, 0.0])}
    slow_head = {name: {"kernel": jnp.array(k), "bias": jnp.array(b)} for name, (k, b) in layers.items()}
    head = jax.tree.map(jnp.zeros_like, slow_head)
    worth = jnp.array([4.0, 10.0, 20.0, 30.0, 40.0])
    latents = Latents(lambda k: jnp.zeros((number, 1)), lambda k: worth[k][:, None])

    def targets(n, **options):
        algorithm = rl.q_learner(Context(1, 2), values.scalar(), hidden=1, n_step=n, **options)
        return algorithm.objective.loss(head, slow_head, latents, window, jax.random.key(0))[1]["td_error"]

    found, early = jax.jit(
        lambda: ([targets(n) for n in range(1, 5)], [targets(n, target="s_t+n-1") for n in (2, 3)])
    )()
    np.testing.assert_allclose(np.transpose(found), [expected for _, expected in EPISODE])
    np.testing.assert_allclose(np.transpose(early), [ONE_EARLY[end] for end, _ in EPISODE])


def embedded(head, z, taus, xp=np):
    """IQN's latents of taus [B, N] in numpy, or in jax.numpy as `xp`: float32 [B * N, D]."""
    cosines = np.cos(np.pi * taus[..., None] * np.arange(len(head["embedding"]["kernel"])))
    phi = xp.maximum(cosines @ head["embedding"]["kernel"] + head["embedding"]["bias"], 0)
    return (z[:, None] * phi).reshape(-1, z.shape[-1])


@pytest.mark.parametrize(("double", "dueling"), [(True, True), (False, False)])
def test_iqn_is_rlax_at_the_taus_that_were_drawn(double, dueling):
    kind = values.implicit_quantile(quantiles=4, target_quantiles=5, act_quantiles=6, cosines=7)
    algorithm = rl.q_learner(CONTEXT, kind, double=double, dueling=dueling, n_step=3, hidden=8)
    head, slow_head = (random_params(algorithm.objective.init, seed) for seed in (1, 2))
    online, slow, window = make_case()
    key = jax.random.key(3)

    @jax.jit
    def run(head, slow_head, key):
        latents = make_latents(online, slow)
        found, gradient = losses_and_gradient(algorithm.objective, head, slow_head, latents, window, key)
        q = algorithm.q_values(head, latents.online(0)), algorithm.q_values(head, latents.online(0), key)
        return found, gradient, q

    (losses, metrics), gradient, (q, drawn_q) = run(head, slow_head, key)

    def quantiles(head, z, taus, xp=np):  # [B, A, N]
        out = network(head, embedded(head, z, taus, xp), dueling, xp=xp)
        return out.reshape(*taus.shape, ACTIONS).transpose(0, 2, 1)

    draw = lambda name, n: np.asarray(jax.random.uniform(named_key(key, f"taus {name}"), (BATCH, n)))  # noqa: E731
    middle = np.tile((np.arange(6) + 0.5) / 6, (BATCH, 1))
    np.testing.assert_allclose(q, quantiles(head, online[0], middle).mean(-1), rtol=1e-4, atol=1e-5)
    expected = quantiles(head, online[0], draw("act", 6)).mean(-1)
    np.testing.assert_allclose(drawn_q, expected, rtol=1e-4, atol=1e-5)

    r_t, discount_t, offset = map(np.asarray, n_step(window.rewards, window.discounts, window.valid, 3))
    rows = np.arange(BATCH)
    taus = draw("online 0", 4)
    out_tm1 = quantiles(head, online[0], taus)
    slow_t = quantiles(slow_head, slow[offset, rows], draw("target", 5))
    chooser, z_t = (head, online) if double else (slow_head, slow)
    selector_t = quantiles(chooser, z_t[offset, rows], draw("selector", 6)).mean(-1)
    slopes, by_rlax = [], jax.jit(jax.value_and_grad(rlax.quantile_q_learning), static_argnums=7)
    for b in rows:
        step = window.actions[b, 0], r_t[b], discount_t[b]
        arrays = out_tm1[b].T, taus[b], *step, selector_t[b][None], slow_t[b].T
        loss, slope = by_rlax(*arrays, 1.0)
        slopes.append(slope.T)
        np.testing.assert_allclose(losses[b], loss * window.weight[b], rtol=1e-4, atol=1e-5)
        best = slow_t[b, selector_t[b].argmax()].mean()
        error = r_t[b] + discount_t[b] * best - out_tm1[b, window.actions[b, 0]].mean()
        np.testing.assert_allclose(metrics["td_error"][b], error, rtol=1e-4, atol=1e-5)
    outputs = partial(quantiles, z=online[0], taus=taus, xp=jnp)
    check_gradient(gradient, head, outputs, slopes, window.weight)


KINDS = {
    "scalar": values.scalar(),
    "quantile": values.quantile(quantiles=ATOMS),
    "categorical": values.categorical(atoms=ATOMS, v_min=-2.0, v_max=4.0),
}
ATOMS_7 = np.linspace(-2, 4, ATOMS, dtype=np.float32)


def of_outcome(kind, out, action, r_t, discount_t, outcome):
    """`slope_of`, where one outcome [M] stands for the last state."""
    slow_t = np.log(outcome) if kind == "categorical" else outcome
    return slope_of(kind, out, action, r_t, discount_t, np.zeros(1), slow_t[None])


@pytest.mark.parametrize("kind", KINDS)
def test_munchausen_is_the_paper_for_every_kind(kind):
    alpha, tau, clip = 0.8, 0.5, -0.6
    algorithm = rl.q_learner(
        CONTEXT, KINDS[kind], munchausen=True, munchausen_alpha=alpha, munchausen_tau=tau,
        munchausen_clip=clip, n_step=3, hidden=8,
    )  # fmt: skip
    head, slow_head = (random_params(algorithm.objective.init, seed) for seed in (1, 2))
    online, slow, window = make_case()
    (losses, metrics), gradient = jax.jit(
        lambda *arrays: losses_and_gradient(
            algorithm.objective, *arrays[:2], make_latents(*arrays[2:]), window, None
        )
    )(head, slow_head, online, slow)

    r_t, discount_t, offset = map(np.asarray, n_step(window.rewards, window.discounts, window.valid, 3))
    slopes = []
    for b in range(BATCH):
        own, there = (network(slow_head, slow[k], False)[b] for k in (0, offset[b]))
        there = softmax(there) if kind == "categorical" else there
        q_tm1, q_t = (
            softmax(own) @ ATOMS_7 if kind == "categorical" else own.mean(-1),
            there @ ATOMS_7 if kind == "categorical" else there.mean(-1),
        )
        action, policy = window.actions[b, 0], softmax(q_t / tau)
        bonus = np.clip(tau * np.log(softmax(q_tm1 / tau)[action]), clip, 0)
        total = r_t[b] + alpha * bonus - discount_t[b] * tau * policy @ np.log(policy)
        out = network(head, online[0], False)[b]
        (loss, error), slope = of_outcome(kind, out, action, total, discount_t[b], policy @ there)
        slopes.append(slope)
        np.testing.assert_allclose(losses[b], loss * window.weight[b], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(metrics["td_error"][b], error, rtol=1e-4, atol=1e-5)
    outputs = partial(network, z=online[0], dueling=False, xp=jnp)
    check_gradient(gradient, head, outputs, slopes, window.weight)


@pytest.mark.parametrize("kind", KINDS)
def test_drq_averages_targets_over_one_set_of_views_and_losses_over_another(kind):
    algorithm = rl.q_learner(
        CONTEXT, KINDS[kind], view="shift", copies=2, target_copies=3, n_step=3, hidden=8
    )
    head, slow_head = (random_params(algorithm.objective.init, seed) for seed in (1, 2))
    *_, window = make_case()
    views = [make_case(seed)[:2] for seed in range(5)]  # as they are asked for: 3 of the target, then 2

    @jax.jit
    def run(head, slow_head):
        left = iter(views)
        nothing = make_latents(np.full_like(views[0][0], np.nan), np.full_like(views[0][1], np.nan))
        latents = nothing._replace(of=lambda window: make_latents(*next(left)))
        key = jax.random.key(0)
        found = losses_and_gradient(algorithm.objective, head, slow_head, latents, window, key)
        assert next(left, None) is None
        return found

    (losses, metrics), gradient = run(head, slow_head)
    r_t, discount_t, offset = map(np.asarray, n_step(window.rewards, window.discounts, window.valid, 3))
    slopes = []
    for b in range(BATCH):
        outcomes = []
        for _, slow in views[:3]:
            out = network(slow_head, slow[offset[b]], False)[b]
            out = softmax(out) if kind == "categorical" else out
            worth = out @ ATOMS_7 if kind == "categorical" else out.mean(-1)
            outcomes.append(out[worth.argmax()])
        rest = window.actions[b, 0], r_t[b], discount_t[b], np.mean(outcomes, 0)
        pairs = [of_outcome(kind, network(head, online[0], False)[b], *rest) for online, _ in views[3:]]
        loss, error = np.mean([pair for pair, _ in pairs], 0)
        slopes.append(np.stack([slope for _, slope in pairs]) / 2)
        np.testing.assert_allclose(losses[b], loss * window.weight[b], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(metrics["td_error"][b], error, rtol=1e-4, atol=1e-5)

    def outputs(head):
        return jnp.stack([network(head, online[0], False, xp=jnp) for online, _ in views[3:]], 1)

    check_gradient(gradient, head, outputs, slopes, window.weight)


def test_streams_with_one_hidden_layer():
    algorithm = rl.q_learner(CONTEXT, values.scalar(), dueling=True, noisy=True, shared_hidden=True, hidden=8)
    head, key = random_params(algorithm.objective.init), jax.random.key(5)
    (z, *_), *_ = make_case()
    assert set(head) == {"hidden", "q_out", "v_out"}
    noise = np.asarray(jax.random.normal(key, (FEATURES + 8 + 8 + ACTIONS + 8 + 1,)))
    first, q, v = np.split(noise, [FEATURES + 8, FEATURES + 8 + 8 + ACTIONS])
    # The same as two streams whose hidden layers are equal, noise and all.
    twice = {name: head[name] for name in ("q_out", "v_out")} | dict.fromkeys(
        ("q_hidden", "v_hidden"), head["hidden"]
    )
    expected = network(twice, z, True, np.concatenate([first, q, first, v]))[..., 0]
    np.testing.assert_allclose(jax.jit(algorithm.q_values)(head, z, key), expected, rtol=1e-4, atol=1e-5)


def test_a_slow_network_is_replaced_or_moved_or_there_is_none():
    row = partial(rl.REGISTRY["dqn"], CONTEXT)
    assert row().slow(7) == periodic(7) and not row().acts_slow
    averaged = row(slow="ema", slow_tau=0.75, act_with="slow")
    assert averaged.acts_slow and float(averaged.slow(7)(8.0, 4.0, 1)) == 0.75 * 4 + 0.25 * 8
    without = row(slow="none", hidden=8)
    assert without.slow(7) is None
    # Its target is the online network's, and no gradient flows into it.
    head = random_params(without.objective.init, 1)
    online, _, window = make_case()
    replaced = row(hidden=8).objective.loss

    @jax.jit
    def gradients(head, other):
        def mean(head, loss, slow_head):
            return loss(head, slow_head, make_latents(online, online), window, None)[0].mean()

        return jax.grad(mean)(head, without.objective.loss, None), jax.grad(mean)(head, replaced, other)

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), *gradients(head, head))


def test_the_slow_network_that_acts_is_of_encoder_and_head():
    slow = {"encoder": {"w": 3}, "head": {"w": 4}}
    state = TrainState({"encoder": {"w": 1}, RL: {"w": 2}, "inverse": {"w": 5}}, {RL: slow}, None, 0, None)
    assert slow_params(state) == {"encoder": {"w": 3}, RL: {"w": 4}, "inverse": {"w": 5}}
    state = state._replace(slow={RL: slow | {"encoder": {}}})  # --target_encoder=online
    assert slow_params(state) == {"encoder": {"w": 1}, RL: {"w": 4}, "inverse": {"w": 5}}


def test_one_priority_a_batch_is_its_mean():
    kinds = [values.categorical(atoms=ATOMS, priority=name) for name in ("cross_entropy", "batch_mean")]
    head = random_params(rl.q_learner(CONTEXT, kinds[0], hidden=8).objective.init)
    online, slow, window = make_case()
    loss = [rl.q_learner(CONTEXT, kind, hidden=8).objective.loss for kind in kinds]
    each, one = jax.jit(lambda: [f(head, head, make_latents(online, slow), window, None) for f in loss])()
    np.testing.assert_array_equal(each[0], one[0])
    assert one[1]["td_error"].shape == (1,)
    np.testing.assert_allclose(one[1]["td_error"], each[1]["td_error"].mean(), rtol=1e-6)


def test_head_of_the_thesis_has_its_size():
    # On nature's 3,136 features, 6 actions: each stream 3136 * 512 + 512 = 1,606,144, then 512 * 306 + 306 =
    # 156,978 and 512 * 51 + 51 = 26,163; all of it twice, since every weight has its sigma.
    context = Context(3136, 6)
    shapes = jax.eval_shape(rl.rainbow(context).objective.init, jax.random.key(0))
    assert count(shapes) == 2 * (2 * 1_606_144 + 156_978 + 26_163)


def test_normal_logits():
    assert rl.normal_logits(np.linspace(-2, 2, 5), 1.0) == (-2.0, -0.5, 0.0, -0.5, -2.0)
    assert rl.normal_logits(np.linspace(-2, 2, 5), 2.0) == (-0.5, -0.125, 0.0, -0.125, -0.5)
    assert rl.normal_logits(np.array([1.0, 2.0, 3.0]), 1.0) == (0.0, -0.5, -2.0)  # 0 is not among them
