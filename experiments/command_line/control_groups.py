"""What control groups leave to this process: memory, and a share of the cores' time. Imports no jax.

A container, a job of SLURM or a systemd service is a control group. Version 1 has a tree for each controller,
version 2 one for all; a machine may have both (`man 7 cgroups`). A limit of a group holds for all below it.
"""

import contextlib
import math
import re
from pathlib import Path, PurePosixPath

ROOT = Path("/")


def folders(root: Path = ROOT) -> list[Path]:
    """The directories of this process' groups and of all that these are in, as far as they can be seen.

    Args:
        root: of the file system; another one for tests.
    """
    try:
        mine = (root / "proc/self/cgroup").read_text(errors="replace").splitlines()
        mounts = (root / "proc/self/mountinfo").read_text(errors="replace").splitlines()
    except OSError:
        return []
    groups = {}  # {controller: this process' group}; version 2 has no names of controllers there
    for line in mine:
        _, _, rest = line.partition(":")
        names, _, path = rest.partition(":")
        groups |= dict.fromkeys(names.split(","), path)
    found: dict[Path, None] = {}
    for line in mounts:
        before, _, after = line.partition(" - ")
        if len(before.split()) < 5 or len(after.split()) < 3:
            continue
        seen_from, place = (_unescaped(text) for text in before.split()[3:5])
        kind, _, options = after.split()[:3]
        names = {"cgroup2": [""], "cgroup": options.split(",")}.get(kind, [])
        for path in {groups[name] for name in names if name in groups}:
            mount = root / place.lstrip("/")
            folder = mount
            with contextlib.suppress(ValueError):  # not below what is mounted: that is all there is to see
                folder = mount / PurePosixPath(path).relative_to(seen_from)
            if ".." in folder.parts:  # in a namespace of groups that does not show it
                folder = mount
            found |= dict.fromkeys(x for x in (folder, *folder.parents) if x.is_relative_to(mount))
    return list(found)


def _unescaped(text: str) -> str:
    """A path of mountinfo, where a space is \\040."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), text)


def free_memory(root: Path = ROOT) -> int | None:
    """The bytes that new processes can have, also under a group's limit; None where that is not known.

    Args:
        root: of the file system; another one for tests.
    """
    found = [free_bytes(root)]
    with contextlib.suppress(OSError, ValueError, IndexError, StopIteration):
        lines = (root / "proc/meminfo").read_text().splitlines()
        found.append(next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")))
    return min((size for size in found if size is not None), default=None)


def free_bytes(root: Path = ROOT) -> int | None:
    """The memory that the groups leave to new processes; None where they set no limit.

    What a group keeps of files that nobody uses counts as free: the kernel gives it up.
    """
    left = []
    for folder in folders(root):
        for limit, used, cache in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            if (most := _number(folder / limit)) is None or (now := _number(folder / used)) is None:
                continue
            with contextlib.suppress(OSError, ValueError):
                lines = (folder / "memory.stat").read_text().splitlines()
                now -= next((int(x.split()[1]) for x in lines if x.split()[:1] == [cache]), 0)
            left.append(max(most - now, 0))
    return min(left, default=None)


def cores(root: Path = ROOT) -> int | None:
    """The cores whose time the groups allow, a part of one counting as one; None where they set no limit."""
    shares = []
    for folder in folders(root):
        with contextlib.suppress(OSError, ValueError, ZeroDivisionError):  # ValueError: "max"
            quota, period = map(int, (folder / "cpu.max").read_text().split())
            shares.append(quota / period)
        quota, period = (_number(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        if quota is not None and quota > 0 and period:  # -1 is no limit
            shares.append(quota / period)
    return max(math.ceil(min(shares)), 1) if shares else None


def _number(path: Path) -> int | None:
    """What a file of one number holds; None where there is none, or "max"."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
