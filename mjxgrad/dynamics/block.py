"""Constraint rows of one kind, and the impedance that they share."""

import equinox as eqx
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float


class Block(eqx.Module):
    """Constraint rows of one kind, before gating and scaling. All fields have the rows as leading axis.

    Attributes:
        jacobian: from joint velocities to the rows, also where the row is inactive.
        residual: r in a_ref (m or rad).
        impedance: d(r), and dw and d0, its values from the width on and at r = 0.
        solimp: what the impedance follows from.
        inverse_weight: Â, inverse inertia (1/kg).
        solref: stiffness and damping in MuJoCo's formats.
        margin: distance at which the row begins (m or rad).
        friction_loss: largest force of a friction loss row.
        is_active: whether the row takes part.
        rows_each: how many consecutive rows begin and end together, those of a contact or of a limit; 0 if none ever does.
        is_pyramid: whether these are the edges of a pyramid, whose mean is the normal row; otherwise the first one is.
        is_contact: whether these are contacts.
    """

    jacobian: Float[Array, "rows nv"]
    residual: Float[Array, " rows"]
    impedance: Float[Array, "rows 3"]
    solimp: Float[Array, "rows 5"]
    inverse_weight: Float[Array, " rows"]
    solref: Float[Array, "rows 2"]
    margin: Float[Array, " rows"]
    friction_loss: Float[Array, " rows"]
    is_active: Bool[Array, " rows"]
    rows_each: int = eqx.field(static=True, default=0, kw_only=True)
    is_pyramid: bool = eqx.field(static=True, default=False, kw_only=True)
    is_contact: bool = eqx.field(static=True, default=False, kw_only=True)


def impedance(solimp: Float[Array, "n 5"], violation: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Return d(r), dw and d0: from d0 at r = 0 to dw at the width, along two power laws that meet at the midpoint."""
    smallest = jnp.clip(solimp[:, 0], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    largest = jnp.clip(solimp[:, 1], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    width = jnp.maximum(solimp[:, 2], mujoco.mjMINVAL)
    middle = jnp.clip(solimp[:, 3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    power = jnp.maximum(solimp[:, 4], 1.0)
    # Beyond the width the powers are evaluated where they are finite and thrown away.
    is_inside = jnp.abs(violation) < width
    x = jnp.where(is_inside, jnp.abs(violation) / width, 0.5)
    is_lower = x < middle
    part = jnp.where(is_lower, middle, 1 - middle)
    climb = part * (jnp.where(is_lower, x, 1 - x) / part) ** power
    inside = smallest + (largest - smallest) * jnp.where(is_lower, climb, 1 - climb)
    return jnp.stack([jnp.where(is_inside, inside, largest), largest, smallest], axis=1)
