"""Steps under smoothing: what they simulate, what they differentiate, what they refuse."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import optimize

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.scene import SceneWarning
from mjxgrad.stepping import smoothing_warnings
from tests.scenes import put
from tests.solver.test_noise import DISTRIBUTIONS, kernels
from tests.solver.test_smoothed_law import _nodes

# A ball that can move up and sideways over a plane, and a slider with a limit; impedance rises with depth.
SCENE = """<mujoco><option timestep="0.002" cone="{cone}" tolerance="1e-13" iterations="100"/><worldbody>
  <geom type="plane" size="5 5 .1" condim="1" solimp=".6 .9 .004"/>
  <body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
    <geom size=".1" condim="{dim}" mass="2" solimp=".6 .9 .004"/></body>
  <body pos="3 0 1"><joint type="slide" axis="1 0 0" range="-1 .1" limited="true"/>
    <geom size=".1" mass="2" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
LENGTH = 2e-3
HEIGHT, SINK = 1e-3, -0.2  # m above the plane, m/s


@functools.cache
def _scene(cone="pyramidal", dim=1):
    return put(SCENE.format(cone=cone, dim=dim))


@eqx.filter_jit
def _acceleration(model, data, position, velocity, contact):
    moved = mg.forward(model, data.replace(qpos=position, qvel=velocity), contact=contact)
    return moved.qacc


def _at(height, sink=SINK, slide=0.0, limit=0.0, contact=mg.Discrete(), **scene):
    model, data = _scene(**scene)
    position, velocity = jnp.array([height, 0.0, limit]), jnp.array([sink, slide, 0.0])
    return np.asarray(_acceleration(model, data, position, velocity, contact))


# Other laws than the plain one compile for a while; what is theirs, `test_law` tests apart from the step.
scenes = pytest.mark.parametrize(
    "scene",
    [
        pytest.param({}, id="pyramidal"),
        pytest.param({"cone": "elliptic", "dim": 3}, id="elliptic", marks=pytest.mark.slow),
    ],
)


@kernels
def test_acceleration_balances_the_mean_force_under_noise(name):
    """Root of a + g = F(a), the force averaged over noise by quadrature: the solve's own accuracy, 1e-8.

    solref is (0.02, 1), so K = (dw tc)⁻², B = 2 / (dw tc); the compiled inverse weight is 1/m. With power 2 and midpoint 1/2 the
    impedance at depth e < width / 2 is d0 + (dw - d0) 2 (e/width)²; e is the mean penetration under noise where there is one.
    """
    w, share = _nodes(np.array([-HEIGHT / LENGTH]), name)
    touches = LENGTH * w < -HEIGHT
    depth = -np.sum(share * (HEIGHT + LENGTH * w) * touches) / np.sum(share * touches)
    assert depth < 0.5 * 4e-3
    d = 0.6 + 0.3 * 2 * (depth / 4e-3) ** 2
    rate, damping, weight = d / (0.9 * 0.02) ** 2, 2 / (0.9 * 0.02), 2 * d / (1 - d)

    def excess(a):
        x = a + damping * SINK + rate * HEIGHT
        last = min(-HEIGHT, -x / rate) / LENGTH
        w, share = _nodes(np.array([last]), name)
        push = np.where(w < last, x + rate * LENGTH * w, 0.0)
        return 2 * (a + 9.81) + weight * np.sum(share * push)

    exact = optimize.brentq(excess, -20, 100, xtol=1e-13)
    found = _at(HEIGHT, contact=mg.Smoothing(LENGTH, kernel=name))[0]
    assert found == pytest.approx(exact, rel=1e-8)
    assert found > -9.0  # it is not the fall


@kernels
def test_its_force_is_the_mean_of_mujoco_s_over_samples_of_the_density(name):
    """C MuJoCo's at the same acceleration, by inverse dynamics, within 4 standard errors; the impedance is that of any depth.

    Student's t has no variance, but means over their own standard errors tend to a normal distribution there, too.
    """
    native = mujoco.MjModel.from_xml_string(SCENE.format(cone="pyramidal", dim=1))
    native.geom_solimp[:] = [0.8, 0.8, 4e-3, 0.5, 2]
    model, at = _scene()[0].tree_replace({"geom_solimp": jnp.asarray(native.geom_solimp)}), mujoco.MjData(native)
    velocity, smoothing = jnp.array([SINK, 0.0, 0.0]), mg.Smoothing(LENGTH, kernel=name)
    random = np.random.default_rng(3)
    for height in (-LENGTH, 0.5 * LENGTH, 3 * LENGTH):
        acceleration = np.asarray(_acceleration(model, _scene()[1], jnp.array([height, 0, 0]), velocity, smoothing))
        forces = []
        for w in LENGTH * DISTRIBUTIONS[name].ppf(random.uniform(size=4000)):
            at.qpos[:], at.qvel[:], at.qacc[:] = [height + w, 0, 0], velocity, acceleration
            mujoco.mj_inverse(native, at)
            forces.append(at.qfrc_constraint[0])
        mean, error = np.mean(forces), np.std(forces) / len(forces) ** 0.5
        assert abs(2 * (acceleration[0] + 9.81) - mean) < 4 * error
        assert error < (0.05 if height < 0 else 0.5) * mean


@kernels
@scenes
def test_without_length_it_is_the_step_of_mujoco(scene, name):
    """Noise of a tenth of a micrometre; the impedance's slope times that depth, 1e-7 / 4e-3 of the force, and less."""
    small = mg.Smoothing(1e-7, kernel=name)
    for height in (-1e-3, 1e-3, 0.3):
        found, hard = (_at(height, slide=0.4, contact=s, **scene) for s in (small, mg.Discrete()))
        np.testing.assert_allclose(found, hard, rtol=1e-4, atol=1e-6)


def test_an_approaching_body_is_not_braked_from_afar_nor_is_a_limit_smoothed():
    """At 1 m/s a row without gate would act from 2 ζ |v| / ω = 40 mm (dw B / (d K)) on; the slider is 1 mm from its limit."""
    found = _at(0.02, -1.0, limit=0.099, contact=mg.Smoothing(LENGTH))
    assert found[0] == pytest.approx(-9.81, abs=1e-9)
    assert found[2] == 0


@pytest.mark.parametrize("name", ["gaussian", pytest.param("logistic", marks=pytest.mark.slow), "log_barrier"])
@scenes
def test_derivatives_are_central_differences(scene, name):
    """By height, velocities and length; differences of width 1e-6 of a law that bends over 1e-3: 1e-6."""
    model, data = _scene(**scene)

    def outcome(p):
        position, velocity = jnp.array([p[0], 0.0, 0.0]), jnp.array([p[1], p[2], 0.0])
        moved = mg.step(model, data.replace(qpos=position, qvel=velocity), contact=mg.Smoothing(p[3], kernel=name))
        return jnp.dot(moved.qvel, jnp.array([1.0, 0.7, 0.0]))

    point = jnp.array([HEIGHT, SINK, 0.3, LENGTH])
    program = jax.jit(jax.value_and_grad(outcome))
    found = program(point)[1]
    width = np.array([1e-6, 1e-5, 1e-5, 1e-6])
    ends = np.array([program(end)[0] for end in jnp.concatenate([point + np.diag(width), point - np.diag(width)])])
    exact = (ends[:4] - ends[4:]) / (2 * width)
    np.testing.assert_allclose(found, exact, rtol=1e-5, atol=1e-5 * np.abs(exact).max())
    assert np.abs(found).min() > 1e-3


@pytest.mark.parametrize("name", ["gaussian", pytest.param("log_barrier", marks=pytest.mark.slow)])
@scenes
def test_backward_moves_as_without_and_differentiates_the_smoothed_step(scene, name):
    """To the last bit the one, and to that of the solve the other: two starts of one iteration."""
    model, data = _scene(**scene)
    smoothed = (mg.Smoothing(LENGTH, mode, name) for mode in ("forward", "backward"))
    modes = (mg.Discrete(), *smoothed)

    def outcome(height, contact):
        position = jnp.array([0.0, 0.0, 0.0]).at[0].set(height)
        start = data.replace(qpos=position, qvel=jnp.array([SINK, 0.3, 0.0]))
        moved = mg.step(model, start, contact=contact)
        return moved.qvel, moved.qfrc_constraint, moved._impl.efc_force

    @jax.jit
    def program(height):
        one = jnp.ones_like(height)
        return [jax.jvp(functools.partial(outcome, contact=s), (height,), (one,)) for s in modes]

    for height in (HEIGHT, -HEIGHT):
        (hard, hard_slope), (_, smooth_slope), (backward, slope) = program(jnp.array(height))
        for true, found in zip(hard, backward, strict=True):
            np.testing.assert_array_equal(true, found)
        for smooth, found in zip(smooth_slope, slope, strict=True):
            np.testing.assert_allclose(found, smooth, rtol=1e-8, atol=1e-9 * np.abs(smooth).max())
        assert np.abs(slope[0] - hard_slope[0]).max() > 0.1


def test_runge_kutta_takes_the_smoothed_acceleration_at_each_stage():
    """The classical rule written out, to the accuracy of the solves."""
    model, data = _scene()
    start = np.array([HEIGHT, 0.0, 0.0]), np.array([SINK, 0.3, 0.0])
    smoothing, h = mg.Smoothing(LENGTH), 2e-3
    rungs = model.tree_replace({"opt.integrator": mjx.IntegratorType.RK4})
    moved = eqx.filter_jit(mg.step)(rungs, data.replace(qpos=start[0], qvel=start[1]), contact=smoothing)
    rates, position, velocity = [], *start
    for share in (0.5, 0.5, 1.0, None):
        rates.append((velocity, np.asarray(_acceleration(model, data, position, velocity, smoothing))))
        if share is not None:
            position, velocity = (x + h * share * rate for x, rate in zip(start, rates[-1], strict=True))
    for found, x, each in zip((moved.qpos, moved.qvel), start, zip(*rates, strict=True), strict=True):
        np.testing.assert_allclose(found, x + h / 6 * np.dot([1, 2, 2, 1], each), rtol=1e-10, atol=1e-13)
    assert rates[0][1][0] > -9.0  # there is a force at a distance


def test_lengths_are_swept_in_one_program():
    """One vmap over a Smoothing equals single steps."""
    model, data = _scene()
    lengths = jnp.array([1e-3, 3e-3])
    sweep = jax.vmap(lambda s: _acceleration(model, data, jnp.array([HEIGHT, 0, 0]), jnp.array([SINK, 0, 0]), s))
    each = [_at(HEIGHT, contact=mg.Smoothing(length)) for length in lengths]
    np.testing.assert_allclose(sweep(mg.Smoothing(lengths)), each, rtol=1e-10)


BOX = """<mujoco><default><geom condim="1"/></default><worldbody>
  <geom name="box" type="box" size="2 .1 .1" pos="0 0 -.1"/>
  <body pos="0 0 .105"><joint type="slide" axis="0 0 1"/>
    <geom name="pin" type="box" size=".1 .05 .1"/></body>
  <body pos="1 0 .105"><joint type="slide" axis="0 0 1"/><geom name="ball" size=".1"/></body></worldbody></mujoco>"""


def test_what_has_no_force_at_a_distance_over_a_box_is_warned_of():
    """Of another box it is 1 m in place of 5 mm, within reach of the noise; a ball's distance is known from anywhere."""
    (model, data), smoothing = put(BOX), mg.Smoothing(5e-3)
    pin, ball = eqx.filter_jit(mg.forward)(model, data, contact=smoothing).qacc
    assert abs(pin + 9.81) < 1e-12
    assert ball > -9.81 + 1
    (warning,) = smoothing_warnings(model)
    assert "box – pin" in warning


def test_a_scene_without_contact_is_named():
    """By the rollout, too, with the scene's name."""
    scene = mg.load_scene(
        '<mujoco model="void"><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    with pytest.warns(SceneWarning, match="MJCF: smoothing has no effect"):
        jax.eval_shape(lambda s: mg.rollout(scene, s, horizon=2, contact=mg.Smoothing(1e-3)), mg.initial_state(scene))
