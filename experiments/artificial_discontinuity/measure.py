"""From settings to numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.artificial_discontinuity import mating
from experiments.artificial_discontinuity.outcome import Judged, Outcome, Static
from experiments.artificial_discontinuity.paths import PATHS
from experiments.artificial_discontinuity.pushes import push_slopes
from experiments.artificial_discontinuity.reference import overlap_force
from experiments.artificial_discontinuity.settings import Settings
from experiments.artificial_discontinuity.shapes import HALF, Shape, lattice, shape
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Jumps, jumps_along

# Impedance that rises from zero within 2 mm, in place of MuJoCo's default, so that a contact begins without force.
_GENTLE = (0.0, 0.95, 0.002, 0.5, 2.0)
_NEAR = 1e-9  # m; contacts as near as that are one
# Jumps of a wrench that is solved to 1e-10 count from this share of the largest force on.
_SMALLEST = 1e-4

_FRICTION = """<mujoco><option gravity="0 0 0" tolerance="1e-10"/><worldbody>
<geom type="box" size=".5 .1 .1"/><body pos="0 0 .195"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Find the jumps of every body along every path, judge the box's, and estimate slopes across them."""
    sizes = settings.sizes
    bodies = {name: shape(name) for name in sizes.shapes} | {count: lattice(count) for count in sizes.lattices}
    shapes = list(bodies.values())
    with workspace.stage("held bodies", "bodies", len(shapes)) as advance_to:
        found = in_threads(lambda body: [_static(settings, body, name) for name in sizes.paths], shapes, advance_to)
    statics = [one for each in found for one in each]
    box = [one for one in statics if one.shape == shapes[0].label]
    with workspace.stage("overlap volumes", "paths", len(sizes.paths)):
        reference = {one.path: _overlap(settings, shapes[0], one.path, one.plain.parameters) for one in box}
        judged = [found for one in box for found in _judged(settings, shapes[0], one)]
    pushed, places = [bodies[name] for name in sizes.pushed], {one.path: _where(one) for one in box}
    for body in pushed:
        workspace.check(body.scene, name=body.label)
    with workspace.stage("pushes", "bodies", len(pushed)) as advance_to:
        pushes = in_threads(lambda one: push_slopes(settings, one[1], places, one[0]), enumerate(pushed), advance_to)
    return Outcome(
        settings=settings,
        paths={name: PATHS[name] for name in sizes.paths},
        statics=statics,
        judged=judged,
        reference=reference,
        slopes=[one for each in pushes for one in each],
        matings=mating.measure(settings, workspace),
        friction=_friction(sizes.num_points),
    )


def _static(settings: Settings, body: Shape, name: str) -> Static:
    path, count = PATHS[name], settings.sizes.num_points

    def poses(parameters: np.ndarray) -> np.ndarray:
        return path.poses(body, settings.depth, parameters)

    def jumps(force) -> Jumps:
        return jumps_along(lambda x: force(poses(x)), path.interval, num_points=count, smallest=_SMALLEST)

    def measured(scene: mg.Scene, smoothing: mg.Smoothing | None = None) -> Jumps:
        return jumps(lambda at: _wrenches(scene, jnp.asarray(at), smoothing)[0])

    _, distances, places = _wrenches(body.scene, jnp.asarray(poses(np.linspace(*path.interval, count))), None)
    touching = [
        np.round(at[gap < 0] / _NEAR) for gap, at in zip(np.asarray(distances), np.asarray(places), strict=True)
    ]
    different = np.array([len(np.unique(one, axis=0)) for one in touching])
    return Static(
        shape=body.label,
        path=name,
        num_rows=body.num_rows,
        is_lattice=body.is_lattice,
        plain=measured(body.scene),
        gentle=None if body.is_lattice else measured(_gentle(body.scene)),
        smoothed=None if body.is_lattice else measured(body.scene, mg.Smoothing(settings.smoothing)),
        c_mujoco=jumps(lambda at: _c_wrenches(body.scene.mj_model, at)),
        contacts=different,
        copies=np.array([len(one) for one in touching]) - different,
    )


def _gentle(scene: mg.Scene) -> mg.Scene:
    """Give the scene with contacts that begin without force; only numbers change, so nothing is compiled anew."""
    solimp = jnp.broadcast_to(jnp.array(_GENTLE), scene.model.geom_solimp.shape)
    return eqx.tree_at(lambda s: s.model, scene, scene.model.replace(geom_solimp=solimp))


@eqx.filter_jit
def _wrenches(
    scene: mg.Scene, poses: Float[Array, "points 7"], smoothing: mg.Smoothing | None
) -> tuple[Float[Array, "points 6"], Float[Array, "points contacts"], Float[Array, "points contacts 3"]]:
    """Return force and torque, and the distances and places of all contacts."""

    def one(pose: Float[Array, " 7"]) -> tuple[Array, Array, Array]:
        data = mg.forward(scene.model, scene.data.replace(qpos=pose), smoothing=smoothing)
        return _wrench(data.qfrc_constraint), data._impl.contact.dist, data._impl.contact.pos

    return jax.vmap(one)(poses)


def _wrench(force):
    """Return force and torque of a free joint, the torque as a force at half an edge, all in N."""
    return force * np.array([1.0, 1.0, 1.0, 1 / HALF, 1 / HALF, 1 / HALF])


def _c_wrenches(model: mujoco.MjModel, poses: np.ndarray) -> Float[np.ndarray, "points 6"]:
    data = mujoco.MjData(model)
    found = np.empty((len(poses), 6))
    for row, pose in zip(found, poses, strict=True):
        data.qpos[:], data.qacc_warmstart[:] = pose, 0.0
        mujoco.mj_forward(model, data)
        row[:] = _wrench(data.qfrc_constraint)
    return found


def _overlap(settings, body: Shape, name: str, parameters: np.ndarray) -> Float[np.ndarray, "points 3"]:
    return overlap_force(PATHS[name].poses(body, settings.depth, parameters))


def _judged(settings: Settings, body: Shape, static: Static) -> list[Judged]:
    """Hold each jump of the box against the reference just beside it, and a penetration depth away."""
    found, jumps, gentle, path = [], static.plain, static.gentle or static.plain, PATHS[static.path]
    away = settings.depth if path.unit == "m" else settings.depth / HALF
    for place, relative in zip(jumps.places, jumps.relative, strict=True):
        near, far = (
            _overlap(settings, body, static.path, np.array([place - step, place + step])) for step in (1e-7, away)
        )
        left, right = np.searchsorted(jumps.parameters, place) + np.array([-1, 0])
        found.append(
            Judged(
                path=static.path,
                place=float(place),
                relative=float(relative),
                is_geometric=bool((np.abs(gentle.places - place) < 1e-3 * path.length).any()),
                reference_jump=_turn(near),
                reference_change=_turn(far),
                from_contacts=int(static.contacts[max(left, 0)]),
                to_contacts=int(static.contacts[min(right, len(static.contacts) - 1)]),
            )
        )
    return found


def _turn(pair: Float[np.ndarray, "2 3"]) -> float:
    larger = np.linalg.norm(pair, axis=1).max()
    return float(np.linalg.norm(pair[1] - pair[0]) / larger) if larger > 0 else 0.0


def _where(static: Static) -> float:
    """Return the place of the box's largest jump on a path, or its middle."""
    jumps = static.plain
    return float(jumps.places[jumps.largest] if len(jumps.places) else np.mean(PATHS[static.path].interval))


def _friction(num_points: int) -> Jumps:
    """Find how the friction on a ball that is pressed on and slides turns with its speed."""
    scene = mg.load_scene(_FRICTION)

    @jax.jit
    def forces(speeds: Float[Array, " points"]) -> Float[Array, " points"]:
        def one(speed: Float[Array, ""]) -> Array:
            velocity = jnp.zeros(2).at[0].set(speed)
            return mg.forward(scene.model, scene.data.replace(qvel=velocity)).qfrc_constraint[0]

        return jax.vmap(one)(speeds)

    return jumps_along(lambda x: np.asarray(forces(jnp.asarray(x))), (-1.0, 1.0), num_points=num_points)
