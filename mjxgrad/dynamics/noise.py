r"""Rows of contacts and limits under noise on their distance.

A row has x = J a + B J v + c r with c = K d(r), and pushes with -D x where x < 0 and r < 0. Noise w on r makes that
x + c w and r + w. With ρ the noise's density, P its distribution function and S its softened ramp, in units of its
length (see `smoothing.kernels`), the mean push is

    F(x) = -D ∫_{w < W} (x + c w) ρ(w) dw,        W = min(-r, -x/c),

that is D c S(x/c) while x > c r, and from there on downwards the tangent to that: noise-free parts of x that are
positive mean a row that lets go before the bodies part, negative ones a row that pushes until they do. The cost is a
mean of convex functions of a, so the problem stays convex, and the rows need nothing but the two numbers of
`constraint.Noise`, spread = c times length, gate = c r. The edges of a pyramid share their noise, which changes
nothing, since the mean of a sum is the sum of the means; cones: see `constraint`.

Two of a row's parameters depend on depth themselves, through the impedance: the weight D and c. They are taken at one
depth, the mean of -(r + w) where it is positive. For bodies in contact this is their depth as the length goes to zero;
for bodies apart it is about how far noise drives them into each other when it does. (At the mean distance itself,
contacts whose impedance begins at zero would have no force at a distance at all.)

MJX knows the distance of boxes, meshes and height fields only where they overlap, and says 1 or more elsewhere: such
slots have no rows.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.contact.law import impedance, stiffness_damping
from mjxgrad.dynamics.block import Block
from mjxgrad.dynamics.constraint import Noise, RowLayout
from mjxgrad.smoothing import Kernel, Smoothing

# Far below the stiffness of any contact (1/s²). Without stiffness noise on the distance does nothing, and c divides.
_SOFTEST = 1e-3
# Inverse inertia of a slot without contact (1/kg), so large that no force is left; an infinite one would have no
# derivative.
_WEIGHTLESS = 1e30


def smoothed(
    model: mjx.Model, data: mjx.Data, blocks: list[Block], smoothing: Smoothing, layout: RowLayout
) -> tuple[list[Block], Noise | None, RowLayout]:
    """Return rows, their noise and their laws under noise.

    Args:
        model: with the solver's options.
        data: with contacts.
        blocks: the rows of this state.
        smoothing: which noise, and on what.
        layout: the laws of the rows without noise.

    Returns:
        The rows, present at any distance where they have noise; the noise of all rows, with numbers without meaning
        where there is none; the laws. Noise is None, and nothing else changes, if there is nothing to be smoothed.
    """
    has_distance, num_contacts = _has_distance(model, data), 0
    rows, noises, first = [], [], None
    start = 0
    for block in blocks:
        each, count = block.rows_each, len(block.residual)
        length = smoothing.length if block.is_contact else smoothing.limit_length
        if not each or length is None:
            noise = Noise(jnp.ones_like(block.residual), jnp.zeros_like(block.residual))
        else:
            known = jnp.ones(count // each, bool)
            if block.is_contact:
                known = has_distance[num_contacts : num_contacts + count // each]
                num_contacts += count // each
            block, noise = _noisy(model, block, known, length.astype(block.residual.dtype), smoothing)
            first = start if first is None else first
        rows.append(block)
        noises.append(noise)
        start += count
    if first is None:
        return blocks, None, layout
    noise = Noise(*(jnp.concatenate([getattr(n, name) for n in noises]) for name in ("spread", "gate")))
    return rows, noise, dataclasses.replace(layout, kernel=smoothing.noise, first_noisy=first)


def noisy_rows(
    model: mjx.Model, block: Block, smoothing: Smoothing, layout: RowLayout
) -> tuple[Block, Noise, RowLayout]:
    """Return contact rows under noise that are a whole problem's, as `smoothed` does; all at a known distance."""
    known = jnp.ones(len(block.residual) // block.rows_each, bool)
    block, noise = _noisy(model, block, known, smoothing.length.astype(block.residual.dtype), smoothing)
    return block, noise, dataclasses.replace(layout, kernel=smoothing.noise, first_noisy=0)


def _noisy(
    model: mjx.Model, block: Block, known: Bool[Array, " groups"], length: Float[Array, ""], smoothing: Smoothing
) -> tuple[Block, Noise]:
    """Return a block that is present at any known distance, and its noise."""
    each, kernel = block.rows_each, smoothing.noise
    distance = jnp.where(known, block.residual[::each], 1.0)
    depth = _depth(kernel, distance, length)
    resistance = impedance(block.solimp[::each], depth)

    def spread(x: Array) -> Array:
        return jnp.repeat(x, each, axis=0, total_repeat_length=len(block.residual))

    stiffness = stiffness_damping(model, block.solref, block.impedance.full)[0][::each]
    rate = jnp.maximum(stiffness * resistance.present, _SOFTEST)
    gate = rate * distance if smoothing.gated else jnp.full_like(distance, -jnp.inf)
    is_known = spread(known)
    present = eqx.tree_at(
        lambda b: (b.impedance, b.inverse_weight, b.is_active),
        block,
        (jax.tree.map(spread, resistance), jnp.where(is_known, block.inverse_weight, _WEIGHTLESS), is_known),
    )
    return present, Noise(spread(rate * length), spread(gate))


def _depth(kernel: Kernel, distance: Float[Array, " groups"], length: Float[Array, ""]) -> Float[Array, " groups"]:
    """Return the mean of -(r + w) where it is positive (m or rad)."""
    return length * kernel.depth(distance / length)


def _has_distance(model: mjx.Model, data: mjx.Data) -> Bool[Array, " contacts"]:
    contact = data._impl.contact
    convex = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
    is_convex = np.isin(model.geom_type, [int(kind) for kind in convex])
    if not is_convex.any() or not len(contact.dist):
        return jnp.ones(len(contact.dist), bool)
    # Of a ball on a box it is known, and of no interest beyond a metre.
    return ~(jnp.any(jnp.asarray(is_convex)[contact.geom], axis=1) & (contact.dist >= 1))
