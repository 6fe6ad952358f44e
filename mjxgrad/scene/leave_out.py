"""What a user lets a scene do without, by proof or on their word."""

import math
from dataclasses import dataclass

import mujoco

from mjxgrad._mjx import make_efc_type
from mjxgrad.contact.parameters import ContactPair, contact_pairs
from mjxgrad.scene.masks import TooManyMasksError, keep_pairs
from mjxgrad.scene.omissions import Omission
from mjxgrad.scene.separation import proven_distance


@dataclass(frozen=True)
class LeaveOut:
    """Contacts and limits that a scene is to do without, beyond what no motion of it can need.

    Nothing of this happens unless asked for: proofs hold for the lengths in the file, while `scene.model` may be given
    others, and limits give way. Whether a motion needed it after all is what `mg.check_omissions` says.

    Attributes:
        never_touching: pairs of geoms that `separation` proves apart at all joint positions.
        beyond_limits: how far joints may leave their ranges in such a proof (rad or m); None trusts no limit, so that only
            what no turn of any hinge brings together is left out.
        clearance: distance that is to be proven beyond the margin (m). Smoothing acts at a distance: take several of its
            lengths.
        pairs: pairs of geoms by name that touch in no motion of interest, on your word.
        limits: joints by name that reach their limits in no motion of interest, on your word.
    """

    never_touching: bool = True
    beyond_limits: float | None = None
    clearance: float = 0.01
    pairs: tuple[tuple[str, str], ...] = ()
    limits: tuple[str, ...] = ()

    def __post_init__(self):
        """Refuse numbers without meaning.

        Raises:
            ValueError: if a length is negative or not finite.
        """
        for name, value in (("beyond_limits", self.beyond_limits), ("clearance", self.clearance)):
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"leave_out.{name} must be finite and at least 0, got {value!r}")


@dataclass(frozen=True)
class OmittedPair:
    """A pair of geoms whose contact is left out.

    Attributes:
        pair: in the full model.
        distance: that it is proven to keep (m); None on the user's word.
    """

    pair: ContactPair
    distance: float | None


def omit(model: mujoco.MjModel, wanted: LeaveOut) -> tuple[tuple[OmittedPair, ...], tuple[Omission, ...]]:
    """Leave out pairs and limits.

    Args:
        model: changed in place.
        wanted: what to leave out.

    Returns:
        The pairs left out, and what was done in words.

    Raises:
        ValueError: if a name is unknown, a pair is listed as `<pair>` in the file, or there are too many different
            pairs to leave out.
    """
    rows = _num_rows(model)
    everything = contact_pairs(model)
    omitted = _named(everything, wanted)
    if wanted.never_touching:
        omitted += _proven(model, [pair for pair in everything if pair not in {o.pair for o in omitted}], wanted)
    gone = {one.pair for one in omitted}
    if gone:
        try:
            keep_pairs(model, (pair for pair in everything if pair.explicit < 0 and pair not in gone))
        except TooManyMasksError as error:
            raise ValueError(
                f"leave_out must leave pairs that collision masks can express, got {len(gone)} of {len(everything)} to leave "
                f"out: {error}; name fewer pairs or all of a geom, or set never_touching=False"
            ) from error
    without_limit = [_limited_joint(model, name) for name in wanted.limits]
    model.jnt_limited[without_limit] = 0
    omissions = _in_words(omitted, len(everything), wanted)
    if omissions:
        omissions.append(Omission("constraint rows", f"{_num_rows(model)} remain of {rows}"))
    return tuple(omitted), tuple(omissions)


def _named(everything: tuple[ContactPair, ...], wanted: LeaveOut) -> list[OmittedPair]:
    by_names = {frozenset(pair.names): pair for pair in everything}
    omitted = []
    for names in dict.fromkeys(map(frozenset, wanted.pairs)):
        pair = by_names.get(names)
        shown = " – ".join(sorted(names))
        if pair is None:
            listed = ", ".join(map(str, everything[:20])) + (" ..." if len(everything) > 20 else "")
            raise ValueError(
                f"leave_out.pairs must name pairs of geoms that can touch, got {shown!r}; those that can: {listed or 'none'}"
            )
        if pair.explicit >= 0:
            raise ValueError(
                f"leave_out.pairs must not name a pair listed as <pair> in the MJCF, got {shown!r}; remove it there"
            )
        omitted.append(OmittedPair(pair, None))
    return omitted


def _proven(model: mujoco.MjModel, pairs: list[ContactPair], wanted: LeaveOut) -> list[OmittedPair]:
    omitted = []
    for pair in pairs:
        # Who lists a pair wants it; one that cannot touch there is a mistake to find, not to hide.
        if pair.explicit >= 0:
            continue
        needed = float(model.geom_margin[[pair.geom1, pair.geom2]].sum()) + wanted.clearance
        distance = proven_distance(model, pair.geom1, pair.geom2, at_least=needed, beyond_limits=wanted.beyond_limits)
        if distance is not None:
            omitted.append(OmittedPair(pair, distance))
    return omitted


def _limited_joint(model: mujoco.MjModel, name: str) -> int:
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if joint >= 0 and model.jnt_limited[joint]:
        return joint
    known = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in range(model.njnt) if model.jnt_limited[j]]
    raise ValueError(
        f"leave_out.limits must name joints with limits, got {name!r}; "
        f"those that have: {', '.join(filter(None, known)) or 'none'}"
    )


def _in_words(omitted: list[OmittedPair], total: int, wanted: LeaveOut) -> list[Omission]:
    distances = [one.distance for one in omitted if one.distance is not None]
    claimed = [one for one in omitted if one.distance is None]
    omissions = []
    if distances:
        proven = [one for one in omitted if one.distance is not None]
        trusted = (
            "at all angles of their joints"
            if wanted.beyond_limits is None
            else f"while no joint leaves its range by more than {wanted.beyond_limits:g}"
        )
        reason = f"proven at least {1e3 * min(distances):.3g} mm apart {trusted}: {_listed(proven)}"
        omissions.append(Omission(f"contact of {len(proven)} of {total} pairs", reason))
    if claimed:
        omissions.append(Omission(f"contact of {len(claimed)} of {total} pairs", f"as asked: {_listed(claimed)}"))
    if wanted.limits:
        omissions.append(Omission(f"{len(wanted.limits)} of the joint limits", f"as asked: {', '.join(wanted.limits)}"))
    return omissions


def _listed(omitted: list[OmittedPair]) -> str:
    shown = ", ".join(str(one.pair) for one in omitted[:4])
    return shown + (f" + {len(omitted) - 4} more" if len(omitted) > 4 else "")


def _num_rows(model: mujoco.MjModel) -> int:
    return len(make_efc_type(model))
