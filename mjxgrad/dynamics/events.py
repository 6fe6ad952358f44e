r"""What automatic differentiation misses when a contact or limit begins or ends: first version, docstring follows."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import assembly, constraint, implicit, linear
from mjxgrad.dynamics.block import Block
from mjxgrad.dynamics.newton import Problem

_SLOWEST = 1e-3


class _Situation(eqx.Module):
    """A state with this step's events all at r = 0, in contact; rows of the whole problem.

    Attributes:
        problem: whose minimum is the acceleration.
        damping: B of each row (1/s), zero where the row does not act after the event.
        is_event: whether the row begins or ends in this step.
        rate: by how much an event comes later per distance, over the time that its force acts for (1/m, or s/m).
        start: acceleration to start from.
        tolerance: of the solve.
    """

    problem: Problem
    damping: Float[Array, " rows"]
    is_event: Bool[Array, " rows"]
    rate: Float[Array, " rows"]
    start: Float[Array, " nv"]
    tolerance: Float[Array, ""]


def correct(model: mjx.Model, data: mjx.Data, blocks: list[Block]) -> mjx.Data:
    """Return data whose acceleration and constraint force have the tangent of a semi-implicit step's events."""
    if not any(block.rows_each for block in blocks):
        return data
    distance, normal = _groups(blocks)
    speed = normal @ data.qvel
    moved = model.opt.timestep * speed
    begins = (distance < 0) & (distance - moved >= 0) & (speed < -_SLOWEST)
    ends = (distance >= 0) & (distance - moved < 0) & (speed > _SLOWEST)
    situation = _situation(model, data, data.qvel, blocks, (begins, ends), jnp.abs(moved))
    change = _saltation(assembly.row_layout(model, data), _limits(model, None), situation, _spread(blocks, distance))
    return data.replace(qacc=data.qacc + change, qfrc_constraint=data.qfrc_constraint + situation.problem.mass @ change)


def impulse(
    model: mjx.Model, data: mjx.Data, blocks: list[Block], mean_velocity: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Return a velocity of value zero with the tangent of the events between two states, for Runge-Kutta steps.

    Args:
        model: gives the time step.
        data: of the state before.
        blocks: of the state before.
        mean_velocity: displacement over the step, divided by the time step.
    """
    if not any(block.rows_each for block in blocks):
        return jnp.zeros_like(data.qvel)
    h = model.opt.timestep
    distance, normal = _groups(blocks)
    after = distance + h * (normal @ mean_velocity)
    velocity = data.qvel + 0.5 * h * data.qacc
    speed = normal @ velocity
    begins = (distance >= 0) & (after < 0) & (speed < -_SLOWEST)
    ends = (distance < 0) & (after >= 0) & (speed > _SLOWEST)
    situation = _situation(model, data, velocity, blocks, (begins, ends), jnp.abs(speed))
    layout = assembly.row_layout(model, data)
    return _saltation(layout, _limits(model, 0.5), situation, _spread(blocks, distance))


def _limits(model, share):
    return int(model.opt.iterations), share


def _situation(model, data, velocity, blocks, events, scale) -> _Situation:
    begins, ends = events
    happens = begins | ends
    rate = jnp.where(happens, 1 / jnp.where(happens, scale, 1.0), 0.0)
    is_event = _spread(blocks, happens)
    touching = _touching(assembly.joined(blocks), is_event)
    jacobian, reference, weight = assembly.law(model, velocity, touching)
    rows = assembly.rows_of(model, data, assembly.row_layout(model, data))
    rows = eqx.tree_at(lambda r: (r.reference, r.weight), rows, (reference, weight))
    problem = Problem(mjx.full_m(model, data), data.qfrc_smooth, jacobian, rows)
    damping = jnp.where(_spread(blocks, ends), 0.0, model.opt.timestep * assembly.stiffness_damping(model, touching)[1])
    tolerance = jnp.asarray(model.opt.tolerance, velocity.dtype)
    return _Situation(problem, damping, is_event, _spread(blocks, rate), data.qacc, tolerance)


def _groups(blocks: list[Block]) -> tuple[Float[Array, " groups"], Float[Array, "groups nv"]]:
    """Return distance and normal row of each contact and limit."""
    distance, normal = [], []
    for block in blocks:
        if not block.rows_each:
            continue
        jacobian = block.jacobian.reshape(-1, block.rows_each, block.jacobian.shape[1])
        distance.append(block.residual[:: block.rows_each])
        normal.append(jnp.mean(jacobian, axis=1) if block.is_pyramid else jacobian[:, 0])
    return jnp.concatenate(distance), jnp.concatenate(normal)


def _spread(blocks: list[Block], values: Array) -> Array:
    """Return per row what is given per group, zero where rows never begin or end."""
    parts, start = [], 0
    for block in blocks:
        count = len(block.residual)
        if not block.rows_each:
            parts.append(jnp.zeros(count, values.dtype))
            continue
        num_groups = count // block.rows_each
        parts.append(jnp.repeat(values[start : start + num_groups], block.rows_each, total_repeat_length=count))
        start += num_groups
    return jnp.concatenate(parts)


def _touching(block: Block, is_event: Bool[Array, " rows"]) -> Block:
    first = jnp.where(is_event, block.impedance[:, 2], block.impedance[:, 0])
    return eqx.tree_at(
        lambda b: (b.residual, b.impedance, b.is_active),
        block,
        (
            jnp.where(is_event, 0.0, block.residual),
            block.impedance.at[:, 0].set(first),
            block.is_active | is_event,
        ),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _saltation(layout, limits, situation: _Situation, distance: Float[Array, " rows"]) -> Float[Array, " nv"]:
    """Return zero, whose tangent is the response of the motion to the force that a later event leaves out."""
    return jnp.zeros_like(situation.start)


@_saltation.defjvp
def _saltation_jvp(layout, limits, primals, tangents):
    situation, _ = primals
    max_iterations, share = limits
    problem, is_event = situation.problem, situation.is_event
    acceleration = implicit.solve(layout, max_iterations, problem, situation.start, situation.tolerance)
    point = problem.at(layout, acceleration)
    quiet = eqx.tree_at(lambda p: p.rows.weight, problem, jnp.where(is_event, 0.0, problem.rows.weight))
    response = quiet.hessian(layout, point.x)
    late = jnp.where(is_event, point.row_force * situation.rate, 0.0)
    change = -linear.solve_positive_definite(response, problem.jacobian.T @ (late * tangents[1]))
    if share is not None:
        full = problem.hessian(layout, point.x)
        damped = constraint.curvature_product(
            layout, problem.rows, point.x, situation.damping[:, None] * problem.jacobian
        )
        slowed = full + share * problem.jacobian.T @ damped
        change = jnp.linalg.solve(slowed, full @ change)
    return jnp.zeros_like(situation.start), change
