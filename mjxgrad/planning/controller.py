"""Control by receding horizon: plan from the present state, do the first step of the plan, and plan again."""

import dataclasses
import itertools
import time
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import ArrayLike, Float

from mjxgrad._text import Printed, format_number
from mjxgrad.planning.linear_model import Exact, Smoother
from mjxgrad.planning.system import Cost, System, check_problem
from mjxgrad.planning.trajectory import Course, Problem, Search, checked, iterate, shifted
from mjxgrad.rollouts import State


class Controller(Printed):
    """Choose controls by planning anew in each step of a system.

    A decision begins at the last plan, shifted by one step, and takes a few iterations of `optimise_trajectory`. It looks at
    the clock between them, and keeps its deadline with the best plan so far. One program is compiled, when the controller is
    made. `print` shows the rate and the missed deadlines.

    Attributes:
        cost: cost of plans; to replace it by one with other numbers, such as a moved goal, compiles nothing.
        deadline: time of a decision (s), or None.
        seconds: durations of the decisions since the last reset (s).
        num_missed: number of decisions that the deadline cut short, or that ended after it.
        compile_seconds: duration of the compilation (s).
    """

    def __init__(
        self,
        system: System,
        cost: Cost,
        controls: Float[ArrayLike, "horizon m"],
        *,
        smoother: Smoother = Exact(),
        schedule: Sequence[float] | Float[ArrayLike, " iterations"] = (1.0,),
        first_schedule: Sequence[float] | Float[ArrayLike, " first"] | None = None,
        deadline: float | None = None,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
    ):
        """Compile an iteration; see `optimise_trajectory` for its arguments.

        Args:
            system: the system; one decision is one step of it.
            cost: the cost of plans.
            controls: initial controls of the first decision, one row per step.
            smoother: the smoother of the linear models at factor 1; its noise is the same in all decisions.
            schedule: factors of the smoothing in each decision, one per iteration.
            first_schedule: the same for the first decision, which has no deadline; None takes `schedule`.
            deadline: the time of a decision (s); one iteration is taken at least.
            lower: lower limits of the controls.
            upper: upper limits of the controls.

        Warns:
            UserWarning: as `optimise_trajectory`, for a scene in its reference pose.

        Raises:
            ValueError: if the deadline is not positive, and as `optimise_trajectory`.
        """
        if deadline is not None and not deadline > 0:
            raise ValueError(f"deadline must be positive, in seconds, or None, got {deadline}")
        check_problem(system, cost)
        began, origin = time.perf_counter(), system.origin
        for message in smoother.warnings(system, origin):
            warnings.warn(message, stacklevel=2)
        both = (schedule if first_schedule is None else first_schedule, schedule)
        given = [checked(system, origin, controls, np.asarray(one), lower, upper) for one in both]
        self._schedules, self._origin = [np.asarray(factors) for _, factors, *_ in given], np.asarray(origin)
        start, _, *limits = given[0]
        problem = Problem(system, cost, smoother, jax.random.split(jax.random.key(0), len(start)), *limits)
        self.system, self.cost, self.deadline, self._none = system, cost, deadline, problem.begin(origin, start)
        numbers, one = eqx.filter(cost, eqx.is_inexact_array_like), self._schedules[0][0]
        lowered = jax.jit(_iteration(problem)).lower(numbers, self._none, self._origin, *_inputs(one, one))
        self._iterate, self.compile_seconds = lowered.compile(), time.perf_counter() - began
        self.reset()

    def reset(self) -> None:
        """Forget the plan and the counts; the next decision is a first one."""
        self._search, self._expected, self.num_missed = self._none, 0.0, 0
        self.seconds: list[float] = []

    @property
    def plan(self) -> Course:
        """The present plan; its cost is infinite if its states are not finite."""
        return self._search.best

    def __call__(self, state: State | mujoco.MjData | Float[ArrayLike, " state"]) -> Float[np.ndarray, " m"]:
        """Return the controls of the present step.

        Args:
            state: the present state: a vector of the system, or for a scene its `State` or C MuJoCo's data.

        Raises:
            ValueError: if the state has another size than the system's, or is not finite.
        """
        start, is_first = self._vector(state), not self.seconds
        limit = np.inf if self.deadline is None or is_first else self.deadline
        factors, began, is_cut = self._schedules[0 if is_first else 1], time.perf_counter(), False
        if is_first:
            self._advance(start, *_inputs(factors[0], factors[0], is_first=True))
        for number, (factor, following) in enumerate(itertools.pairwise([*factors, factors[-1]])):
            before = time.perf_counter()
            # An iteration is expected to last as long as the one before it.
            if is_cut := number > 0 and before - began + self._expected > limit:
                break
            self._advance(start, *_inputs(factor, following, is_shifted=number == 0 and not is_first))
            self._expected = time.perf_counter() - before
        self.seconds.append(time.perf_counter() - began)
        self.num_missed += is_cut or self.seconds[-1] > limit
        return np.array(self.plan.controls)[0]

    def _advance(self, start: np.ndarray, *inputs: np.generic) -> None:
        numbers = eqx.filter(self.cost, eqx.is_inexact_array_like)
        self._search = jax.block_until_ready(self._iterate(numbers, self._search, start, *inputs))

    def _vector(self, state: Any) -> Float[np.ndarray, " state"]:
        parts = [getattr(state, name) for name in ("qpos", "qvel", "act")] if hasattr(state, "qpos") else [state]
        vector = np.concatenate(parts).astype(self._origin.dtype)
        if vector.shape != self._origin.shape:
            raise ValueError(f"state must have shape {self._origin.shape} in this system, got {vector.shape}")
        if not np.isfinite(vector).all():
            raise ValueError(f"state must be finite, got {vector.tolist()}")
        return vector

    def __str__(self) -> str:
        rate = f"{format_number(1 / float(np.median(self.seconds or [np.inf])))} Hz in the median"
        missed = f", {self.num_missed} missed {format_number(1e3 * self.deadline)} ms" if self.deadline else ""
        is_idle = self.seconds and np.array_equal(self.plan.controls, self._none.best.controls)
        idle = ". Controls are as given, since no small change lowers the cost: begin with others" if is_idle else ""
        return f"{len(self.seconds)} decisions, {rate}{missed}; compiled once, in {self.compile_seconds:.1f} s{idle}"


def _inputs(factor: Any, following: Any, *, is_first: bool = False, is_shifted: bool = False) -> tuple[np.generic, ...]:
    """Return the last arguments of an iteration, as NumPy's numbers: JAX would compile a program to make its own."""
    return factor, following, np.bool_(is_first), np.bool_(is_shifted)


def _iteration(problem: Problem):
    """Return the program of an iteration: of given controls the first, which computes their course, or of a shifted plan."""
    rest = eqx.filter(problem.cost, eqx.is_inexact_array_like, inverse=True)

    def run(numbers: Cost, search: Search, start, factor, following, is_first, is_shifted) -> Search:
        one, plan = dataclasses.replace(problem, cost=eqx.combine(numbers, rest)), search.best
        fresh = one.begin(start, shifted(plan, jnp.where(is_shifted, 1, 0)))
        # The new course of the shifted plan is not computed: the feedback law around the old one takes the difference.
        states = jnp.concatenate([start[None], plan.states[2:], plan.states[-1:]])
        course = Course(jnp.where(is_first, fresh.course.states, states), fresh.course.controls, fresh.course.cost)
        fresh = dataclasses.replace(fresh, course=course)
        search = jax.tree.map(lambda new, old: jnp.where(is_first | is_shifted, new, old), fresh, search)
        return iterate(one, search, factor, following, is_first)[0]

    return run
