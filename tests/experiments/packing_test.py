"""Tests of experiments.packing, and of what reads packed runs."""

import gzip
import json
from pathlib import Path
from unittest import mock

import pytest

from experiments import figures, packing, report
from experiments.runs import collect
from experiments.sweeping import states
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.run.ending import Ending
from srl_jax.training import completed
from tests.helpers import NOT_FINITE, write_run
from tests.in_process import parse

ROW = {
    "kind": "eval", "env_steps": 300, "updates": 9007199254740993, "wall_s": 0.1,
    "eval/return_mean": 0.30000000000000004, "eval/returns": [1, 1.0, -0.0, 1e-45, None],
    "name": "né", "nested": [[], [0, 0.1], None], "on": True,
}  # fmt: skip
"""What JSON may hold: integers beyond a double's, integral floats, -0.0, null, lists in lists, text, bool."""


@pytest.fixture
def root(tmp_path):
    """Two arms of figure 6.3 with two seeds each on Catch, and one run of another layout that failed."""
    root = tmp_path / "runs"
    for seed, returns in enumerate([(-1, 0, 1), (-1, None, 0.5)]):
        write_run(
            root / f"Catch/rl_only_nature/seed{seed}", returns, seed=seed, ended=Ending("finished", 200)
        )
        source = f"Catch/pretrain_256/seed{seed}"
        values = {"seed": seed, "mode": "joint", "encoder_from": source, "steps": 200}
        write_run(root / f"Catch/joint_256/seed{seed}", (0, 1, 0), **values)
    write_run(root / "alone_seed10", (0, 1), seed=10, ended=NOT_FINITE)
    return root


def _told(runs):
    """Everything of runs but their paths, as text: 1 is not 1.0 there, nor True."""
    return [
        (
            run.game,
            run.arm,
            run.config,
            run.ended,
            json.dumps(run.rows),
            json.dumps(run.about, sort_keys=True),
        )
        for run in runs
    ]


def test_a_packed_run_is_the_run(root, tmp_path):
    path = root / "Catch/joint_256/seed1/config.json"
    about = {"versions": {"jax": "1.2"}, "started": "then", "cpus": 2, "gamma": 1}
    path.write_text(json.dumps(json.loads(path.read_text()) | about))
    beside = root / "Catch/joint_256/seed0/config.json"
    beside.write_text(json.dumps(json.loads(beside.read_text()) | {"gamma": 1.0}))
    with open(root / "alone_seed10/metrics.jsonl", "a") as file:
        file.write(json.dumps(ROW) + "\n")
    assert packing.pack(root, tmp_path / "out") == (5, 5, [])
    runs = collect.load_runs(root)
    packed = collect.load_runs(tmp_path / "out")
    assert _told(packed) == _told(runs)
    assert json.loads(json.dumps(packed[0].rows[-1])) == ROW
    assert [run.path.relative_to(tmp_path / "out") for run in packed] == [
        run.path.relative_to(root) for run in runs
    ]
    assert packing.read(tmp_path / "out", only_last=True)[0].rows == [ROW]
    assert packing.unpack(tmp_path / "out", tmp_path / "again") == 5
    for run in runs:
        again = tmp_path / "again" / run.path.relative_to(root) / "metrics.jsonl"
        assert again.read_bytes() == (run.path / "metrics.jsonl").read_bytes()
    # Unpacked, those that have all their env steps say so, or a sweep would take them for killed.
    assert [run.over for run in runs if run.ended is None] == [True, True]
    ended = [run if run.ended else run._replace(ended=Ending("finished", 200)) for run in runs]
    assert _told(collect.load_runs(tmp_path / "again")) == _told(ended)
    path = tmp_path / "again/Catch/joint_256/seed0"
    assert states.look(path, completed(Config.load(path))).kind == "done"
    with pytest.raises(ConfigError, match="a run is there"):
        packing.unpack(tmp_path / "out", tmp_path / "again")


def test_an_arm_has_one_configuration_and_a_run_what_is_its_own(root, tmp_path):
    packing.pack(root, tmp_path / "out")
    configs = json.loads((tmp_path / "out/configs.json").read_text())
    assert [arm["arm"] for arm in configs] == ["alone", "joint_256", "rl_only_nature"]
    assert [run["path"] for run in configs[1]["runs"]] == [f"Catch/joint_256/seed{seed}" for seed in (0, 1)]
    own = {"seed": 1, "encoder_from": "Catch/pretrain_256/seed1"}
    assert configs[1]["runs"][1]["config"] == own and not own.keys() & configs[1]["config"].keys()
    assert configs[1]["config"]["game"] == "Catch" and configs[0]["runs"][0]["config"] == {"seed": 10}
    assert configs[0]["runs"][0]["ended"]["reason"] == NOT_FINITE.reason


def test_pandas_reads_all_rows_in_a_line(root, tmp_path):
    pandas = pytest.importorskip("pandas")
    packing.pack(root, tmp_path / "out")
    rows = pandas.read_json(tmp_path / "out/rows.jsonl.gz", lines=True)
    last = rows[rows.env_steps == 200].set_index(["arm", "seed"])["eval/return_mean"]
    assert last["rl_only_nature"].to_dict() == {0: 1.0, 1: 0.5} and len(rows) == 4 * 4 + 3


def test_runs_are_added_in_any_order_to_the_same_bytes(root, tmp_path):
    packing.pack(root, tmp_path / "all")
    late = root / "Catch/joint_256/seed0"
    late.rename(tmp_path / "late")
    assert packing.pack(root, tmp_path / "some") == (4, 4, [])
    some = {path.name: path.read_bytes() for path in (tmp_path / "some").iterdir()}
    (tmp_path / "some/README.md").write_text("Why?")
    (tmp_path / "late").rename(late)
    assert packing.pack(root, tmp_path / "some") == (1, 5, [])
    for name in (packing.CONFIGS, packing.ROWS):
        assert (tmp_path / "some" / name).read_bytes() == (tmp_path / "all" / name).read_bytes() != some[name]
    assert packing.pack(root, tmp_path / "some") == (0, 5, [])
    assert sorted(path.name for path in (tmp_path / "some").iterdir()) == ["README.md", *sorted(some)]


def test_a_run_that_is_there_with_other_rows_or_settings_is_refused(root, tmp_path):
    packing.pack(root, tmp_path / "out")
    there = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    over = Ending("finished", 200)
    write_run(tmp_path / "rows/Catch/joint_256/seed5", seed=5, ended=over)
    write_run(tmp_path / "rows/Catch/rl_only_nature/seed0", (-1, 0, 2), ended=over)
    write_run(tmp_path / "settings/Catch/rl_only_nature/seed0", (-1, 0, 1), gamma=0.9, ended=over)
    for what in ("rows", "settings"):
        with pytest.raises(ConfigError, match=f"Catch, rl_only_nature, seed 0 is there with other {what}"):
            packing.pack(tmp_path / what, tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == there


def test_two_runs_have_two_places(root, tmp_path):
    over = Ending("finished", 200)
    write_run(tmp_path / "a/one", seed=0, ended=over)
    write_run(tmp_path / "b/one", seed=0, gamma=0.9, game="CatchDistractor", ended=over)
    packing.pack(tmp_path / "a", tmp_path / "out")
    with pytest.raises(
        ConfigError, match=r"out/one: the place of Catch, .* and of CatchDistractor, .*seed 0"
    ):
        packing.pack(tmp_path / "b", tmp_path / "out")
    configs = tmp_path / "out" / packing.CONFIGS
    text = configs.read_text()
    for path in ("../one", "/tmp/one"):
        configs.write_text(text.replace('"path": "one"', f'"path": "{path}"'))
        with pytest.raises(ConfigError, match=f"{path} is not below the folder"):
            packing.unpack(tmp_path / "out", tmp_path / "again")


def test_a_run_that_is_packed_by_itself_keeps_its_name(tmp_path):
    for name in "ab":
        packing.pack(write_run(tmp_path / "runs" / name, ended=Ending("finished", 100)), tmp_path / "out")
    packing.unpack(tmp_path / "out", tmp_path / "again")
    assert [run.arm for run in collect.load_runs(tmp_path / "again")] == ["a", "b"]
    # So does that of its seeds.
    for seed in range(2):
        write_run(tmp_path / f"joint/seed{seed}", seed=seed, ended=Ending("finished", 100))
    for i, place in enumerate(("joint", "joint/seed0")):
        packing.pack(tmp_path / place, tmp_path / f"packed{i}")
        packing.unpack(tmp_path / f"packed{i}", tmp_path / f"unpacked{i}")
        assert {run.arm for run in collect.load_runs(tmp_path / f"unpacked{i}")} == {"joint"}


def test_what_packing_did_not_write_is_refused(root, tmp_path):
    out = tmp_path / "out"
    packing.pack(root, out)
    configs, rows = (out / packing.CONFIGS).read_text(), gzip.decompress((out / packing.ROWS).read_bytes())
    whole, first = gzip.compress(rows), rows.splitlines()[0]

    def refused(match, *, configs=configs, data=whole):
        (out / packing.CONFIGS).write_text(configs)
        (out / packing.ROWS).write_bytes(data)
        with pytest.raises(ConfigError, match=match) as error:
            packing.read(out)
        assert "\n" not in str(error.value)

    refused("rows.jsonl.gz: damaged", data=whole[:-9])
    refused("rows.jsonl.gz: damaged", data=rows)
    refused("line 1: not what packing writes", data=gzip.compress(first.replace(b'"arm"', b'"leg"')))
    refused("line 1: not what packing writes", data=gzip.compress(b"[]"))
    refused("alone_seed10, line 1: kind is none of", data=gzip.compress(first.replace(b"eval", b"game", 1)))
    refused("rows of Catch, x, seed 10, which", data=gzip.compress(first.replace(b"alone", b"x")))
    refused("configs.json: not what packing writes", configs='{"arm": 1}')
    refused("configs.json: not what packing writes", configs=configs.replace('"path"', '"place"', 1))
    refused("alone_seed10: config: no field 'gama'", configs=configs.replace('"gamma"', '"gama"', 1))
    (out / packing.ROWS).unlink()
    with pytest.raises(ConfigError, match="rows.jsonl.gz: No such file"):
        packing.read(out)


def test_a_run_that_may_get_more_rows_is_left_out(root, tmp_path):
    part = write_run(root / "Catch/joint_256/seed2", (0, 1), seed=2, mode="joint", steps=200)
    none = write_run(root / "Catch/joint_256/seed3", (), seed=3, mode="joint", steps=200)
    assert packing.pack(root, tmp_path / "out") == (5, 5, [part, none])


def test_a_run_that_may_be_playing_its_final_games_is_left_out(tmp_path):
    part = write_run(tmp_path / "runs/part", steps=100, final_games=2)
    write_run(tmp_path / "runs/whole", steps=100, final_games=2, final=(1, 2), ended=Ending("finished", 100))
    assert packing.pack(tmp_path / "runs", tmp_path / "out") == (1, 1, [part])
    (run,) = packing.read(tmp_path / "out")
    assert run.rows[-1]["final/returns"] == [1, 2]


def test_a_row_that_has_a_key_of_packing_is_refused(root, tmp_path):
    with open(root / "alone_seed10/metrics.jsonl", "a") as file:
        file.write(json.dumps(ROW | {"seed": 1}) + "\n")
    with pytest.raises(ConfigError, match="alone_seed10: its rows have a key 'seed'"):
        packing.pack(root, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def _figures(out, *more):
    given = ["--figure=6.3", "--games=Catch", "--seeds=2", f"--out={out}", *more]
    return figures.run(parse(figures, *given))


def test_a_figure_and_a_page_are_the_same_from_packed_runs(root, tmp_path):
    pytest.importorskip("matplotlib")
    packing.pack(root, tmp_path / "packed/runs")
    for out in (root, tmp_path / "packed/runs"):
        assert _figures(out, "--redraw") == 0
    pages = []
    for out in (root, tmp_path / "packed/runs"):
        page = tmp_path / f"page_of_{out.parent.name}/page.html"
        page = report.report(parse(report, f"--runs={out}", f"--out={page}", "--force"))
        pages.append(page.read_bytes())
    for name in ("6.3.json", "6.3.png"):
        drawn = [(out / "figures" / name).read_bytes() for out in (root, tmp_path / "packed/runs")]
        assert drawn[0] == drawn[1]
    assert pages[0] == pages[1]


def test_packed_runs_are_not_run_again_in_their_place_nor_counted_twice(root, tmp_path):
    packing.pack(root, root)
    with pytest.raises(ConfigError, match="its runs are packed; draw them with --redraw"):
        _figures(root, "--dry_run")
    with pytest.raises(ConfigError, match="the same game, arm and seed as"):
        collect.load_runs(root)
    with pytest.raises(ConfigError, match="the same game, arm and seed as"):
        collect.load_named(root, ["Catch/joint_256/seed1"])
    assert collect.arm_names(root) == ["alone", "joint_256", "rl_only_nature"]


def test_the_command_line(root, tmp_path, capsys):
    def main(*arguments):
        packing.main(parse(packing, *arguments, positional="runs"))

    main(root, f"--out={tmp_path / 'out'}")
    main(tmp_path / "out", f"--out={tmp_path / 'again'}", "--unpack")
    told = f"{tmp_path / 'out'}: 5 runs added, 5 in all\n{tmp_path / 'again'}: 5 runs unpacked\n"
    assert capsys.readouterr().out == told
    for arguments, why in (
        ([f"--out={tmp_path / 'new'}"], "--runs: missing"),
        ([root], "--out: missing"),
        ([root, f"--out={root}"], "name a folder that is neither in --runs nor around it"),
        ([root, f"--out={root / 'packed'}"], "name a folder that is neither in --runs nor around it"),
        ([root, f"--out={root.parent}"], "name a folder that is neither in --runs nor around it"),
        ([tmp_path / "none", f"--out={tmp_path / 'new'}"], "--runs=.*none: no such directory"),
        ([tmp_path / "out", f"--out={tmp_path / 'new'}"], "out: no run directory there"),
        ([root, f"--out={root / 'alone_seed10/config.json'}"], "exists and is not a directory"),
        ([root, f"--out={tmp_path / 'new'}", "--unpack"], "configs.json: No such file"),
        ([tmp_path / "out", f"--out={tmp_path / 'out'}", "--unpack"], "name a folder that is neither"),
        ([tmp_path / "out", f"--out={tmp_path / 'new'}", "--unpack", "--stopped"], "^--stopped: --unpack"),
    ):
        with pytest.raises(ConfigError, match=why):
            main(*arguments)
    assert not (tmp_path / "new").exists()


def test_a_run_that_was_stopped_is_packed_when_it_has_ended_or_is_asked_for(tmp_path):
    run = write_run(tmp_path / "runs/Catch/a/seed0", (0, 1), ended=Ending("stopped", 100))
    write_run(tmp_path / "runs/Catch/a/seed1", (0, 1, 2), ended=Ending("finished", 200), seed=1)
    assert packing.pack(tmp_path / "runs", tmp_path / "out") == (1, 1, [run])
    assert packing.pack(tmp_path / "runs", tmp_path / "out", stopped=True) == (1, 2, [])


def test_a_run_without_rows_is_read(tmp_path):
    run = write_run(tmp_path / "runs/Catch/a/seed0", ended=NOT_FINITE)
    (run / "metrics.jsonl").write_text("")
    packing.pack(tmp_path / "runs", tmp_path / "out")
    (read,) = packing.read(tmp_path / "out")
    assert read.rows == [] and read.ended == NOT_FINITE
    assert packing.read(tmp_path / "out", only_last=True)[0].rows == []


def test_an_addition_that_was_killed_between_its_files_is_made_again(root, tmp_path, monkeypatch):
    out = tmp_path / "out"
    packing.pack(write_run(tmp_path / "first/a/seed0", ended=Ending("finished", 100)).parents[1], out)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(packing, "replace_text", mock.Mock(side_effect=KeyboardInterrupt))
        packing.pack(root, out)
    with pytest.raises(ConfigError, match="configs.json does not have; packing the same runs again mends it"):
        packing.read(out)
    assert packing.pack(root, out) == (5, 6, [])
    assert len(packing.read(out)) == 6


def test_packed_runs_are_found_by_what_they_are_runs_of(root, tmp_path, monkeypatch):
    monkeypatch.chdir(root / "Catch/joint_256")
    packing.pack(Path("."), tmp_path / "out")  # as seed0 and seed1
    packing.pack(root, tmp_path / "out")
    names = [f"Catch/{arm}/seed{seed}" for seed in (1, 0) for arm in ("joint_256", "rl_only_nature")]
    found = collect.load_named(tmp_path / "out", names)
    assert [f"{run.game}/{run.arm}/seed{run.seed}" for run in found] == names
    monkeypatch.chdir(root / "Catch/rl_only_nature/seed0")
    packing.pack(Path("."), tmp_path / "alone")
    assert [run.path.name for run in collect.load_runs(tmp_path / "alone")] == ["seed0"]
