"""No option and no flag is taken and not read: what is changed alone changes something, or is refused."""

import dataclasses
import functools
import re
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from experiments import packing
from srl_jax import checks, encoders, envs, objectives, plugins, rl, specs
from srl_jax.checks import NEEDS
from srl_jax.config import INFOS, Config, unresolved
from srl_jax.encoders.options import ENDS, POOLS
from srl_jax.errors import ConfigError
from srl_jax.layers import INITIALISERS
from srl_jax.learning.agent import components
from srl_jax.needs import EVERYTHING, Unread
from srl_jax.rl.values import PRIORITIES
from srl_jax.training import completed, refuse_unread
from srl_jax.types import Context
from tests.helpers import NUM_ACTIONS, SMALL, make_encoder
from tests.observed import BESIDE, Observed, of_agent, of_algorithm, of_encoder, of_objective

ENCODER = encoders.tiny((18, 18, 4), features=8)
CONTEXT = Context.of(ENCODER, NUM_ACTIONS)._replace(rl_layer=BESIDE.first_layer)
REGISTRIES = {"rl": rl.REGISTRY, "encoder": encoders.REGISTRY, "objective": objectives.REGISTRY}
ROWS = [(kind, row) for kind, registry in REGISTRIES.items() for row in registry]
TINY = {
    "hidden": "8",
    "outputs": "8",
    "atoms": "5",
    "quantiles": "4",
    "target_quantiles": "4",
    "act_quantiles": "4",
}
TINY |= {"cosines": "4", "steps": "1", "n_step": "2"}

TEXTS = {
    "init": tuple(INITIALISERS), "end": tuple(ENDS), "pool": POOLS, "padding": ("valid", "same"),
    "priority": PRIORITIES, "slow": rl.SLOW, "act_with": rl.ACTORS, "rl target": tuple(rl.N_STEP_VIEWS),
    "view": ("none", "shift", "intensity"), "distance": ("squared", "cosine"),
    "similarity": ("bilinear", "cosine"), "norm": ("half_squared", "l2"), "action": ("joined", "multiplied"),
    "reward loss": ("two_hot", "squared"), "terminal loss": ("cross_entropy", "squared"),
    "forward_pixels target": ("observation", "difference"),
    "forward_latent target": ("slow", "periodic", "stopped", "gradient"),
    "spr target": ("slow", "stopped"), "projection": ("own", "rl"), "latent_l2 target": ("zero", "slow"),
}  # fmt: skip
"""{option, behind its row or registry where it means several things: its texts}."""


def others(kind: str, row: str, option: str, value) -> list[str]:
    """Other values of an option than this one, of which the first is tried."""
    if isinstance(value, bool):
        return [specs.value_text(not value)]
    if isinstance(value, str):
        names = (name for name in (f"{row} {option}", f"{kind} {option}", option) if name in TEXTS)
        return [text for text in TEXTS[next(names)] if text != value]
    if isinstance(value, int):
        return [str(value + 1), str(2 * value)]
    return [repr(value / 2), repr(2 * value)] if value else ["0.5", "8.0"]


@functools.cache
def observed(kind: str, text: str) -> Observed:
    """What a row does."""
    registry = REGISTRIES[kind]
    spec = specs.parse(text, registry, kind)
    if kind == "encoder":
        return of_encoder(plugins.build(spec, registry, (84, 84, 4)))
    found = plugins.build(spec, registry, CONTEXT)
    return of_algorithm(found, make_encoder()) if kind == "rl" else of_objective(found, ENCODER)


def refusal(kind: str, text: str, option: str) -> str:
    """Why a run refuses an option that was given; "" where it takes it."""
    spec = specs.parse(text, REGISTRIES[kind], kind)
    learner = spec if kind == "rl" else specs.parse("rainbow", rl.REGISTRY, "rl")
    run = checks.run_of(Config(mode="joint", rl=str(learner)), rl=learner)
    prefix = spec.name if kind == "objective" else kind
    try:
        run.spec_in_force(spec, [f"{prefix}:{option}"])
    except specs.SpecError as error:
        assert str(error).startswith(f"--{kind}={spec}: nothing reads {option} with"), error
        assert str(error).endswith("; leave it out")
        return str(error)
    return ""


def settings(kind: str, row: str, option: str, defaults: dict) -> dict[str, dict[str, str]]:
    """What is tried beside an option: the defaults, and what it needs of its row, or the contrary."""
    found: dict[str, dict[str, str]] = {"": {}}
    need = specs.needs_of(REGISTRIES[kind][row]).get(option, "")
    parts = [re.split("(!?=)", part) for part in need.split(",") if "=" in part and ":" not in part]
    for name, sign, text in parts:
        if name not in defaults:
            continue
        holds = (specs.parse_value(text, type(defaults[name])) == defaults[name]) == (sign == "=")
        if holds:
            found[f"not {name}"] = {
                name: text if sign == "!=" else others(kind, row, name, defaults[name])[0]
            }
        else:
            met = text if sign == "=" else others(kind, row, name, defaults[name])[0]
            found.setdefault("met", {})[name] = met
    return found


@pytest.mark.parametrize(("kind", "row"), ROWS)
def test_an_option_changes_something_or_is_refused(kind, row):
    defaults = specs.option_defaults(REGISTRIES[kind][row])
    small = {name: text for name, text in TINY.items() if name in defaults}
    if kind == "rl" and row != "rainbow":  # what it has as `q_learner` has it, is tried there
        shared = specs.option_defaults(rl.q_learner)
        own = [name for name, value in defaults.items() if shared.get(name) != value]
    else:
        own = list(defaults)
    for option in own:
        default = defaults[option]
        for name, beside in settings(kind, row, option, defaults).items():
            base = {**small, **beside, **({"double": "false"} if option.startswith("munchausen") else {})}
            value = specs.parse_value(base[option], type(default)) if option in base else default
            before, tried = observed(kind, specs.join(row, base)), []
            for text in others(kind, row, option, value):
                try:
                    tried.append((observed(kind, specs.join(row, {**base, option: text})) != before, text))
                except ValueError:  # does not go with the others, and that is said
                    continue
                if tried[-1][0]:
                    break
            assert tried, f"{option}: no value of it goes with {base}"
            changed, text = tried[-1]
            refused = refusal(kind, specs.join(row, {**base, option: text}), option)
            assert changed == (not refused), (option, text, base, refused)
            if name:
                assert changed == (name == "met"), (option, base)
            elif refused:
                assert "met" in settings(kind, row, option, defaults), f"{option} is never read"


LEAN = "hidden=8,atoms=5,double=false,dueling=false,noisy=false"
"""Options of `rainbow` with which it is traced fast."""


def with_rl(options: str) -> dict:
    return {"rl": f"rainbow:{LEAN},{options}"}


def with_objectives(*texts: str, mode: str = "joint", **values) -> dict:
    return {"mode": mode, "objectives": texts, **values}


BASES = {
    "rl_only": {},
    "frozen": {"mode": "frozen", "encoder_from": "x"},
    "pretrain": with_objectives("inverse:hidden=8", mode="pretrain"),
    "slow pretrain": with_objectives("latent_l2:target=slow", mode="pretrain"),
    "stopped pretrain": with_objectives("forward_latent:hidden=8,target=stopped", mode="pretrain"),
    "byol pretrain": with_objectives("byol:hidden=8,outputs=8", mode="pretrain"),
    "given policy": with_objectives("latent_l2", mode="pretrain", policy_from="x"),
    "joint": with_objectives("reconstruction"),
    "summed": with_objectives("inverse:hidden=8", encoder_optimizer="summed"),
    "no head": with_objectives("latent_l2", encoder_optimizer="summed"),
    "no head, two Adams": with_objectives("latent_l2"),
    "no head, decoupled": with_objectives("latent_l2", mode="decoupled"),
    "ratio": with_objectives("latent_l2:weight=ratio:0.1"),
    "srl_stopped": with_objectives("inverse:hidden=8", gate="srl_stopped"),
    "decoupled": with_objectives("inverse:hidden=8", mode="decoupled"),
    "views": with_objectives("latent_l2", rl_view="shift", srl_view="shift"),
    "own views": with_objectives("byol:hidden=8,outputs=8", **with_rl("view=shift")),
    "uniform": with_rl("prioritized=false"),
    "alpha": with_rl("alpha=0"),
    "ema": with_rl("slow=ema"),
    "no slow": with_rl("slow=none"),
    "constant": {"eps_train": 0.1, "eps_final": 0.1, "beta": 0.5, "beta_final": 0.5},
    "heads": {"reset": "head", "reset_every": 32},
    "all": {"reset": "all", "reset_every": 32},
}
"""Runs beside which a flag is given."""

FLAGS: dict[str, tuple] = {
    # field: (a value, where it is read, where it is not)
    "rl": ("rainbow:hidden=8,n_step=2", ["rl_only"], ["pretrain"]),
    "augment": ("srl", ["joint"], ["rl_only", "views", "own views"]),
    "rl_view": ("intensity", ["rl_only"], ["pretrain", "own views"]),
    "srl_view": ("intensity", ["pretrain"], ["rl_only", "own views"]),
    "target_view": (
        "intensity",
        ["rl_only", "slow pretrain", "stopped pretrain"],
        ["pretrain", "byol pretrain", "own views"],
    ),
    "srl_every": (2, ["joint"], ["rl_only"]),
    "encoder_optimizer": ("simultaneous", ["joint"], ["rl_only", "srl_stopped", "decoupled"]),
    "gate": ("srl_stopped", ["joint"], ["rl_only"]),
    "target_encoder": ("online", ["rl_only", "byol pretrain", "ema"], ["pretrain", "no slow"]),
    "gamma": (0.5, ["rl_only"], ["pretrain"]),
    "gamma_anneal": ("0.9->0.99@20", ["rl_only"], ["pretrain"]),
    "n_anneal": ("3->1@20", ["rl_only"], ["pretrain"]),
    "reset": ("all", ["heads"], []),
    "reset_every": (96, ["heads"], ["rl_only"]),
    "reset_last": (70, ["heads"], ["rl_only"]),
    "shrink": (0.8, ["all"], ["heads"]),
    "lr_rl": (1e-3, ["rl_only", "frozen"], ["pretrain"]),
    "lr_srl": (
        1e-3,
        ["summed", "decoupled", "no head, two Adams", "no head, decoupled"],
        ["rl_only", "no head", "ratio"],
    ),
    "lr_encoder": (1e-3, ["rl_only", "pretrain"], ["frozen"]),
    "lr_encoder_srl": (1e-3, ["joint"], ["rl_only", "frozen", "summed", "ratio", "decoupled"]),
    "decoder_weight_decay": (1e-3, ["joint"], ["rl_only", "summed"]),
    "beta": (0.7, ["rl_only"], ["pretrain", "uniform", "alpha"]),
    "beta_final": (0.7, ["rl_only"], ["pretrain", "uniform", "alpha"]),
    "beta_anneal_steps": (1000, ["rl_only"], ["pretrain", "uniform", "constant"]),
    "eps_train": (0.7, ["rl_only"], ["pretrain"]),
    "eps_final": (0.7, ["rl_only"], ["pretrain"]),
    "eps_anneal_steps": (1000, ["rl_only"], ["pretrain", "constant"]),
    "slow_update_every": (7, ["rl_only", "frozen"], ["pretrain", "ema", "no slow"]),
    "pretrain_epsilon": (0.7, ["given policy"], ["rl_only", "pretrain"]),
}

OF_HOST = {
    "policy_from": ("y", ["pretrain"], ["rl_only", "joint"]),
    "heads_from": ("all", ["frozen"], ["rl_only", "pretrain"]),
    "diagnostics_kept": (5, ["rl_only"], []),
    **{
        name: (value, ["rl_only", "frozen"], ["pretrain"])
        for name, value in {
            "eps_eval": 0.1, "eval_games": 7, "eval_envs": 3, "final_games": 9,
            "eval_max_steps": 99, "stop_at_return": 5.0, "keep_best": False,
        }.items()
    },
}  # fmt: skip
"""Flags that the host alone reads, likewise."""


def base(name: str, **values) -> Config:
    unread = {"eval_games", "slow_update_every"} | ({"rl"} if "pretrain" in str(BASES[name]) else set())
    small = {**SMALL, "rl": f"rainbow:{LEAN}", "encoder": "linear", "diagnostics": True}
    return Config(**{**{k: x for k, x in small.items() if k not in unread}, **BASES[name], **values})


def resolved(config: Config, given) -> Config:
    """As `srl_jax.training.resolved`, at the size of the frames."""
    config = checks.check(config, given=given)
    full = completed(config, given)
    _, _, terms = components(full, (42, 42, 1), NUM_ACTIONS)
    refuse_unread(config, full, terms, given)
    return full


seen = functools.cache(of_agent)


@pytest.fixture(scope="module", autouse=True)
def linear():
    """A row of encoders that is traced fast; ROWS are the package's."""
    encoders.REGISTRY["linear"] = lambda shape: make_encoder(shape=shape)
    yield
    del encoders.REGISTRY["linear"]


def test_every_flag_that_is_not_always_read_is_tried():
    assert FLAGS.keys() | OF_HOST.keys() == NEEDS.keys() < INFOS.keys()


@pytest.mark.parametrize("field", [*FLAGS, *OF_HOST])
def test_a_flag_changes_something_or_is_refused(field):
    value, read, unread = {**FLAGS, **OF_HOST}[field]
    for name in read:
        before, after = base(name), base(name, **{field: value})
        assert resolved(after, [field]) != resolved(before, ())
        if field in FLAGS:
            assert seen(after) != seen(before), name
    for name in unread:
        before, after = base(name), base(name, **{field: value})
        flag = f"--{field}={specs.value_text(value)}: nothing reads it"
        for given in ([field], EVERYTHING):
            with pytest.raises(Unread) as error:
                resolved(after, given)
        assert str(error.value).startswith(flag) or name in ("constant", "views"), error.value
        assert str(error.value).endswith("; leave it out") and "\n" not in str(error.value)
        # Of a preset or an earlier run it is not refused, and not in force; and it would change nothing.
        if field not in ("decoder_weight_decay", "target_view", "target_encoder", "lr_srl"):
            assert resolved(after, ()) == resolved(before, ()), name
        if field in FLAGS:
            assert seen(after) == seen(before), name


def envs_made(text: str) -> tuple:
    """What is made of a game, and what its first frames are where that is cheap to know."""
    with (
        mock.patch("srl_jax.envs.adapter.Adapter") as adapter,
        mock.patch("srl_jax.envs.atari.Atari") as atari,
    ):
        with mock.patch("srl_jax.envs.adapter.made") as made:
            env = envs.make(text, num_envs=1, seed=0, frame_size=42)
            if adapter.called:
                adapter.call_args.args[0]()
    if not adapter.called and not atari.called:
        frames = [env.reset()[0], *(env.step(np.zeros(1, np.int32))[0] for _ in range(3))]
        return (np.stack(frames).tobytes(),)
    return str(adapter.call_args and adapter.call_args.kwargs), str(made.call_args), str(atari.call_args)


@pytest.mark.parametrize("row", envs.REGISTRY)
def test_an_option_of_a_game_changes_something(row):
    values = {"game": "Breakout", "id": "a:B-v0", "background": "moving"}
    given = {"gymnasium": {"id": "A-v0"}}.get(row, {})
    for option, default in specs.option_defaults(envs.REGISTRY[row]).items():
        text = values.get(option) or others("game", row, option, default)[0]
        assert envs_made(specs.join(row, {**given, option: text})) != envs_made(specs.join(row, given)), (
            option
        )


@pytest.mark.parametrize(
    ("objective", "option", "field"),
    [
        ("forward_latent:hidden=8,tau=0.5", "tau", {"target_encoder": "online"}),
        ("forward_latent:hidden=8,target=periodic,every=3", "every", {"target_encoder": "online"}),
        ("latent_l2:target=slow", "target", {"target_encoder": "online"}),
        ("reconstruction:moving=10", "moving", {"frame_stack": 1}),
    ],
)
def test_an_option_may_need_a_flag(objective, option, field):
    name, options = specs.split(objective)
    given = [f"{name}:{option}"]
    resolved(base("rl_only", **with_objectives(objective)), given)
    config = base("rl_only", **with_objectives(objective), **field)
    flag, value = next(iter(field.items()))
    with pytest.raises(
        ConfigError, match=f"nothing reads {option} with.* --{flag}={value}|without --{flag}="
    ):
        resolved(config, given)
    assert resolved(config, ()) == resolved(
        base(
            "rl_only",
            **with_objectives(specs.join(name, {k: x for k, x in options.items() if k != option})),
            **field,
        ),
        (),
    )


def test_what_a_preset_has_and_nothing_reads_takes_its_default():
    config = Config(mode="rl_only", lr_srl=0.5, gate="pcgrad", rl="rainbow:noisy=false,noisy_std=0.5")
    with pytest.raises(Unread, match="^--gate=pcgrad: .*modes that do: joint.*; leave it out$") as error:
        checks.check(config)
    assert error.value.field == "gate"
    checked = checks.check(config, given=["rl"])
    assert (checked.lr_srl, checked.gate) == (1e-4, "sum")
    assert "noisy_std=0.1," in completed(checked, ["rl", "rl:noisy"]).rl
    with pytest.raises(
        ConfigError, match="--rl=.*: nothing reads noisy_std without noisy=true; leave it out"
    ):
        completed(checked, ["rl", "rl:noisy_std"])


def test_the_default_may_be_given_where_nothing_reads_it():
    config = Config(mode="pretrain", objectives=("spr:target=stopped,tau=0.99",), lr_rl=1e-4)
    assert resolved(config, EVERYTHING) == resolved(resolved(config, ()), EVERYTHING)


RESULTS = sorted(Path(__file__).parents[1].glob("experiments/results/*/configs.json"))


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.parent.name)
def test_what_is_said_of_earlier_runs_is_read_and_could_be_resumed(path):
    runs = packing.read(path.parent, only_last=True)
    for config in {dataclasses.replace(run.config, seed=0) for run in runs}:
        base = unresolved(config)  # as `--config` takes it
        wanted = completed(checks.check(base, given=(), complete=False))
        assert wanted == completed(config) == completed(wanted)


@pytest.mark.parametrize("views", [{"srl_view": "shift"}, {"augment": "srl"}, {"encoder": "a_lix:lix=1"}])
@pytest.mark.parametrize("target_view", ["none", "same", "shift"])
def test_a_target_of_the_online_encoder_is_the_latent_itself_where_both_see_the_same(views, target_view):
    config = Config(
        **{**SMALL, **with_objectives("latent_l2:target=slow"), "target_encoder": "online", **views},
        target_view=target_view,
    )
    apart = "encoder" in views or target_view != "same"
    options = specs.split(resolved(config, ()).objectives[0])[1]
    assert options["target"] == ("slow" if apart else "zero")
