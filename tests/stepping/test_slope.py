"""`mg.Slope` of MJX's step: MuJoCo's motion to the bit, and the derivative whose mean is the slope of its outcome."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import compare_to_slope, phases

BALL = """<mujoco><option gravity="0 0 0" timestep="0.002"/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .2">
    <joint type="slide" axis="0 0 1" {limit}/><geom size=".1" mass="1" {contact}/></body></worldbody></mujoco>"""


PLACES = phases((0.0, 0.03), 96)


def _ends(scene, contact, transform):
    """Return what a transformation gives of the end as a function of the place where the motion starts."""

    def end(place):
        start = mg.initial_state(scene, place[None], jnp.array([-2.0]))
        return mg.rollout(scene, start, horizon=120, contact=contact).qpos[-1, 0]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(transform(end)))(jnp.asarray(PLACES)))


def _forward(function):
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))


@pytest.mark.parametrize(
    ("limit", "contact", "transform"),
    [("", "", jax.value_and_grad), ('range="-.1 1" limited="true"', 'contype="0" conaffinity="0"', _forward)],
    ids=["contact", "limit"],
)
def test_the_mean_derivative_of_a_bounce_is_its_slope_and_the_motion_is_mujocos(limit, contact, transform):
    """-e⁻², nearly: contact at the critical damping leaves e⁻² of the speed."""
    scene = mg.load_scene(BALL.format(limit=limit, contact=contact))
    outcomes, derivatives = _ends(scene, mg.Slope(), transform)
    own, discrete = _ends(scene, mg.Discrete(), _forward)
    np.testing.assert_array_equal(outcomes, own)
    found = compare_to_slope(PLACES, outcomes, [derivatives, discrete], ("slope", "discrete"))
    np.testing.assert_allclose(found.mean[0], found.slope, atol=0.02)
    assert abs(found.mean[1] - found.slope) > 0.5  # a tooth's


@pytest.mark.parametrize("transform", [lambda f: f, jax.grad], ids=["motion", "gradient"])
def test_no_product_is_left_to_a_gpus_ten_bits(transform):
    scene = mg.load_scene(BALL.format(limit="", contact=""))

    def end(speed):
        return mg.rollout(scene, mg.initial_state(scene, qvel=speed), horizon=3, contact=mg.Slope()).qpos[-1, 0]

    program = str(jax.make_jaxpr(transform(end))(jnp.ones(1)))
    assert program.count("dot_general[") == program.count("Precision.HIGHEST, Precision.HIGHEST") > 0
