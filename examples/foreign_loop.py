"""A loop of your own on Catch: the replay and the losses of srl_jax over somebody else's network.

    python examples/foreign_loop.py

C51 with double Q-learning and three-step returns, and the inverse model beside it over the same latents.
After 60,000 env steps the mean return of the last 100 games is 0.86; 1 is the most, -0.63 random play.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from srl_jax import Replay, encoders, envs, latents, losses, objectives, types, window

N, A, ATOMS = 8, 3, jnp.linspace(-2, 2, 31)
conv, flat = nn.Conv(16, (6, 6), 4), lambda x: x.reshape(len(x), -1)
network = nn.Sequential([lambda x: x / 255, conv, nn.relu, flat, nn.Dense(64), nn.relu])
encoder = encoders.flax_encoder(network, None, (42, 42, 4))
inverse, optimizer = objectives.inverse(types.Context.of(encoder, A)), optax.adam(1e-3)


def logits(params: types.Params, x: types.Array) -> jax.Array:
    return (encoder.apply(params["encoder"], x) @ params["head"]).reshape(-1, A, len(ATOMS))


@jax.jit
def values(params: types.Params, x: types.Array) -> jax.Array:
    return jax.nn.softmax(logits(params, x)) @ ATOMS


@jax.jit
def learn(params: types.Params, slow: types.Params, opt_state: optax.OptState, batch: types.Window):
    r_t, discount_t, offset = losses.n_step(batch.rewards, batch.discounts, batch.valid, 3)
    x_tm1, x_t, a_tm1 = window.observation(batch, 0), window.observation(batch, offset), batch.actions[:, 0]

    def loss(params: types.Params):
        rl = jax.vmap(losses.categorical_q_learning, (0, None, 0, 0, 0, 0, 0))(
            logits(params, x_tm1), ATOMS, a_tm1, r_t, discount_t, logits(slow, x_t), values(params, x_t)
        )
        seen = latents.make_latents(encoder, params["encoder"], slow["encoder"], batch)
        srl, _ = inverse.loss(params["inverse"], {}, seen, batch, jax.random.key(0))
        return jnp.mean(rl * batch.weight) + 0.1 * jnp.mean(srl), rl

    grads, td_error = jax.grad(loss, has_aux=True)(params)
    steps, opt_state = optimizer.update(grads, opt_state)
    return optax.apply_updates(params, steps), opt_state, td_error


def main(steps: int = 60_000) -> list[float]:
    """Trains for so many env steps; the return of each game."""
    env, rng = envs.make("Catch", num_envs=N, seed=0, frame_size=42), np.random.default_rng(0)
    replay = Replay(capacity=20_000, num_streams=N, frame_shape=(42, 42, 1), horizon=3)
    frames, _ = env.reset()
    replay.begin(frames)
    stack, score, returns = frames.repeat(4, -1), np.zeros(N), []
    params = {"encoder": encoder.init(jax.random.key(0)), "inverse": inverse.init(jax.random.key(1))}
    params["head"] = 0.1 * jax.random.normal(jax.random.key(2), (64, A * len(ATOMS)))
    slow, opt_state = params, optimizer.init(params)
    for step in range(0, steps, N):
        random = rng.random(N) < max(0.02, 1 - 3 * step / steps)
        actions = np.where(random, rng.integers(0, A, N), values(params, stack).argmax(-1))
        frames, rewards, terminated, truncated, info = env.step(actions)
        replay.add(actions, rewards, terminated, truncated, info["life_lost"], frames)
        stack, score = np.concatenate([stack[..., 1:], frames], -1), score + rewards
        if (over := terminated | truncated).any():
            frames, _ = env.reset(options={"reset_mask": over})
            replay.begin(frames[over], np.flatnonzero(over))
            returns += score[over].tolist()
            stack[over], score[over] = frames[over], 0
        if len(replay) >= 100:
            batch, indices = replay.sample(64, beta=0.4)
            params, opt_state, td_error = learn(params, slow, opt_state, batch)
            replay.set_priorities(indices, td_error)
        if step % 800 == 0:
            slow = params
    return returns


if __name__ == "__main__":
    print(f"mean return of the last 100 games: {np.mean(main()[-100:]):.2f} (1: all balls caught)")
