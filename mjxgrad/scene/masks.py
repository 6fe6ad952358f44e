"""Which geoms collide, said by MuJoCo's bit masks: the only way to leave out single pairs of a compiled model."""

from collections.abc import Iterable

import mujoco
import numpy as np

from mjxgrad.contact.parameters import ContactPair

_NUM_BITS = 31  # of a signed integer, the sign left alone


class TooManyMasksError(ValueError):
    """The pairs that remain cannot be told apart from the others by the bits that there are."""


def keep_pairs(model: mujoco.MjModel, kept: Iterable[ContactPair]) -> None:
    """Set `contype` and `conaffinity` so that of all pairs of geoms only these collide, in the same order as before.

    Geoms that collide with the same others share a bit: theirs is the type, the others have the affinity. Bits are given
    out until every pair has one, first to those that settle most pairs. What MuJoCo filters by other rules (geoms of one
    rigid body, of parent and child, excluded bodies) stays filtered, and explicit pairs stay as they are.

    Args:
        model: changed in place.
        kept: pairs of this model that are not explicit.

    Raises:
        TooManyMasksError: if 31 bits do not suffice.
    """
    neighbours: dict[int, set[int]] = {}
    for pair in kept:
        neighbours.setdefault(pair.geom1, set()).add(pair.geom2)
        neighbours.setdefault(pair.geom2, set()).add(pair.geom1)
    alike: dict[frozenset[int], list[int]] = {}
    for geom, others in neighbours.items():
        alike.setdefault(frozenset(others), []).append(geom)
    contype, conaffinity = np.zeros(model.ngeom, int), np.zeros(model.ngeom, int)
    unsettled = {frozenset((geom, other)) for geom, others in neighbours.items() for other in others}
    bit = 0
    while unsettled:
        if bit == _NUM_BITS:
            raise TooManyMasksError(f"MuJoCo has {_NUM_BITS} bits to tell colliding geoms apart")
        settled = {others: unsettled & _between(geoms, others) for others, geoms in alike.items()}
        others = max(settled, key=lambda one: len(settled[one]))
        contype[alike[others]] |= 1 << bit
        conaffinity[sorted(others)] |= 1 << bit
        unsettled -= settled[others]
        bit += 1
    model.geom_contype[:], model.geom_conaffinity[:] = contype, conaffinity


def _between(geoms: Iterable[int], others: Iterable[int]) -> set[frozenset[int]]:
    return {frozenset((geom, other)) for geom in geoms for other in others}
