"""What all tests share; pytest reads it before any test module, and so before jax is imported."""

import atexit
import gc
import importlib.metadata
import os
import shutil
import sys
import tempfile

# The tests are written for a CPU; JAX_PLATFORMS=cuda runs them on a GPU all the same.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Most programs of tests run a few times only: XLA compiles them several times faster, and they run half as
# fast. Others need `helpers.optimised`. XLA ends a process whose flags it does not know: hence the version.
_fast = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
_fast += " --xla_cpu_parallel_codegen_split_count=1"
if importlib.metadata.version("jaxlib").startswith("0.10."):
    os.environ.setdefault("XLA_FLAGS", _fast)

# Tracing makes many small objects, which Python would look through every 700 of them, and jax with it.
gc.set_threshold(50_000, 20, 20)

# Small products in one thread: those of OpenBLAS spin while they wait for a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What one test compiles is there for all, in both processes of `make test` and in those that tests start.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _cache = tempfile.mkdtemp(prefix="srl_jax_tests_")
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    # Python may keep what it compiled, too: else each of those processes reads all modules anew.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

# The first example of a property that runs on jax compiles, so no single example has a deadline.
# Reproducible by default; HYPOTHESIS_PROFILE=thorough looks at many more, other ones each time.
_quiet = [HealthCheck.too_slow, HealthCheck.data_too_large]
settings.register_profile(
    "default", max_examples=30, deadline=None, derandomize=True, suppress_health_check=_quiet
)
settings.register_profile("thorough", max_examples=1000, deadline=None, suppress_health_check=_quiet)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Has no module keep what the ones before it compiled, half a megabyte or more a program."""
    yield
    if jax := sys.modules.get("jax"):
        jax.clear_caches()


@pytest.fixture
def loop(monkeypatch):
    """A stub in place of srl_jax.run.loop, see `tests.in_process.Loop`."""
    import srl_jax.run
    from tests.in_process import Loop

    stub = Loop()
    monkeypatch.setitem(sys.modules, "srl_jax.run.loop", stub)
    monkeypatch.setattr(srl_jax.run, "loop", stub, raising=False)
    return stub


@pytest.fixture(scope="module")
def shared_agents():
    """Runs of a module whose agents are alike compile them once; nothing that is timed or learns for long."""
    from tests import helpers

    with helpers.shared_agents():
        yield
