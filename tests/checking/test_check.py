"""Planted faults are named, and what is measured is what closed forms say."""

import dataclasses
import functools
import importlib
import re
import threading
import time
import types
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import _text
from mjxgrad.checking import findings
from mjxgrad.checking.check import _warned, program, telling
from mjxgrad.checking.findings import headline, left_out_findings, measured_findings, price_finding, recommend
from mjxgrad.checking.measure import Line, Measured, Slope, crossover, estimates, measure, nearest, slopes
from mjxgrad.checking.motions import (
    KINDS,
    REFINED,
    Direction,
    Moved,
    Mover,
    most_contacts,
    random_motions,
    run,
    seconds_of,
    start_of,
)
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.diagnostics.jumps import Jumps
from mjxgrad.diagnostics.slope import compare_to_slope, phases
from mjxgrad.engines.pool import Pool
from mjxgrad.scene.load import count_pairs
from tests.scenes import ASSETS

BALL = """<mujoco><option timestep="{timestep}"/><default><geom {contact}/></default><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="ball" pos="0 0 {height}"><joint name="z" type="slide" axis="0 0 1"/><geom name="ball" size=".05" mass=".2"/></body>
</worldbody><actuator><motor name="push" joint="z" gear="{gear}" ctrlrange="-1 1"/></actuator></mujoco>"""

# A ball so small that between a hit and a miss lies nothing to be sampled; no gravity, so that its height is that of its start.
WALL = """<mujoco><option timestep=".005" gravity="0 0 0"/><worldbody>
  <geom name="wall" type="box" pos="1 0 1" size=".05 1 .1"/><body name="ball" pos=".2 0 1.08">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <geom name="ball" size=".00005" mass=".2"/></body></worldbody><keyframe><key name="throw" qvel="3 0"/></keyframe></mujoco>"""


def ball(timestep=0.002, height=0.3, gear=1, contact=""):
    return BALL.format(timestep=timestep, height=height, gear=gear, contact=contact)


def quick(source, cost=None):
    return mg.check(source, cost, derivatives=False)


def kinds(verdict):
    return {fault.kind for fault in verdict.faults}


def fault(verdict, kind):
    (found,) = [one.text for one in verdict.faults if one.kind == kind]
    return found


@pytest.fixture(autouse=True)
def short_motions(monkeypatch):
    """Random motions of half a second in place of two, each step of which is asked for its contacts."""
    monkeypatch.setattr("mjxgrad.checking.motions._SECONDS", 0.5)


@pytest.fixture(scope="module")
def measured():
    """From a scene to its verdict, of as few motions as a large scene gets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("mjxgrad.checking.check"), "_BATCH", 32)
        yield functools.cache(lambda source: mg.check(source, budget=1000))


@pytest.fixture
def wall(measured):
    return measured(WALL)


@pytest.fixture
def bounce(measured):
    return measured(ball())


@pytest.mark.parametrize(
    ("contact", "longest"),
    [
        ('solref=".004 1"', 0.002),  # a time constant takes two steps at least, or refsafe replaces it
        # h²k + 2hb = 4 with k = 4e4, b = 400: h = (−b + √(b² + 4k)) / k = 0.0041; the steepest impedance is taken, so less.
        ('solref="-40000 -400"', 0.0042),
    ],
)
def test_a_time_step_too_long_for_a_contact_is_named(contact, longest):
    verdict = quick(ball(timestep=0.01, contact=contact))
    assert "10 ms is too long for contact floor – ball" in fault(verdict, "time_step")
    assert 0 < verdict.recommendation.timestep < longest
    assert not kinds(quick(ball(timestep=verdict.recommendation.timestep, contact=contact)))
    assert repr(verdict.stability) == verdict.stability.summary()


def test_an_actuator_without_effect_is_named_and_no_other():
    assert "actuator 'push'" in fault(quick(ball(gear=0)), "no_effect")
    assert not kinds(quick(ball(gear=1)))


def test_a_price_is_that_of_a_rollouts_gradient(monkeypatch):
    """Plans have cheaper ones, which follow no pairs and give a motion's end alone."""
    own, asked = Pool.maps, set()

    def maps(self, *given, gradient, wanted):
        asked.add((gradient, "apart" in wanted))
        return own(self, *given, gradient=gradient, wanted=wanted)

    monkeypatch.setattr(Pool, "maps", maps)
    prices = seconds_of(mg.load_scene(ball(), engine="mujoco"))
    assert asked == {("slope", True), ("discrete", False)}
    assert 0 < prices["motion"] < prices["discrete"]


@pytest.mark.parametrize(("reach", "expected"), [("-90 90", {"degrees"}), ("-1.5 1.5", set()), ("-9 9", set())])
def test_a_control_range_in_degrees_is_named(reach, expected):
    """MuJoCo turns a joint's range into rad, and no control range; a servo that turns further than its joint is no mistake."""
    scene = mg.load_scene(
        f"""<mujoco><worldbody><body><joint name="j" range="-90 90"/><geom type="capsule" fromto="0 0 0 .3 0 0"
        size=".02"/></body></worldbody><actuator><position name="servo" joint="j" ctrlrange="{reach}"/></actuator></mujoco>"""
    )
    assert kinds(quick(scene)) & {"degrees"} == expected


def test_a_start_that_was_asked_for_is_that_of_motions_and_of_the_code():
    """Without it motions begin at both keys, and the code at the first."""
    keys = "<keyframe><key name='far' qpos='3'/><key name='near' qpos='.1' ctrl='.9'/></keyframe></mujoco>"
    scene = ball().replace("</mujoco>", keys)
    verdict = mg.check(scene, start="near", derivatives=False)
    assert set(verdict.motions.poses) == {"key frame near"}
    np.testing.assert_array_equal(verdict.motions.qpos[:, 0], 0.1)
    assert verdict.motions.controls.mean() > 0.4
    assert verdict.motions.controls.max() <= 1
    assert "keyframe='near'" in verdict.code
    assert "key('near').ctrl" in program(verdict, "ball.xml", Path("ball.py"))[0]
    assert "keyframe='far'" in quick(scene).code
    with pytest.raises(ValueError, match=r"keyframe must be one of \['far', 'near'\]"):
        mg.check(scene, start="between")


@pytest.mark.parametrize(
    ("cost", "kind", "said"),
    [
        (lambda motion: motion.qpos[-1, 0] * jnp.nan, "cost_not_finite", "the cost is not finite"),
        (lambda motion: 1.0, "cost_unfelt", "the cost does not feel the motion"),
        (lambda motion: jnp.sign(motion.qvel[0, 0]), "cost", "the cost has no derivative"),
        (lambda motion: jnp.abs(motion.qvel[0, 0]) ** 0.5, "cost", "the cost has no derivative"),
    ],
)
def test_what_is_wrong_with_a_cost_is_said_first(cost, kind, said):
    """The ball begins at rest, where a sign and a root have no derivative, and another speed has another value."""
    verdict = quick(ball(), cost)
    assert kinds(verdict) == {kind}
    assert verdict.headline.endswith(f"Mind that {said}.")


def test_contact_that_never_touches_is_named():
    """It falls for half a second, 1.2 of 40 m."""
    assert "floor – ball" in fault(quick(ball(height=40, gear=0.1)), "no_contact")


def test_motions_that_leave_all_numbers_are_named():
    """A spring of 1e7 N/m on 0.2 kg, integrated explicitly: h²k/m = 200, beyond 4."""
    unstable = ball().replace('motor name="push" joint="z" gear="1"', 'position name="push" joint="z" kp="1e7"')
    assert "not_finite" in kinds(quick(unstable))


def test_a_start_that_is_none_is_named():
    key = ball().replace("</mujoco>", '<keyframe><key name="home" qpos="nan"/></keyframe></mujoco>')
    for one in (key, key.replace("qpos", "qvel")):
        found = quick(one, cost=lambda motion: motion.qpos[-1, 9] ** 2)
        assert fault(found, "not_finite") == "Key frame home must hold numbers, got NaN."
        assert "index 9 is out of bounds" in fault(found, "index")  # by a motion that has numbers
    assert "ball in floor begins 250 mm deep" in fault(quick(ball(height=-0.2)), "start")


def test_an_index_beyond_an_array_is_named():
    """JAX takes the last number in silence."""
    assert "index 9 is out of bounds" in fault(quick(ball(), cost=lambda motion: motion.qpos[-1, 9] ** 2), "index")
    assert "index" not in kinds(quick(ball(), cost=lambda motion: motion.qpos.at[-1, 0].get() ** 2))


def test_the_first_touch_is_that_of_free_fall():
    """From 0.25 m above the floor, √(2 d / g) and √(2 g d); a push of 1 N on 0.2 kg changes g by half at most."""
    (touch,) = quick(ball(gear=1e-3)).motions.touches
    np.testing.assert_allclose(touch.time, np.sqrt(2 * 0.25 / 9.81), atol=0.004)
    np.testing.assert_allclose(touch.speed, np.sqrt(2 * 9.81 * 0.25), rtol=0.02)


def test_a_step_by_mjx_is_compared_with_c_mujocos_where_that_is_asked():
    """A ball meets a floor by one formula; a mesh meets a box by rules of MJX's own, so that C MuJoCo steps it."""
    alike = mg.check(ball(), derivatives=False, mjx=True)
    assert "A step by MJX is C MuJoCo's to " in alike.summary()
    assert "engines" not in kinds(alike)
    other = mg.check(
        """<mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>
        <geom type="box" size=".2 .2 .1"/><body pos=".15 .15 .1" euler="0 90 45">
        <freejoint name="root"/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>""",
        derivatives=False,
        mjx=True,
    )
    assert "worst at root (the reference pose" in fault(other, "engines")
    assert "Mind that MJX moves it otherwise." in other.headline
    assert "MJX has no contacts of meshes and height fields like C MuJoCo's" in other.summary().replace("\n  ", " ")
    lacking = mg.check(ball().replace("<option", "<option noslip_iterations='1'"), derivatives=False, mjx=True)
    assert "cannot be stepped by MJX: MJX has no noslip solver" in lacking.summary().replace("\n  ", " ")


def test_pairs_are_counted_as_they_are_listed():
    """By contype and conaffinity; geoms of one body never touch."""
    geoms = "<geom size='.1'/><geom size='.1' contype='2' conaffinity='4'/>"
    bodies = "".join(f"<body pos='{i} 0 0'><freejoint/>{geoms}</body>" for i in range(4))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><geom size='.1'/>{bodies}</worldbody></mujoco>")
    assert count_pairs(model) == len(contact_pairs(model)) == 10


def test_what_a_budget_leaves_no_time_for_is_named():
    """Nothing is begun after a thousandth of a second but a line by eight motions, so that there is a verdict."""
    verdict = mg.check(ball(), budget=1e-3)
    assert re.search("% off by [1-9][0-9]* readings; ", verdict.headline)
    assert verdict.recommendation.estimator == "alpha_order"  # is never wrong
    assert "readings by 8 motions each" in verdict.summary().replace("\n  ", " ")
    (told,) = [one.text for one in verdict.findings if one.kind == "left_out"]
    assert "budget of 0.001 s: noise of 0.1; a line along the controls;" in told
    assert len(verdict.headline.split()) <= 25


def test_as_many_steps_are_measured_as_were_asked_for_however_slow():
    """Of 250 that the motions have, in a thousandth of a second, by as few motions as there are for fewer steps."""
    verdict = mg.check(ball(), horizon=130, budget=1e-3)
    assert verdict.measured.times[-1] == pytest.approx(130 * 0.002)
    assert "readings by 8 motions each" in verdict.summary().replace("\n  ", " ")
    assert verdict.recommendation.horizon == 130
    assert "horizon=130" in program(verdict, "scene.xml", Path("task.py"))[0]
    assert mg.check(ball(), horizon=7, derivatives=False).recommendation.horizon == 7
    for horizon, said in ((3, "at least 4"), (251, "at most 250, the time steps of the random motions")):
        with pytest.raises(ValueError, match=f"horizon must be {said}"):
            mg.check(ball(), horizon=horizon)


def test_a_body_that_is_touched_later_than_was_measured_is_named_unless_a_cost_tells_what_counts():
    """One falls a centimetre, within 23 steps, and the other 1 m in 0.45 s, 226 steps, where 40 are measured."""
    two = """<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/>
      <body name="near" pos="0 0 .06"><joint type="slide" axis="0 0 1"/><geom size=".05" mass=".1"/></body>
      <body name="late" pos="1 0 1.05"><joint type="slide" axis="0 0 1"/><geom size=".05" mass="3"/></body>
      </worldbody></mujoco>"""
    verdict = mg.check(two, budget=1e-3)
    told = fault(verdict, "untouched")
    assert "late is not touched within the 0.08 s that were measured, but after 0.45 s: give --horizon 250" in told
    assert "Mind that late is not touched." in verdict.headline
    assert "untouched" not in kinds(mg.check(two, horizon=250, budget=1e-3))
    assert "untouched" not in kinds(mg.check(two, lambda motion: motion.qpos[-1, 0], budget=1e-3))
    far = mg.check(two.replace("0 1.05", "0 40"), budget=1e-3)
    assert "late can be touched, but no random motion does so within 0.5 s" in far.summary().replace("\n  ", " ")
    assert "untouched" not in kinds(far)


@pytest.fixture
def measuring():
    """From a mover to what is measured of a ball's motions, and to the advice that follows from what was measured."""
    scene, rng = mg.load_scene(ball()), np.random.default_rng(0)
    motions, stability = random_motions(scene, rng), mg.check_stability(scene, speed=1.0)

    def measured_by(mover, log=lambda _: None):
        return measure(scene, motions, mover, rng, from_start=False, seconds=1, log=log)

    return measured_by, lambda measured, price=np.inf: recommend(motions, stability, measured, None, price)


class OutOfTime(Mover):
    """Motions that take no time, as many as the number of steps, a line and noise need, and for ever the others."""

    def __init__(self, num_moves=2 + 7 + 1):
        self.size, self.end = 32, time.perf_counter() + 1000
        self._left = num_moves

    def seconds(self, kind, num_steps):
        """Return hardly anything."""
        return 1e-9

    def move(self, kind, states, controls, direction, lengths, contact=None):
        """Return the velocity at the start as the outcome of all times."""
        self._left -= 1
        if self._left < 0:
            raise TimeoutError
        outcomes = np.repeat(states.qvel[:, None, :1], len(lengths), axis=1)
        derivatives = np.full_like(outcomes, direction.velocities[0])
        return Moved(outcomes, derivatives, np.ones(outcomes.shape[:2]), 0)


def test_questions_that_there_is_no_time_for_are_left_out_by_name(measuring):
    measured_by, advise = measuring
    measured = measured_by(OutOfTime(), (told := []).append)
    assert told[1].startswith(
        "1 of 7: a line along the start; slope 0.0% off; discrete 0.0% off"
    )  # before all else is measured
    assert (len(measured.lines), len(measured.noises), len(measured.left_out)) == (1, 1, 5)
    (told,) = left_out_findings(measured, 60)
    for words in ("budget of 60 s", "a line along the controls", "noise of 0.3", "contacts at"):
        assert words in told.text
    assert advise(measured).gradient == "discrete"  # both are the slope
    _, derivatives = telling(measured, ("speed",)).drawings
    assert derivatives.count('style="fill: #d55e00') == 33  # a dot for each motion, and a legend


class Rounding(OutOfTime):
    """Two outcomes: the velocity at the start, and one that rounding alone changes, by steps."""

    def __init__(self, diverges):
        super().__init__(1000)
        self._diverges = diverges

    def move(self, kind, states, controls, direction, lengths, contact=None):
        felt = super().move(kind, states, controls, direction, lengths, contact)
        rounding = 1e-17 * np.sign(felt.outcomes)
        outcomes, derivatives = (
            np.concatenate(pair, axis=2)
            for pair in ((felt.outcomes, rounding), (felt.derivatives, 0 * felt.derivatives))
        )
        if self._diverges and len(lengths) > 1:
            outcomes[:, -1] = np.nan
        return Moved(outcomes, derivatives, felt.growth, 0)


@pytest.mark.filterwarnings("ignore:Degrees of freedom:RuntimeWarning", "ignore:Mean of empty slice:RuntimeWarning")
@pytest.mark.parametrize("diverges", [False, True])
def test_rounding_is_no_jump_and_no_slope(measuring, diverges):
    """One of two outcomes; along the controls neither is felt. Where all motions end in no number, what came before counts."""
    measured = measuring[0](Rounding(diverges))
    assert [len(line.jumps.places) for line in measured.lines] == [0, 0, 0]
    num_moving = sum(line.varied != "the controls" for line in measured.lines)
    readings = {slope.errors.size for slope in slopes(measured.lines)}
    assert readings == {num_moving * (len(measured.times) - diverges)}


@pytest.mark.parametrize(("height", "expected"), [(0.009, 4), (0.011, 1)])
def test_contacts_nearer_than_a_centimetre_are_counted(height, expected):
    box = mg.load_scene(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1"><freejoint/>
        <geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    )
    assert most_contacts(box, np.array([[[0, 0, 0.1 + height, 1, 0, 0, 0]]])) == expected


def test_a_body_that_is_put_down_touches_from_the_start():
    """Its distance is zero at first, and negative from the first step on."""
    resting, falling = (random_motions(mg.load_scene(ball(height=z)), np.random.default_rng(0)) for z in (0.05, 0.3))
    assert (resting.touching, resting.touches) == (("floor – ball",), ())
    assert (resting.onsets < 0).all()
    assert falling.touching == ()
    assert [touch.pair for touch in falling.touches] == ["floor – ball"]


class Endless(OutOfTime):
    """Motions that begin in good time, and then meet states that take for ever."""

    def move(self, kind, states, controls, direction, lengths, contact=None):
        if len(lengths) > 1:
            raise TimeoutError
        return super().move(kind, states, controls, direction, lengths, contact)


def test_what_outlasts_the_budget_is_given_up_and_named(measuring):
    measured_by, advise = measuring
    measured = measured_by(Endless())
    assert (measured.lines, measured.noises, len(measured.left_out)) == ((), (), 7)
    assert {finding.kind for finding in measured_findings(measured)} <= {"slope", "order", "note"}
    assert advise(measured).estimator == "alpha_order"


def _moved(kind):
    """Return a ball's bounces from three speeds, pushed along a line."""
    scene = mg.load_scene(ball(height=0.06))
    mover = Mover(scene, 3, lambda t: jnp.stack([t.qpos[-1, 0], t.qvel[-1, 0]]))
    states = jax.tree.map(lambda leaf: np.repeat(np.array(leaf)[None], 3, axis=0), mg.initial_state(scene))
    states.qvel[:] = [[-1.0], [-2.0], [0.5]]
    direction = Direction(np.array([0.3]), np.array([1.0]), 0.1 * np.ones((20, 1)))
    return mover.move(kind, states, np.zeros((3, 20, 1)), direction, (5, 20))


def test_an_interruption_keeps_what_was_measured(monkeypatch):
    """The line before it; noise and the other lines are named."""

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("mjxgrad.checking.measure._Probe.noise", interrupted)
    own, order = measure, []
    module = importlib.import_module("mjxgrad.checking.check")
    monkeypatch.setattr(module, "seconds_of", lambda *given: order.append("prices") or seconds_of(*given))
    monkeypatch.setattr(module, "measure", lambda *given, **how: order.append("derivatives") or own(*given, **how))
    measured = mg.check(ball(), budget=1000).measured
    assert order == ["prices", "derivatives"], "or Ctrl-C would wait for prices"
    assert len(measured.lines) == 1
    assert len(measured.left_out) > 3


@pytest.mark.parametrize("part", ["random_motions", "seconds_of", "measure", "most_contacts"])
def test_an_interruption_of_any_part_keeps_what_is_known(monkeypatch, part):
    """What waits for C++ does so in another thread, since Python calls no handler of signals meanwhile."""
    module, told, places = importlib.import_module("mjxgrad.checking.check"), [], []
    own = getattr(module, part)

    def interrupted(*given, **how):
        places.append(threading.current_thread() is threading.main_thread())
        if len(places) == 1:
            raise KeyboardInterrupt
        return own(*given, **how)

    monkeypatch.setattr(module, part, interrupted)
    if part == "random_motions":
        with pytest.raises(KeyboardInterrupt):
            mg.check(ball(), log=told.append)
        assert "1 degree of freedom" in told[-1]
    else:
        verdict = mg.check(ball(), budget=2, log=told.append)
        assert "First to touch: floor – ball" in verdict.summary()
        stopped = "Derivatives were not measured: it was interrupted." in verdict.summary()
        assert stopped == (part != "most_contacts"), "after all measurements nothing is lost"
        assert ("measuring derivatives by C MuJoCo" in told) == (part != "seconds_of")
    assert places[0] == (part in ("measure", "most_contacts"))  # these wait themselves, or are Python


def test_derivatives_along_a_line_are_those_of_a_rollout():
    """Of the start by 0.3 m and 1 m/s, and of the push by 0.1 N."""
    scene = mg.load_scene(ball(height=0.06))
    still, found = mg.initial_state(scene), _moved("discrete")

    def run(place, speed):
        qpos, qvel = still.qpos + 0.3 * place, speed + place * jnp.ones(1)
        start = mg.initial_state(scene, qpos=qpos, qvel=qvel)
        course = mg.rollout(scene.with_engine("mujoco"), start, 0.1 * place * jnp.ones((20, 1)))
        return jnp.stack([course.qpos[-1, 0], course.qvel[-1, 0]])

    for speed, derivatives in zip((-1.0, -2.0, 0.5), found.derivatives, strict=True):
        np.testing.assert_allclose(derivatives[-1], jax.jacfwd(run)(0.0, speed), rtol=1e-4, atol=1e-6)


def test_a_fine_motion_is_that_of_a_shorter_time_step():
    scene = mg.load_scene(ball(height=0.06), timestep=0.002 / REFINED)
    for speed, found in zip((-1.0, -2.0, 0.5), _moved("fine").outcomes, strict=True):
        start = mg.initial_state(scene, qvel=np.array([speed]))
        course = mg.rollout(scene.with_engine("mujoco"), start, horizon=20 * REFINED)
        np.testing.assert_allclose(found[-1], [course.qpos[-1, 0], course.qvel[-1, 0]], rtol=1e-6)


def test_numbers_that_c_mujoco_alone_has_move_its_motions():
    """A ball falls through honey: by the rollout of the same scene, and otherwise than through nothing."""
    scene = mg.load_scene(ball(height=0.6)).with_engine("mujoco")
    start, controls = start_of(jax.tree.map(lambda x: x[None], mg.initial_state(scene))), np.zeros((1, 50, 1))
    thick = scene.with_model(viscosity=2.0)
    free, found = (run(one, start, controls)["qvel"][0] for one in (scene, thick))
    np.testing.assert_allclose(found, mg.rollout(thick, mg.initial_state(thick), controls[0]).qvel, rtol=1e-12)
    assert free[-1, 0] < 1.1 * found[-1, 0] < 0


def test_hit_or_miss_is_named_with_its_pair(wall):
    assert "ball – wall touches on one side" in fault(wall, "jump")
    assert wall.recommendation.estimator == "alpha_order"


def test_a_bounce_has_its_slope_and_not_by_mujocos_own_derivative(bounce):
    """Contact begins with a jump, at an impedance of 0.9, which MuJoCo's derivative does not see."""
    slope, discrete = slopes(bounce.measured.lines)
    assert discrete.error > 2 * slope.error  # by as many motions as there was time for, which scatter
    assert bounce.recommendation.gradient == "slope"
    assert bounce.recommendation.estimator == "first_order"
    assert "jump" not in kinds(bounce)


def test_the_page_begins_with_the_answer_and_a_picture_and_needs_nothing_beside_it(wall):
    text = wall.as_html()
    assert text.index("<h1>") < text.index("<svg") < text.index("<ul>")
    assert len(wall.headline.split()) <= 25
    assert "http" not in text


def line_of(slope, discrete, growth=1.0, fine=1.0):
    """Outcomes that rise by 1 along a line at two times, by `fine` at a shorter step, and derivatives said to be theirs."""
    places = phases((-1.0, 1.0), 64)
    outcomes = np.repeat(places[:, None], 2, axis=1)[:, :, None]
    filled = [np.broadcast_to(np.reshape(one, (-1, 1, 1)), outcomes.shape) for one in (slope, discrete)]
    plain, shorter = (compare_to_slope(places, rise * outcomes, filled, KINDS) for rise in (1.0, fine))
    none = Jumps(*[np.zeros(0)] * 3)
    line = Line("the reference pose", "the start", plain, shorter, none, (), growth * np.ones(2), 0)
    return Measured(np.array([0.05, 0.1]), (line,), ())


def test_a_derivative_that_is_off_or_scatters_has_that_error():
    """The slope is 1; half of it is off by a half, and 1 ± 30 from 64 motions by about 4, which counts as all of it."""
    scattered = 1 + 30 * (-1.0) ** np.arange(64) * np.sqrt(np.arange(64) % 7)
    np.testing.assert_allclose([one.error for one in slopes(line_of(1.0, 0.5).lines)], [0, 0.5], atol=1e-12)
    assert slopes(line_of(scattered, 1.0).lines)[0].error == 1.0


def test_scatter_is_not_rewarded():
    """15 % off with wide error bars, beside 4 % off with narrow ones: by the number that are right the first would win."""
    slope, discrete = Slope("slope", np.array([0.03, 0.04, 0.04, 0.04]), 64), Slope("discrete", np.full(4, 0.15), 64)
    assert nearest((slope, discrete)) == "slope"
    assert nearest((Slope("slope", np.array([0.25, 0.05, 0.35, 0.01]), 64), discrete)) == "discrete"


def test_a_dear_slope_that_is_no_nearer_is_named_and_left():
    """Nearer by 0.005 ± 0.004: enough at twice the price, by log₂ 2 = 1 standard error, and not at 46 times."""
    errors = [("slope", 0.18), ("discrete", 0.2)]
    slope, discrete = (Slope(kind, np.array([0.2, 0.2, 0.2, error]), 64) for kind, error in errors)
    assert [nearest((slope, discrete), price) for price in (1.9, 46)] == ["slope", "discrete"]
    told = price_finding({"slope": 4.6, "discrete": 0.1}, (slope, discrete), 40).text
    assert "costs 46 times as much and is no nearer beyond doubt" in told
    assert told.startswith("A gradient of one rollout of 40 steps takes 4.6 s by ")


def test_one_reading_does_not_choose_a_dear_slope():
    """Its spread is unknown, so that a slope that is nearer there is taken for its price, as where nothing was measured."""
    slope, discrete = Slope("slope", np.array([0.3]), 64), Slope("discrete", np.array([0.7]), 64)
    assert [nearest((slope, discrete), price) for price in (3, 5)] == ["slope", "discrete"]
    assert "1 reading by 64 motions each" in (told := findings.slope_finding((slope, discrete)).text)
    assert "too few to choose by" in told


@pytest.mark.parametrize(
    ("count", "said"), [(0, "too few readings to tell"), (3, "too few readings to tell"), (4, "70 % off by 4 readings")]
)
def test_too_few_readings_give_no_percentage_and_no_fault(bounce, count, said):
    advice = dataclasses.replace(bounce.recommendation, gradient="discrete")
    found = [Slope(kind, np.full(count, 0.7), 64) for kind in KINDS]
    assert f" ahead: {said}." in headline([], advice, bounce.motions, found, {})
    assert findings.slope_finding(found).is_fault == (count == 4)


def test_the_answer_comes_first_with_its_sureness_and_its_price(bounce):
    found, fault = slopes(bounce.measured.lines), findings.Finding("jump", "", True)
    told = headline([fault], bounce.recommendation, bounce.motions, found, {"slope": 0.084, "discrete": 0.1})
    assert re.fullmatch(
        r"Take contact=mg.Slope\(\) and first_order, .* s ahead: .* % off by \d+ readings; 0.084 s a gradient of one rollout. "
        "Mind that the outcome jumps.",
        told,
    )
    assert len(told.split()) <= 25


def test_a_few_motions_tell_a_slope_as_all_do(measuring):
    """Of a sine with noise, whose slope is steep and curved, derivatives at eight of 64 places."""
    places, rng = phases((-1.0, 1.0), 64), np.random.default_rng(0)
    exact = 3 * np.cos(3 * places)
    some = np.where(np.arange(64) % 8 == 0, exact, np.nan)
    found = compare_to_slope(places, np.sin(3 * places) + 1e-3 * rng.normal(size=64), [some, exact], ["few", "all"])
    np.testing.assert_allclose(found.mean[0], found.mean[1], rtol=0.01)
    assert abs(found.error[0]) < 4 * found.standard_error[0] < 0.05


@pytest.mark.parametrize(
    ("slope", "discrete", "expected"),
    [
        (1.0, 1.0, "discrete"),
        (1.0, 0.5, "slope"),
        (0.5, 0.5, "discrete"),
        (1 + 3000 * (np.arange(64) % 10 == 0), 1.0, "discrete"),
    ],
)
def test_what_is_recommended_is_what_was_measured(measuring, slope, discrete, expected):
    """MuJoCo's own derivative where it is as near, else the slope, but not where its mean is that of a few."""
    assert measuring[1](line_of(slope, discrete)).gradient == expected


def test_a_slope_of_the_time_step_alone_is_named():
    (found,) = [one.text for one in measured_findings(line_of(1.0, 1.0, fine=0.5)) if "shorter" in one.text]
    assert "At 2 of 2 readings the slope is another at a time step 4 times shorter" in found
    assert not [one for one in measured_findings(line_of(1.0, 1.0)) if "shorter" in one.text]


def test_errors_cross_where_those_of_zeroth_order_become_smaller_for_good():
    """e^(t − 6.5) and 1 cross at 6.5; a draw before does not count."""
    times, signs = np.linspace(1.0, 10.0, 10), np.array([1.0, -1.0])[:, None, None]

    def cross(*squares):
        return crossover(times, *(signs * np.sqrt(square * np.ones((10, 1))) for square in squares))

    assert cross(np.where(times == 2, 1.5, np.exp(times - 6.5))[:, None], 1) == pytest.approx(6.5)
    assert cross(1, 2) == np.inf
    assert cross(2, 1) == 1.0


def test_an_exploding_derivative_is_named():
    assert not [one for one in measured_findings(line_of(1.0, 1.0, growth=900.0)) if one.kind == "explodes"]
    (found,) = [one for one in measured_findings(line_of(1.0, 1.0, growth=1100.0)) if one.kind == "explodes"]
    assert found.is_fault
    assert "within 0.05 s" in found.text


def test_both_estimates_of_a_linear_cost_are_its_slope(key):
    """Of f = 3 w: first order exactly, zeroth order within three of its own errors."""
    noise = np.asarray(0.1 * jax.random.normal(key, (400, 1, 1)))
    first, zeroth = estimates(3 * noise, np.full_like(noise, 3.0), noise / 0.1**2)
    np.testing.assert_allclose(first, 3.0, rtol=1e-12)
    assert abs(zeroth.mean() - 3) < 3 * zeroth.std() / np.sqrt(400)


def test_the_code_of_a_verdict_runs(bounce, tmp_path):
    names = {}
    (tmp_path / "scene.xml").write_text(ball())
    code = bounce.code.replace("'scene.xml'", repr(str(tmp_path / "scene.xml")))
    exec(compile(code, "verdict", "exec"), names)
    assert np.isfinite(names["estimate"].value).all()


def test_the_code_has_a_cost_by_its_name(tmp_path):
    """Minus the height of the ball in the end, which began at 0.3 m and fell for five steps."""
    path = tmp_path / "scene.xml"
    path.write_text(ball())
    names = {}
    code = mg.check(path, "height:ball", derivatives=False).code
    exec(compile(code.partition("objective =")[0], "verdict", "exec"), names)
    ended = mg.rollout(names["scene"], names["start"], jnp.zeros((5, 1)))
    np.testing.assert_allclose(names["cost"](ended), -0.3 - ended.qpos[-1, 0], rtol=1e-12)


@pytest.mark.parametrize(("price", "gradient"), [(3.0, "slope"), (10.0, "discrete"), (np.inf, "slope")])
def test_a_slope_that_was_not_measured_is_taken_where_it_is_cheap(measuring, price, gradient):
    """Or where its price is not known, as in scenes without actuators."""
    _, advise = measuring
    assert advise(None, price).gradient == gradient


@pytest.mark.parametrize("progress", [True, False])
def test_a_long_check_tells_what_it_does_from_its_third_second_on_and_every_ten(monkeypatch, capfd, progress):
    """By a clock of its own: after 3 s something is told, 2 s later nothing, and after 10 more something again."""
    now = iter([0.0, 3.0, 3.0, 5.0, 15.0, 15.0, *[15.0] * 20])
    monkeypatch.setattr(_text, "time", types.SimpleNamespace(monotonic=lambda: next(now)))
    mg.check(ball(gear=0, height=0.05), derivatives=False, progress=progress)
    told = capfd.readouterr().err.splitlines()
    assert len(told) == 2 * progress
    assert all(one.startswith("check: ") and one.endswith("; Ctrl-C keeps what was found") for one in told)
    assert not any(".;" in one for one in told)


def test_a_program_of_slow_steps_has_fewer_samples_and_foretells_its_time(bounce):
    """30 steps of 16 samples of 250 time steps are 120 000: at 0.1 ms 12 s; at 10 ms four samples take 300 s."""
    advice = dataclasses.replace(bounce.recommendation, gradient="discrete", timestep=None)
    assert bounce.motions.timestep == 0.002
    for each, num_samples, wanted in [(1e-4, 16, 12.0), (1e-3, 12, 90.0), (1e-2, 4, 300.0)]:
        verdict = dataclasses.replace(bounce, recommendation=advice, seconds={"discrete": each})
        text, seconds = program(verdict, "scene.xml", Path("task.py"))
        assert f"num_samples={num_samples})" in text
        np.testing.assert_allclose(seconds, wanted)


SEVEN = ("hopper", "half_cheetah", "walker2d", "ant", "humanoid", "swimmer", "inverted_double_pendulum")


@pytest.mark.slow
@pytest.mark.parametrize("name", SEVEN)
def test_gymnasiums_scenes_get_a_verdict_without_a_false_alarm(name):
    """All seven are in use: none has an idle actuator, a step too long or a motion that ends in NaN."""
    verdict = mg.check(ASSETS / f"{name}.xml")
    assert not kinds(verdict) & {"no_effect", "not_finite", "time_step", "no_contact"}
    slope, discrete = slopes(verdict.measured.lines)
    # Where nothing lands, both are the same to rounding.
    assert not slope.error > 1.01 * discrete.error


def test_warnings_of_other_libraries_are_said_once_and_none_is_empty():
    """Of each mesh whose face has more than 20 corners MJX warns, in words that differ by its name."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for name in ("one", "other"):
            warnings.warn(f"mesh {name} has coplanar faces", UserWarning, stacklevel=1)
    (finding,) = _warned(caught)
    assert "esh one has coplanar faces (1 more alike)" in finding.text


@pytest.mark.parametrize(("error", "is_fault"), [(0.3, True), (0.2, False)])
def test_derivatives_that_are_all_far_off_are_a_fault(error, is_fault):
    """Where one kind is near enough it is recommended without a word."""
    found = [Slope("slope", np.full(9, error), 64), Slope("discrete", np.full(9, 0.5), 64)]
    assert findings.slope_finding(found).is_fault == is_fault


def test_an_exact_touch_is_said_and_decided_alike_in_both_precisions():
    """A ball that stands on the floor, in single precision as in a script, and in double precision as by the command."""
    resting = ball(height=0.05)
    with jax.enable_x64(False):
        single = mg.check(mg.load_scene(resting), derivatives=False)
    double = mg.check(resting, derivatives=False)
    assert single.motions.touching == double.motions.touching == ("floor – ball",)
    assert "floor – ball touches exactly at the start" in single.summary().replace("\n  ", " ")
    assert not [one for one in quick(ball(height=0.0501)).findings if "exactly" in one.text]
