"""One motion has one derivative: by an array of controls, a policy, a rollout that goes on, and an environment's steps."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.engines.pool import pool_of
from mjxgrad.envs import Environment

# Both of its ends land and leave the floor again, so that pairs of motions are in flight most of the time.
LINKS = """<mujoco><option timestep=".002"/><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .32" euler="0 25 0">
  <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .25 0 0" size=".03" mass=".5"/>
  <body pos=".25 0 0"><joint name="k" axis="0 1 0" damping=".02" stiffness=".5"/>
  <geom type="capsule" fromto="0 0 0 .25 0 0" size=".03" mass=".5"/></body></body></worldbody>
  <actuator><motor joint="k" ctrlrange="-1 1"/></actuator></mujoco>"""
HORIZON, SKIP = 120, 4
FIRST = 12 * SKIP  # a step after the first landing, up to which both engines agree to rounding
HEIGHTS = jnp.array([0.0, 0.007, 0.013])


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(LINKS).with_engine("mujoco")


def _start(scene, height):
    return mg.initial_state(scene, scene.data.qpos.at[1].add(height), jnp.array([0.5, 0.0, 0.0, 0.0]))


def _derivative(course):
    """Return derivatives by height, of positions and velocities after each interval."""
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.jacfwd(course)))(HEIGHTS))


@pytest.fixture(scope="module")
def by_array(scene):
    def course(height):
        found = mg.rollout(scene, _start(scene, height), jnp.zeros((HORIZON, 1)), contact=mg.Slope())
        return jnp.concatenate([found.qpos, found.qvel], axis=1)[SKIP::SKIP]

    return _derivative(course)


def assert_alike(found, by_array):
    np.testing.assert_allclose(found, by_array, atol=1e-6 * np.abs(by_array).max())


@pytest.fixture(scope="module")
def going_on(scene):
    """Derivatives of pairs' changes and of ends, interval by interval, each of which is a rollout of its own."""

    def course(height):
        state, found = _start(scene, height), []
        for _ in range(HORIZON // SKIP):
            state = mg.rollout(scene, state, jnp.zeros((SKIP, 1)), contact=mg.Slope()).final
            found.append((state.pairs.held, jnp.concatenate([state.qpos, state.qvel])))
        return jax.tree.map(lambda *each: jnp.stack(each), *found)

    return _derivative(course)


def test_pairs_are_in_flight_between_intervals(going_on, by_array):
    """Else the tests below would compare nothing."""
    assert np.abs(going_on[0]).max() > 0.1
    assert np.abs(by_array).max() > 1


def test_a_policy_that_gives_the_same_controls_has_the_derivative_of_the_array(scene, by_array):
    def course(height):
        policy = lambda gain, state: gain * jnp.zeros(1)  # noqa: E731
        found = mg.rollout(scene, _start(scene, height), policy, jnp.ones(()), horizon=HORIZON, contact=mg.Slope())
        return jnp.concatenate([found.qpos, found.qvel], axis=1)[SKIP::SKIP]

    assert_alike(_derivative(course), by_array)


def test_a_rollout_that_goes_on_has_the_derivative_of_one(going_on, by_array):
    assert_alike(going_on[1], by_array)


class Links(Environment):
    def observe(self, state, memory):
        return jnp.concatenate([state.qpos, state.qvel])

    def rewards(self, before, action, after, memory):
        return {"forward": after.qpos[0]}


def test_the_steps_of_an_environment_have_it_too(scene, by_array):
    environment = Links(scene=scene, contact=mg.Slope(), frame_skip=SKIP)

    def course(height):
        first = dataclasses.replace(environment.reset(jax.random.key(0)), physics=_start(scene, height))

        def step(state, _):
            state = environment.step(state, jnp.zeros(1))
            return state, state.obs

        return jax.lax.scan(step, first, None, length=HORIZON // SKIP)[1]

    assert_alike(_derivative(course), by_array)


@pytest.mark.slow
@pytest.mark.parametrize("route", ["array", "environment"])
def test_mjx_has_the_derivative_of_c_mujoco(by_array, route):
    """Written anew in JAX, with a few slots. Later, a solver's error may decide by one step when a pair is let go."""
    own = mg.load_scene(LINKS)
    environment = Links(scene=own, contact=mg.Slope(), frame_skip=SKIP)

    def course(height):
        start = _start(own, height)
        if route == "array":
            found = mg.rollout(own, start, jnp.zeros((HORIZON, 1)), contact=mg.Slope())
            return jnp.concatenate([found.qpos, found.qvel], axis=1)[SKIP::SKIP]
        first = environment.reset(jax.random.key(0))
        first = dataclasses.replace(first, physics=dataclasses.replace(start, pairs=first.physics.pairs))

        def step(state, _):
            state = environment.step(state, jnp.zeros(1))
            return state, state.obs

        return jax.lax.scan(step, first, None, length=HORIZON // SKIP)[1]

    found = _derivative(course)
    off = np.abs(found - by_array).max(axis=(0, 2)) / np.abs(by_array).max()
    assert (off[: FIRST // SKIP] < 1e-9).all()  # the first landing, and all that follows from it
    assert (off < 1e-3).all()


@pytest.mark.slow
def test_both_engines_have_one_derivative_in_single_precision():
    with jax.enable_x64(False):
        found = []
        for engine in ("mujoco", "mjx"):
            scene, heights = mg.load_scene(LINKS).with_engine(engine), jnp.asarray(np.asarray(HEIGHTS), jnp.float32)

            def course(height, scene=scene):
                moved = mg.rollout(scene, _start(scene, height), jnp.zeros((HORIZON, 1)), contact=mg.Slope())
                return jnp.concatenate([moved.qpos, moved.qvel], axis=1)[SKIP::SKIP]

            found.append(np.asarray(jax.jit(jax.vmap(jax.jacfwd(course)))(heights)))
        assert found[1].dtype == np.float32
        np.testing.assert_allclose(found[1], found[0], atol=1e-3 * np.abs(found[0]).max())


def test_both_engines_have_one_derivative_through_a_policy_and_reverse_mode_has_it_too(scene):
    """By a gain, which moves the landings; MJX's slope is written anew in JAX."""
    found = []
    for engine in ("mujoco", "mjx"):

        def end(gain, engine=engine):
            chosen = scene.with_engine(engine)
            policy = lambda gain, state: gain * (0.3 - state.qpos[3:])  # noqa: E731
            found = mg.rollout(chosen, _start(chosen, 0.0), policy, gain, horizon=HORIZON, contact=mg.Slope())
            return jnp.concatenate([found.qpos[FIRST], found.qpos[-1]])

        @jax.jit
        def both(gain, end=end):  # of one linearisation, as `jax.jacfwd` and `jax.jacrev` take it one by one
            last, push = jax.linearize(end, gain)
            (pulled,) = jax.vmap(jax.linear_transpose(push, gain))(jnp.eye(last.size))
            return push(jnp.ones_like(gain)), pulled

        forward, reverse = both(jnp.array(0.2))
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
        found.append(forward)
    # Later a solver's error may decide by one step when a pair is let go, and the policy carries that on.
    np.testing.assert_allclose(found[1][:4], found[0][:4], atol=1e-8 * np.abs(found[0][:4]).max())
    assert np.abs(found[0][:4]).max() > 1e-4


def test_the_change_that_checks_follow_is_that_of_a_rollout(scene, by_array):
    model, num = scene.mj_model, len(HEIGHTS)
    qpos = np.tile(model.qpos0, (num, 1))
    qpos[:, 1] += HEIGHTS
    start = {"time": np.zeros((num, 1)), "qpos": qpos, "qvel": np.tile([0.5, 0.0, 0.0, 0.0], (num, 1))}
    changes = (np.tile(np.eye(8)[1], (num, 1)), np.zeros((num, HORIZON, 1)))
    found = pool_of(model).follow("slope", {}, start, {"ctrl": np.zeros((num, HORIZON, 1))}, changes)
    assert_alike(found["change"][:, SKIP - 1 :: SKIP], by_array)


def test_a_scene_is_stepped_by_the_engine_that_was_chosen(scene):
    assert (scene.engine, mg.load_scene(LINKS).engine) == ("mujoco", "mjx")
    assert scene.with_engine("mjx").engine == "mjx"
    flexible = mg.load_scene(LINKS, engine="mujoco")
    with pytest.raises(ValueError, match="was loaded for C MuJoCo"):
        flexible.with_engine("mjx")
    # No hint to MJX where MJX cannot step the file.
    with pytest.raises(ValueError, match="cannot be stepped by MJX"):
        mg.load_scene(DELAYED.format("Euler"), engine="mujoco").with_engine("mjx")


DELAYED = """<mujoco><option timestep=".01" integrator="{}"/><worldbody><body><joint name="j" axis="0 1 0" damping=".1"/>
  <geom size=".05" pos="0 0 -.5"/></body></worldbody><actuator><motor joint="j" delay=".05" nsample="6"/></actuator></mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("way", ["array", "policy", "goes on"])
def test_a_delayed_actuator_keeps_its_history(way, integrator):
    """Its controls act five steps later, also after an interruption; derivatives are differences of C MuJoCo's motion."""
    model = mujoco.MjModel.from_xml_string(DELAYED.format(integrator))
    scene, controls = mg.load_scene(model), np.linspace(0.5, 1, 40)[:, None]

    def by_mujoco(added):
        data = mujoco.MjData(model)
        for ctrl in controls + added:
            data.ctrl = ctrl
            mujoco.mj_step(model, data)
        return data.qpos[0]

    def end(added):
        start = mg.initial_state(scene)
        if way == "policy":
            policy = lambda added, state: added + 0.5 + 0.5 * state.time.reshape(1) / 0.39  # noqa: E731
            return mg.rollout(scene.with_engine("mujoco"), start, policy, added, horizon=40).qpos[-1, 0]
        if way == "goes on":
            half = mg.rollout(scene.with_engine("mujoco"), start, controls[:20] + added)
            return mg.rollout(scene.with_engine("mujoco"), half.final, controls[20:] + added).qpos[-1, 0]
        return mg.rollout(scene.with_engine("mujoco"), start, controls + added).qpos[-1, 0]

    value, derivative = jax.jit(jax.value_and_grad(end))(0.0)
    np.testing.assert_allclose(value, by_mujoco(0.0), rtol=1e-9)
    np.testing.assert_allclose(derivative, (by_mujoco(1e-6) - by_mujoco(-1e-6)) / 2e-6, rtol=1e-6)


def test_a_start_on_the_floor_is_that_of_the_file_in_single_precision():
    """A box of 0.04 m stands at 0.04 m: rounded, it would begin a nanometre inside the floor, which contact of 1e5 1/s² shows."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .04"><freejoint/>
        <geom type="box" size=".04 .04 .04"/></body></worldbody></mujoco>"""
    )
    engine, rounded = pool_of(model), model.qpos0.astype(np.float32)
    assert (rounded != model.qpos0).any()
    np.testing.assert_array_equal(engine._exactly("qpos", rounded), model.qpos0)
    moved = rounded + np.float32(1e-3)
    np.testing.assert_array_equal(engine._exactly("qpos", moved)[2], float(moved[2]))


def test_a_sensor_that_only_c_mujoco_has_is_a_cost():
    """The distance of a rod from a ball, against differences of C MuJoCo's own reading."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body pos="0 0 1"><joint name="a" axis="0 1 0"/>
        <geom name="rod" type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body><geom name="ball" size=".1" pos=".3 .3 .5"/>
        </worldbody><actuator><motor joint="a"/></actuator>
        <sensor><distance geom1="rod" geom2="ball" cutoff="5"/></sensor></mujoco>"""
    )
    scene = mg.load_scene(model, engine="mujoco")

    def reading(torque):
        start, controls = mg.initial_state(scene), torque * jnp.ones((30, 1))
        found = mg.rollout(scene, start, controls, observe=lambda model, data: data.sensordata, contact=mg.Discrete())
        return found.observations[-1, 0]

    def by_mujoco(torque):
        data = mujoco.MjData(model)
        for _ in range(30):
            data.ctrl = torque
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        return data.sensordata[0]

    value, derivative = jax.jit(jax.value_and_grad(reading))(0.2)
    np.testing.assert_allclose(value, by_mujoco(0.2), rtol=1e-9)
    np.testing.assert_allclose(derivative, (by_mujoco(0.2 + 1e-6) - by_mujoco(0.2 - 1e-6)) / 2e-6, rtol=1e-5)


def test_a_parameter_that_is_zero_is_not_switched_on():
    """Entries of a DC motor's gain that are zero ask for other activations; those that are not have their derivative."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".05" pos="0 0 -.3"/></body></worldbody>
        <actuator><dcmotor joint="j" motorconst=".1 .1" resistance="2"/></actuator></mujoco>"""
    )
    scene, gains = mg.load_scene(model), np.array(model.actuator_gainprm)

    def end(gains):
        start = mg.initial_state(scene)
        changed = scene.with_model(actuator_gainprm=gains)
        return mg.rollout(changed.with_engine("mujoco"), start, 3 * jnp.ones((20, 1))).qpos[-1, 0]

    gradient, value = np.asarray(jax.jit(jax.grad(end))(jnp.asarray(gains))), jax.jit(end)
    assert np.isfinite(gradient).all()
    for entry in np.flatnonzero(gains):
        change = 1e-5 * np.eye(gains.size)[entry].reshape(gains.shape)
        expected = (value(gains + change) - value(gains - change)) / 2e-5
        np.testing.assert_allclose(gradient.reshape(-1)[entry], expected, rtol=1e-4)
