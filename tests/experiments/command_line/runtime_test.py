"""Tests of runtime. None writes to the cache of the user, and only the last one restarts anything."""

import importlib.metadata
import os
import pathlib
import subprocess
import sys

import pytest

from experiments import evaluate, train
from experiments.command_line import runtime
from tests.helpers import rows_of
from tests.in_process import parse

ROOT = pathlib.Path(__file__).resolve().parents[3]
CACHE = pathlib.Path("/cache/xla")
VERSION = ".".join(importlib.metadata.version("jaxlib").split(".")[:2])
(YNN,) = runtime.XLA_FLAGS["0.10"]
JAX_CACHE = {
    "JAX_COMPILATION_CACHE_DIR": "/cache/xla",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


AT_START = runtime.MALLOC | runtime.BLAS


def _wanted(env, encoder="nature", **given):
    defaults = {"glibc": True, "gpu": False, "cache": CACHE, "cores": 2, "jaxlib": "0.10.2"}
    return runtime.wanted(env, encoder, **(defaults | given))


def test_the_wanted_environment():
    everything = AT_START | JAX_CACHE | {"XLA_FLAGS": YNN}
    assert _wanted({}) == everything
    assert _wanted({}, "sac_ae:features=256") == everything | {"NPROC": "3"}
    assert _wanted({"NPROC": "1"}, "sac_ae") == everything
    assert _wanted({}, "sac_ae", gpu=True) == JAX_CACHE
    assert _wanted(everything) == {}
    assert _wanted({}, "tiny") == AT_START | JAX_CACHE
    assert _wanted({}, glibc=False) == JAX_CACHE | {"XLA_FLAGS": YNN}
    assert _wanted({}, gpu=True) == JAX_CACHE
    assert _wanted({}, cache=None) == AT_START | {"XLA_FLAGS": YNN}
    assert _wanted({}, jaxlib="0.9.1") == AT_START | JAX_CACHE


def test_an_encoder_that_nobody_has_measured_counts_as_large():
    assert _wanted({}, "my_own:features=3") == _wanted({}, "sac_ae") == _wanted({}, "impala:width=2")


def test_the_work_of_every_encoder_is_known_before_jax_is():
    import jax

    from srl_jax import encoders

    observation = jax.ShapeDtypeStruct((1, 84, 84, 4), "uint8")
    counted = {}
    for name, row in encoders.REGISTRY.items():
        encoder = row((84, 84, 4))
        params = jax.eval_shape(encoder.init, jax.random.key(0))
        counted[name] = jax.jit(encoder.apply).lower(params, observation).cost_analysis()["flops"] / 2e6
    assert runtime.MULTIPLY_ADDS == pytest.approx(counted, rel=0.02)


def test_what_the_user_has_set_stays():
    others = {name: value for name, value in AT_START.items() if name != "MALLOC_MMAP_MAX_"}
    assert _wanted({"MALLOC_MMAP_MAX_": "7"}, "tiny", cache=None) == others
    assert _wanted({"GLIBC_TUNABLES": "glibc.malloc.mmap_max=1"}, "tiny", cache=None) == runtime.BLAS
    # An empty directory is how jax is told to keep nothing; a directory of the user's has its own limits.
    for folder in ("", "/elsewhere"):
        assert _wanted({"JAX_COMPILATION_CACHE_DIR": folder}, "tiny", glibc=False) == {}
    found = _wanted({"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "2"}, "tiny", glibc=False)
    assert found == {k: v for k, v in JAX_CACHE.items() if "COMPILE_TIME" not in k}


@pytest.mark.parametrize(
    ("present", "want"),
    [
        ("", YNN),
        ("--xla_a=1 --xla_b", f"--xla_a=1 --xla_b {YNN}"),
        ("--xla_cpu_experimental_ynn_fusion_type=", None),
        (f"--xla_a=1 {YNN} --xla_b", None),
        ("/a/file/of/flags", None),
    ],
)
def test_flags_are_added_to_those_that_are_there(present, want):
    found = _wanted({"XLA_FLAGS": present}, glibc=False, cache=None)
    assert found == ({} if want is None else {"XLA_FLAGS": want})


def test_a_gpu_is_one_that_jax_may_and_can_use(tmp_path, monkeypatch):
    device = tmp_path / "nvidia0"
    monkeypatch.setattr(runtime.importlib.util, "find_spec", lambda name: object())
    assert not runtime.has_gpu({}, str(device))
    device.touch()
    answers = {"": True, "cuda": True, "gpu,cpu": True, "cpu": False, "cpu,cuda": False, "tpu": False}
    for platforms, answer in answers.items():
        assert runtime.has_gpu({"JAX_PLATFORMS": platforms}, str(device)) == answer
    assert runtime.has_gpu({}, str(device))
    monkeypatch.setattr(runtime.importlib.util, "find_spec", lambda name: None)
    assert not runtime.has_gpu({}, str(device))


def test_the_cache_folder_is_the_users_alone(tmp_path, monkeypatch):
    env = {"XDG_CACHE_HOME": str(tmp_path / "a")}
    folder = runtime.cache_folder(env)
    assert folder == tmp_path / "a" / "srl_jax" and folder.stat().st_mode & 0o777 == 0o700
    assert runtime.cache_folder(env) == folder
    folder.chmod(0o770)
    assert runtime.cache_folder(env) is None
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert runtime.cache_folder(env) is None
    monkeypatch.undo()
    (tmp_path / "file").touch()
    assert runtime.cache_folder({"XDG_CACHE_HOME": str(tmp_path / "file")}) is None
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path)
    for relative in ("", "not/absolute"):
        assert runtime.cache_folder({"XDG_CACHE_HOME": relative}) == tmp_path / ".cache" / "srl_jax"


def test_xla_takes_the_flags_of_its_version():
    # XLA ends a process whose flags it does not know, so another one is asked.
    xla = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": " ".join(runtime.XLA_FLAGS[VERSION])}
    code = "import jax; jax.devices()"
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | xla, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def started(monkeypatch, tmp_path):
    """What `prepare` would replace the process by; a stub returns, so `prepare` goes on after it."""
    calls = []
    monkeypatch.setattr(runtime.os, "execve", lambda *call: calls.append(call))
    monkeypatch.setattr(runtime, "has_glibc", lambda: True)
    monkeypatch.setattr(runtime, "has_gpu", lambda env: False)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "experiments.train", "--out=a b"])
    return calls


def test_it_restarts_once_with_everything(started, tmp_path, capsys):
    env = {"XDG_CACHE_HOME": str(tmp_path), "HOME": "/h"}
    runtime.prepare("auto", "nature", dict(env))
    ((program, arguments, given),) = started
    assert program == sys.executable
    assert arguments == [sys.executable, "-X", "dev", "-m", "experiments.train", "--out=a b"]
    assert given.items() >= (env | AT_START | {"XLA_FLAGS": YNN, runtime.GUARD: "tuned"}).items()
    assert pathlib.Path(given["JAX_COMPILATION_CACHE_DIR"]).parent == tmp_path / "srl_jax" / "xla"
    line = capsys.readouterr().err.split("\n")[0]
    count = len(given) - len(env) - 1
    assert line == (
        f"runtime: restarting with {count} variables that make jax faster here (--tune_runtime=off sets none)"
    )
    # The process that it starts finds nothing to do.
    before = dict(given)
    runtime.prepare("auto", "nature", given)
    assert len(started) == 1 and given == before
    assert capsys.readouterr() == ("", "")


def test_the_guard_forbids_a_restart_but_not_the_rest(started, tmp_path, capsys):
    env = {"XDG_CACHE_HOME": str(tmp_path), runtime.GUARD: "tuned"}
    runtime.prepare("auto", "nature", env)
    assert not started and not AT_START.keys() & env.keys()
    assert env["XLA_FLAGS"] == YNN and "JAX_COMPILATION_CACHE_DIR" in env
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert printed.err.startswith("runtime: 4 variables that make jax faster here are set (")


def test_what_jax_reads_needs_no_restart(started, tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "has_glibc", lambda: False)
    env = {"XDG_CACHE_HOME": str(tmp_path)}
    runtime.prepare("auto", "nature", env)
    assert not started
    assert env.keys() == {"XDG_CACHE_HOME", "XLA_FLAGS", *JAX_CACHE}


def test_a_restart_that_fails_is_no_error(started, tmp_path, monkeypatch, capsys):
    def refuse(*call):
        raise OSError(7, "Argument list too long")

    monkeypatch.setattr(runtime.os, "execve", refuse)
    env = {"XDG_CACHE_HOME": str(tmp_path)}
    runtime.prepare("auto", "tiny", env)
    assert env.keys() == {"XDG_CACHE_HOME", *JAX_CACHE}
    assert "runtime: not restarted: Argument list too long\n" in capsys.readouterr().err


def test_off_leaves_everything(started, tmp_path, capsys):
    env = {"XDG_CACHE_HOME": str(tmp_path)}
    runtime.prepare("off", "nature", env)
    assert not started and env == {"XDG_CACHE_HOME": str(tmp_path)} and not list(tmp_path.iterdir())
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("module", [train, evaluate])
def test_the_flag_is_a_flag_of_both_entry_points(module, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(module, "--tune_runtime=x")
    assert ended.value.code == 2
    assert capsys.readouterr() == ("", "error: --tune_runtime=x: valid: auto, off\n")


@pytest.mark.skipif(not runtime.has_glibc(), reason="only glibc's variables need a restart")
def test_training_restarts_once_and_learns_the_same(tmp_path):
    small = [
        "--game=Catch", "--frame_size=42", "--encoder=tiny", "--mode=pretrain", "--objective=latent_l2",
        "--num_envs=4", "--batch_size=4", "--learn_start=8", "--steps=40", "--log_every=20",
        "--nodiagnostics",
    ]  # fmt: skip
    present = {name: value for name, value in os.environ.items() if name not in (*AT_START, runtime.GUARD)}
    done = subprocess.run(
        [sys.executable, "-m", "experiments.train", *small, f"--out={tmp_path / 'auto'}"],
        cwd=ROOT,
        env=present | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("40 env steps, ")
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("runtime: "))
    assert line.startswith("runtime: restarting with ") and len(line) < 100
    # In this process nothing restarts.
    assert train.train(parse(train, *small, f"--out={tmp_path / 'off'}")) == 0
    assert "loss/latent_l2" in rows_of(tmp_path / "auto")[-1]
    assert rows_of(tmp_path / "auto") == rows_of(tmp_path / "off")
