"""The table of malformed inputs: command lines, and files that were damaged or are no files at all.

A case is a folder that `Case.prepare` fills and a command line that must be refused there. `{folder}` in an
argument stands for the case's folder, `{source}` for a copy of a valid run in it, `{checkpoint}` for that
run's checkpoint. `{canary}` is a file that any code that hides in the input would make.
"""

import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from srl_jax import checkpoint
from srl_jax.config import INFOS, Config
from srl_jax.specs import Info

from ..flags import MOVED, last_of_each

FLAGS, PRESETS, SPECS = "flags", "presets", "objectives and other specs"
TOGETHER, CHECKPOINTS, CONFIGS = "flags that contradict each other", "checkpoints", "configs and metrics"
PICKLES, NAMES, LINKS = "pickles", "names and paths", "symbolic links, devices and pipes"
VALID = "valid input, accepted"
KINDS = (FLAGS, PRESETS, SPECS, TOGETHER, CHECKPOINTS, CONFIGS, PICKLES, NAMES, LINKS, VALID)

CANARY = "CANARY"
CODE = "__import__('os').system('touch " + CANARY + "')"
"""Makes the canary in the working directory, the case's folder, if anything evaluates it."""

SETTINGS = {
    "game": "Catch",
    "frame_size": 42,
    "encoder": "tiny:features=8",
    "rl": "rainbow:hidden=8,atoms=5",
    "num_envs": 2,
    "eval_max_steps": 30,
}
"""Of the valid run: small, and built without compiling anything."""
FITTING = tuple(f"--{name}={value}" for name, value in SETTINGS.items())
START = (*FITTING, "--mode=finetuned", "--encoder_from={source}")
"""Trains from the valid run's encoder."""
GIVEN = (*FITTING, "--mode=pretrain", "--objective=latent_l2", "--policy_from={source}")
"""Trains a representation on frames of the valid run's policy."""
NUM_ACTIONS = 3

Prepare = Callable[[Path, Path], None]
"""(the case's folder, the valid run)."""


class Case(NamedTuple):
    """One malformed input.

    Attributes:
        kind: one of `KINDS`.
        name: of the case, unique within its kind.
        program: the module below `experiments`.
        arguments: its command line.
        names: what the line on stderr must hold: the flag or the file.
        prepare: fills the folder; None leaves it empty.
    """

    kind: str
    name: str
    program: str
    arguments: tuple[str, ...]
    names: str
    prepare: Prepare | None = None


# The valid run, and what is done to copies of it


def make_valid_run(run: Path) -> None:
    """A run directory as training leaves it: config.json, metrics.jsonl and one checkpoint, of zeros."""
    import jax

    from srl_jax.agent import make_agent
    from srl_jax.metrics import MetricsWriter
    from srl_jax.training import resolved

    config = resolved(Config(**SETTINGS))
    run.mkdir(parents=True)
    with mock.patch.dict(os.environ, JAX_PLATFORMS="cpu"):  # as the cases' processes have it
        config.save(run)
    frame = (config.frame_size, config.frame_size, 1)
    agent = make_agent(config, frame, NUM_ACTIONS)
    shapes = jax.eval_shape(agent.init, jax.random.key(0)).params
    params = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    about = {"frame_shape": frame, "num_actions": NUM_ACTIONS, "env_steps": 1000, "updates": 100}
    checkpoint.save(run, params, config, **about)
    with MetricsWriter(run / "metrics.jsonl") as writer:
        for step in (0, 1000):
            writer.write("train", step, step // 10, 1.0, {"loss/rl": 1.0 + step, "grad_norm/rl": 0.5})
            values = {"eval/return_mean": -1.0, "eval/returns": [-1.0, -1.0], "eval/lengths": [20, 24]}
            writer.write("eval", step, step // 10, 1.0, values)


def checkpoint_of(run: Path) -> Path:
    """The one checkpoint of the valid run, or of a copy."""
    (found,) = (run / "checkpoints").iterdir()
    return found


def copied(change: Callable[[Path], Any] = lambda run: None) -> Prepare:
    """Prepares a copy of the valid run, `source`, with a change made to it."""

    def prepare(folder: Path, valid: Path) -> None:
        shutil.copytree(valid, folder / "source")
        change(folder / "source")

    return prepare


def damaged(change: Callable[[Path], Any]) -> Prepare:
    """Prepares a copy of the valid run with a change made to its checkpoint's folder."""
    return copied(lambda run: change(checkpoint_of(run)))


def seal(folder: Path) -> None:
    """Makes manifest.sha256 fit manifest.json, where the checkpoint has one."""
    if (folder / "manifest.sha256").exists():
        digest = sha256((folder / "manifest.json").read_bytes()).hexdigest()
        (folder / "manifest.sha256").write_text(f"{digest}  manifest.json\n")


def edit(change: Callable[[Any], Any], name: str = "manifest.json") -> Callable[[Path], None]:
    """Rewrites a JSON file of a folder with what `change` makes of its content."""

    def rewrite(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(change(content)))
        seal(folder)

    return rewrite


def entry(where: str, value: Any) -> Callable[[Any], Any]:
    """A change of one entry, `a/b/c` within objects; `KeyError` as the value removes it."""

    def change(content: dict) -> dict:
        *path, last = where.split("|")
        inner = content
        for key in path:
            inner = inner[key]
        if value is KeyError:
            del inner[last]
        else:
            inner[last] = value
        return content

    return change


def written(name: str, data: bytes) -> Callable[[Path], None]:
    """Replaces a file's bytes; manifest.sha256 fits, the manifest's own sums do not."""

    def write(folder: Path) -> None:
        (folder / name).write_bytes(data)
        seal(folder)

    return write


def replaced(name: str, put: Callable[[Path], Any]) -> Callable[[Path], None]:
    """Puts something else in a file's place."""

    def replace(folder: Path) -> None:
        path = folder / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        put(path)

    return replace


def replaced_by(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Changes a file's bytes; what its sum is stays."""

    def rewrite(folder: Path) -> None:
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return rewrite


def sparse(path: Path) -> None:
    """A file of a terabyte that takes no room."""
    with open(path, "wb") as file:
        file.truncate(1 << 40)


def put(**content: Any) -> Prepare:
    """Prepares a folder with files: text or bytes, or a function of the path. `__` is a slash, `_` a dot."""

    def prepare(folder: Path, valid: Path) -> None:
        for name, what in content.items():
            path = folder / name.replace("__", "/").replace("_", ".")
            path.parent.mkdir(parents=True, exist_ok=True)
            if callable(what):
                what(path)
            else:
                path.write_bytes(what.encode() if isinstance(what, str) else what)

    return prepare


class Trap:
    """Makes the canary when it is unpickled."""

    def __reduce__(self):
        return os.system, (f"touch {CANARY}",)


TRAPS = {"text": pickle.dumps(Trap(), protocol=0), "binary": pickle.dumps(Trap(), protocol=5)}
DEEP = 100_000

# What is no JSON document that any of the readers may take.
NOT_JSON = {
    "empty": b"",
    "no JSON": b"this is no JSON",
    "cut short": b'{"game": "Cat',
    "arrays in arrays": b"[" * DEEP,
    "objects in objects": b'{"a":' * DEEP,
    "closed arrays in arrays": b"[" * DEEP + b"]" * DEEP,
    "NaN": b"NaN",
    "a string": b'"game"',
    "null": b"null",
    "a number of 100,000 digits": b"1" * 100_000,
    "no UTF-8": b'{"game": "\xff\xfe"}',
    "UTF-16": '{"game": "Catch"}'.encode("utf-16"),
    "a NUL": b'{"game": "Catch"}\0',
    "rubbish behind it": b'{"game": "Catch"} {}',
    "Python": b"{'game': 'Catch'}",
    "code": CODE.encode(),
}


def _train(*arguments: str) -> tuple[str, tuple[str, ...]]:
    out = () if any(a.startswith("--out") for a in arguments) else ("--out={folder}/run",)
    return "train", last_of_each((*out, "--tune_runtime=off", *arguments))


def _evaluate(*arguments: str) -> tuple[str, tuple[str, ...]]:
    run = () if any(a.startswith("--run") for a in arguments) else ("--run={source}",)
    return "evaluate", last_of_each((*run, "--games=1", "--tune_runtime=off", *arguments))


def _draw(*arguments: str) -> tuple[str, tuple[str, ...]]:
    run = () if any(a.startswith("--run") for a in arguments) else ("--run={source}",)
    return "draw", (*run, *arguments)


# The table


def cases() -> list[Case]:
    """All cases, the valid ones among them."""
    found = [case for part in _PARTS for case in part()]
    names = [(case.kind, case.name) for case in found]
    assert len(set(names)) == len(names), [name for name in names if names.count(name) > 1]
    return found


def _wrong(info: Info) -> Iterator[tuple[str, str]]:
    """(what, text) of values that a flag of this kind must refuse."""
    if info.kind is bool:
        yield from (("empty", ""), ("a word", "maybe"), ("two", "2"), ("code", CODE))
    elif info.choices:
        yield from (("empty", ""), ("other", "x"), ("code", CODE), ("line break", f"{info.choices[0]}\nx"))
        yield from (("other letters", info.choices[0] + "\u0301"), ("long", "x" * 5000))
    elif info.kind in (int, float):
        yield from (("empty", ""), ("a word", "abc"), ("code", CODE), ("line break", "1\n2"))
        yield from (("infinite", "inf"), ("huge", "1e400"), ("400 digits", "9" * 400))
        if not info.optional:
            yield "not a number", "nan"
        least = info.minimum if info.minimum is not None else info.above
        if least is not None:
            yield "too small", typed(least - 1)
        if info.maximum is not None:
            yield "too large", typed(info.maximum + 1)
        if info.kind is int:
            yield from (("a fraction", "1.5"), ("beyond 32 bits", str(2**31)), ("hexadecimal", "0x10"))
        else:
            yield from (("beyond single precision", "1e39"), ("complex", "1+1j"))


def typed(number: float) -> str:
    """A number as one types it."""
    return f"{number:.10g}"


def _flags() -> Iterator[Case]:
    infos = {info.flag or name: info for name, info in INFOS.items()}
    infos["tune_runtime"] = Info(str, "", choices=("auto", "off"))
    for flag, info in infos.items():
        for what, text in _wrong(info):
            yield Case(FLAGS, f"{flag}: {what}", *_train(f"--{flag}={text}"), f"--{flag}")
    others = {
        "misspelled": ("--gane=Pong", "--gane"),
        "unknown": ("--frobnicate=1", "--frobnicate"),
        "dunder": ("--__class__=1", "--__class__"),
        **{f"of before: {flag}": (f"--{flag}=1", f"--{flag}") for flag in MOVED},
        "code": (f"--{CODE}", CODE[:20]),
        "no value": ("--steps", "steps"),
        "one dash": ("-steps=abc", "--steps"),
        "three dashes": ("---steps=5", "-steps"),
        "a word": ("Pong", "Pong"),
        "no of a number": ("--nosteps", "nosteps"),
        "no with a value": ("--nokeep_best=5", "keep_best"),
        "a switch with a value": ("--overwrite=perhaps", "overwrite"),
        "print_config with a value": ("--print_config=perhaps", "print_config"),
        "a name that is not ASCII": ("--\u017fteps=5", "teps"),
        "nothing but dashes and a word": ("--", "x", "'x'"),
    }
    for name, (*arguments, names) in others.items():
        yield Case(FLAGS, name, *_train(*arguments), names)
    files = {
        "that is not there": {},
        "that is empty": {"file": b""},
        "that is no text": {"file": b"\xff\xfe\x00--steps=1"},
        "with a NUL in a path": {"file": b"--out=a\0b"},
        "that is a pipe": {"file": os.mkfifo},
        "without an end": {"file": sparse},
        "that names itself": {"file": b"--flagfile=file"},
    }
    for name, content in files.items():
        yield Case(FLAGS, f"flagfile {name}", *_train("--flagfile=file"), "--flagfile", put(**content))
    seeds = ("", ",", "1,", "1,,2", "1;2", "0,0", "-1", "1.5", "nan", "2147483648", "9" * 400, "a", CODE)
    for text in seeds:
        yield Case(FLAGS, f"seeds={text[:20]}", *_train(f"--seeds={text}"), "--seeds")
    evaluate = {
        "games": ("", "0", "-1", "1.5", "nan", "x", "9" * 400, "9" * 5000, "9999999999999", CODE),
        "seed": ("", "-1", "1.5", "nan", "x", "2147483648", "9" * 400, CODE),
        "epsilon": ("", "-0.1", "1.1", "nan", "inf", "-inf", "1e400", "x", CODE),
        "tune_runtime": ("", "x", CODE),
        "frobnicate": ("1",),
    }
    for flag, texts in evaluate.items():
        for text in texts:
            call = _evaluate(f"--{flag}={text}")
            yield Case(FLAGS, f"evaluate --{flag}={text[:30]} ({len(text)})", *call, flag, copied())
    benchmarks = {
        "bench": (("rounds", "0"), ("rounds", "-1"), ("rounds", "x"), ("rounds", "1e400"), ("only", "x"))
        + (("only", ""), ("only", CODE), ("only", "catch,"), ("frobnicate", "1"), ("out", "/dev/null")),
        "gpu": (("device", "tpu"), ("updates", "0"), ("updates", "-1"), ("updates", "x"), ("seeds", "0"))
        + (("seeds", "-1"), ("seconds", "nan"), ("seconds", "inf"), ("seconds", "-1"), ("seconds", "0")),
    }
    for program, values in benchmarks.items():
        also = () if program == "bench" else ("--device=cpu",)
        for flag, text in values:
            call = f"benchmarks.{program}", last_of_each((*also, f"--{flag}={text}"))
            yield Case(FLAGS, f"{program} --{flag}={text[:30]}", *call, flag)


def _presets() -> Iterator[Case]:
    texts = {
        "empty": "",
        "unknown": "x",
        "none": "none",
        "misspelled": "thesis/joint_25",
        "without its folder": "joint_256",
        "in capitals": "DEMO",
        "two": "demo,catch/joint",
        "blank behind": "demo ",
        "line break": "demo\nx",
        "dots": "../presets",
        "dunder": "__class__",
        "code": CODE,
        "long": "x" * 5000,
        "other letters": "d\u0435mo",
        "terminal": "\x1b[2J",
    }
    for name, text in texts.items():
        yield Case(PRESETS, name, *_train(f"--preset={text}"), "--preset")
    for preset in ("thesis/frozen_256", "thesis/joint_from_pretrained_256", "catch/finetuned"):
        yield Case(PRESETS, f"{preset} without its encoder", *_train(f"--preset={preset}"), "--encoder_from")


def _specs() -> Iterator[Case]:
    objectives = (
        "reconstruction:weight=" + CODE,
        CODE,
        "__class__",
        "__import__('os')",
        "lambda: 0",
        "reconstruction:__class__=1",
        "reconstruction:context=1",
        "reconstruction:weight=",
        "reconstruction:weight",
        "reconstruction:",
        "reconstruction:=1",
        "reconstruction:,",
        "reconstruction:weight=1,",
        "reconstruction:weight=1,weight=1",
        ":weight=1",
        "reconstruction:weight=nan",
        "reconstruction:weight=inf",
        "reconstruction:weight=1e39",
        "reconstruction:weight=-1",
        "reconstruction:weight=1:2",
        "reconstruction:weight=1;x=2",
        "reconstruction:weight=True",
        "reconstruction:weight=0x1",
        "reconstruction:weight={}",
        "reconstruction weight=1",
        "Reconstruction",
        "reconstruction\nlatent_l2",
        "r\u0435construction",
        "\x1b[31mreconstruction",
        "../reconstruction",
        "srl_jax.objectives.inverse",
        "x" * 5000,
        "inverse:hidden=0",
        "inverse:hidden=-1",
        "inverse:hidden=1.5",
        "inverse:hidden=2147483648",
        "inverse:hidden=2147483647",
        "inverse:hidden=" + "9" * 400,
        "latent_l2:hidden=4",
        " ",
    )
    for text in objectives:
        call = _train("--game=Catch", "--mode=joint", f"--objective={text}")
        yield Case(SPECS, f"objective {text[:40]!r}", *call, "--objective=")
    others = {
        "objective twice": ("latent_l2", "latent_l2:weight=2"),
        "objective none and another": ("none", "latent_l2"),
    }
    for name, texts in others.items():
        call = _train("--game=Catch", "--mode=joint", *(f"--objective={text}" for text in texts))
        yield Case(SPECS, name, *call, "--objective=")
    encoders = (
        "",
        ":",
        "tiny:",
        "Tiny",
        "nature:features=1",
        "nature:observation_shape=1",
        "sac_ae:features=0",
        "sac_ae:features=-1",
        "sac_ae:features=2.5",
        "sac_ae:features=1e400",
        "sac_ae:features=99999999999",
        "sac_ae:features=2147483647",
        "sac_ae:layer_norm=maybe",
        "sac_ae:features=256,features=256",
        "tiny:features=" + CODE,
        "tiny:__dict__=1",
        "__builtins__",
    )
    for text in encoders:
        yield Case(SPECS, f"encoder {text!r}", *_train("--game=Catch", f"--encoder={text}"), "--encoder=")
    algorithms = (
        "",
        "rainbow:",
        "rainbow:n_step=0",
        "rainbow:n_step=1.5",
        "rainbow:n_step=2147483647",
        "rainbow:n_step=1e9,n_step=1",
        "rainbow:atoms=1",
        "rainbow:atoms=1000000000",
        "rainbow:v_min=10",
        "rainbow:v_min=nan",
        "rainbow:v_max=1e39",
        "rainbow:v_min=1,v_max=1",
        "rainbow:hidden=0",
        "rainbow:hidden=2147483647",
        "rainbow:alpha=2",
        "rainbow:alpha=-1",
        "rainbow:noisy_std=-1",
        "rainbow:noisy_std=inf",
        "rainbow:init_std=-1",
        "rainbow:init_std=1e-300",
        "rainbow:double=2",
        "rainbow:context=1",
        "dqn:dueling=yes",
        "c51:func=rainbow",
        "double:" + CODE,
        "rainbow:hidden=" + CODE,
        "_plain",
    )
    for text in algorithms:
        yield Case(SPECS, f"rl {text!r}", *_train("--game=Catch", f"--rl={text}"), "--rl=")


def _together() -> Iterator[Case]:
    table = {
        "a batch larger than the buffer": ("--batch_size=100", "--buffer_size=99", "--batch_size"),
        "learning starts after the buffer": ("--learn_start=2000", "--buffer_size=1999", "--learn_start"),
        "a buffer without room for a window": (
            *("--batch_size=1", "--learn_start=0", "--buffer_size=50", "--num_envs=10", "--buffer_size=50"),
        ),
        "a return longer than the buffer": ("--rl=:n_step=20000", "--buffer_size=1000", "n_step"),
        "too many environments for the buffer": ("--num_envs=10000", "--buffer_size=20000", "num_envs"),
        "a buffer larger than memory": ("--buffer_size=2000000000", "--buffer_size"),
        "frames that Catch does not know": ("--frame_size=50", "--frame_size=50"),
        "frames that are too small": ("--game=Pong", "--frame_size=8", "--encoder"),
        "an encoder for rl_only": ("--encoder_from=.", "--encoder_from"),
        "no encoder for frozen": ("--mode=frozen", "--encoder_from"),
        "an objective for rl_only": ("--objective=inverse", "--objective"),
        "no objective for joint": ("--mode=joint", "--objective"),
        "an empty objective for joint": ("--mode=joint", "--objective=", "--objective"),
        "an objective for finetuned": (
            "--mode=finetuned", "--objective=inverse", "--encoder_from=.", "--objective",
        ),
        "a policy for joint": ("--mode=joint", "--objective=inverse", "--policy_from=.", "--policy_from"),
        "augmentation of nothing": ("--augment=srl", "--augment"),
        "a rate for a frozen encoder": (
            "--mode=frozen", "--encoder_from=.", "--lr_encoder=1", "--lr_encoder",
        ),
        "fewer losses of one kind": (
            *("--mode=pretrain", "--objective=inverse", "--srl_every=2", "--srl_every"),
        ),
        "seed and seeds": ("--seed=1", "--seeds=1,2", "--seeds"),
        "an option that the algorithm lacks": ("--rl=rainbow:n_stp=1", "--rl"),
        "atoms the wrong way round": ("--rl=:v_min=1,v_max=0", "v_m"),
        "one atom": ("--rl=:atoms=1", "atoms"),
        "an exponent above 1": ("--rl=:alpha=1.5", "alpha"),
        "overwrite without out": ("--overwrite", "--out=", "--out"),
    }  # fmt: skip
    for name, (*arguments, names) in table.items():
        yield Case(TOGETHER, name, *_train("--game=Catch", *arguments), names)
    differing = {
        "another encoder": "--encoder=tiny:features=9",
        "another size": "--frame_size=84",
        "another stack": "--frame_stack=3",
    }
    for name, flag in differing.items():
        yield Case(TOGETHER, f"encoder_from: {name}", *_train(*START, flag), "--encoder_from", copied())
        if "encoder" not in name:
            yield Case(TOGETHER, f"policy_from: {name}", *_train(*GIVEN, flag), "--policy_from", copied())
    call = _train(*GIVEN, "--game=CatchDistractor")
    yield Case(TOGETHER, "policy_from: another game", *call, "--policy_from", copied())
    for flag in ("encoder_from", "policy_from"):
        call = _train(*(START if flag == "encoder_from" else GIVEN), "--out={source}", "--overwrite")
        yield Case(TOGETHER, f"overwrite what {flag} names", *call, "--overwrite would delete", copied())


def _checkpoints() -> Iterator[Case]:
    damage: dict[str, Callable[[bytes], bytes]] = {
        "empty": lambda data: b"",
        "cut short": lambda data: data[: len(data) // 2],
        "one bit differs": lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
        "longer": lambda data: data + b"\0",
        "zeros": lambda data: bytes(len(data)),
    }
    things: dict[str, Callable[[Path], Any]] = {"gone": lambda path: None, "a folder": os.mkdir}
    for name in ("manifest.json", "manifest.sha256", "params.msgpack"):
        changes = {what: replaced_by(name, change) for what, change in damage.items()}
        changes |= {what: replaced(name, thing) for what, thing in things.items()}
        for what, change in changes.items():
            shown = "manifest" if name.startswith("manifest") else name
            yield Case(CHECKPOINTS, f"{name}: {what}", *_evaluate(), shown, damaged(change))
            call = _train(*START)
            yield Case(CHECKPOINTS, f"{name}: {what}, to encoder_from", *call, "{source}", damaged(change))
            call = _train(*GIVEN)
            yield Case(CHECKPOINTS, f"{name}: {what}, to policy_from", *call, "{source}", damaged(change))
    # Of other versions and other kinds of runs.
    for where, value in (("format", 99), ("config|frobnicate", 1), ("config|mode", "none")):
        change = damaged(edit(entry(where, value)))
        yield Case(CHECKPOINTS, f"{where} is {value}", *_evaluate(), "{checkpoint}", change)
    pretrained = damaged(
        edit(lambda m: entry("config|objectives", ["latent_l2"])(entry("config|mode", "pretrain")(m)))
    )
    yield Case(CHECKPOINTS, "no policy", *_evaluate(), "--run", pretrained)
    yield Case(CHECKPOINTS, "no policy, to policy_from", *_train(*GIVEN), "--policy_from", pretrained)


def _configs() -> Iterator[Case]:
    for name, data in NOT_JSON.items():
        change = copied(written("config.json", data))
        yield Case(CONFIGS, f"config {name}", *_draw(), "config.json", change)
    fields = {
        "game": (1, None, "Pogn", ["Catch"]),
        "seed": ("0", 0.5, True, 10**400, -1),
        "lr_rl": (10**400, "x", float("nan"), float("-inf")),
        "objectives": ("latent_l2", [1], [["latent_l2"]], {"latent_l2": 1}),
        "encoder": (None, 1, ["tiny"], {}),
        "stop_at_return": ("off", True, 10**400),
        "frobnicate": (1,),
        "__init__": (CODE,),
    }
    for field, wrong in fields.items():
        for value in wrong:
            change = copied(edit(entry(field, value), "config.json"))
            name = f"config: {field} {json.dumps(value)[:24]}"
            yield Case(CONFIGS, name, *_draw(), "config.json", change)

    def twice(run: Path) -> None:
        path = run / "config.json"
        path.write_text(path.read_text().replace("{", '{"game": "Catch", ', 1))

    yield Case(CONFIGS, "config: a key twice", *_draw(), "config.json", copied(twice))

    def with_row(row: bytes) -> Prepare:
        return copied(lambda run: (run / "metrics.jsonl").write_bytes(row + b"\n"))

    for name, data in NOT_JSON.items():
        yield Case(CONFIGS, f"metrics {name}", *_draw(), "metrics.jsonl", with_row(data))
    good = {
        "kind": "eval", "env_steps": 0, "updates": 0, "wall_s": 1.0,
        "eval/return_mean": 1.0, "eval/returns": [1.0],
    }  # fmt: skip
    wrong = {
        "no kind": {"kind": KeyError},
        "kind is a list": {"kind": ["eval"]},
        "kind of another name": {"kind": CODE},
        "no env_steps": {"env_steps": KeyError},
        "env_steps is text": {"env_steps": "many"},
        "env_steps is null": {"env_steps": None},
        "env_steps is huge": {"env_steps": 10**400},
        "env_steps is a list": {"env_steps": [0, 1]},
        "env_steps is negative": {"env_steps": -1},
        "the mean is text": {"eval/return_mean": CODE},
        "the mean is huge": {"eval/return_mean": 10**400},
        "the mean is a list": {"eval/return_mean": [1.0]},
        "the mean is an object": {"eval/return_mean": {}},
        "returns are text": {"eval/returns": "12"},
        "drift is text": {"diag/drift/steps": "0"},
        "drift is of nothing": {"diag/drift/steps": [0], "diag/decoder_now/x": 1.0, "diag/encoder_now/x": {}},
        "returns are lists": {"eval/returns": [[1.0], [1.0, 2.0]]},
        "returns are an object": {"eval/returns": {"0": 1.0}},
        "returns are one number": {"eval/returns": 5},
        "a return is huge": {"eval/returns": [10**400]},
        "a loss is text": {"kind": "train", "loss/rl": "low"},
        "a loss is a list": {"kind": "train", "loss/rl": [1.0, 2.0]},
        "a loss is huge": {"kind": "train", "loss/rl": 10**400},
        "a loss is an object": {"kind": "train", "loss/rl": {"x": 1}},
    }
    for name, change in wrong.items():
        row = {key: value for key, value in (good | change).items() if value is not KeyError}
        call = _draw()
        yield Case(CONFIGS, f"metrics: {name}", *call, "metrics.jsonl", with_row(json.dumps(row).encode()))
    double = json.dumps(good).replace("{", '{"kind": "train", ', 1).encode()
    yield Case(CONFIGS, "metrics: a key twice", *_draw(), "metrics.jsonl", with_row(double))
    for name in ("config.json", "metrics.jsonl"):
        gone = copied(lambda run, name=name: (run / name).unlink())
        yield Case(CONFIGS, f"no {name}", *_draw(), name, gone)
        large = copied(replaced(name, sparse))
        yield Case(CONFIGS, f"{name} of a terabyte", *_draw(), name, large)
        folder = copied(replaced(name, os.mkdir))
        yield Case(CONFIGS, f"{name} is a folder", *_draw(), name, folder)
    file = copied(lambda run: (run / "figures").write_text("mine"))
    yield Case(CONFIGS, "figures is a file", *_draw(), "figures", file)
    for text in ("x", "6.2", "6.2/", "/", "6.2/rl_only_nature", "9.9/x", "../..", CODE, "\n", "x" * 5000):
        call = _draw(f"--thesis={text}")
        yield Case(CONFIGS, f"thesis {text[:30]!r}", *call, "--thesis", copied())


def _pickles() -> Iterator[Case]:
    for kind, data in TRAPS.items():
        for name in ("config.json", "metrics.jsonl"):
            call = _draw()
            yield Case(PICKLES, f"{name} ({kind})", *call, name, copied(written(name, data + b"\n")))
        for name in ("manifest.json", "params.msgpack"):
            change = damaged(lambda folder, name=name, data=data: (folder / name).write_bytes(data))
            yield Case(PICKLES, f"{name} ({kind})", *_evaluate(), name, change)
            yield Case(PICKLES, f"{name} ({kind}), to train", *_train(*START), "{source}", change)
            yield Case(PICKLES, f"{name} ({kind}), to pretrain", *_train(*GIVEN), "{source}", change)
        yield Case(PICKLES, f"flagfile ({kind})", *_train("--flagfile=file"), "", put(file=data))
        prepare = put(agent_pkl=data)
        for call, names in (
            (_evaluate("--run=agent.pkl"), "agent.pkl"),
            (_draw("--run=agent.pkl"), "agent.pkl"),
            (_train(*START, "--encoder_from=agent.pkl"), "--encoder_from"),
            (_train(*GIVEN, "--policy_from=agent.pkl"), "--policy_from"),
        ):
            yield Case(PICKLES, f"a pickle as {names} of {call[0]} ({kind})", *call, names, prepare)
        run = put(run__config_json=data, run__metrics_jsonl=data)
        call = _train("--game=Catch", "--overwrite")
        yield Case(PICKLES, f"a run to overwrite ({kind})", *call, "--out", run)


def _names() -> Iterator[Case]:
    outs = {
        "none": "",
        "of 300 letters": "{folder}/" + "x" * 300,
        "of 5,000 letters": "{folder}/" + "x" * 5000,
        "of 5,000 folders": "{folder}/" + "x/" * 5000,
        "below one of 300 letters": "new/" + "x" * 300 + "/run",
        "with a line break": "{folder}/a\nb",
        "with a carriage return": "{folder}/a\rb",
        "with a colour": "{folder}/\x1b[31mrun",
        "with a byte that is no letter": "{folder}/" + os.fsdecode(b"\xff"),
        "that writes backwards": "{folder}/\u202enur",
        "a file": "{folder}/file",
        "a file, from below": "{folder}/none/../file",
        "below a file": "{folder}/file/run",
        "this folder": ".",
        "the folder above": "..",
        "far above": "../../../../../../../../../..",
        "the root": "/",
        "a device": "/dev/null",
        "below a device": "/dev/null/run",
        "below the kernel": "/proc/self/none/run",
        "a folder that is not empty": "{folder}/full",
    }
    prepare = put(file="mine", full__mine="mine")
    for name, text in outs.items():
        yield Case(NAMES, f"out: {name}", *_train("--game=Catch", f"--out={text}"), "--out", prepare)
    for name in ("this folder", "the folder above", "the root", "a file", "a folder that is not empty"):
        call = _train("--game=Catch", "--overwrite", f"--out={outs[name]}")
        yield Case(NAMES, f"overwrite: {name}", *call, "--out", prepare)
    fakes = {
        "an empty config": {"full__config_json": "{}"},
        "a config that is a list": {"full__config_json": '["game", "mode", "versions"]'},
        "a config without an end": {"full__config_json": sparse},
        "a config 100,000 deep": {"full__config_json": "[" * DEEP},
        "a config that is a folder": {"full__config_json": os.mkdir},
    }
    for name, files in fakes.items():
        call = _train("--game=Catch", "--overwrite", "--out=full")
        yield Case(NAMES, f"overwrite: {name}", *call, "--out", put(**files))
    sources = {
        "none": "{folder}/none",
        "of 300 letters": "{folder}/" + "x" * 300,
        "of 5,000 letters": "{folder}/" + "x" * 5000,
        "with a line break": "a\nb",
        "with a byte that is no letter": os.fsdecode(b"\xff"),
        "a file": "{folder}/file",
        "below a file": "{folder}/file/run",
        "an empty folder": "{folder}/empty",
        "another folder": "{folder}/full",
        "checkpoints without one": "{folder}/bare",
        "the root": "/",
        "a device": "/dev/null",
        "a device without an end": "/dev/zero",
        "an address": "https://localhost/run",
    }
    prepare = put(file="mine", full__mine="mine", empty=os.mkdir, bare__checkpoints__000000001__mine="mine")
    for name, text in sources.items():
        yield Case(NAMES, f"evaluate: {name}", *_evaluate(f"--run={text}"), "", prepare)
        yield Case(NAMES, f"draw: {name}", *_draw(f"--run={text}"), "", prepare)
        call = _train(*START, f"--encoder_from={text}")
        yield Case(NAMES, f"encoder_from: {name}", *call, "--encoder_from", prepare)
        call = _train(*GIVEN, f"--policy_from={text}")
        yield Case(NAMES, f"policy_from: {name}", *call, "--policy_from", prepare)
    yield Case(NAMES, "evaluate: nothing", *_evaluate("--run="), "--run")
    yield Case(NAMES, "draw: nothing", *_draw("--run="), "--run")
    gifs = {
        "another ending": "a.png",
        "no ending": "gif",
        "nothing but an ending": ".gif",
        "in no folder": "{folder}/none/a.gif",
        "below a file": "{folder}/file/a.gif",
        "a file that is there": "{folder}/old.gif",
        "a folder": "{folder}/folder.gif",
        "of 300 letters": "x" * 300 + ".gif",
        "of 5,000 letters": "x" * 5000 + ".gif",
        "with a line break": "a\nb.gif",
        "a link that leads nowhere": "{folder}/link.gif",
    }

    def with_gifs(folder: Path, valid: Path) -> None:
        shutil.copytree(valid, folder / "source")
        (folder / "file").write_text("mine")
        (folder / "old.gif").write_text("mine")
        (folder / "folder.gif").mkdir()
        (folder / "link.gif").symlink_to("nowhere")

    for name, text in gifs.items():
        yield Case(NAMES, f"gif: {name}", *_evaluate(f"--gif={text}"), "--gif", with_gifs)


def _links() -> Iterator[Case]:
    def to(target: str) -> Callable[[Path], None]:
        return lambda path: path.symlink_to(target)

    things: dict[str, Callable[[Path], Any]] = {
        "a pipe": os.mkfifo,
        "a link to zeros without end": to("/dev/zero"),
        "a link to a terminal": to("/dev/tty"),
        "a link that leads nowhere": to("nowhere"),
        "a link to itself": lambda path: path.symlink_to(path.name),
        "a link to a folder": to(".."),
        "a link to a pipe": lambda path: (os.mkfifo(path.with_name("pipe")), path.symlink_to("pipe")),
        "a socket": _socket,
    }
    for name, thing in things.items():
        for file in ("manifest.json", "params.msgpack"):
            change = damaged(replaced(file, thing))
            call = _evaluate("--run={checkpoint}")
            yield Case(LINKS, f"{file} is {name}, to evaluate", *call, "{checkpoint}", change)
            call = _train(*START, "--encoder_from={checkpoint}")
            yield Case(LINKS, f"{file} is {name}, to train", *call, "{checkpoint}", change)
        for file in ("config.json", "metrics.jsonl"):
            change = copied(replaced(file, thing))
            yield Case(LINKS, f"{file} is {name}, to draw", *_draw(), file, change)
        run = put(run__config_json=thing, run__mine="mine")
        call = _train("--game=Catch", "--overwrite")
        yield Case(LINKS, f"config.json is {name}, to overwrite", *call, "--out", run)
    folders = {
        "checkpoints is a link to itself": replaced("checkpoints", to("checkpoints")),
        "checkpoints is a link that leads nowhere": replaced("checkpoints", to("nowhere")),
        "checkpoints is a file": replaced("checkpoints", lambda path: path.write_text("mine")),
        "checkpoints is a pipe": replaced("checkpoints", os.mkfifo),
        "checkpoints is a link to zeros": replaced("checkpoints", to("/dev/zero")),
    }
    for name, change in folders.items():
        yield Case(LINKS, f"{name}, to evaluate", *_evaluate(), "{source}", copied(change))
        yield Case(LINKS, f"{name}, to train", *_train(*START), "--encoder_from", copied(change))
    outs = {
        "a link that leads nowhere": to("nowhere"),
        "a link to itself": to("run"),
        "a link to a file": to("file"),
        "a link to a folder with files": to("full"),
        "a link to zeros": to("/dev/zero"),
        "a pipe": os.mkfifo,
        "a socket": _socket,
    }
    for name, thing in outs.items():
        prepare = put(file="mine", full__mine="mine", run=thing)
        yield Case(LINKS, f"out is {name}", *_train("--game=Catch"), "--out", prepare)
        call = _train("--game=Catch", "--overwrite")
        yield Case(LINKS, f"out is {name}, to overwrite", *call, "--out", prepare)
    for name in ("a link that leads nowhere", "a link to itself", "a link to a file"):
        prepare = put(file="mine", run=outs[name])
        call = _train("--game=Catch", "--out=run/below")
        yield Case(LINKS, f"out is below {name}", *call, "--out", prepare)

    def linked_run(folder: Path, valid: Path) -> None:
        shutil.copytree(valid, folder / "source")
        (folder / "run").symlink_to("source")

    call = _train("--game=Catch", "--overwrite")
    yield Case(LINKS, "out is a link to a run, to overwrite", *call, "--out", linked_run)


def _socket(path: Path) -> None:
    import socket

    # A socket's path may have 107 bytes; the folder's descriptor makes it shorter.
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(f"/proc/self/fd/{descriptor}/{path.name}")
    finally:
        os.close(descriptor)


def _valid() -> Iterator[Case]:
    yield Case(VALID, "evaluate", *_evaluate(), "", copied())
    yield Case(VALID, "evaluate one checkpoint", *_evaluate("--run={checkpoint}"), "", copied())
    yield Case(VALID, "evaluate a manifest written again", *_evaluate(), "", damaged(edit(lambda m: m)))
    yield Case(VALID, "draw", *_draw(), "", copied())
    row = b'{"kind": "train", "env_steps": 0, "loss/$\\\\frac$": 1.0}\n'
    odd = copied(lambda run: (run / "metrics.jsonl").write_bytes(row))
    yield Case(VALID, "draw a loss of an odd name", *_draw(), "", odd)
    call = _train(*START, "--print_config")
    yield Case(VALID, "print the config of a run from an encoder", *call, "", copied())


_PARTS = (
    _flags, _presets, _specs, _together, _checkpoints, _configs, _pickles, _names, _links, _valid,
)  # fmt: skip
