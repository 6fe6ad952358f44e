"""Plans on smoothed models: against dense least squares where they are exact, and where contact must be made."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import mjxgrad as mg
from mjxgrad.planning import (
    Analytic,
    Cost,
    Exact,
    FunctionSystem,
    GoalCost,
    LinearModel,
    SceneSystem,
    Smoother,
    optimise_trajectory,
    trajectory,
)
from mjxgrad.planning.system import terminal_model
from mjxgrad.planning.trajectory import minimise_in_box
from mjxgrad.stepping import Smoothing

A, B = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.02, 0.0], [0.1, 0.05]])
HORIZON, START, GOAL = 6, jnp.array([1.0, -0.5]), jnp.array([0.2, 0.3])
STAGE, TERMINAL, CONTROL = jnp.array([1.0, 0.3]), jnp.array([20.0, 5.0]), 0.01
GAP = 0.3


def affine(state, control):
    return A @ state + B @ control


def pushed(state, control):
    """A finger and a block on a rail; the block gives way to the finger, and does not come along."""
    finger = state[0] + control[0]
    return jnp.stack([finger, jnp.maximum(state[1], finger)])


def dense():
    """The same problem as one least-squares problem ½ |G u − r|² in all controls."""
    powers = [np.linalg.matrix_power(A, i) for i in range(HORIZON + 1)]
    rows, right = [], []
    for t in range(HORIZON + 1):
        weight = np.sqrt(np.asarray(TERMINAL if t == HORIZON else STAGE))
        blocks = [powers[t - 1 - i] @ B if i < t else np.zeros((2, 2)) for i in range(HORIZON)]
        rows.append(weight[:, None] * np.concatenate(blocks, axis=1))
        right.append(weight * (np.asarray(GOAL) - powers[t] @ np.asarray(START)))
    rows.append(np.sqrt(CONTROL) * np.eye(2 * HORIZON))
    right.append(np.zeros(2 * HORIZON))
    return np.concatenate(rows), np.concatenate(right)


@eqx.filter_jit
def planned(limit):
    """Return the plan of the linear problem."""
    system, cost = FunctionSystem(affine, 2, 2), GoalCost(GOAL, STAGE, TERMINAL, CONTROL)
    return optimise_trajectory(
        system, cost, START, jnp.zeros((HORIZON, 2)), jax.random.key(0), smoother=Exact(),
        schedule=np.ones(25), lower=-limit, upper=limit,
    )  # fmt: skip


@pytest.mark.parametrize("limit", [1e3, 2.0])
def test_a_linear_plan_is_the_optimum_of_dense_least_squares(limit):
    G, r = dense()
    expected = lsq_linear(G, r, (-limit, limit), tol=1e-13)
    plan = planned(jnp.array(limit))
    if limit < 10:
        assert (np.abs(expected.x) > 0.999 * limit).sum() > 2
    # The step's regularisation of 1e-6 leaves a share of that of the way in each iteration.
    np.testing.assert_allclose(plan.controls.ravel(), expected.x, atol=1e-5)
    np.testing.assert_allclose(plan.cost, expected.cost, rtol=1e-8)
    assert plan.converged


def test_one_step_on_a_linear_problem_falls_by_what_it_promised():
    plan = planned(jnp.array(1e3))
    np.testing.assert_allclose(plan.iterations.promised[0], plan.start_cost - plan.iterations.cost[0], rtol=1e-6)
    assert plan.iterations.step[0] == 1


def test_ctrl_c_ends_with_the_best_of_the_iterations_before(monkeypatch):
    """In the third iteration; in the first nothing was found. As one program, under `jax.jit`, it is the same plan."""
    system, cost = FunctionSystem(affine, 2, 2), GoalCost(GOAL, STAGE, TERMINAL, CONTROL)

    def plan(schedule=None, last=None):
        left = iter(range(99 if last is None else last))

        def call(work):
            if next(left, None) is None:
                raise KeyboardInterrupt
            return work()

        monkeypatch.setattr(trajectory, "patiently", call)
        given = system, cost, START, jnp.zeros((HORIZON, 2)), jax.random.key(0)
        return optimise_trajectory(*given, schedule=schedule, lower=-2.0, upper=2.0)

    with pytest.warns(UserWarning, match="interrupted after 2 of 20 iterations: the plan is the best of these"):
        found = plan(last=3)
    expected = plan(schedule=np.ones(2))
    assert found.iterations.cost.shape == (2,)
    for name in ("controls", "cost", "start_cost"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    whole = plan()
    assert whole.cost < found.cost
    np.testing.assert_allclose(whole.controls, planned(jnp.array(2.0)).controls, atol=1e-6)
    for nothing in (0, 1):
        with pytest.raises(KeyboardInterrupt):
            plan(last=nothing)


@pytest.mark.parametrize("num_controls", [1, 2])
def test_controls_without_influence_and_weight_stay_while_the_others_reach_the_goal(num_controls):
    """The last force moves the speed alone, which has no weight, as controls have none; a second control moves nothing at all."""
    system = FunctionSystem(lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]]), 2, num_controls)
    cost = GoalCost(jnp.array([1.0, 0.0]), 0.0, jnp.array([1.0, 0.0]), 0.0)
    plan = optimise_trajectory(system, cost, jnp.zeros(2), jnp.zeros((10, num_controls)), jax.random.key(0))
    assert plan.cost < 1e-12 * plan.start_cost
    assert plan.converged
    np.testing.assert_array_equal(plan.controls[-1], 0.0)
    np.testing.assert_array_equal(plan.controls[:, 1:], 0.0)


def test_a_scenes_plan_starts_at_its_state_or_its_data():
    scene = mg.load_scene(
        """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body></worldbody>
        <actuator><motor joint="x"/></actuator></mujoco>"""
    )
    system = SceneSystem(scene=scene.with_engine("mujoco"))
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:], data.qvel[:] = 0.3, -0.2
    starts = jnp.array([0.3, -0.2]), data, mg.initial_state(scene, np.array([0.3]), np.array([-0.2]))
    cost = GoalCost(jnp.zeros(2), jnp.ones(2), jnp.ones(2), 1.0)
    plans = [
        optimise_trajectory(system, cost, x, jnp.zeros((3, 1)), jax.random.key(0), schedule=np.ones(1)) for x in starts
    ]
    for one in plans:
        np.testing.assert_array_equal(one.states, plans[0].states)
    given = system, cost, data, jnp.zeros((3, 1)), jax.random.key(0)
    with pytest.raises(ValueError, match="schedule must be given with a smoother: one factor of the smoothing per"):
        optimise_trajectory(*given, smoother=Analytic(Smoothing(0.01)))


@pytest.mark.parametrize("seed", range(5))
def test_a_program_in_a_box_has_the_minimum_of_bounded_least_squares(seed):
    rng = np.random.default_rng(seed)
    root, gradient = np.tril(rng.normal(size=(4, 4))) + 2 * np.eye(4), 4 * rng.normal(size=4)
    low, high = -rng.uniform(0, 1, 4), rng.uniform(0, 1, 4)
    found, _, is_sound = minimise_in_box(*map(jnp.asarray, (root @ root.T, gradient, low, high)))
    expected = lsq_linear(root.T, -np.linalg.solve(root, gradient), (low, high), tol=1e-14)
    np.testing.assert_allclose(found, expected.x, atol=1e-7)
    assert is_sound


class Saddle(Cost):
    """A cost that bends down along the second coordinate."""

    def stage(self, system, state, control):
        return 0.0 * control[0]

    def terminal(self, system, state):
        return state[0] ** 2 + state[0] - state[1] ** 2


def test_curvature_that_bends_down_is_left_out_and_the_slope_kept():
    found = terminal_model(Saddle(), FunctionSystem(affine, 2, 2), jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(found.gradient, [3.0, -4.0])
    np.testing.assert_allclose(found.hessian, [[2.0, 0.0], [0.0, 0.0]], atol=1e-12)


def test_a_step_that_would_leave_finite_numbers_is_shortened():
    """A point on a line may go anywhere up to 0.5, beyond which there are no numbers; its goal is at 1."""
    system = FunctionSystem(lambda state, control: jnp.where(state + control > 0.5, jnp.nan, state + control), 1, 1)
    cost = GoalCost(jnp.ones(1), 0.0, 1.0, 1e-3)
    plan = optimise_trajectory(
        system, cost, jnp.zeros(1), jnp.zeros((4, 1)), jax.random.key(0), smoother=Exact(), schedule=np.ones(20)
    )
    assert np.isfinite(plan.states).all()
    # The shortest of the steps that are tried is 0.03 of the way.
    assert 0.45 < plan.states[-1, 0] <= 0.5
    assert not plan.diverged


class Softly(Smoother):
    """The same with normal noise w on the finger's place: the block goes to E max(b, f + w) = b + σ [φ(z) + z Φ(z)]."""

    length: jax.Array

    def step(self, system, state, control, key):
        finger = state[0] + control[0]
        z = (finger - state[1]) / self.length
        gained = jax.scipy.stats.norm.pdf(z) + z * jax.scipy.stats.norm.cdf(z)
        return jnp.stack([finger, state[1] + self.length * gained])

    def linear_model(self, system, state, control, key):
        return LinearModel(*jax.jacfwd(lambda *at: self.step(system, *at, key), (0, 1))(state, control))


@eqx.filter_jit
def pushing(smoother):
    """Return the plan that brings the block from 0 to 1; the finger starts short of it."""
    cost = GoalCost(jnp.array([0.0, 1.0]), jnp.zeros(2), jnp.array([0.0, 10.0]), 0.01)
    return optimise_trajectory(
        FunctionSystem(pushed, 2, 1), cost, jnp.array([-GAP, 0.0]), jnp.zeros((8, 1)), jax.random.key(0),
        smoother=smoother, schedule=np.geomspace(1, 0.01, 25), lower=-0.4, upper=0.4,
    )  # fmt: skip


def test_a_block_that_is_not_touched_is_pushed_home_by_smoothed_models():
    plan = pushing(Softly(jnp.array(0.3)))
    # The finger's way is GAP + 1 in eight steps, at the least (1 + GAP)² / 8 squared controls, half of it at a weight of 0.01.
    assert plan.cost < 1.5 * 0.5 * 0.01 * (1 + GAP) ** 2 / 8
    assert plan.start_cost == pytest.approx(5.0)
    np.testing.assert_allclose(plan.states[-1, 1], 1.0, atol=0.01)
    assert np.all(np.abs(plan.controls) <= 0.4)
    assert not plan.unmoved.any()


def test_without_smoothing_nothing_is_known_of_the_block_and_nothing_moves():
    plan = pushing(Exact())
    assert plan.cost == plan.start_cost
    np.testing.assert_array_equal(plan.controls, 0)
    # The block costs and no control moves it; the finger, which one moves, costs nothing.
    assert plan.unmoved.tolist() == [False, True]
    assert not plan.converged
    assert plan.verdict().startswith("nothing is touched: no control moves 'coordinate 1', which has")
    assert (
        str(plan)
        == f"Cost {plan.cost:.3g} from {plan.start_cost:.3g} in {plan.iterations.cost.size} iterations: {plan.verdict()}."
    )


def _swinging(growth):
    """Return the plan of a mass that a control moves and a second coordinate that multiplies in each step."""
    system = FunctionSystem(lambda x, u: jnp.stack([x[0] + u[0], growth * (x[1] + u[0])]), 2, 1)
    given = GoalCost(jnp.ones(2), jnp.zeros(2), jnp.ones(2), 0.01), jnp.zeros(2), jnp.zeros((8, 1)), jax.random.key(0)
    return optimise_trajectory(system, *given, smoother=Exact(), schedule=np.ones(3))


def test_what_multiplies_hides_nothing_that_is_moved():
    assert _swinging(30.0).unmoved.tolist() == [False, False]


def test_derivatives_that_are_no_numbers_are_told():
    plan = _swinging(1e60)
    assert plan.cost == plan.start_cost
    assert not plan.converged
    assert plan.verdict().startswith("not improved: the derivatives of its steps multiply beyond all numbers; give")


@pytest.mark.parametrize(("reached", "told"), [(9.5, "not converged: 5% of what linear models promised came true"),
                                              (6.0, "not converged; take more iterations")])  # fmt: skip
def test_a_plan_whose_models_promise_in_vain_is_told(reached, told):
    """Of 10 that two iterations promised 0.5 or 4 came true."""
    costs, plan = jnp.array([10.0, 9.8, reached]), _swinging(1.0)
    iterations = dataclasses.replace(plan.iterations, smoothed_cost=costs, promised=jnp.array([0.0, 5.0, 5.0]))
    plan = dataclasses.replace(plan, iterations=iterations, converged=jnp.asarray(False), cost=plan.start_cost)
    assert plan.verdict().startswith(told)


def test_a_plan_whose_derivatives_are_wrong_has_not_converged():
    """Regularisation grows until the model promises nothing."""

    def planned(factor):
        step = lambda x, u: x + factor * u + jax.lax.stop_gradient((1 - factor) * u)  # noqa: E731
        given = GoalCost(jnp.ones(1), 1.0, 1.0, 0.01), jnp.zeros(1), jnp.zeros((4, 1)), jax.random.key(0)
        return optimise_trajectory(FunctionSystem(step, 1, 1), *given, smoother=Exact(), schedule=np.ones(30))

    wrong = planned(-1.0)
    assert wrong.iterations.promised[-1] < 1e-4 * wrong.cost
    assert not wrong.converged
    assert planned(1.0).converged


def test_a_plan_is_the_rollout_of_its_controls():
    plan = pushing(Softly(jnp.array(0.3)))
    state = plan.states[0]
    for control, expected in zip(plan.controls, plan.states[1:], strict=True):
        state = pushed(state, control)
        np.testing.assert_allclose(state, expected, atol=1e-14)


def test_to_plan_again_compiles_nothing(compilations):
    """Nor to step a scene or to roll it out: from elsewhere, to elsewhere, with other weights and limits."""
    scene = mg.load_scene(
        "<mujoco><worldbody><body><joint type='slide' name='x'/><geom size='.1'/></body></worldbody>"
        "<actuator><motor joint='x'/></actuator></mujoco>"
    )
    given = jnp.zeros((HORIZON, 2))
    for i in range(3):
        before = len(compilations)
        system, cost = FunctionSystem(affine, 2, 2), GoalCost(GOAL + i, STAGE, TERMINAL, CONTROL + i)
        plan = optimise_trajectory(
            system,
            cost,
            START + i,
            given,
            jax.random.key(i),
            smoother=Exact(),
            schedule=np.array([1.0, 0.5 - 0.1 * i]),
            upper=3.0 + i,
        )
        given = plan.controls
        state = SceneSystem(scene, num_substeps=2).step(jnp.array([0.1 * i, 0.0]), jnp.ones(1))
        mg.rollout(
            scene, mg.initial_state(scene, state[:1], state[1:]), float(i) * jnp.ones((3, 1)), contact=mg.Onset()
        )
        assert i == 0 or len(compilations) == before


def test_a_smoother_scales_all_that_has_a_length():
    analytic = Analytic(Smoothing(0.2, "backward")).scaled(0.5)
    assert (analytic.smoothing.length, analytic.smoothing.mode) == (0.1, "backward")
