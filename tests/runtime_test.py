"""Tests of experiments.runtime. None writes to the user's cache, and only the last one restarts anything."""

import json
import os
import pathlib
import subprocess
import sys
import types

import pytest

from experiments import evaluate, runtime, train

ROOT = pathlib.Path(__file__).resolve().parents[1]
CACHE = pathlib.Path("/cache/xla")
(YNN,) = runtime.XLA_FLAGS
JAX_CACHE = {
    "JAX_COMPILATION_CACHE_DIR": "/cache/xla",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


AT_START = runtime.MALLOC | runtime.BLAS


def _wanted(env, encoder="nature", **given):
    defaults = {"glibc": True, "gpu": False, "cache": CACHE, "cores": 2, "works": lambda flags: True}
    return runtime.wanted(env, encoder, **(defaults | given))


def _never(flags):
    raise AssertionError("asked without need")


def test_the_wanted_environment():
    everything = AT_START | JAX_CACHE | {"XLA_FLAGS": YNN}
    assert _wanted({}) == everything
    assert _wanted({}, "sac_ae:features=256") == everything | {"NPROC": "3"}
    assert _wanted({"NPROC": "1"}, "sac_ae") == everything
    assert _wanted({}, "sac_ae", gpu=True) == JAX_CACHE
    assert _wanted(everything, works=_never) == {}
    assert _wanted({}, "tiny", works=_never) == AT_START | JAX_CACHE
    assert _wanted({}, glibc=False) == JAX_CACHE | {"XLA_FLAGS": YNN}
    assert _wanted({}, gpu=True, works=_never) == JAX_CACHE
    assert _wanted({}, cache=None) == AT_START | {"XLA_FLAGS": YNN}
    assert _wanted({}, works=lambda flags: False) == AT_START | JAX_CACHE


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
    asked = []
    env = {"XLA_FLAGS": present}
    found = _wanted(env, glibc=False, cache=None, works=lambda flags: asked.append(flags) or True)
    assert found == ({} if want is None else {"XLA_FLAGS": want})
    assert asked == ([] if want is None else [want])  # the whole text is tried, not our part alone


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


@pytest.fixture
def xla(monkeypatch):
    """Stands in for the process that tries the flags; knows `YNN` and no other."""
    calls = []

    def run(command, env, timeout, **streams):
        assert command[:2] == [sys.executable, "-c"] and timeout <= 60
        assert set(streams.values()) == {subprocess.DEVNULL}
        assert env["JAX_PLATFORMS"] == "cpu" and "JAX_COMPILATION_CACHE_DIR" not in env
        calls.append(env["XLA_FLAGS"])
        if "hang" in env["XLA_FLAGS"]:
            raise subprocess.TimeoutExpired(command, timeout)
        return types.SimpleNamespace(returncode=0 if env["XLA_FLAGS"] == YNN else -6)

    monkeypatch.setattr(runtime.subprocess, "run", run)
    return calls


def test_an_unknown_flag_is_left_out_and_the_answer_remembered(tmp_path, xla, capsys, monkeypatch):
    for _ in range(2):
        assert runtime.remembered(YNN, tmp_path)
        assert not runtime.remembered("--xla_bogus", tmp_path)
    assert xla == [YNN, "--xla_bogus"]
    assert capsys.readouterr().err.count("\n") == 2  # a line for each time that one was tried
    assert [path.name for path in tmp_path.iterdir()] == ["runtime.json"]
    # Another processor, or another jax, is asked anew, and the old answers stay.
    monkeypatch.setattr(runtime, "machine", lambda: "another")
    assert runtime.remembered(YNN, tmp_path)
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda name: "9.9")
    assert runtime.remembered(YNN, tmp_path)
    assert len(xla) == 4
    assert list(json.loads((tmp_path / "runtime.json").read_text()).values()) == [True, False, True, True]


def test_no_answer_is_not_remembered(tmp_path, xla):
    for _ in range(2):
        assert not runtime.remembered("--xla_hang", tmp_path)
    assert len(xla) == 2 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"a": "b"}'])
def test_a_damaged_answer_is_asked_for_again(content, tmp_path, xla, capsys):
    (tmp_path / "runtime.json").write_bytes(content)
    for _ in range(2):
        assert runtime.remembered(YNN, tmp_path)
    assert xla == [YNN]
    assert capsys.readouterr().err.count("\n") == 1


def test_an_answer_must_be_true_or_false(tmp_path, xla):
    runtime.remembered("--xla_bogus", tmp_path)
    file = tmp_path / "runtime.json"
    file.write_text(file.read_text().replace("false", '"yes"'))
    assert not runtime.remembered("--xla_bogus", tmp_path)
    assert len(xla) == 2


def test_answers_that_cannot_be_kept_are_asked_for_each_time(tmp_path, xla, capsys):
    (tmp_path / "runtime.json").mkdir()
    for folder in (tmp_path, tmp_path / "missing", None):
        assert runtime.remembered(YNN, folder)
    assert xla == [YNN] * 3
    assert capsys.readouterr().err.count("\n") == 3
    assert [path.name for path in tmp_path.iterdir()] == ["runtime.json"]


def test_xla_itself_is_asked(monkeypatch):
    # Stops at the flags, before anything is compiled.
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert runtime.probe("--xla_no_such_flag=1") is False


@pytest.fixture
def started(monkeypatch, tmp_path):
    """What `prepare` would replace the process by; a stub returns, so `prepare` goes on after it."""
    calls = []
    monkeypatch.setattr(runtime.os, "execve", lambda *call: calls.append(call))
    monkeypatch.setattr(runtime, "has_glibc", lambda: True)
    monkeypatch.setattr(runtime, "has_gpu", lambda env: False)
    monkeypatch.setattr(runtime, "remembered", lambda flags, folder: True)
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


def test_the_flag_is_a_flag_of_both_entry_points():
    for module in (train, evaluate):
        done = _entry_point(module.__name__, "--tune_runtime=x")
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == "error: --tune_runtime=x: valid: auto, off\n"


def _entry_point(module, *arguments, **env):
    present = {name: value for name, value in os.environ.items() if name not in (*AT_START, runtime.GUARD)}
    return subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=ROOT,
        env=present | env,
        capture_output=True,
        text=True,
        timeout=120,
    )


def _rows(run):
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert rows
    return [{k: v for k, v in row.items() if not k.startswith("wall_")} for row in rows]


@pytest.mark.skipif(not runtime.has_glibc(), reason="only glibc's variables need a restart")
def test_training_restarts_once_and_learns_the_same(tmp_path):
    small = [
        "--game=Catch", "--frame_size=42", "--encoder=tiny", "--mode=pretrain", "--objective=latent_l2",
        "--num_envs=4", "--batch_size=4", "--learn_start=8", "--steps=40", "--log_every=20",
    ]  # fmt: skip
    env = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "JAX_PLATFORMS": "cpu"}
    lines = {}
    for tune in ("auto", "off"):
        arguments = [*small, f"--tune_runtime={tune}", f"--out={tmp_path / tune}"]
        done = _entry_point("experiments.train", *arguments, **env)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("40 env steps, ")
        lines[tune] = [line for line in done.stderr.splitlines() if line.startswith("runtime: ")]
    assert lines["off"] == []
    (line,) = lines["auto"]
    assert line.startswith("runtime: restarting with ") and len(line) < 100
    assert "loss/latent_l2" in _rows(tmp_path / "auto")[-1]
    assert _rows(tmp_path / "auto") == _rows(tmp_path / "off")
