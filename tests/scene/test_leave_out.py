"""What a user lets a scene do without is gone, said, and nothing else changes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene.omissions import keep_pairs

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
# What does not act in the motions here.
APART = mg.LeaveOut(pairs=(("floor", "bob"),), limits=("swing",))
PAIRED = SCENE.replace("</worldbody>", "</worldbody><contact><pair geom1='floor' geom2='bob'/></contact>")


def _names(pairs):
    return {frozenset(pair.names) for pair in pairs}


def test_nothing_that_could_act_is_left_out_unless_asked_for():
    assert len(mg.load_scene(SCENE).pairs) == 2
    assert mg.load_scene(SCENE).omitted_pairs == ()


def test_named_pairs_and_limits_are_left_out():
    wanted = mg.LeaveOut(pairs=(("ball", "floor"),), limits=("swing",))
    scene = mg.load_scene(SCENE, leave_out=wanted)
    assert _names(scene.pairs) == {frozenset(("floor", "bob"))}
    assert _names(scene.omitted_pairs) == {frozenset(("floor", "ball"))}
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
    (lean_value, lean_path), lean_slope = outcome(mg.load_scene(SCENE, leave_out=APART))
    assert path[:, 0].min() < -0.005, "the ball must touch the floor"
    # XLA may order the operations of two programs differently: roundings of 1e-16, in 6 steps.
    np.testing.assert_allclose(lean_path, path, rtol=0, atol=1e-13)
    np.testing.assert_allclose([lean_value, lean_slope], [value, slope], rtol=1e-11)


def test_a_step_with_and_without_what_does_not_act_is_the_same():
    position, velocity = jnp.array([-0.01, 0.3]), jnp.array([-1.0, 2.0])

    def moved(scene):
        step = jax.jit(lambda model, data: mg.step(model, data).qvel)
        return step(scene.model, scene.data.replace(qpos=position, qvel=velocity))

    lean = moved(mg.load_scene(SCENE, leave_out=APART))
    full = moved(mg.load_scene(SCENE))
    assert full[0] > -1.0, "the floor must act"
    # Rows that do not act are zero; only the order of sums may differ.
    np.testing.assert_allclose(lean, full, rtol=1e-14)


def test_the_summary_says_what_was_left_out_why_and_how_many_rows_remain():
    wanted = mg.LeaveOut(pairs=(("ball", "floor"),), limits=("swing",))
    text = " ".join(mg.load_scene(SCENE, leave_out=wanted).summary().split())
    assert "as asked: floor – ball" in text
    assert "as asked: swing" in text
    # One point of the ball, two of the capsule, one limit.
    assert "2 remain of 4" in text


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (
            {"pairs": (("ball", "bal"),)},
            r"leave_out.pairs must name pairs of geoms that can touch, got \('ball', 'bal'\)",
        ),
        ({"limits": ("fall",)}, "leave_out.limits must name joints with limits, got 'fall'; those that have: swing"),
    ],
)
def test_mistakes_are_named(wanted, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        mg.load_scene(SCENE, leave_out=mg.LeaveOut(**wanted))


def test_a_listed_pair_is_not_left_out_by_name():
    with pytest.raises(ValueError, match="listed as <pair> in the MJCF, got 'floor – bob'; remove it there"):
        mg.load_scene(PAIRED, leave_out=mg.LeaveOut(pairs=(("floor", "bob"),)))


def test_keeping_everything_and_leaving_out_exclude_each_other():
    with pytest.raises(ValueError, match="leave_out must be None with keep_everything=True"):
        mg.load_scene(SCENE, leave_out=mg.LeaveOut(limits=("swing",)), keep_everything=True)


def _crowd(count):
    bodies = "".join(f"<body pos='{i} 0 0'><freejoint/><geom size='.1'/></body>" for i in range(count))
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom type='plane' size='1 1 1'/>{bodies}</worldbody></mujoco>"
    )


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_masks_keep_the_pairs_that_are_to_be_kept_in_their_order(share):
    model, rng = _crowd(15), np.random.default_rng(3)
    everything = contact_pairs(model)
    kept = tuple(pair for pair in everything if rng.random() < share)
    keep_pairs(model, kept)
    assert contact_pairs(model) == kept


def test_more_masks_than_bits_are_refused():
    """A chain of 65 geoms, each against the next: no bit settles more than the two pairs of one geom."""
    model = _crowd(64)
    chain = [pair for pair in contact_pairs(model) if abs(pair.geom1 - pair.geom2) == 1]
    with pytest.raises(ValueError, match="31 bits"):
        keep_pairs(model, chain)
    shorter = [pair for pair in chain if max(pair.geom1, pair.geom2) <= 62]
    keep_pairs(model, shorter)
    assert contact_pairs(model) == tuple(shorter)
