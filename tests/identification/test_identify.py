"""Parameters come back from motions that were made with them, as surely as the noise allows."""

import contextlib
import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mjxgrad as mg
from mjxgrad import identification
from mjxgrad._text import duration
from mjxgrad.identification import Parameter, Recording, Stopped, search
from mjxgrad.identification.motions import Motions
from mjxgrad.identification.recording import stack
from mjxgrad.identification.search import as_text

_STEP, _STEPS = 0.01, 40
_CART = """<mujoco><option timestep="0.01"/><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
  <geom size=".1" mass="2"/></body></worldbody><actuator><motor name="motor" joint="x" gear="3"/></actuator>
  <sensor><jointpos name="place" joint="x"/></sensor></mujoco>"""
_SLED = """<mujoco><option timestep=".004" integrator="implicitfast"/><worldbody>
  <geom type="plane" pos="0 0 -.05" size="1 1 .1"/><body><joint name="x" type="slide" axis="1 0 0" damping="8"/>{}
  <geom type="box" size=".05 .05 .05" mass=".4" {}/></body></worldbody>
  <actuator><position name="servo" joint="x" kp="400" kv="20"/></actuator></mujoco>"""
_ON_FLOOR, _ALONE = ('<joint type="slide" axis="0 0 1"/>', ""), ("", 'contype="0" conaffinity="0"')
_DRIVE = 2 * np.sin(np.arange(_STEPS) / 5)


def _course(gear=3.0, mass=2.0, x=0.0, v=0.0, drive=_DRIVE):
    """Semi-implicit Euler of a cart without damping: v changes by h·g·u/m, then x by h·v."""
    speeds = v + np.concatenate([[0], np.cumsum(_STEP * gear * drive / mass)])
    return x + np.concatenate([[0], np.cumsum(_STEP * speeds[1:])])


@pytest.fixture(scope="module")
def cart():
    return mg.load_scene(_CART)


@pytest.fixture
def few_starts(monkeypatch):
    """Of other starts an eighth is compared: a cart with one parameter has one minimum, and each start costs a model."""
    monkeypatch.setattr("mjxgrad.identification.search._SCATTERED", 64)


def _interrupted(step, _):
    if step:
        raise KeyboardInterrupt


def _noisy():
    """A course at a gear of 3.3, with ten times the noise that is stated."""
    measured = _course(gear=3.3) + 0.01 * np.random.default_rng(0).normal(size=_STEPS + 1)
    return Recording({"place": measured}, _DRIVE[:, None], noise={"place": 0.001})


def test_an_interrupted_search_returns_the_best_values_so_far(cart):
    """After its first step, which is the nominal value; a second Ctrl-C is not needed."""
    gear = {"gear": identification.gear(cart, "motor")}
    result = mg.identify(cart, gear, [_noisy()], held_out=[_noisy()], log=_interrupted)
    assert result.stopped is Stopped.INTERRUPTED
    assert result.num_steps == 1
    assert np.isfinite(result.half_width["gear"])
    assert result.headline.startswith("Interrupted, best so far: error")
    assert "± by noise alone" in result.summary()
    assert "had not converged, so values may be off by many times what noise alone leaves" in result.warnings()[0]


def test_over_a_part_of_a_recording_the_motion_at_its_last_state_is_compared_with_that_state(cart):
    """The course's own residuals are zero over any number of steps."""
    window = stack(cart, [Recording({"place": _course()}, _DRIVE[:, None])])
    motions = Motions(cart, {"none": Parameter(1.0)}, delay=None, contact=None)
    for steps in (1, 5, _STEPS):
        left = motions.residuals(window, np.ones((1, 1)), np.zeros((1, 1, 2)), steps)
        np.testing.assert_allclose(left, 0.0, atol=1e-6)


def test_a_search_that_is_cut_short_keeps_the_best_of_the_whole_and_claims_nothing_of_the_rest(cart):
    """Places go with the gear, so that the first eighth of the course tells it but for damping of a step by 1/101.

    Where that eighth is of another gear, its values are not kept.
    """
    recording = Recording({"place": _course(gear=3.3)}, _DRIVE[:, None], noise={"place": 0.001})
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [recording], max_steps=2)
    assert result.stopped is Stopped.STEPS
    np.testing.assert_allclose(result.values["gear"], 3.3, rtol=0.01)
    assert result.rms[1] < 0.1 * result.rms[0]
    assert np.isfinite(result.half_width["gear"])
    assert "stopped when it had used the first 12 % of the recordings" in result.summary()
    assert "Without effect" not in result.summary()
    bent = _course(gear=3.3)
    bent[:6] = _course(gear=9.0)[:6]
    recording = Recording({"place": bent}, _DRIVE[:, None], noise={"place": 0.001})
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [recording], max_steps=2)
    np.testing.assert_allclose(result.values["gear"], 3.0)
    assert result.rms[1] == result.rms[0]


def test_a_search_says_what_it_does_until_it_ends_and_no_further_start_follows_one_that_ends_alike(cart):
    """A parabola has one minimum, and ten times the noise that was stated is left there."""
    told = []
    gear = {"gear": identification.gear(cart, "motor")}
    mg.identify(cart, gear, [_noisy()], log=lambda step, metrics: told.append(metrics))
    assert all(one["seconds"] > 0 for one in told)
    assert all(one["most"] >= one["seconds"] for one in told)
    assert {(one["start"], one["starts"]) for one in told} == {(0, 1), (0, 512), (1, 1)}
    least, most = identification.outlook(cart, gear, [_noisy()]).more
    assert 0 < least < most


def test_what_a_recording_is_perhaps_not_is_told():
    """On a hinge from -1 to 1 rad, 57.3 times its angle fits as degrees. One start is 200 times the noise off, one blows up."""
    scene = mg.load_scene("""<mujoco><worldbody><body><joint name="hip" axis="0 1 0" range="-57 57"/><geom size=".1"/></body>
        </worldbody></mujoco>""")
    turn = 0.2 + 0.3 * np.sin(np.arange(20) / 5)
    damping = {"damping": identification.damping(scene, "hip", bounds=(0.0, 1.0))}
    for factor, start, said in (
        (1.0, mg.initial_state(scene), "the first place of hip is 200 times its noise beside the exact start"),
        (57.3, None, "hip goes to 28.6 rad, beyond its range from -0.995 to 0.995 rad: is it in degrees?"),
        (1.0, None, None),
    ):
        one = Recording({"qpos": factor * turn}, times=0.002 * np.arange(20), noise={"qpos": 0.001}, start=start)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            identification.outlook(scene, damping, [one])
        texts = [str(one.message) for one in told if "undamped" not in str(one.message)]
        assert len(texts) == (said is not None)
        assert all(said in text for text in texts)
    with pytest.warns(UserWarning, match="something moves at 5e\\+05 m/s or rad/s: has a simulation blown up"):
        identification.outlook(scene, damping, [Recording({"qpos": turn, "qvel": 1e6 * turn}, times=one.times)])


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(
    ("error", "stopped"), [(KeyboardInterrupt, Stopped.INTERRUPTED), (mg.DivergedError, Stopped.STALLED)]
)
def test_an_ensemble_that_fails_keeps_the_values_found_before(cart, monkeypatch, error, stopped):
    """Interrupted, or since most motions diverge."""

    def fails(*_):
        raise error

    monkeypatch.setattr("mjxgrad.identification.search._Search.is_rugged", lambda *_: True)
    monkeypatch.setattr("mjxgrad.identification.search.fit", fails)
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [_noisy()])
    assert result.stopped is stopped
    assert not result.is_sound
    np.testing.assert_allclose(result.values["gear"], 3.3, atol=0.1)


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize("knows_noise", [True, False])
def test_values_that_explain_nothing_are_not_called_found(cart, knows_noise):
    """A recording of noise alone: no gear makes it, whether its size is stated or not."""
    noise = Recording(
        {"place": np.random.default_rng(0).normal(size=_STEPS + 1)},
        _DRIVE[:, None],
        noise={"place": 0.1},
        knows_noise=knows_noise,
    )
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [noise])
    assert not result.is_sound
    assert result.headline.startswith(
        f"Not found, for {'more than noise' if knows_noise else 'most of the first error'} is left"
    )
    assert " before; " in result.headline
    assert ("times the noise" in result.headline) == knows_noise


@pytest.mark.usefixtures("few_starts")
def test_a_scene_that_is_already_right_is_called_found_though_nothing_got_better(cart):
    """What is left is noise of 0.5 % of the motion, which the recording does not state."""
    course = _course()
    measured = course + 0.005 * course.std() * np.random.default_rng(0).normal(size=len(course))
    made = Recording({"place": measured}, _DRIVE[:, None], noise={"place": course.std()})
    made = dataclasses.replace(made, knows_noise=False)
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [made], held_out=[made])
    assert result.rms[1] > 0.8 * result.rms[0]
    assert result.is_sound
    assert result.headline.startswith("Found to ")


def test_one_parameter_and_its_interval_are_those_of_the_regression(cart):
    """The place is the gear times a known course, here between the steps and with noise: a regression through the origin."""
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, 0.4, 25))
    course = np.interp(times, _STEP * np.arange(_STEPS + 1), _course(gear=1.0))
    measured = 3.3 * course + 0.01 * rng.normal(size=25)
    recording = Recording({"place": measured}, _DRIVE[:, None], times, noise={"place": 0.02})
    held_out = Recording(
        {"qvel": np.full(3, np.nan), "place": 3.3 * course[:3] + 0.06},
        _DRIVE[:, None],
        times[:3],
        noise={"place": 0.02},
    )
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [recording], held_out=[held_out])
    expected = course @ measured / (course @ course)
    spread = np.sqrt(((measured - expected * course) ** 2).sum() / 24 / (course @ course))
    assert result.stopped is Stopped.CONVERGED
    np.testing.assert_allclose(result.values["gear"], expected, atol=1e-3 * spread)  # where the search ends
    np.testing.assert_allclose(
        result.half_width["gear"], 2.063899 * spread, rtol=1e-5
    )  # Student's 97.5 % at 24 degrees
    np.testing.assert_allclose(result.rms[1], np.sqrt(((measured - expected * course) ** 2).mean()) / 0.02, rtol=1e-6)
    left = (expected * course[:3] - 3.3 * course[:3] - 0.06) / 0.02
    np.testing.assert_allclose(result.held_out_rms[1], np.sqrt((left**2).mean()), rtol=1e-3)
    assert result.num_motions == 1  # the sum of squares is a parabola
    assert "gear" in result.summary()
    assert "motions is fitted" not in result.summary()
    bounded = mg.identify(cart, {"gear": identification.gear(cart, "motor", bounds=(1.0, 3.1))}, [recording])
    np.testing.assert_allclose(bounded.values["gear"], 3.1)
    assert bounded.at_bounds == ("gear",)
    assert bounded.stopped is Stopped.CONVERGED


def test_what_is_saved_mujoco_sysid_loads(cart, tmp_path):
    sysid = pytest.importorskip("mujoco.sysid")
    if not hasattr(sysid, "ParameterDict"):
        pytest.skip("mujoco[sysid] is not installed")
    parameters = {"gear": identification.gear(cart, "motor", bounds=(1.0, 5.0))}
    result = mg.identify(cart, parameters, [Recording({"place": _course(gear=3.3)}, _DRIVE[:, None])])
    result.save(tmp_path / "found.yaml")
    loaded = sysid.ParameterDict.load_from_disk(tmp_path / "found.yaml")
    np.testing.assert_array_equal(loaded["gear"].value, result.values["gear"])
    np.testing.assert_array_equal([loaded["gear"].min_value, loaded["gear"].max_value], [[1.0], [5.0]])


def test_a_search_comes_back_from_a_bound_that_a_step_went_beyond(cart):
    """Motion goes with 1/m: from 4 kg the first step for 2 kg leads to 0, that is to the bound at 1.9 kg."""
    mass = Parameter(4.0, 1.9, 5.0, identification.mass(cart, "cart").write)
    result = mg.identify(cart, {"mass": mass}, [Recording({"place": _course()}, _DRIVE[:, None])])
    np.testing.assert_allclose(result.values["mass"], 2.0, rtol=1e-6)
    assert result.at_bounds == ()


def test_mass_and_gear_cannot_be_told_apart(cart):
    """The motion shows their ratio alone."""
    parameters = {
        "mass": identification.mass(cart, "cart", bounds=(0.5, 5.0)),
        "gear": Parameter(2.0, 0.5, 8.0, identification.gear(cart, "motor").write),
        "idle": Parameter(1.0, 0.0, 2.0),
    }
    parameters["mass"] = Parameter(3.5, 0.5, 5.0, parameters["mass"].write, "kg")
    alone = Recording({"place": _course()}, _DRIVE[:, None])
    result = mg.identify(cart, parameters, [alone])
    np.testing.assert_allclose(result.values["gear"] / result.values["mass"], 1.5, rtol=1e-6)
    (combination,) = result.inseparable
    assert combination == pytest.approx({"mass": 0.01, "gear": 0.01})
    assert result.without_effect == ("idle",)
    assert np.isinf([result.half_width[name] for name in parameters]).all()
    assert "Cannot be told apart: mass, gear. +1 % of mass with +1 % of gear" in result.summary()


def test_starts_and_a_delay_are_found_with_the_parameter(cart):
    """Controls 13 ms late, linear between their times; two recordings that begin elsewhere than they say."""
    at = _STEP * np.arange(_STEPS)
    drives = [_DRIVE, 1.5 * np.cos(np.arange(_STEPS) / 3)]
    starts = [(0.02, -0.3), (-0.05, 0.1)]
    recordings = [
        Recording({"place": _course(3.6, 2.0, x, v, np.interp(at - 0.013, at, drive))}, drive[:, None])
        for drive, (x, v) in zip(drives, starts, strict=True)
    ]
    parameters = {"gear": identification.gear(cart, "motor"), "delay": Parameter(0.005, 0.0, 0.03)}
    result = mg.identify(cart, parameters, recordings, delay="delay", free_start=True)
    np.testing.assert_allclose(result.values["gear"], 3.6, rtol=1e-6)
    np.testing.assert_allclose(result.values["delay"], 0.013, rtol=1e-5)
    np.testing.assert_allclose(result.offsets, starts, atol=1e-6)


def test_through_a_bounce_an_onset_gives_the_exact_height_and_the_own_motion_one_within_its_interval():
    """The height of a drop from the simulation's own course after the impact.

    The place then falls where the height grows. Without an onset it is a sawtooth, each tooth of which rises.
    """
    scene = mg.load_scene("""<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="5 5 .1"/>
        <body><joint type="slide" axis="0 0 1"/><geom size=".05" mass=".2"/><site name="tip"/></body></worldbody>
        <sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>""")
    times = 0.005 * np.arange(61)
    late = times > 0.2

    def raised(model, height):
        return {"body_pos": model.body_pos.at[1, 2].set(height)}

    found = {}
    for name, contact in (("onset", mg.Onset()), ("discrete", mg.Discrete())):
        start = mg.initial_state(scene, qvel=jnp.array([-1.0]))
        there = scene.with_model(**raised(scene.model, 0.25))
        course = mg.rollout(there, start, horizon=60, contact=contact).qpos + 0.25
        noise = 0.0 if name == "onset" else 1e-5
        measured = np.column_stack([np.zeros((61, 2)), course]) + noise * np.random.default_rng(0).normal(size=(61, 3))
        stated = {"tip": noise} if noise else {}
        recording = Recording({"tip": measured[late]}, times=times[late], start=start, noise=stated)
        found[name] = mg.identify(scene, {"height": Parameter(0.3, 0.1, 0.5, raised)}, [recording], contact=contact)
    assert found["onset"].stopped is Stopped.CONVERGED
    np.testing.assert_allclose(found["onset"].values["height"], 0.25, atol=1e-6)
    assert abs(found["discrete"].values["height"] - 0.25) < found["discrete"].half_width["height"] < 0.05
    assert found["onset"].num_motions == 1 < found["discrete"].num_motions
    assert "motions is fitted" in found["discrete"].summary()


def test_windows_begin_where_the_recording_was_and_turns_are_compared_by_their_angle():
    """A tumbling body: no residual in any window of its own motion; where a turn by 0.02 rad is measured, that turn."""
    scene = mg.load_scene("""<mujoco><option timestep="0.01"/><worldbody>
        <body><freejoint/><geom type="box" size=".1 .2 .3"/></body><body pos="1 0 0"><joint name="x" type="slide" axis="1 0 0"/>
        <geom size=".1"/></body></worldbody><actuator><motor joint="x"/></actuator></mujoco>""")
    controls = np.cos(np.arange(30) / 4)[:, None]
    start = mg.initial_state(scene, qvel=jnp.array([1.0, 0, 2, 3, -2, 1, 0.5]))
    course = jax.jit(lambda: mg.rollout(scene.with_engine("mujoco"), start, controls))()
    qpos = np.array(course.qpos)
    qpos[20:, 3:7] *= -1  # the same turn
    turned = qpos.copy()
    w, x, y, z = qpos[25, 3:7]
    # q ⊗ (1, 0.01, 0, 0): 0.02 rad about its own x.
    turned[25, 3:7] = [w - 0.01 * x, x + 0.01 * w, y + 0.01 * z, z - 0.01 * y]
    noise = {"qpos": [1, 1, 1, 0.5, 0.5, 0.5, 1]}
    whole = Recording({"qpos": turned, "qvel": course.qvel}, controls, noise=noise, start=start)
    windows = stack(scene, whole.cut(0.08, 0.01))
    assert windows.controls.shape == (3, 8, 1)
    by_mujoco, by_mjx = (
        Motions(scene, {"none": Parameter(1.0)}, delay=None, contact=contact) for contact in (None, mg.Onset())
    )
    for motions in (by_mujoco, by_mjx):
        found = motions.residuals(windows, np.ones((1, 1)), np.zeros((1, 3, 14))).reshape(3, 9, 14)[..., :7]
        assert np.abs(found).max() < 1e-7
    # The angle of a turn is taken by one function, whoever moves the body.
    found = by_mujoco.residuals(stack(scene, [whole]), np.ones((1, 1)), np.zeros((1, 1, 14))).reshape(31, 14)
    np.testing.assert_allclose(found[25, :7], [0, 0, 0, -0.04, 0, 0, 0], atol=1e-5)


@pytest.mark.usefixtures("few_starts")
def test_a_start_that_is_not_as_it_was_is_seen_in_the_residuals(cart):
    """0.1 m/s that the recording does not tell: the gear takes them up, and what is left is a curve and no noise.

    Of 41 independent numbers the correlation is within 3/√41 = 0.47 of zero; that of the cart's places is above 0.5.
    """
    noise = 0.001 * np.random.default_rng(0).normal(size=_STEPS + 1)
    recording = Recording({"place": _course(v=0.1) + noise}, _DRIVE[:, None], noise={"place": 0.001})
    parameters = {"gear": identification.gear(cart, "motor", bounds=(1.0, 9.0))}
    wrong = mg.identify(cart, parameters, [recording])
    assert abs(wrong.values["gear"] - 3.0) > wrong.half_width["gear"]
    assert wrong.correlation > 0.5
    assert "free_start=True" in " ".join(wrong.warnings())
    right = mg.identify(cart, parameters, [recording], free_start=True)
    assert abs(right.values["gear"] - 3.0) < right.half_width["gear"]
    assert abs(right.correlation) < 0.47
    assert right.warnings() == []


def test_noise_that_is_overstated_is_told(cart):
    noise = 1e-3 * np.random.default_rng(0).normal(size=_STEPS + 1)
    for stated, told in ((1e-3, False), (3e-3, True)):
        recording = Recording({"place": _course(gear=3.3) + noise}, _DRIVE[:, None], noise={"place": stated})
        result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [recording])
        assert any("larger than what is left" in warning for warning in result.warnings()) == told


@pytest.mark.usefixtures("few_starts")
def test_other_data_compile_nothing_and_what_exceeds_the_noise_is_said(cart, compilations):
    """The second cart is pulled by 0.2 N that the scene does not know: no gear explains its motion, and chi-square sees it."""
    results = []
    for pull in (0.0, 0.2, 0.2):
        before = len(compilations)
        place = _course(gear=3.3) + pull / 4 * (_STEP * np.arange(_STEPS + 1)) ** 2
        place += 1e-4 * np.random.default_rng(0).normal(size=place.shape)
        recording = Recording({"place": place}, _DRIVE[:, None], noise={"place": 1e-4})
        results.append(mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [recording]))
    assert len(compilations) == before
    assert not results[0].warnings()
    assert f"{results[2].rms[1]:.3g} times the noise" in results[2].summary()


def test_the_end_of_a_recording_is_foretold_from_the_start_that_was_found_for_its_beginning(cart):
    """The first row says 0.15 m/s, give or take 0.05, the rest that it was 0.1: the difference is 15 mm at the end."""
    place = _course(v=0.1) + 1e-3 * np.random.default_rng(0).normal(size=_STEPS + 1)
    speed, is_late = np.where(np.arange(_STEPS + 1) > 0, np.nan, 0.15), np.arange(_STEPS + 1) > 30
    parts = [{"place": np.where(one, place, np.nan), "qvel": speed} for one in (~is_late, is_late)]
    noise = {"place": 1e-3, "qvel": 0.05}
    early, late = (Recording(one, _DRIVE[:, None], noise=noise) for one in parts)
    gear = {"gear": identification.gear(cart, "motor")}
    result = mg.identify(cart, gear, [early], held_out=[late])
    np.testing.assert_allclose(result.offsets[0, 1], -0.05, atol=0.01)
    assert result.held_out_rms[1] < 3 < result.held_out_rms[0]
    other = dataclasses.replace(late, measured={**parts[1], "qvel": speed + 1e-6})
    assert mg.identify(cart, gear, [early], held_out=[other]).held_out_rms[1] > 5


def test_a_recording_of_places_alone_is_cut_into_windows_that_start_at_their_speeds(cart):
    """Speeds of the cart by its places over five rows, within their noise and what the drive changes meanwhile."""
    noise = {"qpos": 1e-4}
    windows = Recording({"qpos": _course()}, _DRIVE[:, None], noise=noise).cut(0.1, _STEP)
    speeds = np.diff(_course(), prepend=0.0) / _STEP  # of the step that led to each place
    assert len(windows) == 4
    for i, window in enumerate(windows[1:], 1):
        np.testing.assert_allclose(window.measured["qvel"][0], speeds[10 * i], atol=0.005)
        assert np.isnan(window.measured["qvel"][1:]).all()
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, windows[1:], free_start=True)
    np.testing.assert_allclose(result.values["gear"], 3.0, rtol=0.02)


def test_what_recordings_cannot_tell_is_said_before_a_search(cart):
    """The motion shows the ratio of mass and gear alone; of the gear by itself the error is that of a regression, and a price."""
    recording = Recording({"place": _course()}, _DRIVE[:, None], noise={"place": 1e-3})
    gear, mass = identification.gear(cart, "motor"), identification.mass(cart, "cart")
    both = identification.outlook(cart, {"mass": mass, "gear": gear}, [recording])
    assert "not told: mass with gear" in both.summary()
    assert both.rows()[1:] == [("mass", "not told", "gear"), ("gear", "not told", "mass")]
    alone = identification.outlook(cart, {"gear": gear}, [recording])
    error = 1e-3 / np.linalg.norm(_course(gear=1.0))
    np.testing.assert_allclose(np.sqrt(alone.told["covariance"][0, 0]), error, rtol=0.02)
    assert 0 < alone.seconds[0] == alone.seconds[1] < 5  # nothing can touch, so there are no ensembles
    assert alone.summary().startswith(f"About {duration(max(alone.seconds[0], 1))} for 1 recording of 40 steps; ")


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(("floor", "noise"), [(False, 1e-4), (False, 1e-3), (True, 1e-4)])
def test_damping_and_the_servo_s_are_one_force_and_told_as_their_sum(floor, noise):
    """Secants of the two differ by their widths, and on a floor, where contacts chatter, by jumps: neither tells them apart.

    Of the true sum, 12 + 20, values of any two are found; the stiffness of 320 is told all the same.
    """
    scene = mg.load_scene(_SLED.format(*_ON_FLOOR if floor else _ALONE), engine="mujoco")
    controls = 0.1 * np.sin(np.arange(60) / 8)[:, None]
    places = mg.rollout(
        scene.with_model(
            dof_damping=scene.model.dof_damping.at[0].set(12.0),
            actuator_gainprm=scene.model.actuator_gainprm.at[0, 0].set(320.0),
            actuator_biasprm=scene.model.actuator_biasprm.at[0, 1].set(-320.0),
        ),
        mg.initial_state(scene),
        controls,
    ).qpos
    measured = np.asarray(places) + noise * np.random.default_rng(1).normal(size=places.shape)
    recording = Recording({"qpos": measured}, controls, noise={"qpos": noise}, start=mg.initial_state(scene))
    parameters = {"damping": identification.damping(scene, "x"), "servo": identification.gains(scene, "servo")}
    before = identification.outlook(scene, parameters, [recording])
    assert before.is_rugged == floor
    assert (before.seconds[1] > 2 * before.seconds[0]) == floor  # ensembles grow to four times their size
    (combination,) = before.told["inseparable"]
    assert combination == {"damping": 0.01, "servo[1]": pytest.approx(-0.01 * 8 / 20, rel=0.1)}
    assert "not told: damping with servo[1]" in before.summary()
    assert "+1 % of damping with -0.4 % of servo[1] changes nothing" in before.summary()
    assert np.isfinite(before.told["half_width"]).tolist() == [False, True, False]
    told = []
    result = mg.identify(scene, parameters, [recording], log=lambda *one: told.append(one))
    ensembles = [as_text(*one, has_noise=True) for one in told if one[1]["motions"] > 1]
    assert all(f", ensemble {i} of at most 16, mean of " in text for i, text in enumerate(ensembles[:3], 1))
    assert (len(ensembles) > 2) == floor
    (combination,) = result.inseparable
    assert set(combination) == {"damping", "servo[1]"}
    assert "Cannot be told apart: damping, servo[1]" in result.summary()
    assert np.isinf([result.half_width["damping"], result.half_width["servo"][1]]).all()
    stiffness, damping = result.values["servo"]
    assert abs(stiffness - 320) < result.half_width["servo"][0] < 2e4 * noise
    np.testing.assert_allclose(result.values["damping"] + damping, 32.0, rtol=0.03)


@pytest.mark.usefixtures("few_starts")
def test_another_start_that_diverges_does_not_lose_what_was_found(cart, monkeypatch):
    """The first descent ends at 3.3, where ten times the stated noise is left; the next one diverges."""
    descents, descend = [], search._Search._descend

    def diverges_later(*given):
        descents.append(given)
        if len(descents) > 1:
            raise mg.DivergedError
        return descend(*given)

    monkeypatch.setattr(search._Search, "_descend", diverges_later)
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, [_noisy()])
    assert len(descents) > 1
    assert result.stopped is Stopped.CONVERGED
    np.testing.assert_allclose(result.values["gear"], 3.3, atol=0.1)


def test_exact_starts_are_no_unknowns(monkeypatch):
    """Of ten starts nine are exact, so that two numbers of a start are unknown beside the gear.

    The interval is Student's with as many degrees of freedom, and chi-square has as many.
    """
    cart = mg.load_scene(_CART, engine="mujoco")
    rng, steps, freedoms, judge = np.random.default_rng(0), 4, [], search.exceeds_noise
    monkeypatch.setattr(search, "exceeds_noise", lambda rms, freedom: freedoms.append(freedom) or judge(rms, freedom))
    places, start = _course(drive=_DRIVE[:steps]), mg.initial_state(cart)
    speeds, recordings = np.append(0.0, np.diff(places) / _STEP), []
    for i in range(10):
        measured = {"qpos": places + 1e-3 * rng.normal(size=5), "qvel": speeds + 1e-3 * rng.normal(size=5)}
        noise = dict.fromkeys(measured, 1e-3)
        recordings.append(Recording(measured, _DRIVE[:steps, None], noise=noise, start=start if i else None))
    result = mg.identify(cart, {"gear": identification.gear(cart, "motor")}, recordings)
    freedom = 10 * 2 * 5 - 1 - 2
    factor = result.half_width["gear"] / np.sqrt(result.covariance[0, 0])
    np.testing.assert_allclose(factor, scipy.stats.t.ppf(0.975, freedom), rtol=1e-5)
    assert set(freedoms) == {freedom}


def test_a_window_begins_with_the_control_of_its_own_time():
    """Controls at 10 Hz equal their time, and so do those of windows of 0.25 s, which begin between two rows."""
    at, times = np.arange(21) / 10, np.arange(201) / 100
    recording = Recording({"qpos": 0 * times}, at[:, None], times=times, control_times=at)
    windows = recording.cut(0.25, 0.01)
    assert len(windows) == 8
    for i, window in enumerate(windows):
        found = np.interp(window.times, window.control_times, window.controls[:, 0])
        np.testing.assert_allclose(found, 0.25 * i + window.times, atol=1e-12)


def test_a_gap_longer_than_a_window_has_none():
    """Half a second at 0 and at 3 s, so that the window from 2.75 s has one row, and those before it none."""
    times = np.append(np.arange(50), np.arange(300, 351)) / 100
    windows = Recording({"qpos": 0 * times}, times=times).cut(0.25, 0.01)
    assert [window.name.removeprefix("the recording from ") for window in windows] == ["0 s", "0.25 s", "3 s", "3.25 s"]
    with pytest.raises(ValueError, match=r"duration must be that of two rows of the recording at least, got 0\.25 s"):
        Recording({"qpos": [0.0, 1.0, 2.0]}, times=[0, 1, 2]).cut(0.25, 0.01)


def test_controls_reach_over_the_whole_motion_but_for_one_interval(cart):
    """Five rows 0.1 s apart: 0.4 s, held for 0.1 s more at either end; a single row counts as a time step."""
    for first, count, end, said in (
        (0.0, 5, 0.5, None),
        (0.1, 5, 0.5, None),
        (0.0, 1, 0.01, None),
        (0.0, 5, 0.51, "must reach from 0 to 0.51 s but for one interval, 0.1 s, got 0 to 0.4 s"),
        (0.11, 5, 0.5, "must reach from 0 to 0.5 s but for one interval, 0.1 s, got 0.11 to 0.51 s"),
        (0.0, 1, 0.02, "must reach from 0 to 0.02 s but for one interval, 0.01 s, got 0 to 0 s"),
    ):
        at = first + 0.1 * np.arange(count)
        one = Recording({"qpos": np.zeros(2)}, np.ones((count, 1)), times=[0.0, end], control_times=at)
        for use in (lambda one: stack(cart, [one]), lambda one, end=end: one.cut(end, _STEP)):
            with contextlib.nullcontext() if said is None else pytest.raises(ValueError, match=said):
                use(one)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "qvel of the recording must have 1 columns in this scene, got 3"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_search(cart, given, said):
    """A speed of three numbers as what is fitted, and as what is held out; and no steps at all, before anything else."""
    wrong, gear = Recording({"qvel": np.zeros((41, 3))}, _DRIVE[:, None]), {"gear": identification.gear(cart, "motor")}
    steps = []
    for recordings, held_out in (([wrong], []), ([_noisy()], [wrong])):
        with pytest.raises(ValueError, match=said):
            mg.identify(cart, gear, recordings, held_out=held_out, log=lambda step, _: steps.append(step), **given)
    assert steps == []


def test_what_is_shown_at_a_prompt_is_short_and_says_what_it_is(cart):
    """A recording by its signals, a parameter by its numbers, a result as `print` does."""
    recording = Recording({"place": np.zeros(41)}, _DRIVE[:, None], name="walk")
    assert repr(recording) == "Recording('walk': place (41, 1), controls (40, 1), one row per time step)"
    alone = Recording({"qpos": np.zeros((3, 2))}, times=[0, 0.1, 0.25])
    assert repr(alone) == "Recording('the recording': qpos (3, 2), no controls, 0.25 s)"
    gear = identification.gear(cart, "motor")
    assert repr(gear) == "Parameter(nominal=3, lower=0.3, upper=30, unit='')"
    gains = Parameter([60.0, 3.0], [6.0, 0.3], np.inf, lambda model, value: {}, "N")
    assert repr(gains) == "Parameter(nominal=[60 3], lower=[6 0.3], upper=[inf inf], unit='N')"
    result = mg.identify(cart, {"gear": gear}, [dataclasses.replace(recording, measured={"place": _course()})])
    assert repr(result) == result.summary()
    before = identification.outlook(cart, {"gear": gear}, [recording])
    assert repr(before) == before.summary()


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ({"place": np.zeros((0, 1))}, "at least one row of some signal, got {'place': 0}"),
        ({"place": [0.0, np.inf]}, "finite, or NaN for none, got infinity in place"),
        ({"place": [0.0, 1.0], "qvel": [0.0]}, "same number of rows, got {'place': 2, 'qvel': 1}"),
    ],
)
def test_recordings_without_rows_or_with_infinity_are_told_so(measured, said):
    with pytest.raises(ValueError, match="of the recording must") as refused:
        Recording(measured)
    assert said in str(refused.value)


def test_recordings_with_and_without_a_start_go_together_in_a_scene_of_any_engine(cart):
    """States of two engines carry more or less beside positions and velocities."""
    scene = cart.with_engine("mjx")
    one = _noisy()
    given = dataclasses.replace(one, start=mg.initial_state(scene), name="with a start")
    found = stack(cart, [one, given])
    assert len(found.state.qpos) == 2


def test_the_inertia_of_a_body_that_was_compiled_as_diagonal_is_no_parameter():
    scene = mg.load_scene('<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>')
    with pytest.raises(ValueError, match="inertia of b, which was compiled as diagonal, cannot change"):
        identification.inertia(scene, "b")
