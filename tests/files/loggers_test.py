"""Loggers: who is given a run's rows, each of them once, and what happens where one fails."""

import csv
import io
import json
import sys
import types

import numpy as np
import pytest

from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import loggers
from srl_jax.files.loggers import check, factory, listed
from srl_jax.files.metrics import read_metrics
from srl_jax.run.reporting import Report
from tests.helpers import SMALL

MINE = """
class Mine:
    calls = []
    def __init__(self, out, config):
        self.calls.append(("made", str(out), config["gamma"]))
    def row(self, env_step, values):
        self.calls.append((env_step, values))
    def close(self):
        self.calls.append("closed")
"""


class Plain:
    """A logger without the methods that may be missing; fails at the rows of an env step."""

    fails_at = fails_to_begin = None

    def __init__(self, out, config):
        if self.fails_to_begin:
            raise OSError(self.fails_to_begin)
        self.steps = self.seen.setdefault(out, [])

    def row(self, env_step, values):
        if env_step == self.fails_at:
            raise ConnectionError("no\nroute")
        self.steps.append(env_step)

    def close(self):
        self.steps.append("closed")


@pytest.fixture
def plain(monkeypatch):
    """The row `plain` of the registry; its `seen` is {run directory: what it was given}."""
    made = type("PlainHere", (Plain,), {"seen": {}})
    monkeypatch.setitem(loggers.REGISTRY, "plain", made)
    return made


def report(out, *names, **values):
    out.mkdir(exist_ok=True)
    return Report(out, Config(**{**SMALL, **values}, loggers=names), progress=False)


def write(one, *steps):
    for step in steps:
        one.train_row(step, step // 10, {"epsilon": 0.5})


# What --logger says


def test_values_are_lists_and_options_have_commas_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    assert listed(["csv,wandb:project=a,group=b, tensorboard", "none", "os.path:join"]) == (
        "csv", "wandb:project=a,group=b", "tensorboard", "os.path:join",
    )  # fmt: skip
    assert listed(["mine.py:Mine,mine:Mine"]) == (f"{tmp_path}/mine.py:Mine",) * 2
    assert listed(["none"]) == listed([""]) == ()


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["csvv"], "--logger=csvv: no 'csvv'; did you mean csv? valid: tensorboard, wandb, csv"),
        (["wandb:projet=x"], "--logger=wandb:projet=x: wandb has no option 'projet'; did you mean project"),
        (["csv", "csv"], "--logger=csv: given twice"),
        (["/a/mine.py:Mine", "/b/mine.py:Mine"], "--logger=/b/mine.py:Mine: named as /a/mine.py:Mine is"),
        (["nonesuch_module:A"], "--logger=nonesuch_module: ModuleNotFoundError: No module named"),
        (["json:Nonesuch"], "--logger=json:Nonesuch: json has no class Nonesuch"),
        (["json:__name__"], "--logger=json:__name__: json has no class __name__"),
        (["/nowhere/mine.py:Mine"], "--logger=/nowhere/mine.py: no such file"),
    ],
)
def test_what_cannot_log_is_refused_in_a_line(texts, message):
    with pytest.raises(ConfigError) as error:
        check(listed(texts) if "/" not in texts[0] else texts)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "package"), [("wandb", "wandb"), ("tensorboard", "tensorboardX")])
def test_a_package_that_is_missing_is_named(monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=f"^--logger={name}: needs {package}: pip install {package}$"):
        check([name])


def test_a_class_in_a_file_logs(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    (text,) = listed([f"{tmp_path}/mine.py:Mine"])
    with report(tmp_path / "run", text, gamma=0.5) as one:
        write(one, 40)
    calls = sys.modules[factory(text).__module__].Mine.calls
    (row,) = read_metrics(tmp_path / "run/metrics.jsonl")
    numbers = {key: x for key, x in row.items() if key not in ("kind", "env_steps", "train/return_mean")}
    assert calls == [("made", f"{tmp_path}/run", 0.5), (40, numbers), "closed"]


# Each row once


def test_a_resumed_run_gives_no_row_twice_and_each_logger_what_it_lacks(tmp_path, plain):
    with report(tmp_path, "plain", "csv") as one:
        write(one, 40, 80)
        snapshot = json.loads(json.dumps(one.snapshot()))
        write(one, 120, 160)
    for last in (120, 200):  # it is killed again before it has got as far as the first time
        again = report(tmp_path, "plain", "csv", "tensorboard")
        again.restore(snapshot)
        with again:
            write(again, *range(120, last + 1, 40))
    steps = [40, 80, 120, 160, 200]
    assert [step for step in plain.seen[tmp_path] if step != "closed"] == steps
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["env_steps"]) for row in rows] == steps
    assert json.loads((tmp_path / loggers.FILE).read_text()) == {"plain": 5, "csv": 5, "tensorboard": 5}


def test_a_logger_that_fails_is_left_out_and_catches_up_when_the_run_is_resumed(tmp_path, plain, capsys):
    plain.fails_at = 80
    with report(tmp_path, "csv", "plain") as one:
        write(one, 40, 80, 120)
        snapshot = one.snapshot()
    said = capsys.readouterr().err
    assert said == "logger plain: ConnectionError: no route; it is left out from now on\n"
    assert plain.seen[tmp_path] == [40]
    assert len(read_metrics(tmp_path / "metrics.jsonl")) == 3
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 4
    plain.fails_at, plain.fails_to_begin = None, "down"
    again = report(tmp_path, "csv", "plain")
    again.restore(snapshot)
    with again:  # where it is still not there, the run goes on all the same
        write(again, 160)
    assert "logger plain: OSError: down; it is left out" in capsys.readouterr().err
    plain.fails_to_begin = None
    last = report(tmp_path, "csv", "plain")
    last.restore(snapshot)
    with last:
        write(last, 160)
    assert plain.seen[tmp_path] == [40, 80, 120, 160, "closed"]


def test_a_run_that_begins_is_refused_where_its_logger_cannot_be_made(tmp_path, plain):
    plain.fails_to_begin = "not logged in"
    with pytest.raises(ConfigError, match="^--logger=plain: OSError: not logged in$"):
        with report(tmp_path / "run", "csv", "plain"):
            pass
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize("text", ["{", "[]", '{"csv": "1"}'])
def test_numbers_of_rows_that_are_damaged_are_named(tmp_path, text):
    (tmp_path / loggers.FILE).write_text(text)
    with pytest.raises(ConfigError, match=f"{loggers.FILE}: .*; without it, loggers are given all rows"):
        report(tmp_path, "csv").__enter__()


def test_a_run_without_loggers_writes_nothing_beside_its_rows(tmp_path):
    with report(tmp_path) as one:
        write(one, 40)
        one.pictures(40, {"reconstruction": (np.zeros((2, 4, 4, 1), np.float32),) * 3})
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.jsonl"]


# csv


def test_csv_has_columns_by_first_appearance_and_empty_cells(tmp_path):
    made = loggers.CSV(tmp_path, {})
    made.row(40, {"updates": 1, "loss/a": 0.5})
    made.row(80, {"updates": 2, "loss/a": 0.25})
    made.row(80, {"updates": 2, "eval/x,y": -1.0})
    made.row(120, {"loss/a": 0.125})
    made.close()
    assert (tmp_path / "metrics.csv").read_text() == (
        'env_steps,updates,loss/a,"eval/x,y"\n40,1,0.5,\n80,2,0.25,\n80,2,,-1.0\n120,,0.125,\n'
    )


def test_csv_goes_on_behind_the_last_whole_line(tmp_path):
    file = tmp_path / "metrics.csv"
    file.write_text("env_steps,a\n40,1\n80,")
    loggers.CSV(tmp_path, {}).row(80, {"a": 2, "b": 3})
    assert file.read_text() == "env_steps,a,b\n40,1,\n80,2,3\n"


# TensorBoard and Weights & Biases


def events(folder):
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for file in sorted(folder.iterdir()):
        data = file.read_bytes()
        while data:  # a record: length (8 bytes), its checksum (4), the event, its checksum (4)
            length = int.from_bytes(data[:8], "little")
            found.append(Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
    return [(event.step, value) for event in found for value in event.summary.value]


PICTURE = {"reconstruction": [np.full((2, 3, 4, 1), x, np.float32) for x in (0.0, 1.5, 0.5)]}
"""Two examples of 3 x 4 pixels: black, white and beyond, grey."""


def test_tensorboard_gets_numbers_hyperparameters_and_pictures(tmp_path):
    pytest.importorskip("tensorboardX")
    pillow = pytest.importorskip("PIL.Image")
    with report(tmp_path, "tensorboard", gamma=0.5) as one:
        write(one, 320)
        one.pictures(400, PICTURE)
    found = events(tmp_path / "tensorboard")
    scalars = {
        (step, value.tag): value.simple_value for step, value in found if value.HasField("simple_value")
    }
    assert scalars[320, "epsilon"] == 0.5 and scalars[320, "updates"] == 32
    (picture,) = [value for step, value in found if step == 400 and value.HasField("image")]
    assert picture.tag == "pictures/reconstruction"
    pixels = np.asarray(pillow.open(io.BytesIO(picture.image.encoded_image_string)).convert("L"))
    assert pixels.shape == (9, 8)
    assert [set(pixels[row]) for row in (0, 3, 6)] == [{0}, {255}, {128}]
    told = b"".join(value.SerializeToString() for _, value in found if value.tag.startswith("_hparams_"))
    assert b"gamma" in told and b"eval/return_mean" in told


@pytest.fixture
def wandb(monkeypatch):
    """A stand-in for the package: what runs of it were told, by their ids."""
    fake = types.ModuleType("wandb")
    fake.runs = {}

    def init(**options):
        told = fake.runs.setdefault(options["id"], [])
        told.append(options)
        config = types.SimpleNamespace(update=lambda values, **_: told.append(values))
        return types.SimpleNamespace(
            define_metric=lambda *names, **how: None,
            config=config,
            log=told.append,
            finish=lambda: told.append("finished"),
        )

    fake.init, fake.Image = init, np.shape
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    return fake


def test_wandb_gets_them_too_and_resumes_its_run(tmp_path, wandb):
    name = "wandb:project=mine"
    with report(tmp_path, name) as one:
        write(one, 40)
        snapshot = one.snapshot()
        write(one, 80)
    again = report(tmp_path, name)
    again.restore(snapshot)
    with again:
        write(again, 80, 120)
        again.pictures(120, PICTURE)
    ((ident, told),) = wandb.runs.items()
    assert ident == (tmp_path / "wandb/run_id").read_text()
    options, config, *rows, picture, end = told
    assert options["project"] == "mine" and options["resume"] == "allow" and options["dir"] == str(tmp_path)
    assert config == json.loads(Config(**SMALL, loggers=(name,)).to_json())
    assert [row["env_steps"] for row in rows if "epsilon" in row] == [40, 80, 120]
    assert picture == {"env_steps": 120, "pictures/reconstruction": (9, 8, 1)} and end == "finished"


def test_two_seeds_are_two_runs_of_wandb(tmp_path, wandb):
    with report(tmp_path / "seed0", "wandb"), report(tmp_path / "seed1", "wandb"):
        pass
    options = [told[0] for told in wandb.runs.values()]
    assert len(options) == 2 and {x["reinit"] for x in options} == {"create_new"}
    assert {x["project"] for x in options} == {"srl_jax"}
