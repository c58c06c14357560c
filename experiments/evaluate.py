"""Plays full games from a checkpoint: `python -m experiments.evaluate runs/pong --gif=pong.gif`.

Prints one JSON object: the game, the checkpoint's env steps, the mean, and every return and length. With
--final these are the run's own final games, whose returns are those of its row of kind "final".
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path

from absl import flags

from srl_jax.errors import ConfigError, saving
from srl_jax.files import display
from srl_jax.files.checkpoint import Manifest
from srl_jax.specs import Info

from .command_line import flags as config_flags
from .command_line import paths, runtime
from .runs.run_data import read_rows


def check_gif(path: str) -> Path:
    """The path of a GIF that can be written.

    Raises:
        ConfigError: it cannot, or there is one already.
    """
    from .drawing import plots

    if not plots.available():
        raise ConfigError("--gif: needs matplotlib and Pillow, pip install 'srl-jax[plots]'")
    return paths.check_file("gif", path, ".gif")


def check_final(manifest: Manifest, values: flags.FlagValues) -> None:
    """Whether --final stands alone, and the run has played final games by these parameters.

    Raises:
        ConfigError: it does not, or has not; or its rows cannot be read.
    """
    if not values.final:
        return
    if not manifest.config.final_games:
        raise ConfigError(f"--final: the run in {values.run} has no final games; give --games=100, say")
    for name in ("games", "envs", "seed", "epsilon", "max_steps"):
        if values[name].present:
            raise ConfigError(f"--{name}={values[name].value}: given beside --final, which has the run's own")
    rows = read_rows(manifest.path.parents[1] / "metrics.jsonl")
    if not any(row["kind"] == "final" and row["env_steps"] == manifest.env_steps for row in rows):
        raise ConfigError(
            f"--final: no final games were played by {manifest.path}; name a run that has ended, or give "
            "--games=100, say"
        )


def main(values: flags.FlagValues, prepare: Callable[[str, str], None] | None = None) -> None:
    """The entry point.

    Args:
        values: parsed flags, as `define_flags` defines them.
        prepare: called with --tune_runtime and the run's encoder before jax is imported. It may replace the
            process, so only a process of our own gives it.
    """
    if not values.run:
        raise ConfigError("--run: missing; name a run directory or a checkpoint, srl-jax evaluate runs/NAME")
    gif = check_gif(values.gif) if values.gif else None
    run = paths.given("run", values.run)
    from srl_jax.files import checkpoint
    from srl_jax.learning.modes import MODES

    manifest = checkpoint.read_manifest(run)
    config = manifest.config
    if not MODES[config.mode].rl:
        raise ConfigError(f"--run={values.run}: a run of --mode={config.mode} has no policy to play with")
    check_final(manifest, values)
    if prepare is not None:
        prepare(values.tune_runtime, config.encoder)

    runtime.check_device()

    import jax

    from srl_jax import loading
    from srl_jax.run import actor, evaluations
    from srl_jax.run.evaluate import evaluate

    most = values.max_steps or config.eval_max_steps
    config = dataclasses.replace(config, eval_max_steps=most)
    loaded = loading.load(run, imports=values["import"].value)
    manifest, seed = loaded.manifest, values.seed
    games, at_once = values.games, values.envs or config.eval_envs or config.num_envs
    key = jax.random.key(seed)
    if values.final:
        games, at_once, seed, key = evaluations.games(config, evaluations.FINAL, manifest.env_steps)
    policy = loaded.policy(key)
    env = actor.make_env(config, "eval", min(games, at_once), seed=seed)
    if manifest.num_actions != env.single_action_space.n:
        raise ConfigError(
            f"{manifest.path}: its policy has {manifest.num_actions} actions, {config.game} has "
            f"{env.single_action_space.n}"
        )
    shape = env.single_observation_space.shape
    checkpoint.check_frames(manifest, shape, str(manifest.path), config.game)
    played = evaluate(
        policy,
        env,
        games=games,
        seed=seed,
        epsilon=config.eps_eval if values.epsilon is None else values.epsilon,
        stack=config.frame_stack,
        max_steps=most,
        record=most + 1 if values.gif else 0,
    )
    result = {
        "game": config.game,
        "env_steps": manifest.env_steps,
        "return_mean": sum(played.returns) / len(played.returns),
        "returns": played.returns,
        "lengths": played.lengths,
    }
    if played.cut:
        display.say(f"{played.cut} of the games were cut at {most} env steps; --max_steps= sets where")
    display.result(json.dumps(result))
    if gif:
        from .drawing import images

        with saving(f"--gif={values.gif}"):
            images.gif(played.frames[: played.lengths[0] + 1], gif)  # the first game


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_string("run", "", "run directory, or one of its checkpoints", values)
    games = Info(int, "games to play", minimum=1, maximum=1_000_000)
    config_flags.define("games", games, 10, values)
    most = Info(int, "where a game is cut; 0: at the run's eval_max_steps", "env steps", minimum=0)
    config_flags.define("max_steps", most, 0, values)
    envs = Info(int, "environments that play at once; 0: the run's eval_envs", "environments", minimum=0)
    config_flags.define("envs", envs, 0, values)
    flags.DEFINE_boolean("final", False, "play the run's own final games, again", values)
    seed = Info(int, "of the games; the same seed gives the same games", minimum=0)
    config_flags.define("seed", seed, 0, values)
    epsilon = "probability of a random action; the run's eps_eval if not given"
    config_flags.define("epsilon", Info(float, epsilon, minimum=0, maximum=1), None, values)
    config_flags.define_import_flag(values)
    flags.DEFINE_string("gif", "", "file to write the first game to, as a GIF", values)
    config_flags.define_runtime_flag(values)


cli = config_flags.program(functools.partial(main, prepare=runtime.prepare), define_flags, positional="run")

if __name__ == "__main__":
    cli()
