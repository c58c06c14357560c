import subprocess
import sys

import numpy as np
import pytest

from experiments import plots
from srl_jax.data import thesis_curve

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


@pytest.fixture
def drawn(monkeypatch):
    """The figures that the functions under test saved, to look at their parts."""
    figures = []
    save = plots.save

    def keep(figure, path):
        figures.append(figure)
        return save(figure, path)

    monkeypatch.setattr(plots, "save", keep)
    return figures


def eval_row(steps, returns):
    mean = float(np.mean(returns))
    return {
        "kind": "eval",
        "env_steps": steps,
        "eval/return_mean": mean,
        "eval/returns": list(returns),
    }


def is_small_png(path):
    with Image.open(path) as image:
        return image.format == "PNG" and path.stat().st_size < 150_000


def test_learning_curve_draws_means_and_cuts_the_reference_at_equal_steps(tmp_path, drawn):
    rows = [eval_row(0, [-21.0, -20.0]), eval_row(150_000, [-19.0, -11.0]), {"kind": "train"}]
    reference = [("thesis", *thesis_curve("6.1", "Pong", "rl_only_nature"))]
    path = plots.learning_curve(rows, tmp_path / "a" / "curve.png", "Pong", reference)
    assert is_small_png(path)
    (axes,) = drawn[0].axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["this run"] == [[0, -20.5], [150_000, -15]]
    # The thesis has -21 at 0, -19.8 at 100,000, -20.7 at 200,000; half-way between: -20.25.
    np.testing.assert_allclose(lines["thesis"], [[0, -21], [100_000, -19.8], [150_000, -20.25]])
    assert axes.get_ylabel() == "mean return over 2 games"
    band = axes.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (-21, -11)


def test_learning_curve_has_a_line_for_each_policy(tmp_path, drawn):
    rows = [eval_row(steps, [float(steps)]) for steps in (0, 100)]
    plots.learning_curve(rows, tmp_path / "curve.png", "x", policies={"random": -10.0, "no-op": 30.0})
    (axes,) = drawn[0].axes
    assert [text.get_text() for text in axes.texts] == ["random policy", "no-op policy"]
    assert [line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == "-."] == [-10.0, 30.0]


def test_a_reference_shorter_than_the_run_is_not_extended(tmp_path, drawn):
    rows = [eval_row(steps, [1.0]) for steps in (0, 100)]
    plots.learning_curve(rows, tmp_path / "curve.png", "x", [("r", [0, 50], [2.0, 3.0])])
    line = next(line for line in drawn[0].axes[0].lines if line.get_label() == "r")
    assert line.get_xydata().tolist() == [[0, 2], [50, 3]]


def test_nothing_to_draw_writes_nothing(tmp_path):
    assert plots.learning_curve([{"kind": "train"}], tmp_path / "a.png", "x") is None
    assert plots.losses([eval_row(0, [1.0])], tmp_path / "b.png") is None
    assert not list(tmp_path.iterdir())


def test_one_evaluation_is_enough(tmp_path):
    reference = [("thesis", *thesis_curve("6.1", "Pong", "rl_only_nature"))]
    path = plots.learning_curve([eval_row(0, [1.0])], tmp_path / "a.png", "x", reference)
    assert is_small_png(path)


def test_losses_has_a_panel_for_each_loss_and_the_gradient_norm(tmp_path, drawn):
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
    assert is_small_png(plots.losses(rows, tmp_path / "losses.png"))
    scales = {axes.get_title(): axes.get_yscale() for axes in drawn[0].axes}
    assert scales == {"loss/falls": "log", "loss/signed": "linear", "gradient norm": "linear"}


def test_image_panel_shows_images_and_their_difference(tmp_path, drawn):
    targets = np.full((8, 84, 84, 1), 0.5, np.float32)
    outputs = targets.copy()
    outputs[2, 10, 20] = 0.75
    path = plots.image_panel(targets, targets, outputs, tmp_path / "panel.png", "x")
    assert is_small_png(path)
    cells = np.array(drawn[0].axes[:24]).reshape(6, 4)
    shown = [[np.asarray(cell.images[0].get_array()) for cell in row] for row in cells]
    np.testing.assert_array_equal(shown[0][0], targets[0, ..., -1])
    assert shown[2][2][10, 20] == 0.75
    assert shown[2][3][10, 20] == 0.25 and shown[2][3].sum() == 0.25
    # All differences share the scale that the colour bar shows.
    assert {cell.images[0].get_clim() for cell in cells[:, 3]} == {(0.0, 0.25)}


def test_image_panel_shows_colour_in_colour(tmp_path, drawn):
    targets = np.zeros((1, 8, 12, 3), np.float32)
    targets[..., 0] = 1.0  # red
    outputs = targets.copy()
    outputs[0, 2, 3] = 1.5, -0.25, 0.0
    assert is_small_png(plots.image_panel(targets, targets, outputs, tmp_path / "panel.png", "x"))
    _, target, output, difference = (np.asarray(axes.images[0].get_array()) for axes in drawn[0].axes[:4])
    np.testing.assert_array_equal(target, targets[0])
    assert output[2, 3].tolist() == [1.0, 0.0, 0.0]  # clipped, as the difference is not
    assert difference.shape == (8, 12) and difference[2, 3] == 0.5 == difference.sum()


def test_image_panel_of_noise_is_still_small_and_a_perfect_output_is_fine(tmp_path):
    noise = np.random.default_rng(0).uniform(size=(3, 84, 84, 1)).astype(np.float32)
    assert is_small_png(plots.image_panel(noise, noise, noise, tmp_path / "panel.png", "x"))


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((1, 84, 84, 3), float), ((84, 84, 1), float), ((1, 84, 84, 1), np.uint8), ((0, 84, 84, 1), float)],
)
def test_image_panel_refuses_other_images(tmp_path, shape, dtype):
    good = np.zeros((1, 84, 84, 1), np.float32)
    with pytest.raises(ValueError, match="images must be"):
        plots.image_panel(good, np.zeros(shape, dtype), good, tmp_path / "panel.png", "x")
    four = np.zeros((1, 84, 84, 4), np.float32)
    with pytest.raises(ValueError, match=r"images must be \[B, H, W, 1\] or \[B, H, W, 3\]"):
        plots.image_panel(four, four, four, tmp_path / "panel.png", "x")


@pytest.mark.parametrize("channels", [1, 3])
def test_gif_holds_the_frames(tmp_path, channels):
    frames = np.zeros((3, 8, 6, channels), np.uint8)
    frames[1, 2, 3] = 255
    frames[2] = 255
    path = plots.gif(frames, tmp_path / "a.gif", fps=20, scale=2)
    with Image.open(path) as image:
        assert image.n_frames == 3 and image.size == (12, 16)
        for i in range(3):
            image.seek(i)
            assert image.info["duration"] == 50
            pixels = np.asarray(image.convert("L"))
            np.testing.assert_array_equal(pixels, frames[i, ..., 0].repeat(2, 0).repeat(2, 1))


def test_gif_holds_colours(tmp_path):
    frames = np.zeros((2, 8, 6, 3), np.uint8)
    frames[1, 2:4, :, 2] = 255
    with Image.open(plots.gif(frames, tmp_path / "a.gif", scale=1)) as image:
        image.seek(1)
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), frames[1])


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((2, 8, 6, 1), float), ((2, 8, 6, 4), np.uint8), ((2, 8, 6), np.uint8), ((0, 8, 6, 1), np.uint8)],
)
def test_gif_refuses_other_frames(tmp_path, shape, dtype):
    with pytest.raises(ValueError, match="frame"):
        plots.gif(np.zeros(shape, dtype), tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


def test_available_without_importing_and_without_the_extra(monkeypatch):
    code = (
        "import sys; from experiments import plots; assert plots.available();"
        "assert not {'matplotlib', 'PIL'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    monkeypatch.setattr(plots.importlib.util, "find_spec", lambda name: None)
    assert not plots.available()


def test_thesis_curve_is_the_published_one_and_lists_what_there_is():
    steps, returns = thesis_curve("6.1", "Pong", "rl_only_nature")
    assert len(steps) == 20 and (np.diff(steps) == 100_000).all()
    assert returns[steps == 500_000] == [-6.9]
    with pytest.raises(ValueError, match="valid: rl_only_nature, rl_only_256_aug, rl_only_256"):
        thesis_curve("6.2", "Pong", "joint_50")
    with pytest.raises(ValueError, match="valid games: Breakout, Enduro, MsPacman, Pong, Qbert"):
        thesis_curve("6.2", "Tetris", "joint_50")
