"""srl_jax/training.py: a run by one call, as the command makes it."""

import dataclasses

import numpy as np
import pytest

import srl_jax
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files.metrics import read_metrics
from srl_jax.run import ending
from srl_jax.training import check_sources, completed, resolved
from tests.files.checkpoint_test import CONFIG, write
from tests.helpers import SMALL

pytestmark = pytest.mark.usefixtures("shared_agents")


def test_a_run_is_trained_into_a_new_directory_and_loaded(tmp_path):
    path = tmp_path / "runs" / "x"
    config = Config(**{**SMALL, "steps": 120, "eval_every": 60, "keep_encoder_every": 1}, loggers=("csv",))
    result = srl_jax.train(config, str(path), progress=False)
    assert (result.env_steps, result.interrupted) == (120, False)
    assert ending.read(path).status == "finished" and not (path / "lock").exists()
    # config.json has every option, as the command writes it.
    assert Config.load(path) == resolved(config) != config
    rows = read_metrics(path / "metrics.jsonl")
    assert rows[-1]["env_steps"] == 120
    assert len((path / "metrics.csv").read_text().splitlines()) == 1 + len(rows)
    loaded = srl_jax.load(path)
    assert loaded.env_steps == 120 and loaded.config == resolved(config)
    assert srl_jax.load(path / "best").act(np.zeros((2, 42, 42, 4), np.uint8)).shape == (2,)
    assert srl_jax.load(path / "encoders").env_steps == 60
    before = sorted(path.rglob("*"))
    with pytest.raises(ConfigError, match=f"^{path}: not an empty directory; name a new one"):
        srl_jax.train(config, path)
    assert sorted(path.rglob("*")) == before


@pytest.mark.parametrize(
    "values, message",
    [
        ({"mode": "frozen"}, "--encoder_from: --mode=frozen needs"),
        ({"rl": "rainboww"}, "--rl=rainboww: no 'rainboww'; did you mean rainbow"),
        ({"rl": "c51:n_step=0"}, "--rl=c51:n_step=0: n_step must be at least 1"),
        ({"loggers": ("csvv",)}, "--logger=csvv: no 'csvv'; did you mean csv"),
        ({"game": "no_module_here:Game-v0"}, "--game=no_module_here:Game-v0: "),
        ({"mode": "frozen", "encoder_from": "nowhere"}, "--encoder_from=nowhere: "),
        ({"buffer_size": 35, "learn_start": 8}, "--buffer_size=35: must be at least 36"),
    ],
)
def test_what_cannot_be_run_is_refused_and_leaves_nothing(values, message, tmp_path):
    with pytest.raises(ConfigError, match=f"^{message}"):
        srl_jax.train(Config(**{**SMALL, **values}), tmp_path / "runs" / "x", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_a_mapping_is_no_configuration(tmp_path):
    with pytest.raises(TypeError, match="^config must be a srl_jax.Config, not dict$"):
        srl_jax.train(SMALL, tmp_path / "x")


def test_a_file_is_no_place_for_a_run(tmp_path):
    (tmp_path / "x").write_text("mine")
    with pytest.raises(ConfigError, match="not an empty directory"):
        srl_jax.train(Config(**SMALL), tmp_path / "x")
    assert (tmp_path / "x").read_text() == "mine"


PRETRAIN = {"mode": "pretrain", "objectives": ("reconstruction",)}
SOURCES = {"encoder_from": {"mode": "frozen"}, "policy_from": PRETRAIN}


@pytest.mark.parametrize(
    ("flag", "change", "message"),
    [
        ("encoder_from", {}, None),
        ("encoder_from", {"seed": 6, "mode": "finetuned"}, None),
        (
            "encoder_from",
            {"encoder": "tiny:features=16"},
            "the architecture differs: encoder is tiny:features=8",
        ),
        ("encoder_from", {"encoder": "nature"}, "the architecture differs: encoder is .* and nature here"),
        ("encoder_from", {"frame_size": 84}, "the preprocessing differs: frame_size is 42 there and 84 here"),
        ("encoder_from", {"frame_stack": 3}, "the preprocessing differs: frame_stack is 4 there and 3 here"),
        ("policy_from", {"encoder": "nature"}, None),  # a policy brings its own encoder
        ("policy_from", {"game": "CatchDistractor"}, "the game differs"),
        ("policy_from", {"frame_size": 84}, "the preprocessing differs"),
        ("policy_from", {"frame_stack": 3}, "the preprocessing differs"),
    ],
)
def test_a_source_that_does_not_fit_is_refused(tmp_path, flag, change, message):
    write(tmp_path)
    config = dataclasses.replace(CONFIG, **SOURCES[flag] | change | {flag: str(tmp_path)})
    if message is None:
        check_sources(config)
    else:
        with pytest.raises(ConfigError, match=f"--{flag}={tmp_path}: {message}"):
            check_sources(config)


def test_an_encoder_of_before_there_was_an_option_has_its_default(tmp_path):
    full = completed(CONFIG).encoder
    assert full.startswith("tiny:") and "init=pytorch" in full
    write(tmp_path)  # as few options as CONFIG has
    config = dataclasses.replace(CONFIG, **SOURCES["encoder_from"], encoder_from=str(tmp_path))
    check_sources(dataclasses.replace(config, encoder=full))
    with pytest.raises(ConfigError, match=f"encoder is {CONFIG.encoder} there and tiny:features=9"):
        check_sources(dataclasses.replace(config, encoder="tiny:features=9"))


def test_a_representation_run_has_no_policy(tmp_path):
    write(tmp_path, config=dataclasses.replace(CONFIG, **PRETRAIN))
    with pytest.raises(ConfigError, match="has no policy"):
        check_sources(dataclasses.replace(CONFIG, **PRETRAIN, policy_from=str(tmp_path)))


@pytest.mark.parametrize("flag", SOURCES)
def test_a_source_that_is_not_there_is_named_with_its_flag(tmp_path, flag):
    config = dataclasses.replace(CONFIG, **{flag: str(tmp_path / "none")})
    with pytest.raises(ConfigError, match=f"--{flag}=.*none: .*no checkpoint there"):
        check_sources(config)
