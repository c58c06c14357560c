"""srl_jax/replay/sumtree.py against numpy's cumsum."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srl_jax.replay.sumtree import SumTree


def find(tree, prefix_sums):
    return tree._find(np.asarray(prefix_sums, float), tree._ends())


@st.composite
def written_tree(draw, values):
    """A tree after a few writes, repeated indices among them, and the leaves it should have."""
    capacity = draw(st.integers(1, 600))  # one, two and three levels
    writes = draw(
        st.lists(st.lists(st.tuples(st.integers(0, capacity - 1), values), max_size=30), max_size=6)
    )
    tree, leaves = SumTree(capacity), [0.0] * capacity
    for write in writes:
        tree.put(np.array([i for i, _ in write], np.int64), np.array([v for _, v in write]))
        for index, value in write:
            leaves[index] = value
    return tree, np.array(leaves)


whole_numbers = st.integers(0, 1000).map(float)
awkward_floats = st.one_of(st.just(0.0), st.floats(1e-12, 1e12))


@given(written_tree(whole_numbers))
@settings(deadline=None, max_examples=80)
def test_find_equals_search_in_cumsum(case):
    # Sums of whole numbers are exact, so every prefix has one right answer.
    tree, leaves = case
    cumsum = np.cumsum(leaves)
    np.testing.assert_array_equal(tree.get(np.arange(len(leaves))), leaves)
    assert tree.total == cumsum[-1]
    if tree.total:
        prefix = np.linspace(0, tree.total, 97, endpoint=False)
        prefix = np.concatenate([prefix, cumsum[cumsum < tree.total]])  # exactly on the borders
        np.testing.assert_array_equal(find(tree, prefix), np.searchsorted(cumsum, prefix, side="right"))


@given(written_tree(awkward_floats))
@settings(deadline=None, max_examples=80)
def test_never_finds_a_zero_leaf_whatever_the_rounding(case):
    tree, leaves = case
    np.testing.assert_allclose(tree.total, leaves.sum(), rtol=1e-12)
    if tree.total:
        borders = np.minimum(np.cumsum(leaves), tree.total)
        prefix = np.concatenate([borders, np.nextafter(borders, 0), [0.0, tree.total * (1 + 1e-9)]])
        assert (tree.get(find(tree, prefix)) > 0).all()


def test_total_does_not_drift():
    rng = np.random.default_rng(0)
    tree = SumTree(5000)
    for _ in range(300):
        tree.put(rng.integers(0, 5000, 64), rng.random(64) * 10.0 ** rng.integers(-9, 9, 64))
    tree.put(np.arange(5000), np.zeros(5000))
    assert tree.total == 0.0  # differences of 1e9s would leave a residue


@given(written_tree(awkward_floats))
@settings(deadline=None, max_examples=40)
def test_leaves_are_the_whole_state(case):
    # A checkpoint keeps the leaves alone; the draws after it must not differ by a bit.
    tree, leaves = case
    one_by_one, at_once = SumTree(len(leaves)), SumTree(len(leaves))
    one_by_one.put(np.arange(len(leaves)), leaves)
    at_once.put(np.arange(len(leaves)), 1.0)
    at_once.fill(leaves)
    for copy in (one_by_one, at_once):
        assert copy._sums.tobytes() == tree._sums.tobytes()
        assert copy.leaves.tobytes() == tree.leaves.tobytes()
        assert copy.total == tree.total
        if tree.total:
            prefix = np.minimum(np.cumsum(leaves), tree.total)
            np.testing.assert_array_equal(find(copy, prefix), find(tree, prefix))


def test_sums_of_many_blocks_are_those_of_their_leaves_alone():
    # As many as a long run has: however many rows numpy adds up at once, each in the same order.
    rng = np.random.default_rng(0)
    leaves = rng.random(100_000) * 10.0 ** rng.integers(-9, 9, 100_000)
    written, filled = SumTree(100_000), SumTree(100_000)
    for part in np.array_split(rng.permutation(100_000), 700):
        written.put(part, leaves[part])
    filled.fill(leaves)
    assert written._sums.tobytes() == filled._sums.tobytes()
    assert filled.leaves.tobytes() == leaves.tobytes()


@given(written_tree(awkward_floats), st.integers(1, 200), st.integers(0, 99))
@settings(deadline=None, max_examples=40)
def test_stratified_counts_are_within_two(case, n, seed):
    tree, leaves = case
    if tree.total:
        counts = np.bincount(tree.sample_stratified(n, np.random.default_rng(seed)), minlength=len(leaves))
        assert np.abs(counts - n * leaves / tree.total).max() <= 2 + 1e-6


def test_draws_cover_a_leaf_in_proportion_not_only_its_start():
    # One draw a time: leaf 1 holds [1, 4) of 4, so it must come exactly when the uniform is >= 1/4.
    tree = SumTree(2)
    tree.put(np.arange(2), np.array([1.0, 3.0]))
    uniforms = np.random.default_rng(3).random(200)
    rng = np.random.default_rng(3)
    drawn = [tree.sample_stratified(1, rng)[0] for _ in range(200)]
    np.testing.assert_array_equal(drawn, uniforms >= 0.25)


def test_empty_and_impossible_trees():
    tree = SumTree(4)
    with pytest.raises(ValueError, match="all its values are 0"):
        tree.sample_stratified(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="read-only"):
        tree.leaves[0] = 2.0
