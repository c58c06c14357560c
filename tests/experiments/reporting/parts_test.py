"""experiments/reporting: what a page is made of, its numbers, pictures and settings."""

import base64
import io
import json
import shutil

import numpy as np
import pytest

from experiments.drawing import images
from experiments.runs import collect
from experiments.runs.collect import RunData
from srl_jax.config import Config
from srl_jax.run.ending import Ending
from srl_jax.training import completed
from tests.experiments.reporting.report_test import write_run

Image = pytest.importorskip("PIL.Image", reason="needs the extra plots")
pages = pytest.importorskip("experiments.reporting.page", reason="needs the extra plots")
configs, gallery, numbers, pictures = pages.configs, pages.gallery, pages.numbers, pages.gallery.pictures


def test_options_at_their_defaults_where_the_objective_is_are_no_differences():
    both = {"mode": "joint", "encoder": "tiny"}
    arms = {
        "alone": Config(game="Catch", encoder="tiny"),
        "plain": Config(game="Catch", objectives=("reconstruction",), **both),
        "heavy": Config(game="Catch", objectives=("reconstruction:weight=2,noise=0.1",), **both),
    }
    runs = [RunData("", "Catch", arm, 0, completed(config), []) for arm, config in arms.items()]
    differing, shared = configs.settings(runs, list(arms))
    assert differing["objectives reconstruction: weight"] == {"alone": "–", "plain": "1.0", "heavy": "2.0"}
    assert differing["objectives reconstruction: noise"] == {"alone": "–", "plain": "0.0", "heavy": "0.1"}
    assert {name for name in differing if ": " in name} == {
        "objectives reconstruction: weight", "objectives reconstruction: noise",
    }  # fmt: skip
    assert shared["objectives reconstruction: tied"] == "false, where the objective is"
    of_plain = configs.glossary(runs, differing, "alone")["plain"]
    assert "reconstruction weight 1.0" in of_plain and "tied" not in of_plain


def test_of_several_arms_of_rl_alone_the_one_most_like_the_others_is_the_baseline():
    arms = {
        "alone_other": Config(game="Catch", lr_rl=1e-3, batch_size=64),
        "alone": Config(game="Catch"),
        "joint": Config(game="Catch", mode="joint", objectives=("reconstruction",)),
        "joint_rate": Config(game="Catch", mode="joint", objectives=("reconstruction",), lr_rl=1e-3),
    }
    row = {"kind": "eval", "env_steps": 100, "eval/return_mean": 1.0}
    runs = [RunData("", "Catch", arm, 0, config, [row]) for arm, config in arms.items()]
    assert numbers.baseline_of(runs, list(arms)) == "alone"
    assert numbers.baseline_of(runs, list(arms), "joint") == "joint"
    two_games = [*runs, *(runs[i]._replace(game="CatchDistractor") for i in (0, 2))]
    assert numbers.baseline_of(two_games, list(arms)) == "alone_other"  # the other would be missing there
    assert numbers.baseline_of(runs[2:], list(arms)[2:]) == "joint"  # as like as the other, and the first


def test_whether_a_run_is_finished():
    def run(evals, trains, **values):
        rows = [{"kind": "eval", "env_steps": step, "eval/return_mean": 1.0} for step in evals]
        rows += [{"kind": "train", "env_steps": step} for step in trains]
        return RunData("", "Catch", "a", 0, Config(steps=250, eval_every=100, log_every=50, **values), rows)

    assert numbers.finished(run([0, 100, 200], [50, 100, 150, 200, 250]))
    assert not numbers.finished(
        run([0, 100, 200], [50, 100, 150, 200])
    )  # the last row of training is missing
    assert not numbers.finished(run([0, 100], [250]))  # the last evaluation is
    assert numbers.finished(run([0, 100], [100], stop_at_return=1.0))
    assert numbers.finished(run([], [250], mode="pretrain"))
    # One seed of several has the return that all need, and was stopped.
    stopped = run([0, 100], [100], stop_at_return=1.0)._replace(ended=Ending("stopped", 100))
    assert not numbers.finished(stopped)
    assert numbers.finished(run([0], [])._replace(ended=Ending("finished", 250)))


def test_a_performance_profile_by_hand():
    # In Catch 0 is a miss, -1, and 1 a catch, 1: these end at 0.5 and 1, and at 0.
    ends = {arm: {"at_the_end": np.array(x)} for arm, x in {"rl": [0.0, 1.0], "joint": [-1.0]}.items()}
    comparison = numbers.Comparison(100, ends, {}, None)
    games, thresholds, found = numbers.profiles({"Catch": comparison})
    assert games == ["Catch"] and thresholds[0] < 0 and thresholds[-1] == 1.0
    rl, joint = found["rl"], found["joint"]
    np.testing.assert_array_equal(rl.point, np.where(thresholds < 0.5, 1.0, 0.5 * (thresholds < 1.0)))
    np.testing.assert_array_equal(joint.point, thresholds < 0)
    # Two runs are drawn again as either one twice, or as both.
    between = (thresholds > 0.5) & (thresholds < 1)
    assert np.isnan(joint.low).all() and (rl.low[between] == 0).all() and (rl.high[between] == 1).all()


@pytest.mark.parametrize("noise", [False, True])
def test_large_pictures_are_made_smaller(tmp_path, noise):
    rng = np.random.default_rng(0)
    shape = (40, 42, 42, 3)
    frames = rng.integers(0, 256, shape, dtype=np.uint8) if noise else np.zeros(shape, np.uint8)
    frames[1] = frames[0]
    path = images.gif(frames, tmp_path / "play.gif", scale=2)
    limit = 50_000 if noise else path.stat().st_size
    found = pictures.taken(path, limit)
    with opened(found) as image:
        assert found.bytes <= limit and image.size == (84, 84)
        if noise:  # the first frames, in colour and as fast; the first of them is there twice
            assert image.info["duration"] == 140 and 1 < image.n_frames < 20
            shown = np.asarray(image.convert("RGB"))[::2, ::2].astype(int)
            assert np.abs(shown - frames[0]).mean() < 20  # of 256 colours; a grey one is 50 off
    assert pictures.taken(tmp_path / "none.gif", limit) is None


def test_many_pictures_are_made_smaller_still(tmp_path, monkeypatch):
    image = np.random.default_rng(0).random((6, 42, 42, 1), np.float32)
    run = collect.load_run(write_run(tmp_path / "rl/seed0", [0.0]))
    images.image_panel(image, image, image[::-1], run.path / "figures/reconstruction.png", "")
    shutil.copy(
        run.path / "figures/reconstruction.png", run.path / "figures/losses.png"
    )  # which a report draws
    monkeypatch.setattr(gallery, "LARGEST_PICTURE", 20_000)
    games = [numbers.Game("Catch", {"rl": [run]}, [run], True, None)]
    (shown,) = gallery.own_pictures(games)["Catch"]["png"]
    with opened(shown.picture) as image:
        assert image.format == "WEBP" and image.width == pictures.COLUMN
    larger = (run.path / "figures/reconstruction.png").stat().st_size
    assert shown.picture.bytes < larger / 1.5 and shown.picture.size == image.size


def opened(picture):
    return Image.open(io.BytesIO(base64.b64decode(picture.source.partition(",")[2])))


@pytest.mark.parametrize(("arms", "sizes"), [(0, [0]), (1, [1]), (6, [6]), (7, [4, 4]), (14, [6, 6, 4])])
def test_arms_are_drawn_in_groups_with_the_baseline(arms, sizes):
    names = [f"arm{i}" for i in range(arms)]
    found = gallery.groups(names, "arm3")
    assert [len(group) for group in found] == sizes and set(sum(found, [])) == set(names)
    assert arms < 4 or all("arm3" in group for group in found)


def test_what_a_run_went_on_under_is_said(tmp_path):
    run = write_run(tmp_path / "run")
    about = json.loads((run / "config.json").read_text())
    changed = {"jax": "1.3", "git_revision": "fedcba9876543210-dirty", "cpus": 8}
    about["continued"] = [{"env_steps": 100, "changed": changed}]
    (run / "config.json").write_text(json.dumps(about))
    found = configs.about(collect.load_run(run))
    assert found["jax"] == "1.2.3, then 1.3" and found["cpus"] == "none, then 8"
    assert found["git_revision"] == "0123456789, then fedcba9876-dirty"


def test_arms_are_in_the_order_of_their_numbers(tmp_path):
    for arm in ("weight10", "weight9", "weight100", "joint_50"):
        write_run(tmp_path / arm / "seed0", [0.0])
    assert numbers.arms_of(collect.load_runs(tmp_path)) == ["joint_50", "weight9", "weight10", "weight100"]


def test_where_curves_of_training_end_early_is_said(tmp_path):
    runs = [collect.load_run(write_run(tmp_path / f"a/seed{seed}", [0.0], seed=seed)) for seed in range(3)]
    runs[1] = runs[1]._replace(rows=runs[1].rows[:-1])  # 100 env steps of 200
    taken = {"all": runs, "whole": [runs[0], runs[2]]}
    games = {name: numbers.Game("Catch", {"a": runs}, those, True, None) for name, those in taken.items()}
    assert games["all"].cut == ["a: cut at 100 env steps, where seed 1 is"]
    assert games["whole"].cut == [] and games["whole"].sound == taken["whole"]


def test_a_picture_of_a_readme_may_have_any_name(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "größe 1.png")
    (tmp_path / "README.md").write_text("# A\n\n![x](größe%201.png)\n", encoding="utf-8")
    assert pages.readme.read(tmp_path).pictures == [tmp_path / "größe 1.png"]
    (tmp_path / "README.md").write_text("\ufeff# A\n\n![x](a%00.png)\n", encoding="utf-8")
    found = pages.readme.read(tmp_path)
    assert found.title == "A" and found.pictures == []


def test_a_run_that_starts_from_a_best_checkpoint_starts_from_its_arm():
    for below in ("", "/best", "/best/000000100", "/encoders/000000100", "/checkpoints"):
        assert collect.source_arm(f"runs/Catch/pretrain/seed0{below}") == "pretrain"
