"""A peg is put into a hole: contact by boxes, by points on the peg, and by a pressure over the overlap."""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from timeit import timeit
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from jaxtyping import Array, Float
from pydantic import Field

import mjxgrad as mg
from experiments.artificial_discontinuity import secant_slope
from experiments.motion import advance
from experiments.report import Table
from experiments.settings import Positive, RunSettings
from experiments.theme import FIRST, REFERENCE, Drawings, shades, subplots
from experiments.words import joined, percent, quantity
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad.diagnostics import jumps_along
from mjxgrad.tasks import scene_path


class Settings(RunSettings):
    """Depth of a peg against its offset from the hole, its gradient, and descents on it."""

    # Numbers of points that stand for the pressure.
    points: tuple[Annotated[int, Field(ge=4, multiple_of=4)], ...] = (4, 16, 64, 256)
    # Of the hole on each side, in m; the second is that of everything else.
    clearances: tuple[Positive, ...] = (0.0005, 0.001, 0.002)
    chamfer: Positive = 0.003  # of the hole's rim where it has one, in m
    stiffness: Positive = 4e7  # of the pressure, in N/m² per m of depth
    stddev: Positive = 0.0005  # of the noise on the offset, in m; controls have four times as much
    num_points: Annotated[int, Field(ge=32, multiple_of=16)] = 64  # offsets, and rollouts of a slope
    num_steps: Annotated[int, Field(ge=10)] = 30  # of each descent; four seeds, 16 rollouts a step


HALF = np.array([0.019, 0.04])  # m, of the peg
_ABOVE, _TILT, _HORIZON, _PIECES = 0.002, 0.03, 150, 3  # m over the hole and rad at the start; steps of 2 ms; controls
_THICKNESS = 0.02  # m
OFFSETS, _STANDS, _IN = (0.0, 0.008), 0.006, 0.01  # m; where descents begin; depth of a peg that is in
_REST = np.zeros((_PIECES, 2))  # changes of the servos' targets


def walls(clearance: float, chamfer: float) -> tuple[Float[np.ndarray, "2 faces 2"], Float[np.ndarray, "2 faces"]]:
    """Return outward normals and offsets of the faces of both walls; inside, offset − normal · x is the depth below a face."""
    rim, slant = HALF[0] + clearance, np.sqrt(0.5)
    top, side, cut = (0.0, 1.0), (-1.0, 0.0), (-slant, slant)
    normals = np.array([top, side, cut])[: 2 + (chamfer > 0)]
    offsets = np.array([0.0, -rim, -slant * (rim + chamfer)])[: len(normals)]
    return np.stack([normals * [-1, 1], normals]), np.stack([offsets, offsets])


def wrench(pose: Float[Array, " 3"], faces: tuple, stiffness: float, num_points: int | None) -> Float[Array, " 3"]:
    """Return force and torque (x, z, tilt) of the pressure on the peg, in N and N m.

    The pressure is the stiffness times the depth in a wall, the least below its faces; it pushes along the peg's own normal,
    which does not flip. Along an edge the depth is piecewise linear, so Simpson's rule between its kinks is exact. A number of
    points gives the trapezoidal rule in place of it, a sum of springs.

    References:
        Elandt, Drumwright, Sherman, Ruina. A pressure field model for fast, robust approximation of net contact force and moment
        between nominally rigid objects. IROS 2019, arXiv:1904.11433.
    """
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    turn = jnp.array([[cos, -sin], [sin, cos]])
    corners = jnp.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * HALF @ turn.T

    def integral(first: Array, last: Array, outward: Array, normals: Array, offsets: Array) -> Array:
        """Return that of depth and its torque along an edge of length 1."""
        push = -turn @ outward

        def at(s: Array) -> Array:
            arm = first + s * (last - first)
            depth = jnp.maximum(jnp.min(offsets - normals @ (pose[:2] + arm)), 0.0)
            return depth * jnp.array([push[0], push[1], arm[0] * push[1] - arm[1] * push[0]])

        if num_points is None:
            depths = (offsets - normals @ (pose[:2] + end) for end in (first, last))
            kinks = jnp.sort(jnp.concatenate([jnp.array([0.0, 1.0]), _kinks(*depths)]))
            middle, weight = (kinks[1:] + kinks[:-1]) / 2, jnp.diff(kinks)[:, None] / 6
            values = jax.vmap(at)(kinks)
            return (weight * (values[1:] + 4 * jax.vmap(at)(middle) + values[:-1])).sum(axis=0)
        count = num_points // 4
        share = np.where((np.arange(count + 1) % count) == 0, 0.5, 1.0)[:, None] / count
        return (share * jax.vmap(at)(jnp.arange(count + 1) / count)).sum(axis=0)

    by_edge, edges = jax.vmap(integral, (0, 0, 0, None, None)), (corners, jnp.roll(corners, -1, axis=0))
    by_wall = jax.vmap(by_edge, (None, None, None, 0, 0))(*edges, jnp.asarray(_OUTWARD), *faces)
    return stiffness * _THICKNESS * jnp.einsum("e,wek->k", _LENGTHS, by_wall)


_OUTWARD, _LENGTHS = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float), np.tile(2 * HALF, 2)


def _kinks(first: Float[Array, " faces"], last: Float[Array, " faces"]) -> Float[Array, " kinks"]:
    """Return where along an edge, from 0 to 1, a depth below a face is zero, or equals that below another."""
    pairs = np.triu_indices(len(first), 1)
    start, end = (jnp.concatenate([x, x[pairs[0]] - x[pairs[1]]]) for x in (first, last))
    is_crossed = start * end < 0
    return jnp.where(is_crossed, start / jnp.where(is_crossed, start - end, 1.0), 0.0)


def outcome_of(kind: str | int, settings: Settings, clearance: float, chamfer: float = 0.0) -> Callable[..., Array]:
    """Return the depth of the peg's tip (m) by the offset at the start (m) and changes of the servos' targets (m, rad).

    Contact is of "boxes" by C MuJoCo, of a number of points, or of the "pressure".
    """
    spec = mujoco.MjSpec.from_file(str(scene_path("peg_and_hole")))
    for name, sign in (("left", -1), ("right", 1)):
        wall, rim = spec.geom(name), HALF[0] + clearance
        wall.pos = [sign * (rim + 0.05), 0, -0.05 - chamfer]
        if chamfer:
            spec.worldbody.add_geom(type=wall.type, size=wall.size, pos=[sign * (rim + chamfer + 0.05), 0, -0.05])
            half, turn = chamfer / np.sqrt(2), [np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0]
            place = [sign * (rim + chamfer), 0, -chamfer]
            spec.worldbody.add_geom(type=wall.type, size=[half, 0.01, half], pos=place, quat=turn)
    is_boxes = kind == "boxes"
    if not is_boxes:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    scene, faces = mg.load_scene(spec.compile()), walls(clearance, chamfer)
    scene = scene.with_engine("mujoco") if is_boxes else scene
    number = None if isinstance(kind, str) else kind

    def step(targets: Array, data: mjx.Data) -> mjx.Data:
        piece = jnp.minimum(data.time / scene.model.opt.timestep * _PIECES / _HORIZON + 1e-6, _PIECES - 1).astype(int)
        force = wrench(data.qpos, faces, settings.stiffness, number)
        return mg.step(scene.model, data.replace(ctrl=targets[piece], qfrc_applied=force))

    def depth(offset: Float[Array, ""], controls: Float[Array, "pieces 2"]) -> Float[Array, ""]:
        pose = jnp.stack([offset, jnp.asarray(HALF[1] + _ABOVE), jnp.asarray(_TILT)])
        targets = controls + jnp.stack([offset, jnp.asarray(_TILT)])
        if is_boxes:
            held = jnp.repeat(targets, _HORIZON // _PIECES, axis=0)
            end = mg.rollout(scene, mg.initial_state(scene, pose), held, contact=mg.Slope()).final
        else:
            end = advance(functools.partial(step, targets), scene.data.replace(qpos=pose), _HORIZON)
        return HALF[1] - end.qpos[1]

    return depth


@dataclass(frozen=True)
class Told:
    """One way to tell contact: depths by offset, their largest jump (m), and derivatives under noise (m/m).

    The noise is about the offset where the depth changes most. The slope is that of the mean depth, from secants; the price is
    of one rollout with its derivative (s).
    """

    label: str
    depths: np.ndarray
    jump: float
    slope: float
    derivatives: np.ndarray
    price: float

    @property
    def errors(self) -> tuple[float, float]:
        """Bias and scatter of a derivative over the slope."""
        bias = abs(self.derivatives.mean() - self.slope)
        return bias / abs(self.slope), self.derivatives.std(ddof=1) / abs(self.slope)


@dataclass(frozen=True)
class Outcome:
    """All that was found; holes have the share of offsets that go in, descents the depth at the end by seed (m)."""

    settings: Settings
    told: list[Told]
    holes: dict[tuple[str, float, float], float]  # by contact, clearance and chamfer (m)
    descents: dict[tuple[str, str], np.ndarray]  # by contact and estimator

    def rows(self) -> list[dict[str, Any]]:
        """One row per offset, for metrics.csv."""
        columns = zip(np.linspace(*OFFSETS, self.settings.num_points), *(x.depths for x in self.told), strict=True)
        return [dict(zip(("offset", *(x.label for x in self.told)), row, strict=True)) for row in columns]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure depths and slopes, the holes that a peg finds, and descents."""
    kinds, own = ("boxes", *settings.points, "pressure"), settings.clearances[len(settings.clearances) // 2]
    jobs: dict[Any, Callable] = {kind: functools.partial(_told, kind, settings, own) for kind in kinds}
    holes: list[Any] = list(itertools.product(("boxes", "pressure"), settings.clearances, (0.0, settings.chamfer)))
    descents: list[Any] = list(itertools.product(("boxes", "pressure"), ("first_order", "zeroth_order", "alpha_order")))
    jobs |= {at: functools.partial(_share, settings, *at) for at in holes}
    jobs |= {at: functools.partial(_descents, settings, own, *at) for at in descents}
    found = dict(zip(jobs, workspace.each("mating", "parts", {str(at): job for at, job in jobs.items()}), strict=True))
    return Outcome(settings, *([found[k] for k in kinds], *({at: found[at] for at in x} for x in (holes, descents))))


def _told(kind: str | int, settings: Settings, clearance: float) -> Told:
    count, depth = settings.num_points, outcome_of(kind, settings, clearance)
    simulate = jax.jit(jax.vmap(lambda p: depth(p, jnp.asarray(_REST))))
    slopes = jax.jit(jax.vmap(lambda p: jax.jvp(lambda q: depth(q, jnp.asarray(_REST)), (p,), (jnp.ones_like(p),))[1]))
    offsets = np.linspace(*OFFSETS, count)
    depths = np.asarray(simulate(offsets))
    place = float(offsets[np.argmax(np.abs(np.diff(depths)))])
    starts = place + settings.stddev * np.random.default_rng(settings.seed).normal(size=count)
    derivatives = np.asarray(slopes(starts))
    price = timeit(lambda: jax.block_until_ready(slopes(starts)), number=3) / 3 / count
    jumps = jumps_along(lambda p: np.asarray(simulate(p)), OFFSETS, num_points=count)
    slope = np.mean([secant_slope(simulate, place, settings.stddev, count, i) for i in range(8)])
    label = f"{kind} points" if isinstance(kind, int) else kind
    return Told(label, depths, float(jumps.sizes.max(initial=0)), float(slope), derivatives, price)


def _share(settings: Settings, kind: str, clearance: float, chamfer: float) -> float:
    depth = outcome_of(kind, settings, clearance, chamfer)
    found = jax.jit(jax.vmap(lambda p: depth(p, jnp.asarray(_REST))))(np.linspace(*OFFSETS, settings.num_points))
    return float(np.mean(np.asarray(found) > _IN))


def _descents(settings: Settings, clearance: float, kind: str, name: str) -> np.ndarray:
    """Return depths after descents from a peg that stands on the rim, by seed; parameters are in mm and 20 mrad."""
    depth, units = outcome_of(kind, settings, clearance), jnp.array([1e-3, 0.02])
    cost = lambda flat: -depth(jnp.asarray(_STANDS), flat.reshape(_REST.shape) * units)  # noqa: E731
    result = mg.optimise(
        mg.parameter_noise(cost, 4e3 * settings.stddev, _REST.size),
        jnp.zeros(_REST.size),
        jax.random.split(jax.random.key(settings.seed), 4),
        estimator=functools.partial(getattr(mg.estimators, name), num_samples=16),
        optimiser=optax.adam(0.3),
        num_steps=settings.num_steps,
    )
    return -np.asarray(jax.vmap(cost)(result.params))


def answer(outcome: Outcome) -> str:
    """Say how far each way of contact jumps."""
    first, last = outcome.told[0], outcome.told[-1]
    jumps = [f"{1e3 * x.jump:.2g} mm ({x.label})" for x in (first, *outcome.told[1:-1:2], last)]
    return f"Depths jump by up to {'; '.join(jumps)}."


def verdict(outcome: Outcome) -> str:
    """Say how biased derivatives are, and who puts the peg in."""
    biases = joined(f"{percent(x.errors[0])} ({x.label})" for x in outcome.told)
    ends = [
        f"{name.replace('_', ' ')} {(found > _IN).sum()} of {len(found)} ({contact})"
        for (contact, name), found in outcome.descents.items()
    ]
    return f"Where the depth changes most, first order's bias over the slope is {biases}. The peg is put in by {joined(ends)}."


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate contacts, holes and descents."""
    contacts = [
        [x.label, f"{1e3 * x.jump:.3g}", quantity(x.slope), *map(percent, x.errors), f"{1e3 * x.price:.2f}"]
        for x in outcome.told
    ]
    columns = ("contact", "largest jump, mm", "slope of the mean depth", "bias", "scatter", "ms a gradient")
    holes = [
        [kind, *(f"{1e3 * x:g}" for x in sizes), percent(share)] for (kind, *sizes), share in outcome.holes.items()
    ]
    ends = [[*at, ", ".join(f"{1e3 * x:.1f}" for x in found)] for at, found in outcome.descents.items()]
    caption = "First order's bias, and scatter of one rollout, over the slope, under noise about the steepest place."
    return [
        Table(columns, contacts, caption),
        Table(("contact", "clearance, mm", "chamfer, mm", "offsets that go in"), holes, "Of offsets from 0 to 8 mm."),
        Table(("contact", "gradient", "depths at the end, mm"), ends, "By seed, from a peg that stands on the rim."),
    ]


_SHOWN = -1e3, 1e3  # m/m


def drawings(outcome: Outcome) -> Drawings:
    """Draw depths by offset, and derivatives by contact."""
    figure, ((left, right),) = subplots(1, 2, height=4.6)
    offsets = 1e3 * np.linspace(*OFFSETS, outcome.settings.num_points)
    for i, (x, shade) in enumerate(zip(outcome.told, shades(len(outcome.told)), strict=True)):
        colour = FIRST if x.label == "boxes" else shade
        left.plot(offsets, 1e3 * x.depths, color=colour, label=x.label)
        right.plot(np.full(len(x.derivatives), i), np.clip(x.derivatives, *_SHOWN), "_", color=colour, alpha=0.5, ms=10)
        right.plot(i + 0.2, np.clip(x.derivatives.mean(), *_SHOWN), "o", color=colour)
        right.plot(i + 0.2, x.slope, "D", color=REFERENCE, mfc="none", ms=8)
    right.set_xticks(range(len(outcome.told)), [x.label for x in outcome.told], fontsize=8.5)
    right.set(yscale="symlog", title="Derivatives under noise", ylabel="m/m")
    left.set(title="Depth after 0.3 s", xlabel="offset, mm", ylabel="depth, mm")
    left.legend(fontsize=8.5)
    caption = (
        "Left, how deep the peg goes by its offset from the hole. Right, derivatives of single rollouts under noise about the "
        "steepest place of each (dashes), their mean (dots), and the slope of the mean depth (diamonds); what lies beyond "
        "1000 is at the edge."
    )
    return {"depths": (figure, "Depth of the peg by how contact is told, and its derivatives", caption)}
