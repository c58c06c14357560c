"""The update of three arms of the thesis in PyTorch, eager, as its users write it; answers `worker` requests.

`python -m experiments.benchmarks.torch_side`. Parameters and batch come from srl_jax, and without noise the
losses are srl_jax's (handler `check`), so that what is timed (handler `time`) is the same mathematics. It
imports nothing of srl_jax: what the two sides share, they state twice.

Here images are [B, C, H, W] and a flattened image runs over C, H, W; srl_jax has [B, H, W, C] and H, W, C.
"""

import math
import platform
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .worker import serve

INPUT_GAIN = 32.0  # the presets' option gain
N_STEP = 3
ATOMS, V_MIN, V_MAX = 51, -10.0, 10.0
INIT_STD = 1.0  # the presets' option: of the value distribution at the start, in units of reward
HIDDEN = 512
LEARNING_RATE, ADAM_EPS = 1e-4, 1e-8
CHECK_ADAM_EPS = 1e-3  # see srl_jax' side
DECODER_WEIGHT_DECAY = 1e-7
SLOW_UPDATE_EVERY = 500  # updates
WEIGHTS = {"rl": 1.0, "reconstruction": 1.0, "latent_l2": 1e-6}


class Arm(NamedTuple):
    """What distinguishes the arms.

    Attributes:
        layers: the encoder's convolutions: channels, kernel, stride.
        features: size of its bottleneck, 0 for none.
        joint: whether reconstruction and latent L2 are trained beside RL.
    """

    layers: tuple[tuple[int, int, int], ...]
    features: int
    joint: bool


_NATURE = ((32, 8, 4), (64, 4, 2), (64, 3, 1))
_SAC_AE = ((32, 3, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1))
ARMS = {
    "rl_only_nature": Arm(_NATURE, 0, False),
    "rl_only_256": Arm(_SAC_AE, 256, False),
    "joint_256": Arm(_SAC_AE, 256, True),
}


class Encoder(nn.Module):
    """float32 [B, S, H, W] in [0, 1] -> latents [B, D]; without a bottleneck, the flattened maps.

    Attributes:
        maps: (C, H, W) of the last convolution's output.
    """

    def __init__(self, arm: Arm, channels: int, sizes: list[int]):
        super().__init__()
        inputs = [channels] + [layer[0] for layer in arm.layers]
        self.convs = nn.ModuleList(
            nn.Conv2d(i, o, k, s) for i, (o, k, s) in zip(inputs, arm.layers, strict=False)
        )
        self.maps = (inputs[-1], sizes[-1], sizes[-1])
        self.bottleneck = None
        self.features = math.prod(self.maps)
        if arm.features:
            self.bottleneck = nn.Sequential(
                nn.Linear(self.features, arm.features), nn.LayerNorm(arm.features, eps=1e-5), nn.Tanh()
            )
            self.features = arm.features

    def forward(self, pixels: Tensor) -> Tensor:
        x = pixels * INPUT_GAIN
        for conv in self.convs:
            x = F.relu(conv(x))
        x = x.flatten(1)
        return x if self.bottleneck is None else self.bottleneck(x)


class Decoder(nn.Module):
    """The mirror of an `Encoder` with a bottleneck: [B, D] -> float32 [B, S, H, W], linear at the end."""

    def __init__(self, arm: Arm, channels: int, sizes: list[int], maps: tuple[int, int, int]):
        super().__init__()
        self.maps = maps
        self.linear = nn.Linear(arm.features, math.prod(maps))
        outputs = [channels] + [layer[0] for layer in arm.layers[:-1]]
        self.convs = nn.ModuleList()
        for i in reversed(range(len(arm.layers))):
            inputs, kernel, stride = arm.layers[i]
            padding = sizes[i] - ((sizes[i + 1] - 1) * stride + kernel)
            self.convs.append(nn.ConvTranspose2d(inputs, outputs[i], kernel, stride, output_padding=padding))

    def forward(self, z: Tensor) -> Tensor:
        x = F.relu(self.linear(z)).view(-1, *self.maps)
        for conv in self.convs[:-1]:
            x = F.relu(conv(x))
        return self.convs[-1](x)


class NoisyLinear(nn.Module):
    """A linear layer with factorised Gaussian noise (Fortunato et al. 2018); in eval mode with its means.

    `reset_noise` draws e, one for all batches until the next: `f(e) = sign(e) sqrt|e|`.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        for name, shape in (("weight", (outputs, inputs)), ("bias", (outputs,))):
            setattr(self, f"{name}_mu", nn.Parameter(torch.zeros(shape)))
            setattr(self, f"{name}_sigma", nn.Parameter(torch.zeros(shape)))
            self.register_buffer(f"{name}_epsilon", torch.zeros(shape))

    def reset_noise(self) -> None:
        outputs, inputs = self.weight_mu.shape
        noise_in, noise_out = _signed_sqrt(torch.randn(inputs)), _signed_sqrt(torch.randn(outputs))
        self.weight_epsilon.copy_(torch.outer(noise_out, noise_in))
        self.bias_epsilon.copy_(noise_out)

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return F.linear(x, self.weight_mu, self.bias_mu)
        weight = self.weight_mu + self.weight_sigma * self.weight_epsilon
        return F.linear(x, weight, self.bias_mu + self.bias_sigma * self.bias_epsilon)


def _signed_sqrt(x: Tensor) -> Tensor:
    return x.sign() * x.abs().sqrt()


class QNetwork(nn.Module):
    """Rainbow's head: latents [B, D] -> logits [B, A, M], dueling and noisy.

    The prior is the logits of a normal around 0, added to the state's.
    """

    def __init__(self, features: int, num_actions: int):
        super().__init__()
        self.num_actions = num_actions
        self.q_hidden = NoisyLinear(features, HIDDEN)
        self.q_out = NoisyLinear(HIDDEN, num_actions * ATOMS)
        self.v_hidden = NoisyLinear(features, HIDDEN)
        self.v_out = NoisyLinear(HIDDEN, ATOMS)
        self.register_buffer("prior", -0.5 * (_support() / INIT_STD) ** 2, persistent=False)

    def forward(self, z: Tensor) -> Tensor:
        q = self.q_out(F.relu(self.q_hidden(z))).view(-1, self.num_actions, ATOMS)
        v = self.v_out(F.relu(self.v_hidden(z))).view(-1, 1, ATOMS)
        return q - q.mean(1, keepdim=True) + v + self.prior

    def reset_noise(self) -> None:
        for layer in (self.q_hidden, self.q_out, self.v_hidden, self.v_out):
            layer.reset_noise()


class Network(nn.Module):
    """Encoder and head: what has a slow copy."""

    def __init__(self, arm: Arm, channels: int, sizes: list[int], num_actions: int):
        super().__init__()
        self.encoder = Encoder(arm, channels, sizes)
        self.head = QNetwork(self.encoder.features, num_actions)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.head(self.encoder(pixels))


class Learner:
    """The networks of an arm, their optimizer, and the update."""

    def __init__(
        self,
        arm: str,
        params: dict[str, np.ndarray],
        window: dict[str, np.ndarray],
        num_actions: int,
        memory_format: torch.memory_format,
        encoder_optimizer: str,
        adam_eps: float = ADAM_EPS,
    ):
        """Builds everything.

        Args:
            arm: a key of `ARMS`.
            params: srl_jax's `TrainState.params` and `.slow`, by path.
            window: srl_jax's `Window`, grey frames uint8 [B, S + K, H, W, 1] and the rest: one batch for all
                updates.
            num_actions: A.
            memory_format: of images and kernels.
            encoder_optimizer: "summed": one Adam on the sum of the losses; "separate": RL's Adam steps, then
                the representation's own on the same batch, encoded anew, as the thesis' code does.
            adam_eps: Adam's epsilon.

        Raises:
            ValueError: parameters that do not fit the arm.
        """
        layers = ARMS[arm].layers
        window = window | {"frames": window["frames"][..., 0]}
        channels = window["frames"].shape[1] - window["actions"].shape[1]
        sizes = [window["frames"].shape[-1]]
        for _, kernel, stride in layers:
            sizes.append((sizes[-1] - kernel) // stride + 1)
        self.window, self.stack, self.memory_format = window, channels, memory_format
        self.online = Network(ARMS[arm], channels, sizes, num_actions)
        self.slow = Network(ARMS[arm], channels, sizes, num_actions).requires_grad_(False)
        self.decoder = None
        left = dict(params)
        _load(self.online, left, "params/encoder", "params/rl")
        _load(self.slow, left, "slow/rl/encoder", "slow/rl/head")
        groups: list[dict[str, Any]] = [{"params": list(self.online.parameters())}]
        second: list[dict[str, Any]] = []
        if ARMS[arm].joint:
            self.decoder = Decoder(ARMS[arm], channels, sizes, self.online.encoder.maps)
            _load_decoder(self.decoder, left)
            self.decoder.to(memory_format=memory_format)
            decoder = {"params": list(self.decoder.parameters()), "weight_decay": DECODER_WEIGHT_DECAY}
            if encoder_optimizer == "separate":
                second = [{"params": list(self.online.encoder.parameters())}, decoder]
            else:
                groups.append(decoder)
        if left:
            raise ValueError(f"{arm} has no {', '.join(sorted(left))}")
        self.online.to(memory_format=memory_format)
        self.slow.to(memory_format=memory_format)
        self.parameters = list({p for group in groups + second for p in group["params"]})
        self.optimizer = torch.optim.Adam(groups, lr=LEARNING_RATE, eps=adam_eps)
        self.second = torch.optim.Adam(second, lr=LEARNING_RATE, eps=adam_eps) if second else None
        self.support = _support()
        self.steps = 0

    def noise(self, on: bool) -> None:
        """Has noisy layers act with noise, or with their means."""
        self.online.train(on)
        self.slow.train(on)

    def update(self) -> tuple[np.ndarray, dict[str, Tensor]]:
        """One update on the batch: a gradient step, or two.

        Returns:
            The temporal-difference errors, float32 [B], in nats: the Kullback-Leibler divergence of the value
            distribution from its target, which priorities are made of. And the metrics, scalars: each mean
            loss, their weighted sum "total" and the mean of the largest value of s_t.
        """
        batch = {name: torch.from_numpy(array) for name, array in self.window.items()}
        if self.online.training:
            self.online.head.reset_noise()
            self.slow.head.reset_noise()
        r_t, discount_t, offset = n_step(batch["rewards"], batch["discounts"], batch["valid"])
        pixels_tm1 = self._pixels(batch["frames"][:, : self.stack])
        pixels_t = self._pixels(_stack_at(batch["frames"], offset, self.stack))

        z_tm1 = self.online.encoder(pixels_tm1)
        logits_tm1 = self.online.head(z_tm1)
        with torch.no_grad():
            selector_t = self.online(pixels_t).softmax(-1) @ self.support
            target = self._target(self.slow(pixels_t), selector_t.argmax(-1), r_t, discount_t)
        rows = torch.arange(len(r_t))
        cross_entropy = -(target * logits_tm1[rows, batch["actions"][:, 0]].log_softmax(-1)).sum(-1)

        losses = {"rl": (cross_entropy * batch["weight"]).mean()}
        if self.second is not None:
            self._step(self.optimizer, losses)
            later = self._representation(self.online.encoder(pixels_tm1), pixels_tm1)
            self._step(self.second, later)
            losses |= later
        else:
            if self.decoder is not None:
                losses |= self._representation(z_tm1, pixels_tm1)
            self._step(self.optimizer, losses)
        total = sum(WEIGHTS[name] * loss.detach() for name, loss in losses.items())
        self.steps += 1
        if self.steps % SLOW_UPDATE_EVERY == 0:
            self.slow.load_state_dict(self.online.state_dict())

        with torch.no_grad():
            entropy = -(target * target.clamp(min=1e-30).log()).sum(-1)
            td_error = (cross_entropy - entropy).clamp(min=0).numpy()
            q_max = (logits_tm1.softmax(-1) @ self.support).amax(-1).mean()
        metrics = {name: loss.detach() for name, loss in losses.items()}
        return td_error, metrics | {"total": total, "q_max": q_max}

    def _representation(self, z: Tensor, pixels: Tensor) -> dict[str, Tensor]:
        return {
            "reconstruction": F.mse_loss(self.decoder(z), pixels),
            "latent_l2": 0.5 * z.square().sum(-1).mean(),
        }

    def _step(self, optimizer: torch.optim.Optimizer, losses: dict[str, Tensor]) -> None:
        optimizer.zero_grad()
        sum(WEIGHTS[name] * loss for name, loss in losses.items()).backward()
        optimizer.step()

    def _pixels(self, frames: Tensor) -> Tensor:
        return frames.to(torch.float32, memory_format=self.memory_format) / 255

    def _target(self, slow_logits: Tensor, actions: Tensor, r_t: Tensor, discount_t: Tensor) -> Tensor:
        """The projected distribution of Bellemare et al. (2017), float32 [B, M]."""
        probs = slow_logits[torch.arange(len(actions)), actions].softmax(-1)
        moved = (r_t[:, None] + discount_t[:, None] * self.support).clamp(V_MIN, V_MAX)
        spacing = (V_MAX - V_MIN) / (ATOMS - 1)
        share = (1 - (moved[:, None, :] - self.support[:, None]).abs() / spacing).clamp(0, 1)
        return (share * probs[:, None, :]).sum(-1)


def n_step(rewards: Tensor, discounts: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The n-step return, the discount and the offset of the state bootstrapped from, [B] each.

    Rewards are summed until `N_STEP` steps are done or the episode is over (srl_jax.rl.losses.n_step).
    """
    r_t = torch.zeros(len(rewards))
    discount_t = torch.ones(len(rewards))
    for k in range(N_STEP):
        r_t = r_t + valid[:, k] * discount_t * rewards[:, k]
        discount_t = discount_t * torch.where(valid[:, k] > 0, discounts[:, k], 1.0)
    return r_t, discount_t, valid[:, :N_STEP].sum(-1).long()


def _stack_at(frames: Tensor, offset: Tensor, size: int) -> Tensor:
    """Of each row, the `size` frames from its offset on: uint8 [B, size, H, W]."""
    if (offset == N_STEP).all():
        return frames[:, N_STEP : N_STEP + size]
    return frames[torch.arange(len(frames))[:, None], offset[:, None] + torch.arange(size)]


def _support() -> Tensor:
    return torch.linspace(V_MIN, V_MAX, ATOMS)


def _load(network: Network, params: dict[str, np.ndarray], prefix: str, head: str) -> None:
    """Copies an encoder and its RL head, of these paths, and takes what it copied out of params."""
    encoder, maps = network.encoder, network.encoder.maps
    for i, conv in enumerate(encoder.convs):
        _load_conv(conv, params, f"{prefix}/Conv_{i}", (3, 2, 0, 1))
    if encoder.bottleneck is not None:
        linear, norm, _ = encoder.bottleneck
        name = f"{prefix}/Dense_0"
        _set(linear.weight, _rows_chw(params.pop(f"{name}/kernel"), maps).T)
        _set(linear.bias, params.pop(f"{name}/bias"))
        name = f"{prefix}/LayerNorm_0"
        _set(norm.weight, params.pop(f"{name}/scale"))
        _set(norm.bias, params.pop(f"{name}/bias"))
    for layer in ("q_hidden", "q_out", "v_hidden", "v_out"):
        noisy, name = getattr(network.head, layer), f"{head}/{layer}"
        for ours, theirs in (("mu", ""), ("sigma", "_sigma")):
            kernel = params.pop(f"{name}/kernel{theirs}")
            if layer.endswith("hidden") and encoder.bottleneck is None:
                kernel = _rows_chw(kernel, maps)
            _set(getattr(noisy, f"weight_{ours}"), kernel.T)
            _set(getattr(noisy, f"bias_{ours}"), params.pop(f"{name}/bias{theirs}"))


def _load_decoder(decoder: Decoder, params: dict[str, np.ndarray]) -> None:
    """As `_load`, a decoder."""
    name = "params/reconstruction"
    _set(decoder.linear.weight, _rows_chw(params.pop(f"{name}/WideDense_0/kernel"), decoder.maps))
    _set(decoder.linear.bias, _rows_chw(params.pop(f"{name}/WideDense_0/bias"), decoder.maps))
    for i, conv in enumerate(decoder.convs):
        _load_conv(conv, params, f"{name}/ConvTranspose_{i}", (2, 3, 0, 1))


def _load_conv(conv: nn.Module, params: dict[str, np.ndarray], name: str, axes: tuple[int, ...]) -> None:
    _set(conv.weight, params.pop(f"{name}/kernel").transpose(axes))
    _set(conv.bias, params.pop(f"{name}/bias"))


def _rows_chw(array: np.ndarray, maps: tuple[int, int, int]) -> np.ndarray:
    """Rows in the order H, W, C -> in the order C, H, W; [H * W * C, ...]."""
    channels, height, width = maps
    rows = array.reshape(height, width, channels, -1).transpose(2, 0, 1, 3)
    return rows.reshape(array.shape)


def _set(parameter: nn.Parameter, value: np.ndarray) -> None:
    if parameter.shape != value.shape:
        raise ValueError(f"a parameter of {tuple(parameter.shape)} cannot hold {value.shape}")
    with torch.no_grad():
        parameter.copy_(torch.from_numpy(np.array(value, np.float32, order="C")))


def _read(path: str) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


class Side:
    """The handlers; `setup` comes first."""

    def setup(
        self,
        arm: str,
        params: str,
        window: str,
        threads: int = 2,
        memory_format: str = "contiguous",
        num_actions: int = 6,
        encoder_optimizer: str = "separate",
    ) -> dict[str, Any]:
        """Builds an arm's learner.

        Args:
            arm: a key of `ARMS`.
            params: path of an .npz of srl_jax's parameters by path, as `params/encoder/Conv_0/kernel`.
            window: path of an .npz of srl_jax's `Window`.
            threads: PyTorch's.
            memory_format: "contiguous" or "channels_last".
            num_actions: A.
            encoder_optimizer: see `Learner`.

        Returns:
            "versions" of PyTorch and Python; "parameters", how many numbers are trained.
        """
        formats = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        self._arguments = (
            arm, _read(params), _read(window), num_actions, formats[memory_format], encoder_optimizer,
        )  # fmt: skip
        self._learner = Learner(*self._arguments)
        versions = {"torch": torch.__version__, "python": platform.python_version()}
        return {"versions": versions, "parameters": sum(p.numel() for p in self._learner.parameters)}

    def check(self, updates: int = 2) -> dict[str, Any]:
        """The mean losses of the first updates without noise, before weights, and their weighted sum "total".

        From the parameters that setup was given, on networks of its own.
        """
        learner = Learner(*self._arguments, CHECK_ADAM_EPS)
        learner.noise(False)
        return {"losses": [self._losses(learner) for _ in range(updates)]}

    def time(self, updates: int) -> dict[str, Any]:
        """Does so many updates with noise, from where the last call left off; a process' first are slower.

        Returns:
            "seconds" of each, by the wall clock.
        """
        self._learner.noise(True)
        return {"seconds": list(self._timed(updates))}

    def _losses(self, learner: Learner) -> dict[str, float]:
        _, metrics = learner.update()
        return {name: value.item() for name, value in metrics.items() if name in WEIGHTS or name == "total"}

    def _timed(self, updates: int) -> Iterator[float]:
        for _ in range(updates):
            start = time.perf_counter()
            self._learner.update()
            yield time.perf_counter() - start


if __name__ == "__main__":
    side = Side()
    serve({"setup": side.setup, "check": side.check, "time": side.time})
