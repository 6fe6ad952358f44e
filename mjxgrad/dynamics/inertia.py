r"""The mass matrix as a linear map: applied without being formed.

M a is the force that gives the bodies of a tree the accelerations that joint accelerations a make of them: sums over
ancestors, a product with each body's inertia, sums over descendants, as in `kinematics.rne`. Its derivative is of the same
kind, where that of the matrix is a matrix.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import spatial, tree
from mjxgrad.dynamics.spatial import combine, contract


class Bodies(eqx.Module):
    """Bodies in motion.

    Attributes:
        inertia: of each body about the centre of mass of its tree, as MuJoCo keeps it.
        axes: motion of unit joint velocities about it.
        armature: inertia of the joints' drives (kg or kg m²).
        moves: for each body the joint velocities that move it.
    """

    inertia: Float[Array, "nbody 10 *batch"]
    axes: Float[Array, "nv 6 *batch"]
    armature: Float[Array, "nv *batch"]
    moves: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def apply(self, acceleration: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Return M a."""
        moves = np.zeros((len(self.moves), len(self.axes)))
        for row, dofs in zip(moves, self.moves, strict=True):
            row[list(dofs)] = 1
        motion = combine(moves, spatial.scale(acceleration, self.axes))
        force = spatial.momentum(self.inertia, motion)
        return spatial.dot(self.axes, combine(moves.T, force)) + self.armature * acceleration


class Inertia(eqx.Module):
    """M.

    Attributes:
        matrix: its entries.
        bodies: what it is made of, if nothing else adds to it: then derivatives go through them and not through the
            entries.
    """

    matrix: Float[Array, "nv nv *batch"]
    bodies: Bodies | None = None

    def apply(self, acceleration: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Return M a."""
        if self.bodies is None:
            return contract("ij,j->i", self.matrix, acceleration)
        return self.bodies.apply(acceleration)


def inertia_of(model: mjx.Model, data: mjx.Data) -> Inertia:
    """Return M of data with its mass matrix filled in."""
    matrix = mjx.full_m(model, data)
    if model.ntendon or data._impl.M.ndim == 1:
        # Tendons have armature of their own; the sparse format is MJX's.
        return Inertia(matrix)
    moves = tuple(tuple(int(dof) for dof in np.nonzero(row)[0]) for row in tree.moving_dofs(model))
    armature = jnp.asarray(model.dof_armature, matrix.dtype)
    return Inertia(matrix, Bodies(data._impl.cinert, data.cdof, armature, moves))
