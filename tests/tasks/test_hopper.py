"""Gymnasium's hopper, dropped under a policy that holds its posture: the derivative against the slope of the outcome."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.stepping import own_motion
from mjxgrad.tasks import robot_scene

POSE = jnp.array([0.0, 1.22, 0.0, -0.4, -0.5, 0.3])  # m, m, rad; bent legs absorb the landing
SPEED = jnp.array([0.5, -1.0, 0.0, 0.0, 0.0, 0.0])  # the foot lands after 70 ms
STIFFNESS, DAMPING = jnp.array([0.5, 0.5, 0.3]), jnp.array([0.05, 0.05, 0.03])  # of 200 Nm per rad and per rad/s


@pytest.mark.slow
def test_after_the_landing_only_the_slope_derivative_is_the_slope():
    """With respect to the angle that the foot holds, moved so far that the landing passes through many time steps.

    Under a window w that vanishes at both ends the mean slope of the cost c, the teeth of its time steps included, is
    -∫ w' c / ∫ w, whatever the shape of c.
    """
    scene = robot_scene("hopper")
    state = mg.initial_state(scene, POSE, SPEED)
    shifts = jnp.asarray(mg.diagnostics.phases((-0.1, 0.1), 480))

    def held(offset, state):
        return offset - STIFFNESS * state.qpos[3:] - DAMPING * state.qvel[3:]

    def cost(shift, gradient):
        offset = (STIFFNESS * POSE[3:]).at[2].add(shift)
        return -mg.rollout(scene, state, held, offset, horizon=150, contact=own_motion(gradient)).qpos[-1, :2].sum()

    def along(gradient):
        return jax.jit(jax.vmap(jax.value_and_grad(lambda shift: cost(shift, gradient))))(shifts)

    (costs, event), (_, discrete) = along("slope"), along("discrete")
    angle = np.pi * np.asarray(shifts) / 0.1
    window, change = 1 + np.cos(angle), -np.pi / 0.1 * np.sin(angle)
    slope = -float(np.mean(change * costs) / np.mean(window))
    event, discrete = (float(np.average(x, weights=window)) for x in (event, discrete))
    assert abs(discrete - slope) > abs(slope)
    assert event == pytest.approx(slope, abs=0.05 * abs(discrete - slope))
