"""What other programs and other runs take from a checkpoint: an agent, its policy, its encoder."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax import plugins
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.learning.agent import Agent, make_agent
from srl_jax.learning.optim import ENCODER, RL
from srl_jax.learning.update import epsilon_greedy
from srl_jax.run.actor import Policy
from srl_jax.types import Array, Encoder, Params
from srl_jax.window import check_observations


class Loaded:
    """What a checkpoint holds: an encoder, and its policy where that was kept, as functions of arrays.

    Observations are uint8 [..., H, W, S * C], frame by frame, the newest frame last, or float32 in [0, 1] of
    that shape: a batch, or one alone, or with more axes in front. Each function is compiled once for each
    number of observations. To differentiate, take `encoder.apply(params["encoder"], observations)`.

    Attributes:
        agent: what the configuration means, `srl_jax.learning.agent.Agent`.
        params: {"encoder": tree, OBJECTIVE: its head's tree}, what the checkpoint holds; RL's is "rl".
        manifest: of the checkpoint.
        config: of the run, resolved.
        encoder: `agent.encoder`.
        env_steps: after which it was written.
    """

    def __init__(self, agent: Agent, params: dict[str, Params], manifest: checkpoint.Manifest):
        self.agent, self.params, self.manifest = agent, params, manifest
        self.config: Config = manifest.config
        self.encoder: Encoder = agent.encoder
        self.env_steps: int = manifest.env_steps
        self._rng = np.random.default_rng(0)

        def q_values(params: dict[str, Params], observations: Array) -> Array:
            return agent.algorithm.q_values(params[RL], agent.encoder.apply(params[ENCODER], observations))

        self._encode, self._q_values = jax.jit(agent.encoder.apply), jax.jit(q_values)

    def __repr__(self) -> str:
        names = ", ".join(self.params)
        return f"<{names} of {self.manifest.path}, {self.config.game} after {self.env_steps:,} env steps>"

    def encode(self, observations: Array) -> jax.Array:
        """The latents of observations, float32 [..., D].

        Raises:
            ValueError: the observations have another shape or dtype.
        """
        return self._over(lambda x: self._encode(self.params[ENCODER], x), observations)

    def q_values(self, observations: Array) -> jax.Array:
        """The expected return of each action without noise, float32 [..., A], in units of (clipped) reward.

        Raises:
            srl_jax.errors.ConfigError: no policy was kept there, but an encoder, or the run trained none.
            ValueError: the observations have another shape or dtype.
        """
        self._check_policy()
        return self._over(lambda x: self._q_values(self.params, x), observations)

    def act(
        self, observations: Array, epsilon: float = 0.0, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """Greedy actions, int32 [...]; each with probability epsilon a uniformly random one instead.

        They count from 0, as those of `srl_jax.envs` do: a loop over an environment whose actions start at
        another number adds that.

        Args:
            observations: see above.
            epsilon: in [0, 1].
            rng: draws where epsilon is above 0; None for one of this object's own, which starts at seed 0.

        Raises:
            srl_jax.errors.ConfigError: see `q_values`.
            ValueError: see `q_values`, or epsilon is out of range.
        """
        if not 0 <= epsilon <= 1:
            raise ValueError(f"epsilon must be in [0, 1], not {epsilon}")
        values = self.q_values(observations)
        key = jax.random.key((rng or self._rng).integers(2**31) if epsilon > 0 else 0)
        coin_key, action_key = jax.random.split(key)
        return np.array(epsilon_greedy(values, coin_key, action_key, epsilon))

    def policy(self, key: jax.Array) -> Policy:
        """The epsilon-greedy policy that evaluations play, see `greedy_policy`.

        Raises:
            srl_jax.errors.ConfigError: see `q_values`.
        """
        self._check_policy()
        return greedy_policy(self.agent, self.params, key)

    def _check_policy(self) -> None:
        if RL not in self.params:
            raise ConfigError(
                f"{self.manifest.path}: no policy was kept there, an encoder alone; name a run that trains "
                "RL or one of its checkpoints"
            )

    def _over(self, function: Callable[[Array], jax.Array], observations: Array) -> jax.Array:
        """A function of a batch, of observations with any axes in front."""
        if not isinstance(observations, jax.Array):
            observations = np.array(observations)  # a copy, for jax may go on reading what it is handed
        shape = self.encoder.observation_shape
        check_observations(observations, shape)
        ahead = observations.shape[:-3]
        if 0 in ahead:
            one = jax.eval_shape(function, jax.ShapeDtypeStruct((1, *shape), observations.dtype))
            return jnp.zeros((*ahead, *one.shape[1:]), one.dtype)
        result = function(observations.reshape(-1, *shape))
        return result.reshape(*ahead, *result.shape[1:])


def load(
    path: str | os.PathLike[str], *, imports: str | os.PathLike[str] | Iterable[str] | None = None
) -> Loaded:
    """Loads what was trained.

        policy = srl_jax.load("runs/pong")  # or "runs/pong/best", "runs/pong/checkpoints/000500000"
        policy.encode(observations), policy.q_values(observations), policy.act(observations)
        srl_jax.load("runs/pong/encoders/000100000").encode(observations)

    Args:
        path: a run directory, whose newest checkpoint is meant; one of its checkpoints; its best/; or an
            encoder that was kept in its encoders/, which has no policy beside it.
        imports: a file or module, or several, to import first, which register what the run is made of, as of
            `--import`; None for those that its configuration names.

    Raises:
        srl_jax.errors.ConfigError: there is none, it is damaged, does not fit this code, or something cannot
            be imported; one line.
    """
    if Path(path).suffix == ".npz":
        raise ConfigError(f"{path}: an exported encoder is read by srl_jax.encoders.from_npz")
    if isinstance(imports, str | os.PathLike):
        imports = [os.fspath(imports)]
    manifest = checkpoint.read_manifest(Path(path))
    plugins.load(manifest.config.imports if imports is None else map(plugins.located, imports))
    try:
        agent = make_agent(manifest.config, manifest.frame_shape, manifest.num_actions, trained=False)
        template = agent.shapes().params
    except (ConfigError, TypeError) as error:  # a TypeError is jax's, of shapes that cannot be
        raise ConfigError(f"{manifest.path}: {error}") from None
    tree = checkpoint.load(manifest)
    # A kept encoder comes alone, or with the decoders that diagnostics keep.
    template = {name: x for name, x in template.items() if name in tree}
    params = checkpoint.load_into(template, tree, str(manifest.path))
    return Loaded(agent, jax.tree.map(jnp.asarray, params), manifest)


def greedy_policy(agent: Agent, params: dict[str, Params], key: jax.Array) -> Policy:
    """The epsilon-greedy policy of an agent's parameters, without noise, as a function of numpy arrays."""

    def policy(frames: np.ndarray, step: int, epsilon: float) -> np.ndarray:
        return np.asarray(agent.act_eval(params, frames, key, np.int32(step), np.float32(epsilon)))

    return policy


def given_policy(
    config: Config, frame_shape: tuple, num_actions: int
) -> Callable[[jax.Array], Policy] | None:
    """The policy of `policy_from` without noise, a function of the key that it draws from; None without one.

    Raises:
        srl_jax.errors.ConfigError: it cannot be loaded, or has other frames or actions than the game.
    """
    if not config.policy_from:
        return None
    loaded = load(config.policy_from, imports=())  # what this run imports is imported already
    manifest = loaded.manifest
    if manifest.num_actions != num_actions:
        raise ConfigError(
            f"--policy_from={config.policy_from}: its policy has {manifest.num_actions} actions, "
            f"{config.game} has {num_actions}"
        )
    checkpoint.check_frames(manifest, frame_shape, f"--policy_from={config.policy_from}", config.game)
    return loaded.policy


def initial_params(config: Config, frame_shape: tuple, agent: Agent) -> dict[str, Params]:
    """{group: tree} of what starts from `encoder_from`: the encoder, and heads as `heads_from` says.

    Args:
        config: of the run.
        frame_shape: (H, W, C) of its environments.
        agent: of the configuration.

    Raises:
        srl_jax.errors.ConfigError: it cannot be loaded or does not fit.
    """
    if not config.encoder_from:
        return {}
    manifest = checkpoint.read_manifest(config.encoder_from)
    checkpoint.check_frames(manifest, frame_shape, f"--encoder_from={config.encoder_from}", config.game)
    found, template = checkpoint.load(manifest), agent.shapes().params
    wanted = {"representation": template.keys() - {RL}, "all": template.keys(), "none": {ENCODER}}
    names = sorted(wanted[config.heads_from] & found.keys())
    hint = "" if config.heads_from == "none" else " (--heads_from=none starts from the encoder alone)"
    return checkpoint.load_into(
        {name: template[name] for name in names},
        {name: found[name] for name in names},
        f"--encoder_from={config.encoder_from}{hint}",
    )
