r"""Moments of samples that arrive in chunks, merged without cancellation.

A summary is a pytree of moments and of sums; with all leaves zero it is the summary of no samples. Moments are about the
mean of the samples so far, never about zero: costs of 1e6 ± 1 would otherwise lose their variance in float32.

References:
    Chan, Golub, LeVeque. Updating formulae and a pairwise algorithm for computing sample
    variances. COMPSTAT 1982, equation 2.1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class Moments(eqx.Module):
    """Count, mean, and sum of squared deviations.

    The mean is kept as one of the samples, the origin, and an offset from it. A single float32 number would be off by 0.03
    for costs of 1e6, too much for a small spread.
    """

    count: Int[Array, ""]
    origin: Float[Array, "*shape"]
    offset: Float[Array, "*shape"]
    squares: Float[Array, "*shape"]

    @classmethod
    def of(cls, samples: Float[Array, "units *shape"], mask: Bool[Array, " units"]) -> "Moments":
        """Summarise the samples that the mask picks; the others may be NaN."""
        count = mask.sum()
        origin = _masked(samples, mask)[jnp.argmax(mask)]
        samples = _masked(samples - origin, mask)
        offset = samples.sum(axis=0) / as_real(jnp.maximum(count, 1), samples)
        return cls(count, origin, offset, (_masked(samples - offset, mask) ** 2).sum(axis=0))

    @property
    def mean(self) -> Float[Array, "*shape"]:
        """The mean, rounded."""
        return self.origin + self.offset

    def above(self, centre: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Return the mean minus a centre, without rounding the mean first."""
        return (self.origin - centre) + self.offset

    def merge(self, other: "Moments") -> "Moments":
        count = self.count + other.count
        origin = jnp.where(self.count > 0, self.origin, other.origin)
        theirs = other.above(origin)
        mine = jnp.where(self.count > 0, self.offset, theirs)
        share = as_real(other.count, mine) / as_real(jnp.maximum(count, 1), mine)
        squares = self.squares + other.squares + (theirs - mine) ** 2 * self.count * share
        return Moments(count, origin, mine + (theirs - mine) * share, squares)

    def variance(self) -> Float[Array, "*shape"]:
        """Return the variance, with N − 1; zero for fewer than two samples."""
        return self.squares / as_real(jnp.maximum(self.count - 1, 1), self.squares)

    def squared_error(self) -> Float[Array, "*shape"]:
        """Return the squared standard error of the mean, NaN for fewer than two samples."""
        count = as_real(self.count, self.squares)
        return jnp.where(count > 1, self.squares / jnp.maximum(count * (count - 1), 1), jnp.nan)


class ScoreMoments(eqx.Module):
    r"""Joint moments of costs and scores that leave the choice of the baseline to the end.

    A unit is one sample or an antithetic pair. With costs $f_j$ and scores $s_j$ in a unit and a centre $c$, its
    features are $u = \mathrm{mean}_j((f_j - c) s_j)$, $p = (\bar f - c)\bar s$ and $\bar s$; bars are means within the
    unit. Moving the centre acts on them linearly: $u \to u + \bar s\,\Delta$, $p \to p + \bar s\,\Delta$. Sums of features
    and of their products about any centre therefore follow from sums about another. About the mean they merge without
    cancellation; about zero or the noise-free cost they give the other baselines.
    """

    costs: Moments  # moments of f̄, whose mean is the centre
    first: Float[Array, "3 dim"]  # sums of (u, p, s̄)
    second: Float[Array, "3 3 dim"]  # sums of their products

    @classmethod
    def of(
        cls,
        costs: Float[Array, "units rollouts"],
        scores: Float[Array, "units rollouts dim"],
        mask: Bool[Array, " units"],
    ) -> "ScoreMoments":
        """Summarise the units that the mask picks; the others may be NaN."""
        scores = _masked(scores, mask)
        summary = Moments.of(costs.mean(axis=1), mask)
        centred = _masked((costs - summary.origin) - summary.offset, mask)
        product = (centred[..., None] * scores).mean(axis=1)
        mean_score = scores.mean(axis=1)
        product_of_means = centred.mean(axis=1)[:, None] * mean_score
        features = jnp.stack([product, product_of_means, mean_score])
        # Elementwise, not einsum: a matrix product may be in TF32 on a GPU.
        second = (features[:, None] * features[None, :]).sum(axis=2)
        return cls(summary, features.sum(axis=1), second)

    def merge(self, other: "ScoreMoments") -> "ScoreMoments":
        costs = self.costs.merge(other.costs)
        mine = self.moved(self.costs.above(costs.origin) - costs.offset)
        theirs = other.moved(other.costs.above(costs.origin) - costs.offset)
        return ScoreMoments(costs, mine[0] + theirs[0], mine[1] + theirs[1])

    def moved(self, shift: Float[Array, ""]) -> tuple[Float[Array, "3 dim"], Float[Array, "3 3 dim"]]:
        """Return the sums of the features, and of their products, about a centre that lies below the mean by the shift."""
        return _shifted(self.first, shift, 0), _shifted(_shifted(self.second, shift, 0), shift, 1)


def merged(one: PyTree, other: PyTree) -> PyTree:
    """Return the summary of both sets of samples: moments are merged, all other leaves added."""

    def has_merge(leaf: PyTree) -> bool:
        return isinstance(leaf, Moments | ScoreMoments)

    return jax.tree.map(lambda x, y: x.merge(y) if has_merge(x) else x + y, one, other, is_leaf=has_merge)


def as_real(count: Int[Array, "*batch"], like: Float[Array, "..."]) -> Float[Array, "*batch"]:
    """Return a count as a float of the type of `like`; a quotient of integers would have double precision."""
    return count.astype(like.dtype)


def _shifted(sums: Float[Array, "..."], shift: Float[Array, ""], axis: int) -> Float[Array, "..."]:
    """Add the shift times the mean score to the two other features."""
    product, product_of_means, score = jnp.moveaxis(sums, axis, 0)
    moved = jnp.stack([product + shift * score, product_of_means + shift * score, score])
    return jnp.moveaxis(moved, 0, axis)


def _masked(samples: Float[Array, "units ..."], mask: Bool[Array, " units"]) -> Float[Array, "..."]:
    return jnp.where(mask.reshape(-1, *[1] * (samples.ndim - 1)), samples, 0)
