"""Tests of experiments.compare."""

import json

import pytest

from experiments import compare, packing
from experiments.drawing import plots
from experiments.drawing.colours import styles
from experiments.runs import collect
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from tests.helpers import NOT_FINITE, write_run
from tests.in_process import parse


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two seeds of a, which end at 200 env steps; b, with another rate, goes on to 300; c is joint."""
    root = tmp_path_factory.mktemp("runs")
    write_run(root / "a/seed0", (-1, 0, 1), lr_rl=1e-3)
    write_run(root / "a/seed1", (-1, -1, 0), seed=1, lr_rl=1e-3)
    write_run(root / "b", (0, 1, 1, 5), lr_rl=1e-4)
    write_run(root / "c", (0, 0), lr_rl=1e-4, mode="joint", objectives=("latent_l2:weight=1e-5",))
    write_run(root / "pong", (0, 0), game="Pong", frame_size=84)
    write_run(root / "noisy", (0, 0), eps_eval=0.5)
    write_run(root / "failed", (0, 0), ended=NOT_FINITE)
    write_run(root / "broken", (0, 0), ended=NOT_FINITE)
    (root / "linked").symlink_to("a")
    rows = [json.loads(line) for line in (root / "c/metrics.jsonl").read_text().splitlines()]
    rows[0] |= {"loss/x": 0.5, "text": "x"}
    (root / "c/metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return root


def _compare(*arguments):
    compare.compare(parse(compare, *arguments, positional="runs"))


@pytest.fixture
def drawn(monkeypatch):
    """The panels and looks of what was drawn."""
    pytest.importorskip("matplotlib")
    given, draw = [], plots.draw_panels

    def keep(panels, path, title, note, looks, label):
        given.append((panels, note, looks))
        return draw(panels, path, title, note, looks, label)

    monkeypatch.setattr(plots, "draw_panels", keep)
    return given


def test_the_table_by_hand(runs, capsys):
    _compare(runs / "a", runs / "b")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    # Of a at 200: 1 and 0, so 0.5, and 12.706 times a standard error of 0.5 to either side. Averages over
    # 0 .. 200 are 0 and -0.75 of a, and (0.5 + 1) / 2 of b, which goes on.
    assert lines[0][:5] == ["Catch,", "eval/return_mean", "seeds", "at", "200"]
    assert lines[1][:6] == ["lr_rl=1e-3", "2", "0.5", "[-5.853,", "6.853]", "-0.375"]
    assert lines[2] == ["lr_rl=1e-4", "1", "1", "0.75", str(runs / "b")]
    assert lines[3:] == [["lr_rl:", "1e-3,", "1e-4"]]


def test_final_games_are_compared_where_all_have_them_and_as_many(tmp_path, capsys):
    for seed, final in enumerate([(1, 3), (4, 6)]):
        write_run(tmp_path / f"a/seed{seed}", seed=seed, final=final, final_games=2)
    write_run(tmp_path / "b", final=(7, 9), final_games=2, lr_rl=1e-3)
    _compare(tmp_path, "--key=final/return_mean")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    # Of a, the mean of 2 and 5, and 12.706 times a standard error of 1.5 to either side.
    a, b = ([x.strip("[],") for x in line] for line in lines[1:3])
    assert [float(x) for x in a[2:5]] == pytest.approx([3.5, 3.5 - 19.059, 3.5 + 19.059], abs=0.01)
    assert b[2] == "8"
    write_run(tmp_path / "c", final=(7, 9, 8), final_games=3)
    with pytest.raises(ConfigError, match="final_games is 2 there and 3 here; --force"):
        _compare(tmp_path, "--key=final/return_mean")
    _compare(tmp_path, "--key=eval/return_mean")  # their curves are alike


def test_the_picture_has_means_intervals_and_names(runs, tmp_path, drawn):
    path = tmp_path / "ab.png"
    _compare(runs / "a", runs / "b", f"--out={path}")
    assert path.read_bytes().startswith(b"\x89PNG")
    (((panel,), note, looks),) = drawn
    a, b = panel.lines
    assert (a.label, a.seeds, b.label, b.seeds) == ("lr_rl=1e-3", 2, "lr_rl=1e-4", 1)
    assert list(a.curve.point) == [-1, -0.5, 0.5] and a.curve.high[2] == pytest.approx(6.853, abs=1e-3)
    assert list(b.curve.at) == [0, 100, 200, 300] and note.startswith("bands: 95 % t intervals")
    assert {level.method for level in panel.policies} == {"random", "no-op"}
    # The colours of a and b among all arms that were named, and not of what their labels happen to be.
    assert looks == dict(zip(("lr_rl=1e-3", "lr_rl=1e-4"), styles(["a", "b"]).values(), strict=True))
    before = path.read_bytes()
    _compare(runs / "b", runs / "c", "--key=loss/x", f"--out={path}", "--overwrite")
    assert path.read_bytes() != before and not drawn[1][0][0].policies
    assert "Catch, b: 1 of 1 seed left out: has no loss/x" in drawn[1][1]


def _arms(*configs):
    return [compare.Arm("Catch", f"arm{i}", f"runs/arm{i}", config, []) for i, config in enumerate(configs)]


def test_labels_are_the_first_settings_that_tell_arms_apart():
    joint = {"mode": "joint", "objectives": ("reconstruction:weight=1",)}
    light = {"mode": "joint", "objectives": ("reconstruction:weight=0.1", "latent_l2:weight=1")}
    arms = _arms(Config(), Config(**joint), Config(**light))
    weights = ["-", "1", "0.1"]  # the first one has no decoder
    assert compare.differing(arms).pop("reconstruction:weight") == weights
    assert compare.differing(arms).keys() == {"mode", "objective", "reconstruction:weight"}
    assert compare._labels(arms) == ["arm0", "arm1", "arm2"]  # the objectives are too long
    arms = _arms(*(Config(mode="joint", objectives=(f"reconstruction:weight={x}",)) for x in (1, 2)))
    assert compare._labels(arms) == ["reconstruction:weight=1", "reconstruction:weight=2"]
    assert compare._labels([*arms, *_arms(Config())]) == [
        "mode=joint, reconstruction:weight=1",
        "mode=joint, reconstruction:weight=2",
        "mode=rl_only",
    ]
    assert compare._labels(_arms(Config(), Config(seed=1))) == ["arm0", "arm1"]
    # What runs start from is told by its arm, and what is written beside rows is not told.
    sources = [f"runs/Catch/pretrain_{x}/seed{x}/best/000000100" for x in (1, 2)]
    starts = [Config(mode="frozen", encoder_from=path, keep_best=i > 0) for i, path in enumerate(sources)]
    assert compare.differing(_arms(*starts)) == {"encoder_from": ["pretrain_1", "pretrain_2"]}
    same = [arm._replace(name="x") for arm in _arms(Config(), Config())]
    assert compare._labels(same) == ["runs/arm0", "runs/arm1"]
    same[1] = same[1]._replace(game="Pong")  # in panels of their own
    assert compare._labels(same) == ["x", "x"]


def test_packed_runs_and_folders_of_arms_are_read_alike(runs, tmp_path, capsys):
    for name in ("a", "b"):
        read = collect.load_runs(runs / name)
        packing.write(tmp_path / name, [x._replace(path=tmp_path / name / x.path.name) for x in read])
    _compare(tmp_path)
    here = capsys.readouterr().out
    _compare(runs / "a", runs / "b")
    assert [line.split()[:4] for line in here.splitlines()] == [
        line.split()[:4] for line in capsys.readouterr().out.splitlines()
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "--runs: missing; name two"),
        (("a",), "^a: one curve; name a second run, .*; srl-jax draw draws one"),
        (("a", "a/", "linked", "a/seed0"), "^a: one curve; name a second run, .*; srl-jax draw draws one"),
        (("a", "nothing"), "nothing: no run directory there"),
        (("a", "b", "--key=eval/return_men"), "no run has it; there are eval/return_mean"),
        (("a", "c", "--key=nope"), "no run has it; there are eval/return_mean, loss/x, updates, wall_s$"),
        (("a", "c", "--key=text"), "c: text is not a number in each row"),
        (("a", "pong"), "of different games, Catch, Pong; --force compares"),
        (("a", "noisy"), "another protocol than .*eps_eval is 0.005 there and 0.5 here; --force"),
        (
            ("failed", "broken"),
            "nothing to draw; Catch, failed: 1 of 1 seed left out: loss/rl is not finite",
        ),
        (("a", "b", "--out=x.jpg"), "--out=x.jpg: must end in .png"),
        (("a", "b", "--out=there.png"), "there.png: exists; name a new file, or --overwrite replaces it"),
    ],
)
def test_what_cannot_be_compared_is_refused_and_nothing_written(runs, monkeypatch, arguments, message):
    monkeypatch.chdir(runs)
    (runs / "there.png").write_bytes(b"")
    with pytest.raises(ConfigError, match=message):
        _compare(*arguments)
    assert (runs / "there.png").read_bytes() == b""


def test_games_that_differ_have_panels_of_their_own_where_that_is_forced(runs, tmp_path, drawn):
    _compare(runs / "a", runs / "pong", "--force", f"--out={tmp_path / 'x.png'}")
    assert [panel.game for panel in drawn[0][0]] == ["Catch", "Pong"]
    _compare(runs / "a", runs / "noisy", "--force", f"--out={tmp_path / 'y.png'}")
    assert "another protocol" in drawn[1][1]


def test_a_run_without_a_policy_is_said_and_left_out(tmp_path, capsys):
    write_run(tmp_path / "a")
    run = write_run(tmp_path / "pretrain", mode="pretrain", objectives=("latent_l2",))
    rows = [row for row in map(json.loads, (run / "metrics.jsonl").read_text().splitlines())]
    kept = [{k: x for k, x in row.items() if k != "eval/return_mean"} for row in rows]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept))
    _compare(tmp_path / "a", run)
    assert "pretrain: has no policy" in "".join(capsys.readouterr())
