"""Features that MJX cannot simulate, each with its remedy: of a small scene per feature, stepped in C MuJoCo and in MJX 3.17."""

import copy
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum

import mujoco
import numpy as np

from mjxgrad._mjx import has_collision_fn, mjx
from mjxgrad.contact.parameters import ContactPair, contact_pairs

_OBJECT = mujoco.mjtObj
_ENABLE = mujoco.mjtEnableBit
_DISABLE = mujoco.mjtDisableBit
_GEOM = mujoco.mjtGeom
_INTEGRATOR = mujoco.mjtIntegrator
_SCALAR = (mujoco.mjtJoint.mjJNT_SLIDE.value, mujoco.mjtJoint.mjJNT_HINGE.value)
_SEARCHED = {_GEOM.mjGEOM_ELLIPSOID.value, _GEOM.mjGEOM_CYLINDER.value}
_CAPSULE = _GEOM.mjGEOM_CAPSULE.value
_NEAR, _ROUNDING = 1e-6, 1e-9  # m
_SHAPED = {_GEOM.mjGEOM_MESH.value, _GEOM.mjGEOM_HFIELD.value}
_SMOOTH = _SEARCHED | {_GEOM.mjGEOM_SPHERE.value, _CAPSULE}


def element_name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """Return an element's name in messages: its kind with its name or number."""
    name = mujoco.mj_id2name(model, kind, index)
    word = kind.name.removeprefix("mjOBJ_").lower()
    return f"{word} {name!r}" if name else f"{word} {index}"


def _where(kind: mujoco.mjtObj, condition: Callable[[mujoco.MjModel], np.ndarray]):
    """Return a function that names the elements for which a condition holds; the condition returns one row per element."""

    def find(model: mujoco.MjModel) -> list[str]:
        rows = np.asarray(condition(model))
        rows = rows.reshape(rows.shape[0], -1).any(axis=1) if rows.size else np.zeros(0, bool)
        return [element_name(model, kind, i) for i in np.flatnonzero(rows).tolist()]

    return find


def _unknown_type(kind: mujoco.mjtObj, field: str, ours: type[IntEnum], theirs: type):
    """Return a function that names elements whose type MJX does not know, with this type."""

    def find(model: mujoco.MjModel) -> list[str]:
        known = {int(member) for member in ours}
        return [
            f"{element_name(model, kind, i)} ({theirs(t).name.partition('_')[2].lower()})"
            for i, t in enumerate(getattr(model, field))
            if int(t) not in known
        ]

    return find


def _when(condition: Callable[[mujoco.MjModel], bool], given: str | Callable):
    """Return a function that returns `given` if a condition on the whole model holds."""

    def find(model: mujoco.MjModel) -> list[str]:
        return [given(model) if callable(given) else given] if condition(model) else []

    return find


def _flag(member: mujoco.mjtEnableBit):
    name = member.name.removeprefix("mjENBL_").lower()
    return _when(lambda m: bool(m.opt.enableflags & member.value), f"<flag {name}='enable'/>")


def has_medium(model: mujoco.MjModel) -> bool:
    """Whether bodies move through a fluid."""
    return model.opt.density > 0 or model.opt.viscosity > 0


def has_limits(model: mujoco.MjModel) -> bool:
    """Whether a joint or tendon is limited."""
    return bool(model.jnt_limited.any() or model.tendon_limited.any())


def has_friction_loss(model: mujoco.MjModel) -> bool:
    """Whether a joint or tendon has friction loss."""
    return bool((model.dof_frictionloss > 0).any() or (model.tendon_frictionloss > 0).any())


def has_constraints(model: mujoco.MjModel) -> bool:
    """Whether any constraint can ever act."""
    return not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value and bool(
        model.neq or has_limits(model) or has_friction_loss(model) or contact_pairs(model)
    )


def _pairs(condition: Callable[[mujoco.MjModel, ContactPair, list[int]], object]):
    """Return a function that names the pairs for which a condition on the pair and both types of geom holds."""

    def find(model: mujoco.MjModel) -> Iterator[str]:
        for pair in contact_pairs(model):
            kinds = model.geom_type[[pair.geom1, pair.geom2]].tolist()
            if condition(model, pair, kinds):
                words = [mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds]
                yield " with ".join(f"{name!r} ({word})" for name, word in zip(pair.names, words, strict=True))

    return find


def _is_searched(_: mujoco.MjModel, __: ContactPair, kinds: list[int]) -> bool:
    """Return whether MJX can only find this contact by a search on distance fields."""
    known = {_GEOM.mjGEOM_SPHERE.value, _GEOM.mjGEOM_CYLINDER.value}
    return set(kinds) != known and bool(_SEARCHED.intersection(kinds)) and _SMOOTH.issuperset(kinds)


def _has_mesh_margin(model: mujoco.MjModel, pair: ContactPair, kinds: list[int]) -> bool:
    margin = model.geom_margin[[pair.geom1, pair.geom2]].sum()
    margin = model.pair_margin[pair.explicit] if pair.explicit >= 0 else margin
    return bool(margin) and bool(_SHAPED.intersection(kinds))


def _undecided(model: mujoco.MjModel) -> list[str]:
    """Name what touches or not by rounding alone: in the reference pose the gap is zero, and no coordinate moves it."""
    found, far = dict[str, None](), copy.deepcopy(model)
    far.geom_margin[:] += _NEAR
    far.body_margin[:] += _NEAR
    far.pair_margin[:] += 2 * _NEAR
    data, rates = mujoco.MjData(far), np.zeros((2, 3, model.nv))
    mujoco.mj_fwdPosition(far, data)
    for contact in data.contact:
        if contact.exclude in (0, 1) and abs(contact.dist - contact.includemargin + 2 * _NEAR) < _ROUNDING:
            for geom, rate in zip(contact.geom.tolist(), rates, strict=True):
                mujoco.mj_jac(far, data, rate, None, contact.pos, model.geom_bodyid[geom])
            if np.abs(contact.frame[:3] @ (rates[1] - rates[0])).max() < _ROUNDING:
                names = (element_name(model, _OBJECT.mjOBJ_GEOM, geom) for geom in contact.geom.tolist())
                found[" with ".join(names)] = None
    return list(found)


_LAWS = (
    ("geom_sol{}", _OBJECT.mjOBJ_GEOM),
    ("pair_sol{}", _OBJECT.mjOBJ_PAIR),
    ("jnt_sol{}", _OBJECT.mjOBJ_JOINT),
    ("dof_sol{}", _OBJECT.mjOBJ_DOF),
    ("eq_sol{}", _OBJECT.mjOBJ_EQUALITY),
    ("tendon_sol{}_lim", _OBJECT.mjOBJ_TENDON),
    ("tendon_sol{}_fri", _OBJECT.mjOBJ_TENDON),
)


def _laws(part: str, condition: Callable[[np.ndarray], np.ndarray]):
    """Return a function that names the elements for whose `solref` or `solimp` a condition holds."""

    def find(model: mujoco.MjModel) -> Iterator[str]:
        for field, kind in ((name.format(part), kind) for name, kind in _LAWS):
            rows = getattr(model, field)
            for i in np.flatnonzero(condition(rows)).tolist():
                numbers = " ".join(f"{x:g}" for x in rows[i, :3])
                yield f"{numbers} in {field} of {element_name(model, kind, i)}"

    return find


def _varies_over_no_width(solimp: np.ndarray) -> np.ndarray:
    """Return where C MuJoCo takes the mean impedance at every depth, MJX the largest."""
    ends = np.clip(solimp[:, :2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    return (solimp[:, 2] <= mujoco.mjMINVAL) & (ends[:, 0] != ends[:, 1])


def _disabled_actuators(model: mujoco.MjModel) -> np.ndarray:
    group = model.actuator_group
    in_range = (group >= 0) & (group < 31)
    return in_range & ((model.opt.disableactuator >> np.clip(group, 0, 30)) & 1).astype(bool)


_DIRECTLY = "remove it from the MJCF"
_LINEAR = "keep the linear coefficient only"

# The part of an actuator, its field, the kinds that MJX knows, all kinds, and the remedy.
ACTUATORS = (
    ("transmission", "actuator_trntype", mjx.TrnType, mujoco.mjtTrn, "drive a joint, tendon or site instead"),
    ("dynamics", "actuator_dyntype", mjx.DynType, mujoco.mjtDyn, "use none, integrator, filter, filterexact or muscle"),
    ("gain", "actuator_gaintype", mjx.GainType, mujoco.mjtGain, "use fixed, affine or muscle"),
    ("bias", "actuator_biastype", mjx.BiasType, mujoco.mjtBias, "use none, affine or muscle"),
)
# The missing feature; a function that names its uses in a model; the remedy.
REFUSALS: tuple[tuple[str, Callable[[mujoco.MjModel], Iterable[str]], str], ...] = (
    ("flexible bodies", _where(_OBJECT.mjOBJ_FLEX, lambda m: np.ones(m.nflex, bool)),
     "build them of rigid bodies and joints"),
    ("plugins", _where(_OBJECT.mjOBJ_PLUGIN, lambda m: np.ones(m.nplugin, bool)),
     "remove them, or replace signed distance fields by meshes or primitive geoms"),
    ("collision between some types of geom", _pairs(lambda _, __, kinds: not has_collision_fn(*kinds)),  # pyright: ignore[reportArgumentType]
     "exclude the pair by contype and conaffinity or <contact><exclude>, or use capsules, spheres or boxes"),
    # In dm_control's finger, with two ellipsoids, the derivative of a search is 2000 times the slope; elsewhere it is NaN.
    ("exact contact of cylinders and ellipsoids with each other and capsules, and of ellipsoids with spheres",
     _pairs(_is_searched),
     "use capsules, spheres or boxes, or exclude the pair by contype and conaffinity or <contact><exclude>"),
    ("margin in contacts of meshes and height fields", _pairs(_has_mesh_margin), "set margin='0' on both geoms"),
    ("such integrator",
     _when(lambda m: m.opt.integrator in (_INTEGRATOR.mjINT_IMPLICIT, _INTEGRATOR.mjINT_DISCRETE),
           lambda m: f"integrator={_INTEGRATOR(m.opt.integrator).name.removeprefix('mjINT_').lower()!r}"),
     "use 'implicitfast', 'Euler' or 'RK4'"),
    ("override of contact parameters", _flag(_ENABLE.mjENBL_OVERRIDE),
     "write o_solref, o_solimp, o_friction and half of o_margin into <default><geom>"),
    ("exact constraint diagonal", _flag(_ENABLE.mjENBL_DIAGEXACT), _DIRECTLY),
    ("IPC contact", _flag(_ENABLE.mjENBL_IPC), _DIRECTLY),
    ("noslip solver",
     _when(lambda m: m.opt.noslip_iterations > 0,
           lambda m: f"noslip_iterations={m.opt.noslip_iterations}"),
     "set noslip_iterations='0', and against slip use cone='elliptic' with a larger impratio"),
    ("polynomial joint stiffness", _where(_OBJECT.mjOBJ_JOINT, lambda m: m.jnt_stiffnesspoly != 0), _LINEAR),
    ("polynomial joint damping", _where(_OBJECT.mjOBJ_JOINT, lambda m: (m.dof_dampingpoly != 0)[m.jnt_dofadr]), _LINEAR),
    ("polynomial tendon stiffness or damping",
     _where(_OBJECT.mjOBJ_TENDON, lambda m: np.hstack([m.tendon_stiffnesspoly, m.tendon_dampingpoly]) != 0),
     "keep the linear coefficients only"),
    ("armature or damping of an actuator",
     _where(_OBJECT.mjOBJ_ACTUATOR,
            lambda m: np.column_stack([m.actuator_armature, m.actuator_damping, m.actuator_dampingpoly]) != 0),
     "give them, times gear², to its joint or tendon, with linear coefficients only"),
    ("surface velocity", _where(_OBJECT.mjOBJ_GEOM, lambda m: m.geom_surfacevel != 0),
     "drive the body that carries the geom by a joint"),
    ("contact adhesion", _where(_OBJECT.mjOBJ_GEOM, lambda m: m.geom_adhesion != 0), _DIRECTLY),
    ("contact adhesion", _where(_OBJECT.mjOBJ_PAIR, lambda m: m.pair_adhesion != 0), _DIRECTLY),
    ("ellipsoid fluid model", _where(_OBJECT.mjOBJ_GEOM, lambda m: (m.geom_fluid[:, 0] > 0) & has_medium(m)),
     "use fluidshape='none' for the box model, or set density and viscosity to zero"),
    ("fluid forces with integrator 'implicitfast'",
     _when(lambda m: has_medium(m) and m.opt.integrator == _INTEGRATOR.mjINT_IMPLICITFAST,
           lambda m: f"density={m.opt.density:g}, viscosity={m.opt.viscosity:g}"),
     "use 'Euler' or 'RK4'"),
    *((f"such actuator {word}", _unknown_type(_OBJECT.mjOBJ_ACTUATOR, field, ours, theirs), remedy)
      for word, field, ours, theirs, remedy in ACTUATORS),
    ("actuators with several controls", _where(_OBJECT.mjOBJ_ACTUATOR, lambda m: m.actuator_ctrlnum != 1),
     "use one actuator per control"),
    ("disabled actuator groups", _where(_OBJECT.mjOBJ_ACTUATOR, _disabled_actuators),
     "remove those actuators, or actuatorgroupdisable from <option>"),
    ("early activation",
     _where(_OBJECT.mjOBJ_ACTUATOR, lambda m: m.actuator_actearly & (m.actuator_actadr >= 0)), "set actearly='false'"),
    ("actuator delay", _where(_OBJECT.mjOBJ_ACTUATOR, lambda m: m.actuator_history[:, 0] > 0),
     "remove delay and nsample, and delay the controls before the rollout"),
    ("such equality constraint",
     _unknown_type(_OBJECT.mjOBJ_EQUALITY, "eq_type", mjx.EqType, mujoco.mjtEq), "use connect, weld, joint or tendon"),
    ("flags that disable only springs or only dampers",
     _when(lambda m: bool(m.opt.disableflags & _DISABLE.mjDSBL_SPRING) != bool(m.opt.disableflags & _DISABLE.mjDSBL_DAMPER),
           "one of <flag spring='disable'/> and <flag damper='disable'/>"),
     "set stiffness or damping to zero instead"),
    ("impedance that rises over no width", _laws("imp", _varies_over_no_width), "give solimp a width, or equal d0 and dwidth"),
    ("solref of mixed signs", _laws("ref", lambda solref: (solref[:, 0] > 0) != (solref[:, 1] > 0)),
     "give two positive numbers (time constant, damping ratio) or two that are not (−stiffness, −damping)"),
    ("joint limit that acts on both ends at once",
     _where(_OBJECT.mjOBJ_JOINT,
            lambda m: m.jnt_limited & np.isin(m.jnt_type, _SCALAR) & (2 * m.jnt_margin > np.ptp(m.jnt_range, axis=1))),
     "make the joint's margin smaller than half its range"),
    ("tendon limit that acts on both ends at once",
     _where(_OBJECT.mjOBJ_TENDON, lambda m: m.tendon_limited & (2 * m.tendon_margin > np.ptp(m.tendon_range, axis=1))),
     "make the tendon's margin smaller than half its range"),
)  # fmt: skip


# Of random poses that touch, up to 60 in 100 accelerate otherwise by more than 1 %.
UNLIKE = ("contacts of meshes and height fields like C MuJoCo's", _pairs(lambda _, __, kinds: _SHAPED.intersection(kinds)),
          "load it with engine='mjx' to have MJX's own")  # fmt: skip
PARALLEL = ("second contact of capsules that are exactly parallel", _pairs(lambda _, __, kinds: set(kinds) == {_CAPSULE}),
            "C MuJoCo has it")  # fmt: skip
UNDECIDED = ("rounding like C MuJoCo's, which alone decides whether these touch", _undecided,
             "lift or sink one of them by a micrometre")  # fmt: skip


def refusal_messages(model: mujoco.MjModel, refusals: Iterable[tuple] = REFUSALS) -> list[str]:
    """Return one sentence per feature that MJX cannot simulate."""
    messages = []
    for feature, find, remedy in refusals:
        if found := list(find(model)):
            more = f" and {len(found) - 4} more" if len(found) > 4 else ""
            messages.append(f"MJX has no {feature}, got {', '.join(found[:4])}{more}; {remedy}")
    return messages
