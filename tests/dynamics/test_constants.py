"""Constants of a model follow its masses, inertias, lengths and sizes: against C MuJoCo, which computes them again."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from tests.dynamics.scenes import ASSETS, zoo

_FIELDS = (
    "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "tendon_invweight0", "tendon_length0", "actuator_acc0",
)  # fmt: skip


def _model(name):
    model = zoo(welded=True)[0] if name == "zoo" else mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


def _in_c(model, **fields):
    """Return the constants that C finds for other values."""
    for name, value in fields.items():
        getattr(model, name)[:] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return {name: getattr(model, name).copy() for name in _FIELDS}


def _changes(model):
    random = np.random.default_rng(0)
    mass = model.body_mass * random.uniform(0.5, 2, model.nbody)
    inertia = model.body_inertia * random.uniform(0.8, 1.2, (model.nbody, 1))
    arms = model.body_ipos + random.normal(size=model.body_ipos.shape) / 50 * (model.body_simple == 0)[:, None]
    return {"body_mass": mass, "body_inertia": inertia, "body_ipos": arms, "dof_armature": model.dof_armature * 1.5}


# Every kind of joint, tendons, weightless slides; a long chain.
@pytest.mark.parametrize("name", ["zoo", "humanoid"])
def test_constants_are_those_of_c(name):
    model = _model(name)
    changes, before = _changes(model), mjx.put_model(model)
    expected = _in_c(model, **changes)
    found = jax.jit(lambda fields: mg.set_const(before.replace(**fields)))(changes)
    for field in _FIELDS:
        scale = np.abs(expected[field]).max(initial=0.0)
        np.testing.assert_allclose(getattr(found, field), expected[field], rtol=1e-9, atol=1e-12 * scale, err_msg=field)


@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_derivatives_by_every_mass_inertia_and_armature_are_those_of_differences(name):
    """Of a random sum of all constants, by central differences of C: to 1e-6, as differences are with a step of 1e-5."""
    model = _model(name)
    before, random = mjx.put_model(model), np.random.default_rng(1)
    start = {field: getattr(model, field).copy() for field in ("body_mass", "body_inertia", "dof_armature")}
    weights = {field: random.normal(size=getattr(model, field).shape) for field in _FIELDS}

    def total(fields):
        found = mg.set_const(before.replace(**fields))
        return sum(jnp.sum(weights[field] * getattr(found, field)) for field in _FIELDS)

    slopes = jax.jit(jax.grad(total))({field: jnp.asarray(value) for field, value in start.items()})
    for field, value in start.items():
        for place in np.argwhere(value > 0):
            step, sums = 1e-5 * value[tuple(place)], []
            for side in (1, -1):
                moved = {other: given.copy() for other, given in start.items()}
                moved[field][tuple(place)] += side * step
                sums.append(sum((weights[one] * given).sum() for one, given in _in_c(model, **moved).items()))
            expected = (sums[0] - sums[1]) / (2 * step)
            np.testing.assert_allclose(
                slopes[field][tuple(place)], expected, rtol=1e-6, atol=1e-6, err_msg=f"{field} {place}"
            )


def test_radii_follow_sizes_as_when_compiled():
    """One geom of each primitive kind, and a plane, which has none."""
    kinds = "plane", "sphere", "capsule", "ellipsoid", "cylinder", "box"
    geoms = "".join(f'<geom type="{kind}" size=".1 .3 .2" contype="0" conaffinity="0"/>' for kind in kinds)
    text = f"<mujoco><worldbody>{geoms}<body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    model, other = (mujoco.MjModel.from_xml_string(t) for t in (text, text.replace(".3 .2", ".2 .4")))
    found = mg.load_scene(model).with_model(geom_size=jnp.asarray(other.geom_size))
    np.testing.assert_allclose(found.model.geom_rbound, other.geom_rbound, rtol=1e-14)


def test_a_changed_mass_presses_as_a_recompiled_model_does():
    """The whole step, contact included: against the same scene written with the other mass."""
    text = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .0995"><freejoint/>
      <geom size=".1" mass="{}"/></body></worldbody></mujoco>"""
    light, heavy = (mg.load_scene(text.format(mass)) for mass in (1.0, 3.0))
    changed = light.with_model(body_mass=heavy.model.body_mass, body_inertia=heavy.model.body_inertia)
    found, expected = (mg.rollout(scene, mg.initial_state(scene), horizon=3).qvel for scene in (changed, heavy))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    stale = light.with_model(
        body_mass=heavy.model.body_mass,
        body_inertia=heavy.model.body_inertia,
        body_invweight0=light.model.body_invweight0,  # given: it stays
    )
    assert np.abs(mg.rollout(stale, mg.initial_state(stale), horizon=3).qvel - expected).max() > 1e-3
