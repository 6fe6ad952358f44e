r"""Pairs of geoms that can touch, and their effective contact parameters.

MuJoCo derives the parameters of a contact from its two geoms (or from an explicit `<pair>`), clamps some of them and reads
`solref` in either of two formats. Here the effective values are brought to one form, in which pairs can be compared and swept. It
is the law of `contact.law` with $K = k / d_w^2$ and $B = b / d_w$, $k = \omega_0^2$ the stiffness and $b$ the damping, both per
unit of the contact's effective mass. At full impedance the contact is the oscillator $\ddot r = -k r - b \dot r + (1 - d_w) a_0$,
with $a_0$ the acceleration without contact. It rests at depth $(1 - d_w) a_0 / k$.

References:
    MuJoCo documentation, "Solver parameters" and "Contact parameters".
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._mjx import contact_groups, geom_groups, geom_pairs, mjx
from mjxgrad.batched.maps import safe_sqrt
from mjxgrad.contact.law import rest_depth, stiffness_damping

_DISABLES_CONTACT = mujoco.mjtDisableBit.mjDSBL_CONTACT.value | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value
# Data for MJX's contacts before they are found: of it, only the slots are copied.
_NOWHERE = SimpleNamespace(_impl=SimpleNamespace(contact=SimpleNamespace(dim=None, efc_address=None)))


@dataclass(frozen=True)
class ContactPair:
    """Two geoms that MJX tests for contact."""

    geom1: int  # index of the first geom; MJX orders the two by geom type
    geom2: int  # index of the second geom
    explicit: int  # index of the `<pair>` that holds the parameters, -1 if the geoms hold them
    condim: int  # dimension of the contact: 1, 3, 4 or 6
    names: tuple[str, str]  # names of the two geoms

    def __str__(self) -> str:
        return " – ".join(self.names)


Pairs = tuple[ContactPair, ...]


class ContactParameters(eqx.Module):
    r"""Effective contact parameters, one row per pair."""

    stiffness: Float[Array, "*batch pairs"]  # $k = \omega_0^2$, in 1/s²
    damping: Float[Array, "*batch pairs"]  # $b$, in 1/s
    impedance: Float[Array, "*batch pairs 2"]  # $d_0$ and $d_w$
    width: Float[Array, "*batch pairs"]  # penetration over which the impedance rises, in m
    friction: Float[Array, "*batch pairs 5"]  # two sliding, one torsional (m) and two rolling (m) coefficients
    margin: Float[Array, "*batch pairs"]  # distance at which contact begins, in m
    # $c$ of `contact.law`, the relative compliance of a pyramid's normal direction; 1 for other cones.
    pyramid: Float[Array, "*batch pairs"]
    # `solref` as mixed by MuJoCo, before `refsafe` and before formats are resolved.
    solref: Float[Array, "*batch pairs 2"]
    solimp: Float[Array, "*batch pairs 5"]  # `solimp` as mixed by MuJoCo, before it is clamped
    timestep: Float[Array, "*batch"]  # time step of the model, in s

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


def contact_pairs(model: mjx.Model | mujoco.MjModel, most: int | None = None) -> Pairs:
    """List the pairs of geoms that MJX tests for contact, so many at most; none if contacts are disabled."""
    # Only the static structure of the model is read.
    if int(model.opt.disableflags) & _DISABLES_CONTACT:
        return ()
    pairs = []
    for geom1, geom2, explicit in (map(int, pair) for pair in itertools.islice(geom_pairs(model), most)):
        names = (geom_name(model, geom1), geom_name(model, geom2))
        dims = [model.geom_condim[geom] for geom in _of_most_priority(model, geom1, geom2)]
        condim = model.pair_dim[explicit] if explicit >= 0 else max(dims)
        pairs.append(ContactPair(geom1, geom2, explicit, int(condim), names))
    return tuple(pairs)


def deciding_geoms(model: mjx.Model | mujoco.MjModel, pair: ContactPair) -> tuple[int, ...]:
    """Return the geoms that determine the parameters of a pair: none if it is explicit, one if that has priority."""
    return () if pair.explicit >= 0 else _of_most_priority(model, pair.geom1, pair.geom2)


def _of_most_priority(model: mjx.Model | mujoco.MjModel, *geoms: int) -> tuple[int, ...]:
    highest = max(model.geom_priority[list(geoms)])
    return tuple(geom for geom in geoms if model.geom_priority[geom] == highest)


# Compiled as one program: one operation after another takes seconds for the first scene of a kind.
@eqx.filter_jit
def contact_parameters(model: mjx.Model, pairs: Pairs) -> ContactParameters:
    """Compute the effective parameters of pairs, one row each."""
    # Differentiable with respect to the model's leaves, and traceable.
    solref, solimp, friction, margin = _mixed(model, pairs)
    (stiffness, damping), pyramid = stiffness_damping(model, solref), jnp.ones_like(margin)
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        condim, square = np.array([pair.condim for pair in pairs], int), friction[:, 0] ** 2
        factor = square * (1 + square) / (np.maximum(condim - 1, 1) * model.opt.impratio)
        pyramid = jnp.where(condim > 1, factor, 1.0)
    return ContactParameters(
        stiffness=stiffness,
        damping=damping,
        impedance=jnp.clip(solimp[:, :2], mujoco.mjMINIMP, mujoco.mjMAXIMP),
        width=jnp.maximum(solimp[:, 2], mujoco.mjMINVAL),
        friction=friction,
        margin=margin,
        pyramid=pyramid,
        solref=solref,
        solimp=solimp,
        timestep=jnp.asarray(model.opt.timestep),
    )


def _mixed(model: mjx.Model, pairs: Pairs) -> Iterator[Array]:
    """Yield `solref`, `solimp`, friction and margin of pairs, as MJX's contacts have them."""
    model = model.replace(
        geom_solmix=jnp.maximum(model.geom_solmix, mujoco.mjMINVAL),  # no quotient of zeros
        # MJX makes a group for any two shapes and meshes, of which there are hundreds; parameters do not depend on them.
        geom_type=np.full_like(model.geom_type, mujoco.mjtGeom.mjGEOM_SPHERE),
        geom_dataid=np.full_like(model.geom_dataid, -1),
    )
    groups = contact_groups(model, _NOWHERE) if pairs else {}  # pyright: ignore[reportArgumentType]
    every = itertools.chain.from_iterable(geom_groups(model).values())
    places = {(frozenset((int(geom1), int(geom2))), int(pair)): i for i, (geom1, geom2, pair) in enumerate(every)}
    index = np.array([places[frozenset((pair.geom1, pair.geom2)), pair.explicit] for pair in pairs], int)
    for name, shape in (("solref", (0, 2)), ("solimp", (0, 5)), ("friction", (0, 5)), ("includemargin", (0,))):
        of_groups = [getattr(contact, name) for contact in groups.values()]
        yield jnp.concatenate([jnp.zeros(shape, model.geom_solref.dtype), *of_groups])[index]
