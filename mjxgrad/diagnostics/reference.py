r"""The gradient of a smoothed objective, found without either estimator that is on trial.

For noise on a single parameter it is an integral over a line,

$$F'(\theta) = \int (f(x) - f(\theta)) \frac{x - \theta}{\sigma^2}
   \varphi\!\left(\frac{x - \theta}{\sigma}\right) \frac{dx}{\sigma},$$

so one sweep of $f$ serves every $\theta$. The line is cut into equal cells and $f$ evaluated at a random place in each:
unbiased for any $f$, jumps and the fine saw teeth of simulated impacts included, with an error that falls as 1/cells
at a jump and faster elsewhere. A quadrature on regular points would need a smooth $f$ to know its own error.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

# The Gaussian weight beyond six standard deviations is below 1e-7 of its peak.
REACH = 6.0


class Landscape(eqx.Module):
    """A cost along one parameter, at one random place, ascending, in each of many cells of one length."""

    points: Float[Array, " cells"]
    costs: Float[Array, "*batch cells"]
    cell: Float[Array, ""]

    def smoothed_gradient(
        self, params: Float[Array, ""], stddev: Float[Array, ""], centre: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Give the gradient of the smoothed cost, at least `REACH` standard deviations inside the landscape.

        With it a standard error that is rather too large than too small; both NaN if a cost that carries weight is not
        finite. The centre is a cost to compare with, such as that at `params` itself, not taken from these costs.
        """
        offset = (self.points - params) / stddev
        weight = offset / stddev * jax.scipy.stats.norm.pdf(offset) / stddev
        # Outside the reach a cost may be anything, also not finite.
        terms = jnp.where(jnp.abs(offset) <= REACH, (self.costs - centre) * weight, 0) * self.cell
        # Neighbouring cells differ by the variance within them and by their means, so this is on the safe side. Two
        # points per cell would give an unbiased one that mostly misses the only cell that matters: that of the jump.
        variance = (jnp.diff(terms) ** 2).sum(axis=-1) / 2
        return terms.sum(axis=-1), jnp.sqrt(variance)


def cell_points(
    key: PRNGKeyArray, low: Float[Array, ""], high: Float[Array, ""], num_cells: int
) -> tuple[Float[Array, " cells"], Float[Array, ""]]:
    """Draw one point in each of the equal cells of a line, ascending, and give the length of a cell."""
    cell = (high - low) / num_cells
    return low + cell * (jnp.arange(num_cells) + jax.random.uniform(key, (num_cells,), cell.dtype)), cell


def map_in_chunks(function: Callable, points: PyTree, chunk_size: int) -> PyTree:
    """Apply a function under `jax.vmap` to points with a leading axis, some at a time.

    `jax.lax.map` with a batch size would compile the function a second time for what remains over.
    """
    count = jax.tree.leaves(points)[0].shape[0]
    num_chunks = -(-count // chunk_size)
    size = -(-count // num_chunks)
    # The last chunk is filled up with points that there are already.
    indices = jnp.minimum(jnp.arange(num_chunks * size), count - 1)

    def one_chunk(indices: Array) -> PyTree:
        return jax.vmap(function)(jax.tree.map(lambda leaf: leaf[indices], points))

    results = jax.lax.map(one_chunk, indices.reshape(num_chunks, size))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], results)
