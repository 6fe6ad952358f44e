"""What a step of a scene leaves out: what its motion does not need, and what a user lets it do without."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from mjxgrad._mjx import make_efc_type
from mjxgrad.contact.parameters import ContactPair, contact_pairs, named_pairs
from mjxgrad.scene.refusals import has_friction_loss, has_limits, has_medium

_NUM_MASK_BITS = 31  # of a signed integer, the sign left alone
_DISABLE = mujoco.mjtDisableBit
_EULERDAMP = _DISABLE.mjDSBL_EULERDAMP.value


@dataclass(frozen=True)
class Omission:
    """Work that a step of this scene does not do.

    Attributes:
        what: the stage, or the elements.
        reason: why the motion does not need it.
    """

    what: str
    reason: str


@dataclass(frozen=True)
class LeaveOut:
    """Contacts and limits that a scene is to do without, on your word.

    Whether a motion needed them after all is what `mg.check_omissions` says; `mg.diagnostics.unused` lists what
    recorded motions did not come near.

    Attributes:
        pairs: pairs of geoms by name that touch in no motion of interest.
        limits: joints by name that reach their limits in no motion of interest.
    """

    pairs: tuple[tuple[str, str], ...] = ()
    limits: tuple[str, ...] = ()


def switch_off(model: mujoco.MjModel) -> tuple[Omission, ...]:
    """Switch off what a scene does not need, and list all that a step of it leaves out.

    Most stages cost nothing once the model has no element for them, for their arrays have no
    rows, and what is computed for reading only is removed by XLA from a compiled rollout, which
    carries nothing but the state. One flag has to be set, in place: Euler integration would factorise the
    mass matrix a second time for damping that is zero.
    """
    omissions = tuple(Omission(what, reason) for what, find in _TABLE if (reason := find(model)))
    if _has_needless_eulerdamp(model):
        model.opt.disableflags |= _EULERDAMP
    return omissions


def _absent(absence: str, is_there: Callable[[mujoco.MjModel], bool], flag=None):
    """Reason for leaving out a stage: it has no elements, or its flag is disabled."""

    def reason(model: mujoco.MjModel) -> str | None:
        if flag is not None and model.opt.disableflags & flag.value:
            name = flag.name.removeprefix("mjDSBL_").lower()
            return f"the file disables the flag {name}"
        return None if is_there(model) else absence

    return reason


def _counted(count: Callable[[mujoco.MjModel], int], reason: str):
    """Reason for leaving out elements of which there are some, with their number."""

    def find(model: mujoco.MjModel) -> str | None:
        number = int(count(model))
        return f"{number}: {reason}" if number else None

    return find


def _has_needless_eulerdamp(model: mujoco.MjModel) -> bool:
    return (
        model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        and not model.opt.disableflags & _EULERDAMP
        and not model.dof_damping.any()
    )


def _touching(model: mujoco.MjModel) -> set[int]:
    return {geom for pair in contact_pairs(model) for geom in (pair.geom1, pair.geom2)}


def _num_unused_sites(model: mujoco.MjModel) -> int:
    """Sites at which no tendon, actuator or equality constraint acts."""
    wrap = mujoco.mjtWrap
    acts = (
        np.isin(model.wrap_type, [wrap.mjWRAP_SITE, wrap.mjWRAP_SPHERE, wrap.mjWRAP_CYLINDER]).any()
        or (model.eq_objtype == mujoco.mjtObj.mjOBJ_SITE).any()
        or (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).any()
    )
    return 0 if acts else model.nsite


def _num_render_meshes(model: mujoco.MjModel) -> int:
    """Meshes of which no instance collides."""
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    return model.nmesh - len({int(model.geom_dataid[g]) for g in _touching(model) if is_mesh[g]})


_TABLE: tuple[tuple[str, Callable[[mujoco.MjModel], str | None]], ...] = (
    ("tendons", _absent("none in the scene", lambda m: m.ntendon > 0)),
    ("collision detection",
     _absent("no two geoms can touch", lambda m: bool(contact_pairs(m)), _DISABLE.mjDSBL_CONTACT)),
    ("equality constraints", _absent("none in the scene", lambda m: m.neq > 0, _DISABLE.mjDSBL_EQUALITY)),
    ("friction loss", _absent("no joint or tendon has any", has_friction_loss, _DISABLE.mjDSBL_FRICTIONLOSS)),
    ("limits", _absent("no joint or tendon is limited", has_limits, _DISABLE.mjDSBL_LIMIT)),
    ("actuation", _absent("no actuators", lambda m: m.nu > 0, _DISABLE.mjDSBL_ACTUATION)),
    ("gravity compensation", _absent("no body has gravcomp", lambda m: m.ngravcomp > 0, _DISABLE.mjDSBL_GRAVITY)),
    ("fluid forces", _absent("no medium: density = viscosity = 0", has_medium)),
    ("implicit damping",
     lambda m: "no joint is damped; keep_everything=True to differentiate by dof_damping"
     if _has_needless_eulerdamp(m) else None),
    ("sensors",
     lambda m: _absent("none in the scene", lambda n: n.nsensor > 0, _DISABLE.mjDSBL_SENSOR)(m)
     or f"{m.nsensor}: not computed unless something reads them"),
    ("contact of visual geoms", _counted(lambda m: m.ngeom - len(_touching(m)), "they match no other geom")),
    ("sites", _counted(_num_unused_sites, "nothing acts at them; placed only if read")),
    ("cameras", _counted(lambda m: m.ncam, "placed only if read, and for rendering")),
    ("lights", _counted(lambda m: m.nlight, "rendering only")),
    ("textures, materials", _counted(lambda m: m.ntex + m.nmat, "rendering only")),
    ("skins", _counted(lambda m: m.nskin, "rendering only")),
    ("visual meshes", _counted(_num_render_meshes, "rendering only; no instance collides")),
    ("outputs of a step that nobody reads",
     lambda m: "a compiled rollout carries only the state, so XLA removes them"),
)  # fmt: skip


def omit(model: mujoco.MjModel, wanted: LeaveOut) -> tuple[tuple[ContactPair, ...], tuple[Omission, ...]]:
    """Leave out pairs and limits of a model, in place; return the pairs, and what was done in words.

    Raises:
        ValueError: if a name is unknown, a pair is listed as `<pair>` in the file, or there are too many different
            pairs to leave out.
    """
    rows = len(make_efc_type(model))
    everything, omitted = omit_pairs(model, wanted)
    omissions = []
    if omitted:
        more = f" + {len(omitted) - 4} more" if len(omitted) > 4 else ""
        listed = ", ".join(str(pair) for pair in omitted[:4]) + more
        omissions.append(Omission(f"contact of {len(omitted)} of {len(everything)} pairs", f"as asked: {listed}"))
    model.jnt_limited[[_limited_joint(model, name) for name in wanted.limits]] = 0
    if wanted.limits:
        omissions.append(Omission(f"{len(wanted.limits)} of the joint limits", f"as asked: {', '.join(wanted.limits)}"))
    if omissions:
        omissions.append(Omission("constraint rows", f"{len(make_efc_type(model))} remain of {rows}"))
    return omitted, tuple(omissions)


def omit_pairs(model: mujoco.MjModel, wanted: LeaveOut) -> tuple[tuple[ContactPair, ...], tuple[ContactPair, ...]]:
    """Leave out pairs of a model, in place; return all that it had and those left out. Raises ValueError as `omit` does."""
    everything = contact_pairs(model)
    omitted = named_pairs(everything, wanted.pairs, "leave_out.pairs")
    for pair in omitted:
        if pair.explicit >= 0:
            raise ValueError(
                f"leave_out.pairs must not name a pair listed as <pair> in the MJCF, got {str(pair)!r}; remove it there"
            )
    if omitted:
        keep_pairs(model, (pair for pair in everything if pair.explicit < 0 and pair not in omitted))
    return everything, omitted


def keep_pairs(model: mujoco.MjModel, kept: Iterable[ContactPair]) -> None:
    """Set `contype` and `conaffinity` in place so that of all pairs only these collide, in the same order as before.

    Geoms that collide with the same others share a bit: theirs is the type, the others have the affinity. Bits are given
    out until every pair has one, first to those that settle most pairs. What MuJoCo filters by other rules (geoms of one
    rigid body, of parent and child, excluded bodies) stays filtered, and explicit pairs, which `kept` has none of, stay as they
    are. Raises ValueError if 31 bits do not suffice.
    """
    neighbours: dict[int, set[int]] = {}
    for pair in kept:
        neighbours.setdefault(pair.geom1, set()).add(pair.geom2)
        neighbours.setdefault(pair.geom2, set()).add(pair.geom1)
    alike: dict[frozenset[int], list[int]] = {}
    for geom, others in neighbours.items():
        alike.setdefault(frozenset(others), []).append(geom)
    contype, conaffinity = np.zeros(model.ngeom, int), np.zeros(model.ngeom, int)
    unsettled = {frozenset((geom, other)) for geom, others in neighbours.items() for other in others}
    bit = 0
    while unsettled:
        if bit == _NUM_MASK_BITS:
            raise ValueError(
                f"leave_out must leave pairs that the {_NUM_MASK_BITS} bits of MuJoCo's collision masks can tell apart; "
                "name fewer pairs or all of a geom"
            )
        settled = {others: unsettled & _between(geoms, others) for others, geoms in alike.items()}
        others = max(settled, key=lambda one: len(settled[one]))
        contype[alike[others]] |= 1 << bit
        conaffinity[sorted(others)] |= 1 << bit
        unsettled -= settled[others]
        bit += 1
    model.geom_contype[:], model.geom_conaffinity[:] = contype, conaffinity


def _between(geoms: Iterable[int], others: Iterable[int]) -> set[frozenset[int]]:
    return {frozenset((geom, other)) for geom in geoms for other in others}


def _limited_joint(model: mujoco.MjModel, name: str) -> int:
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if joint >= 0 and model.jnt_limited[joint]:
        return joint
    known = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in range(model.njnt) if model.jnt_limited[j]]
    raise ValueError(
        f"leave_out.limits must name joints with limits, got {name!r}; "
        f"those that have: {', '.join(filter(None, known)) or 'none'}"
    )
