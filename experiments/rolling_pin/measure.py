"""From settings to descents."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.rolling_pin.settings import Settings
from experiments.workspace import Workspace
from mjxgrad.dynamics import Smoothing
from mjxgrad.tasks.rolling_pin import STIFFNESS, RollingPin, rolling_pin

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
    key = jax.random.key(settings.seed)
    slope = jax.jit(jax.grad(task.true_cost))(jnp.zeros(task.horizon * task.num_controls))
    programs, descents = _programs(settings), []
    with workspace.stage("descent", "programs", len(programs)) as advance_to:
        for done, program in enumerate(programs):
            descents += _descend(task, program, settings, jax.random.fold_in(key, done))
            advance_to(done + 1)
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
    return task.with_smoothing(None if mode is None else Smoothing(scale * variant["length"], settings.kernel, mode))
