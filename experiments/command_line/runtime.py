"""The environment that jax and XLA's CPU backend run well in, set before jax is imported.

Only an entry point's `__main__` calls `prepare`; nothing here is for library code. To import it imports no
jax.

jax and XLA read their variables when they are imported or first used, so those are set in `os.environ`.
glibc and OpenBLAS read theirs when the process starts, so for those alone it replaces itself, once.
"""

import hashlib
import importlib.metadata
import importlib.util
import math
import os
import platform
import re
import stat
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from srl_jax.errors import ConfigError
from srl_jax.files import display

from . import control_groups

GUARD = "SRL_JAX_RUNTIME"
"""Set in the process that `prepare` started; such a process is not started again."""

MALLOC = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "1000000000000",
    "MALLOC_ARENA_MAX": "1",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}
"""glibc's malloc keeps the memory that it was given, in one heap for all threads, of large pages. XLA
allocates its temporaries afresh for every update; without these the kernel takes the pages back and hands
them out again, zeroed, each time."""

BLAS = {"OPENBLAS_NUM_THREADS": "1"}
"""numpy's products, which only diagnostics have, in one thread: OpenBLAS's threads spin while they wait, and
where XLA's or another run's have the cores, products of 84 x 210 by 210 x 160 took 28 ms instead of one."""

_AT_START = MALLOC | BLAS
"""What is read when the process, or numpy, starts."""

MULTIPLY_ADDS = {
    "der": 1.3, "tiny": 2.1, "nature": 7.8, "mrq": 12.8, "a_lix": 32.4, "sac_ae": 51.6, "impala": 54.7
}  # fmt: skip
"""{encoder: millions of multiplications with an addition} that one observation of 84 x 84 x 4 takes with the
default options, as XLA counts them. An encoder's size decides what helps it on a CPU, and has to be known
before jax is imported. An encoder that is not listed, a user's own, counts as the largest."""

_YNN = "--xla_cpu_experimental_ynn_fusion_type=LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT,LIBRARY_FUSION_TYPE_REDUCE"
XLA_FLAGS = {"0.10": (_YNN,), "0.11": (_YNN,), "0.12": (_YNN,)}
"""{jaxlib's version, without what follows the second number: flags}: products and reductions by the YNNPACK
library. XLA ends a process whose flags it does not know, so a version that is not listed gets none."""
FLAGS_FROM = 4.0
"""Million multiply-adds from which `XLA_FLAGS` pay. Updates of `nature` take 0.81 of the time with them. The
products of `tiny` are too small: on Catch a run makes 370 env steps a second with them, and 440 without."""
THREAD_FROM = 20.0
"""Million multiply-adds from which a thread more than there are cores pays. With it, on two cores, updates
of `sac_ae` take 0.86 of the time in joint training and 0.95 in RL alone, those of `nature` 1.02. `impala`,
`a_lix`, `mrq` and `der` have not been measured, with either: they follow from their size."""


def cache_folder(env: Mapping[str, str]) -> Path | None:
    """`srl_jax` in the user's cache directory, made if need be; None unless it is ours alone to write."""
    root = env.get("XDG_CACHE_HOME", "")
    try:
        folder = (Path(root) if os.path.isabs(root) else Path.home() / ".cache") / "srl_jax"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = folder.stat()
    except (OSError, RuntimeError):
        return None
    # What lies there is executed: jax loads compiled code from it.
    private = info.st_uid == os.geteuid() and not info.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return folder if private and os.access(folder, os.W_OK | os.X_OK) else None


def has_glibc() -> bool:
    """Whether this process' C library is the GNU one."""
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except (AttributeError, ValueError, OSError):
        return False


def has_gpu(env: Mapping[str, str], device: str = "/dev/nvidia0") -> bool:
    """Whether jax will take an NVIDIA GPU: device and plugin are there, and JAX_PLATFORMS allows it."""
    first = env.get("JAX_PLATFORMS", "").split(",")[0].strip()
    plugin = importlib.util.find_spec("jax_plugins") is not None
    return os.path.exists(device) and plugin and first in ("", "cuda", "gpu")


def cores() -> int:
    """How many this process may use, by its affinity and the time that its control groups allow."""
    mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    allowed = control_groups.cores()
    return mine if allowed is None else min(mine, allowed)


def machine() -> str:
    """A name for the kind of processor, of its architecture, model and instruction sets as far as known."""
    found = [platform.machine()]
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for name in ("model name", "flags", "Features"):
        found += re.findall(rf"^{name}\s*:.*$", text, re.MULTILINE)[:1]
    return hashlib.sha256("\n".join(found).encode()).hexdigest()[:12]


def with_flags(present: str, flags: tuple[str, ...]) -> str:
    """XLA_FLAGS with the flags appended that it does not set; as it is where it names a file of flags."""
    if present.strip() and not present.lstrip().startswith("-"):
        return present
    names = {flag.split("=")[0] for flag in present.split()}
    return " ".join([*present.split(), *(flag for flag in flags if flag.split("=")[0] not in names)])


def wanted(
    env: Mapping[str, str],
    encoder: str,
    *,
    glibc: bool,
    gpu: bool,
    cache: Path | None,
    cores: int,
    jaxlib: str,
) -> dict[str, str]:
    """The variables to set, with their values; none that the user has set, but for XLA_FLAGS, which grows.

    Args:
        env: the present environment.
        encoder: a specification.
        glibc: whether the process has glibc's malloc.
        gpu: whether jax will run on a GPU; what is for a CPU is then left out.
        cache: where jax may keep what it compiled, None for nowhere.
        cores: that the process may use.
        jaxlib: its version.
    """
    found = {}
    if glibc and not gpu and "glibc.malloc" not in env.get("GLIBC_TUNABLES", ""):
        found |= MALLOC
    if glibc and not gpu:
        found |= BLAS
    if cache is not None and "JAX_COMPILATION_CACHE_DIR" not in env:
        found["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        found["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        found["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    work = 0.0 if gpu else MULTIPLY_ADDS.get(encoder.split(":")[0], math.inf)
    if work >= THREAD_FROM:
        found["NPROC"] = str(cores + 1)
    found = {name: value for name, value in found.items() if name not in env}
    present = env.get("XLA_FLAGS", "")
    minor = ".".join(jaxlib.split(".")[:2])
    new = with_flags(present, XLA_FLAGS.get(minor, ()) if work >= FLAGS_FROM else ())
    return found if new.split() == present.split() else found | {"XLA_FLAGS": new}


def _say(text: str) -> None:
    display.say(f"runtime: {text}")


def prepare(tune: str, encoder: str, env: MutableMapping[str, str] = os.environ) -> None:
    """Sets what `wanted` names, starting the program again if that is what it takes; says so in one line.

    Does not return where it starts the program again.

    Args:
        tune: the value of --tune_runtime; "off" leaves everything alone.
        encoder: the run's, a specification.
        env: the environment to set.
    """
    if tune == "off":
        return
    folder = cache_folder(env)
    # One machine's code need not run on another that shares the home directory.
    cache = folder and folder / "xla" / machine()
    new = wanted(
        env,
        encoder,
        glibc=has_glibc(),
        gpu=has_gpu(env),
        cache=cache,
        cores=cores(),
        jaxlib=importlib.metadata.version("jaxlib"),
    )
    hint = "(--tune_runtime=off sets none)"
    if _AT_START.keys() & new.keys() and GUARD not in env and sys.executable:
        _say(f"restarting with {len(new)} variables that make jax faster here {hint}")
        if sys.stdout is not None:
            sys.stdout.flush()
        try:
            os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**env, **new, GUARD: "tuned"})
        except OSError as error:
            _say(f"not restarted: {error.strerror}")
    new = {name: value for name, value in new.items() if name not in _AT_START}
    if new:
        _say(f"{len(new)} variables that make jax faster here are set {hint}")
        env.update(new)


def check_device() -> None:
    """Whether jax finds a device of the kind that JAX_PLATFORMS asks for; imports jax.

    Raises:
        ConfigError: it does not.
    """
    import jax

    try:
        jax.devices()
    except Exception as error:  # of several kinds, some without a text
        why = f" ({str(error).splitlines()[0]})" if str(error) else ""
        raise ConfigError(
            f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}: jax finds no such device{why}; "
            "JAX_PLATFORMS=cpu runs on the processor"
        ) from None
