"""What the package says of itself, in several places at once."""

import pathlib
import re
import tomllib

import srl_jax

ROOT = pathlib.Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _cited(field):
    (value,) = re.findall(
        rf"^{field}: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    return value


def test_the_version_is_the_same_everywhere():
    assert PROJECT["version"] == _cited("version") == srl_jax.__version__


def test_the_licence_is_the_same_everywhere():
    assert PROJECT["license"] == _cited("license") == "Apache-2.0"
    (file,) = PROJECT["license-files"]
    text = (ROOT / file).read_text(encoding="utf-8")
    assert "Apache License\n" in text and "Version 2.0, January 2004" in text
    assert "Copyright 2026 The srl_jax authors" in text and "[yyyy]" not in text
    assert "[LICENSE](LICENSE)" in (ROOT / "README.md").read_text(encoding="utf-8")
