"""Collect every spring of a scene, and say what its time step makes of them."""

import math
from collections.abc import Iterator

import jax
import mujoco
import numpy as np

from mjxgrad._mjx import COLLISION_FUNCTIONS
from mjxgrad.contact.law import stiffness_damping
from mjxgrad.contact.parameters import ContactPair
from mjxgrad.diagnostics.stability.report import StabilityReport
from mjxgrad.diagnostics.stability.spring import Spring
from mjxgrad.scene import Scene


def check_stability(scene: Scene, *, speed: float | None = None, joint_speed: float | None = None) -> StabilityReport:
    """Compare the contacts, limits and equalities of a scene with what its time step can follow.

    Nothing is simulated. The limits are those of one spring and damper, see `mjxgrad.diagnostics.stability.spring`.

    Args:
        scene: with known values.
        speed: at which geoms approach each other, in m/s; without it nothing is said about what only a speed decides:
            passing through, depth, and onsets.
        joint_speed: the same for joints and tendons at their limits, in rad/s or m/s.

    Returns:
        The report: `print` it, or take its `warnings`.

    Raises:
        ValueError: if a speed is not positive, or the scene is batched or traced.
    """
    for name, value in (("speed", speed), ("joint_speed", joint_speed)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive, got {value}; leave it out to ask about no speed")
    model = scene.model
    leaves = (model.geom_solref, model.jnt_solref, model.opt.timestep)
    is_traced = any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
    if is_traced or np.ndim(model.geom_solref) != 2 or np.ndim(model.opt.timestep) != 0:
        raise ValueError("check_stability needs one scene with known values, got a batched or traced one")
    # Inside jit, operations on known values would be traced, too.
    with jax.ensure_compile_time_eval():
        springs = (*_contacts(scene), *_others(scene))
    return StabilityReport(
        scene.name, springs, float(model.opt.timestep), speed, joint_speed, str(scene.data.qpos.dtype)
    )


def _contacts(scene: Scene) -> Iterator[Spring]:
    if not scene.pairs:
        return
    parameters = scene.contact_parameters()
    columns = (parameters.stiffness, parameters.damping, parameters.impedance, parameters.width, parameters.solref)
    stiffness, damping, impedance, width, solref = (np.asarray(column, float) for column in columns)
    friction = np.asarray(parameters.friction[:, 0], float)
    is_pyramidal = scene.model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    for i, pair in enumerate(scene.pairs):
        kinds = tuple(mujoco.mjtGeom(int(scene.mj_model.geom_type[geom])) for geom in (pair.geom1, pair.geom2))
        yield _spring(
            scene,
            "contact",
            str(pair),
            stiffness[i],
            damping[i],
            impedance[i],
            width[i],
            solref[i],
            _thickness(scene, pair),
            COLLISION_FUNCTIONS[kinds].ncon,
            float(friction[i]) if is_pyramidal and pair.condim > 1 else None,
        )


def _others(scene: Scene) -> Iterator[Spring]:
    """Joint limits, tendon limits and equalities that are switched on."""
    model, c_model = scene.model, scene.mj_model
    disabled = int(model.opt.disableflags)
    flag = mujoco.mjtDisableBit
    if disabled & flag.mjDSBL_CONSTRAINT:
        return
    is_on = {
        "joint limit": not disabled & flag.mjDSBL_LIMIT,
        "tendon limit": not disabled & flag.mjDSBL_LIMIT,
        "equality": not disabled & flag.mjDSBL_EQUALITY,
    }
    kinds = (
        ("joint limit", c_model.jnt_limited, model.jnt_solref, model.jnt_solimp, model.jnt_range),
        ("tendon limit", c_model.tendon_limited, model.tendon_solref_lim, model.tendon_solimp_lim, model.tendon_range),
        ("equality", c_model.eq_active0, model.eq_solref, model.eq_solimp, None),
    )
    objects = (mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_TENDON, mujoco.mjtObj.mjOBJ_EQUALITY)
    for (kind, active, solref, solimp, ranges), which in zip(kinds, objects, strict=True):
        chosen = np.flatnonzero(active) if is_on[kind] else np.zeros(0, int)
        if not chosen.size:
            continue
        stiffness, damping = (np.asarray(x, float) for x in stiffness_damping(model, solref))
        for i in chosen:
            name = mujoco.mj_id2name(c_model, which, i) or f"{kind} {i}"
            size = np.inf if ranges is None else float(np.ptp(np.asarray(ranges[i], float)))
            impedance, width = np.asarray(solimp[i, :2], float), float(solimp[i, 2])
            impedance = np.clip(impedance, mujoco.mjMINIMP, mujoco.mjMAXIMP)
            yield _spring(
                scene, kind, name, stiffness[i], damping[i], impedance, width, np.asarray(solref[i], float), size
            )


def _spring(
    scene: Scene,
    kind: str,
    name: str,
    stiffness,
    damping,
    impedance,
    width,
    solref,
    size: float,
    num_rows: int = 1,
    pyramid: float | None = None,
) -> Spring:
    return Spring(
        kind,
        name,
        float(stiffness),
        float(damping),
        (float(impedance[0]), float(impedance[1])),
        max(float(width), mujoco.mjMINVAL),
        float(solref[0]) if solref[0] > 0 else None,
        float(scene.model.opt.timestep),
        mujoco.mjtIntegrator(int(scene.model.opt.integrator)),
        size,
        num_rows,
        pyramid,
    )


def _thickness(scene: Scene, pair: ContactPair) -> float:
    """Least thickness of two geoms together, by which they may interpenetrate and still part the way they came (m)."""
    kinds = [mujoco.mjtGeom(int(scene.mj_model.geom_type[geom])) for geom in (pair.geom1, pair.geom2)]
    # Behind a plane or under a height field everything is inside, however far.
    if {mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD} & set(kinds):
        return np.inf
    return sum(_half_thickness(scene, geom, kind) for geom, kind in zip((pair.geom1, pair.geom2), kinds, strict=True))


def _half_thickness(scene: Scene, geom: int, kind: mujoco.mjtGeom) -> float:
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return float(scene.model.geom_size[geom, 0])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        # Half extents of the box around it, in its own axes.
        return float(scene.mj_model.geom_aabb[geom, 3:].min())
    sizes = np.asarray(scene.model.geom_size[geom], float)
    return float(sizes[sizes > 0].min(initial=np.inf))
