"""From settings to descents."""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.rolling_pin.outcome import Descent, Outcome
from experiments.rolling_pin.settings import Settings
from experiments.workspace import Workspace
from mjxgrad.dynamics import Smoothing
from mjxgrad.tasks.rolling_pin import STIFFNESS, RollingPin, rolling_pin


class Variant(eqx.Module):
    """A way to see the bed, as numbers alone, so that several are one batch of one program.

    Attributes:
        proximity: weight of the distance in the cost.
        extra: radius by which the pin is larger at first (m).
        margin: of contact at first (m), with the height of rest kept by a softer contact.
        length: of the kernel at first (m); unused without a mode.
        stddev: of the noise on the controls.
    """

    proximity: Float[Array, "..."]
    extra: Float[Array, "..."]
    margin: Float[Array, "..."]
    length: Float[Array, "..."]
    stddev: Float[Array, "..."]


@dataclasses.dataclass(frozen=True)
class Group:
    """Variants that share a program.

    Attributes:
        mode: of the kernel; None has none.
        estimator: of the gradient.
        variants: by label.
        num_samples: rollouts per step.
    """

    mode: str | None
    estimator: Callable
    variants: dict[str, Variant]
    num_samples: int


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend in every way from controls of zero, and judge each by the true cost."""
    task = rolling_pin()
    workspace.check(task.scene)
    groups = _groups(settings)
    key = jax.random.key(settings.seed)
    start = jnp.zeros(task.horizon * task.num_controls)
    slope = np.asarray(jax.jit(jax.grad(task.true_cost))(start))
    descents: list[Descent] = []
    with workspace.stage("descent", "programs", len(groups)) as advance_to:
        for done, group in enumerate(groups):
            descents += _descend(task, group, settings, jax.random.fold_in(key, done))
            advance_to(done + 1)
    best = min(descents, key=lambda one: one.costs[-1])
    return Outcome(
        settings=settings,
        descents=descents,
        start_gradient=float(np.abs(slope).max()),
        target=np.asarray(task.target),
        heights={one.label: _final_heights(task, one) for one in descents},
        motion=np.asarray(_positions(task, jnp.asarray(best.params))),
        task=task,
    )


def _groups(settings: Settings) -> list[Group]:
    few, many = settings.num_samples, settings.search_samples
    first = functools.partial(mg.estimators.first_order, num_samples=few)
    reach, search = settings.remedies, settings.search_stddev

    def variant(**parts: float) -> Variant:
        # Lengths must be positive even where no kernel asks for them.
        given = {"proximity": 0.0, "extra": 0.0, "margin": 0.0, "length": 1.0, "stddev": settings.stddev} | parts
        return Variant(**{name: jnp.asarray(value, float) for name, value in given.items()})

    seen = {
        "first order": variant(),
        "contact loss": variant(proximity=reach.proximity),
        "larger pin": variant(extra=reach.radius),
        "margin, height kept": variant(margin=reach.margin),
    }
    kernel = variant(length=reach.length)
    return [
        Group(None, first, seen, few),
        Group("forward", first, {"kernel, forward": kernel}, few),
        Group("backward", first, {"kernel, backward only": kernel}, few),
        Group(
            None,
            functools.partial(mg.estimators.zeroth_order, num_samples=many),
            {"zeroth order": variant(stddev=search)},
            many,
        ),
        Group(
            None,
            functools.partial(mg.estimators.alpha_order, num_samples=many),
            {"α-order": variant(stddev=search)},
            many,
        ),
    ]


def _descend(task: RollingPin, group: Group, settings: Settings, key: Array) -> list[Descent]:
    """Descend for all variants of a group at once, with what reaches out shrinking as it goes."""
    shrink = optax.exponential_decay(1.0, settings.num_steps, settings.remedies.last)
    start = jnp.zeros(task.horizon * task.num_controls)

    @eqx.filter_jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def run(variant: Variant, key: Array) -> tuple[Array, Array, Array]:
        descent = mg.estimated_gradient(
            lambda scale: _seen(task, variant, scale, group.mode, settings).objective(variant.stddev),
            key,
            estimator=group.estimator,
            optimiser=optax.adam(settings.learning_rate),
            annealing=shrink,
        )

        def step(carry, _):
            params, state = carry
            updates, state = descent.update(jnp.zeros_like(params), state, params)
            return (params + updates, state), (params, state.estimate.alpha)

        (last, state), (visited, alpha) = jax.lax.scan(step, (start, descent.init(start)), length=settings.num_steps)
        return jnp.concatenate([visited, last[None]]), alpha, state.num_skipped

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *group.variants.values())
    visited, alpha, skipped = run(stacked, key)
    return [
        Descent(
            label=label,
            params=np.asarray(visited[i, -1]),
            costs=np.asarray(_judged(task, visited[i])),
            alpha=np.asarray(alpha[i]),
            num_samples=group.num_samples,
            num_skipped=int(skipped[i]),
        )
        for i, label in enumerate(group.variants)
    ]


@eqx.filter_jit
def _judged(task: RollingPin, visited: Float[Array, "points dim"]) -> Float[Array, " points"]:
    return jax.vmap(task.true_cost)(visited)


def _seen(task: RollingPin, variant: Variant, scale: Array, mode: str | None, settings: Settings) -> RollingPin:
    """Give the task as a variant sees it."""
    task = task.with_proximity(variant.proximity).enlarged(scale * variant.extra)
    # Without a margin this is the contact of the scene.
    kept = mg.Softness(
        STIFFNESS, 1.0, margin=scale * variant.margin, rest_acceleration=settings.remedies.rest_acceleration
    )
    task = task.with_softness(kept)
    return task.with_smoothing(None if mode is None else Smoothing(scale * variant.length, settings.kernel, mode))


@eqx.filter_jit
def _positions(task: RollingPin, params: Float[Array, " dim"]) -> Float[Array, "states nq"]:
    controls = params.reshape(task.horizon, task.num_controls)
    return mg.rollout(task.scene, task.state, controls).qpos


def _final_heights(task: RollingPin, descent: Descent) -> Float[np.ndarray, " pillars"]:
    return np.asarray(_positions(task, jnp.asarray(descent.params))[-1, 2:])
