"""A task with all that its paper says of how to optimise it, and what came out there."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
from jaxtyping import Array, Float, Int

from mjxgrad.objective import ActionNoise

Schedule = Callable[[Int[Array, ""] | int], Float[Array, ""] | float]


@dataclasses.dataclass(frozen=True)
class Published:
    """A task with its settings; those of the paper in `published.TASKS`, our own for a scene.

    The optimiser is plain gradient descent: params ← params − learning_rate · estimate.

    Attributes:
        name: of the task.
        objective: the cost under noise on the actions.
        params: where the optimisation starts.
        num_samples: rollouts per estimate.
        learning_rate: a number, or an optax schedule from the number of steps made.
        num_steps: of the optimiser.
        gamma: the bias that the α-order rule may accept.
        bound: L, what the α-order rule takes as the largest norm of one sample's zeroth-order gradient.
        reference: mean and standard deviation over seeds of the noise-free cost, at the "start" and at the end of
            "first", "zeroth", "alpha" and "ddcg"; NaN is a deviation that is not known.
        num_starts: over how many starts `final_cost` averages where they are random.
    """

    name: str
    objective: ActionNoise
    params: Float[Array, " dim"]
    num_samples: int
    learning_rate: float | Schedule
    num_steps: int
    gamma: float
    bound: float
    reference: Mapping[str, tuple[float, float]]
    num_starts: int = 1

    def final_cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Give the cost without action noise: from the nominal start, or the mean over a fixed set of random ones.

        Args:
            params: the point.
        """
        free = self.objective.zero_noise()
        actions, start = self.objective.split(free)
        if start is None:
            return self.objective.value(params, free)
        keys = jax.random.split(jax.random.key(0), self.num_starts)
        starts = jax.vmap(self.objective.task.sample_start)(keys)
        return jax.vmap(lambda x: self.objective.value(params, (actions, x)))(starts).mean()
