"""Force at a distance: set on the pairs asked for, and bodies rest where they should."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.contact import Softness
from mjxgrad.scene import SceneWarning, load_scene

# Friction other than 1 and impedance that still rises at rest: neither factor of the rest depth is trivial.
BALL = """
<mujoco>
  <option timestep="0.002" tolerance="1e-14" cone="{cone}"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" friction="0.6" group="3"/>
    <body name="body" pos="0 0 0.12"><freejoint/><geom name="ball" size="0.1" friction="0.6"/></body>
  </worldbody>
</mujoco>
"""
SOFT = Softness(stiffness=2000, damping_ratio=1, impedance=(0.2, 0.8), width=0.01)
GRAVITY = 9.81

# All touch the floor; two and three touch each other besides.
THREE = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" margin="0.001"/>
    <body name="a" pos="0 0 0.1"><freejoint/><geom name="one" size="0.1" group="1" conaffinity="0"/></body>
    <body name="b" pos="1 0 0.1"><freejoint/><geom name="two" size="0.1" group="2" contype="3" conaffinity="2"/></body>
    <body name="c" pos="1.205 0 0.1"><freejoint/><geom name="three" size="0.1" group="2" contype="3" conaffinity="2"/></body>
  </worldbody>
</mujoco>
"""

pytestmark = pytest.mark.filterwarnings("ignore::mjxgrad.scene.SceneWarning")


@pytest.fixture(scope="module")
def pyramids():
    return load_scene(BALL.format(cone="pyramidal"))


@pytest.fixture(scope="module")
def three():
    return load_scene(THREE)


def _with(softness, **parts):
    return dataclasses.replace(softness, **parts)


def _settled(scene):
    """Let C MuJoCo come to rest; 12 s are a hundred decay times of the softest contact here."""
    model = scene.to_mujoco()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=6000)
    assert abs(data.qvel[2]) < 1e-10
    return data


def _distance(data):
    return data.qpos[2] - 0.1


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("margin", [0.0, 0.004])
def test_c_mujoco_rests_where_the_parameters_say(cone, margin):
    scene = load_scene(BALL.format(cone=cone), softness=_with(SOFT, margin=margin))
    expected = scene.contact_parameters().rest_distance(GRAVITY)[0]
    np.testing.assert_allclose(_distance(_settled(scene)), expected, rtol=1e-8)


def test_the_height_of_rest_is_that_without_margin(pyramids):
    plain = _distance(_settled(pyramids.with_softness(SOFT)))
    kept = pyramids.with_softness(_with(SOFT, margin=0.02, rest_acceleration=GRAVITY))
    data = _settled(kept)
    np.testing.assert_allclose(_distance(data), plain, rtol=1e-8)
    # MJX agrees that nothing moves there; 1e-6 of gravity is what C's own rest is good for.
    step = eqx.filter_jit(mg.step)
    state = kept.data.replace(qpos=jnp.asarray(data.qpos), qvel=jnp.zeros(6))
    assert np.abs(step(kept.model, state).qvel).max() < 1e-6 * GRAVITY * 0.002


def test_constant_impedance_needs_the_stiffness_of_the_closed_form(pyramids):
    elliptic = load_scene(BALL.format(cone="elliptic"))
    softness = Softness(2000, 0.7, impedance=0.9, margin=0.03, rest_acceleration=5.0)
    got = elliptic.with_softness(softness).contact_parameters()
    # Depth ρ₀ = (1 − d) a₀ / k without margin; k' = (1 − d) a₀ / (m + ρ₀) with it.
    depth = 0.1 * 5 / 2000
    np.testing.assert_allclose(got.stiffness, 0.1 * 5 / (0.03 + depth), rtol=1e-10)
    np.testing.assert_allclose(got.damping_ratio, 0.7, rtol=1e-10)


def test_force_begins_at_the_margin(pyramids):
    model = pyramids.with_softness(_with(SOFT, margin=0.02)).to_mujoco()
    data = mujoco.MjData(model)
    for distance, touches in ((0.0201, False), (0.0199, True)):
        data.qpos[2] = 0.1 + distance
        mujoco.mj_forward(model, data)
        assert (data.nefc > 0) == touches


def test_rest_depth_has_the_derivative_of_its_equation(pyramids):
    def depth(softness, load):
        return pyramids.with_softness(softness).contact_parameters().rest_depth(load)[0]

    by_parts, by_load = jax.jit(jax.grad(depth, (0, 1)))(SOFT, GRAVITY)
    step = 1e-6
    central = (depth(SOFT, GRAVITY * (1 + step)) - depth(SOFT, GRAVITY * (1 - step))) / (2 * step * GRAVITY)
    # The error of the difference is of order step² and rounding / step: 1e-9.
    np.testing.assert_allclose(by_load, central, rtol=1e-7)
    # The depth depends on load and stiffness through their ratio alone.
    np.testing.assert_allclose(by_parts.stiffness * SOFT.stiffness, -by_load * GRAVITY, rtol=1e-9)


def test_the_margin_of_selected_pairs_is_theirs_alone(three):
    """All pairs of "one" are selected, but the floor touches the others, too."""
    after = three.with_softness(Softness(margin=0.006)).contact_parameters()
    np.testing.assert_allclose(after.margin, 0.006, rtol=1e-12)
    with pytest.raises(ValueError, match=r"two – three would also change the pair .* shares the geom"):
        three.with_softness(Softness(margin=0.006, pairs=(("two", "three"),)))


def test_a_height_is_not_kept_twice_over(pyramids):
    """The stiffness of a contact with a margin may be a compensated one; halving it again would say nothing."""
    once = pyramids.with_softness(_with(SOFT, margin=0.02, rest_acceleration=GRAVITY))
    with pytest.raises(ValueError, match="stiffness must be given with rest_acceleration"):
        once.with_softness(Softness(margin=0.02, rest_acceleration=GRAVITY))


def test_a_margin_on_a_mesh_is_refused():
    mesh = '<asset><mesh name="m" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset><worldbody>'
    source = BALL.format(cone="elliptic").replace("<worldbody>", mesh).replace('size="0.1"', 'type="mesh" mesh="m"')
    with pytest.raises(ValueError, match=r"margin must not be set for the pair .*ball.*mesh"):
        load_scene(source, softness=Softness(margin=0.01))


def test_bodies_that_would_hover_are_warned_about_by_name(pyramids):
    with pytest.warns(SceneWarning, match=r"ball.*hover 0\.01.* m.*rest_acceleration=9\.81"):
        pyramids.with_softness(_with(SOFT, margin=0.02))


@pytest.mark.filterwarnings("error")
def test_a_kept_height_needs_no_warning(pyramids):
    pyramids.with_softness(_with(SOFT, margin=0.005, rest_acceleration=GRAVITY))


def test_bodies_of_several_geoms_keep_a_margin_by_c_mujoco():
    """It rejects them by a margin of their own. The same written in the file is the same motion."""
    text = """<mujoco><default><geom margin="{}"/></default><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .13">
        <freejoint/><geom size=".1" pos=".2 0 0"/><geom size=".1" pos="-.2 0 0"/></body></worldbody></mujoco>"""
    given = load_scene(text.format(0), engine="mujoco", softness=Softness(margin=0.02))
    written = load_scene(text.format(0.01), engine="mujoco")
    one, other = (mg.rollout(scene, mg.initial_state(scene), horizon=100).qpos[-1, 2] for scene in (given, written))
    np.testing.assert_allclose(one, other, atol=1e-9)
    assert other > 0.11
