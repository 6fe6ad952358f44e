"""What every estimator returns."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.estimators.moments import Moments


class Diagnosis(eqx.Enumeration):
    """What to know about an estimate before using it; `Diagnosis[estimate.diagnosis]` is the sentence."""

    fine = "every sample was finite"
    some_not_finite = "samples that were not finite were left out, so the mean is over the rest"
    baseline_not_finite = "the zero-noise rollout was not finite, so there is no baseline"
    too_few_finite = "fewer than two independent samples were finite, so there is no estimate"


class GradientEstimate(eqx.Module):
    r"""An estimate of $\nabla F(\theta)$ and what it cost.

    `covariance_diagonal` is per rollout, whatever the estimator does with its rollouts: divided
    by the number of finite ones and rooted it is `standard_error`. A leave-one-out baseline and
    antithetic pairs make samples dependent; both are accounted for in it.

    Attributes:
        value: the estimate, NaN if fewer than two independent samples were finite.
        standard_error: of each coordinate of `value`.
        covariance_diagonal: variance of each coordinate, per rollout.
        objective_mean: mean cost under noise, an estimate of $F(\theta)$.
        objective_standard_error: of `objective_mean`.
        num_samples: rollouts with noise that were asked for.
        num_finite: of those, the ones used; a pair is used if both of it are finite.
        num_rollouts: rollouts spent, a zero-noise baseline included.
        num_gradient_rollouts: of those, the ones that were differentiated.
        diagnosis: an item of `Diagnosis`.
    """

    value: Float[Array, " dim"]
    standard_error: Float[Array, " dim"]
    covariance_diagonal: Float[Array, " dim"]
    objective_mean: Float[Array, ""]
    objective_standard_error: Float[Array, ""]
    num_samples: Int[Array, ""]
    num_finite: Int[Array, ""]
    num_rollouts: Int[Array, ""]
    num_gradient_rollouts: Int[Array, ""]
    diagnosis: Diagnosis

    @property
    def variance(self) -> Float[Array, "*batch"]:
        """Trace of the covariance, per rollout."""
        return self.covariance_diagonal.sum(axis=-1)

    @property
    def finite_fraction(self) -> Float[Array, "*batch"]:
        """Share of the samples that were finite."""
        return self.num_finite / self.num_samples


def assemble(
    value: Float[Array, " dim"],
    squared_error: Float[Array, " dim"],
    costs: Moments,
    *,
    count: Int[Array, ""],
    rollouts_per_unit: int,
    num_samples: int,
    num_rollouts: int,
    num_gradient_rollouts: int,
    has_baseline: Bool[Array, ""] | bool = True,
) -> GradientEstimate:
    """Put an estimate together, refusing to give a number where there is none.

    Args:
        value: the mean.
        squared_error: its squared standard error.
        costs: moments of the cost over independent units.
        count: independent units (samples, or pairs of them) that were finite.
        rollouts_per_unit: 2 for antithetic pairs, else 1.
        num_samples: samples asked for.
        num_rollouts: rollouts spent.
        num_gradient_rollouts: rollouts differentiated.
        has_baseline: whether a baseline that had to be finite was so.

    Returns:
        The estimate, all NaN where there is none.
    """
    num_finite = count * rollouts_per_unit
    exists = (count >= 2) & has_baseline
    diagnosis = Diagnosis.where(num_finite == num_samples, Diagnosis.fine, Diagnosis.some_not_finite)
    diagnosis = Diagnosis.where(count >= 2, diagnosis, Diagnosis.too_few_finite)
    diagnosis = Diagnosis.where(has_baseline, diagnosis, Diagnosis.baseline_not_finite)
    value = jnp.where(exists, value, jnp.nan)
    squared_error = jnp.where(exists, jnp.maximum(squared_error, 0), jnp.nan)
    return GradientEstimate(
        value=value,
        standard_error=jnp.sqrt(squared_error),
        covariance_diagonal=squared_error * num_finite.astype(squared_error.dtype),
        objective_mean=jnp.where(costs.count > 0, costs.mean, jnp.nan),
        objective_standard_error=jnp.sqrt(costs.squared_error()),
        num_samples=jnp.asarray(num_samples),
        num_finite=num_finite,
        num_rollouts=jnp.asarray(num_rollouts),
        num_gradient_rollouts=jnp.asarray(num_gradient_rollouts),
        diagnosis=diagnosis,
    )
