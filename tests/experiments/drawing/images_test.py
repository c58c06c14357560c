"""Tests of experiments.drawing.images."""

import numpy as np
import pytest

from experiments.drawing import images, plots

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


@pytest.fixture
def drawn(monkeypatch):
    """The figures that the functions under test saved, to look at their parts."""
    figures = []
    save = plots.save
    monkeypatch.setattr(plots, "save", lambda figure, path: figures.append(figure) or save(figure, path))
    return figures


def is_small_png(path):
    with Image.open(path) as image:
        return image.format == "PNG" and path.stat().st_size < 150_000


def test_image_panel_shows_images_and_their_difference(tmp_path, drawn):
    targets = np.full((8, 84, 84, 1), 0.5, np.float32)
    outputs = targets.copy()
    outputs[2, 10, 20] = 0.75
    path = images.image_panel(targets, targets, outputs, tmp_path / "panel.png", "x")
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
    assert is_small_png(images.image_panel(targets, targets, outputs, tmp_path / "panel.png", "x"))
    _, target, output, difference = (np.asarray(axes.images[0].get_array()) for axes in drawn[0].axes[:4])
    np.testing.assert_array_equal(target, targets[0])
    assert output[2, 3].tolist() == [1.0, 0.0, 0.0]  # clipped, as the difference is not
    assert difference.shape == (8, 12) and difference[2, 3] == 0.5 == difference.sum()


def test_image_panel_of_noise_is_still_small_and_a_perfect_output_is_fine(tmp_path):
    noise = np.random.default_rng(0).uniform(size=(3, 84, 84, 1)).astype(np.float32)
    assert is_small_png(images.image_panel(noise, noise, noise, tmp_path / "panel.png", "x"))


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((1, 84, 84, 3), float), ((84, 84, 1), float), ((1, 84, 84, 1), np.uint8), ((0, 84, 84, 1), float)],
)
def test_image_panel_refuses_other_images(tmp_path, shape, dtype):
    good = np.zeros((1, 84, 84, 1), np.float32)
    with pytest.raises(ValueError, match="images must be float"):
        images.image_panel(good, np.zeros(shape, dtype), good, tmp_path / "panel.png", "x")
    four = np.zeros((1, 84, 84, 4), np.float32)
    with pytest.raises(ValueError, match=r"images must be float \[B, H, W, 1\] or \[B, H, W, 3\]"):
        images.image_panel(four, four, four, tmp_path / "panel.png", "x")


@pytest.mark.parametrize("channels", [1, 3])
def test_gif_holds_the_frames(tmp_path, channels):
    frames = np.zeros((3, 8, 6, channels), np.uint8)
    frames[1, 2, 3] = 255
    frames[2] = 255
    path = images.gif(frames, tmp_path / "a.gif", scale=2)
    with Image.open(path) as image:
        assert image.n_frames == 3 and image.size == (12, 16)
        for i in range(3):
            image.seek(i)
            assert image.info["duration"] == 70
            pixels = np.asarray(image.convert("L"))
            np.testing.assert_array_equal(pixels, frames[i, ..., 0].repeat(2, 0).repeat(2, 1))


def test_gif_holds_colours(tmp_path):
    frames = np.zeros((2, 8, 6, 3), np.uint8)
    frames[1, 2:4, :, 2] = 255
    with Image.open(images.gif(frames, tmp_path / "a.gif", scale=1)) as image:
        image.seek(1)
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), frames[1])


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((2, 8, 6, 1), float), ((2, 8, 6, 4), np.uint8), ((2, 8, 6), np.uint8), ((0, 8, 6, 1), np.uint8)],
)
def test_gif_refuses_other_frames(tmp_path, shape, dtype):
    with pytest.raises(ValueError, match="frame"):
        images.gif(np.zeros(shape, dtype), tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())
