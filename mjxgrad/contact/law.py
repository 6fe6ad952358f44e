r"""The law of a contact or limit: stiffness, damping, impedance, and depth at rest.

A row with violation $r$ and rate $v$ has the reference acceleration $a_\text{ref} = -B v - K d(r) r$. The impedance $d(r)$
is the share of it that is realised: $d_0$ at $r = 0$, $d_w$ from the width on. `solref` gives $K$ and $B$, `solimp` $d$.

Under a force that would give its bodies the acceleration $a_0$ towards each other, a contact at rest has
$K d(\rho)^2 \rho / (1 - d(\rho)) = c\,a_0$, with $\rho$ the depth below the distance at which it begins and $K = k / d_w^2$.
The factor $c$ is 1 for frictionless contacts and elliptic cones. A pyramid's normal force is the sum over its edges, whose
regularisation MuJoCo scales with friction: $c = \mu^2 (1 + \mu^2) / ((n - 1)\,\text{impratio})$, $n$ the dimension of
the contact. With the default impratio of 1, $c = 1$ at $\mu = 1$, $n = 3$.
The left side grows with the depth, so there is one solution. Where $a_0$ is the force over MuJoCo's own estimate of
the contact's mass, at the reference pose, it is exact.

References:
    MuJoCo documentation, "Solver parameters" and "Computation", "Constraint model".
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._arrays import is_known_to_be
from mjxgrad._mjx import mjx

_Each = Float[Array, "*shape"]
_HALVINGS = 50  # halvings of the bracket; a Newton step ends the search


class Impedance(eqx.Module):
    """Impedances of rows: d(r) at the present violation, dw from the width on, and d0 at r = 0."""

    present: Float[Array, "*rows"]
    full: Float[Array, "*rows"]
    onset: Float[Array, "*rows"]


def is_square(*solimps: Float[Array | np.ndarray, "_ 5"]) -> bool:
    """Return whether the powers of all `solimp` are known to be two."""
    return all(is_known_to_be(2.0, solimp, column=4) for solimp in solimps)


def impedance(solimp: Float[Array, "*n 5"], violation: Float[Array, "*n"], *, is_square: bool = False) -> Impedance:
    """Return d at the violation r (m or rad), which rises from d0 to dw by two power laws that meet at the midpoint."""
    # `is_square` says that the power is known to be two, MuJoCo's default; a square takes a tenth of the time.
    smallest = jnp.clip(solimp[..., 0], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    largest = jnp.clip(solimp[..., 1], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    width = jnp.maximum(solimp[..., 2], mujoco.mjMINVAL)
    middle = jnp.clip(solimp[..., 3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    power = jnp.maximum(solimp[..., 4], 1.0)
    # Beyond the width the powers are evaluated at a harmless point and not used.
    is_inside = jnp.abs(violation) < width
    x = jnp.where(is_inside, jnp.abs(violation) / width, 0.5)
    is_lower = x < middle
    part = jnp.where(is_lower, middle, 1 - middle)
    share = jnp.where(is_lower, x, 1 - x) / part
    climb = part * (share**2 if is_square else share**power)
    inside = smallest + (largest - smallest) * jnp.where(is_lower, climb, 1 - climb)
    return Impedance(jnp.where(is_inside, inside, largest), largest, smallest)


def stiffness_damping(
    model: mjx.Model, solref: Float[Array, "*n 2"], full: Float[ArrayLike, "..."] = 1.0
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return K (1/s²) and B (1/s) from `full`, the impedance dw; with 1, k = K dw² and b = B dw, independent of dw."""
    # Each format is evaluated on valid numbers of its own, so that no infinity of the other enters the derivative. Under refsafe
    # the time constant is at least two time steps. At this bound the derivative is that of larger time constants.
    first, second = solref[..., 0], solref[..., 1]
    time_constant = jnp.where(first > 0, first, 1.0)
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        shortest = 2 * model.opt.timestep
        time_constant = jnp.where(time_constant >= shortest, time_constant, shortest)
    ratio = jnp.where(second > 0, second, 1.0)
    stiffness = jnp.where(first > 0, 1 / (full * time_constant * ratio) ** 2, -first / full**2)
    damping = jnp.where(second > 0, 2 / (full * time_constant), -second / full)
    return stiffness, damping


def rest_depth(acceleration: Float[ArrayLike, "..."], stiffness: _Each, solimp: Float[Array, "*shape 5"]) -> _Each:
    r"""Solve for the depth at rest (m) under $c\,a_0$ (m/s²) at stiffness $k$ (1/s²), both positive."""
    # It is counted from where contact begins, and differentiable by the implicit function theorem.
    acceleration = jnp.broadcast_to(jnp.asarray(acceleration, stiffness.dtype), stiffness.shape)
    largest = impedance(solimp, jnp.zeros_like(stiffness)).full
    # Beyond the width the impedance is constant, and the depth has a closed form.
    beyond = (1 - largest) * acceleration / stiffness
    upper = jnp.maximum(solimp[..., 2], beyond)

    def excess(depth: Array) -> Array:
        return stiffness * static_response(depth, solimp) - acceleration

    def halve(_: ArrayLike, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        is_shallow = excess(middle) < 0
        return jnp.where(is_shallow, middle, low), jnp.where(is_shallow, high, middle)

    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros_like(upper), upper)))
    depth = (low + high) / 2
    _, slope = jax.jvp(excess, (depth,), (jnp.ones_like(depth),))
    return depth - excess(depth) / jax.lax.stop_gradient(slope)


def static_response(depth: _Each, solimp: Float[Array, "*shape 5"]) -> _Each:
    r"""Return $d(\rho)^2 \rho / (d_w^2 (1 - d(\rho)))$, which the stiffness turns into an acceleration (m)."""
    profile = impedance(solimp, depth)
    return profile.present**2 * depth / (profile.full**2 * (1 - profile.present))


def compensated_stiffness(
    stiffness: _Each, solimp: Float[Array, "*shape 5"], margin: _Each, acceleration: Float[ArrayLike, "..."]
) -> _Each:
    r"""Return the stiffness at which a contact with a margin rests where it would rest without."""
    # Without margin the depth at rest is $\rho_0$. With margin $m$ the same place is $m + \rho_0$ below the start of
    # the force, so the stiffness must fall by the ratio of `static_response` at both. For a constant impedance $d$ that
    # is $k' = (1 - d) a_0 / (m + \rho_0)$, in 1/s², never above the given one. `acceleration` is $c\,a_0$ (m/s²).
    depth = rest_depth(acceleration, stiffness, solimp)
    return stiffness * static_response(depth, solimp) / static_response(depth + margin, solimp)
