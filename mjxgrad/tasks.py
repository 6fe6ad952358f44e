"""A scene with a cost and noise, a throw over a wall; the classes for your own; and scenes by name."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjxgrad.contact import Softness
from mjxgrad.objective import ParameterNoise, parameter_noise
from mjxgrad.objective.task import InScene, Outcome, SceneTask, Task, finite_cost
from mjxgrad.rollouts import State, initial_state, rollout
from mjxgrad.scene import Scene, load_scene

__all__ = ["BallWall", "Outcome", "SceneTask", "Task", "ball_wall", "scene_path", "wall_softness"]

# Beside the package in a checkout, inside it when installed from a wheel.
_FOLDERS = (Path(__file__).parents[1] / "mjcf", Path(__file__).parent / "mjcf")
# Only the wall is softened: on a softer floor the ball would also sink in and slide farther.
WALL_CONTACT = (("ball", "wall"),)


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
