"""The update of three arms of the thesis and of DER in PyTorch, eager; a side of `worker`.

Parameters and batch come from srl_jax, and without noise the losses are srl_jax's, so that what is timed is
the same mathematics. It imports nothing of srl_jax: what the two sides share, they state twice.

Here images are [B, C, H, W] and a flattened image runs over C, H, W; srl_jax has [B, H, W, C] and H, W, C.
"""

import time
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F


class Recipe(NamedTuple):
    """What of a preset is not seen from the parameters.

    Attributes:
        strides: the encoder's.
        gain: of pixels in [0, 1].
        n_step, adam_eps, max_grad_norm, slow_update_every: as in srl_jax; a norm of 0 clips nothing.
    """

    strides: tuple[int, ...]
    gain: float = 255.0
    n_step: int = 3
    adam_eps: float = 1e-8
    max_grad_norm: float = 0.0
    slow_update_every: int = 500


RECIPES = {
    "thesis/rl_only_nature": Recipe((4, 2, 1)),
    "thesis/rl_only_256": Recipe((2, 1, 1, 1)),
    "thesis/joint_256": Recipe((2, 1, 1, 1)),
    "atari100k/der": Recipe((5, 5), 1.0, 20, 1.5e-4, 10.0, 2000),
}
"""By preset."""

ATOMS, V_MIN, V_MAX = 51, -10.0, 10.0
LEARNING_RATE = 1e-4
CHECK_ADAM_EPS = 1e-3  # see srl_jax' side
DECODER_WEIGHT_DECAY = 1e-7
WEIGHTS = {"rl": 1.0, "reconstruction": 1.0, "latent_l2": 1e-6}
WARM_UPDATES = 5  # a process' first are slower

ENCODER, HEAD, DECODER = "params/encoder", "params/rl", "params/reconstruction"
SLOW = {ENCODER: "slow/rl/encoder", HEAD: "slow/rl/head"}
"""{parameters: their slow copy}."""


class Learner:
    """The networks of a preset, their optimizers, and the update.

    Args:
        params: srl_jax's `TrainState.params` and `.slow`, by path.
        window: srl_jax's `Window`, with grey frames uint8 [B, S + K, H, W, 1]; the batch of all updates.
        recipe: the preset's.
        memory_format: of images and kernels.
        separate: whether, in joint training, RL's Adam steps first, then the representation's own on the same
            batch, encoded anew, as the thesis' code does; else one Adam steps on the sum of the losses.
        noise: whether the head's layers have noise.
    """

    def __init__(
        self,
        params: dict[str, np.ndarray],
        window: dict[str, np.ndarray],
        recipe: Recipe,
        memory_format: torch.memory_format,
        separate: bool,
        noise: bool,
    ):
        self.window = window | {"frames": window["frames"][..., 0]}
        self.stack = window["frames"].shape[1] - window["actions"].shape[1]
        self.recipe, self.memory_format, self.noisy, self.steps = recipe, memory_format, noise, 0
        self.sizes = [window["frames"].shape[2]]
        for i, stride in enumerate(recipe.strides):
            kernel = params[f"{ENCODER}/Conv_{i}/kernel"]
            self.sizes.append((self.sizes[-1] - len(kernel)) // stride + 1)
        self.maps = (kernel.shape[-1], self.sizes[-1], self.sizes[-1])
        self.params = {path: self._in_torchs_order(path, array) for path, array in params.items()}
        self.noise: dict[str, tuple[Tensor, Tensor]] = {}
        encoder, head, decoder = (
            [x.requires_grad_() for path, x in self.params.items() if path.startswith(group)]
            for group in (ENCODER, HEAD, DECODER)
        )
        groups = [[{"params": encoder + head}]]
        if decoder:
            if separate:
                groups.append([{"params": encoder}])
            groups[-1].append({"params": decoder, "weight_decay": DECODER_WEIGHT_DECAY})
        self.optimizers = [torch.optim.Adam(some, lr=LEARNING_RATE, eps=recipe.adam_eps) for some in groups]
        self.joint = bool(decoder)
        self.support = torch.linspace(V_MIN, V_MAX, ATOMS)

    def _in_torchs_order(self, path: str, value: np.ndarray) -> Tensor:
        """A parameter of srl_jax as PyTorch's functions take it."""
        channels, height, width = self.maps
        if value.ndim == 4:
            value = value.transpose((2, 3, 0, 1) if "ConvTranspose" in path else (3, 2, 0, 1))
        elif len(value) == channels * height * width:  # rows in the order H, W, C
            value = value.reshape(height, width, channels, -1).transpose(2, 0, 1, 3).reshape(value.shape)
        if value.ndim == 2 and "WideDense" not in path:  # which is [outputs, inputs] on both sides
            value = value.T
        found = torch.from_numpy(np.array(value, np.float32, order="C"))
        return found.to(memory_format=self.memory_format) if value.ndim == 4 else found

    def update(self) -> tuple[np.ndarray, dict[str, Tensor]]:
        """One update on the batch: a gradient step, or two.

        Returns:
            The temporal-difference errors, float32 [B], in nats: the cross-entropy of the value distribution
            with its target, which priorities are made of. And the metrics, scalars: each mean loss, their
            weighted sum "total" and the mean of the largest value of s_t.
        """
        batch = {name: torch.from_numpy(array) for name, array in self.window.items()}
        if self.noisy:
            self._draw_noise()
        r_t, discount_t, offset = n_step(
            batch["rewards"], batch["discounts"], batch["valid"], self.recipe.n_step
        )
        pixels_tm1 = self._pixels(batch["frames"][:, : self.stack])
        pixels_t = self._pixels(_stack_at(batch["frames"], offset, self.stack, self.recipe.n_step))

        z_tm1 = self._encode(ENCODER, pixels_tm1)
        logits_tm1 = self._logits(HEAD, z_tm1)
        with torch.no_grad():
            selector_t = self._logits(HEAD, self._encode(ENCODER, pixels_t)).softmax(-1) @ self.support
            slow_logits_t = self._logits(SLOW[HEAD], self._encode(SLOW[ENCODER], pixels_t))
            target = self._target(slow_logits_t, selector_t.argmax(-1), r_t, discount_t)
        rows = torch.arange(len(r_t))
        cross_entropy = -(target * logits_tm1[rows, batch["actions"][:, 0]].log_softmax(-1)).sum(-1)

        losses = {"rl": (cross_entropy * batch["weight"]).mean()}
        first, *second = self.optimizers
        if second:
            self._step(first, losses)
            later = self._representation(self._encode(ENCODER, pixels_tm1), pixels_tm1)
            self._step(*second, later)
            losses |= later
        else:
            if self.joint:
                losses |= self._representation(z_tm1, pixels_tm1)
            self._step(first, losses)
        self.steps += 1
        with torch.no_grad():
            if self.steps % self.recipe.slow_update_every == 0:
                for path, value in self.params.items():
                    for group, slow in SLOW.items():
                        if path.startswith(group):
                            self.params[path.replace(group, slow)].copy_(value)
            td_error = cross_entropy.detach().numpy()
            total = sum(WEIGHTS[name] * loss for name, loss in losses.items())
            q_max = (logits_tm1.softmax(-1) @ self.support).amax(-1).mean()
        metrics = {name: loss.detach() for name, loss in losses.items()}
        return td_error, metrics | {"total": total, "q_max": q_max}

    # Networks, by the path of their parameters

    def _encode(self, path: str, pixels: Tensor) -> Tensor:
        """float32 [B, S, H, W] in [0, 1] -> latents [B, D]; without a bottleneck, the flattened maps."""
        x = pixels * self.recipe.gain
        for i, stride in enumerate(self.recipe.strides):
            x = F.relu(F.conv2d(x, *self._layer(f"{path}/Conv_{i}"), stride))
        x = x.flatten(1)
        if f"{path}/Dense_0/kernel" in self.params:
            x = F.linear(x, *self._layer(f"{path}/Dense_0"))
            x = F.layer_norm(x, x.shape[1:], *self._layer(f"{path}/LayerNorm_0", "scale"), eps=1e-5).tanh()
        return x

    def _decode(self, z: Tensor) -> Tensor:
        """The mirror of an encoder with a bottleneck: [B, D] -> float32 [B, S, H, W], linear at the end."""
        x = F.linear(z, *self._layer(f"{DECODER}/WideDense_0")).view(-1, *self.maps)
        for i, stride in enumerate(reversed(self.recipe.strides)):
            kernel, bias = self._layer(f"{DECODER}/ConvTranspose_{i}")
            smaller, size = self.sizes[-1 - i], self.sizes[-2 - i]
            padding = size - ((smaller - 1) * stride + kernel.shape[-1])
            x = F.conv_transpose2d(F.relu(x), kernel, bias, stride, output_padding=padding)
        return x

    def _logits(self, path: str, z: Tensor) -> Tensor:
        """Rainbow's head: latents [B, D] -> logits [B, A, M], dueling and noisy."""
        q = self._noisy(f"{path}/q_out", F.relu(self._noisy(f"{path}/q_hidden", z))).unflatten(1, (-1, ATOMS))
        v = self._noisy(f"{path}/v_out", F.relu(self._noisy(f"{path}/v_hidden", z))).unflatten(1, (1, ATOMS))
        return q - q.mean(1, keepdim=True) + v

    def _noisy(self, path: str, x: Tensor) -> Tensor:
        """A linear layer with factorised Gaussian noise (Fortunato et al. 2018)."""
        kernel, bias = self._layer(path)
        if self.noisy:
            of_kernel, of_bias = self.noise[path]
            kernel = kernel + self.params[f"{path}/kernel_sigma"] * of_kernel
            bias = bias + self.params[f"{path}/bias_sigma"] * of_bias
        return F.linear(x, kernel, bias)

    def _draw_noise(self) -> None:
        """Draws e, one for all batches until the next: `f(e) = sign(e) sqrt|e|`."""
        for path, sigma in self.params.items():
            if path.endswith("/kernel_sigma"):
                noise = [torch.randn(size) for size in sigma.shape]
                outputs, inputs = (e.sign() * e.abs().sqrt() for e in noise)
                self.noise[path.removesuffix("/kernel_sigma")] = torch.outer(outputs, inputs), outputs

    def _layer(self, path: str, kernel: str = "kernel") -> tuple[Tensor, Tensor]:
        return self.params[f"{path}/{kernel}"], self.params[f"{path}/bias"]

    # Losses

    def _representation(self, z: Tensor, pixels: Tensor) -> dict[str, Tensor]:
        return {
            "reconstruction": F.mse_loss(self._decode(z), pixels),
            "latent_l2": 0.5 * z.square().sum(-1).mean(),
        }

    def _step(self, optimizer: torch.optim.Optimizer, losses: dict[str, Tensor]) -> None:
        optimizer.zero_grad()
        sum(WEIGHTS[name] * loss for name, loss in losses.items()).backward()
        if self.recipe.max_grad_norm:
            moved = [x for group in optimizer.param_groups for x in group["params"]]
            torch.nn.utils.clip_grad_norm_(moved, self.recipe.max_grad_norm)
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


def n_step(rewards: Tensor, discounts: Tensor, valid: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """The n-step return, the discount and the offset of the state bootstrapped from, [B] each.

    Rewards are summed until n steps are done or the episode is over (srl_jax.rl.losses.n_step).
    """
    r_t = torch.zeros(len(rewards))
    discount_t = torch.ones(len(rewards))
    for k in range(n):
        r_t = r_t + valid[:, k] * discount_t * rewards[:, k]
        discount_t = discount_t * torch.where(valid[:, k] > 0, discounts[:, k], 1.0)
    return r_t, discount_t, valid[:, :n].sum(-1).long()


def _stack_at(frames: Tensor, offset: Tensor, size: int, n: int) -> Tensor:
    """Of each row, the `size` frames from its offset on: uint8 [B, size, H, W]."""
    if (offset == n).all():
        return frames[:, n : n + size]
    return frames[torch.arange(len(frames))[:, None], offset[:, None] + torch.arange(size)]


class Updates:
    """A preset's update; `check` comes first.

    Args:
        preset: a key of `RECIPES`.
        threads: PyTorch's.
        memory_format: "contiguous_format" or "channels_last".
        encoder_optimizer: "separate" or "summed", see `Learner`.
    """

    def __init__(self, preset: str, threads: int, memory_format: str, encoder_optimizer: str = "separate"):
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        self._of_side = RECIPES[preset], getattr(torch, memory_format), encoder_optimizer == "separate"

    def check(self, params: dict, window: dict, updates: int) -> list[dict[str, float]]:
        """The losses of the first updates without noise; makes and warms up another learner, which is timed.

        Args:
            params, window: see `Learner`.
            updates: how many.
        """
        recipe, *others = self._of_side
        checked = Learner(params, window, recipe._replace(adam_eps=CHECK_ADAM_EPS), *others, noise=False)
        found = [checked.update()[1] for _ in range(updates)]
        self._learner = Learner(params, window, *self._of_side, noise=True)
        self.turn(WARM_UPDATES)
        return [{name: x.item() for name, x in losses.items() if name != "q_max"} for losses in found]

    def turn(self, updates: int) -> dict[str, list[float]]:
        """Goes on with so many updates. Returns "update", the milliseconds of each."""
        found = []
        for _ in range(updates):
            start = time.perf_counter()
            self._learner.update()
            found.append(1e3 * (time.perf_counter() - start))
        return {"update": found}
