"""What made a run: versions of packages, the commit, files of --import, what XLA was told, the machine.

A run's config.json says it beside the settings, and under "continued" what was another one when the run was
resumed. Imports no jax.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

PACKAGES = (
    "srl-jax", "jax", "jaxlib", "flax", "optax", "chex", "numpy", "gymnasium", "absl-py", "ale-py",
)  # fmt: skip
MADE_BY = ("versions", "git_revision", "environment", "cpus", "cores", "imported")
"""The keys of `made_by`."""
ABOUT = (*MADE_BY, "started", "seeds", "continued")
"""What config.json holds beside the fields of Config; "seeds" where one process trains several."""


def made_by(imports: Iterable[str] = ()) -> dict[str, Any]:
    """What config.json says of this process: software, how many CPUs there are, and how many for it.

    Args:
        imports: files and modules that the run imports, as of `srl_jax.config.Config`.
    """
    values = versions(), git_revision(), told_to_xla(), os.cpu_count(), cores(), sums(imports)
    return dict(zip(MADE_BY, values, strict=True))


def cores() -> int | None:
    """On how many CPUs this process may run, by its affinity; XLA has as many threads, on which roundings
    depend."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def is_file(name: str) -> bool:
    """Whether what is imported, or a name of `history`, is a file and no module or package."""
    return name.endswith(".py")


def sums(imports: Iterable[str]) -> dict[str, str]:
    """{name of a file, wherever it lies: its sha256} of what is imported; of modules nothing is said.

    Files of one name have one sum, of all their content. What is not there is left out.
    """
    found: dict[str, Any] = {}
    for path in map(Path, filter(is_file, imports)):
        with contextlib.suppress(OSError):
            content = path.read_bytes()
            found.setdefault(path.name, hashlib.sha256()).update(content)
    return {name: found[name].hexdigest() for name in found}


def now() -> str:
    """The time, UTC."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())


def history(about: Mapping[str, Any]) -> dict[str, list[Any]]:
    """What made a run: {what: its values, oldest first}, of packages, environment variables, files, the rest.

    Args:
        about: the content of config.json. What it does not say at all is left out.

    Raises:
        ValueError: it is not what training writes.
    """
    try:
        found = {name: [value] for name, value in _flat(about).items()}
        for continued in about.get("continued", []):
            for name, value in continued["changed"].items():
                found.setdefault(name, [None]).append(value)
    except (TypeError, KeyError, AttributeError):
        raise ValueError("what it says of versions is not what training writes") from None
    return found


def changes(about: Mapping[str, Any], imports: Iterable[str]) -> dict[str, tuple[Any, Any]]:
    """What is different now of what made a run: {name: (then, now)}, as of `history`; None for nothing.

    Args:
        about: the content of config.json.
        imports: what the run imports now.
    """
    then = {name: values[-1] for name, values in history(about).items()}
    here = _flat({name: value for name, value in made_by(imports).items() if name in about})
    pairs = {name: (then.get(name), here.get(name)) for name in {**then, **here}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _flat(about: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in MADE_BY:
        if name in about:
            found |= about[name] if isinstance(about[name], dict) else {name: about[name]}
    return found


def told_to_xla() -> dict[str, str]:
    """The environment variables that change an update's roundings."""
    return {name: os.environ[name] for name in ("XLA_FLAGS", "NPROC", "JAX_PLATFORMS") if name in os.environ}


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that a run's numbers depend on."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            pass  # An extra that is not installed, or a checkout that is run in place.
    return found


def git_revision() -> str | None:
    """The commit of the checkout that this package lies in, `-dirty` if tracked files differ from it.

    None where there is no git, no commit, or the package is merely installed below another checkout.
    """
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return None
        revision = git("rev-parse", "--verify", "HEAD")
        return revision + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
