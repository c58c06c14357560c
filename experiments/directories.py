"""Run directories: new ones, and ones to overwrite, to resume or to read; each has one writer at a time."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from srl_jax import checkpoint, display, ending, loggers, rundir
from srl_jax.checkpoint import Manifest
from srl_jax.config import PARTIAL, SOURCES, Config, another_run, changes, record_changes
from srl_jax.errors import ConfigError, SaveError
from srl_jax.metrics import read_metrics
from srl_jax.reading import SETTINGS, parse_json, read_bytes

from . import flags as config_flags


def say(line: str) -> None:
    """A line about resuming, for whoever watches."""
    display.say(f"resume: {line}")


def runs_below(root: Path, file: str = "config.json") -> list[Path]:
    """Directories with a config.json, or another file, in or below a directory.

    Links are followed: a run may lie elsewhere.

    Each is found once: by its own path where that is below, else by the first link to it. A link to what the
    link or the root lies in is not followed.

    Returns:
        As `natural` sorts them.

    Raises:
        ConfigError: a directory cannot be read.
    """

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):  # removed meanwhile, by a run that is under way
            raise ConfigError(f"{error.filename}: {error.strerror}")

    found: list[str] = []
    seen: set[str] = set()
    waiting = [os.fspath(root)]
    while waiting:
        links: list[str] = []
        for top in waiting:
            for folder, folders, files in os.walk(top, onerror=refuse):
                real = os.path.realpath(folder)
                if real in seen:
                    folders.clear()
                    continue
                seen.add(real)
                if file in files and os.path.isfile(os.path.join(folder, file)):
                    found.append(folder)
                paths = [os.path.join(folder, name) for name in folders]
                links += [path for path in paths if os.path.islink(path) and not _around(path, real, root)]
        waiting = sorted(links, key=natural)
    return [Path(folder) for folder in sorted(found, key=natural)]


def _around(link: str, *places: str | Path) -> bool:
    """Whether a link leads to a directory in which one of the places lies."""
    return any(Path(os.path.realpath(place)).is_relative_to(os.path.realpath(link)) for place in places)


def natural(text: str) -> list:
    """A key for sorting names with numbers in them by these: seed2 before seed10."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", text))]


def check_out(out: str | None, config: Config, *, overwrite: bool, resume: bool) -> Path:
    """Whether a run can be written there; writes nothing.

    Args:
        out: the path, or None where it was not given.
        config: what it starts from must not be deleted.
        overwrite: a run that lies there may be deleted.
        resume: whether a run that lies there will be resumed.

    Returns:
        The path.

    Raises:
        ConfigError: it cannot.
    """
    if not out:
        raise ConfigError("--out: missing; name a directory for the run, --out=runs/NAME")
    if overwrite and resume:
        raise ConfigError("--resume=auto: resumes the run that --overwrite deletes; give one of them")
    path = config_flags.check_place("out", out)
    try:
        if blank(path):
            return path
        if resume:
            if not _is_run(path):
                raise ConfigError(f"--out={out}: not a run directory, so --resume=auto cannot resume it")
            return path
        if not overwrite:
            raise ConfigError(
                f"--out={out}: not empty; name a new directory, or --resume=auto resumes the run, "
                "or --overwrite deletes it"
            )
        if path.is_symlink():
            raise ConfigError(
                f"--out={out}: a link, so --overwrite does not delete it; name what it leads to"
            )
        if not _is_run(path):
            raise ConfigError(f"--out={out}: not a run directory, so --overwrite does not delete it")
    except OSError as error:
        raise ConfigError(f"--out={out}: {error.strerror}") from None
    kept = {"encoder_from": config.encoder_from, "policy_from": config.policy_from}
    for flag, source in kept.items():
        if source and Path(source).resolve().is_relative_to(path.resolve()):
            raise ConfigError(f"--out={out}: --overwrite would delete --{flag}={source}")
    if Path.cwd().is_relative_to(path.resolve()):
        raise ConfigError(f"--out={out}: --overwrite would delete the working directory")
    return path


def blank(path: Path) -> bool:
    """Whether nothing lies there, or only what a process left that ended before its run's first row."""
    if not path.is_dir():
        return True
    begun = _is_config(path / "config.json")
    rows = path / "metrics.jsonl"
    unwritten = begun and rows.is_file() and not rows.stat().st_size

    def left(entry: Path) -> bool:
        if entry.name.startswith("seed") and entry.is_dir() and not entry.is_symlink():
            return blank(entry)
        if entry.name in (rundir.LOCK, PARTIAL):
            return True
        if entry.is_symlink() or not begun:
            return False
        if entry.name == "encoders":  # what diagnostics keep of the first evaluation
            return unwritten and all(kept.name == f"{0:09d}" for kept in _finished(entry))
        if entry.name == "checkpoints":
            return unwritten and not _finished(entry)
        written = ("metrics.jsonl", *loggers.WRITTEN)
        return entry.name == "config.json" or (unwritten and entry.name in written)

    return all(left(entry) for entry in path.iterdir())


def _finished(folder: Path) -> list[Path]:
    """What lies in a folder of checkpoints, but for what was not written to its end."""
    return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]


def say_anew(path: Path) -> None:
    """Says that the run of a directory without a checkpoint begins again, if one has begun there."""
    if (path / "config.json").exists():
        say(f"{path}: no checkpoint there yet; the run begins again")


def _is_run(path: Path) -> bool:
    """Whether the directory, or one of seeds in it, holds a config.json that this program wrote."""
    return any(map(_is_config, (path / "config.json", *sorted(path.glob("seed*/config.json")))))


def _is_config(file: Path) -> bool:
    try:
        values = parse_json(read_bytes(file, SETTINGS))
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and {"game", "mode", "versions"} <= values.keys()


def to_resume(path: Path, config: Config, at_most: int | None = None) -> Manifest | None:
    """The checkpoint from which the run in a directory can be resumed; writes nothing.

    Args:
        path: of a run directory, or of one that is still to be made.
        config: resolved.
        at_most: env steps; newer checkpoints do not count.

    Returns:
        The manifest of the newest one that is whole, or None where the run has to begin. One without
        `srl_jax.checkpoint.NUMBERS` among its files is of a run that has ended.

    Raises:
        ConfigError: another process writes there, or the run has another configuration, or its checkpoints
            are all damaged, or gone though there were some.
    """
    rundir.check_free(path)
    if blank(path):
        say_anew(path)
        return None
    there = Config.load(path)
    if differing := another_run(there, config):
        raise ConfigError(
            f"--out={path}: the run there has another configuration: {differing}; srl-jax resume {path} "
            "takes its own, name another directory, or --overwrite without --resume starts anew"
        )
    manifest = checkpoint.newest_good(path, say, at_most)
    if manifest is None:
        if (steps := reached(path)) >= first_checkpoint(config):
            raise ConfigError(
                f"--out={path}: the run there got to {steps} env steps, and there is no checkpoint to "
                "resume it from; --overwrite would start anew"
            )
        say_anew(path)
        return None
    if differing := another_run(manifest.config, config):
        raise ConfigError(f"{manifest.path}: of another configuration: {differing}")
    if checkpoint.NUMBERS not in manifest.files:
        if config.steps > there.steps:
            raise ConfigError(
                f"--steps={config.steps}: the run in {path} has ended after {manifest.env_steps} env steps "
                "and left no replay to resume with; --keep_replay beside training keeps it"
            )
        return manifest
    if config.steps < manifest.env_steps:
        raise ConfigError(
            f"--steps={config.steps}: the run in {path} has done {manifest.env_steps} env steps already"
        )
    if config.steps != there.steps:
        say(f"{path}: --steps was {there.steps} and is {config.steps}{_by_the_end(config)}")
    with contextlib.suppress(ConfigError):  # it informs and decides nothing
        if (ended := ending.read(path)) is not None and ended.status == "diverged":
            say(f"{path}: ended since {ended.reason}; the same code on the same machine gets there again")
    for flag in SOURCES:
        then, now = getattr(there, flag), getattr(config, flag)
        if then != now:
            how = "the run resumes with the latter" if flag == "policy_from" else "neither is read any more"
            say(f"{path}: --{flag} was {then} and is {now}: {how}")
    if changed := changes(path):
        what = ", ".join(
            f"{name} was {then!r:.200} and is {now!r:.200}" for name, (then, now) in changed.items()
        )
        say(f"{path}: {what}: results may differ from those of a run that did not end")
    return manifest


def _by_the_end(config: Config) -> str:
    """What of a run depends on how long it is, for the line that says that this has changed."""
    found = []
    if config.lr_final_share != 1.0:
        found.append("learning rates fall to --lr_final_share by the new end")
    if config.diagnostics and config.diagnostics_kept:
        found.append("drift is measured against encoders spread over the new length")
    return f"; {' and '.join(found)}" if found else ""


@contextlib.contextmanager
def going_on(path: Path, manifest: Manifest, config: Config) -> Iterator[None]:
    """Holds the directory of a run that is resumed; its config.json gets what has changed since it began.

    Raises:
        ConfigError: another process writes there.
        SaveError: config.json could not be written.
    """
    with rundir.held(path):
        try:
            record_changes(path, manifest.env_steps, config)
        except OSError as error:
            raise SaveError(f"--out={path}: {error.strerror}") from None
        yield


def all_to_resume(runs: list[tuple[Path, Config]]) -> list[Manifest | None]:
    """`to_resume` of runs that are resumed in step: checkpoints of the same env step, or None for all.

    Raises:
        ConfigError: one cannot be resumed, or it would have to begin again and another one got further.
    """
    at_most = None
    while True:
        found = [to_resume(path, config, at_most) for path, config in runs]
        if None in found:
            first, config = runs[found.index(None)]
            for (path, _), manifest in zip(runs, found, strict=True):
                never = not (first / "config.json").exists()
                if manifest and (never or manifest.env_steps >= first_checkpoint(config)):
                    raise ConfigError(
                        f"--out={first}: no checkpoint there to resume from, while {path} has one of "
                        f"{manifest.env_steps} env steps; --overwrite would start all of them anew"
                    )
            return [None] * len(runs)
        steps = {manifest.env_steps for manifest in found}
        if len(steps) == 1:
            return found
        at_most = min(steps)


def first_checkpoint(config: Config) -> int:
    """Env steps at which the first checkpoint is on disk for certain."""
    return (config.checkpoint_every or config.eval_every) + config.num_envs


def reached(path: Path) -> int:
    """The env steps of a run's last row, or 0."""
    try:
        return max((int(row["env_steps"]) for row in read_metrics(path / "metrics.jsonl")), default=0)
    except (OSError, ValueError, KeyError, TypeError):
        return 0
