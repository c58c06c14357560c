"""The types of the project: what moves between replay, update and the losses.

Shapes use B for batch, S for stacked frames (4), K for the window's horizon, H, W and C for a frame's height,
width and channels (1 grey, 3 colour), D for the latent's size. An observation has S * C channels, frame by
frame: channel s * C + c is c of frame s, and the newest frame is the last.
Nothing here imports jax, so that a command line can be checked without paying for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array: TypeAlias = jax.Array | np.ndarray
    Offsets: TypeAlias = int | Array | Sequence[int | Array]
else:  # nobody pays for jax who only reads the names
    Array = Offsets = Any

Params: TypeAlias = Any
"""A tree of float32 arrays."""


class Window(NamedTuple):
    """B short stretches of experience: K + 1 observations' worth of single frames.

    Offset k means the observation s_{t+k}; s_t is the one that was sampled. Observations are stacks of S
    frames, and neighbours share S - 1 of them, so a window holds S + K frames, not S * (K + 1).

    Frames never cross an episode: before the first frame of an episode the first frame is repeated,
    after the last one the last one is repeated (those offsets have `valid` = 0).

    Attributes:
        frames: uint8 [B, S + K, H, W, C]; frame i belongs to time t - S + 1 + i.
        actions: int32 [B, K]; `actions[:, k]` was taken in s_{t+k}. Zero where not valid.
        rewards: float32 [B, K]; `rewards[:, k]` followed `actions[:, k]`, as learnt from (clipped or
            not is the loop's choice). Zero where not valid.
        discounts: float32 [B, K]; gamma, or 0 where s_{t+k+1} is terminal (game over, or a lost life
            where the run counts that as terminal). No loss ever sees `done`. Zero where not valid.
        valid: float32 [B, K]; 1 while s_{t+k+1} belongs to the same episode as s_t, then 0 for good.
            The final observation of an episode belongs to it. `valid[:, 0]` is always 1.
        weight: float32 [B]; importance weights, divided by the batch's maximum.
        n_step: int32 [B]; n of RL's return where that is annealed, at most K; None: as RL itself says.
    """

    frames: Array
    actions: Array
    rewards: Array
    discounts: Array
    valid: Array
    weight: Array
    n_step: Array | None = None


class Encoder(NamedTuple):
    """An encoder, as pure functions, and the recipe of the decoder that mirrors it.

    Attributes:
        init: key -> params.
        apply: (params, uint8 [B, H, W, S * C]) -> float32 [B, D]; divides by 255 on entry. Images that are
            already float32 in [0, 1] pass as they are.
        features: D.
        observation_shape: (H, W, S * C).
        make_decoder: (extra_inputs: int = 0) -> Decoder; its input is the latent joined with that many
            more numbers (a one-hot action, say). None where there is no decoder.
        map_shape: (H', W', C') of the maps that the latent is, flattened; None where it is behind a linear
            layer or a pool, or nothing is known of it.
        steps: what `apply` computes, step by step, for a program without this one, see
            `srl_jax.encoders.files.to_npz`; None where nothing says it.
        make_tied_decoder: () -> Decoder whose convolutions have the transposes of the encoder's kernels; None
            where there is none.
        train: (params, observations as of `apply`, key) -> latents as the losses of an update see them, with
            noise of the key; None where they are those of `apply`.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[[Params, Array], jax.Array]
    features: int
    observation_shape: tuple[int, ...]
    make_decoder: MakeDecoder | None
    map_shape: tuple[int, ...] | None = None
    steps: Sequence[Mapping[str, Any]] | None = None
    make_tied_decoder: Callable[[], Decoder] | None = None
    train: Callable[[Params, Array, jax.Array], jax.Array] | None = None


class Decoder(NamedTuple):
    """A decoder, pure functions: init(key) -> params; apply(params, [B, D + extra]) -> [B, H, W, S * C].

    What it `reads` of other groups is among the params of apply, as an objective's of `Objective.reads`.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[[Params, Array], jax.Array]
    reads: Mapping[str, Callable[[Params], Params]] = MappingProxyType({})


class MakeDecoder(Protocol):
    """The type of `Encoder.make_decoder`."""

    def __call__(self, extra_inputs: int = 0) -> Decoder: ...


def no_decoder(extra_inputs: int = 0) -> Decoder:
    """`Context.make_decoder` where there is no decoder.

    Raises:
        ValueError: always; an objective that asks for a decoder cannot be built.
    """
    raise ValueError("it needs a decoder, and the encoder has none")


class Layer(NamedTuple):
    """A layer of another group of parameters, which an objective may compute with, see `Objective.reads`.

    Attributes:
        group: that it is a part of.
        features: its outputs.
        part: the group's tree -> the layer's own parameters, a part of it.
        apply: (the layer's own parameters, float32 [B, D]) -> float32 [B, features].
    """

    group: str
    features: int
    part: Callable[[Params], Params]
    apply: Callable[[Params, Array], jax.Array]


class Context(NamedTuple):
    """What a factory may know of the run that it is built for: what it stands on.

    Attributes:
        features: D, the latent's size.
        num_actions: A.
        make_decoder: as of `Encoder`; raises ValueError where there is no decoder.
        map_shape, make_tied_decoder: as of `Encoder`.
        rl_layer: the first layer of RL's head, where RL is trained and its head has one that reads latents.
    """

    features: int
    num_actions: int
    make_decoder: MakeDecoder = no_decoder
    map_shape: tuple[int, ...] | None = None
    make_tied_decoder: Callable[[], Decoder] | None = None
    rl_layer: Layer | None = None

    @classmethod
    def of(cls, encoder: Encoder, num_actions: int) -> Context:
        """The context of objectives over an encoder."""
        decoder = encoder.make_decoder or no_decoder
        return cls(encoder.features, num_actions, decoder, encoder.map_shape, encoder.make_tied_decoder)


def no_other_window(window: Window) -> Latents:
    """`Latents.of` where latents do not come from windows.

    Raises:
        ValueError: always.
    """
    raise ValueError("these latents are not those of a window")


class Latents(NamedTuple):
    """The latents of a window's observations under the online and the slow encoder.

    `online(k)` and `slow(k)` give float32 [B, D] for offset k, an int or an int32 array [B] (one offset
    per row). For a sequence of K offsets, a list say, they give float32 [K, B, D], by one call of the encoder
    with K * B rows.

    The same offset is encoded at most once per trace, however many objectives ask for it. Offsets are the
    same if they are equal ints, one and the same array, or arrays of equal numbers where these are known
    when they are traced, as those of numpy arrays are. The same list is encoded once, too, and so is an
    offset that a list holds twice. But an offset alone and the same offset in a list are both encoded, and
    so are the offsets that two different lists share: what one objective asks for never changes the
    roundings of what another one sees.

    An objective without a slow copy of the encoder has the online encoder's latents as slow ones, without
    gradient.

    `of(window)` are the latents of another window under the same encoders: of a view of this one, say, that
    an objective has drawn with its own key. What it encodes is nobody else's.
    """

    online: Callable[[Offsets], jax.Array]
    slow: Callable[[Offsets], jax.Array]
    of: Callable[[Window], Latents] = no_other_window


class Objective(NamedTuple):
    """One term of the loss, and the parameters that only it uses. Reinforcement learning is one too.

    Attributes:
        init: key -> head parameters (may be an empty dict).
        loss: (head, slow_head, latents, window, key) -> (losses [B], metrics: dict of scalars, or of an
            array for `td_error`, see `srl_jax.rl.Algorithm`).
        weight: the factor of its batch mean in the sum of a pass; a `srl_jax.specs.Weight` is a schedule of
            it, or a ratio of gradients. A factory passes on what it is given.
        horizon: how many steps after s_t it reads.
        slow: how its head's slow copy follows, (new, old, step) -> slow; None if it has none. A rule that
            changes nothing but in every k-th step may say so by an attribute `every` = k.
        is_decoder: the head is a decoder, which the optimizer's decoder weight decay applies to.
        image: None, or (head, latents, window) -> (target, output), float32 [B, H, W, S * C] each, for the
            picture that shows what it learnt.
        reads: {group: its tree -> a part of it}: parameters of other groups that the loss and the image
            compute with. Heads, slow ones too, have each part under the name of its group, beside their own
            parameters, a dict then. Where the mode lets the objective train the encoder, its gradient flows
            into what it reads, whose group an optimizer moves as `srl_jax.learning.update.passes` says;
            elsewhere none does.
        own_views: its loss draws views of its own, for `Latents.of`, and is handed the window as replay has
            it, whatever view the run shows other losses. Its row has an option `view`, by which it is known
            that no flag's view is read.
    """

    init: Callable[[jax.Array], Params]
    loss: Callable[[Params, Params, Latents, Window, jax.Array], tuple[Array, Mapping[str, Array]]]
    weight: float = 1.0
    horizon: int = 0
    slow: Callable[[Params, Params, Array], Params] | None = None
    is_decoder: bool = False
    image: Callable[[Params, Latents, Window], tuple[Array, Array]] | None = None
    reads: Mapping[str, Callable[[Params], Params]] = MappingProxyType({})
    own_views: bool = False

    def read(self, params: Mapping[str, Params]) -> dict[str, Params]:
        """{group: the part that it reads} of all parameters."""
        return {group: part(params[group]) for group, part in self.reads.items()}

    def head(self, own: Params, read: Mapping[str, Params]) -> Params:
        """What its loss and its image are handed as a head: its own parameters and what it reads."""
        return own | read if read else own


class TrainState(NamedTuple):
    """Everything that an update changes.

    Attributes:
        params: {"encoder": tree, OBJECTIVE: its head's tree}.
        slow: {objective: {"encoder": tree, "head": tree}}, the lagged copies of those that have some; real
            copies, never the same buffers. The encoder is {} where targets are encoded by the online one.
            "read" beside them, {group: part}, is of what the objective reads, where it does.
        opt_state: {group: Adam's state}: "encoder", "encoder_srl" where it has two, and each head that moves;
            "rl_srl" where an objective with an Adam of its own for the encoder reads RL's head.
        step: int32, updates done.
        key: the run's key; update i uses fold_in(key, i), so it never changes.
        norms: running means of norms, see `srl_jax.learning.weights`; None where no weight is a ratio.
    """

    params: Params
    slow: Params
    opt_state: Any
    step: Array
    key: Array
    norms: Any = None
