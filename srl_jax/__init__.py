"""State representation learning for model-free reinforcement learning from pixels, in JAX.

    import srl_jax

    result = srl_jax.train(srl_jax.Config(game="Pong", steps=1_000_000), "runs/x")
    policy = srl_jax.load("runs/x")
    actions = policy.act(observations)  # uint8 [B, H, W, S * C] -> int32 [B]

`losses`, `objectives`, `encoders` and `Replay` are parts for a loop of your own; `statistics` says how
certain scores are, and `data` has published ones. Each name is imported when it is first asked for;
`import srl_jax` itself and `Config` import no jax.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from srl_jax import data, encoders, envs, objectives, statistics
    from srl_jax.config import Config
    from srl_jax.loading import load
    from srl_jax.replay import Replay
    from srl_jax.rl import losses
    from srl_jax.training import train
else:  # a checker would take any name for one that is there

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = importlib.import_module(_MODULES[name])
        value = module if module.__name__.endswith(f".{name}") else getattr(module, name)
        globals()[name] = value
        return value


__version__ = "0.1.0"
__all__ = [
    "Config", "Replay", "__version__", "data", "encoders", "envs", "load", "losses", "objectives",
    "statistics", "train",
]  # fmt: skip

_MODULES = {
    "Config": "srl_jax.config",
    "Replay": "srl_jax.replay",
    "data": "srl_jax.data",
    "encoders": "srl_jax.encoders",
    "envs": "srl_jax.envs",
    "load": "srl_jax.loading",
    "losses": "srl_jax.rl.losses",
    "objectives": "srl_jax.objectives",
    "statistics": "srl_jax.statistics",
    "train": "srl_jax.training",
}
"""Where each name is: a module of that name, or the module that has it."""


def __dir__() -> list[str]:
    return __all__
