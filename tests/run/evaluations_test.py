"""srl_jax/run/evaluations.py: the games after the last env step, whatever ends a run meanwhile."""

import dataclasses
import json
import threading
import time

import pytest

from experiments import evaluate
from srl_jax import loading
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.resuming import all_to_resume, has_ended
from srl_jax.run import ending, evaluations, loop
from srl_jax.run.actor import seed_for
from srl_jax.run.evaluations import FINAL, games
from tests.helpers import SMALL, agent_of, rows_of, stop_after
from tests.in_process import parse

pytestmark = pytest.mark.usefixtures("shared_agents")

CONFIG = Config(**SMALL | {"steps": 120, "eval_every": 60, "eval_games": 2}, final_games=5, eval_envs=3)


def train(path, config=CONFIG, **options):
    if not path.exists():
        path.mkdir()
        config.save(path)
    return loop.train(config, path, progress=False, **options)


def resume(path, config=CONFIG, **options):
    return train(path, config, resume=checkpoint.newest_good(path, pytest.fail), **options)


def kinds(path):
    return [(row["kind"], row["env_steps"]) for row in rows_of(path) if row["kind"] != "train"]


def files(path):
    """{checkpoint: its files and their sums}."""
    return {p.name: checkpoint.read_manifest(p).files for p in sorted((path / "checkpoints").iterdir())}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, shared_agents):
    """A run that nobody stops."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    assert not train(path).interrupted
    return path


def test_the_games_are_a_function_of_the_seed_the_kind_and_the_moment():
    final, curve = games(CONFIG, FINAL, 120), games(CONFIG, "eval", 120)
    assert final[:3] == (5, 3, seed_for(0, "final", 120)) and curve[:3] == (2, 2, seed_for(0, "eval", 120))
    assert games(dataclasses.replace(CONFIG, eval_envs=9), FINAL, 120).at_once == 5


def test_a_run_ends_with_the_row_of_its_final_games(whole):
    assert kinds(whole) == [("eval", 0), ("eval", 60), ("eval", 120), ("final", 120)]
    row = rows_of(whole)[-1]
    returns, lengths = row["final/returns"], row["final/lengths"]
    assert len(returns) == len(lengths) == row["final/games"] == 5
    mean = sum(returns) / 5
    assert row["final/return_mean"] == pytest.approx(mean)
    assert row["final/return_std"] == pytest.approx((sum((x - mean) ** 2 for x in returns) / 4) ** 0.5)
    assert row["final/return_median"] == sorted(returns)[2]
    assert row["final/length_mean"] == pytest.approx(sum(lengths) / 5)
    assert ending.read(whole) == ("finished", 120, "")
    assert all(set(own) == {"params.msgpack"} for own in files(whole).values()) and len(files(whole)) == 2


def test_the_games_can_be_played_again(whole, monkeypatch, capsys):
    def play(*arguments, run=whole):
        evaluate.main(parse(evaluate, run, "--final", *arguments, positional="run"))

    monkeypatch.setattr(loading, "make_agent", lambda *of, trained: agent_of(*of))
    play()
    played, row = json.loads(capsys.readouterr().out), rows_of(whole)[-1]
    assert (played["returns"], played["lengths"]) == (row["final/returns"], row["final/lengths"])
    for given in ("--games=3", "--envs=1", "--seed=5", "--epsilon=0.5"):
        with pytest.raises(ConfigError, match=f"{given}: given beside --final"):
            play(given)
    before = whole / "checkpoints/000000060"
    with pytest.raises(ConfigError, match=f"^--final: no final games were played by {before}; "):
        play(run=before)


def test_nothing_else_of_a_run_depends_on_its_final_games(whole, tmp_path):
    train(tmp_path / "run", dataclasses.replace(CONFIG, final_games=0))
    assert rows_of(tmp_path / "run") == rows_of(whole)[:-1]
    assert files(tmp_path / "run") == files(whole)


def during(monkeypatch, do, kind=FINAL, moments=(40, 120)):
    """Has something done before the first step of the evaluation of a moment, at the end of a run."""
    evaluate, own = evaluations.evaluate, {games(CONFIG, kind, steps).seed for steps in moments}

    def play(policy, env, *, seed, stop, **options):
        if seed in own:
            do(stop)
        return evaluate(policy, env, seed=seed, stop=stop, **options)

    monkeypatch.setattr(evaluations, "evaluate", play)


class Endless:
    """What takes as long as anybody waits for it.

    Attributes:
        begun: whether it has begun; a run's `stop`.
    """

    def __init__(self):
        self._event = threading.Event()
        self.begun = self._event.is_set

    def __call__(self, stop):
        self._event.set()
        while not stop():
            time.sleep(0.01)


@pytest.mark.parametrize("kind", ["eval", FINAL])
def test_a_stop_is_obeyed_at_once_and_the_row_is_the_same_later(whole, tmp_path, monkeypatch, kind):
    path, endless = tmp_path / "run", Endless()
    with monkeypatch.context() as patch:
        during(patch, endless, kind)
        result = train(path, stop=endless.begun)
    assert result.interrupted and result.env_steps == result.saved == 120
    assert ending.read(path) == ("stopped", 120, "")
    assert kinds(path)[-1] == ("eval", 60 if kind == "eval" else 120)
    manifest = checkpoint.read_manifest(path)
    assert "run.json" in manifest.files and not has_ended(path, manifest, CONFIG)
    assert not resume(path).interrupted
    assert rows_of(path) == rows_of(whole) and files(path) == files(whole)
    assert has_ended(path, checkpoint.read_manifest(path), CONFIG)


def test_a_stop_is_obeyed_while_a_row_waits_for_an_evaluation(whole, tmp_path, monkeypatch):
    path = tmp_path / "run"
    with monkeypatch.context() as patch, stop_after(76, times=3) as stop:
        during(patch, Endless(), "eval", [60])
        result = train(path, stop=stop)
    assert result.interrupted and result.env_steps == result.saved == 76  # a row is due after 80
    assert not resume(path).interrupted
    assert rows_of(path) == rows_of(whole)


def test_a_run_that_is_killed_meanwhile_plays_them_again(whole, tmp_path, monkeypatch):
    def killed(stop):
        raise RuntimeError("killed")

    path = tmp_path / "run"
    with monkeypatch.context() as patch:
        during(patch, killed)
        with pytest.raises(RuntimeError, match="killed"):
            train(path)
    trained = []
    with monkeypatch.context() as patch:
        patch.setattr(loop.Run, "step", lambda run: trained.append(run))
        resume(path)
    assert not trained and rows_of(path) == rows_of(whole) and files(path) == files(whole)


def test_an_extended_run_plays_them_at_its_new_end(tmp_path, monkeypatch):
    longer = dataclasses.replace(CONFIG, steps=160, keep_replay=True, loggers=("csv",))
    train(tmp_path / "whole", longer)
    path, shorter = tmp_path / "run", dataclasses.replace(longer, steps=120)
    train(path, shorter)
    manifest = checkpoint.read_manifest(path)
    assert has_ended(path, manifest, shorter) and not has_ended(path, manifest, longer)
    assert kinds(path)[-1] == ("final", 120)
    resume(path, longer)
    assert rows_of(path) == rows_of(tmp_path / "whole") and kinds(path)[-1] == ("final", 160)
    # Loggers have what was: the games of the first end, too, and no row is left out.
    steps = [line.partition(",")[0] for line in (path / "metrics.csv").read_text().splitlines()[1:]]
    assert steps == ["0", "40", "60", "80", "120", "120", "120", "160", "160"]


def test_a_return_that_ends_a_run_early_is_followed_by_them(tmp_path, monkeypatch):
    config = dataclasses.replace(CONFIG, stop_at_return=-1.0)  # which every policy reaches
    path, endless = tmp_path / "run", Endless()
    with monkeypatch.context() as patch:
        during(patch, endless)
        result = train(path, config, stop=endless.begun)
    assert result.interrupted and result.env_steps == 40
    resume(path, config)
    assert kinds(path) == [("eval", 0), ("final", 40)]


def test_seeds_of_one_process_each_have_their_own(tmp_path):
    config, outs = dataclasses.replace(CONFIG, steps=60, keep_replay=True), [tmp_path / "a", tmp_path / "b"]
    for out in outs:
        out.mkdir()
        config.save(out)
    loop.train_seeds(config, [0, 1], outs, progress=False)
    assert [kinds(out)[-1] for out in outs] == [("final", 60)] * 2
    first, second = (rows_of(out)[-1]["final/lengths"] for out in outs)
    assert first != second


def test_of_seeds_of_which_one_had_ended_both_resume_from_before(tmp_path, monkeypatch):
    config, outs = dataclasses.replace(CONFIG, checkpoint_every=40), [tmp_path / "a", tmp_path / "b"]
    runs = [(out, dataclasses.replace(config, seed=i)) for i, out in enumerate(outs)]
    for out, own in runs:
        out.mkdir()
        own.save(out)
    save = checkpoint.save

    def killed(run, *arguments, **options):
        if run == outs[1] and options["env_steps"] == 120 and not options.get("state"):
            raise RuntimeError("killed")
        return save(run, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", killed)
        with pytest.raises(RuntimeError, match="killed"):
            loop.train_seeds(config, [0, 1], outs, progress=False)
    ends = [checkpoint.read_manifest(out) for out in outs]
    assert [("run.json" in end.files, end.env_steps) for end in ends] == [(False, 120), (True, 120)]
    before = [rows_of(out) for out in outs]
    found = all_to_resume(runs)
    assert [(m.env_steps, "run.json" in m.files) for m in found] == [(80, True)] * 2
    loop.train_seeds(config, [0, 1], outs, progress=False, resume=found)
    assert [rows_of(out) for out in outs] == before


def test_a_run_without_a_policy_has_none(tmp_path):
    config = dataclasses.replace(CONFIG, mode="pretrain", objectives=("latent_l2",), steps=60)
    train(tmp_path / "run", config)
    assert {kind for kind, _ in kinds(tmp_path / "run")} <= {"eval"}
