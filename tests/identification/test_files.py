"""Recordings, parameters and scenes as files; and the command that takes and writes them."""

import warnings
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import cli
from mjxgrad.identification import files
from mjxgrad.identification.motions import Motions
from mjxgrad.identification.parameters import Parameter, write_all
from mjxgrad.identification.recording import Recording, stack, start_of

_SCENE = """<mujoco><option timestep="0.01"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body name="ball" pos="0 0 3"><freejoint name="root"/><geom name="ball" pos="1e-3 0 0" size=".1" mass="1"/></body>
  <body name="cart" pos="2 0 1"><joint name="x" type="slide" axis="1 0 0" damping=".1" frictionloss=".1"/>
  <geom name="cart" size=".1" mass="2"/></body></worldbody>
  <actuator><motor name="x" joint="x" gear="3"/><position name="servo" joint="x" kp="5" kv="1"/></actuator>
  <sensor><jointpos name="place" joint="x"/><framepos name="tip" objtype="body" objname="cart"/></sensor></mujoco>"""
_CART = """<mujoco><option timestep="0.01"/><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" damping=".1"/>
  <geom size=".1" mass="2"/></body></worldbody><actuator><motor name="motor" joint="x" gear="3"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(_SCENE, keep_everything=True)


def _write(path, **columns):
    rows = zip(*columns.values(), strict=True)
    Path(path).write_text("\n".join(",".join(map(str, row)) for row in [columns.keys(), *rows]) + "\n")


def test_columns_go_to_joints_sensors_and_actuators_by_name(scene, tmp_path):
    """The first row is the start, and what it lacks the scene's pose; CSV and NPZ say the same."""
    columns = {
        "time": [1.0, 1.02, 1.03],
        "qpos:x": [0.5, 0.6, ""],
        "qpos:root[2]": [2.5, 2.4, 2.3],
        "qvel[6]": [0.7, 0.8, 0.9],
        "tip[0]": [2.5, 2.6, 2.7],
        "ctrl:x": [1, 2, 3],
        "servo": [4, 5, 6],
        "camera": [0, 0, 0],
    }
    _write(tmp_path / "a.csv", **columns | {"camera": ["far", "near", "near"]})
    arrays = {name: np.array([np.nan if v == "" else v for v in column]) for name, column in columns.items()}
    arrays["camera"] = np.array(["far", "near", "near"])
    del arrays["ctrl:x"], arrays["servo"], arrays["qvel[6]"]
    arrays["ctrl"] = np.array([[1, 4], [2, 5], [3, 6]])
    arrays["qvel"] = np.column_stack([np.full((3, 6), np.nan), [0.7, 0.8, 0.9]])
    np.savez(tmp_path / "a.npz", **arrays)
    for name in ("a.csv", "a.npz"):
        found, unknown = files.recording(scene, tmp_path / name)
        assert unknown == ("camera",)
        np.testing.assert_allclose(found.times, [0, 0.02, 0.03])
        np.testing.assert_allclose(found.controls, [[1, 4], [2, 5], [3, 6]])
        np.testing.assert_allclose(found.measured["qpos"][:, [2, 7]], [[2.5, 0.5], [2.4, 0.6], [2.3, np.nan]])
        np.testing.assert_allclose(found.measured["tip"][:, 0], [2.5, 2.6, 2.7])
        start = start_of(scene, found, found.times)
        np.testing.assert_allclose(start.qpos, [0, 0, 2.5, 1, 0, 0, 0, 0.5])
        np.testing.assert_allclose(start.qvel, [0, 0, 0, 0, 0, 0, 0.7])
        np.testing.assert_allclose(found.noise["tip"][0], np.std([2.5, 2.6, 2.7]))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"x": [1, 2]}, "must have a column named time"),
        ({"time": [0, 1, 1], "place": [1, 2, 3]}, "time in .* must increase, got 1, then 1"),
        ({"time": [], "place": []}, "must have at least two rows of numbers, got 0"),
        ({"time": [0, 1], "x": [1, 2]}, "must say what it is, as one of ctrl:x, qpos:x"),
        ({"time": [0, 1], "place": [1, 2], "ctrl:x": [0, 0]}, "it lacks servo$"),
        ({"time": [0, 1], "place": [1, 2], "ctrl:x": [0, 0], "servos": [0, 0]}, "is it servos"),
        ({"time": [0, 1], "ctrl:x": [0, 0], "servo": [0, 0], "palce": [1, 2]}, "did you mean place"),
        ({"time": [0, "soon"], "x": [1, 2]}, "a line of names, then numbers.*: time in line 3 is no number: 'soon'"),
        (
            {"time": [0, 1], "place": [1, 2], "ctrl:x": [0, "on"], "servo": [0, 0]},
            "ctrl:x in line 3 is no number: 'on'",
        ),
        ({"time": [0, 1], "qpos:palce": [1, 2]}, "qpos:palce, which is not of this scene; did you mean qpos:"),
        (
            {"time": [0, 1], "place": [1, 2], "ctrl:x": [0, np.nan], "servo": [0, 0]},
            "x has no finite number in row 2, at 1 s$",
        ),
        (
            {"time": [3, 4], "place": [1, 2], "servo": ["", ""]},
            "it lacks x; its column servo has no .* in row 1, at 3 s$",
        ),
        (bytes(range(256)), "a.csv must be a line of names, then numbers"),
        (b"time,x\n\n0,1,2", "line 3 has 3 cells, not 2"),
        (b"# made by a robot\ntime,x\n0,1", "line 1 is a comment, not names"),
        (b"time;x\n0;1", "decimal points, separated by commas: its cells are separated by ';'"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused_with_what_it_lacks(scene, tmp_path, columns, said):
    path = tmp_path / "a.csv"
    path.write_bytes(columns) if isinstance(columns, bytes) else _write(path, **columns)
    with pytest.raises(ValueError, match=said):
        files.recording(scene, path)
    path.rename(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a\.npz must be an NPZ with arrays of numbers"):
        files.recording(scene, tmp_path / "a.npz")


def test_actuators_with_several_controls_take_a_column_for_each(tmp_path):
    """A pid has two, then comes a motor: controls are numbered through. Column names lead back to the same places."""
    scene = mg.load_scene(
        """<mujoco><worldbody><body><joint name="h"/><geom pos=".3 0 0" size=".1"/></body></worldbody>
        <actuator><pid name="turn" joint="h" kp="5" kv=".3"/><motor name="push" joint="h"/></actuator></mujoco>""",
        engine="mujoco",
    )
    columns = {"time": [0.0, 0.002], "qpos": [0.1, 0.2], "push": [5, 6], "turn[1]": [3, 4]}
    _write(tmp_path / "a.csv", **columns, **{"turn[0]": [1, 2]})
    found, unknown = files.recording(scene, tmp_path / "a.csv")
    assert unknown == ()
    np.testing.assert_array_equal(found.controls, [[1, 3, 5], [2, 4, 6]])
    names = files.column_names(scene)
    assert [names["ctrl", i] for i in range(3)] == ["ctrl:turn[0]", "ctrl:turn[1]", "ctrl:push"]
    _write(tmp_path / "a.csv", **columns)
    with pytest.raises(ValueError, match=r"it lacks turn\[0\]"):
        files.recording(scene, tmp_path / "a.csv")


def test_a_misspelt_column_is_told_with_the_name_that_it_is_like(scene, tmp_path):
    """A second name of what is there already, or one that is like none, is no slip."""
    columns = {"time": [0, 1], "qpos:x": [1, 2], "ctrl:x": [0, 0], "servo": [0, 0]}
    _write(tmp_path / "a.csv", **columns, plac=[1, 2], servo2=[0, 0], camera=[0, 0])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        _, unknown = files.recording(scene, tmp_path / "a.csv")
    assert unknown == ("plac", "servo2", "camera")
    (text,) = (str(one.message) for one in told)
    assert text.endswith("a.csv has a column plac, which is not of this scene and is left out; did you mean place?")


def test_an_archive_with_complex_numbers_is_refused(scene, tmp_path):
    """One of them would else lose its imaginary part in silence."""
    np.savez(tmp_path / "a.npz", time=np.arange(3.0), place=np.full(3, 1j))
    with pytest.raises(ValueError, match="place must be real numbers, got complex128"):
        files.recording(scene, tmp_path / "a.npz")


def test_each_number_of_a_free_joint_counts_but_a_part_of_a_quaternion():
    """Motion capture of places alone: three of six changes are compared, and the fit sees them."""
    scene = mg.load_scene(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>", engine="mujoco"
    )
    places = np.full((3, 7), np.nan)
    places[:, :3] = [[0, 0, 0], [0.1, 0.2, 0.3], [0.2, 0.4, 0.6]]
    window = stack(scene, [Recording({"qpos": places})])
    np.testing.assert_allclose(window.weight["qpos"][0], np.tile([1, 1, 1, 0, 0, 0], (3, 1)))
    motions = Motions(scene, {"none": Parameter(1.0)}, delay=None, contact=None)
    left = motions.residuals(window, np.ones((1, 1)), np.zeros((1, 1, 12)))
    np.testing.assert_allclose(left.reshape(3, 6)[1, :2], [-0.1, -0.2])
    places[:, 3] = 1.0
    with pytest.raises(ValueError, match="all four numbers of a quaternion"):
        stack(scene, [Recording({"qpos": places})])


def named(scene, given):
    return {text.partition("=")[0]: files.parameter(scene, text) for text in given}


def test_the_noise_is_that_of_columns_or_whole_signals(scene, tmp_path):
    """Positions have one number per velocity; what was not measured weighs nothing."""
    columns = {
        "time": [0, 0.01],
        "qpos:x": [0.5, 0.6],
        "qpos:root[2]": [2, 3],
        "qpos:root[3]": [1, 1],
        "qvel:x": [0, 1],
    }
    _write(tmp_path / "a.csv", **columns, **{"ctrl:x": [0, 0], "servo": [0, 0]})
    noise = {"qpos": 0.3, "qpos:x": 0.1, "qpos:root[2]": 0.2, "qvel": 0.5}
    found, _ = files.recording(scene, tmp_path / "a.csv", noise)
    np.testing.assert_allclose(found.noise["qpos"], [0.3, 0.3, 0.2, 0.3, 0.3, 0.3, 0.1])
    assert found.knows_noise
    for wrong, said in (
        ({"qpos": 0.3}, "it lacks qvel:x"),
        ({"qpos": 0.0}, "positive"),
        ({"tip": 1.0}, "must name columns of"),
    ):
        with pytest.raises(ValueError, match=said):
            files.recording(scene, tmp_path / "a.csv", wrong)


def test_parameters_are_named_in_a_word(scene):
    given = ["mass:cart=0.5..3", "friction:floor/ball", "damping:x", "gains:servo", "delay=0..0.1"]
    found = named(scene, [*given, "body_pos[2]:cart=0.5..2", "jnt_stiffness:x=0..1"])
    fields = found["body_pos[2]:cart"].write(scene.model, jnp.asarray(1.5)) | found["jnt_stiffness:x"].write(
        scene.model, jnp.asarray(0.5)
    )
    np.testing.assert_allclose(fields["body_pos"][2], [2, 0, 1.5])
    np.testing.assert_allclose(fields["jnt_stiffness"], [0, 0.5])
    assert (found["mass:cart"].nominal, found["mass:cart"].upper, found["delay"].upper) == (2.0, 3.0, 0.1)
    refused = {
        "weight:cart": "kind one of mass",
        "mas:cart": "did you mean mass?",
        "mass": "must say of what",
        "gear:no": "no",
        "mass:cart=-1..1": "negative",
        "body_pos:cart": r"body_pos must have a column from 0 to 2, such as body_pos\[2\]:cart",
        "delay:servo": "delay must be of all controls and at least 0 s",
        "delay=-1..2": "delay must be of all controls and at least 0 s",
        "opt.timestep": "kind one of mass",
    }
    for wrong, said in refused.items():
        with pytest.raises(ValueError, match=said):
            files.parameter(scene, wrong)


def test_the_written_scene_has_the_numbers_that_were_found(scene, tmp_path):
    """Every kind at once, compiled again: each field as in the scene."""
    source = tmp_path / "scene.xml"
    source.write_text(_SCENE)
    given = ["mass:cart", "inertia:ball", "friction", "damping:x", "armature:x=0..1", "friction_loss:x=0..1", "gear:x"]
    wanted = named(scene, [*given, "gains:servo", "damping_ratio", "stiffness", "width"])
    values = {name: jnp.asarray(0.1 + 0.9 * one.nominal) for name, one in wanted.items()}
    found = write_all(scene, wanted, values)
    (tmp_path / "out").mkdir()
    files.write_xml(scene, found, source, tmp_path / "out" / "found.xml")
    again, expected = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "found.xml")), found.to_mujoco()
    for field in (
        "body_mass", "body_ipos", "body_inertia", "dof_damping", "dof_armature", "dof_frictionloss", "geom_friction",
        "geom_solref", "geom_solimp", "actuator_gear", "actuator_gainprm", "actuator_biasprm",
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(again, field), getattr(expected, field), rtol=1e-4, atol=1e-6, err_msg=field)


def test_held_out_is_the_end_of_one_motion_or_some_of_several():
    one = files.Recording({"place": np.arange(10.0)}, np.zeros((10, 2)), 0.01 * np.arange(10), 0.01 * np.arange(10))
    (early,), (late,) = files.hold_out([one], 0.3)
    assert len(early.times) == 7
    is_judged = [True, *[False] * 6, *[True] * 3]  # the first row is the start
    np.testing.assert_array_equal(np.isfinite(late.measured["place"][:, 0]), is_judged)
    fitted, judged = files.hold_out([one] * 10, 0.2)
    assert (len(fitted), len(judged)) == (8, 2)


def test_the_command_finds_a_mass_and_writes_what_it_found(tmp_path, monkeypatch, capsys):
    """2 kg pushed by 3 N times the control: written is the motion of 3 kg. With the gear beside it only the ratio is seen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.signal, "signal", lambda *_: None)
    Path("cart.xml").write_text(_CART.replace(' damping=".1"', ""))
    drive = np.sin(np.arange(40) / 5)
    speed = np.concatenate([[0], np.cumsum(0.01 * 3 * drive / 3)])
    place = np.concatenate([[0], np.cumsum(0.01 * speed[1:])])
    _write("motion.csv", **{"time": 0.01 * np.arange(40), "x": place[:40], "motor": drive, "other": drive})
    command = ["identify", "cart.xml", "motion.csv", "--parameter", "mass:cart"]
    assert cli.main(command) == 0
    said = capsys.readouterr()
    assert said.out.startswith("Found to <0.01 %: error ")
    assert said.err.index("About ") < said.err.index("step 1:")
    assert "left out of motion.csv: other" in said.out
    assert len(said.out.splitlines()[0].split()) <= 20
    assert mujoco.MjModel.from_xml_path("identified/identified.xml").body("cart").mass == pytest.approx(3.0, rel=1e-4)
    page = Path("identified/report.html").read_text()
    assert page.count("<svg") == 1
    assert "http" not in page.replace("http://www.w3.org", "")
    assert cli.main([*command, "gear:motor"]) == 1
    said = capsys.readouterr().out
    assert said.startswith("0 of 2 numbers found")
    assert "Cannot be told apart: mass:cart, gear:motor" in said
    assert cli.main(["identify", "cart.xml", "motion.csv", "--parameter", "weight"]) == 2
    _write("late.csv", **{"time": 10.0 * np.arange(40), "x": place[:40], "motor": drive})  # in milliseconds
    assert cli.main(["identify", "cart.xml", "late.csv", "--parameter", "mass:cart"]) == 2
    assert "time of late.csv must be in seconds" in capsys.readouterr().err


def test_the_command_begins_at_a_key_frame_and_says_what_it_replaces(tmp_path, monkeypatch, capsys):
    """A cart of 3 kg from 1 m at 0.5 m/s; the recording has no speeds, so that the first row alone would say that it rests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.signal, "signal", lambda *_: None)
    keys = '</actuator><keyframe><key name="there" qpos="1" qvel=".5"/></keyframe>'
    Path("cart.xml").write_text(_CART.replace(' damping=".1"', "").replace("</actuator>", keys))
    drive = np.sin(np.arange(40) / 5)
    speed = 0.5 + np.concatenate([[0], np.cumsum(0.01 * 3 * drive / 3)])
    place = 1 + np.concatenate([[0], np.cumsum(0.01 * speed[1:])])
    _write("motion.csv", **{"time": 0.01 * np.arange(40), "x": place[:40], "motor": drive})
    command = ["identify", "cart.xml", "motion.csv", "--parameter", "mass:cart", "--noise", "x=1e-5", "--start"]
    assert cli.main([*command, "ther"]) == 2
    assert "--start must be noisy, exact, free or a key frame (there), got ther" in capsys.readouterr().err
    assert cli.main([*command, "there"]) == 0
    assert "replaces the results" not in capsys.readouterr().err
    assert mujoco.MjModel.from_xml_path("identified/identified.xml").body("cart").mass == pytest.approx(3.0, rel=1e-4)
    with pytest.warns(
        mg.scene.SceneWarning, match="in motion.csv, the first place of x is 1e[+]05 times its noise beside"
    ):
        assert cli.main([*command, "exact"]) == 1
    said = capsys.readouterr().err
    assert said.index("replaces the results in identified") < said.index("About ")


def test_figures_name_their_signals_as_columns_do(scene):
    names = files.column_names(scene)
    assert [names["qpos", 2], names["qpos", 7], names["qvel", 6]] == ["qpos:root[2]", "qpos:x", "qvel:x"]
    assert [names["place", 0], names["tip", 1]] == ["sensor:place", "sensor:tip[1]"]
