"""The answer of an experiment on stability, computed from its numbers, and its pictures."""

import functools
import re
from collections import Counter
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure as Picture
from matplotlib.patches import Patch

from experiments.report import Table
from experiments.stability.classes import BOUNCE, GAIN, Derivative, Motion
from experiments.stability.measure import C_MUJOCO, NOT_ASKED, Outcome, SceneOutcome, against_c
from experiments.stability.scenes import AXES, RADIUS, Points, StabilityScene, effective
from experiments.theme import REFERENCE, Drawings, power, subplots
from experiments.words import percent
from mjxgrad.contact.bounce import Bounce
from mjxgrad.contact.warnings import largest_stable_step, steepest

UNEXPLAINED = "unexplained"
_SAME_MOTION = 1e-3
"""Difference of final positions, over what a body flies in the rollout, up to which two motions are one."""
_LITTLE_FRICTION = 0.03
"""Below it the edges of a pyramid weigh more than a thousand times what its normal would."""
_LINES = {"derivative": "by the start", "derivative_by_parameters": "by parameters", "slope_derivative": "slope"}


def answer(outcome: Outcome) -> str:
    """Say at which share of the points step and gradient hold, and whether every failure is flagged."""
    found, precision = outcome.found, outcome.settings.precisions[0]
    ours, theirs = (_held(found.motion.sel(simulator=name)) for name in (precision, C_MUJOCO))
    right, judged = _right(found.derivative.sel(simulator=precision), found.motion.sel(simulator=precision))
    gradient = f", gradients there at {percent(right / judged)}" if judged else ""
    unflagged = int((found.silent | found.missed).sum())
    flags = f"{unflagged} failures are unflagged" if unflagged else "every failure is flagged"
    return f"Motion holds at {ours} (C MuJoCo: {theirs}){gradient}; {flags}."


def _held(motion) -> str:
    return percent(float((motion < Motion.GAINS_ENERGY).mean()))


def verdict(outcome: Outcome) -> str:
    """Say whether a failure goes unflagged, and how mjxgrad compares with C MuJoCo."""
    found, precisions = outcome.found, outcome.settings.precisions
    silent, missed = int(found.silent.sum()), int(found.missed.sum())
    sentences = [
        f"{silent} rollouts have a number that is not finite, and no flag."
        if silent
        else "Every rollout with a number that is not finite is flagged.",
        f"`soundness` misses {missed} gradients that explode or are not finite."
        if missed
        else "`soundness` tells every gradient that explodes or is not finite.",
    ]
    for name in precisions:
        signs = against_c(found, name)
        why = [reason for one in outcome.scenes for reason in reasons(one, name).values()]
        unexplained = f" ({why.count(UNEXPLAINED) or 'none'} without a reason found)" if why else ""
        sentences.append(
            f"In {name} {int((signs == 0).sum())} of {signs.size} motions are as good as C MuJoCo's, "
            f"{_count(signs > 0)} worse{unexplained} and {_count(signs < 0)} better."
        )
    return " ".join(sentences)


def summary(outcome: Outcome) -> Table:
    """Count by precision what is not solved, what is right and what only `soundness` tells."""
    rows = []
    for name in outcome.settings.precisions:
        found = outcome.found.sel(simulator=name)
        unflagged = found.gradient_unflagged_by_rollout
        rows.append(
            [
                name,
                _count(found.motion == Motion.UNSOLVED),
                _count(found.untold),
                *(
                    "{} of {}".format(*_right(found[key], found.motion))
                    for key in ("derivative", "derivative_by_parameters")
                ),
                _count(unflagged),
                _count(unflagged & (found.derivative == Derivative.NON_FINITE)),
            ]
        )
    columns = (
        "precision", "not solved to a thousandth", "not told by Trajectory.unsolved", "right by the start", "by parameters",
        "gradients told by soundness alone", "not finite",
    )  # fmt: skip
    caption = (
        "Points. Derivatives by the start, and by contact parameters, friction and time step, where the motion is fine: right of "
        "those that finite differences can judge. Told by `soundness` alone, or an estimator's count: gradients that explode, or "
        "are not finite, although their rollouts did not diverge."
    )
    return Table(columns, rows, caption)


def findings(outcome: Outcome) -> list[str]:
    """Compare the explicit limit with what single bounces do."""
    singles = [one for one in outcome.scenes if one.scene.bounces]
    if not singles:
        return []
    ratio = np.concatenate([load(one.scene, one.points) for one in singles])
    fails = np.concatenate([one.found.motion.sel(simulator="float64") for one in singles]) >= Motion.GAINS_ENERGY
    below = ratio < 1
    sentence = f"Within the explicit limit {_count(fails & below)} of {below.sum()} single bounces gain energy"
    if (fails & below).any():
        sentence += f", the earliest at {ratio[fails].min():.2g} times the largest stable time step"
    return [f"{sentence}; beyond it {(fails & ~below).sum()} of {(~below).sum()} do."]


def tables(outcome: Outcome) -> list[Table]:
    """Count classes by scene and simulator, and give the reasons of what is worse than C MuJoCo."""
    motions, derivatives, explained = [], [], []
    for one in outcome.scenes:
        for name in one.found.simulator.values:
            found, label = one.found.sel(simulator=name), name if name == C_MUJOCO else f"mjxgrad, {name}"
            motions.append([one.scene.name, label, *_cells(found.motion, Motion)])
            for key, line in _LINES.items():
                if (found[key] != NOT_ASKED).all():
                    derivatives.append([one.scene.name, label, line, *_cells(found[key], Derivative)])
        for precision in outcome.settings.precisions:
            why = reasons(one, precision)
            for reason, count in Counter(why.values()).most_common():
                index = next(i for i, said in why.items() if said == reason)
                explained.append([one.scene.name, precision, reason, str(count), _example(one, precision, index)])
    found = [
        Table(
            ("scene", "simulator", *(kind.label for kind in Motion)),
            motions,
            "Points by what the motion does. Bounces are judged by their restitution where it is known, by closed form or "
            "quadrature; “gains energy” is more kinetic energy than start, gravity and compressed springs had to give; “not "
            "solved” is an acceleration that is off by a thousandth of a step’s velocity, by the forces that it leaves "
            "unbalanced; where these are rounded, in float32, by the forces of the same state in float64.",
        ),
        Table(
            ("scene", "simulator", "derivative", *(kind.label for kind in Derivative)),
            derivatives,
            "Points by what the derivative is. C MuJoCo’s is a central difference; it is unjudged where two widths disagree. "
            "Those of mjxgrad are judged by central differences of mjxgrad in float64, the slope at MuJoCo's motion by the "
            "restitution.",
        ),
        Table(
            ("scene", "precision", "reason", "points", "for instance"),
            explained,
            "Points where the motion of mjxgrad is of a worse kind than that of C MuJoCo, by the reason found, with one each.",
        ),
    ]
    return [table for table in found if table.rows]


def load(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Give the time step over the largest at which one spring gains no energy: unstable from 1 on.

    $h \omega_0 / (2 (\sqrt{1 + \zeta^2} - \zeta))$, in the standard format $h / t_c$ over $2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$.
    """
    found = np.empty(len(points))
    for i in range(len(points)):
        point = points[i]
        impedance = np.clip((point["impedance_first"], point["impedance_last"]), mujoco.mjMINIMP, mujoco.mjMAXIMP)
        stiffness, damping = steepest(*effective(scene, point), impedance, point["width"])
        frequency = np.sqrt(stiffness)
        limit = largest_stable_step(damping / (2 * frequency), mujoco.mjtIntegrator.mjINT_EULER)
        found[i] = point["timestep"] * frequency / limit
    return found


def reasons(one: SceneOutcome, precision: str) -> dict[int, str]:
    """Give the reason of every point at which mjxgrad does worse, by its index; `UNEXPLAINED` where none is found."""
    values, ours, theirs = one.points.values, one.found.sel(simulator=precision), one.found.sel(simulator=C_MUJOCO)
    is_fine_in_double = against_c(one.found, "float64") <= 0
    takes_other_impedance = (values["width"] == 0) & (values["impedance_first"] != values["impedance_last"])
    is_unsolved = ours.motion == Motion.UNSOLVED
    is_single = is_fine_in_double & (precision == "float32")
    has_steep_pyramids = one.scene.name.endswith("pyramidal") & (values["friction"] < _LITTLE_FRICTION)
    # Of balls, two radii deep.
    coincide = bool(one.scene.crossing) & (values["depth"] == 2)
    rules = (
        (is_unsolved & is_single & has_steep_pyramids, "pyramids of little friction weigh as 1/μ²: beyond float32"),
        (is_unsolved & is_single, "the solve stops short, in float32 alone"),
        (is_unsolved, "the solve stops short"),
        (takes_other_impedance, "width 0: C MuJoCo takes the mean of both impedances, MJX the second"),
        (ours.apart_from_c <= _SAME_MOTION, "the same motion, on either side of the bound between two classes"),
        (coincide, "the centres coincide: rounding decides on which side they part"),
        (is_single, "single precision: right in float64"),
        (theirs.motion >= Motion.GAINS_ENERGY, "C MuJoCo fails, too, in another way"),
        (load(one.scene, one.points) >= 1, "beyond the explicit limit, where rounding grows"),
        (theirs.derivative == Derivative.EXPLODES, "the derivative of C MuJoCo's motion explodes: rounding grows"),
    )
    names = [reason for _, reason in rules]
    chosen = np.select([np.asarray(is_so) for is_so, _ in rules], list(range(len(rules))), len(rules))
    return {int(i): [*names, UNEXPLAINED][chosen[i]] for i in np.flatnonzero(against_c(one.found, precision) > 0)}


def _count(where) -> str:
    return str(int(where.sum()) or "none")


def _right(kinds, motion) -> tuple[int, int]:
    """Count the right derivatives, and those that can be judged, where the motion is fine."""
    judged = np.isin(kinds, (Derivative.RIGHT, Derivative.WRONG, Derivative.EXPLODES, Derivative.NON_FINITE))
    is_fine = (motion < Motion.GAINS_ENERGY).values
    return int(((kinds.values == Derivative.RIGHT) & is_fine).sum()), int((judged & is_fine).sum())


def _cells(values, kinds: type[Motion] | type[Derivative]) -> list[str]:
    return [str(count or "") for count in np.bincount(values, minlength=len(kinds))]


def _example(one: SceneOutcome, precision: str, index: int) -> str:
    plane, point = one.points.family[index], one.points[index]
    names = point if plane < 0 else dict.fromkeys(one.points.planes[plane])
    shown = ", ".join(f"{name.replace('_', ' ')} {point[name]:.3g}" for name in names)
    at = one.found.motion.isel(point=index)
    ours, theirs = (Motion(int(at.sel(simulator=name))).label for name in (precision, C_MUJOCO))
    return f"{shown}: {ours}, C MuJoCo {theirs}"


_LIMITS = {
    "two balls": "Dashed, against the speed: one step, or one bounce, carries a ball past the other's centre. ",
    "chain": "Dashed, the explicit limit of a joint limit, h²k + 2hb = 4. ",
}
_EXPLICIT = (
    "Dashed, the explicit limit h²k + 2hb = 4, in the standard format h/t_c = 2ζ(√(1 + ζ²) − ζ): above or to the unstable "
    "side of it a single contact gains energy. "
)

# In the order of the items.
_MOTIONS = ("#c9e3f4", "#9ccbe8", "#56b4e9", "#0072b2", "#f0c36d", "#cc79a7", "#d55e00", "#22262e")
_DERIVATIVES = ("#66c2a5", "#e8eaed", "#a6341b", "#8c6d31", "#7f3c8d", "#22262e")
_NAMES = {
    "timestep": "time step, s",
    "time_constant": "time constant, s",
    "damping_ratio": "damping ratio",
    "stiffness": "direct stiffness, 1/s²",
    "impedance_first": "impedance at the surface",
    "width": "width, m",
    "mass_ratio": "mass ratio",
    "speed": "speed, m/s",
    "friction": "friction",
    "depth": "depth at the start, radii",
    "margin": "margin, m",
}


def drawings(outcome: Outcome) -> Drawings:
    """Name a figure per kind of scene, the planes of its first scene."""
    shown = {one.scene.family if one.scene.has_refsafe else one.scene.name: one for one in reversed(outcome.scenes)}
    return {re.sub(r"\W", "_", one.scene.name): functools.partial(_planes, one) for one in reversed(shown.values())}


def _planes(one: SceneOutcome, outcome: Outcome) -> tuple[Picture, str, str]:
    """One row per plane: motion in C MuJoCo, in mjxgrad by precision, and the gradient by precision."""
    precisions = outcome.settings.precisions
    columns = [(C_MUJOCO, "motion")] + [(name, what) for what in ("motion", "derivative") for name in precisions]
    rows = len(one.points.planes)
    figure, axes = subplots(rows, len(columns), height=0.9 + 2.05 * rows, sharey="row", sharex="row")
    for i, (across, up) in enumerate(one.points.planes):
        for j, (name, what) in enumerate(columns):
            axis = axes[i, j]
            values = one.points.plane(i, one.found[what].sel(simulator=name).values)
            # What the eye is to find is where a column is another than the one that it stands beside.
            model = C_MUJOCO if what == "motion" else precisions[0]
            same = values == one.points.plane(i, one.found[what].sel(simulator=model).values) if name != model else None
            _image(axis, values, _MOTIONS if what == "motion" else _DERIVATIVES, same)
            _scales(axis, across, up, values.shape[0])
            _limit(axis, one, i)
            if i == 0:
                where = name if name == C_MUJOCO else f"mjxgrad, {name}"
                axis.set_title(f"{'Motion' if what == 'motion' else 'Gradient'}\n{where}", fontsize=9.5)
            axis.set_xlabel(_NAMES[across], fontsize=9)
        axes[i, 0].set_ylabel(_NAMES[up], fontsize=9)
    _legend(figure, one)
    caption = (
        f"Each square is one rollout of {outcome.settings.num_steps} steps, whatever the time step, and its gradient; all "
        f"that is not on an axis is MuJoCo's default. Pale: motion as in C MuJoCo, a gradient as in "
        f"{precisions[0]}. {_LIMITS.get(one.scene.family, _EXPLICIT)}A bounce is right within "
        f"{BOUNCE:g} of its restitution; energy is gained beyond {GAIN:.0%}. Gradients are judged by central differences in "
        "float64; where the motion diverges there is none."
    )
    return figure, one.scene.name.capitalize(), caption


def _image(axis: Axes, values: np.ndarray, colours: Sequence[str], pale: np.ndarray | None) -> None:
    squares = to_rgba_array(colours)[np.maximum(values, 0)]
    if pale is not None:
        squares[pale, 3] = 0.25
    axis.imshow(squares, origin="lower", aspect="auto", interpolation="nearest")
    axis.grid(visible=False)


def _scales(axis: Axes, across: str, up: str, count: int) -> None:
    """Ticks at a few of the values that the squares stand for."""
    at = np.unique(np.linspace(0, count - 1, 3).round().astype(int))
    for name, put in ((across, axis.set_xticks), (up, axis.set_yticks)):
        values = AXES[name](np.linspace(0, 1, count))[at]
        put(at, [_short(value) for value in values])


def _short(value: float) -> str:
    if value == 0 or 0.01 <= value < 1000:
        return f"{float(f'{value:.2g}'):g}"
    exponent = int(np.floor(np.log10(value)))
    return power(10.0**exponent * round(value / 10.0**exponent))


def _limit(axis: Axes, one: SceneOutcome, index: int) -> None:
    """Draw the analytic limit, if one passes through the plane: where a logarithm is 0, in the coordinates of the squares."""
    names = set(one.points.planes[index])
    if one.scene.family == "two balls" and "speed" in names:
        values = _crossing(one.scene, one.points)
    elif names & {"timestep", "time_constant", "damping_ratio", "stiffness"}:
        values = load(one.scene, one.points)
    else:
        return
    image = one.points.plane(index, np.log(values))
    if image.min() < 0 < image.max():
        axis.contour(image, levels=[0.0], colors=REFERENCE, linewidths=1.4, linestyles="--")


def _crossing(scene: StabilityScene, points: Points) -> Float[np.ndarray, " points"]:
    r"""Give how far two balls go into each other, over the distance at which their centres meet: beyond 1 they pass.

    One step carries them $v h$, unseen; a bounce goes $v \sqrt e / \omega_0$ deep.
    """
    springs = np.array([effective(scene, points[i]) for i in range(len(points))])
    frequency, damping = np.sqrt(springs[:, 0]), springs[:, 1]
    restitution = np.asarray(Bounce(2 / damping, damping / (2 * frequency)).restitution)
    time = np.maximum(points.values["timestep"], np.sqrt(restitution) / frequency)
    return points.values["speed"] * time / (2 * RADIUS)


def _legend(figure: Picture, one: SceneOutcome) -> None:
    shown = one.found.isel(point=one.points.family >= 0)
    kinds = np.unique(shown.motion)
    slopes = np.unique(shown.derivative.drop_sel(simulator=C_MUJOCO))
    handles = [Patch(color=_MOTIONS[k], label=Motion(k).label) for k in kinds]
    handles += [
        Patch(color=_DERIVATIVES[k], label=f"gradient {Derivative(k).label}") for k in slopes if k != Derivative.NONE
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9)
