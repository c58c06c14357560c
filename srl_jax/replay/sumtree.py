"""A sum tree in numpy: set priorities and draw in proportion to them, many at a time.

The tree has two levels, leaves in blocks of 64 and the sums of the blocks, rather than 17 or 20 levels: a
numpy call on 30 numbers costs about as much as one on 2,000, and a running sum over the 1,563 blocks of
100,000 leaves is one call.
"""

import numpy as np

_SHIFT = 6
_BLOCK = 1 << _SHIFT


class SumTree:
    """Non-negative float64 values, their sum, and the search for where a prefix sum falls.

    Attributes:
        capacity: int, how many leaves there are.
        leaves: float64 [capacity], the values; read only: write through `put`. It is the whole
            state: the inner nodes follow from it.
    """

    def __init__(self, capacity: int):
        """Makes a tree of zeros.

        Args:
            capacity: the number of leaves, at least 1.
        """
        self.capacity = int(capacity)
        blocks = -(-self.capacity // _BLOCK)
        self._blocks, self._sums = np.zeros((blocks, _BLOCK)), np.zeros(blocks)
        self.leaves = self._blocks.reshape(-1)[: self.capacity]
        self.leaves.flags.writeable = False

    @property
    def total(self) -> float:
        """The sum of all leaves, rounded as by one summation, however many `put`s there were."""
        return float(self._sums.sum())

    def get(self, indices: np.ndarray) -> np.ndarray:
        """The values, float64 [n], of the leaves `indices`, int [n] in [0, capacity)."""
        return self.leaves[indices]

    def put(self, indices: np.ndarray, values: np.ndarray) -> None:
        """Writes leaves and the sums of their blocks.

        Sums are computed anew from the leaves, never by a difference: errors do not build up.

        Args:
            indices: int64 [n] in [0, capacity). Where an index is repeated, its last value counts.
            values: float64 [n] (or one number for all), finite and not negative. None of it is checked.
        """
        self._blocks.reshape(-1)[indices] = values
        blocks = indices >> _SHIFT
        self._sums[blocks] = np.add.reduce(self._blocks.take(blocks, axis=0), axis=1)

    def fill(self, values: np.ndarray) -> None:
        """Writes all leaves; every sum comes out to the bit as if they had been `put` one by one.

        Args:
            values: float64 [capacity], finite and not negative, which is not checked.
        """
        self._blocks.reshape(-1)[: self.capacity] = values
        np.add.reduce(self._blocks, axis=1, out=self._sums)

    def _ends(self):
        """float64 [blocks + 1]: 0, and the sums up to the end of each block."""
        ends = np.empty(len(self._sums) + 1)
        ends[0] = 0.0
        np.add.accumulate(self._sums, out=ends[1:])
        if not ends[-1] > 0:
            raise ValueError("the tree is empty: all its values are 0")
        return ends

    def _find(self, prefix_sums, ends):
        """The leaf, int64 [n], in which each prefix sum falls: leaf i covers [sum before i, sum up to i).

        `ends` is `_ends()`. A prefix sum that rounding puts at or past the end of its block gets the last
        leaf there that is not negligible; none gets a leaf whose value is 0.
        """
        # Strictly below the last end, so that an end above exists; the first such end is above the one
        # before it, too, so its block is not 0. Likewise for the leaf within the block.
        rest = np.minimum(prefix_sums, np.nextafter(ends[-1], 0.0))
        blocks = ends[1:].searchsorted(rest, side="right")
        rest = rest - ends.take(blocks)
        ends = np.add.accumulate(self._blocks.take(blocks, axis=0), axis=1)
        rest = np.minimum(rest, np.nextafter(ends[:, -1], 0.0))
        return (blocks << _SHIFT) + (ends > rest[:, None]).argmax(axis=1)

    def sample_stratified(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n leaves in proportion to their values, one from each n-th part of the total.

        Each leaf's count is within 2 of n * value / total (Schaul et al. 2016, appendix B.2.1).

        Args:
            n: how many.
            rng: consumed by one call of `random(n)`.

        Returns:
            int64 [n], in ascending order; never a leaf whose value is 0.

        Raises:
            ValueError: all leaves are 0.
        """
        ends = self._ends()
        return self._find((np.arange(n) + rng.random(n)) * (ends[-1] / n), ends)
