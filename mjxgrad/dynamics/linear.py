"""Linear algebra of joint-space size, where the batch is large and the matrices are small."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

# Up to this many joint-space dimensions a sum of broadcast products beats the batched matrix product: XLA's CPU back end
# calls the latter once per matrix (256 matrices 24 × 12: 107 against 239 µs), and fuses the former.
_BROADCAST_UP_TO = 32


def gram(
    left: Float[Array, "rows nv"], right: Float[Array, "rows nv"]
) -> Float[Array, "nv nv"]:
    """Return leftᵀ right for a product known to be symmetric."""
    if left.shape[1] <= _BROADCAST_UP_TO:
        return jnp.sum(left[:, :, None] * right[:, None, :], axis=0)
    product = jnp.einsum("ri,rj->ij", left, right, precision="highest")
    return 0.5 * (product + product.T)


def solve_positive_definite(
    matrix: Float[Array, "nv nv"], vector: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Return matrix⁻¹ vector by Cholesky; non-finite where the matrix is not positive definite.

    Declared as a linear solve, so that its derivatives are solves too and none goes through the factorisation.
    """
    factor = jax.lax.stop_gradient(jsl.cho_factor(matrix, lower=True)[0])

    def solve(_, b):
        return jsl.cho_solve((factor, True), b)

    return jax.lax.custom_linear_solve(lambda x: matrix @ x, vector, solve, symmetric=True)
