"""Tests of experiments.drawing.plots."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from experiments.drawing import plots  # noqa: E402
from srl_jax.data import thesis_curve  # noqa: E402
from srl_jax.statistics import Interval  # noqa: E402

STEPS = [0, 100, 200]


def _panel(game, **lines):
    made = [
        plots.Line(name, plots.Curve(STEPS, *(np.full(3, x + d) for d in (0, -1, 1))), 5, thesis)
        for name, (x, thesis) in lines.items()
    ]
    return plots.Panel(game, made, [plots.Level("Human", 9.0, "other protocol")])


def test_every_game_has_a_panel_and_an_arm_one_colour(drawn, tmp_path):
    thesis = ([0, 150, 300], [1.0, 4.0, 10.0])
    panels = [_panel("Pong", a=(1.0, None), b=(2.0, thesis)), _panel("Catch", b=(5.0, None))]
    plots.draw_panels(panels, tmp_path / "x.png", "title", "one\ntwo")
    first, second = drawn[0].axes
    assert [axes.get_title() for axes in (first, second)] == ["Pong", "Catch"]
    assert first.get_xlabel() == "env steps (4 frames each)" and second.get_xlabel() == "env steps"
    solid = {line.get_ydata()[0]: line.get_color() for line in first.lines if line.get_linestyle() == "-"}
    assert solid[1.0] != solid[2.0]
    assert [line.get_color() for line in second.lines if line.get_linestyle() == "-"] == [solid[2.0]]
    # The thesis' curve ends with ours, at 200, between its points: 4 + (10 - 4) / 3 = 6.
    (dashed,) = [line for line in first.lines if line.get_linestyle() == "--"]
    assert dashed.get_xdata().tolist() == [0, 150, 200]
    assert dashed.get_ydata().tolist() == [1.0, 4.0, 6.0]
    assert dashed.get_color() == solid[2.0]
    (legend,) = drawn[0].legends
    told = [text.get_text() for text in legend.get_texts()]
    assert told == ["a (5 seeds)", "b (5 seeds)", "the thesis' own, one run each"]
    assert [text.get_text() for text in first.texts] == ["Human"]
    told = legend.get_title().get_text().split("\n")
    assert told[:2] == ["one", "two"] and "Pong, Human, 9: other protocol" in told


@pytest.mark.parametrize("games", [1, 2])
def test_a_long_title_stays_within_the_picture(games, drawn, tmp_path):
    words = "Reconstruction and contrast of RL's own size, and how their gradients meet RL's"
    plots.draw_panels([_panel("Pong", a=(1.0, None))] * games, tmp_path / "x.png", f"gates  {words}, {words}")
    (figure,) = drawn
    figure.canvas.draw()
    (title,) = [text for text in figure.texts if "gates" in text.get_text()]
    box = title.get_window_extent()
    assert _inside(box, figure) and box.y1 <= figure.bbox.height
    assert all(axes.title.get_window_extent().y1 <= box.y0 for axes in figure.axes)


def _inside(box, figure):
    return box.x0 >= 0 and box.x1 <= figure.bbox.width


@pytest.mark.parametrize("games", [1, 2])
def test_long_names_of_arms_stay_within_the_picture(games, drawn, tmp_path):
    name = "w" + "".join(f"ord_{i}" for i in range(20))
    assert len(name) > 90
    plots.draw_panels(
        [_panel("Pong", **{name: (1.0, None), "b": (2.0, None)})] * games, tmp_path / "x.png", ""
    )
    intervals = {arm: Interval(1.0, 0.0, 2.0, "Welch") for arm in (name, "b")}
    plots.differences(
        "title", name, {"area": intervals}, {"area": [("#112233", "-")] * 2}, tmp_path / "x.png"
    )
    for figure in drawn:
        figure.canvas.draw()
    (legend,) = drawn[0].legends
    assert _inside(legend.get_window_extent(), drawn[0])
    (axes,) = drawn[1].axes
    assert axes.bbox.width > drawn[1].bbox.width / 2
    assert all(_inside(x.get_window_extent(), drawn[1]) for x in (*axes.get_yticklabels(), *drawn[1].texts))


@pytest.mark.parametrize("seeds", [2, 5])
def test_of_a_single_evaluation_there_are_the_runs_or_the_interval(seeds, drawn, tmp_path):
    runs = [[1.0], [3.0]] if seeds == 2 else ()
    line = plots.Line("a", plots.Curve([0], *(np.array([x]) for x in (2.0, 1.0, 3.0))), seeds, runs=runs)
    plots.draw_panels([plots.Panel("Pong", [line])], tmp_path / "x.png", "title")
    axes = drawn[0].axes[0]
    assert [(*x.get_ydata(), x.get_marker()) for x in axes.lines] == [
        *((run, "o") for (run,) in runs),
        (2.0, "o"),
    ]
    segments = [x.get_segments()[0][:, 1].tolist() for x in axes.collections]
    assert segments == ([] if runs else [[1.0, 3.0]])


def test_a_band_is_the_interval(drawn, tmp_path):
    plots.draw_panels([_panel("Pong", a=(3.0, None))], tmp_path / "x.png", "title")
    (band,) = drawn[0].axes[0].collections
    corners = band.get_paths()[0].vertices
    assert (corners[:, 1].min(), corners[:, 1].max()) == (2.0, 4.0)
    assert (corners[:, 0].min(), corners[:, 0].max()) == (0, 200)


def test_a_band_that_is_very_wide_does_not_make_the_lines_flat(drawn, tmp_path):
    wide = plots.Line("a", plots.Curve(STEPS, [0.0, 1.0, 2.0], [np.nan, -8.0, -7.0], [np.nan, 2.5, 11.0]), 2)
    plots.draw_panels([plots.Panel("Pong", [wide])], tmp_path / "x.png", "title")
    # The line is 2 high, so that the axis ends 2 beyond it, and 5 % of these six.
    assert drawn[0].axes[0].get_ylim() == pytest.approx((-2.3, 4.3))


def test_runs_are_thin_lines_in_place_of_the_band(drawn, tmp_path):
    curve = plots.Curve(STEPS, [0.0, 1.0, 2.0], [np.nan, -8.0, -7.0], [np.nan, 2.5, 11.0])
    line = plots.Line("a", curve, 2, runs=[[0.0, 1.0, 1.0], [0.0, 1.0, 3.0]])
    plots.draw_panels([plots.Panel("Pong", [line])], tmp_path / "x.png", "title")
    axes = drawn[0].axes[0]
    assert [list(x.get_ydata()) for x in axes.lines] == [[0, 1, 1], [0, 1, 3], [0, 1, 2]]
    assert not axes.collections
    assert axes.get_ylim() == pytest.approx((-0.15, 3.15))  # 5 % of the three to either side


def test_policies_and_published_results_are_within_the_axis(drawn, tmp_path):
    line = plots.Line("a", plots.Curve(STEPS, [0.0, 1.0, 2.0], *[np.full(3, np.nan)] * 2), 1)
    panel = plots.Panel("Pong", [line], [plots.Level("Human", 20.0)], [plots.Level("random", -10.0)])
    plots.draw_panels([panel], tmp_path / "x.png", "title")
    assert drawn[0].axes[0].get_ylim() == pytest.approx((-11.5, 21.5))  # 5 % of the thirty to either side


def test_arms_look_as_they_are_told_to(drawn, tmp_path):
    looks = {"a": ("#112233", "-"), "b": ("#112233", ":")}
    panel = _panel("Pong", a=(1.0, None), b=(2.0, None))
    plots.draw_panels([panel], tmp_path / "x.png", "title", looks=looks)
    drawn = [line for line in drawn[0].axes[0].lines if len(line.get_xdata()) == 3]
    assert [(line.get_color(), line.get_linestyle()) for line in drawn] == list(looks.values())


def test_the_same_numbers_give_the_same_file(tmp_path):
    panels = [_panel("Pong", a=(1.0, None))]
    files = [plots.draw_panels(panels, tmp_path / name, "title", "note") for name in ("x.png", "y.png")]
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(
    ("noop", "lines"),
    [
        # The axis spans 0 to 10, and a margin of 5 % on both sides: 2 % of it are 0.22.
        (0.5, {"random policy": 0.0, "no-op policy": 0.5}),
        (0.2, {"random, no-op": 0.1}),
        (None, {"random policy": 0.0}),
    ],
)
def test_policies_that_learn_nothing_are_lines_and_near_ones_share_one(drawn, tmp_path, noop, lines):
    line = plots.Line("a", plots.Curve(STEPS, np.array([0.0, 5.0, 10.0]), *[np.full(3, np.nan)] * 2), 1)
    policies = [plots.Level("random", 0.0, "sticky actions 0 (here 0.25)")]
    policies += [] if noop is None else [plots.Level("no-op", noop)]
    plots.draw_panels([plots.Panel("Pong", [line], [], policies)], tmp_path / "x.png", "title")
    (axes,) = drawn[0].axes
    drawn_lines = [x.get_ydata()[0] for x in axes.lines if x.get_linestyle() == "-."]
    assert dict(zip([x.get_text() for x in axes.texts], drawn_lines, strict=True)) == lines
    (legend,) = drawn[0].legends
    assert "Pong, random policy, 0: sticky actions 0 (here 0.25)" in legend.get_title().get_text()


def test_available_without_the_extra(monkeypatch):
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
