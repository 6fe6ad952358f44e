r"""Orientations of bodies: products of turns, or sums of angles where all turns of a chain share one axis.

A turn is the fixed rotation of a body, then the joint's rotation about an axis fixed to the rotated frame. In general
orientations are products of turns from the root, formed by doubling, in rounds logarithmic in the depth of the tree. Most legged
robots and arms of the benchmarks are planar. With the common axis a of a chain the orientation after a turn is

    R_a(φ) C = cos φ (1 - a aᵀ) C + sin φ [a]ₓ C + a aᵀ C,

where C is the constant product of the fixed rotations and φ the sum of the angles. Each turn then costs one sine and one cosine,
and no products. Axes and fixed rotations must be known when the program is traced.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from mjxgrad._arrays import known
from mjxgrad._mjx import mjx
from mjxgrad.batched import linear, maps
from mjxgrad.batched.maps import contract, pick
from mjxgrad.bodies import spatial, tree

_Turns = Float[Array, "njnt 4"]
_Vectors = Float[Array, "n 3"]
_Matrices = Float[Array, "n 3 3"]
_Joint = mujoco.mjtJoint
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_PARALLEL = 16  # axes count as parallel up to this many units of rounding


class Products(eqx.Module):
    """Orientations after each turn, as products of turns from the root. An index of -1 is the world.

    Both quaternions and matrices are carried through the products, so that XLA can remove unused quaternions.
    """

    quat: Float[Array, "turns 4"]
    mat: Float[Array, "turns 3 3"]

    def quaternions(self, index: np.ndarray) -> Float[Array, "n 4"]:
        """Return the orientations of chosen frames as quaternions."""
        return pick(index, self.quat, _IDENTITY)

    def compose(self, index: np.ndarray, matrices: _Matrices) -> _Matrices:
        """Return the orientations given by matrices in chosen frames."""
        return spatial.compose(pick(index, self.mat, np.eye(3)), matrices)

    def rotate(self, index: np.ndarray, vectors: _Vectors) -> _Vectors:
        """Return vectors of chosen frames in the world."""
        return spatial.rotate(pick(index, self.mat, np.eye(3)), vectors)


class Angles(eqx.Module):
    """Orientations after each turn, as sums φ of angles about the axes of chains (rad) and the formula's constants."""

    angle: Float[Array, " turns"]
    chain: "Chains" = eqx.field(static=True)

    def quaternions(self, index):
        half, is_turned = pick(index, 0.5 * self.angle), (index >= 0)[:, None]
        fixed = jnp.asarray(np.where(is_turned, self.chain.quaternion[index], _IDENTITY), half.dtype)
        turned = jnp.asarray(np.where(is_turned, self.chain.turned_quaternion[index], 0.0), half.dtype)
        return maps.scale(jnp.cos(half), fixed) + maps.scale(jnp.sin(half), turned)

    def compose(self, index, matrices):
        parts = (contract("nij,njk->nik", part, matrices).reshape(-1, 9) for part in self._parts(index))
        return self._sum(index, *parts).reshape(-1, 3, 3)

    def rotate(self, index, vectors):
        return self._sum(index, *(contract("nij,nj->ni", part, vectors) for part in self._parts(index)))

    def _parts(self, index: np.ndarray) -> list[Array]:
        is_turned = (index >= 0)[:, None, None]
        pairs = ((self.chain.even, 0.0), (self.chain.odd, 0.0), (self.chain.constant, np.eye(3)))
        return [jnp.asarray(np.where(is_turned, part[index], rest), self.angle.dtype) for part, rest in pairs]

    def _sum(self, index: np.ndarray, even: Array, odd: Array, constant: Array) -> Array:
        cosine, sine = (pick(index, function(self.angle)) for function in (jnp.cos, jnp.sin))
        return maps.scale(cosine, even) + maps.scale(sine, odd) + constant


@dataclass(frozen=True, eq=False)
class Chains:
    """Constants of chains that turn about one axis each, for each turn."""

    sums: np.ndarray  # coefficients 0 or ±1 of the joints' angles in φ
    even: np.ndarray  # (1 - a aᵀ) C
    odd: np.ndarray  # [a]ₓ C
    constant: np.ndarray  # a aᵀ C
    quaternion: np.ndarray  # the quaternion of C
    turned_quaternion: np.ndarray  # (0, a) times the quaternion of C


def orientation(model: mjx.Model, data: mjx.Data, frames: tree.Frames, turn: _Turns) -> Products | Angles:
    """Return the orientations after all turns, from the quaternion of each joint."""
    found = chains(model, frames)
    if found is None:
        return _products(model, data, frames, turn)
    hinges = np.flatnonzero(model.jnt_type == _Joint.mjJNT_HINGE)
    places = model.jnt_qposadr[hinges]
    angles = linear.take(data.qpos, tuple(places.tolist())) - model.qpos0[places]
    return Angles(maps.combine(found.sums[:, hinges], angles), found)


def _products(model: mjx.Model, data: mjx.Data, frames: tree.Frames, turn: _Turns) -> Products:
    has_joint = frames.joint >= 0
    own = pick(frames.joint, turn, _IDENTITY * (frames.mocap < 0)[:, None])
    if model.nmocap:
        own += pick(frames.mocap, spatial.normalise(data.mocap_quat))
    quat = own
    if (frames.body >= 0).any():
        fixed = pick(frames.body, model.body_quat, _IDENTITY)
        quat = spatial.multiply(fixed, own) if has_joint.any() else fixed
    mat = spatial.rotation_matrix(quat)
    for jump in frames.jumps:
        quat = spatial.multiply(pick(jump, quat, _IDENTITY), quat)
        mat = spatial.compose(pick(jump, mat, np.eye(3)), mat)
    return Products(quat, mat)


def chains(model: mjx.Model, frames: tree.Frames) -> Chains | None:
    """Return the constants of chains about one axis each; None unless every chain is known to have one axis."""
    axes, quats = known(model.jnt_axis), known(model.body_quat)
    turns_freely = np.isin(model.jnt_type, (_Joint.mjJNT_FREE, _Joint.mjJNT_BALL)).any()
    if axes is None or quats is None or turns_freely or model.nmocap or not (frames.joint >= 0).any():
        return None
    tolerance = _PARALLEL * np.finfo(axes.dtype).eps
    count = len(frames.body)
    previous = frames.jumps[0] if frames.jumps else np.full(count, -1)
    sums, axis = np.zeros((count, model.njnt)), np.zeros((count, 3))
    fixed: list[Rotation] = []
    for t, (before, body, joint) in enumerate(zip(previous, frames.body, frames.joint, strict=True)):
        own = Rotation.from_quat(quats[body].astype(float), scalar_first=True) if body >= 0 else Rotation.identity()
        fixed.append(fixed[before] * own if before >= 0 else own)
        if before >= 0:
            sums[t], axis[t] = sums[before], axis[before]
        if joint < 0:
            continue
        in_world = fixed[t].apply(axes[joint].astype(float))
        if not axis[t].any():
            axis[t] = in_world
        sign = 1.0 if axis[t] @ in_world > 0 else -1.0
        if np.abs(in_world - sign * axis[t]).max() > tolerance:
            return None
        sums[t, joint] = sign
    c = np.array([rotation.as_matrix() for rotation in fixed])
    along = axis[:, :, None] * axis[:, None]
    is_turning = (sums != 0).sum(axis=1)[:, None, None] > 0
    quaternion = np.array([rotation.as_quat(scalar_first=True) for rotation in fixed])
    return Chains(
        sums=sums,
        even=np.where(is_turning, c - along @ c, 0.0),
        odd=np.cross(axis[:, :, None], c, axis=1),
        constant=np.where(is_turning, along @ c, c),
        quaternion=quaternion,
        turned_quaternion=np.einsum("kij,ni,nj->nk", spatial.QUATERNION[:, 1:], axis, quaternion),
    )
