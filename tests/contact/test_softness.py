"""The knob does what it says, on every pair, whatever the scene had before."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad.contact import Softness
from mjxgrad.scene import SceneWarning, load_scene

# Nothing alike: formats, priorities, weights and an explicit pair.
BALLS = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" solref="0.04 0.8"/>
    <body pos="0 0 0.095"><freejoint/><geom name="one" size="0.1" solmix="3" {one}/></body>
    <body pos="1 0 0.095"><freejoint/><geom name="two" size="0.1" {two}/></body>
    <body pos="2 0 0.095"><freejoint/><geom name="three" size="0.1" solref="0.9 1"/></body>
  </worldbody>
  <contact>
    <pair geom1="three" geom2="floor" solref="0.05 0.7"/>
    <pair geom1="three" geom2="one"/>
    <pair geom1="three" geom2="two"/>
  </contact>
</mujoco>
"""
EQUAL = BALLS.format(one='solref="0.04 0.8"', two='solref="0.04 0.8"')
NO_CONTACT = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"


@pytest.fixture(scope="module")
def unequal():
    return load_scene(BALLS.format(one='solref="-3000 -70"', two='priority="1" solref="0.03 1.5"'))


@pytest.fixture(scope="module")
def equal():
    return load_scene(EQUAL)


def _row(scene, *names):
    return next(i for i, pair in enumerate(scene.pairs) if set(pair.names) == set(names))


def test_every_pair_gets_the_values_asked_for_as_c_mujoco_sees(unequal):
    softer = unequal.with_softness(Softness(stiffness=900, damping_ratio=0.7, impedance=(0.3, 0.6), width=0.02))
    got, model = softer.contact_parameters(), softer.to_mujoco()
    np.testing.assert_allclose(got.stiffness, 900, rtol=1e-12)
    # b = 2ζ√k
    np.testing.assert_allclose(got.damping, 2 * 0.7 * 30, rtol=1e-12)
    np.testing.assert_allclose(got.impedance, [[0.3, 0.6]] * len(unequal.pairs), rtol=1e-12)
    np.testing.assert_allclose(got.width, 0.02, rtol=1e-12)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 3
    for contact in data.contact:
        stiffness, damping, _, _ = data.efc_KBIP[contact.efc_address]
        # K = k / dw², B = b / dw
        np.testing.assert_allclose([stiffness, damping], [900 / 0.36, 42 / 0.6], rtol=1e-12)
        np.testing.assert_allclose(contact.solimp[:3], [0.3, 0.6, 0.02], rtol=1e-12)


def test_refsafe_leaves_softness_alone(unequal):
    # 1 / (tc ζ)² = 10000 needs tc = 0.01; k = 40000 would need 0.005 s, below 2h = 0.008 s.
    got = unequal.with_softness(Softness(stiffness=4e4, damping_ratio=1)).contact_parameters()
    np.testing.assert_allclose(got.stiffness, 4e4, rtol=1e-12)


def test_nothing_given_changes_nothing(unequal):
    assert eqx.tree_equal(unequal.with_softness(Softness()).model, unequal.model)


def test_stiffness_alone_keeps_the_damping_ratio(equal):
    subset = Softness(stiffness=50.0, pairs=(("three", "floor"),))
    row = _row(equal, "three", "floor")
    after = equal.with_softness(subset).contact_parameters()
    np.testing.assert_allclose(after.stiffness[row], 50.0, rtol=1e-12)
    np.testing.assert_allclose(after.damping_ratio[row], 0.7, rtol=1e-12)


def test_damping_ratio_alone_keeps_the_stiffness_even_where_refsafe_had_clamped_it():
    source = EQUAL.replace('<pair geom1="three" geom2="floor" solref="0.05 0.7"/>',
                           '<pair geom1="three" geom2="floor" solref="0.001 1"/>')  # fmt: skip
    with pytest.warns(SceneWarning, match="refsafe"):
        scene = load_scene(source)
    row = _row(scene, "three", "floor")
    subset = Softness(damping_ratio=0.25, pairs=(("three", "floor"),))
    after = scene.with_softness(subset).contact_parameters()
    # tc = 2h = 0.008, so k = 1 / 0.008².
    np.testing.assert_allclose(after.stiffness[row], 0.008**-2, rtol=1e-12)
    np.testing.assert_allclose(after.damping_ratio[row], 0.25, rtol=1e-12)


def test_a_value_to_be_kept_must_be_the_same_around_a_shared_geom():
    # With the floor's 0.04 0.8: ζ = 70 / (2√3000) = 0.64 in the direct format, else (0.8 + 1) / 2.
    scene = load_scene(BALLS.format(one='solref="-3000 -70"', two=""))
    with pytest.raises(ValueError, match=r"damping_ratio must be given.*share a geom, got 0\.639"):
        scene.with_softness(Softness(stiffness=900))


def test_impedance_alone_keeps_width_and_stiffness(unequal):
    before = unequal.contact_parameters()
    after = unequal.with_softness(Softness(impedance=0.5)).contact_parameters()
    np.testing.assert_allclose(after.impedance, 0.5, rtol=1e-12)
    for kept in ("stiffness", "damping", "width", "friction", "margin"):
        np.testing.assert_array_equal(getattr(after, kept), getattr(before, kept))


def test_a_subset_leaves_other_pairs_alone(unequal):
    before = unequal.contact_parameters()
    subset = Softness(stiffness=900, damping_ratio=0.7, geoms=("three",))
    after = unequal.with_softness(subset).contact_parameters()
    chosen = np.array(["three" in pair.names for pair in unequal.pairs])
    assert chosen.sum() == 3
    np.testing.assert_allclose(after.stiffness[chosen], 900, rtol=1e-12)
    np.testing.assert_array_equal(after.stiffness[~chosen], before.stiffness[~chosen])


def test_a_pair_decided_by_priority_needs_only_the_winner(unequal):
    # "two" decides its contacts with "one" and "floor" alone, whose own contact is not selected.
    subset = Softness(stiffness=900, damping_ratio=0.7, pairs=(("two", "one"), ("two", "floor")))
    before, after = unequal.contact_parameters(), unequal.with_softness(subset).contact_parameters()
    for names, expected in (
        (("two", "one"), 900), (("two", "floor"), 900),
        (("one", "floor"), before.stiffness[_row(unequal, "one", "floor")]),
    ):  # fmt: skip
        np.testing.assert_allclose(after.stiffness[_row(unequal, *names)], expected, rtol=1e-12)


def test_a_sweep_is_one_vmap(unequal):
    stiffness = np.array([1e2, 1e3, 1e4])
    sweep = Softness(stiffness, np.ones(3), np.tile([0.2, 0.4], (3, 1)))
    got = jax.jit(jax.vmap(lambda s: unequal.with_softness(s).contact_parameters()))(sweep)
    np.testing.assert_allclose(got.stiffness, np.tile(stiffness[:, None], len(unequal.pairs)))
    np.testing.assert_allclose(got.impedance[..., 0], 0.2)
    np.testing.assert_allclose(got.impedance[..., 1], 0.4)


def test_derivatives_are_those_of_the_closed_form(unequal):
    """Both geoms carry the value, and the smaller solref wins: their shares must add up to one."""

    def damping(stiffness, ratio):
        softness = Softness(stiffness=stiffness, damping_ratio=ratio)
        return unequal.with_softness(softness).contact_parameters().damping

    by_stiffness, by_ratio = jax.jit(jax.jacfwd(damping, (0, 1)))(jnp.array(900.0), jnp.array(0.7))
    # b = 2ζ√k: ∂b/∂k = ζ/√k and ∂b/∂ζ = 2√k.
    np.testing.assert_allclose(by_stiffness, 0.7 / 30, rtol=1e-12)
    np.testing.assert_allclose(by_ratio, 60.0, rtol=1e-12)


@pytest.mark.parametrize("solref", ["-3000 0", "0 -70"])
def test_contact_without_damping_or_stiffness_or_weights_has_finite_derivatives(solref):
    one = f'solref="{solref}"'
    source = BALLS.format(one=one, two=one + ' solmix="0"').replace('"plane"', '"plane" solmix="0"')
    scene = load_scene(source)

    def total(model):
        parameters = eqx.tree_at(lambda s: s.model, scene, model).contact_parameters()
        return parameters.stiffness.sum() + parameters.damping.sum()

    gradient = jax.jit(jax.grad(total, allow_int=True))(scene.model)
    assert np.isfinite(gradient.geom_solref).all()
    assert np.isfinite(gradient.geom_solmix).all()


def test_a_contact_too_stiff_for_the_time_step_is_warned_about(equal):
    with pytest.warns(SceneWarning, match=r"h²k \+ 2hb = .*stable below 4.*time step below") as said:
        equal.with_softness(Softness(stiffness=1e6, damping_ratio=1))
    assert len(said) == 1


def test_softness_without_contact_has_no_effect_and_says_so():
    with pytest.warns(SceneWarning, match="no effect: no two geoms"):
        load_scene(NO_CONTACT, softness=Softness(stiffness=900, damping_ratio=1))


def test_an_impedance_out_of_range_says_what_it_becomes(equal):
    with pytest.warns(SceneWarning, match=r"impedance 1 has the effect of 0\.9999"):
        harder = equal.with_softness(Softness(impedance=1.0))
    np.testing.assert_allclose(harder.contact_parameters().impedance, 0.9999, rtol=1e-12)


@pytest.mark.filterwarnings("error")
def test_traced_values_warn_about_nothing(equal):
    soften = eqx.filter_jit(lambda scene, softness: scene.with_softness(softness))
    soften(equal, Softness(stiffness=1e6, damping_ratio=1))
