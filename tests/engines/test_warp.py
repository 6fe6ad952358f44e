"""MuJoCo Warp against C MuJoCo: motion, derivatives of steps and of rollouts, batches, room; `make test-warp` installs it."""

import functools
import importlib.util
import itertools
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.batched import device
from mjxgrad.engines import worlds
from mjxgrad.scene import SceneError, load
from mjxgrad.scene.scene import SceneWarning
from tests.engines.test_derivative import SCENES
from tests.engines.whole_steps import by_whole_steps

if importlib.util.find_spec("warp") is None:
    pytest.skip("NVIDIA Warp is not installed", allow_module_level=True)

NAMES = ["free box, pyramids", "ball joint, rolling, elliptic", "muscle, tendon, filter"]
CART = """<mujoco><option timestep="0.005"/><worldbody><geom name="floor" type="plane" size="2 2 .1"/><body pos="0 0 .1"><joint
    name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><geom name="ball" size=".1" mass="1"/><body
    pos="0 0 .2"><joint axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 .3"/></body></body></worldbody>
    <actuator><motor joint="x" gear="5"/></actuator><sensor><jointpos joint="x"/></sensor></mujoco>"""


def _start(scene):
    rng, model = np.random.default_rng(1), scene.mj_model
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, 0.02 * rng.normal(size=model.nv), 1.0)
    state = mg.initial_state(scene, qpos, 0.3 * rng.normal(size=model.nv), rng.uniform(0.2, 0.8, model.na))
    return state, rng.uniform(0.05, 0.6, model.nu)


@pytest.mark.parametrize("name", NAMES)
def test_a_step_and_its_derivative_are_c_mujocos(name):
    scene = mg.load_scene(SCENES[name], engine="warp")
    model, (state, ctrl) = scene.mj_model, _start(scene)
    controls = np.tile(ctrl, (10, 1))
    found, right = (
        mg.rollout(one, state, controls, contact=mg.Discrete()) for one in (scene, scene.with_engine("mujoco"))
    )
    np.testing.assert_allclose(found.qpos, right.qpos, atol=1e-5)  # single precision, over ten steps
    one = mg.linearise(scene, state, ctrl, contact=mg.Discrete())
    expected = by_whole_steps(model, *(np.asarray(x) for x in (state.qpos, state.qvel, state.act)), ctrl)
    for ours, theirs in zip((one.A, one.B), expected, strict=True):
        # Rounding, 6e-8, over a width of 3e-5 is 0.2 % of the largest entry.
        np.testing.assert_allclose(ours, theirs, atol=0.01 * np.abs(expected[0]).max())


def _cost(scene, state, controls):
    course = mg.rollout(scene, state, controls, contact=mg.Discrete(), observe=lambda model, data: data.sensordata)
    return course.qpos[-1, 0] + course.observations[-1].sum() + (course.qvel[-1] ** 2).sum()


def test_gradients_of_rollouts_agree_in_batches_and_in_parts(monkeypatch):
    scene = mg.load_scene(CART, engine="warp")
    controls = 0.5 * np.random.default_rng(0).normal(size=(3, 6, 1))
    start = mg.initial_state(scene, qvel=np.array([0.1, -0.2, 0.3]))

    def gradients(scene):
        return jax.jit(jax.vmap(jax.value_and_grad(lambda u: _cost(scene, start, u))))(controls)

    expected = gradients(scene.with_engine("mujoco"))
    for most in (2**32, 1):  # bytes: one world at a time
        monkeypatch.setattr(worlds, "_AT_ONCE", most)
        for ours, theirs in zip(gradients(scene), expected, strict=True):
            # The ball begins on the floor, so differences are to one side, and of those rounding is half a percent.
            np.testing.assert_allclose(ours, theirs, rtol=5e-3, atol=1e-2 * float(jnp.abs(theirs).max()))


def test_forward_mode_is_reverse_mode():
    scene = mg.load_scene(CART, engine="warp")
    controls, start = 0.5 * np.random.default_rng(0).normal(size=(6, 1)), mg.initial_state(scene)
    run = lambda u: _cost(scene, start, u)  # noqa: E731
    _, along = jax.jvp(run, (controls,), (np.ones_like(controls),))
    np.testing.assert_allclose(jax.grad(run)(controls).sum(), along, rtol=1e-6)


def test_every_motion_of_a_batch_may_have_its_own_numbers():
    scene = mg.load_scene(CART, engine="warp")
    masses, controls = np.array([0.5, 1.0, 2.0]), np.ones((8, 1))

    def end(scene, mass):
        other = scene.with_model(body_mass=scene.model.body_mass.at[1].set(mass))
        return mg.rollout(other, mg.initial_state(other), controls, contact=mg.Discrete()).qpos[-1]

    found = jax.vmap(lambda mass: end(scene, mass))(masses)  # its constants follow
    expected = [end(scene.with_engine("mujoco"), mass) for mass in masses]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    with pytest.raises(NotImplementedError, match=r"no derivative by actuator_acc0, .*body_mass.*: take"):
        jax.grad(lambda mass: end(scene, mass)[0])(1.0)


def test_numbers_that_warp_keeps_in_another_form_are_c_mujocos():
    xml = """<mujoco><option timestep=".005" cone="elliptic"/><worldbody><geom type="plane" size="2 2 .1"/><body pos="0 0 .099">
        <freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    scene = mg.load_scene(xml, engine="mujoco")
    start, other = mg.initial_state(scene, qvel=np.array([1.0, 0.3, 0, 0, 0, 2.0])), scene.with_model(impratio=10.0)
    found, expected, before = (
        mg.rollout(one, start, np.zeros((30, 0)), contact=mg.Discrete()).qpos[-1]
        for one in (other.with_engine("warp"), other, scene)
    )
    np.testing.assert_allclose(found, expected, atol=3e-6)
    assert np.abs(expected - before).max() > 1e-4


def test_contacts_without_room_are_counted():
    floor = '<mujoco><worldbody><geom type="plane" size="2 2 .1"/>{}</worldbody></mujoco>'
    box = '<body pos="{} 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    xml = floor.format("".join(box.format(0.5 * i) for i in range(3)))
    counts = []
    for room in (4, 16):
        scene = mg.load_scene(xml, engine="warp", max_contacts=room)
        counts.append(int(mg.rollout(scene, mg.initial_state(scene), np.zeros((5, 0))).crowded))
    assert counts == [5, 0]


def test_differences_cross_no_surface():
    beam = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="2 2 .1"/><body pos="0 0 .1">
        <joint type="slide" axis="0 0 1"/>
        <joint axis="0 1 0"/><geom type="capsule" fromto="-.2 0 0 .2 0 0" size=".1" mass="1"/></body></worldbody>
        </mujoco>"""
    scene = mg.load_scene(beam, engine="warp")
    linearise = lambda scene, state, contact: mg.linearise(scene, state, np.zeros(0), contact=contact).A  # noqa: E731
    # Of differences of 3e-5 one end, or both, would be on the other side.
    for height, contact in itertools.product((1e-5, 1e-6, -1e-6, -1e-5), (mg.Discrete(), mg.Slope())):
        state = mg.initial_state(scene, qpos=np.array([height, 0.0]), qvel=np.array([-0.5, 0.1]))
        found, expected = (linearise(one, state, contact) for one in (scene, scene.with_engine("mujoco")))
        np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())  # rounding over 2e-6


def test_a_control_at_the_end_of_its_range_has_the_derivative_within():
    scene = mg.load_scene(CART.replace('gear="5"', 'gear="5" ctrllimited="true" ctrlrange="-1 1"'), engine="warp")
    start = mg.initial_state(scene)
    slope = jax.jit(jax.grad(lambda u, by: mg.rollout(by, start, u[None, None]).qvel[-1, 0]))
    for control, share in ((1.0, 1.0), (-1.0, 1.0), (1.2, 0.0)):
        u = jnp.asarray(control)
        np.testing.assert_allclose(
            slope(u, scene), share * slope(jnp.zeros(()), scene.with_engine("mujoco")), rtol=1e-3
        )


@pytest.mark.parametrize("most_dense", [60, 0], ids=["dense", "sparse"])
def test_the_slope_is_c_mujocos(most_dense, monkeypatch):
    monkeypatch.setattr(worlds, "_MOST_DENSE", most_dense)
    ball = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="2 2 .1"/><body pos="0 0 .12"><freejoint/>
        <geom size=".1" mass="1"/></body></worldbody></mujoco>"""
    speeds = np.array([1.0, 0, -0.5, 0, 0, 0]) + np.random.default_rng(0).normal(size=(8, 6)) * [[0.3] * 3 + [0.9] * 3]

    def cost(scene, qvel):
        course = mg.rollout(scene, mg.initial_state(scene, qvel=qvel), np.zeros((40, 0)), contact=mg.Slope())
        return course.qpos[-1, 0] + course.qvel[-1, 2]

    scene = mg.load_scene(ball, engine="warp")
    slopes = lambda scene: jax.jit(jax.vmap(jax.grad(functools.partial(cost, scene))))(speeds)  # noqa: E731
    found, expected = slopes(scene), slopes(scene.with_engine("mujoco"))
    # Rounding is 0.4 % of a difference, and what friction changes here is 0.3; without events it is off by 0.05.
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_what_warp_lacks_is_said():
    scene = mg.load_scene(CART, engine="warp")
    with pytest.raises(ValueError, match=r"was loaded for MuJoCo Warp, engine='warp'; without engine= MJX steps it"):
        mg.rollout(scene, mg.initial_state(scene), np.zeros((2, 1)), contact=mg.Onset())
    bat = """<mujoco><worldbody><body mocap="true"><geom type="plane" size="1 1 .1"/></body><body pos="0 0 .1"><joint type="slide"
        axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>"""
    scene = mg.load_scene(bat, engine="warp")

    def end(height):
        places = {"mocap_pos": jnp.zeros((2, 1, 3)).at[:, :, 2].set(height)}
        return mg.rollout(scene, mg.initial_state(scene), np.zeros((2, 0)), inputs=places, contact=mg.Slope()).qpos[
            -1, 0
        ]

    with pytest.raises(NotImplementedError, match="slope has no derivative by places of mocap bodies: take"):
        jax.jit(jax.grad(end)).lower(0.0)
    slow = CART.replace('gear="5"', 'gear="5" delay="0.05" nsample="8"')
    with pytest.raises(SceneError, match="carries no delays"):
        mg.load_scene(slow, engine="warp")


TETRAHEDRON = """<mujoco><asset><mesh name="t" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset><worldbody>
    <geom type="plane" size="1 1 .1"/><body pos="0 0 .15"><joint name="z" type="slide" axis="0 0 1"/>
    <geom type="mesh" mesh="t"/></body></worldbody><actuator><motor joint="z" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_a_gpu_steps_by_warp_what_mjx_lacks(monkeypatch):
    monkeypatch.setattr(load, "is_gpu", lambda: True)
    with jax.enable_x64(False), pytest.warns(SceneWarning, match="MuJoCo Warp steps it: .*mesh"):
        assert mg.load_scene(TETRAHEDRON).engine == "warp"
    assert mg.load_scene(CART).engine == "mjx"
    monkeypatch.setattr(load, "is_gpu", lambda: False)
    with pytest.warns(SceneWarning, match="C MuJoCo steps it: .*mesh"):
        assert mg.load_scene(TETRAHEDRON).engine == "mujoco"


def test_check_tells_on_a_gpu_what_each_engine_takes(monkeypatch):
    monkeypatch.setattr(load, "is_gpu", lambda: True)
    monkeypatch.setattr(device, "is_cpu", lambda: False)
    verdict = mg.check(TETRAHEDRON, budget=2.0)
    (told,) = [one.text for one in verdict.findings if one.kind == "engine_prices"]
    assert re.search(
        r"^256 discrete gradients of 20 steps side by side take .* s by C MuJoCo .* s by MuJoCo Warp", told
    )
    # C MuJoCo is faster on a processor, and MJX refuses the scene.
    assert verdict.recommendation.engine == "mujoco"
    assert "engine='mujoco'" in verdict.code
    # Compilation is not for a quick check.
    assert not any(one.kind == "engine_prices" for one in mg.check(TETRAHEDRON, derivatives=False).findings)
