r"""The published tasks with real contact in place of a law of their own.

The push had a spring there, the friction a law of drag, the tennis a reflection; in the motion planning a step into an obstacle
was not taken. Sizes, masses, starts, goals and costs are the published ones, where nothing else is said.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.problems import published
from mjxgrad.contact import Softness
from mjxgrad.objective.policy import linear_policy
from mjxgrad.rollouts import State, Trajectory, initial_state
from mjxgrad.scene import Scene, load_scene
from mjxgrad.tasks import ActionTask, scene_path

PUSH_CONTACT = (("pusher", "pushed"),)
# Two bodies of 0.1 kg move against each other like one of half that mass.
REDUCED_MASS = 0.05  # kg


def quadratic_cost(quadratic: published.QuadraticCost, trajectory: Trajectory) -> Float[Array, " steps"]:
    """Return the cost of every state, positions before velocities: that of a step, and after the last the final one."""
    states = jnp.concatenate([trajectory.qpos, trajectory.qvel], axis=1)
    charged = jax.vmap(quadratic.stage)(states[:-1], trajectory.ctrl)
    return jnp.append(charged, quadratic.terminal(states[-1]))


def push(stiffness: float = 10.0, *, horizon: int = 200) -> ActionTask:
    """Load the push: both balls are to be 1 m ahead and at rest, the second above all; 200 steps are 1 s.

    The published tasks of 10 and 1000 N/m differ in damping and horizon, too; here in stiffness (N/m) alone. The state is
    how far both have come, then their velocities; the control is the force on the first, in N.
    """
    scene = load_scene(scene_path("push"), softness=push_softness(stiffness))
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = published.QuadraticCost(jnp.array([1.0, 1.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return _quadratic_task(scene, cost, horizon, start_params=jnp.full((horizon, 1), 0.1))  # N


def push_softness(stiffness: float | Float[Array, "..."], damping_ratio: float | Float[Array, "..."] = 0.0) -> Softness:
    """Set the softness of the balls' contact.

    Args:
        stiffness: in N/m; 10 is soft, 1000 stiff. Undamped, a knock adds energy where it takes few time steps: 6 % at
            1000.
        damping_ratio: 0 is elastic, as published; 1 is critical.

    Returns:
        The softness, or a stack of them if an argument has an axis.
    """
    stiffness, damping_ratio = jnp.broadcast_arrays(jnp.asarray(stiffness, float), jnp.asarray(damping_ratio, float))
    return Softness(stiffness / REDUCED_MASS, damping_ratio, pairs=PUSH_CONTACT)


def friction(*, horizon: int = 400) -> ActionTask:
    """Load the tray and the puck: both are to be 2 m ahead and at rest, the puck above all; 400 steps are 2 s.

    A puck that is off the tray falls, at the speed ahead that it has. The state is the positions of the tray and of the
    puck (ahead, and above the tray's level), then their velocities; the control is the force on the tray, in N.
    """
    scene = load_scene(scene_path("friction"))
    weight = jnp.array([0.1, 10.0, 0.0, 0.1, 0.1, 0.0])
    cost = published.QuadraticCost(jnp.array([2.0, 2.0, 0.0, 0.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return _quadratic_task(scene, cost, horizon, start_params=jnp.zeros((horizon, 1)))


def motion_planning(*, horizon: int = 100) -> ActionTask:
    """Load the robot and the pillars: it is to reach the point 4 m ahead and stay; 100 steps are 2 s.

    There are half as many steps as published, of twice the length. The state is position and velocity; the controls are
    the velocities asked for, in m/s.
    """
    scene = load_scene(scene_path("motion_planning"))
    weight = jnp.array([1.0, 1.0, 0.0, 0.0])
    cost = published.QuadraticCost(jnp.array([0.0, 4.0, 0.0, 0.0]), weight, 10 * weight, jnp.array(0.001))
    return _quadratic_task(scene, cost, horizon, start_params=jnp.full((horizon, 2), 0.01), stddev=0.3)  # m/s


class Starts(eqx.Module):
    """Draws the published starts of a task, as states like one of the scene."""

    like: State
    task: published.Tennis

    def __call__(self, key: PRNGKeyArray) -> State:
        return self.state(self.task.sample_start(key))

    def state(self, vector: Float[Array, " 7"]) -> State:
        """Return the scene's state of a published one; the pad is at rest."""
        ball, velocity, pad = vector[:2], vector[2:4], vector[4:]
        return eqx.tree_at(
            lambda state: (state.qpos, state.qvel),
            self.like,
            (jnp.concatenate([ball, pad]), jnp.concatenate([velocity, jnp.zeros(3)])),
        )


def tennis(*, horizon: int = 200) -> ActionTask:
    """Load the ball and the pad: the ball is to end at rest 2.5 m from where the pad begins; 200 steps are 10 s.

    The policy sees the ball's position and velocity, then the pad's position and angle, and gives the pad's velocity and
    rate of turning (m, m/s, rad, rad/s).
    """
    scene = load_scene(scene_path("tennis"))
    original = published.tennis()
    # A pose that is said is not judged: at that of the file the ball lies in the pad.
    starts = Starts(initial_state(scene, scene.data.qpos), original)
    policy, params = linear_policy(7, 3, bias=False, observe=published_state)
    goal = jnp.zeros(10).at[1].set(2.5)
    final_weight = jnp.zeros(10).at[jnp.array([0, 1, 5, 6])].set(jnp.array([100.0, 100.0, 10.0, 10.0]))
    return _quadratic_task(
        scene,
        published.QuadraticCost(goal, jnp.zeros(10), final_weight, jnp.array(0.001)),
        horizon,
        state=starts.state(original.nominal_start()),
        start_distribution=starts,
        start_params=params,
        policy=policy,
    )


def published_state(state: State) -> Float[Array, " 7"]:
    """Return the state as it was published, without the pad's velocity."""
    return jnp.concatenate([state.qpos[:2], state.qvel[:2], state.qpos[2:]])


def _quadratic_task(
    scene: Scene, cost: published.QuadraticCost, horizon: int, *, state: State | None = None, **options: Any
) -> ActionTask:
    """Make a task with a quadratic cost of positions, velocities and controls; from rest unless another start is given."""
    # The number of controls is the scene's; pyright takes it for an argument, since `Task` declares it as a variable.
    return ActionTask(  # pyright: ignore[reportCallIssue]
        scene=scene,
        state=initial_state(scene, scene.data.qpos) if state is None else state,
        cost=Partial(quadratic_cost, cost),
        horizon=horizon,
        **options,
    )
