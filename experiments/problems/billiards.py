r"""A driven ball has to knock another, which it does not touch, to a target.

The cost is $|x_2(T)|^2 + \epsilon \int |u|^2 dt$. Standing still costs 2. The derivative knows nothing of the second ball as
long as the balls do not touch: what solves the task is a force that acts from a distance, or noise under which some rollouts
do touch.

References:
    Zhong, Han, Brikis. Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients w.r.t. Position,
    Velocity and Control? arXiv:2207.05060, task 3. Its optimum for balls that collide in no time is 1.396542.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.objective import ParameterNoise, parameter_noise
from mjxgrad.objective.task import InScene, finite_cost
from mjxgrad.rollouts import Trajectory, initial_state, rollout
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path

_PLACE = (-1.0, -1.0)  # of the knocked ball, from which its joints count (m)


class Billiards(InScene):
    r"""The stroke; see `billiards`.

    Attributes:
        target: where the knocked ball should be in the end, in m.
        effort: $\epsilon$, price of the squared force, in m²/(N² s).
        num_pieces: the force is constant over as many pieces of the time.
        horizon: number of steps, a multiple of `num_pieces`.
    """

    target: Float[Array, " 2"]
    effort: Float[Array, ""]
    num_pieces: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)

    def start(self, force: float = 1.0) -> Float[Array, " dim"]:
        """Return a constant force towards the other ball; below 1.43 N per axis the balls do not touch."""
        return jnp.full(2 * self.num_pieces, force)

    def controls(self, params: Float[Array, " dim"]) -> Float[Array, "horizon 2"]:
        """Return the force at each step, in N, from that of each piece, both axes of a piece side by side."""
        return jnp.repeat(params.reshape(self.num_pieces, 2), self.horizon // self.num_pieces, axis=0)

    def trajectory(self, params: Float[Array, " dim"]) -> Trajectory:
        start = initial_state(self.scene)
        return rollout(self.scene, start, self.controls(params), contact=self.contact)

    def cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the squared distance to the target plus the price of the effort, in m²; NaN if the rollout diverged."""
        trajectory = self.trajectory(params)
        miss = jnp.array(_PLACE) + trajectory.qpos[-1, 2:] - self.target
        duration = self.horizon * self.scene.model.opt.timestep
        effort = self.effort * duration * jnp.sum(params**2) / self.num_pieces
        return finite_cost(miss @ miss + effort, trajectory)

    def with_margin(self, margin: float | Float[Array, ""]) -> "Billiards":
        """Return the same stroke with a contact that begins at another distance, in m: as if the balls were larger."""
        scene = self.scene.with_model(pair_margin=jnp.full_like(self.scene.model.pair_margin, margin))
        return dataclasses.replace(self, scene=scene)

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Return the cost as a function of the forces, with noise on each of them, in N."""
        return parameter_noise(self.cost, stddev, dim=2 * self.num_pieces)


def billiards(*, num_pieces: int = 20) -> Billiards:
    """Load the stroke: the balls are 1.01 m apart, the target is 1.41 m behind the second, and there is one second of time.

    Args:
        num_pieces: the force is constant over as many pieces of the second; with 20 the optimum is dearer by 0.0005 than
            that of a force that may change at any time. It must divide 960, the steps of a second.

    Returns:
        The task; its parameters are the forces, in N.

    Raises:
        ValueError: if `num_pieces` does not divide the steps.
    """
    scene = load_scene(scene_path("billiards"))
    horizon = round(1 / scene.mj_model.opt.timestep)
    if num_pieces < 1 or horizon % num_pieces:
        raise ValueError(f"num_pieces must divide the {horizon} steps of a second, got {num_pieces}")
    return Billiards(scene, jnp.zeros(2), jnp.asarray(0.1), num_pieces, horizon)
