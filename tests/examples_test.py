"""The examples do what they say."""

import gymnasium
import numpy as np
import pytest
from absl import flags
from gymnasium.utils.env_checker import check_env

from examples.own_environment import Dot
from experiments import flags as config_flags
from experiments import train
from srl_jax import envs
from srl_jax.config import Config
from srl_jax.diagnostics import heldout
from srl_jax.metrics import read_metrics

GAME = "examples.own_environment:Dot-v0"


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # what gymnasium's checker recommends
def test_the_environment_keeps_gymnasiums_promises():
    check_env(gymnasium.make("Dot-v0", disable_env_checker=True).unwrapped, skip_render_check=True)
    envs.game(GAME).check()


def test_its_state_is_what_is_seen(monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    held_out = heldout.collect(Config(game=f"{GAME},grey=true", frame_size=64), 1)
    assert held_out.variables == Dot.state_names and not held_out.problem
    # Green is of brightness 150, red of 76; the dot is drawn over the place.
    frames = held_out.observations[:, -1].reshape(64, 64, 64)[:, ::4, ::4]
    for frame, state in zip(frames, held_out.states.astype(int), strict=True):
        dot, place = tuple(state[:2]), tuple(state[2:])
        assert frame[dot] == 76 and (frame[place] == 150 or dot == place)
        assert (frame > 0).sum() == len({dot, place})


@pytest.mark.parametrize("options", ["", ",grey=true"])
def test_an_environment_of_ones_own_is_trained(options, tmp_path, monkeypatch):
    monkeypatch.setattr(heldout, "WINDOWS", 64)
    small = {"steps": 240, "eval_every": 120, "log_every": 40, "eval_games": 2, "eval_max_steps": 100}
    small |= {"buffer_size": 400, "learn_start": 40, "num_envs": 4, "batch_size": 8, "frame_size": 42}
    small |= {"rl": "rainbow:hidden=16,atoms=11", "encoder": "tiny:features=8", "out": tmp_path / "run"}
    small |= {"mode": "joint", "objective": "reconstruction"}
    values = flags.FlagValues()
    train.define_flags(values)
    arguments = [f"--{name}={value}" for name, value in small.items()]
    config_flags.parse(["train", f"--game={GAME}{options}", *arguments], values)
    assert train.train(values) == 0
    config = Config.load(tmp_path / "run")
    assert config.game == envs.canonical(f"{GAME}{options}")
    last = [row for row in read_metrics(tmp_path / "run/metrics.jsonl") if row["kind"] == "eval"][-1]
    assert last["env_steps"] == 240 and np.isfinite(last["eval/return_mean"])
    assert {f"diag/probe/{name}" for name in Dot.state_names} <= set(last)
    assert list((tmp_path / "run/figures").glob("*.png"))
