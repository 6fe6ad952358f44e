"""What a user lets a scene do without is gone, said, and nothing else changes."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.scene import SceneWarning

# A ball falls on a floor, beside a pendulum that hangs too high to reach it and has limits.
SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" tolerance="1e-12"/>
  <default><geom condim="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.105"><joint name="fall" type="slide" axis="0 0 1"/><geom name="ball" size="0.1" conaffinity="0"/></body>
    <body pos="2 0 1">
      <joint name="swing" axis="0 1 0" limited="true" range="-1 1"/>
      <geom name="bob" type="capsule" fromto="0 0 0 0.4 0 0" size="0.05" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
PAIRED = SCENE.replace("</worldbody>", "</worldbody><contact><pair geom1='floor' geom2='bob'/></contact>")


def _names(pairs):
    return {frozenset(pair.names) for pair in pairs}


def test_nothing_that_could_act_is_left_out_unless_asked_for():
    assert len(mg.load_scene(SCENE).pairs) == 2
    assert mg.load_scene(SCENE).omitted_pairs == ()


def test_pairs_proven_apart_are_left_out_when_asked_for():
    scene = mg.load_scene(SCENE, leave_out=mg.LeaveOut())
    assert _names(scene.pairs) == {frozenset(("floor", "ball"))}
    (omitted,) = scene.omitted_pairs
    assert set(omitted.pair.names) == {"floor", "bob"}
    # The bob reaches 0.45 down from 1 m; the proof need not be tight, but must not claim more.
    assert omitted.distance is not None
    assert 0.01 <= omitted.distance <= 0.55
    assert int(scene.data._impl.nefc) == 2  # one contact without friction, one limit
    assert _names(mg.load_scene(SCENE).pairs) == _names((*scene.pairs, omitted.pair))


def test_a_clearance_beyond_the_distance_keeps_the_pair():
    assert len(mg.load_scene(SCENE, leave_out=mg.LeaveOut(clearance=0.54)).pairs) == 1
    assert len(mg.load_scene(SCENE, leave_out=mg.LeaveOut(clearance=0.56)).pairs) == 2


def test_the_margin_counts_against_the_distance():
    wide = SCENE.replace('name="bob"', 'name="bob" margin="0.5"')
    assert len(mg.load_scene(wide, leave_out=mg.LeaveOut(clearance=0.1)).pairs) == 2
    assert len(mg.load_scene(wide, leave_out=mg.LeaveOut(clearance=0.04)).pairs) == 1


def test_a_pair_listed_in_the_file_is_never_left_out_by_proof():
    assert len(mg.load_scene(PAIRED, leave_out=mg.LeaveOut()).pairs) == 2


def test_named_pairs_and_limits_are_left_out():
    wanted = mg.LeaveOut(never_touching=False, pairs=(("ball", "floor"),), limits=("swing",))
    scene = mg.load_scene(SCENE, leave_out=wanted)
    assert _names(scene.pairs) == {frozenset(("floor", "bob"))}
    assert scene.omitted_pairs[0].distance is None
    assert int(scene.data._impl.nefc) == 2  # two points of the capsule
    assert scene.mj_model.jnt_limited[1], "the C model stays complete"
    assert scene.mj_model.geom_contype.all()


@pytest.mark.slow  # two gradients to compile
def test_motion_and_gradient_stay_the_same():
    def outcome(scene):
        def height(velocity):
            trajectory = mg.rollout(scene, mg.initial_state(scene, qvel=jnp.array([velocity, 1.0])), horizon=6)
            return trajectory.qpos[-1] @ jnp.array([1.0, 2.0]), trajectory.qpos

        return jax.jit(jax.value_and_grad(height, has_aux=True))(-1.0)

    (value, path), slope = outcome(mg.load_scene(SCENE))
    (lean_value, lean_path), lean_slope = outcome(mg.load_scene(SCENE, leave_out=mg.LeaveOut(limits=("swing",))))
    assert path[:, 0].min() < -0.005, "the ball must touch the floor"
    # XLA may order the operations of two programs differently: roundings of 1e-16, in 6 steps.
    np.testing.assert_allclose(lean_path, path, rtol=0, atol=1e-13)
    np.testing.assert_allclose([lean_value, lean_slope], [value, slope], rtol=1e-11)


def test_a_step_with_and_without_what_does_not_act_is_the_same():
    position, velocity = jnp.array([-0.01, 0.3]), jnp.array([-1.0, 2.0])

    def moved(scene):
        step = jax.jit(lambda model, data: mg.step(model, data).qvel)
        return step(scene.model, scene.data.replace(qpos=position, qvel=velocity))

    lean = moved(mg.load_scene(SCENE, leave_out=mg.LeaveOut(limits=("swing",))))
    full = moved(mg.load_scene(SCENE))
    assert full[0] > -1.0, "the floor must act"
    # Rows that do not act are zero; only the order of sums may differ.
    np.testing.assert_allclose(lean, full, rtol=1e-14)


def test_the_summary_says_what_was_left_out_why_and_how_many_rows_remain():
    wanted = mg.LeaveOut(pairs=(("ball", "floor"),), limits=("swing",), beyond_limits=0.1)
    text = " ".join(mg.load_scene(SCENE, leave_out=wanted).summary().split())
    assert "proven at least" in text
    assert "while no joint leaves its range by more than 0.1: floor – bob" in text
    assert "as asked: floor – ball" in text
    assert "as asked: swing" in text
    # One point of the ball, two of the capsule, one limit.
    assert "0 remain of 4" in text


def test_a_margin_beyond_the_proof_is_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = mg.load_scene(SCENE, leave_out=mg.LeaveOut(clearance=0.3))
        scene.with_softness(mg.Softness(stiffness=400, damping_ratio=1))
    with pytest.warns(SceneWarning, match="floor – bob is left out, proven .* apart, which its margin of 350 mm"):
        scene.with_softness(mg.Softness(margin=0.7))


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"pairs": (("ball", "bal"),)}, "leave_out.pairs must name pairs of geoms that can touch, got 'bal – ball'"),
        ({"limits": ("fall",)}, "leave_out.limits must name joints with limits, got 'fall'; those that have: swing"),
        ({"clearance": -0.1}, "leave_out.clearance must be finite and at least 0, got -0.1"),
        ({"beyond_limits": float("nan")}, "leave_out.beyond_limits must be finite and at least 0, got nan"),
    ],
)
def test_mistakes_are_named(wanted, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        mg.load_scene(SCENE, leave_out=mg.LeaveOut(**wanted))


def test_a_listed_pair_is_not_left_out_by_name():
    with pytest.raises(ValueError, match="listed as <pair> in the MJCF, got 'bob – floor'; remove it there"):
        mg.load_scene(PAIRED, leave_out=mg.LeaveOut(pairs=(("floor", "bob"),)))


def test_keeping_everything_and_leaving_out_exclude_each_other():
    with pytest.raises(ValueError, match="leave_out must be None with keep_everything=True"):
        mg.load_scene(SCENE, leave_out=mg.LeaveOut(), keep_everything=True)
