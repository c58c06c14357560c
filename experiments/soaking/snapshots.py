"""Snapshots of environments: a new one goes on as the old one does."""

from collections.abc import Callable, Mapping

import numpy as np

from srl_jax import envs
from srl_jax.display import Progress

from . import Count, Say

NOOP_MAX = 30
ODD_GAMES = ("Breakout", "Qbert", "YarsRevenge", "Seaquest", "Pong")
"""Several lives; remember the past; score against another player."""


class Lines:
    """The stream of a Progress whose lines somebody else takes."""

    def __init__(self, say: Say):
        self._say = say

    def write(self, text: str) -> None:
        if text.strip():
            self._say(text.strip())

    def flush(self) -> None:
        pass


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


def out_of_snapshots(short: bool, say: Say) -> list[Count]:
    """Snapshots of Atari at random moments, restored in new environments, beside the old ones for 200 moves.

    All 57 games, and some of them with and without sticky actions and no-ops, after a step, a reset and an
    end. Episodes are cut after 40 steps and environments reseeded after 60, so that the logs that are played
    again hold resets and begin at different times.
    """
    both = (0.0, 0.25), (0, NOOP_MAX)
    cases = [(game, s, n, m) for game in ODD_GAMES for s in both[0] for n in both[1] for m in MOMENTS]
    cases += [
        (game, both[0][i % 2], both[1][i // 2 % 2], list(MOMENTS)[i % 3])
        for i, game in enumerate(envs.ATARI_57)
    ]
    cases, number, moves = (cases[1:2], 2, 40) if short else (cases, 3, 200)
    failed = events = 0
    with Progress(len(cases), "snapshots", stream=Lines(say)) as progress:
        for index, (game, sticky, noops, moment) in enumerate(cases):
            options = {"sticky_actions": sticky, "noop_max": noops, "max_frames": 160, "reseed_every": 60}

            def make(game=game, options=options):
                return envs.make(game, num_envs=number, seed=1, frame_size=42, **options)

            player = Player.start(make(), index)
            player.moves(int(player.rng.integers(50, 150)))
            difference, snapshot = goes_on(player, make, player.until(moment), moves)
            player.env.close()
            if difference:
                failed += 1
                progress.note(f"{game}, sticky_actions={sticky}, noop_max={noops}, {moment}: {difference}")
            events += len(snapshot["events"])
            progress.update(index + 1, game=game)
    detail = f"{number} environments each; {events:,} steps and resets played again"
    return [Count(f"snapshots restored, then {moves} moves beside the original", len(cases), failed, detail)]
