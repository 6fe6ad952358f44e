"""Effective contact parameters, against C MuJoCo."""

import jax
import mujoco
import numpy as np
import pytest

from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene import load_scene

# Every ball touches the floor: mixing, a share of solmix, none at all, priority of either side,
# the direct format, both formats together, and an explicit pair.
FLOOR = (
    'type="plane" size="1 1 .1" solref="0.04 0.8" solimp="0.8 0.9 0.003 0.4 3" friction="0.6 0.02 0.003" margin="0.001"'
)
GEOMS = {
    "plain": "",
    "mixed": 'solmix="3" solref="0.03 1.5" solimp="0.5 0.7 0.01 0.5 2" friction="0.4 0.03 0.001"',
    "weightless": 'solmix="0" solref="0.03 1.5" solimp="0.5 0.7 0.01 0.5 2"',
    "winner": 'priority="2" solref="0.03 1.5" solimp="0.5 0.7 0.01 0.5 2" friction="0.1 0 0" condim="6" margin="0.002"',
    "loser": 'priority="-1" solref="0.03 1.5" solimp="0.5 0.7 0.01 0.5 2" friction="3 0 0"',
    "direct": 'solref="-3000 -70" solimp="0.5 0.7 0.01 0.5 2"',
    "clamped": 'priority="1" solref="0.001 1" solimp="0 1.5 0.002 0.5 2"',
    "explicit": 'solref="0.9 1" friction="9 9 9"',
}
PAIR = (
    '<contact><pair geom1="explicit" geom2="floor" solref="0.05 0.7" solimp="0.3 0.6 0.02 0.5 2" '
    'friction="0.5 0.4 0.01 0.001 0.002" margin="0.003" condim="4"/></contact>'
)


def _balls(option=""):
    bodies = "".join(
        f'<body pos="{i} 0 0.095"><freejoint/><geom name="{name}" size="0.1" {attributes}/></body>'
        for i, (name, attributes) in enumerate(GEOMS.items())
    )
    return (
        f'<mujoco><option timestep="0.004" {option}/><worldbody><geom name="floor" {FLOOR}/>'
        f"{bodies}</worldbody>{PAIR}</mujoco>"
    )


@pytest.fixture(scope="module")
def scene():
    return load_scene(_balls())


@pytest.fixture(scope="module")
def touching(scene):
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    return data


@pytest.mark.parametrize("name", GEOMS)
def test_parameters_are_those_that_c_mujoco_gives_its_contacts_and_their_rows(scene, touching, name):
    geom = scene.mj_model.geom(name).id
    contact = next(c for c in touching.contact if geom in c.geom)
    row = next(i for i, pair in enumerate(scene.pairs) if name in pair.names and "floor" in pair.names)
    ours = jax.tree.map(np.asarray, scene.contact_parameters())
    assert scene.pairs[row].condim == contact.dim
    np.testing.assert_allclose(ours.solref[row], contact.solref, rtol=1e-12)
    np.testing.assert_allclose(ours.solimp[row], contact.solimp, rtol=1e-12)
    np.testing.assert_allclose(ours.friction[row], contact.friction, rtol=1e-12)
    np.testing.assert_allclose(ours.margin[row], contact.includemargin, rtol=1e-12)
    stiffness, damping, _, _ = touching.efc_KBIP[contact.efc_address]
    width = ours.impedance[row, 1]
    # K = k / dw² and B = b / dw.
    np.testing.assert_allclose(ours.stiffness[row] / width**2, stiffness, rtol=1e-12)
    np.testing.assert_allclose(ours.damping[row] / width, damping, rtol=1e-12)


def test_refsafe_can_be_off(touching):
    free = load_scene(_balls().replace("/><worldbody>", '><flag refsafe="disable"/></option><worldbody>', 1))
    row = next(i for i, pair in enumerate(free.pairs) if "clamped" in pair.names)
    # k = 1 / (tc ζ)² with tc = 0.001 and ζ = 1.
    np.testing.assert_allclose(free.contact_parameters().stiffness[row], 1e6, rtol=1e-12)


def test_an_unnamed_geom_is_called_by_its_body():
    source = (
        '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="cart">'
        '<freejoint/><geom size="1"/><geom size="1"/></body></worldbody></mujoco>'
    )
    assert [pair.names[1] for pair in load_scene(source).pairs] == ["cart[0]", "cart[1]"]


def test_without_contact_there_are_no_pairs():
    for flag in ("contact", "constraint"):
        source = _balls().replace("/><worldbody>", f'><flag {flag}="disable"/></option><worldbody>', 1)
        assert contact_pairs(mujoco.MjModel.from_xml_string(source)) == ()


def test_a_time_constant_below_two_steps_is_warned_about():
    source = _balls().replace('solref="0.001 1"', 'solref="{} 1"').replace("0.004", "0.002")
    with pytest.warns(UserWarning, match=r"0\.001 s is below two time steps.*0\.004 s"):
        scene = load_scene(source.format("0.001"))
    assert len(scene.warnings()) == 1
    assert load_scene(source.format("0.004")).warnings() == []
