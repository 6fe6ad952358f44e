"""The verdict as one page: a bold line, one picture, then sentences; the rest is folded."""

import html
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float

from mjxgrad.contact.warnings import format_number
from mjxgrad.verdict.measure import Line, Measured

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 360.0, 280.0, 58.0, 12.0, 34.0, 44.0
_TICK = 0.022  # half the length of a tangent, as a share of the width
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
svg { width: 100%; height: auto; display: block; } svg text { font: 12px system-ui, sans-serif; fill: var(--ink); }
svg .axis { stroke: var(--line); } svg .plain { stroke: var(--plain); fill: var(--plain); }
svg .smooth { stroke: var(--smooth); fill: var(--smooth); } svg .jump { stroke: var(--soft); stroke-dasharray: 4 3; }
svg text.plain { stroke: none; fill: var(--plain); } svg text.smooth { stroke: none; fill: var(--smooth); }
li { margin: .35rem 0; overflow-wrap: anywhere; } .fault { font-weight: 600; } ul { padding-left: 1.2rem; }
pre { overflow-x: auto; border: 1px solid var(--line); border-radius: .4rem; padding: .7rem; font-size: .8rem; }
summary { cursor: pointer; padding: .3rem 0; }
"""


class Sentence(Protocol):
    """What stands in the list."""

    @property
    def text(self) -> str: ...

    @property
    def is_fault(self) -> bool: ...


def page(
    name: str,
    headline: str,
    findings: Sequence[Sentence],
    code: str,
    details: dict[str, str],
    measured: Measured | None,
    outcomes: Sequence[str],
) -> str:
    """Write the page as HTML that needs nothing beside it."""
    sentences = "".join(f"<li{' class=fault' if one.is_fault else ''}>{_text(one.text)}</li>" for one in findings)
    folded = "".join(
        f"<details><summary>{_text(title)}</summary><pre>{_text(body)}</pre></details>"
        for title, body in details.items()
    )
    body = (
        f'<p class="kicker">mjxgrad check {_text(name)}</p><h1>{_text(headline)}</h1>'
        f"{'' if measured is None else _figure(measured, outcomes)}<ul>{sentences}</ul>"
        f"<h2>To paste</h2><pre>{_text(code)}</pre>{folded}"
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(name)}: {_text(headline)}</title><style>{_STYLE}</style></head><body><main>{body}</main></body></html>\n"
    )


def _text(text: str) -> str:
    return html.escape(text)


def _figure(measured: Measured, outcomes: Sequence[str]) -> str:
    """Draw the line on which MuJoCo's derivative is farthest from the slope, or that with the largest jump."""
    line, time, outcome = _most_telling(measured)
    caption = (
        f"{outcomes[outcome][:1].upper() + outcomes[outcome][1:]} after {measured.times[time]:.2g} s, along a "
        f"random change of {line.varied} ({line.pose}). Each dash is a derivative: it should lie along its curve."
    )
    if len(line.jumps.places):
        caption += " Dashed: jumps."
    return f"<figure>{_drawing(line, time, outcome)}<figcaption>{_text(caption)}</figcaption></figure>"


def _most_telling(measured: Measured) -> tuple[Line, int, int]:
    jumping = [line for line in measured.lines if len(line.jumps.places)]
    if jumping:
        line = max(jumping, key=lambda one: float(one.jumps.sizes.max()))
        sizes = np.abs(line.jumps.after - line.jumps.before)[line.jumps.largest]
        return line, len(measured.times) - 1, int(sizes.argmax())
    errors = [np.where(line.plain.is_resolved(), line.plain.relative_error[0], 0) for line in measured.lines]
    number, time, outcome = np.unravel_index(int(np.argmax(errors)), np.shape(errors))
    return measured.lines[int(number)], int(time), int(outcome)


def _drawing(line: Line, time: int, outcome: int) -> str:
    x = line.plain.parameters
    curves = {"plain": (line.plain, "MuJoCo's step"), "smooth": (line.smooth, "with an onset")}
    values = np.concatenate([one.outcomes[:, time, outcome] for one, _ in curves.values()])
    values = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
    low, high = float(values.min()), float(values.max())
    high = high if high > low else low + 1.0
    across = lambda at: _LEFT + (at - x[0]) / (x[-1] - x[0]) * (_WIDTH - _LEFT - _RIGHT)  # noqa: E731
    up = lambda value: _HEIGHT - _BOTTOM - (value - low) / (high - low) * (_HEIGHT - _BOTTOM - _TOP)  # noqa: E731
    marks = [f'<path class="axis" fill="none" d="M{_LEFT} {_TOP}V{_HEIGHT - _BOTTOM}H{_WIDTH - _RIGHT}"/>']
    for at in line.jumps.places:
        marks.append(f'<path class="jump" d="M{across(at):.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
    for number, (style, (one, label)) in enumerate(curves.items()):
        dashes = _dashes(
            across(x), up(one.outcomes[:, time, outcome]), _slant(one.derivatives[0, :, time, outcome], x, low, high)
        )
        marks.append(f'<path class="{style}" stroke-width="1.6" d="{dashes}"/>')
        marks.append(f'<text class="{style}" x="{_LEFT + 130 * number}" y="18">{_text(label)}</text>')
    digits = max(2, int(np.ceil(np.log10(max(abs(low), abs(high), 1e-12) / (high - low)))) + 2)
    for value in (low, high):
        marks.append(f'<text x="{_LEFT - 6}" y="{up(value) + 4:.1f}" text-anchor="end">{value:.{digits}g}</text>')
    for value, anchor in ((x[0], "start"), (x[-1], "end")):
        text = format_number(round(float(value), 2))
        marks.append(f'<text x="{across(value):.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="{anchor}">{text}</text>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    marks.append(f'<text x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">place on the line</text>')
    return f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img">{"".join(marks)}</svg>'


def _slant(derivatives: np.ndarray, x: np.ndarray, low: float, high: float) -> Float[np.ndarray, " points"]:
    """Return derivatives as slopes on the paper, downwards positive."""
    scale = (x[-1] - x[0]) / (_WIDTH - _LEFT - _RIGHT) * (_HEIGHT - _BOTTOM - _TOP) / (high - low)
    return -derivatives * scale


def _dashes(x: np.ndarray, y: np.ndarray, slant: np.ndarray) -> str:
    """Draw a short tangent through each point, of one length whatever its slope."""
    half = _TICK * _WIDTH / 2 / np.sqrt(1 + slant**2)
    ends = zip(x - half, y - half * slant, 2 * half, 2 * half * slant, strict=True)
    return "".join(f"M{a:.1f} {b:.1f}l{c:.1f} {d:.1f}" for a, b, c, d in ends if np.isfinite([a, b, c, d]).all())
