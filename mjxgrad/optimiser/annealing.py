"""How much the cost is smoothed by noise or contact while it is being optimised: less and less."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree


class Annealing(eqx.Module):
    """A scale in (0, 1] that an objective follows."""

    @abstractmethod
    def init(self, dtype: jnp.dtype) -> PyTree:
        """Give the state before the first step."""

    @abstractmethod
    def scale(self, state: PyTree, step: Int[Array, ""]) -> Float[Array, ""]:
        """Give the scale of a step."""

    @abstractmethod
    def update(self, state: PyTree, cost: Float[Array, ""], cost_error: Float[Array, ""]) -> PyTree:
        """Take note of the mean cost under noise, and its standard error, at a step."""


class Schedule(Annealing):
    """A scale that follows the number of the step, such as an optax schedule."""

    function: Callable[[ArrayLike], ArrayLike]

    def init(self, dtype: jnp.dtype) -> Float[Array, ""]:
        return jnp.zeros((), dtype)

    def scale(self, state: Float[Array, ""], step: Int[Array, ""]) -> Float[Array, ""]:
        return jnp.asarray(self.function(step), state.dtype)

    def update(self, state: Float[Array, ""], cost: Float[Array, ""], cost_error: Float[Array, ""]) -> Array:
        return state


class PlateauState(eqx.Module):
    """What `Plateau` keeps: the scale; of the present block the steps, their costs and squared standard errors summed up.

    `previous` is the mean cost of the block before, infinite if that had another scale, and the last its squared error.
    """

    scale: Float[Array, ""]
    count: Int[Array, ""]
    total: Float[Array, ""]
    total_square: Float[Array, ""]
    previous: Float[Array, ""]
    previous_square: Float[Array, ""]


class Plateau(Annealing):
    r"""Lower the scale when the mean cost under noise stops improving.

    Steps are taken in blocks of `patience`. With $c$ the mean cost of a block, $c'$ that of the block before and $e$ the
    standard error of their difference, the scale is multiplied by `factor` if

    $$c' - c \le \max(e, \mathrm{tolerance}\,|c'|).$$

    Blocks, because the lowest of many noisy costs keeps falling by luck alone. The costs are those that the estimates
    come with: watching them takes no rollout. After a change of scale the cost is another function, so the next
    comparison waits for two blocks at the new scale.

    Attributes:
        factor: in (0, 1).
        patience: steps in a block.
        tolerance: least relative improvement that counts.
        minimum: the scale is never below it; in (0, 1].
    """

    factor: float = eqx.field(static=True, default=0.5)
    patience: int = eqx.field(static=True, default=10)
    tolerance: float = eqx.field(static=True, default=0.0)
    minimum: float = eqx.field(static=True, default=0.01)

    def __check_init__(self):
        if not 0 < self.factor < 1:
            raise ValueError(f"factor must be between 0 and 1, got {self.factor}")
        if self.patience < 1:
            raise ValueError(f"patience must be at least 1, got {self.patience}")
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance must be at least 0, got {self.tolerance}")
        if not 0 < self.minimum <= 1:
            raise ValueError(f"minimum must be above 0 and at most 1, got {self.minimum}")

    def init(self, dtype: jnp.dtype) -> PlateauState:
        zero = jnp.zeros((), dtype)
        return PlateauState(jnp.ones((), dtype), jnp.zeros((), jnp.int32), zero, zero, zero + jnp.inf, zero)

    def scale(self, state: PlateauState, step: Int[Array, ""]) -> Float[Array, ""]:
        return state.scale

    def update(self, state: PlateauState, cost: Float[Array, ""], cost_error: Float[Array, ""]) -> PlateauState:
        count = state.count + 1
        total, total_square = state.total + cost, state.total_square + cost_error**2
        mean, square = total / self.patience, total_square / self.patience**2

        needed = jnp.maximum(jnp.sqrt(square + state.previous_square), self.tolerance * jnp.abs(state.previous))
        has_stalled = jnp.isfinite(state.previous) & (state.previous - mean <= needed)
        lowered = jnp.where(has_stalled, jnp.maximum(state.scale * self.factor, self.minimum), state.scale)
        is_changed = lowered != state.scale
        zero = jnp.zeros_like(total)
        judged = PlateauState(
            lowered,
            jnp.zeros_like(count),
            zero,
            zero,
            jnp.where(is_changed, jnp.inf, mean),
            jnp.where(is_changed, 0, square),
        )
        gathering = PlateauState(state.scale, count, total, total_square, state.previous, state.previous_square)
        return jax.tree.map(lambda full, not_yet: jnp.where(count == self.patience, full, not_yet), judged, gathering)


def as_annealing(annealing: Annealing | Callable[[ArrayLike], ArrayLike] | None) -> Annealing | None:
    """Wrap a schedule, refusing what is neither an annealing nor callable."""
    if annealing is None or isinstance(annealing, Annealing):
        return annealing
    if not callable(annealing):
        raise ValueError(
            f"annealing must be a Plateau or a schedule from step to scale, got {annealing!r}; "
            "for a fixed scale give the objective that scale"
        )
    return Schedule(annealing)
