r"""What automatic differentiation misses when a contact or limit begins or ends: first version, docstring follows."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import assembly, implicit, linear
from mjxgrad.dynamics.block import Block
from mjxgrad.dynamics.constraint import RowLayout
from mjxgrad.dynamics.newton import Problem

_SLOWEST = 1e-3


class _Groups(eqx.Module):
    """Rows that begin and end together, of all kinds; g counts groups, rows those of the whole problem."""

    distance: Float[Array, " g"]
    normal: Float[Array, "g nv"]


class _Events(eqx.Module):
    """All that the derivative needs of this step's events."""

    problem: Problem
    rate: Float[Array, " rows"]
    is_event: Bool[Array, " rows"]


def correct(model: mjx.Model, data: mjx.Data, blocks: list[Block]) -> mjx.Data:
    """Return data whose acceleration has the derivative of this step's events; its value stays."""
    if not any(block.rows_each for block in blocks):
        return data
    layout = assembly.row_layout(model, data)
    groups = _groups(blocks)
    speed = groups.normal @ data.qvel
    h = model.opt.timestep
    before = groups.distance - h * speed
    begins = (groups.distance < 0) & (before >= 0) & (speed < -_SLOWEST)
    ends = (groups.distance >= 0) & (before < 0) & (speed > _SLOWEST)
    happens = begins | ends
    rate = jnp.where(happens, 1 / (h * jnp.where(happens, jnp.abs(speed), 1.0)), 0.0)
    spread = functools.partial(_spread, blocks)
    is_event = spread(happens)
    touching = _touching(assembly.joined(blocks), is_event)
    jacobian, reference, weight = assembly.law(model, data.qvel, touching)
    rows = eqx.tree_at(lambda r: (r.reference, r.weight), assembly.rows_of(model, data, layout), (reference, weight))
    problem = Problem(mjx.full_m(model, data), data.qfrc_smooth, jacobian, rows)
    events = _Events(problem, spread(rate), is_event)
    settings = (data.qacc, jnp.asarray(model.opt.tolerance, data.qacc.dtype))
    still = jax.lax.stop_gradient((events, settings))
    qacc, force = _attach(
        layout, int(model.opt.iterations), (data.qacc, data.qfrc_constraint), spread(groups.distance), *still
    )
    return data.replace(qacc=qacc, qfrc_constraint=force)


def _groups(blocks: list[Block]) -> _Groups:
    distance, normal = [], []
    for block in blocks:
        if not block.rows_each:
            continue
        jacobian = block.jacobian.reshape(-1, block.rows_each, block.jacobian.shape[1])
        distance.append(block.residual[:: block.rows_each])
        normal.append(jnp.mean(jacobian, axis=1) if block.is_pyramid else jacobian[:, 0])
    return _Groups(jnp.concatenate(distance), jnp.concatenate(normal))


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
def _attach(layout: RowLayout, max_iterations: int, motion, distance, events: _Events, settings):
    return motion


@_attach.defjvp
def _attach_jvp(layout, max_iterations, primals, tangents):
    motion, _, events, (start, tolerance) = primals
    problem = events.problem
    acceleration = implicit.solve(layout, max_iterations, problem, start, tolerance)
    point = problem.at(layout, acceleration)
    quiet = jnp.where(events.is_event, 0.0, problem.rows.weight)
    others = eqx.tree_at(lambda p: p.rows.weight, problem, quiet)
    response = others.hessian(layout, point.x)
    late = jnp.where(events.is_event, point.row_force * events.rate, 0.0)
    lost = problem.jacobian.T @ (late * tangents[1])
    change = -linear.solve_positive_definite(response, lost)
    moved = (tangents[0][0] + change, tangents[0][1] + problem.mass @ change)
    return motion, moved
