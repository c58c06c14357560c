"""One colour an arm: the same in all figures below a directory, and on the page about its runs.

The thesis' arms have colours of their own wherever they are drawn, such that arms of one figure differ.
Others take, in the order of their names, what the arms beside them use least. Imports neither jax nor
matplotlib.
"""

import functools
from collections import Counter
from collections.abc import Iterable, Sequence

from ..arms import FIGURES

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette: distinguishable to colour-blind readers."""
LINES = ("-", "--", ":", "-.")
"""Of arms that have the same colour."""
Style = tuple[str, str]
"""A colour and a line."""


def styles(arms: Sequence[str], among: Iterable[str] = ()) -> dict[str, Style]:
    """The colour and the line of each arm.

    Args:
        arms: that are drawn together; where a colour comes again, the line is another one. Of 28 no two look
            alike: where an arm's colour has no line left, another colour has.
        among: all arms of the directory: they decide colours, too.
    """
    there = {*arms, *among}
    colours = {arm: colour for arm, colour in _thesis().items() if arm in there}
    for arm in sorted(there - colours.keys()):
        colours[arm] = _rarest(COLOURS, list(colours.values()))
    used: Counter[str] = Counter()
    found = {}
    for arm in dict.fromkeys(arms):
        colour = colours[arm]
        if used[colour] >= len(LINES):
            colour = min(COLOURS, key=used.__getitem__)
        found[arm] = colour, LINES[used[colour] % len(LINES)]
        used[colour] += 1
    return found


@functools.cache
def _thesis() -> dict[str, str]:
    figures = [[arm.name for arm in figure.arms] for figure in FIGURES.values()]
    shown = Counter(arm for figure in figures for arm in figure)
    found: dict[str, str] = {}
    for arm, _ in shown.most_common():  # those of many figures choose first
        beside = {found.get(other) for figure in figures if arm in figure for other in figure}
        found[arm] = _rarest([colour for colour in COLOURS if colour not in beside], list(found.values()))
    return found


def _rarest(colours: Sequence[str], given: Sequence[str]) -> str:
    """The colour that was given least, of such ones the one not given for longest."""
    last = {colour: i for i, colour in enumerate(given)}
    return min(colours, key=lambda colour: (given.count(colour), last.get(colour, -1)))
