"""experiments/soaking/__main__.py and the parts: their short versions, and whether they would notice."""

import json

import pytest

from experiments.soaking import Count, cost, damage, disk, kills, memory, small
from experiments.soaking import __main__ as soak
from srl_jax import checkpoint
from srl_jax.errors import ConfigError


def lines(line):
    print(line)


def held(counts):
    assert counts and all(row.number > 0 for row in counts if "skipped" not in row.detail)
    return not any(row.failed for row in counts)


def test_killed_runs_end_as_if_they_had_not_been(tmp_path):
    counts = kills.soak(True, tmp_path, lines)
    assert held(counts)
    assert sum(row.number for row in counts) >= 2


def test_a_difference_between_two_runs_is_found(tmp_path):
    row = {"kind": "train", "env_steps": 1, "updates": 0, "wall_s": 1.0, "loss/rl": 0.5}
    alone = {"digest": {"a": "1", "b": "2"}, "rows": [{k: x for k, x in row.items() if k != "wall_s"}]}
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").write_text(json.dumps(row | {"wall_s": 9.0}) + "\n")
    (tmp_path / "run.digest").write_text('{"a": "1", "b": "2"}')
    assert kills.differing(tmp_path / "run", alone) == []
    (tmp_path / "run.digest").write_text('{"a": "1", "b": "3", "c": "4"}')
    assert kills.differing(tmp_path / "run", alone) == ["b", "c"]
    (tmp_path / "run" / "metrics.jsonl").write_text("")
    assert kills.differing(tmp_path / "run", alone) == ["b", "c", "metrics.jsonl"]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of Catch that was stopped, as all parts that are asked for one get it."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    return small.stopped_run(folder, at=400), folder


def test_damage_is_noticed_and_a_reader_that_looks_away_is_found_out(tmp_path, stopped, monkeypatch):
    _, run = stopped
    monkeypatch.setattr(damage, "stopped_run", lambda folder, at: folder.symlink_to(run))
    assert held(damage.soak(True, tmp_path, lines))
    monkeypatch.setattr(checkpoint, "verify", lambda manifest: None)
    (tmp_path / "again").mkdir()
    assert not held(damage.soak(True, tmp_path / "again", lines))


def test_a_full_disk_loses_nothing_and_a_careless_writer_is_found_out(tmp_path, monkeypatch):
    assert held([disk.in_turn(tmp_path / "one", True, lines)])
    careful = checkpoint.save

    def careless(run, *arguments, **options):
        for old in sorted((run / "checkpoints").glob("[0-9]*"))[:1]:
            checkpoint.shutil.rmtree(old)
        return careful(run, *arguments, **options)

    run = small.stopped_run(tmp_path / "two", at=400)
    monkeypatch.setattr(disk, "stopped_run", lambda folder, at: run)
    monkeypatch.setattr(checkpoint, "save", careless)
    assert disk.in_turn(tmp_path / "two", True, lines).failed


def test_memory_and_cost(tmp_path):
    for part in (memory, cost):
        folder = tmp_path / part.__name__
        folder.mkdir()
        assert held(part.soak(True, folder, lines))


def test_table_and_what_is_kept(tmp_path):
    kills_found = soak.Result("0123456789", False, 90.0, [Count("killed", 1200, 0, "fast")])
    disk_found = soak.Result(None, True, 6.0, [Count("full", 7, 2)])
    results = {"disk": disk_found, "kills": kills_found}
    assert soak.table(results).splitlines() == [
        "| part | tried | times | failed | |",
        "|---|---|---|---|---|",
        "| kills | killed | 1,200 | 0 | fast |",
        "| disk | full | 7 | 2 |  |",
        "",
        "kills 1.5 minutes (0123456), disk 0.1 minutes (None, short).",
    ]
    soak.write(tmp_path, results)
    assert soak.read(tmp_path) == results
    (tmp_path / "soak.json").write_text("[]")
    with pytest.raises(ConfigError, match="without a soak.json"):
        soak.read(tmp_path)


def test_parts_are_chosen_in_order():
    assert soak.chosen(None) == list(soak.PARTS)
    assert soak.chosen(["disk", "kills"]) == ["kills", "disk"]
    with pytest.raises(ConfigError, match="--only=kill: did you mean kills"):
        soak.chosen(["kill"])
