"""An iteration of a plan in parts that are compiled once and measured, for decisions that look at the clock between them."""

import copy
import dataclasses
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._arrays import traceable
from mjxgrad.planning.system import Cost
from mjxgrad.planning.trajectory import Course, Problem, Search

PARTS: tuple[str, ...] = ("linear models", "backward pass", "rollouts")
"""Of an iteration, in their order."""
Turn = tuple[str, int]
"""A part, and the step of the plan from which on it is taken."""
LAST: Turn = (PARTS[-1], 0)
_NUM_MEASURED = 3  # iterations


class Iteration:
    """The parts of an iteration. Linear models take longest by far: they are taken of so many steps of the plan at a time.

    Attributes:
        blank: the search before its first iteration.
        horizon: number of steps of the plan.
        count: number of steps whose linear models are taken at a time.
        programs: the compiled parts.
        seconds: typical time of each part in an iteration.
        shortest: least time of linear models between two looks at the clock: other programs do not count in it.
        compile_seconds: duration of the compilation (s).
    """

    def __init__(
        self,
        problem: Problem,
        cost: Cost,
        controls: Float[Array, "horizon m"],
        start: Float[np.ndarray, " state"],
        still: Float[np.ndarray, "N horizon m"],
        count: int,
    ):
        """Compile and measure all parts.

        Args:
            problem: the constants of all iterations.
            cost: the cost; `run` takes others that differ in the values of floats alone.
            controls: initial controls.
            start: the state at which an iteration is measured.
            still: random changes of the controls, zeros.
            count: number of steps whose linear models are taken at a time.
        """
        self._problem, self._cost, self._start, self._still = problem, cost, start, still
        self.blank, self.horizon = problem.begin(problem.system.origin, controls), len(controls)
        self.programs: dict[str, Any] = {}
        self.compile_seconds = 0.0
        self._compile(count, PARTS)

    def by(self, count: int) -> "Iteration":
        """Return the iteration with linear models of another number of steps at a time."""
        other = copy.copy(self)
        other._compile(count, PARTS[:1])
        return other

    def _compile(self, count: int, names: Sequence[str]) -> None:
        """Compile some parts at once, and measure an iteration."""
        began, problem = time.perf_counter(), self._problem
        rest = eqx.partition(self._cost, eqx.is_inexact_array_like)[1]
        of = lambda numbers: dataclasses.replace(problem, cost=eqx.combine(numbers, rest))  # noqa: E731

        def linearised(numbers: Any, search: Search, factor: Array, _: Array, begin: Array, *__: Any) -> Search:
            # Of a plan that was shifted, at the first piece of an iteration: all pieces are to belong to one motion.
            is_new = (begin == self.horizon - count) & ~jnp.isfinite(search.course.cost)
            search = jax.lax.cond(is_new, lambda: of(numbers).followed(search, factor), lambda: search)
            return of(numbers).linearised(search, factor, begin, count)

        solved = lambda numbers, search, *_: of(numbers).solved(search)  # noqa: E731
        chosen = lambda numbers, search, _, after, __, *given: of(numbers).chosen(search, after, *given)[0]  # noqa: E731
        functions, given = dict(zip(PARTS, (linearised, solved, chosen), strict=True)), self._given(LAST)
        with traceable("cost"):
            lowered = [jax.jit(functions[name]).lower(*given) for name in names]
        with ThreadPoolExecutor(len(names)) as threads:
            programs = threads.map(lambda one: one.compile(), lowered)
            self.programs = self.programs | dict(zip(names, programs, strict=True))
        self.count = count
        self.compile_seconds += time.perf_counter() - began
        every = self._measured()
        self.seconds = {name: float(np.median([taken[name] for taken in every])) for name in PARTS}
        self.shortest = min(taken[PARTS[0]] for taken in every) / self.num_pieces

    def _given(
        self,
        turn: Turn,
        cost: Cost | None = None,
        search: Search | None = None,
        factors: tuple[Any, Any] | None = None,
        noise: Float[np.ndarray, "N horizon m"] | None = None,
        is_first: bool = False,
    ) -> tuple:
        """Return the arguments that all programs share."""
        one = np.ones((), self.blank.best.cost.dtype)[()]
        numbers = eqx.filter(self._cost if cost is None else cost, eqx.is_inexact_array_like)
        search, noise = self.blank if search is None else search, self._still if noise is None else noise
        return numbers, search, *(factors or (one, one)), np.int32(turn[1]), np.bool_(is_first), noise

    def run(self, turn: Turn, *given: Any, **how: Any) -> Search:
        """Run a part; see `_given` for its arguments."""
        return jax.block_until_ready(self.programs[turn[0]](*self._given(turn, *given, **how)))

    @property
    def first(self) -> Turn:
        """The begin of an iteration: its last steps, since the plan moves towards its first ones from decision to decision."""
        return PARTS[0], self.horizon - self.count

    def after(self, turn: Turn) -> Turn:
        """Return what comes next."""
        part, begin = turn
        if part == PARTS[0] and begin > 0:
            return part, max(begin - self.count, 0)
        index = PARTS.index(part) + 1
        return (PARTS[index], 0) if index < len(PARTS) else self.first

    def moved_on(self, turn: Turn) -> Turn:
        """Return what is next where it was this one before the plan moved on by a step."""
        part, begin = turn
        if part != PARTS[0] or turn == self.first:
            return turn
        return self.after(turn) if begin + self.count == 1 else (part, max(begin - 1, 0))

    @property
    def longest(self) -> tuple[str, float]:
        """The part that takes longest between two looks at the clock, and its seconds."""
        pieces = dict.fromkeys(PARTS, 1) | {PARTS[0]: self.num_pieces}
        return max(((name, x / pieces[name]) for name, x in self.seconds.items()), key=lambda one: one[1])

    @property
    def num_pieces(self) -> int:
        """In how many the linear models are taken."""
        return -(-self.horizon // self.count)

    def begun(self, start: Float[np.ndarray, " state"]) -> Search:
        """Return the search before its first iteration, from a state."""
        states = jax.device_put(np.tile(start, (self.horizon + 1, 1)))
        course = Course(states, self.blank.best.controls, self.blank.best.cost)
        return dataclasses.replace(self.blank, course=course, best=course)

    def _measured(self) -> list[dict[str, float]]:
        """Return the times of the parts in some iterations, but for a first one: what that prepares is kept."""
        search, found = self.run(LAST, search=self.begun(self._start), is_first=True), []
        for _ in range(1 + _NUM_MEASURED):
            turn, taken = self.first, dict.fromkeys(PARTS, 0.0)
            while True:
                began = time.perf_counter()
                search = self.run(turn, search=search)
                taken[turn[0]] += time.perf_counter() - began
                if (turn := self.after(turn)) == self.first:
                    break
            found.append(taken)
        return found[1:]
