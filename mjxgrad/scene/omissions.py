"""Parts of a step that a scene's motion does not need, and the reasons."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene.refusals import has_friction_loss, has_limits, has_medium

_DISABLE = mujoco.mjtDisableBit
_EULERDAMP = _DISABLE.mjDSBL_EULERDAMP.value


@dataclass(frozen=True)
class Omission:
    """Work that a step of this scene leaves out.

    Attributes:
        what: the stage, or the elements.
        reason: why the motion does not need it.
    """

    what: str
    reason: str


def switch_off(model: mujoco.MjModel) -> tuple[Omission, ...]:
    """Switch off the parts that a scene does not need, and return all omissions of its step.

    Most stages cost nothing once the model has no element for them, since their arrays have no
    rows. XLA removes computations for reading only from a compiled rollout, which carries nothing
    but the state. One flag is set in place: Euler integration would factorise the mass matrix a
    second time for zero damping.
    """
    omissions = tuple(Omission(what, reason) for what, find in _TABLE if (reason := find(model)))
    if _has_needless_eulerdamp(model):
        model.opt.disableflags |= _EULERDAMP
    return omissions


def _absent(absence: str, is_there: Callable[[mujoco.MjModel], bool], flag=None):
    """Return the omission of a stage without elements, or with a disabled flag."""

    def reason(model: mujoco.MjModel) -> str | None:
        if flag is not None and model.opt.disableflags & flag.value:
            name = flag.name.removeprefix("mjDSBL_").lower()
            return f"the file disables the flag {name}"
        return None if is_there(model) else absence

    return reason


def _counted(count: Callable[[mujoco.MjModel], int], reason: str):
    """Return the omission of some elements, with their number."""

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
    """Return the number of sites at which no tendon, actuator or equality constraint acts."""
    wrap = mujoco.mjtWrap
    acts = (
        np.isin(model.wrap_type, [wrap.mjWRAP_SITE, wrap.mjWRAP_SPHERE, wrap.mjWRAP_CYLINDER]).any()
        or (model.eq_objtype == mujoco.mjtObj.mjOBJ_SITE).any()
        or (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).any()
    )
    return 0 if acts else model.nsite


def _num_render_meshes(model: mujoco.MjModel) -> int:
    """Return the number of meshes without colliding instance."""
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
