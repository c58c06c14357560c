"""Tests of experiments.analyses.objectives."""

import json

import pytest

from experiments import arms, packing
from experiments.analyses import objectives
from srl_jax.run.ending import Ending
from tests.helpers import write_run


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    """Areas of RL alone 0.0, 0.2, 0.4; of joint_good 1.0 more; of joint_none as RL alone, but for one."""
    monkeypatch.setattr(objectives, "SEEDS", range(3))
    monkeypatch.setattr(objectives, "GAMES", ("Catch",))
    monkeypatch.setattr(objectives, "BASELINES", {"joint": "rl_only_256", "decoupled": "frozen_random"})
    areas = {"rl_only_256": (0.0, 0.2, 0.4), "joint_good": (1.0, 1.2, 1.4), "joint_none": (0.0, 0.2, 0.5)}
    for arm, each in areas.items():
        for seed, area in enumerate(each):
            path = tmp_path / f"runs/Catch/{arm}/seed{seed}"
            run = write_run(path, (-1.0, 2 * area + 1.0), seed=seed, steps=100, ended=Ending("finished", 100))
            rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
            rows[-1] |= {"diag/probe/ball_x": 0.5, "diag/probe/ball_y": 0.25 * seed, "diag/effective_rank": 7}
            (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    out = tmp_path / "packed"
    packing.pack(tmp_path / "runs", out)
    for name, others in (("joint", ("joint_good", "joint_none")), ("decoupled", ("decoupled_good",))):
        own = [{"name": arm, "preset": "small/joint_256"} for arm in ("rl_only_256", *others)]
        (out / f"{name}.json").write_text(json.dumps({"name": name, "arms": own}))
        assert arms.read_figure(out / f"{name}.json").name == name
    return out


def test_numbers_by_hand(campaign):
    found = objectives.analyse(campaign)
    assert list(found) == ["joint"]  # no run of the other figure is there
    rows = found["joint"]["Catch"]
    good, none = rows["joint_good"], rows["joint_none"]
    # The curve is a line from -1: its mean is the middle of its ends.
    assert rows["rl_only_256"]["area"]["mean"] == pytest.approx(0.2) and "p" not in rows["rl_only_256"]
    assert good["difference"]["mean"] == pytest.approx(1.0)
    # Two standard deviations of 0.2, three runs each: t = 1 / (0.2 sqrt(2/3)) = 6.12 with 4 degrees, 2.776.
    assert good["difference"]["low"] == pytest.approx(1 - 2.776 * 0.2 * (2 / 3) ** 0.5, abs=1e-3)
    assert good["p"] == pytest.approx(0.0036, abs=1e-4) and good["significant"] and not none["significant"]
    # RL alone ends at 1.4, 2.0332 above random play; the curves of joint_good end at 3, 3.4 and 3.8.
    assert good["target"] == pytest.approx(-0.6332 + 0.9 * 2.0332)
    assert good["steps to target"] == pytest.approx(100 * (good["target"] + 1) / 4.4)
    assert (good["reached"], rows["rl_only_256"]["reached"]) == (3, 2)
    assert good["probe of the ball"] == pytest.approx(0.375) and good["effective rank"] == 7.0
    text = objectives.tables(found)
    assert "| good | 1.20 [0.70, 1.70] | **+1.00 [+0.55, +1.45]** | 0.004 |" in text
    assert text.index("| good |") < text.index("| none |")


def test_what_a_run_has_not_is_none(campaign):
    (run, *_) = packing.read(campaign)
    assert objectives.last([run], "diag/none") is None


def test_the_picture_has_a_line_an_objective(campaign, tmp_path):
    pytest.importorskip("matplotlib")
    games = objectives.analyse(campaign)["joint"]
    assert objectives.draw("joint", games, tmp_path / "x.png").stat().st_size > 1000
