"""Plays full games from a checkpoint: `python -m experiments.evaluate runs/pong --gif=pong.gif`.

Prints one JSON object: the game, the checkpoint's env steps, the mean, and every return and length. With
--final these are the run's own final games, whose returns are those of its row of kind "final".
"""

import functools
import json
from collections.abc import Callable

from absl import flags

from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.files.checkpoint import Manifest
from srl_jax.specs import Info

from .command_line import flags as config_flags
from .command_line import paths, runtime
from .runs.run_data import read_rows

FLAGS = flags.FLAGS


def check_gif(path: str) -> None:
    """Whether a GIF can be written there.

    Raises:
        ConfigError: it cannot, or there is one already.
    """
    from .drawing import plots

    if not plots.available():
        raise ConfigError("--gif: needs matplotlib and Pillow, pip install 'srl-jax[plots]'")
    paths.check_file("gif", path, ".gif")


def check_final(manifest: Manifest) -> None:
    """Whether --final stands alone, and the run has played final games by these parameters.

    Raises:
        ConfigError: it does not, or has not; or its rows cannot be read.
    """
    if not FLAGS.final:
        return
    if not manifest.config.final_games:
        raise ConfigError(f"--final: the run in {FLAGS.run} has no final games; give --games=100, say")
    for name in ("games", "envs", "seed", "epsilon"):
        if FLAGS[name].present:
            raise ConfigError(f"--{name}={FLAGS[name].value}: given beside --final, which has the run's own")
    rows = read_rows(manifest.path.parents[1] / "metrics.jsonl")
    if not any(row["kind"] == "final" and row["env_steps"] == manifest.env_steps for row in rows):
        raise ConfigError(
            f"--final: no final games were played by {manifest.path}; name a run that has ended, or give "
            "--games=100, say"
        )


def main(argv: list[str], prepare: Callable[[str, str], None] | None = None) -> None:
    """The entry point.

    Args:
        argv: the program's name.
        prepare: called with --tune_runtime and the run's encoder before jax is imported. It may replace the
            process, so only a process of our own gives it.
    """
    del argv
    if not FLAGS.run:
        raise ConfigError("--run: missing; name a run directory or a checkpoint, srl-jax evaluate runs/NAME")
    if FLAGS.gif:
        check_gif(FLAGS.gif)
    from srl_jax.files import checkpoint
    from srl_jax.learning.modes import MODES

    manifest = checkpoint.read_manifest(FLAGS.run)
    config = manifest.config
    if not MODES[config.mode].rl:
        raise ConfigError(f"--run={FLAGS.run}: a run of --mode={config.mode} has no policy to play with")
    check_final(manifest)
    if prepare is not None:
        prepare(FLAGS.tune_runtime, config.encoder)

    runtime.check_device()

    import jax

    from srl_jax import loading
    from srl_jax.run import actor, evaluations
    from srl_jax.run.evaluate import evaluate

    loaded = loading.load(FLAGS.run, imports=FLAGS["import"].value)
    manifest, seed = loaded.manifest, FLAGS.seed
    games, at_once, key = FLAGS.games, FLAGS.envs or config.eval_envs or config.num_envs, jax.random.key(seed)
    if FLAGS.final:
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
        epsilon=config.eps_eval if FLAGS.epsilon is None else FLAGS.epsilon,
        stack=config.frame_stack,
        max_steps=config.eval_max_steps,
        record=config.eval_max_steps + 1 if FLAGS.gif else 0,
    )
    result = {
        "game": config.game,
        "env_steps": manifest.env_steps,
        "return_mean": sum(played.returns) / len(played.returns),
        "returns": played.returns,
        "lengths": played.lengths,
    }
    if FLAGS.gif:
        from .drawing import images

        images.gif(played.frames[: played.lengths[0] + 1], FLAGS.gif)  # the first game
    display.result(json.dumps(result))


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_string("run", "", "run directory, or one of its checkpoints", flag_values=values)
    games = Info(int, "full games to play", minimum=1, maximum=1_000_000)
    config_flags.define("games", games, 10, values)
    envs = Info(int, "environments that play at once; 0: the run's eval_envs", "environments", minimum=0)
    config_flags.define("envs", envs, 0, values)
    flags.DEFINE_boolean("final", False, "play the run's own final games, again", flag_values=values)
    seed = Info(int, "of the games; the same seed gives the same games", minimum=0)
    config_flags.define("seed", seed, 0, values)
    epsilon = "probability of a random action; the run's eps_eval if not given"
    config_flags.define("epsilon", Info(float, epsilon, minimum=0, maximum=1), None, values)
    config_flags.define_import_flag(values)
    gif = "file to write the first game to, as a GIF"
    flags.DEFINE_string("gif", "", gif, flag_values=values)
    config_flags.define_runtime_flag(values)


def cli() -> None:
    """Runs this entry point as a program."""
    define_flags()
    config_flags.run(functools.partial(main, prepare=runtime.prepare), positional="run")


if __name__ == "__main__":
    cli()
