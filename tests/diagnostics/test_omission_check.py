"""The full model is asked whether recorded motions needed what was left out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from tests.scene.test_leave_out import SCENE

H, G = 0.005, 9.81
FLOOR = mg.LeaveOut(pairs=(("floor", "ball"),))


def _recorded(scene, qpos, qvel, horizon):
    """Rollouts by C MuJoCo of the scene as it is stepped, one for each row of start positions."""
    model = mg.diagnostics.omissions.without_omissions(scene, scene.to_mujoco())
    data = mujoco.MjData(model)
    rollouts = []
    for position, velocity in zip(qpos, qvel, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = position, velocity
        states = []
        for _ in range(horizon + 1):
            states.append((data.qpos.copy(), data.qvel.copy()))
            mujoco.mj_step(model, data)
        positions, velocities = (jnp.array(x) for x in zip(*states, strict=True))
        rollouts.append(
            mg.Trajectory(
                qpos=positions,
                qvel=velocities,
                ctrl=jnp.zeros((horizon, model.nu)),
                observations=None,
                final=mg.initial_state(scene),
                diverged=jnp.array(False),
                first_bad_step=jnp.array(-1),
            )
        )
    return jax.tree.map(lambda *x: jnp.stack(x), *rollouts)


def _with(trajectory, **parts):
    return eqx.tree_at(lambda t: [getattr(t, name) for name in parts], trajectory, list(parts.values()))


def test_an_omitted_contact_that_acts_is_named_with_its_time_and_depth():
    """A ball 5 mm above the floor: after n steps of semi-implicit Euler it has fallen g h² n (n + 1) / 2."""
    scene = mg.load_scene(SCENE, leave_out=FLOOR)
    trajectory = _recorded(scene, [[0.0, 0.0]], [[0.0, 0.0]], horizon=20)
    fallen = G * H**2 * np.arange(21) * np.arange(1, 22) / 2
    first = int(np.argmax(fallen > 0.005))
    check = mg.check_omissions(scene, trajectory)
    (missed,) = check.missed
    assert not check.is_sound
    assert missed.what == "contact of floor – ball"
    assert missed.time == pytest.approx(first * H)
    assert missed.num_states == 21 - first
    assert missed.depth == pytest.approx(fallen[-1] - 0.005, rel=1e-9)
    assert "contact of floor – ball acted in" in check.summary()


def test_the_difference_that_an_omitted_contact_makes_is_its_force():
    """Resting on the floor the ball's weight is carried by what is left out: one mass, one slide joint."""
    scene = mg.load_scene(SCENE, leave_out=FLOOR)
    full = scene.to_mujoco()
    data = mujoco.MjData(full)
    for _ in range(400):
        mujoco.mj_step(full, data)
    mass = full.body_mass[1]
    resting = _recorded(scene, [data.qpos], [data.qvel], horizon=1)
    # Two seconds of a contact that decays in 20 ms.
    first = mg.check_omissions(scene, _with(resting, first_bad_step=jnp.array([0])))
    assert first.force_error == pytest.approx(mass * G, rel=1e-6)
    check = mg.check_omissions(scene, resting)
    # Without its floor the ball gains g h in the first step.
    assert check.step_error == pytest.approx(G * H, rel=1e-6)
    # What was recorded fell, the full model did not.
    assert check.recorded_error == pytest.approx(G * H, rel=1e-6)


def test_a_limit_that_acts_is_named():
    scene = mg.load_scene(SCENE, leave_out=mg.LeaveOut(limits=("swing",)))
    trajectory = _recorded(scene, [[0.5, 0.0], [0.5, 0.9]], [[0.0, 0.0], [0.0, 4.0]], horizon=10)
    (missed,) = mg.check_omissions(scene, trajectory).missed
    assert missed.what == "limit of joint 'swing'"
    # Of the second rollout alone: 0.1 rad at 4 rad/s and more.
    assert missed.time <= 0.025
    assert missed.num_states <= 10


def test_omissions_that_never_act_change_neither_forces_nor_steps():
    scene = mg.load_scene(SCENE, leave_out=mg.LeaveOut(pairs=(("floor", "bob"),), limits=("swing",)))
    trajectory = _recorded(scene, [[0.0, -0.5], [0.1, 0.0]], [[-1.0, 0.0], [0.0, 1.0]], horizon=20)
    check = mg.check_omissions(scene, trajectory)
    assert check.is_sound
    assert check.num_states == 42
    assert check.force_scale > 1, "the ball must rest on the floor"
    # The same problem less rows that do not act, both solved to 1e-12.
    assert check.force_error <= 1e-9 * check.force_scale
    assert check.step_error <= 1e-9
    assert "nothing that was left out acted in 42 states" in check.summary()


def test_rollouts_are_replayed_as_they_were_recorded():
    """Controls, activation and softness have their part in each step of MJX; C MuJoCo repeats it."""
    driven = SCENE.replace(
        "</mujoco>", "<actuator><general joint='swing' dyntype='filter' dynprm='0.1'/></actuator></mujoco>"
    )
    scene = mg.load_scene(driven, leave_out=mg.LeaveOut(pairs=(("floor", "bob"),)))
    scene = scene.with_softness(mg.Softness(stiffness=900, damping_ratio=0.5))
    state = mg.initial_state(scene, qvel=jnp.array([-1.0, 0.0]), act=jnp.array([0.3]))
    controls = jnp.linspace(-1, 1, 10)[:, None]
    trajectory = jax.jit(lambda c: mg.rollout(scene, state, c))(controls)
    check = mg.check_omissions(scene, trajectory, act=state.act)
    assert check.is_sound
    assert check.force_scale > 1
    # Both solved to 1e-12, velocities of the order of one.
    assert check.recorded_error <= 1e-9


def test_what_recorded_motions_did_not_reach_can_be_left_out_of_them():
    full = mg.load_scene(SCENE)
    trajectory = _recorded(full, [[0.0, -0.5]], [[0.0, 0.0]], horizon=20)
    found = mg.diagnostics.unused(full, trajectory)
    assert found.pairs == (("floor", "bob"),)
    assert found.limits == ("swing",)
    lean = mg.load_scene(SCENE, leave_out=found)
    assert mg.check_omissions(lean, trajectory).is_sound


def test_what_came_near_is_not_proposed():
    full = mg.load_scene(SCENE)
    trajectory = _recorded(full, [[0.3, 0.9]], [[0.0, 0.0]], horizon=1)
    assert mg.diagnostics.unused(full, trajectory, limit_clearance=0.05).limits == ("swing",)
    assert mg.diagnostics.unused(full, trajectory, limit_clearance=0.2).limits == ()
    # The ball is at 0.105 + 0.3 - 0.1.
    assert ("floor", "ball") in mg.diagnostics.unused(full, trajectory, clearance=0.29).pairs
    assert ("floor", "ball") not in mg.diagnostics.unused(full, trajectory, clearance=0.32).pairs


def test_contacts_that_came_near_at_once_are_counted():
    """A box falls flat from 5 cm, for three steps of 2 ms: no farther than 0.2 mm."""
    scene = mg.load_scene(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .15"><freejoint/>
        <geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    )
    trajectory = jax.jit(lambda: mg.rollout(scene, mg.initial_state(scene), horizon=3))()
    assert mg.diagnostics.contacts_needed(scene, trajectory, clearance=0.051) == 4
    assert mg.diagnostics.contacts_needed(scene, trajectory, clearance=0.049) == 1


def test_states_after_a_divergence_are_not_looked_at():
    scene = mg.load_scene(SCENE, leave_out=FLOOR)
    trajectory = _recorded(scene, [[0.0, 0.0]], [[0.0, 0.0]], horizon=20)
    cut = _with(trajectory, first_bad_step=jnp.array([2]))
    check = mg.check_omissions(scene, cut)
    assert check.is_sound
    assert check.num_states == 3


def test_a_trajectory_of_another_scene_is_refused():
    scene = mg.load_scene(SCENE, leave_out=FLOOR)
    trajectory = _recorded(scene, [[0.0, 0.0]], [[0.0, 0.0]], horizon=2)
    other = mg.load_scene("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"trajectory\.qpos must have 1 columns in this scene, got 2"):
        mg.check_omissions(other, trajectory)
    bad = _with(trajectory, qvel=trajectory.qvel.at[0, 1, 0].set(jnp.nan))
    with pytest.raises(ValueError, match=r"trajectory\.qvel must be finite"):
        mg.check_omissions(scene, bad)
