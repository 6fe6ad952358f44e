"""What is wrong with MJX's derivatives, and gone here.

Each test runs on our step and, marked as an expected failure, on MJX's: should MJX be mended, the mark fails and says so. The
truth is a central difference of the same converged step.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from tests.scenes import central_difference, put

_MJX_IS_WRONG = pytest.mark.xfail(strict=True, reason="plain MJX gets this wrong")
# That MJX still is takes as long to compile as that we are not, and may wait for the slow tests.
both = pytest.mark.parametrize(
    "step", [mg.step, pytest.param(mjx.step, marks=[_MJX_IS_WRONG, pytest.mark.slow])], ids=["mg", "mjx"]
)

# Widths of 1e-6 leave truncation near 1e-12 and rounding near 1e-10 of values around one; derivatives of contact are
# of order ten.
_WIDTH, _CLOSE = 1e-6, {"rtol": 1e-5, "atol": 1e-6}

BALL = """<mujoco><option tolerance="1e-13" iterations="100" ls_iterations="50" {option}/><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body pos="0 0 .1"><joint type="slide" axis="0 0 1" damping=".1"/><geom size=".1" mass="1" {geom}/></body>
</worldbody></mujoco>"""


def _outcome(step, model, data, nq):
    """Return the map from (qpos, qvel) to the next (qpos, qvel)."""

    def outcome(x):
        moved = step(model, data.replace(qpos=x[:nq], qvel=x[nq:]))
        return jnp.concatenate([moved.qpos, moved.qvel])

    return outcome


def _check_jacobian(step, model, data, close):
    """Compare the Jacobian of a step by position and velocity with central differences."""
    outcome = _outcome(step, model, data, model.nq)
    x = jnp.concatenate([data.qpos, data.qvel])
    found, truth = jax.jit(lambda x: (jax.jacfwd(outcome)(x), central_difference(outcome, x, _WIDTH)))(x)
    np.testing.assert_allclose(found, truth, **close)


def _settled(text, steps=1500):
    """Return MJX's model, and data at rest with the warm start of the last step."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return mjx.put_model(model), mjx.put_data(model, data)


@both
def test_reverse_mode_passes_through_a_solve_of_many_iterations(step):
    model, data = put(BALL.format(option="", geom=""))
    slope = jax.jit(jax.grad(lambda v: step(model, data.replace(qvel=v)).qvel[0]))(jnp.zeros(1))
    assert jnp.isfinite(slope).all()


@both
def test_jacobian_at_rest_does_not_depend_on_the_warm_start(step):
    _check_jacobian(step, *_settled(BALL.format(option="", geom="")), _CLOSE)


@both
@pytest.mark.slow
def test_elliptic_contact_without_sliding_has_a_jacobian(step):
    text = BALL.format(option='cone="elliptic"', geom='condim="4"')
    free = text.replace('<joint type="slide" axis="0 0 1" damping=".1"/>', "<freejoint/>")
    _check_jacobian(step, *_settled(free), _CLOSE)


@both
def test_elliptic_cone_without_any_contact_pair_runs(step):
    model, data = put("""<mujoco><option cone="elliptic"/><worldbody><body>
        <joint type="slide" range="-1 1" limited="true"/><geom size=".1"/></body></worldbody></mujoco>""")
    assert jnp.isfinite(jax.jit(step)(model, data).qpos).all()


CARTPOLE = """<mujoco><option timestep=".01" iterations="1" ls_iterations="50"/><worldbody>
  <body><joint type="slide" axis="1 0 0" range="-1 1" limited="true"/><geom type="box" size=".1 .1 .1" mass="1"/>
    <body><joint type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass=".1"/></body></body>
</worldbody></mujoco>"""


@both
def test_inactive_limits_give_no_nan_in_single_precision(step):
    """20000 random cart-poles short of the limit of their slide; one iteration, so that MJX has a reverse mode at all."""
    with jax.enable_x64(False):
        model, data = put(CARTPOLE)
        key_q, key_v = jax.random.split(jax.random.key(0))
        qpos = jax.random.uniform(key_q, (20000, 2), minval=-0.9, maxval=0.9)
        qvel = jax.random.normal(key_v, (20000, 2))
        assert qpos.dtype == jnp.float32

        def slope(q, v):
            return jax.grad(lambda x: _outcome(step, model, data, 2)(x).sum())(jnp.concatenate([q, v]))

        assert jnp.isfinite(jax.jit(jax.vmap(slope))(qpos, qvel)).all()


@both
def test_a_body_at_rest_feels_its_angular_velocity(step):
    """A quaternion moves by h/2 times the angular velocity, at zero velocity too."""
    model, data = put("""<mujoco><option gravity="0 0 0" timestep=".004"/><worldbody>
        <body><freejoint/><geom size=".1"/></body></worldbody></mujoco>""")
    turned = jax.jacfwd(lambda w: step(model, data.replace(qvel=jnp.zeros(6).at[3:].set(w))).qpos[4:])
    slope = jax.jit(turned)(jnp.zeros(3))
    np.testing.assert_allclose(slope, 0.5 * 0.004 * jnp.eye(3), rtol=1e-12, atol=1e-15)


@both
def test_a_contact_deeper_than_its_width_can_be_differentiated(step):
    """The power of solimp, and the position with a power that is no integer."""
    model, data = put(BALL.format(option="", geom='solimp=".5 .9 .001 .5 2.5"'))
    data = data.replace(qpos=jnp.array([-0.01]))

    def outcome(x):
        solimp = model.geom_solimp.at[:, 4].set(x[1])
        return step(model.replace(geom_solimp=solimp), data.replace(qpos=x[:1])).qvel

    both = jax.jit(lambda x: (jax.jacrev(outcome)(x), central_difference(outcome, x, _WIDTH)))
    np.testing.assert_allclose(*both(jnp.array([-0.01, 2.5])), **_CLOSE)


@both
@pytest.mark.parametrize(
    ("solref", "at", "low", "high", "close"),
    [
        pytest.param((-1, 0), 1e4, 1e4 - 1, 1e4 + 1, 1e-6, id="direct, without damping"),
        pytest.param((1, 1), 0.004, 0.004, 0.004 + 1e-8, 1e-4, id="at the clamp of refsafe"),
    ],
)
def test_stiffness_and_time_constant_have_their_derivative(step, solref, at, low, high, close):
    """At exactly two time steps every larger time constant acts: the one-sided derivative, not half of it."""
    model, data = put(BALL.format(option='timestep=".002"', geom=""))
    data = data.replace(qpos=jnp.array([-0.001]))

    @jax.jit
    def outcome(x):
        numbers = jnp.stack([solref[0] * x, jnp.full_like(x, solref[1])])
        return step(model.replace(geom_solref=jnp.broadcast_to(numbers, model.geom_solref.shape)), data).qvel[0]

    slope = jax.jit(jax.grad(outcome))(2 * model.opt.timestep if at == 0.004 else jnp.array(at))
    truth = (outcome(jnp.array(high)) - outcome(jnp.array(low))) / (high - low)
    np.testing.assert_allclose(slope, truth, rtol=close)


CYLINDER = """<mujoco><option tolerance="1e-13" iterations="100" ls_iterations="50"/><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body pos="0 0 .2"><freejoint/><geom type="cylinder" size=".1 .2" mass="1"/></body></worldbody></mujoco>"""
WELD = """<mujoco><option tolerance="1e-13" iterations="100" ls_iterations="50" gravity="0 0 0"/><worldbody>
  <body name="a" pos="0 0 .2"><freejoint/><geom type="box" size=".1 .2 .1" mass="1"/></body>
  <body name="b" pos="0 0 1.2"><freejoint/><geom type="box" size=".1 .2 .1" mass="1"/></body></worldbody>
  <equality><weld body1="a" body2="b"/></equality></mujoco>"""


@both
@pytest.mark.slow
@pytest.mark.parametrize("text", [CYLINDER, WELD], ids=["standing cylinder", "weld at zero error"])
def test_a_degenerate_pose_keeps_its_derivative(step, text):
    """The cylinder's tilt about its first contact point; a weld with nothing to correct."""
    # The cylinder's rim is chosen anew on either side of upright: an error of first order in the width, times stiffness.
    _check_jacobian(step, *_settled(text), {"rtol": 1e-4, "atol": 3e-4})
