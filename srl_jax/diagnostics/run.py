"""All diagnostics of one run."""

import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from srl_jax.config import Config
from srl_jax.diagnostics import measures
from srl_jax.diagnostics.functions import Functions
from srl_jax.diagnostics.heldout import HeldOut, collect
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.learning.update import Hyper
from srl_jax.replay import Replay
from srl_jax.run.actor import seed_for
from srl_jax.types import Params, TrainState, Window

BATCH = 32
"""Observations that are encoded or decoded in one call."""
DECODED = 128
"""Held-out observations, the first ones, that the decoder of now is measured on."""
CROSSED = 32
"""Those of them that decoders and encoders of different epochs are measured on: there are many pairs."""


class Kept(NamedTuple):
    """An epoch that drift is measured against.

    Its decoders stay on disk: those of `sac_ae` have 40 MB each.

    Attributes:
        latents: of the held-out observations, float32 [N, D].
        gram: of these, see `measures.centred_gram`.
    """

    latents: np.ndarray
    gram: np.ndarray


class Diagnostics:
    """Measures a run's latent.

    Attributes:
        steps: env steps of the evaluations whose encoder and decoders are kept, in `encoders/`.

    Args:
        config: of the run.
        functions: of its agent.
        horizon: of its agent's windows.
        out: the run directory.
        say: takes a line about what cannot be measured.
    """

    def __init__(
        self, config: Config, functions: Functions, horizon: int, out: Path, say: Callable[[str], None]
    ):
        self._config, self._functions, self._horizon = config, functions, horizon
        self._folder, self._say = Path(out or ".") / "encoders", say
        self.steps = kept_steps(config)
        self._kept: dict[int, Kept | None] = {}

    @functools.cached_property
    def _held_out(self) -> HeldOut:
        held_out = collect(self._config, self._horizon)
        if held_out.problem:
            self._say(f"no probe of the game's state: {held_out.problem}")
        if self._functions.others:
            others = ", ".join(sorted(self._functions.others))
            self._say(f"no decoder errors of {others}: more than one latent goes into an image")
        return held_out

    def measure(
        self, state: TrainState, env_steps: int, replay: Replay, beta: float, hyper: Hyper, **of_rl: Any
    ) -> dict[str, float | None | list]:
        """The values of an "eval" row, JSON's own, and seconds as `wall_diag_s`; changes nothing of the run.

        Of an epoch that is kept, latents are kept in memory here; `parts` is what belongs into `encoders/`.

        Args:
            state: of the run.
            env_steps: that it has done.
            replay: of the run; a batch for gradients is drawn from it with a generator of its own.
            beta: the importance weights' exponent, now.
            hyper: of its next update.
            **of_rl: of the windows, see `Replay.sample`.
        """
        began, window = time.perf_counter(), None
        if self._functions.conflict is not None and len(replay):
            rng = np.random.default_rng(seed_for(self._config.seed, "diagnostics", env_steps))
            window, _ = replay.sample(self._config.batch_size, beta, rng, **of_rl)
        values = self._measure(state, env_steps, window, hyper)
        plain = {f"diag/{name}": _plain(value) for name, value in values.items()}
        return plain | {"wall_diag_s": round(time.perf_counter() - began, 3)}

    def parts(self, params: Params) -> Params:
        """Of the parameters those that are kept: the encoder, and what images are made by."""
        return {name: params[name] for name in self._functions.groups}

    def _measure(self, state: TrainState, env_steps: int, window: Window | None, hyper: Hyper):
        held_out, params = self._held_out, self.parts(state.params)
        now = self._keep(params["encoder"])
        kept = self._kept_before(env_steps, params)
        z = now.latents
        values: dict[str, Any] = {"drift/steps": list(kept)}
        if not np.isfinite(z).all():
            return values
        values |= {
            "effective_rank": measures.effective_rank(z),
            "dormant_share": measures.dormant_share(z),
            "constant_share": measures.constant_share(z),
            "drift/cosine": [measures.mean_cosine(z, then.latents) for then in kept.values()],
            "drift/centred_cosine": [
                measures.mean_cosine(measures.centred(z), measures.centred(then.latents))
                for then in kept.values()
            ],
            "drift/cka": [measures.alignment(now.gram, then.gram) for then in kept.values()],
        }
        if self._config.frame_stack > 1:
            values["moving_share"] = measures.moving_share(held_out.observations)
        if self._functions.decode:
            values |= self._decoded(params, now, kept)
        if window is not None and self._functions.conflict is not None:
            found = jax.device_get(self._functions.conflict(state._replace(opt_state=None), window, hyper))
            for name, (cosine, ratio) in found.items():
                values |= {f"gradient/{name}/cosine": cosine, f"gradient/{name}/norm_ratio": ratio}
        if held_out.variables:
            scores = measures.probe(z, held_out.states, held_out.episodes)
            scored = np.isfinite(scores)
            named = zip(held_out.variables, scores.tolist(), strict=True)
            values |= {f"probe/{name}": score for name, score in named if np.isfinite(score)}
            if scored.any():
                values["probe/mean"] = scores[scored].mean()
        if env_steps in self.steps:
            self._kept[env_steps] = now
        return values

    def _decoded(self, params: Params, now: Kept, kept: dict[int, Kept]) -> dict[str, Any]:
        """The errors of the objectives' decoders."""

        def crossed(name: str, parts: Params, latents: np.ndarray) -> float:
            valid, errors, *_ = self._decode(name, parts, latents, CROSSED)
            return _mean(errors[valid])

        values: dict[str, Any] = {}
        names = sorted(self._functions.decode)
        for name in names:
            valid, errors, targets, outputs = self._decode(name, params, now.latents, DECODED)
            itself = _mean(errors[:CROSSED][valid[:CROSSED]])
            values[f"decoder_now/{name}"] = [crossed(name, params, then.latents) for then in kept.values()]
            values[f"decoder_now/{name}"] += [itself]
            values[f"encoder_now/{name}"] = []
            if targets.shape[1] == 2:  # else nothing tells what moves
                targets, outputs = targets[valid], outputs[valid]
                found = measures.moving_errors(targets[:, 0], targets[:, 1], outputs[:, 1])
                values |= {f"error/{name}/{what}": value for what, value in found.items()}
        for step in kept:
            then = self._read(step, params)
            for name in names:
                error = crossed(name, then, now.latents) if then else math.nan
                values[f"encoder_now/{name}"].append(error)
        return values

    def _decode(self, name: str, params: Params, latents: np.ndarray, number: int) -> list[np.ndarray]:
        """What `Functions.decode` says of the first so many held-out observations."""
        decode, windows = self._functions.decode[name], self._held_out.windows
        found = [jax.device_get(decode(params, latents[p], _rows(windows, p))) for p in _parts(number)]
        return [np.concatenate(x) for x in zip(*found, strict=True)]

    def _keep(self, encoder: Params) -> Kept:
        observations = self._held_out.observations
        latents = np.concatenate(
            [
                np.asarray(self._functions.encode(encoder, observations[part]))
                for part in _parts(len(observations))
            ]
        )
        return Kept(latents, measures.centred_gram(latents))

    def _kept_before(self, env_steps: int, template: Params) -> dict[int, Kept]:
        """The kept epochs, oldest first; what a process before this one has kept is read from disk."""
        before = [step for step in self.steps if step < env_steps]
        for step in before:
            if step not in self._kept and (parts := self._read(step, template)):
                self._kept[step] = self._keep(parts["encoder"])
        return {step: kept for step in before if (kept := self._kept[step]) is not None}

    def _read(self, step: int, template: Params) -> Params | None:
        """What was kept of an epoch; None, once named and left out from then on, if it cannot be read."""
        path = self._folder / f"{step:09d}"
        try:
            tree = checkpoint.load(checkpoint.read_manifest(path))
            return checkpoint.load_into(template, tree, str(path))
        except ConfigError as error:
            self._kept[step] = None
            self._say(f"drift is measured without the encoder of {step} env steps: {error}")
            return None


def kept_steps(config: Config) -> tuple[int, ...]:
    """Env steps of the evaluations whose encoders are kept: spread evenly, the first one among them.

    The last evaluation is none: nothing comes after it that could be compared with it, and its parameters are
    the run's last checkpoint.
    """
    evaluations = config.steps // config.eval_every  # without the last one
    number = min(config.diagnostics_kept, evaluations)
    indices = {i * evaluations // number for i in range(number)}
    # The loop evaluates after the first step that reaches a multiple.
    return tuple(sorted(config.whole_rounds(i * config.eval_every) for i in indices))


def _plain(value: Any) -> Any:
    """As JSON has it; numbers rounded to float32, whose last digits do not depend on the sums' order."""
    if isinstance(value, list):
        return [_plain(x) for x in value]
    if isinstance(value, int):
        return value
    rounded = np.float32(value)
    return float(str(rounded)) if np.isfinite(rounded) else None


def _mean(values: np.ndarray) -> float:
    """Their mean; NaN of none."""
    return float(values.mean()) if len(values) else math.nan


def _parts(number: int) -> list[slice]:
    return [slice(start, start + BATCH) for start in range(0, number, BATCH)]


def _rows(window: Window, rows: slice) -> Window:
    return jax.tree.map(lambda x: x[rows], window)
