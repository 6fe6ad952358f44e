"""Steps of many worlds by MuJoCo Warp in one call, their derivatives by differences, and what is near their states."""

import copy
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.engines import events
from mjxgrad.engines.bridge import NUMBER, Program, Room, Values
from mjxgrad.stepping import pairs, slope

_POSITION, _VELOCITY, _INPUT = 3e-5, 1e-3, 2e-3  # widths of differences (m or rad; m/s or rad/s; the unit of an input)
_CHANGE, _LEAST_INPUT = 3e-4, 1e-5  # m/s or rad/s that a control's difference may change, and its least width
_CLEAR = 0.8  # of the way to a surface, which differences of positions may go
_LEAST = 2e-6  # of their widths; rounding is 3 % of such a difference
_AT_ONCE = 2**32  # bytes of Warp's data for the worlds of one call
_ROOM = 48  # contacts of a world, unless `max_contacts` says
_MOST_DENSE = 60  # degrees of freedom, from which Warp has sparse rows alone
_TILE = 64  # Warp reads rows in blocks of so many, beyond the end if they do not fit
_NEAREST = 24  # contacts and limits of a world that its slope looks at
_FAR = 1e3  # m or rad: the gap of none
_JOINT, _TENDON = (getattr(mujoco.mjtConstraint, f"mjCNSTR_LIMIT_{name}").value for name in ("JOINT", "TENDON"))
_CONTACT = mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS.value  # and beyond
_PYRAMID = mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL.value
MOTION = ("qpos", "qvel", "act")
INPUTS = ("qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")
_VARIED = (*MOTION, "ctrl", *INPUTS)  # by which there are derivatives
GIVEN = (*_VARIED, "qacc_warmstart", "time")
_FOUND = (*MOTION, "time", "qacc_warmstart", "sensordata")


class Worlds:
    """Steps of many worlds of one C model, and their differences."""

    def __init__(self, mj_model: mujoco.MjModel, room: int | None):
        self.mj_model, contacts = mj_model, room or _ROOM
        dims = np.concatenate([mj_model.geom_condim, mj_model.pair_dim, [1]])
        rows = mj_model.nv + 6 * mj_model.neq + mj_model.njnt + 2 * mj_model.ntendon
        rows += contacts * max(1, 2 * (int(dims.max()) - 1))
        self._room = Room(contacts, -(-rows // _TILE) * _TILE)
        has_limits = mj_model.jnt_limited.any() or mj_model.tendon_limited.any()
        self.has_surfaces = bool(has_limits or mj_model.nflex or mj_model.npair or (mj_model.geom_contype > 0).any())
        self._program = Program(mj_model, "step", (*_FOUND, "overflow"), self._room)
        self._run, self._run_near = self._of_many(self._program), self._of_many(self._surfaces)
        self.step = jax.custom_jvp(self._step)
        self.step.defjvp(self._derived, symbolic_zeros=True)

    def has(self, name: str) -> bool:
        """Return whether Warp has a number of the model."""
        return self._program.has(name)

    def _of_many(self, function: Callable[[Values], Values]) -> Callable[[Values], Values]:
        """Return a function of many worlds, which are the leading axis of all."""

        # One call of Warp takes all of a batch, as far as memory goes.
        @custom_vmap
        def run(given: Values) -> Values:
            count = len(given["qpos"])
            most = max(1, _AT_ONCE // self._program.bytes_each)
            if count > most:
                num = -(-count // most)
                each = -(-count // num)
                padded = {
                    k: jnp.pad(x, [(0, num * each - count)] + [(0, 0)] * (x.ndim - 1), mode="edge")
                    for k, x in given.items()
                }
                found = jax.lax.map(run, {k: x.reshape(num, each, *x.shape[1:]) for k, x in padded.items()})
                return {k: x.reshape(num * each, *x.shape[2:])[:count] for k, x in found.items()}
            dtype = given["qpos"].dtype
            return {k: x.astype(dtype) if eqx.is_inexact_array(x) else x for k, x in function(given).items()}

        @run.def_vmap
        def _(size: int, is_batched: list, given: Values) -> tuple[Values, dict]:
            (flags,) = is_batched
            whole = {k: x if flags[k] else jnp.broadcast_to(x, (size, *x.shape)) for k, x in given.items()}
            found = run({k: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]) for k, x in whole.items()})
            found = {k: x.reshape(size, len(x) // size, *x.shape[1:]) for k, x in found.items()}
            return found, dict.fromkeys(found, True)

        return run

    @functools.cached_property
    def _far(self) -> Program:
        model = copy.deepcopy(self.mj_model)  # whose rows are wanted, in full, and not the solution
        is_sparse = model.nv > _MOST_DENSE
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE if is_sparse else mujoco.mjtJacobian.mjJAC_DENSE
        model.opt.iterations = model.opt.ls_iterations = 1
        names = ("J", "type", "id", "pos", "margin", *(("J_rownnz", "J_rowadr", "J_colind") if is_sparse else ()))
        rows = tuple(f"efc.{name}" for name in names)
        return Program(model, "forward", (*rows, "nefc", "contact.solimp", "qacc_smooth"), self._room)

    @functools.cached_property
    def _widths(self) -> Float[np.ndarray, " nu"]:
        """Return widths of controls: small for a stiff servo, since dry friction and contacts let go beyond a change of speed."""
        model = self.mj_model
        speed = model.opt.timestep * model.actuator_acc0 * np.abs(model.actuator_gainprm[:, 0])  # by a control of 1
        return np.clip(_CHANGE / np.maximum(speed, 1e-9), _LEAST_INPUT, _INPUT).astype(np.float32)

    @functools.cached_property
    def _levers(self) -> Float[np.ndarray, "nbody nv"]:
        return events.levers_of(self.mj_model)

    def _surfaces(self, given: Values) -> Values:
        """Return the nearest contacts and limits of each world."""
        extra = jax.vmap(self._extra)(given)
        names = {"geom_margin": "contact", "pair_margin": "contact", "jnt_margin": "limit", "tendon_margin": "limit"}
        margins = {}
        for name, kind in names.items():
            own = given.get(NUMBER + name, jnp.asarray(getattr(self.mj_model, name), jnp.float32))
            margins[NUMBER + name] = own + extra[kind][:, None] * (0.5 if name == "geom_margin" else 1.0)
        found = self._far(given | margins)
        solimp = found.pop("contact.solimp")
        numbers = {k: x for k, x in given.items() if k.startswith(NUMBER)}
        return jax.vmap(functools.partial(self._nearest, solimp))(found, extra, numbers)

    def _extra(self, given: Values) -> dict[str, Array]:
        """Return by how much margins are larger than a world's own: what a state travels in half a step, at most."""
        # As `events.Surfaces` does.
        model, levers = self.mj_model, self._levers
        least = slope.LEAST_WIDTH * slope.USUAL_WIDTH
        stages = 1.5 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.5
        timestep = given.get(NUMBER + "opt.timestep", jnp.asarray(model.opt.timestep))
        travel = stages * timestep * jnp.abs(given["qvel"])
        contact = least + jax.lax.top_k(levers @ travel, 2)[0].sum()
        return {"contact": contact, "limit": least + max(1.0, levers.max(initial=0.0)) * travel.sum()}

    def _nearest(self, solimps: Float[Array, "contacts 5"], found: Values, extra: Values, numbers: Values) -> Values:
        kind, index = found["efc.type"], found["efc.id"]
        is_contact, is_joint = kind >= _CONTACT, kind == _JOINT
        is_first = jnp.concatenate([jnp.ones(1, bool), (index[1:] != index[:-1]) | ~is_contact[:-1]])
        is_one = (is_contact & is_first) | is_joint | (kind == _TENDON)
        is_one &= jnp.arange(len(kind)) < found["nefc"]
        gaps = found["efc.pos"] - found["efc.margin"] + jnp.where(is_contact, extra["contact"], extra["limit"])
        gaps = jnp.where(is_one, gaps, _FAR)
        nearest = jax.lax.top_k(-jnp.abs(gaps), min(_NEAREST, len(gaps)))[1]
        is_contact, is_joint, index = is_contact[nearest], is_joint[nearest], index[nearest]
        # The first two edges of a pyramid, n + μt and n - μt, have the normal as their mean.
        other = nearest + (kind[nearest] == _PYRAMID)
        normals = 0.5 * (self._rows(found, nearest) + self._rows(found, other))
        solimp = solimps.at[index].get(mode="clip")
        for name, is_own in (("jnt_solimp", is_joint), ("tendon_solimp_lim", ~is_contact & ~is_joint)):
            table = numbers.get(NUMBER + name, jnp.asarray(getattr(self.mj_model, name), jnp.float32))
            if len(table):
                solimp = jnp.where(is_own[:, None], table.at[index].get(mode="clip"), solimp)
        is_one = is_one[nearest]
        return {
            "rows": jnp.where(is_one[:, None], normals, 0.0), "gaps": gaps[nearest], "solimp": solimp,
            "is_contact": is_contact, "is_blind": jnp.zeros_like(is_contact), "acceleration": found["qacc_smooth"],
        }  # fmt: skip

    def _rows(self, found: Values, chosen: Array) -> Float[Array, "rows nv"]:
        """Return some rows of the constraints' Jacobian, dense."""
        jacobian, nv = found["efc.J"], self.mj_model.nv
        if "efc.J_colind" not in found:
            return jacobian[:, :nv].at[chosen].get(mode="clip")
        first, count = (found[f"efc.J_{name}"].at[chosen].get(mode="clip")[:, None] for name in ("rowadr", "rownnz"))
        values, columns = (x[0].at[first + jnp.arange(nv)].get(mode="clip") for x in (jacobian, found["efc.J_colind"]))
        values = jnp.where(jnp.arange(nv) < count, values, 0.0)
        return jnp.zeros((len(chosen), nv)).at[jnp.arange(len(chosen))[:, None], columns].add(values, mode="drop")

    def near(self, given: Values) -> pairs.Gaps:
        """Return the nearest contacts and limits of a world, as constants."""
        found = self._run_near(jax.tree.map(lambda x: jax.lax.stop_gradient(x)[None], given))
        return pairs.Gaps(**{k: x[0] for k, x in found.items()})

    def _step(self, given: Values) -> Values:
        return {k: x[0] for k, x in self._run({k: x[None] for k, x in given.items()}).items()}

    def _derived(self, primals: tuple, tangents: tuple) -> tuple[Values, dict[str, Any]]:
        (given,), (changes,) = primals, tangents
        found = self.step(given)
        names = tuple(k for k, x in given.items() if x.size and not isinstance(changes[k], SymbolicZero))
        if numbers := [k.removeprefix(NUMBER) for k in names if k.startswith(NUMBER)]:
            told = f"MuJoCo Warp has no derivative by {', '.join(numbers)}"
            raise NotImplementedError(f"{told}: take scene.with_engine('mujoco'), or jax.lax.stop_gradient of it")
        names = tuple(k for k in names if k in _VARIED)
        zeros = {
            k: jnp.zeros_like(x) if eqx.is_inexact_array(x) else np.zeros(x.shape, jax.dtypes.float0)
            for k, x in found.items()
        }
        if not names:
            return found, zeros
        parts = [self._to_tangent(given[k], changes[k]) if k == "qpos" else changes[k].reshape(-1) for k in names]
        solved = given | {"qacc_warmstart": found["qacc_warmstart"]}  # from there the solver takes an iteration or two
        moved = jnp.matmul(self.derivative(solved, names), jnp.concatenate(parts), precision="highest")
        sizes = [self.mj_model.nv, self.mj_model.nv, self.mj_model.na]
        qpos, qvel, act, sensed = jnp.split(moved, np.cumsum(sizes))
        return found, zeros | {
            "qpos": self._from_tangent(found["qpos"], qpos), "qvel": qvel, "act": act, "sensordata": sensed,
        }  # fmt: skip

    def derivative(self, given: Values, names: tuple[str, ...]) -> Float[Array, "outputs columns"]:
        """Return the derivative of the next state, in tangent space, and of readings by what is given, by differences.

        Those by positions are central: by what else is given a step hardly curves, and one side takes half as many worlds.
        """
        dtype = given["qpos"].dtype
        given = {k: jax.lax.stop_gradient(x).astype(jnp.float32) for k, x in given.items()}  # so that widths are Warp's
        worlds, ends = [{k: x[None] for k, x in given.items()}], []
        for name in names:
            size = self.mj_model.nv if name == "qpos" else given[name].size
            away = self._reach(given) if name == "qpos" else self._inward(given, name)[None]
            own = [self._moved(given, name, one[:, None] * jnp.eye(size, dtype=jnp.float32)) for one in away]
            worlds += [{k: jnp.broadcast_to(x, (size, *x.shape)) for k, x in given.items()} | {name: x} for x in own]
            ends.append([*own, given[name][None]][:2])
        found = self._run({k: jnp.concatenate([one[k] for one in worlds]) for k in given})
        bounds = np.cumsum([len(one["qpos"]) for one in worlds])
        middle, *parts = ({k: x[i:j] for k, x in found.items()} for i, j in zip([0, *bounds], bounds, strict=False))
        columns = []
        for name, (high, low) in zip(names, ends, strict=True):
            after, before = parts.pop(0), parts.pop(0) if name == "qpos" else middle
            before = {k: jnp.broadcast_to(x, after[k].shape) for k, x in before.items()}
            width = self._apart(name, high, jnp.broadcast_to(low, high.shape))[:, None]
            moved, *others = ((after[k] - before[k]) / width for k in ("qpos", "qvel", "act", "sensordata"))
            if self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
                turned = jax.vmap(self._to_tangent)(before["qpos"], moved)
            else:
                # Known from the velocities; a small input moves positions by little more than their rounding.
                own = jnp.eye(*others[0].shape, dtype=jnp.float32) if name == "qpos" else jnp.zeros_like(others[0])
                end = (middle[k][0] for k in ("qpos", "qvel"))
                turned = jax.vmap(functools.partial(self._carried, given, *end))(own, others[0])
            columns.append(jnp.concatenate([turned, *others], axis=1))
        return jnp.concatenate(columns).T.astype(dtype)

    def _reach(self, given: Values) -> Float[Array, "2 #nv"]:
        """Return the ends of differences of positions: as far to both sides, or to one, where the other crosses a surface."""
        # Contacts and limits begin with a jump.
        if not self.has_surfaces:
            return jnp.array([[_POSITION], [-_POSITION]])
        near = self.near(given)
        rates = near.rows.T
        moves = jnp.abs(rates) > 0
        steps = -near.gaps / jnp.where(moves, rates, 1.0)  # to each surface
        ahead = jnp.min(jnp.where(moves & (steps >= 0), steps, jnp.inf), axis=1)
        behind = jnp.min(jnp.where(moves & (steps < 0), -steps, jnp.inf), axis=1)
        ahead, behind = (jnp.clip(_CLEAR * x, _LEAST, _POSITION) for x in (ahead, behind))
        is_free = (ahead == _POSITION) & (behind == _POSITION)
        return jnp.stack(
            [jnp.where(is_free | (ahead >= behind), ahead, 0), -jnp.where(is_free | (ahead < behind), behind, 0)]
        )

    def _inward(self, given: Values, name: str) -> Float[Array, " size"]:
        """Return the change of each input: where its range ends, into the range, as by C MuJoCo."""
        if name not in ("ctrl", "act"):
            return jnp.full(given[name].size, _VELOCITY if name == "qvel" else _INPUT)
        limited, ends = (getattr(self.mj_model, f"actuator_{name}{kind}") for kind in ("limited", "range"))
        middle = np.where(limited, ends.mean(axis=1), np.inf)
        if name == "act":
            middle = np.repeat(middle, np.maximum(self.mj_model.actuator_actnum, 0))
        width = self._widths if name == "ctrl" else _INPUT
        return jnp.where(given[name] > middle.astype(np.float32), -width, width)

    def _carried(
        self, given: Values, after: Array, speed: Array, change: Array, speeding: Array
    ) -> Float[Array, " nv"]:
        """Return what becomes of positions by the velocities after the step, in tangent space."""
        timestep = given.get(NUMBER + "opt.timestep", jnp.asarray(self.mj_model.opt.timestep, jnp.float32))
        tangents = self._from_tangent(given["qpos"], change), speeding
        move = lambda qpos, qvel: integrate_position(self.mj_model, qpos, qvel, timestep)  # noqa: E731
        return self._to_tangent(after, jax.jvp(move, (given["qpos"], speed), tangents)[1])

    def _moved(self, given: Values, name: str, changes: Float[Array, "columns size"]) -> Array:
        if name != "qpos":
            return given[name] + changes.reshape(-1, *given[name].shape)
        return given["qpos"] + jax.vmap(functools.partial(self._from_tangent, given["qpos"]))(changes)

    def _apart(self, name: str, after: Array, before: Array) -> Float[Array, " columns"]:
        """Return how far apart points are that were rounded."""
        if name != "qpos":
            return jnp.sum((after - before).reshape(len(after), -1), axis=1)
        return jnp.diagonal(jax.vmap(self._to_tangent)(before, after - before))

    def _to_tangent(self, qpos: Float[Array, " nq"], change: Float[Array, " nq"]) -> Float[Array, " nv"]:
        """Return a small change of positions in tangent space."""
        return jax.jvp(functools.partial(position_change, self.mj_model, qpos), (qpos,), (change,))[1]

    def _from_tangent(self, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
        """Return a small change in tangent space as one of positions."""
        moved = lambda change: integrate_position(self.mj_model, qpos, change, 1.0)  # noqa: E731
        return jax.jvp(moved, (jnp.zeros_like(change),), (change,))[1]


@functools.lru_cache(maxsize=16)
def worlds_of(mj_model: mujoco.MjModel, room: int | None) -> Worlds:
    """Return the worlds of a C model, with room for so many contacts each."""
    return Worlds(mj_model, room)
