"""The figure of a verdict: an outcome along a line, and its derivatives beside the slope."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjxgrad.checking.measure import Line, Measured
from mjxgrad.report import INK, Block, svg

_SIZE = (4.6, 2.9)  # inches
_UNITS = {"where": "m, rad", "how": "m/s, rad/s"}  # by an outcome's first word; others have the user's units


def telling(measured: Measured, outcomes: Sequence[str]) -> Block:
    """Draw the line on which MuJoCo's derivative is farthest from the slope, or the line with the largest jump."""
    line, time, outcome = _most_telling(measured)
    words, of = outcomes[outcome], (slice(None), time, outcome)
    unit = _UNITS.get(words.partition(" ")[0], "units of the cost")
    caption = (
        f"{words[:1].upper() + words[1:]} after {measured.times[time]:.2g} s, along a random change of {line.varied} "
        f"({line.pose}). The other figure: its derivatives, which should lie on the grey slope."
    )
    caption += " Dashed: a jump." * bool(len(line.jumps.places))
    x, fine, (smooth, plain) = line.plain.parameters, line.fine.outcomes[of], line.plain.derivatives[:, *of]
    panel = functools.partial(_panel, x, line.jumps.places)
    moved = {"MuJoCo": (line.plain.outcomes[of], INK, "o")}
    derived = {"discrete": (plain, "#d55e00", "s"), "slope": (smooth, "#009e73", "o")}
    drawings = [
        svg(lambda: panel(f"outcome ({unit})", "shorter time steps", fine, moved), "The outcome along the line"),
        svg(lambda: panel(f"derivative ({unit})", "its slope", np.gradient(fine, x), derived), "Its derivatives"),
    ]
    return Block(drawings=drawings, caption=caption)


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


def _panel(x: np.ndarray, jumps: np.ndarray, what: str, fine: str, curve: np.ndarray, dots: dict[str, tuple]) -> Any:
    """Draw dots by name, colour and marker over a grey curve; of several kinds, those beyond its range lie on the edge."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=_SIZE)
    axis.plot(x, curve, color="#8b94a1", lw=1.4, label=fine)
    axis.margins(y=1 / 3)
    low, high = -np.inf, np.inf
    if len(dots) > 1:  # beside other derivatives the slope sets the range
        low, high = axis.get_ylim()
        axis.set_autoscaley_on(False)
    for name, (values, colour, marker) in dots.items():
        axis.plot(x, np.clip(values, low, high), marker, color=colour, ms=3, mew=0, label=name, clip_on=False)
    for place in jumps:
        axis.axvline(place, color="#8b94a1", lw=1, ls="--")
    axis.set(xlabel="place on the line, −1 to 1", ylabel=what)
    figure.legend(loc="outside upper right", ncols=3)
    return figure
