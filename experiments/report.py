"""What an experiment hands back, and the page it becomes."""

import base64
import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.config import Run
from experiments.words import capitalised

STYLE = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
MOST_WORDS = 15  # of an answer
_LONG_TABLE = 12  # rows; longer ones are folded


@dataclass(frozen=True)
class Figure:
    """A picture: its file, relative to the output folder, a title of a few words, and what it shows and how to read it."""

    file: str
    title: str
    caption: str


@dataclass(frozen=True)
class Table:
    """Numbers to read, already rounded to what their error bars allow."""

    columns: Sequence[str]  # headings
    rows: Sequence[Sequence[str]]  # cells, as text; `quantity` writes a number with its error
    caption: str  # what it shows
    # Positions (row, column) of the cells that the verdict rests on.
    emphasised: frozenset[tuple[int, int]] = frozenset()


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


def page(report: Report, folder: Path, *, name: str, question: str, expected: str, about: dict[str, dict]) -> str:
    """Write a report as one HTML page that needs nothing beside it; `about` are headed lists of settings and circumstances."""
    figures = [_figure(figure, folder, number) for number, figure in enumerate(report.figures, start=1)]
    body = [
        f'<header><p class="kicker">{_text(name)}</p><h1>{_text(question)}</h1></header>',
        # Who reads for ten seconds sees the answer and the picture of it.
        f'<p class="answer">{_prose(report.answer)}</p>',
        *figures[:1],
        f'<section class="verdict" aria-label="Verdict"><p>{_prose(report.verdict)}</p>',
        _items(report.findings),
        "</section>",
        f'<p class="expected"><b>Expected beforehand.</b> {_prose(capitalised(expected))}</p>' if expected else "",
        _warnings(report.warnings),
        _video(report, folder),
        _table(report.summary) if report.summary is not None else "",
        *figures[1:],
        *(_table(table) for table in report.tables),
        '<details><summary>Settings, time and versions</summary><div class="about">',
        *(_definitions(heading, entries) for heading, entries in about.items()),
        "</div></details>",
    ]
    return _document(f"{name}: {question}", "\n".join(part for part in body if part))


def overview(runs: Sequence[Run], folders: Sequence[Path], answer: str) -> str:
    """Write the page over a sweep: each combination, its main numbers, its answer and the way to its report."""
    name, keys = runs[0].name, list(runs[0].varied)
    summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
    # In the order of their first appearance.
    headings = list(dict.fromkeys(heading for one in summaries for heading in one["headline"]))
    numbers, answers = [], []
    for run, folder, summary in zip(runs, folders, summaries, strict=True):
        varied = [_text(value) for value in run.varied.values()]
        link = f'<a href="{_text(folder.name)}/report.html">report</a>'
        numbers.append([*varied, *(_text(summary["headline"].get(heading, "")) for heading in headings)])
        answers.append([*varied, _prose(summary["answer"]), link])
    return _document(
        f"{name}, {len(runs)} runs",
        f'<header><p class="kicker">{_text(name)}, swept over {_text(", ".join(keys))}</p>'
        f'<h1>{_text(runs[0].question)}</h1></header><p class="answer">{_prose(answer)}</p>'
        f"{_grid([*keys, 'answer', ''], map(_cells, answers))}"
        f"{_grid([*keys, *headings], map(_cells, numbers)) if headings else ''}",
    )


def gallery(summaries: Mapping[str, dict[str, Any]]) -> str:
    """Write the page over all results, by the name of their folder: a card each, with a moving picture where there is one."""
    cards = []
    for folder, one in summaries.items():
        poster = f"{folder}/{one['figure']}" if one["figure"] else ""
        picture = f'<img src="{_text(poster)}" alt="" loading="lazy">' if poster else ""
        if one["video"]:
            picture = f'<video loop muted autoplay playsinline src="{_text(folder)}/{_text(one["video"])}"></video>'
        cards.append(
            f'<a class="card" href="{_text(folder)}/report.html">{picture}<p class="kicker">{_text(one["name"])}</p>'
            f"<h2>{_text(one['question'])}</h2><p>{_prose(one['answer'])}</p></a>"
        )
    return _document("Experiments", f'<header><h1>Experiments</h1></header><div class="cards">{"".join(cards)}</div>')


def _document(title: str, body: str) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(title)}</title>\n<style>\n{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _text(text: object) -> str:
    return html.escape(str(text))


def _prose(text: str) -> str:
    """Write a sentence, with what stands between backticks as code; no line ends within a name."""
    whole = _text(text).replace("α-order", '<span class="whole">α-order</span>')
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", whole)


def _data_uri(path: Path, media_type: str) -> str:
    return f"data:{media_type};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _items(sentences: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{_prose(sentence)}</li>" for sentence in sentences) + "</ul>" if sentences else ""


def _warnings(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return f'<section class="warnings"><h2>Before you trust the numbers</h2>{_items(sentences)}</section>'


def _figure(figure: Figure, folder: Path, number: int) -> str:
    source = _data_uri(folder / figure.file, "image/png")
    return (
        # A box that is ticked by a click on the picture, so that full size needs no script.
        f'<figure><label class="zoom" title="Click for full size"><input type="checkbox" aria-label="Full size">'
        f'<span class="scroll"><img src="{source}" alt="{_text(figure.title)}"></span></label>'
        f"<figcaption><b>Figure {number}. {_text(figure.title)}.</b> {_prose(figure.caption)}</figcaption></figure>"
    )


def _video(report: Report, folder: Path) -> str:
    if report.video is None:
        return f'<p class="missing"><b>No video.</b> {_prose(report.video_caption)}</p>' if report.video_caption else ""
    source = _data_uri(folder / report.video, "video/mp4")
    return (
        f'<figure><div class="scroll"><video controls loop muted autoplay playsinline src="{source}"></video></div>'
        f"<figcaption><b>Video.</b> {_prose(report.video_caption)}</figcaption></figure>"
    )


def _table(table: Table) -> str:
    rows = (
        "".join(f"<td{_class(table, (i, j), cell)}>{_text(cell)}</td>" for j, cell in enumerate(row))
        for i, row in enumerate(table.rows)
    )
    grid = _grid(table.columns, rows)
    if len(table.rows) > _LONG_TABLE:
        grid = f"<details><summary>{len(table.rows)} rows</summary>{grid}</details>"
    return f'<figure class="table"><figcaption>{_prose(table.caption)}</figcaption>{grid}</figure>'


def _grid(columns: Iterable[str], rows: Iterable[str]) -> str:
    head = "".join(f'<th scope="col">{_text(column)}</th>' for column in columns)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(row: Iterable[str]) -> str:
    return "".join(f"<td>{cell}</td>" for cell in row)


def _class(table: Table, position: tuple[int, int], cell: str) -> str:
    names = ["number"] if re.match(r"[−(]?\d", cell) else []
    names += ["emphasised"] if position in table.emphasised else []
    return f' class="{" ".join(names)}"' if names else ""


def _definitions(heading: str, entries: dict[str, Any]) -> str:
    rows = "".join(
        f"<dt>{_text(key)}</dt><dd>{'<br>'.join(map(_text, value if isinstance(value, list) else [value]))}</dd>"
        for key, value in entries.items()
    )
    return f"<div><h2>{_text(heading)}</h2><dl>{rows}</dl></div>"
