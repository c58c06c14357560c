"""Other packages as references, imported by the first test that asks one of them.

Each process of `make test` reads all test files, and these take seconds.
"""

import importlib
import warnings


class Later:
    """A module of which nothing is imported before it is used."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, attribute):
        with warnings.catch_warnings():  # what it warns of while it is imported
            warnings.simplefilter("ignore")
            module = importlib.import_module(self._name)
        return getattr(module, attribute)


library = Later("rliable.library")
metrics = Later("rliable.metrics")
rlax = Later("rlax")
stats = Later("scipy.stats")
