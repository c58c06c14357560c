"""Everything that a run is at one moment, between two steps, and a run that goes on from there.

What changes while a run runs lives in `srl_jax.loop.Run` and what it holds. Here it is listed once for
writing and once for reading; an attribute that somebody adds to a run and forgets here makes resumed runs
differ, which `experiments.soak` finds.
"""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from srl_jax import checkpoint
from srl_jax.checkpoint import Manifest, State
from srl_jax.diagnostics.measure import check_diagnosed
from srl_jax.errors import ConfigError
from srl_jax.evaluator import Moment
from srl_jax.optim import real_copy

if TYPE_CHECKING:
    from srl_jax.loop import Run

CHUNK_BYTES = 1 << 25
"""Size of a chunk of replay's frames: what a checkpoint writes anew, if one frame of it has changed."""


def take(run: "Run") -> State:
    """What `srl_jax.checkpoint.save` needs beside the parameters."""
    state = run.agent.export(run.state)
    learner = {"slow": state.slow, "opt_state": state.opt_state, "step": state.step}
    trees = {"learner": learner | {"key": jax.random.key_data(state.key)}}
    arrays = {"stacks": run.stacks.frames}
    if run.evaluator.recording is not None:
        arrays["recording"] = run.evaluator.recording
    replay_arrays, replay_numbers = run.replay.snapshot()
    arrays |= {f"replay_{name}": x for name, x in replay_arrays.items()}
    arrays |= {f"env_{name}": x for name, x in run.env.snapshot().items()}
    evaluating = None
    if (moment := run.evaluator.moment) is not None:
        evaluating = {key: getattr(moment, key) for key in ("env_steps", "updates", "diagnosed")}
        if moment.updates != run.updates:  # else its parameters are those of now
            trees["evaluation"] = moment.params
    unchanged = set()
    changed = None if run.saved is None else run.replay.changed_slots(run.saved_position)
    for name, slots in chunks(run.replay):
        arrays[name] = run.replay.frames[:, slots]
        if changed is not None and not changed[slots].any():
            unchanged.add(name)
    numbers = {
        "env_steps": run.env_steps,
        "updates": run.updates,
        "score": run.score.tolist(),
        "solved": run.solved,
        "evaluating": evaluating,
        "random": run.random.bit_generator.state,
        "replay": replay_numbers,
        "report": run.report.snapshot(),
    }
    return State(trees, arrays, numbers, frozenset(unchanged))


def put(run: "Run", manifest: Manifest) -> None:
    """Brings a new run to where the checkpoint was taken; the report must not be open yet.

    Args:
        run: of the same configuration.
        manifest: verified.

    Raises:
        ConfigError: the checkpoint is not of such a run, or the environments do not come back to what was
            seen; names the file or says what differs.
    """
    numbers = checkpoint.load_numbers(manifest)
    try:
        _put(run, manifest, numbers)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"{manifest.path}: cannot be gone on from: {type(error).__name__}: {error}"
        ) from None
    run.saved, run.saved_position = manifest, run.replay.next_position.copy()


def _put(run: "Run", manifest: Manifest, numbers: dict[str, Any]) -> None:
    where = str(manifest.path)
    shapes = run.agent.shapes()
    params = checkpoint.load_into(shapes.params, checkpoint.load(manifest), where)
    template = {
        "slow": shapes.slow,
        "opt_state": shapes.opt_state,
        "step": shapes.step,
        "key": jax.eval_shape(jax.random.key_data, shapes.key),
    }
    learner = checkpoint.load_into(template, checkpoint.load_tree(manifest, "learner"), where)
    key = jax.random.wrap_key_data(learner.pop("key"))
    run.state = run.agent.adopt(shapes._replace(params=params, key=key, **learner))

    def array(name: str, into: np.ndarray | None = None) -> np.ndarray:
        return checkpoint.load_array(manifest, name, into)

    def group(prefix: str) -> dict[str, np.ndarray]:
        names = [
            n.removesuffix(".npy") for n in manifest.files if n.startswith(prefix) and n.endswith(".npy")
        ]
        return {n.removeprefix(prefix): array(n) for n in names if not n.startswith("replay_frames_")}

    replay = run.replay
    replay_arrays = group("replay_")
    positions = replay_arrays["next_position"]
    form = replay.next_position.shape, replay.next_position.dtype
    if (positions.shape, positions.dtype) != form or (positions < 0).any():
        raise ValueError("next_position is not a position in each stream")
    replay.next_position[:] = positions
    for name, slots in chunks(replay):
        replay.frames[:, slots] = array(name, np.empty_like(replay.frames[:, slots], order="C"))
    replay.restore(replay_arrays, numbers["replay"])
    array("stacks", run.stacks.frames)
    recording = array("recording") if "recording.npy" in manifest.files else None
    if recording is not None:
        length, *shape = recording.shape
        if recording.dtype != np.uint8 or tuple(shape) != replay.frame_shape or not length:
            raise ValueError("the recording is not made of frames")
    run.evaluator.recording = recording
    run.env_thread.submit(run.env.restore, group("env_")).result()
    run.random.bit_generator.state = numbers["random"]
    run.env_steps, run.updates = manifest.env_steps, manifest.updates
    if (numbers["env_steps"], numbers["updates"]) != (run.env_steps, run.updates):
        raise ValueError("env steps and updates are not the manifest's")
    score = np.array(numbers["score"], float)
    if score.shape != run.score.shape or not np.isfinite(score).all():
        raise ValueError("a score is missing")
    run.score, run.solved = score, bool(numbers["solved"])
    run.report.restore(numbers["report"], run.env_steps)
    if (evaluating := numbers["evaluating"]) is not None:
        env_steps, updates = int(evaluating["env_steps"]), int(evaluating["updates"])
        policy = params
        if updates != run.updates:
            policy = checkpoint.load_into(shapes.params, checkpoint.load_tree(manifest, "evaluation"), where)
        # Runs from before there were diagnostics have none.
        diagnosed = check_diagnosed(evaluating.get("diagnosed", {}))
        run.start_evaluation(Moment(real_copy(policy), env_steps, updates, diagnosed))


def chunks(replay: Any) -> list[tuple[str, slice]]:
    """Names and slots of the chunks of replay's frames that have ever been written to."""
    streams, slots = replay.frames.shape[:2]
    size = max(1, CHUNK_BYTES // (streams * int(np.prod(replay.frame_shape))))
    starts = range(0, min(slots, replay.filled_slots()), size)
    return [
        (f"replay_frames_{start // size:05d}", slice(start, min(start + size, slots))) for start in starts
    ]
