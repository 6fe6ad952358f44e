"""Integration with error control, against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.problems.integration import adaptive_rollout

RADIUS, STEP, HORIZON = 0.05, 2e-3, 100
# A constant impedance of 0.9 and critical damping: the ball comes back with e⁻² of its speed (tests of contact.bounce).
BALL = f"""
<mujoco>
  <option gravity="0 0 0" timestep="{STEP}"/>
  <worldbody>
    <geom type="plane" size="1 1 .1" solimp="0.9 0.9 0.001"/>
    <body pos="0 0 {RADIUS}">
      <joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{RADIUS}" mass="2" solimp="0.9 0.9 0.001"/>
    </body>
  </worldbody>
</mujoco>
"""
SPINNING = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01"/>
  <worldbody><body><freejoint/><geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody>
</mujoco>
"""
RESTITUTION = float(np.exp(-2))


@pytest.fixture(scope="module")
def ball():
    return mg.load_scene(BALL)


def thrown(scene, height):
    return mg.initial_state(scene, qpos=jnp.array([height]), qvel=jnp.array([-1.0]))


def closed_form(height):
    """Height at 0.2 s: at critical damping contact takes 2 t_c = 40 ms and ends 2 t_c e⁻² deep, at e⁻² of the speed."""
    return RESTITUTION * (HORIZON * STEP - height - 0.04) - 0.04 * RESTITUTION


@pytest.fixture(scope="module")
def adaptive(ball):
    @jax.jit
    @jax.value_and_grad
    def run(height):
        found = adaptive_rollout(ball, thrown(ball, height), [HORIZON * STEP], tolerance=1e-6, max_steps=1024)
        return jnp.where(found.has_failed, jnp.nan, found.qpos[-1, 0])

    return run


@pytest.mark.slow
def test_the_bounce_is_that_of_the_closed_form_and_its_slope_the_restitution_but_not_its_derivative(adaptive):
    height, _ = adaptive(jnp.array(0.05))
    # Errors add up over some 10² steps of 1e-6 and are carried along for 0.1 s.
    assert height == pytest.approx(float(closed_form(0.05)), abs=2e-5)
    (low, slope), (high, _) = adaptive(jnp.array(0.045)), adaptive(jnp.array(0.055))
    # Two errors of 2e-5 over 0.01.
    assert (high - low) / 0.01 == pytest.approx(-RESTITUTION, abs=4e-3)
    assert abs(slope + RESTITUTION) > 0.5


@pytest.mark.slow
def test_adaptive_integration_turns_a_free_body_about_its_axis_and_keeps_quaternions_normalised():
    scene = mg.load_scene(SPINNING)
    state = mg.initial_state(scene, qvel=jnp.array([1.0, 0, 0, 0, 0, 3.0]))
    found = eqx.filter_jit(adaptive_rollout)(scene, state, jnp.array([0.5, 1.0]), tolerance=1e-9)
    half = 3.0 * np.array([0.5, 1.0]) / 2
    assert np.allclose(found.qpos[:, 3:], np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1), atol=1e-7)
    assert np.allclose(found.qpos[:, 0], [0.5, 1.0], atol=1e-9)
    assert not bool(found.has_failed)


@pytest.mark.slow
def test_steps_that_run_out_are_flagged(ball):
    found = eqx.filter_jit(adaptive_rollout)(ball, thrown(ball, 0.05), jnp.array([0.2]), tolerance=1e-8, max_steps=10)
    assert bool(found.has_failed)
