"""What the documentation says: links lead somewhere, commands parse, registries are complete, code works."""

import collections
import functools
import json
import re
import runpy
import shlex
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from absl import flags

from experiments import arms
from experiments.command_line import flags as config_flags
from experiments.command_line.cli import COMMANDS
from srl_jax import encoders, envs, objectives, rl
from srl_jax.learning import modes
from srl_jax.plugins import Registry
from srl_jax.types import Context, Latents, Window

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "WORKSPACE.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:srun )?(python -m experiments\.\S+|srl-jax )")


def _text(page):
    """A page without its code blocks."""
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def _blocks(page, language):
    return [code for kind, code in BLOCK.findall(page.read_text(encoding="utf-8")) if kind == language]


def _commands(page):
    """Command lines in code blocks and between backticks, as lists of words."""
    blocks = "\n".join(_blocks(page, "") + _blocks(page, "bash")).replace("\\\n", " ")
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", _text(page))]
    for line in [*blocks.splitlines(), *spans]:
        if COMMAND.match(line):
            yield shlex.split(re.sub(r"\$\{?\w+\}?", "0", line.removeprefix("srun ")), comments=True)


def _by_module():
    """{module: the arguments of each command that runs it}."""
    found = collections.defaultdict(list)
    for words in (words for page in PAGES for words in _commands(page)):
        if words[0] == "python":
            module, arguments = words[2].removeprefix("experiments."), words[3:]
        else:
            module, arguments = COMMANDS[words[1]].module or words[1], words[2:]
        if module == "resume":  # which trains, with the flags behind the run
            module, arguments = "train", arguments[1:]
        found[module].append(arguments)
    return dict(found)


def _anchors(page):
    """Of a page's headings, as GitHub names them."""
    titles = re.findall(r"^#+ (.*)$", _text(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", _text(page)):
        if not link.startswith("https://"):
            path, _, anchor = link.partition("#")
            target = (page.parent / path) if path else page
            assert target.exists(), link
            assert not anchor or anchor in _anchors(target), link


def test_every_page_can_be_reached_from_the_readme():
    links = re.findall(r"\]\((docs/[^)#\s]+)", _text(ROOT / "README.md"))
    assert {ROOT / link for link in links} == set(ROOT.glob("docs/*.md"))


def _parse(monkeypatch, module, commands):
    """Defines the flags of a module and parses command lines with them, in place of running it."""

    def parse_all(main, define_flags, positional=None):
        def cli():
            for arguments in commands:
                define_flags(values := flags.FlagValues())
                config_flags.parse([module, *arguments], values, positional)
            parsed.append(module)

        return cli

    parsed = []
    monkeypatch.setattr(config_flags, "program", parse_all)
    runpy.run_module(module, run_name="__main__")
    assert parsed == [module]


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("module", sorted(_by_module()))
def test_commands_parse(module, monkeypatch):
    folder = (ROOT / "experiments" / module).is_dir()
    spec = find_spec(f"experiments.{module}{'.__main__' if folder else ''}")
    source = Path(spec.origin).read_text(encoding="utf-8")
    if "config_flags.program(" not in source:
        pytest.skip("it has no flags")
    _parse(monkeypatch, f"experiments.{module}", _by_module()[module])


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_an_unknown_flag_is_found(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        _parse(monkeypatch, "experiments.draw", [["--run=x"], ["--nothing=1"]])
    assert ended.value.code == 2 and "--nothing: no such flag" in capsys.readouterr().err


@pytest.mark.parametrize(
    "rows", [rl.REGISTRY, encoders.REGISTRY, objectives.REGISTRY, modes.MODES, envs.REGISTRY, COMMANDS],
    ids=["rl", "encoders", "objectives", "modes", "envs", "commands"],
)  # fmt: skip
def test_every_row_is_named(rows):
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    for name in rows:
        assert re.search(rf"(?<![\w/]){name}(?!\w)", text), name


def test_the_costs_of_objectives_are_those_that_were_measured():
    rows = json.loads((ROOT / "experiments/results/bench/objectives.json").read_text(encoding="utf-8"))[
        "rows"
    ]
    measured = {
        name.removeprefix("objective_"): f"{row['figures']['ratio']['median']:.2f}"
        for name, row in rows.items()
    }
    for page in (ROOT / "README.md", ROOT / "docs" / "objectives.md"):
        table = re.findall(
            r"(?<=\| )((?:`\w+`(?:, )?)+) \|(?:[^|]+\|)? ((?:\d\.\d\d(?:, )?)+)(?= \|)",
            page.read_text("utf-8"),
        )
        told = [
            pair
            for names, costs in table
            for pair in zip(re.findall(r"\w+", names), costs.split(", "), strict=True)
        ]
        ours = {name for name, row in objectives.REGISTRY.items() if row.__module__.startswith("srl_jax.")}
        assert dict(told) == {name: cost for name, cost in measured.items() if name in ours}, page
        assert len(told) == len(ours)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_is_python_and_json(page):
    for code in _blocks(page, "python"):
        compile(code, page.name, "exec")
    for text in _blocks(page, "json"):
        json.loads(text)


@pytest.fixture
def registry(monkeypatch):
    """A registry of objectives that is empty, and that nobody else sees."""
    registry = Registry("objectives", {})
    monkeypatch.setattr(objectives, "register", registry.register)
    return registry


def test_the_objectives_of_the_tutorial_are_objectives(registry):
    """Each block registers one; its loss is 0 where latents stand still, and where the episode has ended."""
    for code in _blocks(ROOT / "docs/tutorial.md", "python"):
        if ".register(" in code:
            exec(compile(code, "tutorial.md", "exec"), {"__name__": "tutorial"})
    assert list(registry) == ["consistency", "continuity"]
    batch, features = 3, 5
    z = jax.random.normal(jax.random.key(0), (4, batch, features))
    latents = Latents(lambda k: z[k], lambda ks: z[jnp.array(ks)])
    still = Latents(lambda k: z[0], lambda ks: z[jnp.zeros(len(ks), int)])

    @functools.partial(jax.jit, static_argnums=(0, 2))
    def losses_of(loss, head, latents):
        return loss(head, head, latents, window, jax.random.key(2))[0]

    for factory in registry.values():
        objective = factory(Context(features, num_actions=2))
        head = jax.jit(objective.init)(jax.random.key(1))
        step = jnp.zeros((batch, objective.horizon))
        window = Window(None, step.astype(int), step, step, step.at[0].set(1), jnp.ones(batch))
        losses = losses_of(objective.loss, head, latents)
        assert losses.shape == (batch,) and losses[0] > 0 and (losses[1:] == 0).all()
        head = jax.tree.map(jnp.zeros_like, head)  # of consistency, which then predicts no change
        assert jnp.allclose(losses_of(objective.loss, head, still), 0, atol=1e-5)


def test_the_figure_of_the_tutorial_is_a_figure(tmp_path):
    (text,) = _blocks(ROOT / "docs/tutorial.md", "json")
    path = tmp_path / "consistency.json"
    path.write_text(text)
    figure = arms.read_figure(path)
    assert [arm.name for arm in figure.arms] == ["rl_only", "consistency", "consistency_short"]
