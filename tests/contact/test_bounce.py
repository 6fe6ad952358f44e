"""A ball that bounces once: closed form against simulation; derivatives are in `stepping/test_slope.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.contact.bounce import Bounce
from mjxgrad.diagnostics import compare_to_slope, phases

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
    assert float(Bounce(0.02, 1.0).restitution) == pytest.approx(np.exp(-2), rel=1e-12)
    assert float(Bounce(0.02, 1.0).duration) == pytest.approx(2 * 0.02, rel=1e-12)


def test_nothing_jumps_where_damping_becomes_critical():
    """Just inside and outside of the series about ζ = 1 values agree to its first left-out term, 1e-12."""
    for edge in (1 - 1e-4, 1 + 1e-4):
        near, far = Bounce(0.02, edge * (1 - 1e-9)), Bounce(0.02, edge * (1 + 1e-9))
        assert float(near.restitution) == pytest.approx(float(far.restitution), rel=1e-8)
    slopes = jax.vmap(jax.grad(lambda ratio: Bounce(0.02, ratio).restitution))(jnp.array([0.999, 1.0, 1.001]))
    assert float(slopes[1]) == pytest.approx(float((slopes[0] + slopes[2]) / 2), rel=1e-5)


def test_the_simulated_height_is_that_of_the_closed_form(found):
    """Semi-implicit steps are of first order: the ball is off by about one step's flight, v h."""
    exact = Bounce(0.02, 1.0).height(found.parameters, DURATION)
    assert np.abs(found.outcomes - np.asarray(exact)).max() < 1.0 * TIMESTEP


def test_the_slope_of_the_simulated_height_is_less_the_restitution(found):
    """First order in h: h/t_c is 2.5 %."""
    assert float(found.slope) == pytest.approx(-np.exp(-2), rel=0.05)
    assert bool(found.is_resolved())
