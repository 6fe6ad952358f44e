r"""A rolling pin above a bed that it does not touch: a first-order gradient of exactly zero, and ways around it.

The bed is to have a dent. With $z$ the heights of its pillars in the end, $z^\ast$ those wished for and $u$ the controls,
the true cost is

$$\sum_i (z_i - z_i^\ast)^2 / \sum_i (z_i^\ast)^2 + w_u \overline{u^2},$$

1 for an untouched bed. What helps to find the bed changes the simulation or the cost (`with_proximity`), never what is
judged in the end: `true_cost` is of the scene as it is loaded.

References:
    Huang, Hu, Du, Zhou, Su, Tenenbaum, Gan. PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable
    Physics. ICLR 2021, arXiv:2104.03311 (the rolling pin, and soft contact of its tools).
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float
from pydantic import Field

import mjxgrad as mg
from experiments.report import Bold, Table, tabulated
from experiments.settings import Positive, RunSettings, SettingsTable, Several, VideoSettings
from experiments.theme import MUTED, Drawings, legend_below, looks, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.words import joined, quantity
from experiments.workspace import Workspace
from mjxgrad.rollouts import Trajectory, initial_state
from mjxgrad.scene import load_scene
from mjxgrad.stepping import Smoothing
from mjxgrad.tasks import ActionTask, scene_path


class RemedySettings(SettingsTable):
    """How far each remedy reaches at first; all but proximity shrink on the way."""

    proximity: Positive = 0.3
    """Weight of the mean square of the distance to the bed, in distances at the start."""
    radius: Positive = 0.03
    """By which the pin is larger (m)."""
    margin: Positive = 0.03
    """At which force begins (m)."""
    rest_acceleration: Positive = 50.0
    """Under which a margin changes no depth (m/s²): about 8 N on a pillar of the bed."""
    length: Positive = 0.015
    """Standard deviation of the noise that kernels average over (m)."""
    last: Annotated[float, Field(gt=0, le=1)] = 0.02
    """What is left of radius, margin and length in the end, as a share."""


class Settings(RunSettings):
    """A dent in a bed that the pin does not touch, by descent along different derivatives."""

    num_steps: Several = 60
    """Of descent."""
    num_samples: Several = 2
    """Rollouts per step with derivatives."""
    learning_rate: Positive = 0.03
    """Of Adam."""
    stddev: Positive = 0.01
    """Of the noise on the controls of the remedies: so little that no sample finds the bed by it (10 N)."""
    search_stddev: Positive = 0.3
    """Of the noise by which zeroth order and α-order search, white in time (10 N)."""
    search_samples: Annotated[int, Field(ge=4)] = 16
    """Rollouts per step of these."""
    solved_below: Positive = 0.1
    """True cost that counts as solved; the untouched bed has 1."""
    remedies: RemedySettings = RemedySettings()
    """Their reach."""
    video: VideoSettings | None = None
    """Without it, none is made."""


NUM_PILLARS = 8
DENT = (2, 3, 4, 5)
DEPTH = 0.015  # m
CONTROL_WEIGHT = 1e-3  # of the mean square of the controls
STIFFNESS = 1e4  # 1/s², of the scene's contact, which is critically damped


class DentCost(eqx.Module):
    """What the bed looks like in the end, and what it took; see the module.

    Attributes:
        target: heights of the pillars, less those at rest (m).
        proximity_weight: of the mean square of the distance between pin and bed, over that at the start.
        centre: of the pin at rest, less those of the pillars' caps (m): x, z.
        reach: radii of pin and cap together (m).
    """

    target: Float[Array, " pillars"]
    proximity_weight: Float[Array, ""]
    centre: Float[Array, "pillars 2"]
    reach: Float[Array, ""]

    def __call__(self, trajectory: Trajectory) -> Float[Array, ""]:
        error = jnp.sum((trajectory.qpos[-1, 2:] - self.target) ** 2) / jnp.sum(self.target**2)
        effort = CONTROL_WEIGHT * jnp.mean(trajectory.ctrl**2)
        distance = jax.vmap(self.distance)(trajectory.qpos)
        far = jnp.maximum(distance, 0.0) / self.distance(jnp.zeros_like(trajectory.qpos[0]))
        return error + effort + self.proximity_weight * jnp.mean(far**2)

    def distance(self, qpos: Float[Array, " nq"]) -> Float[Array, ""]:
        """Return the distance of the pin from the nearest pillar, negative inside (m)."""
        offset = self.centre + jnp.stack([jnp.broadcast_to(qpos[0], self.target.shape), qpos[1] - qpos[2:]], axis=1)
        return jnp.min(jnp.linalg.norm(offset, axis=1)) - self.reach


class RollingPin(ActionTask):
    """The pin and its bed; see `rolling_pin`. Every remedy gives another task, of the same controls."""

    @property
    def target(self) -> Float[Array, " pillars"]:
        """Heights wished for, less those at rest (m)."""
        return self.cost.target  # pyright: ignore[reportFunctionMemberAccess]

    def with_proximity(self, weight: Float[ArrayLike, ""]) -> "RollingPin":
        """Return the task whose cost draws the pin to the bed."""
        return eqx.tree_at(lambda task: task.cost.proximity_weight, self, jnp.asarray(weight, float))

    def enlarged(self, extra: Float[ArrayLike, ""]) -> "RollingPin":
        """Return the task with a pin of a radius larger by so much (m); it is no heavier."""
        size = self.scene.model.geom_size.at[self.scene.mj_model.geom("pin").id, 0].add(extra)
        return dataclasses.replace(self, scene=self.scene.with_model(geom_size=size))

    def true_cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the cost of flattened controls, without noise."""
        return self.run(params.reshape(self.horizon, self.num_controls)).cost


def rolling_pin(*, horizon: int = 120) -> RollingPin:
    """Load the task: four of eight pillars are to be 15 mm lower in the end.

    Controls are the forces on the pin along x and z, in units of 10 N. The pin begins at rest 30 mm above the first of the
    four, so that it has to come down, and then to roll along. A step is 5 ms.
    """
    scene = load_scene(scene_path("rolling_pin"))
    model = scene.mj_model
    caps = np.array([model.geom(f"pillar_{i}").id for i in range(NUM_PILLARS)])
    pin = model.geom("pin").id
    at_rest = model.body_pos[model.geom_bodyid] + model.geom_pos
    target = np.zeros(NUM_PILLARS)
    target[list(DENT)] = -DEPTH
    cost = DentCost(
        target=jnp.asarray(target),
        proximity_weight=jnp.zeros(()),
        centre=jnp.asarray((at_rest[pin] - at_rest[caps])[:, [0, 2]]),
        reach=jnp.asarray(model.geom_size[pin, 0] + model.geom_size[caps[0], 0]),
    )
    start = jnp.zeros((horizon, scene.model.nu))
    return RollingPin(scene, initial_state(scene), cost, horizon, start_params=start)  # pyright: ignore[reportCallIssue]


# A way to see the bed, as numbers alone, so that several are one batch of one program: `proximity`, weight of the distance in
# the cost; `extra` radius of the pin, `margin` and `length` of the kernel at first (m); `stddev` of the noise on the controls.
Variant = dict[str, Float[Array, "..."]]
# Mode of the kernel (None has none), estimator, rollouts per step, and by label the variants that share these.
_Program = tuple[str | None, Callable, int, dict[str, Variant]]


@dataclasses.dataclass(frozen=True)
class Descent:
    """One descent."""

    label: str  # of the derivative it went along
    params: Float[np.ndarray, " dim"]  # where it ended
    costs: Float[np.ndarray, " points"]  # true cost, without noise, before every step and in the end
    num_samples: int  # rollouts per step
    num_skipped: int  # steps without a finite estimate
    heights: Float[np.ndarray, " pillars"]  # in the end, under the true motion (m)

    def steps_to(self, cost: float) -> int | None:
        """Give the first step whose result is below a cost, from which on it stays there."""
        above = np.flatnonzero(~(self.costs < cost))
        first = 0 if not above.size else int(above[-1]) + 1
        return first if first < len(self.costs) else None


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The numbers."""

    settings: Settings
    descents: list[Descent]
    start_gradient: float  # largest element of the gradient of the true cost at the start
    task: RollingPin

    def is_solved(self, descent: Descent) -> bool:
        """Say whether a descent ends below the cost that counts as solved."""
        return bool(descent.costs[-1] < self.settings.solved_below)

    def rows(self) -> list[dict[str, Any]]:
        """Give the true cost of every step of every descent, for metrics.csv."""
        return [
            {"method": one.label, "step": step, "rollouts": step * one.num_samples, "true_cost": float(cost)}
            for one in self.descents
            for step, cost in enumerate(one.costs)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend in every way from controls of zero, and judge each by the true cost."""
    task = rolling_pin()
    workspace.check(task.scene)
    slope = jax.jit(jax.grad(task.true_cost))(jnp.zeros(task.horizon * task.num_controls))
    programs = _programs(settings)
    keys = jax.random.split(jax.random.key(settings.seed), len(programs))
    parts = {f"{i}": functools.partial(_descend, task, one, settings, keys[i]) for i, one in enumerate(programs)}
    descents = list(itertools.chain(*workspace.each("descent", "programs", parts)))
    return Outcome(settings, descents, float(jnp.abs(slope).max()), task)


@eqx.filter_jit
def positions(task: RollingPin, params: Float[Array, " dim"]) -> Float[Array, "states nq"]:
    """Move the pin by flattened controls, under the true motion."""
    return mg.rollout(task.scene, task.state, params.reshape(task.horizon, task.num_controls)).qpos


def _programs(settings: Settings) -> list[_Program]:
    few, many, reach = settings.num_samples, settings.search_samples, settings.remedies

    def variant(**parts: float) -> Variant:
        # Lengths must be positive even where no kernel asks for them.
        given = {"proximity": 0.0, "extra": 0.0, "margin": 0.0, "length": 1.0, "stddev": settings.stddev} | parts
        return {name: jnp.asarray(value, float) for name, value in given.items()}

    seen = {
        "first order": variant(),
        "contact loss": variant(proximity=reach.proximity),
        "larger pin": variant(extra=reach.radius),
        "margin, height kept": variant(margin=reach.margin),
    }
    kernel, search = variant(length=reach.length), variant(stddev=settings.search_stddev)
    return [
        (None, mg.estimators.first_order, few, seen),
        ("forward", mg.estimators.first_order, few, {"kernel, forward": kernel}),
        ("backward", mg.estimators.first_order, few, {"kernel, backward only": kernel}),
        (None, mg.estimators.zeroth_order, many, {"zeroth order": search}),
        (None, mg.estimators.alpha_order, many, {"α-order": search}),
    ]


def _descend(task: RollingPin, program: _Program, settings: Settings, key: Array) -> list[Descent]:
    """Descend for several variants at once, with what reaches out shrinking as it goes."""
    mode, estimator, num_samples, variants = program
    shrink = optax.exponential_decay(1.0, settings.num_steps, settings.remedies.last)
    start = jnp.zeros(task.horizon * task.num_controls)

    @eqx.filter_jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def run(variant: Variant, key: Array) -> tuple[Array, Array]:
        descent = mg.estimated_gradient(
            lambda scale: _seen(task, variant, scale, mode, settings).objective(variant["stddev"]),
            key,
            estimator=functools.partial(estimator, num_samples=num_samples),
            optimiser=optax.adam(settings.learning_rate),
            annealing=shrink,
        )

        def step(carry, _):
            params, state = carry
            updates, state = descent.update(jnp.zeros_like(params), state, params)
            return (params + updates, state), params

        (last, state), visited = jax.lax.scan(step, (start, descent.init(start)), length=settings.num_steps)
        return jnp.concatenate([visited, last[None]]), state.num_skipped

    visited, skipped = run(jax.tree.map(lambda *leaves: jnp.stack(leaves), *variants.values()), key)
    return [
        Descent(
            label=label,
            params=np.asarray(visited[i, -1]),
            costs=np.asarray(_judged(task, visited[i])),
            num_samples=num_samples,
            num_skipped=int(skipped[i]),
            heights=np.asarray(positions(task, visited[i, -1])[-1, 2:]),
        )
        for i, label in enumerate(variants)
    ]


@eqx.filter_jit
def _judged(task: RollingPin, visited: Float[Array, "points dim"]) -> Float[Array, " points"]:
    return jax.vmap(task.true_cost)(visited)


def _seen(task: RollingPin, variant: Variant, scale: Array, mode: str | None, settings: Settings) -> RollingPin:
    """Give the task as a variant sees it."""
    task = task.with_proximity(variant["proximity"]).enlarged(scale * variant["extra"])
    # Without a margin this is the contact of the scene.
    rest = settings.remedies.rest_acceleration
    task = task.with_softness(mg.Softness(STIFFNESS, 1.0, margin=scale * variant["margin"], rest_acceleration=rest))
    return task if mode is None else task.with_contact(Smoothing(scale * variant["length"], mode))


def answer(outcome: Outcome) -> str:
    """Count the ways that find the bed, and name the one that ends nearest to what is wanted."""
    found = [one for one in outcome.descents if outcome.is_solved(one)]
    if not found:
        return f"None of {len(outcome.descents)} ways finds it."
    best = min(found, key=lambda one: one.costs[-1])
    plain = "does, too" if any(one.label == "first order" for one in found) else "alone does not"
    return f"{len(found)} of {len(outcome.descents)} ways find it, best “{best.label}”; first order {plain}."


def verdict(outcome: Outcome) -> str:
    """Say what plain first order did, and what solved the task."""
    settings = outcome.settings
    plain = next(one for one in outcome.descents if one.label == "first order")
    has_moved = np.ptp(plain.costs) > 1e-6 * plain.costs[0]
    if outcome.start_gradient == 0 and not has_moved:
        told = (
            "First order stays at the start: its gradient is zero, exactly, and after "
            f"{settings.num_steps} steps the bed is untouched."
        )
    else:
        told = (
            f"First order begins with a gradient of {quantity(outcome.start_gradient)} and ends at a true cost of "
            f"{quantity(plain.costs[-1])}."
        )
    solved = sorted((one for one in outcome.descents if outcome.is_solved(one)), key=lambda one: one.costs[-1])
    failed = [one for one in outcome.descents if not outcome.is_solved(one) and one is not plain]
    below = f"with a true cost below {settings.solved_below:g} of the untouched bed's 1"
    return " ".join(
        [
            told,
            *([f"Solved, {below}, by {_listed(solved)}."] if solved else []),
            *([f"Not solved by {_listed(failed)}."] if failed else []),
        ]
    )


def findings(outcome: Outcome) -> list[str]:
    """Say how many steps had no estimate."""
    lost = sum(one.num_skipped for one in outcome.descents)
    return [f"{lost} steps were left out, because their estimate was not finite."] if lost else []


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    target, below = np.asarray(outcome.task.target), f"{outcome.settings.solved_below:g}"
    rows = []
    for one in outcome.descents:
        steps = one.steps_to(outcome.settings.solved_below)
        rows.append(
            {
                "descent along": one.label,
                "rollouts a step": str(one.num_samples),
                "final true cost": (Bold if outcome.is_solved(one) else str)(quantity(float(one.costs[-1]))),
                "least true cost": quantity(float(one.costs.min())),
                f"steps to stay below {below}": "never" if steps is None else str(steps),
                "rollouts for that": "" if steps is None else str(steps * one.num_samples),
                "worst pillar (mm)": f"{1e3 * abs(one.heights - target).max():.1f}",
            }
        )
    caption = (
        "The true cost is that of the scene as it is, without noise, whatever the descent saw; 1 is the untouched bed. "
        f"In bold what ends below {below}. The last column is the largest distance of a pillar from its wanted height "
        "in the end."
    )
    return [tabulated(rows, caption)]


def _listed(descents: list[Descent]) -> str:
    return joined(f"“{one.label}” ({quantity(one.costs[-1])})" for one in descents)


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"descent": descent}


def descent(outcome: Outcome):
    """True cost against steps and against rollouts."""
    figure, axes = subplots(1, 2, height=4.4, sharey=True)
    left, right = axes[0]
    for one, look in zip(outcome.descents, looks(one.label for one in outcome.descents), strict=True):
        steps = np.arange(len(one.costs))
        look |= {"ms": 4, "markevery": max(1, len(steps) // 8)}
        left.plot(steps, one.costs, label=one.label, **look)
        # The first point has cost no rollout, and a logarithm has no place for it.
        right.plot(steps[1:] * one.num_samples, one.costs[1:], **look)
    for axis in (left, right):
        axis.axhline(outcome.settings.solved_below, color=MUTED, lw=0.8, ls=(0, (2, 3)))
        axis.set_yscale("log")
    left.set(title="Against steps", xlabel="step", ylabel="true cost")
    right.set(title="Against rollouts", xlabel="rollouts", xscale="log")
    legend_below(figure, left, 4)
    reach = outcome.settings.remedies
    caption = (
        "True cost against steps, left, and against rollouts, right: every descent is judged by the same scene, without noise "
        f"and without its remedy. The dotted line is what counts as solved. At first the pin is {1e3 * reach.radius:g} mm "
        f"larger, the margin {1e3 * reach.margin:g} mm wide, the kernel {1e3 * reach.length:g} mm long; all shrink to "
        f"{reach.last:.0%} on the way, so that what is seen becomes what is."
    )
    return figure, "True cost of each descent", caption


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the motion of the best controls, and give the file and its caption."""
    best = min(outcome.descents, key=lambda one: one.costs[-1])
    qpos = np.asarray(positions(outcome.task, jnp.asarray(best.params)))
    caption = (
        f"The motion that {best.label} ends with, {shown_speed(wanted.speed)}; the green line is the wanted depth."
    )
    mj_model = with_coarse_shadows(outcome.task.scene.mj_model)
    return film(workspace, [(mj_model, qpos)], wanted, camera="side", caption=caption)
