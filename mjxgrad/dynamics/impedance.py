"""The impedance of constraint rows: how much of what they ask for they get."""

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.dynamics.known import is_known_to_be


class Impedance(eqx.Module):
    """Impedance of rows; arrays of their own, since two of the three do not depend on the state.

    Attributes:
        present: d(r).
        full: dw, from the width on.
        onset: d0, at r = 0.
    """

    present: Float[Array, "*rows"]
    full: Float[Array, "*rows"]
    onset: Float[Array, "*rows"]


def is_square(*solimps: Float[Array | np.ndarray, "_ 5"]) -> bool:
    """Return whether the power laws of a model's rows are known to be parabolas."""
    return all(is_known_to_be(2.0, solimp, column=4) for solimp in solimps)


def impedance(solimp: Float[Array, "*n 5"], violation: Float[Array, "*n"], *, is_square: bool = False) -> Impedance:
    """Return d: from d0 at r = 0 to dw at the width, along two power laws that meet at the midpoint.

    Args:
        solimp: MuJoCo's five numbers.
        violation: r (m or rad).
        is_square: whether the power is known to be two, MuJoCo's default; a square takes a tenth of the time.
    """
    smallest = jnp.clip(solimp[..., 0], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    largest = jnp.clip(solimp[..., 1], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    width = jnp.maximum(solimp[..., 2], mujoco.mjMINVAL)
    middle = jnp.clip(solimp[..., 3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    power = jnp.maximum(solimp[..., 4], 1.0)
    # Beyond the width the powers are evaluated where they are finite and thrown away.
    is_inside = jnp.abs(violation) < width
    x = jnp.where(is_inside, jnp.abs(violation) / width, 0.5)
    is_lower = x < middle
    part = jnp.where(is_lower, middle, 1 - middle)
    share = jnp.where(is_lower, x, 1 - x) / part
    climb = part * (share**2 if is_square else share**power)
    inside = smallest + (largest - smallest) * jnp.where(is_lower, climb, 1 - climb)
    return Impedance(jnp.where(is_inside, inside, largest), largest, smallest)
