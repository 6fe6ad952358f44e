"""Self-contained HTML pages of figures, sentences and tables; one template, one style sheet."""

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
"""Style of figures, for matplotlib."""
INK = "#22262e"
"""The colour in a figure that becomes the page's text colour."""
_WIDE = 6.0  # inches; on a telephone wider figures keep a readable width and scroll within their box
_GREY = 40  # largest difference of a grey's colour components, of 255
# The change of colours by `_for_both`, for pictures within a figure.
_IMAGES = "<style>@media (prefers-color-scheme: dark) { image { filter: invert(1) hue-rotate(180deg) } }</style>"
# A figure opened by itself has no page colours.
_ALONE = f"color-scheme: light dark; color: {INK}; color: light-dark({INK}, #e7eaef)"
_UNIT = re.compile(r"(?<=[\d²³⁰-⁹]) (?=(?:%|[smNh]|[mµ]s|mm|min|rad|Hz|kg|1/s²?|m/s²?|rad/s)(?![\w/]))")
_XMLNS = ' xmlns="http://www.w3.org/2000/svg"'


@dataclass(frozen=True)
class Table:
    """A table of numbers, already rounded to what their error bars allow."""

    columns: Sequence[str]  # headings
    rows: Sequence[Sequence[str]]  # cells, as text
    caption: str = ""  # description
    # Positions (row, column) of the cells behind the answer.
    emphasised: frozenset[tuple[int, int]] = frozenset()


@dataclass(frozen=True)
class Block:
    """A part of a page: its non-empty fields, in order; backticks in sentences mark code."""

    title: str = ""  # heading
    lead: str = ""  # words in bold before text or caption
    text: str = ""  # paragraph
    drawings: Sequence[str] = ()  # by `svg`, side by side where there is room
    video: bytes = b""  # MP4
    caption: str = ""  # description of drawings or video
    faults: Sequence[str] = ()  # list of sentences, in bold
    items: Sequence[str] = ()  # further sentences of the list
    table: Table | None = None
    code: str = ""  # a program, or text in columns
    look: str = ""  # class of the style sheet
    folded: str = ""  # title of the fold that holds table and code

    def __bool__(self) -> bool:
        return any([self.text, self.drawings, self.video, self.faults, self.items, self.table, self.code])


def require() -> None:
    """Refuse a page if jinja2 or matplotlib is missing; call this before the work that the page reports.

    Raises:
        ImportError: if jinja2 or matplotlib is not installed.
    """
    if missing := [name for name in ("jinja2", "matplotlib") if importlib.util.find_spec(name) is None]:
        raise ImportError(f"a page needs {' and '.join(missing)}, not installed: pip install 'mjxgrad[render]'")


def page(answer: str, about: str, blocks: Iterable[Block], cards: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return a page as HTML.

    Args:
        answer: first line of the page.
        about: the question it answers, or the command that wrote it.
        blocks: parts in order of reading.
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
    """Return a figure as SVG for light and dark pages, and close it.

    Args:
        draw: function that returns matplotlib's figure; called in the style of the pages. `INK` becomes the colour of the
            text, and dark colours on a light page become light on a dark one.
        label: description for readers who cannot see it.

    Raises:
        ImportError: as `require`.
    """
    require()
    import matplotlib.pyplot as plt
    from markupsafe import escape

    plt.close(plt.figure())  # loads the backend, whose settings the end of the context would undo
    with plt.style.context([STYLE, {"svg.hashsalt": label}]), io.StringIO() as file:
        figure, without = draw(), dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=without)
        plt.close(figure)
        text = file.getvalue().partition("<svg")[2]
    look = "wide" if figure.get_size_inches()[0] > _WIDE else "narrow"
    text = re.sub(r' xmlns:xlink="[^"]*"|(?<=<g) id="[^"]*"|xlink:(?=href)', "", text)
    text = re.sub(r"(fill|stroke): (#[0-9a-f]{6})", _for_both, text)
    text = text.replace(">", f">{_IMAGES}", 1) if "<image" in text else text
    return f'<svg role="img" aria-label="{escape(label)}" class="{look}" style="{_ALONE}"{text}'


def _for_both(found: re.Match) -> str:
    """Replace a colour by one for light and, where the browser can, one for dark pages; white becomes the background."""
    name, colour = found.groups()
    parts = bytes.fromhex(colour[1:])
    lightness = "max(0.6, 1.21 - l)" if max(parts) - min(parts) > _GREY else "calc(1.21 - l)"
    dark = f"{name}: {colour}; {name}: light-dark({colour}, oklch(from {colour} {lightness} c h))"
    return f"{name}: currentColor" if colour == INK else dark


def _prose(text: object) -> str:
    """Escape a sentence, with code between backticks; no line ends within a name or between a number and its unit."""
    from markupsafe import Markup, escape

    safe = Markup(_UNIT.sub("\N{NO-BREAK SPACE}", str(escape(text))))  # escaped first, which leaves links as they are
    whole = safe.replace("α-order", Markup('<span class="whole">α-order</span>'))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(whole)))
