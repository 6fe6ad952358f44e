"""The page that leads from a sweep to its runs."""

import html
import json
from collections.abc import Sequence
from pathlib import Path

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
    head = "".join(f'<th scope="col">{html.escape(text)}</th>' for text in [*keys, "verdict", ""])
    rows = "".join(_row(run, folder) for run, folder in zip(runs, folders, strict=True))
    return document(
        f"{runs[0].name}, {len(runs)} runs",
        f'<header><p class="kicker">{html.escape(runs[0].name)}, swept over {html.escape(", ".join(keys))}</p>'
        f"<h1>{html.escape(runs[0].question)}</h1></header>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>',
    )


def _row(run: Run, folder: Path) -> str:
    verdict = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["verdict"]
    cells = [html.escape(str(text)) for text in [*run.varied.values(), verdict]]
    cells.append(f'<a href="{html.escape(folder.name)}/report.html">report</a>')
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
