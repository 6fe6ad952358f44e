"""Networks with layer normalisation, running moments, and a value function in units of its targets."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

# The last layer starts a hundred times smaller than the others, so that the first actions are near zero and depend little on
# the state. Among initialisations this choice mattered most (Andrychowicz et al., arXiv:2006.05990, section 3.2).
FINAL_SCALE = 0.01


class Network(eqx.Module):
    """A multilayer perceptron whose hidden layers end in an exponential linear unit and layer normalisation.

    References:
        Xu et al. Accelerated Policy Learning with Parallel Differentiable Simulation. ICLR 2022, arXiv:2204.07137.
    """

    layers: tuple[eqx.nn.Linear, ...]
    norms: tuple[eqx.nn.LayerNorm, ...]

    @classmethod
    def make(
        cls, sizes: Sequence[int], key: PRNGKeyArray, *, hidden_scale: float = 1.0, final_scale: float = 1.0
    ) -> "Network":
        """Draw a network; `sizes` are the number of inputs, the sizes of the hidden layers, and the number of outputs.

        `hidden_scale` is a factor of the gains and offsets of the hidden layers. Normalisation undoes it in the output, but
        it changes the relative size of the optimiser's steps. `final_scale` is a factor of the gains of the last layer.
        """
        keys = jax.random.split(key, len(sizes) - 1)
        layers = [eqx.nn.Linear(m, n, key=k) for m, n, k in zip(sizes[:-1], sizes[1:], keys, strict=True)]
        *hidden, last = layers
        layers[:-1] = jax.tree.map(lambda x: hidden_scale * x, hidden)
        layers[-1] = eqx.tree_at(lambda x: (x.weight, x.bias), last, (final_scale * last.weight, jnp.zeros(sizes[-1])))
        return cls(tuple(layers), tuple(eqx.nn.LayerNorm(size) for size in sizes[1:-1]))

    def __call__(self, inputs: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        *hidden, last = self.layers
        for layer, norm in zip(hidden, self.norms, strict=True):
            inputs = norm(jax.nn.elu(layer(inputs)))
        return last(inputs)


class Normaliser(eqx.Module):
    """A normalisation of observations by the mean and variance of all so far, merged as in `estimators.moments`."""

    count: Float[Array, ""]
    mean: Float[Array, " obs"]
    squares: Float[Array, " obs"]

    @classmethod
    def make(cls, size: int) -> "Normaliser":
        """Return the normalisation without observations, the identity."""
        return cls(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size))

    def __call__(self, obs: Float[Array, "*rows obs"]) -> Float[Array, "*rows obs"]:
        return (obs - self.mean) / self.scale

    @property
    def scale(self) -> Float[Array, " obs"]:
        """Standard deviations; 1 for a number that never changes."""
        variance = jnp.where(self.count > 1, self.squares / jnp.maximum(self.count, 1), 1.0)
        return jnp.where(variance > 1e-8, jnp.sqrt(variance), 1.0)

    def of_first(self, number: int) -> "Normaliser":
        """Return the normalisation of the first numbers of an observation."""
        return Normaliser(self.count, self.mean[:number], self.squares[:number])

    def with_more(self, obs: Float[Array, "*batch obs"]) -> "Normaliser":
        """Return the normalisation with more observations; those that are not finite are left out."""
        rows = obs.reshape(-1, obs.shape[-1])
        is_sound = jnp.isfinite(rows).all(axis=1, keepdims=True)
        added = is_sound.sum().astype(self.count.dtype)
        rows = jnp.where(is_sound, rows, 0)
        mean = rows.sum(axis=0) / jnp.maximum(added, 1)
        squares = jnp.where(is_sound, (rows - mean) ** 2, 0).sum(axis=0)
        count, shift = self.count + added, mean - self.mean
        share = added / jnp.maximum(count, 1)
        return Normaliser(count, self.mean + share * shift, self.squares + squares + shift**2 * self.count * share)


class ValueFunction(eqx.Module):
    """A value function: a network whose output is in units of the returns seen so far, about their mean.

    Rewards of any size are then fitted at one learning rate.

    References:
        van Hasselt, Guez, Hessel, Mnih, Silver. Learning values across many orders of magnitude. NeurIPS 2016,
        arXiv:1602.07714 (Pop-Art).
    """

    network: Network
    moments: Normaliser

    @classmethod
    def make(cls, sizes: Sequence[int], key: PRNGKeyArray) -> "ValueFunction":
        """Draw a value function that is near zero; `sizes` as for `Network.make`, with one output."""
        return cls(Network.make(sizes, key, final_scale=FINAL_SCALE), Normaliser.make(1))

    def __call__(self, obs: Float[Array, " obs"]) -> Float[Array, ""]:
        """Return the value of a normalised observation."""
        return (self.moments.mean + self.moments.scale * self.network(obs))[0]

    def loss(self, obs: Float[Array, "rows obs"], targets: Float[Array, " rows"]) -> Float[Array, ""]:
        """Return the mean squared error over the variance of returns."""
        return ((jax.vmap(self.network)(obs)[:, 0] - self.moments(targets[:, None])[:, 0]) ** 2).mean()

    def with_more(self, targets: Float[Array, "*batch"]) -> "ValueFunction":
        """Return the same function in units that take more returns into account."""
        moments = self.moments.with_more(targets[..., None])
        last, share = self.network.layers[-1], self.moments.scale / moments.scale
        shift = (self.moments.mean - moments.mean) / moments.scale
        changed = jax.tree.map(lambda x: (share * x.T).T, last)
        changed = eqx.tree_at(lambda n: n.bias, changed, changed.bias + shift)
        return ValueFunction(eqx.tree_at(lambda n: n.layers[-1], self.network, changed), moments)
