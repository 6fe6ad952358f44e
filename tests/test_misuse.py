"""Wrong calls are answered in a sentence: in a process without the checks of types, which would answer first."""

import json
import os

import pytest

from tests.processes import once, run_python

SETUP = """
import functools, json, sys, tempfile, warnings
import equinox as eqx, jax, jax.numpy as jnp, mujoco, numpy as np, optax
import mjxgrad as mg
from mjxgrad import cli, diagnostics, envs, estimators, identification as fit, planning
from mjxgrad.envs import gym
from mjxgrad.estimators import rules
from mjxgrad.identification.parameters import Coordinates
from mjxgrad.identification.recording import stack
from mjxgrad.stepping import own_motion

key, params = jax.random.key(0), jnp.array([1.0, 2.0])
noisy = mg.parameter_noise(lambda x: x @ x, 0.1)
scene = mg.load_scene("<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody>"
                      "<actuator><motor joint='joint'/></actuator></mujoco>".replace("<joint ", "<joint name='joint' "))
state = mg.initial_state(scene)
bounded = mg.load_scene("<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='.1'/></body></worldbody>"
                        "<actuator><motor name='motor' joint='j' ctrlrange='-1 1'/></actuator></mujoco>")
balls = mg.load_scene("<mujoco><worldbody><geom name='floor' type='plane' size='1 1 1'/><geom name='lamp' size='.1' contype='0' "
                      "conaffinity='0'/><body><freejoint name='root'/><geom name='ball' size='.1'/></body><body pos='1 0 1'>"
                      "<freejoint/><geom name='other' size='.1'/></body></worldbody></mujoco>")
strung = mg.load_scene("<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='.1'/></body></worldbody><tendon>"
                       "<fixed name='t'><joint joint='j' coef='1'/></fixed></tendon></mujoco>", engine="mujoco")
still = mg.initial_state(balls, qpos=balls.data.qpos.at[2].set(1.0))
archive = tempfile.mkdtemp() + "/run.npy"
np.save(archive, np.zeros(3))


def first(cost=None, count=8, at=params, key=key, objective=None):
    objective = objective or (noisy if cost is None else mg.parameter_noise(cost, 0.1))
    return estimators.first_order(objective, at, key, num_samples=count)


def optimise(**how):
    given = {"estimator": functools.partial(estimators.first_order, num_samples=4), "optimiser": optax.sgd(0.1), "num_steps": 2}
    return mg.optimise(how.pop("objective", noisy), how.pop("at", params), how.pop("key", key), **given | how)


def task(cost):
    return mg.SceneTask(scene, state, cost, 2).run(jnp.zeros((2, 1)))


def roll(*arguments, **how):
    return mg.rollout(scene, state, *arguments, **how)


def zeroth(estimator=estimators.zeroth_order, **how):
    return estimator(noisy, params, key, **how)


def elite(count, **how):
    return mg.baselines.cross_entropy(noisy, params, key, num_samples=8, num_elite=count, num_steps=2, **how)


def softer(*parts, scene=balls, **how):
    return scene.with_softness(mg.Softness(*parts, **how))


def measured(**how):
    given = {"params": params[None], "key": key, "softness": jnp.ones(2), "num_samples": 8}
    return diagnostics.bias_variance(lambda width: noisy, **given | how)


def jumps(function=lambda x: x, interval=(0.0, 1.0), **how):
    return diagnostics.jumps_along(function, interval, **how)


line = diagnostics.phases((0.2, 0.7), 64)
system = planning.FunctionSystem(lambda x, u: jnp.zeros(2) + u.sum(), 2, 2)


def planned(**how):
    given = {"controls": np.zeros((3, 2)), "smoother": planning.Exact(), "schedule": np.ones(1), "key": key}
    return planning.optimise_trajectory(system, planning.GoalCost(*jnp.ones((3, 2)), 0.1), jnp.zeros(2), **given | how)


def decided(state=(0.0, 0.0), **how):
    given = {"controls": np.zeros((3, 2))} | how
    return planning.Controller(system, planning.GoalCost(*jnp.ones((3, 2)), 0.1), **given)(np.array(state))


five, wrong = np.zeros(5), np.zeros((3, 1))
data, u = mujoco.MjData(scene.mj_model), jnp.zeros((2, 1))
course = mg.SceneTask(scene, state, lambda trajectory: trajectory.qpos[-1, 0], 2)
hinged = mg.load_scene("<mujoco><worldbody><body><joint name='h' range='-90 90'/><geom size='.1'/></body></worldbody></mujoco>")


def learn(key=key, environment=None, **how):
    return mg.learning.learn(environment or cart, key, **{"num_updates": 1} | how)


def warned(call, *arguments, **how):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        call(*arguments, **how)
    raise told[0].message


def identify(measured=five, recordings=None, **how):
    controls = np.zeros((len(measured) - 1, 1))
    recordings = [fit.Recording({"qpos": measured}, controls)] if recordings is None else recordings
    return mg.identify(scene, {"a": fit.Parameter(1.0)}, recordings, **how)


cart = envs.load("diffrl_cartpole")
limited = mg.load_scene("<mujoco><worldbody><body><joint name='h'/><geom size='.1'/></body></worldbody>"
                        "<actuator><motor joint='h' ctrlrange='-1 1'/></actuator></mujoco>", engine="mujoco")


class Leaving(planning.Cost):
    def stage(self, system, state, control):
        return float(state[0])

    def terminal(self, system, state):
        return 0.0


class Squares(planning.LeastSquares):
    stages: callable = lambda x: x
    ends: callable = lambda x: x

    def residuals(self, system, state, control):
        return self.stages(state)

    def terminal_residuals(self, system, state):
        return self.ends(state)


def squares(**how):
    return planning.Controller(system, Squares(**how), np.zeros((3, 2)))


class Checked(envs.Environment):
    def observe(self, state, memory):
        return state.qpos if state.qpos[0] > 0 else -state.qpos

    def rewards(self, before, action, after, memory):
        return {"a": 1.0}


class Rewarded(envs.Environment):
    terms: dict = eqx.field(static=True, default=None)
    seen: float = None

    def observe(self, state, memory):
        return state.qpos if self.seen is None else self.seen

    def rewards(self, before, action, after, memory):
        return self.terms or {"a": 1.0}


def elite_policy():
    policy, zero = mg.linear_policy(2, 1)
    noisy = mg.closed_loop(mg.SceneTask(scene, state, len, 2), policy, 0.3, params=zero)
    return mg.baselines.cross_entropy(noisy, zero, key, num_samples=4, num_elite=2, num_steps=1)


def answer(call):
    try:
        eval(call)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "no error"


print(json.dumps({call: answer(call) for call in json.loads(sys.argv[1])}))
"""
FOUND = {
    "first(objective=lambda x: x @ x)": "objective must be an Objective (wrap a function by mg.parameter_noise",
    "first(cost=lambda x: {'cost': x @ x})": "function must return one number, got dict",
    "first(cost=lambda x: x)": "function must return a scalar of shape (), got shape (2,)",
    "first(count=2.5)": "num_samples must be a whole number, got 2.5",
    "jax.jit(lambda n: first(count=n))(8)": "num_samples must be known before anything is compiled, got a traced value",
    "first(at=jnp.zeros(0))": "params must have at least one number, got none",
    "first(key=jax.random.split(key, 3))": "key must be one of jax.random.key, got an array of shape (3,)",
    "estimators.alpha_order(noisy, params, key, num_samples=8, rule='consistent')": "rule must be one of mg.estimators.rules",
    "estimators.rules.FixedAlpha(3.0)": "alpha must be from 0 to 1, got 3.0",
    "optimise(annealing=0.5)": "annealing must be a function of step, got float",
    "optimise(estimator='first_order')": "estimator must be a function of objective and params and key, got str",
    "optimise(estimator=lambda objective, params, key: params)": "estimator must return a GradientEstimate, got",
    "optimise(optimiser='adam')": "optimiser must be of optax with its settings, as optax.adam(1e-2), got str",
    "optimise(optimiser=optax.adam)": "optimiser must be of optax with its settings, as optax.adam(1e-2), got function",
    "optimise(num_steps=2.5)": "num_steps must be a whole number, got 2.5",
    "optimise(key=0)": "key must come from jax.random.key, with at most one leading axis, got int64 of shape ()",
    "optimise(at=jnp.array([1.0, jnp.nan]))": "params must be finite at the start, got [ 1. nan]",
    "jax.jit(lambda x: optimise(at=x))(params)": "optimise must be called outside of jax.jit and jax.vmap",
    "optimise(checkpoint=archive)": "checkpoint must be a file that a run has saved, got ",
    "mg.rollout(scene, scene.data, horizon=2)": "state must be of mg.initial_state, or the end of a rollout, got Data",
    "mg.rollout(scene.model, state, horizon=2)": "scene must be of mg.load_scene, got Model",
    "mg.rollout(scene, state, horizon=2.5)": "horizon must be a whole number, got 2.5",
    "jax.jit(lambda n: mg.rollout(scene, state, horizon=n))(2)": "horizon must be known before anything is compiled",
    "mg.rollout(scene, state, lambda p, s: (jnp.zeros(1), s), horizon=2)": "one control per actuator, shape (1,), got tuple",
    "task(lambda trajectory: {'cost': 1.0})": "one number per state, shape (3,), got dict",
    "mg.rollout(scene.with_model(geom_friction=jnp.full((1, 3), jnp.nan)), state, horizon=2)": "geom_friction must hold numbers",
    "mg.Softness(stiffness=jnp.inf)": "stiffness must be positive and finite, got inf",
    "jax.jit(lambda s: 1, static_argnums=0)(scene)": "make it an ordinary argument of jax.jit",
    "mg.load_scene('')": "got ''",
    "mg.load_scene('<mujoco/>', softness=1e4)": "softness must be mg.Softness, such as mg.Softness(stiffness=1e4), got float",
    "mg.rollout(scene, state, horizon=2, contact='slope')": 'mg.Onset() or mg.Smoothing(), got "slope"',
    "mg.Softness(geoms='ball')": "geoms must be a tuple of names, got 'ball'; write ('ball',)",
    # Rollouts, and where they begin.
    "roll(jnp.zeros((4, 2)))": "1 column, that of the actuator, shape (horizon, 1), got shape (4, 2)",
    "roll(jnp.zeros(4))": "that of the actuator, shape (horizon, 1), got shape (4,): take controls[:, None]",
    "planned(controls=np.zeros(2))": "2 columns, one per actuator, shape (horizon, 2), got shape (2,): "
        "to hold them for a horizon take jnp.tile(controls, (horizon, 1))",
    "planned(controls=np.zeros((2, 7)))": "got shape (2, 7): if its rows are those of actuators, transpose it",
    "roll(jnp.zeros(1), horizon=5)": "controls must have one row per step and 1 column",
    "mg.rollout(balls, still, jnp.zeros((3, 1)))": "no column, for there are no actuators, shape (horizon, 0), got shape (3, 1)",
    "roll(jnp.array([[0.0], [jnp.nan]]))": "controls must be finite, got nan in step 1 for actuator 0",
    "roll(jnp.zeros((4, 1)), noise=jnp.zeros((3, 1)))": "must agree on the number of steps, got controls 4",
    "roll()": "horizon must be given",
    "roll(lambda p, s: jnp.array(1.0), horizon=2)": "must return one control per actuator, shape (1,), got",
    "scene.with_engine('bullet')": "engine must be one of 'mjx', 'mujoco', 'warp', got 'bullet'",
    "roll(horizon=2, inputs={'ctrl': jnp.zeros((2, 2))})": "inputs must be among qfrc_applied",
    "roll(horizon=2, inputs={'qfrc_applied': jnp.zeros(3)})": "inputs['qfrc_applied'] must have shape (2, 1), one row per step",
    "mg.initial_state(scene, qpos=jnp.zeros(3))": "qpos must have shape (1,) in this scene, got (3,)",
    "mg.initial_state(balls, qpos=jnp.zeros(14))": "quaternion that is not zero, got zeros for root",
    "mg.initial_state(scene, qpos=jnp.array([jnp.nan]))": "qpos must be finite, got nan at 0",
    # Contact in a step.
    "mg.Onset(-0.1)": "width must be finite and not negative",
    "mg.step(balls.model, balls.data, contact=mg.Onset(jnp.ones(3)))": "width must be one value",
    "mg.Smoothing([1e-3, jnp.inf])": "length must be positive",
    "mg.Smoothing(1e-3, mode='both')": "mode must be one of 'forward', 'backward', got 'both'",
    "mg.Smoothing(1e-3, kernel='cauchy')": "kernel must be one of 'gaussian', 'logistic', 'log_barrier', got 'cauchy'",
    "mg.step(balls.model, balls.data, contact=mg.Smoothing([1e-3, 2e-3]))": "length must be one value for a step, got",
    "own_motion('event')": "gradient must be one of 'discrete', 'slope', got 'event'",
    "mg.contact_force(balls.model, balls.data, 'floor', 'bal')": "no geom 'bal'; named geoms are 'floor', 'lamp', 'ball'",
    "mg.contact_force(balls.model, balls.data, 'floor', 'lamp')": "can never touch",
    "mg.rollout(balls.with_engine('mujoco'), still, horizon=2, observe=lambda m, d: mg.contact_force(m, d, 'floor', 'ball'))":
        "data has no contact by C MuJoCo and Warp",
    # What would take all memory, or counts that are none.
    "roll(horizon=10**12)": "horizon must be at most 2147483647, got 1000000000000",
    "roll(horizon=True)": "horizon must be a whole number, got True",
    "jax.jit(jax.vmap(lambda z: roll(jnp.full((10**5, 1), z))))(jnp.zeros(10**6))":
        "1000000 rollouts of 100000 steps would take",
    "first(count=10**12)": "num_samples must be at most 2147483647",
    "optimise(num_steps=10**12)": "num_steps must be at most 2147483647",
    "learn(settings=mg.learning.Settings(num_environments=2**31 - 4))": "2147483644 environments would take",
    "mg.render.frames(scene, np.zeros((3, 1)), speed=1e-9)": "frames would take",
    "mg.render.frames(scene, np.zeros((3, 1)), speed=jnp.inf)": "speed must be positive, got inf",
    "mg.render.frames(scene, np.zeros((3, 1)), fps='30')": "fps must be real numbers, got str",
    "mg.render.frames(scene, np.zeros((2, 3, 1)))": "got (2, 3, 1): draw one motion at a time, such as qpos[0]",
    "mg.render.tile([])": "videos must have one size, each of shape (frames, height, width, 3), got none",
    "mg.render.tile([np.zeros((1, 8, 8, 3))], ['a', 'b'])": "captions must be 1, one for each video, got 2",
    "mg.check_stability(balls, speed='2')": "speed must be real numbers, got str",
    "mg.render.frames(scene, 'rest')": "qpos must be real numbers, got str",
    "mg.render.write_video('x.gif', np.zeros((3, 8, 8, 3)))": "path must be of a file that ends in .mp4, got x.gif",
    "mg.over_devices(3)": "function must be a function of arrays, got int",
    "mg.over_devices(len, num_shared='a')": "num_shared must be a whole number, got 'a'",
    # Tasks, environments and policies.
    "mg.SceneTask(state, scene, len, 2)": "scene must be of mg.load_scene, got State",
    "mg.SceneTask(scene, None, len, 2)": "state must be of mg.initial_state",
    "mg.SceneTask(scene, state, None, 2)": "cost must be a function of trajectory, got NoneType",
    "mg.SceneTask(scene, state, len, 2, policy_sees='x')": "policy_sees must be one of 'state', 'observations', got 'x'",
    "roll(jnp.zeros((2, 1)), measure_growth='yes')": "measure_growth must be True or False, got str",
    "roll(jnp.zeros((2, 1)), inputs=[1.0])": "inputs must be a dict of arrays by name, got list",
    "mg.linear_policy(4, 1, observe=3)": "observe must be a function of state, got int",
    "mg.parameter_noise(jnp.sum, 0.1, dim=2.0)": "dim must be a whole number, got 2.0",
    "mg.parameter_noise(jnp.sum, jnp.inf)": "stddev must be positive and finite, got inf",
    "mg.load_scene('<mujoco/>', engine='brax')": "engine must be one of 'mjx', 'mujoco', 'warp', None, got 'brax'",
    "mg.load_scene('<mujoco/>', keep_everything='no')": "keep_everything must be True or False, got str",
    "optimise(estimator=None)": "estimator must be a function of objective and params and key, got NoneType",
    "optimise(evaluate=lambda x: x)": "evaluate must return a scalar of shape (), got shape (2,)",
    "optimise(bogus=3)": "an option must be one of 'evaluate', 'evaluate_every'",
    "optimise(checkpoint='.')": "checkpoint must be the path of a file, got the folder '.'; add a name",
    "optimise(progress='bar')": "progress must be True or False, got str",
    "estimators.alpha_order(noisy, params, key, num_samples=4, memory=3)": "memory must be the memory of an estimate, got int",
    "mg.learning.Settings(actor_layers='32')": "actor_layers must be a tuple of whole numbers, such as (64, 64), got str",
    "mg.learning.Settings(actor_layers=(3.5,))": "actor_layers[0] must be a whole number, got 3.5",
    "mg.learning.Settings(actor_rate=jnp.inf)": "actor_rate must be positive, got inf",
    "mg.learning.Settings(actor_decay=-1)": "actor_decay must be positive, got -1",
    "mg.learning.Settings(has_critic='no')": "has_critic must be True or False, got str",
    "mg.learning.evaluate(cart, None, key, num_episodes=2)": "policy must be a function of obs, got NoneType",
    "mg.learning.evaluate('ant', len, key, num_episodes=2)": "environment must be of mg.envs.Environment, got str",
    "mg.learning.evaluate(cart, len, key, num_episodes=2, engine='bullet')": "engine must be one of 'mjx', 'mujoco', 'warp', got",
    "mg.learning.Policy.load('nix.npz')": "which does not exist",
    "mg.learning.Policy.load(archive)": "path must be of a policy that save wrote, got",
    "cart.step(state, jnp.zeros(1))": "state must be of reset or step, got State",
    "Rewarded(scene, terms={'a': 'b'}).reset(key)": "'a' in rewards of Rewarded must return one number, got str",
    "Rewarded(scene, seen=3.0).reset(key)": "observe of Rewarded must return a vector, got shape ()",
    "Rewarded(state)": "scene must be of mg.load_scene, got State",
    "Rewarded(scene, randomisation=3)": "randomisation must be a function of key and scene, got int",
    # Softness.
    "mg.Softness(damping_ratio=-1)": "damping_ratio must be at least 0",
    "mg.Softness(impedance=1.5)": "impedance must be between 0 and 1",
    "mg.Softness(width=0)": "width must be positive",
    "mg.Softness(margin=-0.1)": "margin must be finite and at least 0",
    "mg.Softness(rest_acceleration=9.81)": "must come with a margin",
    "mg.Softness(margin=0.1, rest_acceleration=0)": "rest_acceleration must be positive",
    "mg.Softness(geoms=('a',), pairs=(('a', 'b'),))": "either geoms or pairs",
    "softer(9e2, 1.0, geoms=('flor',))": "those that can: ",
    "softer(9e2, 1.0, pairs=(('ball', 'floor'),))": "would also change the pair",
    "balls.with_softness(mg.Softness(stiffness=[1, 2], damping_ratio=1))": "stiffness must be one value",
    # Scenes.
    "mg.load_scene(3)": "source must be an MJCF file",
    "mg.load_scene('.')": "got the folder",
    "mg.load_scene('<mujoco/>', timestep=0.0)": "timestep must be positive",
    "mg.load_scene('<mujoco><option timestep=\"nan\"/></mujoco>')": "must have a positive time step, got",
    "mg.load_scene('<mujoco><worldbody><body><joint/><geom size=\".1\" friction=\"nan 0 0\"/></body></worldbody></mujoco>')":
        "must hold numbers, got NaN in geom_friction",
    "jax.vmap(balls.with_softness)(mg.Softness(stiffness=[1e2, 1e3], damping_ratio=[1, 1])).summary()":
        "one scene with known values",
    "mg.load_scene('<mujoco><worldbody><geom size=\".1\"/></worldbody></mujoco>')": "got none (nv = 0)",
    "scene.with_model(dof_dampng=jnp.ones(1))": "numbers of the model, got dof_dampng; did you mean dof_damping",
    "scene.with_model(geom_type=jnp.ones(1))": "must name arrays of numbers of the model, got geom_type",
    "scene.with_model(dof_damping=5.0)": "dof_damping must have shape (1,) in this scene, got ()",
    "scene.with_model(body_mass=jnp.array([0.0, -1]))": "body_mass must not be negative, got -1",
    "scene.with_model(timestep=0.0)": "timestep must be positive, got 0",
    "scene.with_model(dof_damping=-5 * jnp.ones(1))": "dof_damping must not be negative, got -5",
    "scene.with_model(dof_frictionloss=jnp.array([-0.1]))": "dof_frictionloss must not be negative, got -0.1",
    "scene.with_model(geom_solmix=jnp.array([-1.0]))": "geom_solmix must not be negative, got -1",
    "strung.with_model(tendon_armature=jnp.array([-1.0]))": "tendon_armature must not be negative, got -1",
    "strung.with_model(tendon_damping=jnp.array([-1.0]))": "tendon_damping must not be negative, got -1",
    "strung.with_model(tendon_frictionloss=jnp.array([-1.0]))": "tendon_frictionloss must not be negative, got -1",
    "strung.with_model(tendon_lengthspring=jnp.array([[2.0, 1.0]]))": "tendon_lengthspring must have its lower ends first",
    "strung.with_model(tendon_range=jnp.array([[2.0, 1.0]]))": "tendon_range must have its lower ends first, got [2.0, 1.0]",
    "scene.with_model(actuator_forcerange=jnp.array([[1.0, -1.0]]))": "actuator_forcerange must have its lower ends first",
    "scene.with_model(jnt_axis=jnp.zeros((1, 3)))": "jnt_axis must have directions, got zeros",
    "limited.with_model(density=-1.0)": "density must not be negative, got -1",
    "limited.with_model(viscosity=-1.0)": "viscosity must not be negative, got -1",
    "limited.with_model(impratio=0.0)": "impratio must be positive, got 0",
    "limited.with_model(actuator_damping=-np.ones(1))": "actuator_damping must not be negative, got -1",
    "limited.with_model(actuator_armature=-np.ones(1))": "actuator_armature must not be negative, got -1",
    "scene.with_model(body_inertia=jnp.array([[0.0, 0, 0], [1, 1, 5]]))":
        "body_inertia must have no moment above the sum of the two others, which no body has, got [1.0, 1.0, 5.0]",
    "mg.load_scene(balls.mj_model, max_contacts=0)": "max_contacts must be at least 1, got 0; None has room for all",
    "mg.check_stability(balls, speed=0.0)": "speed must be positive",
    # Objectives and estimators.
    "first(count=1)": "num_samples must be at least 2, got 1",
    "zeroth(num_samples=8, chunk_size=0)": "chunk_size must be at least 1, got 0",
    "zeroth(num_samples=7, antithetic=True)": "num_samples must be even with antithetic pairs, got 7",
    "zeroth(num_samples=2, antithetic=True)": "num_samples must be at least 4 with antithetic pairs, got 2",
    "zeroth(num_samples=8, baseline='mean')": "baseline must be one of 'leave_one_out', 'zero_noise', 'none', got 'mean'",
    "first(objective=mg.parameter_noise(jnp.sum, 0.1, dim=1))": "params must have shape (1,), got (2,)",
    "first(at={'force': 1})": "params must have floating-point arrays",
    "mg.parameter_noise(jnp.sum, 0.0)": "stddev must be positive and finite, got 0.0",
    "mg.parameter_noise(jnp.sum, jnp.array([0.1, 0.2]), dim=3)": "stddev must be one number or 3, got shape (2,)",
    "noisy.sample_noise(key)": "dim is not known: pass dim",
    "mg.open_loop(mg.SceneTask(scene, state, len, 4), jnp.ones(3))": "stddev must broadcast to (horizon, nu) = (4, 1), got (3,)",
    "mg.open_loop(mg.SceneTask(balls, still, len, 4), 0.1)": "action noise needs controls, got a task of (horizon, nu) = (4, 0)",
    "rules.TrustRegion(failure_probability=0.95)": "failure_probability must be above 0 and at most 0.2, got 0.95",
    "rules.BiasConstrained(1.0, bound=1.0, failure_probability=1.0)": "failure_probability must be above 0 and at most 1.0",
    "mg.linear_policy(3, 1)[0](mg.linear_policy(3, 1)[1], jnp.zeros(2))": "must observe 3 numbers, got shape (2,)",
    "mg.linear_policy(3, 1)[0](mg.linear_policy(3, 1)[1], {'x': 0})": "state must be a vector or a State, got dict",
    "mg.linear_policy(3, 0)": "num_controls must be at least 1, got 0",
    # Optimisation and search.
    "optimise(evaluate_every=0)": "evaluate_every must be at least 1, got 0",
    "optimise(annealing=optax.constant_schedule(1.0))": "objective must be a function from a scale",
    "optimise(checkpoint='/nowhere/at/all.npz')": "checkpoint must be in a folder that exists",
    "optimise(at=jnp.zeros((3, 2)), key=jax.random.split(key, 4))": "params must have a leading axis only where key has the same",
    "optimise(at=jnp.zeros(()))": "params must be a vector of shape",
    "elite(9)": "num_elite must be at least 2 and at most num_samples = 8, got 9",
    "elite(2, stddev=-0.1)": "stddev must be positive",
    "elite(2, stddev=jnp.ones(3))": "stddev must be one number or 2",
    "elite_policy()": "stddev must be given for ClosedLoop",
    # Diagnostics.
    "measured(params=params)": "params must have shape (points, dim), got (2,)",
    "measured(num_samples=1)": "num_samples must be at least 2, got 1",
    "measured(num_reference=3)": "num_reference must be at least 4, got 3",
    "measured(softness={'a': jnp.ones(2), 'b': jnp.ones(3)})": "softness must have the same leading axis in every leaf",
    "measured(confidence=95.0)": "confidence must be between 0 and 1, got 95.0",
    "jumps(interval=(1.0, 1.0))": "interval must be two finite numbers",
    "jumps(num_points=100)": "num_points must be a multiple of num_candidates",
    "jumps(num_refinements=0)": "num_refinements must be at least 1",
    "jumps(lambda x: 1.0)": "function must return one value per parameter",
    "diagnostics.phases((0.0, 1.0), 31)": "num_phases must be at least 32, got 31",
    "diagnostics.compare_to_slope(line, line, [line[:-1]], ['short'])": "derivatives must hold one array",
    "diagnostics.compare_to_slope(line[::-1], line, [line], ['backwards'])": "parameters must be at least 32 and increase",
    # Planning.
    "planned(schedule=np.zeros(0))": "schedule must be one factor per iteration",
    "planned(schedule=np.array([1.0, 0.0]))": "schedule must be positive, got 0: for no smoothing take Exact()",
    "planned(lower=1.0, upper=0.0)": "lower must be at most upper",
    "planned(controls=np.zeros((3, 1)))": "2 columns, one per actuator, shape (horizon, 2), got shape (3, 1)",
    "decided(deadline=0.0)": "deadline must be positive, in seconds, or None, got 0.0",
    "decided(state=(0.0, 0.0, 0.0))": "state must have shape (2,) in this system, got (3,)",
    "decided(state=(0.0, np.nan))": "state must be finite, got [0.0, nan]",
    "system.with_contact(mg.Smoothing(0.1))": "analytic smoothing must be of a SceneSystem, got FunctionSystem",
    # Identification.
    "fit.Recording({'qpos': wrong}, times=[0, 1])": "measured and times of the recording must have the same number",
    "fit.Recording({'qpos': np.zeros(2)}, times=[1, 0])": "times of the recording must increase",
    "fit.Recording({'qpos': five}, noise={'qpso': 1})": "noise of the recording must name measured signals",
    "fit.Recording({'qpos': five}, noise={'qpos': 0.0})": "noise of qpos of the recording must be positive",
    "fit.Recording({'sensor': five}).cut(0.1, 0.01)": "must have measured qpos to be cut",
    "fit.Recording({'qpos': np.zeros(3)}, wrong)": "4 rows for 3 controls, one at each state",
    "stack(scene, [fit.Recording({'qpos': five}, wrong, 0.01 * np.arange(5))])": "controls of the recording must have a row",
    "stack(scene, [fit.Recording({'qpos': five}, np.zeros((4, 2)))])": "must have 1 columns in this scene",
    "stack(scene, [fit.Recording({'qvel': np.zeros((5, 2))})])": "qvel of the recording must have 1 columns",
    "stack(scene, [fit.Recording({'speed': five})])": "there is no sensor 'speed'",
    "identify(recordings=[])": "recordings must hold at least one",
    "identify(np.full(5, np.nan))": "got NaN alone",
    "identify(recordings=[fit.Recording({'qpos': five})])": "controls of the recording must be given in a scene with actuators",
    "identify(delay='b')": "delay must name one",
    "fit.Parameter(3.0, 0.0, 1.0)": "lower, nominal and upper must increase",
    "fit.Parameter([1.0, 2.0], [0.0, 0.0, 0.0])": "lower must be one number or of shape",
    "fit.Parameter(np.nan)": "nominal must be finite",
    "fit.armature(scene, 'joint')": "bounds of armature must be given",
    "fit.mass(scene, 'leg')": "there is no body 'leg'; named bodies are 'world'",
    "fit.softness(scene, 'hardness')": "part must be one of stiffness, damping_ratio, width",
    "Coordinates.of({})": "parameters must name at least one",
    # Environments.
    "cart.step(cart.reset(key), jnp.zeros(2))": "action must have shape (1,), got (2,)",
    "envs.diffrl.CartPole(scene, frame_skip=0)": "frame_skip must be at least 1, got 0",
    "cart.refined(0)": "times must be at least 1, got 0",
    "mg.render.write_video('no/such/v.mp4', np.zeros((2, 4, 4, 3), np.uint8))": "in an existing folder, got no/such/v.mp4",
    "roll(jnp.zeros((3, 1), complex))": "controls must be real numbers, got complex",
    "roll('abc')": "controls must be real numbers, got str",
    "mg.learning.learn([], key, num_updates=1)": "environment must be one mg.envs.Environment or several, got []",
    "mg.learning.Settings(window=0)": "window must be at least 1, got 0",
    "mg.learning.Settings(stddev=(0.1, 0.0))": "stddev must be positive",
    "mg.learning.Settings(window=16, critic_batches=5)": "critic_batches must divide the 1024 states of an update, got 5",
    "mg.learning.Settings(trace=0.9, has_critic=False)": "trace must be 1 without a value function, got 0.9",
    # Arguments of another kind, or in another place.
    "mg.linearise(scene, state, jnp.zeros(3))": "ctrl must have shape (1,), one number per actuator",
    "mg.step(scene, state)": "model must be MJX's, as scene.model; for a scene and a state see mg.rollout, got Scene",
    "mg.check_stability(scene.model)": "scene must be of mg.load_scene, got Model",
    "mg.check(balls, lambda trajectory: trajectory.qpos)": "a scalar of shape () or one number per state, shape (",
    "mg.check(balls, 3)": "cost must be a function of trajectory, got int",
    "mg.check(balls, seed=-3)": "seed must be at least 0, got -3",
    "mg.sweep(balls.mj_model, noise=0.0)": "noise must be positive and finite, got 0.0",
    "mg.SceneTask(scene, state, 3, 2)": "cost must be a function of trajectory, got int",
    "identify(recordings=fit.Recording({'qpos': five}))": "recordings must hold at least one, in a list, got a recording",
    "identify(recordings=['a.csv'])": "recordings must be of mg.identification.Recording, got str",
    "mg.identify(scene, {'a': 1.0}, [fit.Recording({'qpos': five})])": "parameters must be of mg.identification, such as",
    "fit.friction(scene)": "geoms that can touch, got none",
    "fit.friction(balls, 'floor/ball', 'ball')": "contacts must be named by geoms, or by pairs geom/geom, got floor/ball, ball",
    "mg.learning.learn(cart, key, num_updates=1, settings={})": "settings must be of mg.learning.Settings, got dict",
    "mg.learning.learn(cart, key, num_updates=1, checkpoint='/no/x.npz')": "checkpoint must be in a folder that exists",
    "planned(controls=np.full((3, 2), np.nan))": "controls must be finite",
    "planned(num_samples=2.5)": "num_samples must be a whole number, got 2.5",
    "planned(num_samples=2, stddev=-1.0)": "stddev must be at least 0 and finite, got [-1. -1.]",
    "planned(smoother='exact')": "smoother must be one of mg.planning, such as Exact()",
    "planning.SceneSystem(scene, num_substeps=2.5)": "num_substeps must be a whole number, got 2.5",
    "planning.GoalCost(jnp.zeros(2), jnp.ones(3), 1.0, 0.1).stage(system, jnp.zeros(2), jnp.zeros(2))":
        "stage_weight must be one number or have shape (2,), got (3,)",
    "planning.GoalCost(jnp.zeros(2), 1.0, [1.0, -1.0], 0.1)": "terminal_weight must be at least 0 and finite, got [ 1. -1.]",
    "mg.render.frames(scene, roll(horizon=2))": "qpos must be positions, got a trajectory: give its .qpos",
    "mg.render.write_video('v.mp4', np.zeros((2, 4)))": "video must have shape (frames, height, width, 3), got (2, 4)",
    # Functions: none, in place of a path, or of other arguments.
    "optimise(log=3)": "log must be a function of step and metrics, got int",
    "optimise(log=lambda metrics: None)": "log must be a function of step and metrics, got function: too many positional",
    "optimise(evaluate=3)": "evaluate must be a function of params, got int",
    "optimise(annealing='linear')": "annealing must be a function of step, got str",
    "optimise(estimator=estimators.first_order)": "argument: 'num_samples'",
    "optimise(estimator=functools.partial(estimators.first_order, num_samples=4, seed=0))": "unexpected keyword argument 'seed'",
    "learn(log=3)": "log must be a function of step and metrics, got int",
    "learn(log=lambda: None)": "log must be a function of step and metrics, got function",
    "identify(log=3)": "log must be a function of step and metrics, got int",
    "mg.check(balls, log=3)": "log must be a function of text, got int",
    "mg.sweep(balls, log=3)": "log must be a function of text, got int",
    "measured(progress=3)": "progress must be a function of done and total, got int",
    "elite(2, log=3)": "log must be a function of step and metrics, got int",
    "roll(u, observe=3)": "observe must be a function of model and data, got int",
    "roll(u, observe=lambda data: data.qpos)": "observe must be a function of model and data, got function: too many",
    "roll(lambda state: jnp.zeros(1), horizon=2)": "policy must be a function of params and state, got function: too many",
    "mg.SceneTask(scene, state, lambda: 0.0, 2)": "cost must be a function of trajectory, got Partial: too many",
    "mg.SceneTask(scene, state, len, 2, start_distribution=3)": "start_distribution must be a function of key, got int",
    "mg.SceneTask(scene, state, len, 2, observe=3)": "observe must be a function of model and data, got int",
    "mg.closed_loop(course, mg.linear_policy(2, 1), 0.1)": "policy must be a function of params and state, got tuple",
    "mg.parameter_noise(3, 0.1)": "function must be a function of params, got int",
    "mg.parameter_noise(0.1, lambda x: x @ x)": "function must be a function of params, got float",
    "mg.parameter_noise(lambda x, y: x @ y, 0.1)": "function must be a function of params, got function: missing",
    # Keys.
    "optimise(key=jax.random.PRNGKey(0))": "one leading axis, got uint32 of shape (2,)",
    "mg.estimated_gradient(noisy, 0, estimator=estimators.first_order)": "key must be one of jax.random.key, got 0",
    "learn(key=jnp.zeros(3))": "key must be of jax.random.key, got float32 of shape (3,)",
    "mg.learning.evaluate(cart, len, 0, num_episodes=2)": "key must be one of jax.random.key, got 0",
    "cart.reset(jax.random.split(key, 3))": "got an array of shape (3,); jax.vmap takes several",
    "measured(key=0)": "key must be one of jax.random.key, got 0",
    "first(key=np.random.default_rng(0))": "key must be one of jax.random.key, got Generator",
    # Counts, seeds and horizons.
    "mg.SceneTask(scene, state, len, 2.0)": "horizon must be a whole number, got 2.0",
    "mg.SceneTask(scene, state, len, 0)": "horizon must be at least 1, got 0",
    "mg.sweep(balls, horizon=2.5)": "horizon must be a whole number, got 2.5",
    "mg.sweep(balls, horizn=10)": "sweep() got an unexpected keyword argument 'horizn'",
    "mg.sweep(balls, contact='slope')": "contact must be mg.Discrete(), mg.Slope(), mg.Onset() or mg.Smoothing()",
    "cli.check(archive, budget=-1.0)": "--budget must be positive, got -1; --quick measures no derivatives",
    "mg.sweep(balls, num_samples=0)": "num_samples must be at least 2, got 0",
    "mg.check(balls, seed='a')": "seed must be a whole number, got 'a'",
    "mg.load_scene(scene.mj_model, max_contacts=2.5)": "max_contacts must be a whole number, got 2.5",
    "mg.render.frames(scene, jnp.zeros((2, 1)), width=64.5)": "width must be a whole number, got 64.5",
    "learn(num_updates='3')": "num_updates must be a whole number, got '3'",
    "mg.learning.Settings(num_environments=8.0)": "num_environments must be a whole number, got 8.0",
    "mg.learning.Settings(actor_layers=64)": "actor_layers must be a tuple of whole numbers, such as (64, 64), got int",
    # Numbers of another type: text, lists that are ragged, integers, None, objects.
    "roll([[0.0], [0.0, 1.0]])": "controls must be real numbers, got list",
    "mg.initial_state(scene, qvel=data)": "qvel must be real numbers, got MjData",
    "mg.initial_state(scene, state)": "qpos must be real numbers, got State",
    "scene.with_model(body_mass='1')": "body_mass must be real numbers, got str",
    "mg.load_scene(scene.mj_model, timestep='0.01')": "timestep must be real numbers, got str",
    "mg.check(balls, budget='1')": "budget must be real numbers, got str",
    "mg.check(balls, derivatives='no')": "derivatives must be True or False, got str",
    "mg.sweep(balls, noise='a')": "noise must be real numbers, got str",
    "mg.sweep(balls, stiffness=['a'])": "stiffness must be real numbers, got list",
    "mg.sweep(balls, stiffness=-1.0)": "stiffness must be positive and finite, got -1.0",
    "mg.Onset('wide')": "width must be real numbers, got str",
    "mg.Smoothing('1e-3')": "length must be real numbers, got str",
    "mg.Softness('1e3')": "softness must be real numbers, got str",
    "mg.open_loop(course, '0.1')": "stddev must be real numbers, got str",
    "mg.closed_loop(course, *mg.linear_policy(2, 1))": "stddev must be real numbers, got Linear",
    "mg.parameter_noise(lambda x: x @ x, None)": "stddev must be real numbers, got NoneType",
    "mg.parameter_noise(lambda x: x @ x, [0.1, -0.1])": "stddev must be positive",
    "mg.learning.Settings(alpha='auto')": "alpha must be real numbers, got str",
    "mg.learning.Settings(stddev=0.3)": "stddev must be positive at the beginning and at the end, two numbers, got 0.3",
    "mg.learning.Settings(actor_rate=-1e-3)": "actor_rate must be positive, got -0.001",
    "cart.step(cart.reset(key), 'left')": "action must be real numbers, got str",
    "fit.Recording({'qpos': 'abc'})": "qpos of the recording must be real numbers, got str",
    "fit.Recording({'qpos': [[1, 2], [3]]})": "qpos of the recording must be real numbers, got list",
    "optimise(at=np.array([1, 2]))": "params must be floating-point, got int32; write 1.0 in place of 1",
    # NaN, infinity, nothing, and signs.
    "roll(u, inputs={'qfrc_applied': jnp.full((2, 1), jnp.nan)})": "inputs['qfrc_applied'] must be finite, got nan",
    "scene.with_model(body_mass=jnp.array([0.0, jnp.inf]))": "body_mass must hold numbers, got infinity",
    "scene.with_model(geom_friction=jnp.array([[-1.0, 0, 0]]))": "geom_friction must not be negative, got -1",
    "fit.Recording({})": "must hold at least one row of some signal, got none",
    "fit.Recording({'qpos': five}, times=[0, 1, 2, 3, np.nan])": "times of the recording must be finite",
    "fit.Recording({'qpos': five}, np.full((4, 1), np.nan))": "controls of the recording must be finite",
    "measured(softness=[1e3, 1e4])": "got lengths [()]; give arrays, not lists",
    # Units: degrees for radians, milliseconds for seconds.
    "warned(mg.initial_state, hinged, qpos=[45.0])": "h begins at 45 rad, beyond its range from -1.5708 to 1.5708 rad",
    "warned(mg.load_scene, scene.mj_model, timestep=2)": "a time step of 2 s is long: give seconds",
    "warned(mg.load_scene, scene.mj_model, timestep=1e-9)": "a time step of 1e-09 s is short: a second of motion takes 1e+09",
    "warned(stack, bounded, [fit.Recording({'qpos': five}, 3 * np.ones((4, 1)))])": "in the recording, a control of actuator",
    # One thing in the place of another, and wrong orders.
    "mg.rollout(state, scene, u)": "scene must be of mg.load_scene, got State",
    "mg.rollout(scene, state.qpos, u)": "state must be of mg.initial_state, or the end of a rollout, got",
    "roll(u, 0.1 * u)": "params must belong to a policy, got them beside a sequence of controls: give noise as noise=",
    "roll(u, checkpoint='run.npz')": "checkpoint must be True or False, got str",
    "roll(u, contact=mg.Slope)": "contact must be mg.Discrete(), mg.Slope(), mg.Onset() or mg.Smoothing(), got <class",
    "mg.forward(scene, state)": "model must be MJX's, as scene.model; for a scene and a state see mg.rollout, got Scene",
    "mg.solve(scene.mj_model, data)": "model must be MJX's, as scene.model",
    "mg.set_const(scene)": "model must be MJX's, as scene.model, got Scene",
    "mg.sensor(scene, state, 'touch')": "model must be MJX's, as scene.model, got Scene",
    "mg.load_scene(data)": "source must be an MJCF file",
    "mg.open_loop(scene, 0.1)": "task must be a task, such as mg.SceneTask, got Scene",
    "mg.open_loop(0.1, course)": "task must be a task, such as mg.SceneTask, got float",
    "mg.optimise(params, noisy, key, estimator=first, optimiser=optax.sgd(0.1), num_steps=2)": "objective must be an Objective",
    "mg.optimise(course, u, key, estimator=zeroth, optimiser=optax.sgd(0.1), num_steps=2)": "an Objective (wrap a function",
    "optimise(objective=course)": "a function from a scale to an objective), got SceneTask",
    "optimise(checkpoint=3)": "checkpoint must be the path of a file, got int",
    "optimise(patience=2.5)": "patience must be a whole number, got 2.5",
    "learn(checkpoint=3)": "checkpoint must be the path of a file, got int",
    "learn(environment=scene)": "environment must be one mg.envs.Environment or several, got Scene",
    "learn(environment=envs.diffrl.CartPole)": "environment must be one mg.envs.Environment or several, got <class",
    "identify(free_start='yes')": "free_start must be True, False or None, got str",
    "identify(held_out=fit.Recording({'qpos': five}))": "held_out must be a list of recordings, got Recording",
    "mg.identify(scene.mj_model, {'a': fit.Parameter(1.0)}, [fit.Recording({'qpos': five})])": "scene must be of mg.load_scene",
    "mg.identify(scene, [fit.Parameter(1.0)], [fit.Recording({'qpos': five})])": "parameters must be a dict from names to",
    "fit.Recording(five)": "measured of the recording must be a dict by signal",
    "fit.Recording({'qpos': five}, noise=0.1)": "noise of the recording must be a dict by signal",
    "fit.Recording({'qpos': five}, start=data)": "start of the recording must be of mg.initial_state, got MjData",
    "fit.Recording({'qpos': five}, times=3)": "times of the recording must be finite, one row per time, got 3",
    "fit.damping(scene, 'joint', bounds=3)": "bounds of damping must be two numbers that increase, got 3",
    "fit.damping(scene, 'joint', bounds=(1, 0))": "bounds of damping must be two numbers that increase, got (1, 0)",
    "mg.check(scene, 'height')": "there is no body or site ''",
    "mg.check(scene, 'length:ball')": "cost must be file.py:function, module:function, or of a body as height:torso",
    "mg.render.frames(scene, state)": "qpos must be positions, got a state: give its .qpos",
    "mg.render.write_video(np.zeros((2, 4, 4, 3), np.uint8), 'v.mp4')": "a file, got an array of shape (2, 4, 4, 3)",
    "mg.render.write_video('v.mp4', np.zeros((2, 4, 4, 5), np.uint8))": "video must have shape (frames, height, width, 3), got",
    "mg.rollout(scene, eqx.tree_at(lambda s: s.time, state, jnp.zeros(3)), u)": "state.time must have shape () in this",
    "mg.rollout(scene, eqx.tree_at(lambda s: s.qpos, state, None), u)": "state.qpos must be real numbers, got NoneType",
    "mg.rollout(scene, eqx.tree_at(lambda s: s.qpos, state, jnp.zeros(1, int)), np.zeros((2, 1)))": "no error",
    "mg.initial_state(scene, qpos=key)": "qpos must be real numbers, got a random key",
    "mg.initial_state(scene, qpos=np.array([None]))": "qpos must be real numbers, got an array of objects or text",
    "mg.initial_state(scene, qpos=np.ma.array([0.5], mask=[True]))": "qpos must be real numbers, got a masked array; fill it",
    "roll(lambda p, s: jnp.array([1j]), horizon=2)": "the policy's controls must be real numbers, got complex64",
    "mg.linearise(scene, state, jnp.zeros((1, 1)))": "ctrl must have shape (1,), one number per actuator, got (1, 1)",
    "mg.rollout(mg.load_scene(scene.mj_model, engine='mujoco'), state, np.zeros((2, 1)), contact=mg.Onset())":
        "contact=mg.Onset(...) is MJX's alone: ",
    "scene.with_model(body_quat=jnp.zeros_like(scene.model.body_quat))": "body_quat must have directions, got zeros",
    "scene.with_model(jnt_range=jnp.array([[1.0, -1.0]]))": "jnt_range must have its lower ends first, got [1.0, -1.0]",
    "mg.over_devices(lambda a, b: a)(jnp.ones(3), jnp.ones(2))": "of one size, got leading axes of [(2,), (3,)]",
    "optimise(objective=lambda c: noisy, annealing=lambda i: 1 / (1.0 - i))": "scale of annealing must be finite, got inf in",
    # Functions that leave JAX, numbers that are not real, and what would change nothing.
    "first(cost=lambda x: float(x[0]))": "function must compute with jax.numpy, got NumPy, float()",
    "optimise(objective=mg.parameter_noise(lambda x: np.sum(np.asarray(x)), 0.1))": "function must compute with jax.numpy",
    "optimise(evaluate=lambda x: x[0] if x[0] > 0 else x[1])": "evaluate must compute with jax.numpy",
    "jax.jit(lambda u: mg.SceneTask(scene, state, lambda t: t.qpos[-1, 0].item(), 2).run(u))(u)":
        "the task's cost must compute with jax.numpy",
    "roll(lambda p, s: jnp.array([float(s.qpos[0])]), horizon=2)": "the policy, or observe, must compute with jax.numpy",
    "jax.jit(lambda k: Checked(scene).reset(k))(key)": "start, observe or rewards must compute with jax.numpy",
    "planning.Controller(system, Leaving(), np.zeros((3, 2)))": "cost must compute with jax.numpy",
    "first(cost=lambda x: 1j * x.sum())": "function must return a real number, got complex64",
    "task(lambda trajectory: 1j * trajectory.qpos[-1, 0])": "the task's cost must return real numbers, got complex64",
    "mg.learning.Policy.load('no.npz')": "path must be of a policy that save wrote, got no.npz",
    "optimise(optimiser=optax.adam('1e-2'))": "optimiser must have numbers as its settings, as optax.adam(1e-2); its update",
    "fit.number(scene, 'body_pos', 'world', column=7)": "column of body_pos must be from 0 to 2, got 7",
    "scene.with_model(body_mass=jnp.zeros(2))": "body_mass must leave every moving body some mass, got none for body 1",
    "mg.render.frames(scene, np.zeros((3, 1)), camera='desk')": "there is no camera 'desk'; named cameras are none",
    "decided(deadline='20ms')": "deadline must be real numbers, got str",
    "planning.Controller(planning.SceneSystem(balls), planning.GoalCost(jnp.zeros(14), 1, 1, 1), jnp.zeros((3, 0)))":
        "system must have controls to plan, got none",
    "warned(optimise, optimiser=optax.adam(jnp.nan))": "no step was taken: its learning rate gives NaN or infinity",
    "warned(optimise, objective=mg.parameter_noise(lambda x: jnp.nan * x.sum(), 0.1))":
        "no step was taken: costs or derivatives were NaN or infinite",
    "warned(mg.rollout, limited, mg.initial_state(limited), [[0.5], [-3.0]])":
        "a control of actuator 0 is -3 in step 1, and its ctrlrange is -1 to 1: MuJoCo clamps it",
    # What must go on to work: a count of something as the cost, NumPy's integers, keys of the old kind.
    "first(cost=lambda x: 3)": "no error",
    "first(cost=lambda x: jnp.sum(x > 0))": "no error",
    "mg.rollout(scene, state, lambda p, s: [jnp.sin(s.time)], horizon=2)": "no error",
    "first(count=np.int64(8), key=jax.random.PRNGKey(0))": "no error",
    "jax.vmap(lambda k: first(key=k))(jax.random.split(key, 3))": "no error",
    "jax.jit(lambda a: jax.vmap(estimators.rules.FixedAlpha)(a))(jnp.zeros(2))": "no error",
    "optimise(key=jax.random.split(key, 2))": "no error",
    "optimise(num_steps=jnp.array(2), patience=np.int64(3))": "no error",
    "optimise(log=lambda *told: None, evaluate=jnp.sum)": "no error",
    "optimise(log=lambda step, metrics, end='': None)": "no error",
    "mg.SceneTask(scene, state, len, np.int64(2))": "no error",
    "roll([[0.0], [0]])": "no error",
    "roll(np.zeros((2, 1), int))": "no error",
    "jax.jit(jax.jit(lambda x: mg.initial_state(scene, qpos=[x[0]])))(params)": "no error",
    "mg.Softness(stiffness=10**10)": "no error",
    "jax.jit(lambda: mg.learning.Settings().trace)()": "no error",
    "fit.Recording({'qpos': [0, 1, 2]}, [[0], [1]])": "no error",
    # What environments' methods and policies give.
    "Rewarded(scene, terms={'reward': 1.0}).reset(key)": "by text other than 'reward' and 'diverged', got ['reward']",
    "type('Env', (Rewarded,), {'rewards': lambda *_: {1: 1.0}})(scene).reset(key)": "'reward' and 'diverged', got [1]",
    "type('Env', (Rewarded,), {'rewards': lambda *_: {}})(scene).reset(key)": "rewards of Env must name at least one number",
    "(env := type('Env', (Rewarded,), {'is_over': lambda *_: 0})(limited)).step(env.reset(key), [0.0])":
        "is_over of Env must return True or False, got int32[]",
    "(env := type('Env', (Rewarded,), {'is_over': lambda *_: None})(limited)).step(env.reset(key), [0.0])":
        "is_over of Env must return True or False, got NoneType",
    "(env := type('Env', (Rewarded,), {'control': lambda *_: None})(limited)).step(env.reset(key), [0.0])":
        "control of Env must be real numbers, got NoneType",
    "(env := type('Env', (Rewarded,), {'control': lambda *_: jnp.zeros(3)})(limited)).step(env.reset(key), [0.0])":
        "control of Env must return a vector of shape (1,), got shape (3,)",
    "(env := type('Env', (Rewarded,), {'next_memory': lambda *_: jnp.zeros(3)})(limited)).step(env.reset(key), [0.0])":
        "next_memory of Env must return what has the form of its memory, None, got float32[3]",
    "Rewarded(scene, randomisation=lambda key, scene: None).randomised(key)":
        "what randomisation returns must be a scene, by scene.with_model, got NoneType",
    "mg.learning.evaluate(Rewarded(limited), lambda obs: np.sin(np.asarray(obs)), key, num_episodes=2)":
        "the policy must compute with jax.numpy",
    "(env := Rewarded(limited, seen=[1, 2])).step(env.reset(key), [0.0])": "no error",
    "type('Env', (Rewarded,), {'start': lambda *_: jnp.zeros(3)})(scene).reset(key)":
        "what start of Env returns must be of mg.initial_state, got an array of shape (3,)",
    "type('Env', (Rewarded,), {'start': lambda *_: np.zeros(3)})(scene).reset(key)": "must be of mg.initial_state, got an array",
    "type('Env', (Rewarded,), {'rewards': lambda env, before, *_: before.qpos[0]})(scene).reset(key)":
        "what rewards of Env returns must be a dict of numbers by name, such as {\"speed\": ...}, got an array of shape ()",
    "(env := type('Env', (Rewarded,), {'disturbed': lambda env, state, _: state.qpos})(limited)).step(env.reset(key), [0.0])":
        "what disturbed of Env returns must be a state, as it was given, got an array of shape (1,)",
    "jax.jit(lambda key: cart.reset(key))(1.0)": "key must be one of jax.random.key, got an array of shape ()",
    "Rewarded(scene, contact='discrete')": 'mg.Onset() or mg.Smoothing(), got "discrete"',
    "envs.diffrl.CartPole(scene, contact=mg.Slope)": "mg.Onset() or mg.Smoothing(), got <class 'mjxgrad",
    "Rewarded(scene, contact=mg.Smoothing([1e-3, 2e-3])).refined(2)": "no error",  # for jax.vmap
    "gym.GymEnv(3)": "environment must be of mg.envs.Environment, or the name of one, got int",
    "gym.GymVectorEnv(cart, num_envs=2.5)": "num_envs must be a whole number, got 2.5",
    "gym.GymEnv(cart, render_mod='rgb_array')": "an option must be one of 'render_mode', 'height', 'width', 'camera', got 'ren",
    "(env := gym.GymEnv(cart), env.reset(), env.step('left'))": "action must be real numbers, got str",
    # What plans are made of.
    "planning.optimise_trajectory(system, Leaving(), jnp.zeros(3), np.eye(2), key, smoother=planning.Exact(), schedule=[1])":
        "start must have shape (2,) in this system, got (3,)",
    "planning.optimise_trajectory(system, Leaving(), state, np.zeros((3, 2)), key, smoother=planning.Exact(), schedule=[1])":
        "start must be real numbers, got State",
    "planning.optimise_trajectory(system, Leaving(), [0, jnp.nan], np.eye(2), key, smoother=planning.Exact(), schedule=[1])":
        "start must be finite, got [0.0, nan]",
    "planning.optimise_trajectory(system, Leaving(), [0, 0], np.zeros((3, 2)), key, smoother=planning.Exact(), schedule=[1])":
        "cost must compute with jax.numpy",
    "planned(schedule='fast')": "schedule must be real numbers, got str",
    "planned(lower=jnp.zeros(5))": "lower must be one number or have shape (2,), got (5,)",
    "planned(upper='none')": "upper must be real numbers, got str",
    "planning.FunctionSystem(lambda x: x, 2, 2)": "function must be a function of state and control, got Partial: too many",
    "planning.FunctionSystem(max, '2', 2)": "num_changes must be a whole number, got '2'",
    "planning.FunctionSystem(lambda x, u: jnp.zeros(3), 2, 2).step(jnp.zeros(2), jnp.zeros(2))":
        "function must return the next state, of shape (2,), got (3,)",
    "planning.FunctionSystem(lambda x, u: None, 2, 2).step(jnp.zeros(2), jnp.zeros(2))":
        "the next state by function must be real numbers, got NoneType",
    "type('Cost', (Leaving,), {'stage': lambda *_: None})().total(system, jnp.zeros((2, 2)), jnp.zeros((1, 2)))":
        "stage of a cost must return one number, got NoneType",
    "type('Cost', (Leaving,), {'stage': lambda *_: 0})().total(system, jnp.zeros((2, 2)), jnp.zeros((1, 2)))": "no error",
    "squares(stages=lambda x: x[0])": "residuals of Squares must return a vector, got shape ()",
    "squares(ends=lambda x: x[None])": "terminal_residuals of Squares must return a vector, got shape (1, 2)",
    "squares(stages=lambda x: None)": "residuals of Squares must be real numbers, got NoneType",
    "Squares(ends=lambda x: 1.0).total(system, jnp.zeros((2, 2)), jnp.zeros((1, 2)))": "must return a vector, got shape ()",
    "squares(stages=lambda x: [x[0], 1])": "no error",
    "planning.SceneSystem(scene, contact='slope')": 'mg.Onset() or mg.Smoothing(), got "slope"',
    "planning.GoalCost('up', 1.0, 1.0, 0.1)": "goal must be real numbers, got str",
    "planning.GoalCost(jnp.full(2, jnp.nan), 1.0, 1.0, 0.1)": "goal must be finite, got [nan nan]",
    "planning.GoalCost(jnp.zeros(2), jnp.inf, 1.0, 0.1)": "stage_weight must be at least 0 and finite, got inf",
    "planning.Analytic(0.1)": "smoothing must be such as mg.Smoothing(0.01), or None, got float",
    "planning.Sampled(-0.1, 0.1, 8)": "stddev_state must be at least 0 and finite, got -0.1",
    "decided(stddev=-1.0)": "stddev must be at least 0 and finite, got [-1. -1.]",
    "setattr(planning.Controller(system, planning.GoalCost(*jnp.ones((3, 2)), 0.1), np.zeros((3, 2))), 'cost', None)":
        "make a new Controller for a cost of another form",
    "planning.Controller(system, planning.GoalCost(*jnp.ones((3, 2)), 0.1), np.zeros((3, 2)))('now')":
        "state must be a vector, or for a scene its State or C MuJoCo's data, got str",
    # Recordings and parameters.
    "fit.Recording({'qpos': 3.0})": "measured of the recording must hold one row per time, by name, got shapes {'qpos': ()}",
    "fit.Recording({'qpos': np.zeros((5, 1, 1))})": "must hold one row per time, by name, got shapes {'qpos': (5, 1, 1)}",
    "fit.Recording({'qpos': five}, times=np.arange(5.0)[:, None])": "times of the recording must be finite, one row per time",
    "fit.Recording({'qpos': five}, u, np.arange(5.0), [0.0, 1.0, 2.0])": "one time per row of controls, got 3 times and 2",
    "fit.Recording({'qpos': five}, control_times=[0.0, 1.0])": "one time per row of controls, got 2 times and no rows",
    "stack(scene, [fit.Recording({'qpos': five}, np.zeros((4, 1)), noise={'qpos': [0.1, 0.2]})])":
        "noise of qpos of the recording must be one number or 1 in this scene, got shape (2,)",
    "identify(recordings=[fit.Recording({'qpos': five}, np.zeros((4, 1)), start=still)])":
        "start of the recording must be a state of this scene",
    "fit.Recording({'qpos': five}).cut('1', 0.002)": "duration must be real numbers, got str",
    "fit.Recording({'qpos': five}).cut(-1.0, 0.002)": "duration must be positive, got -1.0",
    "fit.Recording({'qpos': five}).cut(0.004, 0.0)": "timestep must be positive, got 0.0",
    "mg.identify(scene, {1: fit.Parameter(1.0)}, [fit.Recording({'qpos': five}, np.zeros((4, 1)))])": "by text, got [1]",
    "fit.Parameter('1')": "nominal must be real numbers, got str",
    "fit.Parameter(1.0, 0.5, 2.0, write=3)": "write must be a function of model and value, got int",
    "fit.Parameter(1.0, 0.5, 2.0, write=lambda model: {})": "write must be a function of model and value, got function: too many",
    "mg.identify(scene, {'a': fit.Parameter(1.0, 0.5, 2.0, lambda m, v: None)}, [fit.Recording({'qpos': five})])":
        "what write of a returns must be a dict of fields",
    "mg.identify(scene, dict.fromkeys('ab', fit.damping(scene, 'joint', bounds=(0, 1))), [fit.Recording({'qpos': five})])":
        "parameters must be of different numbers, got dof_damping of 'a' and 'b'",
    "fit.mass(scene.mj_model, 'b')": "scene must be of mg.load_scene, got MjModel",
    "fit.friction(scene.mj_model)": "scene must be of mg.load_scene, got MjModel",
    "fit.damping(scene, bounds=(0, 1))": "a parameter must have at least one name, got none",
    "fit.number(hinged, 'jnt_range', 'h', column=0, bounds=(0, 1))": "must be within its bounds, (0, 1), got -1.57",
    "fit.number(scene, 'body_mas', 'b')": "got 'body_mas'; did you mean body_mass?",
    # Pictures, and pairs.
    "mg.render.frames(scene, np.zeros((3, 1)), camera=7)": "camera must be below 0, or -1 for the free camera, got 7",
    "mg.render.frames(scene, np.zeros((3, 1)), camera=-3)": "camera must be at least -1, got -3",
    "mg.render.frames(scene, np.zeros((3, 1)), camera=0.5)": "camera must be a whole number, got 0.5",
    "mg.render.frames(scene, np.zeros((3, 1)), camera=['a'])": "camera must be a whole number, got ['a']",
    "jax.jit(lambda qpos: mg.render.frames(scene, qpos))(wrong)": "frames must be drawn outside of jax.jit and jax.vmap",
    "mg.render.write_video('v.mp4', np.full((2, 8, 8, 3), 255.0))": "or floats from 0 to 1, got float64 from 255 to 255",
    "mg.render.write_video('v.mp4', np.zeros((2, 8, 8, 3), int))": "video must be uint8, as mg.render.frames gives, or floats",
    "mg.render.write_video('v.mp4', np.full((2, 8, 8, 3), np.nan))": "or floats from 0 to 1, got float64 from nan to nan",
    "mg.render.write_video('v.mp4', np.zeros((2, 1, 1, 3), np.uint8))": "two columns at least, got shape (2, 1, 1, 3)",
    "mg.render.write_video('v.mp4', [np.zeros((8, 8, 3)), np.zeros((4, 8, 3))])": "video must have frames of one size",
    "mg.Softness(pairs=('floor', 'ball'))": "pairs must be pairs of two names, such as (('floor', 'ball'),), got ('floor'",
    "mg.Softness(pairs=(('a', 'b', 'c'),))": "pairs must be pairs of two names, such as (('floor', 'ball'),), got (('a'",
}  # fmt: skip


@pytest.fixture(scope="session")
def answers(tmp_path_factory):
    # The workers of a run share the folder above their own.
    base = tmp_path_factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    printed = once(folder, "answers", lambda: run_python("-c", SETUP, json.dumps(list(FOUND)))[0])
    return json.loads(printed.splitlines()[-1])


@pytest.mark.parametrize("call", FOUND)
def test_a_wrong_call_is_answered_in_a_sentence(answers, call):
    assert FOUND[call] in answers[call]
    assert len(answers[call]) < 600
