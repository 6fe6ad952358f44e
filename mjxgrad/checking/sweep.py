"""Bias and variance of gradients over contact stiffness, for a scene, cost and start given by names."""

import dataclasses
import functools
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, instance, is_known, real, whole
from mjxgrad._text import Paged, aligned, duration, format_number, paced
from mjxgrad.batched import device
from mjxgrad.checking.check import Source, in_double, outcomes_of
from mjxgrad.checking.costs import Cost, named_cost
from mjxgrad.checking.findings import chosen, exact_text, percent
from mjxgrad.checking.motions import CONTACT_FIELDS, compiler_options, half_range, seconds_of, touching_exactly
from mjxgrad.contact import Softness
from mjxgrad.contact.warnings import largest_stable_step
from mjxgrad.diagnostics import BiasVariance, bias_variance
from mjxgrad.diagnostics.bias_variance import BATCH, ESTIMATES
from mjxgrad.engines import ENGINES, QUICK, engine_of
from mjxgrad.engines.engine import Engine
from mjxgrad.estimators import first_order
from mjxgrad.objective import Objective, parameter_noise
from mjxgrad.objective.actions import OpenLoop
from mjxgrad.objective.task import SceneTask
from mjxgrad.report import Block, Table, page, svg
from mjxgrad.rollouts import initial_state
from mjxgrad.scene import Scene, SceneWarning, load_scene
from mjxgrad.stepping import Contact, Discrete, EngineName, Slope

STIFFNESS = (1e2, 1e3, 1e4, 1e5, 1e6)
_SECONDS, _MOST_STEPS, _FEWEST_STEPS = 0.5, 300, 50
_SHORT = 0.33  # time step times the frequency of a contact, from which it lasts at most three steps
_ERRORS = f"Error of a gradient of {BATCH} rollouts, by bias and scatter, over the gradient itself."
_UNFELT = 1e-9  # of the cost, gradients that are rounding
_PAIRS = 256  # pairs of rollouts at once
_FEW = 8  # numbers of a direction that are printed
_NEARER = 0.5  # of the slope's error, below which the derivative of each step is taken
# Rollouts of each estimate that nobody chose, with derivatives; by C MuJoCo as many as take so long (s). And those of the truth.
_FEWEST, _MOST, _LONGEST, _REFERENCE = 64, 256, 120.0, 16
_NEAR = 0.5  # of the gradient, an error with which descents get somewhere
_HOPELESS = 10.0  # of the gradient, an error that is no estimate
_NAMES = {**ESTIMATES, "none": "none"}


def scene_task(
    scene: Scene,
    cost: str | Cost | None = None,
    *,
    start: str | int | None = None,
    horizon: int | None = None,
    contact: Contact = Slope(),
    seed: int = 0,
) -> SceneTask:
    """Return a task of a scene, with cost and start given by names; arguments and errors are those of `sweep`."""
    model = scene.mj_model
    state = initial_state(scene) if start is None else initial_state(scene, keyframe=start)
    if start is not None:
        scene = eqx.tree_at(lambda s: s.data.ctrl, scene, jnp.asarray(model.key(start).ctrl, state.qpos.dtype))
    if cost is None:
        outcomes = outcomes_of(scene, None, np.random.default_rng(seed))[1]
        cost = lambda trajectory: outcomes(trajectory)[0]  # noqa: E731
    cost = named_cost(scene, cost) if isinstance(cost, str) else cost
    usual = int(np.clip(round(_SECONDS / model.opt.timestep), _FEWEST_STEPS, _MOST_STEPS))
    horizon = usual if horizon is None else horizon
    return SceneTask(scene, state, cost, horizon, contact=contact)  # pyright: ignore[reportCallIssue]


class CommonShift(OpenLoop):
    """The cost under noise on every control, by a common shift of all along one direction: a single number, with an interval."""

    direction: Float[Array, " nu"]

    def unravel(self, params: Float[Array, " dim"]) -> Float[Array, "horizon nu"]:
        return jnp.broadcast_to(self.task.scene.data.ctrl + params[0] * self.direction, self.noise_shape)

    def pull_back_at(self, params: Float[Array, " dim"], states: PyTree) -> Partial:
        return Partial(jnp.matmul, jnp.tile(self.direction, self.task.horizon)[None])


@eqx.filter_jit
def _in_pairs(objective: Any, direction: Float[Array, " nu"], keys: Key[Array, " pairs"]) -> Float[Array, " pairs"]:
    """Return the difference quotient of each pair, by the deviations of the noise along the shift."""
    along = jnp.broadcast_to(direction / jnp.sqrt(objective.noise_shape[0]), objective.noise_shape)  # a unit vector

    def quotient(key: PRNGKeyArray) -> Float[Array, ""]:
        noise_key, width_key = jax.random.split(key)
        noise = objective.sample_noise(noise_key) / objective.stddev
        rest, width = noise - (noise * along).sum() * along, jnp.linalg.norm(jax.random.normal(width_key, (3,)))
        above, below = (objective.stddev * (rest + side * width * along) for side in (1, -1))
        return (objective.value(jnp.zeros(1), above) - objective.value(jnp.zeros(1), below)) / (2 * width)

    return jax.lax.map(quotient, keys, batch_size=_PAIRS)


def _by_mujoco(task: SceneTask) -> SceneTask:
    """Return a task whose own motion, where that is MuJoCo's, is C MuJoCo's, which compiles nothing."""
    is_own = isinstance(task.contact, Slope | Discrete)
    return task.with_contact(Discrete()).with_engine(QUICK) if is_own else task


def _thrown(task: SceneTask, along: Float[Array, " nv"], speed: Float[Array, " 1"]) -> Float[Array, ""]:
    start = eqx.tree_at(lambda state: state.qvel, task.state, task.state.qvel + speed[0] * along)
    return task.run(jnp.zeros((task.horizon, 0)), start=start).cost


@dataclass(frozen=True)
class Knob:
    """A task's cost under noise, as a function of its contact stiffness and of one number.

    The number shifts all controls along one direction, and every control has noise at each step; both are in halves of the
    control ranges. Without actuators both act on the initial velocities, in m/s or rad/s. Of several, the direction is random.
    """

    task: SceneTask
    noise: float
    seed: int = 0

    @functools.cached_property
    def own(self) -> float:
        """The median stiffness of the file's contacts (1/s²); exactly this value leaves them unchanged."""
        scene = self.task.scene
        return float(np.median(np.asarray(scene.contact_parameters().stiffness))) if scene.pairs else 0.0

    @functools.cached_property
    def direction(self) -> Float[np.ndarray, " moved"]:
        """The unit vector along which all controls, or velocities, are shifted."""
        count = self.task.num_controls or self.task.scene.mj_model.nv
        drawn = np.random.default_rng(self.seed).normal(size=count)
        return drawn / np.linalg.norm(drawn) if count > 1 else np.ones(1)

    def __call__(self, softness: Softness) -> Objective:
        """Return the objective at a stiffness, at critical damping."""
        task, scene, is_own = self.task, self.task.scene, softness.stiffness == self.own
        if is_known(is_own) and is_own:
            for text in scene.warnings():
                warnings.warn(f"{scene.name}: {text}", SceneWarning, stacklevel=2)
        elif scene.pairs:
            model, soft = scene.model, scene.with_softness(Softness(softness.stiffness, 1.0)).model
            fields = {k: jnp.where(is_own, getattr(model, k), getattr(soft, k)) for k in CONTACT_FIELDS}
            task = eqx.tree_at(lambda one: one.scene.model, task, model.replace(**fields))
        like = task.state.qpos.dtype
        along = jnp.asarray(self.direction, like)
        if not task.num_controls:
            return parameter_noise(Partial(_thrown, task, along), self.noise, dim=1)
        half = jnp.asarray(half_range(scene), like)
        return CommonShift(task, self.noise * half, dim=1, direction=half * along)  # pyright: ignore[reportCallIssue]

    @functools.cached_property
    def _traced(self) -> Callable[[Softness], Objective]:
        """The same by C MuJoCo where the motion is MuJoCo's; traced, so that warnings are not repeated."""
        knob = dataclasses.replace(self, task=_by_mujoco(self.task))
        _ = knob.own, knob.direction  # kept, since a trace does not know them
        return eqx.filter_jit(lambda softness: knob(softness))

    def error(
        self, contact: Contact, softness: Softness, key: PRNGKeyArray, truth: tuple[np.ndarray, np.ndarray]
    ) -> float:
        """Return the error to expect of a first-order gradient of 16 rollouts by C MuJoCo, beside a truth and its error."""
        objective = self._traced(softness)
        objective = dataclasses.replace(objective, task=objective.task.with_contact(contact))
        found = first_order(objective, jnp.zeros(1), key, num_samples=BATCH)
        variance, (value, error) = float(found.covariance_diagonal[0]), (float(x.item()) for x in truth)
        bias = max((float(found.value[0]) - value) ** 2 - variance / BATCH - error**2, 0.0)
        return float(np.nan_to_num(np.sqrt(bias + variance / BATCH), nan=np.inf))

    def truth(
        self, softness: Softness, key: PRNGKeyArray, num_rollouts: int
    ) -> tuple[Float[np.ndarray, "1 1"], Float[np.ndarray, "1 1"]]:
        r"""Return the gradient by differences of pairs of rollouts, and its standard error.

        The noise's part along the shift, of standard deviation σ, smooths the cost f; all else is the same in a pair. With the
        density of the half width r being Maxwell's, $r^2 \varphi(r/\sigma)/\sigma^3$, the mean of (f(r) − f(−r)) / 2r is the
        slope of the smoothed cost, for any f (Stein's identity). Where f is linear it does not scatter at all.
        """
        objective = self._traced(softness)
        keys = jax.random.split(key, num_rollouts // 2)
        # The shift moves the noise's part along it by the root of so many steps, over its deviation.
        scale = np.sqrt(self.task.horizon) / self.noise
        slopes = scale * np.asarray(_in_pairs(objective, jnp.asarray(self.direction), keys), float)  # pyright: ignore[reportCallIssue]
        slopes = slopes[np.isfinite(slopes)]
        error = slopes.std(ddof=1) / np.sqrt(len(slopes)) if len(slopes) > 1 else np.nan
        return np.reshape(slopes.mean() if len(slopes) else np.nan, (1, 1)), np.reshape(error, (1, 1))

    def __str__(self) -> str:
        kind, model = "actuator" if self.task.num_controls else "joint", self.task.scene.mj_model
        count, first = (model.nu, model.actuator) if kind == "actuator" else (model.njnt, model.joint)
        numbers = ", ".join(f"{x:.3g}" for x in self.direction)
        mix = f"({numbers})" if len(self.direction) <= _FEW else "of a random direction"
        which = first(0).name or f"the {kind}" if count == 1 else f"all {count} {kind}s in a mix {mix}"
        if kind == "joint":
            return f"the velocity of {which} at the start, with noise of {self.noise:g} on it (m/s, rad/s)"
        return f"a constant added to the control of {which}, with noise of {self.noise:g} in each step; 1 is half its range"


def nearer(
    knob: Knob, softness: Softness, key: PRNGKeyArray, truth: tuple[np.ndarray, np.ndarray], say: Callable[[str], None]
) -> tuple[Knob, str]:
    """Return the knob with the derivative that errs less, and why, where that is not the slope."""

    def error(contact: Slope | Discrete) -> float:
        say(f"a gradient of {BATCH} rollouts by {chosen(contact.gradient)}, to see which derivative errs less")
        return knob.error(contact, softness, key, truth)

    slope, discrete = error(Slope()), error(Discrete())
    if discrete >= _NEARER * slope:
        return knob, ""
    other = dataclasses.replace(knob, task=knob.task.with_contact(Discrete()))
    return other, f"; slopes of the outcome err {slope / discrete:.2g} times as much"


@dataclass(frozen=True)
class Sweep(Paged):
    """The result of `sweep`: the scene, a description, the stiffness of the file's contacts, and the measurements."""

    name: str
    question: str
    own: float
    result: BiasVariance

    @property
    def labels(self) -> list[str]:
        """The labels of the rows."""
        return [format_number(k) + " (file)" * bool(k == self.own) for k in self.result.knob[1]]

    def errors(self) -> dict[str, Float[np.ndarray, " softness"]]:
        """Return the error to expect of a gradient of 16 rollouts, over the gradient's size, by estimate.

        Its square is that of the bias, less what the bias's own error adds, and a sixteenth of the variance of one rollout.
        """
        table, found = self.result.table(), {}
        for name in ESTIMATES:
            if f"{name}_bias" in table:
                bias, half = table[f"{name}_bias"][:, 0], table[f"{name}_bias_high"] - table[f"{name}_bias_low"]
                square = np.maximum(bias**2 - (half[:, 0] / 4) ** 2, 0) + table[f"{name}_variance"][:, 0] / BATCH
                with np.errstate(divide="ignore", invalid="ignore"):  # no gradient at all
                    found[name] = np.sqrt(square) / np.abs(table["truth"][:, 0])
        return found

    def _untold(self) -> Bool[np.ndarray, " softness"]:
        """Return where the gradient is not told from zero, so that no error is a share of it."""
        low, high = (self.result.table()[f"truth_{end}"][:, 0] for end in ("low", "high"))
        return (low <= 0) & (high >= 0)

    def best(self) -> list[str]:
        """Return what to take at each stiffness: what errs least, α-order only where it gains more than a tenth, or "none".

        None is taken where all are far off, or nothing is told from zero.
        """
        errors = self.errors()
        factors = {"alpha_order": 1.1}
        ranks = np.array([np.nan_to_num(factors.get(name, 1.0) * x, nan=np.inf) for name, x in errors.items()])
        is_told = (ranks.min(axis=0) < _HOPELESS) & ~self._untold()
        return [list(errors)[k] if told else "none" for k, told in zip(ranks.argmin(axis=0), is_told, strict=True)]

    @property
    def headline(self) -> str:
        """The answer: what to take at the file's own contact, how sure, what it costs, and from which stiffness not."""
        table = self.result.table()
        measured = [abs(table["truth"]), *(table[f"{name}_bias"] for name in ESTIMATES if f"{name}_bias" in table)]
        if len(table["truth"]) > 1 and not any(np.ptp(one, axis=0).any() for one in measured):
            return "Stiffness changes nothing: nothing touches in these motions; start nearer, or look further ahead."
        if np.abs(table["truth"]).max() <= _UNFELT * np.abs(self.result.cost).max():
            return "The noise does not reach the cost: what moves does not touch what counts; start nearer, or look further."
        row, best, errors = int(np.argmin(abs(self.result.knob[1] - self.own))), self.best(), self.errors()
        if self._untold()[row]:
            truth, high = table["truth"][row, 0], table["truth_high"][row, 0]
            told = f"The gradient is not told from zero: {truth:.2g} ± {high - truth:.2g}, so that no estimate can be judged"
            return f"{told}: start nearer, look further ahead, or take more rollouts."
        if (taken := best[row]) == "none":
            far = f"From {BATCH} rollouts no estimate is within {percent(_HOPELESS)} of the gradient"
            return f"{far}: take softer contact, a shorter time step or a shorter horizon."
        off = errors[taken][row]
        ratio = (table[f"{taken}_variance"] / table["zeroth_variance"])[row, 0]
        reach = np.abs([table[f"{taken}_bias{end}"][row, 0] for end in ("_low", "_high")]).max()
        reach /= abs(table["truth"][row, 0])
        sure = "it has no bias"
        if taken != "zeroth":
            bias = percent(abs(table[f"{taken}_bias"] / table["truth"])[row, 0])
            is_biased = table[f"{taken}_is_biased"][row, 0]
            seen = f"its bias is {bias}" if is_biased else f"no bias was seen above {percent(reach)}"
            seen = seen if is_biased or reach <= 1 else "these rollouts are too few to see its bias"
            sure = f"its variance is {ratio:.2g} of zeroth order's and {seen}"
        others = ", ".join(f"{ESTIMATES[name]} {percent(x[row])}" for name, x in errors.items() if name != taken)
        answer = f"Take {ESTIMATES[taken]}: {sure}; {BATCH * self.result.seconds:.2g} s a gradient of {BATCH} rollouts."
        answer += f" It is {percent(off)} off, {others}{self._needed(taken, row)}."
        later = []
        for label, other, is_off in list(zip(self.labels, best, self.result.too_stiff, strict=True))[row + 1 :]:
            if not is_off and other != taken:
                later.append(f"from {label} 1/s² on {_NAMES[other]}")
                taken = other
        return f"{answer} F{', '.join(later)[1:]}." if later else answer

    def _needed(self, name: str, row: int) -> str:
        """Say from how many rollouts an estimate is half off, where from a batch it is off by more than the gradient."""
        table, truth = self.result.table(), abs(self.result.table()["truth"][row, 0])
        if (off := self.errors()[name][row]) <= 1:
            return ""
        variance = table[f"{name}_variance"][row, 0]
        left = (_NEAR * truth) ** 2 - max((off * truth) ** 2 - variance / BATCH, 0.0)  # for scatter, beside the bias
        if left <= 0:
            return "; more rollouts do not mend its bias"
        return f"; it is {percent(_NEAR)} off from about {format_number(float(f'{variance / left:.1g}'))} rollouts"

    def __str__(self) -> str:
        errors = "\n".join([_ERRORS, *aligned(self._rows(), str.ljust)])
        return "\n\n".join([f"{self.name}: {self.headline}", errors, self.question, self.result.summary(self.labels)])

    def _rows(self) -> list[list[str]]:
        """Return the table of errors as text, header first; the estimate to take is marked."""
        errors, best = self.errors(), self.best()
        head = ["stiffness, 1/s²", *(ESTIMATES[name] for name in errors), "take"]
        table, untold = self.result.table(), self._untold()
        # At least that of the largest gradient that it may be.
        share = abs(table["truth"][:, 0]) / np.maximum(abs(table["truth_low"]), abs(table["truth_high"]))[:, 0]
        least = np.where(untold, share, 1.0)
        heads = ["over " if one else "" for one in untold]
        cells = [
            [head + percent(x).removeprefix(head) for head, x in zip(heads, least * errors[name], strict=True)]
            for name in errors
        ]
        return [head, *map(list, zip(self.labels, *cells, [_NAMES[name] for name in best], strict=True))]

    def as_html(self) -> str:
        """Return the sweep as a self-contained page; needs `mjxgrad[render]`."""
        parts = [svg(functools.partial(self.result.plot, one), f"{one} over stiffness") for one in ("bias", "variance")]
        told = f"Bars: {self.result.confidence:.0%} intervals. Bias in cost per unit of what is moved, variance in its square."
        head, *rows = [row[:-1] for row in self._rows()]
        columns = list(self.errors())
        mark = frozenset((i, 1 + columns.index(name)) for i, name in enumerate(self.best()) if name in columns)
        table = Block(table=Table(head, rows, f"{_ERRORS} Bold is what to take.", mark))
        details = Block(folded="Bias and variance in numbers", code=self.result.summary(self.labels))
        blocks = [table, Block(drawings=parts, caption=told), Block(text=self.question), details]
        answer, _, more = self.headline.partition(". ")
        return page(f"{answer.rstrip('.')}.", f"mjxgrad sweep {self.name}", [Block(text=more), *blocks])


@in_double
def sweep(
    source: Source,
    cost: str | Cost | None = None,
    *,
    stiffness: Sequence[float] | None = None,
    noise: float = 0.1,
    num_samples: int | None = None,
    num_reference: int | None = None,
    seed: int = 0,
    log: Callable[[str], None] | None = None,
    progress: bool = True,
    engine: EngineName | None = None,
    start: str | int | None = None,
    horizon: int | None = None,
    contact: Contact | None = None,
) -> Sweep:
    """Measure bias and variance of first, zeroth and α-order gradients over contact stiffness, in a scene of one's own.

    Args:
        source: an MJCF file, or another source for `load_scene`.
        cost: function of a trajectory; or file.py:function, module:function; or a cost of bodies and sites at the end,
            height:torso (minus its height, m), speed:torso (minus its mean speed along x, m/s), upright:torso (1 − cosine of
            its tilt), reach:hand/ball (their distance, m). None is a random mix of the heaviest body's final coordinates.
        stiffness: stiffnesses to sweep (1/s²), besides the file's own; by default 1e2 to 1e6, as far as the time step integrates
            them.
        noise: standard deviation on each control of each step, in halves of its range; without controls, on velocities.
        num_samples: rollouts per estimate; by default 256, fewer by C MuJoCo where these take more than two minutes, at least 64.
        num_reference: rollouts for the truth, without derivatives; by default sixteen times as many.
        seed: seed of all random numbers.
        progress: whether a sweep of more than two seconds tells on stderr where it is, without a log.
        log: called with the name of each part as it starts. Ctrl-C ends with the stiffnesses measured so far.
        engine: who steps, see `Scene.with_engine`; by default a scene's own, and of a file on a CPU C MuJoCo, which compiles
            nothing.
        start: a key frame with its controls, by default the first, else the reference pose, at rest.
        horizon: number of time steps, by default half a second, but 50 to 300.
        contact: how contact is stepped, see `rollout`; by default `mg.Slope()`, or `mg.Discrete()` where this errs less than half
            as much at the file's own contact, for slopes scatter there.

    Raises:
        ValueError: if there is no such file, function, body or key frame, a number is out of range, or nothing that the controls
            move reaches the cost.
    """
    given = np.atleast_1d(np.asarray(real("stiffness", STIFFNESS if stiffness is None else stiffness), float))
    if not ((given > 0) & (given < np.inf)).all():
        raise ValueError(f"stiffness must be positive and finite, got {', '.join(map(str, given))}")
    if not 0 < real("noise", noise) < np.inf:
        raise ValueError(f"noise must be positive and finite, got {noise}")
    whole("seed", seed, 0)
    if num_samples is not None:
        whole("num_samples", num_samples, 2)
    function("log", log, "text")
    instance("progress", progress, bool, "True or False")
    say = log or (paced("sweep") if progress else lambda _: None)
    is_own = isinstance(contact, Slope | Discrete | None)
    quick = QUICK if is_own and device.is_cpu() else None
    scene = source if isinstance(source, Scene) else load_scene(source, engine=engine or quick)
    scene = scene if engine is None else scene.with_engine(engine)
    if start is None and scene.mj_model.nkey:
        start = scene.mj_model.key(0).name or 0
    task = scene_task(
        scene, cost, start=start, horizon=horizon, contact=Slope() if contact is None else contact, seed=seed
    )
    given, notes = _integrable(scene, given) if stiffness is None and scene.pairs else (given, [])
    own = jnp.broadcast_to(task.scene.data.ctrl, (task.horizon, task.num_controls))
    if not np.isfinite(at_rest := _by_mujoco(task).run(own).cost):
        raise ValueError(f"cost must be finite, got {at_rest} of the motion without noise")
    say("moving from the start under noise")
    knob = Knob(task, noise, seed)
    swept = sorted({*given.tolist(), knob.own}) if scene.pairs else [1.0]
    why = ""
    if task.num_controls and is_own:
        softness = Softness(stiffness=jnp.asarray(knob.own or swept[0]))
        few = _first_look(knob, softness, float(at_rest), say)
        if contact is None and scene.pairs:
            knob, why = nearer(knob, softness, jax.random.key(seed + 1), few, say)
    task, prices = knob.task, _Prices.of(knob.task)
    num_samples = num_samples or prices.affordable(len(swept))
    num_reference = _REFERENCE * num_samples if num_reference is None else num_reference
    say(prices.foretold(len(swept), num_samples, num_reference, task.horizon))
    if why:
        say(f"derivatives are those of each step{why}")
    result = bias_variance(
        knob,
        jnp.zeros((1, 1)),
        jax.random.key(seed),
        softness=Softness(stiffness=swept),
        num_samples=num_samples,
        num_reference=num_reference,
        reference=knob.truth if task.num_controls else None,
        compiler_options=compiler_options(),
        progress=_advances(say),
    )
    called = "where the heaviest body ends up (a random mix)" if cost is None else getattr(cost, "__name__", cost)
    if not np.isfinite(result.table()["truth"]).any():
        raise ValueError(f"cost must be finite, got NaN or infinity in the rollouts of {called} at every stiffness")
    told = f"Gradient of {called} after {task.horizon} steps, by {knob}."
    return Sweep(scene.name, " ".join([told, *_measured(task, swept, notes, why, result)]), knob.own, result)


def _integrable(scene: Scene, given: Float[np.ndarray, " softness"]) -> tuple[Float[np.ndarray, " kept"], list[str]]:
    """Return the stiffnesses that a scene's time step integrates, and a sentence on the others, if there are any."""
    integrator = mujoco.mjtIntegrator(scene.mj_model.opt.integrator)
    limit = (largest_stable_step(1.0, integrator) / float(scene.model.opt.timestep)) ** 2
    if not (too_stiff := given[given >= limit]).size:
        return given, []
    listed, told = " and ".join(map(format_number, too_stiff.tolist())), format_number(limit)
    return given[given < limit], [f"Left out: {listed} 1/s², for the time step integrates none from {told} on."]


def _first_look(
    knob: Knob, softness: Softness, at_rest: float, say: Callable[[str], None]
) -> tuple[Float[np.ndarray, "1 1"], Float[np.ndarray, "1 1"]]:
    """Return the gradient and its error by few motions, and say so where that does not tell it from zero.

    Raises:
        ValueError: if the cost does not feel the controls.
    """
    few, error = knob.truth(softness, jax.random.key(knob.seed), _PAIRS)
    if np.abs([few, error]).max() <= _UNFELT * abs(at_rest):
        wanted = "start nearer, at another key frame, or look further ahead, over a longer horizon"
        stays = f"stays {at_rest:.3g} in {_PAIRS} motions under the noise"
        raise ValueError(f"cost must feel the controls, but {stays}: {wanted}")
    value, half = few.item(), 2 * error.item()
    if abs(value) < half:
        untold = f"the gradient is {value:.2g} ± {half:.2g} by {_PAIRS} motions, not told from zero"
        say(f"{untold}; if it stays so, start nearer or look further ahead")
    return few, error


@dataclass(frozen=True)
class _Prices:
    """Seconds of a motion by C MuJoCo and of its gradient, None where nobody knows them, and who steps."""

    motion: float | None
    gradient: float | None
    engine: Engine

    @classmethod
    def of(cls, task: SceneTask) -> "_Prices":
        by = engine_of(task.scene, task.contact)
        if not task.num_controls:
            return cls(None, None, by)
        each = {kind: task.horizon * seconds for kind, seconds in seconds_of(task.scene).items()}
        return cls(each["motion"], each[getattr(task.contact, "gradient", "slope")], by)

    @property
    def is_quick(self) -> bool:
        """Whether C MuJoCo steps, which compiles nothing."""
        return self.engine is ENGINES[QUICK]

    def affordable(self, num_swept: int) -> int:
        """Return as many rollouts of an estimate as take two minutes, within limits."""
        if self.motion is None or self.gradient is None or not self.is_quick:
            return _MOST
        each = num_swept * (self.gradient + _REFERENCE * self.motion)
        return int(np.clip(BATCH * (_LONGEST // max(BATCH * each, 1e-9)), _FEWEST, _MOST))

    def foretold(self, num_swept: int, num_samples: int, num_reference: int, horizon: int) -> str:
        """Say what a sweep measures, and what it will take."""
        what = f"{num_swept} stiffnesses, {num_samples} rollouts of {horizon} steps each"
        first = "compiling first"
        if self.motion is not None and self.gradient is not None:
            whole_price = duration(num_swept * (num_samples * self.gradient + num_reference * self.motion))
            if self.is_quick:
                what += f": {whole_price}, {BATCH * self.gradient:.2g} s a gradient of {BATCH} rollouts"
            else:  # nobody knows before how long that takes
                first += (
                    f", a minute or several for a robot; engine mujoco would take {whole_price}, and compiles nothing"
                )
        return f"{what}, by {self.engine.title}; {first}"


def _advances(say: Callable[[str], None]) -> Callable[[int, int], None]:
    """Return a function of the parts done and of all, which says at each eighth how long the others take."""
    began, last = [], [0]

    def advanced(done: int, total: int) -> None:
        began.append(time.perf_counter())  # first, when all is compiled
        if (part := 8 * done // total) > last[0] and done > 1:
            last[0] = part
            left = (began[-1] - began[0]) / (done - 1) * (total - done)
            say(f"{done} of {total} parts, {duration(left)} left")

    return advanced


def _measured(task: SceneTask, swept: list[float], notes: list[str], why: str, result: BiasVariance) -> list[str]:
    """Return sentences on what was swept, by which derivative, and what to heed."""
    scene, contact = task.scene, task.contact
    kinds = {"slope": "the slope of the outcome", "discrete": "that of each step"}
    kind = kinds.get(getattr(contact, "gradient", ""), f"{contact}")
    none = "No two geoms can touch, so stiffness has no effect."
    told = ["Swept contacts are critically damped." if scene.pairs else none, *notes]
    told.append(f"Derivative: {kind}, by {engine_of(scene, contact).title}{why}.")
    if exact := touching_exactly(scene, np.asarray(task.state.qpos)):
        told.append(exact_text(exact))
    shortest = (_SHORT / scene.mj_model.opt.timestep) ** 2
    if isinstance(contact, Slope) and scene.pairs and swept[-1] >= shortest:
        short = "on contacts last at most three time steps, and the slope is off, most by MJX: shorten the time step"
        told.append(f"From {format_number(float(f'{shortest:.1g}'))} 1/s² {short}.")
    if result.share < 1:
        reached = f"at {len(result.cost)} of {len(swept)} stiffnesses"
        told.append(f"Interrupted after {result.share:.0%} of the rollouts, {reached}.")
    return told
