"""Trajectory optimisation on smoothed linear models, whose smoothing decreases as the plan improves."""

import dataclasses
import functools
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PRNGKeyArray, Real

from mjxgrad._arrays import Legible, instance, is_known, known, one_key, real, traceable, whole
from mjxgrad._interrupts import patiently
from mjxgrad._programs import compiled, is_traced
from mjxgrad._text import Printed, format_number
from mjxgrad.planning.linear_model import Analytic, Exact, LinearModel, Smoother
from mjxgrad.planning.system import (
    ControlVector,
    Cost,
    Quadratic,
    SceneSystem,
    StateVector,
    System,
    stage_model,
    terminal_model,
)
from mjxgrad.rollouts import State
from mjxgrad.rollouts.rollout import sequence_of

_Row = Float[Array, "*iterations"]
_Scalar = Float[Array, ""]
_Matrix = Float[Array, "m m"]
_Controls = Float[Array, "horizon m"]
_STEPS = (1.0, 0.6, 0.3, 0.1, 0.03)
_LEAST_REGULARISATION, _MOST_REGULARISATION = 1e-6, 1e6
FREE = 1.0  # regularisation up to which a step may go about as far as its model says
# A plan has converged once its model predicts to lower the cost by no more than this share of it.
_TOLERANCE = 1e-4
# An influence of controls on a coordinate counts as zero below this share of the largest influence: roundings of differences.
_INFLUENCE = 1e-5
# Most Newton steps of the projected method. Each fixes further active bounds, or shortens the step by backtracking.
_NEWTON_STEPS = 12
_SHORTENING = 0.5 ** np.arange(8)
_PIECES, _SMALLEST = 4, 0.125  # of a random change of a plan, and the share of the deviation that the first one has
_USUAL = 0.05  # of a control's range, and _UNLIMITED where it has none: the deviation of random changes
_UNLIMITED = 0.1
NO_COST = "the cost of the given controls is no finite number, though all their states are"
_LISTED = 4  # names of coordinates in a sentence
_ITERATIONS = 20  # unless a schedule says
_TRUSTED = 0.8  # of what a linear model promises: where as much comes true, no random change is taken
_KEPT = 0.2  # of what linear models promised; where less came true, random changes are advised


class Iterations(eqx.Module):
    """The record of one iteration, or of all.

    Attributes:
        factor: factor of the smoothing under which the step was computed.
        smoothed_cost: cost of the smoothed system after the iteration, under the next iteration's smoothing.
        cost: cost of the system itself under the same controls, infinite if it diverged.
        step: accepted step length, 0 if none lowered the smoothed cost as much as the given plan or a random change of it.
        promised: decrease of the smoothed cost that the model predicts for a full step.
    """

    factor: _Row
    smoothed_cost: _Row
    cost: _Row
    step: _Row
    promised: _Row


class Plan(eqx.Module, Printed):
    """The controls of least cost that were found; under `jax.vmap` every field gains leading axes.

    Attributes:
        controls: controls, one row per step.
        states: states of the system itself under these controls.
        start_cost: cost of the given controls, without smoothing.
        cost: cost of the best controls, without smoothing; never above `start_cost`.
        iterations: records of the iterations.
        unmoved: coordinates of a change of the state that have a cost but that no control moves, by the last model. Their
            derivatives are zero because nothing is touched, so no iteration can improve them.
        converged: whether the last model that was free to move predicts almost no further decrease; never if a coordinate is
            unmoved.
        diverged: whether the smoothed system left finite numbers, so that iterations were lost.
        names: names of the coordinates of a change.
    """

    controls: _Controls
    states: Float[Array, "states state"]
    start_cost: _Scalar
    cost: _Scalar
    iterations: Iterations
    unmoved: Bool[Array, " n"]
    converged: Bool[Array, ""]
    diverged: Bool[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True, repr=False)

    def verdict(self) -> str:
        """Return one sentence on how the planning ended; on the host, for a single plan."""
        if self.unmoved.any():
            return (
                f"nothing is touched: no control moves {listed(self.names, self.unmoved)}, which has a cost, so derivatives "
                "are zero; start with controls that touch, take num_samples=32, or smooth by Analytic"
            )
        if not np.isfinite(self.cost) and np.isfinite(self.states).all():
            return f"not improved: {NO_COST}"
        if self.diverged:
            return "the smoothed system left finite numbers; use shorter time steps, or tighter limits"
        if not jnp.isfinite(self.iterations.promised[-1]):
            steep = "the derivatives of its steps multiply beyond all numbers"
            return (
                f"not improved: {steep}; give the system contact=mg.Slope(), or take a shorter plan or more smoothing"
            )
        if self.converged:
            return "converged"
        if (share := self._kept()) < _KEPT:
            came = f"{100 * max(share, 0.0):.2g}% of what linear models promised came true"
            return (
                f"not converged: {came}, as where contacts begin and end; take random changes, num_samples=32 or more"
            )
        return "not converged; take more iterations"

    def _kept(self) -> float:
        """Return which share of the promised decreases came true, of the smoothed cost or of the cost itself."""
        costs, promised = np.asarray(self.iterations.smoothed_cost), np.asarray(self.iterations.promised)
        came = max(costs[0] - costs[-1], float(self.start_cost - self.cost))
        return float(came / max(promised.sum(), np.finfo(float).tiny))

    def __str__(self) -> str:
        if is_traced(self.cost) or self.cost.ndim:
            return repr(self)
        cost, before = (format_number(float(x)) for x in (self.cost, self.start_cost))
        return f"Cost {cost} from {before} in {self.iterations.cost.size} iterations: {self.verdict()}."


class Feedback(eqx.Module):
    """The feedback law du = step k + K dx around a trajectory; rows of K are zero for controls at a limit.

    `promised` is the decrease of the cost that the model predicts for a full step. `is_sound` is whether the quadratic
    program of every step was solved.
    """

    change: _Controls
    gain: Float[Array, "horizon m n"]
    promised: _Scalar
    is_sound: Bool[Array, ""]


class Course(Legible):
    """A trajectory, its controls and its cost."""

    states: Float[Array, "states state"]
    controls: _Controls
    cost: _Scalar


class Search(eqx.Module):
    """The state of the search between iterations: its course, the best one without smoothing, and what is known around it."""

    course: Course
    best: Course
    regularisation: _Scalar
    models: LinearModel
    law: Feedback
    unmoved: Bool[Array, " n"]


class Problem(eqx.Module):
    """The constants of all iterations, and the three parts of one."""

    system: System
    cost: Cost
    smoother: Smoother
    keys: Key[Array, " horizon"]
    lower: ControlVector
    upper: ControlVector

    def begin(self, start: StateVector, controls: _Controls) -> Search:
        """Return the search before its first iteration."""
        at_start, (horizon, m), n = jnp.tile(start, (len(controls) + 1, 1)), controls.shape, self.system.num_changes
        zeros = functools.partial(jnp.zeros, dtype=start.dtype)
        given = Course(at_start, jnp.clip(controls, self.lower, self.upper), zeros(()) + jnp.inf)
        models = LinearModel(zeros((horizon, n, n)), zeros((horizon, n, m)))
        law = Feedback(zeros((horizon, m)), zeros((horizon, m, n)), zeros(()), jnp.asarray(True))
        return Search(given, given, zeros(()) + _LEAST_REGULARISATION, models, law, jnp.zeros(n, bool))

    def run(self, smoother: Smoother, course: Course, law: Feedback, step: ArrayLike, noise: ArrayLike = 0.0) -> Course:
        """Follow a course under a feedback law; a step of zero repeats its controls, to which noise is added."""
        follows, course = jnp.asarray(step) > 0, dataclasses.replace(course, controls=course.controls + noise)

        def advance(state, inputs):
            nominal, control, change, gain, key = inputs
            away = self.system.difference(state, nominal)
            moved = control + step * change + jnp.where(follows, gain @ away, 0.0)
            control = jnp.clip(jnp.where(follows, moved, control), self.lower, self.upper)
            return smoother.step(self.system, state, control, key), (state, control)

        if (steered := smoother.steered(self.system)) is not None:
            given = course.controls + jnp.where(follows, step * law.change, 0.0)
            full = {"controls": given, "gain": law.gain, "follows": follows, "lower": self.lower, "upper": self.upper}
            states, controls = steered.steer(states=course.states[:-1], **full)
        else:
            inputs = (course.states[:-1], course.controls, law.change, law.gain, self.keys)
            final, (states, controls) = jax.lax.scan(advance, course.states[0], inputs)
            states = jnp.concatenate([states, final[None]])
        cost = self.cost.total(self.system, states, controls)
        return Course(states, controls, jnp.where(jnp.isfinite(cost), cost, jnp.inf))

    def followed(self, search: Search, factor: _Scalar) -> Search:
        """Return the search about the motion from where its course begins, by the last law; as it is where that diverges.

        A course that was shifted to another state is no motion, and linear models along it promise what no step keeps.
        """
        law = dataclasses.replace(search.law, change=jnp.zeros_like(search.law.change))
        course = self.run(self.smoother.scaled(factor), search.course, law, 1.0)
        kept = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(course.cost), new, old), course, search.course)
        return dataclasses.replace(search, course=kept)

    def linearised(self, search: Search, factor: _Scalar, begin: ArrayLike = 0, count: int | None = None) -> Search:
        """Take the linear models of all steps of the course, or of so many from one on."""
        course, linear_model = search.course, functools.partial(self.smoother.scaled(factor).linear_model, self.system)
        count = len(course.controls) if count is None else count
        steps = [
            jax.lax.dynamic_slice_in_dim(x, begin, count) for x in (course.states[:-1], course.controls, self.keys)
        ]
        put = lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new.astype(old.dtype), begin, 0)  # noqa: E731
        return dataclasses.replace(search, models=jax.tree.map(put, search.models, jax.vmap(linear_model)(*steps)))

    def solved(self, search: Search) -> Search:
        """Take the feedback law of the linear-quadratic problem, and the unmoved coordinates."""
        system, cost, course, models = self.system, self.cost, search.course, search.models
        stages = jax.vmap(lambda *at: stage_model(cost, system, *at))(course.states[:-1], course.controls)
        terminal = terminal_model(cost, system, course.states[-1])
        limits = self.lower - course.controls, self.upper - course.controls
        law = backward_pass(models, stages, terminal, *limits, search.regularisation)
        return dataclasses.replace(search, law=law, unmoved=_unmoved(models, stages, terminal, course.cost))

    def chosen(
        self, search: Search, following: _Scalar, is_first: Bool[Array, ""], noise: Float[Array, "N horizon m"]
    ) -> tuple[Search, _Scalar, _Scalar]:
        """Take the best of several step lengths and samples, at first the given controls; add its true cost and its step."""
        smoother, law, dtype = self.smoother.scaled(following), search.law, search.course.states.dtype
        steps = jnp.pad(jnp.array((0.0, *_STEPS), dtype), (0, len(noise)))
        added = jnp.pad(noise.astype(dtype), ((len(steps) - len(noise), 0), (0, 0), (0, 0)))
        tried = jax.vmap(lambda *at: self.run(smoother, search.course, law, *at))(steps, added)
        came = tried.cost[0] - jnp.min(tried.cost[: 1 + len(_STEPS)])
        is_random = jnp.arange(len(steps)) > len(_STEPS)
        # A random change may cost less than a full step of a model that holds, but is a step towards nothing.
        keeps = law.is_sound & (came >= jnp.maximum(_TRUSTED * law.promised, _TOLERANCE * jnp.abs(tried.cost[0])))
        is_valid = (jnp.arange(len(steps)) == 0) | (~is_first & jnp.where(is_random, ~keeps, law.is_sound))
        index = jnp.argmin(jnp.where(is_valid, tried.cost, jnp.inf))
        course = jax.tree.map(lambda x: x[index], tried)
        is_exact = isinstance(smoother, Analytic) and smoother.smoothing is None
        true = course if is_exact else self.run(Exact(), course, law, 0.0)
        is_better = is_first | (true.cost < search.best.cost)
        best = jax.tree.map(lambda new, old: jnp.where(is_better, new, old), true, search.best)
        # As in Levenberg-Marquardt: more regularisation where no step lowered the cost, less after a full step.
        change = jnp.where(is_first, 1.0, jnp.where(index == 0, 8.0, jnp.where(index == 1, 0.25, 1.0)))
        after = jnp.clip(change * search.regularisation, _LEAST_REGULARISATION, _MOST_REGULARISATION)
        return dataclasses.replace(search, course=course, best=best, regularisation=after), true.cost, steps[index]


@functools.partial(jax.jit, static_argnames=("num_samples", "horizon"))
def random_changes(
    key: PRNGKeyArray, stddev: ControlVector, num_samples: int, horizon: int
) -> Float[Array, "N horizon m"]:
    """Return changes of the controls, each held for a quarter of the plan, and each plan's larger than the last one's."""
    sizes = jnp.geomspace(_SMALLEST, 1, num_samples, dtype=stddev.dtype)[:, None, None] * stddev
    held = sizes * jax.random.normal(key, (num_samples, _PIECES, stddev.size), stddev.dtype)
    return jnp.repeat(held, -(-horizon // _PIECES), axis=1)[:, :horizon]


def optimise_trajectory(
    system: System,
    cost: Cost,
    start: Real[ArrayLike, " state"] | State | mujoco.MjData,
    controls: Float[ArrayLike, "horizon m"],
    key: PRNGKeyArray,
    *,
    smoother: Smoother = Exact(),
    schedule: Float[ArrayLike, " iterations"] | None = None,
    num_samples: int = 0,
    stddev: ArrayLike | None = None,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
) -> Plan:
    """Improve controls by iterating on linear-quadratic models of the smoothed system (iLQR), with decreasing smoothing.

    Each iteration linearises the system along its course and solves the linear-quadratic problem within the control limits.
    It takes the best of several step lengths, by the cost under the next, smaller smoothing. The controls with the lowest
    cost of the system itself are returned.

    Args:
        system: the system to be controlled.
        cost: the cost to be minimised.
        start: the first state: a vector of the system, or for a scene its `State` or C MuJoCo's data.
        controls: initial controls, one row per step; clipped to the limits.
        key: consumed here. All iterations use the same noise of the smoother, so that costs can be compared.
        smoother: the smoother of the linear models at factor 1; `Exact()` is plain iLQR.
        schedule: positive factor of the smoothing in each iteration; it should fall until the smoothed course is the true one.
            None takes 20 iterations, where nothing is smoothed.
        num_samples: plans with random changes that are tried beside the step lengths in each iteration. They find what
            derivatives do not see, and go on where linear models hold for tiny steps alone, as where an object may topple.
            None is taken where four fifths of what the linear model promises come true.
        stddev: standard deviation of these changes, in units of the controls, a number or one per control; each plan has a
            share of it, from an eighth to all. None takes a twentieth of the range between the limits, 0.1 without any.
        lower: lower limits of the controls, a number or one per control; None takes the actuators' own, `ctrlrange`.
        upper: upper limits of the controls, as `lower`.

    Returns:
        The plan; `plan.verdict()` says how it ended. Ctrl-C ends with the best so far, but within `jax.jit`.

    Warns:
        UserWarning: if the smoothing reaches contacts with friction that hold bodies to the floor; and after Ctrl-C.

    Raises:
        ValueError: if shapes do not fit, a limit is above its opposite, an argument is of another kind or not finite, or the
            schedule is empty or not positive.

    References:
        Suh, Pang, Tedrake. Bundled Gradients through Contact via Randomized Smoothing. RA-L 2022, arXiv:2109.05143 (iLQR on
        smoothed models; its trajectories are those of the system itself, here the smoothed ones of a decreasing smoothing).
    """
    one_key(key)
    num_samples = whole("num_samples", num_samples, 0)
    if schedule is None:
        if not isinstance(smoother, Exact):
            wanted = "one factor of the smoothing per iteration, such as jnp.geomspace(1, 0.01, 20)"
            raise ValueError(f"schedule must be given with a smoother: {wanted}")
        schedule = np.ones(_ITERATIONS)
    problem, begin, controls, (factors,) = posed(system, cost, start, controls, key, smoother, [schedule], lower, upper)
    spread = deviations(stddev, problem)
    given = problem, problem.begin(begin, controls), _At.of(factors, jax.random.fold_in(key, 1)), spread
    with traceable("cost"):
        return (_as_one if is_traced(given) else _one_by_one)(*given, num_samples)


def posed(
    system: System,
    cost: Cost,
    start: ArrayLike | State | mujoco.MjData | None,
    controls: ArrayLike,
    key: PRNGKeyArray,
    smoother: Smoother,
    schedules: Sequence[Any],
    lower: ArrayLike | None,
    upper: ArrayLike | None,
) -> tuple[Problem, StateVector, _Controls, list[Float[Array, " iterations"]]]:
    """Return the problem, start, controls and schedules as arrays; refuse what does not fit, and warn of unwanted smoothing.

    A start of None is the system's origin.
    """
    instance("system", system, System, "one such as planning.SceneSystem(scene=scene)")
    if not system.num_controls:
        raise ValueError("system must have controls to plan, got none: give the scene actuators")
    instance("cost", cost, Cost, "one such as planning.GoalCost(...)")
    instance("smoother", smoother, Smoother, "one of mg.planning, such as Exact() or Analytic(mg.Smoothing(0.01))")
    begin = system.origin if start is None else state_of("start", start, system)
    for message in smoother.warnings(system, begin):
        warnings.warn(message, stacklevel=3)
    sequence_of(controls, None, None, system.num_controls)
    dtype, own = begin.dtype, system.control_limits
    controls, factors = jnp.asarray(controls, dtype), [real("schedule", one, dtype) for one in schedules]
    lower = per_control("lower", own[0] if lower is None else lower, system, dtype)
    upper = per_control("upper", own[1] if upper is None else upper, system, dtype)
    for one in factors:
        if one.ndim != 1 or not one.size:
            raise ValueError(f"schedule must be one factor per iteration, at least one, got shape {one.shape}")
        if (given := known(one)) is not None and not (given > 0).all():
            raise ValueError(f"schedule must be positive, got {given.min():g}: for no smoothing take Exact()")
    low, high = known(lower), known(upper)
    if low is not None and high is not None and not (low <= high).all():
        raise ValueError(f"lower must be at most upper, got {low} and {high}")
    return Problem(system, cost, smoother, jax.random.split(key, len(controls)), lower, upper), begin, controls, factors


def state_of(name: str, value: ArrayLike | State | mujoco.MjData, system: System) -> StateVector:
    """Return a state of a system as floats."""
    origin = system.origin
    if isinstance(system, SceneSystem) and isinstance(value, State | mujoco.MjData):
        value = jnp.concatenate([jnp.asarray(getattr(value, part)) for part in ("qpos", "qvel", "act")])
    state = real(name, value)
    if state.shape != origin.shape:
        raise ValueError(f"{name} must have shape {origin.shape} in this system, got {state.shape}")
    if is_known(state) and not np.isfinite(state).all():
        raise ValueError(f"{name} must be finite, got {np.asarray(state).tolist()}")
    return state if jnp.issubdtype(state.dtype, jnp.floating) else state.astype(origin.dtype)


def per_control(name: str, value: ArrayLike, system: System, dtype: Any) -> ControlVector:
    """Return one number for each control."""
    numbers, size = real(name, value, dtype), system.num_controls
    if numbers.shape not in ((), (size,)):
        raise ValueError(f"{name} must be one number or have shape ({size},), got {numbers.shape}")
    return jnp.broadcast_to(numbers, (size,))


def deviations(stddev: ArrayLike | None, problem: Problem) -> ControlVector:
    """Return the standard deviation of random changes of each control."""
    if stddev is None:
        reach = problem.upper - problem.lower
        return jnp.where(jnp.isfinite(reach), _USUAL * reach, _UNLIMITED).astype(problem.lower.dtype)
    given = per_control("stddev", stddev, problem.system, problem.lower.dtype)
    if (value := known(given)) is not None and not ((value >= 0) & (value < np.inf)).all():
        raise ValueError(f"stddev must be at least 0 and finite, got {value}")
    return given


class _At(eqx.Module):
    """Numbers that differ from iteration to iteration, of one or, along an axis, of all."""

    factor: Float[Array, "*iterations"]
    following: Float[Array, "*iterations"]  # factor of the next iteration
    is_first: Bool[Array, "*iterations"]
    key: Key[Array, "*iterations"]

    @classmethod
    def of(cls, factors: Float[Array, " iterations"], key: PRNGKeyArray) -> "_At":
        """Return those of a schedule. An extra first iteration computes the given controls' course."""
        present, following = jnp.insert(factors, 0, factors[0]), jnp.append(factors, factors[-1])
        return cls(present, following, jnp.arange(len(present)) == 0, jax.random.split(key, len(present)))


_Record = tuple[Iterations, _Row]  # of one iteration or of all, and the regularisation that was held


def _iterated(
    problem: Problem, search: Search, at: _At, stddev: ControlVector, num_samples: int
) -> tuple[Search, _Record]:
    """Return the search after an iteration, and its record."""
    noise = random_changes(at.key, stddev, num_samples, len(search.course.controls))
    improved = lambda: problem.solved(problem.linearised(search, at.factor))  # noqa: E731
    # Within the program, or what the first iteration takes would be compiled a second time.
    search, held = jax.lax.cond(at.is_first, lambda: search, improved), search.regularisation
    search, true, step = problem.chosen(search, at.following, at.is_first, noise)
    return search, (Iterations(at.factor, search.course.cost, true, step, search.law.promised), held)


_one_iteration = compiled(_iterated)


def _as_one(problem: Problem, first: Search, every: _At, stddev: ControlVector, num_samples: int) -> Plan:
    """Return the plan as a part of the program that asks for it."""
    advance = lambda search, at: _iterated(problem, search, at, stddev, num_samples)  # noqa: E731
    return _ended(*jax.lax.scan(advance, first, every), problem.system.names)


def _one_by_one(problem: Problem, search: Search, every: _At, stddev: ControlVector, num_samples: int) -> Plan:
    """Return the same plan by a program for an iteration; Ctrl-C ends with what was found, once the given plan is known."""
    records, count = [], len(every.factor)
    for number in range(count):
        at, before = jax.tree.map(lambda x, k=number: x[k], every), search
        one = lambda at=at, before=before: _one_iteration(problem, before, at, stddev, num_samples)  # noqa: E731
        try:
            search, record = patiently(lambda one=one: jax.block_until_ready(one()))
        except KeyboardInterrupt:
            if not records[1:]:
                raise
            told = f"interrupted after {number - 1} of {count - 1} iterations: the plan is the best of these"
            warnings.warn(told, stacklevel=3)
            break
        records.append(record)
    return _ended(search, jax.tree.map(lambda *x: jnp.stack(x), *records), problem.system.names)


@compiled
def _ended(found: Search, records: _Record, names: tuple[str, ...]) -> Plan:
    """Return the plan of a search and the records of its iterations, the first of which is the given plan's."""
    start_cost, (rows, held) = records[0].cost[0], jax.tree.map(lambda x: x[1:], records)
    # What is held to the controls as they are promises nothing, either.
    promised = rows.promised[jnp.max(jnp.where(held <= FREE, jnp.arange(len(held)), 0))]
    return Plan(
        controls=found.best.controls,
        states=found.best.states,
        start_cost=start_cost,
        cost=found.best.cost,
        iterations=rows,
        unmoved=found.unmoved,
        converged=(promised <= _TOLERANCE * jnp.abs(found.course.cost)) & ~found.unmoved.any(),
        diverged=~jnp.all(jnp.isfinite(rows.smoothed_cost)),
        names=names,
    )


def listed(names: Sequence[str], chosen: Bool[Array, " n"]) -> str:
    """Return the chosen of some names as text, each once and in quotation marks."""
    found = list(dict.fromkeys(f"'{name}'" for name, one in zip(names, chosen.tolist(), strict=True) if one))
    return ", ".join(found[:_LISTED]) + f" and {len(found) - _LISTED} more" * (len(found) > _LISTED)


def _unmoved(models: LinearModel, stages: Quadratic, terminal: Quadratic, cost: _Scalar) -> Bool[Array, " n"]:
    """Return which coordinates of the state cost more than rounding but are moved by no control in any step."""
    n = models.A.shape[-1]
    slopes = jnp.concatenate([stages.gradient[1:, :n], terminal.gradient[None]])
    curvatures = jax.vmap(jnp.diag)(jnp.concatenate([stages.hessian[1:, :n, :n], terminal.hessian[None]]))
    gain = jnp.sum(0.5 * slopes**2 / jnp.where(curvatures > 0, curvatures, 1.0), axis=0)

    # Controls that change all at once, by turns up and down: sums of sizes would grow as the motion does not.
    signs = jnp.cos(1.0 + jnp.arange(models.B.shape[0] * models.B.shape[2]) ** 2.0).reshape(models.B.shape[0], -1)

    def spread(moved, given):
        model, change = given
        moved = model.A @ moved + model.B @ change
        size = jnp.abs(moved)
        return moved, size <= _INFLUENCE * size.max()  # of this step: later ones may grow without bounds

    _, is_still = jax.lax.scan(spread, jnp.zeros_like(slopes[0]), (models, signs.astype(slopes.dtype)))
    return (gain > _TOLERANCE * jnp.abs(cost)) & is_still.all(axis=0)


def backward_pass(
    models: LinearModel,
    stages: Quadratic,
    terminal: Quadratic,
    lower: _Controls,
    upper: _Controls,
    regularisation: _Scalar,
) -> Feedback:
    """Minimise the quadratic model of the cost-to-go step by step, the last first.

    Models and stages have a leading axis. The change of a control is between `lower`, at most 0, and `upper`, at least 0.
    The regularisation is added to the curvature by the controls, in units of its largest entry, or as it is where all are zero;
    it shortens the steps.

    References:
        Li, Todorov. Iterative Linear Quadratic Regulator Design for Nonlinear Biological Movement Systems. ICINCO 2004.
        Tassa, Mansard, Todorov. Control-Limited Differential Dynamic Programming. ICRA 2014 (limits).
    """
    n = models.A.shape[-1]

    def back(carry, inputs):
        value, promised, sound = carry
        A, B, stage, low, high = inputs
        both = jnp.concatenate([A, B], axis=1)
        gradient = stage.gradient + both.T @ value.gradient
        hessian = stage.hessian + both.T @ value.hessian @ both
        q_u, q_uu, q_ux = gradient[n:], hessian[n:, n:], hessian[n:, :n]
        added = regularisation * jnp.max(jnp.diag(q_uu))
        # Without curvature, as in a last step that moves speeds of no weight, there is no unit; any holds controls without slope.
        added = jnp.where(added == 0, regularisation, added)
        held = q_uu + added * jnp.eye(len(q_u), dtype=q_u.dtype)
        k, is_free, is_sound = minimise_in_box(held, q_u, low, high)
        K = -_solve_free(held, q_ux, is_free)
        # The exact cost-to-go of this law: its shorter forms hold only without regularisation and limits.
        closed = jnp.concatenate([jnp.eye(n, dtype=K.dtype), K])
        affine = jnp.concatenate([jnp.zeros(n, k.dtype), k])
        value_hessian = closed.T @ hessian @ closed
        value = Quadratic(closed.T @ (gradient + hessian @ affine), 0.5 * (value_hessian + value_hessian.T))
        return (value, promised - q_u @ k - 0.5 * k @ q_uu @ k, sound & is_sound), (k, K)

    start = (terminal, jnp.zeros((), models.A.dtype), jnp.asarray(True))
    inputs = (models.A, models.B, stages, lower, upper)
    (_, promised, sound), (k, K) = jax.lax.scan(back, start, inputs, reverse=True)
    sound &= jnp.all(jnp.isfinite(k)) & jnp.all(jnp.isfinite(K))
    return Feedback(k, K, promised, sound)


def minimise_in_box(
    hessian: _Matrix, gradient: ControlVector, lower: ControlVector, upper: ControlVector
) -> tuple[ControlVector, Bool[Array, " m"], Bool[Array, ""]]:
    """Minimise ½ xᵀ H x + gᵀ x between bounds, by projected Newton steps; H must be positive definite.

    Return the minimiser, which coordinates are free, and whether their gradient is zero up to rounding.

    References:
        Tassa, Mansard, Todorov. Control-Limited Differential Dynamic Programming. ICRA 2014, section III.
    """

    def value(x):
        return 0.5 * x @ hessian @ x + gradient @ x

    def free(x):
        slope = hessian @ x + gradient
        return slope, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))

    def improve(carry):
        number, _, x = carry
        slope, is_free = free(x)
        direction = -_solve_free(hessian, slope[:, None], is_free)[:, 0]
        # Backtracking with all lengths at once: a loop of its own would wait for the slowest problem under vmap.
        tried = jnp.clip(x + _SHORTENING[:, None].astype(x.dtype) * direction, lower, upper)
        values = jax.vmap(value)(tried)
        best = jnp.argmin(values)
        is_better = values[best] < value(x)
        return number + 1, is_better, jnp.where(is_better, tried[best], x)

    start = (0, jnp.asarray(True), jnp.clip(jnp.zeros_like(gradient), lower, upper))
    x = jax.lax.while_loop(lambda carry: carry[1] & (carry[0] < _NEWTON_STEPS), improve, start)[2]
    slope, is_free = free(x)
    rounding = 1e3 * jnp.finfo(x.dtype).eps * (jnp.abs(hessian) @ jnp.abs(x) + jnp.abs(gradient))
    is_sound = jnp.all(jnp.isfinite(x)) & jnp.all(~is_free | (jnp.abs(slope) <= rounding))
    return x, is_free, is_sound


def _solve_free(
    hessian: _Matrix, right: Float[Array, "m columns"], is_free: Bool[Array, " m"]
) -> Float[Array, "m columns"]:
    """Solve H y = b for the free coordinates, with the others held at zero."""
    both = is_free[:, None] & is_free
    held = jnp.where(both, hessian, jnp.eye(len(hessian), dtype=hessian.dtype))
    return jnp.linalg.solve(held, jnp.where(is_free[:, None], right, 0.0))
