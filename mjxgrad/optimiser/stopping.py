"""Whether a run has converged."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad.optimiser.result import Record


class Convergence(eqx.Module):
    r"""Stop a run that has converged, judged over a window of steps by what the estimates say of themselves.

    - `gradient`: stop when $\overline{\lVert g \rVert^2} - \overline{\lVert e \rVert^2} \le
      \mathrm{gradient}^2\,\overline{\lVert e \rVert^2}$, bars being means over the last `window` steps, $g$ the
      estimates and $e$ their standard errors. As $\mathbb{E}\lVert g \rVert^2 = \lVert\mathbb{E} g\rVert^2 +
      \mathbb{E}\lVert e \rVert^2$, the left side estimates the squared norm of the true gradient. A single norm would
      not do: it does not vanish where the gradient does.
    - `cost`: stop when the mean cost under noise of the last `window` steps is below that of the window before by no
      more than `cost` times the latter's magnitude.

    With both, either stops. Costs under different smoothing are not comparable, so a change of scale begins anew, as if
    no step had been taken; steps that were not taken do not count.

    Attributes:
        window: number of steps.
        gradient: norm of the gradient in units of its own error; None does not look at it.
        cost: relative improvement of the cost; None does not look at it.
    """

    window: int = eqx.field(static=True, default=20)
    gradient: float | None = eqx.field(static=True, default=None)
    cost: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.window < 2:
            raise ValueError(f"window must be at least 2, got {self.window}")
        if self.gradient is None and self.cost is None:
            raise ValueError("Convergence must be given gradient, cost or both, got neither")
        for name in ("gradient", "cost"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"{name} must be at least 0, got {value}")


class Recent(eqx.Module):
    """What convergence is judged by: the last two windows of steps, the oldest first, NaN where there is none yet.

    Squares are those of the norm of the gradient, errors of its standard error.
    """

    costs: Float[Array, " both"]
    squares: Float[Array, " both"]
    errors: Float[Array, " both"]
    scale: Float[Array, ""]

    @classmethod
    def empty(cls, convergence: Convergence | None, dtype: jnp.dtype) -> "Recent":
        """Begin without steps; without room for any if nothing is to be judged."""
        nothing = jnp.full(0 if convergence is None else 2 * convergence.window, jnp.nan, dtype)
        return cls(nothing, nothing, nothing, jnp.full((), jnp.nan, dtype))

    def push(self, record: Record) -> "Recent":
        """Add a step if it was taken, forgetting all before if the scale is another."""
        is_same = record.scale == self.scale

        def pushed(old: Float[Array, " both"], new: Float[Array, ""]) -> Float[Array, " both"]:
            kept = jnp.where(is_same, old, jnp.nan)
            return jnp.where(record.is_taken, jnp.append(kept[1:], new), old) if old.size else old

        return Recent(
            pushed(self.costs, record.cost),
            pushed(self.squares, record.gradient_norm**2),
            pushed(self.errors, record.gradient_error**2),
            jnp.where(record.is_taken, record.scale, self.scale),
        )


def has_converged(convergence: Convergence | None, recent: Recent) -> Bool[Array, ""]:
    """Say whether to stop; while the windows are not full, comparisons with NaN say no."""
    result = jnp.zeros((), bool)
    if convergence is None:
        return result
    window = convergence.window
    if convergence.gradient is not None:
        square, error = recent.squares[window:].mean(), recent.errors[window:].mean()
        result |= square - error <= convergence.gradient**2 * error
    if convergence.cost is not None:
        before, now = recent.costs[:window].mean(), recent.costs[window:].mean()
        result |= before - now <= convergence.cost * jnp.abs(before)
    return result
