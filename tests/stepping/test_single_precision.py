"""Derivatives in JAX's default precision, where what symmetry makes nearly zero is zero once squared.

Every pair of geoms, in poses that are symmetric but for a tilt that is smaller and smaller, and every kind of actuator, tendon,
limit, equality and sensor, at rest, at its reference and at its limit: both modes are finite, agree, and are right.
"""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._mjx import mjx
from mjxgrad.bodies import kinematics, spatial
from mjxgrad.contact.collision import collide
from mjxgrad.stepping import onset
from tests.scenes import put

_SHAPES = {
    "plane": 'type="plane" size="1 1 .1"',
    "hfield": 'type="hfield" hfield="h"',
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".05 .1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .12 .15"',
    "cylinder": 'type="cylinder" size=".1 .12"',
    "box": 'type="box" size=".1 .1 .1"',
    "mesh": 'type="mesh" mesh="m"',
}
_PAIRS = [
    *(("plane", name) for name in ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")),
    *(("hfield", name) for name in ("sphere", "capsule", "box", "mesh")),
    *(("sphere", name) for name in ("sphere", "capsule", "cylinder", "box", "mesh")),
    *(("capsule", name) for name in ("capsule", "box", "mesh")),
    *(("box", name) for name in ("box", "mesh")),
    ("mesh", "mesh"),
]
# `test_boxes` has two boxes; the others are as these and take long to compile.
_QUICK = {("plane", "cylinder"), ("sphere", "cylinder"), ("capsule", "capsule"), ("capsule", "box")}
PAIR = """<mujoco><asset>
  <mesh name="m" vertex="-.1 -.1 -.1  .1 -.1 -.1  -.1 .1 -.1  .1 .1 -.1  0 0 .1"/>
  <hfield name="h" nrow="3" ncol="3" size=".5 .5 .1 .1" elevation="0 0 0 0 1 0 0 0 0"/></asset>
<worldbody><geom {}/><body><freejoint/><geom {} mass="1"/></body></worldbody></mujoco>"""
# As XLA compiles quickest, see `conftest`, both modes of capsule and box round differently in a few poses where two corners are
# equally near, though they are of one linearisation, and then take the derivative of either.
_ALIKE = {"xla_cpu_opt_preset": "CPU_OPT_PRESET_DEFAULT"} if jax.__version_info__ < (0, 11) else None
_TILTS = (0.0, *(10.0**-k for k in range(4, 26, 3)))


def _poses():
    """Return positions and quaternions: in line along axes and diagonals, overlapping and apart, faces, edges and corners."""
    places = [[0, 0, 0.19], [0, 0, 0.5], [0.17, 0, 0], [0.1, 0.1, 0.19], [0, 0, 0]]
    half = np.sqrt(0.5)
    turns = [[1, 0, 0, 0], [half, half, 0, 0], [half, 0, half, 0], [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]]
    found, turned = [], np.zeros(4)
    for tilt, place, turn in itertools.product(_TILTS, places, turns):
        mujoco.mju_mulQuat(turned, np.array([1, 0.5 * tilt, 0, tilt]), np.array(turn))
        found.append([*place, *turned])
    return np.array(found)


def _contacts(pair):
    """Return a function of a motion of the body and its pose: all numbers of the contacts, weighted, and their depths' sum."""
    model, data = put(PAIR.format(*(_SHAPES[name] for name in pair)))

    def contacts(motion, pose):
        quat = spatial.multiply(spatial.exponential(motion[3:]), pose[3:])
        posed = data.replace(qpos=jnp.concatenate([pose[:3] + motion[:3], quat]))
        found = collide(model, kinematics.com_pos(model, kinematics.kinematics(model, posed)))._impl.contact
        every = jnp.concatenate([found.dist[:, None], found.pos, found.frame.reshape(-1, 9)], axis=1)
        return jnp.stack([(every @ jnp.cos(jnp.arange(13.0))).sum(), jnp.where(found.dist < 0, found.dist, 0.0).sum()])

    return contacts


def _over_poses(function):
    """Return what a function of a motion and a pose gives of all poses at rest."""
    poses = jnp.asarray(_poses(), jnp.result_type(float))
    return jax.jit(jax.vmap(lambda pose: function(jnp.zeros(6), pose)), compiler_options=_ALIKE)(poses)


@pytest.mark.parametrize(
    "pair", [p if p in _QUICK else pytest.param(p, marks=pytest.mark.slow) for p in _PAIRS], ids="-".join
)
def test_contacts_of_nearly_symmetric_poses_have_both_derivatives(pair):
    """Finite and the same in both modes; and the depth's is that of double precision, there or to either side of the pose.

    Slopes on both sides differ where several corners or faces are equally near. Where precisions choose other points among
    those of a face there is nothing to compare.
    """
    width, eye = 1e-6, jnp.eye(6)

    def both(rest, pose):  # of one linearisation, as `jax.jacfwd` and `jax.jacrev` take it one by one
        value, push = jax.linearize(lambda motion: contacts(motion, pose), rest)
        (pulled,) = jax.vmap(jax.linear_transpose(push, rest))(jnp.eye(value.size, dtype=value.dtype))
        return value, jax.vmap(push, out_axes=1)(jnp.eye(6)), pulled

    def around(rest, pose):
        near = rest + width * jnp.concatenate([eye, -eye])
        return contacts(rest, pose), jax.jacfwd(contacts)(rest, pose), jax.vmap(contacts, (0, None))(near, pose)

    with jax.enable_x64(False):
        contacts = _contacts(pair)
        value, forward, reverse = _over_poses(both)
    contacts = _contacts(pair)
    there, slope, beside = _over_poses(around)
    right, left = (
        (x - there[:, None, 1]) / w for x, w in zip(np.split(beside[..., 1], 2, 1), (width, -width), strict=True)
    )
    assert np.isfinite(forward).all()
    assert np.isfinite(reverse).all()
    scale = 1 + np.abs(forward).max(axis=(1, 2), keepdims=True)
    # Sums of some hundred terms, each rounded to 1e-7 of the largest; a rim's point turns by 1e7 radians for one of tilt.
    np.testing.assert_allclose(forward / scale, reverse / scale, atol=2e-2 if pair == ("plane", "cylinder") else 2e-5)
    is_same = np.abs(value - there).max(axis=1) < 1e-4
    found = np.asarray(forward)[:, 1]
    # Rounding of a double over the width is 1e-10, single precision 1e-6 of numbers up to ten.
    is_between = (found > np.minimum(left, right) - 1e-3) & (found < np.maximum(left, right) + 1e-3)
    is_right = is_between | (np.abs(found - slope[:, 1]) < 1e-3)
    # Of a pyramid, and of a grid of prisms, more points are equally near than of a box.
    assert is_same.mean() > (0.3 if {"mesh", "hfield"} & {*pair} else 0.6)
    # MJX moves a face's point by a micrometre where it clips it, which precisions may decide otherwise.
    assert is_right[is_same].all(axis=1).mean() > 0.98


# C counts what tendons and actuators do to a body in its sensors of force and torque, MJX does not: none of these.
ZOO = """<mujoco><option timestep=".002" gravity="0 0 -9.81" tolerance="1e-12" iterations="50">{flag}</option>
<default><geom contype="0" conaffinity="0" size=".05" mass=".5"/><site size=".01"/></default>
<asset><material name="grey"/></asset><worldbody>
  <geom name="floor" type="plane" size="2 2 .1" contype="1" conaffinity="1"/>
    <camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 0 1"/>
  <site name="world" pos="0 0 2"/>
  <body pos="0 0 1"><joint name="hinge" axis="0 1 0" range="-40 40" stiffness="3" damping=".1" armature=".01"/>
    <geom type="capsule" size=".03 .1" pos="0 0 -.1"/><site name="tip" pos="0 0 -.2"/>
    <body pos="0 0 -.2"><joint name="slide" type="slide" axis="0 0 1" range="-.1 .1" frictionloss=".1"/><geom/>
    <site name="bob" pos=".02 .01 -.05"/></body></body>
  <body pos="1 0 1"><joint name="ball" type="ball" range="0 60" stiffness="2" damping=".1"/><geom pos="0 0 -.1"/>
    <site name="on_ball" pos="0 0 -.1"/></body>
  <body pos="2 0 1" gravcomp="1"><joint name="free_ball" type="ball"/><geom type="box" size=".05 .04 .03"/>
    <site name="turned"/></body>
  <body name="flyer" pos="0 1 .04"><freejoint name="free"/><geom size=".05" contype="1" conaffinity="1" name="foot"/>
    <site name="touching" size=".06"/><site name="still"/></body>
  <body pos="1 1 1"><joint name="arm" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
    <site name="upper" pos=".1 .04 0"/>
    <body pos=".3 0 0"><joint name="elbow" axis="0 0 1"/><geom name="ring" type="cylinder" size=".03 .05"/>
    <geom name="ball_at_elbow" type="sphere" size=".03"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".02"/><site name="lower" pos=".08 .03 0"/><site name="inside"/>
    <site name="beyond" pos="0 -.05 0"/><site name="on_axis" pos="0 0 .1"/></body></body>
  <body pos="2 1 1"><joint name="push" type="slide" axis="1 0 0"/><geom/><site name="pushed"/></body>
  <body pos="3 1 1"><joint name="drag" type="slide" axis="1 0 0"/><geom/></body>
  {held}
  <site name="down" pos=".1 1 1" euler="180 0 0"/><site name="aside" pos="0 1 .04" euler="0 90 0"/>
    <site name="missing" pos="0 1.2 .04" euler="0 90 0"/>
</worldbody>
<tendon>
  <fixed name="sum" stiffness="50" damping="1" range="-.1 .1"
    limited="true" actuatorfrclimited="true" actuatorfrcrange="-1 1"><joint joint="push" coef="1"/>
    <joint joint="drag" coef="-.5"/></fixed>
  <fixed name="slack" stiffness="50" springlength="-.05 .05"><joint joint="drag" coef="1"/></fixed>
  <spatial name="string" stiffness="20" frictionloss=".1"><site site="bob"/><site site="on_ball"/><pulley divisor="2"/>
    <site site="tip"/><site site="on_ball"/></spatial>
  <spatial name="round_ring" stiffness="10"><site site="upper"/><geom geom="ring" sidesite="beyond"/><site site="lower"/>
    </spatial>
  <spatial name="round_ball"><site site="upper"/><geom geom="ball_at_elbow"/><site site="on_axis"/></spatial>
  {inside}
</tendon>
{equality}
<actuator>
  <motor name="m" joint="hinge"/><position joint="slide" kp="20"/><velocity joint="hinge" kv="2"/>
    <intvelocity joint="slide" kp="5" actrange="-1 1"/>
  <damper joint="hinge" kv="2" ctrlrange="0 1"/><cylinder joint="slide" timeconst=".1" area=".1"/>
    <muscle joint="elbow" lengthrange="-1 1"/>
  <general joint="arm" dyntype="filterexact" dynprm=".01" gaintype="affine" gainprm="1 .1 .1"
    biastype="affine" biasprm="0 -1 -.1"/>
  <position joint="ball" gear="1 0 .3" kp="2"/><position jointinparent="free_ball" gear="0 1 .2" kp="2"/>
  <position site="turned" refsite="world" gear="0 0 0 1 .2 0" kp="2"/>
    <position site="pushed" refsite="world" gear="1 0 .5 0 0 0" kp="2"/>
  <motor site="still" gear="1 0 0 0 0 .1"/><motor tendon="sum"/>{pulled}
    <motor joint="free" gear="1 0 0 0 .1 0"/>
</actuator>
{sensors}</mujoco>"""
_PARTS = {
    "inside": '<spatial name="in_ring"><site site="upper"/><geom geom="ring" sidesite="inside"/><site site="lower"/></spatial>',
    "pulled": '<position tendon="in_ring" kp="3"/>',
    "sensors": """<sensor>
  <velocimeter site="bob"/><gyro site="bob"/><magnetometer site="bob"/>
  <camprojection site="bob" camera="eye"/><rangefinder site="down"/><rangefinder site="aside"/><rangefinder site="missing"/>
  <jointpos joint="hinge"/><jointvel joint="hinge"/><tendonpos tendon="string"/><tendonvel tendon="string"/>
    <tendonpos tendon="round_ring"/><tendonpos tendon="round_ball"/>
  <tendonpos tendon="in_ring"/>
  <ballquat joint="ball"/><ballangvel joint="ball"/><framepos objtype="site" objname="bob"/>
    <framequat objtype="site" objname="bob" reftype="site" refname="on_ball"/>
  <framezaxis objtype="site" objname="bob"/><framelinvel objtype="site" objname="bob"/>
    <frameangvel objtype="site" objname="bob"/>
  <subtreecom body="flyer"/><subtreelinvel body="flyer"/><subtreeangmom body="flyer"/><clock/>
<touch site="touching"/><accelerometer site="bob"/><framelinacc objtype="site" objname="bob"/>
<frameangacc objtype="site" objname="bob"/></sensor>""",
    # What needs rows.
    "held": """<body name="p" pos="0 2 1"><freejoint/><geom/></body><body name="q" pos=".2 2 1"><freejoint/>
    <geom type="box" size=".05 .04 .03"/></body><body name="r" pos="0 3 1"><freejoint/><geom/></body>""",
    "equality": """<equality><weld body1="p" body2="q"/><connect body1="r" anchor="0 0 .1"/>
    <joint joint1="drag" joint2="push" polycoef="0 .5 .3 0 0"/></equality>""",
}


def _states(model):
    """Return states at references and at rest, nearly so, at limits and in motion."""
    random, found = np.random.default_rng(5), []

    def state(**joints):
        data = mujoco.MjData(model)
        for name, value in joints.items():
            data.joint(name).qpos = value
        found.append(data)
        return data

    def turn(data, angle):
        data.qvel = angle * random.normal(size=model.nv)
        mujoco.mj_integratePos(model, data.qpos, angle * random.normal(size=model.nv), 1)

    state()
    for angle in (1e-20, 1e-15, 1e-10, 1e-7):
        turn(state(), angle)
    ball = [np.cos(np.pi / 6), 0, np.sin(np.pi / 6), 0]
    state(hinge=np.deg2rad(40), slide=0.1, ball=ball, push=0.125, drag=0.05)
    state(hinge=-np.deg2rad(40), slide=-0.1, push=-0.125, drag=-0.05, free=[0, 1, 0.05, 1, 0, 0, 0])
    wrapped = state(arm=0.2, elbow=-1.0)
    turn(moving := state(), 0.2)
    moving.qvel = random.normal(size=model.nv)
    for data in (wrapped, moving):
        data.ctrl, data.act = 0.1 * random.normal(size=model.nu), np.full(model.na, 0.3)
    return found


def _split(model, motion, xp=jnp):
    """Return the changes of position, velocity, control and activation."""
    return xp.split(motion, np.cumsum([model.nv, model.nv, model.nu]))


def _slopes_in_c(model, start, size):
    """Return the least and the greatest of the slopes to either side of velocity, activation and sensors after a step."""

    def outcome(motion):
        data, (turn, push, control, act) = mujoco.MjData(model), _split(model, motion, np)
        data.qpos = start.qpos
        mujoco.mj_integratePos(model, data.qpos, turn, 1)
        data.qvel, data.ctrl, data.act = start.qvel + push, start.ctrl + control, start.act + act
        mujoco.mj_step(model, data)
        return np.concatenate([data.qvel, data.act, data.sensordata])

    middle = outcome(np.zeros(size))
    sides = [np.stack([(outcome(w * e) - middle) / w for e in np.eye(size)], axis=1) for w in (1e-6, -1e-6)]
    return np.minimum(*sides), np.maximum(*sides)


@pytest.mark.parametrize("is_all", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forces", "all"])
def test_a_step_of_nearly_everything_has_both_derivatives(is_all):
    """Those of C MuJoCo's step, between the slopes on both sides where a limit or the end of a spring is just there."""
    parts = {"flag": "", **_PARTS} if is_all else {"flag": '<flag constraint="disable"/>', **dict.fromkeys(_PARTS, "")}
    model = mujoco.MjModel.from_xml_string(ZOO.format(**parts))
    states, size = _states(model), 2 * model.nv + model.nu + model.na
    with jax.enable_x64(False):
        mjx_model, data = mjx.put_model(model), mjx.make_data(model)

        def outcome(motion, qpos, qvel, ctrl, act):
            turn, push, control, more = _split(model, motion)
            moved = kinematics.integrate_position(mjx_model, qpos, turn, 1.0)
            start = data.replace(qpos=moved, qvel=qvel + push, ctrl=ctrl + control, act=act + more)
            end = mg.step(mjx_model, start)
            return jnp.concatenate([end.qvel, end.act, end.sensordata])

        weights = jnp.cos(jnp.arange(float(model.nv + model.na + model.nsensordata)))

        def both(*start):
            end, push = jax.linearize(lambda motion: outcome(motion, *start), jnp.zeros(size))
            return jax.vmap(push, out_axes=1)(jnp.eye(size)), jax.linear_transpose(push, jnp.zeros(size))(
                weights.astype(end.dtype)
            )[0]

        fields = (np.stack([getattr(data, name) for data in states]) for name in ("qpos", "qvel", "ctrl", "act"))
        slopes, reverse = jax.jit(jax.vmap(both))(*(jnp.asarray(x, jnp.float32) for x in fields))
    assert np.isfinite(slopes).all()
    assert np.isfinite(reverse).all()
    forward = np.asarray(weights, float) @ np.asarray(slopes, float)
    np.testing.assert_allclose(reverse, forward, rtol=1e-4, atol=1e-4 * np.abs(forward).max())
    for start, found in zip(states, slopes, strict=True):
        least, greatest = _slopes_in_c(model, start, size)
        # Rounding of single precision, through weights and stiffness of some thousand.
        close = 2e-3 * (1 + np.abs(least).max(axis=1, keepdims=True))
        assert ((found > least - close) & (found < greatest + close)).all()


@pytest.mark.parametrize("speed", [0.0, 1e-6, 0.1])
def test_how_slow_an_approach_is_has_a_derivative_at_any_rate(speed):
    """1 / (1 + x⁴) has -4 x³ / (1 + x⁴)², x the rate as a multiple of the speed; zero where all rates are beyond it."""
    rates = np.array([0.0, *(10.0**k for k in range(-25, 4))])
    with jax.enable_x64(False):
        rate = jnp.asarray(rates, jnp.float32)
        _, pull = jax.vjp(lambda rate: onset._is_slow(rate, jnp.float32(speed)), rate)
        found = pull(jnp.ones_like(rate))[0]
    x = np.minimum(rates / speed, 1e3) if speed else np.full_like(rates, 1e3)
    # From 1000 times the speed on it is zero in place of 1e-12.
    np.testing.assert_allclose(
        found, np.where(x < 1e3, -4 * x**3 / (1 + x**4) ** 2, 0) / (speed or 1), rtol=1e-4, atol=1e-8
    )
