r"""Estimators and rules to compare with, beside those of the library: REINFORCE with reward-to-go, least squares, DDCG."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from experiments.optimisation.settings import MethodSettings
from mjxgrad.estimators import alpha_order, control_variate, first_order, zeroth_order
from mjxgrad.estimators.estimate import GradientEstimate, Reason, assemble
from mjxgrad.estimators.moments import Moments, as_real
from mjxgrad.estimators.rules import BiasConstrained, Consistent, Evidence, Weights
from mjxgrad.estimators.samples import Plan, check_baseline, sample
from mjxgrad.objective import ActionNoise, Objective, OpenLoop, ParameterNoise, as_vector

__all__ = ["alpha_order", "control_variate", "estimator", "first_order", "least_squares", "reinforce", "zeroth_order"]


class InverseVariance(eqx.Module):
    r"""$\alpha = V^0/(V^0 + V^1)$: least variance if both parts are independent, blind to bias."""

    def __call__(self, evidence: Evidence) -> Weights:
        alpha = evidence.least_variance()
        return Weights(alpha, Reason.inverse_variance, jnp.where(alpha > 0, jnp.nan, 0))


class Concavity(eqx.Module):
    r"""Inverse variance if $V^1 \ge 2(1 - c)\mathrm{Var}f/\sigma^2 - 2\|g^1\|^2$, else $\alpha = 0$.

    A smooth cost satisfies this on average with $c = 0$, a Poincaré inequality one order higher. A cost with jumps has
    too much variance for its derivatives.

    Attributes:
        slack: $c$.

    References:
        Onoda et al., arXiv:2604.18161 (DDCG), here with the noise of each coordinate in its own standard deviations.
    """

    slack: float = 0.3

    def __call__(self, evidence: Evidence) -> Weights:
        needed = 2 * (1 - self.slack) * evidence.cost_variance - 2 * evidence.scaled_first_norm**2
        is_smooth = evidence.scaled_first_variance >= needed
        alpha = jnp.where(is_smooth, evidence.least_variance(), 0)
        reason = Reason.where(is_smooth, Reason.inverse_variance, Reason.inconsistent)
        return Weights(alpha, reason, jnp.where(alpha > 0, jnp.nan, 0))


_RULES = {"consistent": Consistent, "inverse_variance": InverseVariance, "concavity": Concavity}


def estimator(method: MethodSettings, gamma: float = 0.0, bound: float = 0.0) -> functools.partial:
    """Return an estimator, its options bound; the rule "bias_constrained" takes the published constants of a task."""
    options = method.options
    if method.rule is not None:
        is_published = method.rule == "bias_constrained"
        options["rule"] = BiasConstrained(gamma, bound) if is_published else _RULES[method.rule]()
    return functools.partial(globals()[method.name], **options)


def least_squares(
    objective: Objective, params: PyTree, key: PRNGKeyArray, *, num_samples: int, chunk_size: int | None = None
) -> GradientEstimate:
    r"""Estimate the gradient of a smoothed objective by a linear fit to its samples, without derivatives.

    The estimate is the slope of the regression of $f$ on $w$, with an intercept. For Gaussian noise it converges to
    $\nabla F$ for every $f$ (Stein's lemma). For a linear $f$ it is exact from $\mathrm{dim} + 1$ samples on, where
    zeroth order has the full noise. With few more samples than dimensions it is noisier than zeroth order.

    The standard error is the sandwich with each residual divided by one minus its leverage (HC3), because at a jump the
    residual depends on the noise. It is a little too large rather than too small.

    Args:
        objective: an objective with Gaussian noise on the parameters, or open loop from a fixed start.
        params: the point $\theta$, a vector or a pytree as in `first_order`.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. More than dim + 1.
        chunk_size: rollouts at a time. Noise and costs of all samples are kept: memory grows with num_samples * dim.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if the noise is not on the parameters alone, or there are not enough samples for the dimension.

    References:
        Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic
        Contact Models. IEEE T-RO 2023, arXiv:2206.10787, section III (fits to samples). MacKinnon, White. Some
        heteroskedasticity-consistent covariance matrix estimators. Journal of Econometrics 29, 1985 (HC3).
    """
    objective, vector, restore = as_vector(objective, params)
    if not isinstance(objective, ParameterNoise | OpenLoop) or objective.has_circumstances:
        raise ValueError(
            "objective must have its noise on the parameters and nothing else at random, got "
            f"{type(objective).__name__}{' with random starts' if objective.has_circumstances else ''}; "
            "use zeroth_order or control_variate"
        )
    plan = Plan(num_samples, chunk_size, with_score=True)
    if num_samples <= vector.size + 1:
        raise ValueError(
            f"num_samples must be more than dim + 1 = {vector.size + 1}, got {num_samples}; "
            "zeroth_order needs no more than 2"
        )
    num_chunks, size = plan.chunks()
    units = jnp.arange(num_chunks * size).reshape(num_chunks, size)
    samples = jax.lax.map(lambda some: sample(objective, vector, key, plan, some), units)
    samples = jax.tree.map(lambda leaf: leaf.reshape(num_chunks * size, *leaf.shape[2:]), samples)
    mask = samples.zeroth_order_mask()
    costs = Moments.of(samples.rollouts.cost[:, 0], mask)
    # Scores times the standard deviation: comparable size in all coordinates, whatever their units.
    stddev = jnp.ravel(jnp.broadcast_to(objective.stddev, objective.noise_shape)).astype(vector.dtype)
    noise = jnp.where(mask[:, None], samples.rollouts.noise_score[:, 0] * stddev, 0)
    slope, squared_error = _fit(noise, jnp.where(mask, samples.rollouts.cost[:, 0] - costs.mean, 0), mask)
    return assemble(
        slope / stddev,
        squared_error / stddev**2,
        costs,
        plan,
        # A fit that leaves no residual degree of freedom is no estimate.
        count=jnp.where(costs.count > vector.size + 1, costs.count, 0),
        num_felt=samples.num_felt(),
        restore=restore,
    )


def _fit(
    noise: Float[Array, "samples dim"], costs: Float[Array, " samples"], mask: Array
) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Return the slope of the regression, by QR, with its squared error."""
    design = jnp.concatenate([mask[:, None].astype(noise.dtype), noise], axis=1)
    basis, triangle = jnp.linalg.qr(design)
    to_slope = jax.scipy.linalg.solve_triangular(triangle, basis.T)
    fitted = to_slope @ costs
    leverage = (basis**2).sum(axis=1)
    residual = (costs - design @ fitted) / jnp.maximum(1 - leverage, jnp.finfo(noise.dtype).eps)
    squared_error = (to_slope**2 * jnp.where(mask, residual, 0) ** 2).sum(axis=1)
    return fitted[1:], squared_error[1:]


def reinforce(
    objective: Objective,
    params: PyTree,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    baseline: str = "leave_one_out",
) -> GradientEstimate:
    r"""Estimate the gradient by the policy gradient theorem.

    With the cost $c_{it}$ charged at step $t$ of rollout $i$ and the noise $w_{it}$ of its action,

    $$\hat g = \mathrm{mean}_i \sum_t \Big(\frac{\partial \pi_\theta(x_{it})}{\partial\theta}\Big)^{\!\top}
      \frac{w_{it}}{\sigma^2} \Big(\sum_{t' \ge t} c_{it'} - b_{it}\Big).$$

    Costs charged before step $t$ do not depend on $w_{it}$ and add only variance: `zeroth_order` keeps them, this
    estimator leaves them out. The leave-one-out baseline $b_{it}$ is the mean cost to go of the other rollouts at the
    same step. It is independent of rollout $i$, so the estimate is unbiased with it and without. All rollouts are in
    memory at once, because the baseline of every step needs them all.

    The standard error is from the spread of the samples. It ignores their dependence through the baseline, a share of
    order 1 / `num_samples` of the variance.

    Args:
        objective: an objective from `open_loop` or `closed_loop`, on a task that gives `step_costs`.
        params: the point $\theta$, a vector or a pytree as in `first_order`.
        key: consumed here.
        num_samples: rollouts to spend. At least 2.
        baseline: "leave_one_out" or "none".

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit. A sample counts as finite if its
        costs and its score are.

    Raises:
        ValueError: if the objective's noise is not on actions, the task gives no `step_costs`, `num_samples` is below
            2 or `baseline` unknown.

    References:
        Williams. Simple statistical gradient-following algorithms for connectionist reinforcement learning. Machine
        Learning 8, 1992, theorem 1. Sutton, McAllester, Singh, Mansour. Policy gradient methods for reinforcement
        learning with function approximation. NIPS 1999, theorem 1 (cost to go). Kool, van Hoof, Welling. Buy 4
        REINFORCE samples, get a baseline for free! ICLR 2019 workshop, equation 8 (leave-one-out).
    """
    objective, vector, restore = as_vector(objective, params)
    objective = _checked(objective, baseline)
    plan = Plan(num_samples, with_score=True)
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(num_samples))
    noises = jax.vmap(objective.sample_noise)(keys)
    outcomes = jax.vmap(lambda noise: objective.outcome(vector, noise))(noises)
    if outcomes.step_costs is None:
        raise ValueError(
            f"reinforce must be given a task with step_costs, got {type(objective.task).__name__}, which knows only "
            "the total; use zeroth_order, or let its cost be one number per step"
        )
    to_go = _costs_to_go(outcomes.step_costs, objective.task.horizon)
    actions = jax.vmap(lambda noise: objective.split(noise)[0])(noises)
    is_used = jnp.isfinite(outcomes.cost) & jnp.isfinite(to_go).all(axis=1)
    count = is_used.sum()
    if baseline == "leave_one_out":
        # n/(n-1) (C - mean of all) is C minus the mean of the others.
        mean = jnp.where(is_used[:, None], to_go, 0).sum(axis=0) / jnp.maximum(count, 1)
        to_go = (to_go - mean) * (as_real(count, to_go) / as_real(jnp.maximum(count - 1, 1), to_go))
    weighted = actions / objective.stddev**2 * to_go[:, :, None]
    samples = jax.vmap(lambda states, weights: objective.pull_back_at(vector, states)(jnp.ravel(weights)))(
        outcomes.states, jnp.where(is_used[:, None, None], weighted, 0).astype(vector.dtype)
    )
    is_used &= jnp.isfinite(samples).all(axis=1)
    gradients = Moments.of(samples, is_used)
    return assemble(
        gradients.mean,
        gradients.squared_error(),
        Moments.of(outcomes.cost, is_used),
        plan,
        count=gradients.count,
        # Zero noise has no finite score, so every sample that is used was moved by its noise.
        num_felt=(~is_used).sum(),
        restore=restore,
    )


def _costs_to_go(step_costs: Float[Array, "num_samples steps"], horizon: int) -> Float[Array, "num_samples horizon"]:
    """Return the sum of the costs from each step on; costs after the last action are in all of them."""
    return jnp.cumsum(step_costs[:, ::-1], axis=1)[:, ::-1][:, :horizon]


def _checked(objective: Objective, baseline: str) -> ActionNoise:
    if not isinstance(objective, ActionNoise):
        raise ValueError(
            f"objective must have noise on actions, from open_loop or closed_loop, got {type(objective).__name__}; "
            "use zeroth_order where there are no steps"
        )
    check_baseline(baseline, ("leave_one_out", "none"))
    return objective
