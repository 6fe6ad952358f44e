"""Derivatives through C MuJoCo: those of its steps are `mjd_transitionFD`'s, and rollouts are differentiable both ways."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.engines.pool import pool_of
from mjxgrad.stepping import own_motion
from mjxgrad.tasks import scene_path
from tests.engines.whole_steps import by_whole_steps

# MuJoCo's own tolerance would leave more in each difference than it is to be compared to.
_SOLVER = 'tolerance="1e-14" iterations="200"'
SCENES = {
    "free box, pyramids": f"""<mujoco><option {_SOLVER}/><worldbody><geom type="plane" size="2 2 .1"/>
        <body pos="0 0 .098" euler="1 2 3"><freejoint/><geom type="box" size=".1 .15 .1" mass="1"/></body>
        </worldbody></mujoco>""",
    "ball joint, rolling, elliptic": f"""<mujoco><option cone="elliptic" {_SOLVER}/><worldbody>
        <geom type="plane" size="2 2 .1" condim="6"/><body pos="0 0 .3"><joint type="ball"/><geom size=".05" pos=".1 0 -.1"/>
        <body pos=".2 0 -.201"><joint type="ball"/><geom type="ellipsoid" size=".1 .08 .1" condim="6"/></body></body>
        </worldbody></mujoco>""",
    "muscle, tendon, filter": f"""<mujoco><option {_SOLVER}/><worldbody><body name="a"><joint name="j" axis="0 1 0" range="-1 1"
        damping=".1"/><geom type="capsule" size=".05" fromto="0 0 0 .3 0 0"/><body pos=".3 0 0"><joint name="k" axis="0 1 0"
        frictionloss=".01"/><geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/></body></body></worldbody>
        <tendon><fixed name="t" limited="true" range="-.2 .2"><joint joint="j" coef=".5"/><joint joint="k" coef="-.3"/></fixed>
        </tendon><actuator><muscle joint="j" lengthrange="-1 1"/><general joint="k" dyntype="filter" dynprm=".05" gainprm="3"/>
        <position tendon="t" kp="5" ctrlrange="-.1 .1"/></actuator></mujoco>""",
    "RK4 and a slider-crank": f"""<mujoco><option integrator="RK4" {_SOLVER}/><worldbody><body><joint name="j" axis="0 0 1"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .2 0 0"/><site name="crank" pos=".2 0 0"/></body><site name="slider"
        pos=".6 0 0" zaxis="1 0 0"/></worldbody><actuator>
        <position cranksite="crank" slidersite="slider" cranklength=".3" kp="50"/></actuator></mujoco>""",
}


def _random(scene):
    """Return a state within reach of the contacts, and controls within range of some actuators and beyond those of others."""
    rng, model = np.random.default_rng(1), scene.mj_model
    qpos = scene.mj_model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, 0.02 * rng.normal(size=model.nv), 1.0)
    qvel, act = 0.3 * rng.normal(size=model.nv), rng.uniform(0.2, 0.8, model.na)
    return qpos, qvel, act, rng.uniform(0.05, 0.6, model.nu)


@pytest.mark.parametrize("name", SCENES)
def test_one_step_is_that_of_whole_steps(name):
    scene = mg.load_scene(SCENES[name], engine="mujoco")
    qpos, qvel, act, ctrl = _random(scene)
    found = mg.linearise(scene, mg.initial_state(scene, qpos, qvel, act), ctrl, contact=mg.Discrete())
    expected = by_whole_steps(scene.mj_model, qpos, qvel, act, ctrl)
    largest = max(np.abs(one).max(initial=0.0) for one in expected)
    for ours, theirs in zip((found.A, found.B), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6 * largest)  # what differences of 1e-6 leave


def test_the_solve_does_not_end_early_in_derivatives():
    """At MuJoCo's default tolerance differences of whole steps are off; ours are those of a solve that has ended."""
    coarse, fine = (
        mg.load_scene(SCENES["free box, pyramids"].replace(_SOLVER, solver), engine="mujoco")
        for solver in ("", _SOLVER)
    )
    qpos, qvel, act, ctrl = _random(fine)
    found = mg.linearise(coarse, mg.initial_state(coarse, qpos, qvel, act), ctrl, contact=mg.Discrete()).A
    expected = by_whole_steps(fine.mj_model, qpos, qvel, act, ctrl)[0]
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


HORIZON = 12


@pytest.fixture(scope="module")
def pushed():
    """A box that slides, pushed by a servo, with what it depends on; and what becomes of it."""
    scene = mg.load_scene(
        f"""<mujoco><option {_SOLVER}/><worldbody><geom name="floor" type="plane" size="2 2 .1"/><body name="box" pos="0 0 .0995">
        <freejoint/><geom name="box" type="box" size=".1 .1 .1" mass="1"/></body><body name="pusher" pos="-.3 0 .1">
        <joint name="p" type="slide" axis="1 0 0" damping="1"/><geom size=".05" mass=".5"/></body></worldbody>
        <actuator><position joint="p" kp="200"/></actuator></mujoco>"""
    )
    rng = np.random.default_rng(0)
    at = {
        "qvel": jnp.array([0.5, 0.2, 0.0, 0.1, -0.1, 1.0, 0.3]),
        "ctrl": 0.1 * jnp.asarray(rng.normal(size=(HORIZON, 1))),
        "force": jnp.asarray(rng.normal(size=(HORIZON, 7))),
        "mass": scene.model.body_mass,
        "friction": scene.model.geom_friction,
        "stiffness": jnp.array(900.0),
    }

    def end(at, engine="mujoco"):
        changed = scene.with_model(body_mass=at["mass"], geom_friction=at["friction"])
        changed = changed.with_softness(mg.Softness(stiffness=at["stiffness"], damping_ratio=1.0))
        state = mg.initial_state(changed, qvel=at["qvel"])
        inputs = {"qfrc_applied": at["force"]}
        course = mg.rollout(changed.with_engine(engine), state, at["ctrl"], inputs=inputs)
        return jnp.concatenate([course.qpos[-1], course.qvel[-1]]) @ jnp.arange(1.0, 16.0)

    return at, end


@pytest.fixture(scope="module")
def programs(pushed):
    """What becomes of the box, and its gradient by all at once, compiled."""
    _, end = pushed
    return jax.jit(end), jax.jit(jax.grad(end))


def test_every_argument_has_its_derivative(pushed, programs):
    """Against central differences of the rollout, by a random direction in each."""
    (at, _), (value, slopes), rng = pushed, programs, np.random.default_rng(3)
    gradient = slopes(at)
    for name, there in at.items():
        direction = rng.normal(size=there.shape) * (np.abs(there) + 0.01 * (name in ("qvel", "ctrl", "force")))
        ends = [value(at | {name: there + sign * 1e-5 * direction}) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-5
        # 1e-5 of a difference of differences; entries are up to hundreds.
        np.testing.assert_allclose(jnp.sum(gradient[name] * direction), expected, rtol=1e-4, atol=1e-5, err_msg=name)


def test_both_engines_and_both_modes_agree(pushed, programs):
    at, end = pushed
    ours, theirs = jax.jit(jax.grad(lambda at: end(at, "mjx")))(at), programs[1](at)
    forward = jax.jit(jax.jacfwd(lambda v: end(at | {"qvel": v})))(at["qvel"])
    np.testing.assert_allclose(forward, theirs["qvel"], rtol=1e-10)
    for name in at:
        scale = np.abs(ours[name]).max()
        np.testing.assert_allclose(theirs[name], ours[name], atol=1e-4 * scale, err_msg=name)


def test_batches_are_those_of_single_calls(pushed):
    """Starts and parameters mapped over at once, two axes deep; with their outcomes."""
    at, end = pushed
    speeds, stiffness = at["qvel"] * jnp.array([[1.0], [0.5]]), jnp.array([400.0, 900.0, 2500.0])
    both = jax.value_and_grad(lambda v, k: end(at | {"qvel": v, "stiffness": k}), argnums=(0, 1))
    found = jax.jit(jax.vmap(jax.vmap(both, (None, 0)), (0, None)))(speeds, stiffness)
    alone = jax.jit(both)
    single = [alone(v, k) for v in speeds for k in stiffness]
    expected = jax.tree.map(lambda *x: np.reshape(x, (2, 3, *x[0].shape)), *single)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-12), found, expected)


def test_a_policy_is_differentiated_through_the_loop(pushed):
    scene = mg.load_scene(SCENES["muscle, tendon, filter"])

    @jax.jit
    def cost(gain):
        policy = lambda gain, state: 0.3 - gain * state.qvel[:1] * jnp.ones(3)  # noqa: E731
        return (
            mg.rollout(scene.with_engine("mujoco"), mg.initial_state(scene), policy, gain, horizon=HORIZON)
            .qpos[-1]
            .sum()
        )

    expected = (cost(0.5 + 1e-4) - cost(0.5 - 1e-4)) / 2e-4
    for derivative in (jax.jit(jax.grad(cost)), jax.jit(jax.jacfwd(cost))):
        np.testing.assert_allclose(derivative(0.5), expected, rtol=1e-6)


@pytest.mark.parametrize("contact", [mg.Discrete(), mg.Slope()])
def test_the_time_step_has_its_derivative(contact):
    """A fall of n steps of h is of g h² n (n + 1) / 2."""
    fall = """<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""
    scene = mg.load_scene(fall, engine="mujoco")

    def height(timestep):
        held = scene.with_model(timestep=timestep)
        return mg.rollout(held, mg.initial_state(scene), horizon=50, contact=contact).qpos[-1, 0]

    np.testing.assert_allclose(jax.jit(jax.grad(height))(0.002), -9.81 * 0.002 * 50 * 51, rtol=1e-4)


def test_a_motion_that_diverges_has_finite_derivatives():
    """It stays at its last good state, and is flagged."""
    scene = mg.load_scene(SCENES["free box, pyramids"])

    def last(speed):
        state = mg.initial_state(scene, qvel=jnp.full(6, speed))
        return mg.rollout(scene.with_engine("mujoco"), state, horizon=5)

    course = last(2e4)  # m/s, rad/s
    assert course.diverged
    assert np.isfinite(jax.jacrev(lambda v: last(v).qpos[-1])(2e4)).all()


def test_second_derivatives_are_refused_by_name(pushed):
    at, end = pushed
    with pytest.raises(ValueError, match="C MuJoCo has first derivatives alone"):
        jax.hessian(lambda k: end(at | {"stiffness": k}))(at["stiffness"])


@pytest.mark.filterwarnings("ignore::mjxgrad.scene.SceneWarning")
def test_second_derivatives_are_not_promised_by_an_engine_that_lacks_the_scene():
    """MJX has no collision of a cylinder with a box."""
    geoms = "<geom type='box' size='1 1 .1'/><body pos='0 0 1'><freejoint/><geom type='cylinder' size='.1 .1'/></body>"
    scene = mg.load_scene(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    end = lambda v: mg.rollout(scene, mg.initial_state(scene, qvel=v), horizon=2).qpos[-1, 0]  # noqa: E731
    with pytest.raises(
        ValueError, match=r"alone: for second ones MJX must step the scene: .*cannot be stepped by MJX"
    ) as told:
        jax.hessian(end)(jnp.zeros(6))
    assert "engine" not in str(told.value)


def test_a_model_that_is_differentiated_is_left_as_it_was(pushed, programs):
    (at, _), (value, slopes) = pushed, programs
    before = value(at)
    slopes(at)
    assert value(at) == before


@pytest.mark.parametrize(("gradient", "geom"), [("discrete", "box"), ("slope", "sphere")])
def test_a_change_that_is_followed_is_the_forward_derivative(gradient, geom):
    """Step by step in one direction, against the Jacobians of all coordinates; the slope's are averages beside edges."""
    scene = mg.load_scene(SCENES["free box, pyramids"].replace('type="box"', f'type="{geom}"'))
    engine, rng = pool_of(scene.mj_model), np.random.default_rng(5)
    start = {
        "time": np.zeros((1, 1)),
        "qpos": scene.mj_model.qpos0[None] + [0, 0, 0.02, 0, 0, 0, 0],
        "qvel": rng.normal(size=(1, 6)),
    }
    start |= {"act": np.zeros((1, 0))}
    direction = rng.normal(size=12)
    pushes = np.zeros((1, 60, 0))
    found = engine.follow(gradient, {}, start, {"ctrl": pushes}, (direction[None], pushes))

    def end(change):
        qpos = integrate_position(scene.model, jnp.asarray(start["qpos"][0]), change[:6], 1.0)
        state = mg.initial_state(scene, qpos, start["qvel"][0] + change[6:])
        return mg.rollout(scene.with_engine("mujoco"), state, horizon=60, contact=own_motion(gradient)).qvel[1:]

    qvel, change = jax.jit(lambda direction: jax.jvp(end, (jnp.zeros(12),), (direction,)))(jnp.asarray(direction))
    np.testing.assert_allclose(found["qvel"][0], qvel, atol=1e-9)
    np.testing.assert_allclose(found["change"][0, :, 6:], change, atol=1e-5 * np.abs(change).max())


def test_single_precision_has_the_same_derivative_at_rest_and_upright():
    """A box that stands on the floor, in reverse mode: C MuJoCo computes in double, JAX rounds the rest."""

    def slopes():
        scene = mg.load_scene(SCENES["free box, pyramids"].replace('euler="1 2 3"', ""), engine="mujoco")
        state = mg.initial_state(scene)
        end = lambda v: mg.rollout(scene, dataclasses.replace(state, qvel=v), horizon=5, contact=mg.Slope()).qpos[-1]  # noqa: E731
        return np.asarray(jax.jit(jax.jacrev(end))(jnp.zeros_like(state.qvel)))

    double = slopes()
    with jax.enable_x64(False):
        single = slopes()
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=1e-5 * np.abs(double).max())


def test_growth_is_that_of_the_other_engine_and_has_no_derivative():
    scene = mg.load_scene(scene_path("double_pendulum"))

    def swung(torque, engine):
        controls = jnp.tile(jnp.array([torque, 0.0]), (30, 1))
        by = scene.with_engine(engine)
        course = mg.rollout(by, mg.initial_state(by), controls, measure_growth=True)
        return course.qpos[-1, 0], (course.growth, course.explodes)

    differentiated = jax.jit(jax.value_and_grad(swung, has_aux=True), static_argnums=1)
    by_c, by_mjx = (differentiated(0.1, engine) for engine in ("mujoco", "mjx"))
    np.testing.assert_allclose(by_c[0][1], by_mjx[0][1], rtol=1e-6)  # differences of 1e-6
    np.testing.assert_allclose(by_c[1], by_mjx[1], rtol=1e-6)
    assert not by_c[0][1][1]


def test_gaps_smaller_than_differences_do_not_multiply_derivatives():
    """A sphere slides along the floor, at a gap that is zero to rounding and that no joint can change.

    Rounding opens and closes it, so the motion has no differences: free, the sphere gains 1 s of a velocity, rubbed less.
    """
    scene = mg.load_scene("""<mujoco><option integrator="RK4" timestep="0.02"/><worldbody><geom type="plane" size="9 9 1"/>
      <body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/>
        <geom pos="0 0 .5" size=".5"/><geom type="box" pos=".6 0 .5" size=".5 .1 .1" contype="0" conaffinity="0"/></body>
      </worldbody></mujoco>""")

    def end(qvel):
        start = mg.initial_state(scene, qvel=qvel)
        course = mg.rollout(scene.with_engine("mujoco"), start, horizon=50, measure_growth=True)
        return course.qpos[-1], course.explodes

    gained, explodes = jax.jit(jax.jacfwd(end, has_aux=True))(jnp.array([0.3, -0.1, 0.2]))
    assert not explodes
    assert 0 < gained[0, 0] < 1


@pytest.mark.parametrize(("gap", "other", "softness"), [(3e-7, 1.0, 0.02), (-3e-7, 1.0, 0.02), (3e-7, -6e-7, 0.4)])
def test_differences_do_not_step_over_a_jump_that_is_no_contact_at_the_start(gap, other, softness):
    """Half a step of a fall at 1 m/s takes a stage of Runge-Kutta to a floor 1 mm below; differences of 1 µm have -3e4.

    With a second ball that begins to touch on the other side both sides have a jump.
    """
    xml = f"""<mujoco><option integrator="RK4"/><default><geom solref="{softness} 1"/></default><worldbody>
        <geom type="plane" size="1 1 .1"/><body pos="0 0 .1">
        <joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/><geom pos="1 0 {other}" size=".1" mass="1"/></body>
        </worldbody></mujoco>"""
    scene = mg.load_scene(xml)
    start = mg.initial_state(scene, qpos=jnp.array([1e-3 + gap]), qvel=-jnp.ones(1))
    found = mg.linearise(scene.with_engine("mujoco"), start, contact=mg.Discrete()).A
    model, ends = mujoco.MjModel.from_xml_string(xml), []
    for change in (1e-8, -1e-8):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = start.qpos[0] + change, -1.0
        mujoco.mj_step(model, data)
        ends.append(data.qvel[0])
    np.testing.assert_allclose(found[1, 0], (ends[0] - ends[1]) / 2e-8, rtol=1e-3)  # -2.3 and -4.9 1/s


def test_a_bottle_that_stands_on_a_table_is_turned_by_its_weight_and_not_by_which_points_touch():
    """The four points of its rim that touch are others after every turn, a jump of 3 mrad/s: differences of 1 µrad have 3000 1/s.

    It turns back as those of 1 mrad say, about which the contact is as it is, and fifty steps multiply nothing.
    """
    xml = """<mujoco><option timestep=".004" integrator="implicitfast" cone="elliptic"/><worldbody>
        <geom type="box" size=".5 .5 .02" pos="0 0 -.02"/>
        <body pos="0 .1 .08"><freejoint/><geom type="cylinder" size=".03 .08" mass=".25"/></body></worldbody></mujoco>"""
    scene = mg.load_scene(xml, engine="mujoco")
    model, data, product = scene.mj_model, mujoco.MjData(scene.mj_model), np.eye(12)

    @jax.jit
    def linearised(qpos, qvel):
        return mg.linearise(scene, mg.initial_state(scene, qpos, qvel), contact=mg.Discrete()).A

    for number in range(50):
        found = np.asarray(linearised(data.qpos.copy(), data.qvel.copy()))
        product = found @ product
        if number > 5:
            expected, _ = by_whole_steps(model, data.qpos, data.qvel, data.act, data.ctrl, width=1e-3)
            turns = (slice(9, 11), slice(3, 5))
            np.testing.assert_allclose(found[turns], expected[turns], atol=2 * np.abs(expected[turns]).max())
        mujoco.mj_step(model, data)
    assert np.abs(product).max() < 1e3  # 1/s


def test_a_step_is_differentiated_on_its_own_side_of_a_gap_smaller_than_differences():
    """A ball at 10 nm above the floor falls freely in a step; at 10 nm below it is pushed out."""
    scene = mg.load_scene("""<mujoco><worldbody><geom type="plane" size="9 9 1"/>
      <body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>""")

    def linearised(engine):
        by = scene.with_engine(engine)

        def of(gap):
            start = mg.initial_state(by, qpos=gap[None], qvel=jnp.array([-0.1]))
            return mg.linearise(by, start, contact=mg.Discrete()).A

        return jax.jit(of)

    by_mujoco, by_mjx = linearised("mujoco"), linearised("mjx")
    for gap in (1e-8, -1e-8):
        state, expected = by_mujoco(jnp.array(gap)), by_mjx(jnp.array(gap))
        # 4 µm from it, the impedance differs.
        np.testing.assert_allclose(state, expected, atol=1e-2 * np.abs(expected).max())
        assert (abs(state[1, 0]) < 1e-6) == (gap > 0)  # a force that pushes back


BELT = f"""<mujoco><option density="2" viscosity=".1" cone="elliptic" {_SOLVER}/><worldbody>
  <geom type="plane" size="5 5 .1" surfacevel=".2 0 0 0 0 0"/>
  <body pos="0 0 .0999"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
  <body pos="0 2 1"><joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body></worldbody>
  <actuator><motor joint="j" damping=".1"/></actuator></mujoco>"""


def test_what_a_search_for_contacts_leaves_is_not_divided_by_a_width():
    """A wheel rolls for a second on a box, whose edges a cylinder's are searched on. Its way is nearly its speed times a second.

    With contact points to MuJoCo's usual 1e-6 m the derivatives are 2.3, -1.0 and -1.3.
    """
    rubbing = 'condim="6" friction="1.5 .1 .01"'
    scene = mg.load_scene(
        f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
        <geom type="box" size="2 2 .1" pos="0 0 -.1" {rubbing}/><body pos="0 0 .35"><freejoint/>
        <geom type="cylinder" size=".35 .05" euler="90 0 0" mass="5" {rubbing}/></body></worldbody></mujoco>""",
        engine="mujoco",
    )

    def way(speed):
        start = mg.initial_state(scene, qvel=jnp.array([1.0, 0, 0, 0, 1 / 0.35, 0]) * speed)
        return mg.rollout(scene, start, horizon=200, contact=mg.Discrete()).qpos[-1, 0]

    speeds = jnp.array([0.9, 1.0, 1.1])
    ways, slopes = jax.jit(jax.vmap(jax.value_and_grad(way)))(speeds)
    np.testing.assert_allclose(slopes, (ways[2] - ways[0]) / 0.2, rtol=3e-3)  # it hardly curves: 0.9689 to 0.9694


@pytest.mark.parametrize("name", ["geom_surfacevel", "actuator_damping", "density", "impratio"])
def test_numbers_that_only_c_mujoco_has_are_changed_and_differentiated_by(name):
    """A belt that carries a box, and an arm in a medium; against C MuJoCo with the number set by hand, from a fresh MjData."""
    scene, steps, width = mg.load_scene(BELT), 40, 1e-5

    def by_hand(value):
        model = mujoco.MjModel.from_xml_string(BELT)
        holder = model if hasattr(model, name) else model.opt
        setattr(holder, name, value)
        data = mujoco.MjData(model)
        data.qvel[1], data.ctrl[:] = 0.3, 0.5
        mujoco.mj_step(model, data, steps)
        return data.qpos.copy()

    @jax.jit
    def ours(value):
        start = mg.initial_state(scene, qvel=jnp.zeros(7).at[1].set(0.3))
        return mg.rollout(scene.with_model(**{name: value}), start, jnp.full((steps, 1), 0.5)).qpos[-1]

    given = getattr(scene.mj_model if hasattr(scene.mj_model, name) else scene.mj_model.opt, name)
    given = np.array(given, float)
    change = np.zeros_like(given)
    change.flat[0] = 1.0
    np.testing.assert_allclose(ours(given + 0.1 * change), by_hand(given + 0.1 * change), atol=1e-12)
    expected = (by_hand(given + width * change) - by_hand(given - width * change)) / (2 * width)
    found = jax.jvp(ours, (jnp.asarray(given),), (jnp.asarray(change),))[1]
    assert np.abs(expected).max() > 1e-6
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_mjx_refuses_numbers_that_it_lacks():
    scene = mg.load_scene(scene_path("cartpole"))
    with pytest.raises(ValueError, match="MJX cannot change impratio: take scene"):
        scene.with_model(impratio=2.0)
    changed = scene.with_engine("mujoco").with_model(impratio=2.0)
    with pytest.raises(mg.scene.SceneError, match="with_model changed impratio, which MJX does not have"):
        changed.with_engine("mjx")
    assert changed.to_mujoco().opt.impratio == 2.0
