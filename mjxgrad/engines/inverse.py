r"""The derivative of a step of C MuJoCo from its solution.

A step solves R(q, v, a; ...) = 0 for the mean acceleration a = (v' - v)/h, with R inverse dynamics less what acts: inertia, bias,
passive forces, constraints, less actuators and applied forces. R is an explicit function, so

    ∂a/∂x = -(∂R/∂a)⁻¹ ∂R/∂x,     v' = v + h a,     q' = q ⊕ h v',

and no difference contains an iteration of a solver: nothing that its tolerance leaves is divided by a width. `mj_inverse` with
`mjENBL_INVDISCRETE` is R for all integrators but Runge-Kutta. Only differences by positions need kinematics and collisions.

- **Width.** R is as exact as rounding, so positions move by 2⁻³⁰ (m or rad) to one side: wider differences meet more surfaces.
  Without constraints they move by 2⁻²² to both sides, and by 1e-6 where contacts are found by iterations, to 1e-6.
- **Actuators.** Each force depends on the actuator's own length, velocity, control and activations, so all are changed at once,
  and the moment arms carry the result. Where the integrator's matrix depends on controls (muscles, gains by velocity), where
  joints or tendons limit forces, or actuators are coupled, each is changed alone, and R is taken anew.
- **Without R** (Runge-Kutta, noslip, delays, plugins, steps whose residual is not zero) `engines.jacobians` takes whole steps.

`mjd_transitionFD` keeps the integrator's factorisation while it changes what that depends on: muscles and dampers are off by up
to a quarter there.

References:
    Todorov. Convex and analytically-invertible dynamics with contacts and constraints. ICRA 2014.
"""

from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad.engines.layout import EVERY, Layout

# Of positions with and without constraints (m or rad): powers of two change a number by just that.
_NARROW, _FREE = 2.0**-30, 2.0**-22
_SPEED = 2.0**-24  # m/s or rad/s
_WIDTH = 1e-6  # of activations and controls
_PUSH = 1e-5  # m/s² or rad/s², by which R is nearly linear: forces have kinks where friction reaches its cone
_RESIDUAL = 1e-6  # of the largest force, above which a step has no R that is zero
_TINY = 1e-30
_VELOCITY = mujoco.mjtStage.mjSTAGE_POS.value  # the stage that is done: velocities are next
# Shapes whose contacts with all but planes are found by iterations.
_ITERATED = tuple(
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}").value for name in ("HFIELD", "ELLIPSOID", "CYLINDER", "MESH", "SDF")
)
_OWN_GAINS = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE, mujoco.mjtGain.mjGAIN_MUSCLE)
# Those whose matrix has the derivatives of forces by velocity; the last is known to later releases alone.
_IMPLICIT = tuple(
    getattr(mujoco.mjtIntegrator, f"mjINT_{name}").value
    for name in ("IMPLICIT", "IMPLICITFAST", "DISCRETE")
    if hasattr(mujoco.mjtIntegrator, f"mjINT_{name}")
)
_Found = dict[str, np.ndarray]
_BY_POTENTIAL = getattr(mujoco.mjtEnableBit, "mjENBL_IPC", 0)


def has_inverse(model: mujoco.MjModel) -> bool:
    """Return whether inverse dynamics has all that a step of this model does."""
    opt = model.opt
    is_staged = opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    is_other = opt.enableflags & int(_BY_POTENTIAL)
    return not (is_staged or is_other or opt.noslip_iterations or model.nhistory or model.nplugin)


class Inverse:
    """R of one model and its derivatives, with memory of its own; `model` is solved to the end and may be changed."""

    def __init__(self, model: mujoco.MjModel, layout: Layout):
        self.model, self.layout, self.data = model, layout, mujoco.MjData(model)
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_INVDISCRETE
        data, self.moment = self.data, np.zeros((model.nu, model.nv))
        self.qpos, self.qvel, self.qacc, self.act, self.ctrl = data.qpos, data.qvel, data.qacc, data.act, data.ctrl
        self.low, self.high = np.where(
            np.asarray(model.actuator_ctrllimited, bool)[:, None], model.actuator_ctrlrange, [[-np.inf, np.inf]]
        ).T
        depends = model.actuator_gaintype != mujoco.mjtGain.mjGAIN_FIXED
        is_coupled = bool(
            (~np.isin(model.actuator_gaintype, _OWN_GAINS)).any()
            or model.jnt_actfrclimited.any()
            or model.tendon_actfrclimited.any()
            or (model.opt.integrator in _IMPLICIT and depends.any())
        )
        self.filters = model.geom_contype, model.body_contype, model.geom_conaffinity, model.body_conaffinity
        self.filtered = [one.copy() for one in self.filters]
        self.touching = [np.zeros_like(one) for one in self.filters[:2]]
        self.is_coupled, self.is_pulled = is_coupled, False
        self.is_implicit = model.opt.integrator in _IMPLICIT and model.nu > 0
        # The last entry is for -1, the vertices of flexible bodies.
        self.is_iterated = np.append(np.isin(model.geom_type, _ITERATED), True)
        self.has_iterated = bool(self.is_iterated[:-1].any()) or model.nflex > 0
        self.is_plane = np.append(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, False)
        of_act = np.zeros(model.na, int)
        order = np.zeros(model.na, int)
        for actuator, (first, count) in enumerate(zip(model.actuator_actadr, model.actuator_actnum, strict=True)):
            if count > 0:
                of_act[first : first + count], order[first : first + count] = actuator, np.arange(count)
        self.of_act, self.order = of_act, order

    def _set(self, row: np.ndarray, acceleration: np.ndarray) -> None:
        mujoco.mj_setState(self.model, self.data, row, EVERY)
        self.is_pulled = bool(row[self.layout.places["xfrc_applied"]].any())
        self.qacc[:] = acceleration
        if self.is_implicit:
            self.residual()  # the integrator's matrix asks which actuators are at their limits, as they last were

    def residual(self, skip: int = 0) -> Float[np.ndarray, " nv"]:
        """Return inverse dynamics less actuators of what is in `data`; stages before may be skipped."""
        model, data = self.model, self.data
        mujoco.mj_inverseSkip(model, data, skip, 1)
        found = data.qfrc_inverse.copy()
        if model.nu:
            mujoco.mj_fwdActuation(model, data)
            found -= data.qfrc_actuator
        return found

    def applied(self) -> Float[np.ndarray, " nv"]:
        data, found = self.data, self.data.qfrc_applied.copy()
        for body in np.flatnonzero(data.xfrc_applied.any(axis=1)).tolist() if self.is_pulled else ():
            force, torque = np.split(data.xfrc_applied[body], 2)
            mujoco.mj_applyFT(self.model, data, force, torque, data.xipos[body], body, found)
        return found

    def blocks(self, row: np.ndarray, acceleration: np.ndarray, found: _Found) -> bool:
        """Write the derivatives of R, inputs first, at a state and its acceleration; return whether R is zero there."""
        # They are "qpos", "qvel", "qacc" of R; "act" and "ctrl", where there are such, of R and, as "next ...", of activations.
        model, data = self.model, self.data
        self._set(row, acceleration)
        self._by_position(found["qpos"])
        # Friction by elliptic cones is curved: there both sides are needed.
        is_curved = bool(model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and data.ncon)
        self._difference(found["qvel"], 1, _SPEED, on_both_sides=is_curved)
        self._difference(found["qacc"], 2, _PUSH, on_both_sides=is_curved)
        # The last difference moved accelerations alone.
        self.qacc[:] = acceleration
        at = self.residual(_VELOCITY)
        if model.nu or model.na:
            (self._one_by_one if self.is_coupled else self._all_at_once)(found)
            mujoco.mj_setState(model, data, row, EVERY)
        if self.is_pulled:
            self._by_applied(found["qpos"])
        # Of the largest force, by squares: this is asked at every step.
        off, forces = at - self.applied(), (data.qfrc_bias, data.qfrc_constraint, data.qfrc_inverse)
        return bool(off @ off <= _RESIDUAL**2 * max(sum(one @ one for one in forces), _TINY))

    def _difference(self, found: np.ndarray, place: int, width: float, *, on_both_sides: bool) -> None:
        """Write a difference by positions, velocities or accelerations: that of this place among `mjd_inverseFD`'s."""
        arguments: list[np.ndarray | None] = [None] * 7
        arguments[place] = found
        mujoco.mjd_inverseFD(self.model, self.data, width, True, *arguments)
        if on_both_sides:
            arguments[place] = other = np.empty_like(found)
            mujoco.mjd_inverseFD(self.model, self.data, -width, True, *arguments)
            found += other
            found *= 0.5

    def _by_position(self, found: np.ndarray) -> None:
        """Write differences by positions, with those geoms alone that touch: no others come to touch within a width."""
        model, data = self.model, self.data
        geoms = np.asarray(data.contact.geom).reshape(-1, 2) if data.ncon else None
        if not model.nflex:
            for touching, owners in zip(self.touching, (None, model.geom_bodyid), strict=True):
                touching[:] = 0
                if geoms is not None:
                    touching[geoms if owners is None else owners[geoms]] = 1
            for one, before, touching in zip(self.filters, self.filtered, 2 * self.touching, strict=True):
                np.multiply(before, touching, out=one)
        is_searched = self.has_iterated and geoms is not None
        is_searched = is_searched and (self.is_iterated[geoms].any(axis=1) & ~self.is_plane[geoms].any(axis=1)).any()
        width = _FREE if not data.nefc else _WIDTH if is_searched else _NARROW
        self._difference(found, 0, width, on_both_sides=width != _NARROW)
        for one, before in zip(self.filters, self.filtered, strict=True):
            one[:] = before

    def _by_applied(self, found: np.ndarray) -> None:
        """Take what positions change of forces that are applied to bodies."""

        def at() -> np.ndarray:
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            return self.applied()

        for dof in range(self.model.nv):
            found[dof] -= self._by_turn(dof, at)
        at()

    def _by_turn(self, dof: int, at: Callable[[], np.ndarray]) -> np.ndarray:
        before, ends = self.qpos.copy(), []
        for side in (_WIDTH, -_WIDTH):
            mujoco.mj_integratePos(self.model, self.qpos, side * np.eye(1, self.model.nv, dof)[0], 1.0)
            ends.append(at())
            self.qpos[:] = before
        return (ends[0] - ends[1]) / (2 * _WIDTH)

    def _apart(
        self, entry: np.ndarray, index: np.ndarray | slice, at: Callable[[], tuple[np.ndarray, ...]]
    ) -> tuple[np.ndarray, ...]:
        """Return how far apart what is found on both sides of some entries is, and how far apart the entries are."""
        kept, ends = entry[index].copy(), []
        if entry is self.ctrl:
            up, down, width = self.sides(kept, _WIDTH, index)
        else:
            up, down, width = kept + _WIDTH, kept - _WIDTH, np.full(len(kept), 2 * _WIDTH)
        for value in (up, down):
            entry[index] = value
            ends.append(at())
        entry[index] = kept
        return *(one - other for one, other in zip(*ends, strict=True)), width

    def _next(self) -> np.ndarray:
        """Return the activations after the step, and leave the state as it was."""
        if not self.model.na:
            return self.act.copy()
        kept = [one.copy() for one in (self.qpos, self.qvel, self.act)]
        mujoco.mj_Euler(self.model, self.data)
        end = self.act.copy()
        self.qpos[:], self.qvel[:], self.act[:] = kept
        return end

    def sides(self, ctrl: np.ndarray, width: float, index: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, ...]:
        """Return controls moved up and down, those within their limits no farther, and the distances between."""
        low, high, up, down = self.low[index], self.high[index], ctrl + width, ctrl - width
        is_inside = (ctrl >= low) & (ctrl <= high)
        up, down = np.where(is_inside, np.minimum(up, high), up), np.where(is_inside, np.maximum(down, low), down)
        return up, down, np.maximum(up - down, _TINY)

    def at(self, row: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R and the next activations at a state and an acceleration."""
        self._set(row, acceleration)
        found = self.residual() - self.applied()
        return found, self._next()

    def solutions(
        self, row: np.ndarray, acceleration: np.ndarray, matrix: np.ndarray, places: Float[np.ndarray, "places nq"]
    ) -> Float[np.ndarray, "places nv"]:
        """Return the accelerations that solve R = 0 at other positions, by Newton's method with the derivative at hand."""
        # Two steps: the first follows the geometry, the second takes what forces then have beyond their linear change.
        found = []
        try:
            inverse = np.linalg.inv(matrix.T)
        except np.linalg.LinAlgError:
            inverse = _of_divergence(matrix.T)
        self._set(row, acceleration)
        for place in places:
            self.qpos[:], self.qacc[:] = place, acceleration
            self.qacc -= inverse @ (self.residual() - (force := self.applied()))
            self.qacc -= inverse @ (self.residual(_VELOCITY) - force)
            found.append(self.qacc.copy())
        return np.array(found)

    def _all_at_once(self, found: _Found) -> None:
        model, data = self.model, self.data
        mujoco.mju_sparse2dense(
            self.moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )

        def forces() -> tuple[np.ndarray, np.ndarray]:
            mujoco.mj_fwdActuation(model, data)
            return data.actuator_force.copy(), self._next()

        def changes(entry: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return the derivatives of forces and of next activations, each by its own actuator's entry."""
            force, following, width = self._apart(entry, index, forces)
            owner = self.of_act[index] if entry is self.act else index
            by_force, per_act = np.zeros((2, model.nu))
            by_force[owner], per_act[owner] = force[owner] / width, width
            own = per_act[self.of_act]
            return by_force, np.where(own > 0, following / np.maximum(own, _TINY), 0.0)

        every = np.arange(model.nu)
        by_force, of_next = changes(self.ctrl, every)
        found["ctrl"][:] = -by_force[:, None] * self.moment
        if not model.na:
            return
        found["next ctrl"][:] = 0.0
        found["next ctrl"][self.of_act, np.arange(model.na)] = of_next
        found["act"][:] = found["next act"][:] = 0.0
        for number in range(self.order.max() + 1):
            chosen = np.flatnonzero(self.order == number)
            by_force, of_next = changes(self.act, chosen)
            found["act"][chosen] = -by_force[self.of_act[chosen], None] * self.moment[self.of_act[chosen]]
            for one in chosen:
                own = np.flatnonzero(self.of_act == self.of_act[one])
                found["next act"][one, own] = of_next[own]
        for name, entry in (("qpos", data.actuator_length), ("qvel", data.actuator_velocity)):
            _, of_next = changes(entry, every)
            found[f"next {name}"][:] = (of_next[:, None] * self.moment[self.of_act]).T

    def _one_by_one(self, found: _Found) -> None:
        for name, entry in (("ctrl", self.ctrl), ("act", self.act)):
            for k in range(len(entry)):
                both = self._apart(entry, slice(k, k + 1), lambda: (self.residual(_VELOCITY), self._next()))
                found[name][k], found[f"next {name}"][k] = both[0] / both[2], both[1] / both[2]
        if not self.model.na:
            return

        def following() -> np.ndarray:
            mujoco.mj_inverse(self.model, self.data)
            mujoco.mj_fwdActuation(self.model, self.data)
            return self._next()

        for dof in range(self.model.nv):
            found["next qpos"][dof] = self._by_turn(dof, following)
            change, width = self._apart(self.qvel, slice(dof, dof + 1), lambda: (following(),))
            found["next qvel"][dof] = change / width


def shapes(model: mujoco.MjModel) -> dict[str, tuple[int, int]]:
    """Return the shapes of what `Inverse.blocks` writes."""
    nv, na, nu = model.nv, model.na, model.nu
    found = {"qpos": (nv, nv), "qvel": (nv, nv), "qacc": (nv, nv), "act": (na, nv), "ctrl": (nu, nv)}
    return found | {f"next {name}": (found[name][0], na) for name in ("qpos", "qvel", "act", "ctrl")}


def _of_divergence(matrices: Float[np.ndarray, "*rows nv nv"]) -> Float[np.ndarray, "*rows nv nv"]:
    """Return some inverse of matrices that have none: those of motions that diverge, which are flagged elsewhere."""
    return np.linalg.pinv(np.where(np.isfinite(matrices), matrices, 0.0))


def step_of(
    layout: Layout, timestep: float, speeds: Float[np.ndarray, "rows nv"], found: _Found, names: list[str]
) -> _Found:
    """Return the derivatives of steps by "state" and by names of other inputs and numbers, from those of R, inputs first."""
    # Speeds are those after the steps. What is found is as of `Inverse.blocks`, and of each name, with "next" of activations.
    nv, na = layout.nv, found["act"].shape[-2]
    every = ["qpos", "qvel", "act", *names]
    sizes = [found[name].shape[-2] for name in every]
    right = np.swapaxes(np.concatenate([found[name] for name in every], axis=-2), -1, -2)
    matrices = np.swapaxes(found["qacc"], -1, -2)
    try:
        change = -timestep * np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        change = -timestep * _of_divergence(matrices) @ right
    change[..., nv : 2 * nv] += np.eye(nv)
    turned = timestep * speeds
    moved = layout.follow(turned, timestep * change)
    moved[..., :nv] += layout.carry(turned, np.broadcast_to(np.eye(nv), (*speeds.shape[:-1], nv, nv)))
    ends = np.cumsum(sizes)
    for name, begin, end in zip(every[4:], ends[3:-1], ends[4:], strict=True):
        moved[..., begin:end] += layout.carry(turned, np.swapaxes(found[f"shift {name}"], -1, -2))
    rows = [moved, change]
    if na:
        rows.append(np.swapaxes(np.concatenate([found[f"next {name}"] for name in every], axis=-2), -1, -2))
    whole = np.concatenate(rows, axis=-2)
    parts = np.split(whole, np.cumsum(sizes)[:-1], axis=-1)
    return {"state": np.concatenate(parts[:3], axis=-1), **dict(zip(names, parts[3:], strict=True))}
