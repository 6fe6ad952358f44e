"""The pictures of the rolling pin's experiment."""

import jax.numpy as jnp
import numpy as np

from experiments.rolling_pin.measure import Outcome, positions
from experiments.theme import MUTED, Drawings, legend_below, looks, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.workspace import Workspace


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"descent": descent}


def descent(outcome: Outcome):
    """True cost against steps and against rollouts."""
    figure, axes = subplots(1, 2, height=4.4, sharey=True)
    left, right = axes[0]
    for one, look in zip(outcome.descents, looks(one.label for one in outcome.descents), strict=True):
        steps = np.arange(len(one.costs))
        look |= {"ms": 4, "markevery": max(1, len(steps) // 8)}
        left.plot(steps, one.costs, label=one.label, **look)
        # The first point has cost no rollout, and a logarithm has no place for it.
        right.plot(steps[1:] * one.num_samples, one.costs[1:], **look)
    for axis in (left, right):
        axis.axhline(outcome.settings.solved_below, color=MUTED, lw=0.8, ls=(0, (2, 3)))
        axis.set_yscale("log")
    left.set(title="Against steps", xlabel="step", ylabel="true cost")
    right.set(title="Against rollouts", xlabel="rollouts", xscale="log")
    legend_below(figure, left, 4)
    reach = outcome.settings.remedies
    caption = (
        "True cost against steps, left, and against rollouts, right: every descent is judged by the same scene, without noise "
        f"and without its remedy. The dotted line is what counts as solved. At first the pin is {1e3 * reach.radius:g} mm "
        f"larger, the margin {1e3 * reach.margin:g} mm wide, the kernel {1e3 * reach.length:g} mm long; all shrink to "
        f"{reach.last:.0%} on the way, so that what is seen becomes what is."
    )
    return figure, "True cost of each descent", caption


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the motion of the best controls, and give the file and its caption; nothing if none was asked for."""
    wanted = outcome.settings.video
    if wanted is None:
        return None, ""
    best = min(outcome.descents, key=lambda one: one.costs[-1])
    qpos = np.asarray(positions(outcome.task, jnp.asarray(best.params)))
    caption = (
        f"The motion that {best.label} ends with, {shown_speed(wanted.speed)}; the green line is the wanted depth."
    )
    mj_model = with_coarse_shadows(outcome.task.scene.mj_model)
    return film(workspace, [(mj_model, qpos)], wanted, camera="side", caption=caption)
