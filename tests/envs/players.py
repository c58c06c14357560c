"""Random players of environments, and whether a new environment goes on from a snapshot as the old one."""

from collections.abc import Callable, Mapping

import numpy as np


class Player:
    """Random actions; ended environments are reset in the next move, and now and then some others.

    Attributes:
        env, rng: what it moves, and by what.
        ended: bool [N], these wait for a reset.
        others: the probability that a move resets some more.
        was_reset: whether the last move was one.
    """

    def __init__(self, env, rng: np.random.Generator, ended: np.ndarray, others: float):
        self.env, self.rng, self.ended, self.others = env, rng, ended, others
        self.was_reset = True

    @classmethod
    def start(cls, env, seed: int, others: float = 0.1) -> "Player":
        """One that has reset the environments."""
        env.reset()
        return cls(env, np.random.default_rng(seed), np.zeros(env.num_envs, bool), others)

    def beside(self, env) -> "Player":
        """One that will do in other environments what this one will do in its own."""
        rng = np.random.default_rng()
        rng.bit_generator.state = self.rng.bit_generator.state
        return type(self)(env, rng, self.ended.copy(), self.others)

    def move(self) -> list[np.ndarray]:
        """Everything that one step or one reset returned; frames first."""
        number = self.env.num_envs
        self.was_reset = bool(self.ended.any() or self.rng.random() < self.others)
        if self.was_reset:
            mask = self.ended | (self.rng.random(number) < 0.5 * (self.others > 0))
            frames, info = self.env.reset(options={"reset_mask": mask})
            self.ended = np.zeros(number, bool)
            return [frames, *info.values()]
        actions = self.rng.integers(0, self.env.single_action_space.n, number)
        frames, rewards, terminated, truncated, info = self.env.step(actions)
        self.ended = terminated | truncated
        return [frames, rewards, terminated, truncated, *info.values()]

    def moves(self, number: int) -> list[np.ndarray]:
        """Everything that so many moves returned."""
        return [array for _ in range(number) for array in self.move()]

    def until(self, moment: str) -> np.ndarray:
        """Moves on to one of `MOMENTS`; the frames that it saw last."""
        frames = self.move()[0]
        while not MOMENTS[moment](self):
            frames = self.move()[0]
        return frames


MOMENTS = {
    "after a step": lambda player: not player.was_reset and not player.ended.any(),
    "after a reset": lambda player: player.was_reset,
    "after an end": lambda player: player.ended.any(),
}


def goes_on(player: Player, make: Callable, seen: np.ndarray, moves: int) -> tuple[str, Mapping]:
    """Restores a snapshot in a new environment and moves both on side by side.

    Args:
        player: of the environment that the snapshot is taken of.
        make: makes a new one.
        seen: the frames that the player saw last.
        moves: how many.

    Returns:
        what is wrong, or ""; the snapshot.
    """
    snapshot = player.env.snapshot()
    for array in snapshot.values():
        array.setflags(write=False)
    kept = {name: array.copy() for name, array in snapshot.items()}
    env = make()
    try:
        frames = env.restore(snapshot)
    except ValueError as error:
        return str(error), kept
    difference = ""
    if not np.array_equal(frames, seen):
        difference = "the frames differ"
    elif not identical(env.snapshot(), kept):
        difference = "a second snapshot differs"
    other = player.beside(env)
    for number in range(moves):
        if not same(player.move(), other.move()):
            difference = difference or f"move {number} differs"
    if not identical(player.env.snapshot(), env.snapshot()):
        difference = difference or "the snapshots at the end differ"
    if not identical(snapshot, kept):
        difference = difference or "the snapshot has changed"
    env.close()
    return difference, kept


def same(a: list, b: list) -> bool:
    """Whether two lists hold equal arrays."""
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def identical(a: Mapping, b: Mapping) -> bool:
    """Whether two snapshots are the same, dtypes included."""
    return set(a) == set(b) and all(a[n].dtype == b[n].dtype and np.array_equal(a[n], b[n]) for n in a)
