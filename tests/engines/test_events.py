"""The slope of C MuJoCo's outcome: closed forms, secants of the outcome, and what events are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import compare_to_slope, phases
from mjxgrad.engines.events import Surfaces, _by_modes, levers_of
from mjxgrad.engines.jacobians import with_pairs
from mjxgrad.engines.pool import Pool
from tests.scenes import ASSETS

BALL = """<mujoco><option gravity="0 0 0" timestep="{h}"/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .2">
    <joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""
STICK = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .45" euler="0 50 0">
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="-.25 0 0 .25 0 0" size=".03"/></body></worldbody></mujoco>"""
# Both feet land at once, beside knees at their limits, and each hardly moves without the other.
LEGS = """<mujoco><default><geom friction=".9"/><joint axis="0 1 0" armature=".01" damping=".1"/></default><worldbody>
    <geom type="plane" size="5 5 .1"/><body pos="0 0 1.03"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint/>
    <geom type="capsule" size=".05" fromto="0 0 0 0 0 .4"/>
    <body><joint range="-150 0"/><geom type="capsule" size=".04" fromto="0 .1 0 0 .1 -.5"/>
    <body pos="0 .1 -.5"><joint range="-150 0"/>
    <geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/></body></body>
    <body><joint range="-150 0"/><geom type="capsule" size=".04" fromto="0 -.1 0 0 -.1 -.5"/>
    <body pos="0 -.1 -.5"><joint range="-150 0"/>
    <geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/></body></body></body></worldbody></mujoco>"""

PUSHER = """<mujoco><option timestep=".003" cone="elliptic" integrator="implicitfast" impratio="5"/>
    <default><geom solref=".015 1" friction=".6 .01 .001"/></default><worldbody><geom type="plane" size="5 5 .1"/>
    <body pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0" damping="1"/>
    <joint type="slide" axis="0 0 1" stiffness="2000" damping="5"/><joint axis="0 1 0" stiffness="20" damping=".05"/>
    <geom type="box" size=".01 .1 .04" mass=".5"/></body>
    <body pos=".075 0 .06"><freejoint/><geom type="box" size=".06 .08 .06" mass=".4"/></body></worldbody>
    <actuator><velocity joint="x" kv="20"/></actuator></mujoco>"""


def _compared(scene, index, interval, horizon, speeds, count=32, read=3):
    """Return slope and mean derivative of the first coordinates, half way and at the end, over where the motion starts."""

    def outcome(place):
        start = mg.initial_state(scene, scene.data.qpos.at[index].add(place), jnp.asarray(speeds))
        course = mg.rollout(scene.with_engine("mujoco"), start, horizon=horizon, contact=mg.Slope())
        return course.qpos[jnp.array([horizon // 2, horizon]), :read]

    return _to_slope(outcome, interval, count)


def _to_slope(outcome, interval, count):
    parameters = phases(interval, count)
    outcomes, derivatives = jax.jit(jax.vmap(lambda x: jax.jvp(outcome, (x,), (1.0,))))(jnp.asarray(parameters))
    return compare_to_slope(parameters, np.asarray(outcomes), [np.asarray(derivatives)], ("slope",))


@pytest.mark.parametrize("h", [0.002, 0.005])
def test_a_bounce_has_minus_its_restitution_as_slope(h):
    """Critically damped contact of constant impedance leaves e⁻² of the speed; MuJoCo's own derivative is −3 at every step."""
    scene = mg.load_scene(BALL.format(h=h))
    found = _compared(scene, 0, (0.0, 0.03), round(0.24 / h), [-2.0], count=96, read=1)
    np.testing.assert_allclose(found.mean[0, 1], found.slope[1], atol=0.02)
    np.testing.assert_allclose(found.mean[0, 1], -np.exp(-2), atol=0.02)  # the impedance is nearly constant


@pytest.mark.parametrize(
    ("name", "xml", "index", "horizon", "speeds", "read"),
    [("stick", STICK, 1, 230, [0.3, 0, 0], 3), ("legs", LEGS, 1, 150, [0.5, 0, 0.3, 0, 0, 0, 0], 3)],
)
def test_the_mean_derivative_is_the_slope_of_the_outcome(name, xml, index, horizon, speeds, read):
    found = _compared(mg.load_scene(xml), index, (0.0, 0.02), horizon, speeds, read=read)
    # A slope near zero is told by the size of the others.
    off, slope = np.abs(found.error[0]), np.maximum(np.abs(found.slope), 0.2 * np.abs(found.slope).max())
    # The rule is of first order in the time step: of six readings one may be off by more than errors and a twentieth.
    is_right = off <= np.maximum(2 * found.standard_error[0], 0.05 * slope)
    assert is_right.sum() >= is_right.size - 1, (found.mean[0], found.slope)
    assert (off <= np.maximum(2 * found.standard_error[0], 0.25 * slope)).all()


def test_the_motion_is_the_same_to_the_last_bit():
    scene = mg.load_scene(STICK, engine="mujoco")
    courses = [
        jax.jvp(
            lambda v, by=contact: mg.rollout(scene, mg.initial_state(scene, qvel=v), horizon=150, contact=by).qpos,
            (jnp.array([0.3, 0.0, 0.0]),),
            (jnp.ones(3),),
        )[0]
        for contact in (mg.Discrete(), mg.Slope())
    ]
    np.testing.assert_array_equal(*courses)


def _events(xml, qpos, qvel, free=9.81):
    model = mujoco.MjModel.from_xml_string(xml)
    surfaces = Surfaces(model, levers_of(model))
    surfaces.widen(np.array([qvel], float))
    data = mujoco.MjData(surfaces.model)
    data.qpos, data.qvel = qpos, qvel
    near = surfaces.near(data, np.array(qvel, float), np.array(qvel, float), np.full(model.nv, free))
    return None if near is None else near.events


def test_an_event_is_a_gap_within_half_a_step_of_travel():
    """At 2 m/s and 2 ms half a step is 2 mm; the ball touches where its coordinate is −0.1."""
    ball = BALL.format(h=0.002)
    for gap, is_event in ((1.9e-3, True), (-1.9e-3, True), (2.1e-3, False), (-2.1e-3, False)):
        found = _events(ball, [gap - 0.1], [-2.0])
        assert (found is not None) == is_event
        if found is not None:
            np.testing.assert_allclose([found.gaps[0], found.widths[0]], [gap, 2e-3], rtol=1e-9)
            np.testing.assert_allclose(found.rows @ found.moves, [[1.0]])


def test_a_slow_contact_has_the_impedances_width():
    """0.06 of its width, 1 mm by default, or less where a step of free acceleration moves less: 39 µm in 2 ms."""
    for h, width in ((0.003, 6e-5), (0.002, 3.924e-5)):
        assert _events(BALL.format(h=h), [0.99 * width - 0.1], [-0.01]) is not None
        assert _events(BALL.format(h=h), [1.01 * width - 0.1], [-0.01]) is None
        assert _events(BALL.format(h=h), [0.99 * width - 0.1], [-0.01], free=0.0) is None


def test_a_contact_that_rests_is_no_event_however_near_its_surface():
    """Four steps of its travel reach: at 1 mm/s and 2 ms these are 8 µm."""
    for gap, is_event in ((-7.9e-6, True), (-8.1e-6, False)):
        assert (_events(BALL.format(h=0.002), [gap - 0.1], [1e-3]) is not None) == is_event
    assert _events(BALL.format(h=0.002), [-2e-5 - 0.1], [0.0]) is None


def test_a_joint_that_creeps_to_its_limit_does_not_feel_it_before():
    """Damping lets it fall by 2.5 µm a step: after ten it has moved with its start, and is 20 µm from its limit."""
    xml = """<mujoco><option timestep=".0025"/><worldbody><body><joint type="slide" axis="0 0 1" range="0 1" damping="30"/>
        <geom size=".1" mass=".003"/></body></worldbody></mujoco>"""
    found = _compared(mg.load_scene(xml), 0, (4.5e-5, 5.5e-5), 10, [-1e-3], read=1)
    np.testing.assert_allclose(found.derivatives[0, :, 1], 1.0, rtol=1e-4)


def test_margins_and_joint_limits_have_gaps_of_their_own():
    """With a margin of 5 mm at both geoms contact begins at 10 mm; the limit lies at 0.05."""
    ball = (
        BALL.format(h=0.002)
        .replace("<geom size", '<geom margin=".005" size')
        .replace('"1 1 .1"', '"1 1 .1" margin=".005"')
    )
    np.testing.assert_allclose(_events(ball, [0.011 - 0.1], [-2.0]).gaps, [1e-3], rtol=1e-9)
    limited = BALL.format(h=0.002).replace('axis="0 0 1"', 'axis="0 0 1" range="-.05 1"')
    np.testing.assert_allclose(_events(limited, [-0.049], [-2.0]).gaps, [1e-3], rtol=1e-9)


def _landing(joints):
    """Return what begins where both feet are half a millimetre above the floor, falling at 1 m/s."""
    model = mujoco.MjModel.from_xml_string(LEGS)
    data, qvel = mujoco.MjData(model), np.zeros(model.nv)
    data.qpos[3:], qvel[1] = joints, -1.0
    mujoco.mj_kinematics(model, data)
    upright = data.geom_xmat.reshape(-1, 3, 3)[:, 2, 2]
    lowest = min(data.geom_xpos[g, 2] - upright[g] * model.geom_size[g, 1] for g in (3, 5)) - 0.04
    data.qpos[1] -= lowest - 5e-4
    found = _events(LEGS, data.qpos, qvel)
    assert found is not None
    return found


def test_feet_that_cannot_move_apart_are_one_event():
    found = _landing(-0.02)  # rad: away from all limits
    assert len(found.gaps) == 2
    assert len(found.widths) == 1
    assert np.abs(found.moves).max() < 10


def test_a_landing_foot_does_not_carry_its_knee_across_the_limit():
    """The knee lies 0.1 mrad within its limit, which is no event: whatever moves the foot leaves it where it is."""
    found = _landing(-1e-4)
    carried = np.abs(found.moves[3:] * (found.widths + np.abs(found.gaps)))
    assert (carried < 1e-4).all()


def test_force_that_begins_without_a_jump_is_no_event():
    """Small differences see all of it."""
    soft = BALL.format(h=0.002).replace("<geom size", '<geom solimp="0 .9 .01" priority="1" size')
    assert _events(soft, [1e-4 - 0.1], [-2.0]) is None


def test_a_runge_kutta_step_spans_all_of_its_stages():
    """They meet the surface at gaps of 0, 2 and 4 mm, at 2 m/s and 2 ms; the window reaches from -0.4 to 4.4 mm."""
    ball = BALL.format(h=0.002).replace("<option", '<option integrator="RK4"')
    for gap, is_event in ((-0.3e-3, True), (4.3e-3, True), (-0.5e-3, False), (4.5e-3, False)):
        assert (_events(ball, [gap - 0.1], [-2.0]) is not None) == is_event
    found = _compared(mg.load_scene(ball), 0, (0.0, 0.03), 120, [-2.0], read=1)
    off, error = abs(found.mean[0, 1] - found.slope[1]), found.standard_error[0, 1]
    assert off < 2 * error + 0.03  # of -2.6, which a tooth has: some meet the window twice, and scatter
    assert error < 0.1


def test_where_contact_chatters_derivatives_are_the_slope_and_do_not_multiply():
    """A ball that a servo's box pushes along the floor. Followed for two steps, derivatives scatter by 50 times the slope."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1"><freejoint/><geom size=".1" mass="1"/></body>
        <body pos="-.3 0 .1"><joint name="p" type="slide" axis="1 0 0" damping="1"/><geom type="box" size=".05 .2 .05" mass="1"/>
        </body></worldbody><actuator><position joint="p" kp="200"/></actuator></mujoco>"""
    )
    model.opt.tolerance, steps, targets = 1e-12, 300, phases((0.3, 0.8), 33)
    start = {
        "time": np.zeros((33, 1)),
        "qpos": np.tile(model.qpos0, (33, 1)),
        "qvel": np.zeros((33, 7)),
        "act": np.zeros((33, 0)),
    }
    controls = np.repeat(targets[:, None, None], steps, axis=1)
    followed = (np.zeros((33, 14)), np.ones((33, steps, 1)))
    course = Pool(model).follow("slope", {}, start, {"ctrl": controls}, followed)
    outcomes, derivatives = course["qpos"][:, [149, -1], 0], course["change"][:, [149, -1], 0]
    found = compare_to_slope(targets, outcomes, [derivatives], ("slope",))
    assert (np.abs(found.error[0]) < 2 * found.standard_error[0] + 0.02 * found.slope).all()
    assert (found.spread[0] < 0.2 * found.slope).all()  # 0.24, let go to a tenth or after thirty steps


def test_a_hopper_that_lands_on_its_limits_has_its_slope():
    """gymnasium's, by Euler steps: what moves its foot would carry knee and hip off their limits, were they not held."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "hopper.xml"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    scene = mg.load_scene(model)
    scene = eqx.tree_at(lambda s: s.data.ctrl, scene, jnp.full(3, 0.1))  # motors press into the limits
    found = _compared(scene, 1, (0.05, 0.07), 160, [0.5, 0, 0, 0, 0, 0])
    off = np.abs(found.mean[0] - found.slope)
    assert (off <= 2 * found.standard_error[0] + 0.05 * np.abs(found.slope)).all(), (found.mean[0], found.slope)


def test_what_an_event_begins_is_followed():
    """Gymnasium's hopper, that lands, sticks and slips: spanned over one step alone, derivatives scatter ten times as far."""
    scene = mg.load_scene(ASSETS / "hopper.xml")
    scene = eqx.tree_at(lambda s: s.data.qpos, scene, jnp.array([0, 1.22, 0, -0.4, -0.5, 0.3]))
    found = _compared(scene, 1, (0.0, 0.03), 250, [0.5, 0, 0, 0, 0, 0])
    assert (found.spread[0] < 0.05 * np.abs(found.slope).max()).all()


def test_a_contact_of_two_steps_has_its_slope():
    """MuJoCo's stiffest: where the bounce is deep, the next step pushes no more. Over one step alone the mean is -31."""
    scene = mg.load_scene(BALL.format(h=0.002).replace("<geom size", '<geom solref=".004 1" priority="1" size'))
    found = _compared(scene, 0, (0.0, 0.032), 120, [-2.0], count=96, read=1)
    assert abs(found.mean[0, 1] - found.slope[1]) < 0.3  # a tooth has -20


THROWN = """<mujoco><worldbody><body name="bat" mocap="true"><geom name="bat" type="box" size=".2 .2 .02"/></body>
    <body pos="0 0 .2"><freejoint/><geom name="ball" size=".05" mass="1"/></body>
    <body pos="2 0 0"><joint name="j" axis="0 1 0" range="-40 40" damping=".01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body></worldbody></mujoco>"""


def _moved_surface(scene, what):
    """Return the function from a size or place to where the ball and the arm are, half way and at the end."""
    start = mg.initial_state(scene, qvel=jnp.array([0.5, 0.5, -0.5, 0, 5.0, 0, 6.0]))
    ball, turn = scene.mj_model.geom("ball").id, jnp.array([0.0, 0, 1, 0])

    def outcome(x):
        one, inputs = scene, {}
        if what == "radius, range":  # of the ball and of the arm, which never meet
            sizes, ranges = scene.model.geom_size.at[ball, 0].add(x), scene.model.jnt_range.at[1, 1].add(5 * x)
            one = scene.with_model(geom_size=sizes, body_mass=scene.model.body_mass, jnt_range=ranges)
        elif what == "mocap_pos":
            inputs = {what: jnp.tile(x * jnp.array([0.0, 0, 1]), (120, 1, 1))}
        else:
            inputs = {what: jnp.tile(jnp.cos(x / 2) * jnp.array([1.0, 0, 0, 0]) + jnp.sin(x / 2) * turn, (120, 1, 1))}
        course = mg.rollout(one.with_engine("mujoco"), start, horizon=120, contact=mg.Slope(), inputs=inputs)
        return course.qpos[jnp.array([80, 120])][:, jnp.array([0, 2, 7] if what == "radius, range" else [0, 2])]

    return outcome


@pytest.mark.parametrize(("what", "reach"), [("radius, range", 0.01), ("mocap_pos", 0.02), ("mocap_quat", 0.2)])
def test_what_moves_a_surface_has_the_slope_as_mean(what, reach):
    """A ball's radius, a bat's place and turn, a joint's range: small differences are off by 0.1 to 0.7."""
    found = _to_slope(_moved_surface(mg.load_scene(THROWN), what), (-reach, reach), 33)
    off, slope = np.abs(found.error[0]), np.maximum(np.abs(found.slope), 0.2 * np.abs(found.slope).max(axis=0))
    assert (off <= np.maximum(2 * found.standard_error[0], 0.05 * slope)).all(), (found.mean[0], found.slope)


def test_several_steps_at_once_are_those_of_a_rollout():
    """Through a landing that begins in each of them."""
    scene = mg.load_scene(STICK, engine="mujoco")
    for height in np.linspace(-0.348, -0.356, 7):
        place, speed = np.array([0.0, height, 0.0]), np.array([0.3, -2.0, 0.0])

        def course(qvel, place=place):
            last = mg.rollout(scene, mg.initial_state(scene, place, qvel), horizon=3, contact=mg.Slope()).final
            return jnp.concatenate([last.qpos, last.qvel])

        state = {"time": np.zeros((1, 1)), "qpos": place[None], "qvel": speed[None]}
        found = Pool(scene.mj_model).product({}, state, {"ctrl": np.zeros((1, 3, 0))}, gradient="slope")
        by_speed = jax.jacrev(course)(jnp.asarray(speed))
        np.testing.assert_allclose(found["state"][0, :, 3:], by_speed, rtol=1e-4, atol=1e-5)


def test_a_row_that_would_be_carried_across_zero_is_held():
    """Of a foot moved by a height and a knee, (1, 1/2): the knee turns by 0.4 of the gap, unless its limit lies nearer."""
    rows, widths = np.array([[1.0, 0.5], [0.0, -1.0]]), np.full(2, 1e-3)
    for gap, moves in ((-1e-4, [1.0, 0.0]), (-1e-3, [0.8, 0.4])):
        chosen = np.array([True, False])
        found = _by_modes(rows, np.array([0.0, gap]), np.zeros(2), widths, np.zeros(2), chosen, chosen, np.ones(2))
        np.testing.assert_allclose(found.moves[:, 0] * np.sign(found.rows[0, 0]), moves, atol=1e-12)


BOX = """<mujoco><option timestep=".002"/><worldbody><geom type="plane" size="3 3 .1"/><body pos="0 0 .13" euler="0 {tilt} 0">
    <freejoint/><geom type="box" size=".1 .1 .1" mass=".5"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("tilt", "speeds"), [(0, (1.0, 0, -0.5)), (1, (2.0, 0, -0.2))], ids=["flat", "tilted"])
def test_corners_that_land_together_are_taken_together(tilt, speeds):
    """Each alone would turn the box: taken one by one, derivatives are 40 % off, and scatter by 10 times the slope."""
    scene = mg.load_scene(BOX.format(tilt=tilt))

    def outcome(height):
        start = mg.initial_state(scene, scene.data.qpos.at[2].add(height), jnp.array([*speeds, 0, 0, 0]))
        return mg.rollout(scene.with_engine("mujoco"), start, horizon=100, contact=mg.Slope()).qpos[-1, 0]

    found = _to_slope(outcome, (0.0, 0.02), 32)
    assert abs(found.error[0]) <= 2 * found.standard_error[0] + 0.05 * abs(found.slope)
    assert found.spread[0] < 0.3 * abs(found.slope)


ROD = """<mujoco><option timestep=".0025"/><worldbody><geom type="box" size=".3 .3 .1" pos="0 0 -.1"/><body pos="0 0 .0302">
    <freejoint/><geom type="cylinder" size=".02 .03" mass=".1"/></body></worldbody></mujoco>"""


def test_a_cylinder_that_stands_on_a_box_has_the_slope_as_mean():
    """Its lowest point runs along the rim at tilts of rounding size; small differences scatter a thousand times as far."""
    scene = mg.load_scene(ROD, engine="mujoco")

    def outcome(place):
        start = mg.initial_state(scene, qvel=jnp.array([0.05, 0.02 + place, 0, 0.03, 0.02, 0.01]))
        return mg.rollout(scene, start, horizon=60, contact=mg.Slope()).qpos[-1, :2]

    found = _to_slope(outcome, (-0.1, 0.1), 33)
    assert np.all(np.abs(found.error[0]) <= 2 * found.standard_error[0] + 0.05 * np.abs(found.slope).max())
    assert np.all(found.spread[0] < 0.1 * np.abs(found.slope).max())


CLOTH = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><flexcomp name="cloth" type="grid" count="2 2 1"
    spacing=".1 .1 .1" pos="0 0 .14" euler="12 7 0" radius=".02" mass=".5" dim="2">
    <edge equality="true"/></flexcomp></worldbody></mujoco>"""


def test_a_cloth_that_lands_has_the_slope_as_mean():
    """Its vertices are bodies that slide, and its contacts have no geom on its side."""
    scene = mg.load_scene(CLOTH)
    speeds = jnp.tile(jnp.array([0.3, 0.0, -1.0]), 4)

    def outcome(place):
        start = mg.initial_state(scene, qvel=speeds.at[2::3].add(place))
        return mg.rollout(scene, start, horizon=60, contact=mg.Slope()).qpos[-1, jnp.array([0, 2])]

    found = _to_slope(outcome, (-0.3, 0.3), 33)
    assert np.all(np.abs(found.error[0]) <= 2 * found.standard_error[0] + 0.05 * np.abs(found.slope))
    assert np.all(found.mean_error[0] < 0.2 * np.abs(found.slope).max())


def test_a_soft_limit_at_its_surface_does_not_narrow_differences():
    """Force without a jump may be crossed: a width of zero would give NaN."""
    scene = mg.load_scene(
        """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .0999"><joint type="slide" axis="0 0 1" range="0 1"
        limited="true" solimplimit="0 .9 .01"/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>""",
        engine="mujoco",
    )
    assert np.isfinite(mg.linearise(scene, mg.initial_state(scene), contact=mg.Slope()).A).all()


def test_rounding_decides_no_derivative():
    """A puck held on a tilted floor by its joints touches it at random; where it starts, it ends as much farther."""
    scene = mg.load_scene("""<mujoco><worldbody><body euler="20 30 10"><geom type="plane" size="5 5 .1"/><body pos=".1 .2 .1">
        <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
        </mujoco>""")
    num_acting = [_num_contacts(scene, x) for x in np.linspace(0, 1, 50)]
    assert 0 < sum(num_acting) < 50

    def outcome(x):
        start = mg.initial_state(scene, jnp.array([x, 0.0]), jnp.array([0.5, 0.2]))
        return mg.rollout(scene.with_engine("mujoco"), start, horizon=50, contact=mg.Slope()).final.qpos

    _, derivatives = jax.vmap(lambda x: jax.jvp(outcome, (x,), (1.0,)))(jnp.linspace(0, 0.1, 8))
    np.testing.assert_allclose(
        derivatives, np.tile([1.0, 0.0], (8, 1)), atol=1e-4
    )  # differences of 1e-6 of a few mm a step


def _num_contacts(scene, x):
    data = mujoco.MjData(scene.mj_model)
    data.qpos[0] = x
    mujoco.mj_forward(scene.mj_model, data)
    return data.ncon


@pytest.mark.parametrize("speed", [0.325, 0.375, 0.425])
def test_a_derivative_along_faces_that_touch_is_no_steeper_than_a_step_can_be(speed):
    """A plate pushes a crate, face to face: their points of contact jump with turns of a microradian.

    No stable contact changes a velocity by more than 1/h with a position, both of the farthest points that they move. Averaged
    over a jump that is near a surface the derivative was four times as steep, and such steps multiply: of a loader to 1e11.
    """
    model, num_steps = mujoco.MjModel.from_xml_string(PUSHER), 100
    engine, rest = Pool(model), {"act": np.zeros((1, 0)), "time": np.zeros((1, 1))}
    start = {"qpos": model.qpos0[None].copy(), "qvel": np.zeros((1, model.nv)), **rest}
    inputs = {"ctrl": np.full((1, num_steps, 1), speed)}
    before = engine._before(start, engine.run({}, start, inputs))
    how = {"gradient": "slope", "wanted": (*with_pairs(("ctrl",)), "flight")}
    found = engine.maps({}, before, inputs, engine.no_flight((1,)), **how)["state"][0]
    levers = levers_of(model).max(axis=0)
    steep = np.abs(found[:, model.nv :, : model.nv] * levers[:, None] / levers)
    assert steep.max() < 1 / model.opt.timestep
