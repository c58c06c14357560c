"""Tests of srl_jax.specs."""

import functools

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from srl_jax import plugins, specs
from srl_jax.types import Encoder


def _sum(context, *, weight: float = 1.0, n_step: int = 3, low: float = -10.0, noisy=True, kind="a"):
    if kind == "bad":
        raise ValueError("kind is\nbad")
    return context, weight, n_step, low, noisy, kind


REGISTRY = {"sum": _sum, "plain": functools.partial(_sum, noisy=False, n_step=1), "bare": lambda: 7}


def test_options_have_the_type_of_their_default():
    spec = specs.parse(" sum: noisy=0, n_step=1e1,weight=2,low=-3 , kind=b=c", REGISTRY)
    assert spec.name == "sum"
    # In the factory's order, whatever the order they were typed in.
    assert list(spec.options.items()) == [
        ("weight", 2.0), ("n_step", 10), ("low", -3.0), ("noisy", False), ("kind", "b=c"),
    ]  # fmt: skip
    assert [type(value) for value in spec.options.values()] == [float, int, float, bool, str]
    assert str(spec) == "sum:weight=2.0,n_step=10,low=-3.0,noisy=false,kind=b=c"


def test_defaults_are_resolved_and_those_of_a_partial_win():
    assert specs.parse("plain", REGISTRY).resolved == {
        "weight": 1.0, "n_step": 1, "low": -10.0, "noisy": False, "kind": "a",
    }  # fmt: skip
    assert str(specs.parse("plain", REGISTRY)) == "plain"
    assert specs.parse("plain:weight=2", REGISTRY).full == (
        "plain:weight=2.0,n_step=1,low=-10.0,noisy=false,kind=a"
    )
    assert specs.parse("bare", REGISTRY).full == "bare"


@hypothesis.given(
    options=st.fixed_dictionaries(
        {},
        optional={
            "weight": st.floats(0, specs.LIMITS[float]),
            "n_step": st.integers(0, specs.LIMITS[int]),
            "low": st.floats(-specs.LIMITS[float], specs.LIMITS[float]),
            "noisy": st.booleans(),
            "kind": st.text("abc=:. _", max_size=5).map(str.strip),
        },
    )
)
@hypothesis.settings(deadline=None, max_examples=50)
def test_the_canonical_text_gives_the_same_spec(options):
    spec = specs.parse(specs.join("sum", options), REGISTRY)
    assert spec.options == options
    assert specs.parse(str(spec), REGISTRY) == spec
    full = specs.parse(spec.full, REGISTRY)
    assert full.resolved == full.options == spec.resolved


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("summ", ["no 'summ'", "did you mean sum?", "valid: sum, plain, bare"]),
        ("SUM", ["did you mean sum?"]),
        ("xyz", ["valid: sum, plain, bare"]),
        ("", ["no name"]),
        (":weight=1", ["no name"]),
        ("sum:", ["key=value"]),
        ("sum:weight", ["'weight' is not key=value"]),
        ("sum:weight=1,", ["key=value"]),
        ("sum:=1", ["key=value"]),
        ("sum:weight=1,weight=1", ["weight is given twice"]),
        (
            "sum:wieght=1",
            ["no option 'wieght'", "did you mean weight?", "weight=1.0", "noisy=true"],
        ),
        ("bare:a=1", ["no option 'a'", "options and defaults: none"]),
        ("sum:weight=abc", ["weight=abc is not a number", "default 1.0"]),
        ("sum:weight=", ["not a number"]),
        ("sum:n_step=1.5", ["not a whole number", "default 3"]),
        ("sum:noisy=maybe", ["not true or false"]),
        ("sum:weight=nan", ["not a finite number"]),
        ("sum:low=-inf", ["not a finite number"]),
        ("sum:weight=-1", ["must not be negative"]),
        ("sum:n_step=-1", ["must not be negative"]),
        # Beyond 32 bits, which devices count and compute in.
        ("sum:n_step=2147483648", ["must be at most 2147483647"]),
        ("sum:weight=1e39", ["must be at most 3.402823466e+38"]),
        ("sum:low=-1e39", ["must be at least -3.402823466e+38"]),
    ],
)
def test_an_error_is_one_line_that_names_the_flag_and_what_is_valid(text, parts):
    with pytest.raises(specs.SpecError) as error:
        specs.parse(text, REGISTRY, "rl")
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(f"--rl={text}: ")
    for part in parts:
        assert part in message


def test_build_calls_the_factory_with_the_context_and_every_option():
    spec = specs.parse("sum:weight=2,noisy=false", REGISTRY)
    assert plugins.build(spec, REGISTRY, "context") == ("context", 2.0, 3, -10.0, False, "a")


def test_what_a_factory_refuses_is_a_spec_error():
    spec = specs.parse("sum:kind=bad", REGISTRY, "encoder")
    with pytest.raises(specs.SpecError, match="^--encoder=sum:kind=bad: kind is bad$"):
        plugins.build(spec, REGISTRY, None)


def test_what_is_wrong_with_a_factory_of_somebody_else_is_said_in_one_line():
    def of_objectives(context):
        return context.features

    registry = {"mine": of_objectives, "number": lambda shape: 3}
    with pytest.raises(
        specs.SpecError, match=r"^--encoder=mine: line \d+: AttributeError: 'tuple' object has"
    ):
        plugins.build(specs.parse("mine", registry, "encoder"), registry, (84, 84, 4))
    with pytest.raises(specs.SpecError, match="^--encoder=number: its factory must give Encoder, not int$"):
        plugins.build(specs.parse("number", registry, "encoder"), registry, (84, 84, 4), gives=Encoder)


def test_an_option_without_a_usable_default_is_a_mistake_in_the_factory():
    def factory(*, size):
        return size

    with pytest.raises(TypeError, match="size"):
        specs.parse("row", {"row": factory})


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("1_000_000", int, 1_000_000),
        ("5e6", int, 5_000_000),
        # Beyond 2**53 a detour over float would round.
        ("9007199254740993", int, 9_007_199_254_740_993),
        ("1e-6", float, 1e-6),
        ("True", bool, True),
        ("0", bool, False),
    ],
)
def test_values(text, kind, value):
    parsed = specs.parse_value(text, kind)
    assert parsed == value and type(parsed) is kind


def test_limits():
    info = specs.Info(int, "help", "games", minimum=1, maximum=3)
    assert info.parse("3") == 3
    for text, reason in [("0", "at least 1"), ("4", "at most 3"), ("x", "not a whole number")]:
        with pytest.raises(ValueError, match=reason + r" \(games\)"):
            info.parse(text)
    with pytest.raises(ValueError, match="above 0"):
        specs.Info(float, "help", above=0).parse("0")
    with pytest.raises(ValueError, match="did you mean slow"):
        specs.Info(str, "help", choices=("slow", "online")).parse("slwo")
    assert specs.Info(float, "help", optional=True).parse("off") is None


@pytest.mark.parametrize("limit", [specs.LIMITS[int], -specs.LIMITS[int]])
def test_whole_numbers_have_32_bits(limit):
    info = specs.Info(int, "help")
    assert info.parse(str(limit)) == limit
    with pytest.raises(ValueError, match=f"{limit}$"):
        info.parse(str(limit + (1 if limit > 0 else -1)))


@pytest.mark.parametrize("sign", [1, -1])
def test_other_numbers_have_single_precision(sign):
    limit = sign * float(np.finfo(np.float32).max)
    info = specs.Info(float, "help")
    assert info.parse(repr(limit)) == limit
    with pytest.raises(ValueError, match="3.402823466e.38$"):
        info.parse(repr(float(np.nextafter(limit, sign * np.inf))))


def test_names_that_may_have_been_meant():
    names = ["gamma", "lr_rl", "lr_encoder", "slr", "Lr_end", "x_lr"]
    # The first two are spelt nearly so; the others have it as a word.
    assert specs.near("lr", names) == ["slr", "x_lr", "Lr_end", "lr_encoder", "lr_rl"]
    assert specs.near("lr", names, most=2) == ["slr", "x_lr"]
    assert specs.near("GAMA", names) == ["gamma"] and specs.near("q", names) == []
    # A set has an order of its own in each process.
    assert specs.choices_text("q", {"b", "a", "c"}) == "valid: a, b, c"
    assert specs.choices_text("q", ["b", "a"]) == "valid: b, a"
    assert specs.choices_text("q", ["b, c", "a"], "; ") == "valid: b, c; a"
    many = [f"name_{i}" for i in range(21)]
    assert specs.choices_text("name_0x", many).startswith("did you mean name_0? near: name_0, ")
    assert specs.choices_text("name_0x", many).endswith("; 21 are valid")
    assert specs.choices_text("q", many).startswith("valid: name_0, ")
