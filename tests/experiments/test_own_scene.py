"""Experiments on a scene and a cost of a user's own."""

import json

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.motion import CONTINUOUS, DISCRETE
from experiments.optimisation.measure import problem
from experiments.optimisation.settings import Settings as OptimisationSettings
from experiments.sawtooth import Settings as SawtoothSettings
from experiments.sawtooth import measure as saw
from experiments.work_precision.cases import own_case
from experiments.work_precision.settings import Settings as WorkSettings
from experiments.workspace import Workspace

# A block that flies against a wall within 0.06 s and bounces.
BLOCK = """<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody>
  <geom name="wall" type="box" pos=".2 0 0" size=".02 .1 .1"/>
  <body name="block"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
    <geom name="block" size=".05" mass=".2"/></body></worldbody>
  <actuator><motor name="push" joint="x" gear="6" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="near" qpos=".1 0" qvel="1 0" ctrl=".1"/></keyframe></mujoco>"""
SETTINGS = """\
# Which gradient holds in my scene?
experiment = "bias_variance"
scene = "block.xml"
cost = "costs.py:reward"
start = "near"
horizon = 30
stddev = 0.2
angles = [0.0, 0.4]
stiffness = [1e3, 1e6]
num_samples = 64
reference_samples = 256
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "block.xml").write_text(BLOCK)
    (tmp_path / "costs.py").write_text("def reward(trajectory):\n    return (trajectory.qpos[-1, 0] + 0.1) ** 2\n")
    (tmp_path / "broken.py").write_text("def reward(trajectory):\n    return (trajectory\n")
    (tmp_path / "own.toml").write_text(SETTINGS)
    return tmp_path


@pytest.mark.slow
def test_bias_and_variance_are_measured_and_a_changed_cost_is_run_again(folder, capsys):
    assert main(["run", "own.toml", "--output", "runs", "--debug"]) == 0
    summary = json.loads((folder / "runs" / "own" / "summary.json").read_text())
    assert summary["answer"].startswith("Zeroth order is right")
    assert "the file's own contact" in summary["verdict"]
    report = (folder / "runs" / "own" / "report.html").read_text()
    assert "h²k + 2hb" in report
    assert "α-order" in report
    (folder / "costs.py").write_text("def reward(trajectory):\n    return trajectory.qpos[-1]\n")
    assert main(["run", "own.toml", "--output", "runs"]) == 2
    assert "must return a scalar" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("scene=nowhere.xml", "scene: there is no file 'nowhere.xml'"),
        ('scene=""', "scene: there is no file ''"),
        ("scene=costs.py", "costs.py must be MJCF that MuJoCo accepts, but it says: XML parse error"),
        ("cost=nowhere.py:reward", "cost: there is no file nowhere.py"),
        (
            "cost=costs.py",
            "cost must be file.py:function, module:function, or of a body as height:torso, got 'costs.py'",
        ),
        ("cost=broken.py:reward", "raised SyntaxError: '(' was never closed (broken.py, line 2)"),
        ("cost=3", "cost: must be string, got 3"),
        ("start=far", "keyframe must be one of ['near'] in this scene, got 'far'"),
        ("stiffness=[1e3,-1e3]", "stiffness[1]: must be greater than 0, got -1000.0"),
        ("confidence=95", "confidence: must be less than 1, got 95"),
    ],
)
def test_mistakes_are_one_sentence(folder, capsys, override, said):
    assert main(["run", "own.toml", override, "--output", "runs"]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_its_outcome_is_a_sawtooth_of_the_push_and_with_an_onset_a_line(folder):
    """The mean derivative of MuJoCo's step is then not the slope; with an onset it is, within a tenth."""
    own = {"scene": "block.xml", "cost": "costs.py:reward", "start": "near", "horizon": 40}
    settings = SawtoothSettings(experiment="sawtooth", cases=("ball",), num_phases=64, width=0.3, **own)
    (course,) = saw(settings, Workspace(folder)).courses
    assert course.has_impact.all()
    assert float(course.smaller.min()) > 3
    error = course.error.max(("time", "coordinate"))
    assert float(error.sel(arm=CONTINUOUS)) < 0.1 < float(error.sel(arm=DISCRETE))


def test_its_controls_are_what_is_optimised_from_those_of_the_key_frame(folder):
    methods = ({"name": "first_order"}, {"name": "zeroth_order"})
    own = {"scene": "block.xml", "cost": "costs.py:reward", "start": "near", "horizon": 30, "methods": methods}
    found = problem(OptimisationSettings(experiment="optimisation", learning_rate=0.5, num_samples=8, **own))
    np.testing.assert_allclose(found.params, np.full(30, 0.1))
    assert (found.learning_rate, found.num_samples) == (0.5, 8)
    with pytest.raises(ValueError, match="learning_rate: required with a scene"):
        OptimisationSettings(experiment="optimisation", **own)


def test_error_against_run_time_starts_where_the_key_frame_is(folder):
    sizes = {"scenes": (), "refinements": (), "batch": 1, "num_rollouts": 8, "num_samples": ()}
    sizes |= {"gradient_refinements": (), "repeats": 1, "seconds": 0.1}
    own = {"experiment": "work_precision", "sizes": sizes, "scene": "block.xml", "start": "near", "horizon": 50}
    case = own_case(WorkSettings(**own))
    np.testing.assert_allclose(
        [*case.start[0], *case.start[1], *case.controls, case.duration], [0.1, 0, 1, 0, 0.1, 0.1]
    )
    with pytest.raises(ValueError, match="cost: none here"):
        WorkSettings(**own, cost="height:block")
