"""The answer of the experiment on the sawtooth in words, computed from its numbers."""

from typing import Any

import numpy as np

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.sawtooth.measure import Course, Outcome


def verdict(outcome: Outcome) -> str:
    """Say whether teeth are gone, and whose mean derivative is the slope."""
    courses = outcome.courses
    ratio, spread = _pooled(courses, _ratio), _pooled(courses, lambda c: c.spread(CONTINUOUS))
    if not ratio.size:
        return "Nothing touches in these motions: there are no teeth."
    off = {arm: float(np.mean(_pooled(courses, lambda c, a=arm: _off(c, a)) <= 2)) for arm in ARMS}
    return (
        f"The sawtooth is {np.median(ratio):.0f} times smaller in the median ({np.quantile(ratio, 0.1):.0f} at the tenth "
        f"percentile) when contacts begin within the step. The mean of the plain derivative is then the slope within two "
        f"standard errors at {off[CONTINUOUS]:.0%} of {ratio.size} readings ({off[DISCRETE]:.0%} without, {off[EVENT]:.0%} for "
        f"the event gradient), and single derivatives scatter by {np.median(spread):.2f} of it."
    )


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    courses = outcome.courses
    sentences = []
    beyond = [(course, _excess(course, CONTINUOUS)) for course in courses]
    worst = [f"{c.title}, {1e3 * c.timestep:g} ms" for c, e in beyond if (e[c.has_impact] > 0.05).any()]
    if worst:
        sentences.append(f"Some mean derivative is more than 5% beyond its error in {'; '.join(worst)}.")
    moved = _pooled(courses, lambda c: c.shift / c.sawtooth(DISCRETE))
    sentences.append(f"The mean outcome shifts by {np.median(moved):.2f} of MuJoCo's sawtooth in the median.")
    if all(c.reference is not None for c in courses):
        closer = _pooled(courses, _closer)
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
        pick = c.has_impact
        row = [c.title, f"{1e3 * c.timestep:g}", f"{np.median(_ratio(c)[pick]):.0f} ({_ratio(c)[pick].min():.1f})"]
        row += [f"{np.median(c.spread(arm)[pick]):.2g}" for arm in ARMS]
        row += [f"{int((_off(c, arm)[pick] <= 2).sum())} of {int(pick.sum())}" for arm in ARMS]
        row.append(f"{np.median((c.shift / c.sawtooth(DISCRETE))[pick]):.2f}")
        closer = _closer(c)
        error = "–" if closer is None else f"{np.median(closer[pick]):.2f}"
        rows.append([*row, error])
    columns = ["motion", "time step, ms", "sawtooth smaller, times"]
    columns += [f"spread, {arm}" for arm in ARMS] + [f"within 2 errors, {arm}" for arm in ARMS]
    columns += ["shift of the mean", "error"]
    caption = (
        "Medians over times and coordinates with an impact before them; in brackets the least. Spread: standard deviation of "
        "single derivatives about their trend, over the slope. Within 2 errors: readings where the mean derivative is the slope "
        "of its own outcome. Shift of the mean outcome over MuJoCo's sawtooth. Error beside the converged motion over "
        "MuJoCo's own."
    )
    return [Table(columns, rows, caption)]


def _pooled(courses: list[Course], values: Any) -> np.ndarray:
    return np.concatenate([np.broadcast_to(values(c), c.has_impact.shape)[c.has_impact] for c in courses])


def _ratio(course: Course) -> np.ndarray:
    return course.sawtooth(DISCRETE) / np.maximum(course.sawtooth(CONTINUOUS), np.finfo(float).tiny)


def _off(course: Course, arm: str) -> np.ndarray:
    """Give by how many of its standard errors the mean derivative is off the slope of its own outcome."""
    found = course.arms[arm]
    return np.abs(found.error[0]) / np.maximum(found.standard_error[0], found.resolution)


def _excess(course: Course, arm: str) -> np.ndarray:
    """Give the error beyond two standard errors, over the slope."""
    found = course.arms[arm]
    return np.maximum(np.abs(found.error[0]) - 2 * found.standard_error[0], 0) / np.maximum(
        np.abs(found.slope), found.resolution
    )


def _closer(course: Course) -> np.ndarray | None:
    """Give the error beside the converged motion over that of MuJoCo's step; None without a reference."""
    own, theirs = course.error(CONTINUOUS), course.error(DISCRETE)
    return None if own is None or theirs is None else own / theirs
