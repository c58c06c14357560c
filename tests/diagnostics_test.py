"""srl_jax/diagnostics: the measures against hand-worked numbers, and what they may not change."""

import hashlib
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.drawing import plots, run_figures
from srl_jax import envs
from srl_jax.config import Config
from srl_jax.diagnostics import heldout, measures
from srl_jax.diagnostics.drift import drift_matrix
from srl_jax.diagnostics.functions import make_conflict, make_functions
from srl_jax.diagnostics.run import Diagnostics, kept_steps
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.modes import MODES
from srl_jax.optim import RL
from srl_jax.replay import Replay
from srl_jax.types import Objective, TrainState
from srl_jax.update import Hyper
from tests.helpers import SMALL, jit, make_encoder, make_window, random_params

RNG = np.random.default_rng(0)


# Rank, dormancy, drift


def keep(path, parts, config, step):
    """Writes what diagnostics keep of an epoch, as a run does."""
    counts = {"num_actions": 3, "env_steps": step, "updates": 0}
    checkpoint.save(path, parts, config, frame_shape=(42, 42, 1), keep=0, folder="encoders", **counts)


def test_effective_rank():
    # Four points, centred: singular values 4 and 2 and no others. Shares 2/3 and 1/3.
    z = np.array([[2, 1], [2, -1], [-2, 1], [-2, -1.0]], np.float32) @ np.eye(2, 5) + 7
    by_hand = np.exp(-(2 / 3 * np.log(2 / 3) + 1 / 3 * np.log(1 / 3)))
    assert measures.effective_rank(z) == pytest.approx(by_hand, rel=1e-6)
    turn = np.linalg.qr(RNG.normal(size=(5, 5)))[0]
    assert measures.effective_rank(3 * z @ turn) == pytest.approx(by_hand, rel=1e-6)
    assert measures.effective_rank(np.ones((6, 3), np.float32)) == 0.0


@pytest.mark.parametrize("shape", [(40, 12), (12, 40)])
def test_effective_rank_is_that_of_the_singular_values(shape):
    z = RNG.normal(size=shape)
    values = np.linalg.svd(z - z.mean(0), compute_uv=False)
    shares = values[values > 1e-9] / values.sum()
    assert measures.effective_rank(z) == pytest.approx(np.exp(-np.sum(shares * np.log(shares))))


def test_dormant_and_constant_units():
    # Mean |activation|: 1, 0.02, 0, 3, 1; their mean is 1.004, so that at most 0.0251 is dormant.
    z = np.array([[1, 0.02, 0, 3, -1], [-1, -0.02, 0, 3, 1]], np.float32)
    assert measures.dormant_share(z) == pytest.approx(2 / 5)
    assert measures.constant_share(z) == pytest.approx(2 / 5)  # the third, and the fourth, which is stuck
    assert measures.dormant_share(np.zeros((3, 4), np.float32)) == 1.0


def test_cka_knows_no_rotation_and_no_scale():
    a, b = RNG.normal(size=(30, 6)), RNG.normal(size=(30, 4))
    b[:, 0] += a[:, 0]
    centred = [x - x.mean(0) for x in (a, b)]
    (x, y), norm = centred, np.linalg.norm
    reference = norm(y.T @ x) ** 2 / (norm(x.T @ x) * norm(y.T @ y))  # Kornblith et al., equation 6
    cka = lambda a, b: measures.alignment(measures.centred_gram(a), measures.centred_gram(b))  # noqa: E731
    assert cka(a, b) == pytest.approx(reference) and 0.05 < reference < 0.9
    turn = np.linalg.qr(RNG.normal(size=(6, 6)))[0]
    assert cka(5 * a @ turn + 3, b) == pytest.approx(reference)
    assert cka(a, -2 * a @ turn) == pytest.approx(1)
    assert measures.mean_cosine(a, -2 * a) == pytest.approx(-1)
    assert measures.mean_cosine(np.eye(2), np.array([[1, 1], [1, 0.0]])) == pytest.approx(0.5**0.5 / 2)


def rows_of(kept, upto=4):
    """Rows of evaluations at 0, 10, ...: the error of decoder i on encoder j is i + j / 1000."""
    rows = []
    for now in range(0, 10 * upto, 10):
        before = [step for step in kept if step < now]
        rows.append(
            {
                "kind": "eval", "env_steps": now, "diag/drift/steps": before, "diag/effective_rank": 2.0,
                "diag/decoder_now/x": [now + then / 1000 for then in [*before, now]],
                "diag/encoder_now/x": [then + now / 1000 for then in before],
            }
        )  # fmt: skip
    return rows


def test_drift_matrix():
    steps, matrix = drift_matrix([{"kind": "train"}, *rows_of([0, 10, 20])], "x")
    assert steps.tolist() == [0, 10, 20, 30]
    np.testing.assert_array_equal(matrix, steps[:, None] + steps[None, :] / 1000)
    # Of an epoch that is kept, but whose row is lost, only what later rows say of it is known.
    steps, matrix = drift_matrix(rows_of([0, 10])[2:], "x")
    assert steps.tolist() == [0, 10, 30]
    assert np.isnan(matrix).tolist() == [[True, True, False], [True, True, False], [False] * 3]
    assert [len(a) for a in drift_matrix([], "x")] == [0, 0]
    broken = rows_of([0, 10])
    broken[3]["diag/encoder_now/x"].pop()
    with pytest.raises(ValueError, match="drift of x after 30 env steps is not over its 2 kept"):
        drift_matrix(broken, "x")


def test_which_epochs_are_kept():
    def kept(**values):
        return kept_steps(Config(**{**SMALL, **values}))

    assert kept(steps=240, eval_every=60, diagnostics_kept=10) == (0, 60, 120, 180)
    assert kept(steps=240, eval_every=60, diagnostics_kept=2) == (0, 120)
    # With 7 environments, 60 and 120 are reached by 63 and 126.
    assert kept(steps=239, eval_every=60, num_envs=7) == (0, 63, 126)
    assert kept(diagnostics_kept=0) == kept(eval_every=1000) == ()


# Errors, probes


def test_errors_on_moving_and_static_pixels():
    before = np.zeros((2, 2, 2, 1), np.float32)
    target = np.array([[[1, 0.05], [0, 0]], [[0, 0], [0, 0.5]]], np.float32)[..., None]
    output = np.array([[[0.5, 0], [0, 0]], [[0.2, 0], [0, 0.5]]], np.float32)[..., None]
    found = measures.moving_errors(before, target, output)
    # Two of eight pixels move. Their errors are 0.25 and 0, the mean image's (1 - 0.5)^2 and (0.5 - 0.25)^2.
    assert found["moving"] == pytest.approx(0.125)
    assert found["moving_explained"] == pytest.approx(1 - 0.125 / ((0.25 + 0.0625) / 2))
    assert found["static"] == pytest.approx((0.05**2 + 0.2**2) / 6)
    frames = np.stack([before, target], 1) * 255
    assert measures.moving_share(frames.astype(np.uint8)) == 2 / 8
    still = measures.moving_errors(target, target, output)
    assert np.isnan(still["moving"]) and np.isnan(still["moving_explained"])


def test_a_pixel_moves_with_any_of_its_colours():
    # One pixel of two turns from red to green; errors are averaged over the three channels.
    before, target = np.zeros((2, 1, 1, 2, 3), np.float32)
    before[..., 0, 0] = target[..., 0, 1] = 1.0
    found = measures.moving_errors(before, target, np.zeros_like(target))
    assert found["moving"] == pytest.approx(1 / 3) and found["static"] == 0.0
    assert measures.moving_share((255 * np.stack([before, target], 1)).astype(np.uint8)) == 0.5


def test_a_probe_finds_what_is_linear_in_the_latent_and_nothing_else():
    rng = np.random.default_rng(1)
    z, episodes = rng.normal(size=(400, 30)).astype(np.float32), np.repeat(np.arange(20), 20)
    states = np.stack([z @ rng.normal(size=30), rng.normal(size=400), np.ones(400), z[:, 0] ** 2], 1)
    z[:, 5] = 1e6  # a unit that is stuck; what it was is noise now, about a thirtieth of the variance
    planted, noise, constant, squared = measures.probe(z, states, episodes)
    assert planted > 0.9
    assert abs(noise) < 0.1 and abs(squared) < 0.15
    assert np.isnan(constant)
    # More units than observations.
    wide = np.concatenate([z, rng.normal(size=(400, 600))], 1)
    assert 0.2 < measures.probe(wide, states, episodes)[0] < planted
    assert np.isnan(measures.probe(z, states, np.zeros(400, int))).all()


def test_a_unit_that_hardly_moves_does_not_decide_a_probe():
    # On the episodes of the fit it is a thousandth of noise, on the others all of it.
    for seed in range(4):  # without a floor, R^2 is -0.1 to -307
        rng = np.random.default_rng(seed)
        z, episodes = rng.normal(size=(400, 30)), np.repeat(np.arange(20), 20)
        states = z @ rng.normal(size=(30, 1)) + rng.normal(size=(400, 1))
        z[:, 7] = np.where(episodes % 2 == 0, 1e-3, 1.0) * rng.normal(size=400)
        assert measures.probe(z, states, episodes)[0] > 0.5


def test_a_probe_leaves_out_whole_episodes():
    # Each episode has a mark of its own in the latent, and a level of its own in the state: fitting the marks
    # says nothing of other episodes. Where single observations are left out, it looks perfect.
    rng = np.random.default_rng(2)
    episodes = np.repeat(np.arange(16), 8)
    z = 3 * rng.normal(size=(16, 40))[episodes] + 0.3 * rng.normal(size=(128, 40))
    states = rng.normal(size=(16, 1))[episodes]
    assert -0.5 < measures.probe(z, states, episodes)[0] < 0.5


# Gradients


def objective(scale):
    """A loss of one draw's own: the mean latent times a number."""

    def loss(head, slow_head, latents, window, key):
        return scale * jnp.mean(latents.online(0), -1) * head["w"], {}

    return Objective(lambda key: {"w": jnp.ones(())}, loss)


def test_gradient_conflict_of_losses_whose_gradients_are_known():
    encoder = make_encoder()
    terms = {RL: objective(2.0), "same": objective(1.0), "against": objective(-6.0)}
    params = {
        "encoder": random_params(encoder.init),
        **{name: {"w": np.float32(1)} for name in terms},
    }
    slow = {}
    state = TrainState(params, slow, None, np.int32(0), jax.random.key(0))
    hyper = Hyper({RL: np.float32(1), "same": np.float32(4), "against": np.float32(1)}, {})
    # In mode decoupled RL's gradient does not enter the encoder; this is the one that it would be.
    for mode in ("joint", "decoupled"):
        conflict = jit(make_conflict(encoder, terms, MODES[mode]))
        found = {
            name: [float(x) for x in pair] for name, pair in conflict(state, make_window(), hyper).items()
        }
        assert found == {"same": pytest.approx([1, 2]), "against": pytest.approx([-1, 3])}


def test_an_image_of_two_latents_is_left_out_and_told():
    encoder = make_encoder()
    decoder = encoder.make_decoder()

    def later(head, latents, window):
        return latents.online(1), decoder.apply(head, latents.online(0))

    terms = {"one": objective(1.0)._replace(image=later, horizon=1)}
    functions = make_functions(encoder, terms, MODES["pretrain"], channels=1)
    assert functions.decode == {} and functions.others == ("one",) and functions.conflict is None


# Held-out observations


def test_held_out_observations_are_the_games_and_know_its_state():
    config = Config(**{**SMALL, "seed": 5, "num_envs": 2})
    held_out = heldout.collect(config, 3)
    frames = held_out.windows.frames
    assert frames.shape == (heldout.WINDOWS, 7, 42, 42, 1) and not held_out.problem
    assert held_out.variables == ("ball_x", "ball_y", "ball_velocity_x", "ball_velocity_y", "paddle_x")
    # The same ones for another seed, another arm and another horizon.
    other = heldout.collect(Config(**{**SMALL, "seed": 6, "gamma": 0.5}), 1)
    np.testing.assert_array_equal(held_out.observations, other.observations)
    np.testing.assert_array_equal(held_out.states, other.states)
    assert len(set(held_out.episodes)) > 100 and (held_out.windows.valid[:, 0] == 1).all()
    # The ball is where the state says: its centre is bright in the newest frame.
    x, y = (held_out.states[:, i].astype(int) // 2 for i in (0, 1))
    assert (held_out.observations[np.arange(len(x)), -1, y, x] > 60).all()
    # And it moves as the state says, but for bounces.
    nexts = heldout.collect(Config(**SMALL), 1).windows
    assert np.array_equal(nexts.frames[:, 3], held_out.observations[:, -1])


@pytest.mark.parametrize("horizon", [7, 60])
def test_held_out_windows_may_reach_far(horizon):
    config = Config(**SMALL)
    near, far = heldout.collect(config, 3), heldout.collect(config, horizon)
    assert far.windows.frames.shape == (heldout.WINDOWS, 4 + horizon, 42, 42, 1)
    assert far.windows.valid.shape == (heldout.WINDOWS, horizon)
    # The same observations, and windows that go on where shorter ones end.
    np.testing.assert_array_equal(far.states, near.states)
    np.testing.assert_array_equal(far.episodes, near.episodes)
    np.testing.assert_array_equal(far.windows.frames[:, :7], near.windows.frames)
    for name in ("actions", "rewards", "discounts", "valid"):
        np.testing.assert_array_equal(getattr(far.windows, name)[:, :3], getattr(near.windows, name))


@pytest.mark.parametrize(
    ("game", "horizon", "sha256"),
    [
        ("Catch", 1, "46585e8483e86271"),
        ("Catch", 3, "6ddf0b23c83d56e5"),
        ("Pong", 3, "2609b23b597fc8ad"),
    ],
)
def test_held_out_observations_are_those_of_runs_before(game, horizon, sha256):
    # Recorded before windows could reach further than six steps: diagnostics of older runs compare with ours.
    if game == "Pong":
        pytest.importorskip("ale_py")
    held_out = heldout.collect(Config(game=game), horizon)
    digest = hashlib.sha256()
    windows = held_out.windows._replace(frames=held_out.windows.frames[..., 0])  # frames had no channels
    assert windows.n_step is None
    for array in (*windows[:-1], held_out.states, held_out.episodes):
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    assert digest.hexdigest()[:16] == sha256


def test_a_generator_of_ones_own_leaves_replays_alone():
    replay = Replay(capacity=100, num_streams=1, frame_shape=(2, 2, 1), horizon=1, seed=3)
    replay.begin(np.zeros((1, 2, 2, 1), np.uint8))
    no = np.zeros(1, bool)
    for i in range(30):
        replay.add(np.array([i]), np.zeros(1), no, no, no, np.full((1, 2, 2, 1), i, np.uint8))
    before = json.dumps(replay.rng.bit_generator.state)
    first, second = (replay.sample(8, 0.4, np.random.default_rng(1))[1] for _ in range(2))
    assert np.array_equal(first, second) and json.dumps(replay.rng.bit_generator.state) == before
    assert not np.array_equal(first, replay.sample(8, 0.4)[1])


# A run's


def test_a_kept_encoder_that_is_damaged_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    config = Config(**{**SMALL, "diagnostics": True, "eval_every": 60})
    lines = []
    encode = lambda params, frames: frames[:, -1, ::8, ::8].reshape(len(frames), -1) * params["w"]  # noqa: E731
    functions = SimpleNamespace(encode=encode, decode={}, groups=("encoder",), others=(), conflict=None)
    params = {"encoder": {"w": np.float32(0.5)}}
    state = TrainState(params, {}, None, np.int32(0), None)

    def make():
        return Diagnostics(config, functions, 1, tmp_path, lines.append)

    first = make()
    assert first.steps == (0, 60, 120, 180)
    for step in (0, 60):
        values = first.measure(state, step, None, 1.0, None)
        keep(tmp_path, first.parts(params), config, step)
    assert values["diag/drift/steps"] == [0] and values["diag/drift/cka"] == [pytest.approx(1)]
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    expected = first.measure(state, 120, None, 1.0, None)
    again = make().measure(state, 120, None, 1.0, None)
    assert {**again, "wall_diag_s": 0} == {**expected, "wall_diag_s": 0} and not lines
    path = tmp_path / "encoders" / "000000000" / "params.msgpack"
    path.write_bytes(path.read_bytes()[:-1])
    values = make().measure(state, 120, None, 1.0, None)
    assert values["diag/drift/steps"] == [60] and len(values["diag/drift/cosine"]) == 1
    assert len(lines) == 1 and lines[0].startswith(
        f"drift is measured without the encoder of 0 env steps: {path}"
    )


# Pictures


@pytest.mark.skipif(not plots.available(), reason="needs the extra plots")
def test_drift_is_drawn_as_a_matrix_and_numbers_as_curves(tmp_path, monkeypatch):
    figures = []
    save = plots.save
    monkeypatch.setattr(plots, "save", lambda f, path: figures.append(f) or save(f, path))
    rows = rows_of([0, 10, 20])
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    written = run_figures.draw_run(tmp_path, Config())
    assert {path.name for path in written} == {"diagnostics.png", "drift.png"}
    (shown,) = figures[1].axes[0].images
    np.testing.assert_allclose(shown.get_array(), drift_matrix(rows, "x")[1])
    (line,) = figures[0].axes[0].lines
    assert line.get_xydata().tolist() == [[0, 2], [10, 2], [20, 2], [30, 2]]
    rows[3]["diag/drift/steps"].pop()
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    with pytest.raises(ConfigError, match="metrics.jsonl: drift of x after 30 env steps"):
        run_figures.draw_run(tmp_path, Config())


# Atari


@pytest.mark.parametrize(("sticky_actions", "full_actions"), [(0.0, False), (0.25, True)])
def test_the_emulator_whose_memory_is_read_is_in_step(sticky_actions, full_actions):
    pytest.importorskip("ale_py")
    from srl_jax.envs.ram import OutOfStep, Twin

    options = {"sticky_actions": sticky_actions, "full_actions": full_actions}
    env = envs.make("Pong", num_envs=1, seed=0, reseed_every=120, **options)
    assert env.single_action_space.n == (18 if full_actions else 6)
    twin = Twin("Pong", noop_max=30, **options)
    rng = np.random.default_rng(0)
    for _ in range(3):  # the third of them has another seed
        frames, info = env.reset()
        twin.reset(int(env.ale_seeds[0]) if env.steps_since_seeded[0] == 0 else None)
        for _ in range(70):
            twin.check(frames[0, :, :, 0], int(info["frame_number"][0]), int(info["lives"][0]))
            action = rng.integers(env.single_action_space.n, size=1)
            frames, *_, info = env.step(action)
            twin.step(int(action[0]), look=True)
    wrong = frames[0, :, :, 0].copy()
    wrong[40, 40] += 5
    with pytest.raises(OutOfStep, match="a pixel differs by"):
        twin.check(wrong, int(info["frame_number"][0]), int(info["lives"][0]))
    with pytest.raises(OutOfStep, match="frame number"):
        twin.check(frames[0, :, :, 0], int(info["frame_number"][0]) - 4, int(info["lives"][0]))
    env.close()


def test_a_state_is_known_until_an_emulator_is_out_of_step():
    pytest.importorskip("ale_py")
    options = {"num_envs": 2, "seed": 0, "frame_size": 42, "noop_max": 0}
    env, plain = envs.make("Pong", with_state=True, **options), envs.make("Pong", **options)
    frames, info = env.reset()
    np.testing.assert_array_equal(frames, plain.reset()[0])
    assert "state" not in plain.reset()[1] and plain.state_names == ()
    for _ in range(4):
        frames, *_, info = env.step(np.array([2, 3]))
    names = env.state_names
    assert len(names) == 6 and info["state"].shape == (2, 6) and not env.state_problem
    assert info["state"][0, names.index("player_y")] != info["state"][1, names.index("player_y")]
    env._twins[1].step(0, look=False)  # it is ahead now
    for _ in range(2):  # each is compared at its turn
        *_, info = env.step(np.array([2, 3]))
    assert env.state_names == () and "out of step: frame number" in env.state_problem
    assert info["state"].shape == (2, 6)
    unlabelled = envs.make("Zaxxon", with_state=True, **options)
    assert unlabelled.reset()[1]["state"].shape == (2, 0)
    assert unlabelled.state_names == () and not unlabelled.state_problem


def test_a_state_that_is_lost_is_not_probed(monkeypatch):
    def lost(game, **options):
        env = made(game, **options)
        env.state_names, env.state_problem = (), "out of step"
        return env

    made = envs.make
    monkeypatch.setattr(envs, "make", lost)
    monkeypatch.setattr(heldout, "WINDOWS", 40)
    held_out = heldout.collect(Config(**SMALL), 1)
    assert (held_out.variables, held_out.problem) == ((), "out of step")
    assert held_out.states.shape == (40, 0)


def test_labelled_bytes_hold_what_is_seen(monkeypatch):
    pytest.importorskip("ale_py")
    monkeypatch.setattr(heldout, "WINDOWS", 96)
    held_out = heldout.collect(Config(game="Pong"), 1)
    assert held_out.variables == ("player_y", "player_x", "enemy_y", "enemy_x", "ball_x", "ball_y")
    assert not held_out.problem
    # Our paddle, bright in column 75 or so of 84, is as far down as its byte says.
    column = held_out.observations[:, -1, 14:78, 72:78, 0].max(2)
    seen = column > 140
    there = seen.sum(1) >= 4
    middle = (seen * np.arange(64)).sum(1)[there] / seen.sum(1)[there]
    assert there.mean() > 0.8
    assert np.corrcoef(middle, held_out.states[there, 0])[0, 1] > 0.95


def test_a_decoder_that_is_damaged_later_has_no_errors(tmp_path, monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    config = Config(**{**SMALL, "diagnostics": True, "eval_every": 60})
    lines = []

    def decode(params, z, window):  # the errors are the decoder's number, whatever the latent
        image = np.zeros((len(z), 2, 2, 2, 1), np.float32)
        return np.full(len(z), params["x"]["w"]), image, image

    encode = lambda params, frames: frames[:, -1, ::8, ::8].reshape(len(frames), -1) * params["w"]  # noqa: E731
    groups = "encoder", "x"
    functions = SimpleNamespace(encode=encode, decode={"x": decode}, groups=groups, others=(), conflict=None)
    diagnostics = Diagnostics(config, functions, 1, tmp_path, lines.append)

    def measure(step):
        params = {"encoder": {"w": np.float32(0.5)}, "x": {"w": np.float32(step)}}
        values = diagnostics.measure(TrainState(params, {}, None, np.int32(0), None), step, None, 1.0, None)
        keep(tmp_path, diagnostics.parts(params), config, step)
        return [values[f"diag/{which}/x"] for which in ("decoder_now", "encoder_now")]

    assert measure(0) == [[0.0], []]
    assert measure(60) == [[60.0, 60.0], [0.0]]
    # That of 0 was read before, so its latents are known; its decoder is not any more.
    path = tmp_path / "encoders" / "000000000" / "params.msgpack"
    path.write_bytes(path.read_bytes()[:-1])
    assert measure(120) == [[120.0] * 3, [None, 60.0]] and len(lines) == 1
    assert measure(180) == [[180.0] * 3, [60.0, 120.0]] and len(lines) == 1
