"""experiments.report: what is on the page, its numbers by hand, and what it refuses."""

import csv
import dataclasses
import io
import json
import re
import shutil
from functools import partial
from html.parser import HTMLParser

import numpy as np
import pytest

from experiments import report
from experiments.drawing import images, plots
from srl_jax.config import Config
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from tests import helpers
from tests.in_process import parse

pytest.importorskip("PIL.Image", reason="needs the extra plots")
pages = pytest.importorskip("experiments.reporting.page", reason="needs the extra plots")
configs, gallery = pages.configs, pages.gallery

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
README = """# Does it *help*?

Yes, <script>alert(1)</script> [more](../other.md), [there](https://example.org) and [no](javascript:x).

## Why

| a | b |
|---|---|
| 1 | 2 |

![drawn](figures/reconstruction.png) ![gone](figures/gone.png) ![outside](../secret.png)
"""


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
        rows.append(row | {"wall_steps_per_s": speed, "loss/rl": 1.5, "train/return_mean": -0.5})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


class Page(HTMLParser):
    """What is in a page: its elements, its text, its tables; everything that opens is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.words, self.tables = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open
        self.text = " ".join("".join(self.words).split())
        self.pictures = [attributes["alt"] for tag, attributes in self.attributes if tag == "img"]

    def handle_starttag(self, tag, attributes):
        self.attributes.append((tag, dict(attributes)))
        if tag not in ("meta", "link", "img", "wbr"):
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag in ("p", "li", "td", "th", "dd", "dt", "h1", "h2", "h3", "figcaption", "span"):
            self.handle_data(" ")

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data

    def table(self, label):
        """Row heading -> its other cells, of the table with this label."""
        labels = [a.get("aria-label") for tag, a in self.attributes if tag == "div" and "tabindex" in a]
        (rows,) = [rows for name, rows in zip(labels, self.tables, strict=True) if name == label]
        return {" ".join(row[0].split()): [" ".join(cell.split()) for cell in row[1:]] for row in rows}


def build(*runs, **options):
    return pages.build(*runs, **options)[0]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Three arms on Catch, one with a name that is HTML; a README, a figure, pictures, diagnostics of one."""
    root = tmp_path_factory.mktemp("report") / "runs"
    lists = {"diag/drift/steps": [[], [0], [0, 100]], "diag/drift/cka": [[], [0.5], [0.25, 0.75]]}
    for (arm, seed), returns in CURVES.items():
        own = {"mode": "joint", "objectives": ("reconstruction:weight=2",)} if arm == "joint" else {}
        diag = (
            {"diag/effective_rank": [3.0, 2.0, None], "diag/new": [1, 2, 3], **lists} if arm == ODD else None
        )
        if arm == "joint":
            own |= {"steps": 300} if seed == 0 else {"steps": 300, "eval_games": 10}
        speed = 50.0 if arm == "joint" else 100.0
        write_run(root / f"Catch/{arm}/seed{seed}", returns, speed=speed, diag=diag, seed=seed, **own)
    images.gif(np.zeros((30, 42, 42, 1), np.uint8), root / "Catch/rl/seed0/figures/play.gif")
    image = np.zeros((2, 8, 8, 1), np.float32)
    for name in ("reconstruction", "other"):
        images.image_panel(image, image, image, root / f"figures/{name}.png", "")
    shutil.copytree(root / "figures", root / "Catch/joint/seed0/figures")
    about = {
        "figure": "6.3",
        "title": "Joint <script>",
        "question": "Is it?",
        "styles": {"rl": ["#000000", "-"]},
    }
    (root / "figures/other.json").write_text(json.dumps(about))
    (root / "README.md").write_text(README)
    shutil.copy(root / "figures/other.png", root.parent / "secret.png")
    return root


@pytest.fixture(scope="module")
def text(runs):
    return build(runs, baseline="rl", data="report.csv")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_nothing_is_asked_for_from_outside(page):
    for tag, attributes in page.attributes:
        assert tag not in ("script", "iframe", "object", "form", "base")
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "srcset", "action"):
            assert attributes.get(name, "data:").startswith("data:")
    policies = [a["content"] for _, a in page.attributes if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies[0].startswith("default-src 'none'")
    ids = [attributes["id"] for _, attributes in page.attributes if "id" in attributes]
    links = [attributes["href"] for tag, attributes in page.attributes if tag == "a" and "href" in attributes]
    assert links == ["report.csv", *(f"#{name}" for name in ids), "https://example.org"]
    assert len(set(ids)) == len(ids) == 12 and all(page.pictures)


def test_the_question_and_the_arms_come_first(page, text):
    head, answer, numbers_, rest = text.split("<h2>", 3)
    assert "<h1>Does it help?</h1>" in head and "Yes, &lt;script&gt;alert(1)&lt;/script&gt;" in answer
    assert "<h3>Why</h3>" in answer and [["a", "b"], ["1", "2"]] in page.tables
    # Its picture is shown there, and is not shown again; what is not there, or lies outside, is its text.
    assert "drawn" in page.pictures and "gone outside" in page.text
    assert page.pictures.count("reconstruction") == 0 and "Figure 6.3. Joint <script>" in page.pictures
    assert "RL alone (the baseline)" in page.text
    joint = (
        "both in every update, and both train the encoder; objectives reconstruction; reconstruction weight 2"
    )
    assert joint in page.text
    assert "What the numbers say" in numbers_ and "Its colours are not this page&#39;s" in rest


def test_every_arm_and_every_run_is_there_as_text(page, text):
    assert ODD in page.text and "<b>" not in text and "<script" not in text
    assert "Figure 6.3. Joint <script> Is it?" in page.text
    every = page.table("Every run")
    assert {f"Catch / {arm} / seed {seed}" for arm, seed in CURVES} < set(every)
    assert every["Catch / joint / seed 0"][:4] == ["300 of 300", "yes", "4", "5.00 at 300"]
    assert "4 of 5 runs complete" in page.text and "Catch / joint / seed 1: 200 of 300 env steps" in page.text
    assert "0123456789" in page.text and "2026-01-02 03:04:05" in page.text and "jax 1.2.3" in page.text


def test_an_arm_has_one_colour_on_the_whole_page(text):
    mark = r'<svg class="mark"[^>]*><path [^>]*(stroke="#\w+" [^>]*)/></svg>'
    marks = re.findall(rf"{mark}\s*(?:Catch / )?([^<(]+)", text)
    found = {}
    for colour, arm in marks:
        found.setdefault(arm.strip(), set()).add(colour)
    assert set(found) == {"rl", "joint", "&lt;b&gt;&amp;&#34;odd&#34;"} and len(marks) > 12
    assert all(len(colours) == 1 for colours in found.values()) and len(set.union(*found.values())) == 3


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
    assert table["joint"][1:3] == ["1.00 (no interval)", "+0.25 over 0.75 [−2.93, +3.43]"]
    assert table["joint"][3:5] == ["0.75 (no interval)", "+0.44 over 0.31 [−1.94, +2.82]"]
    assert table["joint"][5] == "75 (no interval), 2 of 2 did"
    assert table[ODD][:3] == ["1", "−1.00 (no interval)", "−1.75 under 0.75 (no interval)"]
    assert "Compared up to 200 env steps, where rl, seed 0, ended." in page.text
    # Normalised: a miss is -1 and a catch 1. A tie counts half: (0.5 + 1) / 2.
    over = page.table("The return at the end, over games")
    # Of one game the mean has its t interval, 0.125 * 12.706 to either side; what is no mean is drawn again.
    assert over["joint"][0] == "1.00 (no interval)" and over["rl"][0] == "0.88 [−0.71, 2.46]"
    assert over["joint"][3:5] == ["0.00 (no interval)", "0.75 [0.50, 1.00] too narrow"]
    assert "in Catch, a return of −1 is 0 and one of 1 is 1;" in page.text and "human" not in page.text
    for name, policy in reference_policies("Catch").items():
        cell = f"{policy.return_mean:.2f} (5,000 games)".replace("-", "−")
        assert table[f"{name} policy"] == ["–", cell, "–", cell, "–", "–"]
        normal = (policy.return_mean + 1) / 2
        assert over[f"{name} policy"] == [*[f"{normal:.2f}"] * 3, f"{1 - normal:.2f}", "–", "–"]


def test_final_games_have_a_column_and_a_run_without_its_own_is_not_finished(tmp_path):
    for seed, final in enumerate([(1, 3), (4, 6)]):
        helpers.write_run(tmp_path / f"Catch/a/seed{seed}", seed=seed, final=final, final_games=2, steps=100)
    helpers.write_run(tmp_path / "Catch/b/seed0", final_games=2, steps=100, lr_rl=1e-3)
    page = Page(build(tmp_path))
    cells = {arm: row[-1] for arm, row in page.table("Statistics of Catch").items()}
    assert cells["arm"] == "final games" and cells["b"] == "–"
    assert cells["a"] == "3.50 [−15.56, 22.56] 2 games of each of 2 seeds after 100 env steps"
    assert "2 after the last env step; epsilon" in page.text
    assert [row[1] for name, row in page.table("Every run").items() if name != "run"] == ["yes", "yes", "no"]


def test_two_seeds_tell_little(page):
    assert f"rl has 0.31 [−2.07, 2.69]. Not told apart: joint. No interval: {ODD}." in page.text
    assert "Better:" not in page.text and "▲" not in "".join(page.table("Statistics of Catch")["joint"])


def test_training_and_diagnostics_are_drawn_and_every_seed(page):
    names = {name.removeprefix("Catch: ") for name in page.pictures}
    assert {
        "return in training",
        "loss: rl",
        "effective rank",
        "CKA with the last latents",
        "diag/new",
    } < names
    assert {f"{arm}, each seed" for arm, _ in CURVES} < names
    assert "Without diagnostics: Catch / joint / seed 0, Catch / joint / seed 1" in page.text


def test_cost_settings_and_protocol(page):
    labels = [plots.steps_label(game) for game in ("Pong", "CatchDistractor", "")]
    assert labels == ["env steps (4 frames each)", "env steps", "env steps"]
    cost = page.table("Time and cost of each arm")
    assert cost["Catch / rl"] == ["2", "4.0 h", "2.0 h", "100", "1.00 times"]
    assert cost["Catch / joint"][-2:] == ["50", "2.00 times"]
    settings = page.table("Settings in which arms differ")
    assert settings["field"] == ["rl", "joint", ODD] and settings["mode"] == ["rl_only", "joint", "rl_only"]
    assert settings["objectives reconstruction: weight"] == ["–", "2", "–"]
    assert set(settings) == {"field", "mode", "objectives", "objectives reconstruction: weight", "steps"}
    catch, pong = (configs.protocol_text(Config(game=game, frame_size=84)) for game in ("Catch", "Pong"))
    assert catch == (
        "10 full games an evaluation, every 100,000 env steps; epsilon 0.005; at most 27,000 env steps a game"
    )
    assert pong == catch.replace(
        "; at most", "; no sticky actions; fewer than 30 no-ops at the start; at most"
    ) + (", of 4 frames each; in training, a lost life ends the return")


def test_the_same_runs_give_the_same_bytes_and_the_rows_are_beside_them(runs, text, tmp_path, capsys):
    shutil.copytree(runs, tmp_path / "runs")  # with other times of its files
    shutil.copy(runs.parent / "secret.png", tmp_path)
    out = tmp_path / "made/report.html"
    assert report.report(parsed(tmp_path / "runs", f"--out={out}", "--baseline=rl")) == out
    assert out.read_text() == text and {p.name for p in out.parent.iterdir()} == {"report.html", "report.csv"}
    rows = list(csv.DictReader(io.StringIO((out.parent / "report.csv").read_text())))
    assert len(rows) == sum(len(returns) + 2 for returns in CURVES.values())
    row = next(
        x for x in rows if (x["arm"], x["seed"], x["kind"], x["env_step"]) == ("joint", "0", "eval", "300")
    )
    assert row["game"] == "Catch" and row["eval/return_mean"] == "5.0" and row["loss/rl"] == ""
    assert "diag/drift/cka" not in row and "env_steps" not in row
    with pytest.raises(ConfigError, match="report.html: exists; .*--overwrite"):
        report.report(parsed(f"--out={out}", f"--runs={runs}"))
    out.unlink()
    with pytest.raises(ConfigError, match="report.csv exists; .*--overwrite"):
        report.report(parsed(f"--out={out}", f"--runs={runs}"))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("figures/a.png", b"no picture", "a.png: neither a PNG nor a GIF"),
        ("figures/other.json", b"[1]", "other.json: not a JSON object"),
        ("figures/other.json", b"{", "other.json: not JSON"),
        ("README.md", b"\xff", "README.md: .*utf-8"),
        ("Catch/rl/seed0/figures/play.gif", b"<svg>", "play.gif: neither"),
        ("Catch/rl/seed0/config.json", b'{"versions": 1}', "config.json"),
        (
            "Catch/rl/seed0/metrics.jsonl",
            b'{"kind": "train", "env_steps": 1, "wall_s": "x"}\n',
            "wall_s is not",
        ),
    ],
)
def test_what_is_not_what_training_writes_is_named(runs, tmp_path, monkeypatch, file, content, message):
    monkeypatch.setattr(gallery, "learning_curves", lambda *_: {"means": [], "seeds": []})
    monkeypatch.setattr(gallery, "measured", lambda *_: [])
    shutil.copytree(runs, tmp_path / "runs")
    (tmp_path / "runs" / file).write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        build(tmp_path / "runs", force=True)


parsed = partial(parse, report, positional="runs")


def test_the_command_line(monkeypatch, tmp_path, capsys):
    assert parsed("a", "--out=x.html", "b")["runs"].value == ["a", "b"]
    assert parsed("--runs=a", "--runs=b")["runs"].value == ["a", "b"]
    for wrong, message in (
        (["--runs=a", "a"], "unexpected argument"),
        (["a", "--ovewrite"], "did you mean --overwrite"),
    ):
        with pytest.raises(SystemExit) as ended:
            parsed(*wrong)
        assert ended.value.code == 2 and message in capsys.readouterr().err
    assert report.check_reach(["Pong=-3", "gymnasium:id=A-v0=1"]) == {"Pong": -3.0, "gymnasium:id=A-v0": 1.0}
    find = report.importlib.util.find_spec
    monkeypatch.setattr(
        report.importlib.util, "find_spec", lambda name: None if name == "jinja2" else find(name)
    )
    with pytest.raises(ConfigError, match=r"needs Jinja2: pip install 'srl-jax\[plots\]'"):
        report.report(parsed(tmp_path, f"--out={tmp_path}/x.html"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--runs: missing"),
        (["."], "--out: missing"),
        ([".", "--out=a.txt"], "must end in .html or .htm"),
        ([".", "--out=a/b\n.html"], "has the character"),
        ([".", "--out=file/a.html"], "not a directory"),
        (["none", "--out=a.html"], "--runs=none: no such directory"),
        ([".", "none", "--out=a.html"], "--runs=none: no such directory"),
        ([".", "--out=a.html"], "no run directory"),
        ([".", "--out=a.html", "--reach=Pong"], "must be GAME=SCORE"),
        ([".", "--out=a.html", "--reach=Pong=nan"], "must be GAME=SCORE"),
        (
            [".", "--out=a.html", "--reach=Pong=0", "--reach=Pong=1"],
            "--reach=Pong=1: Pong has a score already",
        ),
        (["{runs}", "--out=a.html", "--reach=Pong=1"], "--reach=Pong: no run of that game; valid: Catch"),
        (
            ["{runs}", "--out=a.html", "--baseline=x"],
            "--baseline=x: not an arm with a policy; valid: <b>.*joint, rl",
        ),
    ],
)
def test_what_is_refused_leaves_nothing(runs, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=message):
        report.report(parsed(*(argument.format(runs=runs) for argument in arguments)))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
