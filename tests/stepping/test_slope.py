"""`mg.Slope` of MJX's step: MuJoCo's motion to the bit, and the derivative whose mean is the slope of its outcome."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import compare_to_slope, phases

BALL = """<mujoco><option gravity="0 0 0" timestep="0.002"/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .2">
    <joint type="slide" axis="0 0 1" {limit}/><geom size=".1" mass="1" {contact}/></body></worldbody></mujoco>"""

# Two feet of one body, which hop and chatter while they slide; what one step's friction is depends on the phase of each.
SLEDGE = """<mujoco><option timestep="0.002"/><default><geom solref="0.01 1" friction="0.5 0.005 0.0001"/></default><worldbody>
    <geom type="plane" size="5 5 .1"/><body pos="0 0 .02"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>
    <geom size=".02" pos=".1 0 0"/><geom size=".02" pos="-.1 0 0"/></body></worldbody></mujoco>"""

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


@pytest.mark.parametrize(
    ("engine", "is_double"),
    [("mujoco", True), ("mujoco", False), ("mjx", False), pytest.param("mjx", True, marks=pytest.mark.slow)],
)
def test_a_sledge_that_hops_to_rest_has_the_slope_of_its_way_and_no_derivative_multiplies(engine, is_double):
    """Its way is v²/2μg, nearly. More pairs begin than MJX has slots for; in its last half it rests 6 µm deep."""
    with jax.enable_x64(is_double):
        scene, speeds = mg.load_scene(SLEDGE, engine=engine), phases((0.9, 1.1), 64)

        def way(speed):
            start = mg.initial_state(scene, qvel=jnp.zeros(3).at[0].set(speed))
            return mg.rollout(scene, start, horizon=250, contact=mg.Slope()).qpos[-1, 0]

        outcomes, derivatives = map(np.asarray, jax.jit(jax.vmap(_forward(way)))(jnp.asarray(speeds)))
    found = compare_to_slope(speeds, outcomes, [derivatives], ("slope",))
    np.testing.assert_allclose(found.slope, 1 / (0.5 * 9.81), rtol=0.02)
    assert abs(found.error[0]) < 3 * found.standard_error[0] < 0.02
    assert found.spread[0] < 0.05


@pytest.mark.parametrize("transform", [lambda f: f, jax.grad], ids=["motion", "gradient"])
def test_no_product_is_left_to_a_gpus_ten_bits(transform):
    scene = mg.load_scene(BALL.format(limit="", contact=""))

    def end(speed):
        return mg.rollout(scene, mg.initial_state(scene, qvel=speed), horizon=3, contact=mg.Slope()).qpos[-1, 0]

    program = str(jax.make_jaxpr(transform(end))(jnp.ones(1)))
    assert program.count("dot_general[") == program.count("Precision.HIGHEST, Precision.HIGHEST") > 0
