"""Two motions under a policy whose few parameters are noisy: smooth and chaotic, and with contact."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import mjxgrad as mg
from experiments.motion import advance
from mjxgrad._mjx import mjx
from mjxgrad.rollouts import State
from mjxgrad.rollouts.state import data_of, state_of
from mjxgrad.stepping import own_motion
from mjxgrad.tasks import scene_path
from mjxgrad.tasks.hopper import hopper

_START_ANGLES = (2.4, 0.5)  # rad from hanging: high enough that the elbow turns over


class Problem(eqx.Module):
    """A motion in segments of some steps each, with a cost at the end of every segment.

    Cost (m) and what a value function is fitted on follow from positions and velocities, controls from parameters and a state;
    the policy's parameters are under noise. Of the gradients "onset" is that of a motion whose contacts begin within the step.
    """

    scene: mg.Scene
    start: State
    control: Callable[[Float[Array, " dim"], State], Float[Array, " nu"]]
    cost: Callable[[Float[Array, " n"]], Float[Array, ""]] = eqx.field(static=True)
    observe: Callable[[Float[Array, " n"]], Float[Array, " features"]] = eqx.field(static=True)
    params: Float[Array, " dim"]
    stddev: float = eqx.field(static=True)
    title: str = eqx.field(static=True)
    gradients: tuple[str, ...] = eqx.field(static=True)
    num_times: int = eqx.field(static=True)
    steps_per_time: int = eqx.field(static=True)

    @property
    def interval(self) -> float:
        """Time from one cost to the next (s)."""
        return float(self.scene.model.opt.timestep) * self.steps_per_time

    def states(self, params: Float[Array, " dim"], window: Int[Array, ""], gradient: str) -> Float[Array, "times n"]:
        """Give the states at the end of each segment; the derivative forgets where it came from after a window of segments."""

        def next_one(state: State, index: Array) -> tuple[State, Array]:
            is_cut = index % window == 0
            state = jax.tree.map(lambda x: jnp.where(is_cut, jax.lax.stop_gradient(x), x), state)
            state = self._segment(params, state, gradient)
            return state, vector(state)

        return jax.lax.scan(next_one, self.start, jnp.arange(self.num_times))[1]

    def jacobians(self, params: Float[Array, " dim"], gradient: str) -> Float[Array, "times n n"]:
        """Give the derivative of each segment's end by its beginning, the policy's share included."""

        def next_one(state: State, _: None) -> tuple[State, Array]:
            def end(x: Float[Array, " n"]) -> tuple[Array, State]:
                qpos, qvel = jnp.split(x, [state.qpos.shape[0]])
                moved = self._segment(params, eqx.tree_at(lambda s: (s.qpos, s.qvel), state, (qpos, qvel)), gradient)
                return vector(moved), moved

            jacobian, moved = jax.jacfwd(end, has_aux=True)(vector(state))
            return moved, jacobian

        return jax.lax.scan(next_one, self.start, length=self.num_times)[1]

    def _segment(self, params: Float[Array, " dim"], state: State, gradient: str) -> State:
        contact = mg.Onset() if gradient == "onset" else own_motion(gradient)

        def step(data: mjx.Data) -> mjx.Data:
            data = data.replace(ctrl=self.control(params, state_of(data)))
            return mg.step(self.scene.model, data, contact=contact)

        return state_of(advance(step, data_of(self.scene, state, self.scene.data.ctrl), self.steps_per_time))


def vector(state: State) -> Float[Array, " n"]:
    """Give positions and velocities as one vector, of a scene whose joints are hinges and slides."""
    return jnp.concatenate([state.qpos, state.qvel])


def problem(name: str, num_times: int) -> Problem:
    """Build a problem whose longest horizon is divided into segments."""
    return _pendulum(num_times) if name == "double_pendulum" else _hopper(num_times)


def _pendulum(num_times: int) -> Problem:
    scene = mg.load_scene(scene_path("double_pendulum"))
    return Problem(
        scene=scene,
        start=mg.initial_state(scene, jnp.array(_START_ANGLES)),
        control=jax.tree_util.Partial(_torques),
        cost=lambda x: 0.3 * (jnp.sin(x[0]) + jnp.sin(x[0] + x[1])),  # how far sideways the tip is, in m
        observe=_angles,
        params=jnp.zeros(4),
        stddev=0.05,
        title="double pendulum",
        gradients=("discrete",),
        num_times=num_times,
        steps_per_time=768 // num_times,
    )


def _torques(params: Float[Array, " 4"], state: State) -> Float[Array, " 2"]:
    """Give a constant torque and one that goes with the angle in each joint; bounded, so that no noise speeds it up for ever."""
    return params[:2] + params[2:] * jnp.sin(state.qpos)


def _angles(x: Float[Array, " 4"]) -> Float[Array, " 6"]:
    angles = jnp.stack([x[0], x[0] + x[1]])
    return jnp.concatenate([jnp.sin(angles), jnp.cos(angles), 0.1 * x[2:]])


def _hopper(num_times: int) -> Problem:
    task = hopper()
    return Problem(
        scene=task.scene,
        start=task.state,
        control=jax.tree_util.Partial(_posture, task.policy, task.start_params),
        cost=lambda x: -x[0] - x[1],  # less the torso's distance forward and its height, in m
        observe=lambda x: x,
        params=jnp.zeros(3),
        stddev=0.05,
        title="hopper",
        gradients=("discrete", "slope", "onset"),
        num_times=num_times,
        steps_per_time=288 // num_times,
    )


def _posture(policy, posture, params: Float[Array, " 3"], state: State) -> Float[Array, " 3"]:
    """Give the posture's actions with the parameters added to its offsets."""
    return policy(eqx.tree_at(lambda p: p.offset, posture, posture.offset + params), state)
