"""experiments.report: what a page compares, what it concludes, and what it leaves out."""

import shutil

import pytest

from experiments.drawing import plots
from srl_jax.errors import ConfigError
from srl_jax.run import ending
from tests import helpers
from tests.experiments.reporting.report_test import Page, build, write_run
from tests.helpers import NOT_FINITE

Image = pytest.importorskip("PIL.Image", reason="needs the extra plots")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Pictures of a pixel: report_test.py draws a page's."""
    monkeypatch.setattr(plots, "save", lambda figure, path: Image.new("L", (1, 1)).save(path))


@pytest.fixture(scope="module")
def two_games(tmp_path_factory):
    """Three seeds on two games; on Catch three arms, on the other one two. Some have failed or just begun."""
    root = tmp_path_factory.mktemp("two") / "runs"
    # Areas: rl 0, 0.25, 0.5; above 1, three times; near 0, 0.25, 0.75. The standard error of rl's mean is
    # 0.25 / sqrt(3), t of two degrees of freedom 4.303, and those of its difference from above are the same.
    ends = {"rl": [0.0, 0.5, 1.0], "near": [0.0, 0.5, 1.5], "above": [2.0, 2.0, 2.0]}
    for game in ("Catch", "CatchDistractor"):
        for arm, values in ends.items():
            mode = {"mode": "rl_only" if arm == "rl" else "joint", "game": game}
            for seed, value in enumerate(values):
                write_run(root / game / arm / f"seed{seed}", [0.0, value / 2, value], seed=seed, **mode)
    # It would be the baseline, as its name sorts first.
    ending.write(write_run(root / "Catch/bad/seed0", [0.0, 9.0]), NOT_FINITE)
    ending.write(write_run(root / "Catch/rl/seed3", [0.0, 1.0], seed=3), NOT_FINITE)
    write_run(root / "Catch/begun/seed0", [-1.0], mode="joint")
    write_run(root / "Catch/pretrain/seed0", mode="pretrain")
    return root


def test_the_sentences_say_what_the_intervals_say(two_games):
    page = Page(build(two_games, media=False))
    sentence = "rl has 0.25 [−0.37, 0.87]. Better: above (+0.75 over 0.25). Not told apart: near."
    assert page.text.count(sentence) == 2
    table = page.table("Statistics of Catch")
    assert table["above"][4] == "+0.75 over 0.25 ▲ [+0.13, +1.37]" and "▲" not in table["near"][4]
    assert list(table) == ["arm", "rl", "above", "near", "random policy", "no-op policy"]
    # Over games nothing is concluded from a bootstrap that is too narrow.
    over = page.table("The return at the end, over games")
    assert all(text.endswith("(no interval)") for text in over["above"][:2]) and "▲" not in over["above"][-1]
    assert over["near"][1].endswith("too narrow")
    # Those that failed or have just begun are named, and cut nothing.
    assert (
        f"Failed, not compared: Catch / bad / seed 0: {NOT_FINITE.reason} Catch / rl / seed 3:" in page.text
    )
    bad, rl = (
        f"{x} seed{y} left out: {NOT_FINITE.reason} (seed {z})"
        for x, y, z in (("bad: 1 of 1", "", 0), ("rl: 1 of 4", "s", 3))
    )
    begun = "begun: 1 of 1 seed left out: has only begun (seed 0)"
    assert f"Not compared: {rl} {bad} {begun}" in page.text
    assert "Catch / begun / seed 0: 200 of 200 env steps" in page.text  # it lacks evaluations
    assert page.table("Every run")["Catch / bad / seed 0"][1] == "failed"
    assert (
        "pretrain" in page.table("Settings in which arms differ")["field"] and "policy" not in page.pictures
    )


def test_pages_of_few_runs(tmp_path, monkeypatch):
    game = "gymnasium:id=A-v0,grey=true,render=false,frame_skip=1,max_steps=0"
    for arm in "ab":
        for seed in range(2):
            write_run(tmp_path / f"own/{arm}/seed{seed}", (1.0, 2.0 + seed), seed=seed, game=game, gamma=0.9)
    page = Page(build(tmp_path / "own"))
    assert list(page.table(f"Statistics of {game}")) == ["arm", "a", "b"]
    assert "No game with reference scores has runs of every arm" in page.text
    ending.write(write_run(tmp_path / "failed/a/seed0", [0.0]), NOT_FINITE)
    page = Page(build(tmp_path / "failed"))
    assert "there is nothing to compare" in page.text and f"left out: {NOT_FINITE.reason}" in page.text
    # Several directories, which are named as they are and not by where they lie.
    write_run(tmp_path / "one/fast_seed0", [0.0, 1.0])
    write_run(tmp_path / "two/runs/slow", [0.0, 0.5], mode="joint", objectives=("reconstruction",))
    page = Page(build(tmp_path / "one", tmp_path / "two/runs/slow"))
    assert list(page.table("Statistics of Catch"))[:3] == ["arm", "fast", "slow"]
    places = {name: row[-1] for name, row in page.table("Every run").items()}
    assert places["Catch / fast / seed 0"] == "one/fast_seed0" and places["Catch / slow / seed 0"] == "slow"
    monkeypatch.chdir(tmp_path / "two/runs/slow")
    page = Page(build(".."))
    assert page.table("Every run")["Catch / slow / seed 0"][-1] == "slow" and "Below runs." in page.text
    assert str(tmp_path) not in page.text


def test_other_protocols_are_refused_or_said(tmp_path):
    write_run(tmp_path / "a/seed0", [0.0, 1.0])
    write_run(tmp_path / "a/seed1", [0.0, 1.0], gamma=0.5, seed=1)
    write_run(tmp_path / "b/seed0", [0.0, 1.0], sticky_actions=0.25)
    with pytest.raises(ConfigError, match="sticky_actions is 0.0 there and 0.25 here; --force"):
        build(tmp_path)
    page = Page(build(tmp_path, force=True))
    assert "Compared by force (--force), though these differ:" in page.text
    assert "sticky_actions is 0.0 there and 0.25 here" in page.text and "gamma is 0.99" in page.text
    shutil.rmtree(tmp_path / "b")
    with pytest.raises(ConfigError, match="gamma is 0.99 there and 0.5 here; --force"):
        build(tmp_path)


def test_arms_that_are_evaluated_at_other_steps_keep_their_own_areas(tmp_path):
    """Up to 300, a is a straight line to 3, and b has 0, 1, 1, 0: (0.5 + 1 + 0.5) / 3."""
    helpers.write_run(tmp_path / "a/seed0", (0, 4), 400)
    helpers.write_run(tmp_path / "b/seed0", (0, 1, 1, 0), 100, mode="joint")
    page = Page(build(tmp_path, baseline="a"))
    assert "Compared up to 300 env steps, where b, seed 0, ended." in page.text
    table = page.table("Statistics of Catch")
    assert table["a"][1] == "3.00 (no interval)" and table["a"][3] == "1.50 (no interval)"
    assert table["b"][1] == "0.00 (no interval)" and table["b"][3] == "0.67 (no interval)"


def test_returns_that_are_null_are_left_out_and_said_to_be(tmp_path):
    final = {"final_games": 2, "steps": 100}
    for arm, returns in (("a", (0, 1)), ("b", (0, 1)), ("c", (None, None))):
        helpers.write_run(tmp_path / f"Catch/{arm}/seed0", returns, final=(1, 3), lr_rl=1e-3, **final)
    metrics = tmp_path / "Catch/b/seed0/metrics.jsonl"
    metrics.write_text(metrics.read_text().replace('"final/return_mean": 2.0', '"final/return_mean": null'))
    page = Page(build(tmp_path))
    cells = {arm: row[-1] for arm, row in page.table("Statistics of Catch").items()}
    assert cells["a"].startswith("2.00") and cells["b"] == "–" and "c" not in cells
    assert "Not compared: c: 1 of 1 seed left out: eval/return_mean is null in each row (seed 0)" in page.text
