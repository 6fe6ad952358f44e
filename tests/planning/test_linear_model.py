"""Smoothed linear models two ways, against closed forms and each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad.bodies.kinematics import position_change
from mjxgrad.planning.linear_model import Analytic, Exact, Sampled
from mjxgrad.planning.system import FunctionSystem, SceneSystem
from mjxgrad.planning.trajectory import checked
from mjxgrad.stepping import Smoothing, own_motion

A, B, OFFSET = np.array([[0.9, 0.2], [-0.3, 1.1]]), np.array([[0.5], [-0.7]]), np.array([0.3, -0.1])
POINT, CONTROL, STDDEV = 0.03, jnp.zeros(1), 0.05
STIFFNESS = 40.0


def affine(state, control):
    return A @ state + B @ control + OFFSET


def wall(state, control):
    """A wall at zero that pushes back in proportion to depth: a contact in one dimension."""
    return state + 2 * control + STIFFNESS * jnp.maximum(0.0, -state)


def edge(state, control):
    return 1.0 * (state + control > 0)


def cliff(state, control):
    """Beyond one standard deviation there are no numbers."""
    return jnp.where(state < -STDDEV, jnp.nan, state) + control


def within(value, error, expected, errors=4.0):
    np.testing.assert_array_less(np.abs(np.asarray(value) - expected), errors * np.asarray(error) + 1e-12)


def analytic(system, state, control, smoothing=None):
    return Analytic(smoothing).linear_model(system, state, control, None)


def sampled(system, state, control, key, **noise):
    return Sampled(**noise).linear_model(system, state, control, key)


def repeated(estimate, times, system, state, control, key, **noise):
    """Return the mean of many models and its standard error."""
    models = eqx.filter_jit(jax.vmap(lambda key: estimate(system, state, control, key, **noise)))(
        jax.random.split(key, times)
    )
    mean = jax.tree.map(lambda x: np.asarray(x).mean(axis=0), models)
    return mean, jax.tree.map(lambda x: np.asarray(x).std(axis=0) / np.sqrt(times), models)


def mean_step(system, state, control, key, **noise):
    return Sampled(**noise).step(system, state, control, key)


def exact_wall():
    """E max(0, −x − w) = σ [φ(z) − z Φ(−z)], z = x/σ, and its derivative −Φ(−z)."""
    z = POINT / STDDEV
    return 1 - STIFFNESS * norm.cdf(-z), POINT + STIFFNESS * STDDEV * (norm.pdf(z) - z * norm.cdf(-z))


def test_a_contact_averaged_over_noise_is_its_closed_form(key):
    slope, _ = exact_wall()
    at = (FunctionSystem(wall, 1, 1), jnp.array([POINT]), CONTROL, key)
    model, error = repeated(sampled, 40, *at, stddev_state=STDDEV, stddev_control=0.1, num_samples=100)
    within(model.A[0, 0], error.A[0, 0], slope)
    within(model.B[0, 0], error.B[0, 0], 2.0)
    assert abs(slope - 1) > 10 * error.A[0, 0]  # without noise the wall is not felt here


def test_samples_see_a_jump(key):
    """E 1[x + w_x + u + w_u > 0] has the derivative φ(x/s)/s, s² the sum of both variances."""
    noise = {"stddev_state": 0.04, "stddev_control": 0.03, "num_samples": 100}
    at = (FunctionSystem(edge, 1, 1), jnp.array([POINT]), CONTROL, key)
    expected = norm.pdf(POINT, scale=0.05)
    model, error = repeated(sampled, 40, *at, **noise)
    within(model.A[0, 0], error.A[0, 0], expected)
    within(model.B[0, 0], error.B[0, 0], expected)


def test_the_mean_step_is_its_closed_form(key):
    at = (FunctionSystem(wall, 1, 1), jnp.array([POINT]), CONTROL, key)
    mean, error = repeated(mean_step, 40, *at, stddev_state=STDDEV, stddev_control=0.1, num_samples=100)
    within(mean, error, exact_wall()[1])


@pytest.mark.slow
def test_samples_that_are_not_finite_are_left_out(key):
    at = (FunctionSystem(cliff, 1, 1), jnp.array([0.0]), CONTROL, key)
    model = sampled(*at, stddev_state=STDDEV, stddev_control=0.1, num_samples=400)
    np.testing.assert_allclose(model.A, 1.0, atol=1e-9)
    at = (at[0], jnp.array([-1.0]), CONTROL, key)
    lost = sampled(*at, stddev_state=1e-3, stddev_control=0.1, num_samples=10)
    assert np.isnan(lost.A).all()


def test_a_mean_step_leaves_out_what_is_not_finite(key):
    """Beyond the cliff there are no numbers; the rest of the samples is a normal distribution cut off at one deviation."""
    at = (FunctionSystem(cliff, 1, 1), jnp.zeros(1), CONTROL, key)
    mean = mean_step(*at, stddev_state=STDDEV, stddev_control=0.0, num_samples=4000)
    within(mean, STDDEV / np.sqrt(8000), STDDEV * norm.pdf(1) / norm.cdf(1))


def test_without_noise_on_a_coordinate_least_squares_gives_zero(key):
    at = (FunctionSystem(affine, 2, 1), jnp.zeros(2), CONTROL, key)
    model = sampled(*at, stddev_state=jnp.array([0.1, 0.0]), stddev_control=0.1, num_samples=20)
    np.testing.assert_allclose(model.A[:, 0], A[:, 0], atol=1e-12)
    assert not model.A[:, 1].any()


SPRING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0" stiffness="3" damping="0.4"/><geom size="0.1" mass="0.5"/></body></worldbody>
  <actuator><motor joint="x"/></actuator></mujoco>"""


@pytest.mark.parametrize("gradient", ["discrete", pytest.param("slope", marks=pytest.mark.slow)])
def test_a_ball_on_a_spring_is_found_without_error_by_both(key, gradient):
    """One step: v ← (m v + h (u − k q)) / (m + h c), q ← q + h v; here two of them."""
    h, m, k, c = 0.01, 0.5, 3.0, 0.4
    rate = np.array([-h * k, m]) / (m + h * c)
    one_a = np.array([[1 + h * rate[0], h * rate[1]], rate])
    one_b = np.array([[h], [1]]) * h / (m + h * c)
    system = SceneSystem(mg.load_scene(SPRING), num_substeps=2, contact=own_motion(gradient))
    at, control, noise = jnp.array([0.1, -0.3]), jnp.array([0.7]), {"stddev_state": 0.1, "stddev_control": 0.1}

    @eqx.filter_jit
    def models():
        return (
            analytic(system, at, control),
            sampled(system, at, control, key, num_samples=8, **noise),
        )

    for model in models():
        np.testing.assert_allclose(model.A, one_a @ one_a, atol=1e-10)
        np.testing.assert_allclose(model.B, one_a @ one_b + one_b, atol=1e-10)


def test_limits_are_those_of_the_actuators_unless_others_are_given():
    ranged = SPRING.replace('<motor joint="x"/>', '<motor joint="x"/><motor joint="x" ctrlrange="-2 3"/>')
    system = SceneSystem(mg.load_scene(ranged))
    given = (system, system.origin, np.zeros((1, 2)), np.ones(1))
    np.testing.assert_array_equal(checked(*given, None, None)[2:], [[-np.inf, -2], [np.inf, 3]])
    np.testing.assert_array_equal(checked(*given, -1.0, None)[2:], [[-1, -1], [np.inf, 3]])


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


BALL = """<mujoco><option timestep="{h}" gravity="0 0 0" tolerance="1e-12"/><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/><body><joint name="z" type="slide" axis="0 0 1"/>
  <geom name="ball" size="0.1" mass="1" pos="0 0 0.1"/></body></worldbody>
  <contact><pair geom1="ball" geom2="floor" condim="1" {contact}/></contact>
  <actuator><motor joint="z"/></actuator></mujoco>"""
IMPEDANCE = 1e-3


@pytest.mark.parametrize("way", ["analytic", pytest.param("sampled", marks=pytest.mark.slow)])
def test_a_contact_in_the_solver_averaged_two_ways_is_its_closed_form(key, way):
    """With impedance d small the force is k times depth per unit mass, so v gains h k σ [φ(z) − z Φ(−z)] on average."""
    h, given = 0.01, 700.0
    contact = f'solref="-{given} 0" solimp="{IMPEDANCE} {IMPEDANCE} 0.001"'
    # MuJoCo takes a body's inverse inertia for the mean over three axes, of which one can move here: a third of it.
    k = 3 * given
    scene = mg.load_scene(BALL.format(h=h, contact=contact))
    system, at = SceneSystem(scene), jnp.array([POINT, 0.0])
    noise = {"stddev_state": jnp.array([STDDEV, 1e-3]), "stddev_control": 0.1}

    if way == "analytic":
        model = eqx.filter_jit(analytic)(system, at, CONTROL, Smoothing(STDDEV))
        error = jax.tree.map(jnp.zeros_like, model)
    else:
        model, error = repeated(sampled, 20, system, at, CONTROL, key, num_samples=50, **noise)
    z = POINT / STDDEV
    slope = -h * k * norm.cdf(-z)
    # The share d of all acceleration into the contact is no spring's.
    np.testing.assert_array_less(np.abs(model.A[1, 0] - slope), 4 * error.A[1, 0] + 4 * IMPEDANCE * h * k)
    within(model.B[1, 0], error.B[1, 0] + IMPEDANCE * h, h)


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
