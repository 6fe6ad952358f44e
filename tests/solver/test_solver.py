"""The solve ends where C's does, on hard problems too, and says so where it does not."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import Inertia
from mjxgrad.solver import constraint, implicit, newton
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import DenseRows, JoinedRows
from mjxgrad.solver.newton import System

_BALL = """
<mujoco>
  <option cone="{cone}" tolerance="1e-15" timestep="{timestep}" iterations="{iterations}"/>
  <worldbody>
    <geom type="plane" size="1 1 .1" friction="{friction} .005 .0001" solref="{solref}" solimp="{solimp}"/>
    <body pos="0 0 {height}"><freejoint/>
      <geom size=".05" mass="1" friction="{friction} .005 .0001" solref="{solref}" solimp="{solimp}"/></body>
  </worldbody>
</mujoco>
"""
_USUAL = {
    "timestep": 0.002, "friction": 0.135, "solref": ".02 1", "solimp": ".9 .95 .001", "height": 0.05, "iterations": 100,
    "cone": "elliptic",
}  # fmt: skip
_HARD = {"timestep": 0.03178, "solref": "7.293e-05 .1113", "solimp": ".9998 .9976 .0337", "friction": 0.0349}
_SOFT = {"timestep": 0.04534, "solref": ".7462 .1337", "solimp": ".9545 .9921 .0002201", "friction": 0.1708}
_ROLL = np.array([0.5, 0.2, -1, 0, 6, 2])  # m/s and rad/s: it slides, spins and falls


def _model(**settings):
    return mujoco.MjModel.from_xml_string(_BALL.format(**{**_USUAL, **settings}))


def _on_its_way(settings, speed):
    """Return C's states and accelerations while the ball goes through the contact."""
    model = _model(**settings)
    data = mujoco.MjData(model)
    data.qpos[2] += 2.3 * speed * model.opt.timestep
    data.qvel[:] = speed * _ROLL
    seen = []
    for _ in range(30):
        mujoco.mj_forward(model, data)
        seen.append((data.qpos.copy(), data.qvel.copy(), data.qacc.copy()))
        mujoco.mj_step(model, data)
    return model, *(np.array(x) for x in zip(*seen, strict=True))


def test_a_sliding_ball_under_an_elliptic_cone_is_pushed_as_in_c():
    """In each of C's states through contact, which stops at an improvement of 1e-15: hence 1e-6 of the largest acceleration."""
    cases = [_on_its_way(*case) for case in ((_HARD, 60.66), (_SOFT, 6.862), ({}, 100.0))]
    base, data = mjx.put_model(cases[0][0]), mjx.make_data(cases[0][0])
    fields = ("geom_friction", "geom_solref", "geom_solimp")
    leaves = {name: jnp.array([getattr(case[0], name) for case in cases]) for name in fields}
    leaves["opt.timestep"] = jnp.array([case[0].opt.timestep for case in cases])

    def push(leaves, qpos, qvel):
        moved = mg.forward(base.tree_replace(leaves), data.replace(qpos=qpos, qvel=qvel))
        return moved.qacc, moved._impl.solver_niter

    states = [jnp.array([case[k] for case in cases]) for k in (1, 2)]
    found, iterations = jax.jit(jax.vmap(jax.vmap(push, (None, 0, 0))))(leaves, *states)
    for accelerations, case in zip(found, cases, strict=True):
        np.testing.assert_allclose(accelerations, case[3], rtol=1e-6, atol=1e-6 * np.abs(case[3]).max())
    assert 3 < iterations.max() <= 20


def test_a_rollout_counts_the_steps_whose_solve_was_cut_short():
    """One iteration is none too few in the air, and too few where a ball begins to slide."""
    scene = mg.load_scene(_model(height=0.0499))
    model = scene.model.replace(opt=scene.model.opt.replace(iterations=1))
    scene = dataclasses.replace(scene, model=model)

    def roll(qvel):
        return mg.rollout(scene, mg.initial_state(scene, qvel=qvel), horizon=4).unsolved

    rising, falling = jax.jit(jax.vmap(roll))(jnp.array([[0, 0, 10.0, 0, 0, 0], [0.5, 0.2, -1, 0, 6, 2]]))
    assert rising <= 1 < falling


@pytest.mark.parametrize(("cone", "are_solved"), [("pyramidal", [False, True]), ("elliptic", [True, True])])
def test_a_rollout_counts_the_steps_that_single_precision_does_not_resolve(cone: str, are_solved: list[bool]):
    """The edges of a pyramid weigh as 1/μ²: at 1e-3 they are 10⁶ times as stiff as their normal, at 0.5 they are not."""
    with jax.enable_x64(False):
        scene = mg.load_scene(_model(height=0.0499, cone=cone))
        spin = jnp.array([0.5, 0.2, 0, 0, 6, 2])

        def iterations(friction, speed):
            model = scene.model.replace(geom_friction=scene.model.geom_friction.at[:, 0].set(friction))
            return mg.step(model, scene.data.replace(qvel=spin.at[2].set(-speed)))._impl.solver_niter

        each = jax.jit(jax.vmap(jax.vmap(iterations, (None, 0)), (0, None)))
        num_iterations = each(jnp.array([1e-3, 0.5]), jnp.array([0.1, 1.0, 10.0]))
    np.testing.assert_array_equal(num_iterations <= 100, np.tile(are_solved, (3, 1)).T)


def test_a_light_body_is_solved_beside_a_heavy_one_that_is_already():
    """In single precision, 10⁸ : 1. Each row acts on one body: a = (f + D a_ref) / (M + D) where that is below a_ref."""
    mass, force = np.array([1e4, 1e-4]), np.array([-1e5, -1e-3])
    weight, reference = np.array([2e4, 3e-4]), np.array([5.0, -4.0])
    expected = (force + weight * reference) / (mass + weight)
    assert (expected < reference).all()
    single = [jnp.asarray(x, jnp.float32) for x in (np.diag(mass), force, np.eye(2), reference, weight)]
    inertia, force, entries, reference, weight = single
    rows = Rows(reference, weight, jnp.zeros_like(weight), ())
    system = System(Inertia(inertia), force, JoinedRows((DenseRows(entries[:, None]),)), jnp.ones(2, bool), rows)
    start = jnp.array([expected[0], 0.0], jnp.float32)
    tolerance = jnp.asarray(1e-6, jnp.float32)
    found, _ = jax.jit(newton.minimise, static_argnums=(0, 1))(RowLayout(0, 0, 2), 100, system, start, tolerance)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("num_hard", [20, *(pytest.param(num, marks=pytest.mark.slow) for num in (0, 160))])
def test_the_last_of_a_large_batch_are_finished_as_in_a_small_one(num_hard: int):
    """In flight there is nothing to iterate; those that slide take some turns, what is not finite has no answer.

    The same numbers to rounding, since the operations are the same, in programs of other shapes. Where the last turns only
    move digits, rounding decides how many there are.
    """
    model = _model()
    mjx_model, data = mjx.put_model(model), mjx.make_data(model)
    size = 512
    heights, qvel = np.full(size, 0.2), np.tile(_ROLL, (size, 1)).astype(float)
    hard = np.random.default_rng(0).permutation(size)[:num_hard]
    heights[hard] = 0.0499
    qvel[hard] *= np.linspace(1, 60, num_hard)[:, None]
    if num_hard:
        qvel[hard[0]] = np.nan
    qpos = np.tile(data.qpos, (size, 1))
    qpos[:, 2] = heights

    @jax.jit
    @jax.vmap
    def push(qpos, qvel):
        moved = mg.forward(mjx_model, data.replace(qpos=qpos, qvel=qvel))
        return moved.qacc, moved._impl.solver_niter

    assert size >= newton._LEAST_BATCH > size // 4
    whole = push(qpos, qvel)
    parts = [push(qpos[i::4], qvel[i::4]) for i in range(4)]
    for i, (acceleration, iterations) in enumerate(parts):
        np.testing.assert_allclose(whole[0][i::4], acceleration, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(whole[1][i::4] <= 100, iterations <= 100)
    if num_hard:
        assert np.isnan(whole[0][hard[0]]).all()
        assert 1 < np.sort(np.asarray(whole[1])[hard])[-2] <= 20


_PENDULUM_BOX = """<mujoco><option iterations="100"/><worldbody><geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/><body pos="0 0 .1">
  <joint axis="0 1 0" range="-.1 .1" frictionloss="1"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".1"/>
  </body></body></worldbody></mujoco>"""


def test_no_solve_goes_around_in_a_circle():
    """A box pressed into the floor, on it a dry hinge at its limit: steps may be a hundred times too long.

    With four looks along each line 1 in 400 does not end; with looks that may go to and fro between two pieces, 1 in 4000.
    The answers are those of C at a tolerance of 1e-8.
    """
    model, size = mujoco.MjModel.from_xml_string(_PENDULUM_BOX), 16384
    mjx_model, data = mjx.put_model(model), mjx.make_data(model)
    random = np.random.default_rng(1)
    poses = np.tile(data.qpos, (size, 1))
    poses[:, :3] += 0.05 * random.normal(size=(size, 3))
    poses[:, 3:7] += 0.03 * random.normal(size=(size, 4))
    poses[:, 7] += 0.05 * random.normal(size=size)
    speeds, starts = 2 * random.normal(size=(size, 7)), 1e3 * random.normal(size=(size, 7))

    @jax.jit
    @jax.vmap
    def push(qpos, qvel, start):
        moved = mg.forward(mjx_model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=start))
        return moved.qacc, moved._impl.solver_niter

    found, num_iterations = push(poses, speeds, starts)
    assert num_iterations.max() <= 20
    hardest = np.argsort(num_iterations)[-5:]
    truth = mujoco.MjData(model)
    for i in hardest:
        truth.qpos[:], truth.qvel[:] = poses[i], speeds[i]
        mujoco.mj_forward(model, truth)
        np.testing.assert_allclose(found[i], truth.qacc, atol=1e-5 * np.abs(truth.qacc).max())


def test_in_single_precision_it_ends_when_what_is_left_is_rounding():
    """What cancels within M a and J a is in no estimate of rounding: without a margin for it half of these go on to the end."""
    random, batch, size = np.random.default_rng(0), 128, 16
    turned = np.linalg.qr(random.normal(size=(batch, size, size)))[0]
    mass = np.einsum("bij,bj,bkj->ikb", turned, 10 ** random.uniform(-2, 0, size=(batch, size)), turned)
    jacobian, reference = random.normal(size=(4, size, batch)), 20 * random.normal(size=(4, batch))
    force, weight = 30 * random.normal(size=(size, batch)), 10 ** random.uniform(-1, 3, size=(4, batch))
    layout, found = RowLayout(0, 0, 4), {}
    for dtype in (jnp.float32, jnp.float64):
        rows = Rows(*(jnp.asarray(x, dtype) for x in (reference, weight, 0 * weight)), ())
        entries = JoinedRows((DenseRows(jnp.asarray(jacobian, dtype)[:, None]),))
        system = System(
            Inertia(jnp.asarray(mass, dtype)), jnp.asarray(force, dtype), entries, jnp.ones((4, batch), bool), rows
        )
        found[dtype] = jax.jit(newton.minimise, static_argnums=(0, 1))(
            layout, 100, system, jnp.zeros((size, batch), dtype), jnp.full(batch, 1e-6, dtype)
        )
    (acceleration, count), (expected, _) = found.values()
    assert count.max() <= 20
    # Conditions of 10² of M, more of H, times eps.
    np.testing.assert_allclose(acceleration, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("size", [4, 18])  # by the factorisation written out, and in blocks
def test_a_row_so_stiff_that_rounding_hides_the_mass_leaves_a_finite_response(size: int):
    """(1 + w j jᵀ)⁻¹ f is f less its part along j, if w is large; from 10⁷ on, single precision has no Cholesky factor of it."""
    random, batch = np.random.default_rng(0), 512
    row, force = random.normal(size=(2, batch, size))
    row /= np.linalg.norm(row, axis=1, keepdims=True)
    weight = 10 ** random.uniform(3, 9, size=(batch, 1))
    single = [jnp.asarray(x, jnp.float32) for x in (row[:, None], force, weight)]

    def response(row, force, weight):
        rows = Rows(jnp.zeros_like(weight), weight, jnp.zeros_like(weight), ())
        entries = JoinedRows((DenseRows(row[:, None]),))
        system = System(Inertia(jnp.eye(size, dtype=force.dtype)), force, entries, jnp.ones(1, bool), rows)
        return implicit.solve_linearised(RowLayout(0, 0, 1), system, constraint.RowHessian(weight, ()), force)

    found = jax.jit(jax.vmap(response))(*single)
    expected = force - row * ((row * force).sum(1) / (1 + 1 / weight[:, 0]))[:, None]
    assert np.isfinite(found).all()
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(force, axis=1)
    # The condition times eps, and a few roundings.
    resolved = weight[:, 0] < 1e5
    assert (error <= 10 * weight[:, 0] * np.finfo(np.float32).eps)[resolved].all()
