"""The configurations of a sweep's runs, worked out in a process of its own: that takes jax.

`python -m experiments.sweeping.resolving` reads runs as JSON on stdin and writes configurations on stdout.
"""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from absl import flags

import srl_jax
from srl_jax.config import Config
from srl_jax.errors import ConfigError

from .. import PACKAGE
from .. import flags as config_flags
from .manifest import planned
from .plan import Planned, settings

INSTALLED = Path(srl_jax.__file__).resolve().parents[1]
"""Where the package lies; PYTHONPATH names it for processes that work elsewhere."""


def environment() -> dict[str, str]:
    """Of a process that works in another directory, from which it shall import nothing.

    Modules that lie where this process works, as of `--game=module:Name-v0`, it may import.
    """
    paths = [str(INSTALLED), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)), os.getcwd()]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)), "PYTHONSAFEPATH": "1"}


def resolve(runs: Sequence[Planned]) -> dict[str, Config]:
    """{name: the configuration that the run will write into its config.json}.

    Raises:
        ConfigError: a run's flags are not valid, or it cannot start from the runs that it names.
    """
    done = subprocess.run(
        [sys.executable, "-m", f"{PACKAGE}.sweeping.resolving"],
        input=json.dumps([run._asdict() for run in runs]),
        capture_output=True,
        text=True,
        env=environment() | {"JAX_PLATFORMS": "cpu"},
    )
    try:
        content = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        last = done.stderr.strip().splitlines()[-1:] or ["no output"]
        raise ConfigError(
            f"the settings could not be checked (status {done.returncode}): {last[0]}"
        ) from None
    if "error" in content:
        raise ConfigError(content["error"])
    return {name: Config(**values) for name, values in content["configs"].items()}


def resolve_here(runs: Sequence[Planned]) -> dict[str, Config]:
    """`resolve` in this process; imports jax."""
    from srl_jax.training import resolved

    from ..train import check_extras

    configs: dict[str, Config] = {}
    known: dict[Config, Config] = {}  # what differs by the seed alone is resolved once
    for run in runs:
        try:
            config = parsed(run)
            key = dataclasses.replace(config, seed=0)
            if key not in known:
                check_extras(config)
                known[key] = resolved(key)
            configs[run.name] = dataclasses.replace(known[key], seed=config.seed)
        except ConfigError as error:
            raise ConfigError(f"{run.name}: {error}") from None
    for run in runs:
        check_sources(run, configs)
    return configs


def parsed(run: Planned) -> Config:
    """The configuration of a run's command line, not yet resolved; imports no jax.

    Raises:
        ConfigError: a flag is unknown or its value is not valid.
    """
    values = flags.FlagValues()
    config_flags.define_config_flags(values)
    config_flags.define_runtime_flag(values)
    sources = [f"--{f}={getattr(run, f)}" for f in ("encoder_from", "policy_from") if getattr(run, f)]
    try:
        values([run.name, *settings(run), *sources])
    except flags.UnrecognizedFlagError as error:
        raise ConfigError(f"--{error.flagname}: {config_flags.unknown(error.flagname, values)}") from None
    except (flags.Error, ValueError) as error:
        raise ConfigError(str(error).removeprefix("flag ")) from None
    return config_flags.config_from_flags(values)


def check_sources(run: Planned, configs: dict[str, Config]) -> None:
    """`srl_jax.training.check_sources` before there are any checkpoints.

    Raises:
        ConfigError: the run cannot start from those that it names.
    """
    here = configs[run.name]
    fields = {
        "encoder_from": ("encoder", "frame_size", "frame_stack"),
        "policy_from": ("game", "frame_size", "frame_stack"),
    }
    for flag, names in fields.items():
        source = getattr(run, flag)
        if not source:
            continue
        if source not in configs:
            raise ConfigError(f"{run.name}: starts from {source}, which is not a run of this sweep")
        there = configs[source]
        for name in names:
            if getattr(there, name) != getattr(here, name):
                raise ConfigError(
                    f"{run.name}: cannot start from {source}: {name} is {getattr(there, name)} there and "
                    f"{getattr(here, name)} here"
                )
        if flag == "policy_from" and there.mode == "pretrain":
            raise ConfigError(f"{run.name}: {source} has no policy: its mode is pretrain")


if __name__ == "__main__":
    try:
        found = resolve_here([planned(values) for values in json.load(sys.stdin)])
        answer = {"configs": {name: dataclasses.asdict(config) for name, config in found.items()}}
    except ConfigError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer))
