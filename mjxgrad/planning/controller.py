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
from jaxtyping import ArrayLike, Float

from mjxgrad._text import Printed, format_number
from mjxgrad.planning.linear_model import Exact, Smoother
from mjxgrad.planning.system import Cost, System
from mjxgrad.planning.trajectory import Course, Problem, Search, checked, iterate, shifted
from mjxgrad.rollouts import State

# An iteration is expected to last as long as the longest before it. That fades, or one delay would cut all later decisions.
_FADING = 0.9


class Controller(Printed):
    """Choose controls by planning anew in each step of a system.

    A decision begins at the last plan, shifted by one step, and takes a few iterations of `optimise_trajectory`. It looks at
    the clock between them, and keeps its deadline with the best plan so far. One program is compiled, when the controller is
    made. `print` shows the rate and the missed deadlines.

    Attributes:
        cost: cost of plans; to replace it by one with other arrays, such as a moved goal, compiles nothing.
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
    ):
        """Compile an iteration; see `optimise_trajectory` for arguments that are not below.

        Args:
            system: the system; one decision is one step of it.
            cost: the cost of plans.
            controls: initial controls of the first decision, one row per step.
            smoother: the smoother of the linear models at factor 1; its noise is the same in all decisions.
            schedule: positive factor of the smoothing in each iteration of a decision.
            first_schedule: the same for the first decision, which has no deadline; None takes `schedule`.
            deadline: the time of a decision (s); the course of the shifted plan is computed at least.
            lower: lower limits of the controls.
            upper: upper limits of the controls.

        Raises:
            ValueError: if the deadline is not positive, and as `optimise_trajectory`.
        """
        if deadline is not None and not deadline > 0:
            raise ValueError(f"deadline must be positive, in seconds, or None, got {deadline}")
        began, first = time.perf_counter(), schedule if first_schedule is None else first_schedule
        origin = system.origin
        controls, factors, *limits = checked(system, controls, [*first, *schedule], lower, upper, origin.dtype)
        problem = Problem(system, cost, smoother, jax.random.split(jax.random.key(0), len(controls)), *limits)
        self.system, self.cost, self.deadline, self._smoother = system, cost, deadline, smoother
        self._schedules, self._origin = np.split(np.asarray(factors), [len(first)]), np.asarray(origin)
        self._iterate, self._none = _compiled(problem), problem.begin(origin, controls)
        self.reset()
        self._advance(self._origin, *self._schedules[0][[0, 0]], begins=True)
        self.compile_seconds = time.perf_counter() - began
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

    def __call__(self, state: State | mujoco.MjData | Float[ArrayLike, " state"]) -> Float[np.ndarray, " m"]:
        """Return the controls of the present step.

        Args:
            state: the present state: a vector of the system, or for a scene its `State` or C MuJoCo's data.

        Warns:
            UserWarning: in a first decision, as `optimise_trajectory`.

        Raises:
            ValueError: if the state has another size than the system's, or is not finite.
        """
        start, is_first = self._vector(state), not self.seconds
        for message in self._smoother.warnings(self.system, start) if is_first else ():
            warnings.warn(message, stacklevel=2)
        limit = np.inf if self.deadline is None or is_first else self.deadline
        factors, began = self._schedules[0 if is_first else 1], time.perf_counter()
        self._advance(start, factors[0], factors[0], begins=True, num_steps=0 if is_first else 1)
        for factor, following in itertools.pairwise([*factors, factors[-1]]):
            before = time.perf_counter()
            if before - began + self._longest > limit:
                self.num_cut += 1
                break
            self._advance(start, factor, following)
            self._longest = max(_FADING * self._longest, time.perf_counter() - before)
        self.seconds.append(time.perf_counter() - began)
        self.num_late += self.seconds[-1] > limit
        return np.array(self.plan.controls)[0]

    def _advance(self, start: np.ndarray, *factors: Any, begins: bool = False, num_steps: int = 0) -> None:
        # NumPy's numbers: each new one of JAX's would take a program to make.
        inputs = (start, *factors, np.bool_(begins), np.int32(num_steps))
        self._search = jax.block_until_ready(self._iterate(self.cost, self._search, *inputs))

    def _vector(self, state: Any) -> Float[np.ndarray, " state"]:
        parts = [getattr(state, name) for name in ("qpos", "qvel", "act")] if hasattr(state, "qpos") else [state]
        vector = np.concatenate(parts).astype(self._origin.dtype)
        if vector.shape != self._origin.shape:
            raise ValueError(f"state must have shape {self._origin.shape} in this system, got {vector.shape}")
        if not np.isfinite(vector).all():
            raise ValueError(f"state must be finite, got {vector.tolist()}")
        return vector

    def __str__(self) -> str:
        compiled = f"compiled once, in {self.compile_seconds:.1f} s"
        if not self.seconds:
            return f"no decision; {compiled}"
        rate = f"{len(self.seconds)} decisions, {format_number(1 / float(np.median(self.seconds)))} Hz in the median"
        late = f", {self.num_late} later than {format_number(1e3 * self.deadline)} ms" if self.deadline else ""
        return f"{rate}{late}{f', {self.num_cut} cut' * (self.num_cut > 0)}; {compiled}"


def _compiled(problem: Problem):
    """Return a compiled iteration; the first one of a decision begins at the last plan, some steps later."""

    @eqx.filter_jit
    def run(cost: Cost, search: Search, start, factor, following, begins, num_steps) -> Search:
        one = dataclasses.replace(problem, cost=cost)
        fresh = one.begin(start, shifted(search.best, num_steps))
        search = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, search)
        return iterate(one, search, factor, following, begins)[0]

    return run
