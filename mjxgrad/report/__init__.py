"""Pages that need nothing beside them: an answer, then figures, sentences, tables; one template, one style sheet."""

import base64
import importlib.util
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parent
STYLE = _FOLDER / "figure.mplstyle"
"""How figures look, for matplotlib."""
INK = "#22262e"
"""The colour in a figure that becomes that of the page's text."""
_WIDE = 6.0  # inches; on a telephone wider figures keep a width at which they can be read, and scroll within their box
_GREY = 40  # of 255: colours whose parts differ by less
# What colours do by `_for_both`, in pictures within a figure.
_IMAGES = "<style>@media (prefers-color-scheme: dark) { image { filter: invert(1) hue-rotate(180deg) } }</style>"
# Opened by itself a figure has no page to take colours from.
_ALONE = f"color-scheme: light dark; color: {INK}; color: light-dark({INK}, #e7eaef)"
_XMLNS = ' xmlns="http://www.w3.org/2000/svg"'


@dataclass(frozen=True)
class Table:
    """Numbers to read, already rounded to what their error bars allow."""

    columns: Sequence[str]  # headings
    rows: Sequence[Sequence[str]]  # cells, as text
    caption: str = ""  # what it shows
    # Positions (row, column) of the cells that the answer rests on.
    emphasised: frozenset[tuple[int, int]] = frozenset()


@dataclass(frozen=True)
class Block:
    """A part of a page: what is given of it, in the order of the fields; between backticks a sentence has code."""

    title: str = ""  # heading
    lead: str = ""  # words in bold before text or caption
    text: str = ""  # paragraph
    drawings: Sequence[str] = ()  # by `svg`, side by side where there is room
    video: bytes = b""  # MP4
    caption: str = ""  # what drawings or video show
    faults: Sequence[str] = ()  # sentences of a list, in bold
    items: Sequence[str] = ()  # further ones
    table: Table | None = None
    code: str = ""  # a program, or text in columns
    look: str = ""  # class of the style sheet
    folded: str = ""  # the title of what a click opens, table and code

    def __bool__(self) -> bool:
        """Whether there is anything to show."""
        return any([self.text, self.drawings, self.video, self.faults, self.items, self.table, self.code])


def require() -> None:
    """Refuse a page where what writes it is missing; to be asked before the work that the page is about.

    Raises:
        ImportError: if jinja2 or matplotlib is not installed.
    """
    if missing := [name for name in ("jinja2", "matplotlib") if importlib.util.find_spec(name) is None]:
        raise ImportError(f"a page needs {' and '.join(missing)}, not installed: pip install 'mjxgrad[render]'")


def page(answer: str, about: str, blocks: Iterable[Block], cards: Sequence[Mapping[str, Any]] = ()) -> str:
    """Write a page as HTML.

    Args:
        answer: its first line.
        about: what it answers, or the command that it is of.
        blocks: in order of reading.
        cards: links to other pages: href, figure or video (paths or nothing), about, title and text of each.

    Raises:
        ImportError: as `require`.
    """
    require()
    import jinja2

    settings = {"autoescape": True, "undefined": jinja2.StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(_FOLDER), **settings)
    environment.filters |= {
        "prose": _prose,
        "inline": lambda drawing: drawing.replace(_XMLNS, ""),
        "base64": lambda content: base64.b64encode(content).decode(),
        "is_number": re.compile(r"[−(-]?\d").match,
    }
    return environment.get_template("page.html").render(answer=answer, about=about, blocks=blocks, cards=cards)


def svg(draw: Callable[[], Any], label: str) -> str:
    """Draw a figure as SVG for light and dark pages, and close it.

    Args:
        draw: returns matplotlib's figure; called in the style of the pages. `INK` becomes the colour of the text, and what is
            dark on a white page is light on a black one.
        label: what it shows, for who does not see it.

    Raises:
        ImportError: as `require`.
    """
    require()
    import matplotlib.pyplot as plt
    from markupsafe import escape

    with plt.style.context([STYLE, {"svg.hashsalt": label}]), io.StringIO() as file:
        figure = draw()
        figure.savefig(
            file, format="svg", transparent=True, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
        )
        plt.close(figure)
        text = file.getvalue().partition("<svg")[2]
    look = "wide" if figure.get_size_inches()[0] > _WIDE else "narrow"
    text = re.sub(r' xmlns:xlink="[^"]*"|(?<=<g) id="[^"]*"|xlink:(?=href)', "", text)
    text = re.sub(r"(fill|stroke): (#[0-9a-f]{6})", _for_both, text)
    text = text.replace(">", f">{_IMAGES}", 1) if "<image" in text else text
    return f'<svg role="img" aria-label="{escape(label)}" class="{look}" style="{_ALONE}"{text}'


def _for_both(found: re.Match) -> str:
    """Set a colour, and where the browser knows how, one for dark pages; white becomes their background, no hue too dark."""
    name, colour = found.groups()
    parts = bytes.fromhex(colour[1:])
    lightness = "max(0.6, 1.21 - l)" if max(parts) - min(parts) > _GREY else "calc(1.21 - l)"
    dark = f"{name}: {colour}; {name}: light-dark({colour}, oklch(from {colour} {lightness} c h))"
    return f"{name}: currentColor" if colour == INK else dark


def _prose(text: object) -> str:
    """Escape a sentence, with what stands between backticks as code; no line ends within a name."""
    from markupsafe import Markup, escape

    whole = escape(text).replace("α-order", Markup('<span class="whole">α-order</span>'))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(whole)))
