"""The double pendulum by error control: how far its steps are the motion, and how fast that parts from its neighbours."""

import jax
import jax.numpy as jnp
import numpy as np

import mjxgrad as mg
from experiments.long_horizon.outcome import Adaptive
from experiments.long_horizon.problems import Problem, vector
from experiments.long_horizon.settings import Settings

_TOLERANCE = 1e-10
_AWAY = 1e-5  # rad and rad/s, half width of differences: far above the tolerance, whatever it grows to


def adaptive(settings: Settings, pendulum: Problem) -> Adaptive:
    """Integrate the pendulum without noise, and its neighbours.

    Args:
        settings: of the run.
        pendulum: the problem.

    Returns:
        Distances and growth at the first times of the horizon.
    """
    import diffrax

    count = settings.sizes.num_adaptive
    every = settings.sizes.num_times // (2 * count)
    times = pendulum.interval * every * np.arange(1, count + 1)
    start = vector(pendulum.start)
    around = jnp.concatenate([jnp.zeros((1, 4)), _AWAY * jnp.eye(4), -_AWAY * jnp.eye(4)])

    @jax.jit
    @jax.vmap
    def integrate(shift: jax.Array):
        state = mg.initial_state(pendulum.scene, (start + shift)[:2], (start + shift)[2:])
        moments = jnp.concatenate([jnp.zeros(1), jnp.asarray(times)])
        found = mg.integration.adaptive_rollout(
            pendulum.scene, state, moments, tolerance=_TOLERANCE, solver=diffrax.Dopri8()
        )
        return jnp.concatenate([found.qpos, found.qvel], axis=1)[1:], found.num_steps

    states, num_steps = (np.asarray(each) for each in integrate(around))
    slopes = (states[1:5] - states[5:]) / (2 * _AWAY)
    whole = settings.sizes.num_times

    @jax.jit
    def stepped(params: jax.Array):
        at = pendulum.states(params, jnp.int32(whole), whole, "discrete")
        return at, mg.diagnostics.growth(pendulum.jacobians(params, whole, "discrete")).log_largest

    at, log_largest = (np.asarray(each)[every - 1 :: every][:count] for each in stepped(pendulum.params))
    return Adaptive(
        times=times,
        apart=np.linalg.norm(at - states[0], axis=1) / np.linalg.norm(states[0], axis=1),
        log_largest=np.log(np.linalg.norm(np.moveaxis(slopes, 0, 2), ord=2, axis=(1, 2))),
        stepped=log_largest,
        num_steps=int(num_steps[0]),
    )
