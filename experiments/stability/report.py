"""The answer of an experiment on stability, computed from its numbers, and its pictures."""

import re
from collections import Counter

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure as Picture
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from experiments.report import Table, tabulated
from experiments.stability.measure import (
    C_MUJOCO,
    GAIN,
    NOT_ASKED,
    Derivative,
    Motion,
    Outcome,
    SceneOutcome,
    against_c,
)
from experiments.stability.scenes import PARAMETERS, Points, StabilityScene
from experiments.theme import REFERENCE, Drawings, legend_below, power, subplots
from experiments.words import percent
from mjxgrad.contact.warnings import largest_stable_step, steepest

_SAME_MOTION = 1e-3
"""Difference of final positions, over what a body flies in the rollout, up to which two motions are one."""
_LITTLE_FRICTION = 0.03  # below it the edges of a pyramid weigh more than a thousand times what its normal would


def answer(outcome: Outcome) -> str:
    """Say at which share of the points step and gradient hold, and whether every failure is flagged."""
    found, precision = outcome.found, outcome.settings.precisions[0]
    ours, theirs = (
        percent(float((found.motion.sel(simulator=name) < Motion.GAINS_ENERGY).mean()))
        for name in (precision, C_MUJOCO)
    )
    right, judged = _right(found.sel(simulator=precision), "derivative")
    gradient = f", gradients there at {percent(right / judged)}" if judged else ""
    unflagged = int(found.silent.sum())
    flags = f"{unflagged} failures are unflagged" if unflagged else "every failure is flagged"
    return f"Motion holds at {ours} (C MuJoCo: {theirs}){gradient}; {flags}."


def verdict(outcome: Outcome) -> str:
    """Say whether a failure goes unflagged, and how mjxgrad compares with C MuJoCo."""
    found = outcome.found
    sentences = [f"Rollouts with a number that is not finite, and no flag: {_count(found.silent)}."]
    for name in outcome.settings.precisions:
        signs = against_c(found, name)
        sentences.append(
            f"In {name} {_count(signs == 0)} of {signs.size} motions are as good as C MuJoCo's, {_count(signs > 0)} worse and "
            f"{_count(signs < 0)} better."
        )
    return " ".join(sentences)


def summary(outcome: Outcome) -> Table:
    """Count by precision what is not solved and what is right."""
    rows = []
    for name in outcome.settings.precisions:
        found = outcome.found.sel(simulator=name)
        rows.append(
            {
                "precision": name,
                "not solved to a thousandth": _count(found.motion == Motion.NOT_SOLVED),
                "not told by Trajectory.unsolved": _count(found.untold),
                "right by the start": "{} of {}".format(*_right(found, "derivative")),
                "by parameters": "{} of {}".format(*_right(found, "derivative_by_parameters")),
            }
        )
    caption = (
        "Points. Derivatives by the start, and by contact parameters, friction and time step, where the motion is fine: right of "
        "those that finite differences can judge."
    )
    return tabulated(rows, caption)


def tables(outcome: Outcome) -> list[Table]:
    """Count classes by scene and simulator, and give the reasons of what is worse than C MuJoCo."""
    motions, derivatives, explained = [], [], []
    for one in outcome.scenes:
        for name in one.found.simulator.values:
            found, label = one.found.sel(simulator=name), name if name == C_MUJOCO else f"mjxgrad, {name}"
            row = {"scene": one.scene.name, "simulator": label}
            motions.append(row | _cells(found.motion, Motion))
            for key, line in {"derivative": "by the start", "derivative_by_parameters": "by parameters"}.items():
                if (found[key] != NOT_ASKED).all():
                    derivatives.append(row | {"derivative": line} | _cells(found[key], Derivative))
        for precision in outcome.settings.precisions:
            row = {"scene": one.scene.name, "precision": precision}
            counts = Counter(reasons(one, precision).values())
            explained += [row | {"reason": reason, "points": str(count)} for reason, count in counts.most_common()]
    found = [
        tabulated(
            motions,
            "Points by what the motion does. “Gains energy” is more kinetic energy than start, gravity and compressed springs "
            "had to give; “not solved” is an acceleration that is off by a thousandth of a step’s velocity, by the forces that "
            "it leaves unbalanced; where these are rounded, in float32, by the forces of the same state in float64.",
        ),
        tabulated(
            derivatives,
            "Points by what the derivative is, judged by central differences of mjxgrad in float64; it is unjudged where two "
            "widths disagree.",
        ),
        tabulated(
            explained,
            "Points where the motion of mjxgrad is of a worse kind than that of C MuJoCo, by the reason found.",
        ),
    ]
    return [table for table in found if table.rows]


def load(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Return the time step over the largest at which one spring gains no energy: unstable from 1 on.

    $h \omega_0 / (2 (\sqrt{1 + \zeta^2} - \zeta))$, in the standard format $h / t_c$ over $2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$.
    """

    def one(point: dict[str, float]) -> float:
        impedance = np.clip((point["impedance_first"], point["impedance_last"]), mujoco.mjMINIMP, mujoco.mjMAXIMP)
        stiffness, damping = steepest(*scene.effective(point), impedance, point["width"])
        frequency = np.sqrt(stiffness)
        limit = largest_stable_step(damping / (2 * frequency), mujoco.mjtIntegrator.mjINT_EULER)
        return point["timestep"] * frequency / limit

    return np.array([one(points[i]) for i in range(len(points))])


def reasons(one: SceneOutcome, precision: str) -> dict[int, str]:
    """Return the reason of every point at which mjxgrad does worse, by its index; "unexplained" where none is found."""
    values, ours, theirs = one.points.values, one.found.sel(simulator=precision), one.found.sel(simulator=C_MUJOCO)
    is_single = (against_c(one.found, "float64") <= 0) & (precision == "float32")
    has_steep_pyramids = one.scene.name.endswith("pyramidal") & (values["friction"] < _LITTLE_FRICTION)
    rules = {
        "pyramids of little friction weigh as 1/μ²: beyond float32": is_single & has_steep_pyramids,
        "width 0: C MuJoCo takes the mean of both impedances, MJX the second": (values["width"] == 0)
        & (values["impedance_first"] != values["impedance_last"]),
        "the same motion, on either side of the bound between two classes": ours.apart_from_c <= _SAME_MOTION,
        # Of balls, two radii deep.
        "the centres coincide: rounding decides on which side they part": bool(one.scene.crossing)
        & (values["depth"] == 2),
        "single precision: right in float64": is_single,
        "C MuJoCo fails, too, in another way": theirs.motion >= Motion.GAINS_ENERGY,
        "beyond the explicit limit, where rounding grows": load(one.scene, one.points) >= 1,
    }
    chosen = np.select([np.asarray(is_so) for is_so in rules.values()], list(range(len(rules))), len(rules))
    return {int(i): [*rules, "unexplained"][chosen[i]] for i in np.flatnonzero(against_c(one.found, precision) > 0)}


def _count(where) -> str:
    return str(int(where.sum()) or "none")


def _right(found, key: str) -> tuple[int, int]:
    """Count the right derivatives, and those that can be judged, where the motion is fine."""
    kinds, is_fine = found[key].values, (found.motion < Motion.GAINS_ENERGY).values
    judged = ~np.isin(kinds, (NOT_ASKED, Derivative.UNJUDGED, Derivative.NONE))
    return int(((kinds == Derivative.RIGHT) & is_fine).sum()), int((judged & is_fine).sum())


def _cells(values, kinds: type[Motion] | type[Derivative]) -> dict[str, str]:
    return {kinds(i).label: str(count or "") for i, count in enumerate(np.bincount(values, minlength=len(kinds)))}


# In the order of the items.
_MOTIONS = ("#c9e3f4", "#9ccbe8", "#cc79a7", "#f0c36d", "#d55e00", "#22262e")
_DERIVATIVES = ("#66c2a5", "#e8eaed", "#a6341b", "#8c6d31", "#7f3c8d", "#22262e")


def drawings(outcome: Outcome) -> Drawings:
    """Draw a figure of all scenes, and one per kind of scene, the planes of its first scene."""
    shown = {one.scene.family if one.scene.has_refsafe else one.scene.name: one for one in reversed(outcome.scenes)}
    planes = {re.sub(r"\W", "_", one.scene.name): _planes(one, outcome) for one in reversed(shown.values())}
    return {"all_scenes": _all_scenes(outcome)} | planes


def _all_scenes(outcome: Outcome) -> tuple[Picture, str, str]:
    """Draw for each scene which share of its points moves how, by simulator, and which share of gradients is right."""
    precisions, count = outcome.settings.precisions, len(outcome.scenes)
    figure, axes = subplots(1, 2, height=1.3 + 0.42 * count, sharey=True, width_ratios=(3, 2))
    parts = (
        (axes[0, 0], "motion", (C_MUJOCO, *precisions), Motion, _MOTIONS, "motion"),
        (axes[0, 1], "derivative", precisions, Derivative, _DERIVATIVES, "gradient, where the motion is fine"),
    )
    for axis, what, names, kinds, colours, title in parts:
        places, found = [], []
        for i, one in enumerate(outcome.scenes):
            for j, name in enumerate(names):
                own = one.found.sel(simulator=name)
                values = own[what].values[(own.motion < Motion.GAINS_ENERGY).values | (what == "motion")]
                found.append(np.bincount(values[values >= 0], minlength=len(kinds)))
                places.append(i + 0.26 * (j - 0.5 * (len(names) - 1)))
        shares = np.array(found) / np.maximum(np.sum(found, axis=1, keepdims=True), 1)
        for kind in np.flatnonzero(shares.any(axis=0)):
            left = shares[:, :kind].sum(axis=1)
            label = kinds(kind).label if what == "motion" else f"gradient {kinds(kind).label}"
            axis.barh(places, shares[:, kind], height=0.24, left=left, color=colours[kind], label=label)
        axis.set(title=title, xlim=(0, 1), xlabel="share of the points")
        axis.xaxis.set_major_formatter(PercentFormatter(1))
        axis.grid(visible=False)
    axes[0, 0].set_yticks(range(count), [one.scene.name for one in outcome.scenes])
    axes[0, 0].invert_yaxis()
    legend_below(figure, axes[0], 5)
    bars = ", ".join((C_MUJOCO, *(f"mjxgrad in {name}" for name in precisions)))
    caption = (
        f"Points of stiff and extreme cases, {outcome.settings.num_steps} steps each. Bars of a scene, from above: {bars}; on "
        "the right mjxgrad alone. Gradients are by the start and judged by central differences in float64. A motion gains energy "
        f"beyond {GAIN:.0%}."
    )
    return figure, "All scenes", caption


def _planes(one: SceneOutcome, outcome: Outcome) -> tuple[Picture, str, str]:
    """Draw one row per plane: motion in C MuJoCo, in mjxgrad by precision, and the gradient by precision."""
    precisions = outcome.settings.precisions
    columns = [(C_MUJOCO, "motion")] + [(name, what) for what in ("motion", "derivative") for name in precisions]
    rows = len(one.points.planes)
    figure, axes = subplots(rows, len(columns), height=0.9 + 2.05 * rows, sharey="row", sharex="row")
    for i, (across, up) in enumerate(one.points.planes):
        for j, (name, what) in enumerate(columns):
            axis = axes[i, j]
            values = one.points.plane(i, one.found[what].sel(simulator=name).values)
            # The eye is to find where a column differs from the one that it stands beside.
            model = C_MUJOCO if what == "motion" else precisions[0]
            same = values == one.points.plane(i, one.found[what].sel(simulator=model).values)
            squares = to_rgba_array(_MOTIONS if what == "motion" else _DERIVATIVES)[np.maximum(values, 0)]
            squares[..., 3] = np.where(same & (name != model), 0.25, 1.0)
            axis.imshow(squares, origin="lower", aspect="auto", interpolation="nearest")
            axis.grid(visible=False)
            _scales(axis, across, up, values.shape[0])
            _limit(axis, one, i)
            if i == 0:
                where = name if name == C_MUJOCO else f"mjxgrad, {name}"
                axis.set_title(f"{'Motion' if what == 'motion' else 'Gradient'}\n{where}", fontsize=9.5)
            axis.set_xlabel(PARAMETERS[across][2], fontsize=9)
        axes[i, 0].set_ylabel(PARAMETERS[up][2], fontsize=9)
    _legend(figure, one)
    caption = (
        f"Each square is one rollout of {outcome.settings.num_steps} steps, whatever the time step, and its gradient; all "
        f"that is not on an axis is MuJoCo's default. Pale: motion as in C MuJoCo, a gradient as in {precisions[0]}. Dashed, the "
        "explicit limit h²k + 2hb = 4, in the standard format h/t_c = 2ζ(√(1 + ζ²) − ζ): on its unstable side a single contact "
        f"gains energy. It is gained beyond {GAIN:.0%}. Gradients are judged by central differences in float64; where the motion "
        "diverges there is none."
    )
    return figure, one.scene.name.capitalize(), caption


def _scales(axis: Axes, across: str, up: str, count: int) -> None:
    """Put ticks at a few of the values that the squares stand for."""
    at = np.unique(np.linspace(0, count - 1, 3).round().astype(int))
    for name, put in ((across, axis.set_xticks), (up, axis.set_yticks)):
        values = PARAMETERS[name][1](np.linspace(0, 1, count))[at]
        put(at, [_short(value) for value in values])


def _short(value: float) -> str:
    if value == 0 or 0.01 <= value < 1000:
        return f"{float(f'{value:.2g}'):g}"
    exponent = int(np.floor(np.log10(value)))
    return power(10.0**exponent * round(value / 10.0**exponent))


def _limit(axis: Axes, one: SceneOutcome, index: int) -> None:
    """Draw the explicit limit, if it passes through the plane: where a logarithm is 0, in the coordinates of the squares."""
    if set(one.points.planes[index]) & {"timestep", "time_constant", "damping_ratio", "stiffness"}:
        image = one.points.plane(index, np.log(load(one.scene, one.points)))
        if image.min() < 0 < image.max():
            axis.contour(image, levels=[0.0], colors=REFERENCE, linewidths=1.4, linestyles="--")


def _legend(figure: Picture, one: SceneOutcome) -> None:
    shown = one.found.isel(point=one.points.family >= 0)
    slopes = np.unique(shown.derivative.drop_sel(simulator=C_MUJOCO))
    handles = [Patch(color=_MOTIONS[k], label=Motion(k).label) for k in np.unique(shown.motion)]
    handles += [
        Patch(color=_DERIVATIVES[k], label=f"gradient {Derivative(k).label}") for k in slopes if k != Derivative.NONE
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9)
