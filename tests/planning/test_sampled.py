"""Smoothed linear models by samples, against closed forms, the analytic way and each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad.engines.pool import Pool
from mjxgrad.planning import (
    Analytic,
    Exact,
    FunctionSystem,
    GoalCost,
    Sampled,
    SceneSystem,
    optimise_trajectory,
)
from mjxgrad.stepping import Smoothing
from tests.scenes import PUSHED_BALL

A, B, OFFSET = np.array([[0.9, 0.2], [-0.3, 1.1]]), np.array([[0.5], [-0.7]]), np.array([0.3, -0.1])
POINT, CONTROL, STDDEV = 0.03, jnp.zeros(1), 0.05
STIFFNESS = 40.0
ORDERS = pytest.mark.parametrize("order", ["first", "zeroth"])
NOISE = {"stddev_state": STDDEV, "stddev_control": 0.1}


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


def repeated(smoother, times, system, state, control, key):
    """Return the mean of many models and its standard error."""
    keys = jax.random.split(key, times)
    models = eqx.filter_jit(jax.vmap(lambda key: smoother.linear_model(system, state, control, key)))(keys)
    mean = jax.tree.map(lambda x: np.asarray(x).mean(axis=0), models)
    return mean, jax.tree.map(lambda x: np.asarray(x).std(axis=0) / np.sqrt(times), models)


def exact_wall():
    """E max(0, −x − w) = σ [φ(z) − z Φ(−z)], z = x/σ, and its derivative −Φ(−z)."""
    z = POINT / STDDEV
    return 1 - STIFFNESS * norm.cdf(-z), POINT + STIFFNESS * STDDEV * (norm.pdf(z) - z * norm.cdf(-z))


@ORDERS
def test_an_affine_step_is_found_without_error(key, order):
    given = (FunctionSystem(affine, 2, 1), jnp.array([0.4, -1.0]), jnp.array([0.2]), key)
    smoother = Sampled(0.1, 0.3, 8, order)
    model = smoother.linear_model(*given)
    np.testing.assert_allclose(model.A, A, atol=1e-12)
    np.testing.assert_allclose(model.B, B, atol=1e-12)
    np.testing.assert_allclose(smoother.step(*given), affine(*given[1:3]), atol=1e-12)


@ORDERS
def test_a_contact_averaged_over_noise_is_its_closed_form(key, order):
    slope, _ = exact_wall()
    at = (FunctionSystem(wall, 1, 1), jnp.array([POINT]), CONTROL, key)
    model, error = repeated(Sampled(**NOISE, num_samples=100, order=order), 40, *at)
    within(model.A[0, 0], error.A[0, 0], slope)
    within(model.B[0, 0], error.B[0, 0], 2.0)
    assert abs(slope - 1) > 10 * error.A[0, 0]  # without noise the wall is not felt here


def test_the_mean_step_is_its_closed_form(key):
    smoother, system = Sampled(**NOISE, num_samples=100), FunctionSystem(wall, 1, 1)
    one = jax.jit(jax.vmap(lambda key: smoother.step(system, jnp.array([POINT]), CONTROL, key)))
    found = np.asarray(one(jax.random.split(key, 40)))
    within(found.mean(), found.std() / np.sqrt(40), exact_wall()[1])


def test_zeroth_order_sees_a_jump_and_first_order_does_not(key):
    """E 1[x + w_x + u + w_u > 0] has the derivative φ(x/s)/s, s² the sum of both variances."""
    at = (FunctionSystem(edge, 1, 1), jnp.array([POINT]), CONTROL, key)
    expected = norm.pdf(POINT, scale=0.05)
    model, error = repeated(Sampled(0.04, 0.03, 100), 40, *at)
    within(model.A[0, 0], error.A[0, 0], expected)
    within(model.B[0, 0], error.B[0, 0], expected)
    model, _ = repeated(Sampled(0.04, 0.03, 100, "first"), 2, *at)
    assert not model.A.any()
    assert not model.B.any()


@ORDERS
def test_samples_that_are_not_finite_are_left_out(key, order):
    system, smoother = FunctionSystem(cliff, 1, 1), Sampled(**NOISE, num_samples=400, order=order)
    np.testing.assert_allclose(smoother.linear_model(system, jnp.zeros(1), CONTROL, key).A, 1.0, atol=1e-9)
    # Of a normal distribution and its mirror image, what lies beyond one deviation is cut off.
    mean = smoother.step(system, jnp.zeros(1), CONTROL, key)
    within(mean, STDDEV / np.sqrt(800), STDDEV * norm.pdf(1) / norm.cdf(1))


def test_a_column_without_noise_is_unknown_and_costs_no_samples(key):
    at = (FunctionSystem(affine, 2, 1), jnp.zeros(2), CONTROL, key)
    model = Sampled(jnp.array([0.1, 0.0]), 0.1, 20).linear_model(*at)
    np.testing.assert_allclose(model.A[:, 0], A[:, 0], atol=1e-12)
    assert np.isnan(model.A[:, 1]).all()
    model = Sampled(None, 0.1, 3).linear_model(*at)  # a constant, one control, and one more
    np.testing.assert_allclose(model.B, B, atol=1e-12)
    assert np.isnan(model.A).all()
    with pytest.raises(ValueError, match="num_samples must be at least 5"):
        Sampled(0.1, 0.1, 4).linear_model(*at)


IMPEDANCE = 1e-3


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_three_ways_agree_on_a_soft_contact(key, engine):
    """With impedance d small the force is k times depth per unit mass, so v gains h k σ [φ(z) − z Φ(−z)] on average."""
    h, given = 0.01, 700.0
    contact = f'solref="-{given} 0" solimp="{IMPEDANCE} {IMPEDANCE} 0.001"'
    # MuJoCo takes a body's inverse inertia for the mean over three axes, of which one can move here: a third of it.
    slope = -h * 3 * given * norm.cdf(-POINT / STDDEV)
    scene = mg.load_scene(PUSHED_BALL.format(h=h, contact=contact), engine=engine)
    at = (SceneSystem(scene), jnp.array([POINT, 0.0]), CONTROL)
    share = IMPEDANCE * h * 3 * given  # of all acceleration into the contact, which is no spring's
    noise = {"stddev_state": jnp.array([STDDEV, 1e-3]), "stddev_control": 0.1, "num_samples": 50}
    ways = [repeated(Sampled(**noise, order=order), 20, *at, key) for order in ("first", "zeroth")]
    if engine == "mjx":
        model = eqx.filter_jit(Analytic(Smoothing(STDDEV)).linear_model)(*at, key)
        ways.append((model, jax.tree.map(jnp.zeros_like, model)))
    for model, error in ways:
        within(model.A[1, 0], error.A[1, 0] + share, slope)
        within(model.B[1, 0], error.B[1, 0] + IMPEDANCE * h, h)


FREE = """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint/><geom type="box" size=".1 .2 .3"/><site name="s"/>
  </body></worldbody><actuator><motor site="s" gear="0 0 0 1 2 3"/></actuator></mujoco>"""


def test_first_order_is_in_the_tangent_space_without_noise(key):
    """It is the derivative of the mean change over the same samples, also where noise turns a body by much."""
    system = SceneSystem(mg.load_scene(FREE, engine="mujoco"))
    at = (system, system.origin, jnp.array([0.5]))
    stddev = jnp.zeros(12).at[3:6].set(0.3).at[9:].set(0.5)
    smoother = Sampled(stddev, 0.1, 4, "first")
    model = jax.jit(lambda: smoother.linear_model(*at, key))()
    width, nominal, noise = 1e-5, system.step(*at[1:]), np.multiply(*smoother._drawn(system, at[1], key))
    moved = lambda w: system.step(system.retract(at[1], w[:12]), at[2] + w[12:])  # noqa: E731
    ends = jax.jit(jax.vmap(lambda w: system.difference(moved(w), nominal)))
    for column in np.eye(13)[3:6]:
        expected = np.mean(ends(noise + width * column) - ends(noise - width * column), axis=0) / (2 * width)
        found = jnp.concatenate([model.A, model.B], axis=1) @ column
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("order", "asked"), [("first", {"run": 1, "product": 1}), ("zeroth", {"run": 1})])
def test_all_samples_of_c_mujoco_are_one_call(key, monkeypatch, order, asked):
    """First order also asks for the step without noise."""
    counts = dict.fromkeys(asked, 0)
    for name in counts:
        function = getattr(Pool, name)

        def call(*given, name=name, function=function, **settings):
            counts[name] += 1
            return function(*given, **settings)

        monkeypatch.setattr(Pool, name, call)
    system = SceneSystem(mg.load_scene(FREE, engine="mujoco"))
    eqx.filter_jit(Sampled(0.1, 0.1, 20, order).linear_model)(system, system.origin, CONTROL, key)
    assert counts == asked


def shove(state, control):
    """A finger goes where it is told, and pushes a box ahead of it that is 0.1 m wide."""
    finger = state[0] + control[0]
    return jnp.stack([finger, jnp.maximum(state[1], finger + 0.1)])


def test_samples_plan_a_push_from_where_nothing_touches(key):
    """Without smoothing no iteration moves the finger, which is 0.3 m from the box."""
    system, start = FunctionSystem(shove, 2, 1), jnp.array([-0.4, 0.0])
    cost = GoalCost(jnp.array([0.0, 0.5]), 0.0, jnp.array([0.0, 1.0]), 1e-3)
    given = system, cost, start, jnp.zeros((6, 1)), key
    assert not optimise_trajectory(*given, smoother=Exact(), schedule=jnp.ones(3)).controls.any()
    plan = optimise_trajectory(*given, smoother=Sampled(0.2, 0.2, 60), schedule=jnp.geomspace(1, 0.05, 20))
    assert abs(plan.states[-1, 1] - 0.5) < 0.02
