"""Files and folders in whose place lies everything that is none, or is none of ours, and names of nothing."""

import errno
import json
import os
import pickle
import shutil
import socket

import pytest

from srl_jax.files import checkpoint
from tests.malformed.conftest import CODE, DRAW, EVALUATE, GIVEN, OVERWRITE, START, TRAIN, call

DEEP = 100_000


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
    return lambda path: path.write_bytes(data + b"\n")  # without it, a row is one that is being written


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
    # tests/experiments/drawing/run_figures_test.py has more.
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
    gifs += ("/proc/a.gif",)
    for text in (*gifs, *(f"{name}.gif" for name in LONG[:2]), "a\nb.gif"):
        refused(*EVALUATE, f"--gif={text}", names="--gif")


def test_a_gif_that_is_not_written_is_one_line_and_the_scores_are_there(source, folder, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        assert call(*EVALUATE, "--gif=a.gif") == 3
    printed = capsys.readouterr()
    assert printed.err == "error: --gif=a.gif: not written: No space left on device\n"
    assert len(json.loads(printed.out)["returns"]) == 1 and not (folder / "a.gif").exists()
    monkeypatch.setenv("HOME", str(folder / "home"))
    (folder / "home").mkdir()
    assert call(*EVALUATE, "--gif=~/a.gif") == 0 and (folder / "home/a.gif").exists()


# What is not malformed


def test_valid_input_is_accepted(source, capsys):
    for command in (EVALUATE, DRAW, (*START, "--print_config")):
        assert call(*command) == 0
        assert capsys.readouterr().err == ""
    (source / "metrics.jsonl").write_text('{"kind": "train", "env_steps": 0, "loss/$\\\\frac$": 1.0}\n')
    assert call(*DRAW) == 0
