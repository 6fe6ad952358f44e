"""Control by receding horizon: plan from the present state, do the first step of the plan, and plan again."""

import dataclasses
import itertools
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._arrays import real, traceable, whole
from mjxgrad._text import Printed, format_number
from mjxgrad.planning.linear_model import Exact, Smoother
from mjxgrad.planning.system import Cost, System
from mjxgrad.planning.trajectory import Course, Problem, per_control, posed
from mjxgrad.rollouts import State

PARTS: tuple[str, ...] = ("linear models", "backward pass", "rollouts")
"""Of an iteration, in their order."""
_PIECES, _SMALLEST = 4, 0.125  # of a random change of a plan, and the share of the deviation that the first plan has
_LITTLE = 0.9  # of the given controls' cost: what costs more has hardly been improved
_FADING = 0.95  # of what a part is expected to take, if it took less


class Controller(Printed):
    """Choose controls by planning anew in each step of a system.

    A decision begins at the last plan, shifted by one step, and takes a few iterations of `optimise_trajectory`. It looks at the
    clock between their parts: where the next one would end after the deadline, it returns the best plan so far, and the next
    decision goes on from there. Programs are compiled when the controller is made. `print` shows what a decision takes.

    Attributes:
        cost: cost of plans; to replace it by one with other numbers, such as a moved goal, compiles nothing.
        deadline: time of a decision (s), or None.
        price: seconds of each part of a decision, as measured when the controller was made.
        seconds: durations of the decisions since the last reset (s).
        num_cut: number of decisions that the deadline cut short.
        num_missed: number of decisions that ended after it.
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
        num_samples: int = 0,
        stddev: ArrayLike = 0.1,
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
            num_samples: plans with random changes that are tried beside the step lengths: they find what derivatives do not
                see, such as a touch from afar.
            stddev: standard deviation of these changes, in units of the controls, a number or one per control. Each plan has
                a share of it, from an eighth to all.
            deadline: the time of a decision (s); one part of an iteration is taken at least.
            lower: lower limits of the controls.
            upper: upper limits of the controls.

        Warns:
            UserWarning: if the deadline is shorter than an iteration; and as `optimise_trajectory`, for the reference pose.

        Raises:
            ValueError: if a number is out of its range, and as `optimise_trajectory`.
        """
        if deadline is not None and not real("deadline", deadline) > 0:
            raise ValueError(f"deadline must be positive, in seconds, or None, got {deadline}")
        self.num_samples = whole("num_samples", num_samples, 0)
        both = [schedule if first_schedule is None else first_schedule, schedule]
        given = system, cost, None, controls, jax.random.key(0), smoother, both, lower, upper
        problem, _, start, factors = posed(*given)
        self._schedules, self._origin = [np.asarray(one) for one in factors], np.asarray(system.origin)
        self.stddev = np.asarray(per_control("stddev", stddev, system, self._origin.dtype))
        if not ((self.stddev >= 0) & (self.stddev < np.inf)).all():
            raise ValueError(f"stddev must be at least 0 and finite, got {self.stddev}")
        self.system, self._cost, self.deadline = system, cost, deadline
        self._compile(problem, start)
        self._measure()
        if deadline is not None and (least := sum(self.price.values()) / len(self._schedules[1])) > deadline:
            warnings.warn(self._too_short(least), stacklevel=2)

    @property
    def cost(self) -> Cost:
        return self._cost

    @cost.setter
    def cost(self, cost: Cost) -> None:
        before, after = (_numbers_of(one) for one in (self._cost, cost))
        if before != after:
            raise ValueError(
                "cost must have the form of the compiled one: make a new Controller for a cost of another form"
            )
        self._cost = cost

    def _compile(self, problem: Problem, controls: Array) -> None:
        """Compile the three parts, at once."""
        began, number = time.perf_counter(), self._schedules[0][0]
        numbers, rest = eqx.partition(self.cost, eqx.is_inexact_array_like)
        self._blank = problem.begin(self.system.origin, controls)
        of = lambda numbers: dataclasses.replace(problem, cost=eqx.combine(numbers, rest))  # noqa: E731
        num = len(controls)
        # Linear models take longest. With a deadline half of them at a time: a decision may end between the halves.
        count = num if self.deadline is None else num - num // 2
        self._iteration = [(PARTS[0], begin) for begin in sorted({0, num - count})] + [(part, 0) for part in PARTS[1:]]
        parts = (
            lambda numbers, search, factor, _, begin, *__: of(numbers).linearised(search, factor, begin, count),
            lambda numbers, search, *_: of(numbers).solved(search),
            lambda numbers, search, _, following, __, *given: of(numbers).chosen(search, following, *given)[0],
        )
        self._still = np.zeros_like(self._noise(0))
        given = numbers, self._blank, number, number, np.int32(0), np.bool_(True), self._still
        with traceable("cost"):
            lowered = [jax.jit(part).lower(*given) for part in parts]
        with ThreadPoolExecutor(len(PARTS)) as threads:
            self._programs: dict[str, Any] = dict(
                zip(PARTS, threads.map(lambda one: one.compile(), lowered), strict=True)
            )
        self.compile_seconds = time.perf_counter() - began

    def _measure(self) -> None:
        """Measure the parts of a decision, the least of three: what a first one prepares is kept."""
        self.price, self._least, found = {}, dict.fromkeys(self._iteration, 0.0), []
        self.reset()
        for _ in range(3):
            self(self._origin)
            found.append(dict(self._last))
        self.price = dict.fromkeys(PARTS, 0.0)
        for step in self._iteration:
            self.price[step[0]] += len(self._schedules[1]) * min(seconds[step] for seconds in found)
        self._least = {step: min(seconds[step] for seconds in found) for step in self._iteration}
        self.reset()

    def reset(self) -> None:
        """Forget the plan and the counts; the next decision is a first one."""
        self._search, self._next, self.num_missed, self.num_cut = self._blank, 0, 0, 0
        self._last, self._expected = dict(self._least), dict(self._least)
        self.seconds: list[float] = []

    @property
    def plan(self) -> Course:
        """The present plan; its cost is infinite if its states are not finite, or where it was not computed in time."""
        return self._search.best

    def __call__(self, state: State | mujoco.MjData | Float[ArrayLike, " state"]) -> Float[np.ndarray, " m"]:
        """Return the controls of the present step.

        Args:
            state: the present state: a vector of the system, or for a scene its `State` or C MuJoCo's data.

        Warns:
            UserWarning: in the first decision, if no control moves something that has a cost, and the cost hardly falls.

        Raises:
            ValueError: if the state has another size than the system's, or is not finite.
        """
        start, is_first, began = self._vector(state), not self.seconds, time.perf_counter()
        limit = np.inf if self.deadline is None or is_first or not self.price else self.deadline
        self._begin(start, is_first)
        given = self.plan.cost
        factors = self._schedules[0 if is_first else 1]
        turns = [(*both, step) for both in itertools.pairwise([*factors, factors[-1]]) for step in self._iteration]
        for number, (factor, following, step) in enumerate(turns[self._next :]):
            before = time.perf_counter()
            is_cut = number > 0 and before - began + self._expected[step] > limit
            self._next = self._iteration.index(step) if is_cut else 0
            if is_cut:
                self.num_cut += 1
                break
            self._advance(step, factor, following)
        self.seconds.append(time.perf_counter() - began)
        self.num_missed += self.seconds[-1] > limit
        if is_first and self._search.unmoved.any() and self.price and not self.plan.cost < _LITTLE * given:
            warnings.warn(self._untouched(), stacklevel=2)
        return np.array(self.plan.controls)[0]

    def _begin(self, start: np.ndarray, is_first: bool) -> None:
        """Shift all by a step, to the present state; the first time compute the course of the given controls."""

        # By NumPy: JAX would compile programs, and takes a tenth of a millisecond for a slice. The new course of the shifted plan
        # is not computed: the feedback law around the old one takes the difference.
        def later(x: Array) -> np.ndarray:
            known = np.asarray(x)
            return np.concatenate([known[1:], known[-1:]]) if known.ndim else known

        search, horizon = self._search, len(self._blank.law.change)
        if not is_first:
            parts = {name: jax.tree.map(later, getattr(search, name)) for name in ("best", "models", "law")}
            search = dataclasses.replace(search, **jax.device_put(parts))
        states = np.tile(start, (horizon + 1, 1)) if is_first else np.array(search.best.states)
        states[0] = start
        unknown = jax.device_put(np.full_like(search.best.cost, np.inf))
        course = Course(jax.device_put(states), search.best.controls, unknown)
        self._search = dataclasses.replace(search, course=course, best=course)
        if is_first:
            self._advance(self._iteration[-1], *2 * [self._schedules[0][0]], is_first=True)

    def _advance(
        self, step: tuple[str, int], factor: np.generic, following: np.generic, *, is_first: bool = False
    ) -> None:
        """Run a part of an iteration, from a step of the plan on; its time is what the next is expected to take."""
        began, numbers = time.perf_counter(), eqx.filter(self.cost, eqx.is_inexact_array_like)
        part, begin = step
        noise = self._noise(len(self.seconds)) if part == PARTS[-1] else self._still
        given = factor, following, np.int32(begin), np.bool_(is_first), noise
        self._search = jax.block_until_ready(self._programs[part](numbers, self._search, *given))
        self._last[step] = time.perf_counter() - began
        self._expected[step] = max(self._last[step], _FADING * self._expected[step])

    def _noise(self, seed: int) -> Float[np.ndarray, "N horizon m"]:
        """Return changes of the controls, each held for a quarter of the plan, and each plan's larger than the last one's."""
        horizon, size = self._blank.course.controls.shape
        sizes = np.geomspace(_SMALLEST, 1, self.num_samples)[:, None, None] * self.stddev
        noise = sizes * np.random.default_rng(seed).normal(size=(self.num_samples, _PIECES, size))
        return np.repeat(noise, -(-horizon // _PIECES), axis=1)[:, :horizon].astype(self._origin.dtype)

    def _vector(self, state: Any) -> Float[np.ndarray, " state"]:
        parts = [getattr(state, name) for name in ("qpos", "qvel", "act")] if hasattr(state, "qpos") else [state]
        try:
            vector = np.concatenate(parts).astype(self._origin.dtype)
        except (TypeError, ValueError):
            wanted = "a vector, or for a scene its State or C MuJoCo's data"
            raise ValueError(f"state must be {wanted}, got {type(state).__name__}") from None
        if vector.shape != self._origin.shape:
            raise ValueError(f"state must have shape {self._origin.shape} in this system, got {vector.shape}")
        if not np.isfinite(vector).all():
            raise ValueError(f"state must be finite, got {vector.tolist()}")
        return vector

    def _too_short(self, least: float) -> str:
        assert self.deadline is not None
        told = f"an iteration takes about {_ms(least)}, longer than the deadline of {_ms(self.deadline)}, and is spread over some"
        steps = int(len(self._blank.course.controls) * self.deadline / least)
        return f"{told} decisions: take a deadline of {_ms(1.2 * least)}, or a plan of {max(steps, 1)} steps"

    def _untouched(self) -> str:
        places = np.flatnonzero(self._search.unmoved)
        told = f"no control moves {self.system.named(places)}, which has a cost: where nothing touches, derivatives are zero"
        helps = "add the distance between what pushes and what is pushed to the cost, smooth by Analytic, or take num_samples=16"
        return f"{told}; {helps}"

    def __str__(self) -> str:
        price, parts = sum(self.price.values()), ", ".join(f"{part} {1e3 * x:.0f}" for part, x in self.price.items())
        told = f"A decision takes about {_ms(price)} ({format_number(1 / price)} Hz): {parts}"
        told += f"; compiled in {self.compile_seconds:.1f} s"
        if not self.seconds:
            return told
        rate = f"{format_number(1 / float(np.median(self.seconds)))} Hz in the median"
        missed = f", {self.num_missed} missed {_ms(self.deadline)}, {self.num_cut} cut short" if self.deadline else ""
        idle = ""
        if np.array_equal(self.plan.controls, self._blank.best.controls):
            why = (
                self._untouched()
                if self._search.unmoved.any()
                else "no small change lowers the cost: begin with others"
            )
            idle = f". Controls are as given, since {why}"
        return f"{len(self.seconds)} decisions, {rate}{missed}. {told}{idle}"


def _ms(seconds: float) -> str:
    return f"{format_number(1e3 * seconds)} ms"


def _numbers_of(cost: Cost) -> tuple[Any, list[str]]:
    """Return the structure and the shapes of a cost's numbers: what its programs are compiled for."""
    leaves, tree = jax.tree.flatten(eqx.filter(cost, eqx.is_inexact_array_like))
    return tree, [jax.typeof(leaf).str_short() for leaf in leaves]
