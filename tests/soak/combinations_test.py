"""Random runs from the registries: each trains and resumes bit for bit, or is refused in one sentence.

The table counts the sentences, so that a reader can judge whether each is right.
"""

import jax
import pytest

from tests import combinations, helpers


def pytest_generate_tests(metafunc):
    if "number" in metafunc.fixturenames:
        metafunc.parametrize("number", range(metafunc.config.getoption("combinations")))


@pytest.fixture
def forgotten():
    """Agents that are shared by the runs of a test, and are not kept for the next one's."""
    with helpers.shared_agents():
        yield
    helpers.forget_agents()
    jax.clear_caches()


@pytest.mark.usefixtures("forgotten")
def test_a_random_combination_runs_and_resumes_or_is_refused(tmp_path, number, record_property):
    refused = combinations.run(combinations.draw(number), tmp_path)
    record_property("draws", 1)
    record_property(f'refused with "{refused}"' if refused else "run, with a resume that is bit-identical", 1)
