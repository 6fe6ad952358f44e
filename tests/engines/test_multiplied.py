"""A warning where slopes of the outcome multiply as the outcome does not."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.engines import SlopeWarning
from tests.scenes import ASSETS

BALL = """<mujoco><option timestep=".002"/><worldbody><geom type="plane" size="9 9 .1"/><body pos="0 0 .3"><freejoint/>
  <geom size=".1" mass="1"/></body></worldbody></mujoco>"""


def _slopes(scene, controls, qvel=None):
    """Return the gradient of where a body ends, and the warnings of it."""
    state = mg.initial_state(scene, qvel=qvel)
    controls = jnp.asarray(controls)
    end = lambda qvel: mg.rollout(scene, mg.initial_state(scene, qvel=qvel), controls, contact=mg.Slope()).qpos[-1, 0]  # noqa: E731
    slope = jax.jit(jax.grad(end))
    found = []
    for _ in range(2):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            jax.block_until_ready(slope(state.qvel))
        found.append([str(one.message) for one in told if issubclass(one.category, SlopeWarning)])
    return found


def test_an_ant_that_tramples_is_told_of_once():
    """Gymnasium's, whose contacts last two steps of Runge-Kutta: over 2 s slopes grow to hundreds, its motions do not part so."""
    scene = mg.load_scene(str(ASSETS / "ant.xml"), engine="mujoco")
    rng = np.random.default_rng(0)
    (first,), second = _slopes(scene, 0.3 * rng.normal(size=(200, 8)))
    assert first.startswith("slopes of the outcome multiply over 200 steps, since contacts chatter: a small change")
    assert first.endswith("take contact=mg.Discrete(), fewer steps, or shorter ones")
    assert not second


@pytest.mark.parametrize("steps", [10, 300])
def test_a_ball_that_bounces_and_rolls_is_not(steps):
    """It falls, bounces and rolls on; its slope is that of the outcome, and so is as large as motions part."""
    scene = mg.load_scene(BALL, engine="mujoco")
    assert _slopes(scene, np.zeros((steps, 0)), jnp.array([0.5, 0, 0, 0, 1.0, 0])) == [[], []]
