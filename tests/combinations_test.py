"""A few random runs from the registries; `make soak` tries hundreds."""

import pytest

from srl_jax import encoders, objectives, rl
from srl_jax.errors import ConfigError
from tests import combinations

pytestmark = pytest.mark.usefixtures("shared_agents")


def test_values_are_drawn_of_every_option_of_every_row():
    registries = {"rl": rl.REGISTRY, "encoder": encoders.REGISTRY, "objective": objectives.REGISTRY}
    for registry, rows in registries.items():
        for row, factory in rows.items():
            for option, default in combinations.options_of(factory).items():
                combinations.values_of(registry, row, option, default)


@pytest.mark.parametrize("number", [3, 4, 12, 13, 18, 33])  # the first two run
def test_a_random_combination_runs_and_resumes_or_is_refused(tmp_path, number):
    combinations.run(combinations.draw(number, encoder="tiny"), tmp_path)


def test_refusals_of_a_kind_have_one_sentence():
    for given, expected in (
        ("--rl=dqn:v=1,n_step=1: target needs 2", "--rl=…: target needs 2"),
        ("--n_anneal=3->1@4: --rl has n_step=1; give it", "--n_anneal=N: --rl has n_step=N; give it"),
        ("--gate=pcgrad: --mode=joint has /x", "--gate=pcgrad: --mode=joint has /x"),
    ):
        assert combinations.sentence(ConfigError(given)) == expected
