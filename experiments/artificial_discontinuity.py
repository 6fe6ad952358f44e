"""Discontinuities that are of the contact geometry: gradients across them, and what rounding, margin, smoothing, noise do."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field
from scipy.stats import norm

import mjxgrad as mg
from experiments.problems.comparison import over_keys
from experiments.report import Table
from experiments.settings import Positive, RunSettings
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, OTHERS, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.words import joined, percent
from experiments.workspace import Workspace
from mjxgrad.diagnostics import jumps_along
from mjxgrad.stepping import Contact


class Settings(RunSettings):
    """Outcomes along a parameter, and their gradients under noise about the largest jump."""

    num_cases: Annotated[int, Field(ge=1, le=3)] = 3  # the first of the cases; one takes a third of the time
    # Radius, or margin, that a remedy gives to edges, in m.
    rounding: Annotated[float, Field(gt=0.001, lt=0.03)] = 0.01
    length: Positive = 0.001  # of the smoothing, in m
    num_points: Annotated[int, Field(ge=32, multiple_of=16)] = 256  # along the parameter, and under the noise
    num_samples: Annotated[int, Field(ge=4)] = 64  # rollouts of an estimate by zeroth or by α-order


PLAIN, ROUNDED, MARGIN = "as it is", "rounded", "margin"
_HEAD = '<mujoco><option timestep="0.002" gravity="0 0 {g}"/><default><geom condim="1" mass="0"/></default><worldbody>'
_X, _Z = ('<joint type="slide" axis="1 0 0"/>', '<joint type="slide" axis="0 0 1"/>')


@dataclass(frozen=True)
class Case:
    """A scene by remedy, whose start and outcome have one parameter."""

    title: str
    unit: str  # of the parameter
    outcome_unit: str
    interval: tuple[float, float]
    stddev: float
    horizon: int
    mjcf: Callable[[str, float], str]
    start: Callable[[Array], tuple[Array, Array]]  # positions and velocities
    outcome: Callable[[mg.State], Array]

    def function(self, remedy: str, settings: Settings, contact: Contact) -> Callable[[Array], Array]:
        """Return the outcome as a function of the parameter; MJX steps what C MuJoCo has not."""
        scene = mg.load_scene(self.mjcf(remedy, settings.rounding))
        if isinstance(contact, mg.Discrete | mg.Slope):
            scene = scene.with_engine("mujoco")

        def outcome(parameter: Array) -> Array:
            state = mg.initial_state(scene, *self.start(parameter))
            return self.outcome(mg.rollout(scene, state, horizon=self.horizon, contact=contact).final)

        return outcome


def _finger(remedy: str, radius: float) -> str:
    """A tip of 2 mm comes down beside the edge of a box that slides; rounded, the box's edges have the radius."""
    less, more = (radius, radius * (remedy == ROUNDED)) if remedy in (ROUNDED, MARGIN) else (0.0, 0.0)
    margin = radius * (remedy == MARGIN)
    return f"""{_HEAD.format(g=0)}<body><joint type="slide" axis="1 0 0" damping="1"/>
<geom type="box" size="{0.1 - less} {0.1 - less} {0.1 - less}" mass="1" margin="{margin}"/></body>
<body>{_X}{_Z}<geom size="{0.002 + more}" mass=".1"/></body></worldbody></mujoco>"""


def _step(remedy: str, radius: float) -> str:
    """A cube slides over another, whose upper face is a little higher; rounded, balls are its corners."""
    places = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    balls = [f'<geom size="{radius}" pos="{" ".join(str(s * (0.1 - radius)) for s in at)}"/>' for at in places]
    size = 0.1 - radius * (remedy == MARGIN)
    box = f'<geom type="box" size="{size} {size} {size}" margin="{radius * (remedy == MARGIN)}"/>'
    return f"""{_HEAD.format(g=0)}<geom type="box" size=".1 .1 .1"/><body>{_X}{_Z}
<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>{"".join(balls) if remedy == ROUNDED else box}
</body></worldbody></mujoco>"""


def _flat(remedy: str, radius: float) -> str:
    """A cylinder lands on its side, tilted a little; rounded, it is a capsule of the same length."""
    less = radius * (remedy == MARGIN)
    kind, size = ("capsule", ".03 .07") if remedy == ROUNDED else ("cylinder", f"{0.03 - less} {0.1 - less}")
    return f"""{_HEAD.format(g=-9.81)}<geom type="plane" size="2 2 .1"/><body>{_Z}<joint type="hinge" axis="0 1 0"/>
<inertial pos="0 0 0" mass="1" diaginertia=".003 .003 .003"/>
<geom type="{kind}" size="{size}" euler="0 90 0" margin="{less}"/></body></worldbody></mujoco>"""


CASES = (
    Case("A tip on the edge of a box", "m", "m", (-0.014, 0.006), 0.001, 50, _finger,
        lambda p: (jnp.stack([0 * p, 0.1 + p, 0 * p + 0.104]), jnp.array([0.0, 0.0, -1.0])), lambda end: end.qpos[0]),
    Case("A cube grazes a cube", "m", "m", (-0.014, -0.002), 0.001, 60, _step,
        lambda p: (jnp.stack([0 * p - 0.204, 0.2 + p]), jnp.array([1.0, 0.0])), lambda end: end.qpos[0]),
    Case("A cylinder lands on its side", "rad", "rad/s", (-0.06, 0.06), 0.01, 60, _flat,
        lambda p: (jnp.stack([0 * p + 0.06, p]), jnp.array([-1.0, 0.0])), lambda end: end.qvel[1]),
)  # fmt: skip


class Row(NamedTuple):
    """A derivative on a case with a remedy; all numbers are shares.

    The change of the outcome is root mean squared along the parameter, over the outcome's range, as is the largest jump. Errors
    are of the mean derivative under noise, over the slope of the mean outcome as it is: against this, and against the slope of
    the remedied outcome. Of estimates from samples they are root mean squared.
    """

    case: str
    remedy: str
    derivative: str
    change: float
    jump: float
    error: float
    own_error: float


@dataclass(frozen=True)
class Found:
    """One case: outcomes along its parameter by remedy, where it jumps most, and the standard error of its slope over it."""

    rows: list[Row]
    curves: dict[str, np.ndarray]
    place: float
    slope_error: float


@dataclass(frozen=True)
class Outcome:
    """All that was found, by case."""

    settings: Settings
    found: list[Found]

    def rows(self) -> list[dict[str, Any]]:
        """One row per case, remedy and derivative, for metrics.csv."""
        return [row._asdict() for one in self.found for row in one.rows]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every case."""
    parts = {case.title: functools.partial(measured, case, settings) for case in CASES[: settings.num_cases]}
    return Outcome(settings, workspace.each("discontinuities", "cases", parts))


def measured(case: Case, settings: Settings) -> Found:
    """Measure a case with every remedy: geometry, how contact is stepped, and noise."""
    own, length = {"discrete": mg.Discrete(), "slope": mg.Slope()}, settings.length
    smooth = {f"smoothing {mode}": {"smoothed": mg.Smoothing(length, mode)} for mode in ("forward", "backward")}
    ways = {PLAIN: own, ROUNDED: own, MARGIN: own, "onset": {"onset": mg.Onset()}, **smooth}
    count, stddev, rows, curves = settings.num_points, case.stddev, [], {}
    place = truth = error = 0.0
    for remedy, contacts in ways.items():
        functions = {name: case.function(remedy, settings, contact) for name, contact in contacts.items()}
        compiled = jax.jit(jax.vmap(next(iter(functions.values()))))  # all of a remedy have the same motion
        simulate = lambda x, f=compiled: np.asarray(f(jnp.asarray(x)))  # noqa: E731
        curves[remedy] = simulate(np.linspace(*case.interval, count))
        jumps = jumps_along(simulate, case.interval, num_points=count)
        place = float(jumps.places[jumps.largest]) if remedy == PLAIN and len(jumps.places) else place
        slopes = [secant_slope(simulate, place, stddev, count, i) for i in range(8)]
        if remedy == PLAIN:
            truth, error = float(np.mean(slopes)), float(np.std(slopes, ddof=1) / np.sqrt(8))
        change = np.sqrt(np.mean((curves[remedy] - curves[PLAIN]) ** 2)) / np.ptp(curves[PLAIN])
        jump = jumps.sizes.max(initial=0.0) / np.ptp(curves[PLAIN])
        noise = jnp.asarray(place + stddev * norm.ppf((np.arange(count) + 0.5) / count))
        for name, function in functions.items():
            derivative = jax.jit(jax.vmap(lambda x, f=function: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]))(noise).mean()
            errors = [abs(float(derivative) - slope) / abs(truth) for slope in (truth, float(np.mean(slopes)))]
            rows.append(Row(case.title, remedy, name, float(change), float(jump), *errors))
    for name in ("zeroth_order", "alpha_order"):
        error_of = _by_noise(case, settings, name, place, truth)
        rows.append(Row(case.title, "noise", name.replace("_", " "), 0.0, rows[0].jump, error_of, error_of))
    return Found(rows, curves, place, error / abs(truth))


def _by_noise(case: Case, settings: Settings, name: str, place: float, truth: float) -> float:
    """Return the root mean squared error of 32 estimates, over the slope."""
    function = case.function(PLAIN, settings, mg.Slope())
    objective, at = mg.parameter_noise(lambda x: function(x[0]), case.stddev, 1), jnp.array([place])
    keys = jax.random.split(jax.random.key(settings.seed), 32)
    found = over_keys(getattr(mg.estimators, name), objective, at, keys, settings.num_samples)
    return float(jnp.sqrt(jnp.mean((found.value / truth - 1) ** 2)))


def secant_slope(simulate: Callable, place: float, stddev: float, count: int, seed: int) -> float:
    """Return the slope of the mean outcome under noise, from one secant in each equal share of the noise; it sees jumps."""
    noise = norm.ppf((np.arange(count) + np.random.default_rng(seed).uniform(size=count)) / count)
    ahead, behind = (np.asarray(simulate(place + s * stddev * noise), float) for s in (1, -1))
    return float(np.mean((ahead - behind) * noise) / (2 * stddev))


def answer(outcome: Outcome) -> str:
    """Say how wrong first order is across the jumps, and with rounded geometry."""
    every = [row for one in outcome.found for row in one.rows]
    least = min(row.error for row in every if row.remedy == PLAIN)
    worst = max(row.own_error for row in every if (row.remedy, row.derivative) == (ROUNDED, "slope"))
    return f"First order is off by {percent(least)} at least; with rounded geometry by {percent(worst)} at most."


def verdict(outcome: Outcome) -> str:
    """Say what each case does, and what rounding makes of it."""
    told = []
    for one in outcome.found:
        plain = (row for row in one.rows if row.remedy in (PLAIN, "noise"))
        errors = joined(f"{percent(row.error)} ({row.derivative})" for row in plain)
        rounded = [row for row in one.rows if row.remedy == ROUNDED]
        own = joined(f"{percent(row.own_error)} ({row.derivative})" for row in rounded)
        told.append(
            f"{rounded[0].case}: the outcome jumps by {percent(one.rows[0].jump)} of its range; gradients are off by {errors}; "
            f"rounded, by {own} of the slope of an outcome that differs by {percent(rounded[0].change)} of the range"
        )
    return "; ".join(told) + "."


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate remedies."""
    rows = [[*row[:3], *map(percent, row[3:])] for one in outcome.found for row in one.rows]
    columns = ("case", "remedy", "derivative", "outcome changed by", "largest jump", "error", "own error")
    caption = (
        "Errors of the mean derivative under noise, over the slope of the mean outcome as it is; last, against the remedied "
        f"outcome's slope. Of noise, root mean squared at {outcome.settings.num_samples} rollouts. Changes and jumps are over "
        f"the outcome's range. The slopes' own errors: {joined(percent(one.slope_error) for one in outcome.found)}."
    )
    return [Table(columns, rows, caption)]


def drawings(outcome: Outcome) -> Drawings:
    """Draw outcomes by remedy, above; errors of gradients against changes of the outcome, below."""
    figure, axes = subplots(2, len(outcome.found), height=7.0)
    for (upper, lower), one, case in zip(axes.T, outcome.found, CASES, strict=False):
        colours = dict(
            zip((*one.curves, "noise"), (REFERENCE, FIRST, DEFAULT, ONSET, *OTHERS[2:4], ZEROTH), strict=True)
        )
        for remedy, values in one.curves.items():
            grid = np.linspace(*case.interval, len(values))
            upper.plot(grid, values, color=colours[remedy], lw=2 if remedy == PLAIN else 1.1)
        for i, row in enumerate(one.rows):
            marker = "os"[row.derivative in ("slope", "alpha order")]
            label = f"{row.remedy}, {row.derivative}" if i < 6 or row.remedy == "noise" else row.remedy
            place = [max(x, 1e-3) for x in (row.change, row.error)]
            lower.plot(*place, marker, color=colours[row.remedy], label=label, mfc="none")
        upper.axvspan(one.place - case.stddev, one.place + case.stddev, color=MUTED, alpha=0.2, lw=0)
        upper.set(title=case.title, xlabel=f"parameter, {case.unit}", ylabel=f"outcome, {case.outcome_unit}")
        lower.set(xscale="log", yscale="log", xlabel="change of the outcome, over its range")
    axes[1, 0].set_ylabel("error of the gradient, over it")
    legend_below(figure, axes[1, 0], 6)
    caption = (
        "Above, outcomes against the parameter, as it is (thick) and with remedies; the band is the noise about the largest "
        "jump. Below, each remedy's error of the gradient against its change of the outcome; 10⁻³ stands for less."
    )
    return {"outcomes": (figure, "Outcomes across discontinuities, and what remedies cost", caption)}
