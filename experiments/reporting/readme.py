"""A campaign's README.md as HTML: no HTML of its own, no picture from elsewhere, no link to another file."""

from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup

from srl_jax.errors import ConfigError
from srl_jax.files.reading import SETTINGS, read_bytes

from . import pictures


class Readme(NamedTuple):
    """What it says.

    Attributes:
        title: its first heading, or empty.
        html: the rest; headings are of one level less.
        pictures: that it shows.
    """

    title: str
    html: Markup
    pictures: list[Path]


def text_of(path: Path) -> str | None:
    """What a file says, in UTF-8; None where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return read_bytes(path, SETTINGS).decode("utf-8-sig")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


def read(folder: Path) -> Readme | None:
    """The README.md of a directory of runs, or None where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    if (text := text_of(folder / "README.md")) is None:
        return None
    markdown = MarkdownIt("js-default", {"html": False})
    markdown.add_render_rule("table_open", lambda *_: '<div class="scroll" tabindex="0"><table>')
    markdown.add_render_rule("table_close", lambda *_: "</table></div>")
    tokens, title, shown = markdown.parse(text), "", []
    if tokens and tokens[0].type == "heading_open" and tokens[0].tag == "h1":
        title = "".join(child.content for child in tokens[1].children or ())
        tokens = tokens[3:]
    for token in tokens:
        if token.type.startswith("heading_"):
            token.tag = f"h{min(int(token.tag[1]) + 1, 6)}"
        elif token.children:
            token.children = [_safe(child, folder, shown) for child in token.children]
    return Readme(title, Markup(markdown.renderer.render(tokens, markdown.options, {})), shown)


def _safe(token: Token, folder: Path, shown: list[Path]) -> Token:
    """The token as it may stand in a page that is read elsewhere; its picture becomes part of the page."""
    if token.type == "image":
        path = (folder / unquote(str(token.attrs["src"])).replace("\0", "")).resolve()
        inside = path.is_relative_to(folder.resolve()) and path.suffix in (".png", ".gif")
        picture = pictures.taken(path, pictures.LARGEST) if inside else None
        if picture is None:
            return Token("text", "", 0, content=token.content)
        shown.append(path)
        token.attrs["src"] = picture.source
    elif token.type == "link_open" and not str(token.attrs["href"]).startswith(("https://", "http://")):
        token.attrs = {}
    return token
