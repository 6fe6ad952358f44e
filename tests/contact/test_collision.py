"""Contacts against C MuJoCo's and against MJX's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.bodies import kinematics
from mjxgrad.contact.collision import collide, slot_geoms
from tests.scenes import central_difference

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
BALL_AND_BOX = CAN.replace('type="cylinder" size=".1 .15"', 'type="box" size=".1 .2 .05"').replace(".07", ".03")


def _finder(model):
    return jax.jit(
        lambda data: collide(model, kinematics.com_pos(model, kinematics.kinematics(model, data)))._impl.contact
    )


def _poses(seed, num_bodies=2):
    random = np.random.default_rng(seed)
    quaternions = random.normal(size=(num_bodies, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.concatenate([random.normal(scale=0.1, size=(num_bodies, 3)), quaternions], axis=1).ravel()


def _loaded(xml):
    mj_model = mujoco.MjModel.from_xml_string(xml)
    model = mjx.put_model(mj_model)
    return mj_model, mjx.make_data(mj_model), _finder(model), slot_geoms(model, mjx.make_data(mj_model))


@pytest.mark.parametrize(
    ("xml", "num_contacts", "num_places"),
    [(BOXES, 16, 1), (CAN, 1, 4), (BALL_AND_BOX, 1, 8)],
    ids=["two boxes on two planes, corner by corner", "side, ends and edge of a cylinder", "around and within a box"],
)
def test_they_touch_where_they_do_in_c(xml, num_contacts, num_places):
    """Pairs, distances, places and normals, in C's order after sorting by pair and depth; from outside and from within."""
    mj_model, start, find, geoms = _loaded(xml)
    mj_data, places = mujoco.MjData(mj_model), set()
    for seed in range(100):
        mj_data.qpos[:] = _poses(seed)
        mujoco.mj_forward(mj_model, mj_data)
        contact, theirs = find(start.replace(qpos=jnp.asarray(mj_data.qpos))), mj_data.contact
        found = [
            np.column_stack([geoms, contact.dist, contact.pos, contact.frame[:, 0]]),
            np.column_stack([theirs.geom, theirs.dist, theirs.pos, theirs.frame[:, :3]]),
        ]
        assert len(theirs) == num_contacts
        ours, theirs = (x[np.lexsort((x[:, 2], x[:, 1], x[:, 0]))] for x in found)
        # The nearest side of a box that a ball's centre is within 1e-5 of is known to 1e-14 over that.
        np.testing.assert_allclose(ours, theirs, atol=1e-9 if xml is BALL_AND_BOX else 1e-14)
        if xml is not BOXES:
            centre = mj_data.geom_xmat[1].reshape(3, 3).T @ (mj_data.geom_xpos[0] - mj_data.geom_xpos[1])
            round_it = np.array([np.hypot(*centre[:2]), abs(centre[2])]) if xml is CAN else np.abs(centre)
            places.add(tuple(round_it > ([0.1, 0.15] if xml is CAN else mj_model.geom_size[1])))
    assert len(places) == num_places or xml is BOXES


@pytest.mark.parametrize(("xml", "seeds"), [(BOXES, [7]), (CAN, range(4))], ids=["boxes", "cylinder"])
def test_contacts_have_the_derivative_of_their_points(xml, seeds):
    _, start, find, _ = _loaded(xml)

    def outcome(qpos):
        contact = find(start.replace(qpos=qpos))
        normal = contact.frame[0, 0] if xml is CAN else jnp.zeros(0)
        return jnp.concatenate([contact.dist, contact.pos.ravel(), normal])

    both = jax.jit(lambda qpos: (jax.jacrev(outcome)(qpos), central_difference(outcome, qpos, 1e-5)))
    # Cubic errors of 1e-5 are beyond rounding, 1e-16 over 1e-5; normals are divided by distances.
    for seed in seeds:
        np.testing.assert_allclose(*both(jnp.asarray(_poses(seed))), atol=1e-7 if xml is CAN else 1e-9)


def test_on_its_axis_a_ball_on_a_cylinder_has_a_derivative():
    """Upright, centres one above the other: the distance is the height less what is between, whichever way it moves."""
    _, start, find, _ = _loaded(CAN)
    upright = jnp.array([0, 0, 0.21, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0], float)
    slope = jax.jacrev(lambda qpos: find(start.replace(qpos=qpos)).dist[0])(upright)
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
        model = mjx.put_model(mujoco.MjModel.from_xml_string(xml.format(numbers, kind, balls)))
        contact = _finder(model)(mjx.make_data(model))
        is_with_it = np.asarray(contact.geom == 0).any(axis=1)
        found.append(np.column_stack([contact.dist, contact.pos, contact.frame[:, 0]])[is_with_it])
    few, every = found
    assert len(few) == 2
    np.testing.assert_allclose(
        np.sort(few, axis=0), np.sort(every[np.argsort(every[:, 0])[:2]], axis=0), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("kind", ['type="box" size=".1 .2 .05"', 'type="mesh" mesh="block"'])
def test_contacts_of_two_faces_lie_half_way_between_them_as_in_c(kind):
    """A block lies 3 mm deep in another that is larger; the four corners, in C's order after sorting."""
    scene = mg.load_scene(f"""<mujoco><asset><mesh name="block"
      vertex="-.1 -.2 -.05 .1 -.2 -.05 -.1 .2 -.05 .1 .2 -.05 -.1 -.2 .05 .1 -.2 .05 -.1 .2 .05 .1 .2 .05"/></asset>
      <worldbody><geom type="box" size=".5 .5 .1"/><body pos=".02 .03 .147"><freejoint/><geom {kind}/></body></worldbody>
    </mujoco>""")
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    found = _finder(scene.model)(scene.data)
    acts = np.asarray(found.dist) < 0
    ours, theirs = np.asarray(found.pos)[acts].round(9), data.contact.pos.round(9)
    assert len(ours) == len(theirs) == 4
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], atol=1e-8)
    np.testing.assert_allclose(np.asarray(found.dist)[acts], data.contact.dist, atol=1e-9)


def test_a_mesh_that_stands_on_three_corners_has_their_contacts():
    """A prism, 1 mm deep and a little tilted. MJX takes one of the three corners a second time; it counts once."""
    scene = mg.load_scene("""<mujoco><asset><mesh name="prism"
      vertex="-.1 -.1 0 .12 -.08 0 0 .1 0 -.1 -.1 .1 .12 -.08 .1 0 .1 .1"/></asset><worldbody>
      <geom type="box" size=".5 .5 .1"/><body pos="0 0 .099" euler=".05 .03 10"><freejoint/>
        <geom type="mesh" mesh="prism"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    found = _finder(scene.model)(scene.data)
    acts = np.asarray(found.dist) < 0
    ours, theirs = (np.unique(x.round(6), axis=0) for x in (np.asarray(found.pos)[acts], data.contact.pos))
    assert acts.sum() == data.ncon == len(theirs) == 3
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
