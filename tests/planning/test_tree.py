"""A tree on smoothed linear models, against dense algebra, rollouts and a box that only a push can move."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.engines.pool import Pool
from mjxgrad.planning import Exact, FunctionSystem, Sampled, SceneSystem, Tree, tree
from mjxgrad.planning.tree import _EVERYTHING, _POSE

INF, START, GOAL = np.inf, np.array([-0.5, 0.0]), np.array([0.0, 1.0])
CONTROL = START[:1]  # the finger is there


def push(state, control):
    """A finger goes where it is told; a box on its right, 0.2 m wide and 0.1 m high, is pushed ahead of it."""
    return jnp.stack([control[0], jnp.maximum(state[1], control[0] + 0.1)])


def tree_of(smoother, **others):
    given = {"lower": [-1.0, -0.2], "upper": [2.0, 1.2], "resolution": [0.1, 0.1]} | others
    given = {name: np.array(x) if isinstance(x, list) else x for name, x in given.items()}
    return Tree(
        FunctionSystem(push, 2, 1), GOAL, np.array([INF, 0.05]), smoother=smoother, **{"reach": 0.3, "batch": 8} | given
    )


@pytest.fixture(scope="module")
def found():
    with jax.enable_x64(True):
        return tree_of(Sampled(None, 0.3, 30)).search(START, CONTROL, jax.random.key(1), capacity=400)


def test_a_push_is_found_from_where_nothing_touches(found):
    assert found.found
    assert abs(found.states[-1, 1] - 1) <= 0.05
    assert np.abs(np.diff([CONTROL, *found.controls], axis=0)).max() <= 0.3 + 1e-12


def test_a_path_is_the_rollout_of_its_controls(found):
    state = jnp.asarray(START)
    for control, expected in zip(found.controls, found.states[1:], strict=True):
        state = push(state, control)
        np.testing.assert_allclose(state, expected, atol=1e-15)
    np.testing.assert_array_equal(found.states[0], START)


def test_errors_are_distances_in_tolerances_and_parents_come_first(found):
    np.testing.assert_allclose(found.errors, np.abs(found.nodes[:, 1] - 1) / 0.05, atol=1e-12)
    assert found.parents[0] == -1
    assert (found.parents[1:] < np.arange(1, len(found.parents))).all()


def test_without_smoothing_the_goal_alone_moves_nothing(monkeypatch):
    """The derivative of the box by the finger is zero before the touch, so that no control takes it nearer."""
    monkeypatch.setattr(tree, "_GOAL", 1.0)
    monkeypatch.setattr(tree, "_ELSEWHERE", 0.0)
    key = jax.random.key(0)
    plain = tree_of(Exact()).search(START, CONTROL, key, capacity=60)
    assert (plain.nodes == START).all()
    smoothed = tree_of(Sampled(None, 0.4, 30)).search(START, CONTROL, key, capacity=60)
    assert smoothed.nodes[:, 1].max() > 0.8


def test_the_same_key_finds_the_same(found):
    again = tree_of(Sampled(None, 0.3, 30)).search(START, CONTROL, jax.random.key(1), capacity=400)
    np.testing.assert_array_equal(again.nodes, found.nodes)


@pytest.mark.parametrize("kind", [_POSE, _EVERYTHING])
def test_distance_and_control_are_those_of_the_dense_ellipsoid(kind):
    """The distance is eᵀ (B Bᵀ + Γ)⁻¹ e of the coordinates that count; the control minimises |k|² + |e − B k|² in 1/Γ."""
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    system = FunctionSystem(lambda x, u: A @ x + B @ u, 3, 2)
    resolution, reach = np.array([0.3, 0.5, 0.2]), np.array([0.7, 1.3])
    grown = Tree(
        system, np.ones(3), np.array([1.0, INF, 1.0]), smoother=Exact(), lower=-np.ones(3), upper=np.ones(3),
        resolution=resolution, reach=reach, batch=1,
    )  # fmt: skip
    state, control, sample = rng.normal(size=3), rng.normal(size=2), rng.normal(size=3)
    given = [jnp.asarray(x)[None] for x in (state, control)]
    keys, kinds = jax.random.split(jax.random.key(0), 1), jnp.array([kind])
    node = grown._made(*given, keys, jnp.ones(3), sample[None], kinds)
    counts = [0, 2] if kind == _POSE else [0, 1, 2]
    away = (sample - A @ state - B @ control)[counts]
    axes, widths = (B * reach)[counts], np.diag(resolution[counts] ** 2)
    expected = away @ np.linalg.solve(axes @ axes.T + widths, away)
    np.testing.assert_allclose(node["distance"][0], expected, rtol=1e-12)
    weight = np.linalg.inv(widths)
    best = np.linalg.solve(np.eye(2) + axes.T @ weight @ axes, axes.T @ weight @ away)
    _, chosen = grown._moved(node, sample[None], kinds)
    np.testing.assert_allclose(chosen[0], control + reach * best / max(1, np.abs(best).max()), rtol=1e-12)


SERVO = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0" damping="8"/><geom size="0.1" mass="0.5"/></body></worldbody>
  <actuator><position joint="x" kp="40" ctrlrange="-0.5 1"/></actuator></mujoco>"""


def test_a_path_by_c_mujoco_is_its_replay_and_each_step_of_a_batch_is_one_call(monkeypatch):
    scene, counts = mg.load_scene(SERVO, engine="mujoco"), {"run": 0}
    function = Pool.run

    def run(*given, **settings):
        counts["run"] += 1
        return function(*given, **settings)

    monkeypatch.setattr(Pool, "run", run)
    grown = Tree(
        SceneSystem(scene, num_substeps=10), np.array([0.9, 0.0]), np.array([0.02, INF]), smoother=Sampled(None, 0.1, 10),
        lower=np.array([-1.0, 0.0]), upper=np.array([1.0, 0.0]), resolution=np.array([0.05, INF]), reach=0.2, batch=4,
    )  # fmt: skip
    found = grown.search(np.zeros(2), np.zeros(1), jax.random.key(0), capacity=200)
    assert found.found
    # A linear model and the nominal step of the root; these and a step of each further batch.
    assert counts["run"] == 2 + 3 * found.num_steps // 4
    data = mujoco.MjData(scene.mj_model)
    for data.ctrl[:] in np.repeat(found.controls, 10, axis=0):
        mujoco.mj_step(scene.mj_model, data)
    np.testing.assert_allclose([*data.qpos, *data.qvel], found.states[-1], atol=1e-9)
    assert found.controls.max() <= 1


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"lower": [0.0]}, r"lower must have shape \(2,\)"),
        ({"resolution": [0.1, INF]}, "both be finite for one coordinate"),
        ({"reach": 0.0}, "reach must be positive, and"),
        ({"batch": 0}, "batch must be at least 1"),
    ],
)
def test_what_does_not_fit_is_refused(wrong, told):
    with pytest.raises(ValueError, match=told):
        tree_of(Exact(), **wrong)


@pytest.mark.parametrize(
    ("start", "control", "told"),
    [
        (np.zeros(3), CONTROL, r"start must have shape \(2,\) in this system, got \(3,\)"),
        (np.array([np.nan, 0.0]), CONTROL, r"start must be finite, got \[nan, 0.0\]"),
        (START, np.zeros(2), r"control must be one number or have shape \(1,\), got \(2,\)"),
        (START, np.array([np.inf]), r"control must be finite, got \[inf\]"),
    ],
)
def test_a_search_from_what_is_no_state_or_control_is_refused(start, control, told):
    with pytest.raises(ValueError, match=told):
        tree_of(Exact()).search(start, control, jax.random.key(0), capacity=10)


@pytest.mark.parametrize(
    ("goal", "told"), [(np.zeros(3), r"goal must have shape \(2,\)"), (np.array([INF, 0.0]), "goal must be finite")]
)
def test_a_goal_that_is_no_state_is_refused(goal, told, monkeypatch):
    monkeypatch.setitem(globals(), "GOAL", goal)
    with pytest.raises(ValueError, match=told):
        tree_of(Exact())
