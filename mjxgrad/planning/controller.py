"""Control by receding horizon: plan from the present state, do the first step of the plan, and plan again."""

import dataclasses
import itertools
import time
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import ArrayLike, Float, PRNGKeyArray

from mjxgrad._text import Printed, format_number
from mjxgrad.planning.linear_model import Exact, Smoother
from mjxgrad.planning.system import Cost, System
from mjxgrad.planning.trajectory import Course, Problem, Search, factors_of, iterate, problem_of, shifted
from mjxgrad.rollouts import State

# An iteration is expected to last as long as the longest before it. That fades, or one delay would cut all later decisions.
_FADING = 0.9


class Controller(Printed):
    """Choose controls by planning anew in each step of a system.

    A decision begins at the last plan, shifted by one step, and takes a few iterations of `optimise_trajectory`. It looks at
    the clock between them, and keeps its deadline with the best plan so far. One program is compiled, when the controller is
    made. `print` shows the rate and the missed deadlines.

    Attributes:
        deadline: time of a decision (s), or None.
        seconds: durations of the decisions since the last reset (s).
        num_late: number of decisions that missed the deadline.
        num_cut: number of decisions that left out iterations because of it.
        compile_seconds: duration of the compilation (s).
    """

    def __init__(
        self,
        system: System,
        cost: Cost,
        controls: Float[ArrayLike, "horizon m"],
        *,
        smoother: Smoother = Exact(),
        schedule: Float[ArrayLike, " iterations"] = (1.0,),
        first_schedule: Float[ArrayLike, " first"] | None = None,
        deadline: float | None = None,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        key: PRNGKeyArray | None = None,
    ):
        """Compile one iteration.

        Args:
            system: the system; one decision is one step of it.
            cost: the cost of plans.
            controls: initial controls of the first decision, one row per step.
            smoother: the smoother of the linear models at factor 1.
            schedule: positive factor of the smoothing in each iteration of a decision.
            first_schedule: the same for the first decision, which has no deadline; None takes `schedule`.
            deadline: the time of a decision (s). Its first part, the course of the shifted plan, is always computed.
            lower: lower limits of the controls; None takes the actuators' own.
            upper: upper limits of the controls, as `lower`.
            key: key of the smoother's noise, which is the same in all decisions; None takes key 0.

        Raises:
            ValueError: if the deadline is not positive, and as `optimise_trajectory`.
        """
        if deadline is not None and not deadline > 0:
            raise ValueError(f"deadline must be positive, in seconds, or None, got {deadline}")
        dtype = jnp.result_type(float)
        key = jax.random.key(0) if key is None else key
        controls, problem = problem_of(system, cost, controls, key, smoother, lower, upper, dtype)
        given = {"first_schedule": schedule if first_schedule is None else first_schedule, "schedule": schedule}
        self._schedules = [np.asarray(factors_of(name, factors, dtype)) for name, factors in given.items()]
        self.system, self.deadline, self._smoother, self._cost = system, deadline, smoother, _strong(cost)
        self._none = problem.begin(jnp.zeros(system.num_coordinates, dtype), controls)
        one, began = self._schedules[0][0], time.perf_counter()
        start = np.zeros(system.num_coordinates, dtype)
        lowered = eqx.filter_jit(_program(problem)).lower(self._cost, self._none, start, *_inputs(one, one))
        self._iterate, self.compile_seconds = lowered.compile(), time.perf_counter() - began
        self.reset()

    def reset(self) -> None:
        """Forget the plan and the counts; the next decision is a first one."""
        self._search, self._longest = self._none, 0.0
        self.seconds: list[float] = []
        self.num_late = self.num_cut = 0

    @property
    def plan(self) -> Course:
        """The present plan; its cost is infinite if its states are not finite."""
        return self._search.best

    @property
    def cost(self) -> Cost:
        """The cost of plans; it may be replaced by one with other numbers, such as with a moved goal."""
        return self._cost

    @cost.setter
    def cost(self, cost: Cost) -> None:
        if _kind(cost) != _kind(self._cost):
            raise ValueError("cost must differ in the numbers of arrays alone; for any other make another Controller")
        self._cost = _strong(cost)

    def __call__(self, state: State | mujoco.MjData | Float[ArrayLike, " state"]) -> Float[np.ndarray, " m"]:
        """Return the controls of the present step.

        Args:
            state: present state: the vector of the system; for a scene also its `State`, or C MuJoCo's data.

        Warns:
            UserWarning: in a first decision, as `optimise_trajectory`.

        Raises:
            ValueError: if the state has another size than the system's, or is not finite.
        """
        start, is_first = self._vector(state), not self.seconds
        for message in self._smoother.warnings(self.system, start) if is_first else ():
            warnings.warn(message, stacklevel=2)
        limit = np.inf if self.deadline is None or is_first else self.deadline
        factors = self._schedules[0 if is_first else 1]
        began = time.perf_counter()
        self._advance(start, _inputs(factors[0], factors[0], begins=True, num_steps=0 if is_first else 1))
        for factor, following in itertools.pairwise([*factors, factors[-1]]):
            before = time.perf_counter()
            if before - began + self._longest > limit:
                self.num_cut += 1
                break
            self._advance(start, _inputs(factor, following))
            self._longest = max(_FADING * self._longest, time.perf_counter() - before)
        chosen = np.array(self.plan.controls)[0]
        self.seconds.append(time.perf_counter() - began)
        self.num_late += self.seconds[-1] > limit
        return chosen

    def _advance(self, start: np.ndarray, inputs: tuple) -> None:
        self._search = jax.block_until_ready(self._iterate(self._cost, self._search, start, *inputs))

    def _vector(self, state: Any) -> Float[np.ndarray, " state"]:
        parts = [getattr(state, name) for name in ("qpos", "qvel", "act")] if hasattr(state, "qpos") else [state]
        vector, shape = np.concatenate(parts).astype(self._none.course.states.dtype), (self.system.num_coordinates,)
        if vector.shape != shape:
            raise ValueError(f"state must have shape {shape} in this system, got {vector.shape}")
        if not np.isfinite(vector).all():
            raise ValueError(f"state must be finite, got {vector.tolist()}")
        return vector

    def __str__(self) -> str:
        if not self.seconds:
            return f"no decision yet; compiled in {self.compile_seconds:.1f} s"
        rate = f"{len(self.seconds)} decisions, {format_number(1 / float(np.median(self.seconds)))} Hz in the median"
        held = "" if self.deadline is None else f", {self.num_late} later than {format_number(1e3 * self.deadline)} ms"
        cut = f", {self.num_cut} cut" if self.num_cut else ""
        return f"{rate}{held}{cut}; compiled once, in {self.compile_seconds:.1f} s"


def _program(problem: Problem):
    """Return the function to compile: one iteration, of which the first begins at the last plan, some steps later."""

    def run(cost: Cost, search: Search, start, factor, following, begins, num_steps) -> Search:
        one = dataclasses.replace(problem, cost=cost)
        fresh = one.begin(start, shifted(search.best, num_steps))
        search = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, search)
        return iterate(one, search, factor, following, begins)[0]

    return run


def _inputs(factor: Any, following: Any, *, begins: bool = False, num_steps: int = 0) -> tuple[np.generic, ...]:
    """Return the last arguments of the program; numbers of numpy, since those of JAX would be compiled."""
    return factor, following, np.bool_(begins), np.int32(num_steps)


def _strong(cost: Cost) -> Cost:
    """Return a cost without weak types, which belong to a program's signature."""
    return jax.tree.map(lambda x: x.astype(x.dtype) if eqx.is_array(x) else x, cost)


def _kind(cost: Cost) -> tuple[list, Any]:
    """Return what a program is compiled for."""
    leaves, structure = jax.tree.flatten(cost)
    return [jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves], structure
