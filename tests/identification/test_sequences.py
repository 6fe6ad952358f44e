"""Problems of mujoco.sysid: the same answer and intervals, whatever a parameter's piece of Python does to the spec."""

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import pytest

from mjxgrad import identification, load_scene
from mjxgrad.identification.inertia import pseudo_inertia
from mjxgrad.identification.parameters import Coordinates
from mjxgrad.identification.sequences import _CompiledFields

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):
    pytest.skip("mujoco[sysid] is not installed", allow_module_level=True)

_ARM = """<mujoco><option timestep=".004"><flag contact="disable"/></option><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".3"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04" mass="1"/>
    <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0"/>
      <geom name="lower" type="box" size=".1 .03 .02" pos=".1 0 0" mass=".5"/>
    </body></body></worldbody>
  <actuator><motor name="motor" joint="shoulder"/></actuator>
  <sensor><jointpos name="shoulder" joint="shoulder"/><jointvel name="speed" joint="elbow"/></sensor></mujoco>"""


def _recorded(noise):
    """Half a second of the arm, sensors and the elbow's angle, as mujoco.sysid keeps them."""
    spec = mujoco.MjSpec.from_string(_ARM)
    model = spec.compile()
    times = model.opt.timestep * np.arange(125)
    controls = (3 * np.sin(12 * times))[:, None]
    start = sysid.create_initial_state(model, np.array([0.3, 0.4]), np.array([0.5, 0]))
    states, sensors = mujoco.rollout.rollout(model, mujoco.MjData(model), start, controls[:-1])
    data = np.column_stack([sensors[0], states[0, :, 2]])
    data = data + noise * np.random.default_rng(0).normal(size=data.shape)
    names = ["shoulder", "speed", ("elbow_qpos", sysid.SignalType.MjStateQPos)]
    measured = sysid.TimeSeries.from_names(states[0, :, 0], data, model, names)
    return sysid.ModelSequences("arm", spec, "swing", start, sysid.TimeSeries(times, controls), measured, True)


def _parameters(spec):
    """A damping that begins at its bound, a length that moves masses, sites and inertias, and ten numbers of a body."""

    def stretch(spec, parameter):
        spec.geom("lower").size[0] = parameter.value[0] / 2
        spec.geom("lower").pos[0] = parameter.value[0] / 2

    def damp(spec, parameter):
        spec.joint("shoulder").damping[0] = parameter.value[0]

    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("damping", 0.3, 0.0, 1.0, modifier=damp))
    parameters.add(sysid.Parameter("length", 0.2, 0.1, 0.4, modifier=stretch))
    parameters.add(sysid.Parameter("frozen", 1.0, 0.5, 2.0, frozen=True))
    parameters["damping"].value[:] = 0.0
    parameters["length"].value[:] = 0.25
    return parameters


def test_the_answer_and_its_intervals_are_those_of_mujoco_sysid(tmp_path):
    """To what its finite differences and both searches' tolerances leave: a hundredth of an interval."""
    sequence = _recorded(noise=0.01)
    parameters = _parameters(sequence.spec)
    before = sequence.spec.to_xml()
    found, result = identification.identify_sequences(parameters, [sequence], onset=None)
    assert sequence.spec.to_xml() == before
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    expected, theirs = sysid.optimize(parameters, residual, verbose=False)
    left, _, _ = residual(theirs.x, expected, return_pred_all=True)
    _, half_width = sysid.calculate_intervals(left, theirs.jac)
    np.testing.assert_allclose(found.as_vector(), expected.as_vector(), atol=0.01 * half_width.min())
    np.testing.assert_allclose(np.concatenate(list(result.half_width.values())), half_width, rtol=1e-3)
    np.testing.assert_allclose(
        result.rms[1] * np.sqrt(result.num_numbers), np.sqrt(sum((r**2).sum() for r in left)), rtol=1e-6
    )
    np.testing.assert_array_equal(parameters["damping"].value, 0.0)
    result.save(tmp_path / "found.yaml")
    loaded = sysid.ParameterDict.load_from_disk(tmp_path / "found.yaml")
    np.testing.assert_array_equal(loaded.as_vector(), found.as_vector())
    np.testing.assert_array_equal(loaded["length"].max_value, [0.4])


@pytest.mark.slow
def test_armatures_of_an_arm_of_five_joints_are_found_to_the_intervals_of_mujoco_sysid():
    """As in its tutorial: all begin at 0.01, sensors are noisy, and torques drive the joints."""
    links = "".join(
        f"<body name='{i}' pos='{0.2 * (i > 0)} 0 0'><joint name='{i}' axis='{i % 2} {1 - i % 2} 0' damping='1'"
        f" armature='{0.5 - 0.1 * i}'/><geom type='capsule' fromto='0 0 0 .2 0 0' size='.03' mass='.8'/>"
        for i in range(5)
    )
    motors, sensors = (
        "".join(f"<{kind} name='{kind}{i}' joint='{i}'/>" for i in range(5)) for kind in ("motor", "jointpos")
    )
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><option timestep='.004'><flag contact='disable'/></option><worldbody>{links}{'</body>' * 5}</worldbody>"
        f"<actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"
    )
    model, rng = spec.compile(), np.random.default_rng(0)
    times = model.opt.timestep * np.arange(250)
    controls = (5 - np.arange(5)) * np.sin(times[:, None] * rng.uniform(3, 8, 5) + np.arange(5))
    start = sysid.create_initial_state(model, np.zeros(5), np.zeros(5))
    states, recorded = mujoco.rollout.rollout(model, mujoco.MjData(model), start, controls[:-1])
    noisy = recorded[0] + 0.05 * rng.normal(size=recorded[0].shape)
    measured = sysid.TimeSeries.from_names(states[0, :, 0], noisy, model)
    sequence = sysid.ModelSequences("arm", spec, "swing", start, sysid.TimeSeries(times, controls), measured, True)
    parameters = sysid.ParameterDict()
    for i in range(5):

        def set_armature(spec, parameter, joint=str(i)):
            spec.joint(joint).armature = parameter.value[0]

        parameters.add(sysid.Parameter(f"armature{i}", 0.5 - 0.1 * i, 0.01, 0.8, modifier=set_armature))
        parameters[f"armature{i}"].value[:] = 0.01
    found, result = identification.identify_sequences(parameters, [sequence], onset=None)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    expected, theirs = sysid.optimize(parameters, residual, verbose=False)
    left, _, _ = residual(theirs.x, expected, return_pred_all=True)
    _, half_width = sysid.calculate_intervals(left, theirs.jac)
    np.testing.assert_allclose(found.as_vector(), expected.as_vector(), atol=0.01 * half_width.min())
    np.testing.assert_allclose(np.concatenate(list(result.half_width.values())), half_width, rtol=1e-3)
    # Twice the 95 % interval: one of 10 000 is beyond it by chance.
    assert (np.abs(found.as_vector() - 0.5 + 0.1 * np.arange(5)) < 2 * half_width).all()


def test_the_derivative_through_the_compiler_is_that_of_recompiled_models():
    """What follows from ten numbers of a body whose axes the compiler reorders, against C MuJoCo, recompiled."""

    def set_body(spec, parameter):
        pseudo = np.asarray(pseudo_inertia(jnp.asarray(parameter.value)))
        body, centre = spec.body("lower"), pseudo[:3, 3] / pseudo[3, 3]
        spread = pseudo[:3, :3] - pseudo[3, 3] * np.outer(centre, centre)
        full = np.trace(spread) * np.eye(3) - spread
        body.explicitinertial, body.mass, body.ipos = True, pseudo[3, 3], centre
        body.fullinertia = [full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]]

    spec = mujoco.MjSpec.from_string(_ARM)
    start = identification.inertia(load_scene(spec.compile()), "lower")
    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("lower", start.nominal, start.lower, start.upper, modifier=set_body))
    fields = _CompiledFields(parameters, spec, Coordinates.of({"lower": start}), sysid.apply_param_modifiers)
    scene = load_scene(fields.inside)
    fields.choose(scene)
    at = start.nominal + 0.01 * np.arange(10)
    numbers = fields.at(at)

    def kept(vector):
        model = fields.put(scene, vector, numbers).model
        return jnp.concatenate([model.dof_M0, model.dof_invweight0, model.body_subtreemass])

    def recompiled(vector):
        parameters.update_from_vector(vector)
        model = sysid.apply_param_modifiers(parameters, spec.copy())
        return np.concatenate([model.dof_M0, model.dof_invweight0, model.body_subtreemass])

    np.testing.assert_allclose(jax.jit(kept)(jnp.asarray(at)), recompiled(at), rtol=1e-6)
    found = jax.jit(jax.jacfwd(kept))(jnp.asarray(at))
    steps = 1e-5 * np.eye(10)
    expected = np.stack([(recompiled(at + s) - recompiled(at - s)) / 2e-5 for s in steps], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_what_a_parameter_may_not_change_is_named():
    sequence = _recorded(noise=0.0)

    def disable(spec, parameter):
        spec.geom("lower").condim = 1 if parameter.value[0] < 0.45 else 3

    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("switch", 0.1, 0.0, 1.0, modifier=disable))
    with pytest.raises(ValueError, match="parameters must change numbers alone, got one that changes geom_condim"):
        identification.identify_sequences(parameters, [sequence])


def test_a_signal_without_a_name_is_refused_with_the_remedy():
    sequence = _recorded(noise=0.0)
    mapping = sequence.sensordata[0].signal_mapping
    mapping[None] = mapping.pop("speed")
    with pytest.raises(ValueError, match="name the sensors in the MJCF"):
        identification.identify_sequences(_parameters(sequence.spec), [sequence])
