"""The result of an estimator, and its assembly from moments."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad._arrays import is_known
from mjxgrad._text import Printed, format_number
from mjxgrad.estimators.evidence import Memory
from mjxgrad.estimators.moments import Moments
from mjxgrad.estimators.samples import Plan
from mjxgrad.objective.base import Scalar, Vector

_UNFELT = 1e-12  # of the cost, for each unit of a parameter: a gradient below is rounding


class Diagnosis(eqx.Enumeration):
    """The soundness of an estimate; `Diagnosis[estimate.diagnosis]` is the sentence."""

    fine = "every sample was finite"
    some_not_finite = "samples that were not finite were left out, so the mean is over the rest"
    baseline_not_finite = "the zero-noise rollout was not finite, so there is no baseline"
    too_few_finite = "fewer than two independent samples were finite, so there is no estimate"


class Reason(eqx.Enumeration):
    """The reason for the value of α, the weight of the first-order part; `Reason[estimate.reason]` is the sentence."""

    fixed = "the estimator leaves no choice, or α was given"
    inverse_variance = "the weights are those of least variance: no bias was found, or none was looked for"
    bias_limit = "the first-order part is biased, so α is smaller than the variances ask for"
    uncertain = "the zeroth-order part is too noisy to bound the bias, so it stands alone"
    inconsistent = "values and derivatives of the samples contradict each other, so the zeroth-order part stands alone"
    not_finite = "too few derivatives were finite, so the zeroth-order part stands alone"
    nothing_felt = (
        "all samples cost the same and no derivative differs from zero, so nothing that the parameters change reaches "
        "the cost"
    )
    inside = "the first-order part lies within the error of the zeroth-order part"


class GradientEstimate(eqx.Module, Printed):
    r"""An estimate of $\nabla F(\theta)$ with its errors and the rollouts spent on it.

    Errors account for the dependence of samples through a leave-one-out baseline and through antithetic pairs.

    Attributes:
        value: the estimate, NaN if fewer than two independent samples were finite. It and the next two have the form of
            the parameters, with None in place of leaves that are no floating-point arrays.
        standard_error: standard error of each coordinate of `value`.
        covariance_diagonal: variance of each coordinate, per rollout: the squared error times `num_finite`.
        objective_mean: mean cost under noise, an estimate of $F(\theta)$.
        objective_standard_error: standard error of `objective_mean`.
        num_samples: rollouts with noise that were asked for.
        num_finite: rollouts with noise that were used; a pair is used if both its rollouts are finite.
        num_rollouts: rollouts spent, a zero-noise baseline included.
        num_gradient_rollouts: rollouts that were differentiated.
        diagnosis: an item of `Diagnosis`.
        alpha: weight of the first-order part.
        reason: an item of `Reason`; every estimator may give `Reason.nothing_felt`.
        bias_bound: an upper bound on the norm of the bias of `value`, if the rule that chose `alpha` knows one. Zero for
            an unbiased estimate, NaN where nothing is known.
        memory: evidence that the next estimate of a descent takes over, see `alpha_order`; None from other estimators.
    """

    value: PyTree[Float[Array, "..."]]
    standard_error: PyTree[Float[Array, "..."]]
    covariance_diagonal: PyTree[Float[Array, "..."]]
    objective_mean: Scalar
    objective_standard_error: Scalar
    num_samples: Int[Array, ""]
    num_finite: Int[Array, ""]
    num_rollouts: Int[Array, ""]
    num_gradient_rollouts: Int[Array, ""]
    diagnosis: Diagnosis
    alpha: Scalar
    reason: Reason
    bias_bound: Scalar
    memory: Memory | None = None

    def __str__(self) -> str:
        if not is_known(self.num_samples) or jnp.ndim(self.num_samples):
            return repr(self)
        parts = [np.asarray(ravel_pytree(part)[0]) for part in (self.value, self.standard_error)]
        # Solvers stop at a tolerance: derivatives by what is not touched are then 1e-20, and costs scatter a little.
        is_unfelt = max(map(np.linalg.norm, parts)) <= _UNFELT * abs(float(self.objective_mean))
        if is_long := (size := parts[0].size) > 6:
            parts = [np.array([np.linalg.norm(part)]) for part in parts]
        pairs = [*zip(*parts, strict=True), (self.objective_mean, self.objective_standard_error)]
        *shown, cost = (f"{format_number(float(x))} ± {format_number(float(error))}" for x, error in pairs)
        head = f"of {size} numbers, of norm {shown[0]}" if is_long else ", ".join(shown)
        spent = f"{int(self.num_rollouts)} rollouts: {Diagnosis[self.diagnosis]}"
        reason = Reason[self.reason]
        if is_unfelt and reason != Reason[Reason.nothing_felt]:
            reason = "the gradient is zero to rounding, so nothing is felt: "
            reason += "the cost does not depend on what is moved, or only by jumps"
        why = f"α is {float(self.alpha):.3g}: {reason}. ± is a standard error."
        return f"Gradient {head}; cost {cost}; {spent}. {why}"

    @property
    def variance(self) -> Float[Array, "*batch"]:
        """Trace of the covariance, per rollout."""
        first = jnp.ndim(self.num_samples)  # the axes before it come from `jax.vmap`
        leaves = jax.tree.leaves(self.covariance_diagonal)
        return jnp.stack([leaf.sum(axis=tuple(range(first, leaf.ndim))) for leaf in leaves]).sum(axis=0)

    @property
    def finite_fraction(self) -> Float[Array, "*batch"]:
        """Share of the samples that were finite."""
        return self.num_finite / self.num_samples


# Called as (objective, params, key); settings such as num_samples are keywords or bound by functools.partial.
Estimator = Callable[..., GradientEstimate]


def is_nothing_felt(plan: Plan, costs: Moments, num_felt: Int[Array, ""]) -> Bool[Array, ""]:
    """Return whether the noise changed no cost, and no derivative differed from zero, in any unit.

    Zero noise is no evidence. With random starts, only costs of units that share a start are compared; without such
    units the costs differ by their starts, and the answer is False.
    """
    return (num_felt == 0) & ((costs.squares == 0) | plan.shares_start | plan.zero_noise_per_unit)


def assemble(
    value: Vector,
    squared_error: Vector,
    costs: Moments,
    plan: Plan,
    *,
    count: Int[Array, ""],
    num_felt: Int[Array, ""],
    restore: Callable[[Vector], PyTree],
    has_baseline: Bool[Array, ""] | bool = True,
    alpha: ArrayLike = 0.0,
    reason: Any = Reason.fixed,
    bias_bound: ArrayLike = 0.0,
    memory: Memory | None = None,
) -> GradientEstimate:
    """Assemble an estimate; its value is NaN where too few units were finite.

    Moments and counts are over units: samples, or pairs of them. `count` is the number of finite units; see also
    `Samples.num_felt`. `restore` maps a vector to the form of the parameters.
    """
    num_finite = count * plan.rollouts_per_unit
    exists = (count >= 2) & has_baseline
    diagnosis = Diagnosis.where(num_finite == plan.num_samples, Diagnosis.fine, Diagnosis.some_not_finite)
    diagnosis = Diagnosis.where(count >= 2, diagnosis, Diagnosis.too_few_finite)
    diagnosis = Diagnosis.where(has_baseline, diagnosis, Diagnosis.baseline_not_finite)
    alpha = jnp.asarray(alpha, value.dtype)
    is_nothing = exists & is_nothing_felt(plan, costs, num_felt)
    value = jnp.where(exists, value, jnp.nan)
    squared_error = jnp.where(exists, jnp.maximum(squared_error, 0), jnp.nan)
    return GradientEstimate(
        value=restore(value),
        standard_error=restore(jnp.sqrt(squared_error)),
        covariance_diagonal=restore(squared_error * num_finite.astype(squared_error.dtype)),
        objective_mean=jnp.where(costs.count > 0, costs.mean, jnp.nan),
        objective_standard_error=jnp.sqrt(costs.squared_error()),
        num_samples=jnp.asarray(plan.num_samples),
        num_finite=num_finite,
        num_rollouts=jnp.asarray(plan.num_rollouts),
        num_gradient_rollouts=jnp.asarray(plan.num_rollouts if plan.with_gradient else 0),
        diagnosis=diagnosis,
        alpha=alpha,
        reason=jax.tree.map(lambda x, y: jnp.where(is_nothing, x, y), Reason.nothing_felt, reason),
        bias_bound=jnp.asarray(bias_bound, value.dtype),
        memory=memory,
    )
