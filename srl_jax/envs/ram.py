"""The memory of an Atari game, which ALE's vector environment does not show.

A second emulator is kept in step with one environment of `atari.Atari`: the same seed for ALE, the same start
of episodes, the same actions. That they are in step is checked, not believed.
"""

from typing import Any

import ale_py
import numpy as np
from ale_py import roms

from srl_jax.data import ram_labels
from srl_jax.envs.atari import Atari
from srl_jax.envs.games import FRAME_SKIP, rom_name
from srl_jax.envs.pixels import averaged

TOLERANCE = 1.0
"""Grey levels by which a frame may differ from the screen that is made smaller here: both are rounded."""


class OutOfStep(Exception):
    """The second emulator is not where the environment is; one line."""


class Twin:
    """An emulator in step with an environment that starts and moves as `atari.Atari`'s.

    Args:
        game: one of `games.ATARI_57`.
        sticky_actions, full_actions, noop_max: the environment's.
    """

    def __init__(self, game: str, *, sticky_actions: float, noop_max: int, full_actions: bool = False):
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self._ale = ale_py.ALEInterface()
        self._ale.setFloat("repeat_action_probability", sticky_actions)
        self._rom = str(roms.get_rom_path(rom_name(game)))
        self._full_actions, self._noop_max = full_actions, noop_max
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
            self._actions = ale.getLegalActionSet() if self._full_actions else ale.getMinimalActionSet()
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
        chosen, self._screens = self._actions[action], []
        for i in range(FRAME_SKIP):
            self._ale.act(chosen)
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
            frame: uint8 [H, W] or [H, W, 1].
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
        if (
            difference := np.abs(averaged(screen, len(frame)) - frame.reshape(len(frame), -1)).max()
        ) > TOLERANCE:
            raise OutOfStep(f"a pixel differs by {difference:.1f} grey levels")


class AtariWithState(Atari):
    """N copies of an Atari game with emulators in step, whose labelled bytes of memory are its state.

    `info["state"]` is float64 [N, V]. In every step the next environment in turn is compared with its
    emulator; from the first difference on the state is not known: `state_problem` says why, and there are no
    `state_names`. A snapshot cannot be restored here: the emulators in step are not in it.

    Args:
        game: one of `games.ATARI_57`; one that nobody has labelled has no state.
        sticky_actions, full_actions, noop_max: as of `atari.Atari`.
        **options: the others of `atari.Atari`.
    """

    def __init__(
        self,
        game: str,
        *,
        sticky_actions: float = 0.0,
        full_actions: bool = False,
        noop_max: int = 30,
        **options,
    ):
        shared: dict[str, Any] = {
            "sticky_actions": sticky_actions,
            "full_actions": full_actions,
            "noop_max": noop_max,
        }
        super().__init__(game, **shared, **options)
        labels = ram_labels(game)
        self.state_names, self._bytes = tuple(labels), list(labels.values())
        made = self.num_envs if labels else 0
        self._twins = [Twin(game, **shared) for _ in range(made)]
        self._turn = 0

    def _reset(self, mask, seeded):
        frames, info = super()._reset(mask, seeded)
        for i in np.flatnonzero(mask) if self.state_names else ():
            self._twins[i].reset(int(self.ale_seeds[i]) if self.steps_since_seeded[i] == 0 else None)
            self._compare(i, frames, info)
        return frames, info | {"state": self._state()}

    def _step(self, actions):
        frames, rewards, terminated, truncated, info = super()._step(actions)
        self._turn = (self._turn + 1) % self.num_envs
        for i, twin in enumerate(self._twins if self.state_names else ()):
            twin.step(int(actions[i]), look=i == self._turn)
        # A game's last frame is older than its screen.
        if self.state_names and not (terminated | truncated)[self._turn]:
            self._compare(self._turn, frames, info)
        return frames, rewards, terminated, truncated, info | {"state": self._state()}

    def _restore(self, arrays):
        raise NotImplementedError

    def _state(self):
        return np.array([twin.ram()[self._bytes] for twin in self._twins], np.float64).reshape(
            self.num_envs, -1
        )

    def _compare(self, i, frames, info):
        try:
            self._twins[i].check(frames[i], int(info["frame_number"][i]), int(info["lives"][i]))
        except OutOfStep as error:
            self.state_problem = f"the emulator whose memory is read is out of step: {error}"
            self.state_names = ()
