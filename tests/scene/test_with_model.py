"""Numbers of a model are replaced by name, and what cannot be is said."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.scene import SceneWarning

H = 0.01
SLIDER = f"""<mujoco><option timestep="{H}" gravity="0 0 0"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0" damping="1" limited="true" range="-1 2"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor joint="x" ctrllimited="true" ctrlrange="-1 3"/><motor joint="x"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(SLIDER)


def test_a_replaced_number_acts_and_is_differentiated(scene):
    """Implicit damping in one step from 1 m/s: v = 1 / (1 + h c / m), with derivative −(h / m) v² by c."""

    def speed(damping):
        moved = scene.with_model(dof_damping=damping)
        return mg.rollout(moved, mg.initial_state(moved, qvel=jnp.ones(1)), horizon=1).qvel[-1, 0]

    value, slope = jax.jit(jax.value_and_grad(speed))(jnp.array([5.0]))
    expected = 1 / (1 + H * 5 / 2)
    np.testing.assert_allclose([value, slope[0]], [expected, -(H / 2) * expected**2], rtol=1e-12)


def test_a_mass_and_a_damping_are_taken_without_a_word(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.with_model(dof_damping=jnp.ones(1))
        scene.with_model(body_mass=2 * scene.model.body_mass)


def test_what_a_changed_mass_does_not_touch_stays_known_while_traced(scene):
    def damping_is_known(mass):
        model = scene.with_model(body_mass=mass).model
        assert not isinstance(model.dof_damping, jax.core.Tracer)
        return model.dof_invweight0

    found = jax.jit(damping_is_known)(2 * scene.model.body_mass)
    np.testing.assert_allclose(found, scene.model.dof_invweight0 / 2, rtol=1e-12)  # 1/m


def test_a_damping_of_a_scene_loaded_without_is_said():
    bare = mg.load_scene(SLIDER.replace('damping="1"', ""))
    with pytest.warns(SceneWarning, match="integrated explicitly"):
        bare.with_model(dof_damping=jnp.ones(1))


def test_a_control_without_limits_has_infinite_ones(scene):
    np.testing.assert_array_equal(scene.ctrlrange, [[-1, 3], [-np.inf, np.inf]])


def test_a_pose_beyond_a_joint_s_range_is_said(scene):
    with pytest.warns(SceneWarning, match="x begins at 2.5 m, beyond its range from -1 to 2 m"):
        mg.initial_state(scene, qpos=np.array([2.5]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mg.initial_state(scene, qpos=np.array([2.0]))
        jax.jit(lambda qpos: mg.initial_state(scene, qpos=qpos))(jnp.array([2.5]))  # not known while traced


SENSED = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body pos="0 0 .09">
  <joint type="slide" axis="0 0 1"/><geom name="ball" size=".1"/><site name="tip" pos="0 0 .1" size=".2"/></body></worldbody>
  <sensor><touch name="touch" site="tip"/><framepos name="place" objtype="site" objname="tip"/></sensor></mujoco>"""


def test_sensors_and_sites_are_read_by_name_as_in_c():
    scene = mg.load_scene(SENSED)

    def look(model, data):
        return mg.sensor(model, data, "touch"), mg.sensor(model, data, "place"), mg.site_position(model, data, "tip")

    touch, place, tip = jax.jit(
        lambda: mg.rollout(scene, mg.initial_state(scene), horizon=1, observe=look).observations
    )()
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    assert data.sensor("touch").data[0] > 1
    np.testing.assert_allclose(touch[0], data.sensor("touch").data, rtol=1e-6)
    np.testing.assert_allclose(place[0], [0, 0, 0.19], atol=1e-12)
    np.testing.assert_allclose(tip, place, atol=1e-12)
    for read, message in (
        (mg.sensor, "there is no sensor 'nose'; named sensors are 'touch', 'place'"),
        (mg.site_position, "there is no site 'nose'; named sites are 'tip'"),
    ):
        with pytest.raises(ValueError, match=message):
            read(scene.model, scene.data, "nose")


def test_a_rangefinder_sees_a_scene_without_materials():
    scene = mg.load_scene("""<mujoco><worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 .5">
      <freejoint/><geom size=".1"/><site name="down" pos="0 0 -.1" zaxis="0 .1 -1"/></body></worldbody>
      <sensor><rangefinder name="height" site="down"/></sensor></mujoco>""")
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    found = jax.jit(mg.forward)(scene.model, scene.data).sensordata
    np.testing.assert_allclose(found, data.sensordata, rtol=1e-12)
    assert found[0] > 0.4


def test_c_mujoco_finds_contacts_of_geoms_that_have_moved_and_grown():
    """Balls moved out through the floor, on a body whose inertia is turned, touch as if compiled there."""

    def mjcf(reach, radius):
        balls = "".join(f'<geom pos="{x * reach} {y * reach} {z * reach}" size="{radius}"/>' for x, y, z in places)
        floor = '<geom type="plane" size="1 1 1"/>'
        return f"<mujoco><worldbody>{floor}<body pos='0 0 .5'><freejoint/>{balls}</body></worldbody></mujoco>"

    places = np.array([[1, 0, -1], [0, 1, -1], [-1, -1, -1], [0.5, 0, 1], [1, 1, 1]])
    near, far = mg.load_scene(mjcf(0.2, 0.05)), mujoco.MjModel.from_xml_string(mjcf(0.49, 0.08))
    moved = near.with_model(geom_pos=far.geom_pos, geom_size=far.geom_size).to_mujoco()
    counts = []
    for model in (moved, far):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        counts.append(data.ncon)
    assert counts == [3, 3]


FALLING = """<mujoco><option timestep="0.01" gravity="0 0 -1" density="{density}" viscosity="1e-5"/><worldbody>
  <body><freejoint/><geom size=".1" mass="2"/></body></worldbody></mujoco>"""


def test_time_step_and_gravity_are_replaced_under_grad_and_vmap():
    """Ten steps h of semi-implicit Euler under g fall g h² (1 + ... + 10) = 55 g h², without a medium."""
    scene = mg.load_scene(FALLING.format(density=0).replace('viscosity="1e-5"', ""))

    def height(h, g):
        moved = scene.with_model(timestep=h, gravity=jnp.stack([0.0, 0.0, g]))
        return mg.rollout(moved, mg.initial_state(moved), horizon=10).qpos[-1, 2]

    steps, pulls = jnp.array([0.01, 0.02]), jnp.array([-9.81, 0.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(height, (0, 1))))(steps, pulls)
    np.testing.assert_allclose(values, 55 * pulls * steps**2, atol=1e-15)
    np.testing.assert_allclose(slopes[0], 110 * pulls * steps, atol=1e-13)
    np.testing.assert_allclose(slopes[1], 55 * steps**2, rtol=1e-12)


def test_wind_blows_as_in_c_mujoco_and_says_where_there_is_nothing_to_blow():
    scene = mg.load_scene(FALLING.format(density=1.2)).with_model(wind=jnp.array([10.0, 0, 0]))
    model = scene.to_mujoco()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 10)
    found = mg.rollout(scene, mg.initial_state(scene), horizon=10).qvel[-1]
    assert data.qvel[0] > 0.05
    np.testing.assert_allclose(found, data.qvel, rtol=1e-9, atol=1e-12)
    with pytest.warns(SceneWarning, match="without a medium"):
        mg.load_scene(SLIDER).with_model(wind=jnp.ones(3))
