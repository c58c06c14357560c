"""A few random runs from the registries; `make soak` tries hundreds."""

import pytest

from srl_jax import encoders, objectives, rl
from tests import combinations

pytestmark = pytest.mark.usefixtures("shared_agents")


def test_values_are_drawn_of_every_option_of_every_row():
    registries = {"rl": rl.REGISTRY, "encoder": encoders.REGISTRY, "objective": objectives.REGISTRY}
    for registry, rows in registries.items():
        for row, factory in rows.items():
            for option, default in combinations.options_of(factory).items():
                combinations.values_of(registry, row, option, default)


@pytest.mark.parametrize("number", range(6))
def test_a_random_combination_runs_and_resumes_or_is_refused(tmp_path, number):
    combinations.run(combinations.draw(number), tmp_path)
