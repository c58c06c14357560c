"""Resets: parts of a learner that are drawn anew while a run goes on, against what it learnt too early.

Nikishin et al. (2022), The Primacy Bias in Deep Reinforcement Learning, reset the last layers of RL's head.
D'Oro et al. (2023), Sample-Efficient Reinforcement Learning by Breaking the Replay Ratio Barrier, and
Schwarzer et al. (2023), Bigger, Better, Faster, reset all heads, and shrink and perturb the encoder. Replay
stays as it is.
`srl_jax.run.schedules` says when there is a reset.
"""

from collections.abc import Callable
from typing import Any

import jax

from srl_jax.latents import named_key
from srl_jax.learning.optim import ENCODER, ENCODER_SRL, RL, RL_SRL
from srl_jax.types import Array, Params, TrainState

TRANSITION = "transition"
"""The name of what is shrunk in an objective's head, as SPR's model of the next latent."""
HIDDEN = ("hidden", "embedding")
"""Ends of the names of the layers of RL's head that come before its last ones."""


def kept(kind: str, group: str, path: tuple[str, ...], shrink: float) -> float:
    """The share of a parameter that a reset leaves; the rest is of fresh ones. 1 leaves it as it is.

    Args:
        kind: "head": RL's head alone is reset; "head_last": of it the last layers alone; "all": all heads
            are, and the encoder and each head's "transition" are shrunk.
        group: of parameters: the encoder's, or an objective's name.
        path: names that lead to the parameter in its group.
        shrink: the share that is left of what is shrunk.
    """
    if kind in ("head", "head_last"):
        stays = kind == "head_last" and "".join(path[:1]).endswith(HIDDEN)
        return 0.0 if group == RL and not stays else 1.0
    return shrink if group == ENCODER or path[:1] == (TRANSITION,) else 0.0


def reset_key(key: jax.Array, number: int) -> jax.Array:
    """The key of the fresh parameters of the number-th reset of a run, the first being 1."""
    return jax.random.fold_in(named_key(key, "reset"), number)


def reset(state: TrainState, fresh: TrainState, kind: str, shrink: float) -> TrainState:
    """A learner after a reset; both may have an axis of seeds in front.

    Slow copies follow the same rule as what they are copies of. Adam's moments are cleared where nothing is
    left of a parameter, and stay where it is shrunk. The count of a group's updates, which corrects the bias
    of its moments, starts again where any of these are cleared.

    Args:
        state: before.
        fresh: as `make_init`'s init gives it for a key of `reset_key`.
        kind, shrink: see `kept`.
    """

    def combined(group: str, old: Params, new: Params) -> Params:
        return _by_share(lambda path: kept(kind, group, path, shrink), old, new)

    def moments(name: str) -> Any:
        old, new = state.opt_state[name], fresh.opt_state[name]
        group = {ENCODER_SRL: ENCODER, RL_SRL: RL}.get(name, name)

        def share(path: tuple[str, ...]) -> float:
            return 1.0 if kept(kind, group, path, shrink) else 0.0

        shares = [share(_names(path)) for path, _ in jax.tree_util.tree_leaves_with_path(old.mu)]
        return old._replace(
            count=old.count if all(shares) else new.count,
            mu=_by_share(share, old.mu, new.mu),
            nu=_by_share(share, old.nu, new.nu),
        )

    def copies(name: str, old: Params, new: Params) -> Params:
        own = {ENCODER: combined(ENCODER, old["encoder"], new["encoder"])}
        own["head"] = combined(name, old["head"], new["head"])
        if "read" in old:
            own["read"] = {group: combined(group, x, new["read"][group]) for group, x in old["read"].items()}
        return own

    return state._replace(
        params={name: combined(name, tree, fresh.params[name]) for name, tree in state.params.items()},
        slow={name: copies(name, old, fresh.slow[name]) for name, old in state.slow.items()},
        opt_state={name: moments(name) for name in state.opt_state},
    )


def _by_share(share_of: Callable[[tuple[str, ...]], float], old: Params, new: Params) -> Params:
    """Two trees as one: of each leaf this share of the old and the rest of the new."""

    def leaf(path: tuple, before: Array, after: Array) -> Array:
        share = share_of(_names(path))
        if share in (0.0, 1.0):
            return before if share else after
        return share * before + (1.0 - share) * after

    return jax.tree_util.tree_map_with_path(leaf, old, new)


def _names(path: tuple) -> tuple[str, ...]:
    return tuple(getattr(entry, "key", str(entry)) for entry in path)
