"""What is converted moves as before; what cannot quite is warned about."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad._mjx import mjx
from mjxgrad.contact.collision import collide
from mjxgrad.scene import SceneWarning, load_scene
from mjxgrad.stepping import forward
from tests.scene.test_refusals import BALL, PENDULUM, fill

BOX = """
<mujoco>
  <option timestep="0.005" {option}/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.095" euler="1 2 0"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""
CUBE = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))


def _pendulum(**parts):
    return fill(PENDULUM, joint='stiffness="5" damping="1"', **parts)


def _ball(friction="1", condim=3, **parts):
    return fill(BALL, asset=f'<default><geom friction="{friction}" condim="{condim}"/></default>', **parts)


# Source, and the setting that the conversion names.
EXACT = {
    "energy": (_ball(flag="<flag energy='enable'/>"), "flag energy"),
    "fwdinv": (_ball(flag="<flag fwdinv='enable'/>"), "flag fwdinv"),
    "island": (_ball(flag="<flag island='disable'/>"), "flag island"),
    "multiccd": (_ball(flag="<flag multiccd='disable'/>"), "flag multiccd"),
    "CG": (_ball(option="solver='CG'"), "solver"),
    "PGS": (_ball(option="solver='PGS'"), "solver"),
    "wind": (_pendulum(option="wind='3 0 0'"), "wind"),
    "wind and implicitfast": (_pendulum(option="wind='3 0 0' integrator='implicitfast'"), "wind"),
    "neither": (_pendulum(flag="<flag spring='disable' damper='disable'/>"), "flag eulerdamp"),
    "frictionless pyramid": (_ball(friction="0 0 0"), "friction of floor – g"),
    "frictionless cone": (_ball(friction="0 0 0", option="cone='elliptic'"), "friction of floor – g"),
    "rolls freely": (_ball(friction="1 0 0", condim=6), "friction of floor – g"),
    "frictionless pair": (
        _ball(rest="<contact><pair geom1='g' geom2='floor' friction='0 0 0 0 0'/></contact>"),
        "friction of floor – g"),
}  # fmt: skip


def _velocities(model, steps=8):
    data = mujoco.MjData(model)
    data.qvel[:] = np.linspace(0.5, -0.7, model.nv)
    data.ctrl[:] = 0.7
    velocities = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        velocities.append(data.qvel.copy())
    return np.array(velocities)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", EXACT)
def test_a_conversion_is_reported_and_moves_the_same(case):
    """C MuJoCo steps the file and the converted model."""
    source, what = EXACT[case]
    scene = load_scene(source)
    assert [c.what for c in scene.conversions] == [what]
    assert scene.conversions[0].exact
    given = _velocities(mujoco.MjModel.from_xml_string(source))
    # Iterative solvers stop early by their own measure, so CG and PGS agree less closely.
    tolerance = 1e-6 if what == "solver" else 1e-12
    np.testing.assert_allclose(_velocities(scene.mj_model), given, atol=tolerance)


def test_mjx_moves_the_converted_scene_as_c_mujoco_does_and_only_that():
    source, _ = EXACT["neither"]
    model = mujoco.MjModel.from_xml_string(source)
    given = _velocities(model)
    step = jax.jit(mjx.step)

    def roll(mjx_model, data):
        data = data.replace(qvel=jnp.linspace(0.5, -0.7, model.nv), ctrl=jnp.full(model.nu, 0.7))
        velocities = []
        for _ in given:
            data = step(mjx_model, data)
            velocities.append(np.array(data.qvel))
        return np.array(velocities)

    scene = load_scene(source)
    np.testing.assert_allclose(roll(scene.model, scene.data), given, atol=1e-8)
    plain = roll(mjx.put_model(model), mjx.make_data(model))
    assert not np.allclose(plain, given, atol=1e-4)


def test_pgs_with_elliptic_cones_does_not_reach_the_optimum_and_is_warned_about():
    source = BOX.format(option="solver='PGS' cone='elliptic' iterations='10000' tolerance='0'")
    with pytest.warns(SceneWarning, match="solver: Newton instead of PGS.*stops short"):
        scene = load_scene(source)
    given = _velocities(mujoco.MjModel.from_xml_string(source))
    assert np.abs(_velocities(scene.mj_model) - given).max() > 1e-2


def test_a_solve_that_would_end_short_is_let_to_its_end():
    """As in the robots of MuJoCo Playground, whose derivative would be that of another motion."""
    source = BOX.format(option="iterations='1'")
    with pytest.warns(SceneWarning, match="iterations: 100 instead of 1: .*derivative"):
        scene = load_scene(source)
    short = _velocities(mujoco.MjModel.from_xml_string(source))
    ended = _velocities(mujoco.MjModel.from_xml_string(source.replace("iterations='1'", "tolerance='0'")))
    found = _velocities(scene.mj_model)
    assert np.abs(found - ended).max() < 1e-4 * np.abs(short - ended).max()


def test_few_iterations_are_no_matter_where_nothing_is_solved():
    scene = load_scene(_pendulum(option="iterations='1'"))  # a warning fails the test
    assert scene.mj_model.opt.iterations == 1


def _limited(actuator):
    rest = "<actuator>" + actuator.format("name='a' joint='j'") + "</actuator>"
    return _pendulum(option="integrator='implicitfast'", rest=rest), "integrator at actuator 'a'.*derivative ignores"


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (_ball(flag="<flag sleep='enable'/>"), "flag sleep: disable instead of enable"),
        (
            BOX.format(option="integrator='implicitfast'"),
            "integrator: implicitfast without the gyroscopic derivative instead of implicitfast: MJX has none",
        ),
        _limited("<position kv='2' forcerange='-.1 .1' {}/>"),
        _limited("<general gaintype='affine' gainprm='1 0 -2' ctrlrange='-.1 .1' ctrllimited='true' {}/>"),
        _limited("<muscle lengthrange='-1 1' {}/>"),
    ],
)
def test_what_does_not_move_quite_the_same_is_warned_about(source, said):
    with pytest.warns(SceneWarning, match=said):
        load_scene(source)


def test_no_body_sleeps_by_c_mujoco_either():
    with pytest.warns(SceneWarning, match="flag sleep: disable instead of enable"):
        scene = load_scene(_ball(flag="<flag sleep='enable'/>"), engine="mujoco")
    assert not scene.mj_model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP


def _num_touching(scene):
    """Contacts found in C MuJoCo and by the library."""
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    distances = jax.jit(lambda m, d: collide(m, mjx.kinematics(m, d)))(scene.model, scene.data)._impl.contact.dist
    return data.ncon, int((distances < 0).sum())


def test_where_mjx_finds_other_contacts_c_mujoco_steps_the_scene_or_the_summary_says_so():
    lying = load_scene(
        """
        <mujoco>
          <worldbody>
            <geom type="capsule" size="0.1 0.3" euler="0 90 0"/>
            <body pos="0 0 0.19"><freejoint/>
              <geom type="capsule" size="0.1 0.3" euler="0 90 0"/>
            </body>
          </worldbody>
        </mujoco>
        """
    )
    assert _num_touching(lying) == (2, 1)
    assert "MJX has no second contact of capsules that are exactly parallel" in lying.summary()
    # The lower corners are at 95 − 100 (1 ± 0.0175 ± 0.035) mm: −10.2, −6.7, −3.2 and 0.3.
    tilted = load_scene(BOX.format(option=""))
    assert _num_touching(tilted) == (3, 3)
    assert "Unlike C MuJoCo" not in tilted.summary()
    as_mesh = BOX.format(option="").replace('type="box" size="0.1 0.1 0.1"', 'type="mesh" mesh="cube"')
    as_mesh = as_mesh.replace("<worldbody>", f"<asset><mesh name='cube' vertex='{CUBE}'/></asset><worldbody>")
    said = "MJX has no contacts of meshes and height fields like C MuJoCo's"
    with pytest.warns(SceneWarning, match=f"C MuJoCo steps it: {said}"):
        assert load_scene(as_mesh).engine == "mujoco"
    with pytest.warns(SceneWarning, match=f"the MJCF: {said}, got .*mesh"):
        taken = load_scene(as_mesh, engine="mjx")
    assert taken.engine == "mjx"
    assert _num_touching(taken) == (3, 1)
    assert said in taken.summary()


def test_a_gap_that_rounding_closes_is_warned_of_where_nothing_moves_it():
    """A ball that slides in the plane that it touches; not one that may leave it."""
    slides = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body pos="0 0 .5">
      <joint type="slide" axis="1 0 0"/>{}<geom name="ball" size=".5"/></body></worldbody></mujoco>"""
    with pytest.warns(SceneWarning, match="rounding like C MuJoCo's.* got geom 'floor' with geom 'ball'; lift or sink"):
        load_scene(slides.format(""))
    assert "rounding" not in load_scene(slides.format('<joint type="slide" axis="0 0 1"/>')).summary()


def test_a_sensor_that_mjx_lacks_is_warned_about_and_the_others_stay():
    sensors = (
        "<sensor><jointpos joint='j'/><e_potential name='energy'/>"
        "<jointvel name='late' joint='j' delay='0.02' nsample='5'/></sensor>"
    )
    with pytest.warns(SceneWarning, match="reads 0") as said:
        scene = load_scene(_pendulum(rest=sensors))
    assert ["'energy'" in str(said[0].message), "'late'" in str(said[1].message)] == [True, True]
    data = scene.data.replace(qpos=jnp.array([0.3]), time=jnp.array(1.0))
    data = jax.jit(lambda m, d: mjx.sensor_pos(m, mjx.kinematics(m, d)))(scene.model, data)
    np.testing.assert_array_equal(data.sensordata, [0.3, 0, 0])
    # The C model keeps all three.
    assert mujoco.mjtSensor.mjSENS_E_POTENTIAL in scene.mj_model.sensor_type


def test_frictionless_contacts_beside_elliptic_ones_have_rows_of_both_kinds():
    source = """
    <mujoco>
      <option cone="elliptic"/>
      <worldbody>
        <geom type="plane" size="1 1 1" condim="1"/>
        <body pos="0 0 0.09"><freejoint/><geom size="0.1" condim="1"/></body>
        <body pos="1 0 0.09"><freejoint/><geom size="0.1" condim="4"/></body>
      </worldbody>
    </mujoco>
    """
    scene = load_scene(source)
    with pytest.raises(NotImplementedError, match="condim=1"):
        mjx.make_data(scene.mj_model)
    kinds = mujoco.mjtConstraint
    # One frictionless pair, then two pairs of condim 4, ball on floor and ball on ball.
    expected = [kinds.mjCNSTR_CONTACT_FRICTIONLESS] + 8 * [kinds.mjCNSTR_CONTACT_ELLIPTIC]
    assert [int(t) for t in scene.data._impl.efc_type] == [int(t) for t in expected]
    np.testing.assert_array_equal(scene.data._impl.contact.efc_address, [0, 1, 5])
    assert scene.data._impl.efc_J.shape == (9, 12)


def test_a_touch_sensor_where_nothing_can_touch_reads_zero():
    """MJX puts the forces of all contacts together for it, and fails of none; so does dm_control's cartpole."""
    scene = load_scene(
        '<mujoco><worldbody><body><joint/><geom size=".1"/><site name="skin" size=".2"/></body></worldbody>'
        '<sensor><touch site="skin"/></sensor></mujoco>'
    )
    data = jax.jit(forward)(scene.model, scene.data)
    np.testing.assert_array_equal(data.sensordata, [0.0])


def test_a_muscle_has_a_derivative_in_single_precision():
    """MJX divides by the width of its switch, 1e-15 for none, and takes the fifth power, which overflows."""
    source = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
        <actuator><muscle joint="j" lengthrange="0 1"/></actuator></mujoco>"""
    with jax.enable_x64(False):
        scene = load_scene(source)
        data = scene.data.replace(act=jnp.array([0.1]), ctrl=jnp.array([0.3]))
        found = jax.jit(jax.grad(lambda act: forward(scene.model, data.replace(act=act)).act_dot[0]))(data.act)
    # The rate is (u - a) / (0.01 (0.5 + 1.5 a)), whose derivative by a is -(0.5 + 1.5 u) / (0.01 (0.5 + 1.5 a)^2).
    np.testing.assert_allclose(found, -0.95 / (0.01 * 0.65**2), rtol=1e-5)
