"""Report of an identification as a page: the answer, signals before and after, and values."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjxgrad.identification.files import column_names
from mjxgrad.identification.motions import Motions
from mjxgrad.identification.parameters import Parameter
from mjxgrad.identification.recording import Recording, stack
from mjxgrad.identification.result import Identification
from mjxgrad.report import INK, Block, Table, page, svg
from mjxgrad.scene import Scene

_MOST_SIGNALS, _MOST_DOTS = 8, 300
_SIZE = (4.6, 2.1)  # inches


def identified_page(
    name: str, scene: Scene, result: Identification, recordings: Sequence[Recording], held_out: Sequence[Recording]
) -> str:
    """Return a self-contained page on the search from a scene with the nominal values; needs `mjxgrad[render]`."""
    told = f"Condition number {result.condition_number:.2g}: combinations of parameters have narrower intervals."
    head, *rows = result.rows()
    numbers = Block(faults=result.warnings(), items=[told] * (result.condition_number > 100), table=Table(head, rows))
    # The held-out end of a single recording, else the first recording.
    motions = [recordings[0], *(held_out[:1] if len(recordings) == 1 else ())]
    blocks = [numbers, _figures(scene, result, motions), Block(folded="In words", code=result.summary())]
    return page(result.headline, f"mjxgrad identify {name}", blocks)


def _figures(scene: Scene, result: Identification, motions: Sequence[Recording]) -> Block:
    """Draw those signals of the last motion that the search changed most."""
    window, before, after = stack(scene, motions[-1:]), {}, {}
    none = np.zeros((1, 1, 2 * scene.model.nv))
    found = none if result.offsets is None else result.offsets[None, :1]
    for curves, one, values, start in (
        (before, scene, result.start, none),
        (after, result.scene, result.values, found),
    ):
        delayed = Motions(one, {"delay": Parameter(0.0)}, delay="delay", contact=None)
        signals = delayed.signals(window, np.full((1, 1), float(np.ravel(values.get("delay", 0.0))[0])), start)
        curves |= {name: signal[0, 0] for name, signal in signals.items()}
    times = np.concatenate([motion.times for motion in motions])
    fitted_until = float(motions[0].times[-1]) if len(motions) > 1 else None
    names, signals = column_names(scene), []
    for name in motions[-1].measured:
        rows = np.concatenate([motion.measured[name] for motion in motions])
        for i, values in enumerate(rows.T):
            known = np.isfinite(values)
            if known.any():
                old, new = before[name][:, i], after[name][:, i]
                change = np.abs(new - old).max() / max(np.ptp(values[known]), 1e-12)
                signals.append((change, names.get((name, i), name), times[known], values[known], old, new))
    least = sorted(one[0] for one in signals)[-_MOST_SIGNALS:][0]
    panel = functools.partial(_panel, float(scene.model.opt.timestep), fitted_until)
    drawings = [svg(functools.partial(panel, *one[1:]), f"{one[1]} over time") for one in signals if one[0] >= least]
    caption = "SI units. Dots: measured. Dashed: where the search began. Line: with the values found."
    caption += " Grey: held out." * (fitted_until is not None)
    if (count := result.num_motions) > 1:
        caption += f" Contacts chatter: one motion, as this line, parts from the dots; the mean of {count} fits."
    if len(signals) > len(drawings):
        caption += f" The {len(drawings)} of {len(signals)} signals that changed most."
    return Block(drawings=drawings, caption=caption)


def _panel(timestep: float, fitted_until: float | None, title: str, *signal: np.ndarray) -> Any:
    """Draw a signal over time: measured, at the start, identified; the curve at the start may leave the picture."""
    import matplotlib.pyplot as plt

    (times, values, before, after), (figure, axis) = signal, plt.subplots(figsize=_SIZE)
    at = timestep * np.arange(len(before))
    end = max(at[-1], times.max())
    if fitted_until is not None:
        axis.axvspan(fitted_until, end, color="#8b94a1", alpha=0.2, lw=0)
    shown = slice(None, None, max(1, len(times) // _MOST_DOTS))
    axis.plot(times[shown], values[shown], "o", color=INK, ms=2.5, mew=0, alpha=0.6)
    axis.plot(at, before, "--", color="#d55e00", lw=1.2)
    axis.plot(at, after, "-", color="#0072b2", lw=1.4)
    low, high = (float(pick([pick(values), pick(after)])) for pick in (np.min, np.max))
    room = 0.15 * (high - low) or max(abs(low), 1e-9)
    axis.set_title(title, parse_math=False)  # names may contain dollars
    axis.set(xlabel="time, s", xlim=(0, end), ylim=(low - room, high + room))
    return figure
