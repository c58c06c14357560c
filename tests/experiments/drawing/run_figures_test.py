"""Tests of experiments.drawing.run_figures."""

import json

import numpy as np
import pytest

from experiments.drawing import run_figures
from srl_jax.config import Config
from srl_jax.errors import ConfigError

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


def eval_row(steps, returns):
    mean = float(np.mean(returns))
    return {"kind": "eval", "env_steps": steps, "eval/return_mean": mean, "eval/returns": list(returns)}


def test_learning_curve_draws_means_the_band_of_games_and_the_thesis_at_equal_steps(tmp_path, drawn):
    rows = [eval_row(0, [-21.0, -20.0]), eval_row(150_000, [-19.0, -11.0]), {"kind": "train"}]
    path = tmp_path / "curve.png"
    config = Config(game="Pong", sticky_actions=0.0)
    assert run_figures.learning_curve(rows, path, "x", config, "6.1/rl_only_nature") == path
    (axes,) = drawn[0].axes
    lines = {line.get_linestyle(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["-"] == [[0, -20.5], [150_000, -15]]
    # The thesis has -21 at 0, -19.8 at 100,000, -20.7 at 200,000; half-way between: -20.25.
    np.testing.assert_allclose(lines["--"], [[0, -21], [100_000, -19.8], [150_000, -20.25]])
    band = axes.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (-21, -11)
    assert axes.get_ylim()[1] > -11  # shown whole
    assert [text.get_text() for text in axes.texts] == ["random policy", "no-op policy"]
    told = drawn[0].legends[0].get_title().get_text()
    assert told.startswith("band: worst to best of 2 games; dashed: the thesis, figure 6.1, rl_only_nature")


def test_what_the_thesis_does_not_have_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="--thesis=6.2/joint_50: .*valid: rl_only_nature, rl_only_256_aug"):
        run_figures.learning_curve([], tmp_path / "x.png", "x", Config(game="Pong"), "6.2/joint_50")


def test_nothing_to_draw_writes_nothing_and_one_evaluation_is_enough(tmp_path):
    config = Config(game="Pong")
    assert run_figures.learning_curve([{"kind": "train"}], tmp_path / "a.png", "x", config) is None
    assert run_figures.numbers([eval_row(0, [1.0])], ("loss",), tmp_path / "b.png", "x") is None
    assert not list(tmp_path.iterdir())
    null = {"kind": "eval", "env_steps": 0, "eval/return_mean": None}
    for row in (eval_row(0, [1.0]), null):
        assert run_figures.learning_curve([row], tmp_path / "c.png", "x", Config(game="x:y")).exists()


def test_each_loss_has_a_panel_and_the_mean_of_many_values_a_band(tmp_path, drawn):
    rows = [
        {
            "kind": "train",
            "env_steps": step,
            "loss/falls": 0.9**step,
            "loss/signed": float((-1) ** step),
            "loss/diverged": None,
            "grad_norm": 1.0 + step / 200,
            "epsilon": 0.1,
        }
        for step in range(100)
    ]
    run_figures.numbers(rows, ("loss", "grad_norm"), tmp_path / "losses.png", "x")
    scales = {axes.get_title(): axes.get_yscale() for axes in drawn[0].axes}
    assert scales == {"loss/falls": "log", "loss/signed": "linear", "grad_norm": "linear"}
    (line,) = drawn[0].axes[1].lines  # means of four, of which two are 1 and two are -1
    np.testing.assert_allclose(line.get_xydata()[[0, -1]], [[1.5, 0], [97.5, 0]], atol=1e-12)
    band = drawn[0].axes[1].collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (-1, 1)


def test_objectives_and_variables_share_a_panel_and_many_become_their_mean(tmp_path, drawn):
    row = {"kind": "eval", "env_steps": 5, "diag/rank": 3, "diag/gradient/a/cosine": 0.5}
    row |= {"diag/gradient/b/cosine": 0.1, "diag/drift/cka": [0.3, 0.6], "diag/drift/steps": [0, 1]}
    row |= {f"diag/probe/{name}": 0.5 for name in ["mean", *"abcdefghi"]}
    run_figures.numbers([row], ("diag",), tmp_path / "x.png", "x")
    shown = {axes.get_title(): [line.get_ydata()[0] for line in axes.lines] for axes in drawn[0].axes}
    assert shown == {
        "diag/drift/*": [0.3, 0.6],
        "diag/gradient/*/cosine": [0.5, 0.1],
        "diag/probe/*": [0.5],
        "diag/rank": [3],
    }
    told = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert told == ["cka, first kept", "cka, last kept", "a", "b", "mean", "this run"]


@pytest.mark.parametrize("size, scale", [(42, 2), (84, 1), (200, 1)])
def test_a_recording_becomes_a_gif_of_the_same_size(tmp_path, size, scale):
    (tmp_path / "metrics.jsonl").touch()
    frames = np.zeros((3, size, size, 1), np.uint8)
    frames[1, 5] = 255
    (path,) = run_figures.draw_run(tmp_path, Config(), recording=frames)
    with Image.open(path) as image:
        assert path.name == "play.gif" and image.n_frames == 3 and image.size == (scale * size,) * 2


def test_names_are_drawn_as_they_are(tmp_path):
    # Between dollar signs, matplotlib would read TeX.
    rows = [{"kind": "train", "env_steps": 5, "loss/$\\frac$": 1.0}, eval_row(5, [1.0])]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    written = run_figures.draw_run(tmp_path, Config(encoder="$\\frac$"))
    assert [path.name for path in written] == ["learning_curve.png", "losses.png"]
