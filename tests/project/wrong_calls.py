"""Calls that mypy must refuse. Nothing runs them; a line without an error has a needless `type: ignore`."""

import srl_jax
from srl_jax import Config, losses

losses.categorical_q_learning(
    "hello",  # type: ignore[arg-type]
    3,  # type: ignore[arg-type]
    None,  # type: ignore[arg-type]
    {},  # type: ignore[arg-type]
    [],  # type: ignore[arg-type]
    4,  # type: ignore[arg-type]
    5,  # type: ignore[arg-type]
)
losses.huber()  # type: ignore[call-arg]
Config(steps="ten")  # type: ignore[arg-type]
Config(step=10)  # type: ignore[call-arg]
Config().steps = 10  # type: ignore[misc]
srl_jax.load(3)  # type: ignore[arg-type]
srl_jax.train(Config(), out=3)  # type: ignore[arg-type]
print(srl_jax.lode)  # type: ignore[attr-defined]
