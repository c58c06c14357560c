"""What the package says of itself, in several places at once, what is installed, and its commands."""

import importlib.metadata
import os
import pathlib
import re
import subprocess
import sys
import tomllib
import zipfile

import pytest

import srl_jax
from experiments.command_line import cli

ROOT = pathlib.Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]


def _cited(field):
    (value,) = re.findall(
        rf"^{field}: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    return value


def test_the_version_is_the_same_everywhere():
    assert PROJECT["version"] == _cited("version") == srl_jax.__version__


def test_the_licence_is_the_same_everywhere():
    assert PROJECT["license"] == _cited("license") == "Apache-2.0"
    (file,) = PROJECT["license-files"]
    text = (ROOT / file).read_text(encoding="utf-8")
    assert "Apache License\n" in text and "Version 2.0, January 2004" in text
    assert "Copyright 2026 The srl_jax authors" in text and "[yyyy]" not in text
    assert "[LICENSE](LICENSE)" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_every_package_is_installed_but_what_only_a_checkout_needs():
    named = PYPROJECT["tool"]["setuptools"]["packages"]
    folders = {"experiments": "srl_jax.experiments", "srl_jax": "srl_jax"}
    found = [
        ".".join((name, *path.parent.relative_to(ROOT / folder).parts))
        for folder, name in folders.items()
        for path in (ROOT / folder).rglob("__init__.py")
    ]
    checkout_only = {f"srl_jax.experiments.{name}" for name in ("analyses", "benchmarks")}
    assert sorted(named) == sorted(set(found) - checkout_only)


def test_the_wheel_has_one_top_level_name_and_everything_that_runs(tmp_path):
    if int(importlib.metadata.version("setuptools").split(".")[0]) < 77:
        pytest.skip("the installed setuptools cannot build it")
    for name in ("srl_jax", "experiments"):  # a build leaves files where it builds
        for path in (ROOT / name).rglob("*"):
            if path.is_file() and path.suffix != ".pyc" and "results" not in path.parts:
                copy = tmp_path / "source" / path.relative_to(ROOT)
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.symlink_to(path)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (tmp_path / "source" / name).symlink_to(ROOT / name)
    code = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    subprocess.run(
        [sys.executable, "-c", code, tmp_path], cwd=tmp_path / "source", check=True, capture_output=True
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        scripts = file.read(next(name for name in names if name.endswith("entry_points.txt"))).decode()
        file.extractall(tmp_path / "installed")
    assert {name.split("/")[0].split("-")[0] for name in names} == {"srl_jax"}
    assert not [name for name in names if re.search("soak|benchmark|results/", name)]
    page = {
        path.relative_to(ROOT) for path in (ROOT / "experiments/reporting").rglob("*.*") if path.is_file()
    }
    page = {f"srl_jax/{path}" for path in page if path.suffix != ".pyc"}
    assert "srl_jax/experiments/reporting/templates/page.html.j2" in page and page <= set(names)
    assert "srl-jax = srl_jax.__main__:main" in scripts
    done = _command("train", "--game=Pogn", cwd=tmp_path, env={"PYTHONPATH": str(tmp_path / "installed")})
    assert (done.returncode, done.stderr[:19]) == (2, "error: --game=Pogn:")


def test_the_library_is_one_import_and_costs_nothing_until_it_is_used():
    code = """if True:
        import sys
        import srl_jax
        light = "jax" not in sys.modules and "numpy" not in sys.modules
        known = callable(srl_jax.data.published) and callable(srl_jax.statistics.welch_power)
        config = srl_jax.Config(game="Catch")
        from experiments.presets import preset_config
        config = preset_config("demo+objective/spr+gate/pcgrad")
        light = light and "jax" not in sys.modules
        from srl_jax import *
        from srl_jax.replay import Replay as replay
        from srl_jax.rl import losses as rl_losses
        import srl_jax.losses, srl_jax.objectives, srl_jax.encoders
        same = Replay is replay and srl_jax.losses is losses is rl_losses
        same = same and known and "inverse" in objectives.REGISTRY
        sys.exit(not (light and same and callable(load) and dir(srl_jax) == srl_jax.__all__))
    """
    assert subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=ROOT, timeout=120).returncode == 0
    with pytest.raises(AttributeError, match="module 'srl_jax' has no attribute 'lodd'"):
        srl_jax.lodd  # noqa: B018


def _command(*arguments, cwd=ROOT, env=None):
    return subprocess.run(
        [sys.executable, "-m", "srl_jax", *arguments],
        cwd=cwd,
        env={**os.environ, **(env or {})},
        capture_output=True,
        text=True,
        timeout=60,
    )


def _main(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["srl-jax", *arguments])
    cli.main()


@pytest.mark.parametrize("arguments", [(), ("--help",), ("help",)])
def test_the_commands_are_listed_a_line_each(arguments, monkeypatch, capsys):
    _main(monkeypatch, *arguments)
    shown = capsys.readouterr()
    assert shown.err == ""
    for name, command in cli.COMMANDS.items():
        assert re.search(rf"^  srl-jax {name} .*  {re.escape(command.help)}$", shown.out, re.MULTILINE)


def test_an_unknown_command_is_answered_with_the_ones_there_are(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        _main(monkeypatch, "evalute", "runs/x")
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith("error: evalute: no such command; did you mean evaluate? valid: train,")


COMMANDS = [f"experiments.{command.module or name}" for name, command in cli.COMMANDS.items()]
LIGHT = [
    "import srl_jax.config, srl_jax.learning.modes, srl_jax.specs, srl_jax.plugins",
    "from srl_jax import config, envs; config.Config(game='my:E-v0'); assert len(envs.NAMES) == 59",
    "import srl_jax.data; srl_jax.data.reference_policies('Pong')",
    "import srl_jax.statistics",
    "from experiments.drawing import plots; assert plots.available()",
    *(
        f"import experiments.{x.module or name}; experiments.{x.module or name}.cli"
        for name, x in cli.COMMANDS.items()
    ),
    "import experiments.benchmarks.bench",
]
"""What is imported before jax may be, or where a command only reads: one after the other, in one process."""


def test_what_is_checked_or_read_first_imports_nothing_that_is_slow():
    heavy = {"jax", "flax", "gymnasium", "ale_py", "pandas", "matplotlib", "PIL"}
    code = "import sys\n"
    for line in LIGHT:
        code += f"{line}\nif found := {heavy} & set(sys.modules): sys.exit({line!r} + str(found))\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
