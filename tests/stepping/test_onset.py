"""Contact that begins within the step: no jumps, the plain derivative right, and MuJoCo's step where nothing begins."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from experiments.sawtooth import case
from mjxgrad.stepping.onset import _split
from mjxgrad.stepping.rows import Block
from tests.scenes import ASSETS

_STATE = ("qpos", "qvel", "act", "time", "qacc_warmstart")
_ONSETS = {"continuous": mg.Onset(), "mujoco": mg.Discrete()}
# Sub-intervals of one look, how many of them are looked at again, and how often each: 64⁷ is 4·10¹².
_PARTS, _FOLLOWED, _LOOKS = 64, 3, 7


def _scene(source):
    model = source if isinstance(source, mujoco.MjModel) else mujoco.MjModel.from_xml_string(source)
    model.opt.iterations, model.opt.tolerance = 100, 1e-13  # a solve that ends early has jumps of its own
    return mg.load_scene(model)


def _end(scene, start, num_steps, kind):
    """Return position and velocity after some steps."""

    def step(_, state):
        moved = mg.step(scene.model, start.replace(**dict(zip(_STATE, state, strict=True))), contact=_ONSETS[kind])
        return tuple(getattr(moved, field) for field in _STATE)

    state = jax.lax.fori_loop(0, num_steps, step, tuple(getattr(start, field) for field in _STATE))
    return jnp.concatenate(state[:2])


@functools.cache
def _outcome(name):
    """From places on a line in state and parameters to position and velocity after the impacts; and how many steps that takes."""
    one = case(name) if not name.endswith(".xml") else None
    scene = _scene(one.model if one else mujoco.MjModel.from_xml_path(str(ASSETS / name)))
    random = np.random.default_rng(1)
    qpos, qvel = np.array(scene.data.qpos), np.array(scene.data.qvel)
    if one:
        for index, value in one.qpos.items():
            qpos[index] = value
        for index, value in one.qvel.items():
            qvel[index] = value
    along_qvel = random.normal(size=len(qvel))
    along_friction = random.normal(size=np.shape(scene.model.geom_friction))

    @functools.partial(jax.jit, static_argnums=(2,))
    def outcome(places, num_steps, kind):
        def at(place):
            friction = scene.model.geom_friction * (1 + 0.1 * place * along_friction)
            changed = eqx.tree_at(lambda s: s.model, scene, scene.model.replace(geom_friction=friction))
            shift = (one.interval[0] if one else 0.0) + 0.02 * place
            start = scene.data.replace(
                qpos=jnp.asarray(qpos).at[one.moved if one else 1].add(shift), qvel=qvel + 0.3 * place * along_qvel
            )
            return _end(changed, start, num_steps, kind)

        return jax.vmap(at)(places)

    duration = one.duration if one else 0.3
    return outcome, round(0.6 * duration / float(scene.model.opt.timestep))


def _roughness(outcome, low, high):
    """Give the ends of sub-intervals, and by how much the difference over each is unlike those beside it."""
    places = np.linspace(low, high, _PARTS + 1)
    values = np.asarray(outcome(places))
    assert np.isfinite(values).all()
    change = np.diff(values, axis=0)
    padded = np.concatenate([change[1:2], change, change[-2:-1]])
    return places, np.abs(change - 0.5 * (padded[:-2] + padded[2:])).max(axis=1)


def _largest_jump(outcome, low=0.0, high=1.0):
    """Close in on where the outcome is roughest: a jump stays, all else falls in proportion."""
    places, size = _roughness(outcome, low, high)
    found = []
    for worst in np.argsort(size)[-_FOLLOWED:]:
        ends, left = places[worst : worst + 2], None
        for _ in range(_LOOKS - 1):
            inner, left = _roughness(outcome, *ends)
            ends = inner[np.argmax(left) :][:2]
        found.append(left.max())
    return max(found)


def _jumps(name, kind):
    outcome, num_steps = _outcome(name)
    return _largest_jump(lambda places: outcome(places, jnp.int32(num_steps), kind))


# After the last look places are 10⁻¹² apart; rounding of some hundred steps, and derivatives of up to 10⁴, make 10⁻⁸ of it.
_ROUNDING = 1e-7


_SLOW = (
    "ball_elliptic", "hopper", "walker2d", "ant", "ball_frictionless", "ball_torsion", "ball_rolling", "ball_inclined",
    "ball_inclined_rolling", "two_balls", "two_balls_elliptic", "arm",
    "half_cheetah.xml", "humanoid.xml", "inverted_double_pendulum.xml", "reacher.xml", "swimmer.xml",
)  # fmt: skip


@pytest.mark.parametrize("name", ["ball", *(pytest.param(name, marks=pytest.mark.slow) for name in _SLOW)])
def test_outcomes_of_neighbouring_starts_and_parameters_are_neighbours(name):
    assert _jumps(name, "continuous") < _ROUNDING
    assert name.endswith(".xml") or _jumps(name, "mujoco") > 1e-5


def test_the_mean_of_the_derivative_is_the_difference_of_the_outcome():
    """The fundamental theorem, over a tooth and a half, each of which is a jump without the onset."""
    outcome, num_steps = _outcome("ball")
    places = np.linspace(0.0, 0.3, 513)

    def value(place):
        return outcome(place[None], jnp.int32(num_steps), "continuous")[0]

    along = jax.jit(jax.vmap(lambda place: jax.jvp(value, (place,), (jnp.ones(()),))))
    values, slopes = map(np.asarray, along(jnp.asarray(places)))
    change = values[-1] - values[0]
    mean = (0.5 * (slopes[:-1] + slopes[1:]) * np.diff(places)[:, None]).sum(axis=0)
    # Kinks between samples: a part of 1 / 512 of the interval each, with derivatives of some times the mean.
    assert np.abs(mean - change).max() < 0.01 * np.abs(change).max()


@pytest.mark.slow
def test_forward_and_reverse_mode_agree():
    one = case("ball")
    scene = _scene(one.model)
    qpos, qvel = np.array(scene.data.qpos), np.array(scene.data.qvel)
    for index, value in one.qvel.items():
        qvel[index] = value

    def cost(height):
        start = mg.initial_state(scene, jnp.asarray(qpos).at[2].set(height), qvel)
        final = mg.rollout(scene, start, horizon=45, contact=mg.Onset()).final
        return jnp.arange(1.0, 8.0) @ final.qpos + jnp.arange(1.0, 7.0) @ final.qvel

    heights = jnp.linspace(0.1, 0.11, 16)
    backward = jax.jit(jax.vmap(jax.grad(cost)))(heights)
    forward = jax.jit(jax.vmap(lambda x: jax.jvp(cost, (x,), (jnp.ones(()),))[1]))(heights)
    np.testing.assert_allclose(backward, forward, rtol=1e-8)


_BALL = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0" cone="{cone}" tolerance="1e-14" iterations="100"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" condim="{condim}" solref="-1e-9 -100" solimp=".9 .9 .001"/>
    <body><freejoint/><geom size="5" condim="{condim}" solref="-1e-9 -100" solimp=".9 .9 .001"/></body>
  </worldbody>
</mujoco>
"""


_CONTACTS = [
    ("pyramidal", 3),
    ("elliptic", 6),
    *(pytest.param(*contact, marks=pytest.mark.slow) for contact in (("elliptic", 3), ("pyramidal", 1))),
]


@pytest.mark.parametrize(("cone", "condim"), _CONTACTS)
def test_the_impulse_of_a_contact_grows_in_proportion_to_the_time_that_is_left(cone, condim):
    """With next to no stiffness what a damper does in full contact does not depend on the depth: the rest is φ."""
    scene = _scene(_BALL.format(cone=cone, condim=condim))
    qvel = jnp.array([0.4, 0.0, -1.0, 0.005, 0.02, 0.0])
    h, speed = 0.002, 1.0

    def after(distance):
        start = scene.data.replace(qpos=scene.data.qpos.at[2].set(5 + distance), qvel=qvel)
        return mg.step(scene.model, start, contact=mg.Onset(0.0)).qvel - qvel

    shares = np.linspace(0.05, 0.95, 7)
    change = jax.jit(jax.vmap(after))(jnp.asarray((0.5 - shares) * h * speed))
    # The point of contact lies half the distance, a millimetre, from the ball of five metres.
    np.testing.assert_allclose(change, shares[:, None] / shares[0] * change[0], rtol=1e-3, atol=1e-9)
    assert np.abs(change[0]).max() > 1e-4


def test_free_flight_and_deep_contact_are_mujocos():
    scene = _scene(_BALL.replace('gravity="0 0 0"', "").format(cone="pyramidal", condim=3))
    qvel = jnp.array([0.3, 0.0, -0.2, 0.0, 1.0, 0.0])
    starts = 5 + jnp.array([0.3, 0.01, -0.005, -0.01])

    def after(height, contact):
        start = scene.data.replace(qpos=scene.data.qpos.at[2].set(height), qvel=qvel)
        return mg.step(scene.model, start, contact=contact).qvel

    widths = jnp.array([mg.Onset().width, 0.0])
    found = jax.jit(jax.vmap(jax.vmap(lambda z, w: after(z, mg.Onset(w)), (0, None)), (None, 0)))(starts, widths)
    expected = jax.jit(jax.vmap(lambda z: after(z, mg.Discrete())))(starts)
    np.testing.assert_allclose(
        found, [expected] * 2, rtol=0, atol=1e-15
    )  # two programs, whose sums XLA may order otherwise


_WALL = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0" cone="{cone}"/>
  <worldbody>
    <geom type="box" size="{half} .2 {half_height}" condim="{condim}"/>
    <body pos="{start}"><freejoint/><geom type="sphere" size=".01" mass=".01" condim="{condim}"
      solref="-300 -35" solimp="0 .3 .02"/></body>
  </worldbody>
</mujoco>
"""


_THIN = {"half": 0.01, "half_height": 0.2, "start": "-.03 0 0"}
# Enters by the left side, is pushed out by the top, then by the right side.
_CORNER = {"half": 0.03, "half_height": 0.02, "start": "-.05 0 .005"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cone", "condim", "wall", "num_pushed"),
    [
        ("pyramidal", 1, _THIN, 1),
        ("pyramidal", 3, _THIN, 3),
        ("elliptic", 3, _THIN, 3),
        ("pyramidal", 1, _CORNER, 2),
        ("elliptic", 3, _CORNER, 3),
    ],
)
def test_through_a_soft_wall_both_sides_push_for_their_share(cone, condim, wall, num_pushed):
    """The normal flips half way through, or turns at two edges. Neither a jump is left, nor the mean over the phases moved."""
    scene = _scene(_WALL.format(cone=cone, condim=condim, **wall))
    qvel = jnp.array([1.9, 0.3, 0.0, 0.0, 4.0, 9.0])

    @functools.partial(jax.jit, static_argnums=1)
    def outcome(places, kind):
        def at(place):
            # What the ball flies in one step.
            qpos = scene.data.qpos.at[0].add(place * 0.002 * 1.9)
            return _end(scene, scene.data.replace(qpos=qpos, qvel=qvel), 40, kind)[len(qpos) :][:3]

        return jax.vmap(at)(places)

    assert _largest_jump(lambda places: outcome(places, "continuous")) < _ROUNDING
    assert _largest_jump(lambda places: outcome(places, "mujoco")) > 1e-4
    phases = (np.arange(64) + 0.5) / 64
    smooth, teeth = (np.asarray(outcome(phases, kind)) for kind in ("continuous", "mujoco"))
    size = np.ptp(teeth, axis=0)
    has_teeth = size > 1e-4  # across a normal only with friction
    assert has_teeth.sum() == num_pushed
    assert (np.ptp(smooth, axis=0) < 0.1 * size)[has_teeth].all()
    # A tenth of the teeth: the mean of a sawtooth is its centre only where it is linear.
    assert (np.abs(smooth.mean(axis=0) - teeth.mean(axis=0)) < 0.1 * size)[has_teeth].all()


_PUSHED = """
<mujoco>
  <option timestep="{timestep}"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" friction=".5"/>
    <body pos="-.15 0 .05"><joint name="p" type="slide" axis="1 0 0" damping="1"/>
      <geom size=".05" mass=".5" contype="2" conaffinity="2"/></body>
    <body pos="0 0 .05"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>{turning}
      <geom type="{kind}" size=".05 .05 .05" mass=".5" friction=".5" contype="3" conaffinity="3"/></body>
  </worldbody>
  <actuator><motor joint="p" gear="5"/></actuator>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "turning"), [("sphere", ""), ("box", '<joint type="hinge" axis="0 1 0"/>')])
@pytest.mark.parametrize("timestep", [1e-3, 4e-3])
def test_a_thing_pushed_along_the_floor_keeps_a_derivative_of_a_size_to_be_believed(kind, turning, timestep):
    """Contacts that chatter multiply the tangent at every switch: without a floor of the width by 10² to 10⁹."""
    scene = mg.load_scene(_PUSHED.format(timestep=timestep, kind=kind, turning=turning))

    def speed(force):
        start = mg.initial_state(scene)
        controls = force * jnp.ones((round(0.24 / timestep), 1))
        return mg.rollout(scene, start, controls, contact=mg.Onset()).qvel[-1, 1]

    derivatives = jax.jit(jax.vmap(jax.grad(speed)))(jnp.linspace(0.7, 0.98, 64))
    # The slope of the outcome is 0.7 to 1.1 (m/s per unit of control).
    assert np.abs(np.median(derivatives)) < 3
    assert derivatives.std() < 30


_FOOT = """
<mujoco>
  <option timestep=".004" tolerance="1e-12"/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .5"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .1 .1" mass="10" contype="0" conaffinity="0"/>
      <body pos="0 0 -.4"><joint name="ankle" axis="0 1 0" armature=".005" damping=".2"/>
        <geom type="capsule" fromto="-.1 0 0 .1 0 0" size=".015" mass=".2" contype="0" conaffinity="0"/>
        <geom name="heel" pos="-.1 0 -.02" size=".015" mass=".05" condim="1"/>
        <geom name="toe" pos=".1 0 -.02" size=".015" mass=".05" condim="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="ankle" kp="100"/></actuator>
</mujoco>
"""


def test_a_light_foot_that_a_strong_motor_presses_down_does_not_chatter():
    """It rocks from heel to toe. With widths by gravity alone derivatives are up to 60 times the slope, their mean twice it."""
    scene = mg.load_scene(_FOOT).with_engine("mujoco")
    time = 4e-3 * jnp.arange(75)

    def turning(place, contact):
        controls = 0.6 * jnp.sin(2 * jnp.pi * 6 * time + place)
        start = mg.initial_state(
            scene, qpos=jnp.stack([-0.06, 0.0, 0.05 + 0.1 * place]), qvel=jnp.array([-0.6, 0.1, 0])
        )
        return mg.rollout(scene, start, controls[:, None], contact=contact).qvel[-1, 2]

    places = jnp.linspace(-1, 1, 128)
    values, derivatives = jax.jit(jax.vmap(jax.value_and_grad(lambda x: turning(x, mg.Onset()))))(places)
    mujocos = jax.jit(jax.vmap(lambda x: turning(x, mg.Discrete())))(places)
    slope = (values[-1] - values[0]) / 2
    assert np.abs(derivatives).max() < 15 * np.abs(slope)
    assert np.abs(derivatives.mean() - slope) < 3 * derivatives.std() / np.sqrt(128)
    # The bound of the width: without it the foot stops short of the floor, and its slope is three quarters of MuJoCo's.
    assert np.abs(slope - (mujocos[-1] - mujocos[0]) / 2) < 0.15 * np.abs(slope)


@pytest.mark.slow
def test_a_derivative_that_has_grown_beyond_belief_is_flagged():
    """A pendulum of 1 cm on its head falls away as exp(t √(3g/2l)), in 0.4 s by exp(15). A free flight grows by its duration."""
    unstable = mg.load_scene("""<mujoco><worldbody><body><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 .01" size=".0001"/></body></worldbody></mujoco>""")
    fall = mg.rollout(unstable, mg.initial_state(unstable), horizon=200, measure_growth=True)
    assert fall.explodes
    free = mg.load_scene(
        _PUSHED.replace('type="plane"', 'type="plane" pos="0 0 -9"').format(timestep=1e-3, kind="sphere", turning="")
    )
    flight = mg.rollout(free, mg.initial_state(free), horizon=20, measure_growth=True)
    assert not flight.explodes
    assert 0.5 < flight.growth < 2
    assert not mg.rollout(free, mg.initial_state(free), horizon=20).explodes


def test_a_weight_that_rounds_to_one_keeps_its_derivative():
    """In single precision that of several contacts just short of whole does, and nothing is left of the step before them."""
    block = object.__new__(Block)
    for name, value in {"residual": jnp.zeros(5), "rows_each": 1}.items():
        object.__setattr__(block, name, value)

    def weight_and_before(shares):
        (_, before), weight, *_ = _split([block], [jnp.append(shares, jnp.float32(1))], [None])
        return weight, before

    shares = 1 - jnp.array([2, 3, 1, 3], jnp.float32) * 2.0**-24
    weight, _ = weight_and_before(shares)
    assert weight == 1
    assert np.isfinite(jax.jacrev(lambda x: weight_and_before(x)[1])(shares)).all()
