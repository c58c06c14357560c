"""Tests of experiments.reporting.gallery."""

from pathlib import Path

import numpy as np
import pytest

from experiments.runs.collect import RunData
from srl_jax.config import Config
from srl_jax.errors import ConfigError

gallery = pytest.importorskip("experiments.reporting.gallery", reason="needs the extra plots")


@pytest.mark.parametrize("seeds, narrow", [(4, True), (5, False)])
def test_bands_of_few_runs_are_called_too_narrow(monkeypatch, seeds, narrow):
    told = []
    monkeypatch.setattr(gallery.pictures, "curves", lambda *_, across, **__: told.append(across))
    ends = {"rl": {"at_the_end": np.linspace(-1, 1, seeds)}}
    comparison = gallery.numbers.Comparison(100, ends, {}, None)
    (shown,) = gallery.profiles({"Catch": comparison}, {"rl": ("#000000", "-")}, None)
    assert shown.arms == ["rl"] * seeds
    assert [("too narrow" in text) for text in told] == [narrow]


def test_what_an_objective_of_ones_own_says_is_drawn_with_its_loss(monkeypatch):
    monkeypatch.setattr(gallery.pictures, "curves", lambda title, *_, **__: title)
    config = Config(game="Catch", mode="joint", objectives=("mine:weight=2", "inverse"))
    rows = [
        {"kind": "train", "env_steps": step, "loss/mine": 1.0, "mine/share": 0.5, "replay/transitions": step}
        for step in (100, 200)
    ]
    runs = [RunData("", "Catch", "a", 0, config, rows)]
    prefixes = gallery.of_losses(runs)
    assert prefixes == ["inverse/", "mine/", "rl/"]
    shown = gallery.measured(runs, ["loss/", *prefixes], {"a": ("#000000", "-")})
    assert [picture.picture for picture in shown] == ["loss: mine", "mine/share"]


@pytest.mark.parametrize("value", ["x", ["x"], [[1.0]], [1e39]])
def test_what_is_no_number_is_named(value):
    rows = [{"kind": "train", "env_steps": 100, "rl/q_max_mean": value}]
    runs = [RunData(Path("runs/a"), "Catch", "a", 0, Config(game="Catch"), rows)]
    with pytest.raises(ConfigError, match="^runs/a/metrics.jsonl: rl/q_max_mean is not a number of single"):
        gallery.measured(runs, ["rl/"], {"a": ("#000000", "-")})
