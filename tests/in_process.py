"""The command line in this process: flags of its own, errors caught, and a stub in place of the loop."""

import os
import pathlib
import subprocess
import sys
import types

import numpy as np
import pytest
from absl import flags

from experiments import train
from experiments.command_line import flags as config_flags
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint

ROOT = pathlib.Path(__file__).resolve().parents[1]
CATCH = ["--game=Catch", "--encoder=tiny", "--frame_size=42", "--steps=500", "--checkpoint_every=100"]
CATCH += ["--eval_every=500", "--nodiagnostics"]


class Loop(types.ModuleType):
    """Stands in for srl_jax.run.loop."""

    def __init__(self):
        super().__init__("srl_jax.run.loop")
        self.calls = []
        self.resumed = []
        self.seeds = []

    def train_seeds(self, config, seeds, outs, *, resume, stop, begun):
        self.seeds.append(seeds)
        manifests = resume or [None] * len(outs)
        runs = zip(outs, manifests, strict=True)
        results = [self.train(config, out, resume=m, stop=stop) for out, m in runs]
        begun()  # what refuses comes before
        return results

    def train(self, config, out, *, resume=None, stop):
        assert not stop()
        self.calls.append((config, out))
        self.resumed.append(resume)
        (pathlib.Path(out) / "metrics.jsonl").touch()
        return types.SimpleNamespace(
            env_steps=0, updates=0, interrupted=False, saved=None, pictures={}, recording=None
        )


def parse(module, *arguments, positional=None):
    """The flags of a program, as these arguments set them."""
    values = flags.FlagValues()
    module.define_flags(values)
    config_flags.parse([module.__name__, *map(str, arguments)], values, positional)
    return values


def train_in_process(*arguments):
    """What the entry point does, in this process and with flags of its own."""
    try:
        return train.train(parse(train, *arguments))
    except ConfigError as error:
        config_flags.fail(error)


def python(*arguments, **env):
    options = {"cwd": ROOT, "env": os.environ | env, "capture_output": True, "text": True, "timeout": 60}
    return subprocess.run([sys.executable, *arguments], **options)


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        train_in_process("--game=Catch", *arguments)
    assert ended.value.code == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line


def checkpoint_of(out, env_steps, ended=False):
    """A checkpoint of the run in a directory, as the loop writes it."""
    params = {"encoder": {"kernel": np.ones(2, np.float32)}}
    state = None if ended else checkpoint.State({}, {}, {})
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": env_steps, "updates": 1}
    return checkpoint.save(out, params, Config.load(out), state=state, **counts)
