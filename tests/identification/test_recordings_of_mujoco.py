"""Intervals hold what they promise: recordings made by C MuJoCo, with nothing chosen for the search."""

import mujoco
import numpy as np
import pytest
from scipy.stats import binom

import mjxgrad as mg
from mjxgrad import identification

_FRICTION, _MASS, _NOISE = 0.6, 1.3, 0.01  # m/s
_CONTROLS = np.sin(np.arange(200) / 8)[:, None]
_TURN = '<joint axis="0 1 0"/>'
_SOFT = 'solimp="0 .95 .002"'
_BOX = """<mujoco><option timestep=".005"/><default><geom {}/></default><worldbody><geom type="plane" size="5 5 .1"/>
  <body name="box" pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0" damping="1"/>
  <joint name="z" type="slide" axis="0 0 1"/>{}<geom type="box" size=".1 .05 .05" mass="1"/></body></worldbody>
  <actuator><motor joint="x" gear="20"/></actuator></mujoco>"""


_FREE = """<mujoco><option timestep=".002"/><default><geom {}/></default><worldbody><geom type="plane" size="5 5 .1"/>
  <body name="box" pos="0 0 .05"><freejoint name="root"/><geom type="box" size=".1 .05 .05" mass="1"/></body></worldbody>
  <actuator><motor joint="root" gear="1 0 0 0 0 0"/><motor joint="root" gear="0 1 0 0 0 0"/></actuator></mujoco>"""


def _states(xml: str, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and speeds of the true box, by C MuJoCo."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.geom_friction[:, 0] = _FRICTION
    model.body_mass[1] *= _MASS
    model.body_inertia[1] *= _MASS
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    found = [(data.qpos.copy(), data.qvel.copy())]
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        found.append((data.qpos.copy(), data.qvel.copy()))
    positions, speeds = zip(*found, strict=True)
    return np.array(positions), np.array(speeds)


def _assert_intervals_hold(xml: str, recordings: list[identification.Recording], may_stall: bool) -> None:
    """Of so many intervals of 95 % as many hold as do with a chance of 98 %, 17 of 20; `pytest -s` shows the counts."""
    scene, held, halves = mg.load_scene(xml, keep_everything=True), [], []
    parameters = {"friction": identification.friction(scene), "mass": identification.mass(scene, "box")}
    for recording in recordings:
        result = mg.identify(scene, parameters, [recording])
        error = np.array([result.values["friction"] - _FRICTION, result.values["mass"] - _MASS])
        halves.append([result.half_width["friction"], result.half_width["mass"]])
        held.append(np.abs(error) <= halves[-1])
        assert result.is_sound or may_stall, result.summary()
    share = np.median(halves, axis=0) / (_FRICTION, _MASS)
    print(
        f"\nfriction and mass hold {np.sum(held, axis=0)} of {len(held)}, median half widths {np.round(100 * share, 2)} %"
    )
    assert (np.sum(held, axis=0) >= binom.ppf(0.02, len(held), 0.95)).all()


@pytest.mark.parametrize(("contact", "chatters"), [(_SOFT, False), ("", True)], ids=["soft contact", "default contact"])
def test_it_is_foretold_that_contacts_chatter(contact, chatters):
    xml = _BOX.format(contact, "")
    scene, true = mg.load_scene(xml, keep_everything=True), _states(xml, _CONTROLS)[1]
    start = mg.initial_state(scene)
    one = identification.Recording({"qvel": true}, _CONTROLS, noise={"qvel": _NOISE}, start=start)
    found = identification.outlook(scene, {"friction": identification.friction(scene)}, [one])
    assert found.is_rugged == chatters
    assert found.is_mean == chatters
    assert ("Contacts chatter; errors are those of the mean of many motions" in found.summary()) == chatters


@pytest.mark.slow
@pytest.mark.parametrize(
    ("contact", "turn", "is_exact"),
    [("", "", True), (_SOFT, "", True), (_SOFT, "", False), ("", "", False), ("", _TURN, True), ("", _TURN, False)],
    ids=[
        "default contact, which chatters",
        "soft contact",
        "noisy starts, soft contact",
        "noisy starts, default contact",
        "default contact, corner by corner",
        "noisy starts, default contact, corner by corner",
    ],
)
def test_intervals_of_twenty_recordings_of_mujoco_cover_the_truth(contact, turn, is_exact):
    """Whether starts are given or measured. A box that turns chatters corner by corner.

    Friction that is 0.2 % off has other motions after twenty steps. Chatter that is not normal may stall the search.
    """
    xml, recordings = _BOX.format(contact, turn), []
    start = mg.initial_state(mg.load_scene(xml, keep_everything=True)) if is_exact else None
    true = _states(xml, _CONTROLS)[1]
    for seed in range(20):
        measured = true + _NOISE * np.random.default_rng(seed).normal(size=true.shape)
        recordings.append(identification.Recording({"qvel": measured}, _CONTROLS, noise={"qvel": _NOISE}, start=start))
    _assert_intervals_hold(xml, recordings, may_stall=bool(turn) and not is_exact)


@pytest.mark.slow
@pytest.mark.parametrize(("contact", "count"), [(_SOFT, 20), ("", 100)], ids=["soft contact", "default contact"])
def test_intervals_hold_where_a_height_of_a_millimetre_decides_all_that_follows(contact, count):
    """A free box, places to 1 mm: on soft contact 0.3 mm of height change the sum of squares eightfold.

    A hundred by default contact, since the errors of friction and mass go together: two counts that tell little more than one.
    """
    xml, recordings = _FREE.format(contact), []
    for seed in range(count):
        t = 0.002 * np.arange(500 + 250 * (seed % 2))
        controls = np.stack([14 * np.sin(9 * t + seed), 11 * np.sin(6.5 * t + 1)], axis=1)
        places = _states(xml, controls)[0][:, :3]
        measured = np.full((len(t) + 1, 7), np.nan)
        measured[:, :3] = places + 0.001 * np.random.default_rng(100 + seed).normal(size=places.shape)
        recordings.append(identification.Recording({"qpos": measured}, controls, noise={"qpos": 0.001}))
    _assert_intervals_hold(xml, recordings, may_stall=not contact)
