r"""Contact softness, set equally on every pair of geoms that can touch.

The parameters are those of `contact.parameters`, with $b = 2 \zeta \omega_0$. A larger $k$ makes contact stiffer; a larger $d$
makes it yield less to a sustained force. With a margin the force begins at that distance from the surface.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._arrays import Legible, as_float, is_known
from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_sqrt
from mjxgrad.contact.law import compensated_stiffness
from mjxgrad.contact.parameters import (
    ContactPair,
    ContactParameters,
    Pairs,
    contact_pairs,
    contact_parameters,
    deciding_geoms,
)

# Plain integers: NumPy's integers do not equal MuJoCo's enumerations.
_WITHOUT_MARGIN = (mujoco.mjtGeom.mjGEOM_MESH.value, mujoco.mjtGeom.mjGEOM_HFIELD.value)
_REQUIREMENTS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "stiffness": (lambda x: (x > 0) & (x < np.inf), "positive and finite"),
    "damping_ratio": (lambda x: x >= 0, "at least 0"),
    "impedance": (lambda x: (x >= 0) & (x <= 1), "between 0 and 1"),
    "width": (lambda x: x > 0, "positive"),
    "margin": (lambda x: (x >= 0) & (x < np.inf), "finite and at least 0"),
    "rest_acceleration": (lambda x: x > 0, "positive"),
}


class Softness(Legible):
    r"""Contact softness, set consistently on all pairs of geoms or on a subset.

    Stiffness and damping are written in MuJoCo's direct format, solref $= (-k, -b)$ with $b = 2 \zeta \sqrt k$. In the
    standard format `refsafe` silently replaces a time constant below two time steps; it leaves the direct format alone. Both
    geoms of a pair get the values, so that neither mixing nor priority changes them.

    A margin moves the start of the force away from the surface, and with it the place of rest: bodies hover by the margin less
    their depth. `rest_acceleration` restores the height, exactly under one load, by a softer spring:
    $k' = (1 - d) a_0 / (m + \rho_0)$ for constant impedance (`contact.law` for any). But under a softer spring n times the load
    sinks $(n - 1)(m + \rho_0)$ deeper, and impacts go deeper, too.

    A part that is `None` stays as it is in the model. If only one of stiffness and damping ratio is given, the other keeps its
    present effective value. Every part is a leaf of a pytree, so that a sweep is one `jax.vmap` with a leading axis.

    Attributes:
        stiffness: $k = \omega_0^2$, in 1/s²; positive. With `rest_acceleration` it is the stiffness without margin.
        damping_ratio: $\zeta$; 1 is critical.
        impedance: a constant $d$, or $(d_0, d_w)$ at the surface and at depth `width`. MuJoCo
            keeps it between 1e-4 and 0.9999.
        width: depth over which the impedance rises from $d_0$ to $d_w$, in m.
        margin: distance at which force begins, in m; at least 0. Each geom of a pair gets half of it.
        rest_acceleration: $a_0$ under which bodies rest as high as without margin, in m/s²; None lets them hover.
        geoms: names of geoms; only pairs with at least one of them change.
        pairs: pairs of geom names; only these pairs change.
    """

    stiffness: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    damping_ratio: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    impedance: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    width: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    margin: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    rest_acceleration: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    geoms: tuple[str, ...] | None = eqx.field(static=True, default=None)
    pairs: tuple[tuple[str, str], ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.geoms is not None and self.pairs is not None:
            raise ValueError("Softness takes either geoms or pairs, got geoms and pairs")
        if isinstance(self.geoms, str):
            raise ValueError(f"geoms must be a tuple of names, got {self.geoms!r}; write ({self.geoms!r},)")
        pairs = () if self.pairs is None else self.pairs
        if not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in pairs):
            raise ValueError(f"pairs must be pairs of two names, such as (('floor', 'ball'),), got {pairs!r}")
        if self.rest_acceleration is not None and self.margin is None:
            raise ValueError("rest_acceleration must come with a margin, got none; give Softness a margin, too")
        for name, (is_valid, requirement) in _REQUIREMENTS.items():
            value = getattr(self, name)
            if is_known(value) and not np.all(is_valid(np.asarray(value))):
                raise ValueError(f"{name} must be {requirement}, got {np.asarray(value).tolist()}")

    def selected(self, model: mjx.Model) -> Pairs:
        """Return the pairs that this softness changes; all pairs without a subset.

        Raises:
            ValueError: if a name is unknown or can touch nothing.
        """
        everything = contact_pairs(model)
        if self.pairs is not None:
            wanted, there = set(map(frozenset, self.pairs)), {frozenset(pair.names) for pair in everything}
            if unknown := [names for names in self.pairs if frozenset(names) not in there]:
                listed = ", ".join(map(str, everything[:20])) + " ..." * (len(everything) > 20) or "none"
                raise ValueError(
                    f"pairs must name pairs of geoms that can touch, got {unknown[0]!r}; those that can: {listed}"
                )
            return tuple(pair for pair in everything if frozenset(pair.names) in wanted)
        if self.geoms is None:
            return everything
        known = sorted({name for pair in everything for name in pair.names})
        if unknown := [name for name in self.geoms if name not in known]:
            there = ", ".join(known) or "none"
            raise ValueError(
                f"geoms must name geoms that can touch another, got {unknown[0]!r}; those that can: {there}"
            )
        return tuple(pair for pair in everything if set(pair.names) & set(self.geoms))

    def apply(self, model: mjx.Model) -> mjx.Model:
        r"""Write this softness into a model.

        It writes `geom_solref`, `geom_solimp`, `geom_margin`, `pair_solref`, `pair_solimp` and `pair_margin`. Traceable and
        differentiable with respect to every part and to the model's leaves. If only one of stiffness and damping ratio is given,
        a geom of several pairs can keep the other's present value only if these pairs have the same.

        Raises:
            ValueError: if a part has a leading axis; if a name is unknown; if a changed geom also determines the contact of a
                pair that was not selected; if present values to be kept disagree; if a margin is set on a mesh or height
                field; if a height is to be kept for a contact that already has a margin, without a given stiffness.
        """
        parts = {}
        for name, (is_valid, _) in _REQUIREMENTS.items():
            value, shape = getattr(self, name), np.shape(getattr(self, name))
            if shape and not (name == "impedance" and shape == (2,)):
                raise ValueError(f"{name} must be one value to be applied, got shape {shape}; sweep under jax.vmap")
            if isinstance(value, jax.core.Tracer):  # a rollout with NaN is flagged as diverged
                parts[name] = jnp.where(is_valid(value), value, jnp.nan)
        self = dataclasses.replace(self, **parts)
        selected = self.selected(model)
        before = contact_parameters(model, selected)
        explicit = {p.explicit: i for i, p in enumerate(selected) if p.explicit >= 0}
        if self.margin is not None:
            model = _with_margin(model, self.margin, selected, list(explicit))
        if all(getattr(self, name) is None for name in _REQUIREMENTS if name != "margin"):
            return model
        _refuse_shared_geoms(model, selected, functools.partial(deciding_geoms, model))
        # The pair of each geom to write.
        geoms = {geom: i for i, p in enumerate(selected) for geom in deciding_geoms(model, p)}
        model = model.replace(
            geom_solimp=self._set_solimp(model.geom_solimp, list(geoms)),
            pair_solimp=self._set_solimp(model.pair_solimp, list(explicit)),
        )
        if any(part is not None for part in (self.stiffness, self.damping_ratio, self.rest_acceleration)):
            solref = self._solref(model, selected, before)
            model = model.replace(
                geom_solref=_write(model.geom_solref, geoms, solref),
                pair_solref=_write(model.pair_solref, explicit, solref),
            )
        return model

    def _solref(self, model: mjx.Model, pairs: Pairs, before: ContactParameters) -> Array:
        """Return solref in the direct format for each pair; the model has the other parts already."""
        refuse = functools.partial(_refuse_disagreement, model, pairs)
        stiffness, damping_ratio = self.stiffness, self.damping_ratio
        if stiffness is None:
            stiffness = before.stiffness
            refuse(stiffness, "stiffness", "give Softness a stiffness")
            if self.rest_acceleration is not None and is_known(before.margin) and np.any(before.margin):
                wanted = "must be given with rest_acceleration where contacts have a margin already, got none"
                raise ValueError(f"stiffness {wanted}; their present stiffness may have been made for that margin")
        if damping_ratio is None:
            damping_ratio = before.damping_ratio
            refuse(damping_ratio, "damping_ratio", "give Softness a damping_ratio")
        stiffness = jnp.broadcast_to(stiffness, before.stiffness.shape)
        if self.rest_acceleration is not None:
            present = contact_parameters(model, pairs)
            load = present.pyramid * self.rest_acceleration
            stiffness = compensated_stiffness(stiffness, present.solimp, present.margin, load)
            remedy = "list one of them as <pair> in the MJCF's <contact>"
            refuse(stiffness, "stiffness that keeps the height", remedy)
        damping = 2.0 * damping_ratio * safe_sqrt(stiffness)
        return jnp.stack([-stiffness, -jnp.broadcast_to(damping, stiffness.shape)], axis=-1)

    def _set_solimp(self, solimp: Array, rows: list[int]) -> Array:
        """Write impedance and width; `solimp` mixes linearly, so its other numbers keep their mixed values."""
        if not rows:
            return solimp
        if self.impedance is not None:
            solimp = solimp.at[np.array(rows), :2].set(self.impedance)
        if self.width is not None:
            solimp = solimp.at[np.array(rows), 2].set(self.width)
        return solimp


def _with_margin(model: mjx.Model, margin: Array, pairs: Pairs, explicit: list[int]) -> mjx.Model:
    """Write the margin to explicit pairs, and half of it to each geom of other pairs, since MuJoCo adds the two."""
    for pair in pairs:
        if any(model.geom_type[geom] in _WITHOUT_MARGIN for geom in (pair.geom1, pair.geom2)):
            reason = "MJX finds contacts of meshes and height fields only where they touch"
            remedy = "select other pairs, or replace the mesh by primitive geoms"
            raise ValueError(f"margin must not be set for the pair {pair}: {reason}; {remedy}")
    _refuse_shared_geoms(model, pairs, _summed_geoms)
    geom_margin, pair_margin = model.geom_margin, model.pair_margin
    if geoms := sorted({geom for pair in pairs for geom in _summed_geoms(pair)}):
        geom_margin = geom_margin.at[np.array(geoms)].set(0.5 * margin)
    if explicit:
        pair_margin = pair_margin.at[np.array(explicit)].set(margin)
    return model.replace(geom_margin=geom_margin, pair_margin=pair_margin)


def _write(values: Array, places: dict[int, int], per_pair: Array) -> Array:
    if not places:
        return values
    return values.at[np.array(list(places))].set(per_pair[np.array(list(places.values()))])


def _summed_geoms(pair: ContactPair) -> tuple[int, ...]:
    return () if pair.explicit >= 0 else (pair.geom1, pair.geom2)


def _refuse_shared_geoms(model: mjx.Model, selected: Pairs, geoms_of: Callable[[ContactPair], tuple[int, ...]]) -> None:
    """Refuse to change pairs whose geoms also determine the contacts of other pairs."""
    decided_by = {geom: pair for pair in selected for geom in geoms_of(pair)}
    chosen = set(selected)
    for other in (pair for pair in contact_pairs(model) if pair not in chosen):
        for geom in geoms_of(other):
            if geom in decided_by:
                name = other.names[0] if geom == other.geom1 else other.names[1]
                effect = f"softness of the pair {decided_by[geom]} would also change the pair {other}"
                remedy = "list one of the two as <pair> in the MJCF's <contact> so that it has its own parameters"
                raise ValueError(f"{effect}, which shares the geom {name!r}; select that pair too, or {remedy}")


def _refuse_disagreement(model: mjx.Model, selected: Pairs, values: Array, part: str, remedy: str) -> None:
    """Refuse different known values for pairs that share a geom; traced values are not checked."""
    if not is_known(values):
        return
    known, first = np.asarray(values), {}
    for i, pair in enumerate(selected):
        for geom in deciding_geoms(model, pair):
            j = first.setdefault(geom, i)
            if not np.isclose(known[i], known[j], rtol=1e-5):
                both = f"{selected[j]} and {pair}, which share a geom, got {known[j]:.4g} and {known[i]:.4g}"
                raise ValueError(f"{part} must be given, or be the same now in the pairs {both}; {remedy}")
