"""Parts of a step that a scene's motion does not need, and the reasons."""

from dataclasses import dataclass

import mujoco

from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene.refusals import has_friction_loss, has_limits, has_medium

_DISABLE = mujoco.mjtDisableBit
_EULERDAMP = _DISABLE.mjDSBL_EULERDAMP.value
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
    """Work that a step of this scene leaves out.

    Attributes:
        what: the stage.
        reason: why the motion does not need it.
    """

    what: str
    reason: str


def switch_off(model: mujoco.MjModel) -> tuple[Omission, ...]:
    """Switch off the parts that a scene does not need, and return all omissions of its step.

    Most stages cost nothing once the model has no element for them, since their arrays have no rows. XLA removes what is
    computed for reading only from a compiled rollout. One flag is set in place: Euler integration would factorise the mass
    matrix a second time for zero damping.
    """
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
