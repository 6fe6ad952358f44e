"""From settings to numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from scipy.spatial.transform import Rotation

import mjxgrad as mg
from experiments.artificial_discontinuity.outcome import GENTLE, PLAIN, SMOOTHED, C, Judged, Outcome, Static, at_largest
from experiments.artificial_discontinuity.pushes import matings, push_slopes
from experiments.artificial_discontinuity.settings import Settings
from experiments.artificial_discontinuity.shapes import HALF, PATHS, Shape, shape
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Jumps, jumps_along

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
        found = in_threads(lambda body: [_static(settings, body, name) for name in sizes.paths], shapes, advance_to)
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
        pushes = in_threads(lambda one: push_slopes(settings, one[1], places, one[0]), enumerate(pushed), advance_to)
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

    def measured(scene: mg.Scene, smoothing: mg.Smoothing | None = None) -> Jumps:
        return jumps(lambda at: _wrenches(scene, jnp.asarray(at), smoothing)[0])

    plain = measured(body.scene)
    found = {PLAIN: plain, GENTLE: plain}
    if not body.is_lattice:
        # Only numbers change, so nothing is compiled anew.
        solimp = jnp.broadcast_to(jnp.array(_GENTLE), body.scene.model.geom_solimp.shape)
        gentle = eqx.tree_at(lambda s: s.model, body.scene, body.scene.model.replace(geom_solimp=solimp))
        found |= {GENTLE: measured(gentle), SMOOTHED: measured(body.scene, mg.Smoothing(settings.smoothing))}
    found[C] = jumps(lambda at: _c_wrenches(body.scene.mj_model, at))
    grid = jnp.asarray(path.poses(body, settings.depth, plain.parameters))
    _, distances, places = (np.asarray(each) for each in _wrenches(body.scene, grid, None))
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
    scene: mg.Scene, poses: Float[Array, "points 7"], smoothing: mg.Smoothing | None
) -> tuple[Float[Array, "points 6"], Float[Array, "points contacts"], Float[Array, "points contacts 3"]]:
    """Return force and torque, and the distances and places of all contacts."""

    def one(pose: Float[Array, " 7"]) -> tuple[Array, Array, Array]:
        data = mg.forward(scene.model, scene.data.replace(qpos=pose), smoothing=smoothing)
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
