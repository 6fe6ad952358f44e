"""Settings that MJX rejects or ignores, replaced by equivalent ones; and parts of a step that a motion does not need.

Each rule changes a copy of the C model in place and returns its change, which says where the motion is not kept exactly.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad._text import name_pairs
from mjxgrad.contact.parameters import contact_pairs, deciding_geoms
from mjxgrad.scene.refusals import ACTUATORS, element_name, has_constraints, has_friction_loss, has_limits, has_medium

_DISABLE = mujoco.mjtDisableBit
_ENABLE = mujoco.mjtEnableBit
_EULERDAMP = _DISABLE.mjDSBL_EULERDAMP.value
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE.value
# Newton's method needs a few for most steps and up to 20 for some. It stops by itself, so a high limit costs nothing.
_FEWEST_ITERATIONS, _ITERATIONS = 20, 100


@dataclass(frozen=True)
class Conversion:
    """A setting of the file and its replacement."""

    what: str  # the setting, as MJCF calls it
    given: str  # its value in the file
    used: str  # its replacement
    reason: str  # why the motion is the same, or how it differs
    exact: bool = True  # whether the motion equals C MuJoCo's, up to the solver's tolerance


def waking(model: mujoco.MjModel) -> Iterator[Conversion]:
    """Let no body sleep, by either engine: what sleeps is no part of a state, from which a rollout goes on."""
    if model.opt.enableflags & _ENABLE.mjENBL_SLEEP.value:
        model.opt.enableflags &= ~_ENABLE.mjENBL_SLEEP.value
        yield Conversion("flag sleep", "enable", "disable", "bodies at rest are stepped too, not frozen", exact=False)


def _flags(model: mujoco.MjModel) -> Iterator[Conversion]:
    for flag, reason in (
        (_ENABLE.mjENBL_ENERGY, "energy is computed for reading only"),
        (_ENABLE.mjENBL_FWDINV, "compares forward and inverse dynamics, moves nothing"),
    ):
        if model.opt.enableflags & flag.value:
            model.opt.enableflags &= ~flag.value
            what = f"flag {flag.name.removeprefix('mjENBL_').lower()}"
            yield Conversion(what, "enable", "disable", reason)
    yield from waking(model)
    for flag in ("ISLAND", "MIDPHASE", "NATIVECCD", "MULTICCD", "AUTORESET"):
        if model.opt.disableflags & getattr(_DISABLE, f"mjDSBL_{flag}").value:
            reason = "chooses between algorithms of C MuJoCo; MJX has its own"
            yield Conversion(f"flag {flag.lower()}", "disable", "ignored", reason)


def _solver(model: mujoco.MjModel) -> Iterator[Conversion]:
    if model.opt.iterations < _FEWEST_ITERATIONS and has_constraints(model):
        given, model.opt.iterations = model.opt.iterations, _ITERATIONS
        reason = "the derivative is that of a solve that has ended, C MuJoCo's ends short of it"
        yield Conversion("iterations", str(given), str(_ITERATIONS), reason, exact=False)
    given = model.opt.solver
    if given == mujoco.mjtSolver.mjSOL_NEWTON:
        return
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and any(p.condim > 1 for p in contact_pairs(model))
    is_exact = given != mujoco.mjtSolver.mjSOL_PGS or not is_elliptic
    reason = "the same convex problem, the same optimum"
    reason = reason if is_exact else "with elliptic cones PGS stops short of the optimum that Newton finds"
    yield Conversion("solver", mujoco.mjtSolver(given).name.removeprefix("mjSOL_"), "Newton", reason, is_exact)


def _wind(model: mujoco.MjModel) -> Iterator[Conversion]:
    if model.opt.wind.any() and not has_medium(model):
        given = " ".join(f"{w:g}" for w in model.opt.wind)
        model.opt.wind[:] = 0.0
        yield Conversion("wind", given, "0 0 0", "there is no medium: density = viscosity = 0")


def _no_passive_forces(model: mujoco.MjModel) -> Iterator[Conversion]:
    if all(model.opt.disableflags & flag.value for flag in (_DISABLE.mjDSBL_SPRING, _DISABLE.mjDSBL_DAMPER)):
        model.opt.disableflags |= _EULERDAMP
        reason = "with the damper flag disabled C MuJoCo integrates no damping, MJX would"
        yield Conversion("flag eulerdamp", "enable", "disable", reason)


def _least_friction(model: mujoco.MjModel) -> Iterator[Conversion]:
    """Clip friction coefficients from below as C does; MJX divides by them unclipped."""
    used, raised = {1: [], 3: [0], 4: [0, 1], 6: [0, 1, 2]}, []
    for pair in contact_pairs(model):
        if pair.explicit >= 0:
            rows, needed = model.pair_friction[[pair.explicit]], list(range(pair.condim - 1))
        else:
            rows, needed = model.geom_friction[list(deciding_geoms(model, pair))], used[pair.condim]
        if (rows[:, needed].max(axis=0) < mujoco.mjMINMU).any():
            raised.append(pair)
    if raised:
        for field in ("geom_friction", "pair_friction"):
            np.maximum(getattr(model, field), mujoco.mjMINMU, out=getattr(model, field))
        least, reason = f"{mujoco.mjMINMU:g}", "what C MuJoCo itself makes of it"
        yield Conversion(f"friction of {name_pairs(raised)}", "0", least, reason)


def _implicitfast(model: mujoco.MjModel) -> Iterator[Conversion]:
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return
    given = "implicitfast"
    if (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        used, reason = (
            f"{given} without the gyroscopic derivative",
            "MJX has none for free bodies; same order of accuracy",
        )
        yield Conversion("integrator", given, used, reason, exact=False)
    affine_gain = (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE) & (model.actuator_gainprm[:, 2] != 0)
    affine_bias = (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE) & (model.actuator_biasprm[:, 2] != 0)
    muscle = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE
    limited = model.actuator_forcelimited.astype(bool)
    # One control per actuator: others are refused.
    clamped = model.actuator_ctrllimited[model.actuator_ctrladr].astype(bool)
    differs = muscle | ((affine_gain | affine_bias) & limited) | (affine_gain & clamped)
    if differs.any():
        names = [element_name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in np.flatnonzero(differs).tolist()]
        used, reason = (
            f"{given} with a simpler derivative",
            "MJX's velocity derivative ignores force and control limits and muscles",
        )
        yield Conversion(f"integrator at {name_pairs(names)}", given, used, reason, exact=False)


def drop_sensors(model: mujoco.MjModel) -> Iterator[Conversion]:
    """Drop sensors that MJX lacks, which would raise or read zero; sensors move nothing."""
    known = {int(member) for member in mjx.SensorType}
    delayed = (model.sensor_history[:, 0] > 0) | (model.sensor_interval[:, 0] > 0)
    for i in range(model.nsensor):
        kind = mujoco.mjtSensor(model.sensor_type[i])
        if int(kind) in known and not delayed[i] and not _is_unmatched_contact(model, i):
            continue
        # No stage computes it any more, but MJX must know its type.
        model.sensor_needstage[i] = mujoco.mjtStage.mjSTAGE_NONE
        model.sensor_type[i] = mujoco.mjtSensor.mjSENS_CLOCK
        name = element_name(model, mujoco.mjtObj.mjOBJ_SENSOR, i)
        word = "delayed " if delayed[i] else ""
        given = word + kind.name.removeprefix("mjSENS_").lower()
        yield Conversion(name, given, "reads 0", "MJX cannot compute it", exact=False)


def kinematics_alone(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model for C MuJoCo that MJX can hold: its tree and numbers, without anything that acts."""
    bare = copy.deepcopy(model)
    bare.opt.solver, bare.opt.integrator = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtIntegrator.mjINT_EULER
    bare.opt.cone, bare.opt.enableflags, bare.opt.noslip_iterations = mujoco.mjtCone.mjCONE_PYRAMIDAL, 0, 0
    bare.geom_contype[:] = bare.geom_conaffinity[:] = 0
    bare.geom_type[np.concatenate([bare.pair_geom1, bare.pair_geom2])] = _SPHERE
    for _, field, known, *_ in ACTUATORS:
        kinds = getattr(bare, field)
        kinds[~np.isin(kinds, [int(kind) for kind in known])] = 0  # at a joint, no dynamics, a fixed gain, no bias
    bare.eq_type[~np.isin(bare.eq_type, [int(kind) for kind in mjx.EqType])] = mujoco.mjtEq.mjEQ_CONNECT
    list(drop_sensors(bare))
    return bare


def _is_unmatched_contact(model: mujoco.MjModel, sensor: int) -> bool:
    if model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_CONTACT:
        return False
    objects = {int(model.sensor_objtype[sensor]), int(model.sensor_reftype[sensor])}
    by_body = {int(o) for o in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY)}
    by_site = model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_SITE
    net_force = model.sensor_intprm[sensor, 1] == 3
    return bool(objects & by_body) or by_site or net_force


# The first group avoids refusals and runs before them, the second runs after them.
BEFORE_REFUSALS = (_flags, _wind)
AFTER_REFUSALS = (_solver, _no_passive_forces, _least_friction, _implicitfast)

# The stage; why it is left out without elements; whether there are any; the flag that disables it.
_STAGES = (
    ("tendons", "none in the scene", lambda m: m.ntendon, None),
    ("collision detection", "no two geoms can touch", contact_pairs, _DISABLE.mjDSBL_CONTACT),
    ("equality constraints", "none in the scene", lambda m: m.neq, _DISABLE.mjDSBL_EQUALITY),
    ("friction loss", "no joint or tendon has any", has_friction_loss, _DISABLE.mjDSBL_FRICTIONLOSS),
    ("limits", "no joint or tendon is limited", has_limits, _DISABLE.mjDSBL_LIMIT),
    ("actuation", "no actuators", lambda m: m.nu, _DISABLE.mjDSBL_ACTUATION),
    ("gravity compensation", "no body has gravcomp", lambda m: m.ngravcomp, _DISABLE.mjDSBL_GRAVITY),
    ("fluid forces", "no medium: density = viscosity = 0", has_medium, None),
)


@dataclass(frozen=True)
class Omission:
    """Work that a step of this scene leaves out."""

    what: str  # the stage
    reason: str  # why the motion does not need it


def switch_off(model: mujoco.MjModel) -> tuple[Omission, ...]:
    """Switch off the parts that a scene does not need, and return all omissions of its step."""
    # Most stages cost nothing once the model has no element for them, since their arrays have no rows. XLA removes what is
    # computed for reading only from a compiled rollout. One flag is set in place: Euler integration would factorise the mass
    # matrix a second time for zero damping.
    omissions = []
    for what, absence, is_there, flag in _STAGES:
        if flag is not None and model.opt.disableflags & flag.value:
            name = flag.name.removeprefix("mjDSBL_").lower()
            omissions.append(Omission(what, f"the file disables the flag {name}"))
        elif not is_there(model):
            omissions.append(Omission(what, absence))
    is_euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    if is_euler and not model.opt.disableflags & _EULERDAMP and not model.dof_damping.any():
        model.opt.disableflags |= _EULERDAMP
        reason = "no joint is damped; keep_everything=True to differentiate by dof_damping"
        omissions.append(Omission("implicit damping", reason))
    return tuple(omissions)
