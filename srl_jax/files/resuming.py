"""Where a run is resumed from, and whether what lies in a directory is a run at all. Imports no jax."""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from srl_jax import config
from srl_jax.config import SOURCES, Config, difference
from srl_jax.errors import ConfigError, saving
from srl_jax.files import checkpoint, display, loggers, provenance, rundir
from srl_jax.files.checkpoint import Manifest
from srl_jax.files.metrics import read_metrics
from srl_jax.files.reading import read_json
from srl_jax.run import ending
from srl_jax.specs import value_text

ENDS = ("steps", "stop_at_return")
"""Fields that say when a run ends."""
MAY_CHANGE = (*ENDS, "keep_replay", "keep_best", "imports", "loggers")
"""Fields that may change when a run is resumed: when it ends, what it leaves, its plug-ins and loggers."""


def another_run(there: Config, here: Config) -> str:
    """`difference` of what makes two runs two: neither `MAY_CHANGE` nor where the sources lie by now."""
    same = {name: getattr(there, name) for name in SOURCES if getattr(there, name) and getattr(here, name)}
    same |= {name: getattr(there, name) for name in MAY_CHANGE}
    return difference(there, dataclasses.replace(here, **same))


def say(line: str) -> None:
    """A line about resuming, for whoever watches."""
    display.say(f"resume: {line}")


def blank(path: Path) -> bool:
    """Whether nothing lies there, or only what a process left that ended before its run's first row."""
    if not path.is_dir():
        return True
    begun, rows = _is_config(path / config.FILE), path / "metrics.jsonl"
    unwritten = begun and rows.is_file() and not rows.stat().st_size
    without_rows = (config.FILE, ending.FILE) if unwritten or not rows.exists() else (config.FILE,)

    def left(entry: Path) -> bool:
        if entry.name.startswith("seed") and entry.is_dir() and not entry.is_symlink():
            return blank(entry) and rundir.is_free(entry)
        if entry.name in (rundir.LOCK, f"{config.FILE}.partial") or entry.name.startswith(rundir.ASIDE):
            return True  # `rundir.put_back` is for what was set aside, before anybody asks
        if entry.is_symlink() or not begun:
            return False
        if entry.name == "encoders":  # what diagnostics keep of the first evaluation
            return unwritten and all(kept.name == f"{0:09d}" for kept in _finished(entry))
        if entry.name == "checkpoints":
            return unwritten and not _finished(entry)
        return entry.name in without_rows or (unwritten and entry.name in ("metrics.jsonl", *loggers.WRITTEN))

    return all(left(entry) for entry in path.iterdir())


def _finished(folder: Path) -> list[Path]:
    """What lies in a folder of checkpoints, but for what was not written to its end."""
    return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]


def say_anew(path: Path) -> None:
    """Says that the run of a directory without a checkpoint begins again, if one has begun there."""
    if (path / config.FILE).exists():
        say(f"{path}: no checkpoint there yet; the run begins again")


def is_run(path: Path) -> bool:
    """Whether the directory holds a config.json that this program wrote."""
    return _is_config(path / config.FILE)


def has_seeds(path: Path) -> bool:
    """Whether one of the directories of seeds in a directory is a run's."""
    return any(map(is_run, sorted(path.glob("seed*"))))


def _is_config(file: Path) -> bool:
    try:
        values = read_json(file)
    except ConfigError:
        return False
    return isinstance(values, dict) and {"game", "mode", "versions"} <= values.keys()


def to_resume(
    path: Path,
    wanted: Config,
    at_most: int | None = None,
    completed: Callable[[Config], Config] = lambda config: config,
) -> Manifest | None:
    """The checkpoint from which the run in a directory can be resumed; writes nothing.

    Args:
        path: of a run directory, or of one that is still to be made.
        wanted: resolved.
        at_most: env steps; newer checkpoints do not count.
        completed: what a configuration of an earlier version means: options of --rl, --encoder and
            --objective that are newer than the run take their defaults.

    Returns:
        The manifest of the newest one that is whole, or None where the run has to begin. One without
        `srl_jax.files.checkpoint.NUMBERS` among its files is of a run that has ended.

    Raises:
        ConfigError: another process writes there, or the run has another configuration, or its checkpoints
            are all damaged, or gone though there were some.
    """
    rundir.check_free(path)
    if blank(path):
        say_anew(path)
        return None
    there, about = config.read(path)
    if differing := another_run(completed(there), wanted):
        raise ConfigError(
            f"--out={path}: the run there has another configuration: {differing}; srl-jax resume {path} "
            "takes its own, name another directory, or --overwrite without --resume starts anew"
        )
    manifest = checkpoint.newest_good(path, say, at_most)
    if manifest is None:
        if (steps := reached(path)) >= first_checkpoint(wanted):
            raise ConfigError(
                f"--out={path}: the run there got to {steps} env steps, and there is no checkpoint to "
                "resume it from; --overwrite would start anew"
            )
        say_anew(path)
        return None
    if differing := another_run(completed(manifest.config), wanted):
        raise ConfigError(f"{manifest.path}: of another configuration: {differing}")
    if checkpoint.NUMBERS not in manifest.files:
        early = manifest.env_steps < wanted.steps and wanted.stop_at_return != there.stop_at_return
        if early or wanted.steps > there.steps:
            flag = "stop_at_return" if early else "steps"
            value = value_text(getattr(wanted, flag))
            raise ConfigError(
                f"--{flag}={value}: the run in {path} has ended after {manifest.env_steps} env steps "
                "and left no replay to resume with; --keep_replay beside training keeps it"
            )
        return manifest
    if wanted.whole_rounds(wanted.steps) < manifest.env_steps:
        raise ConfigError(
            f"--steps={wanted.steps}: the run in {path} has done {manifest.env_steps} env steps already"
        )
    _say_changes(path, there, about, wanted)
    return manifest


def _say_changes(path: Path, there: Config, about: dict, wanted: Config) -> None:
    """Says what is different from when the run in a directory began, or was last resumed.

    Raises:
        ConfigError: what config.json says of versions is not what training writes.
    """
    if wanted.steps != there.steps:
        say(f"{path}: --steps was {there.steps} and is {wanted.steps}{_by_the_end(wanted)}")
    with contextlib.suppress(ConfigError):  # it informs and decides nothing
        if (ended := ending.read(path)) is not None and ended.status == "diverged":
            say(f"{path}: ended since {ended.reason}; the same code on the same machine gets there again")
    for flag in SOURCES:
        then, now = getattr(there, flag), getattr(wanted, flag)
        if then != now:
            how = "the run resumes with the latter" if flag == "policy_from" else "neither is read any more"
            say(f"{path}: --{flag} was {then} and is {now}: {how}")
    if changed := _changes(path, about, wanted):
        what = ", ".join(
            f"{name} was {then!r:.200} and is {now!r:.200}" for name, (then, now) in changed.items()
        )
        say(f"{path}: {what}: results may differ from those of a run that did not end")


def _by_the_end(wanted: Config) -> str:
    """What of a run depends on how long it is, for the line that says that this has changed."""
    found = []
    if wanted.lr_final_share != 1.0:
        found.append("learning rates fall to --lr_final_share by the new end")
    if wanted.diagnostics and wanted.diagnostics_kept:
        found.append("drift is measured against encoders spread over the new length")
    return f"; {' and '.join(found)}" if found else ""


def _changes(path: Path, about: dict, wanted: Config) -> dict[str, tuple]:
    """`srl_jax.files.provenance.changes` of a run directory's config.json, for what is wanted of the run."""
    try:
        return provenance.changes(about, wanted.imports)
    except ValueError as error:
        raise ConfigError(f"{path / config.FILE}: {error}") from None


@contextlib.contextmanager
def going_on(path: Path, manifest: Manifest, resumed: Config) -> Iterator[Callable[[], None]]:
    """Holds the directory of a run that is resumed, and yields what brings its config.json up to date.

    That is called once the run has begun: what is refused changes nothing. The settings of `MAY_CHANGE` take
    their new values; what else has changed is under "continued". Where nothing has, nothing is written.

    Args:
        path: the directory.
        manifest: of the checkpoint from which it is resumed.
        resumed: the configuration that it is resumed with.

    Raises:
        ConfigError: another process writes there.
        SaveError: by what is yielded: config.json could not be written.
    """
    with rundir.held(path):
        there, about = config.read(path)
        values = {name: getattr(resumed, name) for name in MAY_CHANGE}
        settings = {name: value for name, value in values.items() if getattr(there, name) != value}
        changed = {name: now for name, (_, now) in _changes(path, about, resumed).items()}

        def begun() -> None:
            if settings or changed:
                now = {"env_steps": manifest.env_steps, "started": provenance.now()}
                continued = [*about.get("continued", []), {**now, "changed": changed, "settings": settings}]
                with saving(f"--out={path}"):
                    config.write(path, {**about, **settings, "continued": continued})

        yield begun


def all_to_resume(
    runs: list[tuple[Path, Config]], completed: Callable[[Config], Config] = lambda config: config
) -> list[Manifest | None]:
    """`to_resume` of runs that are resumed in step: checkpoints of the same env step, or None for all.

    Raises:
        ConfigError: one cannot be resumed, or it would have to begin again and another one got further.
    """
    at_most = None
    while True:
        found = [to_resume(path, wanted, at_most, completed) for path, wanted in runs]
        steps = [manifest.env_steps for manifest in found if manifest is not None]
        if len(steps) < len(runs):
            first, wanted = runs[found.index(None)]
            for (path, _), manifest in zip(runs, found, strict=True):
                never = not (first / config.FILE).exists()
                if manifest and (never or manifest.env_steps >= first_checkpoint(wanted)):
                    raise ConfigError(
                        f"--out={first}: no checkpoint there to resume from, while {path} has one of "
                        f"{manifest.env_steps} env steps; --overwrite would start all of them anew"
                    )
            return [None] * len(runs)
        # One that has ended, before the others had, can be resumed from its checkpoint before.
        ended = {checkpoint.NUMBERS not in manifest.files for manifest in found if manifest is not None}
        if len(set(steps)) == len(ended) == 1:
            return found
        at_most = min(steps) - (len(set(steps)) == 1)


def has_ended(path: Path, manifest: Manifest, wanted: Config) -> bool:
    """Whether a run has done all that is wanted of it, so that there is nothing to resume.

    Args:
        path: its directory.
        manifest: of its newest checkpoint, see `to_resume`.
        wanted: its configuration, now.
    """
    if checkpoint.NUMBERS not in manifest.files:
        return True
    ended = ending.read(path)  # a run of --keep_replay
    over = manifest.env_steps >= wanted.steps or not difference(manifest.config, wanted, ENDS)
    return over and ended is not None and ended.status == "finished"


def lacks(path: Path, found: Manifest) -> str:
    """What is missing of a run that has ended, as its last checkpoint says, or ""."""
    try:
        if (found.path / checkpoint.PARAMS).stat().st_size != found.files[checkpoint.PARAMS].bytes:
            return f"{checkpoint.PARAMS} has not the size that the manifest knows"
        with open(path / "metrics.jsonl", "rb") as file:
            size = file.seek(0, os.SEEK_END)  # 0 of a run that was too short for a row
            file.seek(max(size - 1, 0))
            return "" if file.read(1) in (b"\n", b"") else "the last row of metrics.jsonl is cut short"
    except OSError as error:
        return f"{os.path.basename(error.filename or 'metrics.jsonl')}: {error.strerror}"


def say_finished(path: Path, manifest: Manifest) -> bool:
    """Whether a run that `has_ended` was ended before its ended.json said so; the file says so now.

    Raises:
        ConfigError: another process writes there.
        SaveError: it could not be written.
    """
    with contextlib.suppress(ConfigError):  # one that is damaged says nothing
        if (ended := ending.read(path)) is not None and ended.status == "finished":
            return False
    if lacks(path, manifest):
        return False
    with rundir.held(path):
        ending.write(path, ending.Ending("finished", manifest.env_steps))
    return True


def first_checkpoint(wanted: Config) -> int:
    """Env steps at which the first checkpoint is on disk for certain."""
    return (wanted.checkpoint_every or wanted.eval_every) + wanted.num_envs


def reached(path: Path) -> int:
    """The env steps of a run's last row, or 0."""
    try:
        return max((int(row["env_steps"]) for row in read_metrics(path / "metrics.jsonl")), default=0)
    except (OSError, ValueError, KeyError, TypeError):
        return 0
