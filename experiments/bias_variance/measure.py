"""From a problem to the numbers."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.bias_variance.outcome import Interval, Outcome
from experiments.bias_variance.problems import Problem
from experiments.bias_variance.problems import problem as set_up
from experiments.bias_variance.settings import Settings
from experiments.failure import ExperimentError
from experiments.theme import power
from experiments.workspace import Workspace
from mjxgrad.diagnostics import BiasVariance, Landscape, bias_variance

# The landscape is smoothed for the picture where it reaches four standard deviations to both sides.
REACH = 4.0


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Estimate at every stiffness and angle, with a progress bar.

    Raises:
        ExperimentError: if at some stiffness and angle there is no estimate, for hardly any rollout was finite.
    """
    problem = set_up(settings)
    rows = len(problem.stiffness)
    if problem.task is not None:
        workspace.check(problem.task.scene)
    with workspace.stage("gradients", "stiffnesses", rows) as advance_to:
        measured = bias_variance(
            problem.objective,
            jnp.asarray(settings.angles)[:, None],
            jax.random.key(settings.seed),
            softness=problem.knob,
            num_samples=settings.num_samples,
            num_reference=settings.reference_samples,
            confidence=settings.confidence,
            progress=lambda done, _: advance_to(done),
        )
    _refuse_without_estimate(measured, problem)
    outcome = _outcome(measured, problem, settings)
    for i in np.flatnonzero(outcome.finite.min(axis=1) < 1):
        workspace.warnings.append(
            f"At stiffness {power(problem.stiffness[i])}, {1 - outcome.finite[i].min():.2%} of the rollouts at one angle were "
            "not finite and were left out, so its means are over the others."
        )
    return outcome


def _refuse_without_estimate(measured: BiasVariance, problem: Problem) -> None:
    bad = ~np.isfinite(np.asarray(measured.bias)).all(axis=(1, 2))
    if bad.any():
        stiffness = ", ".join(power(value) for value in problem.stiffness[bad])
        raise ExperimentError(
            f"stiffness {stiffness} gives no estimate: too few of its rollouts, or of their derivatives, are finite; "
            "leave it out, or lower it until it is stable at the scene's time step (h²k + 2hb < 4)"
        )


def _outcome(measured: BiasVariance, problem: Problem, settings: Settings) -> Outcome:
    first, zeroth = measured.first, measured.zeroth
    assert measured.landscape is not None
    smooth_grid, smoothed = _smoothed(measured.landscape, settings.stddev)
    return Outcome(
        stiffness=problem.stiffness,
        angles=np.asarray(settings.angles),
        has_default=problem.has_default,
        settings=settings,
        first=_interval(first.value, measured.first_interval),
        zeroth=_interval(zeroth.value, measured.zeroth_interval),
        reference=_interval(measured.reference, measured.reference_interval),
        bias=_interval(measured.bias, measured.bias_interval),
        bias_error=np.asarray(measured.bias_error)[..., 0],
        first_variance=_interval(first.covariance_diagonal, measured.first_variance_interval[..., None]),
        zeroth_variance=_interval(zeroth.covariance_diagonal, measured.zeroth_variance_interval[..., None]),
        finite=np.asarray(first.finite_fraction),
        grid=np.asarray(measured.landscape.points)[0],
        cost=np.asarray(measured.landscape.costs),
        smooth_grid=smooth_grid,
        smoothed=smoothed,
    )


def _interval(value: jax.Array, ends: Float[np.ndarray, "2 stiffness angles 1"]) -> Interval:
    return Interval(np.asarray(value)[..., 0], ends[0, ..., 0], ends[1, ..., 0])


def _smoothed(landscape: Landscape, stddev: float) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, "rows grid"]]:
    """Average the landscape under the noise's density, which costs no further rollouts."""
    points, costs = np.asarray(landscape.points)[0], np.asarray(landscape.costs)
    grid = np.linspace(points[0] + REACH * stddev, points[-1] - REACH * stddev, 300)
    weights = np.exp(-0.5 * ((points[:, None] - grid) / stddev) ** 2)
    return grid, costs @ (weights / weights.sum(axis=0))
