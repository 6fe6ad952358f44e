"""The pictures of the rolling pin's experiment."""

import numpy as np

from experiments.rolling_pin.outcome import Outcome
from experiments.theme import FIRST, MUTED, ZEROTH, Drawings, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.workspace import Workspace

# Palette as in the theme; those that share a kind of remedy differ by their dashes.
_COLOURS = {"first order": FIRST, "zeroth order": ZEROTH, "α-order": "#e69f00"}
_OTHERS = ("#009e73", "#cc79a7", "#22262e", "#56b4e9", "#8c6d31")
_DASHES = ("-", (0, (5, 2)), (0, (2, 1.5)))


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"descent": descent, "bed": bed}


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
    reach = outcome.settings.remedies
    caption = (
        "True cost against steps, left, and against rollouts, right: every descent is judged by the same scene, without noise "
        f"and without its remedy. The dotted line is what counts as solved. At first the pin is {1e3 * reach.radius:g} mm "
        f"larger, the margin {1e3 * reach.margin:g} mm wide, the kernel {1e3 * reach.length:g} mm long; all shrink to "
        f"{reach.last:.0%} on the way, so that what is seen becomes what is."
    )
    return figure, "True cost of each descent", caption


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
    caption = (
        "Heights of the eight pillars in the end, under the true motion; grey, the dent that was asked for. The pin starts "
        "above the third."
    )
    return figure, "The bed in the end", caption


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the motion of the best controls, and give the file and its caption; nothing if none was asked for."""
    wanted = outcome.settings.video
    if wanted is None:
        return None, ""
    motion = with_coarse_shadows(outcome.task.scene.mj_model), outcome.motion
    caption = (
        f"The motion that {outcome.best.label} ends with, {shown_speed(wanted.speed)}; the green line is the depth that was "
        "asked for."
    )
    return film(workspace, [motion], wanted, camera="side", caption=caption)


def _looks(outcome: Outcome) -> list[dict]:
    looks, others = [], 0
    for one in outcome.descents:
        if one.label in _COLOURS:
            looks.append({"color": _COLOURS[one.label], "lw": 1.8})
            continue
        looks.append({"color": _OTHERS[others % len(_OTHERS)], "ls": _DASHES[others % len(_DASHES)], "lw": 1.8})
        others += 1
    return looks
