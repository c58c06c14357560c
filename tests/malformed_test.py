"""Malformed input of train, evaluate and draw: one line, status 2; nothing is written and nothing executed.

Command lines are generated from what a flag says of its values; files and folders are replaced by everything
that is none, or is none of ours. What a message says exactly is tested where it is made; here it must name the
flag or the file. `tests/soak/malformed_test.py` reads the hostile files in processes of their own.
"""

import json
import os
import pickle
import shutil
import signal
import socket
from unittest import mock

import pytest
from absl import flags

from experiments import draw, evaluate, train
from experiments import flags as config_flags
from experiments.flags import MOVED, last_of_each
from srl_jax import checkpoint
from srl_jax.config import INFOS
from srl_jax.specs import Info
from tests.helpers import SMALL, write_checkpoint, write_run

LIMIT_S = 20
"""A case that takes longer has failed; what waits for a pipe waits for ever."""
CODE = "__import__('os').system('touch CANARY')"
"""Makes a file in the working directory if anything evaluates it."""
DEEP = 100_000

FITTING = tuple(f"--{name}={SMALL[name]}" for name in ("game", "frame_size", "encoder", "rl", "num_envs"))
TRAIN = ("train", "--tune_runtime=off", "--out=run")
START = (*TRAIN, *FITTING, "--mode=finetuned", "--encoder_from=source")
GIVEN = (*TRAIN, *FITTING, "--mode=pretrain", "--objective=latent_l2", "--policy_from=source")
EVALUATE = ("evaluate", "--tune_runtime=off", "--run=source", "--games=1")
DRAW = ("draw", "--run=source")
OVERWRITE = (*TRAIN, "--game=Catch", "--overwrite")


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """A run directory as training leaves it: config.json, metrics.jsonl and one checkpoint."""
    run = write_run(tmp_path_factory.mktemp("valid") / "source", **SMALL)
    write_checkpoint(run)
    return run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def source(valid, folder):
    """A copy of the valid run in the working directory, `source`."""
    return shutil.copytree(valid, folder / "source")


def call(program, *arguments):
    """Runs an entry point in this process, with flags of its own; returns its exit status."""
    module, values = {"train": train, "evaluate": evaluate, "draw": draw}[program], flags.FlagValues()
    if program == "draw":
        for name in ("run", "thesis"):
            flags.DEFINE_string(name, "", "", flag_values=values)
    else:
        module.define_flags(values)

    def late(*_):
        raise TimeoutError(arguments)

    handler = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        with mock.patch.object(module, "FLAGS", values):
            config_flags.parse([program, *last_of_each(arguments)], values)
            return config_flags.guarded(module.main)([program]) or 0
    except SystemExit as ended:
        return ended.code
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


def listing(folder):
    """Everything below a folder: what it is, its size and time."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            about = os.lstat(os.path.join(root, name))
            if name in folders:  # a file that was made there and removed again leaves another time
                found[root, name] = about.st_mode
            else:
                found[root, name] = about.st_mode, about.st_size, about.st_mtime_ns, about.st_ino
    return found


@pytest.fixture
def refused(folder, capsys):
    """refused(program, *arguments, names=what the line must hold)."""

    def check(program, *arguments, names):
        before = listing(folder)
        status, case = call(program, *arguments), (program, *(text[:200] for text in arguments))
        out, line = capsys.readouterr()
        assert (status, out) == (2, ""), (case, line)
        assert line.count("\n") == 1 and line.endswith("\n") and line[:-1].isprintable(), (case, line)
        assert names in line, (case, line)
        assert listing(folder) == before, case

    return check


# Flags


def wrong(info):
    """Texts that a flag must refuse."""
    if info.kind is bool:
        return ["", "maybe", "2", CODE]
    if info.choices:
        first = info.choices[0]
        return ["", "x", CODE, f"{first}\nx", f"{first}\u0301", "x" * 5000]
    if info.kind not in (int, float):
        return []
    texts = ["", "abc", CODE, "1\n2", "inf", "1e400", "9" * 400]
    texts += ["1.5", str(2**31), "0x10"] if info.kind is int else ["1e39", "1+1j"]
    texts += [] if info.optional else ["nan"]
    least = info.minimum if info.minimum is not None else info.above
    texts += [] if least is None else [f"{least - 1:.10g}"]
    return texts + ([] if info.maximum is None else [f"{info.maximum + 1:.10g}"])


FLAGS = {info.flag or name: info for name, info in INFOS.items() if wrong(info)}
FLAGS["tune_runtime"] = Info(str, "", choices=("auto", "off"))


@pytest.mark.parametrize("flag", FLAGS)
def test_values_that_a_flag_does_not_take(flag, refused):
    for text in wrong(FLAGS[flag]):
        refused(*TRAIN, f"--{flag}={text}", names=f"--{flag}")


@pytest.mark.parametrize(
    ("flag", "texts"),
    [
        ("games", ("", "0", "-1", "1.5", "nan", "x", "9" * 400, "9" * 5000, "9999999999999", CODE)),
        ("seed", ("", "-1", "1.5", "nan", "x", "2147483648", "9" * 400, CODE)),
        ("epsilon", ("", "-0.1", "1.1", "nan", "inf", "-inf", "1e400", "x", CODE)),
        ("tune_runtime", ("", "x", CODE)),
        ("run", ("",)),
        ("frobnicate", ("1",)),
    ],
)
def test_values_that_evaluate_does_not_take(flag, texts, refused, source):
    for text in texts:
        refused(*EVALUATE, f"--{flag}={text}", names=flag)


def test_flags_that_there_are_not(refused):
    for flag in ("--gane=Pong", "--frobnicate=1", "--__class__=1", *(f"--{flag}=1" for flag in MOVED)):
        refused(*TRAIN, flag, names=flag.partition("=")[0])
    for argument, names in (
        (f"--{CODE}", CODE[:20]),
        ("--steps", "steps"),
        ("-steps=abc", "--steps"),
        ("---steps=5", "-steps"),
        ("Pong", "Pong"),
        ("--nosteps", "nosteps"),
        ("--notensorboard=5", "tensorboard"),
        ("--overwrite=perhaps", "overwrite"),
        ("--print_config=perhaps", "print_config"),
        ("--\u017fteps=5", "teps"),
        ("--flagfile=file", "--flagfile"),
    ):
        refused(*TRAIN, argument, names=names)
    refused(*TRAIN, "--", "x", names="'x'")


def test_seeds_and_presets_that_there_are_not(refused):
    seeds = ("", ",", "1,", "1,,2", "1;2", "0,0", "-1", "1.5", "nan", "2147483648", "9" * 400, "a", CODE)
    for text in seeds:
        refused(*TRAIN, f"--seeds={text}", names="--seeds")
    presets = (
        "", "x", "none", "thesis/joint_25", "joint_256", "DEMO", "demo,catch/joint", "demo ", "demo\nx",
        "../presets", "__class__", CODE, "x" * 5000, "d\u0435mo", "\x1b[2J",
    )  # fmt: skip
    for text in presets:
        refused(*TRAIN, f"--preset={text}", names="--preset")
    for preset in ("thesis/frozen_256", "thesis/joint_from_pretrained_256", "catch/finetuned"):
        refused(*TRAIN, f"--preset={preset}", names="--encoder_from")


SPECS = {
    "objective": (
        f"reconstruction:weight={CODE}", CODE, "__class__", "__import__('os')", "lambda: 0",
        "reconstruction:__class__=1", "reconstruction:context=1", "reconstruction:weight=",
        "reconstruction:weight", "reconstruction:", "reconstruction:=1", "reconstruction:,",
        "reconstruction:weight=1,", "reconstruction:weight=1,weight=1", ":weight=1",
        "reconstruction:weight=nan", "reconstruction:weight=inf", "reconstruction:weight=1e39",
        "reconstruction:weight=-1", "reconstruction:weight=1:2", "reconstruction:weight=1;x=2",
        "reconstruction:weight=True", "reconstruction:weight=0x1", "reconstruction:weight={}",
        "reconstruction weight=1", "Reconstruction", "reconstruction\nlatent_l2", "r\u0435construction",
        "\x1b[31mreconstruction", "../reconstruction", "srl_jax.objectives.inverse", "x" * 5000,
        "inverse:hidden=0", "inverse:hidden=-1", "inverse:hidden=1.5", "inverse:hidden=2147483648",
        "inverse:hidden=2147483647", "inverse:hidden=" + "9" * 400, "latent_l2:hidden=4", " ",
    ),
    "encoder": (
        "", ":", "tiny:", "Tiny", "nature:features=1", "nature:observation_shape=1", "sac_ae:features=0",
        "sac_ae:features=-1", "sac_ae:features=2.5", "sac_ae:features=1e400", "sac_ae:features=99999999999",
        "sac_ae:features=2147483647", "sac_ae:layer_norm=maybe", "sac_ae:features=256,features=256",
        f"tiny:features={CODE}", "tiny:__dict__=1", "__builtins__",
    ),
    "rl": (
        "", "rainbow:", "rainbow:n_step=0", "rainbow:n_step=1.5", "rainbow:n_step=2147483647",
        "rainbow:n_step=1e9,n_step=1", "rainbow:atoms=1", "rainbow:atoms=1000000000", "rainbow:v_min=10",
        "rainbow:v_min=nan", "rainbow:v_max=1e39", "rainbow:v_min=1,v_max=1", "rainbow:hidden=0",
        "rainbow:hidden=2147483647", "rainbow:alpha=2", "rainbow:alpha=-1", "rainbow:noisy_std=-1",
        "rainbow:noisy_std=inf", "rainbow:init_std=-1", "rainbow:init_std=1e-300", "rainbow:double=2",
        "rainbow:context=1", "dqn:dueling=yes", "c51:func=rainbow", f"double:{CODE}",
        f"rainbow:hidden={CODE}", "_plain",
    ),
}  # fmt: skip


@pytest.mark.parametrize("flag", SPECS)
def test_specifications_of_nothing(flag, refused):
    mode = ("--mode=joint",) if flag == "objective" else ()
    for text in SPECS[flag]:
        refused(*TRAIN, "--game=Catch", *mode, f"--{flag}={text}", names=f"--{flag}=")


TOGETHER = {
    "--batch_size": ("--batch_size=100", "--buffer_size=99"),
    "--learn_start": ("--learn_start=2000", "--buffer_size=1999"),
    "--buffer_size": ("--buffer_size=2000000000",),
    "--buffer_size=50": ("--batch_size=1", "--learn_start=0", "--num_envs=10", "--buffer_size=50"),
    "n_step": ("--rl=:n_step=20000", "--buffer_size=1000"),
    "num_envs": ("--num_envs=10000", "--buffer_size=20000"),
    "--encoder": ("--game=Pong", "--frame_size=8"),
    "--encoder_from": ("--encoder_from=.",),
    "--objective": ("--mode=joint", "--objective="),
    "--objective=": ("--mode=joint", "--objective=none", "--objective=inverse"),
    "--objective=latent_l2": ("--mode=joint", "--objective=latent_l2", "--objective=latent_l2:weight=2"),
    "--mode=finetuned": ("--mode=finetuned", "--objective=inverse", "--encoder_from=."),
    "--policy_from": ("--mode=joint", "--objective=inverse", "--policy_from=."),
    "--augment": ("--augment=srl",),
    "--lr_encoder": ("--mode=frozen", "--encoder_from=.", "--lr_encoder=1"),
    "--srl_every": ("--mode=pretrain", "--objective=inverse", "--srl_every=2"),
    "v_m": ("--rl=:v_min=1,v_max=0",),
}


@pytest.mark.parametrize("names", TOGETHER)
def test_flags_that_contradict_each_other(names, refused):
    refused(*TRAIN, "--game=Catch", *TOGETHER[names], names=names)


@pytest.mark.parametrize("flag", ["--frame_size=84", "--frame_stack=3", "--encoder=tiny:features=9"])
def test_a_source_that_does_not_fit(flag, refused, source):
    refused(*START, flag, names="--encoder_from")
    if "encoder" not in flag:
        refused(*GIVEN, flag, names="--policy_from")


def test_a_source_is_not_overwritten(refused, source):
    refused(*GIVEN, "--game=CatchDistractor", names="--policy_from")
    for command in (START, GIVEN):
        refused(*command, "--out=source", "--overwrite", names="--overwrite would delete")


# Files


def _bind(path):
    # A socket's path may have 107 bytes; the folder's descriptor makes it shorter.
    descriptor = os.open(path.parent, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(f"/proc/self/fd/{descriptor}/{path.name}")
    os.close(descriptor)


class Trap:
    """Makes a file when it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch CANARY",)


def link(target):
    return lambda path: path.symlink_to(target)


def written(data):
    return lambda path: path.write_bytes(data)


NO_FILES = {
    "gone": lambda path: None,
    "a folder": os.mkdir,
    "a pipe": os.mkfifo,
    "a socket": _bind,
    "a link to zeros without end": link("/dev/zero"),
    "a link to a terminal": link("/dev/tty"),
    "a link that leads nowhere": link("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to a folder": link(".."),
    "a link to a pipe": lambda path: (os.mkfifo(path.with_name("pipe")), path.symlink_to("pipe")),
}
TRAPS = {
    "a pickle": written(pickle.dumps(Trap(), protocol=5)),
    "a pickle as text": written(pickle.dumps(Trap(), protocol=0)),
}
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
TEXTS = NO_FILES | TRAPS | {name: written(data) for name, data in NOT_JSON.items()}
TEXTS["a terabyte"] = lambda path: path.write_bytes(b"") or os.truncate(path, 1 << 40)
CHECKPOINT_FILES = ("manifest.json", "manifest.sha256", "params.msgpack")


def put(path, thing):
    """Puts a thing in a file's place."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    thing(path)


READERS = {"evaluate": EVALUATE, "encoder_from": START, "policy_from": GIVEN}


@pytest.mark.parametrize("file", CHECKPOINT_FILES)
@pytest.mark.parametrize("thing", NO_FILES | TRAPS)
def test_a_checkpoint_of_other_things(file, thing, refused, source):
    put(checkpoint.read_manifest(source).path / file, (NO_FILES | TRAPS)[thing])
    for command in READERS.values():
        refused(*command, names="source")


@pytest.mark.parametrize("file", CHECKPOINT_FILES)
def test_a_checkpoint_that_is_damaged(file, refused, source):
    path = checkpoint.read_manifest(source).path / file
    data = path.read_bytes()
    bit = data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]
    for damaged in (b"", data[: len(data) // 2], bit, data + b"\0", bytes(len(data))):
        path.write_bytes(damaged)
        for command in READERS.values():
            refused(*command, names="source")


@pytest.mark.parametrize("thing", [name for name in NO_FILES if name != "a socket"])
def test_checkpoints_that_are_no_folder(thing, refused, source):
    put(source / "checkpoints", NO_FILES[thing] if thing != "a folder" else written(b"mine"))
    for command in (EVALUATE, START):
        refused(*command, names="source")


@pytest.mark.parametrize("file", ["config.json", "metrics.jsonl"])
@pytest.mark.parametrize("thing", TEXTS)
def test_a_run_of_other_things(file, thing, refused, source):
    put(source / file, TEXTS[thing])
    refused(*DRAW, names=file)


FIELDS = {
    "game": (1, None, "Pogn", ["Catch"]),
    "seed": ("0", 0.5, True, 10**400, -1),
    "lr_rl": (10**400, "x", float("nan"), float("-inf")),
    "objectives": ("latent_l2", [1], [["latent_l2"]], {"latent_l2": 1}),
    "encoder": (None, 1, ["tiny"], {}),
    "stop_at_return": ("off", True, 10**400),
    "frobnicate": (1,),
    "__init__": (CODE,),
}


@pytest.mark.parametrize("field", FIELDS)
def test_a_config_with_other_values(field, refused, source):
    path = source / "config.json"
    content = json.loads(path.read_text())
    for value in FIELDS[field]:
        path.write_text(json.dumps(content | {field: value}))
        refused(*DRAW, names="config.json")


ROW = {"kind": "eval", "env_steps": 0, "updates": 0, "wall_s": 1.0, "eval/return_mean": 1.0}
ROW["eval/returns"] = [1.0]
TRAIN_ROW = {"kind": "train", "env_steps": 0, "updates": 0, "wall_s": 1.0}


def test_rows_with_other_values(refused, source):
    # tests/draw_test.py has more.
    rows = [{key: ROW[key] for key in ROW if key != gone} for gone in ("kind", "env_steps")]
    rows += [ROW | {"kind": CODE}]
    rows += [ROW | {"env_steps": x} for x in ("many", None, 10**400, [0, 1], -1)]
    rows += [ROW | {"eval/return_mean": x} for x in (CODE, [1.0], {})]
    rows += [ROW | {"eval/returns": x} for x in ("12", [[1.0], [1.0, 2.0]], {"0": 1.0}, [10**400])]
    rows += [TRAIN_ROW | {"loss/rl": x} for x in ("low", [1.0, 2.0], 10**400)]
    rows += [ROW | {"diag/drift/steps": "0"}]
    rows += [ROW | {"diag/drift/steps": [0], "diag/decoder_now/x": 1.0, "diag/encoder_now/x": {}}]
    twice = json.dumps(ROW).replace("{", '{"kind": "train", ', 1)
    for text in (*map(json.dumps, rows), twice):
        (source / "metrics.jsonl").write_text(text + "\n")
        refused(*DRAW, names="metrics.jsonl")


def test_figures_that_cannot_be_drawn(refused, source):
    for text in ("x", "6.2", "6.2/", "/", "6.2/rl_only_nature", "9.9/x", "../..", CODE, "\n", "x" * 5000):
        refused(*DRAW, f"--thesis={text}", names="--thesis")
    (source / "figures").write_text("mine")
    refused(*DRAW, names="figures")


# Names


LONG = ("x" * 300, "x" * 5000, "x/" * 5000)
ODD = ("a\nb", "a\rb", "\x1b[31mrun", os.fsdecode(b"\xff"), "\u202enur")


@pytest.fixture
def full(folder):
    """A file, a folder with a file, an empty one, and checkpoints that are none, in the working directory."""
    for name in ("file", "full/mine", "bare/checkpoints/000000001/mine"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("mine")
    (folder / "empty").mkdir()


def test_where_a_run_cannot_lie(refused, full):
    places = ("", "new/" + "x" * 300 + "/run", "file", "none/../file", "file/run", ".", "..", "../" * 20, "/")
    places += ("/dev/null", "/dev/null/run", "/proc/self/none/run", "full")
    for text in (*LONG, *ODD, *places):
        refused(*TRAIN, "--game=Catch", f"--out={text}", names="--out")
    for text in (".", "..", "/", "file", "full"):
        refused(*OVERWRITE, f"--out={text}", names="--out")


@pytest.mark.parametrize("thing", [name for name in TEXTS if name not in ("gone", "a link to a folder")])
def test_what_is_no_run_is_not_overwritten(thing, refused, full, folder):
    put(folder / "full" / "config.json", TEXTS[thing])
    refused(*OVERWRITE, "--out=full", names="--out")


def test_a_list_or_nothing_is_no_config_of_a_run_to_overwrite(refused, full, folder):
    for text in ("{}", '["game", "mode", "versions"]'):
        (folder / "full" / "config.json").write_text(text)
        refused(*OVERWRITE, "--out=full", names="--out")


@pytest.mark.parametrize("thing", [name for name in NO_FILES if name not in ("gone", "a folder")])
def test_out_is_something_else(thing, refused, full, folder):
    put(folder / "run", NO_FILES[thing])
    for command in (TRAIN, OVERWRITE):
        refused(*command, "--game=Catch", names="--out")
    if thing != "a link to a folder":
        refused(*TRAIN, "--game=Catch", "--out=run/below", names="--out")


def test_a_link_to_a_run_is_not_overwritten(refused, source, folder):
    (folder / "run").symlink_to("source")
    refused(*OVERWRITE, names="--out")


SOURCES = ("none", *LONG[:2], "a\nb", os.fsdecode(b"\xff"), "file", "file/run", "empty", "full", "bare")
SOURCES += ("/", "/dev/null", "/dev/zero", "https://localhost/run")


def test_what_is_no_run_to_read(refused, full):
    for text in SOURCES:
        refused(*EVALUATE, f"--run={text}", names="")
        refused(*DRAW, f"--run={text}", names="")
        refused(*START, f"--encoder_from={text}", names="--encoder_from")
        refused(*GIVEN, f"--policy_from={text}", names="--policy_from")
    refused("draw", "--run=", names="--run")


@pytest.mark.parametrize("trap", TRAPS)
def test_a_pickle_is_no_run(trap, refused, folder):
    TRAPS[trap](folder / "agent.pkl")
    for command in (EVALUATE, DRAW):
        refused(*command, "--run=agent.pkl", names="agent.pkl")
    refused(*START, "--encoder_from=agent.pkl", names="--encoder_from")
    refused(*GIVEN, "--policy_from=agent.pkl", names="--policy_from")


def test_where_a_gif_cannot_lie(refused, source, full, folder):
    (folder / "old.gif").write_text("mine")
    (folder / "folder.gif").mkdir()
    (folder / "link.gif").symlink_to("nowhere")
    gifs = ("a.png", "gif", ".gif", "none/a.gif", "file/a.gif", "old.gif", "folder.gif", "link.gif")
    for text in (*gifs, *(f"{name}.gif" for name in LONG[:2]), "a\nb.gif"):
        refused(*EVALUATE, f"--gif={text}", names="--gif")


# What is not malformed


def test_valid_input_is_accepted(source, capsys):
    for command in (EVALUATE, DRAW, (*START, "--print_config")):
        assert call(*command) == 0
        assert capsys.readouterr().err == ""
    (source / "metrics.jsonl").write_text('{"kind": "train", "env_steps": 0, "loss/$\\\\frac$": 1.0}\n')
    assert call(*DRAW) == 0
