"""srl_jax/run/ending.py: what ended.json says, and that nothing else is taken for it."""

import pytest

from srl_jax.errors import ConfigError, SaveError
from srl_jax.run import ending
from srl_jax.run.ending import Ending


def test_it_is_read_as_it_was_written_and_goes(tmp_path):
    assert ending.read(tmp_path) is None
    ending.clear(tmp_path)
    for status in ending.STATUSES:
        ending.write(tmp_path, Ending(status, 5, "ü"))
        assert ending.read(tmp_path) == Ending(status, 5, "ü")
    assert [path.name for path in tmp_path.iterdir()] == ["ended.json"]
    assert [s for s in ending.STATUSES if Ending(s, 0).failed] == ["diverged", "failed"]
    ending.clear(tmp_path)
    assert ending.read(tmp_path) is None


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"status": "finished"}', '{"status": "well", "env_steps": 1}',
        '{"status": "failed", "env_steps": 1.5}', '{"status": "failed", "env_steps": 1, "reason": null}',
        '{"status": "failed", "env_steps": 1, "more": 1}', '{"status": ["failed"], "env_steps": 1}',
    ],
)  # fmt: skip
def test_anything_else_is_refused(tmp_path, text):
    (tmp_path / "ended.json").write_text(text)
    with pytest.raises(ConfigError, match="ended.json: not (what training writes|JSON)"):
        ending.read(tmp_path)


def test_what_cannot_be_written_or_read_is_said(tmp_path):
    (tmp_path / "ended.json").mkdir()
    with pytest.raises(SaveError, match="ended.json: not written"):
        ending.write(tmp_path, Ending("finished", 1))
    with pytest.raises(SaveError, match="ended.json: not removed"):
        ending.clear(tmp_path)
    with pytest.raises(ConfigError, match="ended.json: Is a directory"):
        ending.read(tmp_path)
