"""Scenes with a cost and noise: a throw over a wall, gymnasium's hopper, and the classes for your own."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float, PyTree

from mjxgrad.contact import Softness
from mjxgrad.objective import ActionNoise, ParameterNoise, closed_loop, linear_policy, open_loop, parameter_noise
from mjxgrad.objective.base import Stddev
from mjxgrad.objective.task import InScene, Outcome, PolicyFunction, SceneTask, Task, finite_cost
from mjxgrad.rollouts import State, Trajectory, initial_state, rollout
from mjxgrad.scene import Scene, load_scene

__all__ = [
    "ActionTask", "BallWall", "Outcome", "SceneTask", "Task", "ball_wall", "hopper", "scene_path", "wall_softness",
]  # fmt: skip

# Beside the package in a checkout, inside it when installed from a wheel.
_FOLDERS = (Path(__file__).parents[1] / "mjcf", Path(__file__).parent / "mjcf")
# Only the wall is softened: on a softer floor the ball would also sink in and slide farther.
WALL_CONTACT = (("ball", "wall"),)
# Of the hopper. Bent legs absorb the landing; with the downward speed the foot lands after 70 ms.
START_POSE = (0.0, 1.22, 0.0, -0.4, -0.5, 0.3)  # m, m, rad
START_VELOCITY = (0.5, -1.0, 0.0, 0.0, 0.0, 0.0)
# In actions per rad and per rad/s; an action of 1 is 200 Nm.
STIFFNESS, DAMPING = (0.5, 0.5, 0.3), (0.05, 0.05, 0.03)


class ActionTask(SceneTask):
    """A task with an objective of its own; see `SceneTask`.

    Attributes:
        start_params: start of the optimisation: the controls, or the policy's parameters.
        policy: function from its parameters and a state to controls; None is open loop.
        stddev: default standard deviation of the noise on the actions, in their units.
    """

    start_params: PyTree = eqx.field(kw_only=True)
    policy: PolicyFunction | None = eqx.field(kw_only=True, default=None)
    stddev: float = eqx.field(static=True, kw_only=True, default=0.1)

    def objective(self, stddev: Stddev | None = None, softness: Softness | None = None) -> ActionNoise:
        """Return the cost under noise on the actions, a function of the controls or of the policy's parameters.

        The standard deviation is in units of the controls, by default the task's; a softness of None leaves it unchanged.
        """
        task, stddev = self.with_softness(softness), self.stddev if stddev is None else stddev
        if self.policy is None:
            return open_loop(task, stddev)
        return closed_loop(task, self.policy, stddev, params=self.start_params)


class BallWall(InScene):
    """The throw; see `ball_wall`. Contacts set in without a jump, so derivatives differ only under another impedance.

    Attributes:
        speed: speed of the throw, in m/s.
        target: wanted end of the ball, in m from the start.
        horizon: number of steps, long enough for the ball to land and stop.
    """

    speed: Float[Array, ""]
    target: Float[Array, ""]
    horizon: int = eqx.field(static=True)

    def start(self, angle: Float[Array, " 1"]) -> State:
        """Return the start of a throw at an angle above the floor, in rad."""
        return initial_state(self.scene, qvel=self.speed * jnp.array([jnp.cos(angle[0]), jnp.sin(angle[0])]))

    def cost(self, angle: Float[Array, " 1"]) -> Float[Array, ""]:
        """Return the squared distance from the ball's end to the target, in m²; NaN if the rollout diverged."""
        trajectory = rollout(self.scene, self.start(angle), horizon=self.horizon, contact=self.contact)
        return finite_cost((trajectory.qpos[-1, 0] - self.target) ** 2, trajectory)

    def objective(self, stddev: float | Float[Array, ""] = 0.1, softness: Softness | None = None) -> ParameterNoise:
        """Return the cost as a function of the angle, with noise on the angle (`stddev` in rad).

        Softness applies to all contacts, and None leaves it unchanged; for the wall alone see `wall_softness`.
        """
        return parameter_noise(self.with_softness(softness).cost, stddev, dim=1)


def ball_wall() -> BallWall:
    """Return a throw at an angle: 2 m/s, a target 0.38 m away, and 0.42 s, by when every throw has landed and stopped.

    Throws between about 35 and 74 degrees clear the scene's wall (0.2 m away, 8 cm high). The cost jumps at 35 degrees, where
    first-order and zeroth-order gradients differ (Suh et al., ICML 2022, arXiv:2202.00817, figure 2). The best throw at the
    target is at 57 degrees.
    """
    return BallWall(load_scene(scene_path("ball_wall")), jnp.asarray(2.0), jnp.asarray(0.38), horizon=210)


def wall_softness(stiffness: float | Float[Array, "..."]) -> Softness:
    """Return a softness for the wall alone, critically damped; a stack of them if the stiffness has an axis.

    The stiffness is in 1/s²: 10 is a curtain, 1e5 a brick. At the default time step the wall is stable up to 1.7e5.
    """
    stiffness = jnp.asarray(stiffness, float)
    return Softness(stiffness, jnp.ones_like(stiffness), pairs=WALL_CONTACT)


def hopper(*, horizon: int = 150) -> ActionTask:
    """Return gymnasium's hopper, dropped: the foot lands after 70 ms, and the cost depends on the torso's final position.

    Nothing in it jumps, yet the discrete derivative is wrong for every parameter that shifts the time of landing: the
    impedance is not zero at first touch. Steps are Euler's, of 2 ms, at a quarter of the cost of gymnasium's RK4. The policy
    observes angles and speeds of the three joints. At first it holds the posture like springs and dampers.
    """
    scene = robot_scene("hopper")
    policy, zero = linear_policy(6, 3, observe=_joints)
    stiffness, damping = jnp.array(STIFFNESS), jnp.array(DAMPING)
    gain = -jnp.concatenate([jnp.diag(stiffness), jnp.diag(damping)], axis=1)
    offset = stiffness * jnp.array(START_POSE[3:])
    posture = eqx.tree_at(lambda layer: (layer.weight, layer.bias), zero, (gain, offset))
    state = initial_state(scene, jnp.array(START_POSE), jnp.array(START_VELOCITY))
    # The number of controls is the scene's; pyright expects an argument, since `Task` declares a variable.
    return ActionTask(  # pyright: ignore[reportCallIssue]
        scene=scene, state=state, cost=_jump_cost, horizon=horizon, policy=policy, start_params=posture
    )


def _jump_cost(trajectory: Trajectory) -> Float[Array, ""]:
    """Return minus the forward distance minus the final height of the torso, in m."""
    return -trajectory.qpos[-1, 0] - trajectory.qpos[-1, 1]


def _joints(state: State) -> Float[Array, " 6"]:
    """Return the angles of thigh, leg and foot in rad, then their speeds in rad/s."""
    return jnp.concatenate([state.qpos[3:], state.qvel[3:]])


def scene_path(name: str) -> Path:
    """Return the path of a task's MJCF file by the task's name.

    Raises:
        FileNotFoundError: if there is no such file; the message names the folders that were searched.
    """
    for folder in _FOLDERS:
        path = folder / f"{name}.xml"
        if path.is_file():
            return path
    looked = " nor ".join(str(folder) for folder in _FOLDERS)
    raise FileNotFoundError(f"no scene {name}.xml in {looked}: run from a checkout, or install the wheel again")


def robot_scene(name: str, *, timestep: float | None = None, max_contacts: int | None = None) -> Scene:
    """Load one of gymnasium's robots by the name of its file, to be stepped by Euler's method; see `load_scene`.

    Raises:
        ImportError: if gymnasium is not installed.
    """
    # Imported here: only these robots need it.
    try:
        import gymnasium
    except ImportError as error:
        raise ImportError(f"{name} is gymnasium's, not installed: pip install 'mjxgrad[envs]'") from error
    path = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / f"{name}.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return load_scene(model, timestep=timestep, max_contacts=max_contacts)
