"""Bias and variance of gradients over contact stiffness, for a scene, cost and start given by names."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, Key, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, is_known, real, whole
from mjxgrad._text import Paged, format_number
from mjxgrad.checking.check import Source, _outcomes
from mjxgrad.checking.costs import Cost, named_cost
from mjxgrad.checking.motions import CONTACT_FIELDS, compiler_options, half_range
from mjxgrad.contact import Softness
from mjxgrad.diagnostics import BiasVariance, bias_variance
from mjxgrad.diagnostics.bias_variance import ESTIMATES
from mjxgrad.engines import QUICK, engine_of
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
_PAIRS = 256  # pairs of rollouts at once
_FEW = 8  # numbers of a direction that are printed
_NONE, _BLIND = 0.05, 0.25  # shares of the truth: a bias that counts as none, and one that intervals must exclude


def scene_task(
    scene: Scene,
    cost: str | Cost | None = None,
    *,
    start: str | None = None,
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
        outcomes = _outcomes(scene, None, np.random.default_rng(seed))[1]
        cost = lambda trajectory: outcomes(trajectory)[0]  # noqa: E731
    cost = named_cost(scene, cost) if isinstance(cost, str) else cost
    usual = int(np.clip(round(_SECONDS / model.opt.timestep), _FEWEST_STEPS, _MOST_STEPS))
    horizon = usual if horizon is None else horizon
    return SceneTask(scene, state, cost, horizon, contact=contact)  # pyright: ignore[reportCallIssue]


class CommonShift(OpenLoop):
    """The cost under noise on every control, as a function of a common shift of all controls along one direction.

    The gradient by single controls is hundreds of small numbers; for a single number an interval is informative.
    """

    direction: Float[Array, " nu"]

    def unravel(self, params: Float[Array, " dim"]) -> Float[Array, "horizon nu"]:
        return jnp.broadcast_to(self.task.scene.data.ctrl + params[0] * self.direction, self.noise_shape)

    def score(self, params: Float[Array, " dim"], noise: PyTree) -> Float[Array, " dim"]:
        return self.pull_back_at(params, None)(self._noise_score(params, noise))

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

    @property
    def headline(self) -> str:
        """The answer in a line: the stiffnesses where an estimate has no relevant bias, and none too small to see."""
        table, found = self.result.table(), {}
        truth = abs(table["truth"])
        measured = [truth, *(table[f"{name}_bias"] for name in ESTIMATES if f"{name}_bias" in table)]
        if len(truth) > 1 and not any(np.ptp(one, axis=0).any() for one in measured):
            return "Stiffness changes nothing: nothing touches in these motions; start nearer, or look further ahead."
        for name, words in ESTIMATES.items():
            if f"{name}_bias" in table:
                width = table[f"{name}_bias_high"] - table[f"{name}_bias_low"]
                is_off = table[f"{name}_is_biased"] & (abs(table[f"{name}_bias"]) > _NONE * truth)
                good: list[bool] = (~is_off & (width / 2 <= _BLIND * truth)).all(axis=1).tolist()  # pyright: ignore[reportAssignmentType]
                until = good.index(False) if False in good else len(good)
                where = "at " + ", ".join(label for label, one in zip(self.labels, good, strict=True) if one)
                where = (f"up to {self.labels[until - 1]}" if until == sum(good) else where) + " 1/s²"
                none = "nowhere" if is_off.any() else "too noisy to tell"
                found.setdefault("everywhere" if all(good) else where if any(good) else none, []).append(words)
        return f"No bias seen to {_BLIND:.0%}: {'; '.join(', '.join(words) + ' ' + where for where, words in found.items())}."

    def __str__(self) -> str:
        return f"{self.name}: {self.headline}\n\n{self.question}\n\n{self.result.summary(self.labels)}"

    def as_html(self) -> str:
        """Return the sweep as a self-contained page; needs `mjxgrad[render]`."""
        parts = [svg(functools.partial(self.result.plot, one), f"{one} over stiffness") for one in ("bias", "variance")]
        head, *rows = self.result.rows(self.labels)
        told = f"Bars: {self.result.confidence:.0%} intervals. Bias in cost per unit of what is moved, variance in its square."
        blocks = [Block(text=self.question, drawings=parts, caption=told), Block(table=Table(head, rows))]
        return page(self.headline, f"mjxgrad sweep {self.name}", [*blocks, Block(items=self.result.notes())])


def sweep(
    source: Source,
    cost: str | Cost | None = None,
    *,
    stiffness: Sequence[float] = STIFFNESS,
    noise: float = 0.1,
    num_samples: int = 256,
    num_reference: int = 4096,
    seed: int = 0,
    log: Callable[[str], None] | None = None,
    engine: EngineName | None = None,
    **task_settings: Any,
) -> Sweep:
    """Measure bias and variance of first, zeroth and α-order gradients over contact stiffness, in a scene of one's own.

    Args:
        source: an MJCF file, or another source for `load_scene`.
        cost: function of a trajectory; or file.py:function, module:function; or a cost of bodies and sites at the end,
            height:torso (minus its height, m), speed:torso (minus its mean speed along x, m/s), upright:torso (1 − cosine of
            its tilt), reach:hand/ball (their distance, m). None is a random mix of the heaviest body's final coordinates.
        stiffness: stiffnesses to sweep (1/s²), besides the file's own.
        noise: standard deviation on each control of each step, in halves of its range; without controls, on velocities.
        num_samples: rollouts per estimate.
        num_reference: rollouts for the truth.
        seed: seed of all random numbers.
        log: called with the name of each part as it starts. Ctrl-C ends with the stiffnesses measured so far.
        engine: who steps, see `Scene.with_engine`; by default the scene's own.
        **task_settings: `start`, a key frame with its controls, by default the reference pose, at rest; `horizon`, a number of
            time steps, by default half a second, but 50 to 300; `contact`, see `rollout`, by default `mg.Slope()`.

    Raises:
        ValueError: if there is no such file, function, body or key frame, or a number is out of range.
    """
    given = np.atleast_1d(np.asarray(real("stiffness", stiffness), float))
    if not ((given > 0) & (given < np.inf)).all():
        raise ValueError(f"stiffness must be positive and finite, got {', '.join(map(str, given))}")
    if not 0 < real("noise", noise) < np.inf:
        raise ValueError(f"noise must be positive and finite, got {noise}")
    whole("seed", seed, 0)
    whole("num_samples", num_samples, 2)
    function("log", log, "text")
    scene = source if isinstance(source, Scene) else load_scene(source)
    scene = scene if engine is None else scene.with_engine(engine)
    task = scene_task(scene, cost, seed=seed, **task_settings)
    own = jnp.broadcast_to(task.scene.data.ctrl, (task.horizon, task.num_controls))
    if not np.isfinite(at_rest := _by_mujoco(task).run(own).cost):
        raise ValueError(f"cost must be finite, got {at_rest} of the motion without noise")
    knob = Knob(task, noise, seed)
    swept = sorted({*given.tolist(), knob.own}) if scene.pairs else [1.0]
    given = {"softness": Softness(stiffness=swept), "num_samples": num_samples, "num_reference": num_reference}
    given |= {"reference": knob.truth if task.num_controls else None, "compiler_options": compiler_options()}
    progress = None if log is None else lambda done, total: log(f"{done} of {total} stiffnesses")
    result = bias_variance(knob, jnp.zeros((1, 1)), jax.random.key(seed), progress=progress, **given)
    called = "where the heaviest body ends up (a random mix)" if cost is None else getattr(cost, "__name__", cost)
    contact, shortest = task.contact, (_SHORT / scene.mj_model.opt.timestep) ** 2
    kinds = {"slope": "the slope of the outcome", "discrete": "that of each step"}
    kind = kinds.get(getattr(contact, "gradient", ""), f"{contact}")
    none = "No two geoms can touch, so stiffness has no effect."
    told = [
        f"Gradient of {called} after {task.horizon} steps, by {knob}.",
        "Swept contacts are critically damped." if scene.pairs else none,
        f"Derivative: {kind}, by {engine_of(task.scene, contact).title}.",
    ]
    if isinstance(contact, Slope) and scene.pairs and swept[-1] >= shortest:
        short = "on contacts last at most three time steps, and the slope is off, most by MJX: shorten the time step"
        told.append(f"From {format_number(float(f'{shortest:.1g}'))} 1/s² {short}.")
    table, row = result.table(), swept.index(knob.own) if scene.pairs else 0
    if len(result.cost) and not np.isfinite(table["truth"]).any():
        raise ValueError(f"cost must be finite, got NaN or infinity in the rollouts of {called} at every stiffness")
    if left_out := len(swept) - len(result.cost):
        told.append(f"Interrupted: {left_out} of {len(swept)} stiffnesses are left out.")
    if row < len(result.cost) and table["zeroth_variance"][row, 0] > 0:
        ratios = {x: table[f"{x}_variance"] / table["zeroth_variance"] for x in ESTIMATES if f"{x}_variance" in table}
        ratios = [f"{ratio[row, 0]:.2g} for {ESTIMATES[x]}" for x, ratio in ratios.items() if x != "zeroth"]
        told.append(f"Variance over that of zeroth order, in the file's own contact: {', '.join(ratios)}.")
    return Sweep(scene.name, " ".join(told), knob.own, result)
