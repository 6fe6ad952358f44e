"""A scene controlled by actions under noise, with the start of its optimisation; and the scenes of tasks and robots."""

from pathlib import Path

import equinox as eqx
import mujoco
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from mjxgrad.contact import Softness
from mjxgrad.objective import ActionNoise, closed_loop, open_loop
from mjxgrad.objective.task import Policy, SceneTask
from mjxgrad.scene import Scene, load_scene

# Beside the package in a checkout, inside it when installed from a wheel.
_FOLDERS = (Path(__file__).parents[2] / "mjcf", Path(__file__).parents[1] / "mjcf")


class ActionTask(SceneTask):
    """A task with an objective of its own; see `SceneTask`.

    Attributes:
        start_params: start of the optimisation: the controls, or the policy's parameters.
        policy: function from its parameters and a state to controls; None is open loop.
        stddev: default standard deviation of the noise on the actions, in their units.
    """

    start_params: PyTree = eqx.field(kw_only=True)
    policy: Policy | None = eqx.field(kw_only=True, default=None)
    stddev: float = eqx.field(static=True, kw_only=True, default=0.1)

    def objective(
        self, stddev: float | Float[Array, "..."] | None = None, softness: Softness | None = None
    ) -> ActionNoise:
        """Return the cost under noise on the actions, a function of the controls or of the policy's parameters.

        Args:
            stddev: standard deviation in units of the controls; None takes the task's.
            softness: softness of contact; None leaves it unchanged.
        """
        task, stddev = self.with_softness(softness), self.stddev if stddev is None else stddev
        if self.policy is None:
            return open_loop(task, stddev)
        return closed_loop(task, self.policy, stddev, params=self.start_params)

    def initial_params(self) -> Float[Array, " dim"]:
        """Return the start of the optimisation as the flat vector that estimators take."""
        return ravel_pytree(self.start_params)[0]


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
    """Load one of gymnasium's robots, to be stepped by Euler's method.

    Args:
        name: name of the file without its ending.
        timestep: time step in s, in place of the file's.
        max_contacts: see `load_scene`.

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
