"""The pictures of an experiment on stability."""

import functools
import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure as Picture
from matplotlib.patches import Patch

from experiments.stability.grid import AXES, Points
from experiments.stability.outcome import BOUNCE, C_MUJOCO, GAIN, Derivative, Motion, Outcome, SceneOutcome
from experiments.stability.report import load
from experiments.stability.scenes import RADIUS, StabilityScene, effective
from experiments.theme import REFERENCE, Drawings, power, subplots
from mjxgrad.tasks.textbook import Bounce

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
_DERIVATIVES = ("#56b4e9", "#e8eaed", "#d55e00", "#f0c36d", "#cc79a7", "#22262e")
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
            _image(axis, values, _MOTIONS if what == "motion" else _DERIVATIVES)
            _scales(axis, across, up, values.shape[0])
            _limit(axis, one, i)
            if i == 0:
                where = name if name == C_MUJOCO else f"mjxgrad, {name}"
                axis.set_title(f"{'Motion' if what == 'motion' else 'Gradient'}\n{where}", fontsize=9)
            axis.set_xlabel(_NAMES[across], fontsize=8)
        axes[i, 0].set_ylabel(_NAMES[up], fontsize=8)
    _legend(figure, one)
    caption = (
        f"Each square is one rollout of {outcome.settings.num_steps} steps, whatever the time step, and its gradient; all "
        f"that is not on an axis is MuJoCo's default. {_LIMITS.get(one.scene.family, _EXPLICIT)}A bounce is right within "
        f"{BOUNCE:g} of its restitution; energy is gained beyond {GAIN:.0%}. Gradients are judged by central differences in "
        "float64; where the motion diverges there is none."
    )
    return figure, one.scene.name.capitalize(), caption


def _image(axis: Axes, values: np.ndarray, colours: Sequence[str]) -> None:
    palette = ListedColormap(list(colours))
    norm = BoundaryNorm(np.arange(len(colours) + 1) - 0.5, len(colours))
    axis.imshow(values, cmap=palette, norm=norm, origin="lower", aspect="auto", interpolation="nearest")
    axis.grid(visible=False)


def _scales(axis: Axes, across: str, up: str, count: int) -> None:
    """Ticks at a few of the values that the squares stand for."""
    at = np.unique(np.linspace(0, count - 1, 3).round().astype(int))
    for name, put in ((across, axis.set_xticks), (up, axis.set_yticks)):
        values = AXES[name](np.linspace(0, 1, count))[at]
        put(at, [_short(value) for value in values])
    axis.tick_params(labelsize=7)


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
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8)
