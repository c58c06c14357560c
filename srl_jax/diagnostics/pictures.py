"""What the objectives of a run make of a few observations, for the pictures that a run ends with."""

from typing import Any

import jax
import numpy as np

from srl_jax.latents import make_latents
from srl_jax.learning.agent import Agent
from srl_jax.replay import Replay

PICTURES = 6
"""Examples in the picture of what an objective learnt."""


def pictures(agent: Agent, params: Any, replay: Replay, beta: float) -> dict[str, tuple]:
    """{objective: (inputs, targets, outputs)}, float32 [B, H, W, C] each, of objectives that have an image.

    Of each observation the newest frame is shown.

    Args:
        agent: of the run.
        params: its parameters.
        replay: what observations are drawn from; nothing is drawn where it is empty.
        beta: the importance weights' exponent.
    """
    drawn = {n: (o, o.image) for n, o in agent.objectives.items() if o.image}
    if not drawn or not len(replay):
        return {}
    window, _ = replay.sample(PICTURES, beta)

    def draw(params, window):
        latents = make_latents(agent.encoder, params["encoder"], params["encoder"], window)
        return {
            name: image(objective.head(params[name], objective.read(params)), latents, window)
            for name, (objective, image) in drawn.items()
        }

    made = jax.device_get(jax.jit(draw)(params, window))
    channels = replay.frame_shape[-1]
    stack = agent.encoder.observation_shape[-1] // channels
    inputs = window.frames[:, stack - 1].astype(np.float32) / 255.0
    return {
        name: (inputs, target[..., -channels:], output[..., -channels:])
        for name, (target, output) in made.items()
    }
