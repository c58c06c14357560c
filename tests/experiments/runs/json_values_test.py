"""Numbers in files."""

import json

import numpy as np

from experiments.runs.json_values import json_text


def test_numbers_of_two_processors_give_one_text():
    x = np.array([-0.7728824050951518, 1 / 3, 3.4e-9, 28_000.5])
    text = json_text({"x": x.tolist(), "one": (x[0],), "seeds": [5, None, True, "5"]}, None)
    other = np.nextafter(x, 1)
    assert json_text([0.3 - 0.1 - 0.2, 0.2 + 0.1 - 0.3, -0.0]) == json_text([0.0, 0.0, 0.0])
    assert (other != x).all()
    assert text == json_text({"x": other.tolist(), "one": (other[0],), "seeds": [5, None, True, "5"]}, None)
    assert json.loads(text) == {
        "x": [-0.77288241, 0.33333333, 3.4e-9, 28_000.5],
        "one": [-0.77288241],
        "seeds": [5, None, True, "5"],
    }
