"""A sum tree in numpy: set priorities and draw in proportion to them, many at a time.

Each node has 16 children rather than 2: a numpy call on 30 numbers costs about as much as one on
500, so a tree of a million leaves wants few levels (5 rather than 20), not narrow ones.
"""

import itertools

import numpy as np

_SHIFT = 4
_FANOUT = 1 << _SHIFT


class SumTree:
    """Non-negative float64 values, their sum, and the search for where a prefix sum falls.

    Attributes:
        capacity: int, how many leaves there are.
        leaves: float64 [capacity], the values; read only: write through `set`. It is the whole
            state: the inner nodes follow from it.
    """

    def __init__(self, capacity: int):
        """Makes a tree of zeros.

        Args:
            capacity: the number of leaves, at least 1.

        Raises:
            ValueError: capacity is below 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}")
        self.capacity = int(capacity)
        # Levels from the leaves up, each as siblings [blocks, 16]; the last one is a single block.
        self._levels = []
        nodes = self.capacity
        while not self._levels or nodes > 1:
            blocks = -(-nodes // _FANOUT)
            self._levels.append(np.zeros((blocks, _FANOUT)))
            nodes = blocks
        self.leaves = self._levels[0].reshape(-1)[: self.capacity]
        self.leaves.flags.writeable = False

    @property
    def total(self) -> float:
        """The sum of all leaves, rounded as by one summation, however many `set`s there were."""
        return float(self._levels[-1].sum())

    @property
    def nbytes(self) -> int:
        """Bytes of all nodes: 8 * 16 / 15 a leaf, and the padding of each level to 16 nodes."""
        return sum(level.nbytes for level in self._levels)

    def get(self, indices: np.ndarray) -> np.ndarray:
        """The values, float64 [n], of the leaves `indices`, int [n] in [0, capacity)."""
        return self.leaves[indices]

    def set(self, indices: np.ndarray, values: np.ndarray) -> None:
        """Writes leaves and every sum above them.

        Sums are computed anew from the children, never by a difference: errors do not build up.

        Args:
            indices: int [n] in [0, capacity). Where an index is repeated, its last value counts.
            values: float [n] (or one number for all), finite and not negative.

        Raises:
            IndexError: an index is out of range.
            ValueError: a value is negative or not finite.
        """
        indices = np.asarray(indices, np.int64)
        values = np.asarray(values, np.float64)
        if not indices.size:
            return
        if indices.min() < 0 or indices.max() >= self.capacity:
            raise IndexError(f"leaf index out of range for a capacity of {self.capacity}")
        if not (values.min() >= 0 and values.max() < np.inf):
            raise ValueError("values must be finite and not negative")
        self._levels[0].reshape(-1)[indices] = values
        for children, parents in itertools.pairwise(self._levels):
            indices = indices >> _SHIFT
            parents.reshape(-1)[indices] = np.add.reduce(children.take(indices, axis=0), axis=1)

    def find(self, prefix_sums: np.ndarray) -> np.ndarray:
        """The leaf in which each prefix sum falls: leaf i covers [sum before i, sum up to i).

        Args:
            prefix_sums: float [n] in [0, total]. One that rounding puts at or past the end of its
                subtree gets the last leaf there that is not negligible.

        Returns:
            int64 [n]; never a leaf whose value is 0.

        Raises:
            ValueError: all leaves are 0, or a prefix sum is negative.
        """
        rest = np.array(prefix_sums, np.float64)
        if not self.total > 0:
            raise ValueError("the tree is empty: all its values are 0")
        if rest.size and not rest.min() >= 0:
            raise ValueError("prefix sums must not be negative")
        rows = np.arange(len(rest))
        nodes = np.zeros(len(rest), np.int64)
        before = np.zeros((len(rest), _FANOUT + 1))  # sums of the children before each child
        ends = before[:, 1:]
        for level in reversed(self._levels):
            np.cumsum(level.take(nodes, axis=0), axis=1, out=ends)
            # Strictly below the last end, so that a first end above `rest` exists; it is above the
            # end before it, too, so its child is not 0.
            rest = np.minimum(rest, np.nextafter(ends[:, -1], 0.0))
            child = np.add.reduce(ends <= rest[:, None], axis=1)
            rest = rest - before[rows, child]
            nodes = (nodes << _SHIFT) + child
        return nodes

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
        return self.find((np.arange(n) + rng.random(n)) * (self.total / n))
