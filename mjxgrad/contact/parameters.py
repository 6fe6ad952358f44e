r"""Pairs of geoms that can touch, and their effective contact parameters.

MuJoCo derives the parameters of a contact from its two geoms (or from an explicit `<pair>`), clamps some of them and reads
`solref` in either of two formats. Here the effective values are brought to one form, in which pairs can be compared and swept.
It is the law of `contact.law` with $K = k / d_w^2$ and $B = b / d_w$, $k = \omega_0^2$ the stiffness and $b$ the damping, both
per unit of the contact's effective mass. At full impedance the contact is the oscillator
$\ddot r = -k r - b \dot r + (1 - d_w) a_0$, with $a_0$ the acceleration without contact. It rests at depth
$(1 - d_w) a_0 / k$.

References:
    MuJoCo documentation, "Solver parameters" and "Contact parameters".
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._mjx import geom_pairs, mjx
from mjxgrad.batched.maps import safe_sqrt
from mjxgrad.contact.law import rest_depth, stiffness_damping

_DISABLES_CONTACT = mujoco.mjtDisableBit.mjDSBL_CONTACT.value | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value


@dataclass(frozen=True)
class ContactPair:
    """Two geoms that MJX tests for contact.

    Attributes:
        geom1: index of the first geom; MJX orders the two by geom type.
        geom2: index of the second geom.
        explicit: index of the `<pair>` that holds the parameters, -1 if the geoms hold them.
        condim: dimension of the contact: 1, 3, 4 or 6.
        names: names of the two geoms.
    """

    geom1: int
    geom2: int
    explicit: int
    condim: int
    names: tuple[str, str]

    def __str__(self) -> str:
        return " – ".join(self.names)


Pairs = tuple[ContactPair, ...]


class ContactParameters(eqx.Module):
    r"""Effective contact parameters, one row per pair.

    Attributes:
        stiffness: $k = \omega_0^2$, in 1/s².
        damping: $b$, in 1/s.
        impedance: $d_0$ and $d_w$.
        width: penetration over which the impedance rises, in m.
        friction: two sliding, one torsional (m) and two rolling (m) coefficients.
        margin: distance at which contact begins, in m.
        pyramid: $c$ of `contact.law`, the relative compliance of a pyramid's normal direction; 1 for other cones.
        solref: `solref` as mixed by MuJoCo, before `refsafe` and before formats are resolved.
        solimp: `solimp` as mixed by MuJoCo, before it is clamped.
        timestep: time step of the model, in s.
    """

    stiffness: Float[Array, "*batch pairs"]
    damping: Float[Array, "*batch pairs"]
    impedance: Float[Array, "*batch pairs 2"]
    width: Float[Array, "*batch pairs"]
    friction: Float[Array, "*batch pairs 5"]
    margin: Float[Array, "*batch pairs"]
    pyramid: Float[Array, "*batch pairs"]
    solref: Float[Array, "*batch pairs 2"]
    solimp: Float[Array, "*batch pairs 5"]
    timestep: Float[Array, "*batch"]

    @property
    def damping_ratio(self) -> Float[Array, "*batch pairs"]:
        r"""$b / (2 \sqrt k)$; infinite without stiffness."""
        return self.damping / (2.0 * safe_sqrt(self.stiffness))

    @property
    def stability(self) -> Float[Array, "*batch pairs"]:
        """$h^2 k + 2 h b$; semi-implicit Euler is stable at full impedance while below 4."""
        timestep = self.timestep[..., None]
        return timestep**2 * self.stiffness + 2.0 * timestep * self.damping

    def rest_depth(self, acceleration: Float[ArrayLike, ""]) -> Float[Array, "*batch pairs"]:
        """Return the depth at rest below the distance at which contact begins (m); $(1 - d_w) a_0 / k$ for constant impedance.

        Without contact the bodies would approach at the acceleration $a_0$ (m/s²). For one body on the ground it is gravity, for
        a stack of n equal ones n times that. `contact.law` says when this is exact.
        """
        return rest_depth(self.pyramid * acceleration, self.stiffness, self.solimp)

    def rest_distance(self, acceleration: Float[ArrayLike, ""]) -> Float[Array, "*batch pairs"]:
        """Return the distance of the geoms at rest (m), the margin less `rest_depth`: positive where they hover."""
        return self.margin - self.rest_depth(acceleration)


def geom_name(model: mjx.Model | mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom, or of its body with the geom's place in it."""
    body = int(model.geom_bodyid[geom])
    of_body = mjx.id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body{body}"
    return mjx.id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"{of_body}[{geom - int(model.body_geomadr[body])}]"


def contact_pairs(model: mjx.Model | mujoco.MjModel) -> Pairs:
    """List the pairs of geoms that MJX tests for contact, in no particular order; none if contacts are disabled.

    Only the static structure of the model is read.
    """
    if int(model.opt.disableflags) & _DISABLES_CONTACT:
        return ()
    pairs = []
    for geom1, geom2, explicit in (map(int, pair) for pair in geom_pairs(model)):
        names = (geom_name(model, geom1), geom_name(model, geom2))
        dims = [model.geom_condim[geom] for geom in _of_most_priority(model, geom1, geom2)]
        condim = model.pair_dim[explicit] if explicit >= 0 else max(dims)
        pairs.append(ContactPair(geom1, geom2, explicit, int(condim), names))
    return tuple(pairs)


def named_pairs(pairs: Pairs, wanted: tuple[tuple[str, str], ...], what: str) -> Pairs:
    """Return the pairs with these names, in the order of `pairs`; refuse unknown names in a message about `what`."""
    known = {frozenset(pair.names) for pair in pairs}
    for names in wanted:
        if frozenset(names) not in known:
            listed = ", ".join(map(str, pairs[:20])) + (" ..." if len(pairs) > 20 else "")
            raise ValueError(
                f"{what} must name pairs of geoms that can touch, got {names!r}; those that can: {listed or 'none'}"
            )
    return tuple(pair for pair in pairs if frozenset(pair.names) in set(map(frozenset, wanted)))


def deciding_geoms(model: mjx.Model | mujoco.MjModel, pair: ContactPair) -> tuple[int, ...]:
    """Return the geoms that determine the parameters of a pair: none if it is explicit, one if that has priority."""
    return () if pair.explicit >= 0 else _of_most_priority(model, pair.geom1, pair.geom2)


def _of_most_priority(model: mjx.Model | mujoco.MjModel, *geoms: int) -> tuple[int, ...]:
    highest = max(model.geom_priority[list(geoms)])
    return tuple(geom for geom in geoms if model.geom_priority[geom] == highest)


# Compiled as one program: one operation after another takes seconds for the first scene of a kind.
@eqx.filter_jit
def contact_parameters(model: mjx.Model, pairs: Pairs) -> ContactParameters:
    """Compute the effective parameters of pairs, one row each.

    Differentiable with respect to the model's leaves, and traceable.
    """
    solref, solimp, friction, margin = _mix(model, pairs)
    stiffness, damping = stiffness_damping(model, solref)
    return ContactParameters(
        stiffness=stiffness,
        damping=damping,
        impedance=jnp.clip(solimp[:, :2], mujoco.mjMINIMP, mujoco.mjMAXIMP),
        width=jnp.maximum(solimp[:, 2], mujoco.mjMINVAL),
        friction=friction,
        margin=margin,
        pyramid=_pyramid_factor(model, pairs, friction[:, 0]),
        solref=solref,
        solimp=solimp,
        timestep=jnp.asarray(model.opt.timestep),
    )


def _pyramid_factor(model: mjx.Model, pairs: Pairs, friction: Array) -> Array:
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return jnp.ones_like(friction)
    condim = np.array([pair.condim for pair in pairs], dtype=int)
    factor = friction**2 * (1 + friction**2) / (np.maximum(condim - 1, 1) * model.opt.impratio)
    return jnp.where(condim > 1, factor, 1.0)


def _mix(model: mjx.Model, pairs: Pairs) -> tuple[Array, ...]:
    """Combine the parameters of two geoms by MuJoCo's rules."""
    numbers = [(pair.geom1, pair.geom2, pair.explicit) for pair in pairs]
    geom1, geom2, explicit = np.array(numbers, dtype=int).reshape(-1, 3).T
    weight = _mix_weight(model, geom1, geom2)[:, None]
    solref1, solref2 = model.geom_solref[geom1], model.geom_solref[geom2]
    both_standard = (solref1[:, :1] > 0) & (solref2[:, :1] > 0)
    # Numbers of the direct format are negative, so the smaller one is stiffer.
    solref = jnp.where(both_standard, weight * solref1 + (1 - weight) * solref2, jnp.minimum(solref1, solref2))
    solimp = weight * model.geom_solimp[geom1] + (1 - weight) * model.geom_solimp[geom2]
    friction = jnp.maximum(model.geom_friction[geom1], model.geom_friction[geom2])

    priority1, priority2 = model.geom_priority[geom1], model.geom_priority[geom2]
    winner = np.where(priority1 > priority2, geom1, geom2)
    has_winner = (priority1 != priority2)[:, None]
    solref = jnp.where(has_winner, model.geom_solref[winner], solref)
    solimp = jnp.where(has_winner, model.geom_solimp[winner], solimp)
    friction = jnp.where(has_winner, model.geom_friction[winner], friction)[:, [0, 0, 1, 2, 2]]
    margin = model.geom_margin[geom1] + model.geom_margin[geom2]

    if not (explicit >= 0).any():
        return solref, solimp, friction, margin
    is_explicit = (explicit >= 0)[:, None]
    return (
        jnp.where(is_explicit, model.pair_solref[explicit], solref),
        jnp.where(is_explicit, model.pair_solimp[explicit], solimp),
        jnp.where(is_explicit, model.pair_friction[explicit], friction),
        jnp.where(is_explicit[:, 0], model.pair_margin[explicit], margin),
    )


def _mix_weight(model: mjx.Model, geom1: np.ndarray, geom2: np.ndarray) -> Array:
    """Return the weight of the first geom: its share of `solmix`, one half if both are zero."""
    solmix1, solmix2 = model.geom_solmix[geom1], model.geom_solmix[geom2]
    smallest = mujoco.mjMINVAL
    neither = (solmix1 < smallest) & (solmix2 < smallest)
    total = jnp.where(neither, 1.0, solmix1 + solmix2)
    return jnp.select([neither, solmix1 < smallest, solmix2 < smallest], [0.5, 0.0, 1.0], solmix1 / total)
