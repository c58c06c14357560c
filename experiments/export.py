"""Writes a run's encoder to a file that numpy can read: `srl-jax export runs/x --encoder=enc.npz`.

Each parameter is an array by its name, as Conv_0/kernel; "about" is a JSON text: the specification of the
encoder, the shape of an observation, the size of the latent, the game, the env steps, and the steps that the
encoder computes, with strides, padding and epsilon (see srl_jax/encoders/files.py). A run's newest checkpoint
is meant; one of them, its best/ and what is kept in its encoders/ can be named, too.
srl_jax.encoders.from_npz loads the file.
"""

from absl import flags

from srl_jax.errors import ConfigError

from .command_line import flags as config_flags
from .command_line import paths, runtime


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    if not values.run:
        raise ConfigError("--run: missing; name a run directory or a checkpoint, srl-jax export runs/NAME")
    if not values.encoder:
        raise ConfigError("--encoder: missing; name the file to write, --encoder=enc.npz")
    path = paths.check_file("encoder", values.encoder, ".npz", overwrite=values.overwrite)
    runtime.check_device()

    from srl_jax import encoders, loading

    loaded = loading.load(paths.given("run", values.run), imports=values["import"].value)
    config, encoder = loaded.config, loaded.encoder
    about = {"game": config.game, "env_steps": loaded.env_steps}
    encoders.to_npz(path, encoder, loaded.params["encoder"], config.encoder, **about)
    shape = list(encoder.observation_shape)
    print(f"{path}: {config.encoder.partition(':')[0]}, observations {shape} to {encoder.features} numbers")


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    text, yes, *_ = config_flags.kinds(values)
    text("run", "", "run directory, one of its checkpoints, or an encoder that was kept")
    text("encoder", "", "file to write, which ends in .npz")
    yes("overwrite", False, "replace the file if there is one")
    config_flags.define_import_flag(values)


cli = config_flags.program(main, define_flags, positional="run")

if __name__ == "__main__":
    cli()
