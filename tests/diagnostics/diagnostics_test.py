"""srl_jax/diagnostics: drift, gradients that are known, held-out observations, and what a run keeps."""

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
from srl_jax.diagnostics import heldout
from srl_jax.diagnostics.drift import drift_matrix
from srl_jax.diagnostics.functions import make_conflict, make_functions
from srl_jax.diagnostics.run import Diagnostics, kept_steps
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.learning.modes import MODES
from srl_jax.learning.optim import RL
from srl_jax.learning.update import Hyper
from srl_jax.replay import Replay
from srl_jax.types import Objective, TrainState
from srl_jax.window import observation
from tests.helpers import SMALL, make_encoder, make_window, random_params


def keep(path, parts, config, step):
    """Writes what diagnostics keep of an epoch, as a run does."""
    counts = {"num_actions": 3, "env_steps": step, "updates": 0}
    checkpoint.save(path, parts, config, frame_shape=(42, 42, 1), keep=0, folder="encoders", **counts)


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
        conflict = jax.jit(make_conflict(encoder, terms, MODES[mode]))
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


@pytest.mark.parametrize("after", [0, 20])
def test_a_state_that_is_lost_is_not_probed(monkeypatch, after):
    def lost(game, **options):
        env, steps = made(game, **options), 0
        step = env.step

        def counted(actions):
            nonlocal steps
            if steps == after:
                env.state_names, env.state_problem = (), "out of step"
            steps += 1
            return step(actions)

        env.step = counted
        return env

    made = envs.make
    monkeypatch.setattr(envs, "make", lost)
    monkeypatch.setattr(heldout, "WINDOWS", 40)
    heldout._collect.cache_clear()
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
    assert values["diag/drift/centred_cosine"] == [pytest.approx(1)]
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


def test_a_row_is_decoded_as_far_as_its_episode_goes():
    encoder = make_encoder()
    decoder = encoder.make_decoder()
    term = objective(1.0)._replace(
        image=lambda head, latents, window: (observation(window, 2), decoder.apply(head, latents.online(0))),
        init=decoder.init,
        horizon=2,
    )
    decode = make_functions(encoder, {"x": term}, MODES["pretrain"], channels=1).decode["x"]
    params = {"encoder": encoder.init(jax.random.key(0)), "x": decoder.init(jax.random.key(1))}
    window = make_window(horizon=2, size=encoder.observation_shape[0])
    window.valid[1, 1] = window.valid[2] = 0
    valid, errors, *_ = decode(params, np.zeros((len(window.valid), encoder.features), np.float32), window)
    assert valid.tolist() == [True, False, False, True] and errors.shape == (4,)


def test_a_decoder_that_is_damaged_later_has_no_errors(tmp_path, monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    config = Config(**{**SMALL, "diagnostics": True, "eval_every": 60})
    lines = []

    def decode(params, z, window):  # the errors are the decoder's number, whatever the latent
        image = np.zeros((len(z), 2, 2, 2, 1), np.float32)
        valid = np.arange(len(z)) % 3 > 0  # what is behind an episode's end does not count
        return valid, np.where(valid, params["x"]["w"], 1e6), image, image

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
