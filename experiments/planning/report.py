"""The plans in sentences, a table and pictures."""

import copy
import itertools

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle

from experiments.planning.measure import Attempt, Outcome
from experiments.planning.settings import NAMES
from experiments.problems.planar_pusher import planar_pusher
from experiments.report import Table
from experiments.settings import VideoSettings
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, plain, shades, subplots
from experiments.video import film, shown_speed
from experiments.words import capitalised, quantity
from experiments.workspace import Workspace


def answer(outcome: Outcome) -> str:
    """Say whether smoothed models solve the task, and what plain ones do."""
    smoothed = [one for one in outcome.attempts if one.model != "none"]
    plain = outcome.of("none")
    if not smoothed:
        return capitalised(f"{_yes(outcome, plain)}, with plain models.")
    fails = not any(map(outcome.is_solved, outcome.attempts))
    first = f"{_yes(outcome, smoothed)}, {'not even ' * fails}with smoothed models"
    if not plain:
        return f"{first}."
    is_still = all(outcome.moved(one) == 0 for one in plain)
    fate = "the rod does not move" if is_still else f"{_yes(outcome, plain).lower()}"
    return f"{first}; with plain ones {fate}."


def _yes(outcome: Outcome, attempts: list[Attempt]) -> str:
    """Say whether attempts solve the task, and how many do."""
    num_solved = sum(map(outcome.is_solved, attempts))
    count = f" ({num_solved} of {len(attempts)})" if len(attempts) > 1 else ""
    return f"{'Yes' if num_solved else 'No'}{count}"


def verdict(outcome: Outcome) -> str:
    """Answer the question from the data: which linear models solve the task, and what the others do."""
    return capitalised("; ".join(_one(outcome, model) for model in outcome.settings.models)) + "."


def _one(outcome: Outcome, model: str) -> str:
    """Say how one kind of linear model did."""
    attempts, best = outcome.of(model), outcome.shortest(model)
    name = NAMES[model] if model == "none" else f"{NAMES[model]} models"
    num_solved = sum(map(outcome.is_solved, attempts))
    if len(attempts) > 1:
        ways = f"a way, the shortest of {len(best.controls)} steps" if num_solved else "a way"
        return f"with {name} {num_solved or 'none'} of {len(attempts)} trees {'find' if num_solved else 'finds'} {ways}"
    if num_solved:
        return f"with {name} the rod reaches its goal to {_end(outcome, best)}"
    fate = "does not move at all" if outcome.moved(best) == 0 else f"ends {_end(outcome, best)} from its goal"
    return f"with {name} the rod {fate}"


def _end(outcome: Outcome, attempt: Attempt) -> str:
    return f"{1e3 * outcome.distance(attempt):.1f} mm and {outcome.angle(attempt):.3f} rad"


def findings(outcome: Outcome) -> list[str]:
    """Hold the plan against the scene, and say what polishing gained."""
    off = max(abs(outcome.shown[-1] - outcome.best.states[-1, :5]))
    sentences = [
        f"A rollout of the scene under the plan that was kept ends where the planner says, up to {off:.0e} (m, rad)."
    ]
    if outcome.polished is not None:
        before, after = outcome.shortest(outcome.settings.models[0]), outcome.polished
        sentences.append(
            f"Trajectory optimisation took the shortest way of {len(before.controls)} steps from {_end(outcome, before)} to "
            f"{_end(outcome, after)}, and its cost from {quantity(after.course['cost'][0])} to "
            f"{quantity(after.course['cost'].min())}, in {after.seconds:.0f} s."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    is_tree = outcome.settings.method == "tree"
    columns = (
        "linear models", "seed", "solved", "rod from goal", "turn from goal", "steps",
        "nodes" if is_tree else "iterations without a better step", "time with compilation",
    )  # fmt: skip
    rows = [
        [
            attempt.label,
            str(attempt.seed),
            "yes" if outcome.is_solved(attempt) else "no",
            f"{1e3 * outcome.distance(attempt):.1f} mm",
            f"{outcome.angle(attempt):.3f} rad",
            str(len(attempt.controls)),
            str(len(attempt.course["error"]))
            if is_tree
            else f"{(attempt.course['step'] == 0).sum()} of {len(attempt.course['step'])}",
            f"{attempt.seconds:.0f} s",
        ]
        for attempt in outcome.attempts
    ]
    return [Table(columns, rows, "Every attempt; later seeds of a kind use the compiled program of the first.")]


_COLOURS = {"analytic": ZEROTH, "mean_jacobian": FIRST, "least_squares": "#009e73", "none": DEFAULT}
_HALF_LENGTH, _RADIUS = 0.1, 0.02  # m, of the rod's axis; of rod and finger
_EVERY = 3  # decisions between the poses drawn
_DECISION = 0.1  # s


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    how = {"cost": cost} if outcome.settings.method == "trajectory" else {"tree": tree}
    return {"plane": plane, **how, "pose": pose}


def cost(outcome: Outcome):
    """True and smoothed cost against iterations, beside the smoothing length."""
    figure, axes = subplots(1, 2, height=3.6, width_ratios=[2, 1])
    left, right = axes[0]
    for attempt in outcome.attempts:
        colour = _COLOURS[attempt.model]
        true, smoothed = attempt.course["cost"], attempt.course["smoothed_cost"]
        left.plot(np.arange(len(true)), true, color=colour, lw=2, label=attempt.label)
        if attempt.model != "none":
            left.plot(1 + np.arange(len(smoothed)), smoothed, color=colour, lw=0.9)
            right.plot(1 + np.arange(len(smoothed)), 1e3 * attempt.course["length"], color=REFERENCE)
    left.set_yscale("log")
    left.set(title="Cost", xlabel="iteration")
    for axis in (left, right):
        axis.xaxis.get_major_locator().set_params(integer=True)
    left.legend(loc="center right")
    right.set_yscale("log")
    right.set(title="Smoothing length in mm", xlabel="iteration")
    plain(right.yaxis)
    caption = (
        "Left, the cost of the scene itself under the controls of each iteration (thick), and of the smoothed scene that the "
        "iteration works on (thin). Right, the smoothing length. Both costs meet as the smoothing vanishes; a cost that rises "
        "on the way is a plan whose contact existed in the smoothed scene alone. The best controls of all are kept."
    )
    return figure, "Cost against iterations", caption


def tree(outcome: Outcome):
    """The rod's places in the tree, and the nearest to the goal against nodes."""
    figure, axes = subplots(1, 2, height=4.6)
    left, right = axes[0]
    best = outcome.shortest(outcome.settings.models[0])
    assert best.nodes is not None and best.parents is not None  # noqa: PT018
    reached = "way found" if outcome.is_solved(best) else "way to the nearest node"
    places = best.nodes[:, 2:4]
    joined = np.stack([places[best.parents[1:]], places[1:]], axis=1)
    left.add_collection(LineCollection(list(joined), colors=MUTED, linewidths=0.5, alpha=0.6))
    left.plot(*places.T, ".", ms=1.5, color=MUTED)
    left.plot(*best.states[:, 2:4].T, color=ZEROTH, lw=2.2, label=reached)
    left.plot(*best.states[0, 2:4], "o", color=REFERENCE, ms=5, label="start")
    left.plot(*outcome.goal[:2], "*", color=FIRST, ms=11, label="goal", zorder=4)
    left.set(title="Rod's centre in the nodes", xlabel="x in m", ylabel="y in m", aspect="equal")
    left.margins(0.08)
    left.legend(loc="upper left")
    seen = set()
    for attempt in outcome.attempts:
        error = attempt.course["error"]
        label = None if attempt.model in seen else attempt.label
        seen.add(attempt.model)
        colour = _COLOURS[attempt.model]
        right.step(1 + np.arange(len(error)), error, where="post", color=colour, lw=1.4, label=label)
        right.plot(len(error), error[-1], "o" if error[-1] <= 1 else "x", color=colour, ms=5)
    right.axhline(1, color=REFERENCE, lw=0.9, ls=(0, (2, 3)))
    right.set_xscale("log")
    right.set_yscale("log")
    right.set(title="Nearest to the goal, in tolerances", xlabel="nodes")
    right.legend(loc="upper right")
    settings = outcome.settings
    caption = (
        "Left, where the rod is in every node, joined to its parent; thick, the way that was found. Right, the nearest that "
        f"the tree has come to the goal, in units of the tolerance, against its nodes, for {settings.tree.num_seeds} seeds of "
        "each kind of linear model; below the dotted line it is solved."
    )
    return figure, "The tree", caption


def plane(outcome: Outcome):
    """Rod and finger along the plan."""
    best = outcome.best
    last = len(best.states) - 1
    shown = [*range(0, last, _EVERY), last]
    parts = _stages(best, shown)
    figure, axes = subplots(1, len(parts), height=4.4, sharex=True, sharey=True)
    for axis, part in zip(axes[0], parts, strict=True):
        for number, colour in zip(part, shades(len(part)), strict=True):
            _rod(axis, best.states[number, 2:5], color=colour, alpha=0.55)
            axis.add_patch(Circle(tuple(best.states[number, :2]), _RADIUS, color=colour))
        axis.plot(*best.states[part[0] : part[-1] + 1, :2].T, color=FIRST, lw=1.2)
        _rod(axis, outcome.goal, facecolor="none", edgecolor=REFERENCE, ls="--", lw=1.2)
        axis.add_patch(Circle(tuple(best.states[part[0], :2]), _RADIUS, facecolor="none", edgecolor=FIRST, lw=1.5))
        axis.set(title=f"{part[0] * _DECISION:.1f} to {part[-1] * _DECISION:.1f} s", xlabel="x in m", aspect="equal")
    axes[0, 0].set_ylabel("y in m")
    axes[0, 0].autoscale_view()
    caption = (
        "Rod and finger every 0.3 s and at the end, from faint to strong; the dashed outline is the goal, the ring where the "
        "finger starts."
    )
    return figure, "The plan, seen from above", caption


def pose(outcome: Outcome):
    """The rod's coordinates against time."""
    figure, axes = subplots(1, 3, height=2.9)
    best = outcome.best
    time = _DECISION * np.arange(len(best.states))
    for i, (axis, title) in enumerate(zip(axes[0], ("x in m", "y in m", "turn in rad"), strict=True)):
        axis.axhline(outcome.goal[i], color=REFERENCE, lw=1, ls=(0, (4, 3)))
        axis.plot(time, best.states[:, 2 + i], color=_COLOURS[best.model])
        axis.set(title=title, xlabel="time in s")
        axis.margins(y=0.15)
    caption = "The rod under the plan that was kept, every decision; dashed, the goal."
    return figure, "Where the rod is", caption


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the best plan with the goal as a shade, and give the file and its caption."""
    mj_model = copy.copy(planar_pusher().system.scene.mj_model)
    target = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
    x, y, turn = outcome.goal
    mj_model.body_pos[target] = [x, y, mj_model.body_pos[target, 2]]
    mj_model.body_quat[target] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    still = np.repeat(outcome.shown[-1:], int(1 / outcome.timestep * wanted.speed), axis=0)
    motion = mj_model, np.concatenate([outcome.shown, still])
    caption = f"The plan on the scene itself, {shown_speed(wanted.speed)}; the goal in a light shade."
    return film(workspace, [motion], wanted, camera="above", caption=caption, timestep=outcome.timestep)


def _stages(attempt: Attempt, shown: list[int], most: int = 9) -> list[list[int]]:
    """Split the poses to be drawn into panels that overlap in one pose: too many on one another hide what happens."""
    count = max(1, -(-(len(shown) - 1) // (most - 1)))
    ends = np.linspace(0, len(shown) - 1, count + 1).round().astype(int)
    return [shown[a : b + 1] for a, b in itertools.pairwise(ends)]


def _rod(axis: Axes, pose: np.ndarray, **look) -> None:
    """Draw a capsule as the outline of two half circles."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 20)
    right = np.stack([_HALF_LENGTH + _RADIUS * np.cos(angle), _RADIUS * np.sin(angle)])
    outline = np.concatenate([right, -right], axis=1)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = np.array([[cos, -sin], [sin, cos]]) @ outline + pose[:2, None]
    axis.fill(x, y, **({"lw": 0} | look))  # pyright: ignore[reportArgumentType]
    # The end that the scene paints in another colour tells one half turn from the other.
    axis.plot(pose[0] + cos * _HALF_LENGTH, pose[1] + sin * _HALF_LENGTH, ".", color=REFERENCE, ms=3)
