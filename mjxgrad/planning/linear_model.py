r"""Smoothed linear models of a step: the mean next state, over a little noise, as a linear function of state and control.

Around a state $x$ and a control $u$, with noise $w = (w_x, w_u) \sim N(0, \operatorname{diag} s^2)$, the mean step is

    E f(x + dx + w_x, u + du + w_u)  ≈  E f(x + w_x, u + w_u) + A dx + B du.

Sums of states are `System.retract`; the change on the left is taken from $f(x, u)$, in the coordinates of its tangent space.
Across a contact the mean is smooth even where f is not: A and B contain the effect of a push already before the touch.

There are two ways to this model:

- `Sampled` fits a plane to samples of f. It misses nothing, at the price of noise.
- `Analytic` differentiates a step whose solver averages the contact force. The noise is on the distance of contacts, not on
  the state, and the acceleration is solved for after the average. It agrees with the other for impedances far below one.

References:
    Suh, Pang, Tedrake. Bundled Gradients through Contact via Randomized Smoothing. RA-L 2022, arXiv:2109.05143.
    Pang, Suh, Yang, Tedrake. Global Planning for Contact-Rich Manipulation via Local Smoothing of Quasi-dynamic Contact
    Models. T-RO 2023, arXiv:2206.10787 (the analytic way).
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from mjxgrad._arrays import is_known
from mjxgrad._text import name_pairs
from mjxgrad.planning.system import ControlVector, SceneSystem, StateVector, System
from mjxgrad.rollouts.arguments import native_motion
from mjxgrad.stepping import Smoothing

_Samples = Float[Array, "N both"]


class LinearModel(eqx.Module):
    """A linear model of a step; under `jax.vmap` every field gains leading axes.

    Attributes:
        A: derivative of the next state's change by the present state's; NaN, like all, if too few samples are finite.
        B: derivative of the next state's change by the control.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]


class Smoother(eqx.Module):
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

    def warnings(self, system: System, start: StateVector) -> list[str]:
        """Return warnings about unwanted effects of this smoothing at a start; none for traced numbers."""
        return []


class Analytic(Smoother):
    """Contacts averaged in the solver, without sampling: the result does not depend on the key.

    Attributes:
        smoothing: smoothing of contacts and limits; None is the system itself.
    """

    smoothing: Smoothing | None

    def step(self, system, state, control, key):
        return self._smoothed(system).step(state, control)

    def linear_model(self, system, state, control, key):
        native, system = self.native(system), self._smoothed(system)
        end, jacobian = _linearised(system, state, control) if native is None else native.linearised(state, control)
        return _model(system, jacobian, jnp.all(jnp.isfinite(jacobian)) & jnp.all(jnp.isfinite(end)))

    def native(self, system: System) -> SceneSystem | None:
        """Return the system to be stepped if C MuJoCo steps it, a whole trajectory in one call; otherwise None."""
        system = self._smoothed(system)
        if isinstance(system, SceneSystem) and native_motion(system.scene, system.contact) is not None:
            return system

    def _smoothed(self, system: System) -> System:
        return system if self.smoothing is None else system.with_contact(self.smoothing)

    def warnings(self, system: System, start: StateVector) -> list[str]:
        if self.smoothing is None or not isinstance(system, SceneSystem):
            return []
        given, pairs = system.scene.model, [pair for pair in system.scene.pairs if pair.condim > 1]
        if not all(is_known(x) for x in (start, given.geom_size, given.body_pos, given.geom_pos)):
            return []
        model = system.scene.to_mujoco()
        data = mujoco.MjData(model)
        data.qpos[:] = start[: model.nq]
        mujoco.mj_fwdPosition(model, data)
        is_fixed = model.body_weldid[model.geom_bodyid] == 0
        touching = {frozenset(geoms) for geoms in data.contact.geom.tolist() if is_fixed[geoms].any()}
        resting = [pair for pair in pairs if {pair.geom1, pair.geom2} in touching]
        if not resting:
            return []
        return [
            f"smoothing also reaches {name_pairs(resting)}, which touch at the start: their friction then acts at a distance, "
            "and bodies that should slide or roll hardly move; for planning set their condim to 1, or use Sampled"
        ]


class Exact(Analytic):
    """No smoothing: the system itself."""

    smoothing: Smoothing | None = None


class Sampled(Smoother):
    """The mean over samples of noise on state and control.

    Attributes:
        stddev_state: standard deviation of the noise on the state, a number or one per coordinate of a change.
        stddev_control: standard deviation of the noise on the control, a number or one per control.
        num_samples: number of samples. A smoothed step takes `1 + 2 num_samples` steps, a linear model `1 + num_samples`. The
            latter needs two samples more than there are coordinates.
    """

    stddev_state: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    stddev_control: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    num_samples: int = eqx.field(static=True)

    def step(self, system, state, control, key):
        """Return the mean of the finite next states; samples have mirror images, so a linear step has no error."""
        stddev, unit = self._drawn(system, state, key, least=1)
        noise = stddev * unit
        nominal, value = _sampled(system, state, control, jnp.concatenate([noise, -noise]))
        is_finite = jnp.all(jnp.isfinite(value), axis=1)
        return system.retract(nominal, _mean(value, is_finite))

    def linear_model(self, system, state, control, key):
        """Return the linear model from a plane fitted to samples of the step by least squares.

        Its slope converges to the derivative of the mean (Stein's identity). A column without noise is zero.
        """
        least = system.num_changes + system.num_controls + 2
        stddev, unit = self._drawn(system, state, key, least)
        _, value = _sampled(system, state, control, stddev * unit)
        is_finite = jnp.all(jnp.isfinite(value), axis=1)
        value = jnp.where(is_finite[:, None], value, 0.0)
        # In units of the noise the normal equations are well conditioned for any units of the coordinates.
        design = jnp.where(is_finite[:, None], jnp.concatenate([jnp.ones((self.num_samples, 1)), unit], axis=1), 0.0)
        # Too few finite samples make the equations singular. Ones on the diagonal keep them solvable; the result is NaN later.
        enough = is_finite.sum() >= least
        gram = design.T @ design + jnp.where(enough, 0.0, 1.0) * jnp.eye(least - 1)
        slope = jnp.linalg.solve(gram, design.T @ value)
        is_seen = stddev[:, None] > 0
        jacobian = jnp.where(is_seen, slope[1:] / jnp.where(is_seen, stddev[:, None], 1.0), 0.0).T
        return _model(system, jacobian, enough)

    def _drawn(
        self, system: System, state: StateVector, key: PRNGKeyArray, least: int
    ) -> tuple[Float[Array, " both"], _Samples]:
        """Return the standard deviations of all coordinates of state and control, and normal samples in units of them."""
        parts = []
        for name, size in (("stddev_state", system.num_changes), ("stddev_control", system.num_controls)):
            value = jnp.asarray(getattr(self, name), state.dtype)
            if value.shape not in ((), (size,)):
                raise ValueError(f"{name} must be a number or have shape ({size},), got shape {value.shape}")
            if not isinstance(value, jax.core.Tracer) and not (np.asarray(value) >= 0).all():
                raise ValueError(f"{name} must be at least 0 and finite, got {np.asarray(value)}")
            parts.append(jnp.broadcast_to(value, (size,)))
        if self.num_samples < least:
            raise ValueError(f"num_samples must be at least {least} for this system, got {self.num_samples}")
        stddev = jnp.concatenate(parts)
        return stddev, jax.random.normal(key, (self.num_samples, stddev.size), state.dtype)


def _perturbed(system: System, state: StateVector, control: ControlVector, noise: Float[Array, " both"]) -> StateVector:
    n = system.num_changes
    return system.step(system.retract(state, noise[:n]), control + noise[n:])


def _sampled(
    system: System, state: StateVector, control: ControlVector, noise: _Samples
) -> tuple[StateVector, Float[Array, "N n"]]:
    """Return the next state without noise, and the changes from it to the next states with noise."""
    ends = jax.vmap(lambda w: _perturbed(system, state, control, w))(jnp.pad(noise, ((1, 0), (0, 0))))
    return ends[0], jax.vmap(lambda end: system.difference(end, ends[0]))(ends[1:])


def _linearised(
    system: System, state: StateVector, control: ControlVector
) -> tuple[StateVector, Float[Array, "n both"]]:
    """Return the next state, and the derivative of its change by state and control."""

    def moved(change):
        end = _perturbed(system, state, control, change)
        return end, end

    jacobian, end = jax.jacfwd(moved, has_aux=True)(jnp.zeros(system.num_changes + system.num_controls, state.dtype))
    return end, jax.jacfwd(system.difference)(end, end) @ jacobian


def _mean(samples: Float[Array, "N ..."], is_used: Bool[Array, " N"]) -> Float[Array, "..."]:
    used = is_used.reshape(-1, *[1] * (samples.ndim - 1))
    return jnp.where(used, samples, 0.0).sum(axis=0) / jnp.maximum(is_used.sum(), 1)


def _model(system: System, jacobian: Float[Array, "n both"], exists: Bool[Array, ""]) -> LinearModel:
    """Return the linear model from a Jacobian by state and control; all NaN if it does not exist."""
    return LinearModel(*jnp.split(jnp.where(exists, jacobian, jnp.nan), [system.num_changes], axis=1))
