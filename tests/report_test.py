"""experiments.report: what is on the page, its numbers by hand, and what it refuses."""

import dataclasses
import json
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from absl import flags

from experiments import collect, images, plots, report
from experiments import flags as config_flags
from experiments.collect import RunData
from experiments.reporting import browser, configs, overview
from srl_jax import ending
from srl_jax.config import Config
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from tests.helpers import NOT_FINITE

pytestmark = pytest.mark.skipif(not plots.available(), reason="needs the extra plots")

ODD = '<b>&"odd"'
"""Of an arm whose name is HTML."""
CURVES = {
    ("rl", 0): [0.0, 0.5, 1.0],
    ("rl", 1): [0.0, 0.0, 0.5],
    ("joint", 0): [0.0, 1.0, 1.0, 5.0],
    ("joint", 1): [0.0, 1.0, 1.0],
    (ODD, 0): [-1.0, -1.0, -1.0],
}
"""Returns at 0, 100, 200 (and 300) env steps; joint goes on further than the others do."""


def write_run(path, returns=(), *, speed=100.0, diag=None, **values):
    """A run of 200 env steps, unless told otherwise, with two rows of training and its evaluations."""
    path.mkdir(parents=True)
    fields = {"game": "Catch", "frame_size": 42, "steps": 200, "eval_every": 100, "log_every": 100}
    config = Config(**fields | values)
    about = {
        "versions": {"jax": "1.2.3"},
        "git_revision": "0123456789abcdef",
        "started": "2026-01-02 03:04:05",
    }
    (path / "config.json").write_text(json.dumps({**dataclasses.asdict(config), **about}))
    rows = []
    for i, value in enumerate(returns):
        rows.append({"kind": "eval", "env_steps": 100 * i, "updates": i, "eval/return_mean": value})
        rows[-1] |= {key: x[i] for key, x in (diag or {}).items()} | {"wall_s": 3600.0 * i}
    for step in (100, 200):
        row = {"kind": "train", "env_steps": step, "updates": 1, "wall_s": 3600.0 * step / 100}
        rows.append(row | {"wall_steps_per_s": speed})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


class Page(HTMLParser):
    """What is in a page: its elements, its text, its tables, and whether everything that opens is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.words, self.tables = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.attributes.append((tag, dict(attributes)))
        if tag not in ("meta", "link", "img", "wbr"):
            self.open.append(tag)
        if tag == "div" and dict(attributes).get("role") == "region":
            self.tables.append((dict(attributes)["aria-label"], []))
        elif tag == "tr":
            self.tables[-1][1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag in ("p", "li", "td", "th", "dd", "dt", "h1", "h2", "h3", "figcaption", "span"):
            self.handle_data(" ")

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)
        if {"td", "th"} & set(self.open):
            cells = self.tables[-1][1][-1]
            cells[-1] = " ".join((cells[-1] + data).split(" ")) if data != " " else cells[-1].rstrip() + " "

    def table(self, label):
        """Row heading -> {column heading, or its place: cell}, of the table with this label."""
        (rows,) = [rows for name, rows in self.tables if name == label]
        return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def build(*runs, **options):
    from experiments.reporting import page

    return page.build(*runs, **options)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Three arms on Catch, one with a name that is HTML; a figure, pictures, diagnostics of one."""
    root = tmp_path_factory.mktemp("report") / "runs"
    lists = {"diag/drift/steps": [[], [0], [0, 100]], "diag/drift/cka": [[], [0.5], [0.25, 0.75]]}
    for (arm, seed), returns in CURVES.items():
        own = {"mode": "joint", "objectives": ("reconstruction:weight=2",)} if arm == "joint" else {}
        diag = (
            {"diag/effective_rank": [3.0, 2.0, None], "diag/new": [1, 2, 3], **lists} if arm == ODD else None
        )
        speed = 50.0 if arm == "joint" else 100.0
        place = root / f"Catch/{arm}/seed{seed}"
        if arm == "joint":
            own |= {"steps": 300} if seed == 0 else {"steps": 300, "eval_games": 10}
        write_run(place, returns, speed=speed, diag=diag, seed=seed, **own)
    frames = np.zeros((30, 42, 42, 1), np.uint8)
    images.gif(frames, root / "Catch/rl/seed0/figures/play.gif")
    image = np.zeros((2, 8, 8, 1), np.float32)
    images.image_panel(image, image, image, root / "Catch/joint/seed0/figures/reconstruction.png", "")
    shutil.copytree(root / "Catch/joint/seed0/figures", root / "figures")
    about = {"figure": "6.3", "title": "Joint <script>", "question": "Does it help?"}
    (root / "figures/reconstruction.json").write_text(json.dumps(about))
    return root


@pytest.fixture(scope="module")
def text(runs):
    return build(runs, baseline="rl")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_what_a_run_went_on_under_is_said(tmp_path):
    run = write_run(tmp_path / "run")
    path = run / "config.json"
    changed = {"jax": "1.3", "git_revision": "fedcba9876543210-dirty", "cpus": 8}
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"continued": [{"env_steps": 100, "changed": changed}]})
    )
    about = configs.about(collect.load_run(run))
    assert dict(about.versions) == {"jax": "1.2.3, then 1.3"} and about.cpus == "none, then 8"
    assert overview._short(about) == "0123456789, then fedcba9876-dirty"


def test_nothing_is_asked_for_from_outside(page):
    for tag, attributes in page.attributes:
        assert tag not in ("script", "iframe", "object", "form", "base")
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "href", "srcset", "action"):
            assert attributes.get(name, "#").startswith(("#", "data:"))
    policy = next(
        a["content"] for _, a in page.attributes if a.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")
    ids = [attributes["id"] for _, attributes in page.attributes if "id" in attributes]
    links = [attributes["href"] for tag, attributes in page.attributes if tag == "a"]
    assert links == [f"#{name}" for name in ids] and len(set(ids)) == len(ids) == 12
    assert all(a["alt"] for tag, a in page.attributes if tag == "img")


def test_every_arm_and_every_run_is_there_as_text(page, text):
    assert ODD in page.text and "<b>" not in text and "<script" not in text
    assert "Figure 6.3. Joint <script> Does it help?" in page.text
    runs = page.table("Every run")
    assert {f"Catch / {arm} / seed {seed}" for arm, seed in CURVES} < set(runs)
    assert runs["Catch / joint / seed 0"][:4] == ["300 of 300", "yes", "4", "5.00 at 300"]
    assert "4 of 5 runs" in page.text and "Catch / joint / seed 1: 200 of 300 env steps" in page.text
    assert "0123456789" in page.text and "2026-01-02 03:04:05" in page.text and "jax 1.2.3" in page.text


def test_numbers_by_hand(page):
    # rl ends at 0.75 on average. Areas: (0.25 + 0.75) / 2 and (0 + 0.25) / 2; joint's (0.5 + 1) / 2, twice.
    # t of one degree of freedom is 12.706, and the standard errors of rl's means are 0.25 and 0.1875; joint's
    # runs are alike, so its means have no interval, and the difference has rl's error and degree of freedom.
    table = page.table("Statistics of Catch")
    assert table["arm"][1::2] == ["return at 200", "mean return up to 200", "env steps to reach 0.75"]
    assert table["rl"][0] == "2" and table["rl"][1] == "0.75 [−2.43, 3.93]" and table["rl"][2] == "–"
    assert table["rl"][3] == "0.31 [−2.07, 2.69]"
    # One of rl's two runs is at 0.75 after 150 env steps, the other one never.
    assert table["rl"][5] == "> 200 [150, > 200] too narrow, 1 of 2 did"
    assert table["joint"][1:3] == ["1.00 (no interval)", "+0.25 [−2.93, +3.43]"]
    assert table["joint"][3:5] == ["0.75 (no interval)", "+0.44 [−1.94, +2.82]"]
    assert table["joint"][5] == "75 [75, 75] too narrow, 2 of 2 did"
    assert table[ODD][:3] == ["1", "−1.00 (no interval)", "−1.75 (no interval)"]
    assert "Compared up to 200 env steps, where rl, seed 0, ended." in page.text
    # Human-normalised: a miss is -1 and a catch 1. A tie counts half: (0.5 + 1) / 2.
    over = page.table("The return at the end, over games")
    # Of one game the mean has its t interval, 0.125 * 12.706 to either side; what is no mean is drawn again.
    assert over["joint"][1] == "1.00 (no interval)" and over["rl"][1] == "0.88 [−0.71, 2.46]"
    assert over["joint"][4:] == ["0.00 (no interval)", "0.75 [0.50, 1.00] too narrow"]


def test_policies_that_learn_nothing_are_beside_the_arms(page):
    rows = page.table("Statistics of Catch")
    for name, policy in reference_policies("Catch").items():
        score = f"{policy.return_mean:.2f}".replace("-", "−")
        cells = rows[f"{name} policy"]
        assert cells == ["–", f"{score} (5,000 games)", "–", f"{score} (5,000 games)", "–", "–"]
        assert f"a {name} policy has {score}" in page.text
        # A miss is 0 and a catch 1: half of what is above -1. One game has one mean, median and so on.
        normal = (policy.return_mean + 1) / 2
        over = page.table("The return averaged over env steps, over games")[f"{name} policy"]
        assert over == ["–", *[f"{normal:.2f}"] * 3, f"{1 - normal:.2f}", "–"]


def test_two_seeds_tell_little(page):
    assert "rl has 0.31 [−2.07, 2.69]. No arm differs from it by Welch's t test at 5 %." in page.text
    assert "Above it" not in page.text and "▲" not in "".join(page.table("Statistics of Catch")["joint"])
    assert "1 arm without an interval" in page.text


def test_over_games_nothing_is_said_of_a_bootstrap_that_is_too_narrow(tmp_path):
    for game in ("Catch", "CatchDistractor"):
        for arm, end in (("rl_only_256", 0.0), ("joint_256", 5.0)):
            mode = "rl_only" if arm == "rl_only_256" else "joint"
            for seed in range(3):
                write_run(
                    tmp_path / game / arm / f"seed{seed}", [0.0, end + seed], seed=seed, mode=mode, game=game
                )
    page = Page(build(tmp_path, media=False))
    over = page.text.partition("Over games, interquartile mean")[2]
    assert "Too few seeds to say whether they differ from it: joint_256;" in over
    assert "Above it" not in over.partition("Intervals are")[0]
    assert page.table("The return at the end, over games")["joint_256"][0].endswith("too narrow")
    # On each game alone Welch's test tells: 5 apart, a standard error of sqrt(2 / 3), and 2.776 times that.
    assert "Above it, by Welch's t test at 5 %: joint_256 (+5.00 [+2.73, +7.27] over it)." in page.text


def test_the_sentences_say_what_the_intervals_say(tmp_path):
    # Areas: rl 0, 0.25, 0.5; above 1, three times; near 0, 0.25, 0.75. The standard error of rl's mean is
    # 0.25 / sqrt(3), t of two degrees of freedom 4.303, and those of its difference from above are the same.
    ends = {"rl": [0.0, 0.5, 1.0], "near": [0.0, 0.5, 1.5], "above": [2.0, 2.0, 2.0]}
    for arm, values in ends.items():
        mode = "rl_only" if arm == "rl" else "joint"
        for seed, value in enumerate(values):
            write_run(tmp_path / arm / f"seed{seed}", [0.0, value / 2, value], seed=seed, mode=mode)
    page = Page(build(tmp_path, media=False))
    assert (
        "rl has 0.25 [−0.37, 0.87]. Above it, by Welch's t test at 5 %: above (+0.75 [+0.13, +1.37] over it)."
        in (page.text)
    )
    assert "Not told apart from it: near." in page.text and "Too few" not in page.text
    table = page.table("Statistics of Catch")
    assert "▲" in table["above"][4] and "▲" not in table["near"][4]


def test_a_performance_profile_by_hand():
    from experiments.reporting import numbers

    # In Catch 0 is a miss, -1, and 1 a catch, 1: these end at 0.5 and 1, and at 0.
    ends = {"rl": [[-1.0, 0.0], [-1.0, 1.0]], "joint": [[-1.0, -1.0]]}
    steps = np.array([0, 100])
    comparison = numbers.Comparison(steps, {arm: np.array(x) for arm, x in ends.items()}, None)
    games, thresholds, found = numbers.profiles({"Catch": comparison, "Pong": None}, ["rl", "joint", "other"])
    assert games == ["Catch"] and thresholds[0] < 0 and thresholds[-1] == 1.0
    rl, joint = found["rl"], found["joint"]
    np.testing.assert_array_equal(rl.point, np.where(thresholds < 0.5, 1.0, 0.5 * (thresholds < 1.0)))
    np.testing.assert_array_equal(joint.point, thresholds < 0)
    assert np.isnan(joint.low).all() and list(found) == ["rl", "joint"]
    # Two runs are drawn again as either one twice, or as both.
    between = (thresholds > 0.5) & (thresholds < 1)
    assert (rl.low[between] == 0).all() and (rl.high[between] == 1).all()


def test_cost_and_settings(page):
    cost = page.table("Time and cost of each arm")
    assert cost["Catch / rl"] == ["2", "4.0 h", "2.0 h", "100", "1.00 times"]
    assert cost["Catch / joint"][-2:] == ["50", "2.00 times"]
    settings = page.table("Settings on Catch")
    assert settings["field"] == ["rl", "joint", ODD]
    assert settings["mode"] == ["rl_only", "joint", "rl_only"]
    assert settings["objectives reconstruction: weight"] == ["–", "2", "–"]
    assert set(settings) == {"field", "mode", "objectives", "objectives reconstruction: weight", "steps"}


def test_diagnostics_are_drawn_and_missing_ones_said(page):
    pictures = [attributes["alt"] for tag, attributes in page.attributes if tag == "img"]
    names = {name.removeprefix("Catch: ") for name in pictures}
    assert {"effective rank", "CKA with the oldest latents", "CKA with the last latents", "new"} < names
    without = "Without diagnostics: Catch / joint / seed 0, Catch / joint / seed 1, Catch / rl / seed 0 and"
    assert without in page.text


def test_the_same_runs_give_the_same_bytes(runs, text, tmp_path):
    shutil.copytree(runs, tmp_path / "runs")  # with other times of its files
    assert build(tmp_path / "runs", baseline="rl") == text


def test_a_page_of_runs_of_before(tmp_path):
    # No pictures, no diagnostics, one seed, and of one arm a run that has just begun.
    write_run(tmp_path / "a/seed0", [0.0, 1.0, 1.0])
    write_run(tmp_path / "b/seed0", [-1.0], mode="joint")
    write_run(tmp_path / "pretrain/seed0", mode="pretrain")
    page = Page(build(tmp_path, media=False))
    assert "These runs have no diagnostics" in page.text and "--nomedia" in page.text
    assert list(page.table("Statistics of Catch")) == ["arm", "a", "random policy", "no-op policy"]
    assert "Catch / b / seed 0: 200 of 200 env steps" in page.text  # it lacks evaluations
    assert [a["alt"] for tag, a in page.attributes if tag == "img"] == ["Catch: learning curves"]
    assert "pretrain" in page.table("Settings on Catch")["field"]


def test_what_only_atari_has_is_said_of_atari_alone(tmp_path):
    from experiments.reporting.configs import protocol_text

    catch, pong = (protocol_text(Config(game=game, frame_size=84)) for game in ("Catch", "Pong"))
    assert catch == (
        "10 full games an evaluation, every 100,000 env steps; epsilon 0.005; at most 27,000 env steps a game"
    )
    assert pong == catch.replace(
        "; at most", "; no sticky actions; fewer than 30 no-ops at the start; at most"
    ) + (", of 4 frames each; in training, a lost life ends the return")
    labels = [plots.steps_label(game) for game in ("Pong", "CatchDistractor", "")]
    assert labels == ["env steps (4 frames each)", "env steps", "env steps"]


def test_a_game_without_scores_of_others_has_numbers_of_its_own(tmp_path):
    game = "gymnasium:id=A-v0,grey=true,render=false,frame_skip=1,max_steps=0"
    for arm in "ab":
        for seed in range(2):
            write_run(tmp_path / f"x/{arm}/seed{seed}", (1.0, 2.0 + seed), seed=seed, game=game, gamma=0.9)
    page = Page(build(tmp_path, media=False))
    assert list(page.table(f"Statistics of {game}")) == ["arm", "a", "b"]
    assert "No game with reference scores has runs of every arm" in page.text


def test_other_protocols_are_refused_or_said(tmp_path):
    write_run(tmp_path / "a/seed0", [0.0, 1.0])
    write_run(tmp_path / "a/seed1", [0.0, 1.0], gamma=0.5, seed=1)
    write_run(tmp_path / "b/seed0", [0.0, 1.0], sticky_actions=0.25)
    with pytest.raises(ConfigError, match="sticky_actions is 0.0 there and 0.25 here; --force"):
        build(tmp_path)
    page = Page(build(tmp_path, force=True, media=False))
    assert "Compared by force (--force), though these differ:" in page.text
    assert "sticky_actions is 0.0 there and 0.25 here" in page.text and "gamma is 0.99" in page.text
    shutil.rmtree(tmp_path / "b")
    with pytest.raises(ConfigError, match="gamma is 0.99 there and 0.5 here; --force"):
        build(tmp_path)


def test_what_is_asked_for_must_be_there(runs):
    with pytest.raises(
        ConfigError, match="--baseline=other: not an arm with a policy; valid: <b>.*joint, rl"
    ):
        build(runs, baseline="other")
    with pytest.raises(ConfigError, match="--reach=Pong: no run of that game; valid: Catch"):
        build(runs, reach={"Pong": 1.0})


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("figures/a.png", b"no picture", "a.png: neither a PNG nor a GIF"),
        ("figures/reconstruction.json", b"[1]", "reconstruction.json: not a JSON object"),
        ("Catch/rl/seed0/figures/play.gif", b"<svg>", "play.gif: neither"),
        ("Catch/rl/seed0/config.json", b'{"versions": 1}', "config.json"),
        (
            "Catch/rl/seed0/metrics.jsonl",
            b'{"kind": "train", "env_steps": 1, "wall_s": "x"}\n',
            "wall_s is not",
        ),
    ],
)
def test_what_is_not_what_training_writes_is_named(runs, tmp_path, file, content, message):
    shutil.copytree(runs, tmp_path / "runs")
    (tmp_path / "runs" / file).write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        build(tmp_path / "runs", force=True)


def test_whether_a_run_is_finished():
    from experiments.reporting.numbers import finished

    def run(evals, trains, **values):
        rows = [{"kind": "eval", "env_steps": step, "eval/return_mean": 1.0} for step in evals]
        rows += [{"kind": "train", "env_steps": step} for step in trains]
        return RunData("", "Catch", "a", 0, Config(steps=250, eval_every=100, log_every=50, **values), rows)

    assert finished(run([0, 100, 200], [50, 100, 150, 200, 250]))
    assert not finished(run([0, 100, 200], [50, 100, 150, 200]))  # the last row of training is missing
    assert not finished(run([0, 100], [250]))  # the last evaluation is
    assert finished(run([0, 100], [100], stop_at_return=1.0))
    assert finished(run([], [250], mode="pretrain"))


@pytest.mark.parametrize(("arms", "sizes"), [(6, [6]), (7, [4, 4]), (14, [6, 6, 4])])
def test_arms_are_drawn_in_groups_with_the_baseline(arms, sizes):
    from experiments.reporting.gallery import groups

    names = [f"arm{i}" for i in range(arms)]
    found = groups(names, "arm3")
    assert [len(group) for group in found] == sizes
    assert all("arm3" in group for group in found) and set(sum(found, [])) == set(names)


@pytest.mark.parametrize("noise", [False, True])
def test_large_pictures_are_made_smaller(tmp_path, noise):
    import base64
    import io

    from PIL import Image

    from experiments.reporting import pictures

    rng = np.random.default_rng(0)
    shape = (40, 42, 42, 3)
    frames = rng.integers(0, 256, shape, dtype=np.uint8) if noise else np.zeros(shape, np.uint8)
    frames[1] = frames[0]
    path = images.gif(frames, tmp_path / "play.gif", scale=2)
    limit = 50_000 if noise else path.stat().st_size
    found = pictures.taken(path, limit)
    with Image.open(io.BytesIO(base64.b64decode(found.source.partition(",")[2]))) as image:
        assert found.bytes <= limit and image.size == (84, 84)
        if noise:  # the first frames, in colour and as fast; the first of them is there twice
            assert image.info["duration"] == 140 and 1 < image.n_frames < 20
            shown = np.asarray(image.convert("RGB"))[::2, ::2].astype(int)
            assert np.abs(shown - frames[0]).mean() < 20  # of 256 colours; a grey one is 50 off
    assert pictures.taken(tmp_path / "none.gif", limit) is None


def parsed(*arguments):
    values = flags.FlagValues()
    report.define_flags(values)
    config_flags.parse(["report", *map(str, arguments)], values, "runs")
    return values


def test_the_command_line(runs, tmp_path, capsys):
    out = tmp_path / "made/report.html"
    assert report.report(parsed(runs, f"--out={out}", "--nomedia", "--baseline=rl")) == out
    written = out.read_text()
    assert written.startswith("<!doctype html>") and [p.name for p in out.parent.iterdir()] == ["report.html"]
    with pytest.raises(ConfigError, match="exists; .*--overwrite"):
        report.report(parsed(f"--out={out}", f"--runs={runs}"))
    assert parsed(f"--out={out}", runs)["runs"].value == [str(runs)]
    assert parsed("a", f"--out={out}", "b")["runs"].value == ["a", "b"]
    assert parsed("--runs=a", "--runs=b")["runs"].value == ["a", "b"]
    for wrong, message in (
        ([f"--runs={runs}", runs], "unexpected argument"),
        ([runs, "--ovewrite"], "did you mean --overwrite"),
    ):
        with pytest.raises(SystemExit) as ended:
            parsed(*wrong)
        assert ended.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--runs: missing"),
        (["."], "--out: missing"),
        ([".", "--out=a.txt"], "must end in .html"),
        ([".", "--out=a/b\n.html"], "has the character"),
        ([".", "--out=file/a.html"], "not a directory"),
        (["none", "--out=a.html"], "--runs=none: no such directory"),
        ([".", "none", "--out=a.html"], "--runs=none: no such directory"),
        ([".", "--out=a.html"], "no run directory"),
        ([".", "--out=a.html", "--reach=Pong"], "must be GAME=SCORE"),
        ([".", "--out=a.html", "--reach=Pong=nan"], "must be GAME=SCORE"),
    ],
)
def test_what_is_refused_leaves_nothing(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=message):
        report.report(parsed(*arguments))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(not browser.installed(), reason="needs chromium and chromedriver")
def test_in_a_browser(runs, text, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(text)
    desktop, phone = browser.render(path)
    assert (desktop.width, phone.width) == (1280, 390) and desktop.images[0] == 10
    assert browser.problems(desktop) == browser.problems(phone) == []
    # What it is to find, it finds.
    wide = '<div style="width: 2000px">x</div><img src="http://127.0.0.1:9/x.png"><script>x()</script>'
    path.write_text(f"<!doctype html><title>x</title>{wide}")
    (found,) = browser.render(path, [390])
    lines = " ".join(browser.problems(found))
    assert "wide: <div" in lines and "asks for http://127" in lines and "x is not defined" in lines


def test_seeds_that_failed_are_named_and_cut_nothing(tmp_path):
    diag = {"diag/effective_rank": [1.0, 2.0, 3.0]}
    for seed in (0, 1):
        write_run(tmp_path / f"rl/seed{seed}", [0.0, 1.0, 1.0], seed=seed, diag=diag)
        # It would be the baseline, as its name sorts first.
        ending.write(write_run(tmp_path / f"bad/seed{seed}", [0.0, 9.0], seed=seed), NOT_FINITE)
    half = {"mode": "joint", "objectives": ("reconstruction",)}
    write_run(tmp_path / "half/seed0", [0.0, 1.0, 2.0], diag=diag, **half)
    ending.write(write_run(tmp_path / "half/seed1", [0.0, 1.0], diag=diag, seed=1, **half), NOT_FINITE)
    page = Page(build(tmp_path, media=False))
    assert list(page.table("Statistics of Catch")) == ["arm", "rl", "half", "random policy", "no-op policy"]
    assert page.table("Statistics of Catch")["half"][1] == "2.00 (no interval)"
    text = f"Failed, not compared:Catch / bad / seed 0: {NOT_FINITE.reason} Catch / bad / seed 1:"
    assert text in page.text and "Not finished" not in page.text and "3 of 6 runs" in page.text
    bad = f"bad: 2 of 2 seeds left out: {NOT_FINITE.reason} (seed 0, 1)"
    half = f"half: 1 of 2 seeds left out: {NOT_FINITE.reason} (seed 1)"
    assert f"Not compared:{bad} {half}" in page.text
    assert f"Catch, {half}." in page.text and f"Catch, {bad}." in page.text  # beside the curves
    assert page.table("Every run")["Catch / bad / seed 0"][1] == "failed"
    assert "rl (2 seeds) half (1 seed)" in page.text


def test_a_page_of_runs_that_all_failed(tmp_path):
    ending.write(write_run(tmp_path / "a/seed0", [0.0]), NOT_FINITE)
    page = Page(build(tmp_path, media=False))
    assert f"Not compared:a: 1 of 1 seed left out: {NOT_FINITE.reason}" in page.text


def test_an_encoder_is_from_an_arm_though_its_run_is_a_link(tmp_path):
    from experiments.collect import load_runs
    from experiments.reporting import numbers

    write_run(tmp_path / "disk/Catch/source/seed0", mode="pretrain")
    write_run(
        tmp_path / "cmp/frozen_seed0", [0.0], mode="frozen", encoder_from="/gone/disk/Catch/source/seed0"
    )
    (tmp_path / "cmp/mine_seed0").symlink_to(tmp_path / "disk/Catch/source/seed0")
    runs = load_runs(tmp_path / "cmp")
    assert {cost.arm: cost.source for cost in numbers.costs(runs, ["frozen", "mine"], None)} == {
        "frozen": "mine",
        "mine": "",
    }


def test_runs_of_several_directories_are_on_one_page(tmp_path, monkeypatch):
    write_run(tmp_path / "one/fast_seed0", [0.0, 1.0])
    write_run(tmp_path / "two/runs/slow", [0.0, 0.5], mode="joint", objectives=("reconstruction",))
    page = Page(build(tmp_path / "one", tmp_path / "two/runs/slow", media=False))
    assert list(page.table("Statistics of Catch")) == ["arm", "fast", "slow", "random policy", "no-op policy"]
    places = {name: row[-1] for name, row in page.table("Every run").items()}
    assert places["Catch / fast / seed 0"] == "one/fast_seed0" and places["Catch / slow / seed 0"] == "slow"
    assert "one, slow" in page.text and str(tmp_path) not in page.text
    monkeypatch.chdir(tmp_path / "two/runs/slow")
    page = Page(build("..", media=False))
    assert page.table("Every run")["Catch / slow / seed 0"][-1] == "slow"
    assert "Directory runs" in page.text


def test_arms_are_in_the_order_of_their_numbers(tmp_path):
    from experiments.collect import load_runs
    from experiments.reporting import numbers

    for arm in ("weight10", "weight9", "weight100", "joint_50"):
        write_run(tmp_path / arm / "seed0", [0.0])
    assert numbers.arms_of(load_runs(tmp_path)) == ["joint_50", "weight9", "weight10", "weight100"]
