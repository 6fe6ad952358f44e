r"""Smoothed linear models of a step: the mean next state, over a little noise, as a linear function of state and control.

Around a state $x$ and a control $u$, with noise $w = (w_x, w_u) \sim N(0, \operatorname{diag} s^2)$, the mean step is

    E f(x + dx + w_x, u + du + w_u)  ≈  E f(x + w_x, u + w_u) + A dx + B du.

Sums of states are `System.retract`; the change on the left is taken from $f(x, u)$, in the coordinates of its tangent space.
Across a contact the mean is smooth even where f is not: A and B contain the effect of a push already before the touch.

There are three ways to this model. `Smoother.step` is its constant term.

- `Analytic` differentiates a step whose solver averages the contact force. The noise is on the distance of contacts, not on the
  state, and the acceleration is solved for after the average. It agrees with the mean above for impedances far below one.
- `Sampled` of first order averages derivatives over samples. It misses their blind spots: jumps of f, and with `mg.Discrete()`
  the shift of the time of an impact.
- `Sampled` of zeroth order fits a plane to samples of f. It misses nothing, at the price of noise.

Another way is a `Smoother` of your own.

References:
    Suh, Pang, Tedrake. Bundled Gradients through Contact via Randomized Smoothing. RA-L 2022, arXiv:2109.05143.
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic Contact
    Models. T-RO 2023, arXiv:2206.10787.
"""

import functools
from abc import abstractmethod
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from mjxgrad._arrays import Legible, instance, is_known, known, real, whole
from mjxgrad._text import name_pairs
from mjxgrad.planning.system import ControlVector, SceneSystem, StateVector, System, resting
from mjxgrad.stepping import Smoothing
from mjxgrad.stepping.smoothing import Mode

_Samples = Float[Array, "N both"]
_Changes = Float[Array, " both"]


class LinearModel(eqx.Module):
    """A linear model of a step; under `jax.vmap` every field gains leading axes.

    Attributes:
        A: derivative of the next state's change by the present state's; NaN, like all, if the step is not finite.
        B: derivative of the next state's change by the control.
    """

    A: Float[Array, "*steps n n"]
    B: Float[Array, "*steps n m"]


class Smoother(Legible):
    """A smoothed step with its derivative. The same key gives the same step, so that costs can be compared."""

    @abstractmethod
    def step(self, system: System, state: StateVector, control: ControlVector, key: PRNGKeyArray) -> StateVector:
        """Return the next state of the smoothed system."""

    @abstractmethod
    def linear_model(
        self, system: System, state: StateVector, control: ControlVector, key: PRNGKeyArray
    ) -> LinearModel:
        """Return the linear model of the smoothed system; the key is consumed."""

    def scaled(self, factor: ArrayLike) -> "Smoother":
        """Return the smoother with its arrays, which are lengths and standard deviations, multiplied by a factor."""
        return jax.tree.map(lambda length: factor * length, self)

    def steered(self, system: System) -> System | None:
        """Return the system to be stepped if it takes a whole trajectory in one call; otherwise None."""
        return None

    def warnings(self, system: System, start: StateVector) -> list[str]:
        """Return warnings about unwanted effects of this smoothing at a start; none for traced numbers."""
        return []


class Analytic(Smoother):
    """Contacts averaged in the solver, without sampling: the result does not depend on the key.

    Where C MuJoCo steps the scene, its margins are widened instead, so that nothing is compiled: see `SceneSystem.widened`.

    Attributes:
        smoothing: smoothing of contacts and limits; None is the system itself.
    """

    smoothing: Smoothing | None

    def __check_init__(self):
        instance("smoothing", self.smoothing, Smoothing | None, "such as mg.Smoothing(0.01), or None")

    def step(self, system, state, control, key):
        return self._smoothed(system, "forward").step(state, control)

    def linear_model(self, system, state, control, key):
        end, jacobian = (system := self._smoothed(system, "backward")).linearised(state, control)
        exists = jnp.all(jnp.isfinite(jacobian)) & jnp.all(jnp.isfinite(end))
        return LinearModel(*jnp.split(jnp.where(exists, jacobian, jnp.nan), [system.num_changes], axis=1))

    def steered(self, system: System) -> System | None:
        return smoothed if (smoothed := self._smoothed(system, "forward")).steers else None

    def _smoothed(self, system: System, mode: Mode) -> System:
        if self.smoothing is None:
            return system
        if not system.steers:
            return system.with_contact(self.smoothing)
        # Smoothing of the backward pass alone is in the linear models alone.
        return system.widened(self.smoothing.length) if self.smoothing.mode in ("forward", mode) else system

    def warnings(self, system: System, start: StateVector) -> list[str]:
        if self.smoothing is None or not isinstance(system, SceneSystem) or system.steers:
            return []
        given, pairs = system.scene.model, [pair for pair in system.scene.pairs if pair.condim > 1]
        if not all(is_known(x) for x in (start, given.geom_size, given.body_pos, given.geom_pos)):
            return []
        touching = {frozenset(geoms) for geoms in resting(system.scene.to_mujoco(), start[: given.nq]).tolist()}
        held = [pair for pair in pairs if {pair.geom1, pair.geom2} in touching]
        if not held:
            return []
        told = f"smoothing also reaches {name_pairs(held)}, which touch at the start: their friction then acts at a distance"
        return [f"{told}, and bodies that should slide or roll hardly move; for planning set their condim to 1"]


class Exact(Analytic):
    """No smoothing: the system itself."""

    smoothing: Smoothing | None = None


class Sampled(Smoother):
    """The mean over samples of noise on state and control, by whichever engine steps the system.

    Attributes:
        stddev_state: standard deviation of the noise on the state, a number or one per coordinate of a change; None is no noise.
        stddev_control: standard deviation of the noise on the control, a number or one per control.
        num_samples: number of samples. A smoothed step takes `1 + 2 num_samples` steps, a linear model `1 + num_samples`.
        order: "first" averages derivatives. "zeroth" fits a plane, to two samples more than noisy coordinates at least.
    """

    stddev_state: Float[Array, "..."] | None = eqx.field(
        converter=lambda x: x if x is None else real("stddev_state", x)
    )
    stddev_control: Float[Array, "..."] = eqx.field(converter=functools.partial(real, "stddev_control"))
    num_samples: int = eqx.field(static=True)
    order: Literal["first", "zeroth"] = eqx.field(static=True, default="zeroth")

    def __check_init__(self):
        whole("num_samples", self.num_samples)
        if self.order not in ("first", "zeroth"):
            raise ValueError(f"order must be 'first' or 'zeroth', got {self.order!r}")
        for name in ("stddev_state", "stddev_control"):
            value = None if (given := getattr(self, name)) is None else known(given)
            if value is not None and not ((value >= 0) & (value < np.inf)).all():
                raise ValueError(f"{name} must be at least 0 and finite, got {value}")

    def step(self, system, state, control, key):
        """Return the mean of the finite next states; samples have mirror images, so a linear step has no error."""
        stddev, unit = self._drawn(system, state, key)
        noise = stddev * unit
        nominal, value = _sampled(system, state, control, jnp.concatenate([noise, -noise]))
        return system.retract(nominal, _mean(value, jnp.all(jnp.isfinite(value), axis=1)))

    def linear_model(self, system, state, control, key):
        model = self._zeroth_order if self.order == "zeroth" else self._first_order
        jacobian = model(system, state, control, *self._drawn(system, state, key))
        return LinearModel(*jnp.split(jacobian, [system.num_changes], axis=1))

    def _first_order(
        self, system: System, state: StateVector, control: ControlVector, stddev: _Changes, unit: _Samples
    ) -> Float[Array, "n both"]:
        """Return the mean of the finite Jacobians of the samples, in the coordinates of the tangent space without noise."""
        n, zero, nominal = system.num_changes, jnp.zeros(stddev.size, state.dtype), system.step(state, control)

        def one(noise: _Changes) -> Float[Array, "n both"]:
            moved = lambda change: system.difference(system.retract(state, (noise + change)[:n]), start)  # noqa: E731
            start = system.retract(state, noise[:n])
            end, jacobian = system.linearised(start, control + noise[n:])
            # A step's derivative is in the tangent spaces at its own start and end, which turn with the noise of a rotation.
            both = jnp.concatenate([jax.jacfwd(moved)(zero), jnp.eye(stddev.size, dtype=state.dtype)[n:]])
            onward = (
                jax.jacfwd(lambda x: system.difference(system.retract(end, x), nominal))(zero[:n]) @ jacobian @ both
            )
            return jnp.where(jnp.all(jnp.isfinite(end)), onward, jnp.nan)

        jacobians = jax.vmap(one)(stddev * unit)
        is_finite = jnp.all(jnp.isfinite(jacobians), axis=(1, 2))
        return jnp.where(is_finite.any(), _mean(jacobians, is_finite), jnp.nan)

    def _zeroth_order(
        self, system: System, state: StateVector, control: ControlVector, stddev: _Changes, unit: _Samples
    ) -> Float[Array, "n both"]:
        """Return the slope of a plane fitted to samples of the step by least squares.

        It converges to the derivative of the mean (Stein's identity). Samples do not tell a column without noise: it is NaN.
        """
        first = system.num_changes if self.stddev_state is None else 0
        if self.num_samples < (least := unit.shape[1] - first + 2):
            raise ValueError(f"num_samples must be at least {least} for this system, got {self.num_samples}")
        _, value = _sampled(system, state, control, stddev * unit)
        is_finite = jnp.all(jnp.isfinite(value), axis=1)
        # In units of the noise the normal equations are well conditioned for any units of the coordinates.
        design = jnp.concatenate([jnp.ones((len(unit), 1), unit.dtype), unit[:, first:]], axis=1) * is_finite[:, None]
        # Too few finite samples make the equations singular. Ones on the diagonal keep them solvable; the result is NaN later.
        enough = is_finite.sum() >= least
        gram = design.T @ design + jnp.where(enough, 0.0, 1.0) * jnp.eye(least - 1, dtype=unit.dtype)
        slope = jnp.linalg.solve(gram, design.T @ jnp.where(is_finite[:, None], value, 0.0))[1:]
        is_seen = enough & (stddev[:, None] > 0)
        return jnp.where(
            is_seen, jnp.pad(slope, ((first, 0), (0, 0))) / jnp.where(is_seen, stddev[:, None], 1.0), jnp.nan
        ).T

    def _drawn(self, system: System, state: StateVector, key: PRNGKeyArray) -> tuple[_Changes, _Samples]:
        """Return the standard deviations of all coordinates of state and control, and normal samples in units of them."""
        parts = []
        for name, size in (("stddev_state", system.num_changes), ("stddev_control", system.num_controls)):
            value = jnp.asarray(0.0 if (given := getattr(self, name)) is None else given, state.dtype)
            if value.shape not in ((), (size,)):
                raise ValueError(f"{name} must be a number or have shape ({size},), got shape {value.shape}")
            parts.append(jnp.broadcast_to(value, (size,)))
        stddev = jnp.concatenate(parts)
        return stddev, jax.random.normal(key, (self.num_samples, stddev.size), state.dtype)


def _sampled(
    system: System, state: StateVector, control: ControlVector, noise: _Samples
) -> tuple[StateVector, Float[Array, "N n"]]:
    """Return the next state without noise, and the changes from it to the next states with noise."""
    n = system.num_changes
    perturbed = jax.vmap(lambda w: system.step(system.retract(state, w[:n]), control + w[n:]))
    ends = perturbed(jnp.pad(noise, ((1, 0), (0, 0))))
    return ends[0], jax.vmap(lambda end: system.difference(end, ends[0]))(ends[1:])


def _mean(samples: Float[Array, "N ..."], is_used: Bool[Array, " N"]) -> Float[Array, "..."]:
    used = is_used.reshape(-1, *[1] * (samples.ndim - 1))
    return jnp.where(used, samples, 0.0).sum(axis=0) / jnp.maximum(is_used.sum(), 1)
