"""HTML made of elements whose text is always escaped, and numbers as a reader wants them."""

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any


class Markup(str):
    """Text that is HTML already; every other string is escaped where it becomes part of some."""


VOID = ("img", "meta", "link", "wbr")
"""Elements without an end."""


def text(value: Any) -> Markup:
    """HTML that shows the value; None shows nothing, sequences are joined."""
    if value is None:
        return Markup()
    if isinstance(value, Markup):
        return value
    if isinstance(value, list | tuple):
        return Markup("".join(map(text, value)))
    return Markup(html.escape(str(value)))


def tag(name: str, /, *children: Any, **attributes: Any) -> Markup:
    """An element.

    Args:
        name: of it.
        *children: see `text`.
        **attributes: of it; `_` at the end of a name is dropped, within it is a hyphen. None leaves one out.
    """
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    end = "" if name in VOID else f"{text(children)}</{name}>"
    return Markup(f"<{name}{given}>{end}")


def breakable(name: Any) -> Markup:
    """A name that a narrow column may break behind its underscores and slashes."""
    if type(name) is not str:
        return text(name)
    return Markup(text(name).replace("_", "_<wbr>").replace("/", "/<wbr>"))


def table(head: Sequence[Any], rows: Iterable[Sequence[Any]], label: str, kind: str = "") -> Markup:
    """A table in a box that scrolls by itself where it is too wide; a row begins with its heading.

    Args:
        head: the columns' headings.
        rows: their cells.
        label: what it is a table of, for readers who do not see it.
        kind: a class for its style.
    """
    top = tag("tr", [tag("th", breakable(cell), scope="col") for cell in head])
    body = [
        tag("tr", tag("th", breakable(row[0]), scope="row"), [tag("td", cell) for cell in row[1:]])
        for row in rows
    ]
    inner = tag("table", tag("thead", top), tag("tbody", body), class_=kind or None)
    return tag("div", inner, class_="scroll", tabindex="0", role="region", aria_label=label)


def details(summary: Any, *children: Any) -> Markup:
    """What is shown when it is asked for."""
    return tag("details", tag("summary", summary), *children)


def figure(source: str, caption: Any, alt: str, size: tuple[int, int] | None = None) -> Markup:
    """A picture with its caption.

    Args:
        source: a data URI.
        caption: below it.
        alt: what a reader who does not see it is told.
        size: width and height in pixels; None leaves them to the style.
    """
    width, height = size or (None, None)
    image = tag("img", src=source, alt=alt, width=width, height=height)
    return tag("figure", image, tag("figcaption", caption))


def number(value: float | None, digits: int = 2) -> str:
    """A number with its thousands set apart: 12,345 or 0.53; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    places = 0 if abs(value) >= 1_000 else min(digits, 1) if abs(value) >= 100 else digits
    shown = f"{value:,.{places}f}"
    if float(shown.replace(",", "")) == 0:
        shown = shown.lstrip("-")  # no minus before 0.00
    return shown.replace("-", "−")


def duration(hours: float) -> str:
    """Hours, minutes or seconds, whichever is easy to read."""
    unit, value = next(
        ((u, hours * n) for u, n in (("h", 1), ("min", 60)) if hours * n >= 1), ("s", hours * 3600)
    )
    return f"{number(value, 0 if unit == 's' else 1)} {unit}"


def plural(count: int, noun: str) -> str:
    """ "1 run", "2 runs"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def listed(items: Iterable[Any]) -> str:
    """ "a", "a and b", "a, b and c"."""
    *first, last = [str(item) for item in items] or ["none"]
    return f"{', '.join(first)} and {last}" if first else last
