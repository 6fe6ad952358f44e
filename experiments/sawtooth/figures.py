"""The pictures of the sawtooth."""

import functools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.sawtooth.measure import Outcome
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, subplots

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
