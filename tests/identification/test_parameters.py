"""Parameters: bounds as coordinates, makers that write what they say, and inertias as ten numbers."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import identification
from mjxgrad.bodies.spatial import rotation_matrix
from mjxgrad.identification import files
from mjxgrad.identification.parameters import (
    Coordinates,
    Parameter,
    body_fields,
    logarithms,
    pseudo_inertia,
    second_moments,
    write_all,
)
from mjxgrad.scene import SceneWarning

_SCENE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1" friction=".4"/>
  <body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping="2" armature=".3"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 .4" size=".03" mass=".5"/>
    <body name="ball" pos="0 0 .4"><joint name="slide" type="slide" axis="0 0 1" damping="1"/>
      <geom name="ball" size=".1" mass="2"/></body></body></worldbody>
  <actuator><motor name="motor" joint="hinge" gear="3"/>
    <position name="servo" joint="slide" kp="50" kv="4"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(_SCENE, keep_everything=True)


def test_the_search_begins_at_the_nominal_values_and_stays_within_the_bounds():
    """Between two bounds, above one, below one, without, on one."""
    inf = np.inf
    rows = [(1.0, -0.5, 3.0), (3.0, 1.0, inf), (-2.0, -inf, 1.0), (0.7, -inf, inf), (-0.5, -0.5, 3.5)]
    coordinates = Coordinates.of({str(i): Parameter(*row) for i, row in enumerate(rows)})
    values = coordinates.values(np.linspace(-3, 3, 61)[:, None].repeat(5, axis=1))
    np.testing.assert_allclose(values[30], [1.0, 3.0, -2.0, 0.7, -0.5])
    np.testing.assert_allclose(values[31] - values[30], 0.1 * np.array([3.5, 2.0, 3.0, 0.7, 4.0]))
    np.testing.assert_allclose(values[0], [-0.5, 1.0, -11.0, -1.4, -0.5])
    np.testing.assert_allclose(values[60], [3.0, 9.0, 1.0, 2.8, 3.5])
    np.testing.assert_array_equal(coordinates.is_at_bound(values[0]), [True, True, False, False, True])
    np.testing.assert_array_equal(coordinates.is_at_bound(values[60]), [True, False, True, False, True])


def test_numbers_of_one_sign_are_searched_by_their_logarithm():
    """The bounds are ends of the box, and the derivative is that of the exponential."""
    coordinates = Coordinates.of({"a": Parameter(2.0, 0.2, 20.0), "b": Parameter(-0.2, -0.3, -0.1)})
    low, high = coordinates.box()
    np.testing.assert_allclose([low, high], [[-np.log(10), -np.log(2)], [np.log(10), np.log(1.5)]])
    at = np.array([0.3, -0.2])
    found = coordinates.values(at)
    np.testing.assert_allclose(found, [2 * np.exp(0.3), -0.2 * np.exp(-0.2)])
    slope = (coordinates.values(at + 1e-6) - coordinates.values(at - 1e-6)) / 2e-6
    np.testing.assert_allclose(coordinates.rates(found), slope, rtol=1e-8)


def test_makers_write_what_they_say(scene):
    """Each of them at twice its nominal value, read from the model."""
    made = {
        "mass": identification.mass(scene, "ball"),
        "friction": identification.friction(scene, "floor/ball"),
        "damping": identification.damping(scene, "hinge"),
        "armature": identification.armature(scene, "hinge"),
        "gear": identification.gear(scene, "motor"),
        "gains": identification.gains(scene, "servo"),
        "zeta": identification.softness(scene, "damping_ratio"),
    }
    expected = {"mass": 2.0, "friction": 1.0, "damping": 2.0, "armature": 0.3, "gear": 3.0, "gains": [50.0, 4.0]}
    for name, value in expected.items():
        np.testing.assert_allclose(made[name].nominal, value, err_msg=name)
    units = {name: one.unit for name, one in made.items() if one.unit}
    assert units == {"mass": "kg", "damping": "N m s/rad", "armature": "kg m²"}
    changed = write_all(scene, made, {name: jnp.asarray(2 * one.nominal) for name, one in made.items()})
    before, after = scene.model, changed.model
    np.testing.assert_allclose(after.body_mass, [0, 0.5, 4])
    np.testing.assert_allclose(after.body_inertia[2], 2 * before.body_inertia[2])
    np.testing.assert_allclose(after.dof_damping, [4, 1])
    np.testing.assert_allclose(after.dof_armature, [0.6, 0])
    np.testing.assert_allclose(after.actuator_gear[:, 0], [6, 1])
    np.testing.assert_allclose(after.actuator_gainprm[1, 0], 100)
    np.testing.assert_allclose(after.actuator_biasprm[1, 1:3], [-100, -8])
    index = next(i for i, pair in enumerate(scene.pairs) if set(pair.names) == {"floor", "ball"})
    parameters, present = changed.contact_parameters(), scene.contact_parameters()
    np.testing.assert_allclose(parameters.friction[index, 0], 2)
    np.testing.assert_allclose(parameters.damping_ratio, 2 * present.damping_ratio)
    np.testing.assert_allclose(parameters.stiffness, present.stiffness)


def _random_body(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(12, 3)) * [0.1, 0.2, 0.3] + [0.05, -0.1, 0.2]
    weights = rng.uniform(0.1, 1, 12)
    homogeneous = np.column_stack([points, np.ones(12)])
    return homogeneous.T @ (weights[:, None] * homogeneous), points, weights


@pytest.mark.parametrize(
    ("kind", "gain"), [('velocity kv="5"', 5.0), ('motor gear="2"', 1.0), ('general gainprm="3"', 3.0)]
)
def test_the_gain_of_an_actuator_that_is_no_position_servo_is_where_the_file_has_it(kind, gain):
    """MuJoCo's own compiler says where twice the gain stands."""
    file = f"""<mujoco><worldbody><body><joint name="j"/><geom size=".1" pos=".1 0 0"/></body></worldbody>
        <actuator><{kind} name="a" joint="j"/></actuator></mujoco>"""
    scene = mg.load_scene(file, keep_everything=True)
    parameter = identification.gains(scene, "a")
    np.testing.assert_allclose(np.ravel(parameter.nominal), [gain])
    found = scene.with_model(**parameter.write(scene.model, jnp.asarray(2 * parameter.nominal))).model
    twice = f'kv="{2 * gain}"' if "kv" in kind else f'gainprm="{2 * gain}"'
    asked = file.replace('kv="5"', twice).replace('gainprm="3"', twice).replace("motor", f"general {twice}")
    expected = mujoco.MjModel.from_xml_string(asked)
    np.testing.assert_allclose(found.actuator_gainprm, expected.actuator_gainprm)
    np.testing.assert_allclose(found.actuator_biasprm, expected.actuator_biasprm)


def test_gains_of_several_actuators_are_common_and_of_one_kind():
    scene = mg.load_scene("""<mujoco><worldbody><body><joint name="j"/><geom size=".1" pos=".1 0 0"/></body></worldbody><actuator>
        <position name="a" joint="j" kp="3" kv="1"/><motor name="b" joint="j"/><position name="c" joint="j" kp="4" kv="2"/>
        </actuator></mujoco>""")
    parameter = files.parameter(scene, "gains:a,c")
    np.testing.assert_allclose(parameter.nominal, [3.0, 1.0])
    found = parameter.write(scene.model, jnp.array([5.0, 6.0]))
    np.testing.assert_allclose(found["actuator_gainprm"][:, 0], [5, 1, 5])
    np.testing.assert_allclose(found["actuator_biasprm"][:, 1:3], [[-5, -6], [0, 0], [-5, -6]])
    with pytest.raises(ValueError, match="gains must be of actuators of one kind, got a and b"):
        identification.gains(scene, "a", "b")
    with pytest.raises(ValueError, match="inertia takes one name"):
        files.parameter(scene, "inertia:world,other")


def test_gains_of_what_is_no_servo_are_refused():
    scene = mg.load_scene(
        """<mujoco><worldbody><body><joint name="j"/><geom size=".1" pos=".1 0 0"/></body></worldbody><actuator>
        <general name="a" joint="j" gainprm="3" biastype="affine" biasprm="1 -2 -3"/></actuator></mujoco>"""
    )
    with pytest.raises(ValueError, match="gains must be of a position or velocity servo or a motor"):
        identification.gains(scene, "a")


def test_a_pseudo_inertia_comes_back_from_its_ten_numbers_and_from_mujocos_fields():
    """Second moments of twelve points of mass, by definition."""
    pseudo, points, weights = _random_body(0)
    numbers = logarithms(pseudo)
    np.testing.assert_allclose(pseudo_inertia(jnp.asarray(numbers)), pseudo, rtol=1e-12)
    np.testing.assert_allclose(np.exp(2 * numbers[0]), weights.sum())
    np.testing.assert_allclose(numbers[7:], weights @ points / weights.sum())
    fields = [np.asarray(x, float) for x in body_fields(jnp.asarray(pseudo)).values()]
    np.testing.assert_allclose(second_moments(*fields), pseudo, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("body", ["irregular", "ball"])
def test_the_derivative_by_ten_numbers_is_that_of_the_tensor(body):
    """A ball has equal moments, whose axes have no derivative; there and back the tensor has one, the identity."""
    ball = np.diag([0.02, 0.02, 0.02, 3.0])
    start = logarithms(_random_body(1)[0] if body == "irregular" else ball)

    def there_and_back(numbers):
        fields = body_fields(pseudo_inertia(numbers))
        rotation = rotation_matrix(fields["body_iquat"][None])[0]
        about = rotation @ jnp.diag(jnp.sum(fields["body_inertia"]) / 2 - fields["body_inertia"]) @ rotation.T
        offset = jnp.append(fields["body_ipos"], 1.0)
        return fields["body_mass"] * jnp.outer(offset, offset) + jnp.pad(about, (0, 1))

    found, expected = (jax.jit(jax.jacfwd(f))(jnp.asarray(start)) for f in (there_and_back, pseudo_inertia))
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_the_inertia_of_a_body_begins_where_the_model_is(scene):
    """The motion is that of the scene, to the share by which principal moments are kept apart (1.5e-8)."""
    parameter = identification.inertia(scene, "ball")
    changed = write_all(scene, {"ball": parameter}, {"ball": jnp.asarray(parameter.nominal)})
    for name in ("body_mass", "body_ipos", "body_inertia", "dof_M0"):
        np.testing.assert_allclose(
            getattr(changed.model, name), getattr(scene.model, name), rtol=1e-6, atol=1e-9, err_msg=name
        )


def test_contacts_that_differ_and_become_alike_are_told():
    scene = mg.load_scene("""<mujoco><worldbody><geom name="table" type="plane" size="1 1 .1" friction=".8"/>
      <body pos="0 0 .1"><freejoint/><geom name="cup" size=".1" friction=".5"/></body>
      <body pos="0 .3 .1"><freejoint/><geom name="finger" size=".1"/></body></worldbody></mujoco>""")
    told = r"the MJCF: friction of table – cup \+ 2 more is from 0.8 to 1, and becomes one number: name the pairs that share one"
    with pytest.warns(SceneWarning, match=told):
        identification.friction(scene, geoms=("table", "cup"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identification.friction(scene, pairs=(("table", "cup"),))
