"""Catch: a small pixel game whose true state is known, for trying an idea within a minute.

A ball of 3 x 3 pixels, or of another size, falls with a constant sideways drift that the walls reflect;
a paddle of 13 x 3 pixels at the bottom has to be under it. One ball is one episode of 17 to 24 env
steps, with reward 1 for a catch and -1 for a miss at its end, 0 before. The paddle is fast enough to
catch any ball by following it. Sizes are in pixels of a frame of 84 x 84; a frame of 42 x 42 shows all
of it at half the size.

The game is in the spirit of the Catch of bsuite (Osband et al., 2020), with velocities that a
single frame does not show.
"""

from collections.abc import Mapping

import numpy as np

from srl_jax.envs.base import FrameVectorEnv

GRID = 84
"""The game is played on an integer grid of GRID x GRID, whatever the size of the frames."""
ACTIONS = ("LEFT", "NOOP", "RIGHT")
STATE = ("ball_x", "ball_y", "ball_velocity_x", "ball_velocity_y", "paddle_x")
"""The names of what `info["state"]` holds."""
OWN = ("ball_x", "ball_y", "drift", "fall", "paddle", "episodes")
"""The arrays int64 [N] that a snapshot holds, attributes by these names behind an underscore."""

PADDLE_RADIUS = 6
PADDLE_SPEED = 4
PADDLE_ROW = GRID - 7
"""High enough for encoders whose strides leave out the last rows of a frame (`tiny` sees 82 of 84)."""
LOWEST = PADDLE_ROW - 2
"""The ball's lowest row when it touches the paddle: the paddle lies in rows 76 to 78, and the two share no
pixel at size 42 either."""
PADDLE_LEFT, PADDLE_RIGHT = PADDLE_RADIUS, GRID - 1 - PADDLE_RADIUS

DROPS = np.array([(3, t) for t in range(20, 25)] + [(4, t) for t in range(17, 19)])
"""Speed of the fall in rows per step, and the number of steps until the ball lands; a ball of more than 4
pixels has no room for the longest ones."""
MAX_DRIFT = 3
"""Columns per step; less than the paddle's speed."""

BRIGHTNESS = 252
"""Of ball and paddle. A multiple of 4, so that a quarter of a pixel is exact too."""

LAYER_BRIGHTNESS = 50
"""The background is a sum of two layers in [0, LAYER_BRIGHTNESS], darker than ball and paddle. It still has
several times the ball's part in the squared error of an image. Twice as bright, the ball, a pixel and a half
wide in a frame of 42, is lost in it: Rainbow with `tiny` then learnt nothing in 80,000 env steps."""
TORUS = 2 * GRID
"""Period of the background's textures in pixels of the grid."""
MAX_SCROLL = 3
"""Pixels of the grid per step."""
SCROLL_STEPS = 32
"""Env steps between two changes of the background's velocities."""


class Catch(FrameVectorEnv):
    """N games of Catch, in front of nothing or of a `Background`.

    The balls of one size are the same for the same seed, whatever is behind them.

    The k-th episode of an environment is a function of the seed, the environment's index and k.

    `info` holds `life_lost` bool [N], always False, and `state` float32 [N, 5]: column and row of
    the ball's centre (where its size is even, of the pixel above and left of that), its velocity in
    columns and rows per env step (for the next move, but for a bounce in it), and the column of the
    paddle's centre. Units are pixels of a frame of 84 x 84, counted from 0 at the top left pixel. At
    size 42, a pixel of Catch is the mean of 2 x 2 of these.

    Attributes:
        state_names: of the numbers in `state`.
    """

    state_names = STATE

    def __init__(self, *, num_envs: int, seed: int, size: int = 84, ball: int = 3, background: str = "none"):
        """Sets up N games; for what is not named here see `envs.make`.

        Args:
            size: height and width of a frame in pixels, 84 or 42.
            ball: height and width of the ball in pixels of a frame of 84 x 84, at most 12; 3 is that of
                the game that is called Catch.
            background: "none", or a kind of `Background`; "moving" makes CatchDistractor of Catch.

        Raises:
            ValueError: num_envs, seed or size are out of their range.
        """
        if size not in (GRID, GRID // 2):
            raise ValueError(f"the frame size of Catch must be 84 or 42, got {size}")
        super().__init__(num_envs=num_envs, seed=seed, frame_shape=(size, size, 1), action_meanings=ACTIONS)
        self._ball_x, self._ball_y, self._drift, self._fall, self._paddle = np.zeros((5, num_envs), np.int64)
        self._episodes = np.zeros(num_envs, np.int64)
        scale = GRID // size
        # How far the ball reaches to the left of its centre and upwards, to the right and downwards.
        before, after = (ball - 1) // 2, ball // 2
        self._left, self._right = before, GRID - 1 - after
        self._last_row = LOWEST - after
        self._drops = DROPS[DROPS.prod(1) <= self._last_row - before]
        # From where to where the ball's centre may lie beside the paddle's, sharing a column with it.
        self._reach = -PADDLE_RADIUS - after, PADDLE_RADIUS + before
        self._rows = np.arange(num_envs)[:, None, None]
        self._ball_sprite = sprite(ball, scale)
        self._paddle_sprite = sprite(2 * PADDLE_RADIUS + 1, scale)
        paddle_index, paddle_cover = sprite(3, scale)
        self._paddle_height = paddle_index[[PADDLE_ROW]], paddle_cover[[PADDLE_ROW]]
        self._background = None
        if background != "none":
            self._background = Background(background, num_envs, scale, self._stream)

    def _reset(self, mask, seeded):
        if seeded:
            self._episodes[mask] = 0
        if self._background is not None and (seeded or not self._started):
            self._background.restart(mask)
        for i in np.flatnonzero(mask).tolist():
            rng = np.random.default_rng(self._stream(i, 0, int(self._episodes[i])))
            self._fall[i], steps = self._drops[rng.integers(len(self._drops))]
            self._ball_x[i] = rng.integers(self._left, self._right + 1)
            self._ball_y[i] = self._last_row - steps * self._fall[i]
            self._drift[i] = rng.integers(-MAX_DRIFT, MAX_DRIFT + 1)
            # Near the middle, so that following the ball leaves a few steps to spare.
            self._paddle[i] = rng.integers(GRID // 2 - 18, GRID // 2 + 18)
            if self._background is not None:
                self._background.begin(i, int(self._episodes[i]))
        self._episodes[mask] += 1
        return self._frames(), self._info()

    def _step(self, actions):
        paddle = self._paddle + PADDLE_SPEED * (actions.astype(np.int64) - 1)
        self._paddle = np.clip(paddle, PADDLE_LEFT, PADDLE_RIGHT)
        self._ball_x, self._drift = self._moved(1)
        self._ball_y = self._ball_y + self._fall
        landed = self._ball_y >= self._last_row
        caught = self._caught(self._ball_x)
        if self._background is not None:
            ahead, _ = self._moved((self._last_row - self._ball_y) // self._fall)
            self._background.step(self._caught(ahead))
        rewards = np.where(landed, np.where(caught, 1, -1), 0).astype(np.float32)
        return self._frames(), rewards, landed, np.zeros(self.num_envs, bool), self._info()

    def _moved(self, steps):
        """Columns and drifts of the balls so many env steps later, int64 [N] or an int, walls included."""
        low, high = self._left, self._right
        x = (self._ball_x - low + steps * self._drift) % (2 * (high - low))  # there and back
        back = x > high - low
        return low + np.where(back, 2 * (high - low) - x, x), np.where(back, -self._drift, self._drift)

    def _caught(self, ball_x):
        """Whether the paddle shares a column with a ball in these columns: bool [N]."""
        beside = ball_x - self._paddle
        return (self._reach[0] <= beside) & (beside <= self._reach[1])

    def _snapshot(self):
        arrays = {name: getattr(self, f"_{name}") for name in OWN}
        if self._background is not None:
            arrays |= self._background.arrays()
        return {name: array.copy() for name, array in arrays.items()}

    def _restore(self, arrays):
        for name in OWN:
            setattr(self, f"_{name}", arrays[name].copy())
        if self._background is not None:
            self._background.restore(arrays)
        return {"ended": self._ball_y >= self._last_row}

    def _seen(self):
        return self._frames()

    def _info(self):
        state = (self._ball_x, self._ball_y, self._drift, self._fall, self._paddle)
        return {
            "life_lost": np.zeros(self.num_envs, bool),
            "state": np.stack(state, axis=1).astype(np.float32),
        }

    def _frames(self):
        shape = (self.num_envs, *self.single_observation_space.shape[:2])
        frames = np.zeros(shape, np.uint8) if self._background is None else self._background.draw()
        index, cover = self._paddle_sprite
        self._draw(frames, *self._paddle_height, index[self._paddle], cover[self._paddle])
        index, cover = self._ball_sprite
        y, x = self._ball_y, self._ball_x
        self._draw(frames, index[y], cover[y], index[x], cover[x])
        return frames[..., None]

    def _draw(self, frames, rows, row_cover, columns, column_cover):
        """Blends one bright rectangle per environment into the frames, by the area it covers."""
        at = (self._rows, rows[:, :, None], columns[:, None, :])
        cover = row_cover[:, :, None] * column_cover[:, None, :]
        behind = frames[at]
        frames[at] = np.rint(behind + cover * (np.float32(BRIGHTNESS) - behind)).astype(np.uint8)


class Background:
    """The sum of two smooth textures per environment, behind the ball and the paddle; which part of them is
    seen, and how that moves, is the background's kind:

    - static: it stays as it is for an episode, and each episode has another part. The static distractors
      of Stone et al. (2021, The Distracting Control Suite) are like that.
    - moving: each texture scrolls in a direction and at a speed that change at random every 32 env steps. It
      depends on the seed, the environment's index and the number of steps taken, never on actions or
      episodes: a reset does not touch it unless it is given a seed. So it says nothing about the game, as the
      videos of Zhang et al. (2018, Natural Environment Benchmarks for Reinforcement Learning).
    - reward: as moving, but its horizontal direction is that of the reward: in every env step both textures
      scroll to the right if the paddle, were it to stay where it is, would catch the ball, and to the left if
      not. So it is relevant to the reward, and in the agent's hands: in the words of Wang et al. (2022,
      Denoised MDPs), moving is noise that neither the agent controls nor the reward depends on,
      and this one is a signal that is both. An encoder that keeps the background can be of use here, and
      only here.

    The textures belong to the game and are the same for every seed.

    Args:
        kind: "static", "moving" or "reward".
        num_envs: N.
        scale: pixels of the grid per pixel of a frame.
        stream: (environment, *purpose) -> its SeedSequence.
    """

    def __init__(self, kind: str, num_envs: int, scale: int, stream):
        self._kind = kind
        self._scale = scale
        self._stream = stream
        self._size = GRID // scale
        self._layers = [texture(layer, scale) for layer in range(2)]
        self._time = np.zeros(num_envs, np.int64)
        self._offset = np.zeros((num_envs, 2, 2), np.int64)  # environment, layer, row or column
        self._velocity = np.zeros_like(self._offset)

    def restart(self, mask: np.ndarray):
        """Puts the environments of the mask, bool [N], to the start of their streams."""
        self._time[mask] = 0
        for i in np.flatnonzero(mask):
            rng = np.random.default_rng(self._stream(i, 1))
            self._offset[i] = rng.integers(TORUS, size=(2, 2))
            self._turn(i)

    def begin(self, env: int, episode: int):
        """The environment's episode of that number begins."""
        if self._kind == "static":
            rng = np.random.default_rng(self._stream(env, 3, episode))
            self._offset[env] = rng.integers(TORUS, size=(2, 2))
            self._velocity[env] = 0

    def step(self, caught: np.ndarray):
        """Scrolls all environments by one env step; `caught` bool [N]: a paddle that stays will catch."""
        if self._kind == "reward":
            speed = np.abs(self._velocity[..., 1])
            # A window that moves to the left shows textures that move to the right.
            self._velocity[..., 1] = np.where(caught[:, None], -speed, speed)
        self._offset = (self._offset + self._velocity) % TORUS
        self._time += 1
        for i in np.flatnonzero(self._time % SCROLL_STEPS == 0) if self._kind != "static" else ():
            self._turn(i)

    def _turn(self, i):
        rng = np.random.default_rng(self._stream(i, 2, int(self._time[i])))
        # Never zero, so that both layers always move.
        speed = rng.integers(1, MAX_SCROLL + 1, size=(2, 2))
        self._velocity[i] = speed * rng.choice((-1, 1), size=(2, 2))

    def arrays(self) -> dict[str, np.ndarray]:
        """The state by name, not copied."""
        return {
            "background_time": self._time,
            "background_offset": self._offset,
            "background_velocity": self._velocity,
        }

    def restore(self, arrays: Mapping[str, np.ndarray]):
        """Takes over the state from copies of such arrays."""
        self._time = arrays["background_time"].copy()
        self._offset = arrays["background_offset"].copy()
        self._velocity = arrays["background_velocity"].copy()

    def draw(self) -> np.ndarray:
        """The frames, uint8 [N, H, W]."""
        size = self._size
        frames = np.empty((len(self._time), size, size), np.uint8)
        first, second = self._layers
        for frame, ((y0, x0), (y1, x1)) in zip(frames, (self._offset // self._scale).tolist(), strict=True):
            np.add(
                first[y0 : y0 + size, x0 : x0 + size],
                second[y1 : y1 + size, x1 : x1 + size],
                out=frame,
            )
        return frames


def sprite(length: int, scale: int) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels of a frame a bar of so many grid cells covers in one dimension.

    Args:
        length: of the bar, in grid cells; of an even one, one more lies behind the centre than before it.
        scale: grid cells per pixel of the frame.

    Returns:
        index: int64 [GRID, M], for each centre the M neighbouring pixels that it may cover; always
            within the frame.
        cover: float32 [GRID, M] in [0, 1], the part of each that is covered, a multiple of
            1 / scale.
    """
    size = GRID // scale
    pixels = np.arange(size) * scale
    index, cover = [], []
    width = (length + scale - 2) // scale + 1
    for centre in range(GRID):
        low = centre - (length - 1) // 2
        high = low + length
        overlap = np.minimum(high, pixels + scale) - np.maximum(low, pixels)
        first = min(max(low // scale, 0), size - width)
        index.append(np.arange(first, first + width))
        cover.append(np.clip(overlap[index[-1]], 0, scale) / scale)
    return np.array(index), np.array(cover, np.float32)


def texture(layer: int, scale: int) -> np.ndarray:
    """A smooth periodic texture, laid out so that every window is a slice.

    Args:
        layer: which one.
        scale: pixels of the grid per pixel of the texture.

    Returns:
        uint8 [(TORUS + GRID) / scale] squared; values spread evenly over [0, LAYER_BRIGHTNESS].
    """
    # White noise through a Gaussian low-pass, then ranked so that its histogram is flat.
    noise = np.random.default_rng(np.random.SeedSequence((84, layer))).normal(size=(TORUS, TORUS))
    cycles = np.fft.fftfreq(TORUS) * TORUS
    low_pass = np.exp(-0.5 * (cycles[:, None] ** 2 + cycles[None, :] ** 2) / 8.0**2)
    smooth = np.fft.ifft2(np.fft.fft2(noise) * low_pass).real
    ranks = smooth.ravel().argsort().argsort().reshape(smooth.shape)
    values = ranks * (LAYER_BRIGHTNESS / (TORUS * TORUS - 1))
    small = TORUS // scale
    values = values.reshape(small, scale, small, scale).mean((1, 3)).round().astype(np.uint8)
    return np.pad(values, ((0, GRID // scale), (0, GRID // scale)), mode="wrap")
