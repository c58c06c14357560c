"""Several seeds in one process are the runs that they would be alone."""

import numpy as np
import pytest

from srl_jax.config import Config
from srl_jax.errors import ConfigError, Diverged
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics
from srl_jax.run import ending, loop
from srl_jax.run.loop import train_seeds
from tests.helpers import rows_of, stop_after

pytestmark = pytest.mark.usefixtures("shared_agents")

CONFIG = dict(
    game="Catch", mode="joint", frame_size=42, encoder="tiny:features=8", objectives=("inverse",), num_envs=2,
    rl="rainbow:hidden=8,atoms=5,v_min=-1,v_max=1,dueling=false", buffer_size=200, batch_size=4,
    updates_per_step=0.25, learn_start=40, steps=120, eval_every=60, eval_games=2, log_every=20,
    slow_update_every=4, srl_every=2,
    reset="all", reset_every=60, n_anneal="3->1@5", gamma=0.99, gamma_anneal="0.9->0.99@5", weight_decay=0.1,
)  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def runs(path, shared_agents):
    """(rows of seeds 7 and 3 together, rows of seed 3 alone)."""
    for name in ("s7", "s3", "alone"):
        (path / name).mkdir()
    results = train_seeds(Config(**CONFIG), [7, 3], [path / "s7", path / "s3"], progress=False)
    alone = loop.train(Config(**CONFIG, seed=3), path / "alone", progress=False)
    assert [r.updates for r in results] == [alone.updates] * 2 == [20, 20]
    assert all((path / name / "checkpoints").is_dir() for name in ("s7", "s3"))
    return [read_metrics(path / name / "metrics.jsonl") for name in ("s7", "s3", "alone")]


def test_a_seed_in_company_is_the_seed_alone(runs):
    _, together, alone = runs
    assert [row["kind"] for row in together] == [row["kind"] for row in alone]
    for ours, theirs in zip(together, alone, strict=True):
        assert ours.keys() == theirs.keys()
        for name in ours:
            if not name.startswith("wall_") and name != "checkpoint":
                # Products are summed in another order; actions, and so what is seen, are the same here.
                close = dict(rtol=2e-3, atol=1e-5, err_msg=name)
                if isinstance(ours[name], str) or ours[name] is None:
                    assert ours[name] == theirs[name]
                else:
                    np.testing.assert_allclose(ours[name], theirs[name], **close)
    assert any("loss/inverse" in row for row in together)


def test_seeds_differ(runs):
    first, second, _ = runs
    losses = [[row["loss/rl"] for row in rows if "loss/rl" in row] for rows in (first, second)]
    assert len(losses[0]) == len(losses[1]) > 2
    assert not np.allclose(*losses)


def test_seeds_that_are_stopped_and_go_on_are_those_that_were_not(runs, path, tmp_path):
    steps = 70  # in an evaluation; of one seed, resume_test.py stops everywhere
    outs = [tmp_path / "s7", tmp_path / "s3"]
    for out in outs:
        out.mkdir()
    train = lambda **options: train_seeds(Config(**CONFIG), [7, 3], outs, progress=False, **options)  # noqa: E731
    with stop_after(steps) as stop:
        results = train(stop=stop)
    assert [(r.interrupted, r.env_steps) for r in results] == [(True, steps)] * 2
    manifests = [checkpoint.newest_good(out, pytest.fail) for out in outs]
    assert [(m.env_steps, m.config.seed) for m in manifests] == [(steps, 7), (steps, 3)]
    results = train(resume=manifests)
    assert [(r.interrupted, r.updates) for r in results] == [(False, 20)] * 2
    for out in outs:
        assert rows_of(tmp_path / out.name) == rows_of(path / out.name)
        ours, theirs = (checkpoint.read_manifest(folder / out.name).files for folder in (tmp_path, path))
        assert ours == theirs  # the same sums: parameters are bit-identical


def test_a_seed_keeps_what_it_can_go_on_from_until_all_have_ended(tmp_path, monkeypatch):
    outs = [tmp_path / "s7", tmp_path / "s3"]
    for out in outs:
        out.mkdir()
    slim, there = checkpoint.slim, []

    def slimming(manifest):
        there.append([(out / "checkpoints" / "000000120").exists() for out in outs])
        return slim(manifest)

    monkeypatch.setattr(checkpoint, "slim", slimming)
    train_seeds(Config(**CONFIG, diagnostics=False), [7, 3], outs, progress=False)
    assert there == [[True, True]] * 2


@pytest.mark.parametrize(
    "error",
    [ConfigError("had enough"), Diverged("loss/rl is not finite; so"), KeyboardInterrupt()],
    ids=["error", "diverged", "ctrl-c"],
)
def test_a_seed_that_ends_early_ends_all(tmp_path, monkeypatch, error):
    original = loop.Run.update

    def update(self):
        original(self)
        if self.updates == 3:
            if isinstance(error, Diverged):
                error.run = self.seeds[1].out
            raise error

    monkeypatch.setattr(loop.Run, "update", update)
    outs = [tmp_path / "a", tmp_path / "b"]
    for out in outs:
        out.mkdir()
    changes = {"mode": "rl_only", "objectives": (), "srl_every": 1, "checkpoint_every": 40}
    changes["diagnostics"] = False
    config = Config(**CONFIG | changes)
    run = lambda: train_seeds(config, [0, 1], outs, progress=False)  # noqa: E731
    if not isinstance(error, KeyboardInterrupt):
        with pytest.raises(type(error), match=str(error)):
            run()
        if isinstance(error, Diverged):  # the other one has done nothing wrong
            endings = [ending.read(out) for out in outs]
            assert [x.status for x in endings] == ["stopped", "diverged"]
            assert endings[1].reason == "loss/rl is not finite"
        return
    assert [result.interrupted for result in run()] == [True, True]
    manifests = [checkpoint.newest_good(out, pytest.fail) for out in outs]
    assert [m.env_steps for m in manifests] == [40, 40]  # the last one of both
