"""Tests of experiments.reporting.gallery."""

import numpy as np
import pytest

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
