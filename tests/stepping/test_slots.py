"""Room for the nearest contacts alone: the same motion while that is enough, and a count of the steps in which it may not be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.contact.collision import collide, first_missed
from mjxgrad.stepping import onset as onsets
from mjxgrad.stepping.assembly import gather

# Two balls that touch the floor and each other, and two far above: nine contacts could be with friction, one without.
_SLIDES = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
SCENE = f"""<mujoco><option timestep="0.004" cone="{{cone}}" tolerance="1e-14"/><worldbody><geom type="plane" size="5 5 .1"/>
<body pos="0 0 .1">{_SLIDES}<geom size=".1" mass="1"/></body>
<body pos=".19 0 .1">{_SLIDES}<geom size=".1" mass=".5"/></body>
<body pos="1 1 2">{_SLIDES}<geom size=".1" mass="1" condim="1"/></body>
<body pos="1 1 3">{_SLIDES}<geom size=".1" mass="1" condim="1"/></body></worldbody></mujoco>"""
HORIZON = 12


def _rolled(scene, contact):
    velocity = jnp.asarray(np.random.default_rng(2).normal(scale=0.3, size=scene.model.nv))

    def last(velocity):
        trajectory = mg.rollout(scene, mg.initial_state(scene, qvel=velocity), horizon=HORIZON, contact=contact)
        return jnp.sin(trajectory.qpos[-1]).sum(), trajectory

    tangent = jnp.cos(jnp.arange(float(velocity.size)))
    _, slope, trajectory = jax.jit(lambda v: jax.jvp(last, (v,), (tangent,), has_aux=True))(velocity)
    return trajectory, slope


@pytest.mark.parametrize(
    ("cone", "contact"),
    [
        ("pyramidal", mg.Discrete()),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in (("pyramidal", mg.Onset()), ("elliptic", mg.Discrete()))),
    ],
    ids=["MuJoCo's", "onset", "elliptic"],
)
def test_room_for_those_that_touch_changes_neither_motion_nor_derivative(cone, contact):
    """Three act, and the fourth that could is over a metre away."""
    scenes = [mg.load_scene(SCENE.format(cone=cone), max_contacts=room) for room in (None, 4)]
    rows = [scene.data._impl.efc_J.shape[0] for scene in scenes]
    assert rows[1] < rows[0]
    (all_of_them, slope), (nearest, other) = (_rolled(scene, contact) for scene in scenes)
    # Sums in another order, over twelve steps of impacts.
    np.testing.assert_allclose(nearest.qpos, all_of_them.qpos, atol=1e-12)
    np.testing.assert_allclose(other, slope, rtol=1e-11)
    assert nearest.crowded == all_of_them.crowded == 0


@pytest.mark.parametrize("contact", [mg.Discrete(), mg.Onset()], ids=["MuJoCo's", "onset"])
def test_more_contacts_than_room_are_counted_in_every_step(contact):
    """A box at rest stands on four corners."""
    box = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .0999"><freejoint/>
        <geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    scene = mg.load_scene(box, max_contacts=2)
    trajectory = jax.jit(lambda: mg.rollout(scene, mg.initial_state(scene), horizon=3, contact=contact))()
    assert trajectory.crowded == 3


def test_no_contact_acts_from_farther_than_the_reach():
    """For balls that fly about, at any speed up to 20 m/s."""
    scene = mg.load_scene(SCENE.format(cone="pyramidal"))
    model = scene.model

    @jax.jit
    @jax.vmap
    def look(qpos, qvel):
        data = mg.forward(model, scene.data.replace(qpos=qpos, qvel=qvel))
        rows, _ = onsets.begin(model, data, gather(model, data), mg.Onset())
        active = jnp.concatenate([row.is_active[:: row.rows_each] for row in rows if row.slots])
        contact = data._impl.contact
        farthest = jnp.max(jnp.where(active, contact.dist - contact.includemargin, -jnp.inf))
        return farthest, onsets.reach(model, data, mg.Onset())

    random = np.random.default_rng(5)
    qpos = np.tile(np.asarray(scene.data.qpos), (3000, 1)) + random.normal(scale=0.05, size=(3000, model.nq))
    qpos[:, [-3, -1]] -= [[1.8, 2.8]]  # the upper ones above the floor, too
    qvel = random.normal(size=(3000, model.nv)) * 10 ** random.uniform(-2, 1, size=(3000, 1))
    farthest, reach = look(jnp.asarray(qpos), jnp.asarray(qvel))
    assert (farthest > 0).sum() > 50
    assert (farthest <= reach).all()


def test_the_first_that_finds_no_room_is_no_nearer_than_any_that_does():
    scene = mg.load_scene(SCENE.format(cone="pyramidal"), max_contacts=2)
    every = mg.load_scene(SCENE.format(cone="pyramidal"))
    missed = jax.jit(lambda data: first_missed(scene.model, collide(scene.model, data)))
    data = jax.jit(mg.forward)(every.model, every.data)
    contact = data._impl.contact
    expected = np.sort(contact.dist[contact.dim == 3])[1]
    placed = scene.data.replace(geom_xpos=data.geom_xpos, geom_xmat=data.geom_xmat)
    np.testing.assert_allclose(missed(placed), expected, rtol=1e-12)
    assert first_missed(every.model, data) == np.inf
