"""What `load_scene` takes, and what it says when it cannot."""

import jax
import mujoco
import numpy as np
import pytest

from mjxgrad.scene import SceneError, SceneWarning, load_scene

FALLING = """
<mujoco>
  <worldbody>
    <body name="b"><joint name="j" type="slide" axis="0 0 1"/><geom name="g" size="0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def falling_file(tmp_path):
    path = tmp_path / "falling.xml"
    path.write_text(FALLING)
    return path


def test_file_string_model_and_spec_give_the_same_scene(falling_file):
    model = mujoco.MjModel.from_xml_string(FALLING)
    spec = mujoco.MjSpec.from_string(FALLING)
    scenes = [load_scene(source) for source in (falling_file, str(falling_file), FALLING, model, spec)]
    for scene in scenes:
        assert scene.mj_model.nv == 1
        np.testing.assert_array_equal(scene.model.body_mass, model.body_mass)


def test_a_model_is_called_by_its_own_name_if_it_has_one():
    """Warnings begin with it, and a reader of several scenes' has to know which."""
    named = mujoco.MjModel.from_xml_string(FALLING.replace("<mujoco>", '<mujoco model="falling">'))
    assert load_scene(named).name == "falling"
    assert load_scene(mujoco.MjModel.from_xml_string(FALLING)).name == "the model"


def test_a_model_given_is_not_changed():
    model = mujoco.MjModel.from_xml_string(FALLING)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY.value
    scene = load_scene(model, timestep=0.25)
    assert model.opt.timestep == 0.002
    assert model.opt.enableflags
    assert scene.mj_model.opt.timestep == scene.model.opt.timestep == 0.25


def test_every_leaf_is_an_array_of_the_default_precision():
    scene = load_scene(FALLING)
    leaves = jax.tree.leaves((scene.model, scene.data))
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert scene.model.body_mass.dtype == scene.data.qpos.dtype == np.result_type(float)


def test_the_template_stands_at_the_reference_pose():
    scene = load_scene(FALLING.replace('axis="0 0 1"', 'axis="0 0 1" ref="0.7"'))
    np.testing.assert_allclose(scene.data.qpos, [0.7])


def test_malformed_mjcf_is_answered_in_the_words_of_mujoco(falling_file):
    falling_file.write_text(FALLING.replace('type="slide"', 'type="slyde"'))
    with pytest.raises(SceneError, match=r"falling\.xml must be MJCF .* says: .*slyde") as error:
        load_scene(falling_file)
    assert "\n" not in str(error.value)


def test_several_unsupported_features_are_named_at_once():
    source = FALLING.replace("<worldbody>", "<option integrator='implicit'/><worldbody>").replace(
        'name="g"', 'name="g" surfacevel="1 0 0 0 0 0"'
    )
    with pytest.raises(SceneError, match="for 2 reasons") as error:
        load_scene(source, engine="mjx")
    assert "integrator='implicit'" in str(error.value)
    assert "geom 'g'" in str(error.value)


def test_float32_asks_for_no_more_than_it_resolves():
    with jax.enable_x64(False):
        scene, kept = load_scene(FALLING), load_scene(FALLING, keep_everything=True)
        timestep = scene.to_mujoco().opt.timestep
    assert scene.data.qpos.dtype == np.float32
    np.testing.assert_allclose([scene.model.opt.tolerance, kept.model.opt.tolerance], [1e-6, 1e-8], rtol=1e-6)
    assert [conversion.what for conversion in scene.conversions] == ["tolerance"]
    # Digits that float32 has rounded, and nobody has changed, come back as they were.
    assert timestep == 0.002


def test_what_mujoco_warns_of_is_a_warning_and_no_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    noted = FALLING.replace("<worldbody>", "<custom><numeric name='note' data='nan'/></custom><worldbody>")
    with pytest.warns(SceneWarning, match="the MJCF: MuJoCo says: XML contains a 'NaN'"):
        load_scene(noted)
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is None


def test_names_in_another_encoding_are_refused(tmp_path):
    path = tmp_path / "latin.xml"
    path.write_bytes(b"<mujoco><worldbody><body name='b\xe9'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(SceneError, match=r"latin.xml must have names in UTF-8, got b'.xe9'; save"):
        load_scene(path)


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_single_precision_are_refused_there():
    heavy = "<mujoco><worldbody><body><freejoint/><geom size='.1' mass='1e300'/></body></worldbody></mujoco>"
    said = r"numbers up to 3e\+38 in single precision, got a larger one; set jax_enable_x64"
    with jax.enable_x64(False), pytest.raises(SceneError, match=said):
        load_scene(heavy)
    assert load_scene(heavy).mj_model.body_mass[1] == 1e300


def test_a_function_that_is_traced_may_load_its_scene():
    found = jax.jit(lambda times: times * load_scene(FALLING).model.opt.timestep)(2.0)
    np.testing.assert_allclose(found, 2 * load_scene(FALLING).model.opt.timestep)
