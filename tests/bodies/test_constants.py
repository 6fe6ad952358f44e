"""Constants of a model follow its masses, inertias, lengths and sizes: against C MuJoCo, which computes them again."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from tests.scenes import ASSETS, zoo

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


@pytest.mark.parametrize("pair", ["", '<contact><pair geom1="can" geom2="table"/></contact>'])
def test_bodies_whose_contact_mjx_lacks_have_constants(pair):
    scene = mg.load_scene(
        f"""<mujoco><worldbody><geom name="table" type="box" size="1 1 .1"/><body name="can" pos="0 0 .2"><freejoint/>
        <geom name="can" type="cylinder" size=".03 .1"/></body></worldbody>{pair}</mujoco>""",
        engine="mujoco",
    )
    heavier = scene.with_model(body_mass=2 * scene.mj_model.body_mass)
    np.testing.assert_allclose(
        heavier.model.body_invweight0[1, 0], 0.5 * scene.mj_model.body_invweight0[1, 0], rtol=1e-6
    )


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


# What the compiler reads, by the field that it becomes.
_WRITTEN = {"body_mass": "mass", "body_inertia": "inertia", "geom_size": "size", "geom_friction": "friction"}


def _explicit(name):
    """Return a scene in whose file every mass, inertia, size and friction is a number that nothing else follows from."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / f"{name}.xml"))
    model = spec.compile()
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER  # a quarter of RK4's program
    spec.option.tolerance, spec.option.ls_tolerance, spec.option.iterations = 1e-15, 1e-12, 200
    for i, body in enumerate(spec.bodies[1:], 1):
        body.explicitinertial, body.mass, body.inertia = True, model.body_mass[i], model.body_inertia[i]
        body.ipos, body.iquat = model.body_ipos[i], model.body_iquat[i]
    for i, geom in enumerate(spec.geoms):
        geom.fromto[:] = np.nan
        geom.size, geom.pos, geom.quat = model.geom_size[i], model.geom_pos[i], model.geom_quat[i]
    return spec


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_a_motion_s_derivatives_by_every_mass_inertia_size_and_friction_are_those_of_recompiled_models(name):
    """Three steps with feet that slide on the floor, against central differences of C MuJoCo, recompiled for each number."""
    spec, random, height = _explicit(name), np.random.default_rng(0), 1 if name == "hopper" else 2
    model = spec.compile()
    data, qpos = mujoco.MjData(model), model.qpos0.copy()
    # Joints away from their limits, whose forces would lift what is to touch.
    limited = model.jnt_limited.astype(bool)
    low, high = model.jnt_range[limited].T
    qpos[model.jnt_qposadr[limited]] = random.uniform(0.6 * low + 0.4 * high, 0.4 * low + 0.6 * high)
    qvel = 0.5 * random.normal(size=model.nv)
    # Lowered until it is pressed into the floor by 4 mm.
    data.qpos[:] = qpos
    while min(data.contact.dist, default=1.0) > -0.004:
        data.qpos[height] -= 1e-4
        mujoco.mj_fwdPosition(model, data)
    qpos[height] = data.qpos[height]

    def in_c():
        recompiled = spec.compile()
        moved = mujoco.MjData(recompiled)
        moved.qpos[:], moved.qvel[:] = qpos, qvel
        mujoco.mj_step(recompiled, moved, 3)
        return np.concatenate([moved.qpos, moved.qvel])

    scene = mg.load_scene(model)

    def ours(fields):
        changed = scene.with_model(**fields)
        start = mg.initial_state(changed, qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
        end = mg.rollout(changed, start, horizon=3).final
        return jnp.concatenate([end.qpos, end.qvel])

    values = {field: np.array(getattr(model, field)) for field in _WRITTEN}
    found = jax.jit(jax.jacfwd(ours))({field: jnp.asarray(value) for field, value in values.items()})
    felt = set()
    for field, value in values.items():
        elements = spec.bodies if field.startswith("body") else spec.geoms
        for place in map(tuple, np.argwhere(value > 0)):
            changed, ends, step = value[place[0]].copy(), [], 1e-5 * value[place]
            for side in (1, -1):
                moved = np.array(changed)
                moved[place[1:]] += side * step
                setattr(elements[place[0]], _WRITTEN[field], moved if place[1:] else float(moved))
                ends.append(in_c())
            setattr(elements[place[0]], _WRITTEN[field], changed if place[1:] else float(changed))
            expected = (ends[0] - ends[1]) / (2 * step)
            felt |= {field} if np.abs(expected).max() > 1e-3 else set()
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(found[field][:, *place], expected, atol=1e-5 * scale, err_msg=f"{field} {place}")
    assert felt == set(_WRITTEN)
