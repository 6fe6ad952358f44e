"""A scene's springs beside its time step, against closed forms, the textbook's bounce and C MuJoCo's own steps."""

import itertools

import jax
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics.stability import bounce_angle, restitution

SCENE = """
<mujoco>
  <option timestep="{timestep}" gravity="0 0 0" integrator="{integrator}"><flag refsafe="{refsafe}"/></option>
  <default><geom condim="1" solref="{solref}" solimp="{solimp}"/></default>
  <worldbody>
    {floor}
    <body pos="0 0 .1"><joint name="slide" type="slide" axis="0 0 1" limited="{limited}" range="-1 1"
      solreflimit="{solref}"/><geom name="ball" size=".1"/></body>
  </worldbody>
</mujoco>
"""
FLOOR = '<geom name="floor" type="plane" size="1 1 .1"/>'
OTHER = '<geom name="post" size=".05" pos="0 0 -.5"/>'


def _mjcf(**changes):
    given = {
        "timestep": 0.002, "solref": ".02 1", "solimp": ".9 .9 .001", "refsafe": "disable", "floor": FLOOR,
        "limited": "false", "integrator": "Euler",
    }  # fmt: skip
    return SCENE.format(**(given | changes))


def _report(speed=None, **changes):
    return mg.check_stability(mg.load_scene(_mjcf(**changes)), speed=speed)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 5.0])
def test_the_load_is_the_step_over_the_closed_form_limit_in_the_standard_format(ratio):
    # h/tc < 2ζ(√(1 + ζ²) − ζ)
    limit = 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * 0.02
    (spring,) = _report(solref=f".02 {ratio}").springs
    assert spring.load == pytest.approx(0.002 / limit, rel=1e-9)


@pytest.mark.parametrize("share", [0.97, 1.03])
@pytest.mark.parametrize(
    ("integrator", "first", "damping"),
    [("Euler", 0.9, 20), *((x, 0.5, c) for x in ("Euler", "RK4") for c in (20, 400, 800))],
)
def test_c_mujoco_gains_energy_in_a_held_contact_exactly_where_the_load_exceeds_one(integrator, first, damping, share):
    """Pressed into its contact; damping ratios of 0.05, 1 and 2, and where impedance falls with depth."""
    solref, solimp = f"-40000 -{damping}", f"{first} .5 .5"
    (unit,) = _report(solref=solref, solimp=solimp, integrator=integrator).springs
    step = 0.002 * share / unit.load
    model = mujoco.MjModel.from_xml_string(
        _mjcf(solref=solref, solimp=solimp, timestep=step, integrator=integrator).replace("0 0 0", "0 0 -1000", 1)
    )
    data = mujoco.MjData(model)
    # It rests (1 − d) a₀ / k deep, 12.5 mm at d = 0.5; start a tenth of a millimetre deeper.
    data.qpos[0] = -(1 - first) * 1000 / (40000 * (first / 0.5) ** 2) - 1e-4
    mujoco.mj_step(model, data, 400)
    assert (np.abs(data.qvel[0]) > 0.1) == (share > 1)


def test_a_critically_damped_ball_keeps_the_share_exp_minus_two():
    """Then x = v t exp(−ω t): its acceleration vanishes at ω t = 2, where the speed is −v exp(−2)."""
    assert restitution(1.0) == pytest.approx(np.exp(-2), rel=1e-12)
    assert bounce_angle(1.0) == 1.0


def test_nothing_jumps_where_damping_becomes_critical():
    """About ζ = 1 the angle is 1 + (1 − ζ)/3, to the square of the gap."""
    for gap in (1e-9, -1e-9, 1e-5, -1e-5):
        assert bounce_angle(1 - gap) == pytest.approx(1 + gap / 3, abs=1e-10)


def test_a_bounce_lasts_and_goes_as_deep_as_the_closed_form_says():
    scene = mg.load_scene(_mjcf(timestep=1e-5, solref=".02 .5"))
    (spring,) = mg.check_stability(scene).springs
    model = scene.to_mujoco()
    data = mujoco.MjData(model)
    data.qvel[:] = -1.0
    depths, pushes = [], []
    for _ in range(4000):
        mujoco.mj_step(model, data)
        depths.append(-data.qpos[0])
        pushes.append(data.qfrc_constraint[0] > 0)
    # To first order in the time step: one step of the flight, and two of the contact.
    assert spring.depth(1.0) == pytest.approx(max(depths), abs=1e-5)
    assert spring.num_steps == pytest.approx(sum(pushes), abs=2)


def test_what_refsafe_replaces_is_said_with_the_time_constant_in_effect():
    report = _report(refsafe="enable", solref=".003 1")
    (spring,) = report.springs
    assert spring.replaced == pytest.approx(0.003)
    assert spring.time_constant == pytest.approx(0.004)
    assert any("refsafe replaces it by 0.004 s" in text for text in report.warnings)
    assert _report(refsafe="enable", solref="-1e4 -200").springs[0].replaced is None


def test_joint_limits_are_looked_at_with_their_own_format_and_remedy():
    report = _report(refsafe="enable", solref=".003 1", limited="true")
    limit = next(spring for spring in report.springs if spring.kind == "joint limit")
    assert limit.name == "slide"
    assert any(text.startswith("joint limit of slide") and "the direct format" in text for text in report.warnings)


@pytest.mark.parametrize(("cone", "friction", "is_single", "warns"), [
    ("pyramidal", 0.001, True, True),
    ("pyramidal", 0.001, False, False),
    ("elliptic", 0.001, True, False),
    ("pyramidal", 0.5, True, False),
])  # fmt: skip
def test_a_pyramid_of_little_friction_is_too_much_for_single_precision(cone, friction, is_single, warns):
    text = f"""<mujoco><option cone="{cone}"/><worldbody><geom type="plane" size="1 1 1" friction="{friction}"/>
    <body pos="0 0 .1"><freejoint/><geom size=".1" friction="{friction}"/></body></worldbody></mujoco>"""
    with jax.enable_x64(not is_single):
        warnings = mg.check_stability(mg.load_scene(text)).warnings
    assert any("a pyramid of friction 0.001 weighs" in one for one in warnings) == warns


def test_a_switched_off_limit_is_not_looked_at():
    text = _mjcf(limited="true").replace('refsafe="disable"', 'refsafe="disable" limit="disable"')
    assert {spring.kind for spring in mg.check_stability(mg.load_scene(text)).springs} == {"contact"}


def test_four_contacts_of_a_box_pull_as_much_more_as_their_impedances_add_up_to():
    box = _mjcf().replace('size=".1"/></body>', 'type="box" size=".1 .1 .1"/></body>')
    (spring,) = mg.check_stability(mg.load_scene(box)).springs
    assert spring.num_rows == 4
    # n d / (1 + (n − 1) d) over d, for d = 0.9 and n = 4, is k's factor and b's: h²k + 2hb at 1/s² and 1/s.
    factor = 4 / (1 + 3 * 0.9)
    ratio = np.sqrt(factor)  # ζ grows as the root of the factor
    limit = 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * 0.02 / factor
    assert spring.coupled_load == pytest.approx(0.002 / limit, rel=1e-9)


def test_passing_through_is_said_of_a_post_and_not_of_a_plane():
    # 0.15 m of two radii, in 2 ms: from 75 m/s on.
    assert not any("pass through" in text for text in _report(speed=74.0, solref=".005 1", floor=OTHER).warnings)
    assert any("pass through" in text for text in _report(speed=76.0, solref=".005 1", floor=OTHER).warnings)
    assert not any("pass through" in text for text in _report(speed=76.0, solref=".005 1").warnings)


def test_without_a_speed_nothing_is_said_about_onsets():
    assert _report().warnings == ()
    assert any("at 1 m/s its force begins with a jump" in text for text in _report(speed=1.0).warnings)


def test_the_summary_names_the_scene_its_springs_and_its_warnings():
    report = _report(speed=1.0, solref="-1e8 -200")
    text = str(report)
    assert "contact floor – ball" in text
    assert all(one[:40] in text for one in report.warnings)
    assert max(map(len, text.splitlines())) < 160


SHAPES = {"sphere": 'size=".1"', "capsule": 'size=".1 .1"', "ellipsoid": 'size=".1 .12 .1"', "mesh": 'mesh="cube"'}
SHAPES |= {"cylinder": 'size=".1 .1"', "box": 'size=".1 .1 .1"'}
CUBE = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))


@pytest.mark.parametrize(
    ("first", "second"),
    [pair for pair in itertools.combinations_with_replacement(SHAPES, 2) if pair != ("capsule", "capsule")],
)
def test_no_pair_of_shapes_has_more_contacts_than_counted(first, second):
    """By C MuJoCo, in many places; also of pairs that MJX lacks. Of parallel capsules MJX finds one where C finds two."""
    xml = f"""<mujoco><asset><mesh name="cube" vertex="{CUBE}"/></asset><worldbody><geom type="{first}" {SHAPES[first]}/>
        <body><freejoint/><geom type="{second}" {SHAPES[second]}/></body></worldbody></mujoco>"""
    model, random, most = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0), 0
    data = mujoco.MjData(model)
    for turned in np.concatenate([np.tile([1.0, 0, 0, 0], (200, 1)), random.normal(size=(100, 4))]):
        data.qpos[:] = *random.uniform(-0.1, 0.1, 2), random.uniform(0.15, 0.3), *turned
        mujoco.mj_fwdPosition(model, data)
        most = max(most, data.ncon)
    (spring,) = mg.check_stability(mg.load_scene(model)).springs
    assert 1 <= most <= spring.num_rows
