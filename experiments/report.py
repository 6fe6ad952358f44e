"""What an experiment hands back, and the page it becomes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from markupsafe import Markup

from experiments.config import Run
from experiments.words import capitalised
from mjxgrad import report as pages
from mjxgrad.report import Block, Table

MOST_WORDS = 15  # of an answer
_LINK = Markup('<a href="{}/report.html">report</a>')
_LONG_TABLE = 12  # rows; longer ones are folded


class Bold(str):
    """A cell behind the answer."""


def tabulated(rows: Sequence[Mapping[str, str]], caption: str = "") -> Table:
    """Make a table of rows by heading."""
    cells = [list(row.values()) for row in rows]
    bold = ((i, j) for i, row in enumerate(cells) for j, cell in enumerate(row) if isinstance(cell, Bold))
    return Table(list(rows[0]) if rows else (), cells, caption, frozenset(bold))


@dataclass(frozen=True)
class Figure:
    """A picture: its file, relative to the output folder, a title of a few words, and what it shows and how to read it."""

    file: str
    title: str
    caption: str


@dataclass(frozen=True)
class Report:
    """The outcome of a run."""

    answer: str  # to the title's question, in its words and units, at most `MOST_WORDS`
    verdict: str  # the same in at most three sentences, computed from the data
    figures: Sequence[Figure]  # in order of reading
    tables: Sequence[Table]  # after the figures
    metrics: Sequence[dict[str, Any]]  # rows for metrics.csv, in SI units
    findings: Sequence[str] = ()  # further sentences, one each
    video: str | None = None  # relative to the output folder, or None
    video_caption: str = ""  # what it shows; without a video, why there is none
    warnings: Sequence[str] = field(default_factory=tuple)  # what a reader must know before trusting the numbers
    summary: Table | None = None  # a table to stand before the figures, if there is one
    # Heading -> cell, the run's columns in the page over a sweep.
    headline: dict[str, str] = field(default_factory=dict)


def page(
    report: Report, folder: Path, *, name: str, question: str, expected: str, about: dict[str, dict], config: str = ""
) -> str:
    """Write a report as one HTML page that needs nothing beside it; `about` are headed lists, `config` the resolved settings."""
    figures = [
        Block(lead=f"Figure {i}. {one.title}.", caption=one.caption, drawings=[(folder / one.file).read_text("utf-8")])
        for i, one in enumerate(report.figures, start=1)
    ]
    rows = [(heading, key, str(value)) for heading, entries in about.items() for key, value in entries.items()]
    video = Block(lead="No video.", text=report.video_caption)
    if report.video is not None:
        video = Block(lead="Video.", video=(folder / report.video).read_bytes(), caption=report.video_caption)
    blocks = [
        # Who reads for ten seconds sees the answer and the picture of it.
        *figures[:1],
        Block(look="verdict", text=report.verdict, items=report.findings),
        Block(look="about", lead="Expected beforehand.", text=capitalised(expected)),
        Block(look="warnings", title="Before you trust the numbers", items=report.warnings),
        video,
        *map(_table, filter(None, [report.summary])),
        *figures[1:],
        *map(_table, report.tables),
        Block(look="settings", folded="Settings, time and versions", table=Table((), rows), code=config),
    ]
    return pages.page(report.answer, f"{name}: {question}", blocks)


def _table(table: Table) -> Block:
    return Block(table=table, folded=f"{len(table.rows)} rows" * (len(table.rows) > _LONG_TABLE))


def overview(runs: Sequence[Run], folders: Sequence[Path], answer: str) -> str:
    """Write the page over a sweep: each combination, its main numbers, its answer and the way to its report."""
    name, keys = runs[0].name, list(runs[0].varied)
    summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
    # In the order of their first appearance.
    headings = list(dict.fromkeys(heading for one in summaries for heading in one["headline"]))
    numbers, answers = [], []
    for run, folder, summary in zip(runs, folders, summaries, strict=True):
        varied = list(map(str, run.varied.values()))
        numbers.append([*varied, *(summary["headline"].get(heading, "") for heading in headings)])
        answers.append([*varied, summary["answer"], _LINK.format(folder.name)])
    tables = [Table([*keys, "answer", ""], answers), Table([*keys, *headings], numbers)]
    about = f"{name}, swept over {', '.join(keys)}: {runs[0].question}"
    return pages.page(answer, about, [Block(table=table) for table in tables[: 1 + bool(headings)]])


def gallery(summaries: Mapping[str, dict[str, Any]]) -> str:
    """Write the page over all results, by the name of their folder: a card each, with a moving picture where there is one."""
    cards = [
        {"href": f"{folder}/report.html", "about": one["name"], "title": one["question"], "text": one["answer"]}
        | {kind: one[kind] and f"{folder}/{one[kind]}" for kind in ("figure", "video")}
        for folder, one in summaries.items()
    ]
    return pages.page("Experiments and what they answer", f"{len(cards)} result{'s' * (len(cards) != 1)}", (), cards)
