r"""Contacts averaged over noise on their distance, in closed form, within the solver.

Noise $w$ on the distance $r$ of a contact shifts its rows' reference acceleration, $a_\text{ref} = -B v - K d\,(r + w)$, and
decides whether there is contact at all, $r + w < 0$. The average is over the step's contact law, not over the motion. As the
length goes to zero the step tends to MuJoCo's own. (Without the gate, as in barrier methods, damping would brake approaching
bodies from as far as $2 \zeta |v| / \omega$.)

A row has x = J a + B J v + c r with c = K d(r), and the force -D x where x < 0 and r < 0. Noise turns these into x + c w and r +
w. With ρ the noise's density and S its softened ramp, in units of its length (see `solver.noise`), the mean force is

    F(x) = -D ∫_{w < W} (x + c w) ρ(w) dw,        W = min(-r, -x/c).

This is D c S(x/c) while x > c r, and its tangent at x = c r below that. The cost is a mean of convex functions of a, so the same
solve finds the acceleration. The rows need two numbers, `constraint.Noise`: spread = c times length, and gate = c r. The edges of
a pyramid share their noise. For cones see `constraint`.

The weight D and c also depend on depth, through the impedance. They are taken at the mean of -(r + w) given that it is positive.
MJX knows the distance of boxes, meshes and height fields only where they overlap, and reports 1 or more elsewhere: such slots
have no rows.
"""

import dataclasses
import functools
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import Legible, as_float, is_known, one_of
from mjxgrad._mjx import mjx
from mjxgrad.contact.collision import CONVEX, are, is_blind
from mjxgrad.contact.law import impedance, stiffness_damping
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.solver.constraint import Noise, RowLayout
from mjxgrad.solver.noise import KERNELS
from mjxgrad.stepping.rows import Block

Mode = Literal["forward", "backward"]

# Far below the stiffness of any contact (1/s²): c is a divisor, and at zero stiffness noise on the distance has no effect.
_SOFTEST = 1e-3
# Inverse inertia of a slot without contact (1/kg), so large that its force vanishes; infinity would have no derivative.
_WEIGHTLESS = 1e30


class Smoothing(Legible):
    """Noise on the distance of every contact, averaged in the solver without sampling.

    A pytree whose lengths are leaves: a sweep over them is one `jax.vmap`, and the step can be differentiated by them.

    Attributes:
        length: standard deviation of Gaussian noise (m); noise of other kernels has the mean absolute value of that, 0.798
            lengths, and so the same force at the surface.
        mode: "forward" simulates the smoothed contact, with force at a distance and its derivatives. "backward" simulates
            without smoothing, and takes the derivative of the smoothed step at each visited state.
        kernel: "gaussian", whose contacts act from a few lengths away; "logistic", whose force falls off exponentially, with a
            standard deviation of 1.044 lengths; or "log_barrier", whose force falls off as 1/r and reaches everything: Student's
            t with two degrees of freedom, a standard deviation that is infinite, and a barrier weight of 2π / length².
    """

    length: Float[Array, "..."] = eqx.field(converter=functools.partial(as_float, name="length"))
    # Plain strings, so that unknown names reach the check below, which lists the choices.
    mode: str = eqx.field(static=True, default="forward")
    kernel: str = eqx.field(static=True, default="gaussian")

    def __check_init__(self):
        for name, choices in (("mode", get_args(Mode)), ("kernel", tuple(KERNELS))):
            one_of(name, getattr(self, name), choices)
        if is_known(self.length) and not np.all((np.asarray(self.length) > 0) & np.isfinite(self.length)):
            remedy = "for MuJoCo's own motion take mg.Discrete()"
            raise ValueError(f"length must be positive and finite, got {np.asarray(self.length)!s}: {remedy}")

    def density(self, noise: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        r"""Return the density of the noise that contacts are averaged over (1/m).

        Without motion the force at a distance $r$ is $k \,\mathbb{E} \max(-r - w, 0)$, with $k$ the contact's stiffness. So
        the density at $w$ is the force's second derivative at $r = -w$, over $k$. `solver.noise` has the formulas.

        Args:
            noise: noise on the distance (m).
        """
        return KERNELS[self.kernel].density(noise / self.length) / self.length


def smoothing_warnings(model: mjx.Model) -> list[str]:
    """Return one sentence for each part of a model that a smoothing does not affect; only its static structure is read."""
    messages = []
    pairs = contact_pairs(model)
    if not pairs:
        messages.append("smoothing has no effect: no two geoms of the scene can touch")
    geoms = np.array([(pair.geom1, pair.geom2) for pair in pairs], int).reshape(-1, 2)
    blind = [str(pairs[i]) for i in np.flatnonzero(is_blind(model, geoms))]
    if blind:
        shown = ", ".join(blind[:4]) + (f" and {len(blind) - 4} more" if len(blind) > 4 else "")
        messages.append(
            f"smoothing gives no force at a distance to {shown}: the distance of two boxes, or of a mesh or height field, is "
            "known only where they overlap; build them of spheres and capsules"
        )
    return messages


def smoothed(
    model: mjx.Model, data: mjx.Data, blocks: list[Block], smoothing: Smoothing, layout: RowLayout
) -> tuple[list[Block], Noise | None, RowLayout]:
    """Return rows, the noise of all rows, and their layout under noise; rows with noise are active at any distance."""
    # For rows without noise its numbers are not used. If no row is smoothed, noise is None and the rest is unchanged.
    contact, start = data._impl.contact, 0
    has_distance = jnp.ones(len(contact.dist), bool)
    if np.isin(model.geom_type, CONVEX).any() and len(contact.dist):
        # A ball on a box has a known distance, but beyond a metre it does not matter.
        has_distance = ~(jnp.any(are(model, contact.geom, CONVEX), axis=1) & (contact.dist >= 1))
    rows, noises, first = [], [], None
    for block in blocks:
        if block.slots is None:
            noise = Noise(jnp.ones_like(block.residual), jnp.zeros_like(block.residual))
        else:
            block, noise = noisy(model, block, has_distance[slice(*block.slots)], smoothing)
            first = start if first is None else first
        rows.append(block)
        noises.append(noise)
        start += len(block.residual)
    if first is None:
        return blocks, None, layout
    noise = Noise(*(jnp.concatenate([getattr(n, name) for n in noises]) for name in ("spread", "gate")))
    return rows, noise, dataclasses.replace(layout, first_noisy=first, kernel=KERNELS[smoothing.kernel])


def noisy(model: mjx.Model, block: Block, known: Bool[Array, " groups"], smoothing: Smoothing) -> tuple[Block, Noise]:
    """Return a block of contacts that is active at any known distance, and its noise."""
    each, length = block.rows_each, smoothing.length.astype(block.residual.dtype)
    distance = jnp.where(known, block.residual[::each], 1.0)
    # Impedance at the mean of -(r + w) given that it is positive (m).
    resistance = impedance(block.solimp[::each], length * KERNELS[smoothing.kernel].depth(distance / length))
    spread = functools.partial(jnp.repeat, repeats=each, axis=0)
    stiffness = stiffness_damping(model, block.solref, block.impedance.full)[0][::each]
    rate = jnp.maximum(stiffness * resistance.present, _SOFTEST)
    is_present, impedances = spread(known), jax.tree.map(spread, resistance)
    weight = jnp.where(is_present, block.inverse_weight, _WEIGHTLESS)
    present = dataclasses.replace(block, impedance=impedances, inverse_weight=weight, is_active=is_present)
    return present, Noise(spread(rate * length), spread(rate * distance))
