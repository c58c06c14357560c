"""srl_jax/plugins.py: rows that a file outside the package registers, in every program that needs them."""

import functools
import importlib.metadata
import json
import os
import pathlib
import subprocess
import sys

import pytest

from experiments import evaluate, train
from srl_jax import objectives, plugins
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files.checkpoint import read_manifest
from srl_jax.files.metrics import read_metrics
from srl_jax.plugins import Registry, load, located
from srl_jax.specs import parse
from tests import in_process
from tests.helpers import SMALL, last_of_each, write_run

pytestmark = pytest.mark.usefixtures("shared_agents")
ROOT = pathlib.Path(__file__).resolve().parents[1]

MINE = """
import jax.numpy as jnp
import srl_jax.objectives
from srl_jax.types import Objective

@srl_jax.objectives.register("smallness")
def smallness(context, *, weight: float = 1.0):
    def loss(head, slow_head, latents, window, key):
        return jnp.sum(jnp.square(latents.online(0)), -1), {}

    return Objective(lambda key: {}, loss, horizon=1, weight=weight)
"""
RUN = SMALL | {"steps": 120, "eval_every": 60, "mode": "joint"}
FLAGS = [*(f"--{name}={value}" for name, value in RUN.items()), "--tune_runtime=off", "--objective=smallness"]


def _row(context, *, weight: float = 1.0):
    return context, weight


def _other(context):
    return context


@pytest.fixture
def registry():
    return Registry("objectives", {"own": _other})


def test_a_row_is_registered_by_a_call_or_above_a_function(registry):
    assert registry.register("a", _row) is _row
    assert registry.register("b")(_row) is _row
    registry.register("c", functools.partial(_row, weight=2.0))
    assert list(registry) == ["own", "a", "b", "c"]
    assert parse("a:weight=3", registry).resolved == {"weight": 3.0}
    assert parse("c", registry).resolved == {"weight": 2.0}


def _function(name, folder):
    """A function that is written in a file of its own."""
    path = folder / f"{name}.py"
    path.write_text("def row(context, *, size: int = 3):\n    return size\n")
    space = {}
    exec(compile(path.read_text(), str(path), "exec"), space)
    return space["row"]


def test_a_name_is_registered_once(registry, tmp_path):
    first, second = _function("first", tmp_path), _function("second", tmp_path)
    with pytest.raises(
        ConfigError, match="first.py registers 'own' in srl_jax.objectives, where the package"
    ):
        registry.register("own", first)
    registry.register("a", first)
    with pytest.raises(ConfigError, match="second.py registers 'a' .*, where .*first.py has a row of that"):
        registry.register("a", second)
    assert registry["a"] is first
    again = _function("first", tmp_path)  # the same file, imported a second time
    registry.register("a", again)
    assert registry["a"] is again


@pytest.mark.parametrize("name", ["rl", "encoder", "encoder_srl", "rl_srl", "none", "total"])
def test_an_objective_takes_no_name_of_the_agents_own(name):
    with pytest.raises(ConfigError, match=f"registers '{name}' in srl_jax.objectives, where the package"):
        objectives.register(name, _row)
    assert name not in objectives.REGISTRY


@pytest.mark.parametrize("name", ["", "a:b", "a,b", "a=1", "a b", "ä", 3])
def test_a_name_can_be_written_in_a_specification(registry, name):
    with pytest.raises(ConfigError, match="a name is letters, digits and _"):
        registry.register(name, _row)


def test_a_decorator_without_a_name_is_refused(registry):
    with pytest.raises(ConfigError, match=r'as in register\("mine"\)'):
        registry.register(_row)


def test_options_have_defaults(registry):
    def row(context, *, weight):
        return weight

    with pytest.raises(ConfigError, match="no row 'a': .* weight needs a bool, int, float or str default"):
        registry.register("a", row)


class Points:
    """Entry points of installed packages: {name: values}."""

    def __init__(self, monkeypatch, **points):
        self.asked = []

        def find(*, group, name):
            self.asked.append((group, name))
            return [importlib.metadata.EntryPoint(name, x, group) for x in points.get(name, ())]

        monkeypatch.setattr(importlib.metadata, "entry_points", find)


def test_an_entry_point_is_found_where_the_registry_has_no_such_row(registry, monkeypatch):
    points = Points(monkeypatch, there=["tests.plugins_test:_row"])
    assert parse("own", registry).name == "own" and points.asked == []
    assert parse("there:weight=2", registry).options == {"weight": 2.0}
    assert points.asked == [("srl_jax.objectives", "there")]
    assert "there" in registry and len(points.asked) == 1
    with pytest.raises(ConfigError, match="no 'qux'; valid: own, there"):
        parse("qux", registry)


def test_an_entry_point_that_cannot_be_used_is_named(registry, monkeypatch):
    Points(monkeypatch, twice=["a:x", "b:y"], gone=["no_such_module:x"], odd=["tests.plugins_test:no_such"])
    with pytest.raises(ConfigError, match="'twice' of srl_jax.objectives is in a:x and in b:y"):
        parse("twice", registry)
    with pytest.raises(ConfigError, match="the entry point no_such_module:x: ModuleNotFoundError"):
        parse("gone", registry)
    with pytest.raises(ConfigError, match="the entry point tests.plugins_test:no_such: AttributeError"):
        parse("odd", registry)


# Files and modules


def test_a_file_is_kept_with_its_absolute_path_and_a_module_with_its_name(tmp_path, monkeypatch):
    (tmp_path / "mine.py").touch()
    monkeypatch.chdir(tmp_path)
    for text in ("mine.py", "./mine.py", "mine", str(tmp_path / "mine.py")):
        assert located(text) == str(tmp_path / "mine.py")
    assert located("json.decoder") == "json.decoder"
    with pytest.raises(ConfigError) as error:
        located("other.py")  # nothing has moved: it has just been typed
    assert str(error.value) == f"--import={tmp_path}/other.py: no such file"
    with pytest.raises(ConfigError, match="--import=./mine: must be a file that ends in .py"):
        located("./mine")


def test_a_file_is_executed_once_and_may_import_what_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "beside_it.py").write_text("here = []\n")
    file = tmp_path / "random.py"  # takes nobody's name
    file.write_text("import beside_it\nbeside_it.here.append(__name__)\n")
    for _ in range(2):
        load([str(file), "json.decoder"])
    assert len(sys.modules["beside_it"].here) == 1
    import random

    assert hasattr(random, "shuffle")


BROKEN = {
    "raises": ("import json\njson.loads('{')\n", "line 2: JSONDecodeError: Expecting"),
    "syntax": ("a = 1\nb = = 2\n", "line 2: SyntaxError: invalid syntax"),
    "leaves": ("raise SystemExit(7)\n", "line 1: SystemExit: 7"),
    "imports": ("import no_such_thing\n", "line 1: ModuleNotFoundError: No module named 'no_such_thing'"),
    "registers": (
        "from srl_jax.plugins import Registry\nRegistry('rl', {}).register('a b', print)\n",
        "line 2: srl_jax.rl takes no row 'a b'",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_cannot_be_imported_is_named_with_its_error(name, tmp_path):
    text, reason = BROKEN[name]
    file = tmp_path / f"{name}.py"
    file.write_text(text)
    for _ in range(2):  # not taken for imported
        with pytest.raises(ConfigError) as error:
            load([str(file)])
        assert str(error.value).startswith(f"--import={file}: {reason}") and "\n" not in str(error.value)


def test_what_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=f"--import={tmp_path}/gone.py: no such file; --import=PATH says"):
        load([f"{tmp_path}/gone.py"])
    with pytest.raises(ConfigError, match="--import=no_such.module: ModuleNotFoundError: No module named"):
        load(["no_such.module"])


def test_nothing_is_imported_from_a_run_directory(tmp_path):
    run = write_run(tmp_path / "run")
    (run / "code").mkdir()
    (run / "code" / "mine.py").write_text("raise AssertionError\n")
    (tmp_path / "link.py").symlink_to(run / "code" / "mine.py")
    for path in (run / "code" / "mine.py", tmp_path / "link.py"):
        for function in (located, lambda text: load([text])):
            with pytest.raises(
                ConfigError, match="lies in a run directory, .*, from which nothing is imported"
            ):
                function(str(path))


# Programs


@pytest.fixture
def fresh(monkeypatch):
    """A process that has imported nothing of the user's yet, whenever it is called."""

    def forget():
        plugins._LOADED.clear()
        dict.pop(objectives.REGISTRY, "smallness", None)
        objectives.REGISTRY._origins.pop("smallness", None)

    monkeypatch.setattr(sys, "path", list(sys.path))
    yield forget
    forget()


def _train(*arguments):
    return train.train(in_process.parse(train, *arguments))


def test_an_objective_in_a_file_is_trained_evaluated_and_gone_on_with(tmp_path, fresh, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "draw", lambda *_: None)  # figures have tests of their own
    (tmp_path / "mine.py").write_text(MINE)
    assert _train("--import=mine", *FLAGS, "--out=run") == 0
    run = tmp_path / "run"
    assert Config.load(run).imports == (str(tmp_path / "mine.py"),)
    assert Config.load(run).objectives == ("smallness:weight=1.0",)
    rows = list(read_metrics(run / "metrics.jsonl"))
    assert any("loss/smallness" in row for row in rows)

    # It moved: what is typed beside a program counts.
    def evaluated(*arguments):
        evaluate.main(in_process.parse(evaluate, f"--run={run}", "--games=2", *arguments))
        return json.loads(capsys.readouterr().out)

    fresh()
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    (tmp_path / "mine.py").rename(moved / "renamed.py")
    monkeypatch.chdir(moved)
    with pytest.raises(ConfigError, match=f"^--import={tmp_path}/mine.py: no such file; --import=PATH says"):
        evaluated()
    capsys.readouterr()
    assert len(evaluated("--import=renamed")["returns"]) == 2
    fresh()
    newest = read_manifest(run).path
    newest.rename(newest.with_name(".gone"))
    assert _train("--import=renamed.py", *FLAGS, f"--out={run}", "--resume=auto") == 0
    assert [row["env_steps"] for row in read_metrics(run / "metrics.jsonl")][-1] == 120
    # Without it, the name is unknown.
    fresh()
    with pytest.raises(
        ConfigError, match="no 'smallness'; .*valid: reconstruction,.*; --import=FILE.py registers your"
    ):
        _train(*FLAGS, f"--out={tmp_path}/other")


def test_a_loss_that_is_wrong_is_refused_before_the_first_step(tmp_path, fresh):
    (tmp_path / "mine.py").write_text(MINE.replace("latents.online(0)), -1)", "latents.online(0)))"))
    with pytest.raises(ConfigError, match=r"^--objective=smallness: its losses have shape \(\)"):
        _train(f"--import={tmp_path}/mine.py", *FLAGS, f"--out={tmp_path}/run")
    assert not (tmp_path / "run").exists()


def test_a_sweep_gives_its_runs_what_they_import(tmp_path):
    # Processes: that they are given it is the point. The run ends before its first update.
    (tmp_path / "mine.py").write_text(MINE)
    flags = [flag for flag in FLAGS if not flag.startswith("--game=")]
    line = [sys.executable, "-m", "experiments.sweep", "--presets=catch/joint", "--import=mine.py"]
    done = subprocess.run(
        [*last_of_each((*line, *flags, "--steps=8")), "--out=runs", "--games=Catch"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    config = Config.load(tmp_path / "runs/Catch/joint/seed0")
    assert config.objectives == ("smallness:weight=1.0",) and config.imports == (str(tmp_path / "mine.py"),)
