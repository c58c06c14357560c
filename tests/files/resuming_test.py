"""Where a run goes on, and --out of experiments.train: srl_jax/files/resuming.py."""

import dataclasses
import hashlib
import json
import shutil

import numpy as np
import pytest

from experiments.train import check_out
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint, provenance
from srl_jax.files.resuming import all_to_resume, going_on, to_resume
from srl_jax.files.rundir import run_directory
from srl_jax.run import ending
from srl_jax.training import completed
from tests.files.rundir_test import contents
from tests.helpers import NOT_FINITE

CONFIG = Config(game="Catch", frame_size=42, steps=500, checkpoint_every=100, num_envs=4)
PARAMS = {"encoder": {"kernel": np.ones((2, 2), np.float32)}}
GOING_ON = checkpoint.State({}, {"x": np.arange(3)}, {"y": 1})


def make(path, config=CONFIG, checkpoints=(), ended=False, reached=None):
    """A run as a killed process leaves it, or one that has ended."""
    path.mkdir(parents=True)
    config.save(path)
    made = []
    for env_steps in checkpoints:
        state = None if ended else GOING_ON
        counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": env_steps, "updates": 1}
        made.append(checkpoint.save(path, PARAMS, config, state=state, **counts))
    rows = [{"kind": "train", "env_steps": n} for n in ([] if reached is None else [0, reached])]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return made


def go_on(path, made, wanted):
    with going_on(path, made, wanted) as begun:
        begun()


def everything(path):
    return {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}


@pytest.fixture(autouse=True)
def writes_nothing(tmp_path, monkeypatch):
    """Asking where a run goes on changes nothing."""

    def checked(ask):
        def asking(*arguments):
            before = everything(tmp_path)
            try:
                return ask(*arguments)
            finally:
                assert everything(tmp_path) == before

        return asking

    for ask in (to_resume, all_to_resume):
        monkeypatch.setitem(globals(), ask.__name__, checked(ask))


def test_there_is_nothing_to_go_on_from(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        assert to_resume(tmp_path / name, CONFIG) is None
    assert capsys.readouterr().err == ""
    make(tmp_path / "killed early", reached=103)
    assert to_resume(tmp_path / "killed early", CONFIG) is None
    assert capsys.readouterr().err.endswith("no checkpoint there yet; the run begins again\n")


def test_a_run_goes_on_from_its_newest_good_checkpoint(tmp_path, capsys):
    first, second = make(tmp_path / "run", checkpoints=(100, 200))
    assert to_resume(tmp_path / "run", CONFIG) == second
    assert to_resume(tmp_path / "run", CONFIG, 199) == first
    assert capsys.readouterr().err == ""
    (second.path / "x.npy").write_bytes(b"")
    assert to_resume(tmp_path / "run", CONFIG) == first
    line = capsys.readouterr().err
    assert line.startswith("resume: ") and "x.npy: damaged" in line and line.count("\n") == 1
    shutil.rmtree(first.path)
    with pytest.raises(ConfigError, match="x.npy: damaged.*no other checkpoint, and --overwrite would start"):
        to_resume(tmp_path / "run", CONFIG)


def test_another_configuration_is_refused_with_what_differs(tmp_path):
    make(tmp_path / "run", checkpoints=(100,))
    other = dataclasses.replace(CONFIG, seed=3, gamma=0.9)
    with pytest.raises(ConfigError) as error:
        to_resume(tmp_path / "run", other)
    assert "another configuration: seed is 0 there and 3 here, gamma is 0.99 there and 0.9 here" in str(
        error.value
    )
    # Also where somebody has changed config.json since.
    other.save(tmp_path / "run")
    with pytest.raises(ConfigError, match="000000100: of another configuration: seed is 0 there and 3 here"):
        to_resume(tmp_path / "run", other)


def test_options_that_are_newer_than_a_run_have_their_defaults(tmp_path):
    # Rainbow's options of before there were slow=, view= and others; a resolved Config has all.
    old = dataclasses.replace(CONFIG, rl="dqn:double=true,n_step=3")
    (made,) = make(tmp_path / "run", old, [100])
    runs = [(tmp_path / "run", completed(old))]
    with pytest.raises(ConfigError, match="another configuration: .*rl is dqn:double=true,n_step=3 there"):
        all_to_resume(runs)
    assert all_to_resume(runs, completed) == [made]
    other = completed(dataclasses.replace(CONFIG, rl="dqn:double=true,n_step=3,slow=ema"))
    with pytest.raises(ConfigError, match="another configuration: rl is"):
        all_to_resume([(tmp_path / "run", other)], completed)


def test_a_run_is_extended_and_says_what_depends_on_its_end(tmp_path, capsys):
    run = tmp_path / "run"
    (made,) = make(run, checkpoints=(100,))
    longer = dataclasses.replace(CONFIG, steps=CONFIG.steps + 5, lr_final_share=CONFIG.lr_final_share)
    assert to_resume(run, longer) == made
    line = capsys.readouterr().err
    assert f"--steps was {CONFIG.steps} and is {CONFIG.steps + 5}" in line and "learning rates" not in line
    with going_on(run, made, longer):
        pass
    assert Config.load(run) == CONFIG  # it has not begun
    go_on(run, made, longer)
    said = json.loads((run / "config.json").read_text())
    assert Config.load(run) == longer and said["continued"][-1]["settings"] == {"steps": longer.steps}
    with pytest.raises(ConfigError, match="^--steps=90: the run in .* has done 100 env steps already"):
        to_resume(run, dataclasses.replace(CONFIG, steps=90))
    # A run ends with a whole round of its environments.
    odd = tmp_path / "odd"
    values = dataclasses.replace(CONFIG, steps=98, num_envs=3)
    (ended,) = make(odd, values, checkpoints=(99,))
    assert to_resume(odd, values) == ended
    with pytest.raises(ConfigError, match="^--steps=96: "):
        to_resume(odd, dataclasses.replace(values, steps=96))
    # One that has ended without its replay cannot be.
    checkpoint.slim(made)
    assert to_resume(run, longer).files.keys() == {"params.msgpack"}
    with pytest.raises(ConfigError, match="has ended after 100 env steps and left no replay.*--keep_replay"):
        to_resume(run, dataclasses.replace(longer, steps=longer.steps + 1))
    # Nor one that had reached its return before its last step.
    with pytest.raises(ConfigError, match="^--stop_at_return=5.0: .* has ended after 100 env steps"):
        to_resume(run, dataclasses.replace(longer, stop_at_return=5.0))


def test_what_has_changed_since_is_said_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XLA_FLAGS", "--a")
    monkeypatch.delenv("NPROC", raising=False)
    run = tmp_path / "run"
    (made,) = make(run, checkpoints=(100,))
    began = json.loads((run / "config.json").read_text())
    assert to_resume(run, CONFIG) == made
    go_on(run, made, made.config)
    assert capsys.readouterr().err == "" and json.loads((run / "config.json").read_text()) == began

    there = {name: version for name, version in began["versions"].items() if name != "numpy"}
    (run / "config.json").write_text(json.dumps({**began, "versions": {**there, "jax": "0.1"}, "cpus": 99}))
    monkeypatch.setenv("XLA_FLAGS", "--b")
    monkeypatch.setenv("NPROC", "3")
    monkeypatch.setattr(provenance, "git_revision", lambda: "abc")
    assert to_resume(run, CONFIG) == made
    jax, numpy = (began["versions"][name] for name in ("jax", "numpy"))
    revision, cpus = began["git_revision"], began["cpus"]
    assert capsys.readouterr().err == (
        f"resume: {run}: jax was '0.1' and is {jax!r}, git_revision was {revision!r} and is 'abc', XLA_FLAGS "
        f"was '--a' and is '--b', cpus was 99 and is {cpus}, numpy was None and is {numpy!r}, NPROC was None "
        "and is '3': results may differ from those of a run that did not end\n"
    )
    with going_on(run, made, made.config) as begun:
        begun()
        with pytest.raises(ConfigError, match="is writing there"):
            to_resume(run, CONFIG)
    said = json.loads((run / "config.json").read_text())
    assert said["versions"]["jax"] == "0.1" and Config.load(run) == CONFIG
    (continued,) = said["continued"]
    changed = {"jax": jax, "git_revision": "abc", "XLA_FLAGS": "--b", "cpus": cpus, "numpy": numpy}
    assert continued["env_steps"] == 100 and continued["changed"] == changed | {"NPROC": "3"}
    # From now on that is what it is compared with, and history has both.
    assert to_resume(run, CONFIG) == made and capsys.readouterr().err == ""
    assert provenance.history(said)["jax"] == ["0.1", jax]
    monkeypatch.delenv("NPROC")
    to_resume(run, CONFIG)
    assert "NPROC was '3' and is None" in capsys.readouterr().err


def test_an_imported_file_that_has_changed_is_said_and_kept(tmp_path, capsys):
    file, run = tmp_path / "mine.py", tmp_path / "run"
    file.write_text("a = 1\n")
    begun = dataclasses.replace(CONFIG, imports=(str(file), "json.decoder"))
    (made,) = make(run, begun, checkpoints=(100,))
    then = hashlib.sha256(file.read_bytes()).hexdigest()
    assert json.loads((run / "config.json").read_text())["imported"] == {"mine.py": then}
    # Where it lies by now does not matter.
    moved = tmp_path / "elsewhere" / "mine.py"
    moved.parent.mkdir()
    file.rename(moved)
    wanted = dataclasses.replace(begun, imports=(str(moved), "json.decoder"))
    assert to_resume(run, wanted) == made and capsys.readouterr().err == ""

    moved.write_text("a = 2\n")
    now = hashlib.sha256(moved.read_bytes()).hexdigest()
    assert to_resume(run, wanted) == made
    said = f"resume: {run}: mine.py was {then!r} and is {now!r}: results may differ from those of a run that"
    assert capsys.readouterr().err == f"{said} did not end\n"
    go_on(run, made, wanted)
    (continued,) = json.loads((run / "config.json").read_text())["continued"]
    assert continued["changed"] == {"mine.py": now}
    assert to_resume(run, wanted) == made and capsys.readouterr().err == ""


def test_a_run_from_before_there_were_sums_of_files_says_nothing_of_them(tmp_path, capsys):
    (tmp_path / "mine.py").touch()
    begun = dataclasses.replace(CONFIG, imports=(str(tmp_path / "mine.py"),))
    (made,) = make(tmp_path / "run", begun, checkpoints=(100,))
    path = tmp_path / "run" / "config.json"
    about = json.loads(path.read_text())
    del about["imported"]
    path.write_text(json.dumps(about))
    assert to_resume(tmp_path / "run", begun) == made and capsys.readouterr().err == ""


def test_files_of_one_name_have_one_sum(tmp_path):
    files = [tmp_path / folder / "mine.py" for folder in "ab"]
    for file in files:
        file.parent.mkdir()
        file.write_text(file.parent.name)
    assert provenance.sums(map(str, files)) == {"mine.py": hashlib.sha256(b"ab").hexdigest()}
    assert provenance.sums([str(tmp_path / "gone.py"), "json"]) == {}


@pytest.mark.parametrize("continued", [1, [1], [{}], [{"changed": 1}]])
def test_a_history_that_is_none_is_named(tmp_path, continued):
    make(tmp_path / "run", checkpoints=(100,))
    path = tmp_path / "run" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"continued": continued}))
    with pytest.raises(
        ConfigError, match="config.json: what it says of versions is not what training writes"
    ):
        to_resume(tmp_path / "run", CONFIG)


def test_the_run_that_one_started_from_may_lie_elsewhere(tmp_path, capsys):
    begun = dataclasses.replace(CONFIG, mode="frozen", encoder_from="a/pre")
    (made,) = make(tmp_path / "run", begun, checkpoints=(100,))
    moved = dataclasses.replace(begun, encoder_from="/b/pre")
    assert to_resume(tmp_path / "run", moved) == made
    line = "--encoder_from was a/pre and is /b/pre: neither is read any more\n"
    assert capsys.readouterr().err == f"resume: {tmp_path}/run: {line}"
    # But whether there is one is no matter of its place.
    scratch = dataclasses.replace(begun, encoder_from="")
    with pytest.raises(ConfigError, match="another configuration: encoder_from is a/pre there and  here"):
        to_resume(tmp_path / "run", scratch)


def test_a_run_that_diverged_goes_on_and_it_is_said(tmp_path, capsys):
    (made,) = make(tmp_path / "run", checkpoints=(100,))
    ending.write(tmp_path / "run", NOT_FINITE)
    assert to_resume(tmp_path / "run", CONFIG) == made
    assert "ended since loss/rl is not finite after 330 env steps" in capsys.readouterr().err
    (tmp_path / "run/ended.json").write_text("{")  # nothing depends on it
    assert to_resume(tmp_path / "run", CONFIG) == made
    assert capsys.readouterr().err == ""


def test_a_run_whose_checkpoints_are_gone_is_not_begun_again(tmp_path):
    # Going on means that nothing is lost but what came after the last checkpoint.
    make(tmp_path / "run", reached=104)
    with pytest.raises(ConfigError, match="got to 104 env steps, and there is no checkpoint"):
        to_resume(tmp_path / "run", CONFIG)


# Several seeds


def seeds(tmp_path, *checkpoints, **options):
    """Runs of seeds 0, 1, ... with these checkpoints; None for a directory that was never made."""
    runs = []
    for seed, env_steps in enumerate(checkpoints):
        config = dataclasses.replace(CONFIG, seed=seed)
        if env_steps is not None:
            make(tmp_path / f"seed{seed}", config, env_steps, **options)
        runs.append((tmp_path / f"seed{seed}", config))
    return runs


@pytest.mark.parametrize(
    ("checkpoints", "env_steps"),
    [
        (((100, 200), (100, 200)), 200),
        (((200, 300), (100, 200)), 200),  # killed while the second one saved
        (((200,), (100, 200), (200, 300)), 200),
        (((100,), ()), None),  # killed while the second one saved for the first time
        (((52,), ()), None),
        (((), ()), None),
        ((None, None), None),
        (((), None), None),  # killed while directories were made
    ],
)
def test_seeds_go_on_from_the_newest_step_that_all_have(tmp_path, checkpoints, env_steps):
    found = all_to_resume(seeds(tmp_path, *checkpoints))
    assert [manifest and manifest.env_steps for manifest in found] == [env_steps] * len(checkpoints)
    for seed, manifest in enumerate(found):
        assert manifest is None or manifest.config.seed == seed


@pytest.mark.parametrize("checkpoints", [((100, 200), None), ((52,), None), ((100, 200), ()), ((104,), ())])
def test_no_seed_begins_again_for_the_sake_of_another(tmp_path, checkpoints):
    runs = seeds(tmp_path, *checkpoints)
    with pytest.raises(
        ConfigError, match="seed1: no checkpoint there to resume from, while .*seed0 has one of"
    ):
        all_to_resume(runs)
    with pytest.raises(ConfigError, match="seed1: no checkpoint there"):
        all_to_resume(runs[::-1])


def test_seeds_without_a_step_in_common_are_refused(tmp_path):
    runs = seeds(tmp_path, (300, 400), (200,), reached=300)
    with pytest.raises(ConfigError, match="seed0: the run there got to 300 env steps, and there is no check"):
        all_to_resume(runs)


def test_seeds_of_which_one_was_killed_at_its_end_go_on_from_before(tmp_path):
    runs = seeds(tmp_path, (400,), (400,))
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": 500, "updates": 1}
    checkpoint.save(runs[0][0], PARAMS, runs[0][1], **counts)
    assert [manifest.env_steps for manifest in all_to_resume(runs)] == [400, 400]
    checkpoint.save(runs[1][0], PARAMS, runs[1][1], **counts)
    found = all_to_resume(runs)
    assert [manifest.env_steps for manifest in found] == [500, 500]
    assert all(checkpoint.NUMBERS not in manifest.files for manifest in found)


# Directories


def leftovers(path, kind):
    """What a process leaves that is killed as it begins."""
    path.mkdir(parents=True)
    if kind == "lock":
        (path / "lock").write_text('{"pid": 1')
    elif kind == "half a config":
        (path / "config.json.partial").write_text('{"game": "Ca')
    elif kind == "seeds":
        (path / "seed0").mkdir()
        (path / "seed1").mkdir()
        (path / "seed0" / "lock").touch()


@pytest.mark.parametrize("kind", ["lock", "half a config", "seeds"])
@pytest.mark.parametrize("resume", [True, False])
def test_a_process_that_was_killed_as_it_began_is_in_nobodys_way(tmp_path, kind, resume):
    path = tmp_path / "run"
    leftovers(path, kind)
    assert check_out(str(path), CONFIG, overwrite=False, resume=resume) == path
    assert to_resume(path, CONFIG) is None
    with run_directory(path, CONFIG) as begun:
        begun()
        assert set(contents(path)) == {"config.json", "lock"}
    assert Config.load(path) == CONFIG


@pytest.mark.parametrize("kind", ["config", "rows", "ended", "encoder", "half a checkpoint", "seeds"])
@pytest.mark.parametrize("resume", [True, False])
def test_a_run_that_ended_before_its_first_row_is_begun_anew(tmp_path, capsys, kind, resume):
    path = tmp_path / "run"
    other = dataclasses.replace(CONFIG, gamma=0.5)
    run = path / "seed0" if kind == "seeds" else path
    make(run, other)
    if kind == "config":
        (run / "metrics.jsonl").unlink()
    elif kind == "ended":
        ending.write(run, ending.Ending("failed", 0, "RuntimeError: of the first step"))
    elif kind == "encoder":
        counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "env_steps": 0, "updates": 0}
        checkpoint.save(run, PARAMS, other, folder="encoders", keep=0, **counts)
        (run / "tensorboard").mkdir()
    elif kind == "half a checkpoint":
        (run / "checkpoints" / ".000000100.partial").mkdir(parents=True)
    assert check_out(str(path), CONFIG, overwrite=False, resume=resume) == path
    assert to_resume(run, CONFIG) is None
    assert capsys.readouterr().err == f"resume: {run}: no checkpoint there yet; the run begins again\n"
    with run_directory(run, CONFIG) as begun:
        begun()
        assert set(contents(run)) == {"config.json", "lock"}
    assert Config.load(run) == CONFIG


@pytest.mark.parametrize("kind", ["a row", "a checkpoint", "an encoder", "encoders alone", "notes", "a link"])
def test_what_a_run_has_written_is_kept(tmp_path, kind):
    path = tmp_path / "run"
    make(path, reached=0 if kind == "a row" else None)
    counts = {"frame_shape": (42, 42, 1), "num_actions": 3, "updates": 0, "keep": 0}
    if kind == "a checkpoint":
        checkpoint.save(path, PARAMS, CONFIG, env_steps=4, **counts)
    elif "encoder" in kind:
        step = 4 if kind == "an encoder" else 0
        checkpoint.save(path, PARAMS, CONFIG, env_steps=step, folder="encoders", **counts)
        if kind == "encoders alone":  # somebody keeps them to start from
            (path / "metrics.jsonl").unlink()
    elif kind == "notes":
        (path / "notes.txt").write_text("mine")
    elif kind == "a link":
        (path / "encoders").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="not empty; name a new directory"):
        check_out(str(path), CONFIG, overwrite=False, resume=False)
    if kind != "a checkpoint":
        with pytest.raises(
            ConfigError, match="another configuration: gamma .*; srl-jax resume .* takes its own"
        ):
            to_resume(path, dataclasses.replace(CONFIG, gamma=0.5))


@pytest.mark.parametrize("file", ["notes.txt", "seed0", "seed0/notes.txt", "seed1/config.json"])
def test_a_directory_with_anything_else_is_somebodys(tmp_path, file):
    path = tmp_path / "run"
    leftovers(path, "lock")
    (path / file).parent.mkdir(exist_ok=True)
    (path / file).write_text("{}")
    for options in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(ConfigError, match="not a run directory"):
            check_out(str(path), CONFIG, **options)


def test_a_linked_run_is_gone_on_with_and_not_deleted(tmp_path):
    (made,) = make(tmp_path / "disk/run", checkpoints=(100,))
    (tmp_path / "run").symlink_to(tmp_path / "disk/run")
    out = str(tmp_path / "run")
    assert to_resume(check_out(out, CONFIG, overwrite=False, resume=True), CONFIG).env_steps == made.env_steps
    with pytest.raises(ConfigError, match="--out=.*: a link, so --overwrite does not delete it; name"):
        check_out(out, CONFIG, overwrite=True, resume=False)
