"""The answer of the experiment on the sawtooth: words, tables, pictures."""

import functools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.sawtooth.measure import Outcome
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, subplots
from experiments.words import joined


def verdict(outcome: Outcome) -> str:
    """Say whether teeth are gone, and whose mean derivative is the slope."""
    smaller, spread = _pooled(outcome, "smaller"), _pooled(outcome, "spread", CONTINUOUS)
    if not smaller.size:
        return "Nothing touches in these motions: there are no teeth."
    within = {arm: _pooled(outcome, "within", arm).mean() for arm in ARMS}
    return (
        f"The sawtooth is {np.median(smaller):.0f} times smaller in the median ({np.quantile(smaller, 0.1):.0f} at the tenth "
        f"percentile) when contacts begin within the step. The mean of the plain derivative is then the slope within two "
        f"standard errors at {within[CONTINUOUS]:.0%} of {smaller.size} readings ({within[DISCRETE]:.0%} without, "
        f"{within[EVENT]:.0%} for the event gradient), and single derivatives scatter by {np.median(spread):.2f} of it."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what the table's medians do not show: where a mean derivative is off, and how often the motion is worse."""
    sentences = []
    off = [c for c in outcome.courses if (c.excess.sel(arm=CONTINUOUS).where(c.has_impact) > 0.05).any()]
    if off:
        sentences.append(f"Some mean derivative is more than 5% beyond its error in {joined(map(_name, off))}.")
    closer = _pooled(outcome, "closer")
    if closer.size and np.isfinite(closer).all():
        sentences.append(
            f"Beside MuJoCo's motion at a step many times shorter its error is {np.median(closer):.2f} of MuJoCo's own in the "
            f"median, and larger at {np.mean(closer > 1):.0%} of the readings."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all motions."""
    rows = []
    for c in outcome.courses:
        if not c.has_impact.any():
            continue
        picked = c.where(c.has_impact)
        middle = picked.median(("time", "coordinate"))
        within = (c.within & c.has_impact).sum(("time", "coordinate"))
        row = [str(c.title.values), f"{1e3 * float(c.timestep):g}"]
        row.append(f"{float(middle.smaller):.0f} ({float(picked.smaller.min()):.1f})")
        row += [f"{value:.2g}" for value in middle.spread.values] + [f"{value:.1%}" for value in middle.error.values]
        row += [f"{value} of {int(c.has_impact.sum())}" for value in within.values]
        row.append(f"{float(middle['shift']):.2f}")
        rows.append([*row, "–" if np.isnan(middle.closer) else f"{float(middle.closer):.2f}"])
    columns = ["motion", "time step, ms", "sawtooth smaller, times"]
    columns += [f"{what}, {arm}" for what in ("spread", "error", "within 2 errors") for arm in ARMS]
    columns += ["shift of the mean", "off the converged motion"]
    caption = (
        "Medians over times and coordinates with an impact before them; in brackets the least. Spread: standard deviation of "
        "single derivatives about their trend, over the slope. Error: of the mean derivative, over the slope of its own outcome, "
        "sampling errors included; within 2 errors: readings where it is no more than these. Shift of the mean outcome over "
        "MuJoCo's sawtooth. Distance of the outcome from the converged motion over MuJoCo's own."
    )
    return [Table(columns, rows, caption)]


def _pooled(outcome: Outcome, name: str, arm: str | None = None) -> np.ndarray:
    """Give a number at every reading with an impact before it, of all motions."""
    picked = [(c[name] if arm is None else c[name].sel(arm=arm), c.has_impact) for c in outcome.courses]
    return np.concatenate([values.values[has_impact.values] for values, has_impact in picked])


def _name(course: xr.Dataset) -> str:
    return f"{course.title.values}, {1e3 * float(course.timestep):g} ms"


_COLOURS = {DISCRETE: FIRST, EVENT: ZEROTH, CONTINUOUS: ONSET}
_NAMES = {
    DISCRETE: "MuJoCo's step; its derivative",
    EVENT: "event gradient",
    CONTINUOUS: "contact begins within the step",
}


def drawings(outcome: Outcome) -> Drawings:
    """Name a figure per motion, at its longest time step."""
    longest: dict[str, xr.Dataset] = {}
    for course in outcome.courses:
        longest.setdefault(str(course.case.values), course)
    named = enumerate(longest.items())
    return {f"teeth_{name}": functools.partial(_teeth, course, k == 0) for k, (name, course) in named}


def _teeth(course: xr.Dataset, is_first: bool, _: Outcome):
    """Draw the outcome less its trend and single derivatives over the start, and their mean over time."""
    figure, axes = subplots(3, course.coordinate.size, height=7.4)
    for column, label in zip(axes.T, course.coordinate.values, strict=True):
        one = course.sel(coordinate=label)
        _draw_starts(column[0], column[1], one.isel(time=-1))
        _draw_times(column[2], one)
        column[0].set_title(label)
    for row, label in enumerate(("outcome less its trend", "derivative, each start", "derivative, mean")):
        axes[row, 0].set_ylabel(label)
    handles = [Line2D([], [], color=_COLOURS[arm], marker=".", label=_NAMES[arm]) for arm in ARMS]
    handles.append(Line2D([], [], color=REFERENCE, label="slope of the simulated outcome"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    title, duration, h = str(course.title.values), float(course.time[-1]), 1e3 * float(course.timestep)
    figure.suptitle(f"{title}, {duration:.2f} s, time step {h:g} ms", fontsize=10)
    caption = (
        "Above, where the motion ends up, less a smooth trend, against where it starts. In the middle, the derivative of each "
        "single rollout; the line is the slope of the outcome. Below, their mean against time. Derivatives far off are cut."
    )
    return figure, title, caption if is_first else "As the figure before."


def _draw_starts(upper: Axes, lower: Axes, one: xr.Dataset) -> None:
    """Draw one coordinate of the last reading over the start."""
    for arm in (DISCRETE, CONTINUOUS):
        upper.plot(one.start, one.residual.sel(arm=arm), color=_COLOURS[arm], lw=1.3)
    for arm in ARMS:
        lower.plot(one.start, one.derivative.sel(arm=arm), ".", color=_COLOURS[arm], ms=4)
    slope = float(one.slope.sel(arm=CONTINUOUS))
    lower.axhline(slope, color=REFERENCE, lw=1.2)
    _show(lower, np.append(np.quantile(one.derivative, [0.02, 0.98]), slope))
    upper.axhline(0, color=MUTED, lw=0.6)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("start, m or rad")


def _draw_times(axis: Axes, one: xr.Dataset) -> None:
    """Draw the slope of one coordinate and the mean of each derivative over time."""
    slope = one.slope.sel(arm=CONTINUOUS)
    axis.plot(one.time, slope, color=REFERENCE, lw=2.6)
    for arm in ARMS:
        mean, wide = one["mean"].sel(arm=arm), 2 * one.mean_error.sel(arm=arm)
        axis.plot(one.time, mean, color=_COLOURS[arm], lw=1.3)
        axis.fill_between(one.time, mean - wide, mean + wide, color=_COLOURS[arm], alpha=0.15, lw=0)
    near = np.concatenate([slope, one["mean"].sel(arm=CONTINUOUS), [0.0]])
    reach = max(float(np.ptp(near)), 1e-9)
    _show(axis, np.append(near, np.clip(one["mean"], near.min() - reach, near.max() + reach)))
    axis.set_xlabel("time, s")


def _show(axis: Axes, values: np.ndarray) -> None:
    pad = 0.15 * max(float(np.ptp(values)), np.abs(values).max(), 1e-9)
    axis.set_ylim(values.min() - pad, values.max() + pad)
