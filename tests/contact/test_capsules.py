"""Contacts of planes, balls and capsules against C MuJoCo's, MJX's, and difference quotients."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import kinematics
from mjxgrad.contact.collision import collide, slot_geoms

# Margins beyond all distances, so that C MuJoCo reports every contact; two dimensions, so that two groups are of one type.
SCENE = """
<mujoco>
  <default><geom margin="5"/></default>
  <worldbody>
    <geom type="plane" size="1 1 1" {tilt}/>
    <body><freejoint/><geom size=".1"/></body>
    <body><freejoint/><geom size=".15" condim="1"/></body>
    <body><freejoint/><geom type="capsule" size=".1 .2"/></body>
    <body><freejoint/><geom type="capsule" size=".05 .3"/></body>
    <body><freejoint/><geom type="capsule" size=".07 .1" condim="1"/></body>
  </worldbody>
</mujoco>
"""
LEVEL, TILTED = SCENE.format(tilt=""), SCENE.format(tilt='euler="70 20 0"')
BALLS, CAPSULES = (1, 2), (3, 4, 5)


def finder(model, start):
    """Return the function from positions to contacts."""
    return jax.jit(lambda qpos: collide(model, kinematics(model, start.replace(qpos=qpos)))._impl.contact)


def loaded(xml):
    """Return C's model, the geoms of the slots, and the function from positions to contacts; the same for the same scene."""
    return _loaded(xml, jax.config.jax_enable_x64)


@functools.cache
def _loaded(xml, _):
    mj_model = mujoco.MjModel.from_xml_string(xml)
    scene = mg.load_scene(mj_model, keep_everything=True)
    return mj_model, slot_geoms(scene.model, scene.data), finder(scene.model, scene.data)


@functools.cache
def _jacobian(find, names):
    """Return the program of the derivative of these numbers of each contact, one after the other."""

    def numbers(qpos):
        contact = find(qpos)
        return jnp.column_stack([getattr(contact, name).reshape(len(contact.dist), -1) for name in names])

    return jax.jit(jax.jacrev(numbers))


def poses(seed, num_bodies=5, spread=0.2):
    """Return random positions and turns of free bodies."""
    random = np.random.default_rng(seed)
    quaternions = random.normal(size=(num_bodies, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.concatenate([random.normal(scale=spread, size=(num_bodies, 3)), quaternions], axis=1).ravel()


def by_pair_and_depth(geoms, contact, theirs):
    """Return geoms, distances, places and frames, ours and C's: of a capsule's two ends C counts either first."""
    found = (
        np.column_stack([geoms, contact.dist, contact.pos, contact.frame.reshape(-1, 9)]),
        np.column_stack([theirs.geom, theirs.dist, theirs.pos, theirs.frame]),
    )
    return (x[np.lexsort((x[:, 2].round(9), x[:, 1], x[:, 0]))] for x in found)


def test_they_touch_where_they_do_in_c():
    """Contacts with planes to rounding, those of capsules to the fourth power of a ratio of a hundredth."""
    mj_model, geoms, find = loaded(TILTED)
    mj_data, num_clear = mujoco.MjData(mj_model), 0
    for seed in range(40):
        mj_data.qpos[:] = poses(seed)
        mujoco.mj_forward(mj_model, mj_data)
        ours, theirs = by_pair_and_depth(geoms, find(jnp.asarray(mj_data.qpos)), mj_data.contact)
        first, second = ours[:, :2].astype(int).T
        np.testing.assert_array_equal(ours[:, :2], theirs[:, :2])
        np.testing.assert_allclose(ours[first == 0], theirs[first == 0], rtol=0, atol=1e-14)
        axes = mj_data.geom_xmat.reshape(-1, 3, 3)[:, :, 2]
        is_clear = 1 - np.sum(axes[first] * axes[second], axis=1) ** 2 > 1e-4
        num_clear += np.sum(is_clear & (first > 0))
        # Of half a metre, over a distance of at least 0.1 m between axes for the normals.
        np.testing.assert_allclose(ours[is_clear], theirs[is_clear], rtol=0, atol=5e-8)
        np.testing.assert_allclose(ours[:, 2], theirs[:, 2], rtol=0, atol=1e-8)
    assert num_clear > 380


def test_contacts_with_a_level_plane_are_those_of_mjx_and_on_a_tilted_one_tangents_are_at_right_angles():
    for xml in (LEVEL, TILTED):
        mj_model, geoms, find = loaded(xml)
        model, start = mjx.put_model(mj_model), mjx.make_data(mj_model)
        of_mjx = jax.jit(lambda qpos, m=model, d=start: mjx.collision(m, mjx.kinematics(m, d.replace(qpos=qpos))))
        for seed in range(20):
            contact = find(jnp.asarray(poses(seed)))
            frames = contact.frame
            np.testing.assert_allclose(
                frames @ np.swapaxes(frames, 1, 2), np.tile(np.eye(3), (18, 1, 1)), rtol=0, atol=1e-14
            )
            np.testing.assert_allclose(np.linalg.det(frames), 1, rtol=0, atol=1e-14)
            if xml is LEVEL:
                theirs, on_plane = of_mjx(jnp.asarray(poses(seed)))._impl.contact, geoms[:, 0] == 0
                for name in ("dist", "pos"):
                    ours, own = (getattr(x, name)[on_plane] for x in (contact, theirs))
                    np.testing.assert_allclose(ours, own, rtol=0, atol=1e-13)


@pytest.mark.parametrize("is_double", [True, False])
@pytest.mark.parametrize("lean", [0.0, 1e-4, 0.03, 0.6])
def test_tangents_of_a_standing_leg_follow_its_lean_as_in_c(is_double, lean):
    """Up to quarter turns, after which pyramids of friction look alike; and to the rounding of the axis over its lean.

    The tangent turns so fast about an upright leg that its derivative is left out, but it is finite.
    """
    with jax.enable_x64(is_double):
        mj_model, _, find = loaded("""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
            <body><freejoint/><geom type="capsule" size=".1 .2"/></body></worldbody></mujoco>""")
        mj_data, (sine, cosine) = mujoco.MjData(mj_model), (np.sin(lean / 2), np.cos(lean / 2))
        mj_data.qpos[:] = 0, 0, 0.2, cosine, 0.6 * sine, 0.8 * sine, 0
        mujoco.mj_forward(mj_model, mj_data)
        qpos = jnp.asarray(mj_data.qpos)
        found = np.asarray(find(qpos).frame[0]) @ mj_data.contact.frame[0].reshape(3, 3).T
        assert jnp.isfinite(_jacobian(find, ("frame",))(qpos)).all()
    quarters = np.angle(found[1, 1] + 1j * found[1, 2]) / (np.pi / 2)
    rounding = np.finfo(np.float64 if is_double else np.float32).eps
    np.testing.assert_allclose(quarters, np.round(quarters), rtol=0, atol=4 * rounding / (lean or 1.0))
    np.testing.assert_allclose(found[0], [1, 0, 0], atol=1e-6)


def test_a_ball_that_turns_changes_nothing():
    """Side by side, where the nearest point is at the very middle of what has no length."""
    *_, find = loaded(LEVEL)
    still = np.array([1.0, 0, 0, 0])
    qpos = np.concatenate([[x, 0, 1, *still] for x in (0.0, 0.5, 1.0, 1.5, 2.0)])
    slope = _jacobian(find, ("dist", "pos", "frame"))(jnp.asarray(qpos))[:, :7]
    for ball in BALLS:
        turns = slope[..., 7 * ball - 4 : 7 * ball]
        assert np.abs(turns).max() == 0
    assert np.abs(slope[..., 17:21]).max() > 0


def test_parallel_capsules_and_balls_in_one_place_have_derivatives():
    """Capsules side by side: by what moves them apart the distance grows, by what moves them along not."""
    _, geoms, find = loaded(LEVEL)
    still = np.array([1.0, 0, 0, 0])
    qpos = np.concatenate([[x, 0, 1, *still] for x in (0.0, 0.0, 1.0, 1.5, 2.0)])
    slope = _jacobian(find, ("dist", "pos", "frame"))(jnp.asarray(qpos))[:, 0]
    assert np.isfinite(slope).all()
    pair = np.flatnonzero((geoms == (3, 4)).all(axis=1))[0]
    np.testing.assert_allclose(slope[pair, 14:17], [-1, 0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(slope[pair, 21:24], [1, 0, 0], rtol=0, atol=1e-12)


PLANAR = """
<mujoco><worldbody>
  <body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
    <geom type="capsule" size=".05 .3"/></body>
  <body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
    <geom type="capsule" size=".04 .3"/></body>
</worldbody></mujoco>
"""


def _outcome(mj_model, dtype):
    """Return the first contact's distance, normal and position at positions of a precision."""
    model, start = jax.tree.map(
        lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, (mjx.put_model(mj_model), mjx.make_data(mj_model))
    )

    find = finder(model, start)

    def outcome(qpos):
        contact = find(qpos)
        return jnp.concatenate([contact.dist[:1], contact.frame[0, 0], contact.pos[0]])

    return jax.jit(outcome), jax.jit(jax.jacrev(outcome))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_capsules_whose_axes_cross_touch_along_the_normal_of_both(dtype):
    """As in C; and nothing within their plane turns that normal."""
    mj_model = mujoco.MjModel.from_xml_string(PLANAR)
    mj_data, (outcome, jacobian) = mujoco.MjData(mj_model), _outcome(mj_model, dtype)
    mj_data.qpos[:] = 0.05, 0.1, 0.3, 0.0, 0.0, -1.0
    mujoco.mj_forward(mj_model, mj_data)
    qpos, contact = jnp.asarray(mj_data.qpos, dtype), mj_data.contact
    expected = np.concatenate([contact.dist, contact.frame[0, :3], contact.pos[0]])
    np.testing.assert_allclose(outcome(qpos), expected, rtol=0, atol=1e3 * np.finfo(dtype).eps)
    assert np.abs(jacobian(qpos)[:4]).max() < 1e-6


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parallel_capsules_touch_at_the_middle_of_the_first(dtype):
    """The second is turned about its axis. Rounding of 1e-7 m, over 3e-4, moves the place by less than a millimetre."""
    free = '<body><freejoint/><geom type="capsule" size=".05 .3"/></body>'
    mj_model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{free}{free}</worldbody></mujoco>")
    (outcome, _), random = _outcome(mj_model, dtype), np.random.default_rng(0)
    along, spun = np.zeros(3), np.zeros(4)
    for _ in range(20):
        turn = random.normal(size=4)
        turn /= np.linalg.norm(turn)
        mujoco.mju_rotVecQuat(along, np.array([0.0, 0.0, 1.0]), turn)
        across = np.cross(along, random.normal(size=3))
        first = random.normal(size=3)
        spin = random.uniform(0, np.pi)
        mujoco.mju_mulQuat(spun, turn, np.array([np.cos(spin), 0.0, 0.0, np.sin(spin)]))
        qpos = np.concatenate([first, turn, first + 0.2 * across / np.linalg.norm(across), spun])
        assert abs(np.dot(outcome(jnp.asarray(qpos, dtype))[4:] - first, along)) < 1e-3
