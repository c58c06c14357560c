"""The examples do what they say."""

import pathlib
import re
import shlex

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from examples import foreign_loop, own_objective, use_an_encoder
from examples.own_environment import Dot
from experiments import train
from srl_jax import encoders, envs
from srl_jax.config import Config
from srl_jax.diagnostics import heldout, run
from srl_jax.files.metrics import read_metrics
from srl_jax.types import Latents
from tests.helpers import make_context, make_window
from tests.in_process import parse

pytestmark = pytest.mark.usefixtures("shared_agents")
GAME = "examples.own_environment:Dot-v0"
SMALL = {"steps": 240, "eval_every": 120, "log_every": 40, "eval_games": 2, "eval_max_steps": 100}
SMALL |= {"buffer_size": 400, "learn_start": 40, "num_envs": 4, "batch_size": 8, "frame_size": 42}
SMALL |= {"rl": "dqn:hidden=16", "encoder": "tiny:features=8"}


@pytest.fixture(scope="module")
def own_encoder():
    """The example, whose row other tests of the registry do not see."""
    from examples import own_encoder

    yield own_encoder
    del encoders.REGISTRY["two_layers"]


@pytest.fixture
def few_held_out(monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    monkeypatch.setattr(run, "DECODED", 8)


def trained(*arguments):
    """Trains a small run as the command line does."""
    given = {argument.partition("=")[0] for argument in arguments}
    small = [f"--{name}={value}" for name, value in SMALL.items() if f"--{name}" not in given]
    assert train.train(parse(train, *arguments, *small)) == 0


def command(example, out):
    """The arguments of the command in an example's docstring, less its preset and `out`."""
    text = example.__doc__.split("\n\n")[1].replace("\\\n", " ")
    program, name, *arguments = shlex.split(text)
    assert (program, name, arguments.pop()) == ("srl-jax", "train", f"--out={out}")
    arguments.remove("--preset=catch/joint")
    return arguments


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # what gymnasium's checker recommends
def test_the_environment_keeps_gymnasiums_promises():
    check_env(gymnasium.make("Dot-v0", disable_env_checker=True).unwrapped, skip_render_check=True)
    envs.game(GAME).check()


def test_its_state_is_what_is_seen(few_held_out):
    held_out = heldout.collect(Config(game=f"{GAME},grey=true", frame_size=64), 1)
    assert held_out.variables == Dot.state_names and not held_out.problem
    # Green is of brightness 150, red of 76; the dot is drawn over the place.
    frames = held_out.observations[:, -1].reshape(64, 64, 64)[:, ::4, ::4]
    for frame, state in zip(frames, held_out.states.astype(int), strict=True):
        dot, place = tuple(state[:2]), tuple(state[2:])
        assert frame[dot] == 76 and (frame[place] == 150 or dot == place)
        assert (frame > 0).sum() == len({dot, place})


def test_an_environment_of_ones_own_is_trained(tmp_path, few_held_out):
    trained(f"--game={GAME}", "--mode=joint", "--objective=reconstruction", f"--out={tmp_path / 'run'}")
    config = Config.load(tmp_path / "run")
    assert config.game == envs.canonical(GAME)
    last = [row for row in read_metrics(tmp_path / "run/metrics.jsonl") if row["kind"] == "eval"][-1]
    assert last["env_steps"] == 240 and np.isfinite(last["eval/return_mean"])
    assert {f"diag/probe/{name}" for name in Dot.state_names} <= set(last)
    assert list((tmp_path / "run/figures").glob("*.png"))


def test_an_own_objective_and_encoder_are_trained_as_they_say(tmp_path, few_held_out, own_encoder):
    path = tmp_path / "run"
    own = [*command(own_objective, "runs/slow"), *command(own_encoder, "runs/two_layers")]
    trained(*own, "--preset=catch/joint", f"--out={path}")
    assert Config.load(path).encoder == "two_layers:features=32"
    assert "continuity:weight=0.01" in Config.load(path).objectives
    rows = read_metrics(path / "metrics.jsonl")
    last = {kind: [row for row in rows if row["kind"] == kind][-1] for kind in ("train", "eval")}
    assert last["train"]["loss/continuity"] > 0 and "diag/gradient/continuity/cosine" in last["eval"]
    # Its own line imports what the run is made of, and the head learns over an encoder that stays as it is.
    before, after = use_an_encoder.main(str(path), updates=30)
    assert 0 < after < 0.7 * before


def test_continuity_is_the_squared_step_of_the_latent_within_an_episode():
    window = make_window(batch=3)._replace(valid=np.float32([[1, 1, 1], [0, 0, 0], [1, 0, 0]]))
    z = np.float32([[[0, 0], [1, 1], [2, 0]], [[3, 4], [5, 5], [2, 0]]])  # offsets 0 and 1
    objective = own_objective.continuity(make_context())
    latents = Latents(lambda k: z[k], None)
    losses, metrics = objective.loss({}, {}, latents, window, None)
    assert losses.tolist() == [25.0, 0.0, 0.0] and metrics == {}


def test_the_foreign_loop_plays_and_learns_with_one_import():
    returns = foreign_loop.main(400)
    assert len(returns) >= 8 and set(returns) == {-1.0, 1.0}
    keys = jax.random.split(jax.random.key(0), 3)
    params = {"encoder": foreign_loop.encoder.init(keys[0]), "inverse": foreign_loop.inverse.init(keys[1])}
    params["head"] = 0.1 * jax.random.normal(keys[2], (64, 3 * 31))
    slow, opt_state, errors = params, foreign_loop.optimizer.init(params), []
    for _ in range(30):
        params, opt_state, td_error = foreign_loop.learn(
            params, slow, opt_state, make_window(batch=64, size=42)
        )
        errors.append(float(td_error.mean()))
    assert errors[-1] < errors[0] - 0.2
    text = pathlib.Path(foreign_loop.__file__).read_text(encoding="utf-8")
    assert len(re.findall("^ *(?:from|import) srl_jax", text, re.MULTILINE)) == 1


@pytest.mark.parametrize("side", [42, 84])
def test_an_own_encoder_fits_what_it_encodes(own_encoder, side):
    shape = (side, side, 4)
    encoder = own_encoder.two_layers(shape, features=8)
    frames = np.arange(2 * np.prod(shape)).reshape(2, *shape).astype(np.uint8)
    params, decoder = encoder.init(jax.random.key(0)), encoder.make_decoder()
    of_bytes, of_floats = (encoder.apply(params, x) for x in (frames, frames / np.float32(255)))
    np.testing.assert_allclose(of_bytes, of_floats, atol=1e-5)
    assert of_bytes.shape == (2, 8)
    assert decoder.apply(decoder.init(jax.random.key(1)), of_bytes).shape == frames.shape
