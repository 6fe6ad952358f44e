"""Contacts against C MuJoCo's and against MJX's."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.contact.boxes import ABSENT
from mjxgrad.contact.collision import collide, slot_geoms
from tests.contact.test_capsules import TILTED, by_pair_and_depth, finder, loaded, poses
from tests.scenes import central_difference, put

# Two boxes that do not meet, over two tilted planes; margins beyond all distances, so that C MuJoCo reports every corner.
BOXES = """
<mujoco>
  <default><geom margin="5"/></default>
  <worldbody>
    <geom type="plane" size="1 1 1" euler="10 20 0"/>
    <geom type="plane" size="1 1 1" pos="0 0 -.05" euler="-15 0 0"/>
    <body><freejoint/><geom type="box" size=".1 .2 .05" contype="2"/></body>
    <body><freejoint/><geom type="box" size=".1 .02 .05" contype="2"/></body>
  </worldbody>
</mujoco>
"""
BALLS = """
<mujoco>
  <custom>{numbers}</custom>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 .09"><freejoint/><geom size=".1" condim="1"/></body>
    <body pos=".17 0 .08"><freejoint/><geom size=".1" condim="1"/></body>
    <body pos=".05 .2 .11"><freejoint/><geom size=".12"/></body>
    <body pos=".3 .1 .095"><freejoint/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""


CAN = """
<mujoco><worldbody><body><freejoint/><geom size=".07" margin="5"/></body>
<body><freejoint/><geom type="cylinder" size=".1 .15"/></body></worldbody></mujoco>
"""
two_poses = functools.partial(poses, num_bodies=2, spread=0.1)
BALL_AND_BOX = CAN.replace('type="cylinder" size=".1 .15"', 'type="box" size=".1 .2 .05"').replace(".07", ".03")
ROD_ON_BOX = BALL_AND_BOX.replace('size=".03"', 'type="capsule" size=".03 .15"')
CYLINDER = """<mujoco><worldbody><geom type="plane" size="1 1 1" euler="10 20 0" margin="5"/>
<body><freejoint/><geom type="cylinder" size=".1 .15"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("xml", "num_contacts", "num_places"),
    [(BOXES, 16, 1), (CAN, 1, 4), (BALL_AND_BOX, 1, 8)],
    ids=["two boxes on two planes, corner by corner", "side, ends and edge of a cylinder", "around and within a box"],
)
def test_they_touch_where_they_do_in_c(xml, num_contacts, num_places):
    """Pairs, distances, places and normals, in C's order after sorting by pair and depth; from outside and from within."""
    mj_model, geoms, find = loaded(xml)
    mj_data, places = mujoco.MjData(mj_model), set()
    for seed in range(100):
        mj_data.qpos[:] = two_poses(seed)
        mujoco.mj_forward(mj_model, mj_data)
        assert mj_data.ncon == num_contacts
        ours, theirs = by_pair_and_depth(geoms, find(jnp.asarray(mj_data.qpos)), mj_data.contact)
        # The nearest side of a box that a ball's centre is within 1e-5 of is known to 1e-14 over that.
        np.testing.assert_allclose(ours, theirs, atol=1e-9 if xml is BALL_AND_BOX else 1e-14)
        if xml is not BOXES:
            centre = mj_data.geom_xmat[1].reshape(3, 3).T @ (mj_data.geom_xpos[0] - mj_data.geom_xpos[1])
            round_it = np.array([np.hypot(*centre[:2]), abs(centre[2])]) if xml is CAN else np.abs(centre)
            places.add(tuple(round_it > ([0.1, 0.15] if xml is CAN else mj_model.geom_size[1])))
    assert len(places) == num_places or xml is BOXES


@pytest.mark.parametrize("is_double", [True, False])
@pytest.mark.parametrize(
    ("xml", "counts"), [(ROD_ON_BOX, {1, 2}), (CYLINDER, {4})], ids=["capsule on box", "cylinder on plane"]
)
def test_each_contact_has_its_counterpart_in_c(xml, counts, is_double):
    """From corners, edges, faces and within; every other pose upright or level but for a small tilt.

    The lowest point of an upright cylinder runs along its rim: rounding over the tilt tells where it is.
    """
    random, found = np.random.default_rng(5), set()
    with jax.enable_x64(is_double):
        mj_model, _, find = loaded(xml)
        mj_data = mujoco.MjData(mj_model)
        for seed in range(200):
            qpos = poses(seed, mj_model.nbody - 1, 0.2)
            if seed % 2:
                tilt = 10 ** random.uniform(-4, -1)
                quat = random.choice([[1, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0]])
                qpos[3:7], qpos[10:14] = quat + tilt * random.normal(size=4), [1, 0, 0, 0][: len(qpos) - 10]
                qpos[3:7] /= np.linalg.norm(qpos[3:7])
            mj_data.qpos[:] = np.asarray(jnp.asarray(qpos), float)
            mujoco.mj_forward(mj_model, mj_data)
            contact, theirs = find(jnp.asarray(qpos)), mj_data.contact
            ours = np.column_stack([contact.dist, contact.pos, contact.frame.reshape(-1, 9)])[
                np.asarray(contact.dist) != ABSENT
            ]
            apart = np.abs(ours[:, None] - np.column_stack([theirs.dist, theirs.pos, theirs.frame])).max(axis=2)
            assert len(ours) == len(theirs)
            assert max(apart.min(axis=axis).max() for axis in (0, 1)) < (1e-11 if is_double else 1e-3)
            found.add(len(ours))
    assert found == counts


@pytest.mark.parametrize(
    ("xml", "at", "close"),
    [(BOXES, [two_poses(7)], 1e-9), (CAN, [*map(two_poses, range(4))], 1e-7), (TILTED, [*map(poses, range(4))], 1e-6),
     (ROD_ON_BOX, [*map(two_poses, range(12))], 1e-5), (CYLINDER, [poses(seed, 1) for seed in range(4)], 1e-8)],
    ids=["boxes", "ball on cylinder", "planes, balls and capsules", "capsule on box", "cylinder"],
)  # fmt: skip
def test_contacts_have_the_derivative_of_their_points(xml, at, close):
    """Cubic errors of 1e-5 are beyond rounding, 1e-16 over 1e-5; normals are divided by distances."""
    *_, find = loaded(xml)

    def outcome(qpos):
        contact = find(qpos)
        return jnp.concatenate([contact.dist, contact.pos.ravel(), contact.frame.ravel()])

    both = jax.jit(lambda qpos: (jax.jacrev(outcome)(qpos), central_difference(outcome, qpos, 1e-5)))
    for qpos in at:
        np.testing.assert_allclose(*both(jnp.asarray(qpos)), atol=close)


def test_on_its_axis_a_ball_on_a_cylinder_has_a_derivative():
    """Upright, centres one above the other: the distance is the height less what is between, whichever way it moves."""
    *_, find = loaded(CAN)
    upright = jnp.array([0, 0, 0.21, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0], float)
    slope = jax.jit(jax.jacrev(lambda qpos: find(qpos).dist[0]))(upright)
    np.testing.assert_allclose(slope[:3], [0, 0, 1], atol=1e-14)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize(
    "limits", [{}, {"max_geom_pairs": 2}, {"max_contact_points": 2}, {"max_geom_pairs": 2, "max_contact_points": 1}]
)
def test_slots_are_given_as_in_mjx(limits):
    numbers = "".join(f'<numeric name="{name}" data="{limit}"/>' for name, limit in limits.items())
    mj_model = mujoco.MjModel.from_xml_string(BALLS.format(numbers=numbers))
    model = mjx.put_model(mj_model)
    data = jax.jit(mjx.kinematics)(model, mjx.make_data(mj_model))
    ours, theirs = (jax.jit(find)(model, data)._impl.contact for find in (collide, mjx.collision))
    assert len(theirs.dist) == len(theirs.dim)
    # Other formulas, so other rounding; whole numbers are the same.
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-14), ours, theirs)
    assert (slot_geoms(model, data) is None) == bool(limits)
    if not limits:
        np.testing.assert_array_equal(slot_geoms(model, data), theirs.geom)


@pytest.mark.parametrize("kind", ['type="box" size=".1 .1 .1"', 'type="cylinder" size=".1 .1"'])
def test_of_many_balls_the_nearest_to_something_else_are_found(kind):
    """Where it is decided at run time which pairs are looked at: those of all pairs whose distance is least."""
    balls = "".join(f'<body pos="{x} .05 .17"><freejoint/><geom size=".1"/></body>' for x in (0, 0.05, 0.5, 0.9))
    xml = "<mujoco><custom>{}</custom><worldbody><body><freejoint/><geom {}/></body>{}</worldbody></mujoco>"
    found = []
    for numbers in ('<numeric name="max_geom_pairs" data="2"/>', ""):
        model, data = put(xml.format(numbers, kind, balls))
        contact = finder(model, data)(data.qpos)
        is_with_it = np.asarray(contact.geom == 0).any(axis=1)
        found.append(np.column_stack([contact.dist, contact.pos, contact.frame[:, 0]])[is_with_it])
    few, every = found
    assert len(few) == 2
    np.testing.assert_allclose(
        np.sort(few, axis=0), np.sort(every[np.argsort(every[:, 0])[:2]], axis=0), rtol=0, atol=1e-14
    )


_BLOCK = "-.1 -.2 -.05 .1 -.2 -.05 -.1 .2 -.05 .1 .2 -.05 -.1 -.2 .05 .1 -.2 .05 -.1 .2 .05 .1 .2 .05"
_PRISM = "-.1 -.1 0 .12 -.08 0 0 .1 0 -.1 -.1 .1 .12 -.08 .1 0 .1 .1"


@pytest.mark.parametrize(
    ("corners", "place", "count", "close"),
    [
        (_BLOCK, 'pos=".02 .03 .147"', 4, 1e-8),  # 3 mm deep, half way between its face and the other's
        # 1 mm deep and a little tilted. MJX takes one of the three corners a second time; it counts once.
        (_PRISM, 'pos="0 0 .099" euler=".05 .03 10"', 3, 2e-6),
    ],
    ids=["block", "prism"],
)
@pytest.mark.filterwarnings("ignore:.*like C MuJoCo's")
def test_a_mesh_that_stands_on_a_box_touches_at_its_corners_as_in_c(corners, place, count, close):
    scene = mg.load_scene(f"""<mujoco><asset><mesh name="m" vertex="{corners}"/></asset><worldbody>
      <geom type="box" size=".5 .5 .1"/><body {place}><freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>""",
      engine="mjx")  # fmt: skip
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    found = finder(scene.model, scene.data)(scene.data.qpos)
    ours = np.column_stack([found.pos, found.dist])[np.asarray(found.dist) < 0]
    theirs = np.column_stack([data.contact.pos, data.contact.dist])
    assert len(ours) == len(theirs) == count
    np.testing.assert_allclose(*(x[np.lexsort(x[:, :3].round(5).T)] for x in (ours, theirs)), atol=close)
