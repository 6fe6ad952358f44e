r"""Objectives, the input of estimators: the interface, noise on parameters, and pytrees of parameters as a vector.

Noise smooths a cost: $F(\theta) = \mathbb{E}[f(\theta, w)]$. The score $s$ is the gradient of the log density of the noisy
quantity by $\theta$; it satisfies $\mathbb{E}[s] = 0$ and $\nabla F = \mathbb{E}[f s]$.
"""

import contextlib
import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad._arrays import function as check_function
from mjxgrad._arrays import instance, real, traceable, whole
from mjxgrad.objective.task import as_pytree

Scalar = Float[Array, ""]
Vector = Float[Array, " dim"]
"""The parameters, or one number for each."""
Stddev = float | Float[Array, "..."]

# Up to this number forward mode is faster. On the rollout of tasks/ball_wall (one parameter, 512 samples, 2 cores) it took
# 0.53 s and 7 s of compilation, reverse mode 1.7 s and 13 s. Each further parameter costs about one more forward pass.
MOST_FORWARD_DIMENSIONS = 3


class Differentiated(eqx.Module):
    r"""One rollout, differentiated by the noisy quantity $a = \mu_\theta + w$ in place of the parameters.

    `pull_back` is the transpose of $\partial\mu_\theta/\partial\theta$ at the states of this rollout. Terms can therefore be
    weighted by noise component (by step and action), and pulled back once at the end:

        pull_back(gradient_by_noise) = ∇_θ f(θ, w)    the first-order gradient of this sample
        pull_back(noise_score) = s(θ, w)              the score of this sample

    It is a pytree: `jax.vmap(lambda pull, x: pull(x))` applies it to a batch.

    Attributes:
        cost: cost of the rollout, NaN if it diverged.
        gradient_by_noise: total derivative of the cost by each component of the noise, flattened.
        noise_score: $w/\sigma^2$, flattened in the same order.
        noise_stddev: $\sigma$, flattened in the same order; NaN where it is not known.
        pull_back: linear map from shape (m,) to (dim,).
    """

    cost: Float[Array, "*batch"]
    gradient_by_noise: Float[Array, "*batch m"]
    noise_score: Float[Array, "*batch m"]
    noise_stddev: Float[Array, "*batch m"]
    pull_back: Partial


class Objective(eqx.Module):
    """A cost under noise, the input of estimators.

    A subclass gives `dim`, `sample_noise`, `value` and `score`. It overrides `value_and_score` if both come from one
    rollout, `mirror` and `zero_noise` if its noise is not symmetric about zero, and `differentiate`, `noise_shape` and
    `with_stddev` if it is Gaussian or not on the parameters.
    """

    dim: eqx.AbstractVar[int | None]

    @abstractmethod
    def sample_noise(self, key: PRNGKeyArray) -> PyTree:
        """Draw the noise of one rollout; the key is consumed."""

    @abstractmethod
    def value(self, params: Vector, noise: PyTree) -> Scalar:
        """Return the cost of one rollout, NaN if the rollout diverged."""

    @abstractmethod
    def score(self, params: Vector, noise: PyTree) -> Vector:
        """Return the gradient of the log density of the noisy quantity."""

    def value_and_score(self, params: Vector, noise: PyTree) -> tuple[Scalar, Vector]:
        """Return the cost and the score, from one rollout where the score depends on the states."""
        return self.value(params, noise), self.score(params, noise)

    def mirror(self, noise: PyTree) -> PyTree:
        """Return the mirror image of the noise, equally likely, for antithetic pairs."""
        return jax.tree.map(jnp.negative, noise)

    def redraw(self, noise: PyTree, key: PRNGKeyArray) -> PyTree:
        """Draw other noise under the same circumstances, such as the same random start."""
        return self.sample_noise(key)

    def silence(self, noise: PyTree) -> PyTree:
        """Return zero noise under the same circumstances, such as the same random start."""
        return self.zero_noise()

    @property
    def has_circumstances(self) -> bool:
        """Whether anything else than the noise is random, such as the start; derivatives do not explain its effect."""
        return False

    def zero_noise(self) -> PyTree:
        """Return zero noise, under nominal circumstances."""
        shapes = jax.eval_shape(self.sample_noise, jax.random.key(0))
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the noisy quantity that `differentiate` flattens: (dim,), or (horizon, nu)."""
        if self.dim is None:
            raise ValueError("dim is not known: pass dim=... to parameter_noise, or call objective.sized_for(params)")
        return (self.dim,)

    def differentiate(self, params: Vector, noise: PyTree) -> Differentiated:
        """Roll out once and differentiate by the noisy quantity; by default, by the parameters themselves.

        Both identities of `Differentiated` then hold for any noise. Its standard deviation is not known, and NaN.
        """
        (cost, score), gradient = value_and_gradient(lambda at: self.value_and_score(at, noise), params, has_aux=True)
        return Differentiated(cost, gradient, score, jnp.full_like(gradient, jnp.nan), Partial(unchanged))

    def with_stddev(self, stddev: Stddev) -> "Objective":
        """Return the objective with another standard deviation of the same units and shape; traceable, for schedules.

        Raises:
            ValueError: if the noise has no standard deviation, or `stddev` is not positive or of the wrong shape.
        """
        raise ValueError(
            f"{type(self).__name__} must have a stddev to change, got one without; override with_stddev in it"
        )

    def sized_for(self, params: Vector) -> "Objective":
        """Return the objective with `dim` set by the parameters.

        Raises:
            ValueError: if `params` is not a vector of floating-point numbers, or not of length `dim`.
        """
        shape = jnp.shape(params)
        check_vector(shape, jnp.result_type(params))
        if self.dim is None:
            return dataclasses.replace(self, dim=shape[0])
        if shape[0] != self.dim:
            raise ValueError(f"params must have shape ({self.dim},), got {shape}")
        return self


def check_vector(shape: tuple[int, ...], dtype: jnp.dtype) -> None:
    """Refuse all but vectors of floating-point numbers as parameters."""
    if len(shape) != 1:
        raise ValueError(
            f"params must be a vector of shape (dim,), got shape {shape}; "
            "use jnp.atleast_1d for one number, objective.ravel for controls"
        )
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"params must be floating-point, got {dtype}; write 1.0 in place of 1")
    if not shape[0]:
        raise ValueError("params must have at least one number, got none")


def unchanged(vector: Float[Array, "*seeds dim"]) -> Float[Array, "*seeds dim"]:
    """Return the vector unchanged: the pull-back where the noise is on the parameters."""
    return vector


def as_objective(objective: Any) -> Objective:
    """Return an objective unchanged; raise a ValueError for anything else."""
    remedy = "wrap a function by mg.parameter_noise, or give optimise annealing= with a function from a scale to an objective"
    instance("objective", objective, Objective, f"an Objective ({remedy})")
    return objective


def as_scalar(value: Any, name: str) -> Scalar:
    """Return a number, integer or real, as a floating-point scalar; raise a ValueError for anything else."""
    if not eqx.is_array_like(value):
        raise ValueError(f"{name} must return one number, got {type(value).__name__}")
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must return a scalar of shape (), got shape {jnp.shape(value)}")
    if jnp.iscomplexobj(value):
        raise ValueError(f"{name} must return a real number, got {jnp.result_type(value)}")
    return jnp.asarray(value, jnp.result_type(value, float))


def value_and_gradient(
    function: Callable[[Vector], Any], point: Vector, *, has_aux: bool = False
) -> tuple[Any, Vector]:
    """Differentiate as `jax.value_and_grad` does, in forward mode up to three dimensions if the function has one."""

    def both(at: Vector) -> tuple[Scalar, Any]:
        with traceable("function"):
            found = function(at)
        value = as_scalar(found[0] if has_aux else found, "function")
        return value, (value, found[1]) if has_aux else value

    if point.size <= MOST_FORWARD_DIMENSIONS:
        with contextlib.suppress(TypeError):  # jax.custom_vjp has no forward mode; any other is raised again below
            return jax.jacfwd(both, has_aux=True)(point)[::-1]
    return jax.grad(both, has_aux=True)(point)[::-1]


def gaussian(key: PRNGKeyArray, stddev: Float[Array, "..."], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Draw Gaussian noise of a shape that `stddev` broadcasts to."""
    return stddev * jax.random.normal(key, shape, stddev.dtype)


def positive(stddev: Stddev) -> Float[Array, "..."]:
    """Return the standard deviation as an array; raise a ValueError if it is known and not positive."""
    stddev = real("stddev", stddev)
    stddev = jnp.asarray(stddev, jnp.result_type(stddev, float))
    # A traced value (a noise schedule, a sweep) cannot be checked here.
    if not isinstance(stddev, jax.core.Tracer) and not bool(((stddev > 0) & (stddev < jnp.inf)).all()):
        raise ValueError(f"stddev must be positive and finite, got {stddev}")
    return stddev


class ParameterNoise(Objective):
    r"""$f(\theta + w)$ with $w \sim N(0, \mathrm{stddev}^2)$ on the parameters; see `parameter_noise`."""

    function: Callable[[Any], Scalar]
    stddev: Float[Array, " *dim"]
    dim: int | None = eqx.field(static=True)

    def sample_noise(self, key: PRNGKeyArray) -> Vector:
        return gaussian(key, self.stddev, self.noise_shape)

    def value(self, params: Vector, noise: Vector) -> Scalar:
        with traceable("function"):
            found = self.function(params + noise.astype(params.dtype))
        return as_scalar(found, "function")

    def score(self, params: Vector, noise: Vector) -> Vector:
        return (noise / self.stddev**2).astype(params.dtype)

    def differentiate(self, params: Vector, noise: Vector) -> Differentiated:
        cost, gradient = value_and_gradient(self.function, params + noise.astype(params.dtype))
        stddev = jnp.broadcast_to(self.stddev, params.shape).astype(params.dtype)
        return Differentiated(cost, gradient, self.score(params, noise), stddev, Partial(unchanged))

    def with_stddev(self, stddev: Stddev) -> "ParameterNoise":
        return parameter_noise(self.function, stddev, self.dim)


def parameter_noise(
    function: Callable[[Any], Scalar], stddev: float | Float[Array, "*dim"], dim: int | None = None
) -> ParameterNoise:
    r"""Smooth any function of parameters by Gaussian noise on them.

    $F(\theta) = \mathbb{E}[f(\theta + w)]$, $w \sim N(0, \sigma^2 I)$, with score $w/\sigma^2$. The function, of a vector or of
    the pytree of parameters, is traceable. $\sigma > 0$ is in the parameters' units, one number or one per parameter. Their
    number `dim` is needed only to draw noise by hand: an estimator takes it from its parameters.

    Raises:
        ValueError: if `stddev` is not positive, or neither one number nor `dim` of them.
    """
    check_function("function", function, "params", is_needed=True)
    dim, width = None if dim is None else whole("dim", dim), positive(stddev)
    if width.ndim > 1 or (width.ndim == 1 and dim not in (None, width.shape[0])):
        raise ValueError(f"stddev must be one number or {dim or 'dim'}, got shape {width.shape}")
    dim = width.shape[0] if width.ndim == 1 else dim
    return ParameterNoise(function=as_pytree(function), stddev=width, dim=dim)


class Restored(eqx.Module):
    """A function of a pytree of parameters, as a function of their vector."""

    function: Callable[[PyTree], Any]
    restore: Callable[[Vector], PyTree] = eqx.field(static=True)

    def __call__(self, vector: Vector) -> Any:
        return self.function(self.restore(vector))


def flattened(params: PyTree, num_axes: int = 1) -> tuple[Float[Array, "..."], Callable[[Float[Array, "..."]], PyTree]]:
    """Return the floating-point arrays of a pytree as a vector, with its inverse, also for one per seed; a vector unchanged.

    An array with more axes than a vector, or than one vector per seed, is a pytree, too: controls by step and actuator.
    """
    if eqx.is_array_like(params) and jnp.ndim(params) <= num_axes:
        return jnp.asarray(params), unchanged
    # `is_inexact_array_like` calls a tracer's `__jax_array__`, which is None (jax 0.10.2, equinox 0.13.8).
    is_parameter = lambda x: eqx.is_inexact_array(x) if eqx.is_array(x) else eqx.is_inexact_array_like(x)  # noqa: E731
    arrays, others = eqx.partition(params, is_parameter)
    vector, unravel = ravel_pytree(arrays)
    if vector.size == 0:
        raise ValueError(f"params must have floating-point arrays, got none in {params}; write 1.0 in place of 1")

    def restore(vector: Float[Array, "..."]) -> PyTree:
        return eqx.combine(jax.vmap(unravel)(vector) if vector.ndim == 2 else unravel(vector), others)

    return vector, restore


def of_vector(objective: Any, restore: Callable[[Vector], PyTree]) -> Any:
    """Return an objective, or a function from a scale to one, that takes the vector of `flattened`.

    An objective with noise on actions is unchanged: it takes a vector already, and restores its policy's parameters itself.
    """
    if isinstance(objective, ParameterNoise):
        return dataclasses.replace(objective, function=Restored(objective.function, restore))
    return (lambda scale: of_vector(objective(scale), restore)) if callable(objective) else objective


def as_vector(objective: Objective, params: PyTree) -> tuple[Objective, Vector, Callable[[Vector], PyTree]]:
    """Return an objective of a vector, sized for it, the vector, and the map from a gradient to the parameters' form."""
    vector, restore = flattened(params)
    objective = of_vector(as_objective(objective), restore).sized_for(vector)
    return objective, vector, lambda gradient: eqx.filter(restore(gradient), eqx.is_inexact_array)
