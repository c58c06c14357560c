"""The loop: schedules, files and reproducibility of whole short runs on Catch."""

import json
import re
import shutil
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space

from srl_jax import loading
from srl_jax.config import Config
from srl_jax.diagnostics import heldout
from srl_jax.diagnostics.pictures import PICTURES
from srl_jax.envs.catch import Catch
from srl_jax.errors import ConfigError
from srl_jax.files import checkpoint
from srl_jax.files.metrics import read_metrics
from srl_jax.learning.modes import ENCODER_OPTIMIZERS
from srl_jax.learning.update import Hyper
from srl_jax.run import actor, loop
from srl_jax.run.schedules import Schedules, passed
from srl_jax.types import Window
from tests.helpers import JOINT, SMALL, one_run, rows_of, stop_after, whole
from tests.in_process import parse

pytestmark = pytest.mark.usefixtures("shared_agents")


def train(path, progress=False, stop=None, **values):
    options = {} if stop is None else {"stop": stop}
    path.mkdir()
    config = Config(**{**SMALL, **values})
    config.save(path)
    return loop.train(config, path, progress=progress, **options)


@pytest.fixture(scope="module")
def joint(tmp_path_factory, shared_agents):
    """One joint run that the tests below look at."""
    path = tmp_path_factory.mktemp("runs") / "joint"
    return path, train(path, **JOINT, seed=3, diagnostics=True)


def test_same_seed_same_metrics(joint, tmp_path):
    path, _ = joint
    train(tmp_path / "again", **JOINT, seed=3, diagnostics=True)
    train(tmp_path / "other", **JOINT, seed=4)

    assert rows_of(path) == rows_of(tmp_path / "again")
    assert rows_of(path) != rows_of(tmp_path / "other")
    assert files_of(path) == files_of(tmp_path / "again")
    assert {folder.name for folder in (path / "encoders").iterdir()} == {"000000000", "000000120"}


def files_of(path):
    """Every file of parameters that a run leaves, with its sha256: equal ones are bit-identical."""
    return {p.relative_to(path): checkpoint.read_manifest(p).files for p in path.glob("*/0*")}


def test_neither_timing_nor_diagnostics_change_anything(joint, tmp_path, monkeypatch):
    path, _ = joint
    rng, act_and_step, update = np.random.default_rng(0), loop.Run.act_and_step, loop.Run.update

    def slow_step(*arguments):
        time.sleep(rng.choice([0, 0.02]))
        result = act_and_step(*arguments)
        time.sleep(rng.choice([0, 0.02]))
        return result

    def slow_update(run):
        time.sleep(rng.choice([0, 0.02]))
        update(run)

    monkeypatch.setattr(loop.Run, "act_and_step", slow_step)
    monkeypatch.setattr(loop.Run, "update", slow_update)
    train(tmp_path / "again", **JOINT, seed=3)
    ours, theirs = files_of(tmp_path / "again"), files_of(path)
    assert ours == {name: sums for name, sums in theirs.items() if name.parent.name != "encoders"}
    rows, diagnosed = rows_of(tmp_path / "again"), rows_of(path)
    kept = [{key: x for key, x in row.items() if not key.startswith("diag/")} for row in diagnosed]
    assert kept == rows != diagnosed


def test_representation_losses_in_every_third_update(tmp_path, monkeypatch):
    calls = []
    make_agent = loop.make_agent

    def watched(*arguments):
        agent = make_agent(*arguments)

        def watch(name):
            def call(state, window, hyper):
                result = getattr(agent, name)(state, window, hyper)
                calls.append((name, result[2]))
                return result

            return call

        return agent._replace(update=watch("update"), update_rl=watch("update_rl"))

    monkeypatch.setattr(loop, "make_agent", watched)
    train(tmp_path / "run", **JOINT, srl_every=3)
    names = [name for name, _ in calls]
    assert names == (["update", "update_rl", "update_rl"] * 9)[: len(names)] and len(names) == 25
    rows = [r for r in read_metrics(tmp_path / "run" / "metrics.jsonl") if r["kind"] == "train"]
    # A row is five updates apart from the next; of the updates 10 to 14, only 12 has them.
    assert [row["updates"] for row in rows[2:5]] == [10, 15, 20]
    np.testing.assert_allclose(rows[3]["loss/reconstruction"], calls[12][1]["loss/reconstruction"], rtol=1e-6)
    of_rl = [float(metrics["loss/rl"]) for _, metrics in calls[10:15]]
    np.testing.assert_allclose(rows[3]["loss/rl"], np.mean(of_rl), rtol=1e-5)


def test_a_step_acts_with_the_parameters_from_before_its_updates():
    run = one_run(Config(**{**SMALL, "updates_per_step": 0.5}))
    acted, known = [], []

    def act(params, *rest):  # the state of so many updates has these parameters
        acted.append(next(i for i, x in enumerate(known) if x is params))
        return device.act(params, *rest)

    def update(*arguments):
        state, *rest = device.update(*arguments)
        known.append(state.params)
        return state, *rest

    device = run.device
    run.device = device._replace(act=act, update=update)
    known.append(run.state.params)
    for _ in range(14):
        run.step()
    run.env_threads.shutdown()
    # Two updates a step of four environments, from the step on that starts at 40.
    assert acted == [0] * 11 + [2, 4, 6] and run.updates == 8


def test_rows_of_a_run(joint):
    path, result = joint
    rows = read_metrics(path / "metrics.jsonl")
    train_rows = [row for row in rows if row["kind"] == "train"]
    assert [row["env_steps"] for row in train_rows] == [40, 80, 120, 160, 200, 240]
    assert [row["env_steps"] for row in rows if row["kind"] == "eval"] == [0, 120, 240]
    # Learning starts at 40 env steps; the step from 40 to 44 brings the first half of an update.
    # By 240 there are (240 - 40) * 0.125 = 25.
    assert result.updates == rows[-1]["updates"] == 25
    assert train_rows[0]["updates"] == 0 and "loss/rl" not in train_rows[0]
    last = train_rows[-1]
    names = {
        "loss/rl",
        "loss/reconstruction",
        "loss/latent_l2",
        "loss/total",
        "grad_norm/encoder",
        "rl/q_max_mean",
    }
    assert names | {"epsilon", "beta", "wall_steps_per_s"} <= set(last)
    # epsilon: 1 - 0.95 * 240 / 1,000,000
    assert last["epsilon"] == pytest.approx(1 - 0.95 * 240e-6)
    evaluation = rows[-1]
    assert evaluation["kind"] == "eval" and len(evaluation["eval/returns"]) == 3
    assert evaluation["eval/return_mean"] == pytest.approx(np.mean(evaluation["eval/returns"]))
    assert all(17 <= length <= 24 for length in evaluation["eval/lengths"])


def test_pictures_show_input_target_and_output(joint):
    _, result = joint
    (inputs, targets, outputs) = result.pictures["reconstruction"]
    assert inputs.shape == targets.shape == outputs.shape == (6, 42, 42, 1)
    np.testing.assert_allclose(inputs, targets, atol=1e-7)  # reconstruction's target is its input
    assert 0 <= inputs.min() and inputs.max() <= 1


def test_the_last_evaluation_was_recorded(joint):
    path, result = joint
    last = read_metrics(path / "metrics.jsonl")[-1]
    # Three games, one in each environment: the first one's frames, and the one that it began with.
    assert result.recording.dtype == np.uint8
    assert result.recording.shape == (last["eval/lengths"][0] + 1, 42, 42, 1)


def test_an_agent_comes_back_from_its_checkpoint(joint):
    path, _ = joint
    loaded = loading.load(path)
    assert (loaded.env_steps, loaded.manifest.updates) == (240, 25)
    assert set(loaded.params) == {"encoder", "rl", "reconstruction", "latent_l2"}
    assert set(loaded.agent.objectives) == {"rl", "reconstruction", "latent_l2"}


def test_a_buffer_that_cannot_be_is_refused():
    # 4 environments, and windows of 4 + 3 frames, a slot being written and a spare one: 36.
    small = Config(**{**SMALL, "buffer_size": 35, "learn_start": 0})
    with pytest.raises(ConfigError, match="--buffer_size=35: must be at least 36"):
        one_run(small)


@pytest.mark.parametrize(("eval_max_steps", "frames"), [(100, 108_000), (27_000, 108_000), (40_000, 160_000)])
def test_no_evaluation_game_is_cut_before_eval_max_steps(monkeypatch, eval_max_steps, frames):
    made = []
    monkeypatch.setattr("srl_jax.envs.make", lambda game, **options: made.append(options["max_frames"]))
    config = Config(game="Pong", eval_max_steps=eval_max_steps)
    actor.make_env(config, "eval", 1)
    actor.make_env(config, "train", 1)  # whose episodes are as long as ever
    assert made == [frames, 108_000]


def test_a_given_checkpoint_is_played_as_long_as_its_evaluations(joint, monkeypatch, capsys):
    from experiments import evaluate

    asked, make = [], actor.make_env

    def make_env(*arguments, **options):
        asked.append((arguments[1:], options))
        return make(*arguments, **options)

    monkeypatch.setattr(actor, "make_env", make_env)
    evaluate.main(parse(evaluate, f"--run={joint[0]}", "--games=1"))
    assert asked == [(("eval", 1), {"seed": 0})]
    written = capsys.readouterr()
    assert len(json.loads(written.out)["returns"]) == 1 and "cut" not in written.err

    evaluate.main(parse(evaluate, f"--run={joint[0]}", "--games=2", "--max_steps=3"))
    written = capsys.readouterr()
    assert json.loads(written.out)["lengths"] == [3, 3]
    assert "2 of the games were cut at 3 env steps" in written.err


def test_a_checkpoint_that_asks_for_what_there_is_not_is_refused_by_its_name(joint, tmp_path):
    path, _ = joint
    shutil.copytree(path, tmp_path / "copy")
    manifest = checkpoint.read_manifest(tmp_path / "copy").path / "manifest.json"
    values = json.loads(manifest.read_text())
    for change, reason in (
        ({"rl": "x"}, "no 'x'"),
        ({"encoder": "sac_ae:features=-1"}, "must not be negative"),
    ):
        checkpoint.sign(manifest.parent, {**values, "config": {**values["config"], **change}})
        with pytest.raises(ConfigError, match=f"^{re.escape(str(manifest.parent))}.*{reason}"):
            loading.load(tmp_path / "copy")


class Colour(Catch):
    """Catch with a margin on its right, in three colours: frames of 42 x 50 pixels."""

    def __init__(self, **options):
        super().__init__(**options)
        self.single_observation_space = Box(0, 255, (42, 50, 3), np.uint8)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _frames(self):
        grey = super()._frames()
        return np.concatenate([grey, grey // 2, 255 - grey], -1)


def test_a_run_in_colour_of_any_shape(tmp_path, monkeypatch):
    def make(game, *, num_envs, seed, frame_size, **options):
        return Colour(num_envs=num_envs, seed=seed, size=frame_size)

    values = {**SMALL, "steps": 120, "eval_every": 60, "diagnostics": True, "augment": "all", "mode": "joint"}
    values |= {"rl": "dqn:hidden=16", "encoder_optimizer": "summed"}  # compiled for this test alone
    config = Config(**values, objectives=("reconstruction", "forward_pixels"))
    rows = []
    with monkeypatch.context() as patched:
        patched.setattr("srl_jax.envs.make", make)
        patched.setattr(heldout, "_collect", heldout._collect.__wrapped__)  # others of this game are grey
        for path, env_steps in ((tmp_path / "whole", 1000), (tmp_path / "resumed", 60)):
            path.mkdir()
            with stop_after(env_steps) as stop:
                result = loop.train(config, path, progress=False, stop=stop)
            if result.interrupted:
                assert result.env_steps == 60
                result = loop.train(config, path, progress=False, resume=whole(path))
            rows.append(rows_of(path))
    assert rows[0] == rows[1] and rows[0][-1]["env_steps"] == 120
    # What is seen, learnt, recorded and measured has the environment's shape.
    assert result.recording.shape[1:] == (42, 50, 3)
    np.testing.assert_array_equal(result.recording[..., 0], 255 - result.recording[..., 2])
    for name in ("reconstruction", "forward_pixels"):
        inputs, targets, outputs = result.pictures[name]
        assert inputs.shape == targets.shape == outputs.shape == (PICTURES, 42, 50, 3)
        np.testing.assert_allclose(targets[..., 0], 1 - targets[..., 2], atol=1e-6)
        assert rows[0][-1][f"diag/error/{name}/moving"] > 0
    # No environment is needed to know it.
    loaded = loading.load(path)
    assert loaded.manifest.frame_shape == (42, 50, 3) and loaded.encoder.observation_shape == (42, 50, 12)
    for flag in ("policy_from", "encoder_from"):
        grey = Config(**{**SMALL, "mode": "pretrain", "objectives": ("latent_l2",), flag: str(path)})
        with pytest.raises(ConfigError, match=rf"--{flag}=.* of \[42, 50, 3\], Catch shows \[42, 42, 1\]"):
            one_run(grey, tmp_path)


def test_updates_are_compiled_once(joint):
    del joint
    run = one_run(Config(**SMALL, lr_final_share=0.5))
    (seed,) = run.seeds
    for _ in range(30):
        seed.take(*seed.step_env(np.ones(4, np.int32)))
    run.update()
    size = run.agent.update.compiled._cache_size()  # other runs of the session share the agent
    for _ in range(2):
        run.env_steps += 40  # another learning rate
        run.update()
    assert isinstance(seed.replay.sample(2, 0.5)[0], Window)
    assert run.agent.update.compiled._cache_size() == size


def test_learning_rates_fall_linearly_to_the_share_that_is_left():
    def at(env_steps, share):
        config = Config(**{**SMALL, "steps": 200, "lr_final_share": share})
        hyper = Hyper({}, {name: np.float32(rate) for name, rate in (("encoder", 0.0), ("rl", 4e-3))})
        rates = Schedules(config, hyper).at(env_steps).hyper.learning_rates
        assert all(rate.dtype == np.float32 for rate in rates.values())
        return rates

    assert at(150, 1.0) == pytest.approx({"encoder": 0.0, "rl": 4e-3})
    assert at(0, 0.2) == pytest.approx({"encoder": 0.0, "rl": 4e-3})
    assert at(150, 0.2) == pytest.approx({"encoder": 0.0, "rl": 1.6e-3})
    assert at(200, 0.2) == pytest.approx({"encoder": 0.0, "rl": 0.8e-3})


@pytest.mark.parametrize("form", ENCODER_OPTIMIZERS)
def test_a_run_makes_no_nan_on_the_way(form, tmp_path):
    # jax.debug_nans takes any NaN for a fault, a placeholder too.
    with jax.debug_nans(True):
        train(tmp_path / form, **JOINT, encoder_optimizer=form, max_grad_norm=1.0, steps=160)
    rows = read_metrics(tmp_path / form / "metrics.jsonl")
    assert any(row.get("grad_norm/encoder", 0) > 0 for row in rows)  # measured in some updates alone
    ratios = [row["step_ratio/encoder"] for row in rows if "step_ratio/encoder" in row]
    assert bool(ratios) == (form != "summed") and all(0.05 < ratio < 20 for ratio in ratios)


@pytest.mark.parametrize("num_envs", [4, 40, 64, 80])
def test_every_third_checkpoint_keeps_its_encoder_also_where_a_round_is_longer_than_between_two(num_envs):
    config, kept, saved = Config(game="Catch", num_envs=num_envs, keep_encoder_every=3), [], []
    seed = SimpleNamespace(keep=lambda parts, env_steps, updates: kept.append(env_steps))
    run = SimpleNamespace(config=config, checkpoint_every=40, updates=0, fetch=lambda: None)
    run.state, run.each = SimpleNamespace(params=None), lambda tree: [(seed, {"encoder": {}})]
    for run.env_steps in range(num_envs, 2000, num_envs):
        if passed(run.env_steps - num_envs, run.env_steps, 40):
            saved.append(run.env_steps)
            loop.Run.keep_encoders(run)
    assert kept == saved[2::3] and len(kept) > 5
