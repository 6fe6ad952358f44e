"""The α-order estimate: first order where it can be trusted, an unbiased one where not."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mjxgrad.estimators.by_noise import plan_by_noise
from mjxgrad.estimators.control_variate import assemble_mixture, stream_parts
from mjxgrad.estimators.estimate import GradientEstimate, Reason
from mjxgrad.estimators.parts import Parts
from mjxgrad.estimators.rules import Consistent, Evidence, Rule, Weights
from mjxgrad.objective import Objective


def alpha_order(
    objective: Objective,
    params: Float[Array, " dim"],
    key: PRNGKeyArray,
    *,
    num_samples: int,
    rule: Rule | None = None,
    control_variate: bool = True,
    blocks: np.ndarray | None = None,
    chunk_size: int | None = None,
) -> GradientEstimate:
    r"""Mix a first-order and an unbiased estimate of the gradient of a smoothed objective.

    $\alpha g^1 + (1 - \alpha) g^0$, both parts from the same rollouts. $g^1$ is the mean derivative; $g^0$ the
    control-variate estimate (see `control_variate`), which is never much worse than zeroth order and far better where
    derivatives explain the costs. The rule chooses $\alpha$ and says why. Choosing it from the same samples adds a
    dependence of the order of one over their number that the standard error does not count.

    Args:
        objective: differentiated once per sample by its noise, under `jax.vmap`.
        params: the point $\theta$.
        key: consumed here; do not use it again.
        num_samples: rollouts to spend. At least 2; where starts are random, even and at least 4, since pairs share one.
        rule: chooses $\alpha$; see `mjxgrad.estimators.rules`. None is `Consistent()`.
        control_variate: whether $g^0$ uses derivatives; without, it is zeroth order with the leave-one-out baseline.
        blocks: number of the block of each coordinate, from 0; $\alpha$ is then chosen for each block. None is one
            block, `np.arange(dim)` one for each coordinate.
        chunk_size: rollouts at a time, at least 4; memory grows with it. Samples are compared, and leave each other out,
            within groups of at most 64 of a chunk.

    Returns:
        The estimate of $\nabla F(\theta)$, in objective units per parameter unit.

    Raises:
        ValueError: if `num_samples`, `chunk_size` or `blocks` do not fit, or the objective does not know its noise.

    References:
        Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
        arXiv:2202.00817, section 4 (the mixture).
    """
    params = jnp.asarray(params)
    objective = objective.sized_for(params)
    plan = plan_by_noise(objective, num_samples, chunk_size)
    blocks, num_blocks = _checked_blocks(blocks, params.size)
    parts = stream_parts(objective, params, key, plan, control_variate=control_variate)
    weights = weigh(rule or Consistent(), parts, blocks, num_blocks)
    alpha, bias_bound = weights.alpha[blocks], jnp.sqrt((weights.bias_bound**2).sum())
    if num_blocks == 1:
        weights = jax.tree.map(lambda leaf: leaf[0], weights)
    return assemble_mixture(parts, plan, alpha, alpha=weights.alpha, reason=weights.reason, bias_bound=bias_bound)


def weigh(rule: Rule, parts: Parts, blocks: Int[np.ndarray, " dim"], num_blocks: int) -> Weights:
    """Apply a rule to each block, where it has derivatives to judge.

    Args:
        rule: for one block.
        parts: the summary.
        blocks: number of the block of each coordinate.
        num_blocks: how many there are.

    Returns:
        The weights, with an axis of blocks.
    """

    def one_block(evidence: Evidence) -> Weights:
        weights, has_first = rule(evidence), evidence.count >= 2
        alpha = jnp.where(has_first, weights.alpha, 0)
        reason = Reason.where(has_first, weights.reason, Reason.not_finite)
        return Weights(alpha, reason, jnp.where(alpha > 0, weights.bias_bound, 0))

    return jax.vmap(one_block)(parts.evidence(blocks, num_blocks))


def _checked_blocks(blocks: np.ndarray | None, dim: int) -> tuple[Int[np.ndarray, " dim"], int]:
    """Give the block of each coordinate, and how many blocks there are."""
    if blocks is None:
        return np.zeros(dim, int), 1
    if isinstance(blocks, jax.core.Tracer):
        raise ValueError("blocks must be known when compiling, got a traced array; fix it by functools.partial")
    blocks = np.asarray(blocks)
    if blocks.shape != (dim,):
        raise ValueError(f"blocks must have one number for each of the {dim} coordinates, got shape {blocks.shape}")
    num_blocks = int(blocks.max()) + 1
    if not np.issubdtype(blocks.dtype, np.integer) or set(np.unique(blocks)) != set(range(num_blocks)):
        raise ValueError("blocks must be integers from 0 without gaps; np.arange(dim) is one block for each coordinate")
    return blocks, num_blocks
