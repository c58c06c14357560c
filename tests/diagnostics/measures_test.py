"""srl_jax/diagnostics/measures.py against hand-worked numbers."""

import numpy as np
import pytest

from srl_jax.diagnostics import measures

RNG = np.random.default_rng(0)


def test_effective_rank():
    # Four points, centred: singular values 4 and 2 and no others. Shares 2/3 and 1/3.
    z = np.array([[2, 1], [2, -1], [-2, 1], [-2, -1.0]], np.float32) @ np.eye(2, 5) + 7
    by_hand = np.exp(-(2 / 3 * np.log(2 / 3) + 1 / 3 * np.log(1 / 3)))
    assert measures.effective_rank(z) == pytest.approx(by_hand, rel=1e-6)
    turn = np.linalg.qr(RNG.normal(size=(5, 5)))[0]
    assert measures.effective_rank(3 * z @ turn) == pytest.approx(by_hand, rel=1e-6)
    assert measures.effective_rank(np.ones((6, 3), np.float32)) == 0.0


@pytest.mark.parametrize("shape", [(40, 12), (12, 40)])
def test_effective_rank_is_that_of_the_singular_values(shape):
    z = RNG.normal(size=shape)
    values = np.linalg.svd(z - z.mean(0), compute_uv=False)
    shares = values[values > 1e-9] / values.sum()
    assert measures.effective_rank(z) == pytest.approx(np.exp(-np.sum(shares * np.log(shares))))


def test_dormant_and_constant_units():
    # Mean |activation|: 1, 0.02, 0, 3, 1; their mean is 1.004, so that at most 0.0251 is dormant.
    z = np.array([[1, 0.02, 0, 3, -1], [-1, -0.02, 0, 3, 1]], np.float32)
    assert measures.dormant_share(z) == pytest.approx(2 / 5)
    assert measures.constant_share(z) == pytest.approx(2 / 5)  # the third, and the fourth, which is stuck
    assert measures.dormant_share(np.zeros((3, 4), np.float32)) == 1.0


def test_cka_knows_no_rotation_and_no_scale():
    a, b = RNG.normal(size=(30, 6)), RNG.normal(size=(30, 4))
    b[:, 0] += a[:, 0]
    centred = [x - x.mean(0) for x in (a, b)]
    (x, y), norm = centred, np.linalg.norm
    reference = norm(y.T @ x) ** 2 / (norm(x.T @ x) * norm(y.T @ y))  # Kornblith et al., equation 6
    cka = lambda a, b: measures.alignment(measures.centred_gram(a), measures.centred_gram(b))  # noqa: E731
    assert cka(a, b) == pytest.approx(reference) and 0.05 < reference < 0.9
    turn = np.linalg.qr(RNG.normal(size=(6, 6)))[0]
    assert cka(5 * a @ turn + 3, b) == pytest.approx(reference)
    assert cka(a, -2 * a @ turn) == pytest.approx(1)
    assert measures.mean_cosine(a, -2 * a) == pytest.approx(-1)
    assert measures.mean_cosine(np.eye(2), np.array([[1, 1], [1, 0.0]])) == pytest.approx(0.5**0.5 / 2)
    # What two latents share hides that the rest has turned round: (5, 1) and (5, -1), less (5, 0).
    x = np.array([[5, 1.0], [5, -1]])
    assert measures.mean_cosine(x, x[::-1]) == pytest.approx(24 / 26)
    assert measures.mean_cosine(measures.centred(x), measures.centred(x[::-1])) == pytest.approx(-1)


def test_errors_on_moving_and_static_pixels():
    before = np.zeros((2, 2, 2, 1), np.float32)
    target = np.array([[[1, 0.05], [0, 0]], [[0, 0], [0, 0.5]]], np.float32)[..., None]
    output = np.array([[[0.5, 0], [0, 0]], [[0.2, 0], [0, 0.5]]], np.float32)[..., None]
    found = measures.moving_errors(before, target, output)
    # Two of eight pixels move. Their errors are 0.25 and 0, the mean image's (1 - 0.5)^2 and (0.5 - 0.25)^2.
    assert found["moving"] == pytest.approx(0.125)
    assert found["moving_explained"] == pytest.approx(1 - 0.125 / ((0.25 + 0.0625) / 2))
    assert found["static"] == pytest.approx((0.05**2 + 0.2**2) / 6)
    frames = np.stack([before, target], 1) * 255
    assert measures.moving_share(frames.astype(np.uint8)) == 2 / 8
    still = measures.moving_errors(target, target, output)
    assert np.isnan(still["moving"]) and np.isnan(still["moving_explained"])


def test_a_pixel_moves_with_any_of_its_colours():
    # One pixel of two turns from red to green; errors are averaged over the three channels.
    before, target = np.zeros((2, 1, 1, 2, 3), np.float32)
    before[..., 0, 0] = target[..., 0, 1] = 1.0
    found = measures.moving_errors(before, target, np.zeros_like(target))
    assert found["moving"] == pytest.approx(1 / 3) and found["static"] == 0.0
    assert measures.moving_share((255 * np.stack([before, target], 1)).astype(np.uint8)) == 0.5


def test_a_probe_finds_what_is_linear_in_the_latent_and_nothing_else():
    rng = np.random.default_rng(1)
    z, episodes = rng.normal(size=(400, 30)).astype(np.float32), np.repeat(np.arange(20), 20)
    states = np.stack([z @ rng.normal(size=30), rng.normal(size=400), np.ones(400), z[:, 0] ** 2], 1)
    z[:, 5] = 1e6  # a unit that is stuck; what it was is noise now, about a thirtieth of the variance
    planted, noise, constant, squared = measures.probe(z, states, episodes)
    assert planted > 0.9
    assert abs(noise) < 0.1 and abs(squared) < 0.15
    assert np.isnan(constant)
    # More units than observations.
    wide = np.concatenate([z, rng.normal(size=(400, 600))], 1)
    assert 0.2 < measures.probe(wide, states, episodes)[0] < planted
    assert np.isnan(measures.probe(z, states, np.zeros(400, int))).all()


def test_a_unit_that_hardly_moves_does_not_decide_a_probe():
    # On the episodes of the fit it is a thousandth of noise, on the others all of it.
    for seed in range(4):  # without a floor, R^2 is -0.1 to -307
        rng = np.random.default_rng(seed)
        z, episodes = rng.normal(size=(400, 30)), np.repeat(np.arange(20), 20)
        states = z @ rng.normal(size=(30, 1)) + rng.normal(size=(400, 1))
        z[:, 7] = np.where(episodes % 2 == 0, 1e-3, 1.0) * rng.normal(size=400)
        assert measures.probe(z, states, episodes)[0] > 0.5


def test_a_probe_leaves_out_whole_episodes():
    # Each episode has a mark of its own in the latent, and a level of its own in the state: fitting the marks
    # says nothing of other episodes. Where single observations are left out, it looks perfect.
    rng = np.random.default_rng(2)
    episodes = np.repeat(np.arange(16), 8)
    z = 3 * rng.normal(size=(16, 40))[episodes] + 0.3 * rng.normal(size=(128, 40))
    states = rng.normal(size=(16, 1))[episodes]
    assert -0.5 < measures.probe(z, states, episodes)[0] < 0.5
