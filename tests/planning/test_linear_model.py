"""Smoothed linear models against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad.bodies.kinematics import position_change
from mjxgrad.planning.linear_model import Analytic, Exact
from mjxgrad.planning.system import GoalCost, SceneSystem
from mjxgrad.planning.trajectory import posed
from mjxgrad.stepping import Smoothing, own_motion
from tests.scenes import PUSHED_BALL

POINT, CONTROL, STDDEV = 0.03, jnp.zeros(1), 0.05


def analytic(system, state, control, smoothing=None):
    return Analytic(smoothing).linear_model(system, state, control, None)


SPRING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0" stiffness="3" damping="0.4"/><geom size="0.1" mass="0.5"/></body></worldbody>
  <actuator><motor joint="x"/></actuator></mujoco>"""


@pytest.mark.parametrize("gradient", ["discrete", pytest.param("slope", marks=pytest.mark.slow)])
def test_a_ball_on_a_spring_is_found_without_error(gradient):
    """One step: v ← (m v + h (u − k q)) / (m + h c), q ← q + h v; here two of them."""
    h, m, k, c = 0.01, 0.5, 3.0, 0.4
    rate = np.array([-h * k, m]) / (m + h * c)
    one_a = np.array([[1 + h * rate[0], h * rate[1]], rate])
    one_b = np.array([[h], [1]]) * h / (m + h * c)
    system = SceneSystem(mg.load_scene(SPRING), num_substeps=2, contact=own_motion(gradient))
    model = eqx.filter_jit(analytic)(system, jnp.array([0.1, -0.3]), jnp.array([0.7]))
    np.testing.assert_allclose(model.A, one_a @ one_a, atol=1e-10)
    np.testing.assert_allclose(model.B, one_a @ one_b + one_b, atol=1e-10)


def test_limits_are_those_of_the_actuators_unless_others_are_given():
    ranged = SPRING.replace('<motor joint="x"/>', '<motor joint="x"/><motor joint="x" ctrlrange="-2 3"/>')
    system = SceneSystem(mg.load_scene(ranged))
    cost, key = GoalCost(system.origin, 1.0, 1.0, 1.0), jax.random.key(0)
    given = (system, cost, None, np.zeros((1, 2)), key, Exact(), [np.ones(1)])
    for lower, least in ((None, [-np.inf, -2]), (-1.0, [-1, -1])):
        problem, *_ = posed(*given, lower, None)
        np.testing.assert_array_equal([problem.lower, problem.upper], [least, [np.inf, 3]])


RAILS = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body pos="0 0 {height}"><freejoint/><geom name="ball" size=".1"/></body>
  <body pos=".5 0 .2"><joint type="slide"/><geom name="pusher" size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("height", "expected"), [(0.0999, 1), (0.15, 0)])
def test_smoothing_that_reaches_the_floor_under_a_resting_body_is_warned_about(height, expected):
    system = SceneSystem(mg.load_scene(RAILS.format(height=height)))
    start = jnp.concatenate([system.scene.data.qpos, system.scene.data.qvel])
    found = Analytic(Smoothing(0.01)).warnings(system, start)
    assert len(found) == expected
    assert all("smoothing also reaches floor – ball, which touch at the start" in sentence for sentence in found)
    assert not Exact().warnings(system, start)
    # Under a trace nothing is known of the start.
    jax.eval_shape(lambda x: Analytic(Smoothing(0.01)).warnings(system, x), start)


def test_a_bottle_that_is_drawn_on_a_table_stands_there_under_widened_contacts():
    """Its gap is zero, at which a search finds no contact yet."""
    system = SceneSystem(
        mg.load_scene(
            """<mujoco><worldbody><geom type="box" size=".5 .5 .02" pos="0 0 -.02"/>
            <body pos="0 .1 .08"><freejoint/><geom type="cylinder" size=".03 .08"/></body>
            <body pos="0 0 .08"><joint type="slide" axis="0 1 0"/><geom size=".02"/></body></worldbody></mujoco>""",
            engine="mujoco",
        )
    )
    np.testing.assert_array_equal(system.widened(0.01).scene.model.geom_margin > 0, [False, False, True])


LENGTH = 0.01


def facing(gap, *, engine="mujoco", is_fixed=False, has_pair=False, stands=False):
    """A ball on a rail before another one, which may be fixed; beside them a third one may stand on a floor."""
    alone, rail = 'contype="0" conaffinity="0"' if has_pair else "", '<joint type="slide" axis="1 0 0"/>'
    floor = '<geom type="plane" size="9 9 1"/><body pos="5 0 .1"><freejoint/><geom size=".1"/></body>'
    return SceneSystem(
        mg.load_scene(
            f"""<mujoco><option gravity="0 0 0"/><worldbody>
            <body pos="0 0 1"><joint name="a" type="slide" axis="1 0 0"/><geom name="a" size=".1" mass="1" {alone}/></body>
            <body pos="{0.2 + gap} 0 1">{"" if is_fixed else rail}<geom name="b" size=".1" mass="1" {alone}/></body>
            {floor if stands else ""}</worldbody>
            <contact>{"<pair geom1='a' geom2='b'/>" if has_pair else ""}</contact><actuator><motor joint="a"/></actuator>
            </mujoco>""",
            engine=engine,
        ),
        num_substeps=5,
    )


@pytest.mark.parametrize(
    ("scene", "begins"),
    [
        ({}, 4),
        ({"is_fixed": True}, 4),
        ({"has_pair": True}, 4),
        ({"is_fixed": True, "has_pair": True}, 4),
        ({"stands": True, "is_fixed": True}, 4),
        ({"stands": True}, 8),
        ({"stands": True, "has_pair": True}, 4),
    ],
)
def test_widened_contacts_begin_at_four_lengths_or_eight_beside_what_stands(scene, begins):
    """From rest: there is no damping, and no force but that of the contact."""
    for share, is_moved in ((0.97, True), (1.03, False)):
        system = facing(share * begins * LENGTH, **scene)
        end = Analytic(Smoothing(LENGTH)).step(system, system.origin, CONTROL, jax.random.key(0))
        assert (end[system.scene.model.nq] < 0) == is_moved


@pytest.mark.parametrize("has_pair", [False, True])
def test_widened_contacts_push_about_as_averaged_ones(has_pair):
    """From one to three lengths away, where the push falls to a twentieth. The two laws differ by a third."""
    model = eqx.filter_jit(lambda system: analytic(system, system.origin, CONTROL, Smoothing(LENGTH)))
    for gap in (LENGTH, 2 * LENGTH, 3 * LENGTH):
        by_c, by_mjx = (model(facing(gap, engine=engine, has_pair=has_pair)).B[3, 0] for engine in ("mujoco", "mjx"))
        np.testing.assert_allclose(by_c, by_mjx, rtol=0.4)


def test_a_pair_that_stands_is_not_widened():
    scene = mg.load_scene(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body pos="0 0 .1"><freejoint/><geom name="ball" size=".1" contype="0" conaffinity="0"/></body></worldbody>
        <contact><pair geom1="ball" geom2="floor"/></contact></mujoco>""",
        engine="mujoco",
    )
    model = SceneSystem(scene).widened(LENGTH).scene.model
    np.testing.assert_array_equal(model.pair_margin, scene.model.pair_margin)
    np.testing.assert_array_equal(model.pair_solimp, scene.model.pair_solimp)


IMPEDANCE = 1e-3


def test_a_contact_averaged_in_the_solver_is_its_closed_form():
    """With impedance d small the force is k times depth per unit mass, so v gains h k σ [φ(z) − z Φ(−z)] on average."""
    h, given = 0.01, 700.0
    contact = f'solref="-{given} 0" solimp="{IMPEDANCE} {IMPEDANCE} 0.001"'
    # MuJoCo takes a body's inverse inertia for the mean over three axes, of which one can move here: a third of it.
    k = 3 * given
    system = SceneSystem(mg.load_scene(PUSHED_BALL.format(h=h, contact=contact)))
    model = eqx.filter_jit(analytic)(system, jnp.array([POINT, 0.0]), CONTROL, Smoothing(STDDEV))
    slope = -h * k * norm.cdf(-POINT / STDDEV)
    # The share d of all acceleration into the contact is no spring's.
    np.testing.assert_allclose(model.A[1, 0], slope, atol=4 * IMPEDANCE * h * k)
    np.testing.assert_allclose(model.B[1, 0], h, atol=4 * IMPEDANCE * h)


FREE = """<mujoco><worldbody><body><freejoint/><geom size=".1"/><body pos="0 0 1"><joint type="ball"/><geom size=".1"/>
  <body pos="0 0 1"><joint type="hinge"/><geom size=".1"/></body></body></body></worldbody></mujoco>"""


def test_changes_of_position_are_those_of_c_mujoco_and_undo_the_retraction():
    scene = mg.load_scene(FREE)
    system, model = SceneSystem(scene), scene.mj_model
    rng = np.random.default_rng(3)
    start, end, expected = np.zeros(model.nq), np.zeros(model.nq), np.zeros(model.nv)
    start[:] = end[:] = model.qpos0
    mujoco.mj_integratePos(model, start, rng.normal(size=model.nv), 1)
    mujoco.mj_integratePos(model, end, rng.normal(size=model.nv), 1)
    mujoco.mj_differentiatePos(model, expected, 1, start, end)
    np.testing.assert_allclose(position_change(scene.model, jnp.array(start), jnp.array(end)), expected, atol=1e-12)
    state = jnp.concatenate([jnp.array(start), jnp.zeros(model.nv)])
    change = jnp.array(rng.normal(size=2 * model.nv))
    np.testing.assert_allclose(system.difference(system.retract(state, change), state), change, atol=1e-12)
