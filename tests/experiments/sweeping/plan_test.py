"""experiments/sweeping/plan.py, and the configurations that its runs have."""

import pytest

from experiments.presets import PRESETS
from experiments.sweeping import manifest, plan
from experiments.sweeping.plan import Arm, Planned, arm_of
from srl_jax.errors import ConfigError


def test_what_a_run_starts_from_is_planned_once_and_before_it():
    arms = [arm_of("small/frozen_256"), arm_of("small/joint_from_pretrained_256"), arm_of("small/joint_256")]
    runs = plan.plan(arms, ["Catch"], [0, 1], {"steps": "1000"})
    names = [run.name.split("/")[1:] for run in runs]
    one = ["rl_only_nature", "pretrain_256", "frozen_256", "joint_from_pretrained_256", "joint_256"]
    assert names == [[arm, f"seed{seed}"] for seed in (0, 1) for arm in one]
    by_name = {run.name: run for run in runs}
    frozen = by_name["Catch/frozen_256/seed1"]
    assert frozen.encoder_from == "Catch/pretrain_256/seed1" and frozen.policy_from == ""
    assert by_name["Catch/pretrain_256/seed1"].policy_from == "Catch/rl_only_nature/seed1"
    assert frozen.flags == {"game": "Catch", "seed": "1", "steps": "1000"}
    # Pretraining is 1.5 of the thesis' 5 million env steps.
    assert by_name["Catch/pretrain_256/seed1"].flags["steps"] == "300"
    assert by_name["Catch/joint_256/seed0"].sources == []


def test_an_arm_may_be_the_source_of_another():
    arms = [arm_of("small/frozen_256"), Arm("pretrain_256", "small/pretrain_256", {"steps": "77"})]
    runs = {run.name: run for run in plan.plan(arms, ["Catch"], [3], {"gamma": "0.9"})}
    assert len(runs) == 3
    assert runs["Catch/pretrain_256/seed3"].flags == {
        "game": "Catch", "seed": "3", "steps": "77", "gamma": "0.9",
    }  # fmt: skip
    # In another mode it needs no encoder.
    (alone,) = plan.plan([Arm("a", "small/frozen_256", {"mode": "rl_only"})], [], [0])
    assert alone == Planned("Pong/a/seed0", "small/frozen_256", alone.flags) or alone.sources == []


def test_what_a_process_elsewhere_imports_is_named_absolutely(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("")
    flags = {"import": ("mine",), "logger": ("csv,mine.py:Mine", "wandb:project=a")}
    (run,) = plan.plan([arm_of("small/joint_256")], ["Catch"], [0], flags)
    assert run.flags["import"] == (f"{tmp_path}/mine.py",)
    assert run.flags["logger"] == ("csv", f"{tmp_path}/mine.py:Mine", "wandb:project=a")
    assert manifest.parsed(run)[0].loggers == run.flags["logger"]
    (run,) = plan.plan([arm_of("small/joint_256")], ["Catch"], [0], {"logger": "none"})
    assert run.flags["logger"] == ("none",) and manifest.parsed(run)[0].loggers == ()


@pytest.mark.parametrize(
    "arms, games, flags, says",
    [
        ([Arm("a", "small/joint_256"), Arm("a", "small/joint_50")], [], {}, "arm a: there twice"),
        ([arm_of("small/joint_256"), arm_of("thesis/joint_256")], [], {}, "joint_256: there twice"),
        ([arm_of("small/frozen_256"), Arm("pretrain_256", "small/joint_256")], [], {}, "another name"),
        ([arm_of("small/nope")], [], {}, "small/nope: did you mean"),
        ([arm_of("catch/rl_only+gate/sum")], [], {}, "arm rl_only_sum: .*: gate/sum: in --mode=rl_only RL"),
        ([Arm("../x", "small/joint_256")], [], {}, "letters, digits"),
        ([Arm("x.broken-1", "small/joint_256")], [], {}, "moved aside"),
        ([Arm("a", "small/joint_256", {"seed": "3"})], [], {}, "arm a: --seed"),
        ([arm_of("small/joint_256")], ["Pang"], {}, "--games=Pang: did you mean Pong"),
        ([arm_of("small/joint_256")], [], {"encoder_from": "x"}, "--encoder_from"),
        ([arm_of("small/frozen_256")], [], {"steps": "many"}, "--steps=many"),
        ([Arm("a", "small/joint_256", {"lr_rl": "1"})], [], {"lr_rl": "2"}, "--lr_rl: arm a has its own"),
    ],
)
def test_what_cannot_be_planned(arms, games, flags, says):
    with pytest.raises(ConfigError, match=says):
        plan.plan(arms, games, [0], flags)


def test_seeds():
    assert plan.parse_seeds("3") == [0, 1, 2]
    assert plan.parse_seeds("0,3,7") == [0, 3, 7]
    assert plan.parse_seeds("3,") == [3]
    for text in ("0", "", ",", "1,1", "x", "-1", "-1,2", "1,,2", "1.5", "100000"):
        with pytest.raises(ConfigError, match="--seeds="):
            plan.parse_seeds(text)


def test_games_with_options_have_directories_of_their_own():
    games = ["Pong", "catch:ball=1", "catch:background=moving"]
    runs = plan.plan([arm_of("small/joint_256")], games, [0])
    assert [(run.name, run.flags["game"]) for run in runs] == [
        ("Pong/joint_256/seed0", "Pong"),
        ("catch_ball=1_background=none/joint_256/seed0", "catch:ball=1,background=none"),
        ("CatchDistractor/joint_256/seed0", "CatchDistractor"),
    ]
    with pytest.raises(ConfigError, match="--games=gymnasium:id=a/b-v0,.* of gymnasium:id=a:b-v0,.* do"):
        plan.plan([arm_of("small/joint_256")], ["a:b-v0", "gymnasium:id=a/b-v0"], [0])


def test_patterns_name_presets():
    assert plan.presets(["small/joint_5*", "catch/joint"]) == ["small/joint_50", "catch/joint"]
    assert len(plan.presets(["thesis/*"])) == sum(name.startswith("thesis/") for name in PRESETS)
    with pytest.raises(ConfigError, match="--presets=Small/joint_256x: did you mean small/joint_256"):
        plan.presets(["catch/*", "Small/joint_256x"])


def test_a_command_line_is_the_runs_own():
    run = Planned(
        "Catch/a/seed2",
        "small/frozen_256",
        {"game": "Catch", "seed": "2", "objective": (), "rl": "rainbow"},
        "Catch/b/seed2",
    )
    line = plan.command(run)
    assert line[1:3] == ["-m", "experiments.train"]
    assert line[3:] == [
        "--preset=small/frozen_256", "--game=Catch", "--seed=2", "--objective=none", "--rl=rainbow",
        "--encoder_from=Catch/b/seed2", "--out=Catch/a/seed2", "--resume=auto",
    ]  # fmt: skip


def test_configurations_are_those_that_training_writes():
    flags = {"encoder": "tiny:features=8", "objective": ("forward_pixels", "latent_l2"), "rl": ":n_step=2"}
    (run,) = plan.plan([Arm("a", "small/joint_256", flags)], ["CatchDistractor"], [4], {"steps": "500"})
    ((_, config),) = manifest.resolve([run]).values()
    assert (config.game, config.seed, config.steps) == ("CatchDistractor", 4, 500)
    assert [text.split(",")[0] for text in config.objectives] == [
        "forward_pixels:weight=1.0",
        "latent_l2:weight=1e-06",
    ]
    assert "n_step=2" in config.rl and config.encoder.startswith("tiny:features=8")
    assert config.checkpoint_every == config.eval_every  # resolved


@pytest.mark.parametrize(
    "arm, says",
    [
        (
            Arm("a", "small/joint_256", {"stepz": "3"}),
            "Catch/a/seed0: --stepz: no such flag; did you mean --steps",
        ),
        (Arm("a", "small/joint_256", {"steps": "0"}), "Catch/a/seed0: --steps=0: must be at least 1"),
        (Arm("a", "small/rl_only_256", {"objective": ("x",)}), "runs no representation loss"),
        (Arm("a", "small/joint_256", {"objective": ("x",)}), "Catch/a/seed0: --objective=x"),
        (
            Arm("a", "small/frozen_256", {"encoder": "tiny:features=9"}),
            "cannot start from Catch/pretrain_256",
        ),
    ],
)
def test_settings_that_cannot_be_run_name_the_run(arm, says):
    with pytest.raises(ConfigError, match=says):
        manifest.resolve(plan.plan([arm], ["Catch"], [0]))


def test_a_flag_for_every_run_need_not_be_read_by_each():
    arms = [Arm("frozen_256", "small/frozen_256"), Arm("joint", "catch/joint")]

    def planned(flags, *arms):
        return manifest.resolve(plan.plan(arms, ["Catch"], [0], {"encoder": "tiny:features=8", **flags}))

    found = planned({"lr_srl": "0.5"}, *arms)
    given = {
        name.split("/")[1]: (entry.run.flags.get("lr_srl"), entry.config.lr_srl)
        for name, entry in found.items()
    }
    read, unread = ("0.5", 0.5), (None, 1e-4)
    assert given == {"rl_only_nature": unread, "pretrain_256": read, "frozen_256": unread, "joint": read}
    for flags, of_one in (
        ({"srl_every": "2"}, {}),
        ({}, {"lr_srl": "0.5"}),
    ):  # no run reads it; one has it alone
        with pytest.raises(
            ConfigError, match="^Catch/[a-z0-9_]+/seed0: --(srl_every|lr_srl)=.*: nothing reads it"
        ):
            planned(flags, arms[0]._replace(flags=of_one))


def test_arms_of_the_same_settings_are_told(capsys):
    a, same, other = (
        Arm(name, "catch/rl_only", {"lr_rl": x}) for name, x in (("a", "1"), ("same", "1.0"), ("c", "2"))
    )
    manifest.resolve(plan.plan([a, same, other], ["Catch"], [0, 1]))
    assert capsys.readouterr().err.splitlines() == [
        f"Catch/a/{seed} and Catch/same/{seed} have the same settings, so that both will be the same run"
        for seed in ("seed0", "seed1")
    ]


def test_a_grid_is_an_arm_for_each_combination():
    arms = plan.grid(
        [Arm("a", "catch/joint"), Arm("b", "catch/rl_only")], ["lr_rl=1e-4, 3e-4", "rl=:n_step=1;dqn"], {}
    )
    assert [arm.name for arm in arms][:4] == [
        "a_lr_rl=1e-4_rl=n_step=1", "a_lr_rl=1e-4_rl=dqn", "a_lr_rl=3e-4_rl=n_step=1", "a_lr_rl=3e-4_rl=dqn",
    ]  # fmt: skip
    assert len(arms) == 8 and arms[4].preset == "catch/rl_only"
    assert arms[0].flags == {"lr_rl": "1e-4", "rl": ":n_step=1"}
    runs = plan.plan(arms[:4], [], [0], {})
    entries = manifest.resolve(runs)
    assert {(config.lr_rl, config.rl.split(":")[0]) for _, config in entries.values()} == {
        (lr, rl) for lr in (1e-4, 3e-4) for rl in ("rainbow", "dqn")
    }
    assert plan.grid(arms[:1], [], {}) == arms[:1]
    # What an arm starts from has the values that it has itself, where that is an arm, too.
    pair = [arm_of("small/pretrain_256"), arm_of("small/frozen_256")]
    runs = {run.name: run for run in plan.plan(plan.grid(pair, ["batch_size=8,16"], {}), ["Catch"], [0])}
    for size in (8, 16):
        frozen = runs[f"Catch/frozen_256_batch_size={size}/seed0"]
        assert frozen.encoder_from == f"Catch/pretrain_256_batch_size={size}/seed0"
    arms = plan.grid([Arm("a", "catch/rl_only")], ["protocol=thesis,machado"], {})
    entries = manifest.resolve(plan.plan(arms, [], [0], {}))
    assert [config.eps_eval for _, config in entries.values()] == [0.005, 0.01]


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["lr_rl"], "must be FLAG=VALUE,VALUE"),
        (["=1"], "must be FLAG=VALUE,VALUE"),
        (["lr_rl=1,,2"], "must be FLAG=VALUE,VALUE"),
        (["lr_rl=1e-3,1e-3"], "1e-3 is given 2 times; give it once"),
        (["lr=1,2"], "--lr: no such flag; did you mean --lr_encoder"),
        (["n_step=1,2"], "--n_step: is now --rl=:n_step"),
        (["encoder=tiny:features=8,pool=none"], "'pool=none' is an option; a ; separates values that have"),
        (["gamma=0.9", "gamma=0.99"], "--gamma is given beside it"),
        (["steps=1,2"], "--steps is given beside it"),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(texts, says):
    with pytest.raises(ConfigError, match=f"^--grid={texts[-1]}: {says}"):
        plan.grid([Arm("a", "catch/joint")], texts, {"steps": "7"})


def test_a_composed_preset_is_swept_with_what_it_starts_from():
    (arm,) = map(plan.arm_of, plan.presets(["thesis/frozen_*+small"]))
    assert arm == Arm("frozen_256_small", "thesis/frozen_256+small")
    runs = plan.plan([arm], [], [0])
    assert [run.name for run in runs if "rl_only" not in run.name] == [
        "Catch/pretrain_256_small/seed0", "Catch/frozen_256_small/seed0",
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="arm joint_smal: catch/joint.smal: did you mean small"):
        plan.plan([plan.arm_of("catch/joint+smal")], [], [0])
