"""srl_jax/rl: the algorithms against a network in numpy and rlax's losses; what every row has to keep is in
objectives_test.py."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from srl_jax import plugins, rl, specs
from srl_jax.rl import heads, values
from srl_jax.types import Context, Latents, Window
from tests.helpers import all_zero, make_encoder, random_params
from tests.observed import of_algorithm
from tests.references import rlax

pytestmark = pytest.mark.filterwarnings("ignore:Rlax categorical_cross_entropy:PendingDeprecationWarning")

BATCH, FEATURES, ACTIONS, ATOMS = 6, 5, 3, 7
CONTEXT = Context(FEATURES, ACTIONS)
ATOMS_51 = np.linspace(-10, 10, 51, dtype=np.float32)
SMALL = {"init_std": 0.0, "hidden": 8, "atoms": ATOMS, "v_min": -2.0, "v_max": 4.0}


def make_latents(online, slow):
    """Latents out of tables, float32 [K + 1, B, D]."""

    def table(z):
        z = jnp.asarray(z)
        return lambda k: z[k] if isinstance(k, int) else z[k, np.arange(BATCH)]

    return Latents(table(online), table(slow))


def make_case(seed=0):
    """Tables of latents, and a window of 3 steps.

    Its rows: whole, terminal after 1, 2 and 3 steps, truncated after 1 and 2.
    """
    rng = np.random.default_rng(seed)
    online, slow = rng.normal(size=(2, 4, BATCH, FEATURES)).astype(np.float32)
    rewards = rng.normal(size=(BATCH, 3))
    discounts = np.full((BATCH, 3), 0.9)
    valid = np.ones((BATCH, 3))
    for row, steps in ((1, 1), (2, 2), (3, 3)):
        discounts[row, steps - 1] = 0
        valid[row, steps:] = 0
    for row, steps in ((4, 1), (5, 2)):
        valid[row, steps:] = 0
    actions = rng.integers(0, ACTIONS, (BATCH, 3), dtype=np.int32)
    rewards, discounts = rewards * valid, discounts * valid
    weight = rng.random(BATCH)
    floats = [x.astype(np.float32) for x in (rewards, discounts, valid, weight)]
    return online, slow, Window(np.zeros((BATCH, 7, 1, 1, 1), np.uint8), actions, *floats)


def network(head, z, dueling, noise=None, xp=np):
    """The head in numpy or jax.numpy: [B, A, M]; with the noise of its layers in turn, float32 [any]."""
    noise = None if noise is None else list(noise)

    def layer(name, x):
        kernel, bias = head[name]["kernel"], head[name]["bias"]
        if noise is not None:
            e = np.array([noise.pop(0) for _ in range(sum(kernel.shape))])
            f = np.sign(e) * np.sqrt(np.abs(e))
            kernel = kernel + head[name]["kernel_sigma"] * np.outer(f[: len(kernel)], f[len(kernel) :])
            bias = bias + head[name]["bias_sigma"] * f[len(kernel) :]
        return x @ kernel + bias

    def stream(name, outputs):
        x = layer(f"{name}_out", xp.maximum(layer(f"{name}_hidden", z), 0))
        return x.reshape(len(z), outputs, -1)

    q = stream("q", ACTIONS)
    return q - q.mean(1, keepdims=True) + stream("v", 1) if dueling else q


def by_rlax(family, out, action, r_t, discount_t, selector, slow_t):
    """(loss, error), scalars, of one example by rlax; `out` and `slow_t` [A, M] are what networks give."""
    step = action, r_t, discount_t
    if family == "categorical":
        atoms = jnp.linspace(-2, 4, ATOMS)
        loss = rlax.categorical_double_q_learning(atoms, out, *step, atoms, slow_t, selector)
        return loss, loss
    error = rlax.double_q_learning(out.mean(-1), *step, slow_t.mean(-1), selector)
    if family == "scalar":
        return rlax.huber_loss(error), error
    taus = (jnp.arange(ATOMS) + 0.5) / ATOMS
    return rlax.quantile_q_learning(out.T, taus, *step, selector[None], slow_t.T, 1.0), error


@partial(jax.jit, static_argnums=0)
def slope_of(family, out, action, *rest):
    """((loss, error), slope by the outputs) of `by_rlax`."""
    out, *rest = (jnp.asarray(x, jnp.float32) for x in (out, *rest))
    return jax.value_and_grad(by_rlax, argnums=1, has_aux=True)(family, out, action, *rest)


def losses_and_gradient(objective, head, *rest):
    """(its losses and metrics, the gradient of their mean on the head), to be traced."""

    def mean(head):
        losses, metrics = objective.loss(head, *rest)
        return jnp.mean(losses), (losses, metrics)

    (_, found), gradient = jax.value_and_grad(mean, has_aux=True)(head)
    return found, gradient


def check_gradient(found, head, outputs, slopes, weight):
    """Compares a gradient with that of `mean(weight * losses)`, whose slopes [B, ...] by outputs are given.

    Args:
        outputs: head -> [B, ...].
    """
    slopes = np.stack(slopes) * weight.reshape(-1, *[1] * (np.ndim(slopes) - 1)) / len(weight)
    expected = jax.jit(lambda head, slopes: jax.vjp(outputs, head)[1](slopes)[0])(head, slopes)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), found, expected)


def softmax(x):
    x = np.exp(x - x.max(-1, keepdims=True))
    return x / x.sum(-1, keepdims=True)


@pytest.mark.parametrize(
    ("kind", "double", "dueling", "n_step"),
    [
        ("kl", True, True, 3),
        ("cross_entropy", False, False, 2),
        ("scalar", True, False, 3),
        ("scalar", False, True, 1),
        ("quantile", True, True, 3),
        ("quantile", False, False, 1),
    ],
)
def test_loss_is_rlax_on_the_n_step_view(kind, double, dueling, n_step):
    kinds = {"scalar": values.scalar, "quantile": partial(values.quantile, quantiles=ATOMS)}
    categorical = partial(values.categorical, atoms=ATOMS, v_min=-2.0, v_max=4.0, priority=kind)
    its_values = kinds.get(kind, categorical)()
    algorithm = rl.q_learner(CONTEXT, its_values, double=double, dueling=dueling, n_step=n_step, hidden=8)
    objective = algorithm.objective
    head, slow_head = (random_params(objective.init, seed) for seed in (1, 2))
    online, slow, window = make_case()

    @jax.jit
    def run(head, slow_head, online, slow, key):
        latents = make_latents(online, slow)
        return (
            *losses_and_gradient(objective, head, slow_head, latents, window, key),
            algorithm.q_values(head, latents.online(0)),
        )

    (losses, metrics), gradient, q_values = run(head, slow_head, online, slow, jax.random.key(0))

    atoms = np.linspace(-2, 4, ATOMS, dtype=np.float32)
    distributional = kind in values.PRIORITIES
    expected = lambda out: softmax(out) @ atoms if distributional else out.mean(-1)  # noqa: E731
    family = "categorical" if distributional else kind
    td_error, unweighted, slopes = [], [], []
    for b in range(BATCH):
        total, discount, offset = 0.0, 1.0, 0
        while offset < n_step and window.valid[b, offset]:
            total += discount * window.rewards[b, offset]
            discount *= window.discounts[b, offset]
            offset += 1
        out_tm1 = network(head, online[0], dueling)[b]
        slow_t = network(slow_head, slow[offset], dueling)[b]
        selector = expected(network(head, online[offset], dueling)[b] if double else slow_t)
        example = window.actions[b, 0], total, discount, selector, slow_t
        (loss, error), slope = slope_of(family, out_tm1, *example)
        if kind == "kl":
            best = softmax(slow_t[selector.argmax()])
            target = np.asarray(rlax.categorical_l2_project(total + discount * atoms, best, atoms))
            error += np.sum(target * np.log(target + 1e-30))
        td_error.append(error)
        unweighted.append(loss)
        slopes.append(slope)
    unweighted = np.array(unweighted)

    np.testing.assert_allclose(q_values, expected(network(head, online[0], dueling)), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(metrics["td_error"], td_error, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(losses, unweighted * window.weight, rtol=1e-4, atol=1e-5)
    outputs = partial(network, z=online[0], dueling=dueling, xp=jnp)
    check_gradient(gradient, head, outputs, slopes, window.weight)
    np.testing.assert_allclose(metrics["q_max_mean"], q_values.max(-1).mean(), rtol=1e-5)


@pytest.mark.parametrize(
    ("row", "options"),
    [
        ("rainbow", SMALL | {"noisy": False}),  # double: the online network sees the state bootstrapped from
        ("iqn", {"munchausen": True, "quantiles": 4, "hidden": 8}),
    ],
)
def test_gradient_flows_through_the_sampled_state_alone(row, options):
    algorithm = rl.REGISTRY[row](CONTEXT, **options)
    head, slow_head = (random_params(algorithm.objective.init, seed) for seed in (1, 2))
    online, slow, window = make_case()

    def mean(online, slow, slow_head):
        latents = make_latents(online, slow)
        losses, _ = algorithm.objective.loss(head, slow_head, latents, window, jax.random.key(0))
        return jnp.mean(losses)

    of_online, *of_slow = jax.jit(jax.grad(mean, (0, 1, 2)))(online, slow, slow_head)
    assert np.all(np.any(of_online[0], -1))  # every row's s_t
    assert all_zero(of_online[1:])
    assert all_zero(of_slow)


def test_noise_needs_a_key_and_differs_between_the_networks():
    algorithm = rl.q_learner(CONTEXT, values.scalar(), noisy=True, hidden=8)
    head = random_params(algorithm.objective.init)
    online, _, window = make_case()
    # Every state's latents are the same, rewards are 0 and nothing is discounted. The slow network is the
    # online one. Where the action taken is the best one, only the noise is between the two values.
    still = np.broadcast_to(online[:1], online.shape)
    ones = np.ones_like(window.rewards)

    @jax.jit
    def run(head, key):
        q = algorithm.q_values(head, still[0])
        noisy = algorithm.q_values(head, still[0], key)
        actions = jnp.argmax(q, -1)[:, None] * jnp.ones((1, 3), int)
        w = window._replace(rewards=0 * ones, discounts=ones, valid=ones, actions=actions)
        _, metrics = algorithm.objective.loss(head, head, make_latents(still, still), w, key)
        return q, noisy, metrics["td_error"]

    q, noisy, td_error = run(head, jax.random.key(0))
    same_q, other, _ = run(head, jax.random.key(1))
    np.testing.assert_array_equal(q, same_q)
    assert not np.allclose(q, noisy) and not np.allclose(noisy, other)
    assert np.all(td_error != 0)
    silent = jax.tree_util.tree_map_with_path(
        lambda path, x: 0 * x if "sigma" in jax.tree_util.keystr(path) else x, head
    )
    q, noisy, td_error = run(silent, jax.random.key(0))
    np.testing.assert_allclose(noisy, q, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(td_error, np.zeros(BATCH), atol=1e-5)


@pytest.mark.parametrize("dueling", [True, False])
def test_every_layer_has_noise_of_its_own_cut_from_one_draw(dueling):
    algorithm = rl.rainbow(CONTEXT, distributional=False, dueling=dueling, hidden=8)
    head, key = random_params(algorithm.objective.init), jax.random.key(5)
    (z, *_), *_ = make_case()
    lengths = [FEATURES + 8, 8 + ACTIONS] + ([FEATURES + 8, 8 + 1] if dueling else [])
    noise = np.asarray(jax.random.normal(key, (sum(lengths),)))
    expected = network(head, z, dueling, np.asarray(noise))[..., 0]
    np.testing.assert_allclose(jax.jit(algorithm.q_values)(head, z, key), expected, rtol=1e-4, atol=1e-5)


def leaf_names(algorithm):
    shapes = jax.eval_shape(algorithm.objective.init, jax.random.key(0))
    return {jax.tree_util.keystr(path): x.shape for path, x in jax.tree_util.tree_leaves_with_path(shapes)}


@pytest.mark.parametrize("part", ["distributional", "double", "dueling", "noisy", "prioritized", "n_step"])
def test_every_part_can_be_left_out_alone(part):
    whole = rl.rainbow(CONTEXT)
    less = rl.rainbow(CONTEXT, **{part: 1 if part == "n_step" else False})
    changed = {name for name in ("leaves", "horizon", "alpha") if facts(whole)[name] != facts(less)[name]}
    # What shows from outside; the effect of double is in the loss, above.
    shows = {"double": set(), "prioritized": {"alpha"}, "n_step": {"horizon"}}
    assert changed == shows.get(part, {"leaves"})
    names = leaf_names(less)
    assert any("sigma" in name for name in names) == (part != "noisy")
    assert any("v_out" in name for name in names) == (part != "dueling")
    atoms = 1 if part == "distributional" else 51
    assert names["['q_out']['bias']"] == (ACTIONS * atoms,)


def facts(algorithm):
    return {"leaves": leaf_names(algorithm), "horizon": algorithm.objective.horizon, "alpha": algorithm.alpha}


def test_rows_are_what_their_names_say():
    rows = {name: factory(CONTEXT) for name, factory in rl.REGISTRY.items()}
    for name, outputs in {"dqn": 1, "double": 1, "c51": 51, "qr_dqn": 200}.items():
        assert rows[name].objective.horizon == 1 and rows[name].alpha == 0.0
        hidden, out = FEATURES * 512 + 512, 512 * ACTIONS * outputs + ACTIONS * outputs
        assert sum(np.prod(shape) for shape in leaf_names(rows[name]).values()) == hidden + out
    assert rows["rainbow"].objective.horizon == 3 and rows["rainbow"].alpha == 0.5
    assert rl.rainbow(CONTEXT, alpha=0.7).alpha == 0.7
    assert rows["drq"].objective.horizon == 10
    iqn = {name: shape for name, shape in leaf_names(rows["iqn"]).items() if "kernel" in name}
    assert sorted(iqn.values()) == [(FEATURES, 512), (64, FEATURES), (512, ACTIONS)]
    # dqn and double have the same network; they differ in who chooses the action bootstrapped from.
    head, slow_head = (random_params(rows["dqn"].objective.init, seed) for seed in (1, 2))
    online, slow, window = make_case()

    @jax.jit
    def losses(online, slow):
        arguments = head, slow_head, make_latents(online, slow), window, jax.random.key(0)
        return [rows[name].objective.loss(*arguments)[0] for name in ("dqn", "double")]

    assert not np.allclose(*losses(online, slow))


def test_a_row_has_the_options_that_something_reads():
    parts = set(specs.option_defaults(rl.q_learner))
    distribution = specs.option_defaults(values.categorical)
    taus = {"quantiles", "target_quantiles", "act_quantiles", "cosines"}
    own = {"c51": set(distribution), "qr_dqn": {"quantiles"}, "iqn": taus}
    own |= dict.fromkeys(("double", "dqn", "drq"), set())
    for name, options in own.items():
        assert set(specs.option_defaults(rl.REGISTRY[name])) == parts | options
    rainbow = specs.option_defaults(rl.rainbow)
    assert set(rainbow) == parts | set(distribution) | {"distributional"}
    assert distribution.items() <= rainbow.items()
    with pytest.raises(specs.SpecError, match="--rl=dqn:v_min=-1: dqn has no option 'v_min'"):
        specs.parse("dqn:v_min=-1", rl.REGISTRY, "rl")


def test_without_a_distribution_its_options_may_have_their_defaults():
    # config.json of a run without a distribution has the defaults of its options, which say nothing.
    spec = specs.parse("rainbow:distributional=false", rl.REGISTRY)
    plugins.build(specs.parse(spec.full, rl.REGISTRY), rl.REGISTRY, CONTEXT)


OTHER = {"atoms": ATOMS, "v_min": -2.0, "v_max": 4.0, "init_std": 1.5, "priority": "kl"}
"""No option of a distribution at its default."""


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize(("row", "options"), [("c51", OTHER), ("dqn", {})])
def test_rainbow_is_the_row_with_its_parts(row, options, double):
    options = options | {"double": double, "dueling": True, "noisy": True, "prioritized": True, "n_step": 3}
    options |= {"noisy_std": 0.3, "alpha": 0.7, "hidden": 8}
    whole = rl.rainbow(CONTEXT, distributional=row == "c51", **options)
    row = rl.REGISTRY[row](CONTEXT, **options)
    assert facts(whole) == facts(row)
    assert of_algorithm(whole, make_encoder(FEATURES)) == of_algorithm(row, make_encoder(FEATURES))


@pytest.mark.parametrize("row", rl.REGISTRY)
def test_every_layer_of_a_head_starts_as_asked(row):
    options = {"hidden": 32} | ({"cosines": 16} if row == "iqn" else {})
    algorithm = plugins.build(
        specs.parse(specs.join(row, options | {"init": "xavier"}), rl.REGISTRY), rl.REGISTRY, CONTEXT
    )
    for layer in jax.jit(algorithm.objective.init)(jax.random.key(0)).values():
        bound = (6 / sum(layer["kernel"].shape)) ** 0.5
        assert 0.9 * bound < np.abs(layer["kernel"]).max() <= bound and not layer["bias"].any()


@pytest.mark.parametrize("dueling", [True, False])
@pytest.mark.parametrize(("init_std", "expected"), [(0.0, 20 / 12**0.5), (1.0, 1.0), (2.0, 2.0)])
def test_the_value_distribution_starts_as_wide_as_asked(dueling, init_std, expected):
    # On 51 atoms in [-10, 10]; the uniform distribution has a deviation of 20 / sqrt(12).
    algorithm = rl.rainbow(CONTEXT, init_std=init_std, dueling=dueling)
    network = heads.QNetwork(
        ACTIONS, 51, 512, dueling, True, 0.1, rl.normal_logits(ATOMS_51, init_std) if init_std else None
    )
    head = jax.jit(algorithm.objective.init)(jax.random.key(0))
    z = np.random.default_rng(0).normal(size=(BATCH, FEATURES)).astype(np.float32)
    probs = jax.jit(lambda head, z: jax.nn.softmax(network.apply({"params": head}, z, None)))(head, z)
    mean = probs @ ATOMS_51
    std = np.sqrt(probs @ ATOMS_51**2 - mean**2)
    np.testing.assert_allclose(std, expected, rtol=0.15)
    np.testing.assert_allclose(jax.jit(algorithm.q_values)(head, z), mean, rtol=1e-4, atol=1e-4)
    assert np.abs(mean).max() < 0.6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_step": 0}, "n_step"),
        ({"hidden": 0}, "hidden"),
        ({"atoms": 1}, "atoms"),
        ({"v_min": 1.0, "v_max": 1.0}, "v_min must be below v_max"),
        ({"init_std": -1.0}, "init_std must be 0 or at least 0.4, the distance of two atoms"),
        ({"init_std": 0.3}, "init_std must be 0 or at least 0.4, the distance of two atoms"),
        ({"init_std": 1.0, "v_min": -100.0, "v_max": 100.0}, "init_std must be 0 or at least 4"),
        ({"v_min": 1e6, "v_max": 1e6 + 1}, "float32 has no 51 .* atoms from 1000000.0 to 1000001.0"),
        ({"v_min": -3e38, "v_max": 3e38}, "float32 has no 51 evenly spaced atoms"),
        ({"v_min": 0.0, "v_max": 1e-44}, "float32 has no 51 evenly spaced atoms"),
        ({"priority": "entropy"}, "priority: .*valid: cross_entropy, kl, batch_mean"),
        ({"munchausen": True}, "munchausen=true averages over actions and picks none; it needs double=false"),
        ({"munchausen": True, "double": False, "munchausen_tau": 0.0}, "munchausen_tau must be above 0"),
        ({"view": "rotate"}, "no view 'rotate'; valid: shift"),
        ({"copies": 0}, "copies must be at least 1"),
        ({"slow": "fast"}, "slow: .*valid: periodic, ema, none"),
        ({"slow": "ema", "slow_tau": 1.0}, "tau must be at least 0 and below 1"),
        ({"slow": "none", "act_with": "slow"}, "act_with=slow needs a slow network; slow=none has none"),
        ({"act_with": "fast"}, "act_with: .*valid: online, slow"),
        ({"target": "s_t"}, "target: .*valid: s_t.n, s_t.n-1"),
        ({"target": "s_t+n-1", "n_step": 1}, "target=s_t.n-1 needs n_step of at least 2$"),
        ({"alpha": 1.5}, "alpha must be at most 1"),
        ({"hidden": 2**16 + 1}, "hidden must be at least 1 and at most 65536"),
        ({"atoms": 2**31 - 1}, "atoms must be at least 2 and at most 65536"),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        rl.rainbow(CONTEXT, **options)


def test_quantiles_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="quantiles must be at least 1 and at most 65536"):
        values.quantile(quantiles=0)
    for name in specs.option_defaults(values.implicit_quantile):
        with pytest.raises(ValueError, match=f"^{name} must be at least 1 and at most 65536"):
            values.implicit_quantile(**{name: 0})


LEARNT = {
    "categorical": (values.categorical(), 1.0),
    "categorical, wide": (values.categorical(v_min=-1000.0, v_max=1000.0), 100.0),
    "scalar": (values.scalar(), 1.0),
    "quantile": (values.quantile(quantiles=20), 1.0),
    "implicit quantile": (values.implicit_quantile(), 1.0),
}


@pytest.mark.parametrize(("kind", "reward"), LEARNT.values(), ids=LEARNT)
def test_values_are_learnt(kind, reward):
    # An episode of one step is worth its reward.
    algorithm = rl.q_learner(CONTEXT, kind, dueling=True, hidden=32)
    head = random_params(algorithm.objective.init)
    online, slow, window = make_case()
    window = window._replace(
        rewards=np.full_like(window.rewards, reward),
        discounts=np.zeros_like(window.discounts),
        valid=np.ones_like(window.valid),
        weight=np.ones_like(window.weight),
    )
    adam = optax.adam(1e-2)

    def mean_loss(head):
        latents = make_latents(online, slow)
        return algorithm.objective.loss(head, head, latents, window, jax.random.key(0))[0].mean()

    def update(_, learner):
        head, state = learner
        steps, state = adam.update(jax.grad(mean_loss)(head), state)
        return optax.apply_updates(head, steps), state

    head, _ = jax.jit(lambda head: jax.lax.fori_loop(0, 200, update, (head, adam.init(head))))(head)
    q = np.asarray(jax.jit(algorithm.q_values)(head, online[0]))[np.arange(BATCH), window.actions[:, 0]]
    np.testing.assert_allclose(q, reward, rtol=0.1)
