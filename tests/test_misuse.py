"""What is called wrongly is answered in a sentence, and not in the words of Python or JAX.

In a process without the checks of types that the other tests run under, for they would answer first.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SETUP = """
import functools, json, sys, tempfile
import equinox as eqx, jax, jax.numpy as jnp, numpy as np, optax
import mjxgrad as mg
from mjxgrad import estimators

key, params = jax.random.key(0), jnp.array([1.0, 2.0])
noisy = mg.parameter_noise(lambda x: x @ x, 0.1)
scene = mg.load_scene("<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody>"
                      "<actuator><motor joint='joint'/></actuator></mujoco>".replace("<joint ", "<joint name='joint' "))
state = mg.initial_state(scene)
archive = tempfile.mkdtemp() + "/run.npy"
np.save(archive, np.zeros(3))


def first(cost=None, count=8, at=params, key=key, objective=None):
    objective = objective or (noisy if cost is None else mg.parameter_noise(cost, 0.1))
    return estimators.first_order(objective, at, key, num_samples=count)


def optimise(**how):
    given = {"estimator": functools.partial(estimators.first_order, num_samples=4), "optimiser": optax.sgd(0.1), "num_steps": 2}
    return mg.optimise(noisy, how.pop("at", params), how.pop("key", key), **given | how)


def task(cost):
    return mg.SceneTask(scene, state, cost, 2).run(jnp.zeros((2, 1)))


def elite(count):
    return mg.baselines.cross_entropy(noisy, params, key, num_samples=8, num_elite=count, num_steps=2)


def answer(call):
    try:
        eval(call)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "no error"


print(json.dumps({call: answer(call) for call in json.loads(sys.argv[1])}))
"""
FOUND = {
    "first(objective=lambda x: x @ x)": "objective must be an Objective, got function; wrap a function by mg.parameter_noise",
    "estimators.zeroth_order(lambda x: x @ x, params, key, num_samples=8)": "objective must be an Objective, got function",
    "estimators.first_and_zeroth_order(abs, params, key, num_samples=8)": "objective must be an Objective, got builtin",
    "first(cost=lambda x: {'cost': x @ x})": "function must return one number, got dict",
    "first(cost=lambda x: None)": "function must return one number, got NoneType",
    "first(cost=lambda x: x)": "function must return a scalar of shape (), got shape (2,)",
    "first(count='8')": "num_samples must be a whole number, got '8'",
    "estimators.zeroth_order(noisy, params, key, num_samples='8')": "num_samples must be a whole number, got '8'",
    "mg.baselines.cross_entropy(noisy, params, key, num_samples=2.5, num_elite=2, num_steps=2)":
        "num_samples must be a whole number, got 2.5",
    "elite(2.5)": "num_elite must be a whole number, got 2.5",
    "mg.diagnostics.bias_variance(lambda k: noisy, params[None], key, softness=params, num_samples=4, num_reference='9')":
        "num_reference must be a whole number, got '9'",
    "first(count=None)": "num_samples must be a whole number, got None",
    "first(count=2.5)": "num_samples must be a whole number, got 2.5",
    "first(count=8.0)": "num_samples must be a whole number, got 8.0",
    "jax.jit(lambda n: first(count=n))(8)": "num_samples must be known before anything is compiled, got a traced value",
    "first(at=jnp.zeros(0))": "params must have at least one number, got none",
    "first(key=0)": "key must be one of jax.random.key, got 0",
    "first(key=jax.random.split(key, 3))": "key must be one of jax.random.key, got an array of shape (3,)",
    "estimators.alpha_order(noisy, params, key, num_samples=8, rule='consistent')": "rule must be one of mg.estimators.rules",
    "estimators.rules.FixedAlpha(3.0)": "alpha must be from 0 to 1, got 3.0",
    "optimise(annealing=0.5)": "annealing must be a schedule from step to scale, got 0.5; for a fixed scale",
    "optimise(estimator='first_order')": "estimator must be a function such as functools.partial(",
    "optimise(optimiser='adam')": "optimiser must be of optax, with its settings, such as optax.adam(1e-2), got 'adam'",
    "optimise(optimiser=optax.adam)": "optimiser must be of optax, with its settings, such as optax.adam(1e-2), got <function",
    "optimise(num_steps=2.5)": "num_steps must be a whole number, got 2.5",
    "optimise(key=0)": "key must come from jax.random.key, with at most one leading axis, got int32 of shape ()",
    "optimise(at=jnp.zeros(0))": "params must have at least one number, got none",
    "jax.jit(lambda x: optimise(at=x))(params)": "optimise must be called outside of jax.jit and jax.vmap",
    "optimise(checkpoint=archive)": "checkpoint must be a file that a run has saved, got ",
    "mg.rollout(scene, scene.data, horizon=2)": "state must be of mg.initial_state, or the end of a rollout, got Data",
    "mg.rollout(scene.model, state, horizon=2)": "scene must be of mg.load_scene, got Model",
    "mg.initial_state(scene.model)": "scene must be of mg.load_scene, got Model",
    "mg.rollout(scene, state, horizon=2.5)": "horizon must be a whole number, got 2.5",
    "jax.jit(lambda n: mg.rollout(scene, state, horizon=n))(2)": "horizon must be known before anything is compiled",
    "mg.rollout(scene, state, lambda p, s: None, horizon=2)": "the policy must return one control per actuator, shape (1,)",
    "mg.rollout(scene, state, lambda p, s: (jnp.zeros(1), s), horizon=2)": "one control per actuator, shape (1,), got tuple",
    "task(lambda trajectory: {'cost': 1.0})": "one number per state, shape (3,), got dict",
    "task(lambda trajectory: None)": "one number per state, shape (3,), got NoneType",
    "mg.rollout(scene.with_model(geom_friction=jnp.full((1, 3), jnp.nan)), state, horizon=2)": "geom_friction must hold numbers",
    "mg.Softness(stiffness=jnp.inf)": "stiffness must be positive and finite, got inf",
    "jax.jit(lambda s: 1, static_argnums=0)(scene)": "make it an ordinary argument of jax.jit",
    "mg.load_scene('')": "got ''",
    "mg.load_scene('<mujoco/>', softness=1e4)": "softness must be mg.Softness, such as mg.Softness(stiffness=1e4), got 10000.0",
    "mg.rollout(scene, state, horizon=2, contact='slope')": 'mg.Onset() or mg.Smoothing(), got "slope"',
    "mg.Softness(geoms='ball')": "geoms must be a tuple of names, got 'ball'; write ('ball',)",
    # What must go on to work: a count of something as the cost, NumPy's integers, keys of the old kind.
    "first(cost=lambda x: 3)": "no error",
    "first(cost=lambda x: jnp.sum(x > 0))": "no error",
    "mg.rollout(scene, state, lambda p, s: [jnp.sin(s.time)], horizon=2)": "no error",
    "first(count=np.int64(8), key=jax.random.PRNGKey(0))": "no error",
    "jax.vmap(lambda k: first(key=k))(jax.random.split(key, 3))": "no error",
    "jax.jit(lambda a: jax.vmap(estimators.rules.FixedAlpha)(a))(jnp.zeros(2))": "no error",
    "optimise(key=jax.random.split(key, 2))": "no error",
}  # fmt: skip


@pytest.fixture(scope="module")
def answers():
    command = [sys.executable, "-c", SETUP, json.dumps(list(FOUND))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("call", FOUND)
def test_a_wrong_call_is_answered_in_a_sentence(answers, call):
    assert FOUND[call] in answers[call]
    assert len(answers[call]) < 600
