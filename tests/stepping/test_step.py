"""The step against C MuJoCo, against MJX's rows, and its derivatives against central differences."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.stepping import assembly
from tests.scenes import central_difference, published, put, zoo

_SLOW = pytest.mark.slow
_NAMES = ["hopper", "half_cheetah", "walker2d", "swimmer", "reacher", "inverted_double_pendulum", "ant"]
_QUICK = {"hopper"}
names = pytest.mark.parametrize("name", [n if n in _QUICK else pytest.param(n, marks=_SLOW) for n in _NAMES])
_CASES = [("pyramidal", "Euler"), ("elliptic", "Euler"), ("elliptic", "implicitfast"), ("pyramidal", "RK4")]


def _largest_difference(model, data, steps):
    """Return the largest difference of position and velocity from C over some steps."""
    mjx_model, mjx_data = mjx.put_model(model), mjx.put_data(model, data)
    step = jax.jit(lambda d: mg.step(mjx_model, d))
    worst = 0.0
    for _ in range(steps):
        mujoco.mj_step(model, data)
        mjx_data = step(mjx_data)
        worst = max(worst, np.abs(data.qpos - mjx_data.qpos).max(), np.abs(data.qvel - mjx_data.qvel).max())
    return worst


@names
@pytest.mark.parametrize("settle", [pytest.param(0, marks=_SLOW), 300], ids=["moving", "settled"])
def test_published_scenes_move_as_in_c(name, settle):
    """50 steps at tolerance 1e-12: 1e-9 leaves room for the growth of rounding in contact.

    Where a steep capsule lands, MJX turns the contact's tangents otherwise than C, and with them the pyramid's edges: the
    ant in motion is compared with elliptic cones, which do not feel it. There C stops at an improvement of 1e-12, so its
    accelerations are known to about the root of that, 1e-6, and velocities after a few steps of 0.01 s to 1e-7.
    """
    model, data = published(name, settle)
    is_turned = name == "ant" and settle == 0
    if is_turned:
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    assert _largest_difference(model, data, steps=50) < (1e-7 if is_turned else 1e-9)


@pytest.mark.parametrize(
    ("cone", "integrator"), [_CASES[1], *(pytest.param(*case, marks=_SLOW) for case in (_CASES[0], *_CASES[2:]))]
)
def test_all_kinds_of_rows_move_as_in_c(cone, integrator):
    """Condim 1, 3, 4, 6, limits of hinge, ball, slide and tendon, friction loss, couplings, tumbling bodies held together.

    C stops an elliptic solve at an improvement of 1e-13, that is at forces known to about its root; hence 1e-6. With
    implicitfast C takes the gyroscopic force of tumbling free bodies implicitly and MJX does not, of which load_scene warns.
    """
    assert _largest_difference(*zoo(cone, integrator, welded=integrator != "implicitfast"), steps=30) < 1e-6


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@_SLOW
def test_rows_are_those_of_mjx(cone):
    """Every field but what connect and weld ask for, where MJX lacks the acceleration of turning bodies; rounding of 1e4."""
    model, data = zoo(cone, welded=True)
    mjx_model = mjx.put_model(model)
    ready = jax.jit(lambda d: mjx.fwd_position(mjx_model, d))(mjx.put_data(model, data))
    ours = jax.jit(lambda d: assembly.make_constraint(mjx_model, d, assembly.gather(mjx_model, d)))(ready)._impl
    theirs = jax.jit(lambda d: mjx.make_constraint(mjx_model, d))(ready)._impl
    for name in ("efc_J", "efc_D", "efc_aref", "efc_pos", "efc_margin", "efc_frictionloss"):
        first = 12 if name == "efc_aref" else 0
        found, expected = (getattr(rows, name)[first:] for rows in (ours, theirs))
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-12, err_msg=name)


@_SLOW
def test_solve_replaces_the_one_of_mjx():
    """On data that MJX has prepared, with connect, weld and elliptic contact."""
    model, data = zoo("elliptic", welded=True)
    mjx_model = mjx.put_model(model)
    ready = jax.jit(lambda d: mjx.forward(mjx_model, d))(mjx.put_data(model, data))
    ours = jax.jit(lambda d: mg.solve(mjx_model, d))(ready)
    # MJX stops where the cost improves by less than 1e-13 of its scale, so its forces are known to about 1e-6.
    np.testing.assert_allclose(ours.qacc, ready.qacc, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(ours._impl.efc_force, ready._impl.efc_force, rtol=1e-5, atol=1e-5)


def _check_directional(model, data, steps):
    """Compare derivatives along a random direction in state and controls with central differences."""
    mjx_model, mjx_data = mjx.put_model(model), mjx.put_data(model, data)
    random = np.random.default_rng(3)
    turn, push = random.normal(size=(2, model.nv))
    steer = random.normal(size=(steps, model.nu))
    weight = random.normal(size=model.nq + model.nv)

    def outcome(s):
        qpos = integrate_position(mjx_model, mjx_data.qpos, jnp.asarray(turn), s)
        start = (qpos, mjx_data.qvel + s * push, mjx_data.act, mjx_data.qacc_warmstart)

        def body(carry, controls):
            qpos, qvel, act, warm = carry
            now = mjx_data.replace(
                qpos=qpos, qvel=qvel, act=act, qacc_warmstart=warm, ctrl=mjx_data.ctrl + s * controls
            )
            moved = mg.step(mjx_model, now)
            return (moved.qpos, moved.qvel, moved.act, moved.qacc_warmstart), None

        final, _ = jax.lax.scan(body, start, jnp.asarray(steer))
        return jnp.dot(jnp.concatenate(final[:2]), weight)

    forward = jax.jit(lambda s: jax.jvp(outcome, (s,), (1.0,)))(0.0)[1]
    reverse = jax.jit(jax.grad(outcome))(0.0)
    widths = jnp.array([1e-6, 1e-7, 1e-8])
    ends = jax.jit(jax.vmap(outcome))(jnp.concatenate([widths, -widths]))
    slopes = (ends[:3] - ends[3:]) / (2 * widths)
    # A wide difference may straddle a contact that begins; a narrow one loses digits. The best of three is the truth.
    assert jnp.min(jnp.abs(slopes - forward)) <= 1e-5 * jnp.abs(forward)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


@_SLOW
@pytest.mark.parametrize("name", _NAMES)
def test_directional_derivative_of_50_steps_is_the_central_difference(name):
    _check_directional(*published(name), steps=50)


@pytest.mark.slow
@pytest.mark.parametrize(("cone", "integrator"), _CASES)
def test_derivative_through_all_kinds_of_rows_is_the_central_difference(cone, integrator):
    _check_directional(*zoo(cone, integrator), steps=5)


_SLIDING = """<mujoco><option timestep=".004" tolerance="1e-13" iterations="100" cone="elliptic"/><worldbody>
  <geom type="plane" size="3 3 .1" friction=".5"/>
  <body pos="0 0 .098"><joint name="push" type="slide" axis="1 0 0" damping=".2"/><joint type="slide" axis="0 0 1"/>
    <geom size=".1" mass="1" friction=".3" solref="-4000 -60"/></body></worldbody>
  <actuator><motor joint="push"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "field",
    [
        "geom_solref",
        *(
            pytest.param(x, marks=_SLOW)
            for x in ("body_mass", "geom_friction", "dof_damping", "opt.timestep", "opt.gravity")
        ),
    ],
)
def test_parameters_of_the_model_have_their_derivative(field):
    """Along a scaling of the whole field; mass alone, not what MuJoCo precomputes from it (invweight)."""
    model, data = put(_SLIDING)
    data = data.replace(qvel=jnp.array([1.0, 0.0]), ctrl=jnp.array([0.3]))

    def outcome(scale):
        value = model
        for part in field.split("."):
            value = getattr(value, part)
        changed = model.tree_replace({field: value * scale})

        def step(_, state):
            moved = mg.step(changed, data.replace(**state))
            return {name: getattr(moved, name) for name in state}

        start = {name: getattr(data, name) for name in ("qpos", "qvel", "qacc_warmstart")}
        end = jax.lax.fori_loop(0, 20, step, start)
        return jnp.dot(end["qpos"], jnp.array([1.0, -2.0])) + jnp.dot(end["qvel"], jnp.array([0.5, 3.0]))

    ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(outcome)))(jnp.array([1 + 1e-6, 1.0, 1 - 1e-6]))
    assert jnp.abs(slopes[1]) > 1e-6
    np.testing.assert_allclose(slopes[1], (ends[0] - ends[2]) / 2e-6, rtol=1e-5)


@_SLOW
def test_second_derivatives_nest():
    """Forward over reverse, and over forward, through a sliding contact, in velocity, mass and friction together."""
    model, data = put(_SLIDING)

    def outcome(x):
        changed = model.replace(body_mass=model.body_mass * x[1], geom_friction=model.geom_friction * x[2])
        start = data.replace(qvel=jnp.stack([jnp.ones_like(x[0]), x[0]]), qpos=jnp.array([0.0, -0.001]))
        return mg.step(changed, start).qvel[0]

    point = jnp.array([-0.2, 1.0, 1.0])
    hessian = jax.jit(jax.hessian(outcome))(point)
    truth = jax.jit(lambda x: central_difference(jax.grad(outcome), x, 1e-5))(point)
    assert jnp.sum(jnp.abs(hessian) > 1e-4) > 5
    np.testing.assert_allclose(hessian, truth, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(hessian, jax.jit(jax.jacfwd(jax.jacfwd(outcome)))(point), rtol=1e-6, atol=1e-10)


@_SLOW
def test_a_batch_whose_members_choose_whether_to_step():
    """`jax.lax.cond` on a condition that differs, as of environments of which some are done, is a choice of either."""
    model, data = put(_SLIDING)
    velocities = jnp.array([-0.5, -0.2, 0.1])

    def stepped(v):
        return mg.step(model, data.replace(qvel=jnp.stack([v, v]))).qvel[0]

    def chosen(v):
        return jax.lax.cond(v > -0.3, stepped, lambda v: v, v)

    def either(v):
        return jnp.where(v > -0.3, stepped(v), v)

    found, wanted = (jax.jit(jax.vmap(jax.value_and_grad(f)))(velocities) for f in (chosen, either))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
