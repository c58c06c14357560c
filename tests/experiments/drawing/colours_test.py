"""Tests of experiments.drawing.colours."""

from hypothesis import given
from hypothesis import strategies as st

from experiments.arms import FIGURES
from experiments.drawing.colours import COLOURS, styles

names = st.lists(st.sampled_from([*"abcdefghijk", "joint_256", "rl_only_nature", "joint_50"]), unique=True)


def test_arms_of_the_thesis_look_the_same_everywhere_and_differ_in_a_figure():
    everywhere = {}
    for figure in FIGURES.values():
        found = styles([arm.name for arm in figure.arms], among=["x", "y", "rl_only_256"])
        assert len({colour for colour, _ in found.values()}) == len(found)
        for arm, (colour, line) in found.items():
            assert everywhere.setdefault(arm, colour) == colour and line == "-"


@given(arms=names, others=names)
def test_the_colour_depends_on_the_arms_of_the_directory_alone(arms, others):
    together = {*arms, *others}
    one, two = styles(arms, together), styles(others, sorted(together, reverse=True))
    assert all(one[arm][0] == two[arm][0] for arm in one.keys() & two.keys())
    assert list(one) == arms and len(set(one.values())) == len(one)


def test_as_many_arms_as_there_are_colours_differ_and_more_have_another_line():
    count = len(COLOURS)
    found = list(styles([f"arm{i:02}" for i in range(2 * count)]).values())
    assert sorted(colour for colour, _ in found[:count]) == sorted(COLOURS)
    assert [line for _, line in found] == ["-"] * count + ["--"] * count
    few = styles(["a00", "a07", "a14", "a21", "a28", "a01"], among=[f"a{i:02}" for i in range(40)])
    assert len(set(few.values())) == 6  # five of them have the same colour among all
    assert len(set(styles([f"a{i:02}" for i in range(4 * count)]).values())) == 4 * count
