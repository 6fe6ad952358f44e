"""Accelerations and time integration: MJX's stages in order, with our own rows, solve and integration.

Stages without work (no actuators, tendons, sensors or rows) are skipped when the program is traced, and `jax.jit` removes unused
results. So the solve starts from the last acceleration alone: MJX also evaluates the unconstrained one, which takes another
factorisation. Matrix products request full precision: NVIDIA GPUs otherwise round factors to ten bits.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjxgrad._arrays import instance, is_known_to_be, with_derivative_of
from mjxgrad._mjx import mjx
from mjxgrad.batched import cholesky
from mjxgrad.bodies import forces, kinematics, mended
from mjxgrad.bodies.kinematics import Inertia, inertia_of, integrate_position
from mjxgrad.contact.collision import collide
from mjxgrad.solver import implicit
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import as_rows
from mjxgrad.solver.newton import System
from mjxgrad.stepping import assembly, onset
from mjxgrad.stepping.contact import Contact, Discrete, Onset, Smoothing, check_contact
from mjxgrad.stepping.onset import TwoSolves
from mjxgrad.stepping.rows import Block, joined
from mjxgrad.stepping.smoothing import smoothed

_Vector = Float[Array, " nv"]
_Disable = mujoco.mjtDisableBit
_Integrator = mujoco.mjtIntegrator


@contextlib.contextmanager
def at_full_precision(model: mjx.Model, data: mjx.Data) -> Iterator[None]:
    """Refuse what is not of MJX's JAX implementation, and keep all digits of matrix products."""
    instance("model", model, mjx.Model, "MJX's, as scene.model; for a scene and a state see mg.rollout")
    instance("data", data, mjx.Data, "MJX's, as scene.data; for a scene and a state see mg.rollout")
    if not hasattr(data._impl, "efc_J") or not hasattr(model.opt._impl, "has_fluid_params"):
        raise ValueError(
            "model and data must be of MJX's JAX implementation, got "
            f"{model.impl} and {data.impl}: create them with impl='jax'"
        )
    # MJX lacks this solver; it marks the models of scenes that C MuJoCo steps.
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        raise ValueError("this model is of a scene that C MuJoCo steps, as scene.unsupported says: use mg.rollout")
    with jax.default_matmul_precision("highest"):
        yield


def advance(model: mjx.Model, data: mjx.Data, contact: Contact) -> mjx.Data:
    """Return data one step later, by any way of contact but `Slope`; see `stepping.step`."""
    if model.opt.integrator == _Integrator.mjINT_RK4:
        return _after_stages(model, data, contact)
    data, is_euler = _forward(model, data, contact), model.opt.integrator == _Integrator.mjINT_EULER
    return _advance(model, data, (_euler_acceleration if is_euler else _implicit_acceleration)(model, data), None)


def forward(model: mjx.Model, data: mjx.Data, *, contact: Contact = Discrete()) -> mjx.Data:
    """Compute accelerations and forces of the present state; a drop-in for `mjx.forward`, with the arguments of `step`.

    With an onset, accelerations and forces are means over the coming time step. `Slope` is `Discrete` here, since it is a
    derivative of whole steps.

    Returns:
        Data with every field that depends on the state filled in. Under forward smoothing the constraint rows (`efc_`) are the
        smoothed ones, present at any distance.

    Raises:
        ValueError: as `step`.
    """
    check_contact(contact)
    with at_full_precision(model, data):
        return _forward(model, data, contact)


def _forward(model: mjx.Model, data: mjx.Data, contact: Contact, rows: list[Block] | None = None) -> mjx.Data:
    """Return data with all fields that depend on the state; with `rows`, those of `smooth`, the data is from there, too."""
    if rows is None:
        data, rows = smooth(model, data)
    if isinstance(contact, Smoothing) and contact.mode == "backward":
        fixed, still, given = jax.lax.stop_gradient((model, data, rows))
        own = _forward(fixed, still, Discrete(), rows=given)
        begun = data.replace(qacc_warmstart=own.qacc)
        soft = _forward(model, begun, replace(contact, mode="forward"), rows=rows)
        return with_derivative_of(own, soft)
    layout, noise, solves = assembly.row_layout(model, data), None, None
    if isinstance(contact, Smoothing):
        rows, noise, layout = smoothed(model, data, rows, contact, layout)
    elif isinstance(contact, Onset):
        rows, solves = onset.begin(model, data, rows, contact)
    data = assembly.make_constraint(model, data, rows)
    if model.nsensor:
        data = mended.sensor_vel(model, mended.sensor_pos(model, data))
    if not rows or not layout.num_rows or not model.nv:
        data = _unconstrained(data)
    else:
        system = assembly.system_of(model, data, layout, joined(rows), noise)
        data = _solved(model, data, layout, system, solves)
    return mended.sensor_acc(model, data) if model.nsensor else data


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the acceleration and the constraint forces; a drop-in for `mjx.solve`.

    The derivative is that of the converged solve, by the implicit function theorem; see `solver.implicit`. The model's
    `opt.iterations` and `opt.tolerance` bound the iterations. The data has mass matrix, smooth forces and constraint rows, as
    after `mjx.fwd_acceleration`.

    Returns:
        Data with `qacc`, `qfrc_constraint` and the rows' forces.

    Raises:
        ValueError: if `model` or `data` belong to another implementation of MJX.
    """
    with at_full_precision(model, data):
        layout, impl = assembly.row_layout(model, data), data._impl
        rows = Rows(impl.efc_aref, impl.efc_D, impl.efc_frictionloss, assembly.cone_scales(model, data, layout))
        entries = as_rows(impl.efc_J, [(cone.count, cone.dim) for cone in layout.cones])
        active = jnp.ones(layout.num_rows, bool)
        system = System(Inertia(mjx.full_m(model, data)), data.qfrc_smooth, entries, active, rows)
        if not layout.num_rows or not model.nv:
            return _unconstrained(data)
        return _solved(model, data, layout, system)


def _unconstrained(data: mjx.Data) -> mjx.Data:
    data = data.replace(qacc=data.qacc_smooth, qfrc_constraint=jnp.zeros_like(data.qvel))
    return data.tree_replace({"_impl.solver_niter": jnp.zeros_like(data._impl.solver_niter)})  # pyright: ignore[reportReturnType]


def _solved(
    model: mjx.Model, data: mjx.Data, layout: RowLayout, system: System, solves: TwoSolves | None = None
) -> mjx.Data:
    """Return data with the acceleration that balances all forces, and the rows' forces; of two solves the weighted means."""
    is_cold = model.opt.disableflags & _Disable.mjDSBL_WARMSTART
    start = jax.lax.stop_gradient(data.qacc_smooth if is_cold else data.qacc_warmstart)
    tolerance = jax.lax.stop_gradient(jnp.asarray(model.opt.tolerance, data.qvel.dtype))
    iterations = int(model.opt.iterations)

    def with_forces(system: System, acceleration: _Vector) -> tuple[Array, Array, Array]:
        force = system.row_force(layout, acceleration)
        return acceleration, force, system.rmv(force)

    if solves is None:
        acceleration, count = implicit.solve(layout, iterations, system, start, tolerance)
        found = with_forces(system, acceleration)
    else:
        pair = (solves.variants, solves.is_split)
        both, count = implicit.solve_both(layout, iterations, system, *pair, start, tolerance)
        each = jax.vmap(lambda variant, a: with_forces(system.with_variant(variant), a))(solves.variants, both)
        # In this order the result equals a single solve to the last bit where the two do not differ.
        found = (x[1] + solves.share * (x[0] - x[1]) for x in each)
    acceleration, force, total = found
    rows = {"_impl.efc_force": force, "_impl.solver_niter": count.astype(data._impl.solver_niter.dtype)}
    return data.tree_replace({"qacc": acceleration, "qfrc_constraint": total, **rows})  # pyright: ignore[reportReturnType]


def smooth(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, list[Block]]:
    """Run the stages up to the unconstrained acceleration, and gather the rows; MJX computes tendons and cameras."""
    data = mjx.camlight(model, kinematics.up_to_inertia(model, data))
    data = mjx.factor_m(model, data)
    data = collide(model, data)
    blocks = assembly.gather(model, data)
    if model.nu:
        data = forces.transmission(model, data)
    data = forces.fwd_velocity(model, data)
    return forces.fwd_acceleration(model, forces.fwd_actuation(model, data)), blocks


def _euler_acceleration(model: mjx.Model, data: mjx.Data) -> _Vector:
    """Return the acceleration with joint damping taken implicitly: (M + h D) a' = M a gives a' = a - (M + h D)⁻¹ h D a."""
    is_off = model.opt.disableflags & (_Disable.mjDSBL_EULERDAMP | _Disable.mjDSBL_DAMPER)
    if is_off or is_known_to_be(0.0, model.dof_damping):
        return data.qacc
    damping = model.opt.timestep * model.dof_damping
    return data.qacc - cholesky.solve_positive_definite(inertia_of(model, data).plus(damping), damping * data.qacc)


def _implicit_acceleration(model: mjx.Model, data: mjx.Data) -> _Vector:
    """Return the acceleration with the velocity derivative of the smooth forces taken implicitly."""
    derivative = mjx.deriv_smooth_vel(model, data)
    if derivative is None:
        return data.qacc
    mass = mjx.full_m(model, data) - model.opt.timestep * derivative
    return cholesky.solve_positive_definite(Inertia(mass), data.qfrc_smooth + data.qfrc_constraint)


def _advance(model: mjx.Model, data: mjx.Data, acceleration: _Vector, velocity: _Vector | None) -> mjx.Data:
    """Advance velocity, position, activations and time; positions move with `velocity`, by default the new one."""
    # MJX's explicit Euler step advances activations and time; its velocity and position are not used.
    bare = model.tree_replace({"opt.disableflags": model.opt.disableflags | _Disable.mjDSBL_EULERDAMP})
    moved = mended.euler(bare, data)
    qvel = data.qvel + model.opt.timestep * acceleration
    drift = qvel if velocity is None else velocity
    qpos = integrate_position(model, data.qpos, drift, model.opt.timestep)
    return moved.replace(qpos=qpos, qvel=qvel, qacc_warmstart=data.qacc)


def _after_stages(model: mjx.Model, start: mjx.Data, contact: Contact) -> mjx.Data:
    """Return data one step later by the classical fourth-order rule, whose stages are turns of one scan, compiled once."""
    h = model.opt.timestep
    rest = tuple(jnp.zeros_like(x) for x in (start.qvel, start.qvel, start.act))

    def stage(carry, coefficients):
        last, sums, warm = carry
        share, weight = coefficients
        data = start.replace(
            qpos=integrate_position(model, start.qpos, share * last[0], h),
            qvel=start.qvel + h * share * last[1],
            act=start.act + h * share * last[2],
            time=start.time + h * share,
            qacc_warmstart=warm,
        )
        data = _forward(model, data, contact)
        rates = (data.qvel, data.qacc, data.act_dot)
        sums = tuple(s + weight * r for s, r in zip(sums, rates, strict=True))
        return (rates, sums, data.qacc), data

    tableau = (jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6)
    tableau = jax.tree.map(lambda x: x.astype(start.qvel.dtype), tableau)
    (_, (velocity, acceleration, act_dot), _), stages = jax.lax.scan(stage, (rest, rest, start.qacc_warmstart), tableau)
    last = jax.tree.map(lambda x: x[-1], stages).replace(
        qpos=start.qpos, qvel=start.qvel, act=start.act, time=start.time, act_dot=act_dot
    )
    last = last.tree_replace({"_impl.solver_niter": jnp.max(stages._impl.solver_niter, axis=0)})
    return _advance(model, last, acceleration, velocity)
