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
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._arrays import as_float, is_known
from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_sqrt
from mjxgrad.contact.law import compensated_stiffness
from mjxgrad.contact.parameters import (
    ContactPair,
    ContactParameters,
    body_name,
    contact_pairs,
    contact_parameters,
    deciding_geoms,
    named_pairs,
)

_PARTS = ("stiffness", "damping_ratio", "impedance", "width", "margin", "rest_acceleration")
_SUBSETS = ("geoms", "pairs", "bodies", "groups")
# Positive quantities that are interpolated geometrically.
_GEOMETRIC = ("stiffness", "width", "rest_acceleration")
_Pairs = tuple[ContactPair, ...]
# Plain integers: NumPy's integers do not equal MuJoCo's enumerations.
_WITHOUT_MARGIN = (mujoco.mjtGeom.mjGEOM_MESH.value, mujoco.mjtGeom.mjGEOM_HFIELD.value)
_ROUNDING = 1e-9  # error of the pseudo-inverse of a matrix of zeros and ones


_REQUIREMENTS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "stiffness": (lambda x: (x > 0) & (x < np.inf), "positive and finite"),
    "damping_ratio": (lambda x: x >= 0, "at least 0"),
    "impedance": (lambda x: (x >= 0) & (x <= 1), "between 0 and 1"),
    "width": (lambda x: x > 0, "positive"),
    "margin": (lambda x: (x >= 0) & (x < np.inf), "finite and at least 0"),
    "rest_acceleration": (lambda x: x > 0, "positive"),
}


class Softness(eqx.Module):
    r"""Contact softness, set consistently on all pairs of geoms or on a subset.

    Stiffness and damping are written in MuJoCo's direct format, solref $= (-k, -b)$ with $b = 2 \zeta \sqrt k$. In the
    standard format `refsafe` silently replaces a time constant below two time steps; it leaves the direct format alone. Both
    geoms of a pair get the values, so that neither mixing nor priority changes them.

    A margin moves the start of the force away from the surface, and with it the place of rest: bodies hover by the margin less
    their depth. `rest_acceleration` restores the height, exactly under one load, by a softer spring:
    $k' = (1 - d) a_0 / (m + \rho_0)$ for constant impedance (`contact.law` for any). Two other ways fail. Geoms that shrink by
    the margin cancel it, since a margin only enlarges geoms. A lower impedance reaches $d = 0$ where $k m > a_0$. But under a
    softer spring n times the load sinks $(n - 1)(m + \rho_0)$ deeper, and impacts go deeper, too.

    A part that is `None` stays as it is in the model. If only one of stiffness and damping ratio is given, the other keeps its
    present effective value. Every part is a leaf of a pytree, so that a sweep is one `jax.vmap` over a `Softness` with a
    leading axis (see `sweep`).

    Attributes:
        stiffness: $k = \omega_0^2$, in 1/s²; positive. With `rest_acceleration` it is the stiffness without margin.
        damping_ratio: $\zeta$; 1 is critical.
        impedance: a constant $d$, or $(d_0, d_w)$ at the surface and at depth `width`. MuJoCo
            keeps it between 1e-4 and 0.9999.
        width: depth over which the impedance rises from $d_0$ to $d_w$, in m.
        margin: distance at which force begins, in m; at least 0. The margin of a pair is shared among its geoms.
        rest_acceleration: $a_0$ under which bodies rest as high as without margin, in m/s²; None lets them hover.
        geoms: names of geoms; only pairs with at least one of them change.
        pairs: pairs of geom names; only these pairs change.
        bodies: names of bodies; only pairs with at least one of their geoms change.
        groups: geom groups (MJCF's `group`, 0 to 5); only pairs with at least one geom of these change.
    """

    stiffness: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    damping_ratio: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    impedance: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    width: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    margin: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    rest_acceleration: Float[Array, "..."] | None = eqx.field(converter=as_float, default=None)
    geoms: tuple[str, ...] | None = eqx.field(static=True, default=None)
    pairs: tuple[tuple[str, str], ...] | None = eqx.field(static=True, default=None)
    bodies: tuple[str, ...] | None = eqx.field(static=True, default=None)
    groups: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        """Refuse several subsets at once, a height without a margin, and values out of their range if they are known."""
        given = [name for name in _SUBSETS if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"Softness takes either geoms or pairs, bodies or groups, got {' and '.join(given)}")
        for name in given:
            if isinstance(value := getattr(self, name), str):
                raise ValueError(f"{name} must be a tuple of names, got {value!r}; write ({value!r},)")
        if self.rest_acceleration is not None and self.margin is None:
            raise ValueError("rest_acceleration must come with a margin, got none; give Softness a margin, too")
        for name, (is_valid, requirement) in _REQUIREMENTS.items():
            value = getattr(self, name)
            if is_known(value) and not np.all(is_valid(np.asarray(value))):
                raise ValueError(f"{name} must be {requirement}, got {np.asarray(value).tolist()}")

    @classmethod
    def sweep(cls, **parts: Any) -> "Softness":
        """Stack several values of softness for `jax.vmap`; parts with a single value are broadcast.

        `Softness.sweep(stiffness=[1e2, 1e4], damping_ratio=1.0)` has two values of each.

        Args:
            **parts: the arguments of `Softness`, each with or without a leading axis; an impedance $(d_0, d_w)$ has its pair
                on the last axis.

        Returns:
            One `Softness` whose leaves share their leading axis.
        """
        static = {name: parts.pop(name) for name in _SUBSETS if name in parts}
        arrays = {name: as_float(value) for name, value in parts.items() if value is not None}
        lengths = {name: a.shape[0] for name, a in arrays.items() if a.ndim}
        length = max(lengths.values(), default=1)
        for name, a in arrays.items():
            is_pair = name == "impedance" and a.shape == (2,) and length != 2
            if a.ndim == 0 or is_pair:
                arrays[name] = jnp.broadcast_to(a, (length, *a.shape))
        return cls(**arrays, **static)

    @classmethod
    def between(cls, start: "Softness", end: "Softness", progress: Float[ArrayLike, ""]) -> "Softness":
        """Interpolate between two values of softness; traceable.

        Stiffness, width and rest acceleration change by equal factors, other parts by equal amounts. Where a smoothing of
        `optimise` lowers a scale from 1, `lambda scale: objective(Softness.between(hard, soft, scale))` hardens the
        contact with it; `progress = step / num_steps` makes a schedule.

        Args:
            start: the softness at progress 0.
            end: the softness at progress 1, with the same parts and the same subset.
            progress: share of the way, clipped to between 0 and 1.

        Raises:
            ValueError: if the two differ in the parts that they give or in their subset.
        """
        share = jnp.clip(as_float(progress), 0.0, 1.0)
        parts = {}
        for name in _SUBSETS:
            if getattr(start, name) != getattr(end, name):
                raise ValueError(
                    f"start and end must have the same {name}, got {getattr(start, name)} and {getattr(end, name)}"
                )
            parts[name] = getattr(start, name)
        for name in _PARTS:
            first, last = getattr(start, name), getattr(end, name)
            if (first is None) != (last is None):
                raise ValueError(f"start and end must both have a {name} or neither, got {first} and {last}")
            if first is not None and last is not None:
                is_geometric = name in _GEOMETRIC
                parts[name] = first ** (1 - share) * last**share if is_geometric else (1 - share) * first + share * last
        return cls(**parts)

    def selected(self, model: mjx.Model) -> tuple[ContactPair, ...]:
        """Return the pairs that this softness changes; all pairs without a subset.

        Raises:
            ValueError: if a name is unknown or can touch nothing.
        """
        everything = contact_pairs(model)
        if self.pairs is not None:
            return named_pairs(everything, self.pairs, "softness.pairs")
        if self.geoms is not None:
            return _with_any(everything, "geoms", self.geoms, [set(pair.names) for pair in everything])
        if self.bodies is not None:
            members = [{body_name(model, geom) for geom in (pair.geom1, pair.geom2)} for pair in everything]
            return _with_any(everything, "bodies", self.bodies, members)
        if self.groups is not None:
            members = [{int(model.geom_group[g]) for g in (pair.geom1, pair.geom2)} for pair in everything]
            return _with_any(everything, "groups", self.groups, members)
        return everything

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
        for name in _PARTS:
            shape = np.shape(getattr(self, name))
            if shape and not (name == "impedance" and shape == (2,)):
                raise ValueError(
                    f"{name} must be one value to be applied, got shape {shape}; apply a sweep under jax.vmap"
                )
        self = self._with_nan_for_what_is_refused()
        selected = self.selected(model)
        before = contact_parameters(model, selected)
        explicit = {p.explicit: i for i, p in enumerate(selected) if p.explicit >= 0}
        if self.margin is not None:
            model = self._set_margin(model, selected, list(explicit))
        if all(getattr(self, name) is None for name in _PARTS if name != "margin"):
            return model
        _refuse_shared_geoms(model, selected)
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

    def _with_nan_for_what_is_refused(self) -> "Softness":
        """Return the softness with NaN in place of traced values out of range, so that a rollout is flagged as diverged."""
        parts = {}
        for name, (is_valid, _) in _REQUIREMENTS.items():
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer):
                parts[name] = jnp.where(is_valid(value), value, jnp.nan)
        return dataclasses.replace(self, **parts)

    def _solref(self, model: mjx.Model, pairs: tuple[ContactPair, ...], before: ContactParameters) -> Array:
        """Return solref in the direct format for each pair; the model has the other parts already."""
        refuse = functools.partial(_refuse_disagreement, model, pairs)
        stiffness, damping_ratio = self.stiffness, self.damping_ratio
        if stiffness is None:
            stiffness = before.stiffness
            refuse(stiffness, "stiffness", "give Softness a stiffness")
            if self.rest_acceleration is not None and is_known(before.margin) and np.any(before.margin):
                raise ValueError(
                    "stiffness must be given with rest_acceleration where contacts have a margin already, got none; their "
                    "present stiffness may have been made for that margin"
                )
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

    def _set_margin(self, model: mjx.Model, pairs: tuple[ContactPair, ...], explicit: list[int]) -> mjx.Model:
        """Write the margin to explicit pairs, and share it among the geoms of other pairs."""
        geoms, shares, kept = _margin_shares(model, pairs)
        geom_margin, pair_margin = model.geom_margin, model.pair_margin
        if geoms.size:
            missing = self.margin - kept @ geom_margin
            geom_margin = geom_margin.at[geoms].set((shares @ missing).astype(geom_margin.dtype))
        if explicit:
            pair_margin = pair_margin.at[np.array(explicit)].set(self.margin)
        return model.replace(geom_margin=geom_margin, pair_margin=pair_margin)

    def _set_solimp(self, solimp: Array, rows: list[int]) -> Array:
        """Write impedance and width; `solimp` mixes linearly, so its other numbers keep their mixed values."""
        if not rows:
            return solimp
        if self.impedance is not None:
            solimp = solimp.at[np.array(rows), :2].set(self.impedance)
        if self.width is not None:
            solimp = solimp.at[np.array(rows), 2].set(self.width)
        return solimp


def _write(values: Array, places: dict[int, int], per_pair: Array) -> Array:
    if not places:
        return values
    return values.at[np.array(list(places))].set(per_pair[np.array(list(places.values()))])


def _refuse_shared_geoms(model: mjx.Model, selected: _Pairs) -> None:
    """Refuse to change pairs whose geoms also determine the contacts of other pairs."""
    decided_by = {geom: pair for pair in selected for geom in deciding_geoms(model, pair)}
    for other in contact_pairs(model):
        if other in selected:
            continue
        for geom in deciding_geoms(model, other):
            if geom in decided_by:
                raise ValueError(_shared(decided_by[geom], other, geom))


def _refuse_disagreement(model: mjx.Model, selected: _Pairs, values: Array, part: str, remedy: str) -> None:
    """Refuse different known values for pairs that share a geom; traced values are not checked."""
    if not is_known(values):
        return
    known, first = np.asarray(values), {}
    for i, pair in enumerate(selected):
        for geom in deciding_geoms(model, pair):
            j = first.setdefault(geom, i)
            if not np.isclose(known[i], known[j], rtol=1e-5):
                raise ValueError(
                    f"{part} must be given, or be the same now in the pairs {selected[j]} and "
                    f"{pair}, which share a geom, got {known[j]:.4g} and {known[i]:.4g}; {remedy}"
                )


def _margin_shares(model: mjx.Model, selected: _Pairs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Return how margins of pairs become margins of geoms, which MuJoCo adds, without a change to other pairs.

    A geom of a pair that was not selected keeps its margin. The other geoms of a pair take the difference, two of them half
    each. That is the least-norm solution of $S x = m - P x_\text{kept}$, with one row per pair; explicit pairs are left out.

    Returns:
        The geoms to write, the matrix from the pairs' missing margins to the geoms' margins, and P over all geoms.
    """
    for pair in selected:
        if any(model.geom_type[geom] in _WITHOUT_MARGIN for geom in (pair.geom1, pair.geom2)):
            raise ValueError(
                f"margin must not be set for the pair {pair}: MJX finds contacts of meshes and height fields only where "
                "they touch; select other pairs, or replace the mesh by primitive geoms"
            )
    implicit = [pair for pair in selected if pair.explicit < 0]
    others = [pair for pair in contact_pairs(model) if pair.explicit < 0 and pair not in selected]
    taken = {geom: other for other in others for geom in (other.geom1, other.geom2)}
    free = sorted({geom for pair in implicit for geom in (pair.geom1, pair.geom2)} - taken.keys())
    column = {geom: i for i, geom in enumerate(free)}
    shares, kept = np.zeros((len(implicit), len(free))), np.zeros((len(implicit), model.ngeom))
    for row, pair in enumerate(implicit):
        for geom in (pair.geom1, pair.geom2):
            if geom in column:
                shares[row, column[geom]] += 1
            else:
                kept[row, geom] += 1
        if not shares[row].any():
            raise ValueError(_shared(pair, taken[pair.geom1], pair.geom1))
    solution = np.linalg.pinv(shares)
    # Values may be traced, so solvability must not depend on them: every right-hand side must be in the range of S.
    wanted = np.column_stack([np.ones(len(implicit)), kept])
    unmet = np.abs(shares @ solution @ wanted - wanted).max(axis=1, initial=0.0)
    if unmet.max(initial=0.0) > _ROUNDING:
        row = int(np.argmax(unmet))
        raise ValueError(
            f"margin of the pair {implicit[row]} cannot be set while geoms that it shares with others keep theirs; select "
            "all pairs of these geoms, or list the pair as <pair> in the MJCF's <contact>"
        )
    return np.array(free, dtype=int), solution, kept


def _with_any(everything: _Pairs, kind: str, wanted: tuple, members: list[set]) -> _Pairs:
    known = set().union(*members)
    for one in wanted:
        if one not in known:
            raise ValueError(
                f"softness.{kind} must name {kind} that can touch another, got {one!r}; "
                f"those that can: {', '.join(str(x) for x in sorted(known)) or 'none'}"
            )
    return tuple(pair for pair, names in zip(everything, members, strict=True) if names & set(wanted))


def _shared(pair: ContactPair, other: ContactPair, geom: int) -> str:
    name = other.names[0] if geom == other.geom1 else other.names[1]
    return (
        f"softness of the pair {pair} would also change the pair {other}, which shares the geom {name!r}; select that pair too, "
        "or list one of the two as <pair> in the MJCF's <contact> so that it has its own parameters"
    )
