"""The nodes of a search tree, and how far a sample is from what each of them can reach."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjxgrad.planning.linear_model import LinearModel
from mjxgrad.planning.system import System


class Reach(eqx.Module):
    r"""What one step can reach around a state: an ellipsoid around c with the axes of B diag(r), r the reach of the controls.

    The distance of a change $e$ from its centre is $e^\top (B r r B^\top + \Gamma)^{-1} e$, with $\Gamma$ = diag(resolution²). A
    coordinate that does not count has infinite resolution, so that its inverse, the weight, is zero; and by Woodbury's identity
    only an m by m inverse is needed, one per set of weights.

    Attributes:
        c: the mean next state.
        B: of positions, times the reach of each control.
        inverse: (I + Bᵀ W B)⁻¹ for each set W of weights.
    """

    c: Float[Array, " state"]
    B: Float[Array, "p m"]
    inverse: Float[Array, "kinds m m"]

    def distance(
        self, system: System, sample: Float[Array, " state"], weights: Float[Array, "kinds p"], kind: Int[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, " m"]]:
        """Return the squared distance of a sample, and the control that leads there as far as one does, in units of the reach."""
        away = system.difference(sample, self.c)[: system.num_positions]
        weighted = weights[kind] * away
        pulled = self.B.T @ weighted
        control = self.inverse[kind] @ pulled
        return away @ weighted - pulled @ control, control


def reach(model: LinearModel, radius: Float[Array, " m"], weights: Float[Array, "kinds p"]) -> Reach:
    """Return what the controls reach according to a linear model.

    Args:
        model: of a step.
        radius: how far each control can go from where the model was made.
        weights: inverse squared resolution of each coordinate, 0 where it does not count; one row per kind of sample.
    """
    B = model.B[: weights.shape[1]] * radius
    gram = jnp.einsum("pm,kp,pn->kmn", B, weights, B)
    return Reach(model.c, B, jnp.linalg.inv(jnp.eye(B.shape[1], dtype=B.dtype) + gram))


class Nodes(eqx.Module):
    """Nodes with room for more, those from `size` on empty; or, without the leading axis, a single one.

    Attributes:
        states: of the system itself, each a true successor of its parent.
        controls: that led from the parent here.
        parents: −1 for the root.
        errors: distance from the goal in units of its tolerance, the largest over coordinates.
        reaches: of each node.
        size: how many nodes there are.
    """

    states: Float[Array, "*capacity state"]
    controls: Float[Array, "*capacity m"]
    parents: Int[Array, "*capacity"]
    errors: Float[Array, "*capacity"]
    reaches: Reach
    size: Int[Array, ""]

    @property
    def is_node(self) -> Bool[Array, " capacity"]:
        """Which places are taken."""
        return jnp.arange(len(self.parents)) < self.size

    @property
    def best(self) -> Int[Array, ""]:
        """The node nearest to the goal."""
        return jnp.argmin(jnp.where(self.is_node, self.errors, jnp.inf))

    def nearest(
        self, system: System, sample: Float[Array, " state"], weights: Float[Array, "kinds p"], kind: Int[Array, ""]
    ) -> Int[Array, ""]:
        """Return the node from whose reach a sample is least far."""
        distances, _ = jax.vmap(lambda one: one.distance(system, sample, weights, kind))(self.reaches)
        return jnp.argmin(jnp.where(self.is_node & jnp.isfinite(distances), distances, jnp.inf))

    def add(self, new: "Nodes", is_valid: Bool[Array, "*many"]) -> "Nodes":
        """Append nodes, in their order; those beyond the capacity are lost.

        Args:
            new: with leading axes as `is_valid`; a parent p below −1 is the new node −2 − p, counted over all axes.
            is_valid: which of them to keep. The parent of one that is kept must be kept.
        """
        valid = is_valid.ravel()
        many = valid.size
        places = jnp.where(valid, self.size + jnp.cumsum(valid) - 1, len(self.parents))
        parents = new.parents.ravel()
        parents = jnp.where(parents < -1, places[jnp.clip(-2 - parents, 0, many - 1)], parents)

        def put(old: Array, rows: Array) -> Array:
            return old.at[places].set(rows.reshape(many, *old.shape[1:]).astype(old.dtype), mode="drop")

        return Nodes(
            states=put(self.states, new.states),
            controls=put(self.controls, new.controls),
            parents=put(self.parents, parents),
            errors=put(self.errors, new.errors),
            reaches=jax.tree.map(put, self.reaches, new.reaches),
            size=jnp.minimum(self.size + valid.sum(), len(self.parents)),
        )


def planted(root: Nodes, capacity: int) -> Nodes:
    """Return a tree of one node with room for others.

    Args:
        root: the node, without leading axes.
        capacity: how many nodes there will be room for.
    """

    def spread(x: Array) -> Array:
        return jnp.zeros((capacity, *x.shape), x.dtype).at[0].set(x)

    rows = jax.tree.map(spread, root)
    return eqx.tree_at(lambda nodes: nodes.size, rows, jnp.asarray(1))


def lineage(parents: Int[np.ndarray, " capacity"], node: int) -> list[int]:
    """Return the nodes from the root to a node, both included; on the host."""
    line = [node]
    while parents[line[-1]] >= 0:
        line.append(int(parents[line[-1]]))
    return line[::-1]
