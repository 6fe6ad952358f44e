"""A ball that bounces once: closed form against simulation; derivatives are in `stepping/test_slope.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import compare_to_slope, phases
from mjxgrad.diagnostics.stability import bounce_angle, restitution

DURATION = 0.1
TIMESTEP = 5e-4


@pytest.fixture(scope="module")
def found():
    """MuJoCo's default contact but for its impedance, which is constant, so that there is a closed form."""
    scene = mg.load_scene(
        f"""<mujoco><option gravity="0 0 0" timestep="{TIMESTEP}"><flag refsafe="disable"/></option><worldbody>
        <geom type="plane" size="1 1 .1"/><body pos="0 0 .05"><joint type="slide" axis="0 0 1"/><geom size=".05"/></body>
        </worldbody></mujoco>"""
    )
    model = scene.model.tree_replace({"geom_solimp": scene.model.geom_solimp.at[:, :2].set(0.9)})
    scene = mg.Scene(**{**vars(scene), "model": model})

    def height(start):
        state = mg.initial_state(scene, qpos=start[None], qvel=jnp.array([-1.0]))
        return mg.rollout(scene, state, horizon=round(DURATION / TIMESTEP)).qpos[-1, 0]

    starts = phases((0.005, 0.025), 64)
    heights = np.asarray(jax.jit(jax.vmap(height))(jnp.asarray(starts)))
    return compare_to_slope(starts, heights, [heights], ["none"])


def test_a_critically_damped_ball_keeps_the_share_exp_minus_two():
    """Then x = v t exp(−ω t): its acceleration vanishes at ω t = 2, where the speed is −v exp(−2)."""
    assert restitution(1.0) == pytest.approx(np.exp(-2), rel=1e-12)
    assert bounce_angle(1.0) == 1.0


def test_nothing_jumps_where_damping_becomes_critical():
    """About ζ = 1 the angle is 1 + (1 − ζ)/3, to the square of the gap."""
    for gap in (1e-9, -1e-9, 1e-5, -1e-5):
        assert bounce_angle(1 - gap) == pytest.approx(1 + gap / 3, abs=1e-10)


def test_the_simulated_height_is_that_of_the_closed_form(found):
    """Semi-implicit steps are of first order: the ball is off by about one step's flight, v h.

    At critical damping contact takes 2 / ω = 2 t_c and ends at v t exp(−ω t), two t_c exp(−2) deep at 1 m/s.
    """
    flown = DURATION - found.parameters - 2 * 0.02
    exact = np.exp(-2) * (flown - 2 * 0.02)
    assert np.abs(found.outcomes - np.asarray(exact)).max() < 1.0 * TIMESTEP


def test_the_slope_of_the_simulated_height_is_less_the_restitution(found):
    """First order in h: h/t_c is 2.5 %."""
    assert float(found.slope) == pytest.approx(-np.exp(-2), rel=0.05)
    assert bool(found.is_resolved())
