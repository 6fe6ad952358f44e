r"""The slope of C MuJoCo's outcome: derivatives of a step that know of the contacts and limits about to begin or end.

MuJoCo decides once per step whether a contact or limit acts, by the sign of its gap r (distance less margin). The step is
therefore a smooth map with jumps at r = 0, which its Jacobian A₀, by differences of any small width, does not see. Yet a
change of the start moves each crossing to another step. Where trajectories that differ in phase fill the gap evenly, as in
flight, the expected derivative of a step is that over the travel of one step about r = 0:

    A = A₀ (1 - P L) + D L,        D_i = (f(q⁺_i) - f(q⁻_i)) / 2w_i,        L = (J, τJ),        J P = 1,

for the events i, the rows with |r_i| < w_i. J holds their normal rows, P displacements of which each changes one gap alone, and
q±_i is the present position moved along P_i until its gap is ±w_i. Each crossing is met by one step, and lies τ = -r / Jv from
its start. A is a matrix of rank one per event, as saltation matrices are: an event costs four more steps.

- **Followed.** f(q⁺) has not been pushed yet, and what follows is not linear between two states so far apart. So both go on until
  A₀ explains how they differ, see `engines.flight`. Without, derivatives of a hopper scatter ten to thirty times as far.
- **Together.** What each corner of a box that lands flat does depends on the others. Contacts that share coordinates are taken by
  modes, the left singular vectors of their rows. A mode is as large as moves one gap by 1, and q± lies about the position where
  all of their gaps are zero. Modes that move something ten times as far as a gap are left to A₀, and limits are alone.
- **Several stages.** A Runge-Kutta step looks at contacts at four places along its way. A window about -hv/2, somewhat wider,
  holds all, with as much less weight. Both motions are followed for two steps alone.
- **Width.** w = max(h/2 |J v|, h/2 |J v'|, ε), v and v' the velocities before and after the step, ε = 0.06 of the impedance's
  width, at most 0.06 mm or mrad. v' and ε bound what contacts that chatter multiply; these move by h² |J a|, less what damping
  keeps. Wider windows are biased, and ε is at most four steps of travel: a contact that rests crosses nothing.
- **Displacement.** P is the smallest that changes the gaps by 1, measured by how far a coordinate moves the farthest point of its
  bodies. Other rows that it would carry across zero (a knee at its limit under a foot that lands) are held where they are.
- **Geometry.** Where edges or corners touch, A₀ is along 1 - P J, by displacements that move a body's farthest point 0.06 mm. The
  lowest point of a standing cylinder runs along its rim at tilts of the size of rounding, and small differences see that.
- **Undecided.** A gap that no coordinate moves and that is zero to rounding opens and closes at random. Differences are then
  taken with margins by which it stays as it was in the step itself.
- **Small differences** are those of `engines.inverse`, taken a little farther off where a gap is smaller than they are, also for
  "discrete" gradients. Where they are steeper than any contact, whole steps and narrower differences take their place.
- **Sizes and places.** What moves a gap at a rate R (a radius, a mocap body's place, a joint's range) moves the crossing as
  displacements P R do, and has D R. Its small differences are taken at the same gap, that is with -P R added to the position.
- **Limits.** Jumps that are no event remain unseen: hit or miss, an edge that catches. Where the phases of a motion do not fill
  several steps the slope is ill defined.

References:
    Kong, Payne, Zhu, Johnson. Saltation matrices: the essential tool for linearizing hybrid dynamical systems. arXiv:2306.06862.
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022, arXiv:2202.00817.
"""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjxgrad.stepping import slope

HAIR = 6e-5
"""How far surfaces are moved to average the geometry of contacts (m)."""
_LARGEST_TURN = 0.02  # rad, of the smallest bodies
_NOTHING = 1e-30
_ROUNDING = 1e-9  # m or rad, of gaps
_SMOOTH = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
_LIMITS = (mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT.value, mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON.value)

_Rows = Float[np.ndarray, "rows nv"]
_PerRow = Float[np.ndarray, " rows"]
_PerDof = Float[np.ndarray, " nv"]
_Mask = Bool[np.ndarray, " rows"]


@dataclass(frozen=True)
class Events:
    """Contacts and limits that a step may begin or end, by modes."""

    rows: Float[np.ndarray, "modes nv"]  # J, the rate of each mode by joint velocity
    ahead: Float[np.ndarray, "modes nv"]  # Jτ, what a joint velocity adds to each mode until the crossing (s)
    moves: Float[np.ndarray, "nv modes"]  # P, the displacement that changes one mode by one and leaves the others
    middles: Float[np.ndarray, "nv modes"]  # the displacement to where the gaps of the mode's events are zero
    widths: Float[np.ndarray, " modes"]  # half of what is spanned (m or rad)
    surfaces: Float[np.ndarray, "events nv"]  # J of the events themselves
    gaps: Float[np.ndarray, " events"]  # their distances less margins at present (m or rad)
    centres: Float[np.ndarray, " events"]  # their gaps in the middle; zero, but for steps of several stages (m or rad)
    weights: Float[np.ndarray, "modes events"]  # how much each event counts in each mode
    index: Int[np.ndarray, " events"]  # which of all rows they are


@dataclass(frozen=True)
class Near:
    """Contacts and limits near a position."""

    events: Events | None  # those that the step may begin or end, or None
    # The velocities that move one body of a contact that acts, or may, where a body has edges or corners.
    rough: Int[np.ndarray, " some"]
    is_undecided: bool  # whether rounding decides if a contact or limit acts
    rows: Float[np.ndarray, "others nv"]  # J of the other contacts and limits whose force begins with a jump
    gaps: Float[np.ndarray, " others"]  # their gaps (m or rad)
    lengths: _PerDof  # how far each joint velocity moves the farthest point of its bodies (m or 1)

    def widths(self, changes: Float[np.ndarray, "some nv"]) -> Float[np.ndarray, " some"]:
        """Return by how many times each displacement moves a body's farthest point a hair's breadth, across no surface."""
        sizes = np.abs(changes)
        moved = np.maximum(np.abs(changes @ self.rows.T), _NOTHING)
        crossing = np.min(np.abs(self.gaps) / moved, axis=1, initial=np.inf)
        return np.min(
            [HAIR / (self.lengths * sizes).max(axis=1), _LARGEST_TURN / sizes.max(axis=1), 0.9 * crossing], axis=0
        )


class Surfaces:
    """The gaps of a model's contacts and limits, also of those that do not act yet."""

    def __init__(self, model: mujoco.MjModel, levers: Float[np.ndarray, "nbody nv"]):
        self.levers, self.lengths = levers, levers.max(axis=0)
        self.timestep, self.is_moved = model.opt.timestep, levers > 0
        self.longest = max(1.0, self.lengths.max(initial=0.0))
        self.kept = kept_by_damping(model)
        self.has_stages = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        # The last entry is for -1, the vertices of flexible bodies.
        self.is_rough = np.append(~np.isin(model.geom_type, _SMOOTH), False)
        self.plain, self.model = model, copy.deepcopy(model)
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.widen(np.zeros((1, model.nv)))

    def widen(self, speeds: Float[np.ndarray, "states nv"]) -> None:
        """Widen all margins by what states of these speeds travel in half a step, at most."""
        self.contact_reach, self.limit_reach = self._reach(np.max(np.abs(speeds), axis=0, initial=0.0))
        _widen(self.model, self.plain, self.contact_reach, self.limit_reach)

    def _reach(self, speed: _PerDof) -> tuple[float, float]:
        """Return how far contacts and limits travel in half a step at most."""
        travel, least = self.timestep * (1.5 if self.has_stages else 0.5) * speed, slope.LEAST_WIDTH * slope.USUAL_WIDTH
        return float(np.sort(self.levers @ travel)[-2:].sum()) + least, float(travel.sum() * self.longest) + least

    def beside(self, change: float, data: mujoco.MjData) -> tuple[_PerDof | None, bool]:
        """Return the displacement after which changes of this size cross no surface, or None, and whether rounding decides."""
        mujoco.mj_fwdPosition(self.model, data)
        # Most positions are far from all, which these few operations tell.
        all_gaps = data.efc_pos - data.efc_margin + self.contact_reach
        if np.abs(all_gaps).min(initial=np.inf) > 4 * change * self.longest:
            return None, False
        _, rows, gaps, least, jumps = self._gaps(data)
        is_moved = self._moves(rows)
        near = jumps & is_moved & (np.abs(gaps) < least)
        is_undecided = bool((jumps & ~is_moved & (np.abs(gaps) < _ROUNDING)).any())
        return (clearance(change, rows[near], gaps[near], 0.0) if near.any() else None), is_undecided

    def near(self, data: mujoco.MjData, before: _PerDof, after: _PerDof, free: _PerDof) -> "Near | None":
        """Return what is near the position in `data`, moving as before and after the step; None if nothing is."""
        mujoco.mj_fwdPosition(self.model, data)
        if not data.nefc:
            return None
        is_rough, rows, gaps, least, jumps = self._gaps(data)
        is_contact = np.arange(len(rows)) < np.count_nonzero(np.asarray(data.contact.efc_address) >= 0)
        # What is near one state may not depend on how fast others move.
        gaps = np.where(gaps < np.where(is_contact, *self._reach(np.abs(before))), gaps, np.inf)
        rate, centres = rows @ before, np.zeros(len(rows))
        travel = self.timestep * np.maximum(np.abs(rate), np.abs(rows @ after))
        widths = 0.5 * travel
        if self.has_stages:
            # They meet the surface at gaps of 0, -hv/2 and -hv, and a little beyond where v changes on the way.
            centres, widths = -0.5 * self.timestep * rate, slope.STAGES * widths
        fall = self.timestep**2 * np.abs(rows @ (self.kept * free))
        # A contact that rests crosses nothing, however near its surface it rests.
        slow = np.maximum(np.minimum(fall, slope.STIRRED * travel), slope.SMALLEST)
        widths = np.maximum(widths, np.minimum(least, slow))
        is_rough &= gaps - centres < widths
        is_moved = self._moves(rows)
        is_undecided = jumps & ~is_moved & (np.abs(gaps) < _ROUNDING)
        jumps &= is_moved
        chosen = (np.abs(gaps - centres) < widths) & jumps
        events = None
        if chosen.any():
            is_met = np.abs(gaps) < self.timestep * np.abs(rate)
            times = -np.where(is_met, gaps, 0.0) / np.where(is_met, rate, 1.0)
            events = _by_modes(rows, gaps, centres, widths, times, chosen, is_contact, self.lengths)
        others = jumps & ~chosen & np.isfinite(gaps)  # a force that begins without a jump may be crossed
        return Near(
            events, self._movers(data, is_rough), bool(is_undecided.any()), rows[others], gaps[others], self.lengths
        )

    def _movers(self, data: mujoco.MjData, is_rough: _Mask) -> Int[np.ndarray, " some"]:
        """Return the velocities that move one body of a chosen contact and not the other."""
        if not is_rough.any():
            return np.zeros(0, int)
        contact = data.contact
        geoms = np.asarray(contact.geom).reshape(-1, 2)[np.asarray(contact.efc_address) >= 0]
        chosen = geoms[is_rough[: len(geoms)]]
        if (chosen < 0).any():
            return np.arange(self.model.nv)
        first, second = self.is_moved[self.model.geom_bodyid[chosen]].swapaxes(0, 1)
        return np.flatnonzero((first != second).any(axis=0))

    def _moves(self, rows: _Rows) -> _Mask:
        return np.linalg.norm(rows / self.lengths, axis=1) > 1 / slope.FARTHEST

    def gaps(self, data: mujoco.MjData) -> tuple[bytes, _PerRow]:
        """Return what the rows of contacts and limits belong to, and their gaps, at the position in `data`."""
        mujoco.mj_fwdPosition(self.model, data)
        acts, first, limits = self._addresses(data)
        owners = np.asarray(data.contact.geom).reshape(-1, 2)[acts], data.efc_type[limits], data.efc_id[limits]
        return b";".join(one.tobytes() for one in owners), self._gaps_at(data, first, limits)

    def _addresses(self, data: mujoco.MjData) -> tuple[_Mask, Int[np.ndarray, " contacts"], Int[np.ndarray, " limits"]]:
        """Return which contacts act, and the first rows of these and of limits."""
        first, kinds = np.asarray(data.contact.efc_address), data.efc_type
        return first >= 0, first[first >= 0], np.flatnonzero((kinds == _LIMITS[0]) | (kinds == _LIMITS[1]))

    def _gaps_at(self, data: mujoco.MjData, first: Int[np.ndarray, " n"], limits: Int[np.ndarray, " m"]) -> _PerRow:
        reach = np.repeat([self.contact_reach, self.limit_reach], [len(first), len(limits)])
        address = np.concatenate([first, limits])
        return data.efc_pos[address] - data.efc_margin[address] + reach

    def _gaps(self, data: mujoco.MjData) -> tuple[_Mask, _Rows, _PerRow, _PerRow, _Mask]:
        """Return of contacts and limits whether they are rough, J, gap, least width, and whether force jumps."""
        model, jacobian = self.model, data.efc_J.reshape(-1, self.model.nv)
        contact, (acts, first, limits) = data.contact, self._addresses(data)
        is_pyramid = (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL) & (np.asarray(contact.dim)[acts] > 1)
        # The first two edges of a pyramid, n + μt and n - μt, have the normal as their mean.
        other = first + is_pyramid
        is_joint = data.efc_type[limits] == _LIMITS[0]
        solimp = [np.asarray(contact.solimp).reshape(-1, 5)[acts]]
        for i, joint in zip(data.efc_id[limits].tolist(), is_joint.tolist(), strict=True):
            solimp.append((model.jnt_solimp if joint else model.tendon_solimp_lim)[i : i + 1])
        first_impedance, _, width, *_ = np.concatenate(solimp).T
        width = np.where(width > 0, np.minimum(width, slope.USUAL_WIDTH), slope.USUAL_WIDTH)
        rows = np.concatenate([0.5 * (jacobian[first] + jacobian[other]), jacobian[limits]])
        is_rough = np.zeros(len(rows), bool)
        is_rough[: len(first)] = self.is_rough[np.asarray(contact.geom).reshape(-1, 2)[acts]].any(axis=1)
        gaps, jumps = self._gaps_at(data, first, limits), first_impedance > slope.NO_JUMP
        return is_rough, rows, gaps, slope.LEAST_WIDTH * width, jumps


def kept_by_damping(model: mujoco.MjModel) -> _PerDof:
    """Return how much of each velocity damping leaves after a step."""
    return 1 / (1 + model.opt.timestep * model.dof_damping * model.dof_invweight0)


def _widen(far: mujoco.MjModel, model: mujoco.MjModel, contact: float, limit: float) -> None:
    """Let contacts and limits act at gaps larger by so much (m; m or rad)."""
    far.geom_margin[:] = model.geom_margin + contact / 2
    far.body_margin[:] = model.body_margin + contact / 2  # else bodies of several geoms are searched as before
    far.flex_margin[:] = model.flex_margin + contact / 2
    far.pair_margin[:] = model.pair_margin + contact
    far.opt.o_margin = model.opt.o_margin + contact
    far.jnt_margin[:] = model.jnt_margin + limit
    far.tendon_margin[:] = model.tendon_margin + limit


def undecided(model: mujoco.MjModel) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Return copies in which gaps of the size of rounding are closed, and open."""
    both = copy.deepcopy(model), copy.deepcopy(model)
    for other, more in zip(both, (2 * _ROUNDING, -2 * _ROUNDING), strict=True):
        _widen(other, model, more, more)
    return both


def clearance(
    change: float, surfaces: Float[np.ndarray, "events nv"], gaps: _PerRow, centres: _PerRow | float
) -> _PerDof:
    """Return the smallest displacement after which changes of this size cross none of these surfaces."""
    least, off = 4 * change * np.abs(surfaces).max(axis=1), gaps
    if np.any(centres):
        off = gaps - np.outer([0, 1, 2], centres)
        off = np.take_along_axis(off, np.abs(off).argmin(axis=0)[None], axis=0)[0]
    shift = np.where(np.abs(off) < least, np.where(off < 0, -least, least) - off, 0.0)
    return np.linalg.lstsq(surfaces, shift, rcond=1e-3)[0]


def levers_of(model: mujoco.MjModel) -> Float[np.ndarray, "nbody nv"]:
    """Return how far each joint velocity moves the farthest point below it, for each body that it moves (m or 1)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    is_below = np.eye(model.nbody, dtype=bool)
    for body in reversed(range(1, model.nbody)):  # parents come before their children
        is_below[model.body_parentid[body]] |= is_below[body]
    radius = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, 0.0, model.geom_rbound)
    levers = np.zeros((model.nbody, model.nv))
    for dof, joint in enumerate(model.dof_jntid.tolist()):
        kind, first, below = model.jnt_type[joint], model.jnt_dofadr[joint], is_below[model.dof_bodyid[dof]]
        geoms = below[model.geom_bodyid]
        far = np.linalg.norm(data.geom_xpos[geoms] - data.xanchor[joint], axis=1) + radius[geoms]
        moves_along = kind == mujoco.mjtJoint.mjJNT_SLIDE or (kind == mujoco.mjtJoint.mjJNT_FREE and dof < first + 3)
        levers[below, dof] = 1.0 if moves_along else max(far.max(initial=0.0), 1e-3 * model.stat.extent)
    return levers


def _by_modes(
    rows: _Rows,
    gaps: _PerRow,
    centres: _PerRow,
    widths: _PerRow,
    times: _PerRow,
    chosen: _Mask,
    is_contact: _Mask,
    lengths: _PerDof,
) -> Events | None:
    """Return the chosen rows as events, with displacements that change one mode each and carry no other row across zero."""
    scaled, index = rows / lengths, np.flatnonzero(chosen)
    group = _connected(((rows != 0) & is_contact[:, None])[index])
    patterns, widest, groups = [], [], []
    for one in np.unique(group):
        own = np.flatnonzero(group == one)
        left, sizes, _ = np.linalg.svd(scaled[index[own]], full_matrices=False)
        largest = np.abs(left).max(axis=0)
        for weights in (largest * left).T[largest * sizes > 1 / slope.FARTHEST]:
            patterns.append(np.zeros(len(index)))
            patterns[-1][own] = weights
            widest.append(widths[index[own]].max())
            groups.append(one)
    if not patterns:
        return None
    every = np.array(patterns)
    apart = _independent(every @ scaled[index], np.zeros((0, scaled.shape[1])))
    weights, label, width = every[apart], np.array(groups)[apart], np.array(widest)[apart]
    mode = weights @ scaled[index]
    to_middle = np.where(label[:, None] == label, (weights @ (centres[index] - gaps[index]))[:, None], 0.0)
    held, is_free = np.zeros(0, int), ~chosen
    while True:
        kept = held[_independent(scaled[held], mode)] if held.size else held
        moves = np.linalg.pinv(np.concatenate([mode, scaled[kept]]))[:, : len(mode)]
        middles = moves @ to_middle
        reach = np.max(np.abs(scaled @ moves) * width + np.abs(scaled @ middles), axis=1)
        crossed = np.flatnonzero((np.abs(gaps) < reach) & is_free)
        if not crossed.size:
            break
        held, is_free[crossed] = np.concatenate([held, crossed]), False
    ahead, own = (weights * times[index]) @ rows[index], (rows[index], gaps[index], centres[index])
    moves, middles = moves / lengths[:, None], middles / lengths[:, None]
    return Events(mode * lengths, ahead, moves, middles, width, *own, weights, index)


def _connected(moved: Bool[np.ndarray, "rows nv"]) -> Int[np.ndarray, " rows"]:
    shares = (moved.astype(float) @ moved.T > 0) | np.eye(len(moved), dtype=bool)
    group = np.arange(len(moved))
    while not np.array_equal(group, least := np.where(shares, group, len(group)).min(axis=1)):
        group = least
    return group


def _independent(rows: _Rows, others: Float[np.ndarray, "others nv"]) -> list[int]:
    """Return which rows can be changed alone, without moving anything far; the farthest from the others first."""
    basis = np.linalg.qr(others.T)[0].T if len(others) else others
    rest, found = rows - (rows @ basis.T) @ basis, []
    for _ in range(len(rows)):
        size = np.linalg.norm(rest, axis=1)
        size[found] = 0.0
        best = int(np.argmax(size))
        if size[best] < 1 / slope.FARTHEST:
            break
        found.append(best)
        direction = rest[best] / size[best]
        rest = rest - np.outer(rest @ direction, direction)
    return found
