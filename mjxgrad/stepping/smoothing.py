r"""Contacts and limits averaged over noise on their distance, in closed form, within the solver.

Noise $w$ on the distance $r$ of a contact shifts its rows' reference acceleration, $a_\text{ref} = -B v - K d\,(r + w)$, and
decides whether there is contact at all, $r + w < 0$. The mean of each row's cost over the noise is again convex and has a closed
form, so the same solve finds the acceleration.
What is averaged is thus the step's contact law and not the motion.

As the length goes to zero the step tends to MuJoCo's own, gate included. The gate matters: a row without it
(`gated=False`) acts wherever $J a - a_\text{ref} + K d w < 0$, touching or not, and its damping brakes bodies that
approach from as far as $2 \zeta |v| / \omega$: 4 cm at 1 m/s with MuJoCo's default contact. It is the row that
interior-point and barrier methods smooth.

A row has x = J a + B J v + c r with c = K d(r), and pushes with -D x where x < 0 and r < 0. Noise w on r makes that
x + c w and r + w. With ρ the noise's density, P its distribution function and S its softened ramp, in units of its
length (see `kernels`), the mean push is

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
import functools
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import as_float, is_known
from mjxgrad._mjx import mjx
from mjxgrad.contact.collision import CONVEX, are, is_blind
from mjxgrad.contact.law import impedance, stiffness_damping
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.solver.constraint import Noise, RowLayout
from mjxgrad.solver.kernels import KERNELS, Kernel
from mjxgrad.stepping.rows import Block, per_row

Mode = Literal["forward", "backward"]

# Far below the stiffness of any contact (1/s²). Without stiffness noise on the distance does nothing, and c divides.
_SOFTEST = 1e-3
# Inverse inertia of a slot without contact (1/kg), so large that no force is left; an infinite one would have no
# derivative.
_WEIGHTLESS = 1e30


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

    length: Float[Array, "..."] = eqx.field(converter=as_float)
    # Plain strings, so that a name that there is not meets the check below, which knows the choices.
    kernel: str = eqx.field(static=True, default="gaussian")
    mode: str = eqx.field(static=True, default="forward")
    limit_length: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None, kw_only=True)
    gated: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        """Refuse names that there are not, and lengths that are not positive and finite if they are known."""
        for name, choices in (("kernel", tuple(KERNELS)), ("mode", get_args(Mode))):
            if (given := getattr(self, name)) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {given!r}")
        without = "for a step without smoothing give smoothing=None"
        for name, remedy in (("length", without), ("limit_length", "None leaves limits alone")):
            value = getattr(self, name)
            if is_known(value) and not np.all((np.asarray(value) > 0) & np.isfinite(value)):
                raise ValueError(f"{name} must be positive and finite, got {np.asarray(value)!s}: {remedy}")

    @property
    def noise(self) -> Kernel:
        """The kernel itself, in units of the length."""
        return KERNELS[self.kernel]

    def check(self, _: str) -> None:
        """Refuse what a single step cannot take."""
        for name in ("length", "limit_length"):
            value = getattr(self, name)
            if value is not None and value.ndim:
                raise ValueError(f"{name} must be one value for a step, got shape {value.shape}: sweep under jax.vmap")


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
    geoms = np.array([(pair.geom1, pair.geom2) for pair in pairs], int).reshape(-1, 2)
    blind = [str(pairs[i]) for i in np.flatnonzero(is_blind(model, geoms))]
    if blind:
        shown = ", ".join(blind[:4]) + (f" and {len(blind) - 4} more" if len(blind) > 4 else "")
        messages.append(
            f"smoothing gives no force at a distance to {shown}: MJX knows the distance of a box, mesh or height field from "
            "anything but a plane only where they overlap; build them of spheres and capsules"
        )
    is_off = int(model.opt.disableflags) & (mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    has_limits = not is_off and (np.any(model.jnt_limited) or np.any(model.tendon_limited))
    if smoothing.limit_length is not None and not has_limits:
        messages.append("limit_length has no effect: no joint or tendon of the scene has a limit")
    return messages


def smoothed(
    model: mjx.Model, data: mjx.Data, blocks: list[Block], smoothing: Smoothing, layout: RowLayout
) -> tuple[list[Block], Noise | None, RowLayout]:
    """Return rows, present at any distance where they have noise, the noise of all rows, and their laws under noise.

    Noise has numbers without meaning for rows without, and is None, and nothing else changes, if there is nothing to be smoothed.
    """
    has_distance, num_contacts, start = _has_distance(model, data), 0, 0
    rows, noises, first = [], [], None
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
            block, noise = noisy(model, block, known, smoothing)
            first = start if first is None else first
        rows.append(block)
        noises.append(noise)
        start += count
    if first is None:
        return blocks, None, layout
    noise = Noise(*(jnp.concatenate([getattr(n, name) for n in noises]) for name in ("spread", "gate")))
    return rows, noise, dataclasses.replace(layout, kernel=smoothing.noise, first_noisy=first)


def noisy(model: mjx.Model, block: Block, known: Bool[Array, " groups"], smoothing: Smoothing) -> tuple[Block, Noise]:
    """Return a block that is present at any known distance, and its noise."""
    each, kernel = block.rows_each, smoothing.noise
    length = smoothing.length if block.is_contact else smoothing.limit_length
    assert length is not None
    length = length.astype(block.residual.dtype)
    distance = jnp.where(known, block.residual[::each], 1.0)
    # The mean of -(r + w) where it is positive (m or rad).
    resistance = impedance(block.solimp[::each], length * kernel.depth(distance / length))
    spread = functools.partial(per_row, each=each)
    stiffness = stiffness_damping(model, block.solref, block.impedance.full)[0][::each]
    rate = jnp.maximum(stiffness * resistance.present, _SOFTEST)
    gate = rate * distance if smoothing.gated else jnp.full_like(distance, -jnp.inf)
    is_present, impedances = spread(known), jax.tree.map(spread, resistance)
    weight = jnp.where(is_present, block.inverse_weight, _WEIGHTLESS)
    present = dataclasses.replace(block, impedance=impedances, inverse_weight=weight, is_active=is_present)
    return present, Noise(spread(rate * length), spread(gate))


def _has_distance(model: mjx.Model, data: mjx.Data) -> Bool[Array, " contacts"]:
    contact = data._impl.contact
    if not np.isin(model.geom_type, CONVEX).any() or not len(contact.dist):
        return jnp.ones(len(contact.dist), bool)
    # Of a ball on a box it is known, and of no interest beyond a metre.
    return ~(jnp.any(are(model, contact.geom, CONVEX), axis=1) & (contact.dist >= 1))
