"""srl_jax/latents.py: what each loss sees of a window, by which parameters; how often it encodes."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import augment
from srl_jax.augment import Views, make_view, random_shift
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.latents import make_latents
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL, make_optimizer
from srl_jax.learning.update import (
    Hyper,
    ema,
    make_init,
    make_update,
    named_key,
    passes,
    periodic,
)
from srl_jax.plugins import Registry
from srl_jax.window import observation
from tests.learning.update_test import PIXELS, RATES, SMALL, make_peek, make_peeks

_shift = jax.jit(make_view("shift"))


def test_each_augmentation_and_who_sees_it():
    key = jax.random.key(3)
    shifted = np.asarray(_shift(SMALL, named_key(jax.random.fold_in(key, 0), "augment")).frames)
    assert not any(np.array_equal(*pair) for pair in zip(shifted, SMALL.frames, strict=True))
    views = {"none": (SMALL.frames, SMALL.frames), "srl": (SMALL.frames, shifted), "all": (shifted, shifted)}
    for name, (rl_view, representation_view) in views.items():
        seen = Views.of(Config(augment=name))
        init, update, hyper = make_peeks(RL, "peek", views=seen, form="summed")
        _, _, metrics = jax.jit(update)(init(key), SMALL, hyper)
        for loss, view in ((RL, rl_view), ("peek", representation_view)):
            np.testing.assert_array_equal(metrics[f"{loss}/frames"], view, err_msg=f"{name} {loss}")
            # The latents are those of the same view.
            pixels = observation(SMALL._replace(frames=view), 0).reshape(len(view), -1) / 255
            for which in ("online", "slow"):
                scale = init(key).params["encoder"]["scale"]
                np.testing.assert_allclose(metrics[f"{loss}/{which}"], pixels * scale, rtol=1e-5)


def seen_by(views):
    """Metrics of one update of RL and a peek, which has slow copies of its own here."""
    terms = {RL: make_rl_peek(), "peek": make_peek(slow=ema(0.5))}
    optimizer, mode = make_optimizer(terms), MODES["joint"]
    state = make_init(PIXELS, terms, mode, optimizer)(jax.random.key(3))
    scale = float(state.params["encoder"]["scale"][0])
    update = jax.jit(
        make_update(PIXELS, terms, mode, optimizer, plan=passes(mode, terms, "summed"), views=views)
    )
    _, _, metrics = update(state, SMALL, Hyper({RL: 1.0, "peek": 1.0}, RATES))
    # Latents are pixels times a number: pixels again.
    return {n: np.asarray(x) / (1 if n.endswith("frames") else scale) for n, x in metrics.items() if "/" in n}


def make_rl_peek():
    """A peek that also asks for latents two steps on, as a target does."""
    peek = make_peek(slow=periodic(2))

    def loss(head, slow_head, latents, window, key):
        losses, metrics = peek.loss(head, slow_head, latents, window, key)
        ahead = jnp.full(len(losses), 2)
        later = {"later": latents.online(ahead), "slow_later": latents.slow(ahead)}
        return losses, {**metrics, **later, "again": latents.online(0)}

    return peek._replace(loss=loss)


def pixels_of(frames, k=0):
    return np.asarray(observation(SMALL._replace(frames=frames), k)).reshape(len(frames), -1) / 255


def is_a_shift(found, k):
    """Whether latents are the observation at offset k, each row moved by a shift of its own; the shifts."""
    found, stacks = found.reshape(-1, 6, 6, 4), np.asarray(observation(SMALL, k)) / 255
    shifts = []
    for row, stack in zip(found, stacks, strict=True):
        padded = np.pad(stack, [(4, 4), (4, 4), (0, 0)], mode="edge")
        places = [(y, x) for y in range(9) for x in range(9)]
        shifts.append([at for at in places if np.allclose(padded[at[0] :, at[1] :][:6, :6], row, atol=1e-5)])
    return all(shifts) and shifts


def test_what_rl_the_objectives_and_the_targets_see_is_said_separately():
    plain = pixels_of(SMALL.frames)
    close = lambda a, b: np.allclose(a, b, atol=1e-5)  # noqa: E731
    seen = seen_by(Views("shift", "none"))
    assert close(seen["peek/online"], plain) and not close(seen["rl/online"], plain)
    assert is_a_shift(seen["rl/online"], 0) == is_a_shift(seen["rl/later"], 2)  # one draw a sequence
    assert close(seen["rl/slow"], seen["rl/online"])

    seen = seen_by(Views("none", "shift", "shift"))
    assert close(seen["rl/online"], plain) and is_a_shift(seen["rl/later"], 2)
    assert close(seen["rl/later"], seen["rl/slow_later"])
    assert is_a_shift(seen["peek/slow"], 0) == is_a_shift(seen["rl/later"], 2)  # the targets' draw
    assert is_a_shift(seen["peek/slow"], 0) != is_a_shift(seen["peek/online"], 0)

    seen = seen_by(Views("shift", "shift", "none"))
    assert close(seen["rl/online"], seen["peek/online"])  # alike: one draw
    assert close(seen["rl/later"], pixels_of(SMALL.frames, 2)) and close(seen["peek/slow"], plain)


def test_each_observation_may_have_a_draw_of_its_own():
    seen = seen_by(Views("shift@each", "none"))
    now, later = is_a_shift(seen["rl/online"], 0), is_a_shift(seen["rl/later"], 2)
    assert now and later and now != later
    np.testing.assert_array_equal(seen["rl/online"], seen["rl/again"])
    np.testing.assert_allclose(seen["rl/slow_later"], seen["rl/later"], rtol=1e-5)
    np.testing.assert_array_equal(seen["rl/frames"], SMALL.frames)  # what an image is predicted from


def test_views_of_a_run_follow_augment_where_they_are_not_given():
    views = {"none": Views("none", "none"), "srl": Views("none", "shift"), "all": Views("shift", "shift")}
    for name, expected in views.items():
        assert Views.of(Config(augment=name)) == expected
    given = Config(
        augment="all", rl_view="none", srl_view="shift+intensity@each", target_view="crop_pad_crop"
    )
    assert Views.of(given) == ("none", "shift+intensity@each", "crop_pad_crop")
    for flag, text in (
        ("rl_view", "shft"),
        ("srl_view", "shift+none"),
        ("target_view", "each"),
        ("srl_view", "@each"),
    ):
        with pytest.raises(
            ConfigError, match=f"^--{flag}={re.escape(text)}: no view .*valid: shift, intensity"
        ):
            Views.of(Config(**{flag: text}))


def test_a_view_of_ones_own(monkeypatch):
    monkeypatch.setattr(augment, "VIEWS", Registry("augment", augment.VIEWS))
    augment.VIEWS.register("inverted", lambda frames, key: 255 - frames)
    seen = seen_by(Views("inverted", "none"))
    np.testing.assert_array_equal(seen["rl/frames"], 255 - SMALL.frames)


def test_each_row_has_a_shift_of_its_own():
    same = SMALL._replace(frames=np.broadcast_to(SMALL.frames[:1], SMALL.frames.shape))
    rows = [row for seed in range(5) for row in np.asarray(_shift(same, jax.random.key(seed)).frames)]
    assert len({row.tobytes() for row in rows}) > 12  # 20 draws of 81 shifts
    one = jax.jit(random_shift)(same.frames[2], jax.random.split(jax.random.key(0), 4)[2])
    np.testing.assert_array_equal(rows[2], one)  # the whole row, all its frames, by one draw


def test_each_offset_is_encoded_once_however_many_losses_ask():
    calls = []
    encoder = PIXELS._replace(apply=lambda params, x: calls.append(params) or PIXELS.apply(params, x))
    offset = jnp.zeros(4, jnp.int32)
    latents = make_latents(encoder, {"scale": 1.0}, {"scale": 2.0}, SMALL)
    for _ in range(3):
        for k in (0, 1, offset):
            latents.online(k)
        latents.slow(offset)
    assert len(calls) == 4
    np.testing.assert_array_equal(latents.online(offset), latents.online(0))
    np.testing.assert_allclose(latents.slow(offset), 2 * latents.online(0))


def test_a_list_of_offsets_is_encoded_in_one_call():
    rows = []
    encoder = PIXELS._replace(apply=lambda params, x: rows.append(len(x)) or PIXELS.apply(params, x))
    latents = make_latents(encoder, {"scale": 1.0}, {"scale": 2.0}, SMALL)
    offset = jnp.array([3, 0, 1, 2], jnp.int32)
    for several in ([1, offset, 3], (1, offset, 3)):
        z = latents.slow(several)
        assert z.shape == (3, 4, PIXELS.features)
        assert rows == [12]  # K * B, once
    for k, ours in zip((1, offset, 3), z, strict=True):
        np.testing.assert_array_equal(ours, latents.slow(k))
    assert rows == [12, 4, 4, 4]  # alone they are encoded each
    twice = latents.online([2, 0, 2])
    assert rows[4:] == [8]
    np.testing.assert_array_equal(twice, latents.online([2, 0])[np.array([0, 1, 0])])
    assert rows[4:] == [8]


def test_equal_offsets_are_encoded_once_where_their_numbers_are_known():
    calls = []
    encoder = PIXELS._replace(apply=lambda params, x: calls.append(params) or PIXELS.apply(params, x))

    def run(traced):
        calls.clear()
        latents = make_latents(encoder, {"scale": 1.0}, {"scale": 2.0}, SMALL)
        for offset in (np.full(4, 1, np.int32), np.full(4, 1, np.int32), np.full(4, 2, np.int32)):
            latents.online(offset)
        known = len(calls)
        for offset in (traced, traced, traced + 0):  # what a tracer will be is not known
            latents.online(offset)
        return known, len(calls) - known

    found = []
    jax.eval_shape(lambda offset: found.append(run(offset)), jnp.zeros(4, jnp.int32))
    assert found == [(2, 2)]
