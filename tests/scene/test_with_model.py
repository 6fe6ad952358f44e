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


# A capsule whose frame the compiler takes from the centre of mass, and a body that hangs from a hinge.
COPIED = """<mujoco><option timestep=".004"/><worldbody><geom name="floor" type="plane" size="2 2 .1"/>
  <body name="limb" pos="0 0 .31"><joint type="slide" axis="0 0 1" damping="3"/>
  <geom name="limb" type="capsule" size=".1" fromto="-.2 0 -.2 .2 0 -.2" mass="1"/></body>
  <body name="bar" pos="2 0 1"><joint type="hinge" axis="0 1 0"/><geom name="bar" pos=".3 0 0" size=".1" mass="1"/>
  <site name="tip"/></body></worldbody><sensor><framepos objtype="site" objname="tip"/></sensor></mujoco>"""


def _compiled(change, steps, file=COPIED):
    """Return where a file ends up that is changed before it is compiled, and what it reads then."""
    spec = mujoco.MjSpec.from_string(file)
    change(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    mujoco.mj_forward(model, data)
    return np.concatenate([data.qpos, data.sensordata])


def _centre(spec):
    body, plain = spec.body("limb"), mujoco.MjModel.from_xml_string(COPIED)
    body.explicitinertial, body.mass, body.ipos = True, 1.0, [0, 0, -0.1]
    body.inertia, body.iquat = plain.body_inertia[1], plain.body_iquat[1]


def _up(spec):
    spec.geom("limb").fromto, spec.geom("limb").pos = np.full(6, np.nan), [0, 0, -0.1]
    spec.geom("limb").quat, spec.geom("limb").size = [0.5**0.5, 0, 0.5**0.5, 0], [0.1, 0.2, 0]
    _centre_stays(spec)


def _centre_stays(spec):
    body, plain = spec.body("limb"), mujoco.MjModel.from_xml_string(COPIED)
    body.explicitinertial, body.mass, body.ipos = True, 1.0, plain.body_ipos[1]
    body.inertia, body.iquat = plain.body_inertia[1], plain.body_iquat[1]


def _site(spec):
    spec.site("tip").pos = [0.05, 0, 0]


def _floating(spec):
    spec.body("bar").gravcomp = 0.5


CHANGES = [
    ("body_ipos", (1, 2), -0.1, _centre),
    ("geom_pos", (1, 2), -0.1, _up),
    ("site_pos", (0, 0), 0.05, _site),
    ("body_gravcomp", (2,), 0.5, _floating),
]


@pytest.mark.parametrize(
    ("field", "index", "value", "change", "engine"),
    [(*one, "mujoco") for one in CHANGES] + [(*one, "mjx") for one in (CHANGES[0], CHANGES[-1])],
)
def test_what_the_compiler_copied_or_left_off_changes_as_in_a_file(field, index, value, change, engine):
    """Capsules lie at rest, the bar still swings. The derivative is a difference of such files."""
    scene, steps = mg.load_scene(COPIED, engine=engine), 300 if engine == "mujoco" else 20

    def end(value):
        changed = scene.with_model(**{field: getattr(scene.model, field).at[index].set(value)})
        seen = lambda model, data: data.sensordata  # noqa: E731
        found = mg.rollout(changed, mg.initial_state(changed), horizon=steps, observe=seen)
        return jnp.concatenate([found.qpos[-1], found.observations[-1]])

    np.testing.assert_allclose(end(value), _compiled(change, steps), atol=1e-6)
    assert np.abs(end(value) - _compiled(lambda _: None, steps)).max() > 1e-4 or field == "body_ipos"
    if engine == "mujoco":
        slope, width = jax.jacfwd(end)(value), 1e-5
        np.testing.assert_allclose(slope, (end(value + width) - end(value - width)) / (2 * width), rtol=1e-4, atol=1e-4)


BOX = """<mujoco><worldbody><body name="box" pos="0 0 1">{joint}<geom type="box" size=".1 .2 .3" mass="1"/></body>
  <body><joint name="j"/><geom size=".1" pos=".1 0 0"/></body></worldbody></mujoco>"""


def test_what_was_left_out_of_a_model_cannot_change():
    """Of a free box MuJoCo keeps a diagonal inertia; of dry friction that is zero MJX keeps no row."""
    scene = mg.load_scene(BOX.format(joint="<freejoint/>"))
    moved = scene.model.body_ipos.at[1, 0].set(0.05)
    with pytest.raises(ValueError, match="body_ipos of box, whose inertia was compiled as diagonal, cannot change"):
        scene.with_model(body_ipos=moved)
    with pytest.warns(SceneWarning, match="body_ipos of box, whose inertia was compiled as diagonal, has no effect"):
        jax.eval_shape(lambda x: scene.with_model(body_ipos=x), moved)
    scene.with_model(body_ipos=scene.model.body_ipos.at[2, 0].set(0.05))
    ball = '<body name="ball"><freejoint/><geom size=".1"/></body>'
    two = mg.load_scene(BOX.format(joint="<freejoint/>").replace("<body><joint", f"{ball}<body><joint"))
    with pytest.raises(ValueError, match="body_ipos of ball, whose"):
        two.with_model(body_ipos=two.model.body_ipos.at[2, 0].set(0.05))
    slides = mg.load_scene(BOX.format(joint='<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'))
    with pytest.raises(ValueError, match="jnt_axis of box"):
        slides.with_model(jnt_axis=slides.model.jnt_axis.at[1, 0].set(1.0))
    with pytest.raises(ValueError, match="dof_frictionloss that is zero in the file is left out by MJX"):
        scene.with_model(dof_frictionloss=jnp.ones(7))
    scene.with_engine("mujoco").with_model(dof_frictionloss=jnp.ones(7))


def test_numbers_that_are_rounding_have_the_derivative_of_zero():
    """A hinge's axis, turned by the file's degrees, and a bar's place: 0 and 1e-17 m are one."""
    scene = mg.load_scene(COPIED, engine="mujoco")

    def swing(place):
        changed = scene.with_model(body_pos=scene.model.body_pos.at[2, 1].set(place[0]))
        changed = changed.with_model(body_ipos=changed.model.body_ipos.at[2, 2].set(place[1]))
        return mg.rollout(changed, mg.initial_state(changed), horizon=50).qpos[-1, 1]

    at = [jax.grad(swing)(jnp.full(2, place)) for place in (0.0, 1e-17, 1e-12, 1e-9)]
    assert abs(at[0][1]) > 0.1
    for slope in at[1:]:
        np.testing.assert_allclose(slope, at[0], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("length", [1.0, 2.0])
def test_a_quaternion_counts_by_its_direction(length):
    """A body that turns freely from a quaternion of any length, in its state and in its model; by finite differences."""
    scene = mg.load_scene(BOX.format(joint="<freejoint/>"), engine="mujoco")
    turn = length * jnp.array([0.5, 0.5, 0.1, 0.7]) / jnp.linalg.norm(jnp.array([0.5, 0.5, 0.1, 0.7]))

    def end(turn, mounted):
        changed = scene.with_model(body_quat=scene.model.body_quat.at[2].set(mounted))
        start = jnp.concatenate([scene.data.qpos.at[3:7].set(turn)[:7], jnp.zeros(1)])
        state = mg.initial_state(changed, qpos=start, qvel=jnp.arange(7.0))
        return mg.rollout(changed, state, horizon=20).qpos[-1] @ jnp.arange(1.0, 9.0)

    found = jax.grad(end, (0, 1))(turn, turn)
    for k, slope in enumerate(found):
        pairs = [
            [turn + side * 1e-6 * one if k == i else turn for i in range(2)] for one in jnp.eye(4) for side in (1, -1)
        ]
        ends = np.array([end(*pair) for pair in pairs]).reshape(4, 2)
        np.testing.assert_allclose(slope, (ends[:, 0] - ends[:, 1]) / 2e-6, rtol=1e-4, atol=1e-4)


def test_parameters_may_be_set_one_after_the_other():
    """Two masses on springs, the second set after the first, and once more by both: all have their derivatives."""
    scene = mg.load_scene(COPIED, engine="mujoco")
    by = lambda body: lambda scene, x: scene.with_model(body_mass=scene.model.body_mass.at[body].multiply(x))  # noqa: E731

    def end(numbers, one_by_one):
        step = (
            (lambda scene, body, x: scene.with_parameters(by(body), x)) if one_by_one else lambda s, b, x: by(b)(s, x)
        )
        changed = step(step(step(scene, 1, numbers[0]), 2, numbers[1]), 1, numbers[2])
        found = mg.rollout(changed, mg.initial_state(changed, qvel=jnp.array([0.0, 1.0])), horizon=10)
        return found.qpos[-1] @ jnp.array([1.0, 2.0])

    numbers = jnp.array([1.1, 0.9, 1.3])
    expected = jax.grad(lambda x: end(x, False))(numbers)
    assert (np.abs(expected[jnp.array([0, 2])]) > 1e-6).all()
    np.testing.assert_allclose(jax.grad(lambda x: end(x, True))(numbers), expected, rtol=1e-5, atol=1e-9)
