"""The gradient "event" against slopes of simulated outcomes, and where it must not differ from the discrete one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.cube_toss import cube_toss
from mjxgrad.dynamics import check_gradient, step

# Impacts of everything that can begin, each on a body of its own and without gravity. All move at 1 m/s or 1 rad/s towards a stop
# 5 mm or 5 mrad away (the one with a margin of 1 cm meets it as far off), onto MuJoCo's default contact.
_SCENE = """
<mujoco>
  <option timestep="{timestep}" gravity="0 0 0" cone="{cone}" integrator="{integrator}" tolerance="1e-12" iterations="50"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom type="plane" size="9 9 .1" conaffinity="1" friction=".6 .01 .001" condim="1"/>
    {bodies}
  </worldbody>
  {tendon}
</mujoco>
"""
_TENDON = '<tendon><fixed limited="true" range="-.005 9"><joint joint="t" coef="1"/></fixed></tendon>'


def _half(offset):
    """Half the angle of the ball joint: the offset before 5 mrad before its limit of half a radian."""
    return 0.5 * (0.495 - offset)


# Per kind of row: the body, its position for a start that is farther off by the offset, its velocity, and how far it has come.
_KINDS = {
    "condim 1": (
        '<body pos="0 0 .105"><joint type="slide" axis="0 0 1"/><geom size=".1" condim="1" contype="1"/></body>',
        lambda x: [x],
        [-1],
        lambda q: q[0],
    ),
    "condim 3": (
        '<body pos="1 0 .105"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>'
        '<geom size=".1" condim="3" contype="1"/></body>',
        lambda x: [x, 0.0],
        [-1, 0.3],
        lambda q: q[0],
    ),
    "slide": (
        '<body pos="0 4 1"><joint type="slide" axis="0 0 1" range="-.005 1"/><geom size=".1"/></body>',
        lambda x: [x],
        [-1],
        lambda q: q[0],
    ),
    "condim 6": (
        '<body pos="2 0 .105"><freejoint/><geom size=".1" condim="6" contype="1"/></body>',
        lambda x: [2.0, 0.0, 0.105 + x, 1.0, 0.0, 0.0, 0.0],
        [0.3, 0, -1, 0, 0, 0],
        lambda q: q[2],
    ),
    "margin": (
        '<body pos="3 0 .115"><joint type="slide" axis="0 0 1"/><geom size=".1" condim="1" contype="1" margin=".01"/></body>',
        lambda x: [x],
        [-1],
        lambda q: q[0],
    ),
    "hinge": (
        '<body pos="1 4 1"><joint axis="0 1 0" range="-57 .28648"/><geom size=".1"/></body>',
        lambda x: [-x],
        [1],
        lambda q: -q[0],
    ),
    "ball": (
        '<body pos="2 4 1"><joint type="ball" range="0 28.6479"/><geom size=".1"/></body>',
        lambda x: [jnp.cos(_half(x)), 0.0, jnp.sin(_half(x)), 0.0],
        [0, 1, 0],
        lambda q: -2 * jnp.arctan2(q[2], q[0]),
    ),
    "tendon": (
        '<body pos="3 4 1"><joint name="t" type="slide" axis="0 0 1"/><geom size=".1"/></body>',
        lambda x: [x],
        [-1],
        lambda q: q[0],
    ),
}
_NUM_TEETH = 4


@functools.cache
def _impacts(kinds: tuple[str, ...], integrator: str = "Euler", cone: str = "pyramidal", timestep: float = 5e-4):
    """Return the outcome of impacts as a function of how far off they start, and the offsets of whole teeth."""
    bodies, starts, speeds, reads = zip(*(_KINDS[kind] for kind in kinds), strict=True)
    settings = {"timestep": timestep, "cone": cone, "integrator": integrator}
    tendon = _TENDON if "tendon" in kinds else ""
    scene = mg.load_scene(_SCENE.format(bodies="".join(bodies), tendon=tendon, **settings), keep_everything=True)
    ends = np.cumsum([len(start(0.0)) for start in starts])

    def outcome(offset, gradient):
        qpos = jnp.concatenate([jnp.stack([jnp.asarray(q, float) for q in start(offset)]) for start in starts])
        state = mg.initial_state(scene, qpos=qpos, qvel=np.concatenate(speeds).astype(float))
        end = mg.rollout(scene, state, horizon=round(0.16 / timestep), gradient=gradient).qpos[-1]
        return jnp.stack([read(part) for read, part in zip(reads, jnp.split(end, ends[:-1]), strict=True)])

    return outcome, jnp.linspace(0, _NUM_TEETH * timestep, 8 * _NUM_TEETH + 1)


@functools.cache
def _forward(kinds: tuple[str, ...], integrator: str = "Euler", cone: str = "pyramidal"):
    """Return outcomes, and the derivative of either gradient in forward mode, at all offsets."""
    outcome, offsets = _impacts(kinds, integrator, cone)

    def both(offset, gradient):
        return jax.jvp(lambda x: outcome(x, gradient), (offset,), (jnp.ones_like(offset),))

    results = {g: jax.jit(jax.vmap(functools.partial(both, gradient=g)))(offsets) for g in ("discrete", "event")}
    return jax.tree.map(np.asarray, results)


def _check_means(kinds: tuple[str, ...], integrator: str, cone: str) -> None:
    """The mean over phases is the slope, to 5 % of the larger of the slope and the discrete derivative's error."""
    results = _forward(kinds, integrator, cone)
    simulated = results["discrete"][0]
    slope = (simulated[-1] - simulated[0]) / (_NUM_TEETH * 5e-4)
    # The trapezoidal mean over whole teeth, whose two ends are the same phase.
    discrete, event = (0.5 * (d[:-1] + d[1:]).mean(axis=0) for _, d in (results["discrete"], results["event"]))
    error = np.abs(event - slope) / np.maximum(np.abs(slope), np.abs(discrete - slope))
    assert np.all(error < 0.05), dict(zip(kinds, error, strict=True))
    # It is worth correcting: the true slope is minus the restitution.
    assert np.all(np.abs(discrete - slope) > 3 * np.abs(slope))


_SMALL = ("condim 1", "condim 3", "slide")


def test_the_mean_over_phases_is_the_slope_of_the_outcome():
    _check_means(_SMALL, "Euler", "pyramidal")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "cone"),
    [("Euler", "pyramidal"), ("Euler", "elliptic"), ("implicitfast", "pyramidal"), ("RK4", "pyramidal")],
)
def test_the_mean_is_the_slope_for_every_row_that_begins(integrator, cone):
    _check_means(tuple(_KINDS), integrator, cone)


@pytest.mark.slow
def test_the_motion_is_the_same():
    """To the last bit; beside a derivative but for rounding, which differs between two programs and 320 steps amplify."""
    outcome, offsets = _impacts(_SMALL)
    alone = [jax.jit(jax.vmap(lambda x, g=name: outcome(x, g)))(offsets) for name in ("discrete", "event")]
    np.testing.assert_array_equal(*alone)
    results = _forward(_SMALL)
    np.testing.assert_allclose(results["event"][0], results["discrete"][0], rtol=1e-10)


@pytest.mark.slow
def test_both_modes_agree():
    """Reverse mode is the transpose of the same rule: rounding alone, here amplified by 320 steps."""
    outcome, offsets = _impacts(_SMALL)
    backward = jax.jit(jax.vmap(jax.grad(lambda x: jnp.sum(outcome(x, "event") * jnp.arange(1, 4)))))(offsets)
    forward = _forward(_SMALL)["event"][1] @ np.arange(1, 4)
    np.testing.assert_allclose(backward, forward, rtol=1e-8)


_STILL = """
<mujoco>
  <option timestep=".002" tolerance="1e-12" iterations="50"/>
  <worldbody>
    <geom type="plane" size="9 9 .1" {solimp}/>
    <body pos="0 0 {height}"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
      <geom size=".1" {solimp}/></body>
  </worldbody>
</mujoco>
"""


def _jacobians(scene: mg.Scene, qpos, qvel):
    def moved(gradient):
        def function(x):
            data = scene.data.replace(qpos=x[:2], qvel=x[2:])
            after = step(scene.model, data, gradient=gradient)
            return jnp.concatenate([after.qpos, after.qvel])

        return jax.jit(jax.jacfwd(function))(jnp.concatenate([jnp.asarray(qpos, float), jnp.asarray(qvel, float)]))

    return moved("discrete"), moved("event")


@pytest.mark.parametrize("sideways", [0.0, 0.5], ids=["resting", "sliding"])
def test_nothing_changes_for_a_contact_that_stays(sideways):
    scene = mg.load_scene(_STILL.format(height=0.1, solimp=""))
    discrete, event = _jacobians(scene, [-2e-4, 0], [-1e-6, sideways])
    # Two programs, so up to rounding.
    np.testing.assert_allclose(event, discrete, rtol=1e-14, atol=1e-14)


def test_a_contact_that_begins_changes_the_derivative_by_its_impulse_over_its_speed():
    """By hand: the impulse of one step, per distance, for constant impedance d.

    At r = 0 the row asks for a_ref = -B v and gets a = (1 - s) a_free + s a_ref, s = 1 / (1 + R / A), R = (1 - d) Â / d, with the
    inverse mass A and MuJoCo's estimate of it, Â. A pyramid of friction 1 has R four times as large on each of four edges.
    """
    scene = mg.load_scene(_STILL.format(height=0.1, solimp='solimp=".8 .8 .01 .5 2" friction="1"'))
    timestep, speed, impedance, damping = 0.002, 1.0, 0.8, 2 / (0.8 * 0.02)
    estimate = float(scene.model.body_invweight0[1, 0]) * float(scene.model.body_mass[1])
    share = 1 / (1 + (1 - impedance) / impedance * estimate)
    free = -9.81
    gained = share * (damping * speed - free)
    # Half the speed at which gravity and the contact's own rates balance; more than a step's fall.
    grazing = (9.81 / (2 * (damping + 1 / (impedance * 0.02)))) ** 2
    expected = -gained * speed / (speed**2 + grazing)
    discrete, event = _jacobians(scene, [-0.5 * timestep * speed, 0], [-speed, 0])
    assert event[2, 0] - discrete[2, 0] == pytest.approx(expected, rel=1e-9)
    # What is gained in velocity acts on the position of the same step.
    assert event[0, 0] - discrete[0, 0] == pytest.approx(timestep * expected, rel=1e-9)
    # No other column changes: only the distance decides when contact begins.
    np.testing.assert_array_equal(event[:, 1:], discrete[:, 1:])


def test_nothing_changes_where_force_begins_at_zero():
    """With d0 = 0, which MuJoCo takes as 1e-4, the jump is that share of the free acceleration."""
    scene = mg.load_scene(_STILL.format(height=0.1, solimp='solimp="0 .95 .01 .5 2"'))
    discrete, event = _jacobians(scene, [-0.001, 0], [-1.0, 0])
    np.testing.assert_allclose(event, discrete, atol=0.03)


@pytest.mark.slow
def test_a_grazing_contact_leaves_the_discrete_derivative():
    """At a thousandth of 5 cm/s the term must be about a thousandth of its size at that speed, not a thousand times as large."""
    scene = mg.load_scene(_STILL.format(height=0.1, solimp=""))
    terms = []
    for speed in (0.05, 5e-5):
        discrete, event = _jacobians(scene, [-0.5 * 0.002 * speed, 0], [-speed, 0])
        terms.append(abs(event[2, 0] - discrete[2, 0]))
    assert terms[0] > 100  # 1/s: a landing at 5 cm/s is still felt
    assert terms[1] < 3e-3 * terms[0]


@pytest.mark.slow
def test_an_edge_that_rolls_unloaded_does_not_blow_up():
    """A thrown cube ends on an edge that hops by less than a micrometre, hundreds of times: each hop an event."""
    task = cube_toss("default", timestep=2.5e-4)

    def sideways(speed, gradient):
        trajectory = mg.rollout(task.scene, task.start(speed), horizon=4000, gradient=gradient)
        return trajectory.qpos[::400, 1]

    slopes = [
        jax.jit(lambda x, g=g: jax.jvp(lambda s: sideways(s, g), (x,), (jnp.ones_like(x),))[1])(jnp.array(-2.0))
        for g in ("discrete", "event")
    ]
    # Nothing fast happens in the second half: the derivative may not grow by orders of magnitude there.
    assert np.abs(slopes[1]).max() < 10 * np.abs(slopes[0]).max()


@pytest.mark.slow
def test_nested_batches_of_derivatives_agree():
    """Batches inside and outside of the derivative, over the state and over the softness."""
    scene = mg.load_scene(_STILL.format(height=0.1, solimp=""))
    stiffness, offsets = jnp.array([2e3, 4e3]), jnp.array([-0.0005, -0.0015])

    def velocity(offset, k):
        soft = scene.with_softness(mg.Softness(stiffness=k, damping_ratio=1.0))
        state = mg.initial_state(scene, qpos=jnp.array([offset, 0.0]), qvel=jnp.array([-1.0, 0.0]))
        return mg.rollout(soft, state, horizon=2, gradient="event").qvel[-1, 0]

    def inner(offset):
        return jax.jvp(lambda x: jax.vmap(lambda k: velocity(x, k))(stiffness), (offset,), (1.0,))[1]

    within = jax.jit(jax.vmap(inner))(offsets)
    outside = jax.jit(jax.vmap(lambda x: jax.vmap(lambda k: jax.grad(velocity)(x, k))(stiffness)))(offsets)
    np.testing.assert_allclose(within, outside, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_foot_that_another_impact_makes_slip_is_accounted_for(cone):
    """A plank under gravity lands on one end, then on the other, whose impact makes the first slip."""
    scene = mg.load_scene(f"""
    <mujoco>
      <option timestep=".0005" cone="{cone}" tolerance="1e-12" iterations="50"/>
      <worldbody>
        <geom type="plane" size="9 9 .1" friction=".3"/>
        <body pos="0 0 .1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
          <geom type="box" size=".3 .05 .02" contype="0" conaffinity="0"/>
          <geom size=".03" pos="-.3 0 -.02" friction=".3"/><geom size=".03" pos=".3 0 -.02" friction=".3"/></body>
      </worldbody>
    </mujoco>""")

    def outcome(offset, gradient):
        state = mg.initial_state(scene, qpos=jnp.stack([0.0, offset - 0.005, 0.1]), qvel=jnp.array([0.3, -0.8, 0.0]))
        return mg.rollout(scene, state, horizon=240, gradient=gradient).qpos[-1]

    offsets = jnp.linspace(0, 0.01, 65)
    simulated = np.asarray(jax.jit(jax.vmap(lambda x: outcome(x, "discrete")))(offsets))
    means = {}
    for gradient in ("discrete", "event"):
        each = np.asarray(jax.jit(jax.vmap(jax.jacfwd(functools.partial(outcome, gradient=gradient))))(offsets))
        means[gradient] = 0.5 * (each[:-1] + each[1:]).mean(axis=0)
    slope = (simulated[-1] - simulated[0]) / 0.01
    scale = np.maximum(np.abs(slope), np.abs(means["discrete"] - slope))
    assert np.all(np.abs(means["event"] - slope) < 0.05 * scale), (slope, means)


def test_an_unknown_gradient_is_answered_with_the_choices():
    with pytest.raises(ValueError, match="gradient must be one of 'discrete', 'event', got 'evnt'"):
        check_gradient("evnt")
