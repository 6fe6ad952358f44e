"""Derivatives of C MuJoCo along a few parameters, each of which moves several numbers of the model."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjxgrad as mg
from mjxgrad.engines.jacobians import _derivative
from mjxgrad.engines.pool import Pool

# A box slides to a wall, pushed by a servo; its mass has inertia and derived constants with it.
BOX = """<mujoco><option timestep=".004" cone="elliptic" tolerance="1e-14" iterations="200"/>
  <default><geom friction=".1"/></default><worldbody>
  <geom name="floor" type="plane" size="2 2 .1"/><geom name="wall" type="box" pos=".2 0 .1" size=".02 .3 .1"/>
  <body name="box" pos="0 0 .0998"><freejoint/><geom name="box" type="box" size=".1 .1 .1" mass="1"/></body>
  <body name="pusher" pos="-.3 0 .1"><joint name="p" type="slide" axis="1 0 0" damping="1"/><geom size=".05" mass=".5"/>
  </body></worldbody>
  <actuator><position name="servo" joint="p" kp="200"/></actuator><sensor><actuatorfrc actuator="servo"/></sensor></mujoco>"""
STEPS, GIVEN = 40, {"mass": np.log(1.3), "friction": 0.4, "wall": 0.2, "gain": 1.1}


def changed(scene, at):
    """By the logarithm of a mass, a friction above the others', the place of a wall, and a factor of a servo."""
    model, mass = scene.model, jnp.exp(at["mass"])
    return scene.with_model(
        body_mass=model.body_mass.at[1].multiply(mass),
        body_inertia=model.body_inertia.at[1].multiply(mass),
        geom_friction=model.geom_friction.at[2, 0].set(at["friction"]),
        geom_pos=model.geom_pos.at[1, 0].set(at["wall"]),
        actuator_gainprm=model.actuator_gainprm * at["gain"],
        actuator_biasprm=model.actuator_biasprm * at["gain"],
    )


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(BOX, engine="mujoco")


def ended(scene, contact):
    """Return where the box and the pusher end, after a push."""
    state = mg.initial_state(scene, qvel=jnp.zeros(7).at[0].set(1.0).at[5].set(0.3))
    return mg.rollout(scene, state, jnp.full((STEPS, 1), 0.3), contact=contact).qpos[-1]


def by_hand(at):
    model = mujoco.MjModel.from_xml_string(BOX)
    model.body_mass[1] *= np.exp(at["mass"])
    model.body_inertia[1] *= np.exp(at["mass"])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.geom_friction[2, 0], model.geom_pos[1, 0] = at["friction"], at["wall"]
    model.actuator_gainprm *= at["gain"]
    model.actuator_biasprm *= at["gain"]
    data = mujoco.MjData(model)
    data.qvel[[0, 5]], data.ctrl[:] = (1.0, 0.3), 0.3
    mujoco.mj_step(model, data, STEPS)
    return data.qpos.copy()


def test_they_are_the_differences_of_whole_motions_in_c_mujoco(scene):
    """From a fresh MjData each; the place of the wall decides when it is hit, in a jump, and so is left to the next test."""
    start = {name: jnp.asarray(value) for name, value in GIVEN.items()}
    run = jax.jit(lambda at: ended(scene.with_parameters(changed, at), mg.Discrete()))
    assert_allclose(run(start), by_hand(GIVEN), atol=1e-10)
    found = jax.jit(jax.jacrev(lambda at: ended(scene.with_parameters(changed, at), mg.Discrete())))(start)
    for name in ("mass", "friction", "gain"):
        ends = [by_hand(GIVEN | {name: GIVEN[name] + side * 1e-6}) for side in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-6
        assert np.abs(expected).max() > 1e-4
        assert_allclose(found[name], expected, atol=2e-5 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize(
    ("contact", "error"),
    [(mg.Discrete(), "double"), (mg.Slope(), "double"), (mg.Slope(), "single")],
    ids=["discrete", "slope", "slope in single precision"],
)
def test_they_are_those_by_every_entry_and_take_one_column_each(scene, contact, error, monkeypatch):
    """Of the same model by `with_model` alone, a column each in place of one per entry; both modes, and of a batch."""
    asked = []
    found_by = Pool._found  # what `maps` calls; programs that were compiled before keep that
    monkeypatch.setattr(Pool, "_found", lambda *a, **k: asked.append(found_by(*a, **k)) or asked[-1])

    def gradients(one):
        start = {name: jnp.asarray(value, float) for name, value in GIVEN.items()}
        weights = jnp.arange(1.0, 9.0)
        along = lambda at: ended(one.with_parameters(changed, at), contact) @ weights  # noqa: E731
        every = lambda at: ended(changed(one, at), contact) @ weights  # noqa: E731
        found = [jax.jit(jax.grad(function))(start) for function in (along, every)]
        both = {name: jnp.stack([value, value * 1.01]) for name, value in start.items()}
        many = jax.jit(jax.vmap(jax.grad(along)))(both)
        forward = jax.jit(jax.jacfwd(along))(start)
        return jax.tree.map(np.asarray, (*found, jax.tree.map(lambda x: x[0], many), forward))

    if error == "single":
        with jax.enable_x64(False):
            found, expected, many, forward = gradients(mg.load_scene(BOX, engine="mujoco"))
    else:
        found, expected, many, forward = gradients(scene)
    # Single precision rounds numbers by 6e-8 of their size, and positions by a nanometre where contacts are edges.
    size, close = max(map(np.abs, expected.values())), 1e-7 if error == "double" else 2e-3
    for other in (found, many, forward):
        for name, value in expected.items():
            assert_allclose(other[name], value, atol=close * size, err_msg=name)
    along = [one for one in asked if "parameters" in one]
    assert along[0]["parameters"].shape[-2:] == (14, len(GIVEN))
    assert not {"body_mass", "dof_invweight0", "geom_friction"} & along[0].keys()


def test_what_is_replaced_afterwards_has_its_own_derivative(scene):
    """Friction is doubled after the change, so its derivative is twice that at the double."""

    def doubled(at):
        one = scene.with_parameters(changed, at)
        return ended(one.with_model(geom_friction=2 * one.model.geom_friction), mg.Discrete())[0]

    def once(at):
        return ended(scene.with_parameters(changed, at), mg.Discrete())[0]

    start = {name: jnp.asarray(value) for name, value in GIVEN.items()}
    found = jax.jit(jax.grad(doubled))(start)
    expected = jax.jit(jax.grad(once))(start | {"friction": 2 * start["friction"]})
    assert_allclose(found["friction"], 2 * expected["friction"], rtol=1e-6)
    assert_allclose(found["mass"], expected["mass"], rtol=1e-6)


def test_readings_and_costs_of_the_model_have_theirs_too(scene):
    """A servo's force is its gain times what it is off; and a cost may read the model itself."""

    def read(at):
        one = scene.with_parameters(changed, at)
        state = mg.initial_state(one)
        observe = lambda model, data: data.sensordata[0]  # noqa: E731
        seen = mg.rollout(one, state, jnp.full((1, 1), 0.3), observe=observe).observations
        return seen[0], one.model.body_mass[1]

    start = {name: jnp.asarray(value) for name, value in GIVEN.items()}
    force, mass = jax.jit(jax.jacrev(read))(start)
    assert_allclose(force["gain"], 200 * 0.3, rtol=1e-6)
    assert_allclose(force["mass"], 0, atol=1e-6)
    assert_allclose(mass["mass"], np.exp(GIVEN["mass"]), rtol=1e-6)


def test_mjx_has_the_same(scene):
    """Reverse mode takes all entries at once there."""
    start = {name: jnp.asarray(value) for name, value in GIVEN.items() if name != "wall"}
    mjx = mg.load_scene(BOX)

    def end(one, at):
        far = one.with_parameters(lambda scene, at: changed(scene, at | {"wall": 0.5}), at)
        state = mg.initial_state(one, qvel=jnp.zeros(7).at[0].set(1.0))
        return mg.rollout(far, state, jnp.full((4, 1), 0.3)).qpos[-1] @ jnp.arange(8.0)

    found, expected = (jax.jit(jax.grad(lambda at, one=one: end(one, at)))(start) for one in (mjx, scene))
    for name in start:
        assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "values", "told"),
    [
        (lambda scene: scene, 1.0, "change must be a function of scene and values"),
        (lambda scene, values: None, 1.0, "what change returns must be a scene, by scene.with_model"),
        (changed, {"mass": "heavy"}, "values must be real numbers, got str"),
        (
            lambda scene, x: scene.with_model(body_mas=x),
            1.0,
            "with_model must name arrays of numbers of the model, got body_mas",
        ),
    ],
)
def test_what_is_wrong_is_said(scene, change, values, told):
    with pytest.raises(ValueError, match=told):
        scene.with_parameters(change, values)


SLIDE = """<mujoco><option tolerance="1e-14" iterations="200"/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .1">
  <joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("gap", [1e-6, 3e-7, 1e-8, 0.0, -1e-8, -1e-7, -1e-6])
def test_a_contact_that_is_about_to_begin_or_has_just_begun_stays_as_it_is(gap):
    """Where a body is in the file and a radius move the gap as the joint does, whose differences are far narrower."""
    scene = mg.load_scene(SLIDE, engine="mujoco")

    def speed(place, size, joint):
        model = scene.model
        changed = scene.with_model(
            body_pos=model.body_pos.at[1, 2].add(place), geom_size=model.geom_size.at[1, 0].add(size)
        )
        state = mg.initial_state(changed, qpos=joint[None] + gap, qvel=jnp.array([-0.5]))
        return mg.rollout(changed, state, horizon=1).qvel[-1, 0]

    place, size, joint = jax.grad(speed, (0, 1, 2))(*jnp.zeros(3))
    assert abs(joint) < 10
    assert_allclose([place, -size], 2 * [joint], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("at", [0.3, -0.3, 0.0])
def test_of_a_number_whose_difference_meets_a_jump_or_a_bend_its_own_side_counts(at):
    """A force that jumps, or bends, 0.3 of the difference's width to one side; where it jumps at once, the other side counts."""
    beyond = lambda x: 1e-6 * at < x  # noqa: E731
    forces = (lambda x: 2 * x + 1.0 * beyond(x), lambda x: 2 * x + 5 * (x - 1e-6 * at) * beyond(x))
    slopes = [_derivative(lambda x, f=f: np.array([f(x)]), np.array([f(0.0)]), 1e-6, is_zero=False) for f in forces]
    assert slopes[0] == pytest.approx(2, rel=1e-6)
    assert slopes[1] == pytest.approx({0.3: 2, -0.3: 7, 0.0: 4.5}[at], rel=1e-6)
