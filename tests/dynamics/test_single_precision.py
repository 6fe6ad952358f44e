"""Derivatives in JAX's default precision, where what symmetry makes nearly zero is zero once squared.

Every pair of geoms, in poses that are symmetric but for a tilt that is smaller and smaller, and every kind of actuator, tendon,
limit, equality and sensor, at rest, at its reference and at its limit: both modes are finite, agree, and are right.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import kinematics, spatial
from mjxgrad.dynamics.collision import collide

_SHAPES = {
    "plane": 'type="plane" size="1 1 .1"',
    "hfield": 'type="hfield" hfield="h"',
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".05 .1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .12 .15"',
    "cylinder": 'type="cylinder" size=".1 .12"',
    "box": 'type="box" size=".1 .1 .1"',
    "mesh": 'type="mesh" mesh="m"',
}
_PAIRS = [
    *(("plane", name) for name in ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")),
    *(("hfield", name) for name in ("sphere", "capsule", "box", "mesh")),
    *(("sphere", name) for name in ("sphere", "capsule", "cylinder", "box", "mesh")),
    *(("capsule", name) for name in ("capsule", "box", "mesh")),
    *(("box", name) for name in ("box", "mesh")),
    ("mesh", "mesh"),
]
_QUICK = {("plane", "cylinder"), ("sphere", "cylinder"), ("capsule", "capsule"), ("capsule", "box"), ("box", "box")}
PAIR = """<mujoco><asset>
  <mesh name="m" vertex="-.1 -.1 -.1  .1 -.1 -.1  -.1 .1 -.1  .1 .1 -.1  0 0 .1"/>
  <hfield name="h" nrow="3" ncol="3" size=".5 .5 .1 .1" elevation="0 0 0 0 1 0 0 0 0"/></asset>
<worldbody><geom {}/><body><freejoint/><geom {} mass="1"/></body></worldbody></mujoco>"""
_TILTS = (0.0, *(10.0**-k for k in range(4, 26, 3)))


def _poses():
    """Return positions and quaternions: in line along axes and diagonals, overlapping and apart, faces, edges and corners."""
    places = [[0, 0, 0.19], [0, 0, 0.5], [0.17, 0, 0], [0.1, 0.1, 0.19], [0, 0, 0]]
    half = np.sqrt(0.5)
    turns = [[1, 0, 0, 0], [half, half, 0, 0], [half, 0, half, 0], [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]]
    found = []
    for tilt in _TILTS:
        for place in places:
            for turn in turns:
                change = np.array([1, 0.5 * tilt, 0, tilt])
                found.append(np.concatenate([place, _product(change, np.array(turn))]))
    return np.array(found)


def _product(p, q):
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, p, q)
    return result


def _contacts(pair):
    """Return a function of a motion of the body and its pose: all numbers of the contacts, weighted, and their depths' sum."""
    model = mjx.put_model(mujoco.MjModel.from_xml_string(PAIR.format(*(_SHAPES[name] for name in pair))))
    data = mjx.make_data(model)

    def contacts(motion, pose):
        quat = spatial.multiply(spatial.exponential(motion[3:]), pose[3:])
        posed = data.replace(qpos=jnp.concatenate([pose[:3] + motion[:3], quat]))
        found = collide(model, kinematics.com_pos(model, kinematics.kinematics(model, posed)))._impl.contact
        every = jnp.concatenate([found.dist[:, None], found.pos, found.frame.reshape(-1, 9)], axis=1)
        return jnp.stack([(every @ jnp.cos(jnp.arange(13.0))).sum(), jnp.where(found.dist < 0, found.dist, 0.0).sum()])

    return contacts


def _over_poses(*functions):
    """Return what functions of a motion and a pose give of all poses at rest."""
    poses = jnp.asarray(_poses(), jnp.result_type(float))
    return jax.jit(jax.vmap(lambda pose: [function(jnp.zeros(6), pose) for function in functions]))(poses)


@pytest.mark.parametrize("pair", [p if p in _QUICK else pytest.param(p, marks=pytest.mark.slow) for p in _PAIRS], ids="-".join)
def test_contacts_of_nearly_symmetric_poses_have_both_derivatives(pair):
    """Finite and the same in both modes; and the depth's is that of double precision, there or to either side of the pose.

    Slopes on both sides differ where several corners or faces are equally near. Where precisions choose other points among
    those of a face there is nothing to compare.
    """
    width = 1e-6
    with jax.enable_x64(False):
        value, forward, reverse = _over_poses(_contacts(pair), jax.jacfwd(_contacts(pair)), jax.jacrev(_contacts(pair)))
    contacts = _contacts(pair)
    near = [lambda rest, pose, w=w: jax.vmap(contacts, (0, None))(rest + w * jnp.eye(6), pose) for w in (width, -width)]
    there, slope = _over_poses(contacts, jax.jacfwd(contacts))
    right, left = ((x[..., 1] - there[:, None, 1]) / w for x, w in zip(_over_poses(*near), (width, -width), strict=True))
    assert np.isfinite(forward).all() and np.isfinite(reverse).all()
    scale = 1 + np.abs(forward).max(axis=(1, 2), keepdims=True)
    # Sums of some hundred terms, each rounded to 1e-7 of the largest; a rim's point turns by 1e7 radians for one of tilt.
    np.testing.assert_allclose(forward / scale, reverse / scale, atol=2e-2 if pair == ("plane", "cylinder") else 2e-5)
    is_same = np.abs(value - there).max(axis=1) < 1e-4
    found = np.asarray(forward)[:, 1]
    # Rounding of a double over the width is 1e-10, single precision 1e-6 of numbers up to ten.
    is_between = (found > np.minimum(left, right) - 1e-3) & (found < np.maximum(left, right) + 1e-3)
    is_right = is_between | (np.abs(found - slope[:, 1]) < 1e-3)
    assert is_same.mean() > 0.6
    assert is_right[is_same].all(), _poses()[is_same][~is_right[is_same].all(axis=1)]
