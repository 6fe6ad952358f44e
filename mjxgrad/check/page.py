"""The verdict as one page: a bold line, one picture, then sentences; the rest is folded."""

import html
from collections.abc import Sequence

import numpy as np

from mjxgrad.check.findings import Finding
from mjxgrad.check.measure import Line, Measured

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _PANEL, _GAP = 360.0, 330.0, 68.0, 8.0, 24.0, 126.0, 22.0
_STYLE = """
:root { color-scheme: light dark; --ink: #1d1d1f; --paper: #fff; --soft: #6b6b70; --line: #d9d9de;
  --plain: #c2500a; --smooth: #00795a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #ececf0; --paper: #17171a; --soft: #a3a3ab; --line: #3a3a40; --plain: #ff9d5c; --smooth: #3fd0a4; } }
body { margin: 0; background: var(--paper); color: var(--ink); font: 1rem/1.5 system-ui, sans-serif; }
main { max-width: 44rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.35rem; line-height: 1.3; margin: .2rem 0 1rem; overflow-wrap: anywhere; }
.kicker { color: var(--soft); margin: 0; overflow-wrap: anywhere; }
figure { margin: 0 0 1rem; } figcaption { color: var(--soft); font-size: .9rem; }
svg { width: 100%; max-width: 34rem; height: auto; display: block; }
svg text { font: 12px system-ui, sans-serif; fill: var(--ink); }
svg .axis { stroke: var(--line); } svg .plain { fill: var(--plain); } svg .smooth { fill: var(--smooth); }
svg .ink { fill: var(--ink); }
svg .slope { stroke: var(--soft); fill: none; opacity: .6; } svg .jump { stroke: var(--soft); stroke-dasharray: 4 3; }
table { border-collapse: collapse; font-size: .9rem; } td, th { padding: .2rem .7rem .2rem 0; text-align: right; }
td:first-child, th:first-child { text-align: left; } .scroll { overflow-x: auto; } video { width: 100%; }
svg .measured { fill: var(--ink); opacity: .45; } svg .before { stroke: var(--plain); fill: none; stroke-dasharray: 5 3; }
svg .after { stroke: var(--smooth); fill: none; stroke-width: 1.6; } svg .out { fill: var(--line); opacity: .5; }
li { margin: .35rem 0; overflow-wrap: anywhere; } .fault { font-weight: 600; } ul { padding-left: 1.2rem; }
pre { overflow-x: auto; border: 1px solid var(--line); border-radius: .4rem; padding: .7rem; font-size: .8rem; }
summary { cursor: pointer; padding: .3rem 0; }
"""


def page(
    name: str,
    headline: str,
    findings: Sequence[Finding],
    code: str,
    details: dict[str, str],
    measured: Measured | None,
    outcomes: Sequence[str],
) -> str:
    """Write the page as HTML that needs nothing beside it."""
    sentences = "".join(f"<li{' class=fault' if one.is_fault else ''}>{_text(one.text)}</li>" for one in findings)
    body = (
        f"{_figure(measured, outcomes) if measured is not None and measured.lines else ''}<ul>{sentences}</ul>"
        f"<h2>To paste</h2><pre>{_text(code)}</pre>"
    )
    return document(f"mjxgrad check {name}", headline, body, details)


def document(kicker: str, headline: str, body: str, details: dict[str, str]) -> str:
    """Write any page: what it is, the answer in bold, its body as HTML, and what is folded, by its title."""
    folded = "".join(
        f"<details><summary>{_text(title)}</summary><pre>{_text(text)}</pre></details>"
        for title, text in details.items()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(kicker)}: {_text(headline)}</title><style>{_STYLE}</style></head><body><main>"
        f'<p class="kicker">{_text(kicker)}</p><h1>{_text(headline)}</h1>{body}{folded}</main></body></html>\n'
    )


def _text(text: str) -> str:
    return html.escape(text)


def _figure(measured: Measured, outcomes: Sequence[str]) -> str:
    """Draw the line on which MuJoCo's derivative is farthest from the slope, or that with the largest jump."""
    line, time, outcome = _most_telling(measured)
    caption = (
        f"{outcomes[outcome][:1].upper() + outcomes[outcome][1:]} after {measured.times[time]:.2g} s, along a "
        f"random change of {line.varied} ({line.pose}). Below: its derivatives, which should lie on the grey slope."
    )
    if len(line.jumps.places):
        caption += " Dashed: a jump."
    return f"<figure>{_drawing(line, time, outcome)}<figcaption>{_text(caption)}</figcaption></figure>"


def _most_telling(measured: Measured) -> tuple[Line, int, int]:
    jumping = [line for line in measured.lines if len(line.jumps.places)]
    if jumping:
        line = max(jumping, key=lambda one: float(one.jumps.sizes.max()))
        sizes = np.abs(line.jumps.after - line.jumps.before)[line.jumps.largest]
        return line, len(measured.times) - 1, int(sizes.argmax())
    compared = [line.plain for line in measured.lines]
    errors = [np.where(one.is_resolved(), one.relative_error[1], 0) for one in compared]
    number, time, outcome = np.unravel_index(int(np.argmax(errors)), np.shape(errors))
    return measured.lines[int(number)], int(time), int(outcome)


def _drawing(line: Line, time: int, outcome: int) -> str:
    """Draw the outcome along the line, and below it its derivatives on the slope that they should have."""
    x, fine = line.plain.parameters, line.fine.outcomes[:, time, outcome]
    shown = dict(zip(("smooth", "plain"), line.plain.derivatives[:, :, time, outcome], strict=True))
    slope = np.gradient(fine, x)
    across = lambda at: _LEFT + (at - x[0]) / (x[-1] - x[0]) * (_WIDTH - _LEFT - _RIGHT)  # noqa: E731
    marks = []
    panels = (
        ("outcome", fine, {"ink": line.plain.outcomes[:, time, outcome]}),
        ("derivative", slope, {"plain": shown["plain"], "smooth": shown["smooth"]}),
    )
    for number, (label, curve, dots) in enumerate(panels):
        top = _TOP + number * (_PANEL + _GAP)
        low, high = _range(curve if number else np.concatenate([*dots.values(), curve]))
        up = lambda y, top=top, low=low, high=high: top + _PANEL * (1 - (np.clip(y, low, high) - low) / (high - low))  # noqa: E731
        marks.append(f'<path class="axis" fill="none" d="M{_LEFT} {top}v{_PANEL}H{_WIDTH - _RIGHT}"/>')
        marks += [f'<path class="jump" d="M{across(at):.1f} {top}v{_PANEL}"/>' for at in line.jumps.places]
        marks.append(f'<path class="slope" d="{_path(across(x), up(curve))}"/>')
        for style, heights in dots.items():
            marks += [
                f'<circle class="{style}" cx="{a:.1f}" cy="{b:.1f}" r="1.9"/>'
                for a, b in zip(across(x), up(heights), strict=True)
                if np.isfinite(b)
            ]
        digits = max(2, int(np.ceil(np.log10(max(abs(low), abs(high), 1e-12) / (high - low)))) + 2)
        for value in (low, high):
            marks.append(f'<text x="{_LEFT - 6}" y="{up(value) + 4:.1f}" text-anchor="end">{value:.{digits}g}</text>')
        marks.append(f'<text x="{_WIDTH - _RIGHT}" y="{top - 6}" text-anchor="end">{label}</text>')
    marks.append(f'<text x="{_LEFT}" y="14">dots: MuJoCo, line: shorter time steps</text>')
    label = _TOP + _PANEL + _GAP - 6
    marks.append(f'<text class="plain" x="{_LEFT}" y="{label}">discrete</text>')
    marks.append(f'<text class="smooth" x="{_LEFT + 110}" y="{label}">slope</text>')
    marks.append(f'<text x="{_LEFT}" y="{_HEIGHT - 6}">place on the line, −1 to 1</text>')
    return f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img">{"".join(marks)}</svg>'


def _range(values: np.ndarray) -> tuple[float, float]:
    """Return what to show: all that is finite, and a third more, but nothing empty."""
    values = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
    low, high = float(values.min()), float(values.max())
    room = (high - low) / 3 if high > low else max(abs(low), 1e-9)
    return low - room, high + room


def _path(x: np.ndarray, y: np.ndarray) -> str:
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b)]
    return "M" + "L".join(points) if points else ""
