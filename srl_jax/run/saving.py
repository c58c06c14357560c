"""What a checkpoint holds of the learner: the parameters that act, which others load, and the rest."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from srl_jax.errors import ConfigError, saving
from srl_jax.files import checkpoint
from srl_jax.files.checkpoint import Manifest
from srl_jax.learning.agent import Agent
from srl_jax.learning.optim import real_copy
from srl_jax.types import Params, TrainState


def rest(agent: Agent, state: TrainState) -> dict[str, Any]:
    """What resuming needs of a state beside the parameters that act, a tree of arrays."""
    found = {name: getattr(state, name) for name in ("slow", "opt_state", "step")}
    if agent.acting(state) is not state.params:
        found["params"] = state.params
    if state.norms is not None:  # runs of before there were ratios have none
        found["norms"] = state.norms
    return found | {"key": jax.random.key_data(state.key)}


def params(agent: Agent, manifest: Manifest, name: str = "params") -> Params:
    """The parameters of a policy in a checkpoint, on the device; raises as `checkpoint.load_into`.

    Args:
        agent: that they are of.
        manifest: of the checkpoint.
        name: of the tree there.
    """
    return real_copy(_fitting(agent.shapes().params, manifest, name))


def restored(agent: Agent, manifest: Manifest) -> TrainState:
    """The state that a checkpoint was written of; raises as `checkpoint.load_into`."""
    shapes = agent.shapes()
    found = {"params": _fitting(shapes.params, manifest, "params")}
    found |= _fitting(jax.eval_shape(lambda state: rest(agent, state), shapes), manifest, "learner")
    return real_copy(shapes._replace(**found | {"key": jax.random.wrap_key_data(found["key"])}))


def _fitting(template: Any, manifest: Manifest, name: str) -> Any:
    return checkpoint.load_into(template, checkpoint.load_tree(manifest, name), str(manifest.path))


def slim_before(run: Path, env_steps: int) -> None:
    """Slims a run's checkpoints of before an env step, from which nobody will resume; a damaged one stays.

    Raises:
        SaveError: one could not be written.
    """
    for path in sorted((run / "checkpoints").glob("[0-9]*")):
        with contextlib.suppress(ConfigError):
            manifest = checkpoint.read_manifest(path)
            if checkpoint.NUMBERS in manifest.files and manifest.env_steps < env_steps:
                checkpoint.slim(manifest)


def drop_after(run: Path, env_steps: int) -> bool:
    """Removes the best parameters of after an env step that a run resumes from; it may not get there again.

    Returns:
        Whether they were all that was kept: what a checkpoint knows as the best is not there then.

    Raises:
        SaveError: they cannot be removed.
    """
    kept = list((run / "best").glob("[0-9]*"))
    later = [path for path in kept if int(path.name) > env_steps]
    for path in later:
        with saving(path, "not removed"):
            shutil.rmtree(path)
    return 0 < len(later) == len(kept)


@contextlib.contextmanager
def resumable(manifest: Manifest) -> Iterator[None]:
    """Says in a line that a checkpoint cannot be resumed from, where reading it fails.

    Raises:
        ConfigError: it does.
    """
    try:
        yield
    except ConfigError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{manifest.path}: cannot be resumed from: {reason}") from None
