"""Trajectory optimisation on smoothed linear models, whose smoothing decreases as the plan improves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PRNGKeyArray

from mjxgrad.planning.backward import Feedback, backward_pass
from mjxgrad.planning.cost import Cost, stage_model, terminal_model
from mjxgrad.planning.models import Smoother
from mjxgrad.planning.system import System

_STEPS = (1.0, 0.6, 0.3, 0.1, 0.03)
_LEAST_REGULARISATION, _MOST_REGULARISATION = 1e-6, 1e6
# A plan has converged once its model promises to lower the cost by no more than this share of it.
_TOLERANCE = 1e-4


class Iterations(eqx.Module):
    """What happened in an iteration, or in all of them.

    Attributes:
        factor: of the smoothing under which the step was chosen and measured.
        smoothed_cost: of the smoothed system after the iteration, under the smoothing of the next.
        cost: of the system itself under the same controls, infinite if it diverged.
        step: the length that was accepted, 0 if none lowered the smoothed cost.
        promised: by how much the model said that a full step lowers the smoothed cost.
        regularisation: of the backward pass.
        finite_fraction: the least share of finite samples behind a linear model.
    """

    factor: Float[Array, "*iterations"]
    smoothed_cost: Float[Array, "*iterations"]
    cost: Float[Array, "*iterations"]
    step: Float[Array, "*iterations"]
    promised: Float[Array, "*iterations"]
    regularisation: Float[Array, "*iterations"]
    finite_fraction: Float[Array, "*iterations"]


class Plan(eqx.Module):
    """The controls of least cost that were found; under `jax.vmap` every field gains leading axes.

    Attributes:
        controls: one row per step.
        states: that the system itself goes through under them.
        gain: the last feedback around the smoothed trajectory.
        start_cost: of the controls that were given.
        cost: of the best ones, never above `start_cost`; both without smoothing.
        iterations: the course.
        converged: whether the last model promised almost nothing more.
        diverged: whether the smoothed system left finite numbers, so that iterations were lost.
    """

    controls: Float[Array, "horizon m"]
    states: Float[Array, "states state"]
    gain: Float[Array, "horizon m n"]
    start_cost: Float[Array, ""]
    cost: Float[Array, ""]
    iterations: Iterations
    converged: Bool[Array, ""]
    diverged: Bool[Array, ""]


class _Course(eqx.Module):
    """A trajectory, its controls and its cost."""

    states: Float[Array, "states state"]
    controls: Float[Array, "horizon m"]
    cost: Float[Array, ""]


class _Problem(eqx.Module):
    """What stays the same over all iterations."""

    system: System
    cost: Cost
    smoother: Smoother
    keys: Key[Array, " horizon"]
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]

    def run(self, smoother: Smoother | None, course: _Course, law: Feedback, step: ArrayLike) -> _Course:
        """Follow a course under a feedback law; a step of zero repeats its controls."""
        follows = jnp.asarray(step) > 0

        def advance(state, inputs):
            nominal, control, change, gain, key = inputs
            away = self.system.difference(state, nominal)
            moved = control + step * change + jnp.where(follows, gain @ away, 0.0)
            control = jnp.clip(jnp.where(follows, moved, control), self.lower, self.upper)
            if smoother is None:
                return self.system.step(state, control), (state, control)
            return smoother.step(self.system, state, control, key), (state, control)

        inputs = (course.states[:-1], course.controls, law.change, law.gain, self.keys)
        final, (states, controls) = jax.lax.scan(advance, course.states[0], inputs)
        states = jnp.concatenate([states, final[None]])
        cost = self.cost.total(self.system, states, controls)
        return _Course(states, controls, jnp.where(jnp.isfinite(cost), cost, jnp.inf))

    def law(self, smoother: Smoother, course: _Course, regularisation: Float[Array, ""]):
        """Return the feedback law around a course, and the least share of finite samples."""
        system, cost, states, controls = self.system, self.cost, course.states, course.controls

        def model(state, control, key):
            return smoother.linear_model(system, state, control, key)

        models = jax.vmap(model)(states[:-1], controls, self.keys)
        stages = jax.vmap(lambda state, control: stage_model(cost, system, state, control))(states[:-1], controls)
        terminal = terminal_model(cost, system, states[-1])
        low, high = self.lower - controls, self.upper - controls
        law = backward_pass(models.A, models.B, stages, terminal, low, high, regularisation)
        return law, models.finite_fraction.min()


def optimise_trajectory(
    system: System,
    cost: Cost,
    start: Float[ArrayLike, " state"],
    controls: Float[ArrayLike, "horizon m"],
    key: PRNGKeyArray,
    *,
    smoother: Smoother,
    schedule: Float[ArrayLike, " iterations"],
    lower: ArrayLike = -jnp.inf,
    upper: ArrayLike = jnp.inf,
) -> Plan:
    """Improve controls by iterating on linear-quadratic models of the smoothed system (iLQR), ever less smoothed.

    In each iteration the system is linearised along its course under the present smoothing, the linear-quadratic problem
    solved within the control limits, and the best of several step lengths taken, by the cost of the smoothed system under the
    next, smaller smoothing. What counts in the end is the system itself: its cost under the same controls is recorded, and the
    best controls of all iterations returned.

    Args:
        system: to be controlled.
        cost: to be minimised.
        start: the first state.
        controls: to begin with, one row per step; clipped to the limits.
        key: consumed here. All iterations see the same noise, so that costs can be compared.
        smoother: which linear models, at factor 1; `Exact()` is plain iLQR.
        schedule: the factor of the smoothing in each iteration, positive. Let it fall to where the smoothed course is the
            true one.
        lower: limits of the controls, a number or one per control.
        upper: likewise.

    Returns:
        The plan.

    Raises:
        ValueError: if shapes do not fit, a limit is above its opposite, or the schedule is empty or not positive.

    References:
        Suh, Pang, Tedrake. Bundled Gradients through Contact via Randomized Smoothing. RA-L 2022, arXiv:2109.05143 (iLQR on
        smoothed models; its trajectories are those of the system itself, here the smoothed ones of a decreasing smoothing).
    """
    start, controls = jnp.asarray(start), jnp.asarray(controls)
    factors = jnp.asarray(schedule, start.dtype)
    lower, upper = (jnp.broadcast_to(jnp.asarray(x, start.dtype), (system.num_controls,)) for x in (lower, upper))
    _check(system, controls, factors, lower, upper)
    horizon = len(controls)
    problem = _Problem(system, cost, smoother, jax.random.split(key, horizon), lower, upper)
    steps = jnp.array((0.0, *_STEPS), start.dtype)
    rest = _no_law(system, horizon, start.dtype)
    at_start = jnp.broadcast_to(start, (horizon + 1, *start.shape))
    given = _Course(at_start, jnp.clip(controls, lower, upper), jnp.asarray(jnp.inf, start.dtype))

    def iterate(carry, inputs):
        course, best, regularisation, _ = carry
        factor, following, is_first = inputs
        law, fraction = problem.law(smoother.scaled(factor), course, regularisation)
        tried = jax.vmap(lambda step: problem.run(smoother.scaled(following), course, law, step))(steps)
        index = jnp.where(law.is_sound & ~is_first, jnp.argmin(tried.cost), 0)
        course = jax.tree.map(lambda x: x[index], tried)
        true = problem.run(None, course, rest, 0.0)
        best = jax.tree.map(lambda new, old: jnp.where(is_first | (true.cost < best.cost), new, old), true, best)
        change = jnp.where(index == 0, 8.0, jnp.where(index == 1, 0.25, 1.0))
        after = jnp.clip(change * regularisation, _LEAST_REGULARISATION, _MOST_REGULARISATION)
        after = jnp.where(is_first, regularisation, after)
        row = Iterations(factor, course.cost, true.cost, steps[index], law.promised(), regularisation, fraction)
        return (course, best, after, law.gain), row

    # A turn of the loop before the first finds the given controls' course: outside, it would be compiled once more.
    present, following = jnp.insert(factors, 0, factors[0]), jnp.append(factors, factors[-1])
    inputs = (present, following, jnp.arange(len(present)) == 0)
    carry = (given, given, jnp.asarray(_LEAST_REGULARISATION, start.dtype), rest.gain)
    (course, best, _, gain), rows = jax.lax.scan(iterate, carry, inputs)
    start_cost, rows = rows.cost[0], jax.tree.map(lambda x: x[1:], rows)
    return Plan(
        controls=best.controls,
        states=best.states,
        gain=gain,
        start_cost=start_cost,
        cost=best.cost,
        iterations=rows,
        converged=rows.promised[-1] <= _TOLERANCE * jnp.abs(course.cost),
        diverged=~jnp.all(jnp.isfinite(rows.smoothed_cost)),
    )


def _no_law(system: System, horizon: int, dtype: jnp.dtype) -> Feedback:
    m, zero = system.num_controls, jnp.zeros((), dtype)
    gain = jnp.zeros((horizon, m, system.num_changes), dtype)
    return Feedback(jnp.zeros((horizon, m), dtype), gain, zero, zero, jnp.asarray(True))


def _check(
    system: System,
    controls: Float[Array, "_ _"],
    factors: Float[Array, "..."],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
) -> None:
    if controls.shape[1] != system.num_controls or not len(controls):
        raise ValueError(
            f"controls must have shape (horizon, {system.num_controls}) with a horizon of at least 1, got {controls.shape}"
        )
    if factors.ndim != 1 or not factors.size:
        raise ValueError(f"schedule must be one factor per iteration, at least one, got shape {factors.shape}")
    if not isinstance(factors, jax.core.Tracer) and not (np.asarray(factors) > 0).all():
        raise ValueError(f"schedule must be positive, got {np.asarray(factors).min():g}: for no smoothing take Exact()")
    if any(isinstance(x, jax.core.Tracer) for x in (lower, upper)):
        return
    if not (np.asarray(lower) <= np.asarray(upper)).all():
        raise ValueError(f"lower must be at most upper, got {np.asarray(lower)} and {np.asarray(upper)}")
