"""Runs what a sweep has left to do: a process a run, each after those that it starts from. Imports no jax.

`launch` gives runs to a `concurrent.futures.Executor`, which calls `attempt`: a thread of this process, or a
task of a cluster. A run's command resumes what is there, so `attempt` may be called again at any time.
"""

import concurrent.futures as cf
import contextlib
import graphlib
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import srl_jax
from srl_jax import envs
from srl_jax.config import Config
from srl_jax.errors import EXIT_STATUS, ConfigError, Diverged, SaveError, saving
from srl_jax.files import display, rundir

from ..command_line import control_groups, runtime
from ..command_line.stopping import signals
from . import manifest, plan, states, status
from .manifest import Entry

BAD_INPUT, NO_SPACE, DIVERGED = (EXIT_STATUS[kind] for kind in (ConfigError, SaveError, Diverged))
STOPPED = 128 + signal.SIGTERM

EVERY_S = 0.2
"""How often it is looked whether a run has ended or shall end, in seconds."""
SUMMARY_EVERY_S = 60.0

RUN_BYTES = 600 * 2**20
"""Of a process that trains, beside its replay buffer: measured with the thesis' encoders on a CPU."""
MEMORY_SHARE = 0.9
"""Of the memory that is free when a sweep begins that it may fill."""

STOP = "running"
"""A file in the root of a sweep that is at work: as many bytes as its runs may still be asked to end, first
with a checkpoint and then at once. It gets shorter, which a full disk does not prevent."""

Ended = tuple[int, str]
"""The exit status of a run, negative for a signal, and why it did not end well; "" where it was stopped."""

_CHILD = """
import ctypes, os, sys
parent, cores, *line = sys.argv[1:]
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 15, 0, 0, 0)  # PR_SET_PDEATHSIG, SIGTERM
    if cores:
        os.sched_setaffinity(0, map(int, cores.split(",")))
if os.getppid() != int(parent):  # it has ended before it could be watched
    sys.exit(143)
os.execv(line[0], line)
"""
"""Becomes a run that keeps to its cores. On Linux the kernel sends it SIGTERM when the process that has
started it is gone, however that ended, so that it writes a checkpoint and does not go on unknown."""


def say(text: str) -> None:
    """A line about the sweep, for whoever watches."""
    display.say(f"sweep: {text}")


def run_sweep(
    root: Path,
    entries: Mapping[str, Entry],
    *,
    launcher: str = "local",
    workers: int | None = None,
    retries: int = 2,
    cpus_per_run: int = 1,
    gpus_per_run: float = 0.0,
    ray_address: str | None = None,
    command: Callable[[plan.Planned], list[str]] = plan.command,
) -> int:
    """Runs those of these runs that are not complete.

    Args:
        root: of the sweep, whose other runs are left alone; made if need be.
        entries: from `manifest.resolve`.
        launcher: "local" or "ray".
        workers: runs at once; None: one a core, as far as memory allows, and one in all on a GPU; of a
            cluster, as many as it has room for.
        retries: how often a run that crashed is resumed: no bad setting, full disk or infinite loss.
        cpus_per_run: cores that a run keeps to. Roundings, and so results, may depend on it.
        gpus_per_run: of one GPU or several, for Ray.
        ray_address: of a Ray cluster; None starts one on this machine.
        command: the command line of a run that works in `root`.

    Returns:
        The exit status: 0 if every run is complete, 1 if not, 128 + n after signal n.

    Raises:
        ConfigError: a run cannot be run, or another sweep is at work there; nothing was written.
        SaveError: nothing more can be written; what ran has been stopped.
    """
    states.look_at_all(root, entries)
    root = root.absolute()
    rundir.check_free(root)
    planned = manifest.merged(root, entries)
    executor: cf.Executor
    memory = None
    if launcher == "ray":
        from .ray_executor import Ray

        executor = cluster = Ray(cpus_per_run, gpus_per_run, retries, ray_address)
        at_once = lambda: workers or cluster.capacity()  # noqa: E731
    else:
        count = workers or most_workers(cpus_per_run)
        executor, at_once = cf.ThreadPoolExecutor(count), lambda: count
        free = control_groups.free_memory()
        if free is not None and workers is None:  # who says how many also says that there is memory for them
            memory = MEMORY_SHARE * free

    def submit(entry: Entry) -> cf.Future[Ended]:
        run, config = entry
        return executor.submit(attempt, root, run.name, command(run), config, cpus_per_run, retries)

    with executor:
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out={root}: {error.strerror}") from None
        with rundir.held(root):
            manifest.write(root, planned)
            say(f"{len(entries)} runs in {root}, {at_once()} at once")
            return launch(root, entries, submit, at_once, memory)


def most_workers(cores: int = 1) -> int:
    """Runs at once on this machine: one for so many cores, or one in all on a GPU."""
    return 1 if runtime.has_gpu(os.environ) else max(runtime.cores() // cores, 1)


def run_bytes(config: Config) -> int:
    """About how much memory a run takes once its buffer is full: a byte a pixel and channel, and the rest.

    How large and how colourful frames are only the environment knows, of a game that can be either.
    """
    channels = 3 if envs.known(config.game).own_size else 1
    return RUN_BYTES + config.buffer_size * channels * (config.frame_size or 84) ** 2


def launch(
    root: Path,
    entries: Mapping[str, Entry],
    submit: Callable[[Entry], cf.Future[Ended]],
    workers: Callable[[], int],
    memory: float | None = None,
) -> int:
    """Runs what is not complete; returns when nothing is left to do, or a signal has come.

    Args:
        root: of the sweep, absolute; held by this process.
        entries: {name: Entry}; those that come first are run first where there is a choice.
        submit: gives a run to an executor, which calls `attempt`.
        workers: how many runs it may be given at once.
        memory: bytes that runs may take together; one always fits. None: not looked at.

    Returns, Raises:
        See `run_sweep`.
    """
    order = graphlib.TopologicalSorter({name: entry.run.sources for name, entry in entries.items()})
    order.prepare()
    done = {name for name, state in states.look_at_all(root, entries).items() if state.kind == "done"}
    for name in entries.keys() - done:
        if states.failure(root, name):
            states.note(root, name, "is to be run again")
    bad: dict[str, str] = {}  # {name of one that failed or is blocked: what those say that start from it}
    ready: list[str] = []
    flying: dict[cf.Future[Ended], str] = {}
    place, asked, disk, said_at = list(entries), 0, "", time.monotonic()

    def room(name: str) -> bool:
        if memory is None or not flying:
            return len(flying) < at_once
        taken = sum(run_bytes(entries[other].config) for other in (name, *flying.values()))
        return len(flying) < at_once and taken <= memory

    def settled(name: str) -> bool:
        """Whether one that could begin is dealt with."""
        if name in done:
            order.done(name)
        elif why := next((bad[source] for source in entries[name].run.sources if source in bad), None):
            say(f"{name}: blocked: {why}")
            bad[name] = why
            order.done(name)
        elif not asked and room(name):
            flying[submit(entries[name])] = name
        else:
            return False
        return True

    with _asking(root) as ask, signals() as caught:
        try:
            while order.is_active() and (flying or not asked):
                if (times := max(len(caught), asked_to_end(root), int(bool(disk)))) > asked:
                    why = f"signal {caught[-1]}" if caught else disk or f"{STOP} was taken away"
                    say(f"stopping: {why}; each run writes a checkpoint")
                    asked = times
                    ask(asked)
                at_once = max(workers(), 1)
                ready = sorted([*ready, *order.get_ready()], key=place.index)
                ready = [name for name in ready if not settled(name)]
                for future in cf.wait(flying, EVERY_S, cf.FIRST_COMPLETED).done:
                    name, (code, reason) = flying.pop(future), _result(future)
                    if code == 0:
                        done.add(name)
                        say(f"{name}: done, {status.ended_text(root / name)}")
                    elif code != NO_SPACE and reason:
                        bad[name] = f"{name} failed"
                        say(f"{name}: failed: {reason}")
                        with contextlib.suppress(SaveError):  # of a full disk the runs tell
                            states.note(root, name, f"failed: {reason}")
                    else:
                        disk = disk or (f"{name}: {reason}" if reason else "")
                        ready.append(name)
                        continue
                    order.done(name)
                if time.monotonic() - said_at > SUMMARY_EVERY_S:
                    said_at = time.monotonic()
                    say(status.lines(root, entries, workers())[0])
        except BaseException:
            ask(1)
            cf.wait(flying)  # so that nobody writes on unknown
            raise
    for line in status.lines(root, entries, workers()):
        say(line)
    if disk:
        raise SaveError(disk)
    return 128 + (caught or [signal.SIGTERM])[0] if asked else int(bool(bad))


def _result(future: cf.Future[Ended]) -> Ended:
    try:
        return future.result()
    except Exception as error:  # a worker or a node was lost too often
        line = next(filter(None, str(error).splitlines()), "")
        return 1, f"{type(error).__name__}: {line:.300}"


@contextlib.contextmanager
def _asking(root: Path) -> Iterator[Callable[[int], None]]:
    """A function that asks the runs of a sweep to end; it takes how often they are asked then, in all."""
    path = root / STOP
    with saving(path):
        path.write_bytes(b"..")

    def ask(times: int) -> None:
        with contextlib.suppress(FileNotFoundError):  # whoever removes it asks, too
            os.truncate(path, max(2 - times, 0))

    try:
        yield ask
    finally:
        path.unlink(missing_ok=True)


def asked_to_end(root: Path) -> int:
    """How often the runs of a sweep were asked to end."""
    try:
        return 2 - len((root / STOP).read_bytes())
    except FileNotFoundError:
        return 1


def attempt(root: Path, name: str, command: list[str], config: Config, cores: int, retries: int) -> Ended:
    """Runs or resumes a run in a process of its own, and waits for its end; an executor calls it.

    It waits while another process writes to the run's directory: a former one of this run, which has been
    told to end, or somebody else's.

    Args:
        root: of the sweep, absolute.
        name: of the run, and its directory below the root.
        command: its command line, with paths as they are under the root.
        config: that it has, resolved.
        cores, retries: see `run_sweep`.
    """
    try:
        state, left = states.look(root / name, config), retries
        if state.kind == "busy":
            say(f"{name}: waiting for {state.reason}")
        while state.kind == "busy" and not asked_to_end(root):
            time.sleep(EVERY_S)
            state = states.look(root / name, config)
        while state.kind != "done":
            if asked_to_end(root):
                return STOPPED, ""
            code, reason = _run(root, name, command, cores)
            state = states.look(root / name, config)
            if code == 0 and state.kind != "done":
                return 1, f"ended with status 0 and is {state.kind} {state.reason}".rstrip()
            if code in (BAD_INPUT, NO_SPACE, DIVERGED) or not reason or not left:
                return code, reason
            say(f"{name}: {reason}; resuming it")
            left -= 1
    except ConfigError as error:
        return BAD_INPUT, str(error)
    except (OSError, SaveError) as error:
        return NO_SPACE, f"not started: {error}"
    return 0, ""


def _run(root: Path, name: str, command: list[str], cores: int) -> Ended:
    """One process of a run, from its start to its end.

    It works in the sweep's root, in a session of its own: what a terminal sends to a sweep does not reach it.
    """
    with own_cores(cores) as numbers:
        mine = ",".join(map(str, numbers))
        where = f"started on {platform.node()}, core {mine or 'any'}"
        say(f"{name}: {where}")
        states.note(root, name, f"{where}: {' '.join(command)}")
        with open(states.log_path(root, name), "ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _CHILD, str(os.getpid()), mine, *command],
                cwd=root,
                env=os.environ | {"PYTHONPATH": python_path(), "PYTHONSAFEPATH": "1"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        asked = 0
        while process.poll() is None:
            if asked_to_end(root) > asked:
                asked += 1
                process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(EVERY_S)
    code, line = process.returncode, states.last_line(root, name).removeprefix("error: ")
    if code == 0 or asked:
        return code, ""
    line = "no output" if line.startswith("---") else line
    if code not in (BAD_INPUT, NO_SPACE, DIVERGED):
        line = f"killed by {signal.Signals(-code).name}" if code < 0 else f"status {code}: {line}"
    return code, line


def python_path() -> str:
    """PYTHONPATH of a process that works in another directory, from which it shall import nothing.

    Modules that lie where this process works, as of `--game=module:Name-v0`, it may import.
    """
    installed = str(Path(srl_jax.__file__).resolve().parents[1])
    paths = [installed, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)), os.getcwd()]
    return os.pathsep.join(dict.fromkeys(paths))


_lent: Counter[int] = Counter()  # how many runs of this process are on a core
_lending = threading.Lock()


@contextlib.contextmanager
def own_cores(count: int, folder: Path | None = None) -> Iterator[list[int]]:
    """Numbers of cores for one run: two runs with a core each are together faster than two that share two.

    Who has a core holds its folder below that for temporary files, so all processes of a user share them.
    Where there are too few, runs share a core, but each has as many as it has alone: XLA computes alike then.

    Args:
        count: how many; at least 1.
        folder: of the locks; None: the user's own.

    Yields:
        None at all where there is nothing to choose: on a GPU, or on a system without affinity.
    """
    affinity = getattr(os, "sched_getaffinity", lambda pid: ())
    all_cores = [] if runtime.has_gpu(os.environ) else affinity(0)
    folder = folder or Path(tempfile.gettempdir()) / f"srl_jax-{os.getuid()}" / "cores"
    with contextlib.ExitStack() as locks:
        with _lending:
            least_used = sorted(all_cores, key=lambda core: (_lent[core], core))
            mine: list[int] = []
            for core in least_used:
                with contextlib.suppress(ConfigError, OSError):
                    if len(mine) < count:
                        (folder / str(core)).mkdir(mode=0o700, parents=True, exist_ok=True)
                        locks.enter_context(rundir.held(folder / str(core)))
                        mine.append(core)
            mine += [core for core in least_used if core not in mine][: count - len(mine)]
            _lent.update(mine)
            locks.callback(_lent.subtract, mine)
        yield sorted(mine)
