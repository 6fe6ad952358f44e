"""Gradient descent on a smoothed cost, with any estimator and any optax optimiser."""

from collections.abc import Callable
from typing import Unpack

import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from mjxgrad.objective import Objective
from mjxgrad.optimiser.gradient import Estimator, GradientStep, SmoothedObjective, StepState, gradient_step
from mjxgrad.optimiser.loop import RunOptions, run
from mjxgrad.optimiser.method import Method, Record
from mjxgrad.optimiser.result import Optimisation
from mjxgrad.optimiser.smoothing import Smoothing
from mjxgrad.optimiser.trust_region import TrustRegion


class Descent(Method):
    """Steps along estimated gradients; see `optimise`."""

    rule: GradientStep

    def init(self, params: Float[Array, " dim"]) -> StepState:
        """Give the states of the optimiser and of the smoothing."""
        return self.rule.init(params)

    def advance(
        self, params: Float[Array, " dim"], state: StepState, key: PRNGKeyArray, step: Int[Array, ""]
    ) -> tuple[Float[Array, " dim"], StepState, Record]:
        """Take one step."""
        proposal = self.rule.propose(params, state, key, step)
        record = Record.of_estimate(
            proposal.estimate,
            scale=proposal.scale,
            step_norm=jnp.linalg.norm(proposal.change),
            is_taken=proposal.is_taken,
        )
        return params + proposal.change, proposal.state, record


def optimise(
    objective: Objective | SmoothedObjective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation,
    num_steps: int,
    smoothing: Smoothing | Callable[[ArrayLike], ArrayLike] | None = None,
    trust_region: TrustRegion | None = None,
    clip_norm: float | None = None,
    **options: Unpack[RunOptions],
) -> Optimisation:
    r"""Minimise a cost under noise by descent along estimated gradients.

        estimator = functools.partial(mg.estimators.zeroth_order, num_samples=64)
        result = mg.optimise(
            objective, params, jax.random.key(0),
            estimator=estimator, optimiser=optax.adam(1e-2), num_steps=300,
        )
        result.best_params, result.history.cost, mg.Stopped[result.stopped]

    One compilation, however many steps and seeds: `jax.random.split(jax.random.key(0), 5)` in place of the key runs
    five seeds in one program. Step number n of a run draws its noise from `fold_in(key, n)`.

    A step whose estimate is not finite is not taken: parameters and optimiser stay as they were, the step is counted in
    `num_skipped`, and the next one draws other noise.

    Smoothing that decreases as it converges: `objective` is then a function of a traced scale in (0, 1], and `smoothing`
    sets the scale, either as a schedule or by itself where the cost no longer improves.

        noisy = mg.parameter_noise(function, stddev=0.3)
        mg.optimise(
            lambda scale: noisy.with_stddev(0.3 * scale), params, key,
            smoothing=optax.exponential_decay(1.0, 100, 0.5, end_value=0.05), ...
        )
        # Contact from soft to stiff, by itself:
        mg.optimise(
            lambda scale: task.objective(softness=mg.Softness(stiffness=1e3 / scale, damping_ratio=1.0)), params, key,
            smoothing=mg.Plateau(factor=0.5, patience=10, minimum=0.01), ...
        )

    With tqdm:

        with tqdm.tqdm(total=300) as bar:
            mg.optimise(..., callback=lambda progress: bar.update(progress.step - bar.n) and None)

    Args:
        objective: what to minimise, or with `smoothing` a function from a scale to it.
        params: the start, a vector; with many seeds also one per seed.
        key: consumed here; with a leading axis, one per seed.
        estimator: called as `estimator(objective, params, key)`; any of `mg.estimators` with its settings bound by
            `functools.partial`, or your own.
        optimiser: from optax; it is handed the mean cost under noise as `value`, too.
        num_steps: at most.
        smoothing: a schedule from step to scale, or a `Plateau`.
        trust_region: how far a step may go.
        clip_norm: longest gradient that the optimiser sees; longer ones are shortened to it.
        **options: `evaluate`, `evaluate_every`, `patience`, `convergence`, `max_rollouts`, `max_seconds`, `segment`,
            `callback`, `checkpoint`, `checkpoint_every`; see `RunOptions`.

    Returns:
        The last and the best parameters, the history, why it stopped and what was spent.

    Raises:
        ValueError: if `objective` and `smoothing` do not belong together, a number is out of range, shapes do not fit,
            a trust region does not know its unit, or a checkpoint is damaged or of another run.
    """
    rule = gradient_step(
        objective, estimator, optimiser, smoothing=smoothing, trust_region=trust_region, clip_norm=clip_norm
    )
    return run(Descent(rule), params, key, num_steps=num_steps, **options)
