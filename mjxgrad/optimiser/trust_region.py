"""How far a step may go on the word of an estimate."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.objective import Objective, OpenLoop, ParameterNoise


class TrustRegion(eqx.Module):
    r"""Limit a step to where the estimate of the gradient can be believed.

    An estimate $g$ with bias at most $B$ describes the smoothed cost $F$ about as far as its noise reached, and less
    far the more of it may be bias. The step $s$, in units of the noise's standard deviation, is shortened to

    $$\lVert s \rVert \le \mathrm{radius} \cdot \max(0, 1 - B / \lVert g \rVert).$$

    What this guarantees. With $g = \nabla F + b$, $\lVert b \rVert \le B$,

    $$\langle g, \nabla F \rangle \ge \lVert g \rVert (\lVert g \rVert - B) > 0
      \quad\text{if } B < \lVert g \rVert,$$

    and no better bound exists: $b = B g / \lVert g \rVert$ meets it. So $-g$ is a descent direction as long as a step
    is allowed at all, and none is allowed when the bias may have turned it round. If $\nabla F$ has Lipschitz constant
    $L$, a step of length $t$ along $-g$ changes $F$ by at most
    $-t(\lVert g \rVert - B) + L t^2 / 2$, which is negative for $t < 2(\lVert g \rVert - B)/L$. With
    $t = r\,(1 - B/\lVert g \rVert)$ that is $r < 2\lVert g \rVert / L$, whatever $B$ is: a radius that is safe
    without bias stays safe with it. An optimiser that turns the step away from $-g$ keeps the limit, not the guarantee.
    Sampling error is not part of it: it averages out over steps, which bias does not.

    The length is the Euclidean one, not per root of dimension: in any one direction the noise reaches about one
    standard deviation however many others there are. Where nothing is known of the bias ($B$ is NaN) the radius alone
    limits.

    Attributes:
        radius: in standard deviations of the noise; positive.
        step_scale: the unit of length for each parameter, in the parameter's units. Needed where the noise is not on
            the parameters, as with a policy; None takes the noise's standard deviation.
    """

    radius: float = eqx.field(static=True)
    step_scale: Float[Array, "..."] | float | None = None

    def __check_init__(self):
        """Refuse a radius without meaning.

        Raises:
            ValueError: if it is not positive.
        """
        if not self.radius > 0:
            raise ValueError(f"radius must be positive, got {self.radius}")

    def limit(
        self,
        step: Float[Array, " dim"],
        gradient: Float[Array, " dim"],
        bias_bound: Float[Array, ""],
        objective: Objective,
    ) -> Float[Array, " dim"]:
        """Shorten a step where it is too long.

        Args:
            step: the change of the parameters.
            gradient: the estimate behind it, not clipped.
            bias_bound: on the norm of its bias; NaN where nothing is known.
            objective: whose noise gives the unit of length.

        Returns:
            The step or a shorter one in its direction.

        Raises:
            ValueError: if the objective's noise is not on the parameters and `step_scale` was not given.
        """
        unit = self.step_scale
        if unit is None:
            unit = parameter_stddev(objective, step.size)
        if unit is None:
            raise ValueError(
                f"step_scale must be given to TrustRegion for {type(objective).__name__}, whose noise is not on the "
                "parameters; write TrustRegion(radius, step_scale=...) in the parameters' units"
            )
        norm = jnp.linalg.norm(gradient)
        bound = jnp.nan_to_num(bias_bound, nan=0.0, posinf=jnp.inf)
        trusted = jnp.where(bound < norm, 1 - bound / jnp.where(norm > 0, norm, 1), 0)
        length = jnp.linalg.norm(step / unit)
        return step * jnp.minimum(1, self.radius * trusted / jnp.where(length > 0, length, 1)).astype(step.dtype)


def parameter_stddev(objective: Objective, dim: int) -> Float[Array, " dim"] | None:
    """Give the standard deviation of the noise on each parameter, or None if the noise is elsewhere.

    Args:
        objective: any.
        dim: number of parameters.

    Returns:
        In the parameters' units.
    """
    if isinstance(objective, OpenLoop):
        return jnp.ravel(jnp.broadcast_to(objective.stddev, objective.noise_shape))
    if isinstance(objective, ParameterNoise):
        return jnp.broadcast_to(objective.stddev, (dim,))
    return None


def clip(gradient: Float[Array, " dim"], most: float | None) -> Float[Array, " dim"]:
    """Shorten a gradient to a norm of at most `most`, keeping its direction.

    It is divided by its own norm. (Dividing by the threshold instead leaves it as long as it was, in other units.)

    Args:
        gradient: any.
        most: the largest norm; None leaves everything as it is.

    Returns:
        The gradient or a shorter one.
    """
    if most is None:
        return gradient
    norm = jnp.linalg.norm(gradient)
    return gradient * jnp.where(norm > most, most / jnp.where(norm > 0, norm, 1), 1).astype(gradient.dtype)
