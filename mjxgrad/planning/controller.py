"""Control by receding horizon: plan from the present state, do the first step of the plan, and plan again."""

import dataclasses
import itertools
import math
import time
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from mjxgrad._arrays import real, whole
from mjxgrad._programs import parted
from mjxgrad._text import Printed, format_number
from mjxgrad.planning.iteration import LAST, PARTS, Iteration, Turn
from mjxgrad.planning.linear_model import Analytic, Exact, Smoother
from mjxgrad.planning.system import Cost, SceneSystem, System
from mjxgrad.planning.trajectory import FREE, NO_COST, Course, Problem, deviations, listed, posed, random_changes
from mjxgrad.rollouts import State

_SAMPLES = 16  # random changes of a plan, for 15 % of a decision's time where a finger pushes a box
_FIRST = 10  # iterations of the first decision, and more where the others take more
_DISTANCE = "the distance between what pushes and what is pushed"
_LITTLE = 0.9  # of the given controls' cost: what costs more has hardly been improved
_RECENT, _QUANTILE = 20, 0.9  # a part is expected to take what so large a share of its last times stays below
_SHARE = 0.25  # of a deadline that linear models may take between two looks at the clock
_SHORTER = 0.95  # of the time of more steps
_SLACK = 1.5  # times what is typical, in what is advised: other programs take cores now and then


class Controller(Printed):
    """Choose controls by planning anew in each step of a system.

    A decision begins at the last plan, shifted by one step, and takes a few iterations of `optimise_trajectory`. It looks at the
    clock between their parts: where the next one would end after the deadline, it returns the best plan so far, and the next
    decision goes on from there. The shorter the deadline, the fewer steps have their linear models taken between two looks at the
    clock, so that only a part that takes longer than the deadline by itself misses it. Programs are compiled and measured when
    the controller is made. `print` shows what a decision is expected to take, and after the first one what decisions took.

    Attributes:
        cost: cost of plans; to replace it by one with other floats, such as a moved goal, compiles nothing. One that differs in
            whole numbers or functions is refused with a `ValueError`.
        deadline: time of a decision (s), or None.
        price: seconds of each part of a decision without a deadline, as measured when the controller was made: at the scene's
            first key frame, without any at the system's origin.
        seconds: durations of the decisions since the last reset (s).
        costs: cost of the plan after each of them; infinite where it was not computed in time.
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
        num_samples: int | None = None,
        stddev: ArrayLike | None = None,
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
            first_schedule: the same for the first decision, which has no deadline; None takes ten iterations at the first
                factor of `schedule`, then its others. A plan that has not converged is never caught up with.
            num_samples: plans with random changes that are tried beside the step lengths, see `optimise_trajectory`: they reach
                contacts that derivatives do not see, and get past where a push turns a body. None takes 16, and none with a
                smoother such as `Sampled`, whose steps are many. Where an iteration is spread over decisions, they are tried in
                each that has the time, else in every other one.
            stddev: standard deviation of these changes.
            deadline: the time of a decision (s); one part of an iteration is taken at least. Where it is shorter than an
                iteration more is compiled, to foretell from plans of two lengths what fits.
            lower: lower limits of the controls.
            upper: upper limits of the controls.

        Warns:
            UserWarning: if the deadline is shorter than an iteration; and as `optimise_trajectory`, for the reference pose.

        Raises:
            ValueError: if a number is out of its range, and as `optimise_trajectory`.
        """
        if deadline is not None and not real("deadline", deadline) > 0:
            raise ValueError(f"deadline must be positive, in seconds, or None, got {deadline}")
        usual = _SAMPLES if isinstance(smoother, Analytic) else 0
        self.num_samples = whole("num_samples", usual if num_samples is None else num_samples, 0)
        both = [schedule, *([] if first_schedule is None else [first_schedule])]
        given = system, cost, None, controls, jax.random.key(0), smoother, both, lower, upper
        problem, _, start, factors = posed(*given)
        usual, *others = [np.asarray(one) for one in factors]
        first = others[0] if others else np.concatenate([np.repeat(usual[:1], _FIRST - 1), usual])
        self._schedules, self._origin = (first, usual), np.asarray(system.origin)
        self.stddev = deviations(stddev, problem)
        self.system, self._cost, self.deadline = system, cost, deadline
        self._iteration = self._prepared(problem, start)
        self.compile_seconds = self._iteration.compile_seconds
        self.price = {name: len(self._schedules[1]) * x for name, x in self._iteration.seconds.items()}
        self.reset()
        if deadline is not None and sum(self._iteration.seconds.values()) > deadline:
            warnings.warn(self._too_short(self._one_step(problem, start, deadline), deadline), stacklevel=2)

    @property
    def cost(self) -> Cost:
        return self._cost

    @cost.setter
    def cost(self, cost: Cost) -> None:
        if not _is_alike(self._cost, cost):
            raise ValueError(
                "cost must have the form of the compiled one, and differ in the values of its floats alone: "
                "make a new Controller for a cost of another form"
            )
        self._cost = cost

    def _prepared(self, problem: Problem, controls: Array) -> Iteration:
        """Compile an iteration. With a deadline its linear models are taken of few steps at a time, as far as that pays."""
        horizon, deadline = len(controls), self.deadline
        given = problem, self.cost, controls, self._typical(), np.zeros_like(self._noise(0, horizon))
        found = Iteration(*given, count=horizon)
        if deadline is None:
            return found
        for _ in range(2):  # the time per step is less for many at a time
            part, each = found.longest
            if part != PARTS[0] or each <= _SHARE * deadline or found.count == 1:
                break
            # Two cores that are idle take two steps at once. Where a deadline depends on it, they may be busy soon.
            is_urgent, wanted = each > deadline / 3, round(found.count * _SHARE * deadline / each)
            other = found.by(min(max(1 if is_urgent else 2, wanted), found.count - 1))
            if other.shortest > found.shortest * (_SHORTER if is_urgent else 0.5 + 0.5 * other.count / found.count):
                found.compile_seconds = other.compile_seconds  # in vain, as on a GPU
                break
            found = other
        return found

    def _typical(self) -> Float[np.ndarray, " state"]:
        """Return a state in which iterations are measured: the reference pose of many robots is deep in the floor."""
        if not isinstance(self.system, SceneSystem) or not self.system.scene.mj_model.nkey:
            return self._origin
        key = self.system.scene.mj_model.key(0)
        return np.concatenate([key.qpos, key.qvel, key.act]).astype(self._origin.dtype)

    def reset(self) -> None:
        """Forget the plan and the counts; the next decision is a first one."""
        self._search, self._turn, self.num_missed, self.num_cut = self._iteration.blank, self._iteration.first, 0, 0
        self._taken: dict[str, list[float]] = {part: [] for part in PARTS}
        self.seconds: list[float] = []
        self.costs: list[float] = []

    @property
    def plan(self) -> Course:
        """The present plan; its cost is infinite if its states are not finite, or where it was not computed in time."""
        return self._search.best

    def __call__(self, state: State | mujoco.MjData | Float[ArrayLike, " state"]) -> Float[np.ndarray, " m"]:
        """Return the controls of the present step.

        Args:
            state: the present state: a vector of the system, or for a scene its `State` or C MuJoCo's data.

        Warns:
            UserWarning: in the first decision, if no control moves something that has a cost, and the cost hardly falls; and if
                the cost of the given controls is no finite number.

        Raises:
            ValueError: if the state has another size than the system's, or is not finite.
        """
        began, is_first = time.perf_counter(), not self.seconds
        start = self._vector(state)
        limit = np.inf if self.deadline is None or is_first else began + self.deadline
        self._begin(start, is_first)
        given = float(self.plan.cost)
        self._iterate(self._schedules[0 if is_first else 1], limit)
        self.seconds.append(time.perf_counter() - began)
        self.num_missed += began + self.seconds[-1] > limit
        self.costs.append(float(self.plan.cost))
        if is_first and not np.isfinite(given):
            is_cost = np.isfinite(self.plan.states).all()
            warnings.warn(
                NO_COST if is_cost else "the motion under the given controls leaves finite numbers", stacklevel=2
            )
        if is_first and np.asarray(self._search.unmoved).any() and not float(self.plan.cost) < _LITTLE * given:
            near = f"where the cost has {_DISTANCE}, nothing needs to be done; else add it"
            warnings.warn(self._untouched(near), stacklevel=2)
        return np.array(self.plan.controls)[0]

    def _iterate(self, factors: np.ndarray, limit: float) -> None:
        """Take iterations from where the last decision stopped, one part at least, up to a limit of the clock."""
        is_late = lambda: time.perf_counter() + self._expected(self._turn[0]) > limit  # noqa: E731
        has_begun = self._sample(factors[0], limit)
        for both in itertools.pairwise([*factors, factors[-1]]):
            while True:
                if has_begun and is_late():
                    self.num_cut += 1
                    return
                has_begun, turn = True, self._turn
                self._advance(turn, both)
                self._turn = self._iteration.after(turn)
                if self._turn == self._iteration.first:
                    break

    def _sample(self, factor: Any, limit: float) -> bool:
        """Try random changes also where an iteration is under way, whose law is not known yet; return whether that was done."""
        if not self.num_samples or self._turn in (self._iteration.first, LAST):
            return False
        has_time = sum(map(self._expected, (PARTS[-1], self._turn[0]))) <= limit - time.perf_counter()
        if not has_time and len(self.seconds) % 2:  # every other time, so that the iteration comes to an end
            return False
        before = self._search
        self._advance(LAST, (factor, factor))
        # That the old law does not help says nothing of the next one.
        self._search = dataclasses.replace(self._search, regularisation=before.regularisation)
        return True

    def _begin(self, start: np.ndarray, is_first: bool) -> None:
        """Shift all by a step, to the present state; the first time compute the course of the given controls."""

        # By NumPy: JAX would compile programs, and takes a tenth of a millisecond for a slice. The new course of the shifted plan
        # is not computed: the feedback law around the old one takes the difference.
        def later(x: Array) -> np.ndarray:
            known = np.asarray(x)
            return np.concatenate([known[1:], known[-1:]]) if known.ndim else known

        if is_first:
            self._search = self._iteration.begun(start)
            self._advance(LAST, tuple(self._schedules[0][[0, 0]]), is_first=True)
            return
        parts = {name: jax.tree.map(later, getattr(self._search, name)) for name in ("best", "models", "law")}
        search = dataclasses.replace(self._search, **jax.device_put(parts))
        states = np.array(search.best.states)
        states[0] = start
        unknown = jax.device_put(np.full_like(search.best.cost, np.inf))
        course = Course(jax.device_put(states), search.best.controls, unknown)
        # What no step of an old model improved says little of the next one, and a model that may not move promises nothing.
        held = np.minimum(np.asarray(search.regularisation), FREE).astype(states.dtype)
        self._search = dataclasses.replace(search, course=course, best=course, regularisation=jax.device_put(held))
        self._turn = self._iteration.moved_on(self._turn)

    def _advance(self, turn: Turn, factors: tuple[Any, Any], *, is_first: bool = False) -> None:
        """Run a part of an iteration, and note its time."""
        began, part = time.perf_counter(), turn[0]
        noise = self._noise(len(self.seconds), self._iteration.horizon) if part == PARTS[-1] else None
        self._search = self._iteration.run(turn, self.cost, self._search, factors, noise, is_first)
        self._taken[part].append(time.perf_counter() - began)

    def _expected(self, part: str) -> float:
        recent = sorted(self._taken[part][-_RECENT:])
        return recent[int(_QUANTILE * len(recent))] if recent else 0.0

    def _noise(self, seed: int, horizon: int) -> Float[np.ndarray, "N horizon m"]:
        key = jax.random.key(seed)
        return np.asarray(random_changes(key, self.stddev, self.num_samples, horizon))

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

    def _one_step(self, problem: Problem, controls: Array, deadline: float) -> float:
        """Return the time of an iteration of a plan of one step, or of its linear model where this exceeds the deadline."""
        # A part of the time is the same for all plans, so that a shorter plan takes more than its share.
        took = sum(self._iteration.seconds.values())
        if len(controls) == 1:
            return took
        models = self._iteration.seconds[PARTS[0]] / self._iteration.num_pieces
        if self._iteration.count == 1 and models > deadline:
            return models  # too long already, without the seconds that it takes to compile the rest
        problem, still = dataclasses.replace(problem, keys=problem.keys[:1]), np.zeros_like(self._noise(0, 1))
        short = Iteration(problem, self.cost, controls[:1], self._typical(), still, count=1)
        self.compile_seconds += short.compile_seconds
        return min(sum(short.seconds.values()), took)

    def _too_short(self, one: float, deadline: float) -> str:
        """Return what fits a deadline that is shorter than an iteration, by the time of one of a single step, too."""
        took, (part, each) = sum(self._iteration.seconds.values()), self._iteration.longest
        horizon, several = self._iteration.horizon, "s" * (self._iteration.count > 1)
        models = f"the linear model{several} of {self._iteration.count} step{several}"
        told, remedy = (
            f"an iteration takes about {_ms(took)}",
            f"for one in each take a deadline of {_ms(_SLACK * took)}",
        )
        if _SLACK * each > deadline:
            what = models if part == PARTS[0] else f"its {part}"
            told += f", {what} alone {_ms(each)}, and decisions may miss the deadline of {_ms(deadline)}"
            remedy = f"take one of {_ms(_SLACK * each)}, or for an iteration in each decision {_ms(_SLACK * took)}"
        else:
            num_decisions = math.ceil(_SLACK * took / deadline)
            told += f", and is spread over some {num_decisions} decisions to keep the deadline of {_ms(deadline)}"
        most = min(1 + (horizon - 1) * (deadline / _SLACK - one) / max(took - one, 1e-9), horizon - 1)
        if most < 1:
            return f"{told}: {remedy}; no plan is short enough, one of 1 step takes {_ms(one)}"
        return f"{told}: {remedy}, or a plan of {int(most)} step{'s' * (most >= 2)}"

    def _untouched(self, first: str) -> str:
        still = listed(self.system.names, self._search.unmoved)
        told = (
            f"no control moves {still}, which has a cost: derivatives of that cost are zero until something touches it"
        )
        return f"{told}; {first}, smooth by Analytic, or take num_samples={2 * self.num_samples or _SAMPLES}"

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"

    def __str__(self) -> str:
        if not self.seconds:
            price = sum(self.price.values())
            told = f"A decision takes about {_ms(price)} ({format_number(1 / price)} Hz): {_listed(self.price)}"
            return f"{told}; compiled in {self.compile_seconds:.1f} s"
        typical = float(np.median(self.seconds))
        missed = f", {self.num_missed} missed {_ms(self.deadline)}, {self.num_cut} cut short" if self.deadline else ""
        told = f"{len(self.seconds)} decisions, {_ms(typical)} in the median ({format_number(1 / typical)} Hz){missed}"
        parts = {part: float(np.median(taken)) for part, taken in self._taken.items()}
        parts[PARTS[0]] *= self._iteration.num_pieces
        told += f". An iteration took {_ms(sum(parts.values()))}: {_listed(parts)}; compiled in {self.compile_seconds:.1f} s"
        if len(costs := [cost for cost in self.costs if np.isfinite(cost)]) > 1:
            middle, last = format_number(float(np.median(costs))), format_number(costs[-1])
            told += f". Plans cost {middle} in the median, the last {last}"
        if not np.array_equal(self.plan.controls, self._iteration.blank.best.controls):
            return told
        is_known = not self.costs or np.isfinite(self.costs).any()
        idle = "no small change lowers the cost: begin with others" if is_known else NO_COST
        if self._search.unmoved.any():
            idle = self._untouched(f"add {_DISTANCE} to the cost")
        return f"{told}. Controls are as given, since {idle}"


def _listed(parts: dict[str, float]) -> str:
    return ", ".join(f"{part} {1e3 * x:.0f}" for part, x in parts.items())


def _ms(seconds: float) -> str:
    return f"{format_number(1e3 * seconds)} ms"


def _is_alike(cost: Cost, other: Cost) -> bool:
    """Return whether two costs differ in the values of their floats alone: programs that are compiled for one suit the other."""
    both = [eqx.partition(one, eqx.is_inexact_array_like) for one in (cost, other)]
    form, other_form = ([jax.tree.structure(parts), _shapes(parts[0])] for parts in both)
    if form != other_form:
        return False
    rest, other_rest = (jax.tree.leaves(parts[1]) for parts in both)
    return all(one is two or _is_equal(one, two) for one, two in zip(rest, other_rest, strict=True))


def _shapes(numbers: Any) -> list[str]:
    return [jax.typeof(leaf).str_short() for leaf in jax.tree.leaves(numbers)]


def _is_equal(one: Any, other: Any) -> bool:
    """Return whether two leaves of costs have equal content, such as a function that is defined anew in each step."""
    (arrays, form), (other_arrays, other_form) = (parted(x, trusts_hash=True) for x in (one, other))
    return form is other_form and all(map(np.array_equal, arrays, other_arrays))
