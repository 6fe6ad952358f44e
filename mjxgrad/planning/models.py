"""Which smoothed step a planner sees, and how its linear model is found."""

from abc import abstractmethod
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from mjxgrad.dynamics import Smoothing
from mjxgrad.planning import linear_model
from mjxgrad.planning.linear_model import LinearModel
from mjxgrad.planning.system import System


class Smoother(eqx.Module):
    """A smoothed step and its derivative. The same key gives the same step, so that costs can be compared."""

    @abstractmethod
    def step(
        self, system: System, state: Float[Array, " state"], control: Float[Array, " m"], key: PRNGKeyArray
    ) -> Float[Array, " state"]:
        """Return the next state of the smoothed system."""

    @abstractmethod
    def linear_model(
        self,
        system: System,
        state: Float[Array, " state"],
        control: Float[Array, " m"],
        key: PRNGKeyArray,
        *,
        wrt_state: bool = True,
    ) -> LinearModel:
        """Return the linear model of the smoothed system."""

    @abstractmethod
    def scaled(self, factor: ArrayLike) -> "Smoother":
        """Give the smoother with its lengths and standard deviations multiplied."""


class Exact(Smoother):
    """No smoothing: the system as it is."""

    def step(
        self, system: System, state: Float[Array, " state"], control: Float[Array, " m"], key: PRNGKeyArray
    ) -> Float[Array, " state"]:
        """Return the next state."""
        return system.step(state, control)

    def linear_model(
        self,
        system: System,
        state: Float[Array, " state"],
        control: Float[Array, " m"],
        key: PRNGKeyArray,
        *,
        wrt_state: bool = True,
    ) -> LinearModel:
        """Return the derivative of the step."""
        return linear_model.analytic(system, state, control, wrt_state=wrt_state)

    def scaled(self, factor: ArrayLike) -> "Exact":
        """Give the same."""
        return self


class Analytic(Smoother):
    """Contacts averaged in the solver; without sampling, so each key gives the same.

    Attributes:
        smoothing: of contacts and limits.
    """

    smoothing: Smoothing

    def step(
        self, system: System, state: Float[Array, " state"], control: Float[Array, " m"], key: PRNGKeyArray
    ) -> Float[Array, " state"]:
        """Return the next state of the smoothed contacts."""
        return system.with_smoothing(self.smoothing).step(state, control)

    def linear_model(
        self,
        system: System,
        state: Float[Array, " state"],
        control: Float[Array, " m"],
        key: PRNGKeyArray,
        *,
        wrt_state: bool = True,
    ) -> LinearModel:
        """Return the derivative of the smoothed step."""
        return linear_model.analytic(system.with_smoothing(self.smoothing), state, control, wrt_state=wrt_state)

    def scaled(self, factor: ArrayLike) -> "Analytic":
        """Give the smoother with other lengths."""

        def lengths(smoothing: Smoothing) -> list[Any]:
            both = (smoothing.length, smoothing.limit_length)
            return [length for length in both if length is not None]

        return Analytic(eqx.tree_at(lengths, self.smoothing, [factor * length for length in lengths(self.smoothing)]))


class Sampled(Smoother):
    """The mean over samples of noise on state and control.

    Attributes:
        stddev_state: of the noise on the state, a number or one per coordinate of a change.
        stddev_control: of the noise on the control, a number or one per control.
        num_samples: per step and linear model; in all `1 + 2 num_samples` steps for a step, `1 + num_samples` for a model.
        order: "first" averages Jacobians, "zeroth" fits a plane.
    """

    stddev_state: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    stddev_control: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    num_samples: int = eqx.field(static=True)
    order: Literal["first", "zeroth"] = eqx.field(static=True, default="zeroth")

    def __check_init__(self):
        if self.order not in ("first", "zeroth"):
            raise ValueError(f"order must be 'first' or 'zeroth', got {self.order!r}")

    def step(
        self, system: System, state: Float[Array, " state"], control: Float[Array, " m"], key: PRNGKeyArray
    ) -> Float[Array, " state"]:
        """Return the mean next state."""
        return linear_model.mean_step(
            system,
            state,
            control,
            key,
            stddev_state=self.stddev_state,
            stddev_control=self.stddev_control,
            num_samples=self.num_samples,
        )

    def linear_model(
        self,
        system: System,
        state: Float[Array, " state"],
        control: Float[Array, " m"],
        key: PRNGKeyArray,
        *,
        wrt_state: bool = True,
    ) -> LinearModel:
        """Return the linear model from samples."""
        noise = {"stddev_state": self.stddev_state, "stddev_control": self.stddev_control}
        if self.order == "zeroth":
            return linear_model.zeroth_order(system, state, control, key, num_samples=self.num_samples, **noise)
        return linear_model.first_order(
            system, state, control, key, num_samples=self.num_samples, wrt_state=wrt_state, **noise
        )

    def scaled(self, factor: ArrayLike) -> "Sampled":
        """Give the smoother with other standard deviations."""
        return Sampled(factor * self.stddev_state, factor * self.stddev_control, self.num_samples, self.order)
