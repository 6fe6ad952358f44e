"""The differentiable step: MJX's stages in order, with our own rows, solve and integration.

Drop-ins for `mjx.step`, `mjx.forward` and `mjx.solve` on any model and data of MJX's JAX implementation. Stages without work (no
actuators, tendons, sensors or rows) are skipped when the program is traced. `jax.jit` removes unused results: camera poses, the
unconstrained acceleration, the factor of the mass matrix. Therefore the solve starts from the last acceleration alone. MJX also
evaluates the unconstrained one to choose the better start, which takes another factorisation.

Matrix products request full precision: NVIDIA GPUs otherwise round factors to ten bits, contact Jacobians included.
"""

import contextlib
from collections.abc import Iterator
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjxgrad._arrays import is_known_to_be
from mjxgrad._mjx import mjx
from mjxgrad.batched import cholesky
from mjxgrad.bodies import forces, kinematics, mended
from mjxgrad.bodies.kinematics import Inertia, inertia_of, integrate_position
from mjxgrad.contact.collision import collide
from mjxgrad.solver import implicit
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import DenseRows, JoinedRows
from mjxgrad.solver.newton import System, Variant
from mjxgrad.stepping import assembly
from mjxgrad.stepping import onset as onsets
from mjxgrad.stepping.onset import Onset, Shares, TwoSolves
from mjxgrad.stepping.rows import Block, joined
from mjxgrad.stepping.smoothing import Smoothing, smoothed

_Vector = Float[Array, " nv"]
_Disable = mujoco.mjtDisableBit
_Integrator = mujoco.mjtIntegrator

Gradient = Literal["discrete", "slope"]
"""Derivatives along MuJoCo's own motion: "discrete", of each step, or "slope", with the slope of the outcome as mean."""


@contextlib.contextmanager
def _at_full_precision(model: mjx.Model, data: mjx.Data) -> Iterator[None]:
    if not hasattr(data._impl, "efc_J") or not hasattr(model.opt._impl, "has_fluid_params"):
        raise ValueError(
            "model and data must be of MJX's JAX implementation, got "
            f"{model.impl} and {data.impl}: create them with impl='jax'"
        )
    if (
        model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
    ):  # MJX lacks it; it marks the models of scenes that C MuJoCo steps
        raise ValueError("this model is of a scene that C MuJoCo steps, as scene.unsupported says: use mg.rollout")
    with jax.default_matmul_precision("highest"):
        yield


def check_gradient(gradient: str, onset: Onset | None = None, smoothing: Smoothing | None = None) -> None:
    """Refuse an unknown gradient, and an onset or smoothing that a single step cannot use with it.

    Raises:
        ValueError: if the gradient is unknown, or onset or smoothing are of another type, have a leading axis or conflict.
    """
    if gradient not in get_args(Gradient):
        raise ValueError(f"gradient must be one of {', '.join(map(repr, get_args(Gradient)))}, got {gradient!r}")
    for name, kind, settings in (("smoothing", Smoothing, smoothing), ("onset", Onset, onset)):
        if settings is not None and not isinstance(settings, kind):
            raise ValueError(f"{name} must be an mg.{kind.__name__}() or None, got {settings!r}")
        if settings is not None:
            settings.check(gradient)


def step(
    model: mjx.Model,
    data: mjx.Data,
    *,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
) -> mjx.Data:
    """Advance the state by one time step.

    Args:
        model: any model of MJX's JAX implementation; Euler, implicitfast or RK4.
        data: the present state, controls and applied forces.
        gradient: "discrete", the exact derivative of the simulated map, or "slope", which includes the motion of the times at
            which contacts and limits begin and end. "slope" is the derivative of the step with an onset, along MuJoCo's own
            motion. The step itself is the same.
        onset: lets contacts and limits begin within the step, so that the motion has no jumps and its plain derivative is
            unbiased; see `stepping.onset`. None is MuJoCo's step.
        smoothing: averages every contact over noise on its distance, for the motion or for its derivative alone.

    Returns:
        Data whose state is one time step later and whose other fields are those of the present state, as `mjx.step` returns
        them. Differentiable with respect to every floating-point field of `model` and `data`, any number of times.
        `_impl.solver_niter` is the solve's number of iterations, the largest of Runge-Kutta's four. It is `opt.iterations` + 1
        where the iterations, or the digits of the precision, did not suffice.

    Raises:
        ValueError: if `model` or `data` belong to another implementation of MJX, the gradient is unknown, onset or smoothing
            have a leading axis, or an onset is combined with the gradient "slope".
        NotImplementedError: if MJX lacks the integrator.
    """
    check_gradient(gradient, onset, smoothing)
    if model.opt.integrator not in (_Integrator.mjINT_EULER, _Integrator.mjINT_IMPLICITFAST, _Integrator.mjINT_RK4):
        kind = model.opt.integrator
        raise NotImplementedError(f"integrator must be Euler, implicitfast or RK4, got {kind}: set it in <option>")
    with _at_full_precision(model, data):
        if gradient == "discrete":
            return _step(model, data, onset, smoothing)
        moved = _step(*jax.lax.stop_gradient((model, data)), onset, smoothing)
        return jax.tree.map(_with_derivative_of, moved, _step(model, data, Onset(), smoothing, moved.qvel))


def _step(
    model: mjx.Model,
    data: mjx.Data,
    onset: Onset | None,
    smoothing: Smoothing | None,
    after: _Vector | None = None,
) -> mjx.Data:
    integrator = model.opt.integrator
    if integrator == _Integrator.mjINT_RK4:
        return _runge_kutta(model, data, onset, smoothing, after)
    data = _forward(model, data, onset, smoothing, after)
    is_euler = integrator == _Integrator.mjINT_EULER
    return _advance(model, data, (_euler_acceleration if is_euler else _implicit_acceleration)(model, data), None)


def forward(
    model: mjx.Model, data: mjx.Data, *, onset: Onset | None = None, smoothing: Smoothing | None = None
) -> mjx.Data:
    """Compute accelerations and forces of the present state; a drop-in for `mjx.forward`.

    Args:
        model: any model of MJX's JAX implementation.
        data: the present state, controls and applied forces.
        onset: the onset of `step`; accelerations and forces are then means over the coming time step.
        smoothing: the smoothing of `step`.

    Returns:
        Data with every field that depends on the state filled in. Under forward smoothing the constraint rows (`efc_`) are the
        smoothed ones, present at any distance.

    Raises:
        ValueError: if `model` or `data` belong to another implementation of MJX, or onset or smoothing
            have a leading axis.
    """
    check_gradient("discrete", onset, smoothing)
    with _at_full_precision(model, data):
        return _forward(model, data, onset, smoothing)


def _forward(
    model: mjx.Model,
    data: mjx.Data,
    onset: Onset | None,
    smoothing: Smoothing | None,
    after: _Vector | None = None,
) -> mjx.Data:
    """Return data with all fields that depend on the state; `after` is that of `onset.begin`."""
    data, blocks = _smooth(model, data)
    rows, shares = blocks, None
    if onset is not None:
        averaged = (False, False)
        if smoothing is not None and smoothing.mode == "forward":
            averaged = (True, smoothing.limit_length is not None)
        rows, shares = onsets.begin(model, data, blocks, onset, after, without=averaged)
    data = assembly.make_constraint(model, data, rows)
    if model.nsensor:
        data = mended.sensor_vel(model, mended.sensor_pos(model, data))
    if smoothing is None:
        data = _minimum(
            model, data, *_system(model, data, rows), _start(model, data), onsets.two_solves(model, data, rows, shares)
        )
    else:
        data = _smoothed_solve(model, data, blocks, rows, shares, smoothing)
    return mended.sensor_acc(model, data) if model.nsensor else data


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the acceleration and the constraint forces; a drop-in for `mjx.solve`.

    The derivative is that of the converged solve, by the implicit function theorem; see `solver.implicit`.

    Args:
        model: the model; its `opt.iterations` and `opt.tolerance` bound the iterations.
        data: data with mass matrix, smooth forces and constraint rows, as returned by `mjx.fwd_acceleration`.

    Returns:
        Data with `qacc`, `qfrc_constraint` and the rows' forces.

    Raises:
        ValueError: if `model` or `data` belong to another implementation of MJX.
    """
    with _at_full_precision(model, data):
        layout, impl = assembly.row_layout(model, data), data._impl
        rows = Rows(impl.efc_aref, impl.efc_D, impl.efc_frictionloss, assembly.cone_scales(model, data, layout))
        entries = JoinedRows((DenseRows(impl.efc_J, tuple((cone.count, cone.dim) for cone in layout.cones)),))
        active = jnp.ones(layout.num_rows, bool)
        system = System(Inertia(mjx.full_m(model, data)), data.qfrc_smooth, entries, active, rows)
        return _minimum(model, data, layout, system, _start(model, data))


def _system(model: mjx.Model, data: mjx.Data, blocks: list[Block]) -> tuple[RowLayout, System | None]:
    """Return the layout of the rows and the equations of motion; None in place of these without rows."""
    layout = assembly.row_layout(model, data)
    return layout, assembly.system_of(model, data, layout, joined(blocks)) if blocks else None


def _start(model: mjx.Model, data: mjx.Data) -> _Vector:
    return data.qacc_smooth if model.opt.disableflags & _Disable.mjDSBL_WARMSTART else data.qacc_warmstart


def _smoothed_solve(
    model: mjx.Model,
    data: mjx.Data,
    blocks: list[Block],
    begun: list[Block],
    shares: Shares | None,
    smoothing: Smoothing,
) -> mjx.Data:
    """Solve with rows under noise; in backward mode solve without noise and use noise for the derivative only.

    `blocks` are MuJoCo's rows, `begun` and `shares` the rows and shares with an onset.
    """
    is_forward = smoothing.mode == "forward"
    layout = assembly.row_layout(model, data)
    blocks, uncertain, layout = smoothed(model, data, begun if is_forward else blocks, smoothing, layout)
    solves = onsets.two_solves(model, data, blocks if is_forward else begun, shares)
    if uncertain is None or not model.nv:
        return _minimum(model, data, *_system(model, data, begun), _start(model, data), solves)
    soft = assembly.make_constraint(model, data, blocks)
    system = assembly.system_of(model, data, layout, joined(blocks), uncertain)
    if is_forward:
        return _minimum(model, soft, layout, system, _start(model, data), solves)
    fixed_model, fixed_data, given, solves = jax.lax.stop_gradient((model, data, begun, solves))
    hard = _minimum(fixed_model, fixed_data, *_system(fixed_model, fixed_data, given), _start(model, data), solves)
    soft = _minimum(model, soft, layout, system, hard.qacc)

    found = [(one.qacc, one.qfrc_constraint, one._impl.efc_force) for one in (hard, soft)]
    acceleration, total, force = _with_derivative_of(*found)
    return _solved(data, acceleration, total, force, hard._impl.solver_niter)


@jax.custom_jvp
def _with_derivative_of(value, other):
    """Return the first argument, exactly, with the derivative of the second."""
    return value


@_with_derivative_of.defjvp
def _with_derivative_of_jvp(primals, tangents):
    return _with_derivative_of(*primals), tangents[1]


def _minimum(
    model: mjx.Model,
    data: mjx.Data,
    layout: RowLayout,
    system: System | None,
    start: _Vector,
    solves: TwoSolves | None = None,
) -> mjx.Data:
    """Return data with the acceleration that balances all forces, and the forces of the rows."""
    if system is None or not layout.num_rows or not model.nv:
        data = data.replace(qacc=data.qacc_smooth, qfrc_constraint=jnp.zeros_like(data.qvel))
        none = jnp.zeros_like(data._impl.solver_niter)
        return data.tree_replace({"_impl.solver_niter": none})  # pyright: ignore[reportReturnType]
    tolerance = jax.lax.stop_gradient(jnp.asarray(model.opt.tolerance, data.qvel.dtype))
    iterations = int(model.opt.iterations)
    start = jax.lax.stop_gradient(start)
    if solves is None:
        acceleration, num_iterations = implicit.solve(layout, iterations, system, start, tolerance)
        force = system.row_force(layout, acceleration)
        total = system.rmv(force)
    else:
        both, num_iterations = implicit.solve_both(
            layout, iterations, system, solves.variants, solves.is_split, start, tolerance
        )

        def forces(variant: Variant, acceleration: Array) -> tuple[Array, Array]:
            varied = system.with_variant(variant)
            force = varied.row_force(layout, acceleration)
            return force, varied.rmv(force)

        # In this order the result equals a single solve to the last bit where the two do not differ.
        acceleration, force, total = (
            x[1] + solves.share * (x[0] - x[1]) for x in (both, *jax.vmap(forces)(solves.variants, both))
        )
    return _solved(data, acceleration, total, force, num_iterations.astype(data._impl.solver_niter.dtype))


def _solved(data: mjx.Data, acceleration: Array, total: Array, force: Array, num_iterations: Array) -> mjx.Data:
    found = {"_impl.efc_force": force, "_impl.solver_niter": num_iterations}
    return data.tree_replace({"qacc": acceleration, "qfrc_constraint": total, **found})  # pyright: ignore[reportReturnType]


def _smooth(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, list[Block]]:
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
    """Return the acceleration with joint damping taken implicitly, unless eulerdamp is off.

    With M a the sum of all forces, (M + h D) a' = M a gives a' = a - (M + h D)⁻¹ h D a. So neither the forces nor their
    derivatives need to be summed.
    """
    if model.opt.disableflags & (_Disable.mjDSBL_EULERDAMP | _Disable.mjDSBL_DAMPER) or is_known_to_be(
        0.0, model.dof_damping
    ):
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


def _runge_kutta(
    model: mjx.Model, start: mjx.Data, onset: Onset | None, smoothing: Smoothing | None, after: _Vector | None
) -> mjx.Data:
    """Advance by the classical fourth-order rule.

    All four stages are turns of one scan, the first included, so that the forward pass is compiled once.
    """
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
        data = _forward(model, data, onset, smoothing, after)
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
