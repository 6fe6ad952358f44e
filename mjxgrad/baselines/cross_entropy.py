"""The cross-entropy method: fit a Gaussian to the best candidates, and draw the next ones from it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Key

from mjxgrad.baselines.population import Candidates, Population, search_stddev
from mjxgrad.objective import Objective
from mjxgrad.optimiser.result import Optimisation
from mjxgrad.optimiser.run import RunOptions, run


class CrossEntropy(Population):
    """See `cross_entropy`."""

    objective: Objective
    stddev: Float[Array, " dim"]
    num_samples: int = eqx.field(static=True)
    num_elite: int = eqx.field(static=True)
    keep: float = eqx.field(static=True)
    min_stddev: float = eqx.field(static=True)

    @property
    def least_finite(self) -> int:
        """Ask for a whole elite."""
        return self.num_elite

    def moved(
        self, params: Float[Array, " dim"], stddev: Float[Array, " dim"], candidates: Candidates
    ) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Fit mean and standard deviation to the elite."""
        elite = candidates.params[jnp.argsort(candidates.costs)[: self.num_elite]]
        new = self.keep * params + (1 - self.keep) * elite.mean(axis=0)
        width = self.keep * stddev + (1 - self.keep) * elite.std(axis=0)
        return new, jnp.maximum(width, self.min_stddev)


def cross_entropy(
    objective: Objective,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_samples: int,
    num_elite: int,
    num_steps: int,
    stddev: ArrayLike | None = None,
    keep: float = 0.0,
    min_stddev: float = 0.0,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost by the cross-entropy method.

    Every step draws candidates from $N(\mu, \mathrm{diag}\,\sigma^2)$ and fits $\mu$ and $\sigma$ to the `num_elite`
    best of them, by maximum likelihood (so $\sigma$ has no $n - 1$):

    $$\mu \leftarrow \kappa \mu + (1 - \kappa)\, \mathrm{mean}(\mathrm{elite}), \qquad
      \sigma \leftarrow \kappa \sigma + (1 - \kappa)\, \mathrm{std}(\mathrm{elite}).$$

    Candidates are rolled out without the objective's noise, from random starts where the task has them; one that is not
    finite is never elite. A step with fewer than `num_elite` finite ones is not taken.

    Args:
        objective: what to minimise; only its cost is used.
        params: the first $\mu$.
        key: as in `optimise`.
        num_samples: candidates, and so rollouts, per step.
        num_elite: the best of them that the fit is to. At least 2.
        num_steps: at most.
        stddev: the first $\sigma$, in the parameters' units; one number, or one per parameter. None takes the
            objective's noise, if that is on the parameters.
        keep: $\kappa \in [0, 1)$, share of the old fit.
        min_stddev: $\sigma$ is not let below it, lest the search freeze too early.
        **options: see `RunOptions`.

    Returns:
        As `optimise`; what belongs to gradients is NaN.

    Raises:
        ValueError: if a number is out of range or does not fit, or as in `optimise`.

    References:
        De Boer, Kroese, Mannor, Rubinstein. A tutorial on the cross-entropy method. Annals of Operations Research 134,
        2005, section 5 (continuous optimisation, with smoothing of the fit).
    """
    width = search_stddev(objective, params, stddev, num_samples)
    if not 2 <= num_elite <= num_samples:
        raise ValueError(f"num_elite must be at least 2 and at most num_samples = {num_samples}, got {num_elite}")
    if not 0 <= keep < 1:
        raise ValueError(f"keep must be at least 0 and below 1, got {keep}")
    if not min_stddev >= 0:
        raise ValueError(f"min_stddev must be at least 0, got {min_stddev}")
    method = CrossEntropy(objective, width, num_samples, num_elite, keep, min_stddev)
    return run(method, params, key, RunOptions(num_steps, **options))
