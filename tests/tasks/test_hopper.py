"""The drop of the hopper: its policy, its motion against C MuJoCo, its derivative against its slope."""

import copy

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.stepping import own_motion
from mjxgrad.tasks import DAMPING, START_POSE, STIFFNESS, hopper

HORIZON = 60  # until 0.12 s, 25 steps after the foot touches


@pytest.fixture(scope="module")
def task():
    return hopper(horizon=HORIZON)


def test_the_drop_costs_what_c_mujoco_says(task):
    """The landing included: the foot touches after 70 ms. Both solve to a tolerance of 1e-8."""
    model = copy.copy(task.scene.mj_model)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = task.state.qpos, task.state.qvel
    has_landed = False
    for _ in range(HORIZON):
        error = np.array(START_POSE[3:]) - data.qpos[3:]
        data.ctrl[:] = np.array(STIFFNESS) * error - np.array(DAMPING) * data.qvel[3:]
        mujoco.mj_step(model, data)
        has_landed |= data.ncon > 0
    assert has_landed
    cost = eqx.filter_jit(task.run)(task.policy, task.start_params).cost
    assert float(cost) == pytest.approx(-data.qpos[0] - data.qpos[1], abs=1e-6)


@pytest.mark.slow
def test_after_the_landing_only_the_slope_derivative_is_the_slope():
    """With respect to the angle that the foot holds, moved so far that the landing passes through many time steps.

    Under a window w that vanishes at both ends the mean slope of the cost c, the teeth of its time steps included, is
    -∫ w' c / ∫ w, whatever the shape of c.
    """
    task = hopper()
    offset = jnp.asarray(task.start_params.bias)
    shifts = jnp.asarray(mg.diagnostics.phases((-0.1, 0.1), 480))

    def cost(shift, gradient):
        params = eqx.tree_at(lambda p: p.bias, task.start_params, offset.at[2].add(shift))
        return task.with_contact(own_motion(gradient)).run(task.policy, params).cost

    def along(gradient):
        return jax.jit(jax.vmap(jax.value_and_grad(lambda shift: cost(shift, gradient))))(shifts)

    (costs, event), (_, discrete) = along("slope"), along("discrete")
    angle = np.pi * np.asarray(shifts) / 0.1
    window, change = 1 + np.cos(angle), -np.pi / 0.1 * np.sin(angle)
    slope = -float(np.mean(change * costs) / np.mean(window))
    event, discrete = (float(np.average(x, weights=window)) for x in (event, discrete))
    assert abs(discrete - slope) > abs(slope)
    assert event == pytest.approx(slope, abs=0.05 * abs(discrete - slope))
