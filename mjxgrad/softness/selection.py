"""Which pairs a softness changes, and what stands in the way of changing only those."""

import jax
import mujoco
import numpy as np
from jaxtyping import Array

from mjxgrad._mjx import mjx
from mjxgrad.contacts import ContactPair, contact_pairs, deciding_geoms

Selected = tuple[ContactPair, ...]
# As numbers: an integer of numpy does not compare with MuJoCo's enumerations.
_WITHOUT_MARGIN = (mujoco.mjtGeom.mjGEOM_MESH.value, mujoco.mjtGeom.mjGEOM_HFIELD.value)
_ROUNDING = 1e-9  # of the pseudo-inverse of a matrix of zeros and ones


def is_known(value: Array | None) -> bool:
    """Say whether there is a value, and one that can be looked at."""
    return value is not None and not isinstance(value, jax.core.Tracer)


def select(
    model: mjx.Model,
    *,
    geoms: tuple[str, ...] | None = None,
    pairs: tuple[tuple[str, str], ...] | None = None,
    bodies: tuple[str, ...] | None = None,
    groups: tuple[int, ...] | None = None,
) -> Selected:
    """Give the pairs that are named in one of four ways; all of them without a name.

    Args:
        model: of MJX.
        geoms: pairs with at least one of these geoms.
        pairs: exactly these.
        bodies: pairs with at least one geom of these bodies.
        groups: pairs with at least one geom of these groups, MJCF's `group`.

    Raises:
        ValueError: if a name is unknown or can touch nothing.
    """
    everything = contact_pairs(model)
    if pairs is not None:
        known = {frozenset(pair.names) for pair in everything}
        for names in pairs:
            if frozenset(names) not in known:
                raise ValueError(
                    f"softness.pairs must name pairs of geoms that can touch, got {names!r}; "
                    f"those that can: {', '.join(str(p) for p in everything) or 'none'}"
                )
        wanted = {frozenset(names) for names in pairs}
        return tuple(p for p in everything if frozenset(p.names) in wanted)
    if geoms is not None:
        return _with_any(everything, "geoms", geoms, [set(pair.names) for pair in everything])
    if bodies is not None:
        return _with_any(everything, "bodies", bodies, [_body_names(model, pair) for pair in everything])
    if groups is not None:
        members = [{int(model.geom_group[g]) for g in (pair.geom1, pair.geom2)} for pair in everything]
        return _with_any(everything, "groups", groups, members)
    return everything


def refuse_shared_geoms(model: mjx.Model, selected: Selected) -> None:
    """Refuse to change pairs whose geoms also decide the contact of others.

    Raises:
        ValueError: naming both pairs and the geom.
    """
    decided_by = {geom: pair for pair in selected for geom in deciding_geoms(model, pair)}
    for other in contact_pairs(model):
        if other in selected:
            continue
        for geom in deciding_geoms(model, other):
            if geom in decided_by:
                raise ValueError(_shared(decided_by[geom], other, geom))


def refuse_disagreement(model: mjx.Model, selected: Selected, values: Array, part: str, remedy: str) -> None:
    """Refuse to write one value per pair where pairs with different ones share a geom; not looked at if traced.

    Raises:
        ValueError: naming both pairs and their values.
    """
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


def margin_shares(model: mjx.Model, selected: Selected) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Say how a margin of pairs becomes margins of geoms, which MuJoCo adds, and leaves other pairs alone.

    A geom of a pair that was not selected keeps its margin; the others of a pair take what is missing, two of them half
    each. That is the solution of least norm of $S x = m - P x_\text{kept}$, with a row for each pair.

    Args:
        model: of MJX.
        selected: the pairs; those with parameters of their own have no part in it.

    Returns:
        The geoms to write; the matrix from what each pair misses to their margins; the matrix P over all geoms.

    Raises:
        ValueError: if the margins of the pairs cannot be set without those of others, or a geom is a mesh or height field,
            for which MJX computes no distances.
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
    # Whether they can be met must not depend on values, which may be traced: every right-hand side has to be in reach.
    wanted = np.column_stack([np.ones(len(implicit)), kept])
    unmet = np.abs(shares @ solution @ wanted - wanted).max(axis=1, initial=0.0)
    if unmet.max(initial=0.0) > _ROUNDING:
        row = int(np.argmax(unmet))
        raise ValueError(
            f"margin of the pair {implicit[row]} cannot be set while geoms that it shares with others keep theirs; select "
            "all pairs of these geoms, or list the pair as <pair> in the MJCF's <contact>"
        )
    return np.array(free, dtype=int), solution, kept


def _with_any(everything: Selected, kind: str, wanted: tuple, members: list[set]) -> Selected:
    known = set().union(*members)
    for one in wanted:
        if one not in known:
            raise ValueError(
                f"softness.{kind} must name {kind} that can touch another, got {one!r}; "
                f"those that can: {', '.join(str(x) for x in sorted(known)) or 'none'}"
            )
    return tuple(pair for pair, names in zip(everything, members, strict=True) if names & set(wanted))


def _body_names(model: mjx.Model, pair: ContactPair) -> set[str]:
    bodies = {int(model.geom_bodyid[geom]) for geom in (pair.geom1, pair.geom2)}
    return {mjx.id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body{body}" for body in bodies}


def _shared(pair: ContactPair, other: ContactPair, geom: int) -> str:
    name = other.names[0] if geom == other.geom1 else other.names[1]
    return (
        f"softness of the pair {pair} would also change the pair {other}, "
        f"which shares the geom {name!r}; select that pair too, or list one of "
        f"the two as <pair> in the MJCF's <contact> so that it has its own parameters"
    )
