"""The page that leads from a sweep to its runs."""

import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from experiments.config import Run
from experiments.report import document


def overview(runs: Sequence[Run], folders: Sequence[Path]) -> str:
    """Write the page over a sweep: each combination, its verdict and the way to its report.

    Args:
        runs: the combinations.
        folders: their output folders, complete.

    Returns:
        The page.
    """
    keys = list(runs[0].varied)
    return document(
        f"{runs[0].name}, {len(runs)} runs",
        f'<header><p class="kicker">{html.escape(runs[0].name)}, swept over {html.escape(", ".join(keys))}</p>'
        f"<h1>{html.escape(runs[0].question)}</h1></header>"
        f"{_numbers(runs, folders)}"
        f"{_table([*keys, 'verdict', ''], map(_verdict_row, runs, folders))}",
    )


def _numbers(runs: Sequence[Run], folders: Sequence[Path]) -> str:
    """Set the main numbers of all runs side by side; nothing if they have none."""
    found = [_summary(folder)["headline"] for folder in folders]
    # In the order of their first appearance.
    headings = list(dict.fromkeys(heading for one in found for heading in one))
    if not headings:
        return ""
    rows = (
        _row([*map(html.escape, map(str, run.varied.values())), *(html.escape(one.get(name, "")) for name in headings)])
        for run, one in zip(runs, found, strict=True)
    )
    return _table([*runs[0].varied, *headings], rows)


def _summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def _verdict_row(run: Run, folder: Path) -> str:
    cells = [html.escape(str(text)) for text in [*run.varied.values(), _summary(folder)["verdict"]]]
    return _row([*cells, f'<a href="{html.escape(folder.name)}/report.html">report</a>'])


def _row(cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _table(headings: Iterable[str], rows: Iterable[str]) -> str:
    head = "".join(f'<th scope="col">{html.escape(text)}</th>' for text in headings)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
