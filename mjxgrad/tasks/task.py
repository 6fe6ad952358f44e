"""What an objective needs of a thing to be controlled: how long, how many controls, a cost."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, PyTree

Policy = Callable[[PyTree, Any], Float[Array, " nu"]]


class Task(eqx.Module):
    """Anything that turns controls into a cost; its dynamics need not be MuJoCo's."""

    horizon: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @abstractmethod
    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
    ) -> tuple[Float[Array, ""], PyTree]:
        """Roll out once.

        Args:
            controls: what to apply at each step, or a policy from parameters and a state to
                what to apply.
            params: the policy's parameters.
            noise: added to the controls.

        Returns:
            The cost, NaN if the rollout diverged, and the states that the controls were chosen
            in, with a leading axis of `horizon`.
        """
