"""Runs that start from what another run has learnt: its encoder, its heads, its policy."""

import numpy as np
import pytest

from srl_jax import training
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics
from tests.helpers import JOINT, SMALL, identical, one_run, whole, write_checkpoint
from tests.run.loop_test import train

pytestmark = pytest.mark.usefixtures("shared_agents")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A joint run that has ended."""
    path = tmp_path_factory.mktemp("runs") / "joint"
    write_checkpoint(path, **JOINT)
    return path


@pytest.mark.parametrize("mode", ["frozen", "finetuned", "joint", "decoupled"])
def test_starting_from_an_encoder(source, tmp_path, mode):
    values = {"objectives": JOINT["objectives"]} if mode in ("joint", "decoupled") else {}
    # No update happens before 200 env steps, so the encoder written at 120 is the one it began with.
    run = tmp_path / mode
    train(run, mode=mode, encoder_from=str(source), learn_start=200, **values)
    started = checkpoint.load(checkpoint.read_manifest(run / "checkpoints" / "000000120"))["encoder"]
    given = checkpoint.load(checkpoint.read_manifest(source))["encoder"]
    ended = checkpoint.load(checkpoint.read_manifest(run))["encoder"]

    def same(a, b):
        return all(np.array_equal(a[layer][name], b[layer][name]) for layer in given for name in given[layer])

    assert same(given, started)
    assert same(given, ended) == (mode == "frozen")


def test_pretraining_on_a_given_policy_and_on_a_random_one(source, tmp_path):
    train(tmp_path / "random", mode="pretrain", objectives=("inverse",))
    train(tmp_path / "given", mode="pretrain", objectives=("inverse",), policy_from=str(source))
    rows = [read_metrics(tmp_path / name / "metrics.jsonl") for name in ("random", "given")]
    for mode_rows in rows:
        assert {row["kind"] for row in mode_rows} == {"train"}
        assert "loss/inverse" in mode_rows[-1] and "loss/rl" not in mode_rows[-1]
    assert [rows[0][-1]["epsilon"], rows[1][-1]["epsilon"]] == [1.0, 0.3]
    # Such a run starts another one, but has no policy to give.
    train(tmp_path / "frozen", mode="frozen", encoder_from=str(tmp_path / "random"))
    config = Config(**SMALL, mode="pretrain", objectives=("inverse",), policy_from=str(tmp_path / "random"))
    with pytest.raises(ConfigError, match="has no policy"):
        training.check_sources(config)


def test_an_encoder_that_does_not_fit_is_refused(source):
    for field, value in (("encoder", "tiny:features=16"), ("frame_size", 84), ("frame_stack", 2)):
        config = Config(**{**SMALL, "mode": "frozen", "encoder_from": str(source), field: value})
        with pytest.raises(ConfigError, match=f"{field} is .* there and .* here"):
            training.check_sources(config)


def started(tmp_path, **values):
    """The parameters that a run begins with."""
    run = one_run(Config(**{**SMALL, **values}), tmp_path)
    with run:
        return run.state.params


def test_heads_that_both_runs_have_start_from_the_other_run_as_asked(source, tmp_path):
    theirs = checkpoint.load(whole(source))
    objectives = ("reconstruction", "inverse")
    scratch = started(tmp_path, mode="joint", objectives=objectives, seed=9)
    for heads_from, taken in (
        ("representation", {"encoder", "reconstruction"}),
        ("all", {"encoder", "reconstruction", "rl"}),
        ("none", {"encoder"}),
    ):
        how = {"encoder_from": str(source), "heads_from": heads_from}
        params = started(tmp_path, mode="joint", objectives=objectives, seed=9, **how)
        for name in ("encoder", "rl", *objectives):
            assert identical(params[name], theirs[name] if name in taken else scratch[name]), name


def test_a_head_that_does_not_fit_is_named_with_a_way_out(source, tmp_path):
    other = {"rl": "rainbow:hidden=8,atoms=11,v_min=-2,v_max=2", "mode": "finetuned"}
    with pytest.raises(
        ConfigError, match="--heads_from=none starts from the encoder alone.*.rl..*not float32"
    ):
        started(tmp_path, encoder_from=str(source), heads_from="all", **other)
    started(tmp_path, encoder_from=str(source), **other)
