"""Tests of experiments.arms."""

import json

import pytest

from experiments import arms
from experiments.presets import PRESETS
from srl_jax.errors import ConfigError


def test_the_thesis_figures_have_the_thesis_arms():
    # Digest of the thesis: figures 6.1 to 6.5 and A.1, each against RL alone.
    assert {name: [arm.name for arm in figure.arms] for name, figure in arms.FIGURES.items()} == {
        "6.1": ["rl_only_nature", "finetuned_from_rl_nature", "finetuned_256_aug", "frozen_256"],
        "6.2": ["rl_only_nature", "rl_only_256", "rl_only_256_aug"],
        "6.3": ["rl_only_nature", "joint_256", "joint_50"],
        "6.4": ["rl_only_nature", "joint_256", "joint_256_l2_aug", "joint_256_noreg"],
        "6.5": ["rl_only_nature", "joint_256", "joint_forward_256", "joint_forward_256_aug"],
        "A.1": ["rl_only_nature", "joint_from_pretrained_256"],
    }


@pytest.mark.parametrize("figure", arms.FIGURES.values(), ids=arms.FIGURES)
def test_arms_have_a_preset_for_every_kind_of_game(figure):
    for arm in figure.arms:
        assert arm.preset_for("Pong") == f"thesis/{arm.name}" and arm.preset_for("Pong") in PRESETS
        assert arm.preset_for("CatchDistractor") == f"small/{arm.name}" in PRESETS


def test_the_curve_of_the_thesis_is_the_figures_own():
    rl_only, joint = arms.FIGURES["6.3"].arms[:2]
    steps, returns = joint.thesis_curve("Pong")
    assert steps[:4].tolist() == [0, 100_000, 200_000, 300_000]
    assert returns[:4].tolist() == [-21.0, -21.0, -20.0, -11.4]
    assert rl_only.thesis_curve("Seaquest") is None and joint.thesis_curve("Catch") is None


def test_figures_are_asked_for_by_name():
    assert [f.name for f in arms.figures_named("all")] == list(arms.FIGURES)
    assert [f.name for f in arms.figures_named("6.5,6.3,6.5")] == ["6.5", "6.3"]
    with pytest.raises(ConfigError, match=r"^--figure=6\.9: did you mean 6"):
        arms.figures_named("6.9")


GOOD = {
    "name": "mine",
    "arms": [
        {"name": "a", "preset": "catch/joint"},
        {
            "name": "b",
            "preset": "catch/joint",
            "flags": {"srl_every": 4, "objective": ["x", "y"]},
            "thesis": "6.3/joint_50",
        },
    ],
}


def test_an_arm_may_have_any_flag_of_training(tmp_path):
    flags = {"protocol": "machado", "tune_runtime": "off", "life_loss": False}
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"name": "mine", "arms": [{"name": "a", "preset": "demo", "flags": flags}]}))
    (figure,) = arms.figures_named(str(path))
    assert figure.arms[0].flags == flags | {"life_loss": "false"}


def test_a_figure_of_ones_own(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(GOOD))
    (figure,) = arms.figures_named(str(path))
    assert (figure.name, figure.title, figure.question) == ("mine", "mine", "")
    a, b = figure.arms
    assert a.preset_for("Pong") == "catch/joint" and a.thesis_curve("Pong") is None
    assert b.flags == {"srl_every": "4", "objective": ("x", "y")}
    assert b.thesis_curve("Pong")[1][3] == -16.5


@pytest.mark.parametrize(
    "change, told",
    [
        ({"name": "../x"}, "name '../x': up to 100 letters"),
        ({"name": "x" * 101}, f"name '{'x' * 101}': up to 100 letters"),
        ({"arms": []}, "the figure has no 'arms'"),
        ({"arm": []}, "the figure has no 'arm'; did you mean arms?"),
        ({"title": 3}, "title of the figure is not of type str"),
        ({"arms": ["a"]}, "arm 1 is not a JSON object"),
        ({"arms": [{"name": "a"}]}, "arm 1 has no 'preset'"),
        (
            {"arms": [{"name": "a", "preset": "catch/join"}]},
            "arm 1: no preset catch/join: did you mean catch/joint",
        ),
        ({"arms": [GOOD["arms"][0]] * 2}, "two arms have the same name"),
        (
            {"arms": [{**GOOD["arms"][0], "thesis": "6.3/joint_265"}]},
            "arm 1: the thesis has no curve 6.3/joint_265; did you mean 6.3/joint_256",
        ),
        (
            {"arms": [{**GOOD["arms"][0], "flags": {"srl_evry": 4}}]},
            "arm 1: no flag 'srl_evry'; did you mean srl_every",
        ),
        (
            {"arms": [{**GOOD["arms"][0], "flags": {"lr": 1}}]},
            "arm 1: no flag 'lr'; did you mean lr_encoder or lr_encoder_srl or lr_final_share or lr_rl or",
        ),
        ({"arms": [{**GOOD["arms"][0], "flags": {"qqq": 1}}]}, "arm 1: no flag 'qqq'; srl-jax train"),
        (
            {"arms": [{**GOOD["arms"][0], "flags": {"lr_rl": ["1e-3", "1e-4"]}}]},
            "arm 1: --lr_rl is given 2 times; give it once",
        ),
        (
            {"arms": [{**GOOD["arms"][0], "flags": {"srl_every": None}}]},
            "flag srl_every of arm 1: not a text",
        ),
    ],
)
def test_a_bad_figure_is_refused_by_name(tmp_path, change, told):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(ConfigError) as error:
        arms.figures_named(str(path))
    assert str(error.value).startswith(f"--figure={path}: {told}") and "\n" not in str(error.value)


def test_a_flag_that_there_was_is_answered_with_the_new_way(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({**GOOD, "arms": [{**GOOD["arms"][0], "flags": {"n_step": 5}}]}))
    with pytest.raises(ConfigError, match="arm 1: --n_step is now --rl=:n_step=..."):
        arms.read_figure(path)


def test_no_file_and_no_json_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        arms.figures_named(str(tmp_path / "none.json"))
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(ConfigError, match="not JSON"):
        arms.figures_named(str(tmp_path / "bad.json"))
