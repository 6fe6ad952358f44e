"""What a bias and variance experiment can be made on."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, PyTree

import mjxgrad as mg
from experiments.bias_variance.settings import Settings
from mjxgrad.objective import Objective, parameter_noise
from mjxgrad.tasks.ball_wall import WALL_CONTACT, BallWall, ball_wall

# What MuJoCo gives a contact that says nothing: solref 0.02 1 and solimp 0.9 0.95 0.001.
DEFAULT_STIFFNESS = 1 / (0.02 * 1.0) ** 2
DEFAULT_IMPEDANCE, DEFAULT_WIDTH = (0.9, 0.95), 0.001


@dataclass(frozen=True)
class Problem:
    """A cost of one angle, with a knob.

    Attributes:
        stiffness: effective, one per row.
        knob: settings of the knob, with a leading axis of rows.
        has_default: whether the last row is the default contact, not of the sweep.
        cost: of one setting of the knob and one angle.
        objective: of one setting of the knob: the cost under noise.
        task: to draw, if it can be drawn.
    """

    stiffness: Float[np.ndarray, " rows"]
    knob: PyTree
    has_default: bool
    cost: Callable[[PyTree, Float[Array, " 1"]], Float[Array, ""]]
    objective: Callable[[PyTree], Objective]
    task: BallWall | None = None


def problem(settings: Settings) -> Problem:
    """Set up what the settings ask for.

    Args:
        settings: of the run.

    Returns:
        The problem.
    """
    return {"ball_wall": _ball_wall, "ramp": _ramp}[settings.task](settings)


def wall_contact(task: BallWall, stiffness: Float[np.ndarray, " rows"], settings: Settings) -> mg.Softness:
    """Give the wall each stiffness with its own impedance, and MuJoCo's default contact as one more row."""
    rows = len(stiffness)
    pair = [pair.names for pair in task.scene.pairs].index(WALL_CONTACT[0])
    own = task.scene.mj_model.pair_solimp[task.scene.pairs[pair].explicit]
    # MuJoCo reads an impedance of 0 as its smallest, and the scene would warn of it.
    impedance = np.tile(np.clip(own[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP), (rows, 1))
    width = np.full(rows, own[2])
    damping_ratio = np.full(rows, settings.damping_ratio)
    if settings.include_default:
        stiffness, damping_ratio = np.append(stiffness, DEFAULT_STIFFNESS), np.append(damping_ratio, 1.0)
        impedance, width = np.vstack([impedance, DEFAULT_IMPEDANCE]), np.append(width, DEFAULT_WIDTH)
    return mg.Softness(stiffness, damping_ratio, impedance, width, pairs=WALL_CONTACT)


def _ball_wall(settings: Settings) -> Problem:
    task = ball_wall()
    knob = wall_contact(task, np.sort(settings.stiffness), settings)
    stiffness = np.asarray(knob.stiffness)
    for row in range(len(stiffness)):
        # Outside of a trace, where the scene knows its values and warns of what its time step cannot follow.
        task.with_softness(jax.tree.map(lambda leaf, row=row: leaf[row], knob))

    def cost(softness: mg.Softness, angle: Float[Array, " 1"]) -> Float[Array, ""]:
        return task.with_softness(softness).cost(angle)

    def objective(softness: mg.Softness) -> Objective:
        return task.objective(settings.stddev, softness)

    return Problem(stiffness, knob, settings.include_default, cost, objective, task)


class Ramp(eqx.Module):
    """A step that rises from −1 to 1 with a given slope about zero, on a parabola: a contact's jump in one line."""

    slope: Float[Array, ""]

    def __call__(self, angle: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give the cost."""
        return jnp.clip(self.slope * angle[0], -1, 1) + angle[0] ** 2


def _ramp(settings: Settings) -> Problem:
    slopes = np.sort(np.asarray(settings.stiffness))

    def cost(slope: Float[Array, ""], angle: Float[Array, " 1"]) -> Float[Array, ""]:
        return Ramp(slope)(angle)

    def objective(slope: Float[Array, ""]) -> Objective:
        return parameter_noise(Ramp(slope), settings.stddev, dim=1)

    return Problem(slopes, jnp.asarray(slopes, jax.dtypes.canonicalize_dtype(float)), False, cost, objective)
