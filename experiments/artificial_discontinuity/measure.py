"""From settings to numbers: bodies held along paths, short pushes from uncertain starts, and a peg dropped into a hole."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from scipy.spatial.transform import Rotation
from scipy.stats import norm

import mjxgrad as mg
from experiments.artificial_discontinuity.settings import Settings
from experiments.artificial_discontinuity.shapes import HALF, PATHS, Shape, shape
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Jumps, jumps_along
from mjxgrad.stepping import Contact, own_motion
from mjxgrad.tasks import scene_path

# Which force jumps: under the shape's own contact, which begins with a jump of force but for lattices; with an impedance that
# rises from zero; under the shape's own contact, smoothed; and C MuJoCo's.
PLAIN, GENTLE, SMOOTHED, C = "plain", "gentle", "smoothed", "C MuJoCo"
WAYS = ("first order, discrete", "first order, slope", "zeroth order")


@dataclass(frozen=True)
class Static:
    """Jumps of the force on a body held along a path, by `PLAIN`, `GENTLE`, `SMOOTHED` and `C`; torque is over half an edge (N).

    A lattice's own contact is gentle, and it is not smoothed. Contacts are different points on the grid, as MJX finds them, and
    copies those beside them in the same places.
    """

    shape: str
    path: str
    num_rows: int
    is_lattice: bool
    jumps: dict[str, Jumps]
    contacts: Int[np.ndarray, " points"]
    copies: Int[np.ndarray, " points"]

    def worst(self, force: str) -> float:
        return worst(self.jumps[force])


@dataclass(frozen=True)
class Judged:
    """A jump of the box's force, over that force, beside the gradient of the overlap volume, the reference, over itself.

    Geometric is what is there when contact begins gently, too. Changes are over a penetration depth to each side.
    """

    path: str
    place: float
    relative: float
    is_geometric: bool
    reference_jump: float
    reference_change: float
    contacts: tuple[int, int]


@dataclass(frozen=True)
class Slopes:
    """Estimates of the slope of a short push under noise on the start, one body on one path, in the order of `WAYS`.

    The reference is the slope of the mean outcome, by stratified samples, with its standard error over repeats. The jump is what
    the outcome jumps by in the middle of the noise, if it does: all jumps, each times the noise's density.
    """

    shape: str
    path: str
    place: float
    estimates: Float[np.ndarray, " ways"]
    errors: Float[np.ndarray, " ways"]
    reference: float
    reference_error: float
    jump: float
    starts: Float[np.ndarray, " samples"]
    outcomes: Float[np.ndarray, " samples"]

    @property
    def bias(self) -> Float[np.ndarray, " ways"]:
        return self.estimates - self.reference

    @property
    def deviation(self) -> Float[np.ndarray, " ways"]:
        """Of the estimates from the reference, in standard errors of both."""
        both = np.hypot(self.errors, self.reference_error)
        return np.abs(self.bias) / np.where(both > 0, both, 1.0)


@dataclass(frozen=True)
class Mating:
    """A peg and a hole: force on the held peg, and depth (m) of the dropped one, against its offset; slopes across the edge."""

    label: str
    force: Jumps
    depth: Jumps
    slopes: Slopes


@dataclass(frozen=True)
class Outcome:
    """Every shape along every path, lattices last; the reference is on the box's grid, friction against the sliding speed."""

    settings: Settings
    statics: list[Static]
    judged: list[Judged]
    reference: dict[str, Float[np.ndarray, "points 3"]]
    slopes: list[Slopes]
    matings: list[Mating]
    friction: Jumps

    @property
    def by_shape(self) -> dict[str, list[Static]]:
        """Give each shape's measurements by its label, in the order of the paths."""
        labels = dict.fromkeys(one.shape for one in self.statics)
        return {label: [one for one in self.statics if one.shape == label] for label in labels}

    def rows(self) -> list[dict[str, Any]]:
        return [
            {
                "shape": one.shape,
                "path": one.path,
                "rows": one.num_rows,
                "num_jumps": len(one.jumps[PLAIN].places),
                "largest_jump": largest(one.jumps[PLAIN]),
                "largest_jump_over_force": one.worst(PLAIN),
                "gentle_jump_over_force": one.worst(GENTLE),
                "place_of_largest": at_largest(one.jumps[PLAIN], np.nan),
                "share_of_variation": one.jumps[PLAIN].share,
                "smoothed_jump_over_force": np.nan if one.is_lattice else one.worst(SMOOTHED),
                "c_mujoco_jump_over_force": one.worst(C),
                "c_mujoco_num_jumps": len(one.jumps[C].places),
                "most_contacts": int(one.contacts.max()),
                "most_copies": int(one.copies.max()),
            }
            for one in self.statics
        ]


def worst(jumps: Jumps) -> float:
    """Give the largest jump over the largest value on the path; zero without any."""
    return largest(jumps) / jumps.scale if jumps.scale else 0.0


def largest(jumps: Jumps) -> float:
    """Give the largest jump in its own units; zero without any."""
    return float(jumps.sizes.max(initial=0.0))


def at_largest(jumps: Jumps, otherwise: float) -> float:
    """Give where the largest jump is."""
    return float(jumps.places[jumps.largest]) if len(jumps.places) else otherwise


# Impedance that rises from zero within 2 mm, in place of MuJoCo's default, so that a contact begins without force.
_GENTLE = (0.0, 0.95, 0.002, 0.5, 2.0)
_NEAR = 1e-9  # m; contacts as near as that are one
# Jumps of a wrench that is solved to 1e-10 count from this share of the largest force on.
_SMALLEST = 1e-4
# Force and torque of a free joint, the torque as a force at half an edge, all in N.
_WRENCH = np.array([1.0, 1.0, 1.0, 1 / HALF, 1 / HALF, 1 / HALF])

_FRICTION = """<mujoco><option gravity="0 0 0" tolerance="1e-10"/><worldbody>
<geom type="box" size=".5 .1 .1"/><body pos="0 0 .195"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_THINNEST = 1e-9  # m; of a thinner overlap nothing is known


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Find the jumps of every body along every path, judge the box's, and estimate slopes across them."""
    sizes = settings.sizes
    bodies = {name: shape(name) for name in (*sizes.shapes, *sizes.lattices)}
    shapes = list(bodies.values())
    with workspace.stage("held bodies", "bodies", len(shapes)) as advance_to:
        found = in_threads(
            lambda at: workspace.once(
                f"held {at}", lambda: [_static(settings, shapes[at], name) for name in sizes.paths]
            ),
            range(len(shapes)),
            advance_to,
        )
    statics = [one for each in found for one in each]
    box, cube = found[0], shapes[0]
    with workspace.stage("overlap volumes", "paths", len(sizes.paths)):
        poses = {one.path: PATHS[one.path].poses(cube, settings.depth, one.jumps[PLAIN].parameters) for one in box}
        reference = {path: overlap_force(each) for path, each in poses.items()}
        judged = [found for one in box for found in _judged(settings, cube, one)]
    # Bodies are let go where the box's force jumps most, or in the middle of a path.
    places = {one.path: at_largest(one.jumps[PLAIN], float(np.mean(PATHS[one.path].interval))) for one in box}
    pushed = [bodies[name] for name in sizes.pushed]
    for body in pushed:
        workspace.check(body.scene, name=body.label)
    with workspace.stage("pushes", "bodies", len(pushed)) as advance_to:
        pushes = in_threads(
            lambda at: workspace.once(f"pushed {at}", lambda: push_slopes(settings, pushed[at], places, at)),
            range(len(pushed)),
            advance_to,
        )
    return Outcome(
        settings=settings,
        statics=statics,
        judged=judged,
        reference=reference,
        slopes=[one for each in pushes for one in each],
        matings=matings(settings, workspace),
        friction=_friction(sizes.num_points),
    )


def _static(settings: Settings, body: Shape, name: str) -> Static:
    path, count = PATHS[name], settings.sizes.num_points

    def jumps(force) -> Jumps:
        def at(parameters: np.ndarray) -> np.ndarray:
            return force(path.poses(body, settings.depth, parameters))

        return jumps_along(at, path.interval, num_points=count, smallest=_SMALLEST)

    def measured(scene: mg.Scene, contact: Contact = mg.Discrete()) -> Jumps:
        return jumps(lambda at: _wrenches(scene, jnp.asarray(at), contact)[0])

    plain = measured(body.scene)
    found = {PLAIN: plain, GENTLE: plain}
    if not body.is_lattice:
        # Only numbers change, so nothing is compiled anew.
        solimp = jnp.broadcast_to(jnp.array(_GENTLE), body.scene.model.geom_solimp.shape)
        gentle = eqx.tree_at(lambda s: s.model, body.scene, body.scene.model.replace(geom_solimp=solimp))
        found |= {GENTLE: measured(gentle), SMOOTHED: measured(body.scene, mg.Smoothing(settings.smoothing))}
    found[C] = jumps(lambda at: _c_wrenches(body.scene.mj_model, at))
    grid = jnp.asarray(path.poses(body, settings.depth, plain.parameters))
    _, distances, places = (np.asarray(each) for each in _wrenches(body.scene, grid, mg.Discrete()))
    touching = [np.round(at[gap < 0] / _NEAR) for gap, at in zip(distances, places, strict=True)]
    different = np.array([len(np.unique(one, axis=0)) for one in touching])
    return Static(
        shape=body.label,
        path=name,
        num_rows=body.scene.data._impl.efc_J.shape[0],
        is_lattice=body.is_lattice,
        jumps=found,
        contacts=different,
        copies=np.array([len(one) for one in touching]) - different,
    )


@eqx.filter_jit
def _wrenches(
    scene: mg.Scene, poses: Float[Array, "points 7"], contact: Contact
) -> tuple[Float[Array, "points 6"], Float[Array, "points contacts"], Float[Array, "points contacts 3"]]:
    """Return force and torque, and the distances and places of all contacts."""

    def one(pose: Float[Array, " 7"]) -> tuple[Array, Array, Array]:
        data = mg.forward(scene.model, scene.data.replace(qpos=pose), contact=contact)
        return data.qfrc_constraint * _WRENCH, data._impl.contact.dist, data._impl.contact.pos

    return jax.vmap(one)(poses)


def _c_wrenches(model: mujoco.MjModel, poses: np.ndarray) -> Float[np.ndarray, "points 6"]:
    data = mujoco.MjData(model)
    found = np.empty((len(poses), 6))
    for row, pose in zip(found, poses, strict=True):
        data.qpos[:], data.qacc_warmstart[:] = pose, 0.0
        mujoco.mj_forward(model, data)
        row[:] = data.qfrc_constraint * _WRENCH
    return found


def _judged(settings: Settings, body: Shape, static: Static) -> list[Judged]:
    """Hold each jump of the box against the reference just beside it, and a penetration depth away."""
    found, jumps, path = [], static.jumps[PLAIN], PATHS[static.path]
    away = settings.depth if path.unit == "m" else settings.depth / HALF
    for at, relative in zip(jumps.places, jumps.relative, strict=True):
        sides = (path.poses(body, settings.depth, at + np.array([-step, step])) for step in (1e-7, away))
        near, far = map(overlap_force, sides)
        left, right = np.clip(np.searchsorted(jumps.parameters, at) + np.array([-1, 0]), 0, len(static.contacts) - 1)
        found.append(
            Judged(
                path=static.path,
                place=float(at),
                relative=float(relative),
                is_geometric=bool((np.abs(static.jumps[GENTLE].places - at) < 1e-3 * path.length).any()),
                reference_jump=_turn(near),
                reference_change=_turn(far),
                contacts=(int(static.contacts[left]), int(static.contacts[right])),
            )
        )
    return found


def _turn(pair: Float[np.ndarray, "2 3"]) -> float:
    larger = np.linalg.norm(pair, axis=1).max()
    return float(np.linalg.norm(pair[1] - pair[0]) / larger) if larger > 0 else 0.0


def overlap_force(poses: Float[np.ndarray, "points 7"]) -> Float[np.ndarray, "points 3"]:
    """Give the force of unit pressure on a cube in another, fixed at the origin: a force that geometry alone gives.

    It is less the integral of the normal over what lies inside, or less the derivative of the shared volume by the position, in
    m². The volume is continuous, and so is its gradient but where faces that are parallel part. A penalty on it is what
    pressure fields tend to; jumps that it does not have are none of the motion's.
    """
    return np.array([_force(pose) for pose in poses])


def _force(pose: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 3"]:
    normals = Rotation.from_quat(pose[3:], scalar_first=True).apply(_AXES)
    # Half spaces as scipy takes them, a·x + b ≤ 0; those of the moved cube last.
    offsets = np.concatenate([np.full(6, -HALF), -HALF - normals @ pose[:3]])
    spaces = np.column_stack([np.concatenate([_AXES, normals]), offsets])
    # The largest ball inside both: where its radius is positive they overlap, and its centre lies inside.
    ball = linprog([0, 0, 0, -1], np.column_stack([spaces[:, :3], np.ones(12)]), -offsets, bounds=[(None, None)] * 4)
    if not ball.success or ball.x[3] < _THINNEST:
        return np.zeros(3)
    try:
        hull = ConvexHull(HalfspaceIntersection(spaces, ball.x[:3]).intersections)
    except QhullError:
        return np.zeros(3)
    corners = hull.points[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    outward, distance = hull.equations[:, :3], hull.equations[:, 3]
    is_moved = np.isclose(outward @ normals.T, 1, atol=1e-7) & np.isclose(distance[:, None], offsets[6:], atol=1e-7)
    return -(areas * is_moved.any(axis=1)) @ outward


def _friction(num_points: int) -> Jumps:
    """Find how the friction on a ball that is pressed on and slides turns with its speed."""
    scene = mg.load_scene(_FRICTION)

    @jax.jit
    @jax.vmap
    def force(speed: Float[Array, ""]) -> Array:
        velocity = jnp.zeros(2).at[0].set(speed)
        return mg.forward(scene.model, scene.data.replace(qvel=velocity)).qfrc_constraint[0]

    return jumps_along(lambda x: force(jnp.asarray(x)), (-1.0, 1.0), num_points=num_points)


_NUM_STEPS = 15  # of 2 ms: the body is still in contact, or has just left it
# Of the outcome's largest jump near the start; smaller ones are teeth of the time step.
_SMALLEST_RISE = 1e-3
# A peg and a hole, whose contact is told by boxes, by points on the peg alone, or by points on both.
TILT = 0.1  # rad
_LENGTH = 0.04  # m, half length of the peg
_BELOW = 0.02  # m, how deep the peg's end is where the force is read
_ABOVE = 0.002  # m, how high above the hole it is let go
OFFSETS = (0.0, 0.016)  # m
_NUM_DROPPED = 100  # of 2 ms
_SMALLEST_DEPTH = 0.02  # of the depth; smaller jumps are teeth of the time step

# From starts and the name of a gradient to outcomes and derivatives.
Simulate = Callable[[np.ndarray, str], tuple[Any, Any]]


def push_slopes(settings: Settings, body: Shape, places: dict[str, float], index: int) -> list[Slopes]:
    """Let a body go on each path from a mean start, and estimate how high it is pushed, by where it was."""
    found = []
    for number, (name, place) in enumerate(places.items()):
        path = PATHS[name]

        def simulate(starts: np.ndarray, gradient: str, path=path) -> tuple[Array, Array]:
            # Poses come from SciPy, so that their derivative along the path is a difference; they are smooth.
            little = 1e-6 * path.length
            at, ahead, behind = (path.poses(body, settings.depth, starts + s * little) for s in (0, 1, -1))
            return _ends(
                body.scene, jnp.asarray(at), jnp.asarray(ahead - behind) / (2 * little), gradient, _NUM_STEPS, 2
            )

        rng = np.random.default_rng([settings.seed, index, number])
        found.append(slopes_at(settings, body.label, name, simulate, place, settings.stddev * path.length, rng))
    return found


def slopes_at(
    settings: Settings, label: str, path: str, simulate: Simulate, place: float, stddev: float, rng: np.random.Generator
) -> Slopes:
    """Estimate a slope under noise about a start, in its unit, by first and zeroth order, with a reference."""
    sizes = settings.sizes
    noise = rng.normal(size=sizes.num_samples)
    # One place in each of equal shares of the noise, so that the reference's error is far below the estimates'.
    shape = (sizes.num_repeats, sizes.num_strata)
    strata = norm.ppf((np.arange(sizes.num_strata) + rng.uniform(size=shape)) / sizes.num_strata)
    every = np.concatenate([noise, strata.ravel()])
    found = in_threads(lambda name: simulate(place + stddev * every, name), ("discrete", "slope"))
    (values, discrete), (_, event) = ([np.asarray(each) for each in both] for both in found)
    own, repeats = values[: sizes.num_samples], values[sizes.num_samples :].reshape(shape)
    # Less the mean of the others, which keeps it unbiased.
    baseline = (own.sum() - own) / (len(own) - 1)
    samples = np.stack([discrete[: len(own)], event[: len(own)], (own - baseline) * noise / stddev])
    # Each repeat less the mean of the other repeats, for the same reason.
    others = (repeats.mean(axis=1).sum() - repeats.mean(axis=1)) / (len(repeats) - 1)
    references = ((repeats - others[:, None]) * strata / stddev).mean(axis=1)
    jumps = jumps_along(
        lambda starts: simulate(starts, "discrete")[0],
        (place - 3 * stddev, place + 3 * stddev),
        num_points=sizes.num_rollouts,
        num_refinements=2,
        smallest=_SMALLEST_RISE,
    )
    density = norm.pdf((jumps.places - place) / stddev) / stddev
    order = np.argsort(every)
    return Slopes(
        shape=label,
        path=path,
        place=place,
        estimates=samples.mean(axis=1),
        errors=samples.std(axis=1, ddof=1) / np.sqrt(len(own)),
        reference=float(references.mean()),
        reference_error=float(references.std(ddof=1) / np.sqrt(len(references))),
        jump=float((jumps.after - jumps.before) @ density) if len(jumps.places) else 0.0,
        starts=(place + stddev * every)[order],
        outcomes=values[order],
    )


def matings(settings: Settings, workspace: Workspace) -> list[Mating]:
    """Hold the peg in the hole, and drop it beside it."""
    scenes = {label: mg.load_scene(_peg_and_hole(label)) for label in settings.sizes.geometries}
    jobs = []
    for i, (label, scene) in enumerate(scenes.items()):
        workspace.check(scene, name=f"mating, {label}")
        jobs.append((label, scene, np.random.default_rng([settings.seed, 100 + i])))
    with workspace.stage("mating", "geometries", len(scenes)) as advance_to:
        return in_threads(
            lambda job: workspace.once(f"mating {job[0]}", lambda: _mate(settings, *job)), jobs, advance_to
        )


def _peg_and_hole(label: str) -> mujoco.MjModel:
    """Leave out the points of `mjcf/peg_and_hole.xml`, the rim's or all; boxes meet where there are none."""
    spec = mujoco.MjSpec.from_file(str(scene_path("peg_and_hole")))
    left_out = {"boxes": ("point", "rim"), "points on the peg": ("rim",), "points on both": ()}[label]
    for geom in [one for one in spec.geoms if one.classname.name in left_out]:
        spec.delete(geom)
    if label == "boxes":
        next(one for one in spec.geoms if one.classname.name == "peg").conaffinity = 1
    return spec.compile()


def _mate(settings: Settings, label: str, scene: mg.Scene, rng: np.random.Generator) -> Mating:
    def simulate(offsets: np.ndarray, gradient: str) -> tuple[Array, Array]:
        height, slope = _ends(scene, _tilted(offsets, _ABOVE), jnp.eye(3)[0], gradient, _NUM_DROPPED, 1)
        return _LENGTH - height, -slope

    depth = jumps_along(
        lambda offsets: np.asarray(simulate(offsets, "discrete")[0]),
        OFFSETS,
        num_points=settings.sizes.num_rollouts,
        num_refinements=2,
        smallest=_SMALLEST_DEPTH,
    )
    num_points = settings.sizes.num_points
    force = jumps_along(lambda at: np.asarray(_forces(scene, _tilted(at, -_BELOW))), OFFSETS, num_points=num_points)
    edge, stddev = at_largest(depth, float(np.mean(OFFSETS))), settings.stddev * (OFFSETS[1] - OFFSETS[0])
    return Mating(label, force, depth, slopes_at(settings, label, "offset", simulate, edge, stddev, rng))


def _tilted(offsets: Float[np.ndarray, " offsets"], end: float) -> Float[Array, "offsets 3"]:
    """Place the tilted peg so that its lower end is at a height."""
    still = np.zeros_like(offsets)
    return jnp.stack([offsets, still + end + _LENGTH * np.cos(TILT), still + TILT], axis=1)


@eqx.filter_jit
def _forces(scene: mg.Scene, poses: Float[Array, "offsets 3"]) -> Float[Array, "offsets 3"]:
    force = jax.vmap(lambda pose: mg.forward(scene.model, scene.data.replace(qpos=pose)).qfrc_constraint)(poses)
    return force / np.array([1.0, 1.0, _LENGTH])


@eqx.filter_jit
def _ends(
    scene: mg.Scene,
    poses: Float[Array, "starts nq"],
    tangents: Float[Array, "*starts nq"],
    gradient: str,
    horizon: int,
    index: int,
) -> tuple[Float[Array, " starts"], Float[Array, " starts"]]:
    """Return a position (m) after some steps from each pose, and the derivative along the tangents."""

    def outcome(pose: Float[Array, " nq"]) -> Float[Array, ""]:
        state = mg.initial_state(scene, pose)
        return mg.rollout(scene, state, horizon=horizon, contact=own_motion(gradient)).final.qpos[index]

    every = jnp.broadcast_to(tangents, poses.shape)
    return jax.vmap(lambda pose, tangent: jax.jvp(outcome, (pose,), (tangent,)))(poses, every)
