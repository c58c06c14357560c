"""Plays policies that learn nothing.

    python -m experiments.reference_policies --games=Catch,Pong --episodes=100

A random policy draws its actions uniformly; a no-op policy always does NOOP, and in Catch leaves the paddle
where it is. Both play whole games for raw scores, under the protocol that the flags say, as a run's
evaluations do. The table goes to stdout; `--out=FILE.csv` also replaces or adds these rows in a file, each as
soon as it has been played. srl_jax/data/reference_policies.csv was made like that.

Exit status: 0, or 128 + n after signal n; what was played until then is kept.
"""

import contextlib
import csv
import functools
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import envs
from srl_jax.config import INFOS, Config
from srl_jax.data import POLICIES, ReferencePolicy, policies_from
from srl_jax.errors import ConfigError, saving
from srl_jax.files.display import Progress
from srl_jax.files.reading import replace_text
from srl_jax.specs import Info, choices_text, value_text
from srl_jax.training import check_game

from .command_line import flags as config_flags
from .command_line import paths
from .command_line.stopping import signals

MOST_ENVS = 100
"""Games that are played side by side."""
PROTOCOL = ("sticky_actions", "noop_max", "eval_max_steps")
"""Fields of Config that a policy's returns depend on."""


def play(policy: str, config: Config, episodes: int, stop=lambda: False) -> ReferencePolicy | None:
    """Plays a policy, and shows on stderr how far it is.

    Args:
        policy: one of `srl_jax.data.POLICIES`.
        config: of which the game, the protocol and the seed count.
        episodes: games to play.
        stop: once it says so, the games are left and there is no result.

    Raises:
        ConfigError: the policy is no-op, and the game has no such action.
    """
    from srl_jax.run.actor import make_env, random_policy, seed_for
    from srl_jax.run.evaluate import evaluate, telling

    seed = functools.partial(seed_for, config.seed, "reference policy", policy)
    number = min(episodes, MOST_ENVS)
    env = make_env(config, "eval", number, seed=seed("environments"))
    with contextlib.closing(env), Progress(episodes, "games") as progress:
        progress.note(f"{config.game}, {policy} policy, {episodes:,} games")
        act = random_policy(int(env.single_action_space.n), np.random.default_rng(seed("actions")))
        if policy == "no-op":
            if "NOOP" not in env.action_meanings:
                raise ConfigError(f"--policies=no-op: {config.game} has no action NOOP; valid: random")
            noop = np.full(number, env.action_meanings.index("NOOP"), np.int32)
            act = lambda *_: noop  # noqa: E731
        played = evaluate(
            act,
            env,
            games=episodes,
            seed=seed("games"),
            epsilon=0.0,
            stack=1,
            max_steps=config.eval_max_steps,
            stop=stop,
            told=telling(progress, episodes, number, config.eval_max_steps),
        )
    if played is None:
        return None
    known = envs.game(config.game).options
    return ReferencePolicy(
        config.game,
        policy,
        round(float(np.mean(played.returns)), 6),
        round(float(np.std(played.returns, ddof=1)), 6) if episodes > 1 else None,
        episodes,
        round(float(np.mean(played.lengths)), 3),
        config.sticky_actions if "sticky_actions" in known else None,
        config.noop_max if "noop_max" in known else None,
        config.eval_max_steps,
        _command(config, policy, episodes),
    )


def _command(config: Config, policy: str, episodes: int) -> str:
    """What plays these games again."""
    given = {"games": config.game, "policies": policy, "episodes": episodes}
    given |= {name: getattr(config, name) for name in (*PROTOCOL, "seed")}
    default = Config()
    words = [
        f"--{name}={value_text(value)}"
        for name, value in given.items()
        if name not in INFOS or value != getattr(default, name)
    ]
    return " ".join(["python -m experiments.reference_policies", *words])


def table(rows: Sequence[ReferencePolicy]) -> str:
    """The rows as CSV, with a header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(ReferencePolicy._fields)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return text.getvalue()


def update(path: Path, row: ReferencePolicy) -> None:
    """Puts a row into a CSV file, in the place of the one of its game and policy if there is one.

    Raises:
        ConfigError: the file is there and is none of these.
        SaveError: it cannot be written.
    """
    rows = {(old.game, old.policy): old for old in _read(path)} | {(row.game, row.policy): row}
    ordered = sorted(rows.values(), key=lambda row: (row.game, POLICIES.index(row.policy)))
    with saving(f"--out={path}"):
        replace_text(path, table(ordered))


def _read(path: Path) -> list[ReferencePolicy]:
    try:
        return policies_from(path.read_text(encoding="utf-8").splitlines())
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ConfigError(f"--out={path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError):
        raise ConfigError(f"--out={path}: no table of this command; name a new file") from None


def _chosen(flag: str, given: Sequence[str], valid: Sequence[str]) -> list[str]:
    for name in given:
        if name not in valid:
            raise ConfigError(f"--{flag}={name}: {choices_text(name, valid)}")
    if not given:
        raise ConfigError(f"--{flag}: names none; valid: {', '.join(valid)}")
    return list(dict.fromkeys(given))


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_list("games", ["Catch"], "to play", values)
    flags.DEFINE_list("policies", list(POLICIES), "to play them with", values)
    episodes = Info(int, "full games of each policy on each game", "games", minimum=1, maximum=1_000_000)
    config_flags.define("episodes", episodes, 30, values)
    for name in (*PROTOCOL, "seed"):
        config_flags.define(name, INFOS[name], getattr(Config(), name), values)
    flags.DEFINE_string("out", None, "CSV file to make, or to put the rows into", values)


def run(values: flags.FlagValues) -> int:
    """Plays what the command line asks for.

    Args:
        values: parsed flags, as `define_flags` defines them.

    Returns:
        The exit status.

    Raises:
        ConfigError: the command line is not valid; nothing was written.
        SaveError: the file cannot be written.
    """
    games = envs.several(values["games"].value)
    if not games:
        raise ConfigError("--games: names none; give Catch or Pong, say")
    policies = _chosen("policies", values["policies"].value, POLICIES)
    episodes, out = values["episodes"].value, values["out"].value
    given: Mapping[str, Any] = {name: values[name].value for name in (*PROTOCOL, "seed")}
    configs = [Config(game=game, **given) for game in games]
    for config in configs:
        check_game(config)
    if out is not None:
        out = paths.check_file("out", out, ".csv", overwrite=True)
        _read(out)
    print(table([]), end="")
    with signals() as caught:
        for config in configs:
            for policy in policies:
                row = play(policy, config, episodes, stop=lambda: bool(caught))
                if row is None:
                    return 128 + caught[0]
                print(table([row]).splitlines()[1], flush=True)
                if out is not None:
                    update(out, row)
    return 0


cli = config_flags.program(run, define_flags)

if __name__ == "__main__":
    cli()
