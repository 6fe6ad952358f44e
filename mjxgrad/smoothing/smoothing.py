r"""What to average over in the solver: which noise on the distance of every contact, and what for.

Noise $w$ on the distance $r$ of a contact shifts its rows' reference acceleration, $a_\text{ref} = -B v - K d\,(r + w)$, and
decides whether there is contact at all, $r + w < 0$. The mean of each row's cost over the noise is again convex and has a closed
form, so the same solve finds the acceleration (see `dynamics.noise` for the formulas).
What is averaged is thus the step's contact law and not the motion. Impedance and damping stay at their values at one
depth: that of the contact as it is on average where there is contact at all.

As the length goes to zero the step tends to MuJoCo's own, gate included. The gate matters: a row without it
(`gated=False`) acts wherever $J a - a_\text{ref} + K d w < 0$, touching or not, and its damping brakes bodies that
approach from as far as $2 \zeta |v| / \omega$: 4 cm at 1 m/s with MuJoCo's default contact. It is the row that
interior-point and barrier methods smooth.
"""

from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.smoothing.kernels import KERNELS, Kernel

KernelName = Literal["gaussian", "logistic", "log_barrier"]
Mode = Literal["forward", "backward"]


def _as_length(value: Any) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


def _as_optional_length(value: Any) -> Array | None:
    return None if value is None else _as_length(value)


class Smoothing(eqx.Module):
    """Noise on the distance of every contact, averaged in the solver without sampling.

    A pytree whose lengths are leaves: a sweep over them is one `jax.vmap`, and the step can be differentiated by them.

    Attributes:
        length: of the noise (m): the standard deviation of the Gaussian, and for the other kernels the one that gives
            the same mean absolute value.
        kernel: "gaussian", "logistic" or "log_barrier"; see `kernels`. The first two reach some lengths far, the last
            one falls off as 1/r.
        mode: "forward" moves by the smoothed contact: force at a distance, and derivatives to match. "backward" moves
            as without smoothing, and takes the derivative of the smoothed step at each state that is visited.
        limit_length: likewise for the limits of joints and tendons, in their own units (m or rad); None leaves them as
            they are. Apart from contacts, since no one length fits metres and radians.
        gated: whether noise decides on contact, too, as in MuJoCo; without that, rows act at any distance.
    """

    length: Float[Array, "..."] = eqx.field(converter=_as_length)
    # Plain strings, so that a name that there is not meets the check below, which knows the choices.
    kernel: str = eqx.field(static=True, default="gaussian")
    mode: str = eqx.field(static=True, default="forward")
    limit_length: Float[Array, "..."] | None = eqx.field(converter=_as_optional_length, default=None, kw_only=True)
    gated: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        """Refuse names that there are not, and lengths without meaning if they are known.

        Raises:
            ValueError: if a length is not positive and finite, or there is no such kernel or mode.
        """
        for name, choices in (("kernel", get_args(KernelName)), ("mode", get_args(Mode))):
            if (given := getattr(self, name)) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {given!r}")
        remedies = {
            "length": "for a step without smoothing give smoothing=None",
            "limit_length": "None leaves limits alone",
        }
        for name, remedy in remedies.items():
            value = getattr(self, name)
            if not _is_known(value):
                continue
            known = np.asarray(value)
            if not np.all((known > 0) & np.isfinite(known)):
                raise ValueError(f"{name} must be positive and finite, got {known!s}: {remedy}")

    @property
    def noise(self) -> Kernel:
        """The kernel itself, in units of the length."""
        return KERNELS[self.kernel]

    def check(self, gradient: str) -> None:
        """Refuse what a single step cannot take.

        Raises:
            ValueError: if a length has a leading axis, or the event correction is asked for, too.
        """
        for name in ("length", "limit_length"):
            value = getattr(self, name)
            if value is not None and value.ndim:
                raise ValueError(f"{name} must be one value for a step, got shape {value.shape}: sweep under jax.vmap")
        if gradient == "event":
            raise ValueError(
                "gradient must be 'discrete' with smoothing, got 'event': the derivative of a smoothed contact already knows "
                "that its time moves; smooth limits by limit_length"
            )


def smoothing_warnings(smoothing: Smoothing, model: mjx.Model) -> list[str]:
    """Say which parts of a smoothing have no effect on a model.

    Args:
        smoothing: as given to a step or rollout.
        model: of MJX; only its static structure is read.

    Returns:
        Sentences that name what is not smoothed; none if everything is.
    """
    messages = []
    pairs = contact_pairs(model)
    if not pairs:
        messages.append(f"smoothing of {smoothing.kernel} contact has no effect: no two geoms of the scene can touch")
    blind = [str(pair) for pair in pairs if _is_blind(model, pair.geom1, pair.geom2)]
    if blind:
        shown = ", ".join(blind[:4]) + (f" and {len(blind) - 4} more" if len(blind) > 4 else "")
        messages.append(
            f"smoothing gives no force at a distance to {shown}: MJX knows the distance of a box, mesh or height field from "
            "anything but a plane only where they overlap; build them of spheres and capsules"
        )
    if smoothing.limit_length is not None and not has_limits(model):
        messages.append("limit_length has no effect: no joint or tendon of the scene has a limit")
    return messages


def has_limits(model: mjx.Model) -> bool:
    """Whether some joint or tendon has a limit that acts."""
    if int(model.opt.disableflags) & (mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return False
    return bool(np.any(model.jnt_limited) or np.any(model.tendon_limited))


def _is_blind(model: mjx.Model, geom1: int, geom2: int) -> bool:
    kinds = {int(model.geom_type[geom1]), int(model.geom_type[geom2])}
    return bool(kinds & _CONVEX) and int(mujoco.mjtGeom.mjGEOM_PLANE) not in kinds and kinds != _BALL_ON_BOX


_BALL_ON_BOX = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_BOX)}
_CONVEX = {int(kind) for kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)}


def _is_known(value: Array | None) -> bool:
    # A tree of other things than numbers (axes of vmap, shapes) goes through the constructor, too.
    return isinstance(value, jax.Array | np.ndarray) and not isinstance(value, jax.core.Tracer)
