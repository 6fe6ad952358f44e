r"""How deep a contact rests, for any impedance profile.

Under a force that would give its bodies the acceleration $a_0$ towards each other, a contact at rest has
$K d(\rho)^2 \rho / (1 - d(\rho)) = c\,a_0$, with $\rho$ the depth below the distance at which it begins and
$K = k / d_w^2$.
The factor $c$ is 1 for frictionless contacts and elliptic cones; in a pyramid the normal force is the sum of its edges,
whose regularisation MuJoCo scales with friction, and $c = \mu^2 (1 + \mu^2) / ((n - 1)\,\text{impratio})$, $n$ the
dimension of the contact: 1 only for $\mu = 1$, $n = 3$.

The left side grows with the depth, so there is one solution. Where $a_0$ is the force over MuJoCo's own estimate of
the contact's mass, at the reference pose, it is exact.

References:
    MuJoCo documentation, "Solver parameters" and "Computation", "Constraint model".
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.dynamics.impedance import impedance

# Halvings of the bracket; a Newton step ends the search.
_HALVINGS = 50


def rest_depth(
    acceleration: Float[ArrayLike, "..."], stiffness: Float[Array, "*shape"], solimp: Float[Array, "*shape 5"]
) -> Float[Array, "*shape"]:
    r"""Solve for the depth at rest; differentiable by the implicit function theorem.

    Args:
        acceleration: $c\,a_0$, in m/s²; positive.
        stiffness: $k$, in 1/s²; positive.
        solimp: five numbers, as MuJoCo's.

    Returns:
        The depth below the distance at which contact begins, in m.
    """
    acceleration = jnp.broadcast_to(jnp.asarray(acceleration, stiffness.dtype), stiffness.shape)
    largest = impedance(solimp, jnp.zeros_like(stiffness)).full
    # From the width on the impedance is constant, and the depth known.
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


def static_response(depth: Float[Array, "*shape"], solimp: Float[Array, "*shape 5"]) -> Float[Array, "*shape"]:
    r"""Give $d(\rho)^2 \rho / (d_w^2 (1 - d(\rho)))$, which the stiffness turns into an acceleration (m)."""
    profile = impedance(solimp, depth)
    return profile.present**2 * depth / (profile.full**2 * (1 - profile.present))


def compensated_stiffness(
    stiffness: Float[Array, "*shape"],
    solimp: Float[Array, "*shape 5"],
    margin: Float[Array, "*shape"],
    acceleration: Float[ArrayLike, "..."],
) -> Float[Array, "*shape"]:
    r"""Give the stiffness at which a contact with a margin rests where it would without.

    Without margin it rests at depth $\rho_0$; with margin $m$ the same place is at depth $m + \rho_0$ below the beginning of
    the force, so the stiffness must fall by the ratio of `static_response` at both. For a constant impedance $d$ that
    is $k' = (1 - d) a_0 / (m + \rho_0)$.

    Args:
        stiffness: without margin, in 1/s².
        solimp: five numbers, as MuJoCo's.
        margin: in m.
        acceleration: $c\,a_0$ under which the place of rest is kept, in m/s².

    Returns:
        One stiffness per contact, in 1/s²; never above the one given.
    """
    depth = rest_depth(acceleration, stiffness, solimp)
    return stiffness * static_response(depth, solimp) / static_response(depth + margin, solimp)
