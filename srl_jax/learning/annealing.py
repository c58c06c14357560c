"""n and gamma, annealed over updates after each reset (Schwarzer et al. 2023, section 4); imports no jax."""

import math
from typing import TYPE_CHECKING, NamedTuple

from srl_jax.errors import ConfigError
from srl_jax.specs import Spec, parse_change, value_text

if TYPE_CHECKING:
    from srl_jax.config import Config
    from srl_jax.learning.modes import Mode


class Anneal(NamedTuple):
    """A number that changes from `start` to `end` over the first updates after each reset, and then stays.

    Attributes:
        start, end: n in steps, or gamma.
        updates: until it is there; without resets they count from the start of the run.
    """

    start: float
    end: float
    updates: int

    def __str__(self) -> str:
        """What `parse` reads; of two texts that it reads as the same, the same."""
        return f"{value_text(self.start)}->{value_text(self.end)}@{self.updates}"

    def _between(self, start: float, end: float, updates: int) -> float:
        """The geometric mean of two numbers whose weights are the shares of updates to come and done."""
        done = min(1.0, updates / self.updates)
        return math.exp((1 - done) * math.log(start) + done * math.log(end))

    def n(self, updates: int) -> int:
        """n so many updates after a reset: it falls exponentially, and is rounded."""
        return round(self._between(self.start, self.end, updates))

    def gamma(self, updates: int) -> float:
        """gamma so many updates after a reset: 1 - gamma falls exponentially."""
        return 1.0 - self._between(1.0 - self.start, 1.0 - self.end, updates)


def parse(text: str, kind: type) -> Anneal:
    """Reads `10->3@10000`.

    Args:
        text: two numbers, and updates.
        kind: of the numbers: int for n, at least 1; float for gamma, at least 0 and below 1.

    Raises:
        ValueError: it is not such a text; a reason to follow the value.
    """
    example = "'10->3@10000'" if kind is int else "'0.97->0.997@10000'"
    try:
        found = Anneal(*parse_change(text, kind))
    except ValueError:
        raise ValueError(f"not start->end@updates, in quotes for the shell: {example}") from None
    for number in found[:2]:
        if not (number >= 1 if kind is int else 0 <= number < 1):
            limits = "a whole number from 1" if kind is int else "at least 0 and below 1"
            raise ValueError(f"{value_text(number)} must be {limits}")
    if found.updates < 1:
        raise ValueError("must be annealed over at least 1 update")
    return found


def written(text: str, kind: type) -> str:
    """The one way to write a text of `parse`: "10->3@10000" for "10->3@1e4"; "" stays.

    Raises:
        ConfigError: it is not such a text.
    """
    try:
        return str(parse(text, kind)) if text else ""
    except ValueError as error:
        raise ConfigError(f"--{'n' if kind is int else 'gamma'}_anneal={text}: {error}") from None


def check(config: "Config", mode: "Mode") -> None:
    """Raises ConfigError, a line that names the flag, where those of annealing and resets do not fit."""
    for name, kind in (("n_anneal", int), ("gamma_anneal", float)):
        if not (text := getattr(config, name)):
            continue
        end = parse(written(text, kind), kind).end
        if kind is float and end != config.gamma:
            raise ConfigError(
                f"--{name}={text}: ends at --gamma, which is {config.gamma}; give --gamma={end}"
            )
    if config.reset == "none":
        return
    if not config.reset_every:
        raise ConfigError(f"--reset={config.reset}: give --reset_every, the env steps between two resets")
    if 0 < config.reset_last < config.reset_every:
        every = f"--reset_every={config.reset_every}"
        raise ConfigError(f"--reset_last={config.reset_last}: is before the first reset, see {every}")
    if config.reset == "all" and not (mode.rl_trains_encoder or mode.representation_trains_encoder):
        never = f"--mode={mode.name} never moves the encoder, which that shrinks"
        raise ConfigError(f"--reset=all: {never}; give --reset=head")


def check_n(text: str, rl: Spec) -> None:
    """Raises ConfigError where n does not fit --rl: windows are made for its n_step, the larger n."""
    smallest, largest = sorted(parse(text, int)[:2])
    found = rl.resolved.get("n_step")
    if found is None:
        raise ConfigError(f"--n_anneal={text}: --rl={rl.name} has no option n_step")
    if found != largest:
        raise ConfigError(
            f"--n_anneal={text}: --rl has n_step={found}; give --rl=:n_step={largest}, the larger n"
        )
    if (target := rl.resolved.get("target", "s_t+n")) != "s_t+n" and smallest < 2:
        raise ConfigError(f"--n_anneal={text}: with --rl=:target={target} n is at least 2")
