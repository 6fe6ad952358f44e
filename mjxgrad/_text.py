"""Numbers and names as text, for messages and tables; and files of text."""

import html
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


class Printed:
    """Something that a notebook shows as `print` does, and not as all its arrays."""

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        # IPython asks class by class: the `__repr__` of a dataclass would come before a base class's method.
        cls._repr_pretty_ = lambda self, printer, cycle: printer.text(str(self))


class Paged(Printed):
    """Something with a page, `as_html`, which a notebook shows where the packages for pages are installed."""

    def _repr_html_(self) -> str | None:
        try:
            page = self.as_html()  # pyright: ignore[reportAttributeAccessIssue]
        except ImportError:
            return None
        fit = "this.style.height = this.contentDocument.documentElement.scrollHeight + 'px'"
        return f'<iframe srcdoc="{html.escape(page)}" onload="{fit}" style="width: 100%; height: 40em; border: 0"></iframe>'


def name_pairs(pairs: Sequence[object]) -> str:
    """Return one or two names; or the first and the number of the others."""
    if len(pairs) == 1 or (len(pairs) == 2 and sum(len(str(pair)) for pair in pairs) < 36):
        return ", ".join(str(pair) for pair in pairs)
    return f"{pairs[0]} + {len(pairs) - 1} more"


def aligned(rows: Sequence[Sequence[str]], align: Callable[[str, int], str] = str.rjust) -> list[str]:
    """Return rows of cells as lines of columns, the first one left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(align, row[1:], widths[1:])]).rstrip() for row in rows]


def format_range(pair: Iterable[float], between: str = "–") -> str:
    """Return two numbers as a range, or as one if they are equal."""
    low, high = (f"{x:.4g}" for x in pair)
    return low if low == high else f"{low}{between}{high}"


def format_number(x: float) -> str:
    """Return a number with three digits; whole numbers up to 99999 in full."""
    if np.isinf(x):
        return "∞" if x > 0 else "−∞"
    if 1e3 <= abs(x) < 99999.5:
        return f"{x:.0f}"
    return f"{x + 0.0:.3g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")


def duration(seconds: int | float) -> str:
    """Return a time in words, to two digits."""
    for size, unit in ((3600, "h"), (60, "min"), (1, "s")):
        if seconds >= 1.5 * size or unit == "s":
            return f"{float(f'{seconds / size:.2g}'):g} {unit}"
    return ""


def paced(name: str) -> Callable[[str], None]:
    """Return a function that tells on stderr where a long call is: from its third second on, and then every ten."""
    due = [time.monotonic() + 2.0]

    def say(text: str) -> None:
        if time.monotonic() > due[0]:
            due[0] = time.monotonic() + 10.0
            print(f"{name}: {text.rstrip('.')}; Ctrl-C keeps what was found", file=sys.stderr, flush=True)

    return say


def write(path: str | Path, content: str | bytes) -> None:
    """Write a file beside its place and rename it, so that a full disk or an interruption leaves what was there.

    Where the path is a symbolic link, its target is written.

    Raises:
        OSError: if the file cannot be written; the message names it.
    """
    path = Path(os.path.realpath(path))
    partial = path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise OSError(f"{path} could not be written: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)
