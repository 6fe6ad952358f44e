"""Contacts of two boxes against C MuJoCo's, closed forms and small differences."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.contact.boxes import ABSENT, Box, box_box
from mjxgrad.contact.collision import collide
from tests.scenes import central_difference

PAIR = """<mujoco><worldbody><geom type="box" size="{}" margin="{}"/>
<body><freejoint/><geom type="box" size="{}"/></body></worldbody></mujoco>"""
SIZES = [(".3 .3 .1", ".1 .2 .05"), (".1 .2 .1", ".1 .2 .05"), (".1 .1 .1", ".1 .1 .1"), (".05 .3 .08", ".2 .04 .03")]
PLACES = ("face", "turned face", "edge", "anywhere")


def _touching(model, data, place, random):
    """Put the second box somewhere around the first, up to 10 mm deep."""
    towards, turn = random.normal(size=3), np.zeros(4)
    yaw = random.choice([0, np.pi / 2]) if place == "face" else random.uniform(0, 6)
    if "face" in place:
        towards = np.array([*random.normal(size=2) * random.choice([0, 0.3]), 1.0])
        angles = [*random.normal(size=2) * 10 ** random.uniform(-6, -1), yaw]
    else:
        # On an edge the second box stands over an edge of the first one, which lies askew to it.
        angles = [np.pi / 4 + 0.2 * random.normal(), 0.1 * random.normal(), yaw]
    mujoco.mju_euler2Quat(turn, angles, "xyz")
    data.qpos[3:] = random.normal(size=4) if place == "anywhere" else turn
    data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
    near, far = 0.0, 3.0
    for _ in range(40):
        data.qpos[:3] = towards * (near + far) / 2
        mujoco.mj_kinematics(model, data)
        is_apart = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) > 0
        near, far = (near, (near + far) / 2) if is_apart else ((near + far) / 2, far)
    data.qpos[:3] = (near - 10 ** random.uniform(-5, -2)) * towards
    mujoco.mj_forward(model, data)


def _boxes(x, axes, half):
    return Box(x[0], axes[0], half[0]), Box(x[1], axes[1], half[1])


@pytest.mark.parametrize("margin", [0.0, 0.008])
def test_two_boxes_touch_where_they_do_in_c(margin):
    """Up to eight points of faces, and one where edges cross; positions, distances and frames."""
    random, theirs, poses = np.random.default_rng(3), [], []
    for first, second in SIZES:
        model = mujoco.MjModel.from_xml_string(PAIR.format(first, margin, second))
        data = mujoco.MjData(model)
        for i in range(100):
            _touching(model, data, PLACES[i % 4], random)
            # Into the margin, so that some boxes do not overlap.
            data.qpos[2] += random.uniform(0, margin) * np.sign(data.qpos[2])
            mujoco.mj_forward(model, data)
            theirs.append(np.column_stack([data.contact.dist, data.contact.pos, data.contact.frame.reshape(-1, 9)]))
            poses.append([data.geom_xpos.copy(), data.geom_xmat.reshape(2, 3, 3).copy(), model.geom_size])
    found = jax.jit(jax.vmap(lambda *pose: box_box(*_boxes(*pose))))(*map(np.array, zip(*poses, strict=True)))
    for expected, dist, pos, frame in zip(theirs, *map(np.asarray, found), strict=True):
        ours = np.column_stack([dist, pos, frame.reshape(8, 9)])[dist <= margin]
        assert len(ours) == len(expected)
        apart = np.abs(ours[:, None] - expected).max(axis=2)
        assert max(apart.min(axis=axis, initial=1).max(initial=0) for axis in (0, 1)) < 1e-12
    normals = np.asarray(found[2])[:, 0, 0]
    axes = np.concatenate([np.swapaxes(p[1], 1, 2) for p in poses]).reshape(-1, 6, 3)
    is_of_edges = np.abs(np.einsum("nak,nk->na", axes, normals)).max(axis=1) < 1 - 1e-9
    assert {*map(len, theirs)} >= {1, 2, 3, 4, 5, 6, 7, 8}
    assert is_of_edges.sum() > 60


def _crossing(yaw=np.pi / 2, height=0.19):
    """Return the centre and axes of a bar on edge above one that lies along x, both 0.1 √2 high from axis to edge."""
    tilt = np.sqrt(0.5) * np.array([[np.sqrt(2), 0, 0], [0, 1, -1], [0, 1, 1]])
    about = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return np.array([[0, 0, 0], [0.02, 0.03, height * np.sqrt(2)]]), np.array([tilt, about @ tilt])


def _moved(x, axes, motion):
    """Return a pose after a shift and a turn of the second box."""
    skew = jnp.cross(jnp.eye(3), motion[3:])
    return x.at[1].add(motion[:3]), axes.at[1].set(jax.scipy.linalg.expm(skew) @ axes[1])


def _outcome(motion, x, axes, half):
    dist, pos, frame = box_box(*_boxes(*_moved(x, axes, motion), half))
    return jnp.concatenate([dist, jnp.where(dist[:, None] < ABSENT, pos, 0.0).ravel(), frame[0, 0]])


@jax.jit
def _with_derivatives(*pose):
    """Return distances, places and normal, and their derivative by a motion of the second box, twice."""
    outcome, rest = lambda motion: _outcome(motion, *pose), jnp.zeros(6)
    return outcome(rest), jax.jacfwd(outcome)(rest), central_difference(outcome, rest, 1e-6)


@pytest.mark.parametrize("kind", ["face", "edge"])
def test_the_contacts_of_boxes_have_the_derivative_of_their_points(kind):
    if kind == "edge":
        start, half = _crossing(yaw=1.2), jnp.array([[1.0, 0.1, 0.1], [0.5, 0.1, 0.1]])
    else:
        turn = np.zeros(4), np.zeros(9)
        mujoco.mju_euler2Quat(turn[0], [0.01, 0.02, 0.6], "xyz")
        mujoco.mju_quat2Mat(turn[1], turn[0])
        start = np.array([[0, 0, 0], [0.03, 0.02, 0.29]]), np.array([np.eye(3), turn[1].reshape(3, 3)])
        half = jnp.array([[0.2, 0.15, 0.1], [0.19, 0.18, 0.2]])
    values, *both = _with_derivatives(*map(jnp.asarray, start), half)
    acting = int(jnp.sum(values[:8] < ABSENT))
    assert acting == 1 if kind == "edge" else acting >= 6
    np.testing.assert_allclose(*both, atol=1e-7)


def test_derivatives_are_finite_in_single_precision():
    """Equal boxes face on face, edge on edge and corner on corner, turned by less and less, in both modes."""
    tilts = np.array([0.0, *(10.0**-k for k in range(3, 26))])
    motions = tilts[:, None] * np.concatenate([np.zeros((1, 3)), np.random.default_rng(1).normal(size=(5, 3))])[:, None]
    motions = np.concatenate([np.zeros_like(motions), motions], axis=2).reshape(-1, 6)
    half = jnp.full((2, 3), 0.1, jnp.float32)
    starts = [
        (np.array([[0, 0, 0], place]), np.stack([np.eye(3)] * 2)) for place in ([0, 0, 0.19], [0.2, 0, 0.2], [0.2] * 3)
    ]
    starts += [_crossing(yaw) for yaw in (0, np.pi / 2)]
    with jax.enable_x64(False):

        def outcome(motion, x, axes):
            return jnp.concatenate([y.ravel() for y in box_box(*_boxes(*_moved(x, axes, motion), half))])

        both = jax.jit(jax.vmap(lambda *x: (jax.jacfwd(outcome)(*x), jax.jacrev(outcome)(*x)), in_axes=(0, None, None)))
        for start in starts:
            forward, reverse = both(*(jnp.asarray(x, jnp.float32) for x in (motions, *start)))
            assert np.isfinite(forward).all()
            # Edges at an angle of 1e-5 cut each other at a place that moves by 1e5 times their length; below it is constant.
            assert np.abs(forward).max() < 1e5
            np.testing.assert_allclose(reverse, forward, rtol=1e-3, atol=1e-3)


STACK = """<mujoco><option timestep=".002" tolerance="1e-14" iterations="200"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 .0999"><freejoint/><geom type="box" size=".1 .2 .1" margin=".001"/></body>
<body pos="0 0 .2497"><freejoint/><geom type="box" size=".15 .15 .05"/></body></worldbody></mujoco>"""


def test_a_step_of_stacked_boxes_is_that_of_c():
    """Two boxes on a plane, the upper one turned, so that their faces overlap in up to eight corners."""
    scene, random = mg.load_scene(STACK), np.random.default_rng(0)
    assert len(scene.data._impl.contact.dist) == 16
    starts, ends, most = [], [], 0
    for _ in range(60):
        data = mujoco.MjData(scene.mj_model)
        mujoco.mju_euler2Quat(data.qpos[10:], [*1e-3 * random.normal(size=2), random.uniform(0, 6)], "xyz")
        data.qvel[:] = 0.1 * random.normal(size=12)
        starts.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(scene.mj_model, data)
        ends.append(data.qvel.copy())
        most = max(most, data.ncon)
    step = jax.jit(jax.vmap(lambda qpos, qvel: mg.step(scene.model, scene.data.replace(qpos=qpos, qvel=qvel)).qvel))
    np.testing.assert_allclose(step(*map(np.array, zip(*starts, strict=True))), ends, atol=1e-10)
    assert most == 12


def test_data_of_mjx_has_room_for_the_four_deepest():
    scene = mg.load_scene(STACK)
    turned = scene.data.qpos.at[10:].set(jnp.array([np.cos(0.3), 0.002, 0.001, np.sin(0.3)]))
    found = []
    find = jax.jit(lambda data: collide(scene.model, mjx.kinematics(scene.model, data))._impl.contact)
    for data in (scene.data, mjx.make_data(scene.mj_model)):
        contact = find(data.replace(qpos=turned))
        found.append(np.sort(np.asarray(contact.dist)[(np.asarray(contact.geom) == (1, 2)).all(axis=1)]))
    assert [*map(len, found)] == [8, 4]
    np.testing.assert_allclose(found[1], found[0][:4], atol=1e-14)
