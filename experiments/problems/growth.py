r"""Growth of derivatives with the horizon.

The derivative of a state with respect to an earlier one is the product of the step Jacobians between them. Its largest
singular value $s_t$ bounds every derivative of an outcome at $t$. Where motions diverge exponentially it grows as
$e^{\lambda t}$, and the variance of a first-order estimate as $e^{2 \lambda t}$. The cost bounds the variance of a
zeroth-order estimate.

References:
    Metz, Freeman, Schoenholz, Kachman. Gradients are Not All You Need. arXiv:2111.05803.
    Benettin, Galgani, Giorgilli, Strelcyn. Lyapunov characteristic exponents for smooth dynamical systems and for Hamiltonian
    systems; a method for computing all of them. Meccanica 15, 1980 (by repeated orthogonalisation).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Growth(eqx.Module):
    """The growth of a product of Jacobians with the number of factors.

    Attributes:
        log_largest: logarithm of the product's largest singular value, after each factor.
        log_stretches: logarithms of the stretches along orthogonal directions, in the limit of many factors the largest
            first. Divided by time they tend to the Lyapunov exponents. Their sum is the logarithm of the determinant.
    """

    log_largest: Float[Array, "*batch horizon"]
    log_stretches: Float[Array, "*batch horizon n"]

    def exponents(self, times: Float[Array, " horizon"]) -> Float[Array, "*batch horizon n"]:
        """Return the finite-time Lyapunov exponents (1/s) from the times after each factor (s)."""
        return self.log_stretches / times[:, None]


def growth(jacobians: Float[Array, "*batch horizon n n"]) -> Growth:
    """Multiply Jacobians of consecutive steps, the first one first; any number of factors without overflow."""
    if jacobians.ndim > 3:
        return jax.vmap(growth)(jacobians)
    identity = jnp.eye(jacobians.shape[-1], dtype=jacobians.dtype)

    def multiply(carry: tuple[Array, Array, Array, Array], factor: Array):
        product, log_size, frame, log_stretch = carry
        product = factor @ product
        size = jnp.linalg.norm(product)
        # A vanishing product has no direction; its logarithm stays minus infinity.
        product, log_size = product / jnp.where(size > 0, size, 1.0), log_size + jnp.log(size)
        frame, triangle = jnp.linalg.qr(factor @ frame)
        log_stretch = log_stretch + jnp.log(jnp.abs(jnp.diagonal(triangle)))
        largest = jnp.linalg.norm(product, ord=2)
        return (product, log_size, frame, log_stretch), (log_size + jnp.log(largest), log_stretch)

    zero = jnp.zeros((), jacobians.dtype)
    start = (identity, zero, identity, jnp.zeros(jacobians.shape[-1], jacobians.dtype))
    _, (log_largest, log_stretches) = jax.lax.scan(multiply, start, jacobians)
    return Growth(log_largest, log_stretches)
