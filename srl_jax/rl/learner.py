"""Q-learning of any kind of value, as functions of a head's parameters and latents: what `q_learner` is."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from srl_jax.latents import named_key
from srl_jax.rl.heads import QNetwork
from srl_jax.rl.losses import midpoints, munchausen_return, soft_policy
from srl_jax.rl.values import Values
from srl_jax.types import Array, Latents, Params, Window


class Munchausen(NamedTuple):
    """The numbers of `srl_jax.rl.losses.munchausen_return`."""

    alpha: float
    tau: float
    clip: float


class Draws(NamedTuple):
    """What an update draws once: noise of the online and the slow network, and taus [B, N], or None each.

    Taus are those at which the slow network values the state bootstrapped from, and those over whose
    quantiles actions are compared.
    """

    online: Array | None
    slow: Array | None
    target: Array | None
    selector: Array | None


@dataclasses.dataclass(frozen=True)
class QLearner:
    """What a Q-learner is made of; its options are described at `srl_jax.rl.q_learner`.

    Attributes:
        values, network: the kind of value, and the head of it.
        features: D of the latents.
        step_view: (rewards, discounts, valid, n) -> (return, discount, offset), `srl_jax.rl.losses.n_step`.
        n_step: n, where the window does not say.
        double: whether the online network picks the action that the slow one evaluates.
        munchausen: its numbers, or None.
        view: (window, key) -> window, or None where nothing is changed.
        copies, target_copies: views of s_t and of the state bootstrapped from.
        lagged: whether there is a slow network; the online one without gradient stands in for it.
    """

    values: Values
    network: QNetwork
    features: int
    step_view: Callable[[Array, Array, Array, Any], tuple[Array, Array, Array]]
    n_step: int
    double: bool
    munchausen: Munchausen | None
    view: Callable[[Window, Array], Window] | None
    copies: int
    target_copies: int
    lagged: bool

    def init(self, key: jax.Array) -> Params:
        """The head's parameters."""
        z = jnp.zeros((1, self.features), jnp.float32)
        return self.network.init(key, z, None, self._taus(key, "init", 1, 1))["params"]

    def q_values(self, head: Params, latents: Array, key: jax.Array | None = None) -> Array:
        """As `srl_jax.rl.Algorithm.q_values`; without a key, taus are the midpoints of equal shares."""
        noise, (batch, number) = None, (len(latents), self.values.taus.act)
        if key is not None:
            noise = self._noise(key, 1)[0]
            taus = self._taus(key, "act", batch, number)
        else:
            taus = jnp.broadcast_to(midpoints(number), (batch, number)) if number else None
        return self._expected(head, latents, noise, taus)

    def loss(self, head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        """As `srl_jax.types.Objective.loss`."""
        n = self.n_step if window.n_step is None else window.n_step
        r_t, discount_t, offset = self.step_view(window.rewards, window.discounts, window.valid, n)
        a_tm1, counts = window.actions[:, 0], self.values.taus
        batch = len(a_tm1)
        # The online network has one draw of noise for both observations, and so the same weights.
        online, slow = self._noise(key, 2)
        draws = Draws(
            online=online,
            slow=slow,
            target=self._taus(key, "target", batch, counts.target),
            selector=self._taus(key, "selector", batch, counts.act),
        )
        frozen = jax.lax.stop_gradient((head, slow_head if self.lagged else head))

        targets = self._seen(latents, window, key, "target view", self.target_copies)
        if self.munchausen or self.target_copies > 1:  # one outcome in the place of all actions
            averaged = [self._averaged(frozen, of, offset, r_t, discount_t, a_tm1, draws) for of in targets]
            returns, outcomes = zip(*averaged, strict=True)
            r_t = sum(returns) / self.target_copies
            even = jnp.full((batch, self.target_copies), 1 / self.target_copies, jnp.float32)
            slow_t: Array = jax.vmap(self.values.average)(jnp.stack(outcomes, 1), even)[:, None]
            selector_t: Array = even[:, :1]
        else:
            slow_t, selector_t = self._bootstrap(frozen, targets[0], offset, draws)

        found = []
        for i, of in enumerate(self._seen(latents, window, key, "view", self.copies)):
            taus = self._taus(key, f"online {i}", batch, counts.online)
            out_tm1 = self._apply(head, of.online(0), draws.online, taus)
            losses, td_error = jax.vmap(self.values.loss)(
                out_tm1, a_tm1, r_t, discount_t, slow_t, selector_t, taus
            )
            found.append((losses, td_error, jnp.max(self.values.expected(out_tm1), -1)))
        losses, td_error, q_max = (sum(x) / self.copies for x in zip(*found, strict=True))
        if self.values.batch_mean:
            td_error = jnp.mean(td_error, keepdims=True)
        metrics = {"td_error": td_error, "q_max_mean": jnp.mean(q_max)}
        # Importance weights correct the RL loss alone, so it is the RL loss that multiplies them.
        return losses * window.weight, jax.lax.stop_gradient(metrics)

    def _bootstrap(
        self, frozen: tuple[Params, Params], of: Latents, offset: Array, draws: Draws
    ) -> tuple[Array, Array]:
        """The slow outputs [B, A, M] in the state bootstrapped from, and values [B, A] to choose by there."""
        head, slow_head = frozen
        z_t = of.slow(offset)
        slow_t = self._apply(slow_head, jax.lax.stop_gradient(z_t), draws.slow, draws.target)
        if self.double:
            z_t = jax.lax.stop_gradient(of.online(offset))
            return slow_t, self._expected(head, z_t, draws.online, draws.selector)
        if draws.selector is None:
            return slow_t, self.values.expected(slow_t)
        return slow_t, self._expected(slow_head, z_t, draws.slow, draws.selector)

    def _averaged(
        self,
        frozen: tuple[Params, Params],
        of: Latents,
        offset: Array,
        r_t: Array,
        discount_t: Array,
        a_tm1: Array,
        draws: Draws,
    ) -> tuple[Array, Array]:
        """The return [B], and the slow outputs of what a policy is worth in the state bootstrapped from."""
        slow_t, selector_t = self._bootstrap(frozen, of, offset, draws)
        if self.munchausen is None:
            policy = jax.nn.one_hot(jnp.argmax(selector_t, -1), selector_t.shape[-1], dtype=jnp.float32)
        else:
            alpha, tau, clip = self.munchausen
            policy = soft_policy(selector_t, tau)
            q_tm1 = self._expected(frozen[1], of.slow(0), draws.slow, draws.selector)
            bonus = partial(munchausen_return, alpha=alpha, tau=tau, clip=clip)
            r_t = jax.vmap(bonus)(r_t, discount_t, q_tm1, a_tm1, policy)
        return r_t, jax.vmap(self.values.average)(slow_t, policy)

    def _seen(
        self, latents: Latents, window: Window, key: jax.Array, name: str, number: int
    ) -> list[Latents]:
        """The latents of so many views of the window."""
        if self.view is None:
            return [latents]
        keys = jax.random.split(named_key(key, name), number)
        return [latents.of(self.view(window, k)) for k in keys]

    def _apply(self, head: Params, latents: Array, noise: Array | None, taus: Array | None) -> Any:
        return self.network.apply({"params": head}, latents, noise, taus)

    def _expected(self, head: Params, latents: Array, noise: Array | None, taus: Array | None) -> Array:
        return self.values.expected(self._apply(head, latents, noise, taus))

    def _noise(self, key: jax.Array, rows: int) -> Any:
        """Noise of so many networks, or as many None."""
        return self.network.draw_noise(key, rows, self.features) if self.network.noisy else [None] * rows

    def _taus(self, key: jax.Array, name: str, batch: int, number: int) -> Array | None:
        """Shares of probability, float32 [batch, number], where the head is asked for some."""
        if not self.values.taus.cosines:
            return None
        return jax.random.uniform(named_key(key, f"taus {name}"), (batch, number), jnp.float32)
