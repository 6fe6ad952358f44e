"""A scene and a cost of a user's own, swept over contact stiffness by one line."""

import html
import math
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import cli
from mjxgrad.checking.sweep import Knob, nearer, scene_task
from tests.scenes import ASSETS

# A block is pushed against a wall; its time step holds neither 1e6 1/s² (h²k + 2hb = 8) nor more.
BLOCK = """<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody>
  <geom name="wall" type="box" pos=".2 0 0" size=".02 .1 .1"/>
  <body name="block"><joint name="x" type="slide" axis="1 0 0"/><geom name="block" size=".05" mass=".2"/>
    <site name="tip" pos=".05 0 0"/></body></worldbody>
  <actuator><motor name="push" joint="x" gear="6" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="near" qpos=".12" qvel=".5" ctrl=".5"/></keyframe></mujoco>"""
COSTS = """
def reward(trajectory):
    return (trajectory.qpos[-1, 0] + 0.1) ** 2 - 0.01 * trajectory.qvel[-1, 0]

def all_of_it(trajectory):
    return trajectory.qpos[-1]
"""
PENDULUM = str(ASSETS / "inverted_pendulum.xml")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "block.xml").write_text(BLOCK)
    (folder / "costs.py").write_text(COSTS)
    return folder


@pytest.fixture(scope="module")
def swept(folder):
    return mg.sweep(
        folder / "block.xml",
        f"{folder}/costs.py:reward",
        start="near",
        horizon=40,
        stiffness=[1e3, 1e6],
        noise=0.5,
        num_samples=64,
        num_reference=512,
        contact=mg.Discrete(),
    )


SLED = """<mujoco><option timestep=".005"/><worldbody><geom type="plane" size="9 9 .1"/><body pos="0 0 .0995">
  <joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
  <geom type="box" size=".2 .1 .1" mass="1"/></body></worldbody>
  <actuator><motor joint="x" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_the_derivative_is_the_slope_unless_that_errs_twice_as_much(folder):
    """Onto a wall each step misses the jump; slopes of a sled follow each hop of its corners, which noise averages over."""
    hit = scene_task(
        mg.load_scene(folder / "block.xml", engine="mujoco"), f"{folder}/costs.py:reward", start="near", horizon=40
    )
    slide = scene_task(
        mg.load_scene(SLED, engine="mujoco"), lambda course: (course.qpos[-1, 0] - 0.3) ** 2, horizon=100
    )
    for task, expected in ((hit, mg.Slope), (slide, mg.Discrete)):
        knob = Knob(task, 0.5)
        softness = mg.Softness(stiffness=jnp.asarray(knob.own))
        chosen, why = nearer(knob, softness, jax.random.key(1), knob.truth(softness, jax.random.key(0), 256), print)
        assert isinstance(chosen.task.contact, expected)
        assert why.startswith("; slopes of the outcome err") is (expected is mg.Discrete)


def test_the_truth_of_a_jump_is_the_noises_density_and_of_a_line_exact(folder):
    """A block in flight goes left or right as its pushes' mean does: the slope is √T / σ √(2π) by the mean push."""
    for cost, slope, scatters in (
        (lambda trajectory: jnp.where(trajectory.qvel[-1, 0] > 0, 1.0, 0.0), math.sqrt(20 / (2 * math.pi)) / 0.2, True),
        (lambda trajectory: trajectory.qvel[-1, 0], 20 * 0.002 * 6 / 0.2, False),
    ):
        scene = mg.load_scene(str(folder / "block.xml"))
        knob = Knob(scene_task(scene, cost, horizon=20), noise=0.2)  # within the range of controls
        value, error = knob.truth(mg.Softness(1e4), jax.random.key(0), 2048)
        assert abs(value.item() - slope) <= (3 * error.item() if scatters else 1e-3 * slope)
        assert 0 < error.item() < (0.05 if scatters else 1e-4) * slope


def test_the_truth_is_the_slope_of_the_smoothed_cost_in_c_mujoco(swept, folder):
    """By differences of the mean over common noise, a twentieth of its standard deviation to both sides."""
    scene = mg.load_scene(folder / "block.xml")
    task = scene_task(scene, f"{folder}/costs.py:reward", start="near", horizon=40, contact=mg.Discrete())
    knob, width = Knob(task.with_contact(mg.Discrete()).with_engine("mujoco"), 0.5), 0.025
    keys = jax.random.split(jax.random.key(5), 2000)
    table = swept.result.table()
    for row, stiffness in enumerate(swept.result.knob[1][:2]):
        objective = knob(mg.Softness(stiffness=stiffness))
        values = jax.jit(jax.vmap(lambda at, key: objective.value(at, objective.sample_noise(key)), in_axes=(None, 0)))  # noqa: B023
        ends = [values(jnp.array([at]), keys) for at in (-width, width)]
        slopes = np.asarray(ends[1] - ends[0]) / (2 * width)
        error = np.hypot(slopes.std() / math.sqrt(len(slopes)), (table["truth_high"] - table["truth"])[row, 0] / 2)
        assert abs(slopes.mean() - table["truth"][row, 0]) < 4 * error
        assert error < 0.25 * abs(slopes.mean())


def test_the_table_has_the_files_own_contact_and_says_what_the_time_step_does_not_hold(swept):
    assert swept.labels == ["1000", "2500 (file)", "1e6"]
    lines = str(swept).splitlines()
    assert lines[0].startswith("block.xml: Take ")
    assert "s a gradient of 16 rollouts. It is " in lines[0]
    assert [line.split("  ")[0] for line in lines if line.startswith(("1000", "2500", "1e6 !"))][-3:] == [
        *swept.labels[:2],
        "1e6 !",
    ]
    (sentence,) = [line for line in lines if line.startswith("!")]
    assert "h²k + 2hb = 12, stable below 4" in sentence


def test_the_page_has_answer_picture_table_and_sentence(swept):
    page = swept.as_html()
    answer = swept.headline.partition(". ")[0]
    plain = html.unescape(re.sub("</?span.*?>", "", page)).replace("\N{NO-BREAK SPACE}", " ")
    assert f"<h1>{answer}.</h1>" in plain
    assert page.count("<svg role=") == 2  # bias and variance
    assert html.escape(page) in swept._repr_html_()  # a notebook shows it in a frame
    assert page.index("<h1>") < page.index("2500 (file)") < page.index("<svg")
    assert "h²k" in page.partition("</table>")[2]
    assert "s a gradient of 16 rollouts" in plain
    assert "Error of a gradient of 16 rollouts" in plain


def test_without_matplotlib_page_and_picture_say_what_brings_it(swept, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match="matplotlib, not installed: pip install 'mjxgrad\\[render\\]'"):
        swept.as_html()
    with pytest.raises(ImportError, match="mjxgrad\\[render\\]"):
        swept.result.plot()
    assert swept._repr_html_() is None  # a notebook then shows text


def test_a_sweep_of_gymnasiums_pendulum_is_one_line(tmp_path, monkeypatch, capsys):
    """Nothing of it can touch, which is said, and its own contact measured alone."""
    monkeypatch.chdir(tmp_path)
    Path("upright.py").write_text("def cost(trajectory):\n    return (trajectory.qpos[-1] ** 2).sum()\n")
    arguments = ["--cost", "upright.py:cost", "--horizon", "10", "--samples", "32", "--gradient", "discrete"]
    arguments += ["--engine", "mujoco"]  # which compiles nothing
    assert cli.main(["sweep", PENDULUM, *arguments]) == 0
    said = capsys.readouterr().out
    assert "a constant added to the control of slide" in said
    assert "No two geoms can touch" in said
    assert Path("sweep.html").read_text().startswith("<!DOCTYPE html>")


def test_without_actuators_it_is_by_the_velocity_at_the_start(tmp_path):
    """A ball falls freely for 0.1 s: its height has the derivative 0.1 by its velocity, without any spread."""
    (tmp_path / "ball.xml").write_text(
        '<mujoco><worldbody><body name="ball"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    sizes = {"horizon": 50, "num_samples": 32, "num_reference": 200}
    found = mg.sweep(tmp_path / "ball.xml", "height:ball", contact=mg.Discrete(), engine="mujoco", **sizes)
    assert "velocity of the joint at the start" in found.question
    np.testing.assert_allclose(found.result.first.value, -0.1, rtol=1e-6)
    np.testing.assert_allclose(found.result.table()["truth"], -0.1, rtol=0.05)


def test_the_files_own_stiffness_stands_for_its_contacts_as_they_are(folder):
    """Half critical damping, which no other stiffness has; traced, too."""
    (folder / "bouncy.xml").write_text(BLOCK.replace('mass=".2"', 'mass=".2" solref=".02 .5"'))
    knob = Knob(scene_task(mg.load_scene(folder / "bouncy.xml"), "height:block"), 0.2)

    def contact(stiffness):
        return knob(mg.Softness(stiffness=stiffness)).task.scene.contact_parameters().damping_ratio

    own = knob.task.scene.contact_parameters().damping_ratio
    assert abs(own - 1).min() > 0.1
    for read in (contact, jax.jit(contact)):
        np.testing.assert_allclose(read(jnp.array(knob.own)), own)
        np.testing.assert_allclose(read(jnp.array(2 * knob.own)), 1.0)


def test_derivatives_by_the_push_are_those_by_all_controls_along_it(folder):
    """The transpose of how it moves them, for two actuators, whose directions differ."""
    (folder / "two.xml").write_text(BLOCK.replace("</actuator>", '<motor joint="x" ctrlrange="-3 1"/></actuator>'))
    scene = mg.load_scene(folder / "two.xml")
    objective = Knob(scene_task(scene, "height:block", horizon=3), 0.2)(mg.Softness(stiffness=1e3))
    by_control = jnp.arange(1.0, 7.0)
    (expected,) = jax.vjp(lambda at: objective.unravel(at).ravel(), jnp.zeros(1))[1](by_control)
    np.testing.assert_allclose(objective.pull_back_at(jnp.zeros(1), None)(by_control), expected)
    np.testing.assert_allclose(objective.stddev, [0.2, 0.4])  # of half the range


def test_costs_by_name_are_what_c_mujoco_says(folder):
    scene = mg.load_scene(folder / "block.xml")
    moved = mg.rollout(scene.with_engine("mujoco"), mg.initial_state(scene, qpos=jnp.array([0.05])), jnp.ones((20, 1)))
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:] = moved.qpos[-1]
    mujoco.mj_kinematics(scene.mj_model, data)
    block, tip, start = data.body("block").xpos, data.site("tip").xpos, 0.05
    expected = {
        "height:tip": -tip[2],
        "reach:block/tip": np.linalg.norm(block - tip),
        "speed:block": -(block[0] - start) / (20 * 0.002),
        "upright:block": 0.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(scene_task(scene, name, horizon=20).cost(moved), value, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.xml"], "there is no file nowhere.xml"),
        (["block.xml", "--cost", "none.py:reward"], "there is no file none.py"),
        (["block.xml", "--cost", "costs.py:rewards"], "costs.py has no function 'rewards', but reward, all_of_it"),
        (["block.xml", "--cost", "costs.py:all_of_it"], "cost must return a scalar of shape ()"),
        (["block.xml", "--cost", "broken.py:cost"], "'broken.py:cost' raised SyntaxError: invalid syntax"),
        (["block.xml", "--cost", "height:blok"], "there is no body or site 'blok' in the scene, but body: world"),
        (["block.xml", "--cost", "reach:block"], "reach is of two, as reach:hand/ball, got 'block'"),
        (["block.xml", "--cost", "hight:block"], "or a function; did you mean height:block?"),
        (["block.xml", "--start", "far"], "keyframe must be one of ['near'] in this scene, got 'far'"),
        (["block.xml", "--stiffness", "0"], "stiffness must be positive and finite, got 0.0"),
        (["block.xml", "--html", "nowhere/page.html"], "nowhere/page.html cannot be written"),
        (["block.xml", "--gradient", "slop"], 'Choose from: "slope", "discrete"'),
    ],
)
def test_what_cannot_be_swept_is_said_in_one_sentence(folder, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(cli.signal, "signal", lambda *_: None)
    Path("broken.py").write_text("def cost(:\n")
    assert cli.main(["sweep", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_the_answer_names_what_to_take_how_sure_and_from_where_something_else(swept, monkeypatch):
    """By hand: 16 rollouts of variance 0.16 are off by 0.1, of 4 by 0.5; a bias of 0.5 adds up with them in squares."""
    halves, cost = (
        {"first": 0.02, "zeroth": 0.1, "alpha_order": 0.05},
        {"first": 0.16, "zeroth": 4.0, "alpha_order": 1.0},
    )
    biases = {"first": [0.0, 0.0, 0.5], "zeroth": [0.0, 0.0, 0.0], "alpha_order": [0.0, 0.0, 0.1]}
    truth = np.array([[1.0], [1.0], [-1.0]])
    table = {"truth": truth, "truth_low": truth - 0.1, "truth_high": truth + 0.1}
    for name, half in halves.items():
        bias = np.array(biases[name])[:, None]
        table |= {f"{name}_bias": bias, f"{name}_bias_low": bias - half, f"{name}_bias_high": bias + half}
        table |= {f"{name}_is_biased": abs(bias) > half, f"{name}_variance": np.full((3, 1), cost[name])}
    monkeypatch.setattr(type(swept.result), "table", lambda self: table)
    np.testing.assert_allclose(swept.errors()["first"], [0.1, 0.1, np.sqrt(0.25 + 0.01 - 1e-4)], rtol=1e-6)
    assert not swept.headline.endswith("on α-order.")  # the time step is too long for 1e6 1/s²
    monkeypatch.setattr(type(swept.result), "too_stiff", [""] * 3)
    told = re.sub(r"[\d.e-]+ s a", "0.3 s a", swept.headline)
    assert told == (
        "Take first order: its variance is 0.04 of zeroth order's and no bias was seen above 2 %; "
        "0.3 s a gradient of 16 rollouts. It is 10 % off, zeroth order 50 %, α-order 25 %. From 1e6 1/s² on α-order."
    )
    table["first_bias"][1] = table["first_bias_low"][1] = table["first_bias_high"][1] = 2.0
    table["alpha_order_variance"][:] = 100.0
    assert swept.headline.startswith("Take zeroth order: it has no bias; ")
    assert " It is 50 % off, first order 200 %, α-order 250 %." in swept.headline
    table["zeroth_variance"][:], table["alpha_order_variance"][:] = 64.0, 1e3
    assert "; it is 50 % off from about 300 rollouts." in swept.headline  # 64 / 0.5² is 256
    for name in halves:
        table[f"{name}_variance"] = np.array([[4.0], [1e5], [4.0]])
    assert swept.headline == (
        "From 16 rollouts no estimate is within 1000 % of the gradient: "
        "take softer contact, a shorter time step or a shorter horizon."
    )
    assert swept.best() == ["first", "none", "zeroth"]
    table["truth_low"] = table["truth"] - 1.6
    assert swept.headline == (
        "The gradient is not told from zero: 1 ± 0.1, so that no estimate can be judged: "
        "start nearer, look further ahead, or take more rollouts."
    )
    assert swept.best() == ["none", "none", "zeroth"]
    assert swept._rows()[3][2] == "50 %"  # what is off by 0.5 of what is at most 1.1 is off by 45 %
    assert swept._rows()[1][2] == "over 45 %"
    table |= {name: np.zeros((3, 1)) for name in table if name.endswith("_bias") or name == "truth"}
    assert swept.headline.startswith("Stiffness changes nothing: nothing touches")


def test_a_cost_that_feels_nothing_is_refused_before_the_sweep(folder):
    """A block on a rail has one height; its page would have a zero in every cell, after minutes."""
    with pytest.raises(ValueError, match="cost must feel the controls, but stays -0 in 256 motions"):
        mg.sweep(folder / "block.xml", "height:block", horizon=20, engine="mujoco", contact=mg.Discrete())


def test_a_gradient_that_is_not_told_from_zero_is_said_before_the_sweep(folder):
    """The square of a mean speed has its minimum at no push: by symmetry the gradient is zero, at any stiffness."""
    said, told = [], "by 256 motions, not told from zero; if it stays so, start nearer or look further ahead"
    still = mg.load_scene(BLOCK.replace('ctrl=".5"', 'ctrl="0"').replace('qvel=".5"', 'qvel="0"'), engine="mujoco")
    quick = {"horizon": 5, "num_samples": 4, "num_reference": 8, "stiffness": [1e3]}
    mg.sweep(still, lambda t: t.qvel[-1, 0] ** 2, log=said.append, **quick)
    first = next(
        k
        for k, line in enumerate(said)
        if "4 rollouts of 5 steps each: " in line and " s a gradient of 16 rollouts, by " in line
    )
    assert any(line.endswith(told) for line in said[:first]), said
    said.clear()
    mg.sweep(still, lambda t: t.qvel[-1, 0], log=said.append, **quick)
    assert not any(line.endswith(told) for line in said)


def test_stiffness_that_the_time_step_does_not_hold_is_left_out_unless_asked_for(folder):
    """At 2 ms and critical damping those from (0.828/h)² = 171573 on: h²k + 2hb = 4, and b = 2√k."""
    cost = f"{folder}/costs.py:reward"
    sizes = {"start": "near", "horizon": 20, "num_samples": 8, "num_reference": 16, "engine": "mujoco"}
    found = mg.sweep(folder / "block.xml", cost, contact=mg.Discrete(), **sizes)
    assert found.labels == ["100", "1000", "2500 (file)", "10000", "1e5"]
    assert not any(found.result.too_stiff)
    assert "Left out: 1e6 1/s², for the time step integrates none from 1.72e5 on." in found.question


def test_a_sweep_in_single_precision_is_that_in_double(folder):
    """A ball that stands on the floor in the file: its contact acts from the first step, whoever asks."""
    (folder / "rest.xml").write_text(
        """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .05"><joint type="slide" axis="0 0 1"/>
        <geom size=".05" mass=".2"/></body></worldbody></mujoco>"""
    )
    given = {"horizon": 20, "num_samples": 8, "num_reference": 16, "engine": "mujoco", "contact": mg.Discrete()}
    found = []
    for precision in (False, True):
        with jax.enable_x64(precision):
            one = mg.sweep(mg.load_scene(folder / "rest.xml"), lambda course: course.qpos[-1, 0], **given)
        found.append(np.asarray(one.result.first.value))
        assert "touches exactly at the start" in one.question
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)  # the scene's own numbers keep their single precision
