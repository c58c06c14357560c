"""srl_jax/learning/update.py: how two losses step one encoder, against PyTorch's own Adams.

`two_adams.json` was made by `python -m tests.learning.two_adams_test`, which needs PyTorch (2.13 then): ten
updates of a small network, as the thesis' authors write them, in each of the three forms.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax.learning.modes import ENCODER_OPTIMIZERS, MODES
from srl_jax.learning.optim import NOT_MEASURED, RL, make_optimizer
from srl_jax.learning.update import NORM_EVERY, Hyper, make_init, make_update, passes, periodic
from srl_jax.types import Encoder, Objective, Window

EXPECTED = Path(__file__).with_suffix(".json").with_name("two_adams.json")
INPUTS, FEATURES, ACTIONS, BATCH, UPDATES = 6, 4, 2, 5, 10
RATES = {"encoder": 0.01, "encoder_srl": 0.003, "rl": 0.01, "representation": 0.02}
DECAY, L2, CLIP = 0.1, 0.01, 0.5


def start():
    """{group: kernel}."""
    rng = np.random.default_rng(0)
    shapes = {"encoder": (INPUTS, FEATURES), RL: (FEATURES, ACTIONS), "decoder": (FEATURES, INPUTS)}
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def batches():
    """Of each update: pixels in [0, 1] [B, INPUTS], actions [B], targets of their values [B]."""
    rng = np.random.default_rng(1)
    for _ in range(UPDATES):
        pixels = rng.integers(0, 256, (BATCH, INPUTS)).astype(np.uint8)
        actions = rng.integers(0, ACTIONS, BATCH).astype(np.int32)
        yield pixels, actions, rng.normal(size=BATCH).astype(np.float32)


def with_torch(form, clip):
    """{group: kernel} after the updates, by PyTorch."""
    import torch

    p = {name: torch.nn.Parameter(torch.tensor(x, dtype=torch.float64)) for name, x in start().items()}
    adam = lambda name, rate, **how: torch.optim.Adam([p[name]], lr=RATES[rate], **how)  # noqa: E731
    head, decoder = adam(RL, "rl"), adam("decoder", "representation", weight_decay=DECAY)
    encoder, second = adam("encoder", "encoder"), adam("encoder", "encoder_srl")

    def losses(pixels, actions, targets):
        pixels = torch.tensor(pixels, dtype=torch.float64) / 255
        z = torch.tanh(pixels @ p["encoder"])
        chosen = (z @ p[RL])[torch.arange(BATCH), torch.tensor(actions, dtype=torch.int64)]
        rl = ((chosen - torch.tensor(targets, dtype=torch.float64)) ** 2).mean()
        image = ((z @ p["decoder"] - pixels) ** 2).mean(1).mean()
        return rl, image + L2 * 0.5 * (z**2).sum(1).mean()

    def step(loss, names, optimizers):
        for parameter in p.values():
            parameter.grad = None
        loss.backward()
        if clip:
            torch.nn.utils.clip_grad_norm_([p[name] for name in names], clip)
        for optimizer in optimizers:
            optimizer.step()

    for batch in batches():
        if form == "summed":
            step(sum(losses(*batch)), p, (head, decoder, encoder))
        elif form == "separate":
            step(losses(*batch)[0], (RL, "encoder"), (head, encoder))
            step(losses(*batch)[1], ("decoder", "encoder"), (decoder, second))
        else:  # both gradients, then both steps: those of PyTorch change what it differentiates
            rl, representation = losses(*batch)
            later = torch.autograd.grad(representation, [p["encoder"], p["decoder"]], retain_graph=True)
            step(rl, (RL, "encoder"), (head, encoder))
            p["encoder"].grad, p["decoder"].grad = later
            if clip:
                torch.nn.utils.clip_grad_norm_([p["encoder"], p["decoder"]], clip)
            for optimizer in (decoder, second):
                optimizer.step()
    return {name: x.detach().numpy().tolist() for name, x in p.items()}


def network():
    """The same network as an encoder and objectives."""

    def apply(kernel, observation):  # the pixels are the first of a frame
        x = observation.astype(jnp.float32) / 255
        return jnp.tanh(x.reshape(len(x), -1)[:, :INPUTS] @ kernel)

    encoder = Encoder(lambda key: None, apply, FEATURES, (INPUTS, 1, 1), None)

    def rl(head, slow_head, latents, window, key):
        chosen = jnp.take_along_axis(latents.online(0) @ head, window.actions[:, :1], 1)[:, 0]
        error = chosen - window.rewards[:, 0]
        return error**2, {"td_error": error}

    def image(head, slow_head, latents, window, key):
        pixels = window.frames[:, 0, :, 0, 0].astype(jnp.float32) / 255
        return jnp.mean((latents.online(0) @ head - pixels) ** 2, -1), {}

    def l2(head, slow_head, latents, window, key):
        return 0.5 * jnp.sum(latents.online(0) ** 2, -1), {}

    return encoder, {
        RL: Objective(None, rl, slow=periodic(4)),
        "decoder": Objective(None, image, is_decoder=True),
        "l2": Objective(None, l2, weight=L2),
    }


def window(pixels, actions, targets):
    ones = np.ones((BATCH, 1), np.float32)
    frames = np.stack([pixels, pixels], 1)[..., None, None]
    return Window(frames, actions[:, None], targets[:, None], ones, ones, ones[:, 0])


@pytest.mark.parametrize("clip", [0.0, CLIP])
@pytest.mark.parametrize("form", ENCODER_OPTIMIZERS)
def test_ten_updates_are_pytorchs(form, clip):
    encoder, terms = network()
    optimizer = make_optimizer(terms, decoder_weight_decay=DECAY, max_grad_norm=clip)
    plan = passes(MODES["joint"], terms, form)
    init = make_init(encoder, terms, MODES["joint"], optimizer, plan=plan)
    state = init(jax.random.key(0), {**start(), "l2": {}})
    update = jax.jit(make_update(encoder, terms, MODES["joint"], optimizer, plan=plan))
    hyper = Hyper({name: np.float32(term.weight) for name, term in terms.items()}, RATES)
    for i, batch in enumerate(batches()):
        before = state.params["encoder"]
        state, _, metrics = update(state, window(*batch), hyper)
        if i == 0:
            first = state.params["encoder"] - before
    expected = json.loads(EXPECTED.read_text())[f"{form} {clip:g}"]
    for name in start():
        np.testing.assert_allclose(state.params[name], expected[name], atol=1e-5, rtol=1e-5, err_msg=name)
    assert ("encoder_srl" in state.opt_state) == ("step_ratio/encoder" in metrics) == (form != "summed")
    if form != "summed":
        # At its first step Adam moves every number by its rate, one way or the other.
        assert set(np.round(np.abs(first / 0.001)).astype(int).flat) <= {13, 7}
        assert metrics["step_ratio/encoder"] == NOT_MEASURED  # measured in every NORM_EVERY-th


def test_the_ratio_of_the_two_steps_does_not_see_a_losss_weight():
    encoder, terms = network()
    optimizer = make_optimizer(terms)
    init = make_init(encoder, terms, MODES["joint"], optimizer)
    update = jax.jit(make_update(encoder, terms, MODES["joint"], optimizer))
    for weight in (1.0, 1000.0):
        hyper = Hyper({RL: 1.0, "decoder": weight, "l2": 0.0}, RATES)
        state = init(jax.random.key(0), {**start(), "l2": {}})
        seen = []
        for batch in batches():
            state, _, metrics = update(state, window(*batch), hyper)
            seen.append(float(metrics["step_ratio/encoder"]))
        # The first of NORM_EVERY: Adam's first step is its rate for each number, whatever the gradient.
        assert seen[0] == pytest.approx(RATES["encoder_srl"] / RATES["encoder"], rel=1e-3)
        assert NORM_EVERY >= UPDATES and set(seen[1:]) == {NOT_MEASURED}


def test_there_are_two_passes_only_where_both_train_the_encoder():
    def names(mode, active, form="separate"):
        return [(one.objectives, one.groups.get("encoder")) for one in passes(MODES[mode], active, form)]

    both = (RL, "decoder")
    assert names("joint", both) == [((RL,), "encoder"), (("decoder",), "encoder_srl")]
    assert names("joint", both, "summed") == [(both, "encoder")]
    assert names("joint", (RL,)) == [((RL,), "encoder")]
    assert names("decoupled", both) == [(both, "encoder")]
    assert names("decoupled", (RL,)) == [((RL,), None)]
    assert names("frozen", (RL,)) == [((RL,), None)]
    assert names("pretrain", ("decoder",)) == [(("decoder",), "encoder")]
    with pytest.raises(ValueError, match="an objective cannot be called encoder"):
        names("joint", (RL, "encoder"))


if __name__ == "__main__":
    found = {f"{form} {clip:g}": with_torch(form, clip) for form in ENCODER_OPTIMIZERS for clip in (0, CLIP)}
    EXPECTED.write_text(json.dumps(found, indent=1) + "\n")
