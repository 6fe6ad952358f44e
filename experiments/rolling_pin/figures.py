"""The pictures of the rolling pin's experiment."""

from pathlib import Path

import numpy as np

from experiments.pictures import drawn
from experiments.report import Figure
from experiments.rolling_pin.outcome import Outcome
from experiments.theme import FIRST, MUTED, ZEROTH, subplots

# Palette as in the theme; those that share a kind of remedy differ by their dashes.
_COLOURS = {"first order": FIRST, "zeroth order": ZEROTH, "α-order": "#e69f00"}
_OTHERS = ("#009e73", "#cc79a7", "#22262e", "#56b4e9", "#8c6d31")
_DASHES = ("-", (0, (5, 2)), (0, (2, 1.5)))


def draw(outcome: Outcome, folder: Path, captions: dict[str, str]) -> list[Figure]:
    """Draw all figures.

    Args:
        outcome: the numbers.
        folder: of the run.
        captions: of the figures, by name: descent, bed.

    Returns:
        The figures in order of reading.
    """
    pictures = {"descent": ("True cost of each descent", descent), "bed": ("The bed in the end", bed)}
    return drawn(pictures, outcome, folder, captions)


def descent(outcome: Outcome):
    """True cost against steps and against rollouts."""
    figure, axes = subplots(1, 2, height=4.4, sharey=True)
    left, right = axes[0]
    for one, look in zip(outcome.descents, _looks(outcome), strict=True):
        steps = np.arange(len(one.costs))
        left.plot(steps, one.costs, label=one.label, **look)
        # The first point has cost no rollout, and a logarithm has no place for it.
        right.plot(steps[1:] * one.num_samples, one.costs[1:], **look)
    for axis in (left, right):
        axis.axhline(outcome.settings.solved_below, color=MUTED, lw=0.8, ls=(0, (2, 3)))
        axis.set_yscale("log")
    left.set(title="Against steps", xlabel="step", ylabel="true cost")
    right.set(title="Against rollouts", xlabel="rollouts", xscale="log")
    figure.legend(loc="outside lower center", ncols=4)
    return figure


def bed(outcome: Outcome):
    """Final heights, one small panel for each descent."""
    columns = 4
    rows = -(-len(outcome.descents) // columns)
    figure, axes = subplots(rows, columns, height=2.2 * rows, sharex=True, sharey=True)
    places = np.arange(1, len(outcome.target) + 1)
    for axis, one, look in zip(axes.flat, outcome.descents, _looks(outcome), strict=False):
        axis.step(places, 1e3 * outcome.target, where="mid", color=MUTED, lw=3, alpha=0.5)
        axis.plot(places, 1e3 * outcome.heights[one.label], "o", ms=5, color=look["color"])
        axis.set_title(one.label)
        axis.set_xticks(places)
    for axis in axes.flat[len(outcome.descents) :]:
        axis.set_axis_off()
    for axis in axes[:, 0]:
        axis.set_ylabel("height (mm)")
    for axis in axes[-1]:
        axis.set_xlabel("pillar")
    return figure


def _looks(outcome: Outcome) -> list[dict]:
    looks, others = [], 0
    for one in outcome.descents:
        if one.label in _COLOURS:
            looks.append({"color": _COLOURS[one.label], "lw": 1.8})
            continue
        looks.append({"color": _OTHERS[others % len(_OTHERS)], "ls": _DASHES[others % len(_DASHES)], "lw": 1.8})
        others += 1
    return looks
