"""The API reference: it builds without a warning, has what is public, and hides what is private."""

import html
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import srl_jax
from srl_jax.config import INFOS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """{module: its page}. The build changes `typing`, and has a process of its own therefore."""
    out = tmp_path_factory.mktemp("docs")
    done = subprocess.run(
        [sys.executable, "docs/api.py", str(out)],
        cwd=ROOT, env=os.environ | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    return {
        ".".join(page.relative_to(out).with_suffix("").parts): page.read_text(encoding="utf-8")
        for page in out.rglob("*.html")
    }


def _anchors(page):
    return set(re.findall(r'<(?:section|div) id="([^"]+)"', page))


def test_public_names_are_there(pages):
    # Modules have pages of their own; `losses` is one of another name.
    inside = {name for name in srl_jax.__all__ if name in _anchors(pages["srl_jax"])}
    beside = {name for name in srl_jax.__all__ if f"srl_jax.{name}" in pages}
    assert inside | beside == set(srl_jax.__all__) - {"losses", "__version__"}
    assert {"Window", "Encoder", "Objective", "Objective.__init__"} <= _anchors(pages["srl_jax.types"])
    assert "categorical_q_learning" in _anchors(pages["srl_jax.rl.losses"])
    assert "reconstruction" in _anchors(pages["srl_jax.objectives.reconstruction"])


def test_private_names_are_hidden(pages):
    for module, page in pages.items():
        names = {part for anchor in _anchors(page) for part in anchor.split(".")} | set(module.split("."))
        assert not [name for name in names if name.startswith("_") and name != "__init__"], module


def test_types_and_fields_can_be_read(pages):
    texts = {name: html.unescape(re.sub("<[^>]+>", "", page)) for name, page in pages.items()}
    assert "frames: jax.Array | numpy.ndarray" in texts["srl_jax.types"]
    assert not any("Alias for field" in text or "parent module references" in text for text in texts.values())
    assert all(f"{name}:" in texts["srl_jax"] for name in INFOS)
    assert "capacity of the replay buffer (default: 100000 transitions)" in texts["srl_jax"]
