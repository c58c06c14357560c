"""The memory of an Atari game, which ALE's vector environment does not show.

A second emulator is kept in step with one environment of `atari.Atari`: the same seed for ALE, the same start
of episodes, the same actions. That they are in step is checked, not believed.
"""

import ale_py
import numpy as np
from ale_py import roms

from srl_jax.envs.games import FRAME_SKIP, rom_name

TOLERANCE = 1.0
"""Grey levels by which a frame may differ from the screen that is made smaller here: both are rounded."""


class OutOfStep(Exception):
    """The second emulator is not where the environment is; one line."""


class Twin:
    """An emulator in step with an environment that starts and moves as `atari.Atari`'s.

    Args:
        game: one of `games.ATARI_57`.
        sticky_actions, noop_max: the environment's.
    """

    def __init__(self, game: str, *, sticky_actions: float, noop_max: int):
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self._ale = ale_py.ALEInterface()
        self._ale.setFloat("repeat_action_probability", sticky_actions)
        self._rom = str(roms.get_rom_path(rom_name(game)))
        self._noop_max = noop_max
        self._draws = np.random.RandomState()

    def reset(self, ale_seed: int | None) -> None:
        """Starts an episode as ALE's vector environment does.

        Args:
            ale_seed: that ALE got, which reads the ROM again; None for a reset without one.
        """
        ale = self._ale
        if ale_seed is not None:
            ale.setInt("random_seed", ale_seed)
            ale.loadROM(self._rom)
            self._actions = ale.getMinimalActionSet()
            self._draws = np.random.RandomState(ale_seed)  # a Mersenne twister, seeded as C++'s mt19937
        ale.reset_game()
        # How libstdc++ makes a number below noop_max of 32 random bits.
        noops = int(self._draws.randint(0, 2**32, dtype=np.uint32)) * self._noop_max >> 32
        if ale_py.Action.FIRE in self._actions:
            ale.act(ale_py.Action.FIRE)
            noops -= 1
        for _ in range(noops):
            ale.act(ale_py.Action.NOOP)
            if ale.game_over():
                ale.reset_game()
        self._screens = [ale.getScreenGrayscale()]

    def step(self, action: int, look: bool) -> None:
        """One env step. Of the last two screens, which a frame is made of, copies are kept where `look`."""
        action, self._screens = self._actions[action], []
        for i in range(FRAME_SKIP):
            self._ale.act(action)
            if self._ale.game_over():
                break
            if look and i >= FRAME_SKIP - 2:
                self._screens.append(self._ale.getScreenGrayscale())

    def ram(self) -> np.ndarray:
        """The game's memory, uint8 [128]."""
        return self._ale.getRAM()

    def check(self, frame: np.ndarray, frame_number: int, lives: int) -> None:
        """Compares with what the environment shows after the same step, where `look` was set.

        Args:
            frame: uint8 [H, W].
            frame_number, lives: of its `info`.

        Raises:
            OutOfStep: something differs.
        """
        ale = self._ale
        counted = ale.getFrameNumber(), ale.lives()
        if counted != (frame_number, lives):
            raise OutOfStep(f"frame number and lives are {counted}, not {(frame_number, lives)}")
        screen = np.max(self._screens, axis=0)
        if len(frame) > min(screen.shape):  # larger than the screen: ALE interpolates
            return
        if (difference := np.abs(shrunk(screen, len(frame)) - frame).max()) > TOLERANCE:
            raise OutOfStep(f"a pixel differs by {difference:.1f} grey levels")


def shrunk(screen: np.ndarray, size: int) -> np.ndarray:
    """A screen [H, W] with H and W at least `size`, made smaller by averaging areas: float64 [size, size]."""
    return _averages(_averages(screen, size).T, size).T


def _averages(values: np.ndarray, size: int) -> np.ndarray:
    """Rows [L, ...] -> [size, ...], each the mean of an equal stretch, which may cut rows in parts."""
    sums = np.concatenate((np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0, dtype=np.float64)))
    edges = np.arange(size + 1) * len(values) / size
    whole = np.minimum(edges.astype(int), len(values) - 1)
    at_edges = sums[whole] + (edges - whole)[:, None] * values[whole]
    return np.diff(at_edges, axis=0) * size / len(values)
