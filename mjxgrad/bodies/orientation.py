"""Orientations of bodies: products of turns from the root, formed by doubling, in rounds logarithmic in the depth of the tree.

A turn is the fixed rotation of a body, then the joint's rotation about an axis fixed to the rotated frame.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import pick
from mjxgrad.bodies import spatial, tree

_Vectors = Float[Array, "n 3"]
_Matrices = Float[Array, "n 3 3"]
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


class Orientations(eqx.Module):
    """Orientations after each turn. An index of -1 is the world.

    Both quaternions and matrices are carried through the products, so that XLA can remove unused quaternions.
    """

    quat: Float[Array, "turns 4"]
    mat: Float[Array, "turns 3 3"]

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data, frames: tree.Frames, turn: Float[Array, "njnt 4"]) -> "Orientations":
        """Return the orientations after all turns, from the quaternion of each joint."""
        own = pick(frames.joint, turn, _IDENTITY * (frames.mocap < 0)[:, None])
        if model.nmocap:
            own += pick(frames.mocap, spatial.normalise(data.mocap_quat))
        quat = own
        if (frames.body >= 0).any():
            fixed = pick(frames.body, model.body_quat, _IDENTITY)
            quat = spatial.multiply(fixed, own) if (frames.joint >= 0).any() else fixed
        mat = spatial.rotation_matrix(quat)
        for jump in frames.jumps:
            quat = spatial.multiply(pick(jump, quat, _IDENTITY), quat)
            mat = spatial.compose(pick(jump, mat, np.eye(3)), mat)
        return cls(quat, mat)

    def quaternions(self, index: np.ndarray) -> Float[Array, "n 4"]:
        """Return the orientations of chosen frames as quaternions."""
        return pick(index, self.quat, _IDENTITY)

    def compose(self, index: np.ndarray, matrices: _Matrices) -> _Matrices:
        """Return the orientations given by matrices in chosen frames."""
        return spatial.compose(pick(index, self.mat, np.eye(3)), matrices)

    def rotate(self, index: np.ndarray, vectors: _Vectors) -> _Vectors:
        """Return vectors of chosen frames in the world."""
        return spatial.rotate(pick(index, self.mat, np.eye(3)), vectors)
